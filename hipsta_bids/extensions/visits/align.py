"""Rigid alignment of the labels of one participant's visits, with no visit as target.

Moments of the labels give a first alignment. Then all smoothed label images are registered to their
mean by Gauss and Newton's method; all have the same Jacobian matrix, so that their mean motion is
zero and their order does not matter.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry import digital
from hipsta_bids.geometry.ends import hippocampal_voxels, long_axis
from hipsta_bids.protocols.protocol import CORE, LATERAL_END, MEDIAL_END, Tissue
from hipsta_bids.types import Bool, Float, LabelVolume

#: Standard deviations of the Gaussian on label images, from coarse to fine, mm.
SIGMAS = (2.0, 1.0)
#: Distance of the points at which images are compared, in standard deviations.
STEP = 0.8
#: The outline of the hippocampus weighs so often as much as that of a subfield.
OUTLINE_WEIGHT = 1.5
#: Voxels are averaged to blocks of at most this size before they are smoothed, in standard
#: deviations.
BIN = 0.5
#: Points with less than this share of the largest squared slope are left out.
LEAST_SLOPE = 0.02
#: Near labels of a head or tail without subfields, subfields end where a person ended them. Points
#: are left out where the smoothed image of these labels exceeds this.
HIDDEN = 0.01
#: The slopes of the mean are computed so often at each scale, ...
ROUNDS = 2
#: ... with at most so many steps each, until the labels move by less than this, mm.
STEPS, CONVERGED = 15, 1e-5
#: Visits on the same voxel grid that move by less than this (RMS) share a space, mm: aligning them
#: would add noise only. Their motions shrink smoothly, to 1 - 1/e at this distance.
SHARED = 0.3

_REACH = 10.0  # mm, from the center to a point on the long axis, and so the scale of angles
_GROUPS: tuple[tuple[Tissue, ...], ...] = (MEDIAL_END, (Tissue.CA1,), LATERAL_END, CORE)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Image:
    """Smoothed label images of a visit."""

    channels: list[NDArray[np.float32]]
    """Outline, hidden ends, and a channel for each group of subfields."""
    to_index: Float
    """(4, 4), RAS mm to index."""
    order: Literal[1, 3]
    """Order of interpolation."""

    def at(self, channel: int, points: Float) -> Float:
        """Sample a channel at points (N, 3), RAS mm."""
        index = digital.to_ras(points, self.to_index).T
        values = self.channels[channel]
        sampled = ndimage.map_coordinates(values, index, order=self.order, prefilter=False)
        return np.asarray(sampled, dtype=np.float64)


def align(volumes: Sequence[LabelVolume], hemi: str, *, shared: bool = False) -> list[Float]:
    """Return motions (4, 4) from the participant's frame to the space of each visit, RAS mm.

    The frame has its origin in the middle of the labels, and its axes point right, along the body
    to the head, and up. Its position relative to the labels does not depend on their pose. With
    ``shared``, the visits share a space.
    """
    marks = np.stack([_landmarks(volume) for volume in volumes])
    marks = marks[:, np.isfinite(marks).all(axis=(0, 2))]
    common = [_frame(marks.mean(axis=0), hemi)] * len(volumes)
    centers = marks[:, :2].mean(axis=1)
    distance = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    if shared and distance > _REACH:
        raise GeometryError(
            f"the labels of a visit lie {distance:.0f} mm from their mean: the visits share no "
            "space; use --longitudinal without shared",
            reason="visit-unlike",
        )
    if shared or len(volumes) == 1:
        return common
    motions = _procrustes(marks, hemi)
    for sigma in SIGMAS:
        motions = _register(volumes, motions, sigma)
    if _on_one_grid(volumes):
        share = -np.expm1(-((_spread(volumes, motions) / SHARED) ** 4))
        motions = [_part(frame, m, share) for frame, m in zip(common, motions, strict=True)]
    return motions


def _part(start: Float, end: Float, share: float) -> Float:
    """Return the motion (4, 4) that is a share of the way from one to another."""
    way = np.linalg.inv(start) @ end
    turn = Rotation.from_matrix(way[:3, :3]) ** share
    return np.asarray(start @ digital.affine_of(turn.as_matrix(), share * way[:3, 3]))


def _landmarks(volume: LabelVolume) -> Float:
    """Find six points (6, 3), RAS mm: two on the long axis, and centers of groups of subfields.

    NaN where a group has no voxel.
    """
    hippocampal = hippocampal_voxels(volume)
    points = digital.voxel_points(hippocampal, volume.affine)
    if not len(points):
        raise GeometryError(
            "no voxel of the hippocampus: check the protocol", reason="no-sheet-labels"
        )
    axis = long_axis(points, volume.part[hippocampal])
    center, tissue = points.mean(axis=0), volume.tissue[hippocampal]
    groups = [points[np.isin(tissue, group)] for group in _GROUPS]
    centers = [g.mean(axis=0) if len(g) else np.full(3, np.nan) for g in groups]
    return np.stack([center - _REACH * axis, center + _REACH * axis, *centers])


def _frame(marks: Float, hemi: str) -> Float:
    """Place the frame (4, 4) at landmarks (N, 3), RAS mm: the middle, and right, anterior, up."""
    axis = (marks[1] - marks[0]) / np.linalg.norm(marks[1] - marks[0])
    # From the most lateral group of subfields to the most medial one.
    medial = marks[2] - marks[3] if len(marks) > 3 else np.array([1.0, 0.0, 0.0])  # noqa: PLR2004
    medial = medial - (medial @ axis) * axis
    right = medial / np.linalg.norm(medial) * (1.0 if hemi == "L" else -1.0)
    matrix = np.column_stack([right, axis, np.cross(right, axis)])
    return np.asarray(digital.affine_of(matrix, marks[:2].mean(axis=0)))


def _procrustes(marks: Float, hemi: str) -> list[Float]:
    """Superimpose landmarks (K, N, 3); return the motion of each visit (generalized Procrustes)."""
    centers = marks.mean(axis=1, keepdims=True)
    shapes = marks - centers
    turns = np.stack([np.eye(3)] * len(marks))
    mean = shapes[0]
    for _ in range(50):
        turns = np.stack([Rotation.align_vectors(shape, mean)[0].as_matrix() for shape in shapes])
        mean = np.einsum("kji,knj->ni", turns, shapes) / len(marks)
    local = _frame(mean, hemi)
    return [
        np.asarray(digital.affine_of(turn, center[0]) @ local)
        for turn, center in zip(turns, centers, strict=True)
    ]


def _register(volumes: Sequence[LabelVolume], motions: list[Float], sigma: float) -> list[Float]:
    """Register the visits to their mean at one scale."""
    images = [_smooth(volume, sigma) for volume in volumes]
    for _ in range(ROUNDS):
        grid, step = _grid(volumes, motions, STEP * sigma)
        points, channel, jacobian = _slopes(images, motions, grid, step)
        inverse = np.linalg.inv(jacobian.T @ jacobian)
        weight = np.where(channel == 0, OUTLINE_WEIGHT, 1.0)
        for _ in range(STEPS):
            pairs = zip(images, motions, strict=True)
            values = np.stack([_sample(*pair, points, channel) for pair in pairs])
            residual = weight * (values - values.mean(axis=0))
            moves = -(residual @ jacobian) @ inverse.T
            motions = [m @ _motion(move) for m, move in zip(motions, moves, strict=True)]
            if np.abs(moves).max() < CONVERGED:
                break
    return motions


def _motion(move: Float) -> Float:
    """Return the motion (4, 4) of a shift and turns (6,), mm at the reach of the long axis."""
    turn = Rotation.from_rotvec(move[3:] / _REACH).as_matrix()
    return np.asarray(digital.affine_of(turn, move[:3]))


def _sample(image: _Image, motion: Float, points: Float, channel: NDArray[np.intp]) -> Float:
    """Sample one channel at each of some points (N, 3) of the frame; channels are in order."""
    moved = digital.to_ras(points, motion)
    parts = [image.at(number, moved[channel == number]) for number in np.unique(channel)]
    return np.concatenate(parts)


def _smooth(volume: LabelVolume, sigma: float) -> _Image:
    """Smooth the label images; thick and thin slices end up equally smooth."""
    foreground = hippocampal_voxels(volume)
    around = digital.box_around(digital.positions(foreground))
    tissue, foreground = volume.tissue[around], foreground[around]
    masks = [foreground, foreground & (tissue == Tissue.HIPPOCAMPUS)]
    masks += [np.isin(tissue, group) for group in _GROUPS]
    edges = np.linalg.norm(volume.affine[:3, :3], axis=0)
    # Fine voxels are averaged first, which takes a tenth of the time.
    size = np.maximum(np.floor(BIN * sigma / edges), 1).astype(int)
    edges = edges * size
    deviation = np.sqrt(np.maximum(sigma**2 - edges**2 / 12, 0.0)) / edges
    pad = np.ceil(3 * sigma / edges).astype(int) + 1
    order: Literal[1, 3] = 3 if edges.max() > BIN * sigma else 1
    channels = []
    for mask in masks:
        padded = np.pad(_averaged(mask, size), [(n, n) for n in pad])
        smooth = ndimage.gaussian_filter(padded, deviation, truncate=3.0)
        channels.append(ndimage.spline_filter(smooth, output=np.float32) if order > 1 else smooth)
    # The first block lies so many voxels after the first voxel of the box.
    first = digital.low_corner(around) + (size - 1) / 2 - pad * size
    affine = digital.affine_of(
        volume.affine[:3, :3] * size, volume.affine[:3, :3] @ first + volume.affine[:3, 3]
    )
    return _Image(
        channels=channels, to_index=np.asarray(np.linalg.inv(affine), dtype=np.float64), order=order
    )


def _averaged(mask: Bool, size: NDArray[np.intp]) -> NDArray[np.float32]:
    """Average a mask over blocks of some voxels (3,)."""
    count = -(-np.array(mask.shape) // size)
    filled = np.pad(mask, [(0, int(n)) for n in count * size - mask.shape])
    blocks = filled.reshape([int(n) for pair in zip(count, size, strict=True) for n in pair])
    return np.asarray(blocks.mean(axis=(1, 3, 5), dtype=np.float32))


def _grid(
    volumes: Sequence[LabelVolume], motions: Sequence[Float], step: float
) -> tuple[Float, float]:
    """Lay a grid of points (A, B, C, 3) of the frame around the labels of all visits."""
    reach = np.concatenate([_points(v, m) for v, m in zip(volumes, motions, strict=True)])
    low, high = reach.min(axis=0) - 2 * step, reach.max(axis=0) + 2 * step
    axes = [np.arange(a, b + step, step) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1), step


def _points(volume: LabelVolume, motion: Float) -> Float:
    """Centers (N, 3) of the labeled voxels in the frame, mm."""
    points = digital.voxel_points(hippocampal_voxels(volume), volume.affine)
    return digital.to_ras(points, np.linalg.inv(motion))


def _slopes(
    images: Sequence[_Image], motions: Sequence[Float], grid: Float, step: float
) -> tuple[Float, NDArray[np.intp], Float]:
    """Compute where the mean of the images has slopes.

    Returns points (N, 3), the channel (N,) of each, in order, and the change (N, 6) of its value by
    a shift and turns.
    """
    shape, flat = grid.shape[:3], grid.reshape(-1, 3)
    moved = [digital.to_ras(flat, motion) for motion in motions]
    hidden = np.max([i.at(1, p) for i, p in zip(images, moved, strict=True)], axis=0) > HIDDEN
    parts = []
    for channel in (0, *range(2, 2 + len(_GROUPS))):
        mean = np.mean([i.at(channel, p) for i, p in zip(images, moved, strict=True)], axis=0)
        slope = np.stack(np.gradient(mean.reshape(shape), step), axis=-1).reshape(-1, 3)
        if channel:
            slope[hidden] = 0
        parts.append(slope)
    squared = [(slope**2).sum(axis=1) for slope in parts]
    least = LEAST_SLOPE * max(float(square.max()) for square in squared)
    steep: list[Bool] = [square > least for square in squared]
    channels = (0, *range(2, 2 + len(_GROUPS)))
    number = np.repeat(channels, [int(nodes.sum()) for nodes in steep])
    points = np.concatenate([flat[nodes] for nodes in steep])
    slope = np.concatenate([part[nodes] for part, nodes in zip(parts, steep, strict=True)])
    slope *= np.where(number == 0, OUTLINE_WEIGHT, 1.0)[:, None]
    return points, number, np.hstack([slope, np.cross(points, slope) / _REACH])


def _on_one_grid(volumes: Sequence[LabelVolume]) -> bool:
    """Whether the files of all visits have the same voxels."""
    grids = [volume.in_file(np.zeros((1, 1, 1), dtype=bool)) for volume in volumes]
    shapes = {volume.file_shape or volume.tissue.shape for volume in volumes}
    return len(shapes) == 1 and all(np.allclose(g.affine, grids[0].affine) for g in grids)


def _spread(volumes: Sequence[LabelVolume], motions: Sequence[Float]) -> float:
    """Largest RMS distance, mm, of the labels of a visit between its motion and the first one's."""
    points = [_points(volume, motion) for volume, motion in zip(volumes, motions, strict=True)]
    return max(
        float(np.sqrt(((digital.to_ras(p, m) - digital.to_ras(p, motions[0])) ** 2).sum(1).mean()))
        for p, m in zip(points, motions, strict=True)
    )
