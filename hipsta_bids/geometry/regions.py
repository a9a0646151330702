"""Regions drawn on the sheet: what the maps are in each of them."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hipsta_bids.artifacts import Bool, Float, Sheet
from hipsta_bids.geometry.measures import column_area


@dataclass(frozen=True, eq=False, kw_only=True)
class Regions:
    """Sets of sheet points, which may overlap."""

    names: tuple[str, ...]
    member: Bool
    """(R, Nx, Ny) whether a point belongs to a region."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RegionStatistics:
    """One number per region, (R,) each; NaN where there is nothing to take it of."""

    n_points: Float
    n_valid: Float
    """Points whose columns were measured directly."""
    area: Float
    """Of the mid-surface round the points, mm2."""
    mean: Mapping[str, Float]
    """Of each map, over its valid and known points."""
    sd: Mapping[str, Float]
    """With n - 1 in the denominator."""
    mode: Mapping[str, Float]
    """Most frequent value of each map of labels; the smallest of equals."""


def summarize_regions(
    regions: Regions, sheet: Sheet, maps: Mapping[str, Float], labels: Mapping[str, Float]
) -> RegionStatistics:
    """Sum up maps in regions.

    Parameters
    ----------
    regions : Regions
    sheet : Sheet
    maps : mapping of str to (Nx, Ny) float64
        Numbers, NaN where missing.
    labels : mapping of str to (Nx, Ny) float64
        Labels, NaN where missing.

    Returns
    -------
    RegionStatistics

    Notes
    -----
    Each quadrilateral of the grid belongs to its corners in quarters.
    """
    member = regions.member & sheet.valid
    area = column_area(sheet)
    moments = {name: _moments(member, values) for name, values in maps.items()}
    return RegionStatistics(
        n_points=regions.member.sum(axis=(1, 2)).astype(np.float64),
        n_valid=member.sum(axis=(1, 2)).astype(np.float64),
        area=(regions.member * area).sum(axis=(1, 2)),
        mean={name: mean for name, (mean, _) in moments.items()},
        sd={name: sd for name, (_, sd) in moments.items()},
        mode={name: _mode(member, values) for name, values in labels.items()},
    )


def _moments(member: Bool, values: Float) -> tuple[Float, Float]:
    known = member & np.isfinite(values)
    count = known.sum(axis=(1, 2))
    safe = np.where(np.isfinite(values), values, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(known, safe, 0.0).sum(axis=(1, 2)) / count
        off = np.where(known, safe - mean[:, None, None], 0.0)
        sd = np.sqrt((off**2).sum(axis=(1, 2)) / np.where(count > 1, count - 1, np.nan))
    return np.asarray(mean), np.asarray(sd)


def _mode(member: Bool, values: Float) -> Float:
    known = np.isfinite(values)
    kinds, code = np.unique(values[known], return_inverse=True)
    if not len(kinds):
        return np.full(len(member), np.nan)
    votes = (member[:, known][:, :, None] & (code[:, None] == np.arange(len(kinds)))).sum(axis=1)
    return np.where(votes.any(axis=1), kinds[votes.argmax(axis=1)], np.nan)
