"""The wall of the body: its surface without the caps."""

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from hipsta_bids.geometry.body import Body
from hipsta_bids.geometry.fem import triangle_stiffness
from hipsta_bids.geometry.mesh import lateral_triangles, triangle_areas, unique_edges
from hipsta_bids.settings import BoundarySettings
from hipsta_bids.types import Bool, Float, Int, Surface

# Least curvature of a triangle mesh and its direction.


_UPPER = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])
_TINY = 1e-8  # of unit vectors


def least_curvature(vertices: Float, triangles: Int, smoothing: int) -> tuple[Float, Float]:
    """Least of the two principal curvatures per triangle, and its direction.

    The curvature tensor of Cohen-Steiner & Morvan 2003 (SoCG '03:312-321) by the formulas of
    Alliez et al. 2003 (ACM Trans Graph 22:485-493), step by step as LaPy's
    ``TriaMesh.curvature_tria``, to which tests compare it. LaPy spends most of the time on finding
    the edges.
    """
    corners = vertices[triangles]
    crossed = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = crossed / np.sqrt((crossed**2).sum(axis=1, keepdims=True))
    count = len(vertices)
    edges, faces = _inner_edges(triangles, count)
    tensor = _smoothed(_edge_tensors(vertices, edges, normals[faces]), triangles, smoothing)
    vertex_normals = _sum_at(triangles.T.ravel(), np.tile(crossed, (3, 1)), count)
    length = np.sqrt((vertex_normals**2).sum(axis=1, keepdims=True))
    directions, curvature = _least_in_plane(tensor, vertex_normals / np.maximum(length, 1e-300))
    mean = (directions / 3)[triangles].sum(axis=1)
    mean -= normals * (normals * mean).sum(axis=1, keepdims=True)
    mean /= np.maximum(np.sqrt((mean**2).sum(axis=1, keepdims=True)), _TINY)
    return mean, (curvature / 3)[triangles].sum(axis=1)


def _inner_edges(triangles: Int, count: int) -> tuple[Int, NDArray[np.intp]]:
    """Edges (E, 2) between two triangles, lower vertex first, and these triangles (E, 2).

    The first of the two runs along the edge, the second against it.
    """
    start, stop = triangles.T.ravel(), np.roll(triangles, -1, axis=1).T.ravel()
    code = np.minimum(start, stop).astype(np.int64) * count + np.maximum(start, stop)
    along = np.flatnonzero(start < stop)
    against = np.flatnonzero(start > stop)
    code, first, second = np.intersect1d(
        code[along], code[against], assume_unique=True, return_indices=True
    )
    faces = np.column_stack([along[first], against[second]]) % len(triangles)
    return np.column_stack([code // count, code % count]).astype(np.int32), faces


def _edge_tensors(vertices: Float, edges: Int, normals: Float) -> Float:
    """Curvature tensor of each vertex, (V, 6), upper triangle: the mean over its edges."""
    cosine = (normals[:, 0] * normals[:, 1]).sum(axis=1).clip(-1, 1)
    along = vertices[edges[:, 1]] - vertices[edges[:, 0]]
    turn = (np.cross(normals[:, 0], normals[:, 1]) * along).sum(axis=1)
    length = np.sqrt((along**2).sum(axis=1))
    weight = -np.sign(turn) * np.arccos(cosine) * (length / length.mean())
    along /= length[:, None]
    tensors = along[:, _UPPER[0]] * along[:, _UPPER[1]] * weight[:, None]
    ends = edges.T.ravel()
    degree = np.bincount(ends, minlength=len(vertices))
    return _sum_at(ends, np.tile(tensors, (2, 1)), len(vertices)) / np.maximum(degree, 1)[:, None]


def _smoothed(values: Float, triangles: Int, steps: int) -> Float:
    """Replace values (V, K) by the means of their neighbors'."""
    count = len(values)
    first, second = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    both = np.concatenate([first, second]), np.concatenate([second, first])
    graph = sparse.csr_array((np.ones(len(both[0])), both), shape=(count, count))
    graph.data[:] = 1  # an edge of two triangles is still one neighbor
    degree = np.maximum(graph.sum(axis=1), 1)[:, None]
    for _ in range(steps):
        values = (graph @ values) / degree
    return values


def _least_in_plane(tensor: Float, normals: Float) -> tuple[Float, Float]:
    """Direction (V, 3) and size (V,) of the least curvature across the normals."""
    matrices = np.empty((len(tensor), 3, 3))
    matrices[:, _UPPER[0], _UPPER[1]] = tensor
    matrices[:, _UPPER[1], _UPPER[0]] = tensor
    values, vectors = np.linalg.eigh(matrices)
    # Edges turn across themselves, so in the plane the direction of the one eigenvalue is the
    # eigenvector of the other.
    across = np.abs((vectors * normals[:, :, None]).sum(axis=1))
    order = np.argsort(-across, axis=1)
    low, high = np.sort(order[:, 1:], axis=1).T  # eigenvalues come in ascending order
    vertex = np.arange(len(tensor))
    return vectors[vertex, :, high], values[vertex, low]


def _sum_at(index: NDArray[np.integer], values: Float, count: int) -> Float:
    """Sum rows of values (N, K) by index (N,), (count, K)."""
    return np.column_stack([np.bincount(index, column, count) for column in values.T])


class Wall:
    """The surface without its caps, with vertices numbered anew."""

    def __init__(self, surface: Surface, body: Body, settings: BoundarySettings) -> None:
        triangles = surface.triangles[lateral_triangles(surface)]
        used = np.bincount(triangles.ravel(), minlength=len(surface.vertices)) > 0
        self.index = np.flatnonzero(used).astype(np.int32)
        number = np.full(len(surface.vertices), -1, dtype=np.int32)
        number[self.index] = np.arange(len(self.index))
        self.vertices = surface.vertices[self.index]
        self.triangles = number[triangles]
        self.posterior = surface.posterior_cap[self.index]
        self.anterior = surface.anterior_cap[self.index]
        below = body.ends.height(self.vertices, "posterior")
        above = -body.ends.height(self.vertices, "anterior")
        self.share = np.clip(below / (below + above), 0, 1)
        self.edges = unique_edges(self.triangles)
        self.lengths = np.linalg.norm(np.diff(self.vertices[self.edges], axis=1)[:, 0], axis=1)

        self._tree = cKDTree(self.vertices)
        self.bend_aware, self.evenly_aware = self._stiffness(settings)
        self.areas = triangle_areas(self.vertices, self.triangles)
        count = len(self.vertices)
        share = np.repeat(self.areas / 3, 3)
        self.mass: Float = np.bincount(self.triangles.ravel(), share, count).astype(np.float64)

    def _stiffness(self, settings: BoundarySettings) -> tuple[sparse.csc_array, sparse.csc_array]:
        """Two stiffness matrices with diffusion across sharp convex bends slowed down.

        The first without limit, so that the sharpest lines part the wall; the second down to a
        least value, so that of two edges the sharper one does not win.

        LaPy's curvature is an angle per edge, so it grows with the edge length; in 1/mm it is
        divided by that and a factor (see the settings). On outward triangles it is negative where
        the surface is convex.
        """
        direction, least = least_curvature(
            self.vertices, self.triangles, settings.curvature_smoothing
        )
        bend = -least / (settings.lapy_curvature * float(self.lengths.mean()))
        excess = np.maximum(bend - settings.sharp_bend, 0)
        slowed = np.exp(-settings.anisotropy * excess)
        limited = np.maximum(slowed, settings.least_diffusion)
        return (
            triangle_stiffness(self.vertices, self.triangles, direction, slowed),
            triangle_stiffness(self.vertices, self.triangles, direction, limited),
        )

    def near(self, curve: Float, reach: float) -> Bool:
        """Vertices within ``reach`` mm of a curve and connected to it along the wall."""
        close = np.zeros(len(self.vertices), dtype=bool)
        close[np.concatenate(self._tree.query_ball_point(curve, reach)).astype(np.intp)] = True
        closest = int(self._tree.query(curve[len(curve) // 2])[1])
        close[closest] = True
        seed = np.zeros(len(close), dtype=bool)
        seed[closest] = True
        return self.connected(close, seed)

    def connected(self, part: Bool, seed: Bool) -> Bool:
        """Vertices of a part of the wall that are connected within it to one of the seeds."""
        piece = self._pieces(part)
        return np.asarray(part & np.isin(piece, piece[seed]))

    def _pieces(self, where: Bool) -> NDArray[np.int32]:
        """Piece number of each vertex if only edges between vertices of a set connect."""
        inside = self.edges[where[self.edges[:, 0]] & where[self.edges[:, 1]]]
        # The edges are in order, as the rows of a matrix have to be.
        rows = np.searchsorted(inside[:, 0], np.arange(len(where) + 1))
        links = sparse.csr_array(
            (np.ones(len(inside)), inside[:, 1], rows), shape=(len(where),) * 2
        )
        return np.asarray(sparse.csgraph.connected_components(links, directed=False)[1])

    def with_rim(self, side: Bool, strips: tuple[Bool, Bool]) -> Bool:
        """Add to a side the strips' vertices next to it, so that they share an edge.

        Without it no point would have the coordinates of the edges between them.
        """
        strip = strips[0] | strips[1]
        first, second = self.edges.T
        grown = side.copy()
        grown[second[side[first] & strip[second]]] = True
        grown[first[side[second] & strip[first]]] = True
        return grown

    def sides(self, strips: Bool) -> tuple[Bool, Bool] | None:
        """Find the two large pieces of the wall without the strips; fragments belong to neither."""
        piece = self._pieces(~strips)
        size = np.bincount(piece, weights=~strips)
        first, second = np.argsort(size)[::-1][:2]
        # Each side makes up most of a half; a leak leaves one piece and fragments.
        if size[second] < 0.2 * size[first]:
            return None
        sides = (~strips & (piece == first), ~strips & (piece == second))
        ends = all((side & end).any() for side in sides for end in (self.posterior, self.anterior))
        return sides if ends else None


def edge_graph(edges: Int, weights: Float, count: int) -> sparse.csr_array:
    """Make a symmetric graph of edges (E, 2) with weights (E,)."""
    both = np.vstack([edges, edges[:, ::-1]])
    return sparse.csr_array((np.tile(weights, 2), (both[:, 0], both[:, 1])), shape=(count, count))


def end_to_end(wall: Wall, values: Float) -> tuple[Float, Float] | None:
    """Zero lines that run from the posterior to the anterior end, if there are exactly two."""
    side = values > 0
    crossing = side[wall.edges[:, 0]] != side[wall.edges[:, 1]]
    if not crossing.any():
        return None
    first, second = wall.edges[crossing].T
    share = values[first] / (values[first] - values[second])
    points = wall.vertices[first] + share[:, None] * (wall.vertices[second] - wall.vertices[first])
    mixed = np.flatnonzero(np.ptp(side[wall.triangles].astype(np.int8), axis=1))
    pieces = _connected_crossings(wall, mixed, crossing)
    curves = []
    for piece in range(pieces.max() + 1):
        chosen = pieces == piece
        ends = wall.edges[crossing][chosen]
        if wall.posterior[ends].any() and wall.anterior[ends].any():
            curves.append(points[chosen])
    return (curves[0], curves[1]) if len(curves) == 2 else None  # noqa: PLR2004


def _connected_crossings(wall: Wall, mixed: NDArray[np.intp], crossing: Bool) -> NDArray[np.int32]:
    """Piece number of each crossed edge; two crossed edges of one triangle belong together."""
    code = wall.edges[:, 0].astype(np.int64) << 32 | wall.edges[:, 1]
    code = code[crossing]
    triangles = wall.triangles[mixed]
    pairs = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
    codes = pairs[..., 0].astype(np.int64) << 32 | pairs[..., 1]
    place = np.searchsorted(code, codes).clip(max=len(code) - 1)
    hit = code[place] == codes
    links = place[hit].reshape(-1, 2)  # a zero line crosses two edges of a triangle
    graph = sparse.csr_array(
        (np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(len(code),) * 2
    )
    return np.asarray(sparse.csgraph.connected_components(graph, directed=False)[1])


def vertex_normals(wall: Wall) -> Float:
    """(V, 3) unit outward normals, weighted by area."""
    a, b, c = (wall.vertices[wall.triangles[:, k]] for k in range(3))
    faces = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    index = wall.triangles.ravel()
    total = np.column_stack(
        [np.bincount(index, weights=faces[:, k], minlength=len(wall.vertices)) for k in range(3)]
    )
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1), 1e-12)[:, None])
