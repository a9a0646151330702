"""Where the coordinates are fixed: medial and lateral strip, both sides and both ends of the sheet.

Zero lines of an eigenfunction of the wall run along the medial and lateral edge. Around them,
parts of the wall belong to the edges by weights that fall smoothly from 1 to 0, so that a small
change of the labels moves the boundary by little.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.body import Body
from hipsta_bids.geometry.checks import name_place
from hipsta_bids.geometry.fem import DIRECTION_RESIDUAL, Laplace
from hipsta_bids.geometry.mesh import mean_wall_thickness, signed_volume, tetra_volumes
from hipsta_bids.geometry.wall import Wall, end_to_end
from hipsta_bids.settings import BoundarySettings
from hipsta_bids.types import Bool, Float, Int, Surface

#: Half widths of the bands in which curves are moved to the middle of the edges, in units of the
#: sheet's thickness, 2 volume / wall area, as are all lengths here.
EDGE_BANDS = (1.25, 1.0, 1.0)
#: Width over which bands fade out.
BAND_FADE = 0.5
#: How firmly the sides hold their values, per squared thickness.
FIRMNESS = 30.0
#: The boundary strips face away from the sheet: cosine of the angle between the wall's normal and
#: the direction in which the sheet would go on, where half of a vertex belongs to the strip, and
#: the width over which that changes.
STRIP_FACING, FACING_FADE = 0.62, 0.4
#: At first they hold all within this distance of the curves.
FIRST_STRIP = 0.55
#: They hold at least all within this distance of their middle lines; width of that change.
LEAST_STRIP, LEAST_FADE = 0.25, 0.2
#: They hold nothing farther than this from the curves, one value per round; width of that change.
#: Later rounds start from the middle lines of the strips of the round before.
STRIP_REACH, REACH_FADE = (0.9, 0.75), 0.3
#: The direction of the sheet is measured at one, two and three steps of this length from the edge.
STRIP_STEP = 0.5
#: It is averaged over the volume with a Gaussian of this SD, mm, ...
FLOW_SD = 0.4
#: ... and over up to so many vertices of the strip with one of this SD, in units of thickness.
EDGE_NEIGHBORS, EDGE_SD = 60, 0.4
#: From this weight on a vertex belongs to a strip.
STRIP_WEIGHT = 0.5
#: Below it, the sides hold the middle lines; width of that change.
HOLD_FADE = 0.15
#: The operator of the settings, and others, whose zero lines show how certain the curves are:
#: factors of sharp_bend and of anisotropy.
TILTS = ((1.0, 1.0), (0.8, 1.0), (1.0, 0.625))
#: Curves this near to each other on average lead to the same map, mm.
SAME_CURVES = 0.05
#: Curves this near to each other on their way to the middle of the edges end in the same place, mm:
#: each band divides their distance by about ten.
MET_CURVES = 0.01
#: Distances at which interior labels are looked for, mm outside the wall.
PROBE_DISTANCES = (0.4, 0.8, 1.2)
#: Fewer hits than this share count as no interior labels.
MIN_PROBE_SHARE = 0.02

#: Medial and lateral, or the other way round.
Pair = tuple[Float, Float]
#: Such curves, and the function (V,) whose zero lines they are.
Centered = tuple[Pair, Float]
#: Unit vectors (N, 3) at points (N, 3).
Flow = Callable[[Float], Float]


def ramp(values: Float) -> Float:
    """Rise smoothly from 0 to 1 as values do."""
    share = np.clip(values, 0.0, 1.0)
    return np.asarray(share * share * (3 - 2 * share))


def center_curves(
    wall: Wall,
    values: Float,
    thickness: float,
    reference: Sequence[Centered] = (),
    bands: Sequence[float] = EDGE_BANDS,
) -> Sequence[Centered] | None:
    """Move zero lines of a function (V,) to the middle of the sheet's edges, which may be rounded.

    The function is made again, free in ever narrower bands of equal width on both sides of its
    lines and held at its signs elsewhere: a side that bends more, or reaches farther into a band,
    would pull the line towards itself. Bands fade out, so that a vertex that enters one moves
    nothing by much. Returns the lines and the function before the first band and after each. Lines
    that meet the lines of a ``reference`` on their way become these.
    """
    curves, steps = end_to_end(wall, values), list[Centered]()
    for width in bands:
        if curves is None:
            return None
        if reference and _curve_distance(curves, reference[len(steps)][0]) < MET_CURVES:
            return reference
        steps.append((curves, values))
        reach = (width + BAND_FADE) * thickness
        distance = np.minimum(*(wall.distance(curve, reach) for curve in curves)) / thickness
        hold = ramp((distance - width) / BAND_FADE + 0.5)
        values = _screened(wall, hold, values, thickness)
        curves = end_to_end(wall, values)
    return None if curves is None else [*steps, (curves, values)]


def _screened(wall: Wall, hold: Float, values: Float, thickness: float) -> Float:
    """Harmonic function (V,) that has the signs of values where ``hold`` (V,) is 1, drawn to them.

    The less is held, the freer it is; where 0, it is free.
    """
    with np.errstate(divide="ignore"):
        weight = FIRMNESS / thickness**2 * wall.vertex_areas * hold / (1 - hold)
    return wall.evenly_aware.screened(weight, np.sign(values))


def facing_strips(
    wall: Wall, laplace: Laplace, curves: Pair, values: Float, thickness: float
) -> tuple[Pair, Pair] | None:
    """Weight (V,) the parts of the wall near two curves that face along the sheet, away from it.

    A flat edge is one part from corner to corner; of a round one, it is the middle. The direction
    of the sheet at its edge is the gradient of a harmonic function from edge to edge, continued
    from inside the sheet, where it does not depend on where exactly the curves lie. The middle
    lines of the strips replace the curves, and the same is done again.

    Returns both weights and the middle lines; None where these do not run from end to end.
    """
    normals, areas = wall.smooth_normals, wall.vertex_areas
    weights = [1.0 * np.isfinite(wall.distance(line, FIRST_STRIP * thickness)) for line in curves]
    mean = LocalMean(laplace)
    for reach in STRIP_REACH:
        medial, lateral = (wall.index[weight > STRIP_WEIGHT] for weight in weights)
        flow = mean.direction(laplace.between(medial, lateral, DIRECTION_RESIDUAL))
        for k, inward in enumerate((1.0, -1.0)):
            distance = wall.distance(curves[k], (reach + REACH_FADE) * thickness) / thickness
            strip = np.flatnonzero(weights[k])
            starts = wall.vertices[strip]
            outward = -inward * _direction_at_edge(flow, starts, inward * thickness)
            # Nearer and farther ones have a weight of 1 and 0, wherever they face.
            close = np.flatnonzero(
                (distance > LEAST_STRIP - 0.5 * LEAST_FADE) & (distance < reach + 0.5 * REACH_FADE)
            )
            share = (weights[k] * areas)[strip]
            towards = _local_mean(wall.vertices[close], starts, outward, share, EDGE_SD * thickness)
            cosine = (normals[close] * _unit(towards)).sum(axis=1)
            facing = ramp((cosine - STRIP_FACING) / FACING_FADE + 0.5)
            facing *= ramp((reach - distance[close]) / REACH_FADE + 0.5)
            weight = ramp((LEAST_STRIP - distance) / LEAST_FADE + 0.5)
            weight[close] = np.maximum(weight[close], facing)
            weights[k] = np.where(wall.connected(weight > 0, distance <= LEAST_STRIP), weight, 0.0)
        strength = np.maximum(*weights)
        sides = wall.sides(strength > STRIP_WEIGHT)
        if sides is None:
            return None
        # By the sign of the function, an edge would keep what stands on it on either side.
        values = 1.0 * sides[0] - 1.0 * sides[1]
        hold = np.abs(values) * ramp((STRIP_WEIGHT - strength) / HOLD_FADE)
        values = _screened(wall, hold, values, thickness)
        lines = end_to_end(wall, values)
        if lines is None:
            return None
        curves = _in_order(lines, curves)
    return (weights[0], weights[1]), curves


def _in_order(lines: Pair, curves: Pair) -> Pair:
    """Put lines in the order of the curves that they replace."""
    first, second = (np.mean(cKDTree(curve).query(lines[0])[0]) for curve in curves)
    return lines if first <= second else (lines[1], lines[0])


def _direction_at_edge(flow: Flow, starts: Float, inward: float) -> Float:
    """Compute the unit direction (N, 3) of the flow at the sheet's edge.

    Three steps are made into the sheet; a line through the directions there is continued
    to the edge, since the sheet may bend. The length of ``inward`` is the sheet's thickness, mm;
    it is negative where the flow leads out of the sheet.
    """
    points, direction = starts, flow(starts)
    steps = []
    for _ in range(3):
        points = points + STRIP_STEP * inward * direction
        direction = flow(points)
        steps.append(direction)
    # Least squares through steps 1, 2 and 3, continued to 0.
    return _unit((4 * steps[0] + steps[1] - 2 * steps[2]) / 3)


def _local_mean(at: Float, points: Float, vectors: Float, weight: Float, sd: float) -> Float:
    """Average weighted vectors (N, 3) around places (M, 3), with a Gaussian: (M, 3)."""
    count = min(EDGE_NEIGHBORS, len(points))
    distance, near = (np.asarray(part) for part in cKDTree(points).query(at, k=count))
    distance, near = distance.reshape(len(at), -1), near.reshape(len(at), -1)
    # Relative to the nearest: far from all of them, none would count.
    share = weight.take(near) * np.exp(-0.5 * (distance**2 - distance[:, :1] ** 2) / sd**2)
    return np.asarray(np.einsum("mk,mkd->md", share, vectors.take(near, axis=0)))


class LocalMean:
    """Mean of directions in the tetrahedra of a volume, over a neighborhood.

    It is taken on a grid, so that the tetrahedra's number and place matter little.
    """

    _STEP = 0.7
    """Of the grid, times the SD."""

    def __init__(self, laplace: Laplace) -> None:
        """Find the node of the grid nearest to each tetrahedron."""
        self._laplace = laplace
        points, step = laplace.points, self._STEP * FLOW_SD
        self._volume = np.abs(tetra_volumes(points, laplace.cells))
        # Around the middle, so that mirror images get mirrored grids.
        low, high = points.min(axis=0), points.max(axis=0)
        half = np.ceil((high - low) / 2 / step).astype(int) + 6
        self._low, self._shape = 0.5 * (high + low) - half * step, 2 * half + 1
        centers = points.take(laplace.cells.T, axis=0).mean(axis=0)
        node = np.rint((centers - self._low) / step).astype(np.intp)
        self._node = np.ravel_multi_index(tuple(node.T), tuple(self._shape))

    def direction(self, values: Float) -> Flow:
        """Return a function that gives the mean unit gradient (N, 3) of values at points (N, 3)."""
        step = self._STEP * FLOW_SD
        grids = [
            ndimage.gaussian_filter(
                np.bincount(self._node, self._volume * part, np.prod(self._shape)).reshape(
                    self._shape
                ),
                1 / self._STEP,
                truncate=3.0,
            )
            for part in self._laplace.gradient(values).T
        ]

        def flow(points: Float) -> Float:
            place = ((points - self._low) / step).T
            rows = [
                ndimage.map_coordinates(grid, place, order=1, output=np.float64) for grid in grids
            ]
            return _unit(np.stack(rows, axis=1))

        return flow


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
    side_rule: str
    """How interior and exterior were decided: ``labels``, or, on the sheet, ``bending`` or,
    where cortex is measured, ``continuity`` with the hippocampus."""
    side_margin: float
    """Difference of the shares of outward probes that hit interior labels; NaN without labels."""
    strip_width: float
    """Mean width of the boundary strips, mm."""
    sheet_thickness: float
    """2 volume / area of the two sides, strips left out on either, mm."""
    tilt: int = 0
    """Number of the first operator in ``TILTS`` that has curves; 0 is that of the settings."""
    doubt: float = 0.0
    """Largest mean distance of the curves from those of the other operators, mm."""
    rival: "Boundaries | None" = None
    """The boundary of the operator whose curves lie farthest away; None where all are the same."""


def find_boundaries(
    surface: Surface, laplace: Laplace, body: Body, settings: BoundarySettings
) -> Boundaries:
    """Find the boundary strips, sides and caps of the sheet; the operator is its volume's.

    The zero lines of the first curvature-aware anisotropic Laplace-Beltrami eigenfunction of the
    wall are the medial and lateral boundary (Diers et al. 2023, section 2.1.3), moved to the middle
    of the edges. Other operators lead to the same lines where these are certain, whatever the
    start. Where they do not, their boundary is the result's ``rival``.
    """
    wall = Wall(surface, settings)
    thickness = mean_wall_thickness(surface)
    tilt, lines, first = 0, list[Sequence[Centered]](), None
    bands = EDGE_BANDS if settings.edges == "faces" else ()
    for bend, anisotropy in TILTS:
        operator = wall.operator(
            settings.changed(
                sharp_bend=bend * settings.sharp_bend, anisotropy=anisotropy * settings.anisotropy
            )
        )
        if first is None:
            first, values = operator, operator.eigenfunctions(1)[1][:, 0]
        else:  # A rough function leads to the same curves where these are certain.
            values = operator.first_near(values, first)
        centered = center_curves(wall, values, thickness, lines[0] if lines else (), bands)
        if centered is not None:
            lines.append(centered)
        tilt += not lines
    if not lines:
        raise GeometryError(
            "no line runs along the medial and lateral edge from end to end; check the "
            "labels for touching folds",
            reason="boundaries",
        )
    distances = [_curve_distance(steps[-1][0], lines[0][-1][0]) for steps in lines]
    farthest = int(np.argmax(distances))
    along = partial(_along_curves, surface, wall, laplace, body, settings, thickness=thickness)
    boundaries, rival = along(centered=lines[0][-1]), None
    if distances[farthest] > SAME_CURVES:
        with suppress(GeometryError):
            rival = along(centered=lines[farthest][-1])
    return replace(boundaries, tilt=tilt, doubt=distances[farthest], rival=rival)


def _along_curves(
    surface: Surface,
    wall: Wall,
    laplace: Laplace,
    body: Body,
    settings: BoundarySettings,
    *,
    centered: Centered,
    thickness: float,
) -> Boundaries:
    """Find strips and sides along two curves, given with the function whose zero lines they are."""
    if settings.edges == "zero-lines":
        strips, sides, pair = _narrow_strips(wall, centered[0])
    else:
        strips, sides, pair = _strips_and_sides(wall, laplace, *centered, thickness)
    if sides is None:
        raise _inseparable(centered[0], body)
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
        side_rule=side_rule,
        side_margin=margin,
        strip_width=area / (2 * body.ends.length(wall.vertices)),
        # The strips are end faces of the sheet.
        sheet_thickness=2
        * signed_volume(surface.vertices, surface.triangles)
        / (float(wall.areas.sum()) - area),
    )


def _narrow_strips(
    wall: Wall, curves: Pair
) -> tuple[tuple[Bool, Bool], tuple[Bool, Bool] | None, Pair]:
    """Find the vertices along two curves, one on each edge that a curve crosses, and the sides."""
    reach = 0.51 * float(wall.lengths.max())
    first, second = (np.isfinite(wall.distance(curve, reach)) for curve in curves)
    return (first, second), wall.sides(first | second), curves


def _strips_and_sides(
    wall: Wall, laplace: Laplace, curves: Pair, values: Float, thickness: float
) -> tuple[tuple[Bool, Bool], tuple[Bool, Bool] | None, Pair]:
    """Find strips along two curves and the sides that they separate, if they do.

    Where strips that face along the sheet do not, those within ``FIRST_STRIP`` of the curves may.
    """
    facing = facing_strips(wall, laplace, curves, values, thickness)
    if facing is not None:
        weights, lines = facing
        medial, lateral = (weight > STRIP_WEIGHT for weight in weights)
        sides = _sides_between(wall, medial, lateral)
        if sides is not None:
            return (medial, lateral), sides, lines
    reach = FIRST_STRIP * thickness
    medial, lateral = (np.isfinite(wall.distance(curve, reach)) for curve in curves)
    return (medial, lateral), _sides_between(wall, medial, lateral), curves


def _sides_between(wall: Wall, medial: Bool, lateral: Bool) -> tuple[Bool, Bool] | None:
    """Find the sides between two strips that do not touch, if there are two."""
    return None if (medial & lateral).any() else wall.sides(medial | lateral)


def _inseparable(curves: Pair, body: Body) -> GeometryError:
    """Say where the two paths come closest to each other."""
    gap, nearest = (np.asarray(values) for values in cKDTree(curves[1]).query(curves[0]))
    closest = int(gap.argmin())
    position = name_place(np.stack([curves[0][closest], curves[1][nearest[closest]]]), body)
    return GeometryError(
        "the medial and lateral boundary do not separate interior and exterior; check for "
        f"touching folds near {position} (gap {gap[closest]:.1f} mm)",
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
