"""Other volumes on the sheet, at its points or averaged over depth, and maps in regions of it."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hipsta_bids.extensions.signals.settings import MapSettings
from hipsta_bids.geometry.digital import to_ras
from hipsta_bids.geometry.measures import column_area
from hipsta_bids.inputs.regions import Regions
from hipsta_bids.types import Bool, Float, ScalarVolume, Sheet


@dataclass(frozen=True, eq=False, kw_only=True)
class SampledMap:
    """A volume on the sheet."""

    values: Float
    """(Nx, Ny, T), NaN where missing."""
    outside: float
    """Share of the sampled points that lie outside the field of view."""
    unknown: float
    """Share of the points inside the field of view that have no known value."""

    @property
    def missing(self) -> float:
        """Share of the values that are missing."""
        return float(np.isnan(self.values).mean())


def sample_on_sheet(
    volume: ScalarVolume,
    sheet: Sheet,
    settings: MapSettings,
    *,
    sampling: str,
    interpolation: str,
) -> SampledMap:
    """Read a volume averaged over the sheet's ``depth``, or on its mid-surface or a wall.

    The field of view ends at the outer faces of the outermost voxels; from their centers outward
    the value is the voxel's.
    """
    levels = {"mid": [sheet.middle], "interior": [0], "exterior": [-1]}
    points = sheet.points if sampling == "depth" else sheet.points[:, :, levels[sampling]]
    index, inside = _locate(volume, points.reshape(-1, 3))
    read = _linear if interpolation == "linear" else _nearest
    values = read(volume.values, index, settings.min_known)
    values[~inside] = np.nan
    # Columns without a position are missing, but do not suggest a wrong field of view.
    defined = np.isfinite(points.reshape(-1, 3)).all(axis=1)
    finite = ~np.isnan(values[inside])
    columns = values.reshape(*points.shape[:3], -1)
    merge = _mean if interpolation == "linear" else _most_frequent
    return SampledMap(
        values=merge(columns, settings.min_known),
        outside=float((~inside)[defined].mean()) if defined.any() else 0.0,
        unknown=float(1 - finite.mean()) if finite.size else 0.0,
    )


def _locate(volume: ScalarVolume, points: Float) -> tuple[Float, Bool]:
    """Index (N, 3) into the values, clamped to centers of voxels, and which points are inside."""
    index = to_ras(points, np.linalg.inv(volume.affine))
    whole = index + volume.start
    shape = np.array(volume.shape)
    slack = 0.5 + 1e-6  # rounding of affines must not decide about points on the outer face
    with np.errstate(invalid="ignore"):
        inside = np.all((whole >= -slack) & (whole <= shape - 1 + slack), axis=1)
    index = np.where(inside[:, None], index, 0.0)
    return np.clip(index, 0, np.array(volume.values.shape[:3]) - 1), inside


def _linear(values: Float, index: Float, min_known: float) -> Float:
    """Interpolate (N, T) between eight voxels, by those of them that are known."""
    low = np.floor(index).astype(np.intp)
    share = index - low
    last = np.array(values.shape[:3]) - 1
    total = np.zeros((len(index), values.shape[3]))
    weight = np.zeros_like(total)
    for corner in np.ndindex(2, 2, 2):
        voxel = np.minimum(low + corner, last)
        part = np.prod(np.where(corner, share, 1 - share), axis=1)[:, None]
        sample = values[tuple(voxel.T)]
        finite = np.isfinite(sample)
        total += part * np.where(finite, sample, 0.0)
        weight += part * finite
    return _quotient(total, weight, min_known)


def _nearest(values: Float, index: Float, _: float) -> Float:
    sample = values[tuple(np.rint(index).astype(np.intp).T)]
    return np.asarray(np.where(np.isfinite(sample), sample, np.nan))


def _depth_weights(count: int) -> Float:
    """Weights of evenly spaced points of a column, (1, 1, count, 1), with sum 1."""
    weights = np.ones(count)
    weights[[0, -1]] = 0.5
    return np.asarray(weights / weights.sum())[None, None, :, None]


def _mean(columns: Float, min_known: float) -> Float:
    finite = np.isfinite(columns)
    weights = _depth_weights(columns.shape[2])
    total = (weights * np.where(finite, columns, 0.0)).sum(axis=2)
    return _quotient(total, (weights * finite).sum(axis=2), min_known)


def _most_frequent(columns: Float, min_known: float) -> Float:
    """Take the value with most weight along each column; of equals, that nearest the middle."""
    count = columns.shape[2]
    order = np.argsort(np.abs(np.arange(count) - count // 2), kind="stable")
    columns, weights = columns[:, :, order], _depth_weights(count)[:, :, order]
    equal = columns[:, :, :, None] == columns[:, :, None]
    votes = (equal * weights[:, :, None]).sum(axis=3)
    best = np.take_along_axis(columns, votes.argmax(axis=2)[:, :, None], axis=2)[:, :, 0]
    known_weight = (np.isfinite(columns) * weights).sum(axis=2)
    return np.where(known_weight >= min_known, best, np.nan)


def _quotient(total: Float, weight: Float, least: float) -> Float:
    """Divide where the weight suffices; NaN elsewhere."""
    sufficient = (weight >= least) & (weight > 0)
    return np.where(sufficient, total / np.where(sufficient, weight, 1.0), np.nan)


@dataclass(frozen=True, eq=False, kw_only=True)
class RegionStatistics:
    """One number per region, (R,) each; NaN where a region has no value."""

    n_points: Float
    """Number of points."""
    n_valid: Float
    """Number of points whose columns were measured directly."""
    area: Float
    """Area of the mid-surface round the points, mm2."""
    mean: Mapping[str, Float]
    """Mean of each map over its valid and known points."""
    sd: Mapping[str, Float]
    """Standard deviation of each map, with n - 1 in the denominator."""
    mode: Mapping[str, Float]
    """Most frequent value of each map of labels; the smallest of equals."""


def summarize_regions(
    regions: Regions, sheet: Sheet, maps: Mapping[str, Float], labels: Mapping[str, Float]
) -> RegionStatistics:
    """Summarize maps of numbers and maps of labels, NaN where missing, in regions."""
    member = regions.member & sheet.valid
    moments = {name: _moments(member, values) for name, values in maps.items()}
    return RegionStatistics(
        n_points=regions.member.sum(axis=(1, 2)).astype(np.float64),
        n_valid=member.sum(axis=(1, 2)).astype(np.float64),
        area=(regions.member * column_area(sheet)).sum(axis=(1, 2)),
        mean={name: mean for name, (mean, _) in moments.items()},
        sd={name: sd for name, (_, sd) in moments.items()},
        mode={name: _mode(member, values) for name, values in labels.items()},
    )


def _moments(member: Bool, values: Float) -> tuple[Float, Float]:
    """Mean and standard deviation (R,) of a map over its known members."""
    masked = np.where(member & np.isfinite(values), values, np.nan)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of regions without two known points
        mean, sd = np.nanmean(masked, axis=(1, 2)), np.nanstd(masked, axis=(1, 2), ddof=1)
    return np.asarray(mean), np.asarray(sd)


def _mode(member: Bool, values: Float) -> Float:
    """Most frequent label (R,)."""
    finite = np.isfinite(values)
    kinds, code = np.unique(values[finite], return_inverse=True)
    if not len(kinds):
        return np.full(len(member), np.nan)
    votes = (member[:, finite][:, :, None] & (code[:, None] == np.arange(len(kinds)))).sum(axis=1)
    return np.where(votes.any(axis=1), kinds[votes.argmax(axis=1)], np.nan)
