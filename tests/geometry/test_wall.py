"""The wall without its caps, curvature of known cylinders, and zero lines."""

from dataclasses import replace

import numpy as np
import pytest
from geometry_cases import cylinder
from lapy import Solver, TriaMesh

from hipsta_bids.geometry.mesh import edge_graph, lateral_triangles
from hipsta_bids.geometry.wall import CURVATURE_SMOOTHING, LAPY_CURVATURE, Wall, _Mesh, end_to_end
from hipsta_bids.settings import BoundarySettings

SETTINGS = BoundarySettings()


@pytest.fixture(scope="module")
def wall(slab):
    return Wall(slab.surface, SETTINGS)


@pytest.fixture(scope="module")
def place(slab, wall):
    """Sheet coordinates (u, v, n) of the wall's vertices; u and n of rims too."""
    body = slab.phantom.body
    o, x, y, z = body.place([0.5, 0.6, 0.5, 0.5], [0.5, 0.5, 0.6, 0.5], [0.0, 0.0, 0.0, 0.1])
    axes = np.stack([x - o, y - o, z - o], axis=1)  # the slab is flat: an affine map
    u, v, n = np.linalg.solve(axes, (wall.vertices - o).T)
    return 0.5 + 0.1 * u, 0.5 + 0.1 * v, 0.1 * n


def test_a_speck_beside_a_cap_is_no_part_of_the_wall(slab, wall):
    """The cap lacks a vertex amid it: the triangles round that one hang together by themselves."""
    cap = slab.surface.anterior_cap.copy()
    rim = np.unique(slab.surface.triangles[lateral_triangles(slab.surface)])
    amid = np.setdiff1d(np.flatnonzero(cap), rim)
    points = slab.surface.vertices[amid]
    cap[amid[np.linalg.norm(points - points.mean(axis=0), axis=1).argmin()]] = False
    surface = replace(slab.surface, anterior_cap=cap)
    assert len(np.unique(surface.triangles[lateral_triangles(surface)])) > len(wall.index)
    specked = Wall(surface, SETTINGS)
    np.testing.assert_array_equal(specked.triangles, wall.triangles)
    assert end_to_end(specked, specked.operator(SETTINGS).eigenfunctions(1)[1][:, 0]) is not None


def lapy_curvature(radius, edge, *, outward=True):
    """Both curvatures, the direction of the second, and the mean edge, away from the ends."""
    points, triangles = cylinder(radius, edge, outward=outward)
    _, direction, least, most = TriaMesh(points, triangles).curvature_tria(
        smoothit=CURVATURE_SMOOTHING
    )
    sides = np.roll(points[triangles], 1, axis=1) - points[triangles]
    middle = points[triangles].mean(axis=1)[:, 2]
    inner = (middle > 3) & (middle < 5)
    mean_edge = np.linalg.norm(sides, axis=2).mean()
    return least[inner].mean(), most[inner].mean(), direction[inner], mean_edge


@pytest.mark.parametrize("radius", [1.0, 2.0, 4.0])
@pytest.mark.parametrize("edge", [0.25, 0.35, 0.5])
def test_lapys_curvature_is_the_setting_times_curvature_times_edge(radius, edge):
    least, most, _, mean_edge = lapy_curvature(radius, edge)
    # Convex is negative on outward triangles. Regular triangles give 1 / (2 sqrt 3) = 0.289.
    assert -least * radius / mean_edge == pytest.approx(LAPY_CURVATURE, rel=0.06)
    assert abs(most) < 0.02 * abs(least)


def test_orientation_decides_the_sign_of_lapys_curvature():
    least, most, *_ = lapy_curvature(2.0, 0.35, outward=False)
    assert most > 0
    assert abs(least) < 0.02 * most


def test_directions_do_not_depend_on_arbitrary_signs():
    """Along a cylinder curvature is largest (0) along its axis, whichever corner comes first."""
    points, triangles = cylinder(2.0, 0.35, outward=True)
    middle = points[triangles].mean(axis=1)[:, 2]
    inner = (middle > 3) & (middle < 5)
    first = _Mesh(points, triangles).curvature_tria(CURVATURE_SMOOTHING)
    again = _Mesh(points, np.roll(triangles, 1, axis=1)).curvature_tria(CURVATURE_SMOOTHING)
    assert (np.abs(first[1][inner, 2]) > 0.99).all()
    np.testing.assert_allclose(np.abs((first[0] * again[0]).sum(axis=1)[inner]), 1.0, atol=1e-9)
    lapy = TriaMesh(points, triangles).curvature_tria(CURVATURE_SMOOTHING)
    for ours, theirs in zip(first[2:], lapy[2:], strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-12)


def test_caps_are_left_out(slab, wall):
    assert len(wall.triangles) == np.count_nonzero(lateral_triangles(slab.surface))
    original = slab.surface.triangles[lateral_triangles(slab.surface)]
    np.testing.assert_array_equal(wall.index[wall.triangles], original)
    np.testing.assert_array_equal(wall.vertices, slab.surface.vertices[wall.index])
    # An open tube: Euler number 0.
    assert len(wall.vertices) - len(wall.edges) + len(wall.triangles) == 0


def test_diffusion_is_slow_across_the_rims_only(wall, place):
    """Energy of a function that steps across a region tells how fast diffusion is there."""
    u, _, n = place
    across_rim = np.clip(n / 0.5, -1, 1)  # from side to side round the rims
    along_side = np.clip((u - 0.5) / 0.05, -1, 1)  # from rim to rim in the middle of the sides
    for matrix in (wall.operator(SETTINGS).stiffness, wall.evenly_aware.stiffness):
        # Over slope squared times area: two bands of 8 mm, 1 and 1.2 mm wide.
        rim = across_rim @ (matrix @ across_rim) / (2 * 8 * 1.0 * 2.0**2)
        side = along_side @ (matrix @ along_side) / (2 * 8 * 1.2 * (1 / 0.6) ** 2)
        assert rim < 0.7
        assert side > 0.85  # hardly slowed: waves of the voxels have little curvature


def test_without_anisotropy_diffusion_is_even(slab):
    wall = Wall(slab.surface, BoundarySettings(anisotropy=0.0))
    plain = Solver(TriaMesh(wall.vertices.copy(), wall.triangles.copy()), lump=True)
    for laplace in (wall.operator(BoundarySettings(anisotropy=0.0)), wall.evenly_aware):
        # Rounding: sums of some terms, thin triangles.
        difference = abs(laplace.stiffness - plain.stiffness).max()
        assert difference < 1e-10 * abs(plain.stiffness).max()


def test_the_published_operator_is_lapys(slab):
    """Both principal curvatures slow diffusion, without a threshold."""
    settings = BoundarySettings(operator="published", anisotropy=40.0)
    wall = Wall(slab.surface, settings)
    mesh = type("TriaMesh", (_Mesh,), {})(wall.vertices, wall.triangles)  # LaPy asks for its name
    lapys = Solver(mesh, lump=True, aniso=(40.0, 40.0), aniso_smooth=CURVATURE_SMOOTHING)
    difference = abs(wall.operator(settings).stiffness - lapys.stiffness).max()
    assert difference < 1e-10 * abs(lapys.stiffness).max()  # rounding
    assert abs(wall.operator(SETTINGS).stiffness - lapys.stiffness).max() > 0.01
    # Curves are moved to the middle of the edges by the operator with a threshold and a floor.
    usual = Wall(slab.surface, BoundarySettings(anisotropy=40.0)).evenly_aware
    assert abs(wall.evenly_aware.stiffness - usual.stiffness).max() == 0


def test_curvature_is_from_the_edges_that_lapy_lists(wall):
    """Ours takes an eighth of the time."""
    quick = _Mesh(wall.vertices, wall.triangles)
    wanted = TriaMesh(wall.vertices, wall.triangles).edges()
    for found, expected in zip(quick.edges(), wanted, strict=True):
        np.testing.assert_array_equal(found, expected)


def test_the_wall_has_the_area_of_the_phantoms(wall):
    assert wall.areas.sum() == pytest.approx(2 * (12.0 + 2.0) * 8.0, rel=0.06)  # rims are rounded


def test_distance_is_finite_where_connected_along_the_wall(slab, wall, place):
    u, _, n = place
    line = slab.phantom.body.place(0.5, np.linspace(0, 1, 41), 1.0)
    distance = wall.distance(line, 2.5)  # reaches through the wall of 2 mm
    near = np.isfinite(distance)
    assert distance[near].max() <= 2.5
    assert near.any()
    assert (n[near] > 0).all()
    assert (np.abs(u[near] - 0.5) < 2.6 / 12).all()


def test_sides_fall_apart_along_the_rims(wall, place):
    u, _, n = place
    sides = wall.sides((u < 0.08) | (u > 0.92))
    assert sides is not None
    first, second = (n[side].mean() for side in sides)
    assert first * second < -0.5
    assert not (sides[0] & sides[1]).any()


def test_one_cut_or_a_leak_gives_no_sides(wall, place):
    u, v, _ = place
    assert wall.sides(u < 0.08) is None
    leaky = ((u < 0.08) | (u > 0.92)) & ~((v > 0.4) & (v < 0.7) & (u > 0.5))
    assert wall.sides(leaky) is None
    assert wall.sides(np.abs(v - 0.5) < 0.1) is None  # pieces that do not reach both ends


def test_rim_of_a_side_is_shared_with_the_strips(wall, place):
    u, _, _ = place
    strips = (u < 0.08, u > 0.92)
    sides = wall.sides(strips[0] | strips[1])
    grown = wall.with_rim(sides[0], strips)
    added = grown & ~sides[0]
    assert added.any()
    assert not (added & ~(strips[0] | strips[1])).any()
    neighbors = edge_graph(wall.edges, np.ones(len(wall.edges)), len(u)) @ sides[0]
    assert (neighbors[added] > 0).all()


def test_zero_lines_from_end_to_end(wall, place):
    u, v, n = place
    curves = end_to_end(wall, n)
    assert curves is not None
    assert len({bool(np.mean(wall_u(curve, wall, u)) < 0.5) for curve in curves}) == 2
    across = end_to_end(wall, u - 0.5)  # once along each side
    assert across is not None
    assert np.abs(np.concatenate([wall_u(c, wall, u) for c in across]) - 0.5).max() < 0.05
    assert end_to_end(wall, v - 0.5) is None  # round the body, not along it
    assert end_to_end(wall, np.ones_like(u)) is None
    assert end_to_end(wall, np.sin(12 * u)) is None  # more than two lines


def wall_u(curve, wall, u):
    """Position u of the wall's vertices nearest to a curve's points."""
    gaps = np.linalg.norm(curve[:, None] - wall.vertices[None], axis=2)
    return u[gaps.argmin(axis=1)]


def test_normals_point_outward(slab, wall, place):
    u, _, n = place
    normals = wall.normals
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    o, z = slab.phantom.body.place([0.5, 0.5], [0.5, 0.5], [0.0, 1.0])
    flat = (u > 0.15) & (u < 0.85)
    # Voxels of 0.4 mm leave waves of a few degrees.
    assert (np.sign(n[flat]) * (normals[flat] @ (z - o)) > 0.9).all()
