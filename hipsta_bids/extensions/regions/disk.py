"""The mid-surface of the whole sheet as a disk, its edges and ends, and a map to a rectangle.

Lines of steepest ascent of a function on tetrahedra cross it from wall to wall. Their lengths are
what the two arrival times of Yezzi & Prince 2003 (IEEE Trans Med Imaging 22:1332-1339)
approximate; followed one by one they need neither an order nor an iteration.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.mesh import edge_graph, tetra_volumes, triangle_areas, unique_edges
from hipsta_bids.types import Bool, Float, Int, TetMesh

_FLOOR, _CEILING = 0.05, 20.0
"""Bounds of the weights of edges: negative ones would fold the map."""
NEAR = 0.75
"""Nearer than this to an edge, an end or a hole the body's coordinates are not taken over, mm."""
_PULL = 50.0
"""Ends have so many times their y at first, or where the body ends obliquely, y would not rise."""
_PARTS = 60
"""Into so many parts head and tail are divided to space their rows."""
_SLACK = 1e-6
"""Nodes on the sides of triangles must not be lost by rounding."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Disk:
    """A triangle mesh with one boundary; filled holes are marked."""

    vertices: Float
    """(V, 3) RAS mm."""
    triangles: Int
    """(F, 3) all oriented alike, their normals towards the exterior."""
    holes: tuple[float, ...]
    """Perimeters of the holes, mm, longest first."""
    centers: tuple[Float, ...]
    """(3,) middle of each hole, RAS mm, in the same order."""
    beside: float
    """Area of all other pieces over that of this one."""
    loop: Int
    """(B,) vertices of the boundary, in order."""
    cell: NDArray[np.intp]
    """(F,) tetrahedron in which each triangle lies; -1 where it fills a hole."""

    @cached_property
    def from_edges(self) -> Float:
        """(V,) distance along the sheet from its edges, ends and filled holes, mm."""
        edges = unique_edges(self.triangles[self.cell >= 0])
        lengths = np.linalg.norm(np.diff(self.vertices[edges], axis=1)[:, 0], axis=1)
        edge_points = np.union1d(self.loop, self.triangles[self.cell < 0])
        graph = edge_graph(edges, lengths, len(self.vertices))
        distance: Float = sparse.csgraph.dijkstra(
            graph, directed=False, indices=edge_points, min_only=True
        )
        return distance

    @cached_property
    def stiffness(self) -> sparse.csr_array:
        """Its stiffness, all edge weights at least a floor, so that triangles do not flip."""
        rows, weights = [], []
        for k in range(3):
            corner, i, j = (self.triangles[:, (k + n) % 3] for n in range(3))
            u, v = (self.vertices[end] - self.vertices[corner] for end in (i, j))
            sine = np.linalg.norm(np.cross(u, v), axis=1)
            weights.append(0.5 * (u * v).sum(axis=1) / np.maximum(sine, 1e-9))
            rows.append(np.sort(np.column_stack([i, j]), axis=1))
        size = len(self.vertices)
        pair = np.concatenate(rows).astype(np.int64)
        code, index = np.unique(pair[:, 0] * size + pair[:, 1], return_inverse=True)
        total: Float = np.bincount(index, np.concatenate(weights)).astype(np.float64)
        ends = np.column_stack([code // size, code % size]).astype(np.int32)
        graph = edge_graph(ends, np.clip(total, _FLOOR, _CEILING), size)
        return sparse.csr_array(sparse.diags_array(np.asarray(graph.sum(axis=1)).ravel()) - graph)


def level_surface(
    mesh: TetMesh, values: Float, level: float
) -> tuple[Float, Int, NDArray[np.intp]]:
    """Find where a function (V,) has a value: points, triangles, and a cell per triangle.

    Triangles are oriented so that the function rises along their normals.
    """
    cells = mesh.tetrahedra
    above = values[cells] > level
    number = above.sum(axis=1)
    order = np.argsort(~above, axis=1, kind="stable")  # corners above first
    ends: list[Int] = []
    owner: list[NDArray[np.intp]] = []
    for count, faces in (
        (1, (((0, 1), (0, 2), (0, 3)),)),
        (3, (((0, 3), (1, 3), (2, 3)),)),
        (2, (((0, 2), (0, 3), (1, 3)), ((0, 2), (1, 3), (1, 2)))),
    ):
        rows = np.flatnonzero(number == count)
        corner = np.take_along_axis(cells[rows], order[rows], axis=1)
        for face in faces:
            ends.append(corner[:, np.array(face)])  # (N, 3, 2) vertices of three crossed edges
            owner.append(rows)
    edges = np.sort(np.concatenate(ends).reshape(-1, 2).astype(np.int64), axis=1)
    cell = np.concatenate(owner)
    code, index = np.unique(edges[:, 0] * len(values) + edges[:, 1], return_inverse=True)
    a, b = code // len(values), code % len(values)
    share = ((level - values[a]) / (values[b] - values[a]))[:, None]
    points = mesh.vertices[a] + share * (mesh.vertices[b] - mesh.vertices[a])
    triangles = index.reshape(-1, 3).astype(np.int32)
    p = points[triangles]
    normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    up = mesh.vertices[cells[cell]] - p[:, :1]
    rise = ((values[cells[cell]] - level)[:, :, None] * up).sum(axis=1)
    wrong = (normal * rise).sum(axis=1) < 0
    triangles[wrong] = triangles[wrong][:, ::-1]
    return points, triangles, cell


def make_disk(points: Float, triangles: Int, cell: NDArray[np.intp]) -> Disk:
    """Take the largest piece of a surface and fill all its holes but the longest boundary."""
    graph = edge_graph(unique_edges(triangles), np.ones(len(unique_edges(triangles))), len(points))
    piece = sparse.csgraph.connected_components(graph, directed=False)[1]
    area = np.bincount(piece[triangles[:, 0]], triangle_areas(points, triangles))
    main = piece[triangles[:, 0]] == area.argmax()
    triangles, cell = triangles[main], cell[main]
    loops = _loops(triangles)
    if not loops:
        raise GeometryError("the mid-surface is closed: check the labels", reason="whole-topology")
    length = [
        float(np.linalg.norm(points[loop] - points[np.roll(loop, 1)], axis=1).sum())
        for loop in loops
    ]
    order = np.argsort(length)[::-1]
    filled, centers = list[Int](), list[Float]()
    for number in order[1:]:
        loop = loops[number]
        center = len(points) + len(centers)
        centers.append(points[loop].mean(axis=0))
        # The boundary runs along its triangles; those of the filling run against it.
        filled.append(np.column_stack([np.roll(loop, -1), loop, np.full(len(loop), center)]))
    added = np.concatenate(filled) if filled else np.zeros((0, 3), np.int32)
    vertices = np.vstack([points, *[c[None] for c in centers]])
    closed = np.vstack([triangles, added])
    cell = np.concatenate([cell, np.full(len(added), -1)])
    corners = np.unique(closed)
    index = np.full(len(vertices), -1, dtype=np.int32)
    index[corners] = np.arange(len(corners), dtype=np.int32)
    closed = index[closed]
    euler = len(corners) - len(unique_edges(closed)) + len(closed)
    if euler != 1:
        raise GeometryError(
            f"the sheet has {(1 - euler) // 2} handles: parts of the sheet touch; "
            "correct the labels by hand",
            reason="whole-topology",
        )
    return Disk(
        vertices=vertices[corners],
        triangles=closed,
        holes=tuple(length[n] for n in order[1:]),
        centers=tuple(centers),
        beside=float(area.sum() / area.max() - 1),
        loop=index[loops[order[0]]],
        cell=cell,
    )


def _loops(triangles: Int) -> list[Int]:
    """Find the boundaries, in the direction in which their triangles run."""
    ways = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).astype(np.int64)
    size = int(ways.max()) + 1
    code, reverse = ways[:, 0] * size + ways[:, 1], ways[:, 1] * size + ways[:, 0]
    open_ = ways[~np.isin(code, reverse)]
    after: dict[int, list[int]] = {}
    for a, b in open_.tolist():
        after.setdefault(a, []).append(b)
    loops = []
    while after:
        start = next(iter(after))
        loop, vertex = [], start
        while vertex in after:
            targets = after[vertex]
            loop.append(vertex)
            vertex, branches = targets[-1], targets[:-1]
            if branches:
                after[loop[-1]] = branches
            else:
                del after[loop[-1]]
        loops.append(np.array(loop, dtype=np.int32))
    return loops


@dataclass(frozen=True, eq=False, kw_only=True)
class Edges:
    """The four sides of a disk, vertex numbers in the order of its boundary."""

    medial: Int
    lateral: Int
    posterior: Int
    anterior: Int


def find_edges(disk: Disk, medial: Float, lateral: Float, height: Float) -> Edges:
    """Divide the boundary by what speaks for (1) and against (-1) an edge at its vertices (B,).

    An edge is the arc with the largest sum, by length; the rest are the ends. ``height`` (B,)
    rises towards the anterior end.
    """
    points = disk.vertices[disk.loop]
    step = np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1)
    length = (step + np.roll(step, -1)) / 2
    first = _best_arc(medial * length)
    excluded = np.isin(np.arange(len(length)), first)
    for step_aside in (1, -1):  # a vertex of each end lies between
        excluded |= np.roll(excluded, step_aside)
    second = _best_arc(np.where(excluded, -length.sum(), lateral * length))
    if not (len(first) and len(second)):
        raise GeometryError(
            "the sheet has no medial or lateral edge; check the labels of the subiculum, "
            "CA2 and CA3",
            reason="whole-topology",
        )
    arcs = [first, second]
    count = len(disk.loop)
    between = [
        (first[-1] + np.arange(1, (second[0] - first[-1]) % count)) % count
        for first, second in (arcs, arcs[::-1])
    ]
    between.sort(key=lambda arc: float(np.median(height[arc])))
    sides = [disk.loop[arc] for arc in (*arcs, *between)]
    return Edges(medial=sides[0], lateral=sides[1], posterior=sides[2], anterior=sides[3])


def _best_arc(score: Float) -> NDArray[np.intp]:
    """Find the arc with the largest sum in a closed sequence of scores: its indices, in order."""
    count = len(score)
    total = np.concatenate([[0.0], np.cumsum(np.tile(score, 2))])
    # An arc of a closed sequence either does not wrap, or what it leaves out does not.
    low = np.minimum.accumulate(total[: count + 1])
    end = int((total[: count + 1] - low).argmax())
    high = np.maximum.accumulate(total[: count + 1])
    gap = int((high - total[: count + 1]).argmax())
    inner, outer = total[end] - low[end], total[count] + high[gap] - total[gap]
    if inner >= outer:
        first = int(np.flatnonzero(total[: end + 1] == low[end])[-1])
        return np.arange(first, end)
    begin = int(np.flatnonzero(total[: gap + 1] == high[gap])[-1])
    return np.arange(gap, begin + count) % count


def map_to_rectangle(
    disk: Disk, edges: Edges, body: Float, extent: float, ends: tuple[float, float]
) -> Float:
    """Two functions (V, 2): x from -1 to 1 between the edges, y between the two values of ``ends``.

    Where ``body`` (V, 2) is a number, beyond ``NEAR`` of edges, ends and holes, both are the
    body's; elsewhere they continue as harmonic functions. A harmonic function changes most at a
    short end: there its lines would all lie. Beyond plus and minus ``extent``, y is therefore the
    mean distance along the sheet, from the body, of the points of a line.
    """
    matrix = disk.stiffness
    inside = (disk.from_edges > NEAR) & np.isfinite(body).all(axis=1)
    inner = np.flatnonzero(inside)
    x = _harmonic(matrix, (edges.medial, -1.0), (edges.lateral, 1.0), (inner, body[inner, 0]))
    pulled = [end * _PULL if abs(end) > extent else end for end in ends]
    sides = (edges.posterior, pulled[0]), (edges.anterior, pulled[1])
    y = _harmonic(matrix, *sides, (inner, body[inner, 1]))
    links = unique_edges(disk.triangles)
    lengths = np.linalg.norm(np.diff(disk.vertices[links], axis=1)[:, 0], axis=1)
    far = sparse.csgraph.dijkstra(
        edge_graph(links, lengths, len(y)),
        directed=False,
        indices=np.flatnonzero(np.abs(y) <= extent),
        min_only=True,
    )
    spaced = y.copy()
    for sign, end in ((-1.0, -ends[0]), (1.0, ends[1])):
        beyond = np.flatnonzero(sign * y > extent)
        if end <= extent or not len(beyond):
            continue
        order = beyond[np.argsort(sign * y[beyond], kind="stable")]
        parts = np.array_split(order, min(_PARTS, len(order)))
        level = [extent, *(float(sign * y[part].mean()) for part in parts), end * _PULL]
        mean = [0.0, *(float(far[part].mean()) for part in parts)]
        depth = np.maximum.accumulate([*mean, float(far[order].max())])
        depth += _SLACK * np.arange(len(depth))  # lines must not merge
        reached = np.interp(sign * y[beyond], level, depth)
        spaced[beyond] = sign * (extent + (end - extent) * reached / depth[-1])
    return np.column_stack([x, spaced])


def proximodistal(disk: Disk, edges: Edges) -> Float:
    """Harmonic function (V,) from -1 at the medial to 1 at the lateral edge, without the body's x.

    HippUnfold's proximal-distal coordinate is one, too (DeKraker et al. 2022, eLife 11:e77945).
    """
    return _harmonic(disk.stiffness, (edges.medial, -1.0), (edges.lateral, 1.0))


def _harmonic(matrix: sparse.csr_array, *fixed: tuple[NDArray[np.integer], Float | float]) -> Float:
    """Harmonic function (V,) with given values at some vertices."""
    count = matrix.shape[0]
    result, free = np.zeros(count), np.ones(count, dtype=bool)
    for nodes, value in fixed:
        result[nodes], free[nodes] = value, False
    factor = splu(
        sparse.csc_array(matrix[free][:, free]),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    result[free] = factor.solve(-(matrix @ result)[free])
    return result


def flipped_area(disk: Disk, plane: Float) -> float:
    """Share of a disk's area that a map (V, 2) turns over."""
    a, b, c = (plane[disk.triangles[:, k]] for k in range(3))
    u, v = b - a, c - a
    sign = np.sign(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    area = triangle_areas(disk.vertices, disk.triangles)
    wrong = float(area[sign * np.sign((sign * area).sum()) <= 0].sum())
    return wrong / float(area.sum())


def locate_nodes(disk: Disk, plane: Float, x: Float, y: Float) -> tuple[NDArray[np.intp], Float]:
    """Triangle (Nx, Ny) of a map (V, 2) that holds each node of a grid, and weights (Nx, Ny, 3).

    -1 where there is none. Where a fold makes two triangles claim a node, the one that holds it
    most centrally wins.
    """
    corner = plane[disk.triangles]
    low = [
        np.searchsorted(axis, corner[..., k].min(axis=1) - _SLACK) for k, axis in enumerate((x, y))
    ]
    high = [
        np.searchsorted(axis, corner[..., k].max(axis=1) + _SLACK) for k, axis in enumerate((x, y))
    ]
    count = [b - a for a, b in zip(low, high, strict=True)]
    number = count[0] * count[1]
    cell = np.repeat(np.arange(len(number)), number)
    rank = np.arange(len(cell)) - np.repeat(np.cumsum(number) - number, number)
    i, j = low[0][cell] + rank // count[1][cell], low[1][cell] + rank % count[1][cell]
    a, b, c = corner[cell].swapaxes(0, 1)
    u, v, w = b - a, c - a, np.column_stack([x[i], y[j]]) - a
    det = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    det = np.where(np.abs(det) < 1e-15, np.nan, det)  # noqa: PLR2004 -- flat
    second = (w[:, 0] * v[:, 1] - w[:, 1] * v[:, 0]) / det
    third = (u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0]) / det
    weight = np.column_stack([1 - second - third, second, third])
    worst = weight.min(axis=1)
    order = np.argsort(worst, kind="stable")  # not a number comes last
    order = order[worst[order] > -_SLACK]
    triangle = np.full((len(x), len(y)), -1, dtype=np.intp)
    weights = np.zeros((len(x), len(y), 3))
    triangle[i[order], j[order]] = cell[order]
    weights[i[order], j[order]] = weight[order]
    return triangle, weights


def at_nodes(disk: Disk, plane: Float, values: Float, x: Float, y: Float) -> Float:
    """Values (V,) of a disk at the nodes (Nx, Ny) of a grid; NaN where there is none."""
    triangle, weights = locate_nodes(disk, plane, x, y)
    sampled: Float = (weights * values[disk.triangles[triangle]]).sum(axis=2)
    return np.where(triangle < 0, np.nan, sampled)


_STEPS = 400
_LEVEL = 1e-12
"""What changes less per mm does not change."""
_OPPOSITE = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


class Lines:
    """Directions on a mesh, means over the tetrahedra round each vertex, linear in between.

    So they do not jump between tetrahedra, and no line is caught between two of them.
    """

    def __init__(self, mesh: TetMesh, gradient: Float) -> None:
        """Prepare directions from a gradient (T, 3), neighbors and barycentric coordinates."""
        cells = mesh.tetrahedra
        self.points, self.cells = mesh.vertices, cells
        length = np.linalg.norm(gradient, axis=1, keepdims=True)
        flow = gradient / np.maximum(length, 1e-12) * tetra_volumes(mesh.vertices, cells)[:, None]
        directions: Float = np.stack(
            [np.bincount(cells.ravel(), part, len(self.points)) for part in flow.repeat(4, 0).T], 1
        )
        length = np.linalg.norm(directions, axis=1, keepdims=True)
        self.directions = directions / np.maximum(length, 1e-12)
        corner = mesh.vertices[cells]
        edges = np.swapaxes(corner[:, 1:] - corner[:, :1], 1, 2)
        inverse = np.linalg.inv(edges)
        #: (T, 4, 3) gradients of the four barycentric coordinates.
        self.gradients = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
        faces = np.sort(cells[:, _OPPOSITE].reshape(-1, 3), axis=1).astype(np.int64)
        code = (faces[:, 0] * len(self.points) + faces[:, 1]) * len(self.points) + faces[:, 2]
        order = np.argsort(code, kind="stable")
        twin = np.flatnonzero(code[order[1:]] == code[order[:-1]])
        neighbor = np.full(len(code), -1, dtype=np.intp)
        a, b = order[twin], order[twin + 1]
        neighbor[a], neighbor[b] = b // 4, a // 4
        #: (T, 4) tetrahedron beyond the face opposite to each corner; -1 outside.
        self.neighbor = neighbor.reshape(-1, 4)

    def columns(
        self, cell: NDArray[np.intp], points: Float, count: int, limit: float
    ) -> tuple[Float, Bool]:
        """Points (N, count, 3) evenly along the lines through points (N, 3), lowest value first.

        Also whether (N,) both ends of a line reached the surface, each within ``limit``, mm.
        """
        (up, first), (down, second) = (self._follow(cell, points, s, limit) for s in (1.0, -1.0))
        path = np.concatenate([down[:, :0:-1], up], axis=1)
        steps = np.linalg.norm(np.diff(path, axis=1), axis=2)
        along = np.concatenate([np.zeros((len(path), 1)), steps.cumsum(axis=1)], axis=1)
        share = np.linspace(0, 1, count)
        samples = np.empty((len(path), count, 3))
        for row, (corners, length) in enumerate(zip(path, along, strict=True)):
            for axis in range(3):
                samples[row, :, axis] = np.interp(share * length[-1], length, corners[:, axis])
        return samples, first & second

    def _weights(self, cell: NDArray[np.intp], points: Float) -> Float:
        """Barycentric coordinates (N, 4) of points (N, 3) in their cells."""
        first = self.points[self.cells[cell, 0]]
        weights: Float = np.einsum("nij,nj->ni", self.gradients[cell], points - first)
        weights[:, 0] += 1
        return weights

    def _follow(
        self, cell: NDArray[np.intp], points: Float, sign: float, limit: float
    ) -> tuple[Float, Bool]:
        """Follow lines from points (N, 3) in cells (N,) to the surface.

        Returns the corners (N, S, 3) of the lines, their last point repeated, and whether (N,) each
        reached the surface within a length of ``limit``, mm.
        """
        at, cell = points.copy(), cell.copy()
        path = [at.copy()]
        active = np.arange(len(at))
        arrived = np.zeros(len(at), dtype=bool)
        length = np.zeros(len(at))
        for _ in range(_STEPS):
            if not len(active):
                break
            position, inside = at[active], cell[active]
            weight = np.clip(self._weights(inside, position), 0, 1)
            way = sign * np.einsum("ni,nij->nj", weight, self.directions[self.cells[inside]])
            size = np.linalg.norm(way, axis=1)
            way /= np.maximum(size, 1e-12)[:, None]
            rate = np.einsum("nij,nj->ni", self.gradients[inside], way)
            with np.errstate(divide="ignore", invalid="ignore"):
                far = np.where(rate < -_LEVEL, weight / -rate, np.inf)
            exit_ = far.argmin(axis=1)
            step = far[np.arange(len(active)), exit_]
            step = np.where(np.isfinite(step), step, 0.0)
            at[active] = position + step[:, None] * way
            length[active] += step
            beyond = self.neighbor[inside, exit_]
            arrived[active[beyond < 0]] = True
            cell[active] = np.where(beyond < 0, inside, beyond)
            path.append(at.copy())
            active = active[(beyond >= 0) & (length[active] < limit) & (size > 0)]
        return np.stack(path, axis=1), arrived
