"""Edited masks of the body, on a drawn phantom."""

from dataclasses import replace

import numpy as np
import pytest
from geometry_cases import short_phantom
from scipy import ndimage

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.body import MaskChange, check_mask, extract_body, relabel_by_mask
from hipsta_bids.participant.measure import find_body
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.settings import BodySettings, Settings
from hipsta_bids.types import EditedMask

SETTINGS = BodySettings()


def drawn(protocol="freesurfer", **options):
    return short_phantom().label_volume(load_protocol(protocol), **options)


def corrected(volume, inside, voxel=0.4):
    mask = EditedMask(inside=inside, voxel=voxel)
    return extract_body(replace(volume, edited_mask=mask), SETTINGS)


@pytest.fixture(scope="module")
def volume():
    return drawn()


@pytest.fixture(scope="module")
def body(volume):
    return extract_body(volume, SETTINGS)


@pytest.mark.parametrize(
    ("protocol", "voxels"),
    [("freesurfer", (0.4, 0.4, 0.4)), ("hippunfold", (0.4, 0.4, 0.4)), ("ashsPMC", (0.4, 2, 0.4))],
)
def test_a_mask_that_changes_nothing_changes_nothing(protocol, voxels):
    """Whether head and tail have labels, and in thick slices."""
    volume = drawn(protocol, voxel_size=voxels)
    before = extract_body(volume, SETTINGS)
    after = corrected(volume, before.inside)
    for name in ("tissue", "inside", "interior"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    for end in ("posterior", "anterior"):
        np.testing.assert_array_equal(after.ends[end].point, before.ends[end].point)
        np.testing.assert_array_equal(after.ends[end].normal, before.ends[end].normal)


def test_voxels_outside_of_the_mask_are_no_body(volume, body):
    """Half of CA1 goes; nothing is added."""
    ca1 = np.argwhere(body.inside & (body.tissue == Tissue.CA1))
    gone = np.zeros_like(body.inside)
    gone[tuple(ca1[::2].T)] = True
    after = corrected(volume, body.inside & ~gone)
    assert not after.tissue[gone].any()
    # Apart from these, labels stay; the end planes may turn by a voxel's row.
    kept = ~gone & (body.tissue > 0)
    np.testing.assert_array_equal(after.tissue[kept], body.tissue[kept])


def test_voxels_of_the_mask_get_the_nearest_label(volume, body):
    """One background voxel beside each of some CA1 voxels whose own neighbors are all CA1."""
    hole = np.zeros_like(body.inside)
    apart = ~ndimage.binary_dilation(body.interior, iterations=3)  # no cavity
    index = np.argwhere(body.inside & (body.tissue == Tissue.CA1) & apart)
    middle = index[len(index) // 2]
    hole[tuple(middle)] = True
    damaged = replace(volume, tissue=np.where(hole, np.uint8(0), volume.tissue))
    assert not extract_body(damaged, SETTINGS).tissue[hole].any()
    after = corrected(damaged, body.inside)
    np.testing.assert_array_equal(after.tissue[hole], [Tissue.CA1])
    np.testing.assert_array_equal(after.inside, body.inside)


def test_beyond_the_end_planes_the_labels_stay(volume, body):
    """A mask that is full everywhere fills the body only."""
    after = corrected(volume, np.ones_like(body.inside))
    index = np.argwhere(np.ones_like(body.inside))
    points = index @ volume.affine[:3, :3].T + volume.affine[:3, 3]
    # Half a millimeter: the planes turn a little, since the interior is full now.
    beyond = (after.ends.height(points, "posterior") < -0.5) | (
        after.ends.height(points, "anterior") > 0.5
    )
    outside = tuple(index[beyond].T)
    np.testing.assert_array_equal(after.tissue[outside], body.tissue[outside])
    between = (after.ends.height(points, "posterior") > 0.5) & (
        after.ends.height(points, "anterior") < -0.5
    )
    assert after.tissue[tuple(index[between].T)].all()


def test_a_mask_elsewhere_is_refused(volume, body):
    mask = np.zeros_like(body.inside)
    mask[:2, :2, :2] = True
    with pytest.raises(GeometryError, match="check its hemisphere and its space") as caught:
        corrected(volume, mask)
    assert caught.value.reason == "edited-mask-elsewhere"


@pytest.mark.parametrize(("voxel", "wanted"), [(0.4, []), (0.59, []), (0.61, ["coarse"])])
def test_a_coarse_mask_is_flagged(body, voxel, wanted):
    mask = EditedMask(inside=body.inside, voxel=voxel)
    flags = check_mask(mask, MaskChange(before=9, added=0, removed=0), 0.4, SETTINGS)
    assert [flag.reason.removeprefix("edited-mask-") for flag in flags if flag.raised] == wanted


@pytest.mark.parametrize(("removed", "wanted"), [(40, []), (41, ["different"])])
def test_a_mask_that_changes_half_of_the_body_is_flagged(body, removed, wanted):
    mask = EditedMask(inside=body.inside, voxel=0.4)
    change = MaskChange(before=100, added=10, removed=removed)
    flags = check_mask(mask, change, 0.4, SETTINGS)
    assert [flag.reason.removeprefix("edited-mask-") for flag in flags if flag.raised] == wanted


def test_changes_are_counted(volume, body):
    index = np.argwhere(body.inside)
    gone, new = np.zeros_like(body.inside), np.zeros_like(body.inside)
    gone[tuple(index[::50].T)] = True
    # Beside the body, away from its ends.
    rim = ndimage.binary_dilation(body.inside) & (body.tissue == 0)
    points = np.argwhere(rim) @ volume.affine[:3, :3].T + volume.affine[:3, 3]
    deep = (body.ends.height(points, "posterior") > 0) & (body.ends.height(points, "anterior") < 0)
    new[tuple(np.argwhere(rim)[deep][::40].T)] = True
    change = corrected(volume, (body.inside & ~gone) | new).mask_change
    assert (change.before, change.added, change.removed) == tuple(
        int(np.count_nonzero(mask)) for mask in (body.inside, new, gone)
    )
    assert change.share == (change.added + change.removed) / change.before
    assert body.mask_change is None


def test_the_body_is_found_where_it_can_be(volume, body):
    """And where that is in the file from which the labels were cropped."""
    start, shape = (3, 4, 5), tuple(n + 9 for n in body.inside.shape)
    found = find_body(replace(volume, start=start, file_shape=shape), Settings())
    assert (found.start, found.shape) == (start, shape)
    np.testing.assert_array_equal(found.inside, body.inside)
    np.testing.assert_allclose(
        found.affine[:3, :3] @ start + found.affine[:3, 3],
        volume.affine[:3, 3],
        atol=1e-9,  # rounding
    )
    nothing = replace(volume, tissue=np.zeros_like(volume.tissue))
    assert find_body(nothing, Settings()) is None


def test_labels_can_be_those_of_the_mask(volume, body):
    mask = body.inside.copy()
    index = np.argwhere(mask)
    mask[tuple(index[index[:, 1] > np.median(index[:, 1]) + 6].T)] = False
    masked = replace(volume, edited_mask=EditedMask(inside=mask, voxel=0.4))
    relabeled = relabel_by_mask(masked, SETTINGS)
    assert relabeled.edited_mask is None
    assert np.array_equal(
        extract_body(relabeled, SETTINGS).inside, extract_body(masked, SETTINGS).inside
    )
    assert (relabeled.tissue != volume.tissue).any()
    assert relabel_by_mask(volume, SETTINGS) is volume
