"""Which subfield a place belongs to, and how much of the mid-surface and of the volume each has.

A sheet's grid is too coarse to tell: borders that follow its lines are off by up to half a step.
So areas are labeled at many places of each of its cells, and volumes by tetrahedra. Columns that
cross a border count for both sides: on the mid-surface alone, borders would be those of voxels.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from hipsta_bids.artifacts import Float, Sheet, TetMesh
from hipsta_bids.geometry.body import Body
from hipsta_bids.geometry.measures import layer_area
from hipsta_bids.schemes import Tissue

#: Places per cell along x and y, about a tenth of a millimeter apart along x on the default grid.
_PLACES = 4


def labels_at(points: Float, body: Body) -> NDArray[np.uint8]:
    """Tissue (N,) at points (N, 3), RAS mm: that of the body's voxel there, or else the nearest."""
    voxel = np.rint(body.to_voxels(points)).astype(np.intp)
    last = np.array(body.inside.shape) - 1
    place = tuple(np.clip(voxel, 0, last).T)
    labels = body.tissue[place]
    beside = np.flatnonzero(~body.inside[place] | ((voxel < 0) | (voxel > last)).any(axis=1))
    if len(beside):
        index, centers = body.inside_points()
        _, nearest = cKDTree(centers).query(points[beside])
        labels[beside] = body.tissue[tuple(index[nearest].T)]
    return np.asarray(labels, dtype=np.uint8)


def subfield_areas(whole: Sheet, body: Body) -> dict[Tissue, float]:
    """Area of the mid-surface in each subfield that it has, mm2.

    Parameters
    ----------
    whole : Sheet
        From rim to rim and end to end.
    body : Body

    Returns
    -------
    dict
        The areas add up to that of the mid-surface.
    """
    at = (np.arange(_PLACES) + 0.5) / _PLACES
    inner = whole.points[:, :, 1:-1]  # walls lie beside the voxels as often as in them
    along_x = _between(inner[:-1], inner[1:], at)
    places = _between(along_x[:, :, :-1], along_x[:, :, 1:], at)
    shares = layer_area(whole.points[:, :, whole.middle])[..., None] / places[..., 0, 0, :, 0].size
    weights = np.broadcast_to(shares, places.shape[:-1])
    return _sums(labels_at(places.reshape(-1, 3), body), weights.ravel())


def subfield_volumes(mesh: TetMesh, body: Body) -> dict[Tissue, float]:
    """Volume in each subfield, mm3; the volumes add up to that of the mesh."""
    corners = mesh.vertices[mesh.tetrahedra]
    volume = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6
    return _sums(labels_at(corners.mean(axis=1), body), volume)


def _between(start: Float, end: Float, at: Float) -> Float:
    """Points at fractions of the way, along a new first axis."""
    return np.stack([start + fraction * (end - start) for fraction in at])


def _sums(labels: NDArray[np.uint8], weights: Float) -> dict[Tissue, float]:
    total = np.bincount(labels, weights)
    return {Tissue(int(kind)): float(total[kind]) for kind in np.unique(labels)}
