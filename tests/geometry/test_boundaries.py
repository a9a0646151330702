"""Medial and lateral strips, interior and exterior side, where they are known to be."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from geometry_cases import resampled, short_phantom, solid_of
from scipy.spatial import cKDTree

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry import boundaries
from hipsta_bids.geometry.body import extract_body
from hipsta_bids.geometry.boundaries import center_curves, facing_strips, find_boundaries
from hipsta_bids.geometry.fem import volume_laplace
from hipsta_bids.geometry.measures import bending_angle
from hipsta_bids.geometry.mesh import extract_surface, lateral_triangles, tetrahedralize
from hipsta_bids.geometry.sheet import sample_sheet, solve_coordinates
from hipsta_bids.geometry.wall import Wall
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.settings import BoundarySettings, MeasureSettings, Settings, SheetSettings
from hipsta_bids.types import Coordinates

SETTINGS = BoundarySettings()


def hemi_of(case):
    return "R" if case.volume.affine[0, 3] > 0 else "L"


def rim(case, u):
    """Points of a flat rim, all across the wall and from end to end."""
    v, n = np.linspace(-0.05, 1.05, 81)[:, None], np.linspace(-1, 1, 21)[None]
    return case.phantom.body.place(u, v, n, hemi=hemi_of(case)).reshape(-1, 3)


def test_curves_run_along_the_rims(case):
    """Medial is at u = 0 and lateral at u = 1, in the left and in the right hemisphere."""
    for u, curve in ((0, case.boundaries.medial_curve), (1, case.boundaries.lateral_curve)):
        gap, _ = cKDTree(rim(case, u)).query(curve)
        assert gap.mean() < 0.5  # rims are rounded off by about a voxel of 0.4 mm
        assert gap.max() < 1.0


def test_curves_run_in_the_middle_of_the_rims(case):
    middles = np.linspace(0, 1, 41)
    for u, curve in ((0, case.boundaries.medial_curve), (1, case.boundaries.lateral_curve)):
        line = case.phantom.body.place(u, middles, 0.0, hemi=hemi_of(case))
        gap, _ = cKDTree(line).query(curve)
        assert gap.mean() < 0.95  # the flat rim reaches 1 mm to both sides, to its corners


def test_other_operators_lead_to_the_same_curves(case):
    assert case.boundaries.tilt == 0
    assert case.boundaries.doubt < boundaries.SAME_CURVES
    assert case.boundaries.rival is None


def test_curves_of_an_operator_that_lie_elsewhere_make_a_rival(arc, monkeypatch):
    """Without bands, curves stay where the operator puts them: on the sides, if it is isotropic."""
    monkeypatch.setattr(boundaries, "EDGE_BANDS", ())
    monkeypatch.setattr(boundaries, "TILTS", ((1.0, 1.0), (1.0, 0.0)))
    found = find_boundaries(arc.surface, arc.laplace, arc.body, SETTINGS)
    assert found.doubt > boundaries.SAME_CURVES
    gaps = [cKDTree(rim(arc, 1)).query(b.lateral_curve)[0].mean() for b in (found, found.rival)]
    assert gaps[0] < gaps[1]


def test_strips_hold_the_rims(case):
    for u, strip in ((0, case.boundaries.medial), (1, case.boundaries.lateral)):
        gap, _ = cKDTree(rim(case, u)).query(case.surface.vertices[strip])
        assert gap.max() < 0.6  # mm; edges of the mesh, 0.35 mm long, and rounded corners
    # Triangles that lie in the strips as a whole: half an edge is missing on either side.
    assert case.boundaries.strip_width == pytest.approx(2.0 - 0.35, rel=0.1)


def test_strips_reach_from_edge_to_edge(case):
    for u, strip in ((0, case.boundaries.medial), (1, case.boundaries.lateral)):
        places = case.surface.vertices[strip]
        reached = []
        for n in (-0.5, 0.5):  # mm from the middle of a rim that reaches 1 mm to both sides
            line = case.phantom.body.place(u, np.linspace(0.1, 0.9, 41), n, hemi=hemi_of(case))
            gap, _ = cKDTree(places).query(line)
            reached.append(gap.mean())
        # Vertices of a mesh of 0.35 mm lie within 0.2 mm of any point; smoothing takes 0.1 mm.
        assert max(reached) < 0.3


def test_sides_lie_on_their_sides(case):
    for sign, side in ((-1, case.boundaries.interior), (1, case.boundaries.exterior)):
        points = case.surface.vertices[side]
        u, _, n = case.phantom.body.locate(points, hemi=hemi_of(case)).T
        inner = (u > 0.1) & (u < 0.9)
        assert inner.sum() > 200
        assert (sign * n[inner] > 0.5).all()  # wall at 1 mm, surface within half a voxel


def test_sets_are_apart_and_cover_the_wall(case):
    b = case.boundaries
    assert not np.intersect1d(b.medial, b.lateral).size
    assert not np.intersect1d(b.interior, b.exterior).size
    np.testing.assert_array_equal(b.posterior, np.flatnonzero(case.surface.posterior_cap))
    np.testing.assert_array_equal(b.anterior, np.flatnonzero(case.surface.anterior_cap))
    wall = np.unique(case.surface.triangles[lateral_triangles(case.surface)])
    covered = np.unique(np.concatenate([b.medial, b.lateral, b.interior, b.exterior]))
    assert np.isin(covered, wall).all()
    assert len(covered) > 0.99 * len(wall)  # fragments beside the strips belong to no side


def test_sides_share_edges_with_the_strips(case):
    b = case.boundaries
    for side in (b.interior, b.exterior):
        for strip in (b.medial, b.lateral):
            shared = np.intersect1d(side, strip)
            # At least one vertex per 0.5 mm of the 8 mm long body.
            assert len(shared) > 16


def test_expected_thickness_is_the_phantoms(case):
    assert case.boundaries.sheet_thickness == pytest.approx(2.0, rel=0.05)


def test_interior_is_told_by_labels(case):
    assert case.boundaries.side_rule == "labels"
    assert case.boundaries.side_margin > 0.2  # dentate gyrus lines 55 % of one side only


def without_labels(case):
    body = replace(case.body, interior=np.zeros_like(case.body.interior))
    return find_boundaries(case.surface, case.laplace, body, SETTINGS)


def test_without_interior_labels_bending_has_to_decide(case):
    found = without_labels(case)
    assert found.side_rule == "bending"
    assert np.isnan(found.side_margin)
    sides = {tuple(found.interior), tuple(found.exterior)}
    assert sides == {tuple(case.boundaries.interior), tuple(case.boundaries.exterior)}


@pytest.mark.parametrize("name", ["arc", "spiral"])
def test_bending_and_labels_name_the_same_side(name, request):
    case = request.getfixturevalue(name)
    values = case.coordinates.values
    turned = sample_sheet(case.mesh, Coordinates(values=values * [1.0, 1.0, -1.0]), SheetSettings())
    # Curls round the interior by 2.4 and 4.6 rad; turned round it must say the opposite.
    assert bending_angle(case.sheet, MeasureSettings()) > 0.5
    assert bending_angle(turned, MeasureSettings()) < -0.5


def test_labels_on_the_other_side_change_sides(arc):
    outside = arc.body.tissue == 0
    index = np.argwhere(outside)
    affine = arc.body.affine
    points = index @ affine[:3, :3].T + affine[:3, 3]
    _, _, n = arc.phantom.body.locate(points, hemi="L", reach=3.0).T
    interior = np.zeros_like(outside)
    interior[tuple(index[n > 1.0].T)] = True
    found = find_boundaries(
        arc.surface, arc.laplace, replace(arc.body, interior=interior), SETTINGS
    )
    np.testing.assert_array_equal(found.interior, arc.boundaries.exterior)
    np.testing.assert_array_equal(found.exterior, arc.boundaries.interior)


@pytest.mark.slow
def test_the_mirror_image_has_the_same_boundaries():
    volume = short_phantom().label_volume(load_protocol("freesurfer"))
    image = replace(volume, affine=np.diag([-1.0, 1, 1, 1]) @ volume.affine)
    left, right = solve_volume(volume, "L"), solve_volume(image, "R")
    for name in ("medial_curve", "lateral_curve"):
        mirrored = getattr(right, name) * [-1.0, 1.0, 1.0]
        # mm; the eigenfunction is solved to 1e-6, and a point of its zero line is known the less
        # well the flatter it is there. The strips, which decide about the map, are the same.
        np.testing.assert_allclose(mirrored, getattr(left, name), atol=1e-5)
    for name in ("medial", "lateral", "interior", "exterior"):
        np.testing.assert_array_equal(getattr(right, name), getattr(left, name))


def solve_volume(volume, hemi):
    settings = Settings()
    body = extract_body(volume, settings.body)
    solid = solid_of(resampled(body, settings, hemi), settings.topology)
    surface = extract_surface(solid.field, settings.surface)
    mesh = tetrahedralize(surface, settings.tetra, solid.field.grid.frame)
    return find_boundaries(surface, volume_laplace(mesh), body, settings.boundaries)


def test_curves_are_centered_from_any_start(arc):
    """A line near one corner of a flat edge ends where the one in its middle does."""
    wall = Wall(arc.surface, SETTINGS)
    _, _, n = arc.phantom.body.locate(wall.vertices, hemi="L", reach=3.0).T
    n = np.nan_to_num(n)
    ends = [center_curves(wall, n + shift, 2.0)[-1][0] for shift in (-0.5, 0.0, 0.5)]
    for pair in (ends[0], ends[2]):
        for line, middle in zip(pair, ends[1], strict=True):
            assert cKDTree(middle).query(line)[0].mean() < 0.01


def test_weights_of_strips_fall_smoothly(arc):
    wall = Wall(arc.surface, SETTINGS)
    values = wall.operator(SETTINGS).eigenfunctions(1)[1][:, 0]
    curves, smooth = center_curves(wall, values, 2.0)[-1]
    weights, lines = facing_strips(wall, arc.laplace, curves, smooth, 2.0)
    for weight, line in zip(weights, lines, strict=True):
        assert weight.min() == 0.0
        assert weight.max() == 1.0
        assert np.count_nonzero((weight > 0.05) & (weight < 0.95)) > 40
        gap = cKDTree(line).query(wall.vertices)[0]
        assert weight[gap < 0.15 * 2.0].min() == 1.0
        assert weight[gap > 1.0 * 2.0].max() == 0.0


def test_a_wall_without_lines_from_end_to_end_is_refused(arc, monkeypatch):
    monkeypatch.setattr(boundaries, "end_to_end", lambda *_: None)
    with pytest.raises(GeometryError, match="no line runs along the medial") as caught:
        find_boundaries(arc.surface, arc.laplace, arc.body, SETTINGS)
    assert caught.value.reason == "boundaries"


def test_another_operator_is_asked_where_the_first_has_no_lines(arc, monkeypatch):
    lines, calls = boundaries.end_to_end, []

    def once(*arguments):
        calls.append(1)
        return None if len(calls) == 1 else lines(*arguments)

    monkeypatch.setattr(boundaries, "end_to_end", once)
    found = find_boundaries(arc.surface, arc.laplace, arc.body, SETTINGS)
    gap, _ = cKDTree(arc.boundaries.lateral_curve).query(found.lateral_curve)
    assert gap.mean() < 0.05


def test_strips_that_swallow_the_sides_are_refused(arc, monkeypatch):
    monkeypatch.setattr(boundaries, "FIRST_STRIP", 6.0)
    monkeypatch.setattr(boundaries, "LEAST_STRIP", 6.0)
    monkeypatch.setattr(boundaries, "STRIP_REACH", (6.0, 6.0))
    with pytest.raises(
        GeometryError, match=r"do not separate interior and exterior.*RAS"
    ) as caught:
        find_boundaries(arc.surface, arc.laplace, arc.body, SETTINGS)
    assert caught.value.reason == "boundaries"


def test_coordinates_are_fixed_on_the_boundaries(case):
    values = case.coordinates.values
    b = case.boundaries
    pairs = ((b.medial, b.lateral), (b.posterior, b.anterior), (b.interior, b.exterior))
    for axis, (low, high) in enumerate(pairs):
        assert (values[low, axis] == -1.0).all()
        assert (values[high, axis] == 1.0).all()
    again = solve_coordinates(volume_laplace(case.mesh), b)
    np.testing.assert_array_equal(again.values, values)


def test_lapys_own_solver_finds_the_same(case):
    """Same boundaries, and a sheet that agrees to 1e-6 mm."""
    laplace = volume_laplace(case.mesh, "lapy")
    found = find_boundaries(case.surface, laplace, case.body, SETTINGS.changed(solver="lapy"))
    for name in ("medial", "lateral", "interior", "exterior"):
        np.testing.assert_array_equal(getattr(found, name), getattr(case.boundaries, name))
    # Directions at the edges are solved for to 1e-6, and curves follow them.
    np.testing.assert_allclose(found.medial_curve, case.boundaries.medial_curve, atol=3e-4)
    sheet = sample_sheet(case.mesh, solve_coordinates(laplace, found), SheetSettings())
    np.testing.assert_allclose(sheet.points, case.sheet.points, atol=1e-6)


def test_held_values_weigh_by_area_and_inverse_square_of_the_thickness():
    same = SimpleNamespace(screened=lambda weight, signs: (weight, signs))
    wall = SimpleNamespace(vertex_areas=np.array([2.0, 2.0, 6.0]), evenly_aware=same)
    hold, values = np.array([0.0, 0.5, 0.75]), np.array([1.0, -3.0, 2.0])
    weight, signs = boundaries._screened(wall, hold, values, thickness=4.0)
    wanted = boundaries.FIRMNESS / 16 * np.array([0.0, 2.0, 18.0])
    np.testing.assert_allclose(weight, wanted, rtol=1e-12)  # rounding
    np.testing.assert_array_equal(signs, [1, -1, 1])


def test_local_means_are_gaussian_in_the_distance():
    points, vectors = np.array([[1.0, 0, 0], [3.0, 0, 0]]), np.eye(3)[:2]
    found = boundaries._local_mean(np.zeros((1, 3)), points, vectors, np.array([1.0, 2.0]), sd=2.0)
    np.testing.assert_allclose(found, [[1.0, 2 * np.exp(-0.5 * (9 - 1) / 4), 0.0]], rtol=1e-12)


@pytest.mark.parametrize("operator", ["sharp-bends", "published"])
def test_published_boundaries_are_the_zero_lines(case, operator):
    """Vertices beside a line, not the end faces; the sides reach to them."""
    settings = BoundarySettings(operator=operator, edges="zero-lines")
    laplace = volume_laplace(case.mesh, settings.solver)
    found = find_boundaries(case.surface, laplace, case.body, settings)
    assert 0 < found.strip_width < 0.7 < case.boundaries.strip_width
    for u, curve, strip in (
        (0, found.medial_curve, found.medial),
        (1, found.lateral_curve, found.lateral),
    ):
        gap, _ = cKDTree(curve).query(case.surface.vertices[strip])
        assert gap.max() < 0.4  # half of the longest edge of a mesh of 0.35 mm
        assert cKDTree(rim(case, u)).query(curve)[0].max() < 1.0
    sheet = sample_sheet(case.mesh, solve_coordinates(laplace, found), SheetSettings())
    step = np.diff(sheet.points, axis=2)
    thickness = np.linalg.norm(step, axis=3).sum(axis=2)
    # Without end faces x does not converge beside the edges; in the middle half 2 mm are 2 mm.
    assert np.nanmedian(thickness[10:31]) == pytest.approx(2.0, abs=0.05)


def test_directions_at_an_edge_are_continued_from_inside():
    """Along a line on which one component rises, and the other does so too, from its start."""
    starts = np.array([[0.0, 0, 0], [2.0, 5, 0]])
    steps = []

    def flow(points):
        steps.append(points[:, 0] - starts[:, 0])
        return np.column_stack([np.ones(2), 0.3 * points[:, 0], np.zeros(2)])

    found = boundaries._direction_at_edge(flow, starts, -2.0)
    np.testing.assert_allclose(steps[1:], [[-1, -1], [-2, -2], [-3, -3]])
    np.testing.assert_allclose(
        found, [[1, 0, 0], np.array([1, 0.6, 0]) / np.hypot(1, 0.6)], atol=1e-12
    )
