"""The surface of the whole sheet, head and tail included, and its two faces.

Nothing is cut, and nothing is made a ball of: where banks of the head touch, the labels do not show
them apart. A function on the surface, near 1 on the interior and near -1 on the exterior face, is
solved in one linear system from labels next to the surface, from sharp bends, and from the opposite
wall; its zero line is the rim.

Where the cleft between two banks is lost, the wall there has the same face on both sides. Banks of
low folds hardly face each other: what is left of such a fold is a narrow ridge of a thick wall.
Two walls are thick next to any wall of the head; a thin neighborhood alone makes no ridge.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry import mesh
from hipsta_bids.geometry.digital import FACES, piece_sizes, to_ras
from hipsta_bids.geometry.fem import compact_groups, solve_two_level
from hipsta_bids.geometry.measures import column_area, measure_thickness
from hipsta_bids.geometry.mesh import vertex_areas
from hipsta_bids.geometry.wall import vertex_normals
from hipsta_bids.protocols.protocol import CORE, Tissue
from hipsta_bids.settings import SurfaceSettings
from hipsta_bids.types import Bool, Float, Int, LabelVolume, Sheet, Surface

SMOOTHING, MIN_SMOOTHING = 0.83, 0.25
"""Standard deviation of the Gaussian, in-plane voxels, and its least, mm."""
EDGE_BEND = 0.35
"""Neighbors across a sharper convex bend than this hardly have to be alike, 1/mm."""
OPPOSITE = 0.6
"""How much it weighs that opposite walls are different faces; that neighbors are alike: 2."""
EVIDENCE = {
    Tissue.MOLECULAR_LAYER: (1.0, 0.5),
    **dict.fromkeys(CORE, (1.0, 0.05)),
    Tissue.BACKGROUND: (-1.0, 0.04),
    Tissue.OTHER: (-1.0, 0.04),
}
"""Face next to which a label lies, and how much that weighs. Dentate gyrus lies next to the lateral
edge, too, and what has no label may be either."""
PROBES = (0.25, 0.4, 0.55, 0.7)
"""Where labels are looked for, mm outside the surface."""
REACH = 3.5
"""How far the opposite wall may be, mm."""
FAR_REACH = 6.0
"""The same across two walls that touch."""
STRIP = 0.75
"""The rim strip reaches this far to both sides, multiples of the median distance across."""
ISLAND = 5.0
"""Smaller parts of one face inside of the other belong to that, mm2."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Faces:
    """Which vertices of the surface belong to the two faces."""

    side: Float
    """(V,) near 1 on the interior, near -1 on the exterior face."""
    free: Bool
    """(V,) the strip along the rim, which belongs to neither."""
    opposite: NDArray[np.intp]
    """(V,) the vertex of the wall opposite; -1 where none faces it."""

    @property
    def interior(self) -> Int:
        """Vertices of the interior face."""
        return np.flatnonzero(~self.free & (self.side > 0)).astype(np.int32)

    @property
    def exterior(self) -> Int:
        """Vertices of the exterior face."""
        return np.flatnonzero(~self.free & (self.side <= 0)).astype(np.int32)


def whole_tissue(volume: LabelVolume, body: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(I, J, K) the largest piece of the sheet's subfields, cavities filled; 0 elsewhere.

    Voxels without label that have a tissue in the ``body``, as mended gaps, have it here, too.
    """
    mended = (volume.tissue == Tissue.BACKGROUND) & (body > 0)
    sheet = np.isin(volume.tissue, volume.protocol.sheet)
    tissue = np.where(sheet, volume.tissue, np.where(mended, body, 0))
    pieces, count = ndimage.label(tissue > 0, structure=FACES)
    if not count:
        raise GeometryError(
            "no voxel of the sheet's subfields: check the protocol", reason="no-sheet-labels"
        )
    main = pieces == piece_sizes(pieces).argmax()
    inside = ndimage.binary_fill_holes(main)
    nearest = ndimage.distance_transform_edt(~main, return_distances=False, return_indices=True)
    return np.where(inside, tissue[tuple(nearest)], 0).astype(np.uint8)


def whole_surface(
    inside: Bool, affine: Float, spacing: float, surface: SurfaceSettings
) -> tuple[Surface, NDArray[np.float32], Float]:
    """Smooth a mask and extract its surface; also the field, and its affine to RAS mm."""
    edges = np.linalg.norm(affine[:3, :3], axis=0)
    steps = spacing / edges
    room = np.ceil(2.0 / edges).astype(int)  # mm of free space
    padded = np.pad(inside, [(n, n) for n in room]).astype(np.float32)
    shape = tuple(int(n) for n in (np.array(padded.shape) - 1) // steps + 1)
    values = ndimage.affine_transform(padded, steps, output_shape=shape, order=1, output=np.float32)
    sigma = max(MIN_SMOOTHING, SMOOTHING * float(np.sort(edges)[:2].mean()))
    sigma /= spacing
    field = ndimage.gaussian_filter(values, sigma, truncate=3.0)
    field -= np.float32(0.5)
    pieces, _ = ndimage.label(field > 0, structure=FACES)
    field[(field > 0) & (pieces != piece_sizes(pieces).argmax())] = -0.01
    grid = affine.copy()
    grid[:3, :3] = affine[:3, :3] * steps
    grid[:3, 3] = to_ras(-room, affine)
    nodes, faces, _, _ = marching_cubes(field, level=0.0)  # type: ignore[no-untyped-call]
    faces = mesh.close_gaps(faces.astype(np.int32), len(nodes))
    nodes = mesh.smooth_vertices(nodes.astype(np.float64), faces, surface)
    vertices = to_ras(nodes, grid)
    if mesh.signed_volume(vertices, faces) < 0:
        faces = faces[:, ::-1]
    no_caps = np.zeros(len(vertices), dtype=bool)
    return (
        Surface(vertices=vertices, triangles=faces, posterior_cap=no_caps, anterior_cap=no_caps),
        field,
        grid,
    )


def find_faces(
    surface: Surface, volume: LabelVolume, field: NDArray[np.float32], grid: Float
) -> Faces:
    """Find the interior and the exterior face, and the strip between them."""
    points, triangles = surface.vertices, surface.triangles
    count = len(points)
    edges = mesh.unique_edges(triangles)
    normals = vertex_normals(points, triangles)
    across, opposite, touching = _opposite(points, normals, field, grid)
    step, turn = (
        points[edges[:, 1]] - points[edges[:, 0]],
        normals[edges[:, 1]] - normals[edges[:, 0]],
    )
    lengths = np.linalg.norm(step, axis=1)
    bend = np.maximum((step * turn).sum(axis=1) / lengths**2, 0)  # 1/mm along the edge, convex
    weight = 2 / (1 + (bend / EDGE_BEND) ** 4) + 0.02
    graph = mesh.edge_graph(edges, weight, count)
    diagonal: Float = np.asarray(graph.sum(axis=1), dtype=np.float64).ravel()
    mated = np.flatnonzero(opposite >= 0)
    pairs = mesh.edge_graph(
        np.column_stack([mated, opposite[mated]]).astype(np.int32),
        np.full(len(mated), OPPOSITE),
        count,
    )
    diagonal += np.asarray(pairs.sum(axis=1)).ravel()
    right: Float = np.zeros(count)
    for target, strength in _label_evidence(points, normals, volume):
        diagonal += strength
        right += target * strength
    matrix = sparse.csr_array(sparse.diags_array(diagonal) - graph + pairs)
    side = solve_two_level(matrix, right, np.ones(count, dtype=bool), compact_groups(points), 1e-6)
    side = _without_islands(side, edges, points, triangles)
    crossing = side[edges[:, 0]] * side[edges[:, 1]] <= 0
    reach = STRIP * float(np.nanmedian(across))
    rim = np.unique(edges[crossing])
    near = sparse.csgraph.dijkstra(
        mesh.edge_graph(edges, lengths, count),
        directed=False,
        indices=rim,
        limit=reach,
        min_only=True,
    )
    return Faces(side=side, free=np.isfinite(near), opposite=touching)


def _opposite(
    points: Float, normals: Float, field: NDArray[np.float32], grid: Float
) -> tuple[Float, NDArray[np.intp], NDArray[np.intp]]:
    """Distance across the sheet, mm, and the vertex there; NaN and -1 unless both face so.

    Also that vertex up to ``FAR_REACH``, across two sheets that touch.
    """
    step = 0.1
    depth = np.arange(2 * step, FAR_REACH, step)
    inverse = np.linalg.inv(grid)
    start, way = to_ras(points, inverse), -normals @ inverse[:3, :3].T
    inside = np.empty((len(depth), len(points)), dtype=bool)
    for row, far in enumerate(depth):
        inside[row] = ndimage.map_coordinates(field, (start + far * way).T, order=1) > 0
    out = inside & ~np.vstack([inside[1:], inside[-1:]])  # the next one is outside
    first = out.argmax(axis=0)
    is_hit = out.any(axis=0) & (first < len(depth) - 1)
    across = np.where(is_hit, depth[first] + step / 2, np.nan)
    mate = cKDTree(points).query(points - np.nan_to_num(across)[:, None] * normals)[1]
    reverse = across[mate]
    facing = (normals * normals[mate]).sum(axis=1) < -0.5  # noqa: PLR2004 -- 60 degrees
    mutual = np.abs(reverse - across) < 0.5 * np.fmin(across, reverse)
    mutual &= facing & is_hit
    near = mutual & (np.fmax(across, reverse) < REACH - step)
    return np.where(near, across, np.nan), np.where(near, mate, -1), np.where(mutual, mate, -1)


def _label_evidence(
    points: Float, normals: Float, volume: LabelVolume
) -> list[tuple[float, Float]]:
    """Which side labels next to the surface speak for, and how strongly, (V,) each."""
    inverse = np.linalg.inv(volume.affine)
    evidence = {1.0: np.zeros(len(points)), -1.0: np.zeros(len(points))}
    for distance in PROBES:
        at = to_ras(points + distance * normals, inverse)
        label = ndimage.map_coordinates(volume.tissue, at.T, order=0, mode="constant")
        for tissue, (target, weight) in EVIDENCE.items():
            evidence[target][label == tissue] += weight / len(PROBES)
    return list(evidence.items())


def _without_islands(side: Float, edges: Int, points: Float, triangles: Int) -> Float:
    """Give islands of one face in the other, up to an area, to what is round them."""
    share = mesh.vertex_areas(points, triangles)
    for _ in range(2):
        uncut = (side[edges[:, 0]] > 0) == (side[edges[:, 1]] > 0)
        graph = mesh.edge_graph(edges[uncut], np.ones(int(uncut.sum())), len(side))
        piece = sparse.csgraph.connected_components(graph, directed=False)[1]
        small = np.bincount(piece, share)[piece] < ISLAND
        side = np.where(small, -side, side)
    return side


LINK = 1.0
"""Parts of banks that touch are one place up to this distance, mm."""
RIDGE, SLOPE, AROUND = 1.35, 1.25, 4.0
"""A ridge is thicker than this multiple of the median up to this distance, mm, and its slopes than
the second."""
TWO_WALLS = 1.5
"""A ridge is thicker than this multiple of the median of all columns among which it is looked for.
Without it, walls that vary smoothly have ridges where what lies round them is thin."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TouchingBanks:
    """A place where two banks of a fold touch."""

    points: Float
    """(N, 3) midway between the two banks, RAS mm."""
    area: float
    """Of one bank, mm2."""
    side: str
    """The side on which the cleft is lost: ``interior`` or ``exterior``."""


def find_touching_banks(surface: Surface, faces: Faces) -> list[TouchingBanks]:
    """Find where opposite walls are both interior, or both exterior, largest place first."""
    side = np.where(faces.free, 0, np.sign(faces.side))
    mated = np.flatnonzero((faces.opposite >= 0) & (side != 0))
    mate = faces.opposite[mated]
    touching = side[mated] == side[mate]
    first, second = mated[touching], mate[touching]
    middle = (surface.vertices[first] + surface.vertices[second]) / 2
    pairs = cKDTree(middle).query_pairs(LINK, output_type="ndarray")
    links = sparse.coo_array(
        (np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(first), len(first))
    )
    count, piece = sparse.csgraph.connected_components(links, directed=False)
    area = vertex_areas(surface.vertices, surface.triangles)[first] / 2  # both banks are counted
    banks = [
        TouchingBanks(
            points=middle[piece == number],
            area=float(area[piece == number].sum()),
            # The cleft of the other face is lost: both walls that are left are of one face.
            side="exterior" if side[first[piece == number]].sum() > 0 else "interior",
        )
        for number in range(count)
    ]
    return sorted(banks, key=lambda bank: -bank.area)


def find_ridges(sheet: Sheet, among: Bool) -> list[tuple[Bool, float]]:
    """Find narrow places where the sheet is thick: columns (Nx, Ny), and area without slopes, mm2.

    Only columns ``among`` (Nx, Ny) belong to them; all that have a value are their surroundings.
    """
    thickness, middle = measure_thickness(sheet), sheet.points[:, :, sheet.middle][sheet.valid]
    values = thickness[sheet.valid]
    near = cKDTree(middle).query_ball_point(middle, AROUND)
    ratio = np.zeros(thickness.shape)
    ratio[sheet.valid] = values / [np.median(values[neighbors]) for neighbors in near]
    places, count = ndimage.label(among & (ratio > SLOPE))
    if not count:
        return []
    thick = thickness > TWO_WALLS * np.median(thickness[sheet.valid & among])
    share = np.where(thick & (ratio > RIDGE), column_area(sheet), 0.0)
    areas = ndimage.sum_labels(share, places, np.arange(count) + 1)
    return [(places == number, float(area)) for number, area in enumerate(areas, start=1)]
