"""Visits of a participant on one sheet: phantoms with planted change, new poses and voxels."""

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hipsta_bids.errors import GeometryError
from hipsta_bids.extensions.visits.common import (
    check_alone,
    find_common,
    make_frame,
    measure_placed,
    place_visit,
)
from hipsta_bids.participant.measure import measure_hemisphere
from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.settings import Settings
from hipsta_bids.types import Decision, GivenEnd

SPEC = PhantomSpec(kind="spiral", variation=0.1, bend=0.02, length=14.0)


def pose(degrees=(0, 0, 0), shift=(0, 0, 0)):
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
    motion[:3, 3] = shift
    return motion


POSES = (pose(), pose((6, -4, 3), (2.2, -1.1, 0.4)), pose((-3, 5, -7), (-1.3, 2.7, 1.9)))


def draw(spec, motion, hemi="L"):
    return Phantom(spec).label_volume(
        load_protocol("freesurfer"), voxel_size=(0.4,) * 3, pose=motion, hemi=hemi
    )


def clock(_stage):
    return nullcontext()


def measure_one(frame, number, volume, hemi):
    placed = place_visit(frame, number, volume, hemi, clock)
    return measure_placed(frame, frame.motions[number], volume, placed, clock)


def measure(volumes, hemi="L", *, shared=False):
    settings = Settings()
    frame = make_frame(volumes, hemi, settings, clock, shared=shared)
    return frame, [
        measure_one(frame, number, volume, hemi) for number, volume in enumerate(volumes)
    ]


def rms(values):
    return float(np.sqrt(np.mean(values**2)))


@pytest.fixture(scope="module")
def thinning():
    """Three visits, of which each is 0.1 mm thinner than the one before."""
    return [draw(replace(SPEC, thickness=2.0 - 0.1 * number), POSES[number]) for number in range(3)]


@pytest.fixture(scope="module")
def measured(thinning):
    return measure(thinning)


def test_planted_thinning_is_measured(measured):
    _, maps = measured
    means = [visit.thickness.mean() for visit in maps]
    # A twentieth of the change; drawing in voxels leaves a hundredth of a millimeter.
    assert np.diff(means) == pytest.approx(-0.1, abs=0.012)
    change = maps[2].thickness - maps[0].thickness
    assert np.median(change) == pytest.approx(-0.2, abs=0.02)


def test_thickness_is_at_the_level_of_a_visit_alone(measured, thinning):
    _, maps = measured
    single = measure_hemisphere(thinning[0], "L", Settings(), clock)
    assert maps[0].thickness.mean() == pytest.approx(single.thickness.mean(), abs=0.02)
    assert maps[0].summary.keys() == single.summary.keys()
    assert maps[0].maps.keys() == single.maps.keys()
    # Of the mean of three visits, the edges are rounder.
    for name in ("volume", "area_mid", "extent_x", "extent_y"):
        assert maps[1].summary[name] == pytest.approx(single.summary[name], rel=0.06)


def test_volume_changes_as_thickness_does(measured):
    _, maps = measured
    volumes = np.array([visit.summary["volume"] for visit in maps])
    means = np.array([visit.summary["thickness_mean"] for visit in maps])
    assert volumes / volumes[0] == pytest.approx(means / means[0], rel=0.02)


def test_edges_of_a_visit_are_its_own():
    """The lateral edge recedes: extent, area and volume fall, the rest of the map stays."""
    width = 18.0
    visits = [draw(replace(SPEC, width=w), POSES[n]) for n, w in enumerate((width, width - 1.0))]
    _, (first, second) = measure(visits)
    for name in ("extent_x", "area_mid", "volume"):
        change = second.summary[name] / first.summary[name] - 1
        assert change == pytest.approx(-1.0 / width, rel=0.2)
    assert np.median(second.thickness - first.thickness) == pytest.approx(0.0, abs=0.01)


def test_subfields_and_ends_are_the_same_at_all_visits(measured):
    frame, maps = measured
    for visit in maps[1:]:
        assert np.array_equal(visit.subfield, maps[0].subfield)
    for visit, motion in zip(maps, frame.motions, strict=True):
        assert visit.qc["posterior_end_rule"] == visit.qc["anterior_end_rule"] == "labels"
        points = visit.sheet.points @ np.linalg.inv(motion)[:3, :3].T + np.linalg.inv(motion)[:3, 3]
        # Walls differ, the columns are the same.
        middle = points[:, :, visit.sheet.middle] - frame.evidence.sheet.points[:, :, 4]
        assert rms(np.linalg.norm(middle, axis=-1)) < 0.1


def test_the_order_of_the_visits_does_not_matter(measured, thinning):
    _, maps = measured
    _, backward = measure(thinning[::-1])
    for visit, same in zip(maps, backward[::-1], strict=True):
        assert np.array_equal(visit.thickness, same.thickness)


def test_the_same_visit_twice_has_no_change(thinning):
    _, (first, second) = measure([thinning[0], thinning[0]])
    assert np.array_equal(first.thickness, second.thickness)


def test_a_visit_that_was_moved_has_no_change(thinning):
    volume = thinning[0]
    moved = replace(volume, affine=pose((20, 0, 0), (0, 20, 0)) @ volume.affine)
    _, (first, second) = measure([volume, moved])
    assert rms(first.thickness - second.thickness) < 0.02


def test_visits_that_share_a_space_are_not_aligned(thinning):
    frame, _ = measure([thinning[0], thinning[0]], shared=True)
    assert np.array_equal(frame.motions[0], frame.motions[1])


def test_one_visit_has_a_sheet_of_its_own_labels(thinning):
    _, (maps,) = measure([thinning[0]])
    assert maps.thickness.mean() == pytest.approx(1.98, abs=0.05)
    assert maps.decision is Decision.USE


def test_right_hemispheres_mirror_left_ones():
    visits = [draw(SPEC, POSES[number], "R") for number in (0, 1)]
    _, maps = measure(visits, "R")
    assert maps[0].thickness.mean() == pytest.approx(1.98, abs=0.05)


def test_another_body_among_the_visits_is_not_accepted(thinning):
    stranger = draw(PhantomSpec(kind="tight", thickness=1.4, width=16.0), POSES[1])
    frame = make_frame([*thinning[:2], stranger], "L", Settings(), clock, shared=False)
    try:
        maps = measure_one(frame, 2, stranger, "L")
    except GeometryError as error:
        assert error.reason == "visit-unlike"  # noqa: PT017 -- either is right
    else:
        assert "visits-differ" in {flag.reason for flag in maps.flags}


STRANGER = PhantomSpec(kind="s-shape", thickness=2.4, width=13.0, length=14.0)


@pytest.mark.parametrize("place", [0, 2])
def test_a_visit_that_is_refused_does_not_enter_the_mean(thinning, place):
    visits = list(thinning[:2])
    visits.insert(place, draw(STRANGER, POSES[1]))
    frame, placed = find_common(visits, "L", Settings(), clock, shared=False)
    assert place not in placed
    assert len(frame.motions) == len(placed) == 2
    expected, _ = find_common(thinning[:2], "L", Settings(), clock, shared=False)
    assert np.array_equal(frame.evidence.sheet.points, expected.evidence.sheet.points)


def test_visits_that_fit_are_all_on_the_sheet(thinning):
    frame, placed = find_common(thinning, "L", Settings(), clock, shared=False)
    maps = measure_placed(frame, frame.motions[1], thinning[1], placed[1], clock)
    assert np.array_equal(maps.thickness, measure(thinning)[1][1].thickness)


def test_labels_that_cannot_be_measured_are_refused_before_the_mean(thinning):
    volume = thinning[0]
    mirrored = np.diag([-1.0, 1, 1, 1]) @ volume.affine
    with pytest.raises(GeometryError) as caught:
        check_alone(replace(volume, affine=mirrored), "L", Settings())
    assert caught.value.reason == "left-right-swapped"
    check_alone(volume, "L", Settings())


def test_planes_placed_by_hand_hold_for_all_visits(thinning):
    frame = make_frame(thinning[:1], "L", Settings(), clock, shared=False)
    (plane, _) = frame.ends(frame.motions[0])
    point = np.array(plane.point) + 2 * np.array(plane.normal)
    moved_end = GivenEnd(end="posterior", point=tuple(point.tolist()), normal=plane.normal)
    _, maps = measure([replace(thinning[0], given_ends=(moved_end,)), thinning[1]])
    _, before = measure(thinning[:2])
    for visit, longer in zip(maps, before, strict=True):
        short = longer.qc["body_length_mm"] - visit.qc["body_length_mm"]
        # The direction of the plane is fitted anew without a user's.
        assert short == pytest.approx(2.0, abs=0.4)
