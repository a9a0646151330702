"""Merging of the sheet's labels, the molecular layer, and the refusals."""

from dataclasses import replace

import numpy as np
import pytest
from geometry_cases import plain_body, rigid, short_phantom, straight_ends
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy import ndimage

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.body import _check_ends_reached, _merge_layer, check_side, extract_body
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Part, Tissue
from hipsta_bids.settings import BodySettings
from hipsta_bids.types import LabelVolume

FREESURFER = load_protocol("freesurfer")


def volume_of(tissue, voxel=(1.0, 1.0, 1.0)):
    tissue = np.asarray(tissue, dtype=np.uint8)
    return LabelVolume(
        tissue=tissue,
        part=np.full(tissue.shape, Part.BODY),
        affine=np.diag([*voxel, 1.0]),
        protocol=FREESURFER,
    )


def row(*tissues):
    return volume_of(np.array(tissues).reshape(-1, 1, 1))


def test_layer_goes_to_the_nearest_sheet_subfield():
    layer = Tissue.MOLECULAR_LAYER
    line = row(Tissue.SUBICULUM, layer, layer, layer, layer, Tissue.DENTATE_GYRUS)
    tissue, given_away = _merge_layer(line, BodySettings())
    assert tissue.ravel().tolist() == [Tissue.SUBICULUM] * 5 + [0]
    assert given_away == 4


def test_layer_nearest_to_the_dentate_gyrus_is_left_out_by_the_other_rule():
    layer = Tissue.MOLECULAR_LAYER
    line = row(Tissue.SUBICULUM, layer, layer, layer, layer, Tissue.DENTATE_GYRUS)
    tissue, given_away = _merge_layer(line, BodySettings(layer_rule="nearest-label"))
    assert tissue.ravel().tolist() == [Tissue.SUBICULUM] * 3 + [0] * 3
    assert given_away == 2


def test_a_layer_that_the_protocol_does_not_list_stays_inside_unless_asked_for():
    """HippUnfold's SRLM lies within the inner wall of its sheet."""
    layer = Tissue.MOLECULAR_LAYER
    tissues = (Tissue.SUBICULUM, layer, layer, Tissue.DENTATE_GYRUS)
    line = replace(row(*tissues), protocol=load_protocol("hippunfold"))
    assert layer in line.protocol.interior
    tissue, given_away = _merge_layer(line, BodySettings())
    assert tissue.ravel().tolist() == [Tissue.SUBICULUM, 0, 0, 0]
    assert given_away == 0
    for rule, count in (("nearest-sheet", 2), ("nearest-label", 1)):
        asked = BodySettings(join_every_layer=True, layer_rule=rule)
        tissue, given_away = _merge_layer(line, asked)
        assert tissue.ravel().tolist() == [Tissue.SUBICULUM] * (1 + count) + [0] * (3 - count)
        assert given_away == count


def test_layer_distances_are_millimetres_not_voxels():
    tissue = np.zeros((3, 3, 1))
    tissue[0, 0] = Tissue.MOLECULAR_LAYER
    tissue[1, 0] = Tissue.CA1  # one voxel of 2 mm
    tissue[0, 2] = Tissue.SUBICULUM  # two voxels of 0.5 mm
    given_to, _ = _merge_layer(volume_of(tissue, (2.0, 0.5, 1.0)), BodySettings())
    assert given_to[0, 0, 0] == Tissue.SUBICULUM


@settings(max_examples=40, deadline=None)
@given(
    arrays.arrays(
        np.uint8,
        (5, 4, 6),
        elements=st.sampled_from(
            [0, Tissue.SUBICULUM, Tissue.CA1, Tissue.CA2_3, Tissue.MOLECULAR_LAYER]
        ),
    )
)
def test_layer_takers_are_as_near_as_any(tissue):
    """Against Euclidean distance transforms, one per subfield."""
    voxel = (0.5, 0.7, 1.3)
    volume = volume_of(tissue, voxel)
    given_to, _ = _merge_layer(volume, BodySettings())
    if not np.isin(tissue, FREESURFER.sheet).any():
        assert not given_to.any()
        return
    kinds = [kind for kind in FREESURFER.sheet if (tissue == kind).any()]
    gaps = np.stack(
        [ndimage.distance_transform_edt(tissue != kind, sampling=voxel) for kind in kinds]
    )
    layer = np.argwhere(tissue == Tissue.MOLECULAR_LAYER)
    for place in layer:  # a few voxels
        gap = gaps[(slice(None), *place)]
        chosen = kinds.index(given_to[tuple(place)])
        assert gap[chosen] == pytest.approx(gap.min(), abs=1e-9)  # rounding of distances


def test_nothing_but_the_layer_changes(arc):
    sheet = np.isin(arc.volume.tissue, FREESURFER.sheet)
    np.testing.assert_array_equal(arc.body.tissue[sheet], arc.volume.tissue[sheet])
    assert not arc.body.tissue[~sheet].any()
    assert arc.body.layer_voxels == 0


@pytest.mark.slow
def test_layer_of_the_wall_is_given_back():
    """The phantom's truth is the whole wall, so the layer must return to the sheet."""
    plain = short_phantom().label_volume(FREESURFER)
    layered = short_phantom(layer_thickness=0.6).label_volume(FREESURFER)
    assert (layered.tissue == Tissue.MOLECULAR_LAYER).any()
    wanted, got = (extract_body(v, BodySettings()) for v in (plain, layered))
    # Of the layer at the flat ends u = 0 and 1 nothing is lost either.
    np.testing.assert_array_equal(got.tissue > 0, wanted.tissue > 0)
    assert got.layer_voxels == np.count_nonzero(layered.tissue == Tissue.MOLECULAR_LAYER)


def test_volume_is_the_phantoms(case):
    voxel = abs(np.linalg.det(case.volume.affine[:3, :3]))
    truth = case.phantom.truth(0.5, 0.5).summary["volume"]
    # Counting voxels of 0.4 mm in a wall of 2 mm, and end planes found to a tenth of a voxel.
    assert np.count_nonzero(case.body.inside) * voxel == pytest.approx(truth, rel=0.04)


def test_inside_points_are_voxel_centers_in_ras(arc):
    index, points = arc.body.inside_points()
    assert arc.body.inside[tuple(index.T)].all()
    assert len(index) == np.count_nonzero(arc.body.inside)
    back = np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(arc.body.affine).T
    np.testing.assert_allclose(back[:, :3], index, atol=1e-9)  # rounding


def test_interior_labels_are_marked(arc):
    marked = arc.volume.tissue[arc.body.interior]
    # At the ends of the body, tail labels between the planes have become their neighbors'.
    assert set(np.unique(marked)) <= {*map(int, FREESURFER.interior), Tissue.HIPPOCAMPUS}
    assert (marked != Tissue.HIPPOCAMPUS).mean() > 0.9
    assert marked.size > 100


def test_no_sheet_labels_are_refused():
    with pytest.raises(GeometryError, match="no voxel of the sheet's subfields") as caught:
        extract_body(row(Tissue.DENTATE_GYRUS, Tissue.CA4), BodySettings())
    assert caught.value.reason == "no-sheet-labels"


@pytest.mark.parametrize(("length", "refused"), [(4.0, True), (6.0, False)])
def test_short_bodies_are_refused(length, refused):
    volume = short_phantom(length=length).label_volume(FREESURFER)
    if not refused:
        extract_body(volume, BodySettings())
        return
    with pytest.raises(GeometryError, match=r"mm long, 5 mm are needed") as caught:
        extract_body(volume, BodySettings())
    assert caught.value.reason == "body-too-short"


@pytest.mark.parametrize("end", ["posterior", "anterior"])
def test_labels_that_end_before_an_end_plane_are_refused(end):
    body = extract_body(short_phantom(length=14.0).label_volume(FREESURFER), BodySettings())
    points = body.inside_points()[1]
    _check_ends_reached(points, body.ends)
    depth = np.abs(body.ends.height(points, end))
    _check_ends_reached(points[depth > 2], body.ends)
    with pytest.raises(GeometryError, match=rf"mm before the {end} end plane") as caught:
        _check_ends_reached(points[depth > 4], body.ends)
    assert caught.value.reason == "body-too-short"


@pytest.mark.parametrize("hemi", ["L", "R"])
def test_the_medial_side_lies_towards_the_midline(hemi):
    volume = short_phantom().label_volume(FREESURFER, hemi=hemi)
    offset = check_side(extract_body(volume, BodySettings()), hemi)
    assert offset > 2.0  # the subiculum of a 12 mm wide sheet


@pytest.mark.parametrize("hemi", ["L", "R"])
def test_a_swapped_hemisphere_is_refused(hemi):
    volume = short_phantom().label_volume(FREESURFER, hemi=hemi)
    other = "R" if hemi == "L" else "L"
    with pytest.raises(GeometryError, match="labeled") as caught:
        check_side(extract_body(volume, BodySettings()), other)
    assert caught.value.reason == "left-right-swapped"


def test_a_turned_head_is_not_taken_for_a_swap():
    pose = rigid(degrees=(15.0, -20.0, 20.0))
    volume = short_phantom().label_volume(FREESURFER, pose=pose)
    assert check_side(extract_body(volume, BodySettings()), "L") > 0


@pytest.mark.parametrize("degrees", [(0.0, 180.0, 0.0), (0.0, 0.0, 180.0), (0.0, 90.0, 0.0)])
@pytest.mark.parametrize("claimed", ["L", "R"])
def test_handedness_decides_where_the_subject_lies_otherwise(degrees, claimed):
    """On the back turned round, or on a side, the subiculum may point away from x = 0."""
    phantom = short_phantom(kind="spiral", curvature=None, width=20.0, length=10.0)
    volume = phantom.label_volume(FREESURFER, hemi=claimed, pose=rigid(degrees))
    assert np.isfinite(check_side(extract_body(volume, BodySettings()), claimed))


def test_the_side_is_unknown_without_ca1(arc):
    tissue = np.where(arc.volume.tissue == Tissue.CA1, Tissue.SUBICULUM, arc.volume.tissue)
    volume = LabelVolume(
        tissue=tissue, part=arc.volume.part, affine=arc.volume.affine, protocol=FREESURFER
    )
    assert np.isnan(check_side(extract_body(volume, BodySettings()), "R"))


def test_a_body_leaves_its_end_planes_along_its_last_four_millimeters():
    """The line through its positions; weights fall to zero at the reach. Other pieces are none."""
    tissue = np.zeros((30, 12, 24), dtype=np.uint8)
    for level in range(24):
        first = 4 + level**2 // 40
        tissue[first : first + 8, 2:6, level] = Tissue.CA1
    affine = np.diag([0.5, 0.5, 0.5, 1.0])
    affine[:3, 2], affine[2, 3] = [0.1, -0.2, 0.5], 0.25
    whole = plain_body(tissue, affine, straight_ends(12.0))
    for noise in ((0, slice(7, 11)), (29, slice(7, 11))):
        tissue[noise] = Tissue.CA1
    body = plain_body(tissue, affine, straight_ends(12.0))
    _, points = whole.inside_points()
    for end, level, sign in (("posterior", 0.0, 1), ("anterior", 12.0, -1)):
        depth = sign * (points[:, 2] - level)
        near = depth < 4
        fit = np.polyfit(depth[near], points[near, :2], 1, w=np.sqrt(4 - depth[near]))[0]
        step = np.array([-fit[0], -fit[1], -sign])
        np.testing.assert_allclose(body.outward[end], step / np.linalg.norm(step), atol=1e-9)
