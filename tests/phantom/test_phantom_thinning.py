"""Regions of thinner wall, and a pattern that is shifted along x."""

import numpy as np
import pytest
from test_phantom_truth import _curvature_by_differences

from hipsta_bids.errors import SettingsError
from hipsta_bids.phantom import Phantom, PhantomSpec, Thinning
from hipsta_bids.phantom.phantom import SURFACES, curvatures
from hipsta_bids.phantom.shape import Body, window_jet
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Tissue

REGION = Thinning(depth=0.4, u=(0.35, 0.75), v=(0.5, 1.0))
THINNED = PhantomSpec(thickness=1.8, thinnings=(REGION,))


def thickness(spec, u, v):
    return Phantom(spec).truth(u, v).thickness


def test_wall_is_thinner_in_the_region_and_nowhere_else():
    # Edges of 1 mm; these places are 3 mm and more from any: erfc(3) / 2 is 1e-5 of the depth.
    assert thickness(THINNED, 0.55, 0.9) == pytest.approx(1.4, abs=1e-5)
    assert thickness(THINNED, 0.55, 1.0) == pytest.approx(1.4, abs=1e-5)  # no edge at the end
    assert thickness(THINNED, 0.55, 0.1) == pytest.approx(1.8, abs=1e-5)
    assert thickness(THINNED, 0.1, 0.9) == pytest.approx(1.8, abs=1e-5)
    assert thickness(THINNED, 0.35, 0.9) == pytest.approx(1.6, abs=1e-5)  # half, at the limit


def test_thinning_changes_the_mean_by_its_share_of_the_sheet():
    mean = Phantom(THINNED).truth(0.5, 0.5).summary["thickness_mean"]
    # Edges within the sheet are symmetric about their limits, so that they cancel.
    assert mean == pytest.approx(1.8 - 0.4 * 0.4 * 0.5, abs=1e-6)


def test_negative_depth_thickens_and_the_grid_leaves_room():
    grown = PhantomSpec(thickness=1.8, thinnings=(Thinning(depth=-0.5, u=(0, 1), v=(0, 1)),))
    assert thickness(grown, 0.5, 0.5) == pytest.approx(2.3)
    assert Phantom(grown).body.thickest == pytest.approx(2.3)


@pytest.mark.parametrize("name", SURFACES)
def test_curvature_with_mixed_derivatives_equals_finite_differences(name):
    body = Body(PhantomSpec(bend=0.02, variation=0.1, thinnings=(REGION,), offset=0.03))
    random = np.random.default_rng(7)
    # Round the corner of the region, where the wall changes along both axes.
    u, v = 0.78 + random.uniform(-0.06, 0.06, 60), 0.5 + random.uniform(-0.08, 0.08, 60)
    at = SURFACES[name]
    measured, _ = _curvature_by_differences(body, u, v, at)
    # Truncation is h^2 = 1e-6 times fourth derivatives of up to some tens.
    np.testing.assert_allclose(curvatures(body, u, v, at=at)[0], measured, atol=2e-4)


def test_window_and_its_derivatives():
    at = np.linspace(-2.0, 12.0, 701)
    value, slope, second = window_jet(at, (0.2, 0.7), 10.0, 0.8)
    step = at[1] - at[0]
    # Second-order differences of step 0.02: 0.02^2 times third derivatives of up to 10.
    np.testing.assert_allclose(np.gradient(value, step)[1:-1], slope[1:-1], atol=2e-3)
    np.testing.assert_allclose(np.gradient(slope, step)[1:-1], second[1:-1], atol=5e-3)
    assert value[[0, -1]] == pytest.approx([0.0, 0.0], abs=1e-6)
    assert value[at.searchsorted(4.5)] == pytest.approx(1.0, abs=1e-4)


def test_window_that_is_open_at_both_ends_is_one():
    value, slope, _ = window_jet(np.linspace(-1, 11, 9), (0.0, 1.0), 10.0, 1.0)
    np.testing.assert_array_equal(value, 1.0)
    np.testing.assert_array_equal(slope, 0.0)


def test_offset_moves_the_pattern_and_the_subfields_but_not_the_shape():
    still = PhantomSpec(variation=0.2, thinnings=(REGION,))
    moved = PhantomSpec(variation=0.2, thinnings=(REGION,), offset=0.05)
    u, v = np.linspace(0.1, 0.9, 33), np.array(0.8)
    np.testing.assert_allclose(
        thickness(moved, u + 0.05, v), thickness(still, u, v), atol=1e-12
    )  # rounding
    np.testing.assert_array_equal(
        Phantom(moved).truth(u, v).points, Phantom(still).truth(u, v).points
    )
    named = Phantom(moved).truth(np.array([0.0, 0.17, 0.21]), 0.5).subfield
    assert [Tissue(x).name for x in named] == ["PRESUBICULUM", "PRESUBICULUM", "SUBICULUM"]


@pytest.mark.parametrize("offset", [-0.1, 0.1])
def test_a_shifted_phantom_is_drawn_whole(offset):
    protocol = load_protocol("freesurfer")

    def drawn(spec):
        volume = Phantom(spec).label_volume(protocol, voxel_size=(0.5, 0.5, 0.5))
        return volume, np.isin(volume.tissue, protocol.sheet)

    volume, wall = drawn(PhantomSpec(length=6.0, end_length=1.0, offset=offset))
    plain, same = drawn(PhantomSpec(length=6.0, end_length=1.0))
    np.testing.assert_array_equal(wall, same)
    moved, before = ((x.tissue == Tissue.SUBICULUM).sum() for x in (volume, plain))
    assert moved == pytest.approx(before, rel=0.1)  # as wide as before: it only moved
    share = (volume.tissue == Tissue.PRESUBICULUM).sum() / wall.sum()
    assert share == pytest.approx(0.15 + offset, abs=0.02)


def test_a_thinning_that_leaves_no_wall_is_refused():
    with pytest.raises(SettingsError, match=r"thinning by [0-9.]+ mm leaves no wall of 2 mm"):
        PhantomSpec(thinnings=(Thinning(depth=2.5, u=(0, 1), v=(0, 1)),))


@pytest.mark.parametrize(
    "changes", [{"depth": float("nan")}, {"edge": 0.0}, {"u": (0.2, float("inf"))}]
)
def test_a_thinning_that_makes_no_sense_is_refused(changes):
    values = {"depth": 0.2, "u": (0, 1), "v": (0, 1)} | changes
    with pytest.raises(SettingsError, match=r"phantom: thinning .* is outside"):
        PhantomSpec(thinnings=(Thinning(**values),))
