"""Which columns of the sheet rest on repaired voxels."""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from hipsta_bids.artifacts import Bool, Float, Sheet
from hipsta_bids.geometry.boxes import box_around, low_corner
from hipsta_bids.geometry.topology import SolidField
from hipsta_bids.settings import MeasureSettings

_ALL = np.ones((3, 3, 3), dtype=bool)


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
    known = np.isfinite(sheet.points).all(axis=(2, 3))
    if not known.any():
        return marked
    nodes, radii = _changed_nodes(solid, sheet.points[known].reshape(-1, 3), settings)
    gaps = np.stack([_gaps(sheet.points, axis) for axis in (0, 1)], axis=-1)
    # Most columns are far from all repairs: looking closely at the others only saves much time.
    near = np.asarray(cKDTree(nodes).query(sheet.points[known])[0])
    candidates = np.argwhere(known)[near.min(axis=1) <= radii.max() + gaps[known].mean(axis=-1)]
    if not len(candidates):
        return marked
    widest = gaps[tuple(candidates.T)].max(axis=0)
    parts = np.maximum(np.ceil(widest / settings.repair_reach), 1).astype(int)
    dense = _cells(sheet.points, candidates, parts)
    defined = np.isfinite(dense).all(axis=-1)
    hits = cKDTree(dense[defined]).query_ball_point(nodes, radii)
    hit = np.unique(np.concatenate([np.asarray(found, dtype=np.intp) for found in hits]))
    owner = candidates[np.nonzero(defined)[0][hit]]
    marked[tuple(owner.T)] = True
    return marked


def _gaps(points: Float, axis: int) -> Float:
    """Distance (Nx, Ny) of each column to the farther of its neighbors along an axis, mm."""
    gap = np.nan_to_num(np.linalg.norm(np.diff(points, axis=axis), axis=-1)).max(axis=-1)
    ends = [(int(k == axis), int(k == axis)) for k in range(2)]
    padded = np.pad(gap, ends)
    count = points.shape[axis]
    before, after = (padded.take(range(k, count + k), axis=axis) for k in (0, 1))
    return np.asarray(np.maximum(before, after))


def _changed_nodes(
    solid: SolidField, points: Float, settings: MeasureSettings
) -> tuple[Float, Float]:
    """Points (N, 3), RAS mm, of changed nodes and faces of cuts, and how far each of them marks."""
    box = box_around(np.argwhere(solid.touched))
    inside, touched = solid.field.values[box] > 0, solid.touched[box]
    faces = ndimage.binary_dilation(touched & ~inside, structure=_ALL) & inside
    places, _ = ndimage.label(faces & ~touched)
    low = low_corner(box)
    changed = solid.field.grid.to_ras((np.argwhere(touched) + low).astype(np.float64))
    radius = np.full(len(changed), settings.repair_reach)
    where = np.argwhere(places)
    if not len(where):
        return changed, radius
    face = solid.field.grid.to_ras((where + low).astype(np.float64))
    number = places[tuple(where.T)]
    distance, _ = cKDTree(points).query(face)
    nearest = np.asarray(ndimage.minimum(distance, number, np.arange(number.max() + 1)))
    stumps = nearest[number] + settings.stump_reach
    return np.vstack([changed, face]), np.concatenate([radius, stumps])


def _cells(points: Float, columns: NDArray[np.intp], parts: NDArray[np.intp]) -> Float:
    """Interpolate round columns, up to halfway to their neighbors.

    Parameters
    ----------
    points : (Nx, Ny, Nz, 3) float64
    columns : (C, 2) int
        Numbers along x and y.
    parts : (2,) int
        Steps from half before to half behind a column, along x and y.

    Returns
    -------
    (C, steps, Nz, 3) float64
        NaN where a neighbor is undefined.
    """
    steps = [np.linspace(-0.5, 0.5, int(n) + 1) for n in parts]
    offsets = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 2)
    last = np.array(points.shape[:2]) - 1
    place = np.clip(columns[:, None] + offsets, 0, last)
    low, high = np.floor(place).astype(np.intp), np.ceil(place).astype(np.intp)
    share = (place - low)[..., None, None]
    x, y = share[:, :, 0], share[:, :, 1]
    (a, b), (c, d) = np.moveaxis(low, -1, 0), np.moveaxis(high, -1, 0)
    before = (1 - y) * points[a, b] + y * points[a, d]
    after = (1 - y) * points[c, b] + y * points[c, d]
    return np.asarray((1 - x) * before + x * after)
