"""The ribbon in single slices: its nodes along and across, aligned from slice to slice.

In each slice, harmonic functions run along and across the ribbon and give it nodes. Where nodes of
two slices belong together follows from monotone matching of their mid-lines, so that the walls of
one can be moved to those of the other even where the ribbon moves by more than its thickness.
"""

from typing import NamedTuple

import numpy as np
from lapy import TriaMesh
from numpy.lib.stride_tricks import sliding_window_view
from scipy import ndimage
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import Delaunay, QhullError, cKDTree
from skimage.measure import find_contours

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.digital import piece_sizes
from hipsta_bids.geometry.fem import Laplace, bare_mesh
from hipsta_bids.geometry.outlines import SLIT_HALF_WIDTH, TOUCH_DISTANCE
from hipsta_bids.types import Float, Int

#: Turns are parts of the ribbon farther apart along it than this, mm.
TURN_LENGTH = 3.0
#: Nodes along the ribbon of a slice.
RIBBON_NODES = 81
#: Half length of the edges of the ribbon along its outline, multiples of 2 area / length.
EDGE_HALF_LENGTH = 0.5
#: Half the least thickness of the ribbon in a slice, mm: the working grid's smoothing leaves
#: three fourths of the height of a strip of 0.6 mm, but only half of one of 0.4 mm.
LEAST_HALF_THICKNESS = 0.3
#: Mid-lines of slices are matched by squared distance, mm2, and this times squared stretch.
MATCH_STRETCH = 0.5

_ACROSS = np.linspace(-1, 1, 5)
"""Coordinates across the ribbon at which it has nodes."""
_WITHIN = 1 - 1e-6
"""Nodes of the wall are looked up this near to it, so that rounding does not put them outside."""
_PER_NODE = 4
"""Places on a mid-line per node of the other, in matching."""
_MAX_STRETCH = 4
"""Of a mid-line against another."""
_TIP = 2
"""Outer nodes along the ribbon that may lie in its rounded ends."""
_NEIGHBORS = 6
"""Nearest nodes that a pixel moves with."""


class _Mesh(NamedTuple):
    """Triangles inside an outline."""

    points: Float
    """(V, 2) pixels; the first ones go round the outline."""
    cells: Int
    """(T, 3)."""
    border: int
    """Number of vertices on the outline."""


def ribbon_nodes(outline: Float, lateral: Float, pixel: float) -> Float | None:
    """Nodes (X, Z, 2), in pixels, of the largest piece in a slice, the first ones medial.

    ``outline`` (I, J) is the signed distance, mm; ``lateral`` (I, J) grows from medial to lateral
    and is NaN outside. None where the piece has no two ends, or its coordinates fold.
    """
    pieces, count = ndimage.label(outline > 0)
    if not count:
        return None
    main = pieces == piece_sizes(pieces).argmax()
    try:
        mesh = _triangles(np.where(main | (pieces == 0), outline, -pixel), pixel)
        if mesh is None:
            return None
        nodes = _nodes(mesh, np.where(main, lateral, np.nan))
    except (GeometryError, QhullError):
        return None
    return nodes if np.isfinite(nodes).all() else None


def _triangles(field: Float, pixel: float) -> _Mesh | None:
    """Triangulate where a field (I, J), mm, is positive; vertices are on its contour and pixels.

    None for a few pixels only.
    """
    framed = np.pad(field, 1, constant_values=-pixel)
    lines = find_contours(framed, 0.0)  # type: ignore[no-untyped-call]
    line = max(lines, key=len) - 1
    along = _along(line)
    count = round(along[-1])
    if count < 2 * len(_ACROSS):
        return None
    at = np.linspace(0, along[-1], count, endpoint=False)
    border = np.stack([np.interp(at, along, line[:, k]) for k in (0, 1)], axis=1)
    points = np.concatenate([border, np.argwhere(field > 0.5 * pixel)])
    cells = Delaunay(points).simplices
    a, b, c = (points[cells[:, k]] for k in range(3))
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    inside = ndimage.map_coordinates(field, points[cells].mean(axis=1).T, order=1) > 0
    cells = np.where((area > 0)[:, None], cells, cells[:, ::-1])
    cells = cells[inside & (np.abs(area) > 1e-6)]  # noqa: PLR2004 -- slivers on straight borders
    is_used = np.zeros(len(points), dtype=bool)
    is_used[cells] = True
    number = np.cumsum(is_used) - 1
    return _Mesh(points[is_used], number[cells], int(is_used[:count].sum()))


def _nodes(mesh: _Mesh, lateral: Float) -> Float:
    """Invert the coordinates along and across the ribbon on a regular grid; NaN where they fold."""
    flat = np.column_stack([mesh.points, np.zeros(len(mesh.points))])
    laplace = Laplace(bare_mesh(TriaMesh, flat, mesh.cells))
    slow = laplace.eigenfunctions(1)[1][:, 0]
    if _rises(slow, mesh.points, lateral) < 0:
        slow = -slow
    border = mesh.points[: mesh.border]
    around = _along(np.concatenate([border, border[:1]]))
    after = np.roll(border, -1, axis=0)
    area = 0.5 * float((border[:, 0] * after[:, 1] - border[:, 1] * after[:, 0]).sum())
    thickness = 2 * abs(area) / around[-1]
    strips = []
    for tip in (int(slow[: mesh.border].argmin()), int(slow[: mesh.border].argmax())):
        gap = (around[:-1] - around[tip] + 0.5 * around[-1]) % around[-1] - 0.5 * around[-1]
        order = np.argsort(gap)
        strips.append(order[np.abs(gap[order]) <= EDGE_HALF_LENGTH * thickness])
    medial, lateral_end = strips
    walls = [
        _numbers(medial[-1], lateral_end[0], mesh.border),
        _numbers(lateral_end[-1], medial[0], mesh.border),
    ]
    first, second = walls if area > 0 else walls[::-1]
    # Lengths in pixels, so that triangles between the coordinates keep their shape.
    scale = 0.5 * np.array([abs(area) / thickness, thickness])
    places = np.column_stack([laplace.between(medial, lateral_end), laplace.between(first, second)])
    rows, columns = np.meshgrid(np.linspace(-1, 1, RIBBON_NODES), _ACROSS, indexing="ij")
    targets = _WITHIN * np.stack([rows, columns], axis=-1)
    return np.asarray(LinearNDInterpolator(places * scale, mesh.points)(targets * scale))


def _rises(values: Float, points: Float, lateral: Float) -> float:
    """Covariance of values (V,) at points (V, 2), pixels, with how lateral these are."""
    index = np.clip(np.rint(points).astype(int), 0, np.array(lateral.shape) - 1)
    ranks = lateral[tuple(index.T)]
    finite = np.isfinite(ranks)
    if not finite.any():
        return 0.0
    return float(((ranks[finite] - ranks[finite].mean()) * values[finite]).sum())


def _numbers(start: int, stop: int, count: int) -> Int:
    """Numbers from start to stop, both included, round a circle of ``count``."""
    return np.asarray((start + np.arange((stop - start) % count + 1)) % count)


def _along(line: Float) -> Float:
    """Length of a line (N, 2) up to each of its points, (N,)."""
    return np.append(0.0, np.linalg.norm(np.diff(line, axis=0), axis=1).cumsum())


def _middle(nodes: Float) -> Float:
    return np.asarray(nodes[:, nodes.shape[1] // 2])


def align_nodes(ribbons: list[Float | None], pixel: float) -> list[Float | None]:
    """Move nodes (X, Z, 2) along each slice to match the nodes of the slice inside.

    From the middle slice, on which they are at equal distances, outwards.
    """
    aligned = list(ribbons)
    middle = len(ribbons) // 2
    for order in (range(middle, len(ribbons)), range(middle, -1, -1)):
        inside = None
        for number in order:
            nodes = ribbons[number]
            if nodes is None:
                inside = None
                continue
            shares = np.linspace(0, 1, len(nodes))
            if inside is not None:
                lines = pixel * _middle(inside), pixel * _middle(nodes)
                shares = match_lines(*lines, MATCH_STRETCH)
            aligned[number] = inside = _nodes_at(nodes, shares)
    return aligned


def match_lines(first: Float, second: Float, stretching: float) -> Float:
    """Where points of a line (M, 2), mm, belong on a second one (N, 2): (M,) shares of its length.

    Monotone and from end to end. The sum over the points of squared distance and of ``stretching``
    (mm2) times the squared stretch is least, by dynamic programming.
    """
    count = _PER_NODE * (len(first) - 1) + 1
    along = _along(second)
    at = np.linspace(0, along[-1], count)
    places = np.stack([np.interp(at, along, second[:, k]) for k in (0, 1)], axis=1)
    cost = ((first[:, None] - places) ** 2).sum(axis=2)
    moves = np.arange(_PER_NODE * _MAX_STRETCH + 1)
    steps = np.maximum(np.diff(_along(first)), 1e-3 * along[-1] / count)
    stretch = stretching * (at[1] * moves / steps[:, None]) ** 2
    total = np.where(np.arange(count) == 0, cost[0], np.inf)
    choices = np.zeros((len(first), count), dtype=np.intp)
    before = np.full(len(moves) - 1 + count, np.inf)
    moved = sliding_window_view(before, count)[::-1]  # by each of the moves
    for number in range(1, len(first)):
        before[-count:] = total
        ways = moved + stretch[number - 1][:, None]
        choices[number] = ways.argmin(axis=0)
        total = ways.min(axis=0) + cost[number]
    position = count - 1
    shares = np.zeros(len(first))
    for number in range(len(first) - 1, -1, -1):
        shares[number] = position / (count - 1)
        position -= choices[number, position]
    return shares


def _nodes_at(nodes: Float, shares: Float) -> Float:
    """Nodes (M, Z, 2) at shares (M,) of the length of the mid-line."""
    along = _along(_middle(nodes))
    row = np.interp(shares * along[-1], along, np.arange(len(nodes)))
    below = np.clip(row.astype(int), 0, len(nodes) - 2)
    share = (row - below)[:, None, None]
    return np.asarray((1 - share) * nodes[below] + share * nodes[below + 1])


def moves_between(first: Float, second: Float, points: Float) -> Float:
    """Displacement (N, 2) from one slice to the next at pixels (N, 2) halfway between both.

    Pixels move with the nodes (X, Z, 2) near to them.
    """
    first, second = first.reshape(-1, 2), second.reshape(-1, 2)
    gap, nearest = cKDTree(0.5 * (first + second)).query(points, k=_NEIGHBORS)
    weight = 1 / (np.asarray(gap) ** 2 + 0.25)  # within half a pixel all nodes count about the same
    weight /= np.sum(weight, axis=1, keepdims=True)
    return np.asarray(np.einsum("nk,nkd->nd", weight, (second - first).take(nearest, axis=0)))


def keep_whole(outline: Float, nodes: Float, pixel: float) -> None:
    """Thicken, in place, where a slice's ribbon is so thin that later smoothing would break it.

    ``outline`` (I, J) is the signed distance, mm, ``nodes`` (X, Z, 2) are in pixels.
    """
    middle = _middle(nodes)[_TIP:-_TIP]
    reach = LEAST_HALF_THICKNESS / pixel
    low = np.maximum(np.floor(middle.min(axis=0) - reach).astype(int), 0)
    high = np.ceil(middle.max(axis=0) + reach).astype(int) + 1
    part = outline[low[0] : high[0], low[1] : high[1]]
    index = np.argwhere(part < LEAST_HALF_THICKNESS)
    along = _along(middle)
    at = np.linspace(0, along[-1], max(round(2 * along[-1]), 2))
    line = np.stack([np.interp(at, along, middle[:, k]) for k in (0, 1)], axis=1)
    gap = np.asarray(cKDTree(line).query(index + low, distance_upper_bound=reach)[0])
    near = np.isfinite(gap)
    pixels = tuple(index[near].T)
    part[pixels] = np.maximum(part[pixels], LEAST_HALF_THICKNESS - pixel * gap[near])


def part_turns(outline: Float, nodes: Float, pixel: float) -> None:
    """Widen, in place, gaps between turns of a slice's ribbon that later smoothing would close.

    ``outline`` (I, J) is the signed distance, mm, ``nodes`` (X, Z, 2) are in pixels.
    """
    near = np.argwhere(np.abs(outline) < TOUCH_DISTANCE)
    row = cKDTree(nodes.reshape(-1, 2)).query(near)[1] // nodes.shape[1]
    position = np.full(outline.shape, np.nan)
    position[tuple(near.T)] = pixel * _along(_middle(nodes))[row]
    between = np.zeros(outline.shape, dtype=bool)
    between[:-1] |= np.abs(np.diff(position, axis=0)) > TURN_LENGTH
    between[:, :-1] |= np.abs(np.diff(position, axis=1)) > TURN_LENGTH
    between &= outline < pixel
    if between.any():
        gap = pixel * ndimage.distance_transform_edt(~between)
        np.minimum(outline, gap - SLIT_HALF_WIDTH, out=outline)
