"""The whole measurement, in memory: phantoms against their truth, and damaged labels."""

import numpy as np
import pytest
from measured_phantoms import (
    LENGTH,
    Damage,
    measure,
    measured,
    middle,
    sheet_coordinates,
    spiral,
)

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.checks import FLAG_REACH, columns_near
from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Part, Tissue
from hipsta_bids.settings import BodySettings, CheckSettings, Settings, SheetSettings
from hipsta_bids.types import Decision

SHAPES = [
    PhantomSpec(kind=kind, thickness=thickness, length=LENGTH)
    for kind, thickness in [
        ("arc", 1.2),
        ("arc", 2.0),
        ("spiral", 2.5),
        ("tight", 1.2),
        ("tight", 2.0),
        ("s-shape", 1.6),
        ("slab", 1.2),
    ]
]


@pytest.fixture(params=SHAPES, ids=lambda spec: f"{spec.kind}-{spec.thickness}")
def case(request):
    return measured(request.param)


@pytest.fixture(scope="module")
def plain():
    return measured(spiral())


@pytest.fixture(scope="module")
def damage(plain):
    return Damage(plain)


def test_thickness_is_that_of_the_phantom(case):
    thickness = case.maps.thickness
    # A thirteenth of a 0.4 mm voxel.
    assert thickness.mean() == pytest.approx(case.truth["thickness_mean"], abs=0.03)
    # What drawing in voxels leaves after smoothing: 0.03 to 0.05 mm.
    assert middle(thickness).std() < 0.06


def test_a_clean_phantom_needs_no_repair(case):
    assert case.maps.repairs == ()
    assert case.maps.flags == ()
    assert case.maps.decision == Decision.USE
    assert case.maps.sheet.valid.all()
    assert case.maps.qc["euler_before"] == 1
    assert case.maps.qc["posterior_end_rule"] == case.maps.qc["anterior_end_rule"] == "labels"
    assert case.maps.qc["side_rule"] == "labels"


def test_columns_at_a_filled_hole_are_marked(plain, damage):
    spec = plain.phantom.spec
    maps = measure(damage.erase(damage.shaft(0.5, 0.5, 0.5)))
    assert maps.repairs
    u, v = np.moveaxis(sheet_coordinates(plain)[..., :2], -1, 0)
    distance = np.hypot((u - 0.5) * spec.width, (v - 0.5) * spec.length)
    # A hole 0.5 mm wide, drawn in 0.4 mm voxels, and half of the 1.2 mm to the next column.
    near = maps.repaired[distance < 0.3]
    assert near.size
    assert near.all()
    assert not maps.repaired[distance > 0.5 + 0.4 + 0.35 + 0.6].any()
    assert maps.qc["repaired_fraction"] == pytest.approx(maps.repaired.mean())
    assert not plain.maps.repaired.any()
    # Filled a little too thin, which is flagged.
    (flag,) = maps.flags
    assert flag.reason == "wall-dent"
    flagged = columns_near(maps.sheet, flag.points, FLAG_REACH)
    assert not maps.doubtful[~maps.repaired & ~flagged].any()
    assert maps.qc["doubtful_fraction"] == pytest.approx(maps.doubtful.mean())
    assert sum(maps.qc["repair_kinds"].values()) == len(maps.repairs)
    assert not plain.maps.doubtful.any()
    assert plain.maps.qc["repaired_change_mm"] == 0


def test_the_sheet_lies_in_the_middle_of_the_wall_from_end_to_end(case):
    u, v, n = np.moveaxis(sheet_coordinates(case), -1, 0)
    error = middle(n)
    assert abs(error.mean()) < 0.04  # mm, a tenth of a voxel
    # mm; half a voxel where the wall runs along the voxels, and a tenth for smoothing's overshoot
    assert np.abs(error[4:-4]).max() < 0.22
    # End planes lie between voxels, so to half a voxel.
    ends = np.stack([middle(v)[:, 0], middle(v)[:, -1] - 1]) * LENGTH
    assert np.abs(ends).max() < 0.2
    # x is no arc length, but medial comes first and the columns are in order.
    assert (np.diff(u, axis=0) > 0).all()
    assert (np.diff(v, axis=1) > 0).all()


def test_subfields_lie_where_they_were_drawn(case):
    u = np.clip(sheet_coordinates(case)[..., 0], 0, 1)
    expected = case.phantom.truth(u, 0.5).subfield
    # FreeSurfer's protocol has one label for both.
    expected[np.isin(expected, (Tissue.CA2, Tissue.CA3))] = Tissue.CA2_3
    borders = u[np.nonzero(np.diff(expected, axis=0))]
    width = case.phantom.spec.width
    # Within a voxel of a border either subfield is right.
    away = np.abs(u[..., None] - borders).min(axis=-1) * width > 0.4
    assert 0.8 < away.mean() < 1
    assert (case.maps.subfield == expected)[away].mean() >= 0.95


def test_summary_numbers_are_those_of_the_phantom(case):
    summary, truth = case.maps.summary, case.truth
    # Smoothing rounds the sharp rims off, which costs a thin sheet more.
    rounding = 0.02 if case.phantom.spec.thickness > 1.2 else 0.03
    assert summary["volume"] == pytest.approx(truth["volume"], rel=rounding)
    for name in ("extent_x", "extent_y", "extent_z", "area_mid"):
        assert summary[name] == pytest.approx(truth[name], rel=0.03), name
    # The end faces of the rims go to either side, so their sum is surer than each of them.
    sides = ("area_interior", "area_exterior")
    total = sum(truth[name] for name in sides)
    assert sum(summary[name] for name in sides) == pytest.approx(total, rel=0.04)
    for name in sides:
        assert summary[name] == pytest.approx(truth[name], rel=0.1), name


def test_subfields_add_up_to_the_whole(case):
    summary = case.maps.summary
    tissues = [tissue.name for tissue in case.volume.protocol.sheet]
    for size, whole in (("area", "area_mid"), ("volume", "volume")):
        parts = sum(summary[f"{size}_{name}"] for name in tissues)
        assert parts == pytest.approx(summary[whole], rel=1e-9), size  # the same pieces
    for name in tissues:
        mean = summary[f"thickness_mean_{name}"]
        assert mean == pytest.approx(case.truth["thickness_mean"], abs=0.1), name


def test_curvature_of_an_arc():
    case = measured(PhantomSpec(kind="arc", thickness=2.0, length=LENGTH))
    truth = case.phantom.truth(0.5, 0.5)
    for name in ("curvature_interior", "curvature", "curvature_exterior"):
        values = case.maps.maps[name][8:-8, 4:-4]
        assert np.median(values) == pytest.approx(float(getattr(truth, name)), rel=0.05), name


def test_curvature_changes_sign_with_the_bend():
    case = measured(PhantomSpec(kind="s-shape", thickness=1.6, length=LENGTH))
    uv = sheet_coordinates(case)[6:-6, 4:-4]
    expected = case.phantom.truth(uv[..., 0], uv[..., 1]).curvature
    found = case.maps.maps["curvature"][6:-6, 4:-4]
    assert expected.min() < -0.02
    assert expected.max() > 0.1
    # 1/mm; a tenth of the range, by smoothing along x and the roughness of 0.4 mm voxels.
    np.testing.assert_allclose(found.mean(axis=1), expected.mean(axis=1), atol=0.025)


def test_thickness_follows_a_known_pattern():
    case = measured(spiral(variation=0.2, variation_axis="y", length=14.0))
    uv = middle(sheet_coordinates(case))
    expected = case.phantom.truth(uv[..., 0], np.clip(uv[..., 1], 0, 1)).thickness
    assert np.ptp(expected) > 0.7
    error = middle(case.maps.thickness) - expected
    assert abs(error.mean()) < 0.03  # mm, as for constant thickness
    assert error.std() < 0.08  # mm, a little smoothing on top of the voxels' roughness
    assert case.maps.decision == Decision.USE


def test_left_and_right_are_mirror_images(plain):
    right = measured(spiral(), hemi="R")
    mirrored = right.maps.sheet.points * [-1, 1, 1]
    # The voxels are mirrored exactly; the triangles that cut them are not.
    gap = np.linalg.norm(mirrored - plain.maps.sheet.points, axis=-1)
    assert gap.mean() < 0.1  # mm, a quarter of a voxel
    difference = right.maps.thickness - plain.maps.thickness
    assert abs(difference.mean()) < 0.02
    assert difference.std() < 0.04
    np.testing.assert_allclose(
        np.median(right.maps.maps["curvature"]), np.median(plain.maps.maps["curvature"]), rtol=0.03
    )
    assert (right.maps.subfield == plain.maps.subfield).mean() > 0.95


def test_the_molecular_layer_goes_where_the_setting_says():
    nearest_sheet = measured(spiral(layer_thickness=0.6))
    settings = Settings(body=BodySettings(layer_rule="nearest-label"))
    nearest_label = measured(spiral(layer_thickness=0.6), settings=settings)
    # All of the layer belongs to the phantom's sheet.
    assert nearest_sheet.maps.thickness.mean() == pytest.approx(2.0, abs=0.03)
    assert nearest_sheet.maps.decision == nearest_label.maps.decision == Decision.USE
    assert nearest_label.maps.qc["layer_voxels"] < nearest_sheet.maps.qc["layer_voxels"]
    # Where dentate gyrus lies beneath the 0.6 mm, about half of them are nearer to it.
    loss = nearest_sheet.maps.thickness - nearest_label.maps.thickness
    lateral = sheet_coordinates(nearest_sheet)[..., 0] > 0.5
    assert middle(loss)[middle(lateral)].mean() == pytest.approx(0.3, abs=0.1)
    assert abs(middle(loss)[:8].mean()) < 0.05  # no dentate gyrus at the medial end


@pytest.fixture(scope="module")
def lined():
    """HippUnfold's labels, with 0.6 mm of SRLM between the wall and the dentate gyrus."""
    case = measured(spiral(), protocol="hippunfold")
    drawn = Damage(case)
    lining = (drawn.n < -1.0) & (drawn.n > -1.6) & (case.volume.tissue == Tissue.DENTATE_GYRUS)
    return case, drawn.relabel(lining, Tissue.MOLECULAR_LAYER, Part.UNKNOWN)


def test_the_molecular_layer_of_hippunfold_is_no_part_of_the_sheet(lined):
    case, volume = lined
    maps = measure(volume)
    assert np.count_nonzero(volume.tissue == Tissue.MOLECULAR_LAYER) > 1000
    assert (maps.qc["layer_voxels"], maps.qc["side_rule"]) == (0, "labels")
    # The wall of 2 mm is the phantom's; the end planes differ by what the core tilts the axis.
    assert middle(maps.thickness).mean() == pytest.approx(2.0, abs=0.05)
    np.testing.assert_allclose(maps.thickness, case.maps.thickness, atol=0.1)


def test_the_molecular_layer_of_hippunfold_is_joined_on_request(lined):
    joined = measure(lined[1], settings=Settings(body=BodySettings(join_every_layer=True)))
    assert joined.qc["layer_voxels"] > 1000
    # Columns with 0.6 mm of lining, over its corners and faces.
    assert joined.thickness[26:39].mean() == pytest.approx(2.6, abs=0.1)


def test_voxels_of_a_millimeter_are_refused_whatever_the_sheet():
    thick = Phantom(spiral(kind="arc", thickness=3.0)).label_volume(
        load_protocol("hippunfold"), voxel_size=(1.0, 1.0, 1.0)
    )
    refused(thick, "sheet-too-thin", "too coarse")


def test_the_grid_of_hipsta_measures_nine_tenths_of_the_wall(plain):
    settings = Settings(sheet=SheetSettings(x_extent=0.9, y_extent=0.975, z_extent=0.9))
    maps = measure(plain.volume, settings=settings)
    ratio = maps.thickness.mean() / plain.maps.thickness.mean()
    assert ratio == pytest.approx(0.9, abs=0.005)  # mm per mm; curved lines are nearly straight
    assert maps.summary["volume"] == plain.maps.summary["volume"]


def test_the_grid_has_the_size_that_is_asked_for(plain):
    settings = Settings(sheet=SheetSettings(x_nodes=21, y_nodes=11, z_nodes=5))
    maps = measure(plain.volume, settings=settings)
    assert maps.sheet.points.shape == (21, 11, 5, 3)
    assert maps.thickness.shape == maps.subfield.shape == maps.maps["curvature"].shape == (21, 11)
    # Every other node of the finer grid. Bent columns are cut into longer pieces, which moves
    # the points that are spaced evenly along them, mm.
    finer = plain.maps.sheet.points[::2, ::2, ::2]
    np.testing.assert_allclose(maps.sheet.points[:, :, [0, -1]], finer[:, :, [0, -1]], atol=1e-9)
    np.testing.assert_allclose(maps.sheet.points, finer, atol=0.05)
    np.testing.assert_allclose(maps.thickness, plain.maps.thickness[::2, ::2], atol=0.06)


def test_a_hole_is_filled_and_reported(plain, damage):
    where = damage.shaft(0.5, 0.5, 0.8)  # narrower ones are pits
    assert where.sum() > 10
    maps = measure(damage.erase(where))
    assert maps.decision == Decision.USE
    # Beside the dentate gyrus it is a cavity, where the sheet goes round it.
    (repair,) = [text for text in maps.repairs if not text.startswith("a gap of")]
    assert repair.startswith("a hole of")
    place = np.array(repair.split("RAS ")[1].split()[:3], dtype=float)
    true = plain.phantom.body.place(0.5, 0.5, 0.0)
    assert np.linalg.norm(place - true) < 1.2  # mm, about half the thickness: it says where to look
    assert maps.qc["euler_before"] == 0
    assert_only_local_change(plain, maps, points=12)


def test_a_bridge_is_cut_and_reported(plain, damage):
    where = damage.bar((0.2, 0.5, -0.8), (0.8, 0.5, -0.8), 0.5)
    maps = measure(damage.relabel(where, Tissue.CA1))
    (flag,) = maps.flags  # a stump of the bar, where the map is wrong
    assert flag.reason == "wall-bump"
    near = np.linalg.norm(maps.sheet.points[:, :, 0, None] - flag.points, axis=-1).min(axis=2) < 0.1
    assert (maps.thickness - plain.maps.thickness)[near].max() > 0.5
    (repair,) = maps.repairs
    assert repair.startswith("a bridge of")
    assert maps.qc["euler_before"] == 0
    assert_only_local_change(plain, maps, points=12)


def test_an_island_is_removed_and_reported(plain, damage):
    where = damage.ball((0.4, 0.5, 4.0), 0.8)
    maps = measure(damage.relabel(where, Tissue.CA1))
    assert maps.decision == Decision.USE
    (repair,) = maps.repairs
    assert repair.startswith("a separate piece of")
    assert_only_local_change(plain, maps, points=0)


def test_a_small_cavity_is_closed(plain, damage):
    where = damage.ball((0.4, 0.5, 0.0), 0.5)
    assert where.any()
    assert_only_local_change(plain, measure(damage.erase(where)), points=0)


def assert_only_local_change(plain, maps, *, points):
    """At most so many of 861 points differ by more than 0.3 mm, and the mean hardly."""
    difference = maps.thickness - plain.maps.thickness
    assert np.count_nonzero(np.abs(difference) > 0.3) <= points
    assert abs(difference.mean()) < 0.02


@pytest.mark.parametrize("kind", ["hole", "bridge"])
def test_a_large_repair_is_flagged(damage, kind):
    if kind == "hole":
        volume = damage.erase(damage.shaft(0.5, 0.5, 2.0))
    else:
        where = damage.bar((0.2, 0.5, -0.8), (0.8, 0.5, -0.8), 1.0)
        volume = damage.relabel(where, Tissue.CA1)
    maps = measure(volume)
    assert maps.decision == Decision.LOOK
    assert "large-repair" in {flag.reason for flag in maps.flags}


def test_a_bridge_thicker_than_the_wall_is_flagged(damage):
    """Which of the two is the bridge cannot be told; it must not be filled silently."""
    where = damage.bar((0.2, 0.5, -0.8), (0.8, 0.5, -0.8), 1.2)
    maps = measure(damage.relabel(where, Tissue.CA1))
    assert {"large-repair", "section-intrusion"} <= {flag.reason for flag in maps.flags}


def refused(volume, reason, match, hemi="L", settings=None):
    with pytest.raises(GeometryError, match=match) as caught:
        measure(volume, hemi, settings)
    assert caught.value.reason == reason


def test_missing_slices_are_refused(damage):
    gap = (damage.v > 0.4) & (damage.v < 0.6)
    refused(damage.erase(gap), "body-interrupted", "interrupted")


def test_a_sheet_in_two_strips_is_refused(damage):
    slit = damage.sheet & (damage.u > 0.45) & (damage.u < 0.55)
    refused(damage.erase(slit), "body-split", r"2 strips, at RAS .* \(CA1\)")


def test_a_body_that_is_too_short_is_refused(damage):
    beyond = (damage.v > 0.4) & (damage.volume.tissue > 0)
    volume = damage.relabel(beyond, Tissue.CA1, Part.HEAD)
    refused(volume, "body-too-short", r"4\.\d mm long, 5 mm are needed")
    assert measure(volume, settings=Settings(body=BodySettings(min_length=3.0))).thickness.any()


def test_labels_without_a_sheet_are_refused(damage):
    volume = damage.relabel(damage.sheet, Tissue.DENTATE_GYRUS)
    refused(volume, "no-sheet-labels", "check the protocol")


def test_a_tail_label_across_the_middle_is_refused(damage):
    inside = (damage.v > 0.45) & (damage.v < 0.55) & (damage.volume.tissue > 0)
    volume = damage.relabel(inside, Tissue.HIPPOCAMPUS, Part.TAIL)
    refused(volume, "body-interrupted", "correct head and tail labels")


def test_the_other_hemisphere_is_refused(plain):
    refused(plain.volume, "left-right-swapped", "as in a left hemisphere", hemi="R")


def test_subfields_in_the_wrong_order_are_refused(damage):
    tissue = damage.volume.tissue
    volume = damage.relabel(tissue == Tissue.CA1, Tissue.CA2_3)
    volume = type(volume)(
        tissue=np.where(tissue == Tissue.CA2_3, np.uint8(Tissue.CA1), volume.tissue),
        part=volume.part,
        affine=volume.affine,
        protocol=volume.protocol,
    )
    # The subiculum borders on CA2/3 as where two turns touch, so that the sheet is parted there.
    refused(volume, "body-split", "check the protocol")


def test_too_few_voxels_across_are_refused(plain):
    settings = Settings(checks=CheckSettings(min_voxels_across=6.0))
    refused(plain.volume, "sheet-too-thin", "use a finer segmentation", settings=settings)
