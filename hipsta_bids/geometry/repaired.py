"""Which columns of the sheet rest on repaired voxels."""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from hipsta_bids.artifacts import Bool, Float, Sheet
from hipsta_bids.geometry.topology import SolidField
from hipsta_bids.settings import MeasureSettings

_ALL = np.ones((3, 3, 3), dtype=bool)
_Columns = tuple[NDArray[np.intp], NDArray[np.intp]]


def repaired_columns(sheet: Sheet, solid: SolidField, settings: MeasureSettings) -> Bool:
    """Mark the columns of the sheet that a repair of the topology touched.

    A column stands for the part of the sheet up to halfway to its neighbors, so that a repair
    between two columns is not lost. A cut bridge leaves its two stumps standing: what is nearest
    to either face of the cut is marked, too. Pieces that were removed leave no mark.

    Parameters
    ----------
    sheet : Sheet
    solid : SolidField
        Knows the grid nodes whose side was changed.
    settings : MeasureSettings

    Returns
    -------
    (Nx, Ny) bool
        False where a column is undefined.
    """
    marked = np.zeros(sheet.valid.shape, dtype=bool)
    if not solid.touched.any():
        return marked
    points, columns = _dense_points(sheet, settings.repair_reach)
    if not len(points):
        return marked
    tree = cKDTree(points)
    nodes, radii = _changed_nodes(solid, tree, settings)
    hits = tree.query_ball_point(nodes, radii)
    hit = np.unique(np.concatenate([np.asarray(found, dtype=np.intp) for found in hits]))
    marked[columns[0][hit], columns[1][hit]] = True
    return marked & np.isfinite(sheet.points).all(axis=(2, 3))


def _changed_nodes(
    solid: SolidField, tree: "cKDTree[None, None]", settings: MeasureSettings
) -> tuple[Float, Float]:
    """Points (N, 3), RAS mm, of changed nodes and faces of cuts, and how far each of them marks."""
    inside = solid.field.values > 0
    faces = ndimage.binary_dilation(solid.touched & ~inside, structure=_ALL) & inside
    places, _ = ndimage.label(faces & ~solid.touched)
    to_ras = solid.field.grid.to_ras
    changed = to_ras(np.argwhere(solid.touched).astype(np.float64))
    radius = np.full(len(changed), settings.repair_reach)
    where = np.argwhere(places)
    face = to_ras(where.astype(np.float64))
    if not len(face):
        return changed, radius
    number = places[tuple(where.T)]
    distance, _ = tree.query(face)
    nearest = np.asarray(ndimage.minimum(distance, number, np.arange(number.max() + 1)))
    stumps = nearest[number] + settings.stump_reach
    return np.vstack([changed, face]), np.concatenate([radius, stumps])


def _dense_points(sheet: Sheet, reach: float) -> tuple[Float, _Columns]:
    """Points (N, 3) of the sheet no farther apart than the reach, and the column of each."""
    dense, columns = sheet.points, [np.arange(n) for n in sheet.valid.shape]
    for axis in (0, 1):
        gap = np.linalg.norm(np.diff(sheet.points, axis=axis), axis=-1)
        widest = float(np.max(gap, initial=reach, where=np.isfinite(gap)))
        dense, columns[axis] = _subdivided(dense, axis, int(np.ceil(widest / reach)))
    known = np.isfinite(dense).all(axis=-1)
    x, y, _ = np.nonzero(known)
    return dense[known], (columns[0][x], columns[1][y])


def _subdivided(points: Float, axis: int, parts: int) -> tuple[Float, NDArray[np.intp]]:
    """Interpolate linearly, ``parts`` steps from node to node; and say which node is nearest."""
    last = points.shape[axis] - 1
    place = np.arange(last * parts + 1) / parts
    low, high = np.floor(place).astype(np.intp), np.ceil(place).astype(np.intp)
    share = np.expand_dims(place - low, tuple(k for k in range(points.ndim) if k != axis))
    before, after = np.take(points, low, axis), np.take(points, high, axis)
    return (1 - share) * before + share * after, np.rint(place).astype(np.intp)
