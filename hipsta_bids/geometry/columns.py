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
#: A wall farther than this from the wall of the participant's sheet may belong to another turn, mm:
#: its weight falls smoothly, to 1/e here.
NEAR = 0.5
#: Columns with a wall farther away than this are counted as filled from their neighbors, mm.
FARTHEST = 0.7
#: Full width at half maximum of the Gaussian that smooths the moves of walls on the sheet, mm.
SMOOTHING = 1.0
#: The same of edges, which are smoothed along them, and are less certain, mm.
NEAR_EDGE, EDGE_SMOOTHING = 1.0, 6.0
#: Columns follow an edge less the farther they are from it: 1/e at this distance, mm, and at a
#: larger one where the edge moves far, so that columns do not change places.
EDGE_REACH = 1.0

_FWHM = float(np.sqrt(8 * np.log(2)))  # of a Gaussian, in standard deviations
_TAIL = 1e-4  # weight of a Gaussian of four times the width, for places without a wall near
_ROW_STEP = 4  # columns from point to point of a row: between near ones, a row's direction is rough


@dataclass(frozen=True, eq=False, kw_only=True)
class Walls:
    """Distances of the walls of a visit from the walls of the common sheet, along columns."""

    moves: Float
    """(Nx, Ny, 2) of the interior and exterior wall, mm, smoothed; to the exterior is positive."""
    raw: Float
    """(Nx, Ny, 2) before smoothing; NaN where there is no wall."""

    @property
    def distances(self) -> Float:
        """Distances (Nx, Ny, 2) of the walls, mm, up to the farthest one that is counted."""
        return np.asarray(np.fmin(np.abs(self.raw), FARTHEST))

    @property
    def known(self) -> Bool:
        """Columns (Nx, Ny) with both walls."""
        return np.asarray((self.distances < FARTHEST).all(axis=-1))

    @property
    def distance(self) -> float:
        """Distance of the walls, RMS over the sheet, mm."""
        return float(np.sqrt((self.distances**2).mean()))


def find_walls(sheet: Sheet, motion: Float, field: Field) -> Walls:
    """Find the walls of a visit along the columns of the participant's sheet.

    ``motion`` (4, 4) leads from the sheet to the visit, and ``field`` is positive in its body. The
    walls are the ends of the piece of a column inside the body that overlaps the sheet's most.
    """
    raw = _ends_inside(sheet, motion, field)
    middle = sheet.points[:, :, sheet.middle].reshape(-1, 3)
    squared = ((middle[:, None] - middle[None]) ** 2).sum(axis=-1)
    smooth = _smoothed(raw.reshape(-1, 2), squared, column_area(sheet).ravel(), SMOOTHING, NEAR)
    walls = Walls(moves=smooth.reshape(raw.shape), raw=raw)
    if not walls.known.any():
        raise GeometryError(
            "no column of the common sheet meets the walls of this visit: compare the labels of "
            "the visits",
            reason="visit-unlike",
        )
    return walls


def find_edges(whole: Sheet, motion: Float, field: Field) -> Float:
    """Find where rows of the mid-surface of a sheet from edge to edge leave the body.

    Returns distances (Ny, 2), mm, of the medial and lateral edge of a visit from the edges of the
    sheet; to lateral is positive, and NaN is no edge. ``motion`` and ``field`` are as for
    :func:`find_walls`.
    """
    last = len(whole.points) - 1
    index = np.linspace(0, last, max(last // _ROW_STEP, 1) + 1).round().astype(np.intp)
    rows = whole.points[index, :, whole.middle].swapaxes(0, 1)[None]
    valid = np.ones(rows.shape[:2], dtype=bool)
    edges: Float = _ends_inside(Sheet(points=rows, valid=valid), motion, field)[0]
    return edges


def smooth_edges(edges: Float, whole: Sheet) -> Float:
    """Smooth distances (Ny, 2) of edges along the sheet, mm."""
    place = _places(whole.points[whole.points.shape[0] // 2, :, whole.middle])
    squared = (place[:, None] - place) ** 2
    return _smoothed(edges, squared, np.ones(len(edges)), EDGE_SMOOTHING, NEAR_EDGE)


def move_edges(sheet: Sheet, edges: Float, x_extent: float, y_extent: float) -> Sheet:
    """Move columns along the rows: at the edges by (M, 2) mm, and less the farther from them.

    The M rows are equally spaced from end to end. The sheet reaches from -extent to extent.
    """
    at_y = _positions(1.0, sheet.points.shape[1], len(edges), y_extent)
    medial, lateral = (np.interp(at_y, np.arange(len(edges)), side) for side in edges.T)
    middle = sheet.points[:, :, sheet.middle]
    place = _places(middle)
    beyond = place[-1] * (1 / x_extent - 1) / 2  # from the first and the last column to the edges
    from_edges = (medial, place + beyond), (lateral, place[-1] + beyond - place)
    distance = sum(move * np.exp(-far / np.hypot(EDGE_REACH, 2 * move)) for move, far in from_edges)
    along = np.gradient(middle, axis=0)
    along *= (distance / np.maximum(np.linalg.norm(along, axis=-1), 1e-9))[..., None]
    return Sheet(points=sheet.points + along[:, :, None], valid=sheet.valid)


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


def _positions(extent: float, count: int, nodes: int, reach: float = 1.0) -> Float:
    """Place lines within plus and minus a reach among nodes within an extent, as node numbers."""
    coordinate = np.clip(np.linspace(-reach, reach, count) / extent, -1, 1)
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


def _places(points: Float) -> Float:
    """Distance (N, ...) of points (N, ..., 3) from the first one, along the line of all, mm."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=-1)
    return np.concatenate([np.zeros_like(steps[:1]), steps.cumsum(axis=0)])


def _ends_inside(sheet: Sheet, motion: Float, field: Field) -> Float:
    """Find where columns enter and leave the body of a visit.

    Returns distances (Nx, Ny, 2), mm, from the ends of the columns; NaN without such a place.
    """
    points, depth = _continued(sheet)
    nodes = field.grid.to_nodes(to_ras(points.reshape(-1, 3), motion))
    values = ndimage.map_coordinates(field.values, nodes.T, order=3, mode="nearest")
    low, high = _piece(np.asarray(values, dtype=np.float64).reshape(depth.shape), depth)
    return np.stack([low, high - _length(sheet)], axis=-1)


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


def _smoothed(moves: Float, squared: Float, size: Float, width: float, near: float) -> Float:
    """Smooth moves (N, 2), mm, by a Gaussian of a width at half maximum, mm.

    ``squared`` (N, N) are distances between their places, and ``size`` (N,) is their area or
    length. Moves farther than ``near`` weigh less, and what is unknown nothing: it is filled by
    wider Gaussians of little weight.
    """
    exponent = -squared / (2 * (width / _FWHM) ** 2)
    kernel = sum(_TAIL**level * np.exp(exponent / 16**level) for level in range(3)) * size
    weight = np.where(np.isfinite(moves), np.exp(-((moves / near) ** 4)), 0.0)
    total = kernel @ (weight * np.nan_to_num(moves))
    return np.asarray(total / np.maximum(kernel @ weight, np.finfo(float).tiny))
