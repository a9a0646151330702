"""End planes: fitted to labels, found by the automatic rule, refused where they make no sense."""

import numpy as np
import pytest
from geometry_cases import degrees_between, rigid, rotation, short_phantom

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry import automatic_ends
from hipsta_bids.geometry import ends as ends_mod
from hipsta_bids.geometry import ends as geometry_ends
from hipsta_bids.geometry.body import extract_body
from hipsta_bids.geometry.ends import PLANE_TILT, find_end_planes
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Part, Tissue
from hipsta_bids.settings import BodySettings
from hipsta_bids.types import LabelVolume

FREESURFER, HIPPUNFOLD = load_protocol("freesurfer"), load_protocol("hippunfold")
BODY = BodySettings()


def rod(tail_normal, head_normal, *, voxel=(0.4, 0.4, 0.4), half_body=8.2, pose=None):
    """A rod along +y of 18 x 34 x 14 mm; tail and head begin at planes with these normals."""
    shape = tuple(int(np.ceil(n / v)) for n, v in zip((18.0, 34.0, 14.0), voxel, strict=True))
    index = np.indices(shape).reshape(3, -1).T
    points = (index - (np.array(shape) - 1) / 2) * voxel
    offset = [0.0, half_body, 0.0]
    part = np.full(len(points), Part.BODY)
    part[(points + offset) @ tail_normal < 0] = Part.TAIL
    part[(points - offset) @ head_normal > 0] = Part.HEAD
    affine = np.diag([*voxel, 1.0])
    affine[:3, 3] = -(np.array(shape) - 1) / 2 * voxel
    return LabelVolume(
        tissue=np.full(shape, Tissue.CA1),
        part=part.reshape(shape),
        affine=affine if pose is None else pose @ affine,
        protocol=FREESURFER,
    )


def ends_of(volume, settings=BODY):
    return find_end_planes(volume, volume.tissue, settings)


@pytest.mark.parametrize("slice_mm", [0.4, 1.0, 2.0])
@pytest.mark.parametrize(
    ("tail", "head"), [((0, 0), (0, 0)), ((12, 8), (-10, 5)), ((-20, 10), (0, 25))]
)
def test_planar_interfaces_are_found(tail, head, slice_mm):
    normals = [rotation(0, a) @ rotation(2, b) @ [0.0, 1.0, 0.0] for a, b in (tail, head)]
    ends = ends_of(rod(*normals, voxel=(0.4, slice_mm, 0.4)))
    assert ends.posterior.rule == ends.anterior.rule == "labels"
    # The study behind the rule found 1.3 degrees at slices of 2 mm.
    assert degrees_between(ends.posterior.normal, normals[0]) < 1.5
    assert degrees_between(ends.anterior.normal, normals[1]) < 1.5
    # Labels by voxel center say nothing about the place within half a slice.
    middle = np.array([[0.0, -8.2, 0.0], [0.0, 8.2, 0.0]])
    assert abs(ends.height(middle[:1], "posterior")[0]) < 0.5 * slice_mm
    assert abs(ends.height(middle[1:], "anterior")[0]) < 0.5 * slice_mm


def test_a_tilt_of_one_step_between_thick_slices_is_found_roughly():
    normal = rotation(0, 15) @ [0.0, 1.0, 0.0]
    ends = ends_of(rod(normal, normal, voxel=(0.4, 2.0, 0.4)))
    # 14 mm times tan(15 degrees) is less than two slices: the labels show a step or two only.
    assert degrees_between(ends.posterior.normal, normal) < 3.0
    assert degrees_between(ends.anterior.normal, normal) < 3.0


@pytest.mark.parametrize("share", [0.15, 0.5, 0.85])
def test_one_slice_with_labels_of_both_sides_tilts_the_plane_little(share, monkeypatch):
    """It allows for any tilt up to that from its edge to the far edge of the next slice."""
    volume = rod([0, 1, 0], [0, 1, 0], voxel=(0.4, 2.0, 0.4))
    part = volume.part.copy()
    first = int(np.flatnonzero((part == Part.BODY).any(axis=(0, 2)))[0])
    part[: int(share * part.shape[0]), first] = Part.TAIL
    mixed = LabelVolume(
        tissue=volume.tissue, part=part, affine=volume.affine, protocol=volume.protocol
    )
    along = np.array([0.0, 1.0, 0.0])
    assert degrees_between(ends_of(mixed).posterior.normal, along) < PLANE_TILT
    # The plane goes through that slice, within half of its thickness.
    level = volume.affine[1, 1] * first + volume.affine[1, 3]
    assert abs(ends_of(mixed).posterior.point @ along - level) < 1.0
    if share == 0.5:  # where it allows for most, the plane keeps to the slices
        tilt = degrees_between(ends_of(mixed).posterior.normal, along)
        monkeypatch.setattr(geometry_ends, "PLANE_PRIOR", 1e-4)
        free = ends_of(mixed).posterior.normal
        assert degrees_between(free, along) > 1.2 * tilt


def test_planes_move_with_the_volume():
    pose = rigid(degrees=(10.0, 20.0, -30.0))
    normals = [rotation(0, 15) @ [0.0, 1.0, 0.0], rotation(2, -10) @ [0.0, 1.0, 0.0]]
    still, moved = ends_of(rod(*normals)), ends_of(rod(*normals, pose=pose))
    for end in ("posterior", "anterior"):
        turned = pose[:3, :3] @ still[end].normal
        # The same voxels in another place: only rounding and where Newton's steps end differ.
        np.testing.assert_allclose(moved[end].normal, turned, atol=1e-4)


def test_normals_and_axis_point_from_tail_to_head():
    volume = rod([0.0, 1.0, 0.0], [0.0, 1.0, 0.0])
    backward = LabelVolume(
        tissue=volume.tissue, part=volume.part[:, ::-1], affine=volume.affine, protocol=FREESURFER
    )
    assert ends_of(volume).axis[1] > 0.99  # the axis itself, but for rounding
    assert ends_of(backward).axis[1] < -0.99


def test_heights_and_length():
    ends = ends_of(rod([0.0, 1.0, 0.0], [0.0, 1.0, 0.0]))
    points = np.array([[0.0, 0.0, 0.0], [1.0, 3.0, -1.0]])
    # The interface lies midway between voxel centers; the widest margin is what the fit seeks.
    np.testing.assert_allclose(ends.height(points, "posterior"), [8.2, 11.2], atol=0.02)
    np.testing.assert_allclose(ends.height(points, "anterior"), [-8.2, -5.2], atol=0.02)
    assert ends.length(points) == pytest.approx(16.4, abs=0.04)  # both ends
    assert ends.half_slice == pytest.approx(0.2, abs=1e-2)  # half of 0.4 mm


def test_phantom_ends_are_where_they_were_drawn(case):
    hemi = "L" if case.phantom.spec.kind != "spiral" else "R"
    for end, v in (("posterior", 0.0), ("anterior", 1.0)):
        plane = case.phantom.body.place(np.linspace(0.1, 0.9, 9), v, 0.0, hemi=hemi)
        # A voxel is 0.4 mm; half of it.
        assert np.abs(case.body.ends.height(plane, end)).max() < 0.2


@pytest.mark.parametrize("protocol", ["ashsPMC", "hippunfold"])
@pytest.mark.parametrize("slice_mm", [0.4, 1.0])
def test_rule_of_the_paper_finds_the_body_without_head_and_tail_labels(protocol, slice_mm):
    phantom = short_phantom(length=14.0)
    volume = phantom.label_volume(load_protocol(protocol), voxel_size=(0.4, slice_mm, 0.4))
    body = extract_body(volume, BODY)
    assert "labels" not in (body.ends.posterior.rule, body.ends.anterior.rule)
    u = np.linspace(0.1, 0.9, 9)
    for end, v in (("posterior", 0.0), ("anterior", 1.0)):
        height = body.ends.height(phantom.body.place(u, v, 0.0), end)
        # To the slice, and the principal axis of a bent body leans a little against its sweep.
        assert abs(height.mean()) < 0.75 * slice_mm + 0.4


def test_end_margin_shortens_the_body_at_both_ends():
    volume = short_phantom(length=14.0).label_volume(HIPPUNFOLD)
    whole = extract_body(volume, BODY).ends
    less = extract_body(volume, BodySettings(end_margin=1.5)).ends
    point = np.zeros((1, 3))
    assert whole.height(point, "posterior") - less.height(point, "posterior") == pytest.approx(1.5)
    assert less.height(point, "anterior") - whole.height(point, "anterior") == pytest.approx(1.5)


def test_end_margin_leaves_labelled_ends_alone(arc):
    less = extract_body(arc.volume, BodySettings(end_margin=1.5)).ends
    np.testing.assert_array_equal(less.posterior.point, arc.body.ends.posterior.point)
    np.testing.assert_array_equal(less.anterior.point, arc.body.ends.anterior.point)


def without(volume, part):
    """The same labels with one part's name taken away."""
    return LabelVolume(
        tissue=volume.tissue,
        part=np.where(volume.part == part, Part.BODY, volume.part),
        affine=volume.affine,
        protocol=volume.protocol,
    )


@pytest.mark.parametrize(("lost", "kept"), [(Part.HEAD, "posterior"), (Part.TAIL, "anterior")])
def test_an_end_without_labels_is_cut_across_the_body(arc, lost, kept):
    """Planes of labels may be oblique, which says nothing about the other end."""
    ends = extract_body(without(arc.volume, lost), BODY).ends
    other = "anterior" if kept == "posterior" else "posterior"
    of_labels = arc.body.ends[kept]
    np.testing.assert_allclose(ends[kept].point, of_labels.point, atol=1e-9)
    np.testing.assert_allclose(ends[kept].normal, of_labels.normal, atol=1e-9)
    first, last = (arc.phantom.body.place(np.array([0.5]), v, 0.0)[0] for v in (0.0, 1.0))
    assert degrees_between(last - first, ends[other].normal) < 5.0
    assert ends[kept].rule == "labels"
    assert ends[other].rule != "labels"


def test_few_head_voxels_count_as_none(arc):
    head = np.argwhere(arc.volume.part == Part.HEAD)
    part = arc.volume.part.copy()
    part[tuple(head[49:].T)] = Part.BODY
    volume = LabelVolume(
        tissue=arc.volume.tissue, part=part, affine=arc.volume.affine, protocol=FREESURFER
    )
    assert extract_body(volume, BODY).ends.anterior.rule != "labels"


def sheet_with_head(*, twofold):
    """A slab along +y, CA1 beside CA2, that changes its cross-section from y = 20 mm on."""
    shape = (40, 64, 30)  # 0.5 mm voxels: 20 x 32 x 15 mm
    tissue = np.zeros(shape, dtype=np.uint8)
    tissue[4:24, :, 12:16] = Tissue.CA1
    tissue[24:34, :, 12:16] = Tissue.CA2
    if twofold:
        tissue[4:34, 40:, 4:8] = Tissue.CA2  # a second layer of the digitations
    else:
        tissue[4:34, 40:, 12:22] = Tissue.CA2  # a swelling
    return LabelVolume(
        tissue=tissue,
        part=np.zeros(shape),
        affine=np.diag([0.5, 0.5, 0.5, 1.0]),
        protocol=HIPPUNFOLD,
    )


@pytest.mark.parametrize("twofold", [True, False])
def test_body_stops_before_the_head_where_ca2_goes_on_into_it(twofold):
    ends = ends_of(sheet_with_head(twofold=twofold))
    assert ends.anterior.rule == "cross-section"
    middle = np.array([[9.5, 19.75, 6.75]])
    # To a slice of 0.5 mm; the principal axis leans towards the asymmetric head by a few degrees.
    assert abs(ends.height(middle, "anterior")[0]) < 1.0


def test_body_stops_before_the_bend_of_the_tail_too():
    volume = sheet_with_head(twofold=True)
    turned = LabelVolume(
        tissue=volume.tissue[:, ::-1],
        part=volume.part,
        affine=volume.affine,
        protocol=HIPPUNFOLD,
    )
    # CA1 beside CA2 everywhere, so that only the second layer tells the tail from the body.
    ends = ends_of(turned)
    assert (ends.posterior.rule, ends.anterior.rule) == ("cross-section", "subfields")
    middle = np.array([[9.5, 11.75, 6.75]])
    assert abs(ends.height(middle, "posterior")[0]) < 1.0  # as above


def test_a_plain_rod_has_no_head_to_stop_at():
    volume = sheet_with_head(twofold=True)
    tissue = volume.tissue.copy()
    tissue[:, :, :12] = 0
    ends = ends_of(
        LabelVolume(tissue=tissue, part=volume.part, affine=volume.affine, protocol=HIPPUNFOLD)
    )
    assert ends.anterior.rule == "subfields"
    far = np.array([[9.5, 31.5, 6.75]])
    assert abs(ends.height(far, "anterior")[0]) < 0.5 + 1e-6  # half a slice beyond the last center


def ends_round_core(core, *, tail=0, settings=BODY):
    """Ends of a slab along +y, 32 mm, CA1 beside CA2, with dentate gyrus above it.

    ``core`` has the number of its voxels in each slice; the first ``tail`` slices are of the tail.
    """
    volume = sheet_with_head(twofold=True)
    tissue, part = volume.tissue.copy(), volume.part.copy()
    tissue[:, :, :12] = 0
    sheet = tissue.copy()
    for y, count in core.items():
        tissue[5 : 5 + count, y, 17] = Tissue.DENTATE_GYRUS
    part[:, :tail] = Part.TAIL
    drawn = LabelVolume(tissue=tissue, part=part, affine=volume.affine, protocol=HIPPUNFOLD)
    return find_end_planes(drawn, sheet, settings)


def slices(first, end=64, count=20):
    return dict.fromkeys(range(first, end), count)


def posterior_end(ends):
    """Where the posterior plane crosses the middle of the slab, mm from the first voxels."""
    return -ends.height(np.array([[9.5, -0.25, 6.75]]), "posterior")[0]


def test_the_body_ends_where_its_core_vanishes_in_the_tail():
    ends = ends_round_core(slices(12))
    assert (ends.posterior.rule, ends.anterior.rule) == ("core", "subfields")
    # The axis leans by a degree towards the core.
    assert posterior_end(ends) == pytest.approx(12 * 0.5, abs=0.2)


def test_remnants_of_the_core_do_not_count(monkeypatch):
    few, more = (slices(4, 12, count=n) | slices(12) for n in (5, 15))
    # Where the smoothed profile rises from a quarter to all, half is passed 0.4 mm earlier.
    assert posterior_end(ends_round_core(few)) == pytest.approx(12 * 0.5 - 0.4, abs=0.4)
    assert posterior_end(ends_round_core(more)) == pytest.approx(4 * 0.5 + 0.4, abs=0.4)
    # Even odds where there is half of it: the end lies in between, not at either.
    half = ends_round_core(slices(4, 12, count=10) | slices(12))
    assert 4 * 0.5 + 1.0 < posterior_end(half) < 12 * 0.5 - 1.0
    monkeypatch.setattr(automatic_ends, "CORE_SHARE", 0.1)
    assert posterior_end(ends_round_core(few)) == pytest.approx(4 * 0.5, abs=0.4)


@pytest.mark.parametrize("core", [{}, slices(0), slices(0, 50)], ids=["none", "all", "no head"])
def test_nothing_is_taken_off_where_the_labels_begin_with_the_core_or_have_none(core):
    ends = ends_round_core(core)
    front = "core" if len(core) == 50 else "subfields"
    assert (ends.posterior.rule, ends.anterior.rule) == ("subfields", front)
    # A slice that the leaning axis fills in part may go.
    assert -0.1 < posterior_end(ends) < 0.6


def test_labels_of_the_tail_go_before_the_core():
    ends = ends_round_core(slices(16), tail=8)
    assert ends.posterior.rule == "labels"
    assert posterior_end(ends) == pytest.approx(8 * 0.5, abs=0.1)


def test_no_slice_with_ca1_and_ca2_is_refused():
    volume = sheet_with_head(twofold=True)
    tissue = np.where(volume.tissue == Tissue.CA2, Tissue.CA1, volume.tissue)
    with pytest.raises(GeometryError, match="no slice has both CA1 and CA2/CA3") as caught:
        ends_of(
            LabelVolume(tissue=tissue, part=volume.part, affine=volume.affine, protocol=HIPPUNFOLD)
        )
    assert caught.value.reason == "no-body"


def test_an_interface_along_the_body_is_refused():
    steep = rotation(0, 70) @ [0.0, 1.0, 0.0]
    with pytest.raises(
        GeometryError, match=r"end plane near RAS .* is tilted by \d\d degrees"
    ) as caught:
        ends_of(rod([0.0, 1.0, 0.0], steep, half_body=5.0))
    assert caught.value.reason == "end-plane-tilted"


def test_stray_end_labels_do_not_move_the_planes():
    """Tail labels on voxels in the middle of the body: the tail itself decides."""
    plain = rod([0.0, 1.0, 0.0], [0.0, 1.0, 0.0])
    part = plain.part.copy()
    part[:, 41:46] = Part.TAIL
    stray = LabelVolume(
        tissue=plain.tissue, part=part, affine=plain.affine, protocol=plain.protocol
    )
    before, after = ends_of(plain), ends_of(stray)
    np.testing.assert_allclose(after.posterior.normal, before.posterior.normal, atol=1e-6)
    np.testing.assert_allclose(after.posterior.point, before.posterior.point, atol=1e-6)
    np.testing.assert_allclose(after.axis, before.axis, atol=1e-6)


def test_a_body_cut_short_keeps_its_axis():
    """18 mm wide and 12 mm long: the principal axis lies across."""
    whole = rod([0.0, 1.0, 0.0], [0.0, 1.0, 0.0])
    kept = slice(0, 30)  # 12 mm of 34, the first 9 of them tail
    short = LabelVolume(
        tissue=whole.tissue[:, kept],
        part=whole.part[:, kept],
        affine=whole.affine,
        protocol=HIPPUNFOLD,
    )
    assert ends_mod.long_axis(*labeled(short))[1] > 0.99  # the axis itself, but for rounding


def labeled(volume):
    index = np.argwhere(volume.tissue > 0)
    return index @ volume.affine[:3, :3].T + volume.affine[:3, 3], volume.part[volume.tissue > 0]


def test_labels_that_do_not_lead_away_from_their_end_are_refused():
    """The interface of the tail lies along what is left of the body."""
    turned = ends_mod._checked(
        {
            "posterior": ends_mod.EndPlane(np.zeros(3), np.array([0.0, 1.0, 0.0]), "labels"),
            "anterior": ends_mod.EndPlane(np.ones(3), np.array([0.0, 1.0, 0.0]), "subfields"),
        },
        np.array([0.0, 1.0, 0.0]),
        0.2,
    )
    assert turned.axis[1] == pytest.approx(1.0)
    with pytest.raises(GeometryError, match=r"are cut short: the .* end has no labels") as caught:
        ends_mod._checked(
            {
                "posterior": ends_mod.EndPlane(np.zeros(3), np.array([0.5, 0.866, 0.0]), "labels"),
                "anterior": ends_mod.EndPlane(np.ones(3), np.array([0.5, 0.866, 0.0]), "subfields"),
            },
            np.array([0.94, -0.34, 0.0]),  # 80 degrees from the normals
            0.2,
        )
    assert caught.value.reason == "labels-end"


@pytest.mark.parametrize("slope", [0.0, 0.06, 0.1])
def test_cross_sections_that_have_a_part_of_the_labels_only_are_left_out(slope):
    """A slab whose labels end obliquely on both sides."""
    tissue = np.zeros((40, 64, 30), dtype=np.uint8)
    tissue[4:24, :, 12:16] = Tissue.CA1
    tissue[24:34, :, 12:16] = Tissue.CA2
    x, y, _ = np.indices(tissue.shape)
    low, high = 8 + slope * (x - 4), 52 + slope * (x - 4)
    tissue[(y < low) | (y > high)] = 0
    volume = LabelVolume(
        tissue=tissue,
        part=np.zeros(tissue.shape),
        affine=np.diag([0.5, 0.5, 0.5, 1.0]),
        protocol=HIPPUNFOLD,
    )
    ends = ends_of(volume)
    assert (ends.posterior.rule, ends.anterior.rule) == ("subfields", "subfields")
    corners = np.array([[2.0, 0.5 * 8, 6.75], [17.0, 0.5 * (8 + slope * 30), 6.75]])
    # The principal axis leans the other way. Up to a fifth of the cross-section may be missing, 3
    # of 15 mm: less counts in part. And half a slice of 0.5 mm either way.
    steep = slope + ends.axis[0] / ends.axis[1]
    most = 3.0 * steep + 0.25 + 0.05
    assert ends.height(corners, "posterior").max() < most
    corners[:, 1] += 0.5 * 44
    assert ends.height(corners, "anterior").min() > -most
    assert ends.length(corners) > 22.0 - 15.0 * steep - 1.5


def test_rounding_does_not_decide_which_thick_slices_tell_the_plane():
    """Whole slices lie at 1.5 of their distance, where the window of the fit ends."""
    i, j = np.meshgrid(np.arange(20) * 0.4, np.arange(30) * 0.4, indexing="ij")
    flat = np.column_stack([i.ravel(), j.ravel()])
    parts = []
    for z in (-3.0, -1.0, 1.0, 3.0):
        held = flat[:, 0] < 4.0 + (z == 3.0) * (flat[:, 1] - 6.0)  # the farther slice is lopsided
        parts.append(np.column_stack([flat[held], np.full(held.sum(), z)]))
    below, above = np.vstack(parts[:2]), np.vstack(parts[2:])
    step = np.array([0.0, 0.0, 2.0])
    planes = [
        ends_mod._plane_along_slices(below * (1 + shift), above * (1 + shift), step)
        for shift in (-1e-9, 0.0, 1e-9)
    ]
    for point, normal in planes[1:]:
        np.testing.assert_allclose(normal, planes[0][1], atol=1e-7)
        assert abs((point - planes[0][0]) @ normal) < 1e-7
