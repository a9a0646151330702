"""Medial and lateral boundary of the sheet, and its two sides, on the surface of the body."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from hipsta_bids.artifacts import Bool, Float, Int, Surface, TetMesh
from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.body import Body
from hipsta_bids.geometry.checks import name_place
from hipsta_bids.geometry.laplace import HarmonicSolver, smallest_eigenfunctions
from hipsta_bids.geometry.rims import center_curves, guided_curves, rim_paths
from hipsta_bids.geometry.strips import facing_strips
from hipsta_bids.geometry.surface import (
    mean_wall_thickness,
    signed_volume,
)
from hipsta_bids.geometry.wall import Wall, end_to_end, vertex_normals
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
    """Mean distance between the curves of the two rules, the worse of the two, mm; NaN if only one
    rule gives curves."""
    rim_distance: float
    """Mean distance of the curves from the rim paths, the worse of the two, mm."""
    side_rule: str
    """What told interior from exterior: ``labels``, or, decided on the sheet, ``bending``; where
    cortex is measured, ``continuity`` with the hippocampus takes the place of bending."""
    side_margin: float
    """Difference of the shares of outward probes that hit interior labels; NaN without labels."""
    strip_width: float
    """Mean width of the boundary strips, mm."""
    sheet_thickness: float
    """2 volume / area of the two sides, strips left out on either, mm."""


def find_boundaries(
    surface: Surface,
    mesh: TetMesh,
    body: Body,
    settings: BoundarySettings,
    solver: HarmonicSolver | None = None,
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
    solver : HarmonicSolver, optional
        Of this mesh, if there is one already.

    Returns
    -------
    Boundaries

    Raises
    ------
    GeometryError
        ``boundaries`` if neither rule gives two curves from end to end that separate the sides.
    """
    wall = Wall(surface, body, settings)
    thickness = mean_wall_thickness(surface)
    paths, depths = rim_paths(wall, mesh, body, settings)
    rims = (wall.vertices[paths[0]], wall.vertices[paths[1]])
    guided = guided_curves(wall, paths, depths, thickness, settings)
    curves = _eigenfunction_curves(wall)
    distance = float("nan")
    if curves is not None and guided is not None:
        distance = _curve_distance(curves, guided)
    attempts = [
        (rule, pair and center_curves(wall, pair, thickness, settings))
        for rule, pair in (("eigenfunction", curves), ("rims", guided))
    ]
    if not distance <= settings.max_distance:
        attempts.reverse()
    found = _separating(wall, solver or HarmonicSolver(mesh), attempts, thickness, settings)
    if found is None:
        raise _inseparable(rims, body)
    rule, pair, strips, sides = found
    if _rank(pair[0], body) > _rank(pair[1], body):
        pair, strips = (pair[1], pair[0]), (strips[1], strips[0])
    sides, side_rule, margin = _interior_first(sides, wall, body, settings)
    area = _strip_area(wall, strips[0] | strips[1])
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
    solver: HarmonicSolver,
    attempts: list[tuple[str, tuple[Float, Float] | None]],
    thickness: float,
    settings: BoundarySettings,
) -> tuple[str, tuple[Float, Float], tuple[Bool, Bool], tuple[Bool, Bool]] | None:
    """Take the first pair of curves whose strips separate the wall into two sides, if any."""
    for rule, pair in attempts:
        if pair is None:
            continue
        reach = settings.first_strip * thickness
        plain = (wall.near(pair[0], reach), wall.near(pair[1], reach))
        for strips, middle in (
            facing_strips(wall, solver, pair, thickness, settings),
            (plain, pair),
        ):
            sides = wall.sides(strips[0] | strips[1])
            if sides is not None and not (strips[0] & strips[1]).any():
                return rule, middle, strips, sides
    return None


def _inseparable(rims: tuple[Float, Float], body: Body) -> GeometryError:
    """Say where the rims come closest to each other."""
    gap, nearest = (np.asarray(found) for found in cKDTree(rims[1]).query(rims[0]))
    closest = int(gap.argmin())
    place = name_place(np.stack([rims[0][closest], rims[1][nearest[closest]]]), body)
    return GeometryError(
        "the medial and lateral boundary do not separate the interior from the exterior side: "
        f"check the labels for folds that touch each other, first near {place}, where the "
        f"two rims are only {gap[closest]:.1f} mm apart",
        reason="boundaries",
    )


def _eigenfunction_curves(wall: Wall) -> tuple[Float, Float] | None:
    """Zero lines of the first anisotropic eigenfunction, if exactly two run from end to end."""
    _, functions = smallest_eigenfunctions(wall.bend_aware, wall.mass, 1)
    return end_to_end(wall, functions[:, 0])


def _curve_distance(first: tuple[Float, Float], second: tuple[Float, Float]) -> float:
    """Mean distance of the curves of one pair from those of the other, the worse of the two."""
    gaps = np.array([[_gap(a, b) for b in second] for a in first])
    straight, crossed = np.diag(gaps), np.diag(gaps[:, ::-1])
    return float(min(straight.max(), crossed.max()))


def _gap(points: Float, curve: Float) -> float:
    """Mean distance of points from the nearest ones of a curve, mm."""
    return float(np.mean(cKDTree(curve).query(points)[0]))


def _rank(curve: Float, body: Body) -> float:
    """How lateral the voxels nearest to a curve lie, on average."""
    _, points = body.inside_points()
    _, nearest = cKDTree(points).query(curve)
    return float(body.lateral[nearest].mean())


def _interior_first(
    sides: tuple[Bool, Bool], wall: Wall, body: Body, settings: BoundarySettings
) -> tuple[tuple[Bool, Bool], str, float]:
    """Order the sides by how often probes outward from them hit labels of the interior side."""
    if body.region == "entorhinal":  # no such label touches it
        return sides, "bending", float("nan")
    normals = vertex_normals(wall)
    target = body.interior & (body.tissue == 0)
    hit = np.zeros(len(normals), dtype=bool)
    for reach in settings.probe_distances:
        probe = body.to_voxels(wall.vertices + reach * normals)
        voxel = np.clip(np.rint(probe).astype(int), 0, np.array(target.shape) - 1)
        hit |= target[tuple(voxel.T)]
    share = [float(hit[side].mean()) for side in sides]
    if max(share) < settings.min_probe_share:
        return sides, "bending", float("nan")
    margin = abs(share[0] - share[1])
    return (sides if share[0] > share[1] else (sides[1], sides[0])), "labels", margin


def _strip_area(wall: Wall, strips: Bool) -> float:
    """Area of the triangles within the strips, mm2."""
    return float(wall.areas[strips[wall.triangles].all(axis=1)].sum())
