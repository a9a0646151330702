"""Planes at the ends of the body and the axis between them, from points whose order is known."""

from dataclasses import replace

import numpy as np
import pytest
from geometry_cases import rotation, straight_ends

from hipsta_bids.geometry import ends as ends_mod
from hipsta_bids.geometry.ends import EndPlane, long_axis
from hipsta_bids.protocols.protocol import Part
from hipsta_bids.types import GivenEnd

X, Y, Z = np.eye(3)
TURN = rotation(0, 20) @ rotation(2, -35)


def leaning(degrees):
    """Unit vector that leans from z towards x."""
    return rotation(1, -degrees) @ Z


def test_a_plane_is_named_by_a_place_next_to_the_body():
    plane = EndPlane(np.array([100.0, 0, 0]), Y, "labels")
    points = np.array([[1.0, 5, 3], [2.0, -0.5, 4], [3.0, -2, 5]])
    assert plane.moved("anterior", 2.0, points).point == (2.0, 2.0, 4.0)
    assert plane.entry(points) == {"point_ras_mm": [2.0, 0.0, 4.0], "normal_ras": [0.0, 1.0, 0.0]}
    normal = np.array([0.6, 0.8, 0.0])
    moved = EndPlane(np.zeros(3), normal, "user").moved("posterior", -1.0, np.array([[5.0, 0, 7]]))
    assert moved.normal == tuple(normal)
    np.testing.assert_allclose(moved.point, [5 - 4 * 0.6, -4 * 0.8, 7.0])


def test_lengths_and_depths_between_planes_that_lean():
    """At x, the planes lie at -x tan 10 and 8 - x tan -20 mm along the axis."""
    ends = replace(
        straight_ends(8.0),
        posterior=EndPlane(np.zeros(3), leaning(10), "labels"),
        anterior=EndPlane(8 * Z, leaning(-20), "labels"),
        axis=Z,
    )
    points = np.array([[1.0, 5, 2], [3.0, -7, 1]])
    slope = [np.tan(np.radians(angle)) for angle in (10, 20)]
    assert ends.length(points) == pytest.approx(8 + 2 * sum(slope))
    below = (points[:, 2] + slope[0] * points[:, 0]) * np.cos(np.radians(10))
    above = (8 + slope[1] * points[:, 0] - points[:, 2]) * np.cos(np.radians(20))
    np.testing.assert_allclose(ends.depths(points), [below, above])
    apart = ends.beyond(1.5)
    assert apart.length(points) == pytest.approx(11 + 2 * sum(slope))
    np.testing.assert_allclose(apart.posterior.point, [0, 0, -1.5])
    np.testing.assert_allclose(apart.anterior.point, [0, 0, 9.5])


def box(size, head=0.0, tail=0.0):
    """Points of a box, mm, turned; its first and last mm along y are of tail and head."""
    axes = [np.arange(n + 0.0) - (n - 1) / 2 for n in size]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    parts = np.full(len(points), Part.BODY)
    half = size[1] / 2
    parts[points[:, 1] > half - head] = Part.HEAD
    parts[points[:, 1] < tail - half] = Part.TAIL
    return points @ TURN.T, parts


def test_the_long_axis_leads_from_tail_to_head():
    """By the principal axis, or from end to middle where all is wider than long."""
    ends = [((6, 20, 4), 0, 0), ((6, 20, 4), 5, 0), ((6, 20, 4), 0, 5), ((6, 20, 4), 5, 5)]
    for size, head, tail in [*ends, ((20, 6, 4), 2, 0), ((20, 6, 4), 0, 2), ((20, 6, 4), 1, 2)]:
        points, parts = box(size, head, tail)
        np.testing.assert_allclose(long_axis(points, parts), TURN @ Y, atol=1e-12)
        if head or tail:
            turned = np.array([Part.UNKNOWN, Part.TAIL, Part.UNKNOWN, Part.HEAD])[parts]
            np.testing.assert_allclose(long_axis(points, turned), -TURN @ Y, atol=1e-12)


@pytest.mark.parametrize(("length", "is_long"), [(9, False), (11, True)])
def test_the_axis_of_a_body_is_its_own_if_it_is_longer_than_wide(length, is_long):
    """1.6 times as long: 6 mm across have a variance of 35 / 12, 9 and 11 mm 80 and 120 / 12."""
    points, _ = box((6, length, 4))
    axis, plane = TURN @ Y, EndPlane(np.zeros(3), X, "labels")
    near = rotation(0, 10) @ axis
    expected = axis if is_long else X
    np.testing.assert_allclose(ends_mod._body_axis(points, near, {"anterior": plane}), expected)
    np.testing.assert_allclose(ends_mod._body_axis(points, near, {}), axis if is_long else near)
    across = TURN @ X  # the long axis lies elsewhere
    np.testing.assert_allclose(ends_mod._body_axis(points, across, {}), across)
    np.testing.assert_allclose(ends_mod._body_axis(points, -near, {}), -axis if is_long else -near)


def mirrored(normal, level, count=400, width=3.0):
    """Points on both sides of a plane, mirror images of each other."""
    points = np.random.default_rng(2).uniform(-width, width, (count, 3))
    side = points @ normal - level
    below = points - (side + np.abs(side))[:, None] * normal
    return below, below + 2 * np.abs(side)[:, None] * normal


def test_the_plane_between_mirror_images_is_the_mirror():
    """Whatever the number of labels on either side, and where the fit begins."""
    normal = TURN @ Y
    below, above = mirrored(normal, 1.2)
    for first, second in ((below, above), (below, np.vstack([above] * 3))):
        for start in (normal, Y):
            point, found = ends_mod._logistic_plane(first, second, start)
            np.testing.assert_allclose(found, normal, atol=1e-6)
            assert point @ normal == pytest.approx(1.2, abs=1e-6)
        point, found = ends_mod._separating_plane(first, second, normal, 2.0)
        np.testing.assert_allclose(found, normal, atol=1e-6)
        assert point @ normal == pytest.approx(1.2, abs=1e-6)


@pytest.mark.parametrize("sign", [1, -1])
def test_normals_of_given_planes_point_along_the_axis(sign):
    end = GivenEnd(end="anterior", point=(1.0, 2.0, 3.0), normal=(0.0, 3.0 * sign, 4.0 * sign))
    plane = ends_mod._given_plane(end, X, Z)
    assert (plane.point.tolist(), plane.normal.tolist()) == ([1.0, 2.0, 3.0], [0.0, 0.6, 0.8])


def test_a_plane_lies_where_the_points_next_to_it_do():
    """Mean level of those within two mm; the plane's point may lie aside, or all be far away."""
    plane = EndPlane(np.array([9.0, 1.0, 0.0]), np.array([0.6, 0.8, 0.0]), "labels")
    near = plane.point + np.array([[-4, 3, 1.0], [-8, 6, 2]]) + [[0.6, 0.8, 0], [0.9, 1.2, 0]]
    far = plane.point + np.array([[3.0, 4, 0], [-3, -4, 0]])
    level = ends_mod._level(plane, np.vstack([near, far]), Y)
    assert level == pytest.approx(1 + (3 + 0.8 + 6 + 1.2) / 2)
    assert ends_mod._level(plane, far, Y) == 1.0
