"""The ribbon in single slices: its coordinates in two dimensions, aligned from slice to slice.

In each slice two harmonic functions run along and across the ribbon. Where the mid-lines of two
slices belong together is found by monotone matching, so that walls between slices can be moved
from one to the other even where the ribbon moves sideways by more than its own thickness.
"""

from typing import NamedTuple

import numpy as np
from lapy import TriaMesh
from numpy.typing import NDArray
from scipy import ndimage
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import Delaunay, QhullError
from skimage.measure import find_contours

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.digital import piece_sizes
from hipsta_bids.geometry.fem import Laplace
from hipsta_bids.settings import SliceSettings
from hipsta_bids.types import Bool, Float, Int

_ACROSS = np.linspace(-1, 1, 5)
"""Coordinates across the ribbon at which it has nodes."""


class _Mesh(NamedTuple):
    """Triangles inside an outline."""

    points: Float
    """(V, 2) fine pixels; the first ones go round the outline."""
    cells: Int
    """(T, 3)."""
    border: int
    """Number of vertices on the outline."""


def ribbon_nodes(
    outline: Float, lateral: Float, pixel: float, settings: SliceSettings
) -> Float | None:
    """Nodes (X, Z, 2) of a slice's largest piece, from medial to lateral; fine pixels.

    ``outline`` (I, J) is a signed distance, mm, ``lateral`` (I, J) grows from medial to lateral
    within the ribbon, and NaN elsewhere. None where the piece is no ribbon.
    """
    pieces, count = ndimage.label(outline > 0)
    if not count:
        return None
    main = pieces == piece_sizes(pieces).argmax()
    try:
        mesh = _triangles(np.where(main | (pieces == 0), outline, -pixel), pixel)
        return _nodes(mesh, np.where(main, lateral, np.nan), settings)
    except (GeometryError, QhullError, ValueError, IndexError, RuntimeError):
        return None


def _triangles(field: Float, pixel: float) -> _Mesh:
    """Triangulate where a field (I, J), mm, is positive, by its pixels and its contour."""
    lines = find_contours(np.pad(field, 1, constant_values=-pixel), 0.0)  # type: ignore[no-untyped-call]
    line = max(lines, key=len) - 1
    steps = np.append(0.0, np.linalg.norm(np.diff(line, axis=0), axis=1).cumsum())
    count = max(round(steps[-1]), 8)
    at = np.linspace(0, steps[-1], count, endpoint=False)
    border = np.stack([np.interp(at, steps, line[:, k]) for k in (0, 1)], axis=1)
    inner = np.argwhere(field > 0.5 * pixel)
    points = np.concatenate([border, inner])
    cells = Delaunay(points).simplices
    inside = ndimage.map_coordinates(field, points[cells].mean(axis=1).T, order=1) > 0
    a, b, c = (points[cells[:, k]] for k in range(3))
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    cells = np.where((area > 0)[:, None], cells, cells[:, ::-1])[inside & (np.abs(area) > 1e-6)]
    used = np.zeros(len(points), dtype=bool)
    used[cells] = True
    number = np.cumsum(used) - 1
    return _Mesh(points[used], number[cells], int(used[:count].sum()))


def _nodes(mesh: _Mesh, lateral: Float, settings: SliceSettings) -> Float:
    flat = np.column_stack([mesh.points, np.zeros(len(mesh.points))])
    laplace = Laplace(TriaMesh(flat, mesh.cells))
    slow = laplace.eigenfunctions(1)[1][:, 0]
    border = mesh.points[: mesh.border]
    steps = np.linalg.norm(np.roll(border, -1, axis=0) - border, axis=1)
    along, length = np.append(0.0, steps.cumsum()[:-1]), float(steps.sum())
    area = _area(border)
    thickness = 2 * abs(area) / length
    tips = [int(np.argmin(slow[: mesh.border])), int(np.argmax(slow[: mesh.border]))]
    index = np.rint(mesh.points).astype(int)
    known = lateral[tuple(np.clip(index, 0, np.array(lateral.shape) - 1).T)]
    good = np.isfinite(known)
    if np.corrcoef(slow[good], known[good])[0, 1] < 0:
        tips = tips[::-1]
    strips, ends = [], []
    for tip in tips:
        gap = (along - along[tip] + 0.5 * length) % length - 0.5 * length
        near = np.abs(gap) <= settings.rim_half * thickness
        strips.append(np.flatnonzero(near))
        ends.append((int(np.argmin(np.where(near, gap, np.inf))), int(np.argmax(np.where(near, gap, -np.inf)))))
    first = _between(ends[0][1], ends[1][0], mesh.border)
    second = _between(ends[1][1], ends[0][0], mesh.border)
    if area < 0:
        first, second = second, first
    x = laplace.between(strips[0], strips[1])
    z = laplace.between(first, second)
    scale = np.array([0.5 * abs(area) / thickness, 0.5 * thickness])
    back = LinearNDInterpolator(np.column_stack([x, z]) * scale, mesh.points)
    rows, columns = np.meshgrid(
        np.linspace(-1, 1, settings.ribbon_nodes), _ACROSS, indexing="ij"
    )
    found = back(np.stack([rows, columns], axis=-1) * (1 - 1e-6) * scale)
    if not np.isfinite(found).all():
        raise GeometryError("the ribbon of a slice folds", reason="slice-ribbon")
    return np.asarray(found)


def _area(line: Float) -> float:
    after = np.roll(line, -1, axis=0)
    return 0.5 * float((line[:, 0] * after[:, 1] - line[:, 1] * after[:, 0]).sum())


def _between(start: int, stop: int, count: int) -> Int:
    """Numbers from start to stop, both included, round a circle of ``count``."""
    return (start + np.arange((stop - start) % count + 1)) % count


def match_lines(first: Float, second: Float, bending: float) -> Float:
    """Where on the second mid-line (N, 2), mm, points of the first (M, 2) belong: (M,) in 0 to 1.

    Monotone, from end to end: the sum of squared distances and of ``bending`` (mm2) times the
    squared stretch, by dynamic programming.
    """
    count = 4 * len(first)
    line, length = _even(second, count)
    steps = np.linalg.norm(np.diff(first, axis=0), axis=1)
    cost = ((first[:, None] - line[None]) ** 2).sum(axis=2)
    reach = 16  # a stretch by four
    stretch = length / (count - 1) * np.arange(reach + 1) / np.maximum(steps[:, None], 1e-3)
    total = np.full(count, np.inf)
    total[0] = cost[0, 0]
    chosen = np.zeros((len(first), count), dtype=np.int16)
    for i in range(1, len(first)):
        before = np.full((reach + 1, count), np.inf)
        for step in range(reach + 1):
            before[step, step:] = total[: count - step] + bending * stretch[i - 1, step] ** 2
        chosen[i] = before.argmin(axis=0)
        total = before.min(axis=0) + cost[i]
    at = np.zeros(len(first))
    j = count - 1
    for i in range(len(first) - 1, -1, -1):
        at[i] = j
        j -= int(chosen[i, j])
    return at / (count - 1)


def _even(line: Float, count: int) -> tuple[Float, float]:
    """Points (count, 2) at equal steps along a line (N, 2), and its length."""
    along = np.append(0.0, np.linalg.norm(np.diff(line, axis=0), axis=1).cumsum())
    at = np.linspace(0, along[-1], count)
    return np.stack([np.interp(at, along, line[:, k]) for k in (0, 1)], axis=1), float(along[-1])


def align_nodes(nodes: list[Float], pixel: float, settings: SliceSettings) -> list[Float]:
    """Move nodes (X, Z, 2) along each slice so that equal numbers belong together."""
    middle = len(nodes) // 2
    aligned: dict[int, Float] = {middle: _at(nodes[middle], np.linspace(0, 1, len(nodes[middle])))}
    for order in (range(middle + 1, len(nodes)), range(middle - 1, -1, -1)):
        last = middle
        for number in order:
            center = nodes[number].shape[1] // 2
            where = match_lines(
                pixel * aligned[last][:, center],
                pixel * nodes[number][:, center],
                settings.match_stretch,
            )
            aligned[number] = _at(nodes[number], where)
            last = number
    return [aligned[number] for number in range(len(nodes))]


def _at(nodes: Float, where: Float) -> Float:
    """Nodes at fractions (M,) of the length of the mid-line."""
    middle = nodes[:, nodes.shape[1] // 2]
    along = np.append(0.0, np.linalg.norm(np.diff(middle, axis=0), axis=1).cumsum())
    row = np.interp(where * along[-1], along, np.arange(len(nodes)))
    below = np.clip(row.astype(int), 0, len(nodes) - 2)
    share = (row - below)[:, None, None]
    return np.asarray((1 - share) * nodes[below] + share * nodes[below + 1])
