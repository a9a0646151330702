"""The wall of the body: its surface without the caps, and lines on it."""

from functools import cached_property

import numpy as np
from lapy import TriaMesh
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from hipsta_bids.geometry import mesh
from hipsta_bids.geometry.fem import Directed, Laplace, bare_mesh
from hipsta_bids.settings import BoundarySettings
from hipsta_bids.types import Bool, Float, Int, Surface

#: Least diffusion where curves are moved to the middle of the edges of the sheet.
LEAST_DIFFUSION = 0.1
#: Smoothing steps of the curvature tensor.
CURVATURE_SMOOTHING = 2
#: LaPy's curvature over curvature x mean edge length (measured on cylinders).
LAPY_CURVATURE = 0.3


class _Mesh(TriaMesh):  # type: ignore[misc]  # LaPy is untyped
    """LaPy's mesh, with two methods of LaPy 1.7 replaced.

    Its curvature spends half of its time on ``edges``. ``curvature_tria`` averages directions whose
    signs are arbitrary: they cancel each other or not by rounding.
    """

    def edges(self, with_boundary: bool = False) -> tuple[Int, Int]:  # noqa: ARG002  (as in LaPy)
        """Inner edges (E, 2) and the triangles (E, 2) along and against which they run."""
        inner = sparse.triu(self.adj_dir.multiply(self.adj_dir.T), format="csr")
        inner.sort_indices()
        triangle = self.construct_adj_dir_tidx()
        adjacent = [inner.multiply(side).tocsr().data for side in (triangle, triangle.T)]
        return np.stack(inner.nonzero(), axis=1), np.stack(adjacent, axis=1).astype(np.int32) - 1

    def curvature_tria(self, smoothit: int = 3) -> tuple[Float, Float, Float, Float]:
        """Directions (T, 3) and values (T,) of least and largest curvature, as in LaPy."""
        directions, _, least, most, *_ = self.curvature(smoothit)
        normals = self.tria_normals()
        first = self.v[self.t[:, 1]] - self.v[self.t[:, 0]]
        first /= np.linalg.norm(first, axis=1)[:, None]
        frame = first, np.cross(normals, first)
        # Opposite directions are one: as complex numbers they have the same square.
        a, b = (np.einsum("tik,tk->ti", directions[self.t], side) for side in frame)
        mean = np.sqrt(((a + 1j * b) ** 2).mean(axis=1))
        mean /= np.maximum(np.abs(mean), 1e-12)
        along = mean.real[:, None] * frame[0] + mean.imag[:, None] * frame[1]
        across = mean.real[:, None] * frame[1] - mean.imag[:, None] * frame[0]
        return along, across, least[self.t].mean(axis=1), most[self.t].mean(axis=1)


class Wall:
    """The surface without its caps, in one piece, with vertices numbered anew."""

    def __init__(self, surface: Surface, settings: BoundarySettings) -> None:
        triangles = _one_piece(surface.triangles[mesh.lateral_triangles(surface)])
        used = np.bincount(triangles.ravel(), minlength=len(surface.vertices)) > 0
        self.index = np.flatnonzero(used).astype(np.int32)
        number = np.full(len(surface.vertices), -1, dtype=np.int32)
        number[self.index] = np.arange(len(self.index))
        self.vertices = surface.vertices[self.index]
        self.triangles = number[triangles]
        self.posterior = surface.posterior_cap[self.index]
        self.anterior = surface.anterior_cap[self.index]
        self.edges = mesh.unique_edges(self.triangles)
        self.lengths = np.linalg.norm(np.diff(self.vertices[self.edges], axis=1)[:, 0], axis=1)

        self._tree = cKDTree(self.vertices)
        self.areas = mesh.triangle_areas(self.vertices, self.triangles)
        self.vertex_areas = mesh.vertex_areas(self.vertices, self.triangles)
        plain = bare_mesh(TriaMesh, self.vertices, self.triangles)
        laplace = Laplace(plain, settings.solver)
        curved = _Mesh(self.vertices, self.triangles)
        across, along, least, largest = curved.curvature_tria(CURVATURE_SMOOTHING)
        self._curvature = np.abs(np.stack([largest, least], axis=1))
        self._directed = Directed(laplace, across, along)
        self._bend = -least / (LAPY_CURVATURE * float(self.lengths.mean()))
        self.evenly_aware = self.operator(settings, LEAST_DIFFUSION)

    def operator(self, settings: BoundarySettings, least: float = 0.0) -> Laplace:
        """Make a Laplace operator with diffusion across sharp convex bends slowed down.

        Without limit, the sharpest lines separate the wall; down to a ``least`` speed, of two edges
        the sharper one does not win.

        LaPy's curvature is an angle per edge, so it grows with the edge length; in 1/mm it is
        divided by that and a factor (see the settings). On outward triangles it is negative where
        the surface is convex.
        """
        if settings.operator == "published" and not least:
            speeds = np.exp(-settings.anisotropy * self._curvature)
            return self._directed(speeds)
        excess = np.maximum(self._bend - settings.sharp_bend, 0)
        slowed = np.maximum(np.exp(-settings.anisotropy * excess), least)
        speeds = np.stack([np.ones_like(slowed), slowed], axis=1)
        return self._directed(speeds)

    def distance(self, curve: Float, reach: float) -> Float:
        """Compute distances (V,) from the nearest of a curve's points (N, 3), up to ``reach``, mm.

        Infinite beyond, and where no way along the wall stays within reach, as across a gap.
        """
        distance = np.asarray(
            cKDTree(curve).query(self.vertices, distance_upper_bound=reach)[0], dtype=np.float64
        )
        closest = int(self._tree.query(curve[len(curve) // 2])[1])
        seed = np.zeros(len(distance), dtype=bool)
        seed[closest] = True
        return np.where(self.connected(np.isfinite(distance) | seed, seed), distance, np.inf)

    @cached_property
    def smooth_normals(self) -> Float:
        """(V, 3) mean normals of each vertex and its neighbors, unit length."""
        links = mesh.edge_graph(self.edges, np.ones(len(self.edges)), len(self.vertices))
        total = (links @ self.normals) + self.normals
        return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1), 1e-12)[:, None])

    @cached_property
    def normals(self) -> Float:
        """(V, 3) unit outward normals, weighted by area."""
        return vertex_normals(self.vertices, self.triangles)

    def connected(self, part: Bool, seed: Bool) -> Bool:
        """Vertices of a part of the wall that are connected within it to one of the seeds."""
        piece = self._pieces(part)
        reached = np.zeros(len(piece), dtype=bool)
        reached[piece[seed]] = True
        return np.asarray(part & reached[piece])

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


def _one_piece(triangles: Int) -> Int:
    """Keep the triangles (T, 3) of the largest piece.

    Others are specks between a cap and its rim. On these a second function is constant, too, and
    would be the first eigenfunction.
    """
    count = int(triangles.max()) + 1
    edges = mesh.unique_edges(triangles)
    links = mesh.edge_graph(edges, np.ones(len(edges)), count)
    piece = sparse.csgraph.connected_components(links, directed=False)[1][triangles[:, 0]]
    return np.asarray(triangles[piece == np.bincount(piece).argmax()])


def vertex_normals(vertices: Float, triangles: Int) -> Float:
    """(V, 3) unit normals, weighted by area."""
    a, b, c = (vertices.take(triangles[:, k], axis=0) for k in range(3))
    faces = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    index = triangles.ravel()
    total = np.stack([np.bincount(index, column, len(vertices)) for column in faces.T], 1)
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1), 1e-12)[:, None])


def end_to_end(wall: Wall, values: Float) -> tuple[Float, Float] | None:
    """Zero lines that run from the posterior to the anterior end, if there are exactly two."""
    side = values > 0
    crossing = side[wall.edges[:, 0]] != side[wall.edges[:, 1]]
    if not crossing.any():
        return None
    first, second = wall.edges[crossing].T
    share = values[first] / (values[first] - values[second])
    points = wall.vertices[first] + share[:, None] * (wall.vertices[second] - wall.vertices[first])
    a, b, c = side[wall.triangles.T]
    mixed = np.flatnonzero((a != b) | (a != c))
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
    rank = np.searchsorted(code, codes).clip(max=len(code) - 1)
    hit = code[rank] == codes
    links = rank[hit].reshape(-1, 2)  # a zero line crosses two edges of a triangle
    graph = sparse.csr_array(
        (np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(len(code),) * 2
    )
    return np.asarray(sparse.csgraph.connected_components(graph, directed=False)[1])
