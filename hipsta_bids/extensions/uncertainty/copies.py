"""How certain a map is: the spread of measurements of perturbed copies of the same labels.

A copy is what the same body might look like if it had been scanned and labeled again. A person
draws boundaries a little elsewhere, over millimeters alike, and ends the body at another slice;
labels tell on which side of a boundary a voxel's center lies, no more; and voxels lie elsewhere.
This is a parametric bootstrap (Efron and Tibshirani 1993, An Introduction to the Bootstrap, chapter
6). It does not include other errors, such as a whole subfield drawn wrongly.
"""

import hashlib
import warnings
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.ndimage import (
    affine_transform,
    map_coordinates,
    maximum_filter,
    maximum_filter1d,
    minimum_filter,
)
from scipy.spatial.distance import pdist, squareform
from scipy.spatial.transform import Rotation

from hipsta_bids.errors import GeometryError
from hipsta_bids.extensions.uncertainty.settings import UncertaintySettings
from hipsta_bids.geometry.body import extract_body
from hipsta_bids.geometry.catalog import measure_maps, summarize
from hipsta_bids.geometry.checks import check_thickness, raise_flags
from hipsta_bids.geometry.digital import box, to_ras
from hipsta_bids.geometry.ends import EndPlanes
from hipsta_bids.geometry.measures import pool_sd
from hipsta_bids.geometry.shares import wall_sd
from hipsta_bids.geometry.sheet_checks import RIVAL_OFF
from hipsta_bids.io.volumes import moved
from hipsta_bids.participant.measure import measure_hemisphere, unfold
from hipsta_bids.protocols import EXPERIMENTAL
from hipsta_bids.protocols.load import for_region
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.settings import CheckSettings, Settings
from hipsta_bids.types import EditedMask, Finding, Float, GivenEnd, HemisphereMaps, LabelVolume

_Codes = NDArray[np.int64]

#: Least grid spacing of copies, mm: what all copies share cancels out, and time matters.
COPY_SPACING = 0.46
#: Least SD of walls whose probabilities leave no doubt, mm.
LEAST_DOUBT = 0.04
#: Copies without which no SD is told, and which make a mode.
LEAST = 2
POOLED = 3
"""Nodes along x and y over which variances are averaged: eight copies know one to a half."""
MODE_RATIO = 1.5
"""Ratio of the distance between two modes to that within them, means over pairs of copies."""
#: Labels of a voxel as one number: tissue, part, and whether it is in the edited mask.
_PART, _MASK = 1 << 8, 1 << 16
_MARGIN = 3
"""Nodes of noise beyond the voxels at each side, 4.5 SD of the kernel."""


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
    modes: Finding | None = None
    """Two groups of copies whose maps differ, if there are any; its value is in mm."""

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
            "uncertainty_modes": (2 if self.modes else 1) if self.known else None,
            "uncertainty_modes_mm": self.modes.value if self.modes else 0.0,
        }

    @property
    def notes(self) -> list[str]:
        """Notes for the user, one line each."""
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
    ends = extract_body(volume, settings.body.changed(region="body")).ends
    for number in range(copies):
        try:
            copy = perturb(volume, ends, settings.of(UncertaintySettings), number)
            measured.append(_measure(copy, hemi, settings))
        except GeometryError:
            continue
    sufficient = measured if len(measured) >= max(LEAST, copies / 2) else []
    return Uncertainty(
        copies=copies,
        failed=copies - len(measured),
        maps=_spread([maps for maps, _ in sufficient]),
        summary={k: float(v) for k, v in _spread([summary for _, summary in sufficient]).items()},
        modes=find_modes([maps["thickness"] for maps, _ in sufficient], settings.checks),
    )


def add_uncertainty(maps: HemisphereMaps, spread: Uncertainty) -> HemisphereMaps:
    """Return the maps with the numbers of their uncertainty, and its flag if there is one."""
    flags = raise_flags([spread.modes] if spread.modes else [], maps.sheet, str)
    return replace(maps, qc={**maps.qc, **spread.metrics}, flags=(*maps.flags, *flags))


def _measure(
    volume: LabelVolume, hemi: str, settings: Settings
) -> tuple[Mapping[str, Float], Mapping[str, float]]:
    """Measure maps and summary alone: no flags, cross-sections or layers."""
    grid = {"spacing": max(settings.grid.spacing, COPY_SPACING)}
    if settings.body.region in EXPERIMENTAL:
        whole = measure_hemisphere(volume, hemi, settings.changed(grid=grid), _no_clock)
        return whole.maps, whole.summary
    measured = unfold(volume, hemi, settings.changed(grid=grid), _no_clock, rivals=False)
    check_thickness(measured.thickness, measured.boundaries.sheet_thickness, settings.checks)
    tissues = for_region(volume.protocol, settings.body.region).sheet
    return measure_maps(measured), summarize(measured, tissues)


def _no_clock(_: str) -> AbstractContextManager[None]:
    return nullcontext()


def _spread(rows: Sequence[Mapping[str, Any]]) -> dict[str, Float]:
    """Compute the SD over copies by name, where two know it; of maps around each node."""
    spread = {}
    for name in rows[0] if rows else ():
        values = np.array([row[name] for row in rows], dtype=np.float64)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # where fewer than two know it
            sd = np.nanstd(np.where(np.isfinite(values), values, np.nan), axis=0, ddof=1)
        spread[name] = pool_sd(sd, POOLED) if sd.ndim else np.asarray(sd)
    return spread


def find_modes(maps: Sequence[Float], settings: CheckSettings) -> Finding | None:
    """Find two groups of copies, by average linkage of RMS differences of maps (Nx, Ny), mm.

    Each has two copies or more, and copies of different groups differ much more than copies of one.
    """
    if len(maps) < 2 * LEAST:
        return None
    values = np.array([values.ravel() for values in maps])
    values = values[:, np.isfinite(values).all(axis=0)]
    distance = pdist(values) / np.sqrt(values.shape[1])
    second = fcluster(linkage(distance, "average"), 2, "maxclust") == 2  # noqa: PLR2004 -- two
    counts = np.array([np.sum(~second), np.sum(second)])
    across = squareform(second[:, None] != second, checks=False)
    if counts.min() < LEAST or distance[across].mean() < MODE_RATIO * distance[~across].mean():
        return None
    difference = values[second].mean(axis=0) - values[~second].mean(axis=0)
    # Means over few copies differ by chance, too.
    by_chance = (distance[~across] ** 2).mean() / 2 * (1 / counts).sum()
    rms = float(np.sqrt(max((difference**2).mean() - by_chance, 0.0)))
    return Finding(
        reason="second-choice",
        value=rms,
        limit=settings.flag_rival,
        text=f"perturbed copies of the labels have one of two maps ({counts[0]} and {counts[1]} "
        f"copies), which differ by {rms:.2f} mm (RMS)",
        remedy="look at the edges of the sheet and at repairs",
        share=float((np.abs(difference) > RIVAL_OFF).mean()),
    )


def perturb(
    volume: LabelVolume, ends: EndPlanes, settings: UncertaintySettings, number: int
) -> LabelVolume:
    """Make the copy of a number: boundaries and ends are moved, and the voxels lie elsewhere."""
    volume = _cropped(volume)
    generator = np.random.default_rng((_fingerprint(volume), number))
    codes = _encode(volume)
    shape, affine = _other_grid(volume, settings, generator)
    to_volume = np.linalg.inv(volume.affine) @ affine
    near, places = _near_labels(codes, shape, to_volume)
    voxel = np.linalg.norm(affine[:3, :3], axis=0)
    by_voxel = settings.jitter / np.sqrt(3.0)  # SD of a uniform distribution
    smooth = np.sqrt(np.maximum((settings.relabeling / voxel) ** 2 - by_voxel**2, 0.0))
    share = smooth / np.sqrt(len(settings.correlation))
    if volume.shares:
        share = _doubt(volume, places) / voxel[:, None] / np.sqrt(len(settings.correlation))
        by_voxel = 0.0
    for axis in range(3):
        places[axis] += by_voxel * _smooth_noise(shape, np.ones(3), generator)[near]
        for length in settings.correlation:
            noise = _smooth_noise(shape, length / voxel, generator)[near]
            places[axis] += share[axis] * noise
    sampled = np.zeros(np.prod(shape), dtype=np.int64)
    sampled[near] = _likeliest(codes, places)
    sampled = sampled.reshape(shape)
    mask = volume.edited_mask
    return LabelVolume(
        tissue=(sampled % _PART).astype(np.uint8),
        part=(sampled % _MASK // _PART).astype(np.uint8),
        shares=_move_shares(volume, shape, near, places),
        affine=affine,
        protocol=volume.protocol,
        edited_mask=None if mask is None else EditedMask(inside=sampled >= _MASK, voxel=mask.voxel),
        given_ends=_moved_ends(volume, ends, settings, generator),
    )


def _doubt(volume: LabelVolume, places: Float) -> Float:
    """Read how far walls may lie elsewhere: SD (N,), mm, by probabilities at places (3, N)."""
    sheet = [kind for kind in volume.shares if kind in volume.protocol.sheet]
    share = np.clip(sum(volume.shares[kind] for kind in sheet), 0, 1)
    width = wall_sd(share, np.linalg.norm(volume.affine[:3, :3], axis=0))
    return np.hypot(map_coordinates(width, places, order=1, mode="nearest"), LEAST_DOUBT)


def _move_shares(
    volume: LabelVolume, shape: tuple[int, int, int], near: NDArray[np.intp], places: Float
) -> dict[int, NDArray[np.float32]]:
    """Sample shares at places (3, N), in voxels, for some voxels (N,) of another grid."""
    shares = {}
    for kind, share in volume.shares.items():
        moved_share = np.full(np.prod(shape), kind == Tissue.BACKGROUND, dtype=np.float32)
        moved_share[near] = map_coordinates(share, places, order=1, mode="nearest")
        shares[kind] = moved_share.reshape(shape)
    return shares


def _moved_ends(
    volume: LabelVolume,
    ends: EndPlanes,
    settings: UncertaintySettings,
    generator: np.random.Generator,
) -> tuple[GivenEnd, ...]:
    """Move both end planes along their normals, if the settings ask for it."""
    if not settings.end_shift:
        return volume.given_ends
    half_slices = 2 * settings.end_shift * ends.half_slice
    sds = [max(half_slices, plane.uncertainty) for plane in (ends.posterior, ends.anterior)]
    points = to_ras(np.argwhere(np.isin(volume.tissue, volume.protocol.sheet)), volume.affine)
    posterior, anterior = generator.normal(0.0, sds)
    return (
        ends.posterior.moved("posterior", posterior, points),
        ends.anterior.moved("anterior", anterior, points),
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
        shares={kind: share[around] for kind, share in volume.shares.items()},
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


def _smooth_noise(shape: Sequence[int], length: Float, generator: np.random.Generator) -> Float:
    """Draw Gaussian noise of SD 1 at voxels (N,), correlated over ``length`` (3,) voxels.

    White noise at nodes, blurred by a Gaussian of SD s, has the autocorrelation exp(-d^2 / 4 s^2),
    which is 1/e at the distance d = 2 s. Nodes are 1.5 s apart, few enough and hardly visible.
    """
    kernels = []
    for count, reach in zip(shape, length, strict=True):
        step = 0.75 * reach
        nodes = step * np.arange(-_MARGIN, np.ceil((count - 1) / step) + _MARGIN + 1)
        kernel = np.exp(-2 * ((np.arange(count)[:, None] - nodes) / reach) ** 2)
        kernels.append((kernel / np.linalg.norm(kernel, axis=1)[:, None]).astype(np.float32))
    nodes_shape = [kernel.shape[1] for kernel in kernels]
    noise = generator.standard_normal(nodes_shape, dtype=np.float32)
    for kernel in kernels:
        noise = np.tensordot(noise, kernel, (0, 1))  # each axis in turn
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
