"""Where the coordinates are fixed: medial and lateral strip, both sides and both ends of the sheet.

Two rules find the curves along the sheet's medial and lateral edge: zero lines of an eigenfunction
on the wall, and lines guided by distances inside the body (named ``rims`` in outputs and settings).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.spatial import cKDTree

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.body import Body
from hipsta_bids.geometry.checks import name_place
from hipsta_bids.geometry.fem import DIRECTION_RESIDUAL, Laplace
from hipsta_bids.geometry.mesh import edge_graph, mean_wall_thickness, signed_volume
from hipsta_bids.geometry.wall import Wall, end_to_end
from hipsta_bids.settings import BoundarySettings
from hipsta_bids.types import Bool, Float, Int, Surface

#: Voxels around a vertex whose labels tell how lateral it is.
LABEL_NEIGHBORS = 30
#: One vertex in this many is looked up.
LABEL_STRIDE = 4
#: Share of the vertices that count as most lateral.
LATERAL_SHARE = 0.1
#: Steps along the axis count this much longer, so that distances run across it.
AXIAL_STRETCH = 4.0
#: Cost of a path per mm along an edge; depth below the edge adds its square, mm2.
EDGE_FLOOR = 0.05
#: Depth of the zones along the edges, multiples of 2 volume / wall area.
EDGE_ZONE = 1.5
#: Half widths of the bands in which curves are moved to the middle of the edges, same unit.
EDGE_BANDS = (1.25, 1.0, 1.0)
#: The zones hold at least all within this distance of the path along the edge, in the same unit.
EDGE_ZONE_REACH = 0.75
#: The boundary strips face away from the sheet: least cosine of the angle between the wall's
#: normal and the direction in which the sheet would go on.
STRIP_FACING = 0.62
#: At first they hold all within this distance of the curves, multiples of 2 volume / wall area.
FIRST_STRIP = 0.55
#: They hold at least all within this distance of their middle lines, in the same unit.
LEAST_STRIP = 0.25
#: The direction of the sheet is found after one, two and three steps of this length from the
#: edge, in the same unit.
STRIP_STEP = 0.5
#: Number of tetrahedra over which that direction is averaged.
STRIP_NEIGHBORS = 40
#: One tetrahedron in this many is looked up.
STRIP_STRIDE = 4
#: Number of points of the edge over which it is averaged then.
EDGE_NEIGHBORS = 15
#: They hold nothing farther than this from the curves, in the same unit; one value per round.
#: Later rounds start from the middle lines of the strips of the round before.
STRIP_REACH = (0.9, 0.75)
#: Distances at which interior labels are looked for, mm outside the wall.
PROBE_DISTANCES = (0.4, 0.8, 1.2)
#: Fewer hits than this share count as no interior labels.
MIN_PROBE_SHARE = 0.02

#: Medial and lateral, or the other way round.
Pair = tuple[Float, Float]
Paths = tuple[NDArray[np.intp], NDArray[np.intp]]

_SLICES = 40  # along the body, in each of which the rim is sought


def rim_paths(wall: Wall, laplace: Laplace, body: Body) -> tuple[Paths, Pair]:
    """Medial and lateral path from end to end where the wall is farthest from the opposite rim.

    Distances run inside the volume and mostly across the long axis, as steps along it are
    stretched. The first ones start from the sheet's most lateral labels.

    Also returns how much nearer to the opposite rim each vertex of the wall lies than the rim of
    its slice, (V,) each, mm.
    """
    points, edges = laplace.points, laplace.edges
    steps = np.diff(points[edges], axis=1)[:, 0]
    along = steps @ body.ends.axis
    stretch = AXIAL_STRETCH**2 - 1
    lengths = np.sqrt(np.einsum("ij,ij->i", steps, steps) + stretch * along**2)
    graph = edge_graph(edges, lengths, len(points))
    start = _most_lateral(points, body)
    paths: list[NDArray[np.intp]] = []
    depths: list[Float] = []
    for _ in range(3):  # medial from labels, lateral from medial, medial again from lateral
        distance = sparse.csgraph.dijkstra(graph, indices=start, min_only=True)[wall.index]
        depth = _below_top(distance, wall.share)
        path = _rim_path(depth, wall)
        start = wall.index[path].astype(np.intp)
        paths.append(path)
        depths.append(depth)
    return (paths[2], paths[1]), (depths[2], depths[1])


def guided_curves(wall: Wall, paths: Paths, depths: Pair, thickness: float) -> Pair | None:
    """Middle lines between the two sides within zones along both paths.

    Without these zones the wall falls into its two sides. The zero line of the harmonic function
    between them, with the same curvature-aware diffusion, runs along the edges of the sheet.
    """
    zones = [
        (_below_rim(depth, path, wall) < EDGE_ZONE * thickness)
        | wall.near(wall.vertices[path], EDGE_ZONE_REACH * thickness)
        for path, depth in zip(paths, depths, strict=True)
    ]
    return middle_lines(wall, zones)


def center_curves(wall: Wall, curves: Pair, thickness: float) -> Pair:
    """Move curves to the middle of the sheet's edges, which may be rounded.

    The middle lines are found again in ever narrower bands of equal width on both sides: a side
    that bends more, or reaches farther into a zone, pulls the line towards itself.
    """
    for width in EDGE_BANDS:
        bands = [wall.near(curve, width * thickness) for curve in curves]
        curves = middle_lines(wall, bands) or curves
    return curves


def middle_lines(wall: Wall, zones: Sequence[Bool]) -> Pair | None:
    """Zero lines of the harmonic function between the two sides, one in each of two zones."""
    sides = wall.sides(zones[0] | zones[1])
    if sides is None:
        return None
    fixed = np.flatnonzero(sides[0] | sides[1])
    values = np.where(sides[1][fixed], 1.0, -1.0)
    lines = end_to_end(wall, wall.evenly_aware.solve(fixed, values))
    if lines is None:
        return None
    first, second = (float(zones[0][wall.nearest(line)].mean()) for line in lines)
    return lines if first >= second else (lines[1], lines[0])


def _most_lateral(points: Float, body: Body) -> NDArray[np.intp]:
    """Vertices whose surroundings carry the most lateral labels."""
    count = min(LABEL_NEIGHBORS, len(body.lateral))
    asked = np.arange(0, len(points), LABEL_STRIDE)
    mean = body.lateral[body.nearest(points[asked], count)].mean(axis=1)
    return np.asarray(asked[mean >= np.quantile(mean, 1 - LATERAL_SHARE)])


def _rim_path(depth: Float, wall: Wall) -> NDArray[np.intp]:
    """Cheapest path from end to end; depth below the rim costs."""
    cost = wall.lengths * (EDGE_FLOOR + (np.maximum(depth, 0)[wall.edges].mean(axis=1)) ** 2)
    start, end = (
        int(np.flatnonzero(where)[np.argmin(depth[where])])
        for where in (wall.posterior, wall.anterior)
    )
    graph = edge_graph(wall.edges, cost, len(depth))
    _, before, _ = sparse.csgraph.dijkstra(
        graph, indices=np.array([start]), return_predecessors=True, min_only=True
    )
    path = [end]
    while path[-1] != start and len(path) <= len(depth):
        path.append(int(before[path[-1]]))
    return np.array(path)


def _below_top(values: Float, share: Float) -> Float:
    """How far values (V,) lie below the largest of their slice."""
    top = np.full(_SLICES, -np.inf)
    np.maximum.at(top, np.minimum((share * _SLICES).astype(int), _SLICES - 1), values)
    centers = (np.arange(_SLICES) + 0.5) / _SLICES
    known = np.isfinite(top)
    top = ndimage.median_filter(np.interp(centers, centers[known], top[known]), 5, mode="nearest")
    return np.asarray(np.interp(share, centers, top) - values)


def _below_rim(depth: Float, path: NDArray[np.intp], wall: Wall) -> Float:
    """Depth (V,) below a rim path at the same share of the body's length, mm."""
    order = np.argsort(wall.share[path], kind="stable")
    return np.asarray(depth - np.interp(wall.share, wall.share[path][order], depth[path][order]))


def facing_strips(
    wall: Wall, laplace: Laplace, curves: Pair, thickness: float, settings: BoundarySettings
) -> tuple[tuple[Bool, Bool], Pair]:
    """Find the parts of the wall near two curves that face along the sheet, away from it.

    A flat rim is such a part from corner to corner; of a round one, it is the middle. The direction
    of the sheet at its rim is that of a harmonic function from rim to rim, continued from inside
    the sheet, where it does not depend on where exactly the curves lie. The middle lines of the
    strips replace the curves, and the same is done again.
    """
    finder = _Finder(wall, laplace, thickness, settings)
    starts = curves
    strips = _near(wall, curves, FIRST_STRIP * thickness)
    for reach in STRIP_REACH:
        lines = _near(wall, curves, LEAST_STRIP * thickness)
        limits = _near(wall, curves, reach * thickness)
        medial, lateral = (wall.index[strip] for strip in strips)
        values = laplace.between(medial, lateral, DIRECTION_RESIDUAL)
        flow = laplace.gradient(values, STRIP_STRIDE)
        strips = (
            finder.strip(starts[0], flow, lines[0], limits[0]),
            finder.strip(starts[1], -flow, lines[1], limits[1]),
        )
        starts = (wall.vertices[strips[0]], wall.vertices[strips[1]])
        curves = middle_lines(wall, strips) or curves
    return strips, curves


def _near(wall: Wall, curves: Pair, reach: float) -> tuple[Bool, Bool]:
    return wall.near(curves[0], reach), wall.near(curves[1], reach)


class _Finder:
    """Finds the vertices that face away from the sheet."""

    def __init__(
        self, wall: Wall, laplace: Laplace, thickness: float, settings: BoundarySettings
    ) -> None:
        self._wall, self._settings = wall, settings
        self._step = STRIP_STEP * thickness
        links = edge_graph(wall.edges, np.ones(len(wall.edges)), len(wall.vertices))
        self._normals = _unit((links + sparse.eye_array(len(wall.vertices))) @ wall.normals)
        asked = laplace.cells[::STRIP_STRIDE]
        self._centers = cKDTree(laplace.points[asked.T].mean(axis=0))

    def strip(self, starts: Float, inward: Float, line: Bool, limit: Bool) -> Bool:
        """Vertices (V,) within a limit that face away from the sheet, with a line among them."""
        away = -self._direction_at_rim(starts, inward)
        close = np.flatnonzero(limit)
        count = min(EDGE_NEIGHBORS, len(starts))
        _, nearest = cKDTree(starts).query(self._wall.vertices[close], k=count)
        towards = _unit(away[nearest].mean(axis=1))
        facing = line.copy()
        cosine = (self._normals[close] * towards).sum(axis=1)
        facing[close] |= cosine > STRIP_FACING
        return self._wall.connected(facing, line)

    def _direction_at_rim(self, starts: Float, inward: Float) -> Float:
        """Direction (N, 3) of the sheet at its rim.

        Three steps are made into the sheet; a line through the directions found there is continued
        to the rim, since the sheet may bend.
        """
        points, direction = starts, self._mean(starts, inward)
        found = []
        for _ in range(3):
            points = points + self._step * direction
            direction = self._mean(points, inward)
            found.append(direction)
        # Least squares through steps 1, 2 and 3, continued to 0.
        return _unit((4 * found[0] + found[1] - 2 * found[2]) / 3)

    def _mean(self, points: Float, flow: Float) -> Float:
        _, nearest = self._centers.query(points, k=STRIP_NEIGHBORS)
        return _unit(flow[nearest].mean(axis=1))


def _unit(vectors: Float) -> Float:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12))


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
    """``eigenfunction`` (of the wall) or ``rims`` (guided by distances inside the body)."""
    distance: float
    """Mean distance between the curves of the two rules, the worse of the two, mm; NaN if only one
    rule gives curves."""
    rim_distance: float
    """Mean distance of the curves from the rim paths, the worse of the two, mm."""
    side_rule: str
    """What tells interior from exterior: ``labels``, or, decided on the sheet, ``bending`` or,
    where cortex is measured, ``continuity`` with the hippocampus."""
    side_margin: float
    """Difference of the shares of outward probes that hit interior labels; NaN without labels."""
    strip_width: float
    """Mean width of the boundary strips, mm."""
    sheet_thickness: float
    """2 volume / area of the two sides, strips left out on either, mm."""


def find_boundaries(
    surface: Surface, laplace: Laplace, body: Body, settings: BoundarySettings
) -> Boundaries:
    """Find the boundary strips, sides and caps of the sheet; the operator is that of its volume.

    The zero lines of the first curvature-aware anisotropic Laplace-Beltrami eigenfunction of the
    wall are the medial and lateral boundary (Diers et al. 2023, section 2.1.3). An independent
    answer comes from distances inside the volume, which are largest along the sheet's edges.
    """
    wall = Wall(surface, body, settings)
    thickness = mean_wall_thickness(surface)
    paths, depths = rim_paths(wall, laplace, body)
    rims = (wall.vertices[paths[0]], wall.vertices[paths[1]])
    guided = guided_curves(wall, paths, depths, thickness)
    curves = end_to_end(wall, wall.bend_aware.eigenfunctions(1)[1][:, 0])
    distance = float("nan")
    if curves is not None and guided is not None:
        distance = _curve_distance(curves, guided)
    attempts = [("eigenfunction", curves), ("rims", guided)]
    if not distance <= settings.max_distance:
        attempts.reverse()
    found = _separating(wall, laplace, attempts, thickness, settings)
    if found is None:
        raise _inseparable(rims, body)
    rule, pair, strips, sides = found
    if _rank(pair[0], body) > _rank(pair[1], body):
        pair, strips = (pair[1], pair[0]), (strips[1], strips[0])
    sides, side_rule, margin = _interior_first(sides, wall, body)
    area = float(wall.areas[(strips[0] | strips[1])[wall.triangles].all(axis=1)].sum())
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
        strip_width=area / (2 * body.ends.length(wall.vertices)),
        # The strips are end faces of the sheet.
        sheet_thickness=2
        * signed_volume(surface.vertices, surface.triangles)
        / (float(wall.areas.sum()) - area),
    )


def _separating(
    wall: Wall,
    laplace: Laplace,
    attempts: list[tuple[str, Pair | None]],
    thickness: float,
    settings: BoundarySettings,
) -> tuple[str, Pair, tuple[Bool, Bool], tuple[Bool, Bool]] | None:
    """Take the first pair of curves whose strips separate the wall into two sides, if any."""
    for rule, found in attempts:
        if found is None:
            continue
        pair = center_curves(wall, found, thickness)
        plain = _near(wall, pair, FIRST_STRIP * thickness)
        for strips, middle in (
            facing_strips(wall, laplace, pair, thickness, settings),
            (plain, pair),
        ):
            sides = wall.sides(strips[0] | strips[1])
            if sides is not None and not (strips[0] & strips[1]).any():
                return rule, middle, strips, sides
    return None


def _inseparable(rims: Pair, body: Body) -> GeometryError:
    """Say where the two paths come closest to each other."""
    gap, nearest = (np.asarray(found) for found in cKDTree(rims[1]).query(rims[0]))
    closest = int(gap.argmin())
    position = name_place(np.stack([rims[0][closest], rims[1][nearest[closest]]]), body)
    return GeometryError(
        "the medial and lateral boundary do not separate the interior from the exterior side: "
        f"check the labels for folds that touch each other, first near {position}, where the "
        f"sheet's medial and lateral edge are only {gap[closest]:.1f} mm apart",
        reason="boundaries",
    )


def _curve_distance(first: Pair, second: Pair) -> float:
    """Mean distance of the curves of one pair from those of the other, mm, the worse of the two."""
    gaps = np.array([[np.mean(cKDTree(b).query(a)[0]) for b in second] for a in first])
    straight, crossed = np.diag(gaps), np.diag(gaps[:, ::-1])
    return float(min(straight.max(), crossed.max()))


def _rank(curve: Float, body: Body) -> float:
    """How lateral the voxels nearest to a curve lie, on average."""
    return float(body.lateral[body.nearest(curve)].mean())


def _interior_first(
    sides: tuple[Bool, Bool], wall: Wall, body: Body
) -> tuple[tuple[Bool, Bool], str, float]:
    """Order the sides by how often probes outward from them hit labels of the interior side."""
    if body.region == "entorhinal":  # no such label touches it
        return sides, "bending", float("nan")
    target = body.interior & (body.tissue == 0)
    hit = np.zeros(len(wall.vertices), dtype=bool)
    for reach in PROBE_DISTANCES:
        probe = body.to_voxels(wall.vertices + reach * wall.normals)
        voxel = np.clip(np.rint(probe).astype(int), 0, np.array(target.shape) - 1)
        hit |= target[tuple(voxel.T)]
    share = [float(hit[side].mean()) for side in sides]
    if max(share) < MIN_PROBE_SHARE:
        return sides, "bending", float("nan")
    margin = abs(share[0] - share[1])
    return (sides if share[0] > share[1] else (sides[1], sides[0])), "labels", margin
