"""Noise and thin gaps in labels: flagged with their position, and sound labels left alone."""

from dataclasses import replace

import numpy as np
import pytest
from geometry_cases import plain_body, straight_ends

from hipsta_bids.geometry import checks
from hipsta_bids.geometry.checks import check_labels, describe_uncus
from hipsta_bids.geometry.completion import fill_slits
from hipsta_bids.geometry.grid import cut_across
from hipsta_bids.settings import BodySettings, CheckSettings

CHECKS = CheckSettings()


def damaged(body, where, labeled=False):
    """Return the body without the voxels of a mask, some of which have other labels."""
    tissue = np.where(where, 0, body.tissue).astype(np.uint8)
    inside = body.inside & ~where
    empty = (tissue == 0) & ~body.interior & ~labeled
    gap = fill_slits(tissue, inside, empty, body.affine, BodySettings()).gap
    return replace(body, tissue=tissue, inside=inside, gap=gap)


def reasons(body, settings=CHECKS):
    return {found.reason for found in check_labels(body, settings) if found.raised}


def test_sound_labels_have_no_flags(case):
    assert reasons(case.body) == set()


@pytest.mark.parametrize(("share", "wanted"), [(0.002, set()), (0.05, {"noisy-labels"})])
def test_single_voxels_without_a_label_are_noise(arc, share, wanted):
    flips = np.random.default_rng(3).random(arc.body.tissue.shape) < share
    assert reasons(damaged(arc.body, flips)) & {"noisy-labels"} == wanted


def voxels_near_plane(body, normal, width):
    """Voxels within half a width (mm) of a plane through the middle of the body."""
    points = np.indices(body.tissue.shape).reshape(3, -1).T @ body.affine[:3, :3].T
    points = (points + body.affine[:3, 3]).reshape(*body.tissue.shape, 3)
    middle = body.inside_points()[1].mean(axis=0)
    return np.abs((points - middle) @ normal) < width / 2, middle


def test_a_missing_slice_is_a_gap_and_leaves_a_loose_part(arc):
    where, middle = voxels_near_plane(arc.body, arc.body.ends.axis, 0.45)
    found = check_labels(damaged(arc.body, where), CHECKS)
    points = {finding.reason: finding.points for finding in found if finding.raised}
    assert set(points) == {"thin-gap", "loose-part"}
    position = points["thin-gap"].mean(axis=0)
    assert abs((position - middle) @ arc.body.ends.axis) < 0.4  # mm, a voxel


def test_a_gap_of_two_voxels_is_loose_but_not_thin(arc):
    """Nothing lies between two labeled voxels there; the later steps see such a gap."""
    where, _ = voxels_near_plane(arc.body, arc.body.ends.axis, 1.3)
    assert reasons(damaged(arc.body, where)) == {"loose-part"}


def test_gaps_filled_by_other_labels_are_none(arc):
    where, _ = voxels_near_plane(arc.body, arc.body.ends.axis, 0.45)
    body = damaged(arc.body, where, labeled=where)
    assert reasons(body) == {"loose-part"}


@pytest.mark.parametrize("limit", [{"flag_gap": 999}, {"flag_loose_part": 0.9}])
def test_limits_are_the_settings(arc, limit):
    where, _ = voxels_near_plane(arc.body, arc.body.ends.axis, 0.45)
    assert len(reasons(damaged(arc.body, where), CheckSettings(**limit))) == 1


def test_the_volume_of_the_uncus_is_told(arc):
    uncus = np.tile(np.argwhere(arc.body.tissue)[:1], (400, 1))
    (text,) = describe_uncus(replace(arc.body, uncus=uncus), CHECKS)
    assert text.startswith(f"the uncus was excluded, {400 * arc.body.voxel_volume:.0f} mm3 at ")


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_slices_along_the_axis_count_by_their_distance(arc, axis):
    affine = np.diag([0.5, 0.5, 0.5, 1.0])
    assert checks.voxel_across(replace(arc.body, affine=affine)) == 0.5
    affine[axis, axis] = 2.0
    body = replace(arc.body, affine=affine)
    assert checks.voxel_across(body) == (0.5 if cut_across(body) else 2.0)


def test_pinholes_have_the_sheet_on_five_or_six_sides():
    """Of a block of 6 x 6 x 6 voxels: inside, in a face, and in an edge; and a loose corner."""
    tissue = np.zeros((9, 9, 9), dtype=np.uint8)
    tissue[1:7, 1:7, 1:7] = 3
    tissue[3, 3, 3] = tissue[1, 4, 4] = tissue[1, 1, 3] = 0
    tissue[7, 7, 7] = 3
    noise, gap, loose = check_labels(plain_body(tissue, np.eye(4), straight_ends(9.0)), CHECKS)
    assert sorted(noise.points.tolist()) == [[1, 4, 4], [3, 3, 3]]
    assert (gap.value, loose.points.tolist()) == (0, [[7, 7, 7]])
    assert (noise.value, loose.value) == pytest.approx((2 / 214, 1 / 214))
