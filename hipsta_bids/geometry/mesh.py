"""From a solid field to a closed triangle surface with planar end caps, and to its tetrahedra."""

from collections.abc import Callable
from itertools import combinations

import numpy as np
from scipy import sparse
from skimage.measure import marching_cubes

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.grid import Field
from hipsta_bids.geometry.tetgen_worker import TetgenClient
from hipsta_bids.settings import SurfaceSettings, TetraSettings
from hipsta_bids.types import Bool, Float, Int, Surface, TetMesh, position_text

#: Taubin smoothing: step towards the mean of the neighbors, fraction.
TAUBIN_SHRINK = 0.5
#: Taubin smoothing: step back, fraction.
TAUBIN_INFLATE = -0.53
#: How often a surface that TetGen cannot fill is smoothed more.
UNTANGLE_TRIES = 2
#: Passes in which TetGen moves its vertices to better places (its default is 7). They
#: cost time; on phantoms the errors were the same without.
VOLUME_SMOOTHING_STEPS = 0

_CLIENT = TetgenClient()


def extract_surface(field: Field, settings: SurfaceSettings) -> Surface:
    """Extract the zero level of a field, closed by planar caps, and smooth it.

    Beyond the end planes the field counts as strongly negative, so that marching cubes puts the
    caps into the end planes and their vertices are known. Smoothing: Taubin 1995, SIGGRAPH
    '95:351-358.
    """
    outside = -1e4 * float(np.abs(field.values).max())
    padded = np.pad(field.values, 1, constant_values=outside)
    nodes, faces, _, _ = marching_cubes(padded, level=0.0)  # type: ignore[no-untyped-call]
    nodes = nodes.astype(np.float64) - 1.0
    last = field.grid.shape[2] - 1
    nodes[:, 2] = np.clip(nodes[:, 2], 0, last)
    # Crossings against the free space outside land within 1e-4 of a step from the end plane.
    posterior, anterior = nodes[:, 2] < 1e-3, nodes[:, 2] > last - 1e-3  # noqa: PLR2004
    nodes[posterior, 2], nodes[anterior, 2] = 0, last
    faces = faces.astype(np.int32)
    edges = unique_edges(faces)
    _check_sphere(len(nodes), faces, edges)
    nodes = _taubin(nodes, faces, edges, (posterior, anterior), settings)
    vertices = field.grid.to_ras(nodes)
    if signed_volume(vertices, faces) < 0:
        faces = faces[:, ::-1]
    return Surface(
        vertices=vertices, triangles=faces, posterior_cap=posterior, anterior_cap=anterior
    )


def close_gaps(faces: Int, count: int) -> Int:
    """Close gaps between triangles (F, 3) of ``count`` vertices, (F + n, 3).

    Marching cubes leaves some where cells share an ambiguous face: four vertices without triangles.
    """
    start, end = faces.ravel().astype(np.int64), np.roll(faces, -1, axis=1).ravel()
    lone = ~np.isin(start * count + end, end * count + start)
    after = dict(zip(end[lone].tolist(), start[lone].tolist(), strict=True))
    added = []
    while after:
        first, second = after.popitem()
        third = after.pop(second, first)
        while third != first:
            added.append((first, second, third))
            second, third = third, after.pop(third, first)
    return np.vstack([faces, added]).astype(np.int32) if added else faces


def signed_volume(vertices: Float, triangles: Int) -> float:
    """Volume enclosed by outward triangles, mm3."""
    a, b, c = (vertices.take(triangles[:, k], axis=0) for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def triangle_areas(vertices: Float, triangles: Int) -> Float:
    """Areas of triangles, (F,), mm2."""
    a, b, c = (vertices.take(triangles[:, k], axis=0) for k in range(3))
    return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))


def vertex_areas(vertices: Float, triangles: Int) -> Float:
    """Thirds of the triangles round each vertex, (V,), mm2."""
    thirds = np.repeat(triangle_areas(vertices, triangles) / 3, 3)
    return np.asarray(np.bincount(triangles.ravel(), thirds, len(vertices)), dtype=np.float64)


def lateral_triangles(surface: Surface) -> Bool:
    """Whether each triangle belongs to the wall, not to a cap, (F,)."""
    return ~_on_cap(surface.triangles, (surface.posterior_cap, surface.anterior_cap))


def _on_cap(triangles: Int, caps: tuple[Bool, Bool]) -> Bool:
    """Whether all corners of a triangle are on the same cap, (F,)."""
    return np.asarray(caps[0][triangles].all(axis=1) | caps[1][triangles].all(axis=1))


def mean_wall_thickness(surface: Surface) -> float:
    """2 volume / wall area, mm: the thickness of a sheet whose two sides make up its wall."""
    areas = triangle_areas(surface.vertices, surface.triangles)
    volume = signed_volume(surface.vertices, surface.triangles)
    return 2 * volume / float(areas[lateral_triangles(surface)].sum())


def unique_edges(cells: Int) -> Int:
    """Edges (E, 2) of triangles (F, 3) or tetrahedra (T, 4), each once, lower vertex first."""
    first, second = np.triu_indices(cells.shape[1], k=1)
    a, b = cells[:, first].ravel(), cells[:, second].ravel()
    code = np.sort(np.minimum(a, b).astype(np.int64) << 32 | np.maximum(a, b))
    code = code[np.diff(code, prepend=-1) > 0]
    return np.column_stack([code >> 32, code & 0xFFFFFFFF]).astype(np.int32)


def _check_sphere(count: int, faces: Int, edges: Int) -> None:
    """Refuse triangles between ``count`` vertices that are not one closed sphere."""
    euler = count - len(edges) + len(faces)
    pieces, _ = sparse.csgraph.connected_components(_adjacency(edges, count), directed=False)
    if euler != 2 or pieces != 1 or 2 * len(edges) != 3 * len(faces):  # noqa: PLR2004
        raise GeometryError(
            f"the surface is not one closed sphere (Euler number {euler}, {pieces} pieces): "
            "correct the labels by hand",
            reason="surface-topology",
        )


def smooth_vertices(nodes: Float, faces: Int, settings: SurfaceSettings) -> Float:
    """Smooth a closed surface without caps (Taubin 1995)."""
    no_caps = np.zeros(len(nodes), dtype=bool)
    return _taubin(nodes, faces, unique_edges(faces), (no_caps, no_caps), settings)


def edge_graph(edges: Int, weights: Float, count: int) -> sparse.csr_array:
    """Make a symmetric graph of edges (E, 2) with weights (E,)."""
    ways = np.vstack([edges, edges[:, ::-1]])
    return sparse.csr_array((np.tile(weights, 2), (ways[:, 0], ways[:, 1])), shape=(count, count))


def _adjacency(edges: Int, count: int) -> sparse.csr_array:
    return edge_graph(edges, np.ones(len(edges)), count)


def _taubin(
    nodes: Float, faces: Int, edges: Int, caps: tuple[Bool, Bool], settings: SurfaceSettings
) -> Float:
    """Smooth in grid coordinates; caps stay in their planes, outlines on themselves."""
    cap = caps[0] | caps[1]
    on_cap = _on_cap(faces, caps)
    outline = np.zeros(len(nodes), dtype=bool)
    outline[faces[~on_cap]] = True
    outline &= cap
    weights = _adjacency(edges, len(nodes)).tocoo()
    outline_edge = _outline_edges(faces[on_cap], len(nodes))
    keep = ~outline[weights.row]
    graph = sparse.csr_array(
        (weights.data[keep], (weights.row[keep], weights.col[keep])), shape=weights.shape
    )
    graph = graph + _adjacency(outline_edge, len(nodes))
    graph = graph.multiply(1 / np.maximum(graph.sum(axis=1), 1)[:, None]).tocsr()
    free = np.ones((len(nodes), 3))
    free[cap, 2] = 0
    nodes = nodes.copy()
    for _ in range(settings.taubin_iterations):
        for factor in (TAUBIN_SHRINK, TAUBIN_INFLATE):
            nodes += factor * free * (graph @ nodes - nodes)
    return nodes


def _outline_edges(cap_faces: Int, count: int) -> Int:
    """Edges that belong to one cap triangle only."""
    pairs = np.sort(np.vstack([cap_faces[:, [0, 1]], cap_faces[:, [1, 2]], cap_faces[:, [2, 0]]]))
    code, times = np.unique(pairs[:, 0].astype(np.int64) * count + pairs[:, 1], return_counts=True)
    single = code[times == 1]
    return np.column_stack([single // count, single % count]).astype(np.int32)


def fill_surface(
    surface: Surface,
    extract: Callable[[SurfaceSettings], Surface],
    settings: SurfaceSettings,
    tetra: TetraSettings,
    frame: Float | None = None,
) -> tuple[Surface, TetMesh, int]:
    """Fill a surface with tetrahedra; smooth it more while TetGen cannot, and count how often.

    ``extract`` makes the surface with other settings.
    """
    for extra in range(UNTANGLE_TRIES):
        try:
            return surface, tetrahedralize(surface, tetra, frame), extra
        except GeometryError:
            steps = settings.taubin_iterations * (2 + extra)
            surface = extract(settings.changed(taubin_iterations=steps))
    return surface, tetrahedralize(surface, tetra, frame), UNTANGLE_TRIES


def tetrahedralize(
    surface: Surface, settings: TetraSettings, frame: Float | None = None
) -> TetMesh:
    """Fill a surface with tetrahedra; its vertices are first and stay in place.

    TetGen: Si 2015, ACM Trans Math Softw 41:11. ``nobisect`` keeps the surface as it is, so that
    boundary sets of the surface are valid in the volume. TetGen makes other meshes of the
    same surface elsewhere, or of its mirror image: it gets the surface in the ``frame`` of the body
    (3, 3), which may be left-handed.
    """
    axes = np.eye(3) if frame is None else frame
    turn = 1 if np.linalg.det(axes) > 0 else -1
    origin = surface.vertices[0]
    options = {
        "plc": True,
        "quality": True,
        "minratio": settings.radius_edge_ratio,
        "smooth_maxiter": VOLUME_SMOOTHING_STEPS,
        "nobisect": True,
        "quiet": True,
    }
    # Differences of 1e-14 mm, as between orders of the voxel axes, make other meshes, too.
    local = ((surface.vertices - origin) @ axes.T).round(6)
    result = _CLIENT.mesh(local, surface.triangles[:, ::turn], options, settings.timeout)
    if isinstance(result, str):
        remedy = _where_to_look(surface) if "intersect" in result else "check the labels"
        raise GeometryError(f"{result}: {remedy}", reason="tetrahedralization")
    vertices, cells = result
    cells = cells.astype(np.int32)
    if not np.array_equal(vertices[: len(local)], local):
        raise GeometryError("TetGen moved vertices of the surface", reason="tetrahedralization")
    vertices = np.vstack([surface.vertices, vertices[len(local) :] @ axes + origin])
    volume = tetra_volumes(vertices, cells)
    enclosed = signed_volume(surface.vertices, surface.triangles)
    if not np.isclose(np.abs(volume).sum(), enclosed, rtol=1e-6):  # rounding of 1e5 elements
        raise GeometryError(
            f"the tetrahedra fill {np.abs(volume).sum():.1f} of {enclosed:.1f} mm3: "
            f"{_where_to_look(surface)}",
            reason="tetrahedralization",
        )
    cells[volume < 0] = cells[volume < 0][:, [0, 2, 1, 3]]
    return TetMesh(vertices=vertices, tetrahedra=cells[volume != 0])


def _where_to_look(surface: Surface) -> str:
    return (
        "the surface intersects itself; check the labels for touching parts, first near "
        f"{position_text(_sharpest_fold(surface))}, where it is most sharply folded"
    )


def _sharpest_fold(surface: Surface) -> Float:
    """Middle (3,), RAS mm, of the edge at which two triangles enclose the smallest angle."""
    triangles = surface.triangles
    a, b, c = (surface.vertices[triangles[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    # On a closed surface each edge occurs twice: next to each other once they are in order.
    order = np.lexsort(edges.T).reshape(-1, 2)
    first, second = (order // 3).T
    sharpest = order[np.argmin(np.einsum("ij,ij->i", normals[first], normals[second])), 0]
    return np.asarray(surface.vertices[edges[sharpest]].mean(axis=0))


def tetra_volumes(vertices: Float, tetrahedra: Int) -> Float:
    """Signed volumes of tetrahedra, (T,), mm3."""
    # Coordinates are next to each other; `take` needs a quarter of the time of an index.
    corners = vertices.T.take(tetrahedra.T, axis=1)
    (ax, bx, cx), (ay, by, cy), (az, bz, cz) = corners[:, 1:] - corners[:, :1]
    return np.asarray(
        (ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)) / 6
    )


def cross(a: Float, b: Float) -> Float:
    """Cross products of the rows of (N, 3) arrays, in half the time of NumPy."""
    return np.column_stack(
        [
            a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1],
            a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2],
            a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0],
        ]
    )


def tetra_quality(mesh: TetMesh) -> Float:
    """Mean ratio of each tetrahedron, (T,): 1 for a regular one, 0 for a flat one.

    Liu & Joe 1994, BIT 34:268-287: 12 (3 volume)^(2/3) / sum of squared edge lengths.
    """
    corners = np.moveaxis(mesh.vertices.T.take(mesh.tetrahedra.T, axis=1), 1, 0)
    squares = sum(((b - a) ** 2).sum(axis=0) for a, b in combinations(corners, 2))
    volume = tetra_volumes(mesh.vertices, mesh.tetrahedra)
    return np.asarray(12 * np.cbrt(3 * volume) ** 2 / squares)
