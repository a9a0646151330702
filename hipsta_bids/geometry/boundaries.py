"""Medial and lateral boundary of the sheet, and its two sides, on the surface of the body."""

from dataclasses import dataclass

import numpy as np
from lapy import Solver, TriaMesh
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.spatial import cKDTree

from hipsta_bids.artifacts import Bool, Float, Int, Surface, TetMesh
from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.body import Body
from hipsta_bids.geometry.laplace import smallest_eigenfunctions, solve_dirichlet
from hipsta_bids.geometry.surface import (
    lateral_triangles,
    mean_wall_thickness,
    signed_volume,
    triangle_areas,
    unique_edges,
)
from hipsta_bids.settings import BoundarySettings


@dataclass(frozen=True, eq=False, kw_only=True)
class Boundaries:
    """Where the three coordinates are fixed. Indices are vertices of the surface and the mesh."""

    medial: Int
    lateral: Int
    interior: Int
    exterior: Int
    posterior: Int
    anterior: Int
    medial_curve: Float
    """(N, 3) points of the boundary curve, RAS mm."""
    lateral_curve: Float
    rule: str
    """``eigenfunction`` (surface, anisotropic) or ``ridge`` (volume)."""
    distance: float
    """Largest of the two curves' mean distances between the two rules, mm; NaN if only one exists."""
    rim_distance: float
    """Mean distance of the curves from the rim paths, the worse of the two, mm."""
    side_rule: str
    """What told interior from exterior: ``labels``, or ``bending`` (decided on the sheet)."""
    side_margin: float
    """Difference of the shares of outward probes that hit interior labels; NaN without labels."""
    strip_width: float
    """Full width of the boundary strips, mm."""
    sheet_thickness: float
    """2 volume / area of the two sides, strips left out on either, mm."""


def find_boundaries(
    surface: Surface, mesh: TetMesh, body: Body, settings: BoundarySettings
) -> Boundaries:
    """Find the boundary strips, sides and caps of the sheet.

    The zero lines of the first curvature-aware anisotropic Laplace-Beltrami eigenfunction of the
    wall are the medial and lateral boundary (Diers et al. 2023, section 2.1.3). An independent
    answer comes from the first eigenfunction of the volume: along the sheet's rims it is extreme.

    Parameters
    ----------
    surface : Surface
    mesh : TetMesh
        Its first vertices are those of the surface.
    body : Body
    settings : BoundarySettings

    Returns
    -------
    Boundaries

    Raises
    ------
    GeometryError
        ``boundaries`` if neither rule gives two curves from end to end that separate the sides.
    """
    wall = _Wall(surface, body, settings)
    thickness = mean_wall_thickness(surface)
    paths, depths = _rim_paths(wall, mesh, body, settings)
    rims = (wall.vertices[paths[0]], wall.vertices[paths[1]])
    guided = _guided_curves(wall, paths, depths, thickness, settings)
    curves = _eigenfunction_curves(wall)
    distance = float("nan")
    if curves is not None and guided is not None:
        distance = _curve_distance(curves, guided)
    width = settings.strip_width * thickness
    attempts = [("eigenfunction", curves), ("rims", guided)]
    if not distance <= settings.max_distance:
        attempts.reverse()
    for rule, pair in attempts:
        if pair is None:
            continue
        strips = [wall.near(curve, 0.5 * width) for curve in pair]
        sides = wall.sides(strips[0] | strips[1])
        if sides is not None and not (strips[0] & strips[1]).any():
            break
    else:
        raise GeometryError(
            "the medial and lateral boundary do not separate the interior from the exterior side: "
            "check the labels for folds that touch each other",
            reason="boundaries",
        )
    if _rank(pair[0], body) > _rank(pair[1], body):
        pair, strips = pair[::-1], strips[::-1]
    sides, side_rule, margin = _interior_first(sides, wall, body, settings)
    return Boundaries(
        medial=wall.index[strips[0]],
        lateral=wall.index[strips[1]],
        interior=wall.index[wall.with_rim(sides[0], strips)],
        exterior=wall.index[wall.with_rim(sides[1], strips)],
        posterior=np.flatnonzero(surface.posterior_cap).astype(np.int32),
        anterior=np.flatnonzero(surface.anterior_cap).astype(np.int32),
        medial_curve=pair[0],
        lateral_curve=pair[1],
        rule=rule,
        distance=distance,
        rim_distance=_curve_distance(pair, rims),
        side_rule=side_rule,
        side_margin=margin,
        strip_width=width,
        sheet_thickness=_sheet_thickness(surface, wall, strips[0] | strips[1]),
    )


class _Wall:
    """The surface without its caps, with vertices numbered anew."""

    def __init__(self, surface: Surface, body: Body, settings: BoundarySettings) -> None:
        triangles = surface.triangles[lateral_triangles(surface)]
        self.index = np.unique(triangles).astype(np.int32)
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

        # LaPy's curvature is an angle per edge, so it grows with the edge length; in 1/mm it is
        # divided by that and a factor (see the settings). Outward triangles have negative
        # curvature where the surface is convex: the second weight slows diffusion across the rims.
        strength = settings.anisotropy / (settings.lapy_curvature * float(self.lengths.mean()))
        solver = Solver(
            TriaMesh(self.vertices.copy(), self.triangles.copy()),
            lump=True,
            aniso=(0.0, strength),
            aniso_smooth=settings.curvature_smoothing,
        )
        self.matrix = sparse.csc_array(solver.stiffness)
        self.mass: Float = solver.mass.diagonal()

    def near(self, curve: Float, reach: float) -> Bool:
        """Vertices within ``reach`` mm of a curve and connected to it along the wall."""
        gap, _ = cKDTree(curve).query(self.vertices, distance_upper_bound=reach)
        close = np.isfinite(gap)
        closest = int(cKDTree(self.vertices).query(curve[len(curve) // 2])[1])
        close[closest] = True
        inside = close[self.edges].all(axis=1)
        graph = _graph(self.edges[inside], np.ones(np.count_nonzero(inside)), len(close))
        _, piece = sparse.csgraph.connected_components(graph, directed=False)
        return np.asarray(close & (piece == piece[closest]))

    def with_rim(self, side: Bool, strips: tuple[Bool, Bool] | list[Bool]) -> Bool:
        """A side and the strips' vertices next to it, so that strip and side share an edge.

        Without it no point would have the coordinates of the edges between them.
        """
        strip = strips[0] | strips[1]
        first, second = self.edges.T
        grown = side.copy()
        grown[second[side[first] & strip[second]]] = True
        grown[first[side[second] & strip[first]]] = True
        return grown

    def sides(self, strips: Bool) -> tuple[Bool, Bool] | None:
        """The two large pieces of the wall without the strips; crumbs belong to neither."""
        both = self.edges[~strips[self.edges].any(axis=1)]
        graph = _graph(both, np.ones(len(both)), len(strips))
        _, piece = sparse.csgraph.connected_components(graph, directed=False)
        size = np.bincount(piece, weights=~strips)
        first, second = np.argsort(size)[::-1][:2]
        # Each side makes up most of a half; a leak leaves one piece and crumbs.
        if size[second] < 0.2 * size[first]:  # noqa: PLR2004
            return None
        sides = (~strips & (piece == first), ~strips & (piece == second))
        ends = all((side & end).any() for side in sides for end in (self.posterior, self.anterior))
        return sides if ends else None


def _eigenfunction_curves(wall: _Wall) -> tuple[Float, Float] | None:
    """Zero lines of the first anisotropic eigenfunction, if exactly two run from end to end."""
    _, functions = smallest_eigenfunctions(wall.matrix, wall.mass, 1)
    return _end_to_end(wall, functions[:, 0])


def _end_to_end(wall: _Wall, values: Float) -> tuple[Float, Float] | None:
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


def _connected_crossings(
    wall: _Wall, mixed: NDArray[np.intp], crossing: Bool
) -> NDArray[np.int32]:
    """Piece number of each crossed edge; two crossed edges of one triangle belong together."""
    code = wall.edges[:, 0].astype(np.int64) << 32 | wall.edges[:, 1]
    code = code[crossing]
    triangles = wall.triangles[mixed]
    pairs = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
    codes = pairs[..., 0].astype(np.int64) << 32 | pairs[..., 1]
    place = np.searchsorted(code, codes).clip(max=len(code) - 1)
    hit = code[place] == codes
    links = place[hit].reshape(-1, 2)  # a zero line crosses two edges of a triangle
    graph = sparse.csr_array((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(len(code),) * 2)
    return np.asarray(sparse.csgraph.connected_components(graph, directed=False)[1])


def _rim_paths(
    wall: _Wall, mesh: TetMesh, body: Body, settings: BoundarySettings
) -> tuple[tuple[NDArray[np.intp], NDArray[np.intp]], tuple[Float, Float]]:
    """Paths from end to end along which the wall is farthest from the opposite rim.

    Distances run inside the volume and mostly across the long axis, as steps along it are
    stretched. The first ones start from the sheet's most lateral labels.

    Returns
    -------
    paths : two (N,) arrays of int
        Medial and lateral path, vertices of the wall.
    depths : two (V,) arrays
        How much nearer than the rim of their slice the wall's vertices are to the opposite rim, mm.
    """
    edges = unique_edges(mesh.tetrahedra)
    steps = np.diff(mesh.vertices[edges], axis=1)[:, 0]
    along = steps @ body.ends.axis
    stretch = settings.axial_stretch**2 - 1
    lengths = np.sqrt(np.einsum("ij,ij->i", steps, steps) + stretch * along**2)
    graph = _graph(edges, lengths, len(mesh.vertices))
    start = _most_lateral(mesh, body, settings)
    paths: list[NDArray[np.intp]] = []
    depths: list[Float] = []
    for _ in range(3):  # medial from labels, lateral from medial, medial again from lateral
        distance = sparse.csgraph.dijkstra(graph, indices=start, min_only=True)[wall.index]
        depth = _below_top(distance, wall.share)
        path = _rim_path(depth, wall, settings)
        start = wall.index[path]
        paths.append(path)
        depths.append(depth)
    return (paths[2], paths[1]), (depths[2], depths[1])


def _most_lateral(mesh: TetMesh, body: Body, settings: BoundarySettings) -> NDArray[np.intp]:
    """Vertices whose surroundings carry the most lateral labels."""
    index, points = body.inside_points()
    rank = body.tissue[tuple(index.T)].astype(float)
    count = min(settings.label_neighbors, len(points))
    _, nearest = cKDTree(points).query(mesh.vertices, k=count)
    mean = rank[nearest].mean(axis=1)
    return np.flatnonzero(mean >= np.quantile(mean, 1 - settings.lateral_share))


def _rim_path(depth: Float, wall: _Wall, settings: BoundarySettings) -> NDArray[np.intp]:
    """Cheapest path from end to end; being away from the rim costs."""
    cost = wall.lengths * (
        settings.rim_floor + (np.maximum(depth, 0)[wall.edges].mean(axis=1)) ** 2
    )
    start = _lowest(depth, wall.posterior)
    end = _lowest(depth, wall.anterior)
    graph = _graph(wall.edges, cost, len(depth))
    _, before = sparse.csgraph.dijkstra(graph, indices=start, return_predecessors=True)
    path = [end]
    while path[-1] != start and len(path) <= len(depth):
        path.append(int(before[path[-1]]))
    return np.array(path)


def _lowest(depth: Float, where: Bool) -> int:
    return int(np.flatnonzero(where)[np.argmin(depth[where])])


def _below_top(values: Float, share: Float) -> Float:
    """How far values lie below the largest of their slice."""
    count = 40
    slices = np.minimum((share * count).astype(int), count - 1)
    top = np.full(count, -np.inf)
    np.maximum.at(top, slices, values)
    centres = (np.arange(count) + 0.5) / count
    known = np.isfinite(top)
    top = ndimage.median_filter(np.interp(centres, centres[known], top[known]), 5, mode="nearest")
    return np.interp(share, centres, top) - values


def _below_rim(depth: Float, path: NDArray[np.intp], wall: _Wall) -> Float:
    """Depth below the rim path of the same slice, mm."""
    order = np.argsort(wall.share[path], kind="stable")
    return depth - np.interp(wall.share, wall.share[path][order], depth[path][order])


def _guided_curves(
    wall: _Wall,
    paths: tuple[NDArray[np.intp], NDArray[np.intp]],
    depths: tuple[Float, Float],
    thickness: float,
    settings: BoundarySettings,
) -> tuple[Float, Float] | None:
    """Middle lines between the two sides within the zones at the rims.

    Without the rim zones the wall falls into its two sides. The zero line of the harmonic
    function between them, with the same curvature-aware diffusion, runs along the rims.
    """
    zones = [
        (_below_rim(depth, path, wall) < settings.rim_zone * thickness)
        | wall.near(wall.vertices[path], settings.rim_reach * thickness)
        for path, depth in zip(paths, depths, strict=True)
    ]
    sides = wall.sides(zones[0] | zones[1])
    if sides is None:
        return None
    fixed = np.flatnonzero(sides[0] | sides[1])
    values = np.where(sides[1][fixed], 1.0, -1.0)
    harmonic = solve_dirichlet(wall.matrix, fixed, values)
    return _end_to_end(wall, harmonic)


def _graph(edges: Int, weights: Float, count: int) -> sparse.csr_array:
    """Symmetric graph over edges."""
    both = np.vstack([edges, edges[:, ::-1]])
    return sparse.csr_array((np.tile(weights, 2), (both[:, 0], both[:, 1])), shape=(count, count))


def _curve_distance(first: tuple[Float, Float], second: tuple[Float, Float]) -> float:
    """Mean distance of the curves of one pair from those of the other, the worse of the two."""
    gaps = np.array([[cKDTree(b).query(a)[0].mean() for b in second] for a in first])
    straight, crossed = np.diag(gaps), np.diag(gaps[:, ::-1])
    return float(min(straight.max(), crossed.max()))


def _rank(curve: Float, body: Body) -> float:
    """Mean medial-to-lateral rank of the sheet labels nearest to a curve (Tissue is in order)."""
    index, points = body.inside_points()
    _, nearest = cKDTree(points).query(curve)
    return float(body.tissue[tuple(index[nearest].T)].mean())


def _interior_first(
    sides: tuple[Bool, Bool], wall: _Wall, body: Body, settings: BoundarySettings
) -> tuple[tuple[Bool, Bool], str, float]:
    """Order the sides by how often probes outward from them hit labels of the interior side."""
    normals = _vertex_normals(wall)
    target = body.interior & (body.tissue == 0)
    inverse = np.linalg.inv(body.affine)
    hit = np.zeros(len(normals), dtype=bool)
    for reach in settings.probe_distances:
        probe = (wall.vertices + reach * normals) @ inverse[:3, :3].T + inverse[:3, 3]
        voxel = np.clip(np.rint(probe).astype(int), 0, np.array(target.shape) - 1)
        hit |= target[tuple(voxel.T)]
    share = [float(hit[side].mean()) for side in sides]
    if max(share) < settings.min_probe_share:
        return sides, "bending", float("nan")
    margin = abs(share[0] - share[1])
    return (sides if share[0] > share[1] else sides[::-1]), "labels", margin


def _sheet_thickness(surface: Surface, wall: _Wall, strips: Bool) -> float:
    """2 volume / area of the wall, the strips' own area counted as end faces."""
    areas = triangle_areas(wall.vertices, wall.triangles)
    ends = strips[wall.triangles].all(axis=1)
    return 2 * signed_volume(surface.vertices, surface.triangles) / float(areas[~ends].sum())


def _vertex_normals(wall: _Wall) -> Float:
    """(V, 3) unit outward normals, weighted by area."""
    a, b, c = (wall.vertices[wall.triangles[:, k]] for k in range(3))
    faces = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    index = wall.triangles.ravel()
    total = np.column_stack(
        [np.bincount(index, weights=faces[:, k], minlength=len(wall.vertices)) for k in range(3)]
    )
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1), 1e-12)[:, None])
