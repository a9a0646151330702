"""The mid-curve: arc length, curvature, projection."""

import numpy as np
import pytest

from hipsta_bids.phantom.shape import KINDS, START_ANGLE, Bend, MidCurve, gauss_panels

WIDTH = 20.0
EXACT = 1e-10  # mm: quadrature and rounding are far smaller, any mistake is far larger


@pytest.fixture(params=KINDS)
def curve(request):
    return MidCurve(KINDS[request.param], WIDTH)


def test_constant_curvature_makes_a_circle():
    curve = MidCurve(Bend(medial=0.25, lateral=0.25), WIDTH)
    s = np.linspace(0.0, WIDTH, 57)
    angle = START_ANGLE + s / 4.0
    circle = 4.0 * np.column_stack([np.sin(angle), -np.cos(angle)])
    # The mean of sin and -cos over the arc, written out, puts the centroid at 0.
    low, high = START_ANGLE, START_ANGLE + WIDTH / 4.0
    centroid = 4.0 * np.array([np.cos(low) - np.cos(high), np.sin(low) - np.sin(high)])
    np.testing.assert_allclose(curve.position(s), circle - centroid / (high - low), atol=EXACT)


def test_centroid_is_the_origin(curve):
    s, weights = gauss_panels(0.0, WIDTH, 300)
    np.testing.assert_allclose(weights @ curve.position(s) / WIDTH, 0.0, atol=EXACT)


def test_derivatives_belong_together(curve):
    s, h = np.linspace(0.5, WIDTH - 0.5, 101), 1e-4
    for value, slope in [
        (curve.position, curve.tangent),
        (curve.angle, curve.curvature),
        (curve.curvature, curve.curvature_slope),
    ]:
        difference = (value(s + h) - value(s - h)) / (2.0 * h)
        # Truncation is h^2 = 1e-8 times third derivatives below 0.1; rounding is 1e-11.
        np.testing.assert_allclose(difference, slope(s), atol=1e-8)


def test_normal_points_away_from_the_center_of_a_positive_curvature():
    curve = MidCurve(KINDS["arc"], WIDTH)
    s = np.linspace(0.0, WIDTH, 11)
    centers = curve.position(s) - 4.0 * curve.normal(s)
    np.testing.assert_allclose(centers, np.broadcast_to(centers[0], centers.shape), atol=EXACT)


def test_projection_inverts_offsetting(curve):
    random = np.random.default_rng(1)
    s, n = random.uniform(0.0, WIDTH, 2000), random.uniform(-0.9, 0.9, 2000)
    found = curve.project(curve.position(s) + n[:, None] * curve.normal(s))
    np.testing.assert_allclose(found, [s, n], atol=EXACT)


def test_nothing_projects_beyond_the_flat_ends(curve):
    ends = np.array([0.0, WIDTH])
    out = curve.tangent(ends) * [[-1.0], [1.0]]
    points = curve.position(ends) + 1e-6 * out + 0.5 * curve.normal(ends)
    assert np.isnan(curve.project(points)).all()
    inside = curve.position(ends) - 1e-6 * out + 0.5 * curve.normal(ends)
    np.testing.assert_allclose(curve.project(inside)[1], 0.5, atol=1e-5)  # moved by 1e-6 mm


def test_nothing_projects_from_out_of_reach(curve):
    s = np.array([10.0, 10.0])
    points = curve.position(s) + np.array([[0.99], [1.01]]) * curve.normal(s)
    along, across = curve.project(points, reach=1.0)
    np.testing.assert_allclose(across, [0.99, np.nan], atol=EXACT)
    np.testing.assert_array_equal(np.isnan(along), [False, True])


def test_the_foot_of_a_point_beyond_an_end_is_the_end():
    curve = MidCurve(KINDS["slab"], WIDTH)
    ends = np.array([0.0, WIDTH])
    points = curve.position(ends) + [[-3.0], [3.0]] * curve.tangent(ends)
    np.testing.assert_array_equal(curve.foot(points), ends)


def test_quadrature_is_exact_for_ninth_degree():
    nodes, weights = gauss_panels(1.0, 3.0, 2)
    # Five Gauss nodes integrate degree 9 exactly; 1e-12 is rounding.
    np.testing.assert_allclose(weights @ nodes**9, (3.0**10 - 1.0) / 10.0, rtol=1e-12)
