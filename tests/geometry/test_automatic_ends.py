"""Ends without labels: where they are drawn, however voxels lie; how sure; and a user's planes."""

from dataclasses import replace

import numpy as np
import pytest
from geometry_cases import degrees_between, rigid, rotation, short_phantom
from scipy import stats
from scipy.special import ndtr

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry import automatic_ends
from hipsta_bids.geometry.body import extract_body
from hipsta_bids.geometry.ends import find_end_planes
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Part, Tissue
from hipsta_bids.settings import BodySettings
from hipsta_bids.types import GivenEnd, LabelVolume

HIPPUNFOLD = load_protocol("hippunfold")
BODY = BodySettings()
TAIL, UNCUS = -12.0, 8.0
"""Where the body below begins and ends along y, mm."""


def tissue_at(points):
    """A flat hippocampus along y, from -18 to 18 mm: subiculum, CA1 and CA2 below a dentate gyrus.

    Towards the tail the dentate gyrus gets lower over 4 mm, round where the body begins. In the
    head an uncus of CA2 and dentate gyrus lies medially, and gets higher over 4 mm.
    """
    x, y, z = points.T
    tissue = np.zeros(len(points), dtype=np.uint8)
    sheet = (abs(x) < 8) & (abs(z) < 1) & (abs(y) < 18)
    edges = [-8, -3, 4, 8]
    for kind, low, high in zip((2, 3, 4), edges, edges[1:], strict=False):
        tissue[sheet & (x >= low) & (x < high)] = kind
    height = 3 * np.clip((y - TAIL) / 4 + 0.5, 0, 1)
    core = (x > -1) & (x < 5) & (z >= 1) & (z < 1 + height) & (abs(y) < 18)
    tissue[core] = Tissue.DENTATE_GYRUS
    uncus = 6 * np.clip((y - UNCUS) / 4 + 0.5, 0, 1) * (y < 18)
    tissue[(x > -8) & (x < -3) & (z >= 4) & (z < 4 + uncus)] = Tissue.CA2
    tissue[(x > -8) & (x < -1) & (z >= 4 - 0.5 * uncus) & (z < 4)] = Tissue.DENTATE_GYRUS
    return tissue


def drawn(voxel=(0.4, 0.4, 0.4), shift=0.0, tilt=(0.0, 0.0), mirror=False):
    """Its labels on a grid that is shifted by a share of a voxel along y, and tilted, degrees."""
    edges = rotation(0, tilt[0]) @ rotation(2, tilt[1]) * voxel
    half = np.ceil([13.0, 22.0, 14.0] / np.array(voxel)).astype(int)
    index = np.indices(2 * half).reshape(3, -1).T
    affine = np.eye(4)
    affine[:3, :3] = edges
    affine[:3, 3] = edges @ (np.array([0.03, shift, 0.04]) - half)
    points = index @ edges.T + affine[:3, 3]
    if mirror:
        affine = np.diag([-1.0, 1, 1, 1]) @ affine
    tissue = tissue_at(points).reshape(2 * half)
    return LabelVolume(
        tissue=tissue, part=np.zeros_like(tissue), affine=affine, protocol=HIPPUNFOLD
    )


def ends_of(volume, settings=BODY):
    sheet = np.where(np.isin(volume.tissue, (2, 3, 4)), volume.tissue, 0).astype(np.uint8)
    return find_end_planes(volume, sheet, settings)


def places(volume):
    """Where the end planes cross the middle of the body, mm along y."""
    ends = ends_of(volume)
    middle = np.array([[0.0, 0.0, 0.5]])
    return [
        float(-ends.height(middle, end)[0] / ends[end].normal[1])
        for end in ("posterior", "anterior")
    ]


def test_ends_lie_where_the_dentate_gyrus_and_the_uncus_begin():
    ends = ends_of(drawn())
    assert (ends.posterior.rule, ends.anterior.rule) == ("core", "cross-section")
    # The long axis leans towards the uncus.
    np.testing.assert_allclose(places(drawn()), [TAIL, UNCUS], atol=0.6)


@pytest.mark.parametrize("slice_mm", [1.0, 2.0])
def test_half_a_slice_moves_no_end_by_half_a_slice(slice_mm):
    found = [places(drawn((0.4, slice_mm, 0.4), shift)) for shift in (0.0, 0.25, 0.5, 0.75)]
    assert np.ptp(found, axis=0).max() < 0.3 * slice_mm
    np.testing.assert_allclose(np.mean(found, axis=0), places(drawn()), atol=0.2 * slice_mm)


@pytest.mark.parametrize("tilt", [(8.0, 0.0), (-8.0, 0.0), (0.0, 8.0), (0.0, -8.0)])
def test_a_tilt_of_the_slices_moves_no_end(tilt):
    moved = np.subtract(places(drawn((0.4, 2.0, 0.4), tilt=tilt)), places(drawn()))
    assert np.abs(moved).max() < 0.6


def test_ends_move_with_the_volume_and_with_its_mirror_image():
    volume, pose = drawn((0.4, 2.0, 0.4)), rigid()
    here, there = ends_of(volume), ends_of(replace(volume, affine=pose @ volume.affine))
    image = ends_of(drawn((0.4, 2.0, 0.4), mirror=True))
    flip = np.diag([-1.0, 1.0, 1.0])
    for end in ("posterior", "anterior"):
        point, normal = here[end].point, here[end].normal
        moved = (pose[:3, :3] @ point + pose[:3, 3])[None]
        assert abs(there.height(moved, end)[0]) < 1e-8
        np.testing.assert_allclose(there[end].normal, pose[:3, :3] @ normal)
        assert abs(image.height((flip @ point)[None], end)[0]) < 1e-8


@pytest.mark.parametrize("shift", [0.0, 0.5])
def test_phantom_ends_are_found_in_thick_slices(shift):
    """CA2 and CA3 are drawn in the body alone, 14 mm long."""
    phantom = short_phantom(length=14.0)
    pose = np.eye(4)
    pose[1, 3] = 2.0 * shift
    volume = phantom.label_volume(HIPPUNFOLD, voxel_size=(0.4, 2.0, 0.4), pose=pose)
    ends = extract_body(volume, BODY).ends
    assert ends.posterior.uncertainty < 0.5
    assert ends.anterior.uncertainty < 0.5
    u = np.linspace(0.1, 0.9, 9)
    for end, v in (("posterior", 0.0), ("anterior", 1.0)):
        plane = phantom.body.place(u, v, 0.0) + pose[:3, 3]
        assert abs(ends.height(plane, end).mean()) < 0.5


def test_an_oblique_plane_of_the_tail_leaves_the_head_alone():
    """Tail labels that end at 31 degrees."""
    volume = drawn()
    index = np.moveaxis(np.indices(volume.tissue.shape), 0, -1)
    x, y, _ = np.moveaxis(index @ volume.affine[:3, :3].T + volume.affine[:3, 3], -1, 0)
    part = np.where((volume.tissue > 0) & (y < TAIL + 0.6 * x), Part.TAIL, Part.UNKNOWN)
    ends = ends_of(replace(volume, part=part))
    assert (ends.posterior.rule, ends.anterior.rule) == ("labels", "cross-section")
    assert degrees_between(ends.posterior.normal, [-0.6, 1.0, 0.0]) < 3.0
    # The body's own axis leans a little towards the uncus.
    assert degrees_between(ends.anterior.normal, [0.0, 1.0, 0.0]) < 12.0
    assert abs(ends.height(np.array([[0.0, UNCUS, 0.5]]), "anterior")[0]) < 0.8


def test_an_end_is_less_certain_where_the_cues_differ():
    """The dentate gyrus spreads from 3 mm behind the uncus on."""
    volume = drawn()
    x, y, z = np.moveaxis(np.indices(volume.tissue.shape), 0, -1).reshape(-1, 3).T
    points = np.stack([x, y, z], axis=-1) @ volume.affine[:3, :3].T + volume.affine[:3, 3]
    early = (
        (points[:, 0] > -8)
        & (points[:, 0] <= -1)
        & (points[:, 2] >= 1)
        & (points[:, 2] < 3)
        & (points[:, 1] > UNCUS - 6)
        & (points[:, 1] < 18)
    ).reshape(volume.tissue.shape)
    tissue = np.where(early, np.uint8(Tissue.DENTATE_GYRUS), volume.tissue)
    sure, unsure = ends_of(volume), ends_of(replace(volume, tissue=tissue))
    assert sure.anterior.uncertainty < 1.0
    assert unsure.anterior.uncertainty > sure.anterior.uncertainty + 0.5
    assert unsure.posterior.uncertainty < 0.5
    # It moves towards that, and not all the way.
    moved = places(replace(volume, tissue=tissue))[1] - places(volume)[1]
    assert -5.5 < moved < -0.5


def test_a_users_plane_goes_before_what_is_found():
    volume = drawn()
    point, normal = (0.0, 4.0, 0.5), (0.1, -1.0, 0.0)
    plain = ends_of(volume)
    given = replace(volume, given_ends=(GivenEnd(end="anterior", point=point, normal=normal),))
    ends = ends_of(given)
    assert (ends.posterior.rule, ends.anterior.rule) == (plain.posterior.rule, "user")
    assert ends.anterior.uncertainty == 0.0
    assert abs(ends.height(np.array([point]), "anterior")[0]) < 1e-9
    np.testing.assert_allclose(ends.anterior.normal, -np.array(normal) / np.linalg.norm(normal))
    moved = replace(given, given_ends=(GivenEnd(end="anterior", point=point),))
    np.testing.assert_allclose(ends_of(moved).anterior.normal, plain.anterior.normal)


def test_a_users_plane_goes_before_labels(arc):
    plain = arc.body.ends
    point = plain.anterior.point - 1.5 * plain.axis
    given = (GivenEnd(end="anterior", point=tuple(point)),)
    ends = extract_body(replace(arc.volume, given_ends=given), BODY).ends
    assert (ends.posterior.rule, ends.anterior.rule) == ("labels", "user")
    np.testing.assert_allclose(ends.anterior.point, point)
    np.testing.assert_allclose(ends.anterior.normal, plain.anterior.normal)
    np.testing.assert_allclose(ends.posterior.point, plain.posterior.point)


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        (GivenEnd(end="anterior", point=(60.0, 8.0, 0.0)), "given-end-outside"),
        (
            GivenEnd(end="anterior", point=(0.0, 8.0, 0.0), normal=(1.0, 0.2, 0.0)),
            "end-plane-tilted",
        ),
    ],
)
def test_impossible_planes_are_refused(given, reason):
    with pytest.raises(GeometryError, match="the given anterior end") as caught:
        ends_of(replace(drawn((0.8, 0.8, 0.8)), given_ends=(given,)))
    assert caught.value.reason == reason


@pytest.mark.parametrize("voxel", [(0.4, 0.4, 0.4), (0.4, 2.0, 0.4)])
@pytest.mark.parametrize("tilt", [(0.0, 0.0), (8.0, 0.0)])
def test_the_published_rule_takes_the_last_slices(voxel, tilt):
    """Posteriorly those with CA1 and CA2, anteriorly those with CA2; here from -15 to 11 mm."""
    volume = drawn(voxel, tilt=tilt)
    y = np.tensordot(volume.affine[1, :3], np.indices(volume.tissue.shape), 1)
    y += volume.affine[1, 3]
    gone = ((volume.tissue == Tissue.CA1) & (y < -15)) | ((volume.tissue == Tissue.CA2) & (y > 11))
    volume = replace(volume, tissue=np.where(gone, 0, volume.tissue))
    ends = ends_of(volume, BodySettings(end_rule="last-slice"))
    middle = np.array([[0.0, 0.0, 0.5]])
    # A slice, and what tilted slices and planes reach along y over 16 mm.
    lean = tilt[0] + degrees_between(ends.axis, [0.0, 1.0, 0.0])
    reach = voxel[1] + 8 * np.sin(np.radians(lean))
    for end, place in (("posterior", -15.0), ("anterior", 11.0)):
        assert ends[end].rule == "last-slice"
        found = float(-ends.height(middle, end)[0] / ends[end].normal[1])
        assert found == pytest.approx(place, abs=reach)
        assert abs(found - places(volume)[end == "anterior"]) > 1.0  # graded evidence differs


def test_the_published_rule_needs_a_slice_of_the_body():
    volume = drawn()
    volume = replace(volume, tissue=np.where(volume.tissue == Tissue.CA1, 0, volume.tissue))
    with pytest.raises(GeometryError, match="no slice has both CA1 and CA2/CA3"):
        ends_of(volume, BodySettings(end_rule="last-slice"))


def test_profiles_of_a_box_have_its_area_and_spread():
    """8 x 3 mm in slices of 1.2 mm; half is left at the ends, which the Gaussian blurs."""
    tissue = np.zeros((30, 20, 20), dtype=np.uint8)
    tissue[5:25, 2:18, 4:14] = Tissue.CA1
    turn = rotation(0, 25) @ rotation(2, 40)
    affine = np.eye(4)
    affine[:3, :3] = turn * [0.4, 1.2, 0.3]
    volume = LabelVolume(tissue=tissue, part=tissue * 0, affine=affine, protocol=HIPPUNFOLD)
    levels, area, spread = automatic_ends._profile(volume, tissue, turn[:, 1])
    inner = np.abs(levels - 9.5 * 1.2) < 5
    np.testing.assert_allclose(area["CA1"][inner], 8 * 3, rtol=3e-3)
    expected = np.sqrt((0.4**2 * (20**2 - 1) + 0.3**2 * (10**2 - 1)) / 12)
    np.testing.assert_allclose(spread["CA1"][inner], expected, rtol=1e-3)
    ends = np.interp([1.5 * 1.2, 17.5 * 1.2], levels, area["sheet"])
    np.testing.assert_allclose(ends, 12, rtol=0.02)
    assert area["sheet"].sum() * 0.25 == pytest.approx(8 * 3 * 16 * 1.2, rel=1e-3)
    assert np.average(levels, weights=area["core"] + area["CA1"]) == pytest.approx(9.5 * 1.2)


@pytest.mark.parametrize("ramp", [0.0, 1.5])
def test_sections_with_a_part_of_the_labels_are_left_out_beyond_what_smoothing_takes(ramp):
    """Shares of 0.9 and more are whole; the loss grows from 0 to 1 below that."""
    depth = np.arange(-16, 40) * 0.25
    area = 30 * (np.clip(depth / ramp, 0, 1) if ramp else ndtr(depth))
    lost = automatic_ends._grazed(depth, area, (depth < 0) * 1.0, BODY)
    fine = np.arange(0.125, 3, 0.25)
    blurred = np.clip((0.9 - ndtr(fine)) / 0.1, 0, 1).sum() * 0.25
    grazed = np.clip((0.9 - fine / (ramp or 1e-9)) / 0.1, 0, 1).sum() * 0.25
    assert lost == pytest.approx(max(grazed - blurred, 0), abs=0.02)
    assert lost * 0.5 == automatic_ends._grazed(depth, area, (depth < 0) * 0.5, BODY)


def test_errors_of_means_that_leave_out_one_value_are_standard_errors():
    values = np.array([3.0, 4.5, -1.0, 7.0])
    means = [float(np.delete(values, left).mean()) for left in range(4)]
    assert automatic_ends._jackknife_error(means) == pytest.approx(stats.sem(values))
    assert automatic_ends._jackknife_error(means[:1]) == automatic_ends._jackknife_error([]) == 0


def test_levels_have_a_subfield_with_a_fifth_of_its_usual_area():
    area = {
        "CA1": np.array([0.05, 3, 10, 10, 10, 1, 0]),
        "CA2-3": np.array([9.0, 9, 9, 9, 1, 9, 9]),
    }
    profile = automatic_ends._Profile(np.arange(7.0), area, {})
    assert automatic_ends._has_subfields(profile).tolist() == [False, *[True] * 3, *[False] * 3]
