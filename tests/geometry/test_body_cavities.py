"""What the hippocampus encloses without a label, and end labels amid the body."""

from dataclasses import replace

import numpy as np
import pytest
from geometry_cases import resampled, short_phantom, solid_of
from scipy import ndimage

from hipsta_bids.geometry import completion
from hipsta_bids.geometry.body import extract_body
from hipsta_bids.geometry.digital import to_ras
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.settings import BodySettings, TopologySettings

BODY = BodySettings()
PHANTOM = short_phantom(layer_thickness=0.6)
MIDDLE = PHANTOM.body.place(0.7, 0.5, -0.7)  # in the layer: the wall is at -1


@pytest.fixture(scope="module")
def volume():
    return PHANTOM.label_volume(load_protocol("freesurfer"))


def within(volume, radius, center=MIDDLE):
    """Voxels (I, J, K) within a ball round a point, mm."""
    points = to_ras(np.moveaxis(np.indices(volume.tissue.shape), 0, -1), volume.affine)
    return np.linalg.norm(points - center, axis=-1) < radius


def without(volume, where, value=Tissue.BACKGROUND):
    return replace(volume, tissue=np.where(where, np.uint8(value), volume.tissue))


@pytest.mark.parametrize("content", [Tissue.BACKGROUND, Tissue.CYST])
def test_a_narrow_cavity_becomes_a_part_of_the_layer(volume, content):
    hole = within(volume, 0.8) & (volume.tissue == Tissue.MOLECULAR_LAYER)
    body = extract_body(without(volume, hole, content), BODY)
    np.testing.assert_array_equal(body.tissue > 0, extract_body(volume, BODY).tissue > 0)
    assert len(body.cavities.wide) == 0
    found = np.zeros_like(hole)
    found[tuple(body.cavities.all.T)] = True
    np.testing.assert_array_equal(found, hole)


def test_a_wide_cavity_is_divided_between_both_sides(volume, monkeypatch):
    hole = within(volume, 0.9, PHANTOM.body.place(0.7, 0.5, -1.0))
    monkeypatch.setattr(completion, "CAVITY_RADIUS", 0.4)
    whole, body = (extract_body(v, BODY) for v in (volume, without(volume, hole)))
    (cavity,) = body.cavities.wide
    assert len(cavity) == hole.sum()
    before, after = (b.tissue[hole] > 0 for b in (whole, body))
    # Undamaged, the layer is part of the sheet and the dentate gyrus is not.
    assert 0.1 < before.mean() < 0.9
    assert (before == after).mean() > 0.7


def test_without_a_layer_a_cavity_is_divided():
    plain = short_phantom().label_volume(load_protocol("freesurferCA"))
    hole = within(plain, 0.9, PHANTOM.body.place(0.7, 0.5, -1.0))
    body = extract_body(without(plain, hole), BODY)
    assert len(body.cavities.all) == hole.sum()
    before = extract_body(plain, BODY).tissue[hole] > 0
    assert (before == (body.tissue[hole] > 0)).mean() > 0.7


def test_what_is_open_to_the_outside_stays_as_it_is(volume):
    points = to_ras(np.moveaxis(np.indices(volume.tissue.shape), 0, -1), volume.affine)
    start, end = MIDDLE, PHANTOM.body.place(0.7, 0.5, 1.5)
    along = np.clip((points - start) @ (end - start) / ((end - start) @ (end - start)), 0, 1)
    shaft = np.linalg.norm(points - start - along[..., None] * (end - start), axis=-1) < 0.6
    body = extract_body(without(volume, shaft), BODY)
    assert len(body.cavities.all) == 0


def test_columns_through_a_cavity_are_marked(volume):
    hole = within(volume, 0.8) & (volume.tissue == Tissue.MOLECULAR_LAYER)
    solid = solid_of(resampled(extract_body(without(volume, hole), BODY)), TopologySettings())
    (repair,) = solid.repairs
    assert repair.kind == "cavity"
    assert np.linalg.norm(np.subtract(repair.position, MIDDLE)) < 0.5
    assert not repair.large
    assert solid.touched.any()
    assert solid.changed_fraction == 0


def test_end_labels_between_the_planes_go_to_their_neighbors(volume):
    end = PHANTOM.body.place(0.5, 0.1, 0.0)
    tail = within(volume, 0.9, end) & (volume.tissue > 0)
    mixed = replace(without(volume, tail, Tissue.HIPPOCAMPUS), part=volume.part)
    body, whole = (extract_body(v, BODY) for v in (mixed, volume))
    assert body.handed_over == pytest.approx(tail.sum(), abs=8)  # the plane hardly moves
    assert (body.inside[tail] == whole.inside[tail]).mean() > 0.95


@pytest.mark.parametrize(
    ("ratio", "doubtful"), [(0.8, False), (0.95, True), (1.05, True), (1.3, False)]
)
def test_a_cavity_near_to_a_limit_has_a_second_reading(volume, monkeypatch, ratio, doubtful):
    """The radius of this cavity is ``ratio`` of the limit."""
    hole = without(volume, within(volume, 1.0, PHANTOM.body.place(0.7, 0.5, -1.0)))
    monkeypatch.setattr(completion, "CAVITY_RADIUS", 1e-3)
    (cavity,) = extract_body(hole, BODY).cavities.wide
    inside = np.zeros(volume.tissue.shape, dtype=bool)
    inside[tuple(cavity.T)] = True
    radius = ndimage.distance_transform_edt(inside, sampling=0.4).max()
    monkeypatch.setattr(completion, "CAVITY_RADIUS", radius / ratio)
    first, second = (extract_body(hole, BODY, second=second).cavities for second in (False, True))
    assert first.doubtful is second.doubtful is doubtful
    assert (len(first.wide) == len(second.wide)) is not doubtful
