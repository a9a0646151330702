"""Thickness from the medial axis of single slices, on phantoms whose thickness is known."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from hipsta_bids.errors import GeometryError
from hipsta_bids.extensions.surrogate import medial_axis
from hipsta_bids.extensions.surrogate.medial_axis import draw_slice, surrogate_profiles
from hipsta_bids.geometry.agreement import agreement, compare_nearby
from hipsta_bids.geometry.body import extract_body
from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.settings import Settings

SETTINGS = Settings()
VOXEL = 0.4


@cache
def drawn(spec, hemi="L"):
    """A phantom and its body."""
    phantom = Phantom(spec)
    volume = phantom.label_volume(load_protocol("freesurfer"), hemi=hemi)
    return phantom, extract_body(volume, SETTINGS.body)


def profiles(body, position=0.5):
    return surrogate_profiles(body, position, SETTINGS.sheet)


def spec(kind="spiral", **changes):
    return PhantomSpec(kind=kind, thickness=2.0, length=10.0, **changes)


@pytest.mark.parametrize("kind", ["slab", "arc", "spiral", "s-shape"])
def test_constant_thickness_comes_back(kind):
    _, body = drawn(spec(kind))
    even, _ = profiles(body)
    inner = even.thickness[4:-4]  # the closest points of the others may lie on the rims
    # A wall drawn by voxels is off by up to half a voxel. The closest points are those where its
    # steps reach inward, so that the mean falls short, by less than half of that.
    assert np.abs(inner - 2.0).max() < VOXEL / 2
    assert -VOXEL / 4 < inner.mean() - 2.0 < 0.02


@pytest.mark.parametrize("hemi", ["L", "R"])
def test_varying_thickness_correlates_with_the_truth(hemi):
    phantom, body = drawn(spec(variation=0.3), hemi)
    for position in (0.3, 0.7):
        even, _ = profiles(body, position)
        u, v, _ = phantom.body.locate(even.points, hemi=hemi).T
        found = agreement(even.thickness[2:-2], phantom.truth(u, v).thickness[2:-2])
        # Steps of voxels leave noise with an SD of 0.1 mm, a quarter of a voxel, beside 0.24 mm of
        # the pattern's own in a slice: r is 0.92 at that.
        assert found.correlation > 0.9
        assert found.slope == pytest.approx(1, abs=0.15)
        assert -VOXEL / 4 < found.difference < 0.02


def test_it_runs_from_medial_to_lateral_at_the_given_place():
    phantom, body = drawn(spec())
    for profile in profiles(body, 0.4):
        u, v, n = phantom.body.locate(profile.points).T
        inside = np.isfinite(u)
        assert inside[2:-2].all()
        assert (np.diff(u[inside]) > 0).all()
        # Beside the spiral's tight end the axis goes on straight, off the middle.
        assert np.nanmedian(np.abs(n)) < VOXEL / 4
        # The end planes come from voxels: half of one on a body of 10 mm is 0.02.
        assert np.nanmean(v) == pytest.approx(0.4, abs=0.03)


def test_samplings_are_proportional_and_equidistant(monkeypatch):
    _, body = drawn(spec())
    monkeypatch.setattr(medial_axis, "SAMPLING_STEP", 0.7)
    even, steps = profiles(body)
    nodes = (np.linspace(-0.9, 0.9, 41) + 1) / 2
    np.testing.assert_allclose(even.fraction, nodes, rtol=1e-12)
    np.testing.assert_allclose(np.diff(steps.distance), 0.7, rtol=1e-12)
    apart = np.linalg.norm(np.diff(steps.points, axis=0), axis=1)
    # Chords are shorter than arcs: at most 3 % where the radius is 1.2 mm or more.
    assert (apart < 0.7 + 1e-9).all()
    assert (apart > 0.67).all()
    # The axis is as long as the phantom's mid-curve, 20 mm, but for the rounded ends.
    assert even.distance[-1] / even.fraction[-1] == pytest.approx(20.0, abs=0.6)


def test_the_pixels_hardly_matter(monkeypatch):
    _, body = drawn(spec(variation=0.3))
    coarse = profiles(body)[0]
    monkeypatch.setattr(medial_axis, "PIXEL", medial_axis.PIXEL / 2)
    fine = profiles(body)[0]
    assert np.abs(coarse.thickness - fine.thickness)[3:-3].mean() < 0.02  # mm, a fifth of a pixel


def test_small_holes_are_filled_and_loops_refused(monkeypatch):
    phantom, body = drawn(spec())
    index, points = body.inside_points()

    def without(radius):
        away = np.linalg.norm(points - phantom.body.place(0.4, 0.5, 0.0), axis=1)
        tissue = body.tissue.copy()
        tissue[tuple(index[away < radius].T)] = 0
        return replace(body, tissue=tissue)

    whole, _ = profiles(body)
    holed, _ = profiles(without(0.5))  # 0.8 mm2
    np.testing.assert_allclose(holed.thickness, whole.thickness, atol=0.05)
    monkeypatch.setattr(medial_axis, "HOLE_AREA", 0.1)
    with pytest.raises(GeometryError, match="closes on itself") as error:
        profiles(without(0.5))
    assert error.value.reason == "no-medial-axis"


def test_slices_without_labels_or_without_a_line_are_refused(monkeypatch):
    _, body = drawn(spec())
    with pytest.raises(GeometryError) as error:
        draw_slice(replace(body, tissue=np.zeros_like(body.tissue)), 0.5)
    assert error.value.reason == "no-medial-axis"
    monkeypatch.setattr(medial_axis, "FORK_LENGTH", 6.0)
    with pytest.raises(GeometryError) as error:
        profiles(body)
    assert error.value.reason == "no-medial-axis"


def test_agreement_of_known_numbers():
    first, second = np.array([1.0, 3.0, 5.0, np.nan]), np.array([1.0, 2.0, 3.0, 9.0])
    found = agreement(first, second)
    assert (found.count, found.correlation, found.slope) == (3, pytest.approx(1), pytest.approx(2))
    assert (found.difference, found.deviation) == (1.0, 1.0)
    assert np.isnan(agreement(first[:2], second[:2]).correlation)
    assert np.isnan(agreement(np.ones(5), np.arange(5.0)).slope)
    assert agreement(first[3:], second[3:]).count == 0


def test_values_nearby_are_those_of_the_surface():
    x, y = np.meshgrid(np.arange(6.0), np.arange(5.0), indexing="ij")
    surface = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    values = 2 + surface[:, 0]
    surface[7] = np.nan
    values[8] = np.nan
    points = np.array([[2.0, 2.0, 0.0], [2.5, 2.5, 0.4], [2.0, 2.0, 1.5], [1.0, 2.5, 0.0]])
    found = compare_nearby(points[:3], surface, values, 1.0)
    # At a node its own value (weights of 1e6); between four nodes their mean; too far.
    assert found[0] == pytest.approx(4.0, abs=1e-5)
    assert found[1] == pytest.approx(4.5)
    assert np.isnan(found[2])
    # Between two nodes that are missing, the mean of the next four, which are equally far.
    assert compare_nearby(points[3:], surface, values, 1.2) == pytest.approx([3.0])
    assert np.isnan(compare_nearby(points, surface, np.full(30, np.nan), 1.0)).all()


def test_the_axis_is_extended_in_steps_of_a_pixel_to_the_edge():
    inside = np.zeros((9, 9), dtype=bool)
    inside[4, :7] = True
    found = medial_axis._to_the_edge(
        SimpleNamespace(inside=inside), np.array([4.0, 2.0]), np.array([0.0, 3.0])
    )
    np.testing.assert_array_equal(found, [[4, 3], [4, 4], [4, 5], [4, 6]])


@pytest.mark.parametrize("labels", [(1, 2, 3), (3, 2, 1)])
def test_labels_tell_which_end_of_the_axis_is_medial(labels):
    body = SimpleNamespace(tissue=np.array([labels]), to_voxels=lambda points: points)
    axis = np.array([[0.0, 0.0], [0.0, 1.0], [0.0, 2.0]])
    found = medial_axis._from_medial(body, SimpleNamespace(to_ras=lambda points: points), axis)
    np.testing.assert_array_equal(found, axis if labels[0] == 1 else axis[::-1])
