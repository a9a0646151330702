"""Thickness, curvatures, areas and volumes of grids whose measures are known."""

import numpy as np
import pytest
from geometry_cases import rigid
from hypothesis import given, settings
from hypothesis import strategies as st
from sheet_cases import grid, plates, quadric, saddle, sheet_of, shell, tube

from hipsta_bids.geometry.measures import (
    away_from_edges,
    bending_angle,
    column_area,
    gaussian_curvature,
    layer_area,
    mean_curvature,
    measure_thickness,
    node_shares,
    pool_sd,
)
from hipsta_bids.settings import MeasureSettings

MEASURES = MeasureSettings()
EXACT = 1e-12  # relative rounding


@given(st.floats(0.2, 5.0))
@settings(max_examples=20, deadline=None)
def test_thickness_of_plates(thickness):
    np.testing.assert_allclose(measure_thickness(plates(thickness)), thickness, rtol=EXACT)


def test_thickness_of_tube_and_shell():
    np.testing.assert_allclose(measure_thickness(tube(thickness=1.3)), 1.3, rtol=EXACT)
    np.testing.assert_allclose(measure_thickness(shell(thickness=2.4)), 2.4, rtol=EXACT)


def test_thickness_is_the_length_of_the_line_not_of_its_chord():
    x, y, z = grid(nz=201)
    points = np.stack([10 * x + np.cos(np.pi * z), 8 * y, np.sin(np.pi * z)], axis=-1)
    # Half a circle; 200 chords are short by (pi / 200)^2 / 24.
    np.testing.assert_allclose(measure_thickness(sheet_of(points)), np.pi, rtol=2e-5)


@given(
    st.tuples(*[st.floats(-180, 180)] * 3), st.tuples(*[st.floats(-100, 100)] * 3), st.booleans()
)
@settings(max_examples=20, deadline=None)
def test_rigid_motion_leaves_every_measure(degrees, shift, mirrored):
    still, pose = tube(), rigid(degrees, shift)
    if mirrored:
        pose = pose @ np.diag([-1.0, 1.0, 1.0, 1.0])
    moved = sheet_of(still.points @ pose[:3, :3].T + pose[:3, 3])
    for measure in (
        measure_thickness,
        column_area,
        lambda s: mean_curvature(s, s.middle, MEASURES),
        lambda s: gaussian_curvature(s, s.middle, MEASURES),
        lambda s: bending_angle(s, MEASURES),
    ):
        # Rounding of coordinates of 100 mm, amplified by second differences.
        np.testing.assert_allclose(measure(moved), measure(still), rtol=1e-7, atol=1e-9)


@given(st.floats(0.3, 3.0))
@settings(max_examples=10, deadline=None)
def test_scaling(scale):
    still = tube()
    scaled = sheet_of(scale * still.points)
    thickness, area = measure_thickness(still), column_area(still)
    np.testing.assert_allclose(measure_thickness(scaled), scale * thickness)
    np.testing.assert_allclose(column_area(scaled), scale**2 * area)
    curvature = mean_curvature(still, still.middle, MEASURES)
    np.testing.assert_allclose(mean_curvature(scaled, 4, MEASURES), curvature / scale)


@pytest.mark.parametrize(("level", "radius"), [(0, 3.0), (4, 4.0), (-1, 5.0)])
def test_curvature_of_a_tube_is_half_of_one_over_its_radius(level, radius):
    curvature = mean_curvature(tube(), level, MEASURES)
    # Cubic polynomials over 9 nodes of pi / 40 each; at the edges they are one-sided.
    np.testing.assert_allclose(curvature[4:-4], 0.5 / radius, rtol=0.02)
    np.testing.assert_allclose(curvature, 0.5 / radius, rtol=0.15)


def test_curvature_does_not_mind_oblique_grid_lines():
    """A tube whose lines along y wind round it."""
    x, y, z = grid(nx=81)
    r, angle = 4.0 + 2.0 * (z - 0.5), np.pi * (x + 0.5 * y)
    oblique = sheet_of(np.stack([r * np.cos(angle), r * np.sin(angle), 10 * y], axis=-1))
    curvature = mean_curvature(oblique, 4, MEASURES)
    np.testing.assert_allclose(curvature[4:-4, 4:-4], 0.125, rtol=0.02)  # as above


def test_curvature_of_a_sphere_is_one_over_its_radius():
    curvature = mean_curvature(shell(), 4, MEASURES)
    np.testing.assert_allclose(curvature[4:-4, 4:-4], 0.1, rtol=0.02)  # as above


@pytest.mark.parametrize(
    ("first", "second"), [(0.2, -0.2), (0.3, 0.1), (-0.2, -0.1), (0.0, 0.0), (0.25, -0.05)]
)
def test_curvature_in_the_middle_of_a_quadric(first, second):
    curvature = mean_curvature(quadric(first, second), 4, MEASURES)
    # Quadrics are fitted exactly by cubics.
    assert curvature[20, 20] == pytest.approx((first + second) / 2, abs=1e-9)


def test_curvature_changes_sign_with_the_sides():
    still = tube()
    turned = sheet_of(still.points[:, :, ::-1])
    one, other = (mean_curvature(s, 4, MEASURES) for s in (still, turned))
    np.testing.assert_allclose(other, -one)


def test_curvature_does_not_depend_on_the_direction_of_the_axes():
    still = shell()
    for points in (still.points[::-1], still.points[:, ::-1]):
        one = np.sort(mean_curvature(sheet_of(points), 4, MEASURES).ravel())
        np.testing.assert_allclose(one, np.sort(mean_curvature(still, 4, MEASURES).ravel()))


@pytest.mark.parametrize("turn", [0.5, np.pi, 4.7])
def test_bending_angle_is_the_angle_of_the_arc(turn):
    still = tube(turn=turn)
    # Nodes stand for steps, of which there is one less; edges are one-sided fits.
    assert bending_angle(still, MEASURES) == pytest.approx(turn, rel=0.05)
    turned = sheet_of(still.points[:, :, ::-1])
    assert bending_angle(turned, MEASURES) == pytest.approx(-turn, rel=0.05)


def test_a_flat_sheet_does_not_bend():
    assert bending_angle(plates(), MEASURES) == pytest.approx(0, abs=1e-9)


def test_areas_of_layers():
    flat = plates()
    assert layer_area(flat.points[:, :, 4]).sum() == pytest.approx(96.0)
    bent = tube()
    # Chords of pi / 40 instead of arcs: short by (pi / 40)^2 / 24.
    assert layer_area(bent.points[:, :, -1]).sum() == pytest.approx(np.pi * 50, rel=3e-4)


@given(st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_shares_of_nodes_add_up(seed):
    cells = np.random.default_rng(seed).random((7, 5))
    shares = node_shares(cells)
    assert shares.shape == (8, 6)
    assert shares.sum() == pytest.approx(cells.sum())
    assert shares[0, 0] == pytest.approx(cells[0, 0] / 4)
    assert shares[3, 2] == pytest.approx(cells[2:4, 1:3].sum() / 4)


def test_areas_of_columns():
    assert column_area(plates()).sum() == pytest.approx(96.0)
    # Chords instead of arcs, as above.
    assert column_area(tube()).sum() == pytest.approx(4 * np.pi * 10, rel=3e-4)


def test_where_polynomials_reach_to_both_sides():
    away = away_from_edges((41, 21), MEASURES)
    assert away.sum() == 33 * 13  # windows of nine nodes
    assert away[4:-4, 4:-4].all()
    assert np.argwhere(away_from_edges((5, 4), MEASURES)).tolist() == [[2, 1], [2, 2]]


@pytest.mark.parametrize("level", [0, 4, -1])
def test_gaussian_curvature_of_a_tube_is_zero(level):
    np.testing.assert_allclose(gaussian_curvature(tube(), level, MEASURES), 0, atol=1e-9)


def test_gaussian_curvature_of_a_sphere_is_one_over_its_radius_squared():
    for level, radius in ((0, 9.0), (4, 10.0), (-1, 11.0)):
        curvature = gaussian_curvature(shell(tall=0.15), level, MEASURES)
        # Cubics over 9 nodes along x, and along y over all of an arc of 27 degrees.
        np.testing.assert_allclose(curvature[4:-4], 1 / radius**2, rtol=0.025)


def test_gaussian_curvature_inside_a_ring_is_negative():
    curvature = gaussian_curvature(saddle(), 4, MEASURES)[20]
    # cos / (r (R + r cos)) where the tube faces the middle of the ring; cubics over 34
    # degrees.
    np.testing.assert_allclose(curvature, -1 / (4.0 * (9.0 - 4.0)), rtol=0.04)


@pytest.mark.parametrize(
    ("first", "second"), [(0.2, -0.2), (0.3, 0.1), (-0.2, -0.1), (0.0, 0.3), (0.25, -0.05)]
)
def test_gaussian_curvature_in_the_middle_of_a_quadric(first, second):
    curvature = gaussian_curvature(quadric(first, second), 4, MEASURES)
    # Quadrics are fitted exactly by cubics.
    assert curvature[20, 20] == pytest.approx(first * second, abs=1e-9)


def test_gaussian_curvature_does_not_know_the_sides():
    still = shell()
    turned = sheet_of(still.points[:, :, ::-1])
    one, other = (gaussian_curvature(s, 4, MEASURES) for s in (still, turned))
    np.testing.assert_allclose(other, one)


def test_small_grids_are_measured_with_smaller_windows():
    x, y, z = grid(5, 4, 3)
    points = np.stack([12 * x, 8 * y, 2 * z], axis=-1)
    np.testing.assert_allclose(mean_curvature(sheet_of(points), 1, MEASURES), 0, atol=1e-12)


def test_phantom_measures_are_the_truth(case):
    thickness = measure_thickness(case.sheet)
    # Voxels of 0.4 mm drawn by their centers.
    assert thickness.mean() == pytest.approx(2.0, abs=0.05)
    assert thickness.std() < 0.05  # mm, an eighth of a voxel
    assert np.abs(thickness[4:-4, 1:-1] - 2.0).max() < 0.2  # half a voxel; end rows see one side


@pytest.mark.parametrize("name", ["arc", "slab"])
def test_phantom_curvature_is_the_truth(name, request):
    case = request.getfixturevalue(name)
    truth = case.phantom.truth(0.5, 0.5)
    for level, wanted in (
        (0, truth.curvature_interior),
        (4, truth.curvature),
        (8, truth.curvature_exterior),
    ):
        inner = mean_curvature(case.sheet, level, MEASURES)[6:-6, 4:-4]
        # Second derivatives of voxelized walls: the mean over the middle of the sheet.
        assert inner.mean() == pytest.approx(float(wanted), abs=0.02)


def test_sds_are_averaged_as_variances_of_what_is_there():
    sd = np.arange(1.0, 61.0).reshape(2, 6, 5)
    sd[0, 2, 2] = np.nan
    pooled = pool_sd(sd, 3)
    assert np.isnan(pooled[0, 2, 2])
    assert pooled[1, 3, 2] == pytest.approx(np.sqrt(np.mean(sd[1, 2:5, 1:4] ** 2)))
    beside = np.delete(sd[0, 1:4, 2:5].ravel(), 3)  # without the missing one
    assert pooled[0, 2, 3] == pytest.approx(np.sqrt(np.mean(beside**2)))
    corner = np.pad(sd[1], 1, mode="edge")[:3, :3]
    assert pooled[1, 0, 0] == pytest.approx(np.sqrt(np.mean(corner**2)))
