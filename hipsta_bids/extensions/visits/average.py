"""The mean of a participant's aligned labels: each voxel gets the label that lies deepest there."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from hipsta_bids.geometry import digital
from hipsta_bids.geometry.slices import has_thick_slices
from hipsta_bids.settings import SliceSettings
from hipsta_bids.types import Bool, Float, LabelVolume

#: Voxels of the mean, mm.
VOXEL = 0.35
#: Depths of labels are averaged up to this, mm: what lies farther from a border does not count.
REACH = 1.5

_PART = 256  # codes are tissue and so many times the part
_MARGIN = 3.0  # mm of background around the labels
_FAR = 1e3  # times the distance of slices: distances are measured within slices


def average_labels(
    volumes: Sequence[LabelVolume], motions: Sequence[Float], settings: SliceSettings
) -> LabelVolume:
    """Average labels as signed distances from their borders (shape-based interpolation).

    ``motions`` (4, 4) lead from the participant's frame to the visits, RAS mm. The mean lies in the
    frame. Distances are measured within slices where these are thick.
    """
    codes = [v.tissue.astype(np.int32) + _PART * v.part.astype(np.int32) for v in volumes]
    to_frame = [np.linalg.inv(m) @ v.affine for m, v in zip(motions, volumes, strict=True)]
    shape, affine = _grid(codes, to_frame)
    # From voxels of the mean to voxels of each visit.
    matrices = [np.linalg.inv(matrix) @ affine for matrix in to_frame]
    edges = [_edges(volume, settings) for volume in volumes]
    background = np.full(shape, 0.0, dtype=np.float32)
    for code, matrix, edge in zip(codes, matrices, edges, strict=True):
        _add(background, code == 0, matrix, edge, outside=REACH)
    best, depth = np.zeros(shape, dtype=np.int32), background
    for kind in np.unique(np.concatenate([np.unique(code) for code in codes])).tolist():
        if kind == 0:
            continue
        total = np.zeros(shape, dtype=np.float32)
        for code, matrix, edge in zip(codes, matrices, edges, strict=True):
            _add(total, code == kind, matrix, edge, outside=-REACH)
        deeper = total > depth
        best[deeper], depth[deeper] = kind, total[deeper]
    part, tissue = np.divmod(best, _PART)
    return LabelVolume(
        tissue=tissue.astype(np.uint8),
        part=part.astype(np.uint8),
        affine=affine,
        protocol=volumes[0].protocol,
    )


def _grid(
    codes: Sequence[NDArray[np.int32]], to_frame: Sequence[Float]
) -> tuple[tuple[int, int, int], Float]:
    """Lay the voxels of the mean around all labels; a center lies in the origin of the frame."""
    points = np.concatenate(
        [digital.voxel_points(code > 0, m) for code, m in zip(codes, to_frame, strict=True)]
    )
    low = np.floor((points.min(axis=0) - _MARGIN) / VOXEL)
    count = np.ceil((points.max(axis=0) + _MARGIN) / VOXEL - low).astype(int) + 1
    shape = int(count[0]), int(count[1]), int(count[2])
    return shape, digital.affine_of(VOXEL * np.eye(3), VOXEL * low)


def _edges(volume: LabelVolume, settings: SliceSettings) -> Float:
    """Return the edges (3,) of the voxels, mm; that across thick slices is very long."""
    edges = np.linalg.norm(volume.affine[:3, :3], axis=0)
    if has_thick_slices(volume.affine, settings):
        edges[edges.argmax()] *= _FAR
    return np.asarray(edges)


def _add(
    total: NDArray[np.float32], mask: Bool, matrix: Float, edges: Float, *, outside: float
) -> None:
    """Add the depth in a mask, mm, to a sum on the mean's grid; ``outside`` far from its border."""
    total += np.float32(outside)
    # The part of the visit's grid in which the depth differs from the outside.
    special = mask if outside < 0 else ~mask
    index = digital.positions(special)
    if not len(index):
        return
    pad = np.ceil(REACH / np.minimum(edges, edges.min() * 10)).astype(int) + 1
    around = digital.box(index.min(axis=0), index.max(axis=0) + 1)
    inside = np.pad(mask[around], [(n, n) for n in pad], constant_values=outside > 0)
    depth = _depth(inside, edges)
    low = digital.low_corner(around) - pad
    corners = np.stack(
        np.meshgrid(*([a, a + n - 1] for a, n in zip(low, inside.shape, strict=True)))
    )
    reach = digital.to_ras(corners.reshape(3, -1).T, np.linalg.inv(matrix))
    first = np.maximum(np.floor(reach.min(axis=0)), 0).astype(int)
    last = np.minimum(np.ceil(reach.max(axis=0)) + 1, total.shape).astype(int)
    if (first >= last).any():
        return
    part = digital.box(first, last)
    total[part] += ndimage.affine_transform(
        depth - np.float32(outside),
        matrix[:3, :3],
        matrix[:3, :3] @ first + matrix[:3, 3] - low,
        output_shape=tuple(int(n) for n in last - first),
        order=1,
        mode="constant",
        cval=0.0,
    )


def _depth(inside: Bool, edges: Float) -> NDArray[np.float32]:
    """Signed distance from the border of a mask, mm, positive inside, up to the reach."""
    half = edges.min() / 2
    within = ndimage.distance_transform_edt(inside, sampling=edges) - half
    beyond = ndimage.distance_transform_edt(~inside, sampling=edges) - half
    depth = np.where(inside, within, -beyond)
    return np.asarray(np.clip(depth, -REACH, REACH), dtype=np.float32)
