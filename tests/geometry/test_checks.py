"""Each refusal with a case that must trigger it and one that must not."""

from dataclasses import replace

import numpy as np
import pytest
from geometry_cases import box_mesh, plain_body, resampled, short_phantom, solid_of, straight_ends
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.body import extract_body
from hipsta_bids.geometry.checks import (
    _rank_correlation,
    _share_beyond,
    check_end_labels,
    check_label_order,
    check_thickness,
    check_voxels_across,
)
from hipsta_bids.geometry.grid import check_voxel
from hipsta_bids.geometry.measures import measure_thickness
from hipsta_bids.geometry.mesh import extract_surface
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Part, Tissue
from hipsta_bids.settings import CheckSettings, Settings
from hipsta_bids.types import Coordinates

CHECKS, ALL = CheckSettings(), Settings()


def surface_of(kind, voxel, thickness):
    phantom = short_phantom(kind=kind, curvature=None, thickness=thickness, length=10.0, width=20.0)
    volume = phantom.label_volume(load_protocol("freesurfer"), voxel_size=(voxel,) * 3)
    body = extract_body(volume, ALL.body)
    solid = solid_of(resampled(body), ALL.topology)
    return extract_surface(solid.field, ALL.surface), body


def test_a_sheet_of_hardly_more_than_a_voxel_is_refused():
    """At 1.0 mm, 1.2 mm come out wrong by millimeters without any other sign."""
    surface, body = surface_of("spiral", 1.0, 1.2)
    with pytest.raises(GeometryError, match=r"voxels of 1\.00 mm; 2\.5 are needed") as caught:
        check_voxels_across(surface, body, CHECKS)
    assert caught.value.reason == "sheet-too-thin"


@pytest.mark.parametrize(
    ("voxel", "fine"),
    [
        ((1.0, 1.0, 1.0), False),
        ((0.95, 2.0, 0.95), False),
        ((0.8, 0.8, 0.8), True),
        ((0.4, 2.0, 0.4), True),
        ((2.0, 0.4, 0.4), True),
    ],
)
def test_coarse_voxels_in_plane_are_refused_and_thick_slices_are_not(voxel, fine):
    volume = short_phantom().label_volume(load_protocol("freesurfer"), voxel_size=voxel)
    if fine:
        check_voxel(volume, CHECKS)
        return
    with pytest.raises(GeometryError, match=r"voxels of \S+ mm are too coarse") as caught:
        check_voxel(volume, CHECKS)
    assert caught.value.reason == "sheet-too-thin"


@pytest.mark.parametrize(("axes", "fine"), [((0, 1, 2), False), ((0, 2), False), ((1,), True)])
def test_coarse_labels_in_smaller_voxels_are_refused(axes, fine):
    """Thickness is off by 0.2 to 0.3 mm (SD) from point to point, though its mean is not."""
    volume = short_phantom().label_volume(load_protocol("freesurfer"), voxel_size=(0.8,) * 3)
    tissue, part, affine = volume.tissue, volume.part, volume.affine.copy()
    for axis in axes:
        tissue, part = tissue.repeat(2, axis), part.repeat(2, axis)
        affine[:3, axis] /= 2
    small = replace(volume, tissue=tissue, part=part, affine=affine)
    if fine:
        check_voxel(small, CHECKS)
        return
    with pytest.raises(GeometryError, match=r"voxels of 0\.40 mm .* about 0\.\d+ mm") as caught:
        check_voxel(small, CHECKS)
    assert caught.value.reason == "sheet-too-thin"


def test_a_sheet_that_is_lost_between_its_voxels_is_refused():
    """The same, flat: so little is left after smoothing that no path leads through it."""
    with pytest.raises(GeometryError, match=r"body is interrupted at .* use finer labels"):
        surface_of("slab", 1.0, 0.9)


@pytest.mark.slow
def test_the_same_sheet_is_fine_at_finer_voxels():
    across = check_voxels_across(*surface_of("slab", 0.3, 1.2), CHECKS)
    assert across == pytest.approx(1.2 / 0.3, rel=0.15)  # rims count as wall


def test_voxels_across_of_phantoms(case):
    across = check_voxels_across(case.surface, case.body, CHECKS)
    assert across == pytest.approx(2.0 / 0.4, rel=0.15)  # rims count as wall
    with pytest.raises(GeometryError, match="are needed: use a finer segmentation") as caught:
        check_voxels_across(case.surface, case.body, CheckSettings(min_voxels_across=6.0))
    assert caught.value.reason == "sheet-too-thin"


def test_labels_of_phantoms_are_in_order(case):
    # 0.77 is the least that real labels showed.
    assert check_label_order(case.mesh, case.coordinates, case.body, CHECKS) > 0.9


def test_turned_coordinates_are_refused(case):
    turned = Coordinates(values=case.coordinates.values * [-1.0, 1.0, 1.0])
    with pytest.raises(GeometryError, match="are not in order from medial") as caught:
        check_label_order(case.mesh, turned, case.body, CHECKS)
    assert caught.value.reason == "label-order"


def striped_body(kinds):
    """A box of 12 x 4 x 2 mm along x, striped in the given order, and its x coordinate."""
    tissue = np.repeat(np.array(kinds, dtype=np.uint8), 24 // len(kinds))
    tissue = np.broadcast_to(tissue[:, None, None], (24, 8, 4))
    mesh = box_mesh((24, 8, 4), (12.0, 4.0, 2.0))
    coordinates = Coordinates(values=2 * mesh.vertices / [12.0, 4.0, 2.0] - 1)
    affine = np.diag([0.5, 0.5, 0.5, 1.0])
    affine[:3, 3] = 0.25
    return mesh, coordinates, plain_body(tissue, affine, straight_ends(2.0))


RIGHT_ORDERS = [
    (Tissue.PRESUBICULUM, Tissue.SUBICULUM, Tissue.CA1, Tissue.CA2_3),
    (Tissue.SUBICULUM, Tissue.CA1, Tissue.CA2, Tissue.CA3),
    (Tissue.SUBICULUM, Tissue.CA1),
]
WRONG_ORDERS = [
    (Tissue.PRESUBICULUM, Tissue.CA1, Tissue.SUBICULUM, Tissue.CA2_3),
    (Tissue.SUBICULUM, Tissue.CA2, Tissue.CA1, Tissue.CA3),
    (Tissue.CA1, Tissue.SUBICULUM),
]


@pytest.mark.parametrize("kinds", RIGHT_ORDERS)
def test_any_subset_in_order_passes(kinds):
    assert check_label_order(*striped_body(kinds), CHECKS) > 0.8


@pytest.mark.parametrize("kinds", WRONG_ORDERS)
def test_swapped_subfields_are_refused(kinds):
    """Though the correlation of most of them is above the limit."""
    with pytest.raises(GeometryError, match=r"not in order .* check the protocol"):
        check_label_order(*striped_body(kinds), CHECKS)


def test_a_fragment_elsewhere_is_no_swap():
    mesh, coordinates, body = striped_body(RIGHT_ORDERS[0])
    tissue = body.tissue.copy()
    tissue[0, :2] = Tissue.CA3  # 1 % of the voxels, at the medial rim
    body = plain_body(tissue, body.affine, straight_ends(2.0))
    assert check_label_order(mesh, coordinates, body, CHECKS) > 0.8


def test_one_subfield_has_no_order():
    assert np.isnan(check_label_order(*striped_body((Tissue.CA1,)), CHECKS))


@given(st.integers(0, 1000))
@settings(max_examples=30, deadline=None)
def test_rank_correlation_is_spearmans(seed):
    rng = np.random.default_rng(seed)
    y = rng.integers(0, 5, 60).astype(np.uint8)
    y[:2] = 0, 1
    x = np.round(y + rng.normal(size=60), 1)  # with ties
    wanted = stats.spearmanr(x, y).statistic
    assert _rank_correlation(x, y) == pytest.approx(wanted, abs=1e-12)


def test_thickness_of_phantoms_is_as_expected(case):
    thickness = measure_thickness(case.sheet)
    (found,) = check_thickness(thickness, case.boundaries.sheet_thickness, CHECKS)
    assert not found.raised


def map_of(mean):
    values = np.full((41, 21), mean)
    values[0, 0] = np.nan  # missing points do not count
    return values


@pytest.mark.parametrize(
    ("mean", "flagged"), [(2.0, False), (2.25, False), (2.4, True), (1.6, True)]
)
def test_a_doubtful_mean_is_flagged(mean, flagged):
    (found,) = check_thickness(map_of(mean), 2.0, CHECKS)
    assert found.reason == "thickness-doubtful"
    assert found.raised is flagged
    assert found.change == pytest.approx(mean - 2.0)


@pytest.mark.parametrize("mean", [5.0, 1.0, 2.8, np.nan])
def test_a_wrong_map_is_refused(mean):
    """Such as 3.8 mm too much, as a sheet of one voxel gave without any other sign."""
    values = map_of(mean)
    values[0, 0] = mean
    if np.isnan(mean):
        values[1, 1] = np.inf
    with pytest.raises(GeometryError, match="the map would be wrong") as caught:
        check_thickness(values, 2.0, CHECKS)
    assert caught.value.reason == "thickness-implausible"


@pytest.mark.parametrize("part", [Part.HEAD, Part.TAIL])
def test_an_end_at_which_all_labels_end_is_flagged(arc, part):
    """The head or the tail is not drawn, as in a body that is cut short."""
    lost = arc.volume.part == part
    volume = replace(
        arc.volume,
        tissue=np.where(lost, 0, arc.volume.tissue),
        part=np.where(lost, Part.UNKNOWN, arc.volume.part),
    )
    found = check_end_labels(volume, extract_body(volume, ALL.body), CHECKS)
    flags = [finding for finding in found if finding.raised]
    assert [flag.reason for flag in flags] == ["labels-end"]
    assert ("anterior" if part is Part.HEAD else "posterior") in flags[0].text


def test_a_dentate_gyrus_that_ends_before_the_sheet_is_no_missing_label(arc):
    """In the tail the sheet closes behind it: only the sheet's labels are counted."""
    ends = arc.body.ends
    automatic = replace(ends, posterior=ends.posterior._replace(rule="core"))
    body = replace(arc.body, ends=automatic)
    protocol = arc.volume.protocol
    core = np.isin(arc.volume.tissue, list({*protocol.interior} - {*protocol.layer}))
    hollow = replace(arc.volume, tissue=np.where(core, 0, arc.volume.tissue))
    whole, without = (check_end_labels(v, body, CHECKS)[1] for v in (arc.volume, hollow))
    assert core.any()
    assert whole.reason == "labels-end"
    assert whole.value == without.value


def test_short_head_and_tail_labels_are_enough(arc):
    assert not any(found.raised for found in check_end_labels(arc.volume, arc.body, CHECKS))


def test_voxels_count_on_the_side_of_a_plane_where_they_lie():
    assert _share_beyond(np.array([0.5, 1.5, -0.5]), 0.25) == pytest.approx(0.5)
    # A voxel lies on both sides of the plane, or partly beyond the reach of 3 mm.
    assert _share_beyond(np.array([0.2, 1.5]), 0.5) == pytest.approx(0.3 / 1.7)
    assert _share_beyond(np.array([3.0, -3.2]), 0.5) == pytest.approx(0.3 / 0.5)
    assert _share_beyond(np.array([4.0, -4.0]), 0.5) == 0
