"""How certain a map is: the spread of measurements of perturbed copies of the same labels.

Labels tell on which side of a boundary a voxel's center lies, no more: the boundary may be anywhere
up to half a voxel away. A copy is what the same body might look like if it had been scanned and
labeled again: its boundaries are moved at random within that range, and its voxels lie elsewhere.
This is a parametric bootstrap (Efron and Tibshirani 1993, An Introduction to the Bootstrap, chapter
6). It knows nothing of errors that do not look like this, such as a whole subfield drawn wrongly.
"""

import hashlib
import warnings
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import (
    affine_transform,
    gaussian_filter1d,
    maximum_filter,
    maximum_filter1d,
    minimum_filter,
)
from scipy.spatial.transform import Rotation

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.catalog import measure_maps, summarize
from hipsta_bids.geometry.checks import check_thickness
from hipsta_bids.geometry.digital import box
from hipsta_bids.io.volumes import moved
from hipsta_bids.participant.measure import measure_hemisphere, unfold
from hipsta_bids.protocols import EXPERIMENTAL
from hipsta_bids.protocols.load import for_region
from hipsta_bids.settings import Settings, UncertaintySettings
from hipsta_bids.types import EditedMask, Float, LabelVolume

_Codes = NDArray[np.int64]

#: Copies without which no SD is told.
LEAST = 2
#: Labels of a voxel as one number: tissue, part, and whether it is in the edited mask.
_PART, _MASK = 1 << 8, 1 << 16


@dataclass(frozen=True, eq=False, kw_only=True)
class Uncertainty:
    """Standard deviations over perturbed copies of one hemisphere's labels."""

    copies: int
    """Number of copies that were made."""
    failed: int
    """Number of copies that could not be measured."""
    maps: Mapping[str, Float]
    """(Nx, Ny) by name of the map, in its unit; empty if fewer than half could be measured."""
    summary: Mapping[str, float]
    """By name of the summary measure, in its unit; empty likewise."""

    @property
    def known(self) -> bool:
        """Whether enough copies could be measured."""
        return bool(self.maps)

    @property
    def metrics(self) -> dict[str, Any]:
        """Numbers for the quality record."""
        sd = float(np.nanmedian(self.maps["thickness"])) if self.known else None
        return {
            "uncertainty_copies": self.copies,
            "uncertainty_failed": self.failed,
            "uncertainty_thickness_mm": sd,
            "uncertainty_mean_mm": self.summary["thickness_mean"] if self.known else None,
        }

    @property
    def notes(self) -> list[str]:
        """What a person should know, one line each."""
        if self.known:
            return []
        failed = f"{self.failed} of {self.copies} perturbed copies could not be measured"
        return [f"no uncertainty: {failed}; look at the labels"]


def estimate_uncertainty(
    volume: LabelVolume, hemi: str, settings: Settings, copies: int
) -> Uncertainty:
    """Measure 2 or more perturbed copies of labels, and take the SD (n - 1) at each node.

    The same labels always give the same copies, and the first ones do not depend on how many there
    are.
    """
    measured: list[tuple[Mapping[str, Float], Mapping[str, float]]] = []
    for number in range(copies):
        try:
            copy = perturb(volume, settings.uncertainty, number)
            measured.append(_measure(copy, hemi, settings))
        except GeometryError:
            continue
    sufficient = measured if len(measured) >= max(LEAST, copies / 2) else []
    return Uncertainty(
        copies=copies,
        failed=copies - len(measured),
        maps=_spread([maps for maps, _ in sufficient]),
        summary={k: float(v) for k, v in _spread([summary for _, summary in sufficient]).items()},
    )


def _measure(
    volume: LabelVolume, hemi: str, settings: Settings
) -> tuple[Mapping[str, Float], Mapping[str, float]]:
    """Measure maps and summary alone: no flags, cross-sections or layers."""
    grid = {"spacing": max(settings.grid.spacing, settings.uncertainty.spacing)}
    if settings.body.region in EXPERIMENTAL:
        whole = measure_hemisphere(volume, hemi, settings.changed(grid=grid), _no_clock)
        return whole.maps, whole.summary
    measured = unfold(volume, hemi, settings.changed(grid=grid), _no_clock)
    check_thickness(measured.thickness, measured.boundaries.sheet_thickness, settings.checks)
    tissues = for_region(volume.protocol, settings.body.region).sheet
    return measure_maps(measured), summarize(measured, tissues)


def _no_clock(_: str) -> AbstractContextManager[None]:
    return nullcontext()


def _spread(rows: Sequence[Mapping[str, Any]]) -> dict[str, Float]:
    """SD over copies by name, of what at least two of them know; NaN elsewhere."""
    spread = {}
    for name in rows[0] if rows else ():
        values = np.array([row[name] for row in rows], dtype=np.float64)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # where fewer than two know it
            sd = np.nanstd(np.where(np.isfinite(values), values, np.nan), axis=0, ddof=1)
        spread[name] = np.asarray(sd)
    return spread


def perturb(volume: LabelVolume, settings: UncertaintySettings, number: int) -> LabelVolume:
    """Make one copy: boundaries moved at random, on a voxel grid that lies elsewhere.

    ``number`` tells copies of the same labels apart.
    """
    volume = _cropped(volume)
    generator = np.random.default_rng((_fingerprint(volume), number))
    codes = _encode(volume)
    shape, affine = _other_grid(volume, settings, generator)
    to_volume = np.linalg.inv(volume.affine) @ affine
    near, places = _near_labels(codes, shape, to_volume)
    spread = settings.jitter / np.sqrt(3.0)  # SD of a uniform distribution
    for axis in range(3):
        noise = _smooth_noise(shape, settings.correlation, generator)
        places[axis] += spread * noise[near]
    sampled = np.zeros(np.prod(shape), dtype=np.int64)
    sampled[near] = _likeliest(codes, places)
    sampled = sampled.reshape(shape)
    mask = volume.edited_mask
    return LabelVolume(
        tissue=(sampled % _PART).astype(np.uint8),
        part=(sampled % _MASK // _PART).astype(np.uint8),
        affine=affine,
        protocol=volume.protocol,
        edited_mask=None if mask is None else EditedMask(inside=sampled >= _MASK, voxel=mask.voxel),
        given_ends=volume.given_ends,
    )


def _cropped(volume: LabelVolume) -> LabelVolume:
    """Leave out what lies round the labels, but for two voxels."""
    labeled = _encode(volume) > 0
    if not labeled.any():
        return volume
    indices = np.argwhere(labeled)
    low = np.maximum(indices.min(axis=0) - 2, 0)
    around = box(low, indices.max(axis=0) + 3)
    mask = volume.edited_mask
    return replace(
        volume,
        tissue=volume.tissue[around],
        part=volume.part[around],
        affine=moved(volume.affine, low),
        edited_mask=None if mask is None else replace(mask, inside=mask.inside[around]),
    )


def _fingerprint(volume: LabelVolume) -> int:
    """Turn the labels' content into a number."""
    content = hashlib.sha256(repr(volume.tissue.shape).encode())
    for array in (volume.tissue, volume.part, volume.affine.round(6) + 0.0):
        content.update(np.ascontiguousarray(array).tobytes())
    return int.from_bytes(content.digest()[:16], "big")


def _encode(volume: LabelVolume) -> _Codes:
    codes: _Codes = volume.tissue + np.int64(_PART) * volume.part
    if volume.edited_mask is not None:
        codes += _MASK * volume.edited_mask.inside
    return codes


def _other_grid(
    volume: LabelVolume, settings: UncertaintySettings, generator: np.random.Generator
) -> tuple[tuple[int, int, int], Float]:
    """Shape and affine of the same grid, turned about its middle and shifted by part of a voxel."""
    matrix = volume.affine[:3, :3]
    angles = generator.uniform(-settings.rotation, settings.rotation, 3)
    turned = Rotation.from_euler("xyz", angles, degrees=True).as_matrix() @ matrix
    size = np.array(volume.tissue.shape) - 1
    corners = np.array(np.meshgrid(*([0, n] for n in size))).reshape(3, -1)
    middle = size[:, None] / 2
    reach = np.linalg.solve(turned, matrix @ (corners - middle))
    low = np.floor(reach.min(axis=1))
    count = np.ceil(reach.max(axis=1)) - low + 1
    affine = np.eye(4)
    affine[:3, :3] = turned
    affine[:3, 3:] = volume.affine[:3, 3:] + matrix @ middle
    affine[:3, 3] += turned @ (low + generator.uniform(-0.5, 0.5, 3))
    return (int(count[0]), int(count[1]), int(count[2])), affine


def _near_labels(
    codes: _Codes, shape: tuple[int, int, int], to_volume: Float
) -> tuple[NDArray[np.intp], Float]:
    """Voxels of a copy that may get a label (N,), and their places (3, N) in the volume's voxels.

    They lie within three voxels of one that has a label.
    """
    labeled = np.pad(codes > 0, 4)
    for axis in range(3):
        labeled = maximum_filter1d(labeled.view(np.uint8), 7, axis=axis) > 0
    near = np.flatnonzero(
        affine_transform(
            labeled.view(np.uint8), to_volume[:3, :3], to_volume[:3, 3] + 4, shape, order=0
        )
    )
    index = np.array(np.unravel_index(near, shape))
    return near, to_volume[:3, :3] @ index + to_volume[:3, 3:]


def _smooth_noise(shape: tuple[int, ...], length: float, generator: np.random.Generator) -> Float:
    """Gaussian noise of SD 1 at the voxels (N,), correlated over ``length`` voxels.

    White noise smoothed with a Gaussian of SD s has the autocorrelation exp(-d^2 / 4 s^2), which is
    1/e at the distance d = 2 s.
    """
    noise: NDArray[np.float32] = generator.standard_normal(shape, dtype=np.float32)
    for axis in range(3):
        impulse = np.zeros(shape[axis])
        impulse[0] = 1.0
        kernel = gaussian_filter1d(impulse, length / 2, mode="wrap")
        noise = gaussian_filter1d(noise, length / 2, axis=axis, mode="wrap")
        noise /= np.float32(np.linalg.norm(kernel))
    return noise.ravel().astype(np.float64)


def _likeliest(codes: _Codes, places: Float) -> _Codes:
    """Code with most weight in linear interpolation at places (3, N), in voxels; outside 0."""
    padded = np.pad(codes, 2)
    last = np.array(padded.shape)[:, None] - 2
    places = np.clip(places + 2, 0, last - 1e-6)
    nearest = tuple(np.rint(places).astype(np.int64))
    likeliest: _Codes = padded[nearest]
    # Most voxels lie among voxels of one label only.
    low, high = (f(padded, 3, mode="nearest") for f in (minimum_filter, maximum_filter))
    mixed = np.flatnonzero((low != high)[nearest])
    corner = np.floor(places[:, mixed]).astype(np.int64)
    share = places[:, mixed] - corner
    offsets = np.indices((2, 2, 2)).reshape(3, -1).T
    kinds = np.array([padded[tuple(corner + offset[:, None])] for offset in offsets])
    weights = np.array(
        [np.where(offset[:, None] == 1, share, 1 - share).prod(axis=0) for offset in offsets]
    )
    votes = np.array([(weights * (kinds == kind)).sum(axis=0) for kind in kinds])
    likeliest[mixed] = kinds[votes.argmax(axis=0), np.arange(len(mixed))]
    return likeliest
