"""Columns of a participant's sheet, carried to the edges and walls of a visit."""

from itertools import product

import numpy as np
from scipy import ndimage

from hipsta_bids.geometry import columns
from hipsta_bids.geometry.digital import to_ras
from hipsta_bids.geometry.grid import Field
from hipsta_bids.geometry.mesh import tetra_volumes
from hipsta_bids.types import Coordinates, Float, Sheet, TetMesh

#: An edge farther than this weighs 1/e; edges are smoothed by this along them, as they are less
#: certain than walls, mm.
NEAR_EDGE, EDGE_SMOOTHING = 1.0, 6.0
#: Columns follow an edge less the farther they are from it: 1/e at this distance, mm, and at a
#: larger one where the edge moves far, so that columns do not change places.
EDGE_REACH = 1.0

_ROW_STEP = 4  # columns from point to point of a row: between near ones, a row's direction is rough


def find_edges(whole: Sheet, motion: Float, field: Field) -> Float:
    """Find where rows of the mid-surface of a sheet from edge to edge leave the body.

    Returns distances (Ny, 2), mm, of the medial and lateral edge of a visit from the edges of the
    sheet; to lateral is positive, and NaN is no edge. ``motion`` and ``field`` are as for
    :func:`hipsta_bids.geometry.columns.find_walls`.
    """
    last = len(whole.points) - 1
    index = np.linspace(0, last, max(last // _ROW_STEP, 1) + 1).round().astype(np.intp)
    rows = whole.points[index, :, whole.middle].swapaxes(0, 1)[None]
    valid = np.ones(rows.shape[:2], dtype=bool)
    edges: Float = columns.ends_inside(Sheet(points=rows, valid=valid), motion, field)[0]
    return edges


def smooth_edges(edges: Float, whole: Sheet) -> Float:
    """Smooth distances (Ny, 2) of edges along the sheet, mm."""
    place = _places(whole.points[whole.points.shape[0] // 2, :, whole.middle])
    squared = (place[:, None] - place) ** 2
    return columns.smooth_moves(edges, squared, np.ones(len(edges)), EDGE_SMOOTHING, NEAR_EDGE)


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
    length = columns.column_length(sheet)
    count = sheet.points.shape[2]
    low, high = moves[..., :1], length[..., None] + moves[..., 1:]
    targets = low + np.maximum(high - low, 0) * np.linspace(0, 1, count)
    points = columns.points_along(sheet, targets)
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
        for values in (np.moveaxis(moves, -1, 0), columns.column_length(sheet)[None])
    )
    share = np.clip(columns.column_length(whole) / np.maximum(length[0], 1e-6), 0, 1)
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


def _places(points: Float) -> Float:
    """Distance (N, ...) of points (N, ..., 3) from the first one, along the line of all, mm."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=-1)
    return np.concatenate([np.zeros_like(steps[:1]), steps.cumsum(axis=0)])
