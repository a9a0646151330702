"""The truth, against closed forms and against independent numerical measurements."""

import itertools

import numpy as np
import pytest

from hipsta_bids.phantom import KINDS, Phantom, PhantomSpec
from hipsta_bids.phantom.labels import SUBFIELD_STARTS
from hipsta_bids.phantom.phantom import SURFACES, curvatures, cut_sections, summarize
from hipsta_bids.phantom.shape import START_ANGLE, Body
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Tissue

EXACT = 1e-9  # relative: quadrature of smooth functions and rounding


def summary_of(**changes):
    return Phantom(PhantomSpec(**changes)).truth(0.5, 0.5).summary


def test_slab():
    summary = summary_of(kind="slab", thickness=1.5, width=10.0, length=8.0)
    area = {f"area_{name}": 80.0 for name in SURFACES}
    extents = {"extent_x": 10.0, "extent_y": 8.0, "extent_z": 1.5}
    wanted = {"thickness_mean": 1.5, "volume": 120.0} | extents | area
    wanted |= {
        "area_ratio": 1.0,
        "surface_volume_ratio": 2 / 1.5,
        "circumference_mean": 20.0,
        "interior_exterior_ratio_mean": 1.0,
        "section_area_mean": 15.0,
        "shape_index_mean": 2 / 1.5,
    }
    assert summary == pytest.approx(wanted, rel=EXACT)


def test_straight_arc():
    width = 4.0 * 1.5 * np.pi
    summary = summary_of(kind="arc", width=width, length=10.0)
    for name, radius in [("interior", 3.0), ("mid", 4.0), ("exterior", 5.0)]:
        assert summary[f"area_{name}"] == pytest.approx(1.5 * np.pi * radius * 10.0, rel=EXACT)
    assert summary["circumference_mean"] == pytest.approx(1.5 * np.pi * 8.0, rel=EXACT)
    assert summary["interior_exterior_ratio_mean"] == pytest.approx(0.6, rel=EXACT)
    assert summary["area_ratio"] == pytest.approx(0.6, rel=EXACT)
    assert summary["shape_index_mean"] == pytest.approx(1.0, rel=EXACT)  # 2 / thickness
    ring = 0.75 * np.pi * (5.0**2 - 3.0**2)
    assert summary["section_area_mean"] == pytest.approx(ring, rel=EXACT)
    assert summary["volume"] == pytest.approx(ring * 10.0, rel=EXACT)


def test_curvature_of_a_straight_arc_is_half_of_one_over_its_radius():
    truth = Phantom(PhantomSpec(kind="arc")).truth(np.linspace(0, 1, 5)[:, None], [0.0, 1.0])
    assert truth.curvature.shape == (5, 2)
    np.testing.assert_allclose(truth.curvature_interior, 1.0 / 6.0, rtol=EXACT)
    np.testing.assert_allclose(truth.curvature, 1.0 / 8.0, rtol=EXACT)
    np.testing.assert_allclose(truth.curvature_exterior, 1.0 / 10.0, rtol=EXACT)


@pytest.mark.parametrize("bend", [0.05, -0.04])
def test_arc_swept_round_a_bent_axis_follows_pappus(bend):
    """A body of revolution: its volume is the section's area times its centroid's path."""
    radius, half, width, length = 4.0, 1.0, 18.0, 14.0
    turn = width / radius
    inner, outer = radius - half, radius + half
    area = turn / 2.0 * (outer**2 - inner**2)
    # Centroids of a ring sector and of an arc lie on its bisector, this far from the center.
    chord = np.sin(turn / 2.0) / (turn / 2.0)
    ring = 2.0 / 3.0 * (outer**3 - inner**3) / (outer**2 - inner**2) * chord
    bisector = START_ANGLE + turn / 2.0  # tangent there; its normal's lateral part is the sine
    medial = -(ring - radius * chord) * np.sin(bisector)
    summary = summary_of(kind="arc", width=width, length=length, bend=bend, thickness=2.0 * half)
    assert summary["volume"] == pytest.approx(area * length * (1.0 - bend * medial), rel=EXACT)
    assert summary["extent_y"] == pytest.approx(length, rel=EXACT)


@pytest.mark.parametrize("bend", [0.0, 0.02, -0.03])
@pytest.mark.parametrize("kind", KINDS)
def test_curvature_equals_finite_differences(kind, bend):
    body = Body(PhantomSpec(kind=kind, bend=bend, variation=0.3))
    random = np.random.default_rng(5)
    u, v = random.uniform(0.05, 0.95, (2, 60))
    for at in SURFACES.values():
        mean, gaussian = _curvature_by_differences(body, u, v, at)
        # Truncation is h^2 = 1e-6 times fourth derivatives of up to a few tens.
        found = curvatures(body, u, v, at=at)
        np.testing.assert_allclose(found, (mean, gaussian), atol=5e-5)


def test_gaussian_curvature_of_straight_walls_is_zero():
    truth = Phantom(PhantomSpec(kind="tight")).truth(np.linspace(0, 1, 9)[:, None], [0.2, 0.9])
    for name in ("", "_interior", "_exterior"):
        np.testing.assert_allclose(getattr(truth, f"gaussian_curvature{name}"), 0, atol=1e-12)


def test_gaussian_curvature_of_a_ring_is_that_of_a_torus():
    """An arc swept round a bent axis: its curvature times that of its circle of latitude."""
    spec = PhantomSpec(kind="arc", bend=0.04)
    body, u = Body(spec), np.linspace(0.0, 1.0, 9)
    section = body.curve.position(u * spec.width)
    leaning = -body.curve.normal(u * spec.width)[:, 0]  # medial part, towards the center
    far = 1.0 / spec.bend + section[:, 0]
    np.testing.assert_allclose(
        curvatures(body, u, np.zeros(9), at=0.0)[1], 0.25 * -leaning / far, rtol=1e-9
    )


@pytest.mark.parametrize("bend", [0.0, 0.03])
def test_sections_add_up_to_areas_and_lengths(bend):
    phantom = Phantom(PhantomSpec(kind="spiral", bend=bend, variation=0.3))
    v = np.linspace(0.0, 1.0, 7)
    sections = cut_sections(phantom.body, v)
    fine = np.linspace(0.0, 1.0, 4001)[:, None]
    for name, at in SURFACES.items():
        line = phantom.body.place(fine, v, at * phantom.body.thickness(fine, v))
        length = np.linalg.norm(np.diff(line, axis=0), axis=-1).sum(axis=0)
        # Chords of 4000 parts: (0.02 / 8000)^2 and less.
        np.testing.assert_allclose(sections[f"length_{name}"], length, rtol=1e-6)
    np.testing.assert_allclose(sections["position"][-1], phantom.truth(0, 0).summary["extent_y"])
    assert sections["thickness"] == pytest.approx(
        phantom.body.thickness(fine[:-1], v).mean(axis=0),
        rel=1e-6,  # whole periods
    )


def test_lines_are_as_long_as_their_points_say():
    phantom = Phantom(PhantomSpec(kind="arc", bend=0.04))
    u, v = np.linspace(0, 1, 5)[:, None], np.linspace(0, 1, 2001)[None, :]
    truth = phantom.truth(u, v)
    along = np.linalg.norm(np.diff(truth.points, axis=1), axis=-1).sum(axis=1)
    np.testing.assert_allclose(truth.extent_y[:, 0], along, rtol=1e-6)  # chords
    assert truth.extent_x == pytest.approx(np.full((5, 2001), 20.0))


def _curvature_by_differences(body, u, v, at, h=1e-3):
    """Mean and Gaussian curvature of points alone, by the direction to the exterior."""

    def point(i, j):
        a, b = u + i * h, v + j * h
        return body.place(a, b, at * body.thickness(a, b))

    def dot(a, b):
        return (a * b).sum(axis=1)

    x_u, x_v = (point(1, 0) - point(-1, 0)) / 2, (point(0, 1) - point(0, -1)) / 2
    x_uu = point(1, 0) + point(-1, 0) - 2 * point(0, 0)
    x_vv = point(0, 1) + point(0, -1) - 2 * point(0, 0)
    x_uv = (point(1, 1) - point(1, -1) - point(-1, 1) + point(-1, -1)) / 4
    normal = np.cross(x_u, x_v)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    normal *= -np.sign(dot(normal, body.place(u, v, 0.1) - body.place(u, v, 0.0)))[:, None]
    e, f, g = dot(x_u, x_u), dot(x_u, x_v), dot(x_v, x_v)
    second = [dot(x, normal) for x in (x_uu, x_uv, x_vv)]
    trace = second[0] * g - 2 * second[1] * f + second[2] * e
    det = e * g - f**2
    return trace / (2 * det), (second[0] * second[2] - second[1] ** 2) / det


@pytest.mark.parametrize(("kind", "axis"), [("tight", "xy"), ("spiral", "x"), ("s-shape", "y")])
def test_areas_equal_those_of_fine_triangulations(kind, axis):
    body = Body(PhantomSpec(kind=kind, bend=0.02, variation=0.3, variation_axis=axis))
    summary = summarize(body)
    for name, at in SURFACES.items():
        coarse, fine = (_triangulated_area(body, at, count) for count in (100, 200))
        # Second-order error, removed by Richardson; fourth order remains, about 200^-4 * 50.
        area = (4.0 * fine - coarse) / 3.0
        assert summary[f"area_{name}"] == pytest.approx(area, rel=1e-7)


def _triangulated_area(body, at, count):
    u, v = np.meshgrid(*[np.linspace(0.0, 1.0, count + 1)] * 2, indexing="ij")
    x = body.place(u, v, at * body.thickness(u, v))
    a, b, c, d = x[:-1, :-1], x[1:, :-1], x[:-1, 1:], x[1:, 1:]
    doubled = [np.cross(b - a, c - a), np.cross(b - d, c - d)]
    return sum(np.linalg.norm(cross, axis=-1).sum() for cross in doubled) / 2.0


def test_subfields_add_up_to_the_whole():
    body = Body(PhantomSpec(kind="tight", bend=0.03, variation=0.3))
    borders = [start for _, start in SUBFIELD_STARTS] + [1.0]
    parts = [summarize(body, span=span) for span in itertools.pairwise(borders)]
    whole = summarize(body)
    for key in ("extent_x", "volume", "area_interior", "area_mid", "area_exterior"):
        assert sum(part[key] for part in parts) == pytest.approx(whole[key], rel=EXACT)
    mean = sum(part["area_mid"] * part["thickness_mean"] for part in parts) / whole["area_mid"]
    assert mean == pytest.approx(whole["thickness_mean"], rel=EXACT)


def test_subfield_of_each_position():
    truth = Phantom(PhantomSpec()).truth(np.array([0.0, 0.15, 0.5, 0.78, 0.82, 1.0]), 0.5)
    named = [Tissue(value).name for value in truth.subfield]
    assert named == ["PRESUBICULUM", "SUBICULUM", "CA1", "CA2", "CA3", "CA3"]


@pytest.mark.parametrize("kind", KINDS)
def test_volume_equals_counted_voxels(kind):
    phantom = Phantom(PhantomSpec(kind=kind, bend=0.02, variation=0.3, length=8.0, end_length=0.5))
    protocol = load_protocol("freesurfer")
    volume = phantom.label_volume(protocol, voxel_size=(0.25, 0.25, 0.25), border=0.3)
    body = np.isin(volume.tissue, protocol.sheet) & (volume.part == 2)
    # Some 10,000 voxels at the surface, each off by half a voxel at most, at random: 0.2 %.
    assert body.sum() * 0.25**3 == pytest.approx(
        phantom.truth(0.5, 0.5).summary["volume"], rel=4e-3
    )


def test_thickness_equals_that_of_rays_through_fine_voxels():
    size = 0.1
    spec = PhantomSpec(width=8.0, curvature=(0.0, 0.4), length=3.0, end_length=0.5, variation=0.3)
    phantom = Phantom(spec)
    protocol = load_protocol("freesurfer")
    volume = phantom.label_volume(protocol, voxel_size=(size, size, size), border=0.6)
    wall = np.isin(volume.tissue, protocol.sheet)
    u, v = np.meshgrid(np.linspace(0.1, 0.9, 9), np.linspace(0.1, 0.9, 9), indexing="ij")
    truth = phantom.truth(u, v)
    # Rays along normals found from the mid-surface's points alone.
    h = 1e-4
    ahead, beside = phantom.truth(u + h, v).points, phantom.truth(u, v + h).points
    normal = np.cross(ahead - truth.points, beside - truth.points)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    steps = np.arange(-1.5, 1.5, 0.01)
    rays = truth.points[..., None, :] + steps[:, None] * normal[..., None, :]
    index = np.rint((rays - volume.affine[:3, 3]) / size).astype(int)
    measured = wall[tuple(np.moveaxis(index, -1, 0))].sum(axis=-1) * 0.01
    # Each end of a ray is off by at most half a voxel's diagonal, 0.087 mm, at random about 0.03.
    assert np.abs(measured - truth.thickness).max() < 0.2
    assert np.abs((measured - truth.thickness).mean()) < 0.015  # 0.05 / sqrt(81 rays), 2.5 SE
    assert np.corrcoef(measured.ravel(), truth.thickness.ravel())[0, 1] > 0.98


def test_hemisphere_moves_points_only():
    phantom = Phantom(PhantomSpec(bend=0.02))
    u, v = np.linspace(0.0, 1.0, 7), np.array(0.3)
    left, right = phantom.truth(u, v), phantom.truth(u, v, hemi="R")
    np.testing.assert_array_equal(right.points, left.points * [-1.0, 1.0, 1.0])
    np.testing.assert_array_equal(right.curvature, left.curvature)
