"""Edited labels and masks as they are read, on any grid."""

import gzip
import tracemalloc

import nibabel as nib
import numpy as np
import pytest
from input_cases import AFFINE, save

from hipsta_bids.errors import HipstaError
from hipsta_bids.inputs.labels import read_label_volume
from hipsta_bids.inputs.scan import Edit, HemisphereInput
from hipsta_bids.io.volumes import mask_bytes
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Part, Tissue
from hipsta_bids.types import BodyMask

SHAPE = (60, 50, 40)
BLOCK = (slice(20, 30), slice(22, 28), slice(15, 20))
CROP = (10, 12, 5)  # 5 mm, 10 voxels, before the block


def block(code=1, dtype=np.int16):
    data = np.zeros(SHAPE, dtype=dtype)
    data[BLOCK] = code
    return data


def make_item(*files, edits=(), protocol="hippunfold", **options):
    return HemisphereInput(
        subject="01",
        session=None,
        hemi="L",
        protocol=load_protocol(protocol),
        files=files,
        source="test",
        source_path=files[0].parent,
        explanation="test",
        edits=tuple(
            Edit(kind=kind, path=path, source="edited", source_path=path.parent)
            for kind, path in edits
        ),
        **options,
    )


@pytest.fixture
def labels(tmp_path):
    return save(tmp_path / "a.nii.gz", block())


def read_mask(labels, data, affine=AFFINE):
    path = save(labels.with_name("m.nii.gz"), data, affine)
    return read_label_volume(make_item(labels, edits=[("mask", path)])).edited_mask


def place(inside):
    """The block's mask on the cropped grid, as seen from the file."""
    return np.argwhere(inside) + CROP


@pytest.mark.parametrize("value", [1, 255, 0.5])
def test_a_mask_on_the_labels_grid_is_taken_as_it_is(labels, value):
    mask = block(value, np.float32)
    mask[20, 22, 15] = 0
    found = read_mask(labels, mask)
    np.testing.assert_array_equal(place(found.inside), np.argwhere(mask))
    assert found.voxel == pytest.approx(0.5)


def test_a_coarser_mask_is_interpolated(labels):
    """Every second voxel, shifted by none: halfway between, the rounding goes to the mask."""
    coarse = AFFINE @ np.diag([2.0, 2, 2, 1])
    found = read_mask(labels, block()[::2, ::2, ::2], coarse)
    index = place(found.inside)
    # Coarse nodes 20 to 28, 22 to 26 and 16 to 18 are inside; halfway to the next is half.
    np.testing.assert_array_equal(index.min(axis=0), [19, 21, 15])
    np.testing.assert_array_equal(index.max(axis=0), [29, 27, 19])
    assert found.voxel == pytest.approx(1.0)


def test_a_mask_may_be_larger_or_smaller_than_the_labels(labels):
    padded = AFFINE.copy()
    padded[:3, 3] -= AFFINE[:3, :3] @ [7, 7, 7]
    found = read_mask(labels, np.pad(block(), 7), padded)
    np.testing.assert_array_equal(place(found.inside), np.argwhere(block()))
    cut = AFFINE.copy()
    cut[:3, 3] += AFFINE[:3, :3] @ [20, 22, 15]
    found = read_mask(labels, block()[BLOCK], cut)
    np.testing.assert_array_equal(place(found.inside), np.argwhere(block()))


@pytest.mark.parametrize(
    ("data", "reason", "message"),
    [
        (
            block() + np.int16(2) * (np.arange(40) == 16),
            "edited-mask-not-binary",
            "this has 0, 1, 2, 3",
        ),
        (np.where(block() > 0, np.nan, 0.0), "edited-mask-empty", "is empty"),
        (np.where(block() > 0, np.inf, 0.0), "non-integer-labels", "infinite"),
        (block() + np.int16(1), "edited-mask-not-binary", "this has 1, 2"),
        (np.zeros(SHAPE, np.uint8), "edited-mask-empty", "is empty"),
        (np.zeros((4, 4, 4, 2), np.uint8), "not-3d", "one 3-D volume"),
    ],
)
def test_masks_that_cannot_be_meant(labels, data, reason, message):
    with pytest.raises(HipstaError, match=message) as caught:
        read_mask(labels, data)
    assert caught.value.reason == reason
    assert "m.nii.gz" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_nan_around_a_mask_is_background_and_noted(labels):
    path = save(labels.with_name("m.nii.gz"), np.where(block() > 0, np.float32(1), np.nan))
    volume = read_label_volume(make_item(labels, edits=[("mask", path)]))
    np.testing.assert_array_equal(place(volume.edited_mask.inside), np.argwhere(block()))
    assert volume.notes == ("m.nii.gz: NaN was read as background (0)",)


def test_a_mask_that_is_no_image(labels):
    path = labels.with_name("m.nii.gz")
    path.write_bytes(b"no image")
    with pytest.raises(HipstaError, match="cannot be read as an image") as caught:
        read_label_volume(make_item(labels, edits=[("mask", path)]))
    assert caught.value.reason == "unreadable-image"


def test_edited_labels_replace_the_labels(labels):
    edited = block(2)
    path = save(labels.with_name("e.mgz"), edited.astype(np.int32))
    volume = read_label_volume(make_item(labels, edits=[("labels", path)]))
    assert set(np.unique(volume.tissue)) == {0, Tissue.CA1}
    assert (volume.start, volume.file_shape) == (CROP, SHAPE)


def test_edited_labels_on_another_grid_keep_the_parts_of_the_second_file(tmp_path):
    """FreeSurfer's CA hierarchy with HBT beside it, edited at half the voxel size."""
    subfields, parts = block(206, np.int32), block(231, np.int32)
    parts[25:30, 22:28, 15:20] = 232
    fine = AFFINE @ np.diag([0.5, 0.5, 0.5, 1.0])
    fine[:3, 3] += AFFINE[:3, :3] @ [-0.25, -0.25, -0.25]
    item = make_item(
        save(tmp_path / "a.mgz", subfields),
        save(tmp_path / "b.mgz", parts),
        protocol="freesurferCA",
        parts_protocol=load_protocol("freesurferHBT"),
    )
    before = read_label_volume(item)
    doubled = subfields.repeat(2, axis=0).repeat(2, axis=1).repeat(2, axis=2)
    path = save(tmp_path / "e.nii.gz", doubled, fine)
    after = read_label_volume(
        make_item(
            *item.files,
            protocol="freesurferCA",
            parts_protocol=item.parts_protocol,
            edits=[("labels", path)],
        )
    )
    for part in (Part.HEAD, Part.BODY):
        count = np.count_nonzero(before.part == part)
        assert count == 150
        assert np.count_nonzero(after.part == part) == 8 * count


def test_edited_labels_elsewhere_are_refused(labels):
    moved = AFFINE.copy()
    moved[0, 3] += 40
    path = save(labels.with_name("e.nii.gz"), block(), moved)
    item = make_item(labels, edits=[("labels", path)])
    with pytest.raises(HipstaError, match="100% of the edited labels lie outside") as caught:
        read_label_volume(item)
    assert caught.value.reason == "edited-elsewhere"


def test_broken_labels_can_be_replaced(labels):
    path = save(labels.with_name("e.nii.gz"), block())
    labels.write_bytes(b"broken")
    volume = read_label_volume(make_item(labels, edits=[("labels", path)]))
    assert np.count_nonzero(volume.tissue) == 300


@pytest.mark.parametrize(
    ("data", "reason"), [(block(99), "unknown-labels"), (block(1.5, float), "non-integer-labels")]
)
def test_edited_labels_are_checked_like_others(labels, data, reason):
    path = save(labels.with_name("e.nii.gz"), data)
    with pytest.raises(HipstaError, match=r"e\.nii\.gz") as caught:
        read_label_volume(make_item(labels, edits=[("labels", path)]))
    assert caught.value.reason == reason


def test_written_masks_lie_where_the_body_is(tmp_path):
    body = block() > 0
    start, shape = (2, 0, 7), (body.shape[0] + 5, body.shape[1], body.shape[2] + 9)
    whole = np.zeros(shape, np.uint8)
    whole[tuple(slice(a, a + n) for a, n in zip(start, body.shape, strict=True))] = body
    content = mask_bytes(BodyMask(inside=body, start=start, shape=shape, affine=AFFINE))
    path = tmp_path / "m.nii.gz"
    path.write_bytes(content)
    image = nib.load(path)
    np.testing.assert_array_equal(np.asarray(image.dataobj), whole)
    for affine in (image.get_sform(), image.get_qform()):
        np.testing.assert_allclose(affine, AFFINE, atol=1e-5)  # single precision
    assert (int(image.header["sform_code"]), int(image.header["qform_code"])) == (1, 1)
    assert image.get_data_dtype() == np.uint8
    # Slice by slice or at once, the bytes are the same.
    expected = nib.Nifti1Image(whole, None, image.header).to_bytes()
    assert content == gzip.compress(expected, compresslevel=6, mtime=0)


def test_masks_need_memory_for_the_body_not_for_the_file():
    shape = (700, 700, 200)  # 98 MB
    mask = BodyMask(inside=block() > 0, start=(300, 300, 90), shape=shape, affine=AFFINE)
    tracemalloc.start()
    try:
        mask_bytes(mask)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 5e6
