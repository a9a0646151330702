"""Columns of a participant's sheet carried to a visit, and cut at the walls of that visit."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.digital import to_ras
from hipsta_bids.geometry.grid import Field
from hipsta_bids.geometry.measures import column_area
from hipsta_bids.geometry.mesh import tetra_volumes
from hipsta_bids.types import Bool, Coordinates, Float, Sheet, TetMesh

#: Columns are continued by this much beyond the walls of the participant's sheet, mm.
BEYOND = 1.5
#: Steps along and beyond a column.
STEPS, STEPS_BEYOND = 40, 30
#: Walls farther from that of the participant's sheet are not those of this column, mm.
FARTHEST = 0.7
#: Full width at half maximum of the Gaussian that smooths the moves of walls on the sheet, mm.
SMOOTHING = 1.0

_SIGMA = SMOOTHING / np.sqrt(8 * np.log(2))
_LEAST_WEIGHT = 1e-3  # mm2 of known columns, by the Gaussian, that make a mean


@dataclass(frozen=True, eq=False, kw_only=True)
class Walls:
    """Distances of the walls of a visit from the walls of the common sheet, along columns."""

    moves: Float
    """(Nx, Ny, 2) of the interior and exterior wall, mm, smoothed; to the exterior is positive."""
    raw: Float
    """(Nx, Ny, 2) before smoothing; NaN where no wall is near."""

    @property
    def known(self) -> Bool:
        """Columns (Nx, Ny) with both walls."""
        return np.asarray(np.isfinite(self.raw).all(axis=-1))

    @property
    def distance(self) -> float:
        """Distance of the walls, RMS over the sheet, mm."""
        return float(np.sqrt(np.nanmean(self.raw**2)))


def find_walls(sheet: Sheet, motion: Float, field: Field) -> Walls:
    """Find the walls of a visit along the columns of the participant's sheet.

    ``motion`` (4, 4) leads from the sheet to the visit, and ``field`` is positive in its body. The
    walls are the ends of the piece of a column inside the body that overlaps the sheet's most.
    """
    points, depth = _continued(sheet)
    nodes = field.grid.to_nodes(to_ras(points.reshape(-1, 3), motion))
    values = ndimage.map_coordinates(field.values, nodes.T, order=3, mode="nearest")
    at_nodes = np.asarray(values, dtype=np.float64).reshape(depth.shape)
    low, high = _piece(at_nodes, depth)
    moves = np.stack([low, high - _length(sheet)], axis=-1)
    moves = np.where(np.abs(moves) <= FARTHEST, moves, np.nan)
    if not np.isfinite(moves).all(axis=-1).any():
        raise GeometryError(
            "no column of the common sheet meets the walls of this visit: compare the labels of "
            "the visits",
            reason="visit-unlike",
        )
    return Walls(moves=_smoothed(moves, sheet), raw=moves)


def move_walls(sheet: Sheet, moves: Float, motion: Float) -> Sheet:
    """Carry a sheet to a visit, with its walls moved along its columns by (Nx, Ny, 2) mm."""
    length = _length(sheet)
    count = sheet.points.shape[2]
    low, high = moves[..., :1], length[..., None] + moves[..., 1:]
    targets = low + np.maximum(high - low, 0) * np.linspace(0, 1, count)
    points = _along(sheet, targets)
    return Sheet(points=to_ras(points, motion), valid=sheet.valid)


def moves_at(moves: Float, sheet: Sheet, whole: Sheet, x_extent: float, y_extent: float) -> Float:
    """Interpolate moves of the walls (Nx, Ny, 2) of a sheet at the columns of the whole body.

    Towards the edges, beyond the sheet's last columns, they shrink as the columns do.
    """
    nx, ny = whole.points.shape[:2]
    at_x = _positions(x_extent, nx, moves.shape[0])
    at_y = _positions(y_extent, ny, moves.shape[1])
    place = np.stack(np.meshgrid(at_x, at_y, indexing="ij"))
    inner, length = (
        np.stack([ndimage.map_coordinates(v, place, order=1, mode="nearest") for v in values])
        for values in (np.moveaxis(moves, -1, 0), _length(sheet)[None])
    )
    share = np.clip(_length(whole) / np.maximum(length[0], 1e-6), 0, 1)
    return np.moveaxis(inner * share, 0, -1)


def _positions(extent: float, count: int, nodes: int) -> Float:
    """Place lines from -1 to 1 among nodes within plus and minus an extent, as node numbers."""
    coordinate = np.clip(np.linspace(-1, 1, count) / extent, -1, 1)
    return np.asarray((coordinate + 1) / 2 * (nodes - 1))


def grid_mesh(whole: Sheet) -> tuple[TetMesh, Coordinates]:
    """Divide the cells of a sheet from edge to edge, (Nx, Ny, Nz), into six tetrahedra each."""
    shape = whole.points.shape[:3]
    number = np.arange(np.prod(shape), dtype=np.int32).reshape(shape)
    corner = {
        step: number[tuple(slice(s, n - 1 + s) for s, n in zip(step, shape, strict=True))].ravel()
        for step in product((0, 1), repeat=3)
    }
    tetrahedra = []
    for first, second in ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1)):
        steps = np.zeros((4, 3), dtype=int)
        steps[1:, first] = 1
        steps[2:, second] = 1
        steps[3] = 1
        odd = (second - first) % 3 == 2  # noqa: PLR2004 -- order of the axes is a reflection
        rows = [corner[tuple(step)] for step in steps.tolist()]
        tetrahedra.append(np.stack(rows[:2] + rows[:1:-1] if odd else rows, axis=1))
    vertices = whole.points.reshape(-1, 3)
    elements = np.concatenate(tetrahedra)
    if tetra_volumes(vertices, elements).sum() < 0:
        elements = elements[:, [0, 1, 3, 2]]
    axes = np.meshgrid(*(np.linspace(-1, 1, n) for n in shape), indexing="ij")
    values = np.stack(axes, axis=-1).reshape(-1, 3)
    return TetMesh(vertices=vertices, tetrahedra=elements), Coordinates(values=values)


def _length(sheet: Sheet) -> Float:
    """Length of each column (Nx, Ny), mm."""
    return np.asarray(np.linalg.norm(np.diff(sheet.points, axis=2), axis=3).sum(axis=2))


def _continued(sheet: Sheet) -> tuple[Float, Float]:
    """Points (Nx, Ny, M, 3) along and beyond each column, and their depths (Nx, Ny, M), mm."""
    outside = np.linspace(0, BEYOND, STEPS_BEYOND + 1)[1:]
    length = _length(sheet)[..., None]
    inner = length * np.linspace(0, 1, STEPS + 1)
    start, end = (
        np.broadcast_to(v, (*length.shape[:2], v.size)) for v in (-outside[::-1], outside)
    )
    depth = np.concatenate([start, inner, length + end], axis=2)
    return _along(sheet, depth), depth


def _along(sheet: Sheet, depth: Float) -> Float:
    """Points (Nx, Ny, M, 3) at depths along columns, straight on beyond their ends."""
    points = sheet.points
    last = points.shape[2] - 1
    place = depth / np.maximum(_length(sheet)[..., None], 1e-9) * last
    below = np.clip(np.floor(place), 0, last - 1).astype(np.intp)
    start = np.take_along_axis(points, below[..., None], axis=2)
    end = np.take_along_axis(points, below[..., None] + 1, axis=2)
    return np.asarray(start + (place - below)[..., None] * (end - start))


def _piece(values: Float, depth: Float) -> tuple[Float, Float]:
    """Find where the piece of each column inside the body, values (Nx, Ny, M), begins and ends.

    Depths (Nx, Ny, M), mm; NaN where it goes on to the end of the column, or there is none.
    """
    inside = values > 0
    shape, count = inside.shape[:2], inside.shape[2]
    change = np.diff(inside, axis=2, prepend=False)
    number = np.cumsum(change, axis=2)  # pieces inside have odd numbers
    within = np.zeros(count)
    within[STEPS_BEYOND : STEPS_BEYOND + STEPS + 1] = 1.0
    column = np.arange(shape[0] * shape[1])[:, None] * (count + 1)
    pieces = (column + number.reshape(len(column), -1)).ravel()
    overlap = np.bincount(
        pieces, (inside * within).ravel(), minlength=len(column) * (count + 1)
    ).reshape(*shape, count + 1)
    piece = inside & (number == overlap.argmax(axis=2)[..., None])
    piece &= overlap.max(axis=2)[..., None] > 0
    first = piece.argmax(axis=2)
    final = count - 1 - piece[..., ::-1].argmax(axis=2)
    crosses = piece.any(axis=2)
    low = _crossing(values, depth, np.maximum(first - 1, 0), first)
    high = _crossing(values, depth, np.minimum(final + 1, count - 1), final)
    return (
        np.where(crosses & (first > 0), low, np.nan),
        np.where(crosses & (final < count - 1), high, np.nan),
    )


def _crossing(
    values: Float, depth: Float, outside: NDArray[np.intp], inside: NDArray[np.intp]
) -> Float:
    """Depth (Nx, Ny) at which values are zero between a node outside and its neighbor inside."""
    (a, b), (s, t) = (
        [np.take_along_axis(v, n[..., None], axis=2)[..., 0] for n in (outside, inside)]
        for v in (values, depth)
    )
    share = a / np.where(a != b, a - b, 1.0)
    return np.asarray(s + share * (t - s))


def _smoothed(moves: Float, sheet: Sheet) -> Float:
    """Smooth moves (Nx, Ny, 2) on the sheet; what is unknown gets the mean of its surroundings."""
    middle = sheet.points[:, :, sheet.middle].reshape(-1, 3)
    squared = ((middle[:, None] - middle[None]) ** 2).sum(axis=-1)
    area = column_area(sheet).ravel()
    flat = moves.reshape(-1, 2)
    smooth = np.full(flat.shape, np.nan)
    sigma = _SIGMA
    while np.isnan(smooth).any():
        kernel = np.exp(-squared / (2 * sigma**2)) * area
        for wall in range(2):
            finite = np.isfinite(flat[:, wall])
            weight = kernel[:, finite].sum(axis=1)
            lacking = np.isnan(smooth[:, wall]) & (weight > _LEAST_WEIGHT)
            total = kernel[np.ix_(lacking, finite)] @ flat[finite, wall]
            smooth[lacking, wall] = total / weight[lacking]
        sigma *= 2
    return smooth.reshape(moves.shape)
