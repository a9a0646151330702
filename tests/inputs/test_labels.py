import gzip
import os
import subprocess
import sys
from contextlib import nullcontext
from contextvars import ContextVar
from dataclasses import replace

import nibabel as nib
import numpy as np
import pytest
from input_cases import AFFINE, save
from scipy.spatial.transform import Rotation

from hipsta_bids.errors import InputError, ProtocolError
from hipsta_bids.inputs.labels import MARGIN, label_values, read_label_volume
from hipsta_bids.inputs.scan import HemisphereInput
from hipsta_bids.io import volumes
from hipsta_bids.io.volumes import limit_memory, read_labels, read_scalars
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Part, Tissue

SHAPE = (60, 50, 40)
BLOCK = (slice(20, 30), slice(22, 28), slice(15, 20))


def make_item(*files, protocol="hippunfold", **options):
    return HemisphereInput(
        subject="01",
        session=None,
        hemi=options.pop("hemi", "L"),
        protocol=load_protocol(protocol),
        files=files,
        source="test",
        source_path=files[0].parent,
        explanation="test",
        **options,
    )


def make_labels(dtype=np.int16, code=2):
    data = np.zeros(SHAPE, dtype=dtype)
    data[BLOCK] = code
    data[20, 22, 15] = 1
    return data


def world(volume, tissue):
    """Centers of all voxels of a tissue in RAS mm, sorted."""
    index = np.argwhere(volume.tissue == tissue)
    points = nib.affines.apply_affine(volume.affine, index)
    return points[np.lexsort(points.T)]


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz", "a.mgz", "a.mgh"])
def test_cropping_keeps_every_label_where_it_was(tmp_path, name):
    data = make_labels()
    volume = read_label_volume(make_item(save(tmp_path / name, data)))
    expected = nib.affines.apply_affine(AFFINE, np.argwhere(data == 2))
    # Single precision in the headers of both formats: 1e-5 mm at these distances.
    np.testing.assert_allclose(
        world(volume, Tissue.CA1), expected[np.lexsort(expected.T)], atol=1e-4
    )
    assert volume.tissue.dtype == np.uint8
    assert volume.protocol.name == "hippunfold"


def test_the_margin_is_five_millimeters_as_far_as_the_image_goes(tmp_path):
    volume = read_label_volume(make_item(save(tmp_path / "a.nii", make_labels())))
    # 10 voxels of 0.5 mm on each side of 10, 6 and 5 voxels.
    assert int(MARGIN / 0.5) == 10
    assert volume.tissue.shape == (30, 26, 25)
    data = np.zeros(SHAPE, np.int16)
    data[:3, :3, :3] = 1
    at_border = read_label_volume(make_item(save(tmp_path / "b.nii", data)))
    assert at_border.tissue.shape == (13, 13, 13)


def test_cortical_labels_do_not_widen_the_crop(tmp_path):
    data = make_labels(code=1)  # CA1 of ABC-3T
    data[20, 22, 15] = 8
    alone = read_label_volume(make_item(save(tmp_path / "a.nii", data), protocol="ashsABC3T"))
    data[0, 0, 0] = 9  # entorhinal
    with_cortex = read_label_volume(make_item(save(tmp_path / "b.nii", data), protocol="ashsABC3T"))
    assert with_cortex.tissue.shape == alone.tissue.shape
    np.testing.assert_array_equal(with_cortex.affine, alone.affine)


@pytest.mark.parametrize("dtype", [np.uint8, np.int32, np.float32, np.float64])
def test_types_and_whole_floats_give_the_same_labels(tmp_path, dtype):
    expected = read_label_volume(make_item(save(tmp_path / "a.nii", make_labels())))
    volume = read_label_volume(make_item(save(tmp_path / "b.nii.gz", make_labels(dtype))))
    np.testing.assert_array_equal(volume.tissue, expected.tissue)


@pytest.mark.parametrize("times", [2, 10])  # a tenth is rounded in the header
def test_scaled_integers_are_read_by_their_scaled_values(tmp_path, times):
    image = nib.Nifti1Image(make_labels() * times, AFFINE)
    image.header.set_slope_inter(1 / times, 0)
    raw = (make_labels() * times).tobytes(order="F")
    path = tmp_path / "a.nii"
    with path.open("wb") as stream:
        image.header.set_data_offset(352)
        image.header.write_to(stream)
        stream.write(b"\0" * (352 - stream.tell()) + raw)
    assert label_values(path) == {1, 2}


def test_a_trailing_axis_of_one_is_no_fourth_dimension(tmp_path):
    volume = read_label_volume(make_item(save(tmp_path / "a.nii", make_labels()[..., None])))
    assert volume.tissue.ndim == 3


def test_parts_come_from_the_second_file(tmp_path):
    subfields = np.zeros(SHAPE, np.int32)
    parts = np.zeros(SHAPE, np.int32)
    subfields[BLOCK] = 206
    subfields[20, 22, 15] = 226
    parts[BLOCK] = 231
    parts[25:, :, :] = np.where(subfields[25:] > 0, 232, 0)
    parts[20, 22, 15] = 226
    parts[19, 22, 15] = 232  # nothing in the file with subfields
    item = make_item(
        save(tmp_path / "a.mgz", subfields),
        save(tmp_path / "b.mgz", parts),
        protocol="freesurferCA",
        parts_protocol=load_protocol("freesurferHBT"),
    )
    volume = read_label_volume(item)
    counted = dict(zip(*np.unique(volume.part[volume.tissue > 0], return_counts=True), strict=True))
    assert counted == {Part.HEAD: 150, Part.BODY: 149, Part.TAIL: 1}
    assert not volume.part[volume.tissue == Tissue.BACKGROUND].any()
    assert (volume.tissue == Tissue.CA1).sum() == 299


@pytest.mark.parametrize("other", ["shape", "affine"])
def test_files_on_different_grids_are_not_combined(tmp_path, other):
    parts = np.where(make_labels() > 0, 231, 0).astype(np.int32)
    subfields = np.where(make_labels() > 0, 206, 0).astype(np.int32)
    shifted = AFFINE.copy()
    if other == "shape":
        parts = parts[:-1]
    else:
        shifted[0, 3] += 0.1
    item = make_item(
        save(tmp_path / "a.mgz", subfields),
        save(tmp_path / "b.mgz", parts, shifted),
        protocol="freesurferCA",
        parts_protocol=load_protocol("freesurferHBT"),
    )
    with pytest.raises(InputError, match=r"b\.mgz: its grid is not the grid of a\.mgz") as caught:
        read_label_volume(item)
    assert caught.value.reason == "grid-mismatch"


def test_one_hemisphere_is_taken_from_a_file_of_both(tmp_path):
    data = np.zeros(SHAPE, np.uint8)
    data[5:8, 5:8, 5:8] = 1
    data[40:44, 5:8, 5:8] = 101
    data[40, 5, 5] = 108
    path = save(tmp_path / "a.nii", data)
    left = read_label_volume(make_item(path, protocol="ashsABC3T", bilateral=True))
    right = read_label_volume(make_item(path, protocol="ashsABC3T", bilateral=True, hemi="R"))
    assert (left.tissue == Tissue.CA1).sum() == 27
    assert not (left.tissue == Tissue.SUBICULUM).any()
    assert (right.tissue == Tissue.CA1).sum() == 35
    assert (right.tissue == Tissue.SUBICULUM).sum() == 1
    data[data > 100] = 0
    item = make_item(
        save(tmp_path / "b.nii", data),
        protocol="ashsABC3T",
        bilateral=True,
        hemi="R",
    )
    with pytest.raises(InputError, match="no labels of hemisphere R") as caught:
        read_label_volume(item)
    assert caught.value.reason == "empty-labels"


def test_the_left_hemisphere_may_have_the_higher_codes(tmp_path):
    data = np.zeros(SHAPE, np.uint8)
    data[5:8, 5:8, 5:8] = [[[1, 2, 5]]]
    data[40:44, 5:8, 5:8] = [[[101, 102, 105]]]
    data[40, 5, :2] = 222, 33  # white matter: left alveus, left fornix
    item = make_item(save(tmp_path / "a.nii", data), protocol="cobralab", bilateral=True, hemi="R")
    right = read_label_volume(item)
    left = read_label_volume(replace(item, hemi="L"))
    assert [(side.tissue == Tissue.CA1).sum() for side in (left, right)] == [12, 9]
    assert (left.tissue == Tissue.OTHER).sum() == 1
    assert (right.tissue == Tissue.OTHER).sum() <= 1


def test_labels_that_lack_what_a_tool_always_writes_are_refused(tmp_path):
    data = np.zeros(SHAPE, np.uint8)
    data[20:30, 22:28, 15:19] = [1, 2, 3, 4]  # DG, CA1, CA2 and CA3, subiculum
    path = save(tmp_path / "a.nii", data)
    message = r"no label of SUBICULUM occurs \(found 1, 2, 3, 4\), which hsf always.*fit.*hsfCA23"
    with pytest.raises(ProtocolError, match=message) as caught:
        read_label_volume(make_item(path, protocol="hsf"))
    assert caught.value.reason == "wrong-scheme"
    volume = read_label_volume(make_item(path, protocol="hsfCA23"))
    assert (volume.tissue == Tissue.CA2_3).sum() == (volume.tissue == Tissue.SUBICULUM).sum() == 60
    data[20, 22, 15] = 5  # all fields apart
    with pytest.raises(ProtocolError, match=r"labels 5 are not in the protocol hsfCA23.* and hsf$"):
        read_label_volume(make_item(save(tmp_path / "b.nii", data), protocol="hsfCA23"))


def test_a_problem_found_earlier_is_raised(tmp_path):
    problem = ProtocolError("which atlas?", reason="ambiguous-atlas")
    with pytest.raises(ProtocolError, match="which atlas") as caught:
        read_label_volume(make_item(tmp_path / "a.nii", problem=problem))
    assert caught.value is problem


def truncated(path, size):
    save(path, make_labels())
    path.write_bytes(path.read_bytes()[:size])


def without_size(path):
    save(path, make_labels())
    content = bytearray(path.read_bytes())
    content[4:8] = bytes(4)
    path.write_bytes(content)


def corrupt(path):
    save(path, make_labels())
    path.write_bytes(path.read_bytes()[:-40] + b"\xff" * 40)


def with_values(path, *, scale=1.0, beside=np.nan):
    data = make_labels(np.float32) * np.float32(scale)
    data[31, 28, 20] = beside
    return save(path, data)


#: How to make one bad file of each kind.
BROKEN = {
    "text.nii.gz": lambda path: path.write_text("not an image", encoding="utf-8"),
    "text.nii": lambda path: path.write_text("not an image " * 100, encoding="utf-8"),
    "text.mgh": lambda path: path.write_text("not an image " * 100, encoding="utf-8"),
    "nothing.nii": lambda path: path.touch(),
    "nothing.mgz": lambda path: path.touch(),
    "pipe.nii": os.mkfifo,
    "folder.nii": lambda path: path.mkdir(),
    "truncated.nii.gz": lambda path: truncated(path, 500),
    "truncated.nii": lambda path: truncated(path, 20000),
    "truncated.mgh": lambda path: truncated(path, 20000),
    "truncated.mgz": lambda path: truncated(path, 200),
    "no-size.mgh": without_size,
    "corrupt.nii.gz": corrupt,
    "absent.nii": lambda _: None,
    "4d.nii": lambda path: save(path, np.stack([make_labels()] * 2, axis=-1)),
    "2d.nii": lambda path: save(path, make_labels()[20]),
    "interpolated.nii": lambda path: save(path, make_labels(np.float32) * np.float32(0.75)),
    "nan.nii": lambda path: with_values(path, scale=0.75),
    "infinite.nii": lambda path: with_values(path, beside=np.inf),
    "huge.nii": lambda path: save(path, make_labels(np.float64, code=1e12)),
    "complex.nii": lambda path: save(path, make_labels(np.complex64)),
    "empty.nii.gz": lambda path: save(path, np.zeros(SHAPE, np.int16)),
}


@pytest.mark.parametrize(
    ("name", "reason", "message"),
    [
        *((name, "unreadable-image", "copy or make the file again") for name in list(BROKEN)[:12]),
        ("absent.nii", "unreadable-image", "file not found; check its name"),
        ("4d.nii", "not-3d", "60 x 50 x 40 x 2"),
        ("2d.nii", "not-3d", "50 x 40"),
        ("interpolated.nii", "non-integer-labels", "nearest neighbor"),
        ("nan.nii", "non-integer-labels", "not whole numbers, and some are NaN"),
        ("infinite.nii", "non-integer-labels", "some labels are infinite"),
        ("huge.nii", "non-integer-labels", "not whole numbers"),
        ("complex.nii", "non-integer-labels", "not whole numbers"),
        ("empty.nii.gz", "empty-labels", "all labels are zero"),
    ],
)
def test_a_bad_file_is_refused_in_one_line(tmp_path, name, reason, message):
    path = tmp_path / name
    BROKEN[name](path)
    with pytest.raises(InputError, match=message) as caught:
        read_label_volume(make_item(path))
    assert caught.value.reason == reason
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("slab", [volumes._SLAB, 1])
def test_nan_is_background(tmp_path, monkeypatch, slab):
    monkeypatch.setattr(volumes, "_SLAB", slab)
    data = make_labels(np.float32)
    expected = read_label_volume(make_item(save(tmp_path / "zero.nii", data)))
    path = save(tmp_path / "nan.nii", np.where(data == 0, np.float32(np.nan), data))
    volume = read_label_volume(make_item(path))
    np.testing.assert_array_equal(volume.tissue, expected.tissue)
    assert (volume.start, expected.notes) == (expected.start, ())
    assert volume.notes == ("nan.nii: NaN was read as background (0)",)
    assert label_values(path) == {1, 2}
    with pytest.raises(InputError, match="and some are NaN"):
        label_values(with_values(tmp_path / "other.nii", scale=0.75))
    with pytest.raises(InputError) as caught:
        read_label_volume(make_item(save(path, np.full(SHAPE, np.nan))))
    assert caught.value.reason == "empty-labels"


def test_nifti_2_and_big_endian_files_are_read(tmp_path):
    nib.save(nib.Nifti2Image(make_labels(), AFFINE), tmp_path / "two.nii.gz")
    header = nib.Nifti1Header(endianness=">")
    nib.save(nib.Nifti1Image(make_labels().astype(">i2"), AFFINE, header), tmp_path / "big.nii")
    assert label_values(tmp_path / "two.nii.gz") == label_values(tmp_path / "big.nii") == {1, 2}


def with_affine(path, change):
    """Write an image whose sform is changed behind nibabel's back, which checks on writing."""
    image = nib.Nifti1Image(make_labels(), AFFINE)
    image.header.set_sform(change(AFFINE.copy()), code=1)
    image.header.set_qform(np.eye(4), code=0)
    with path.open("wb") as stream:
        image.header.set_data_offset(352)
        image.header.write_to(stream)
        stream.write(b"\0" * (352 - stream.tell()) + make_labels().tobytes(order="F"))
    return path


def nan_affine(affine):
    affine[1, 1] = np.nan
    return affine


def flat_affine(affine):
    affine[:3, 2] = affine[:3, 1]
    return affine


@pytest.mark.parametrize(
    ("change", "reason", "message"),
    [
        (nan_affine, "bad-affine", "NaN or infinity"),
        (flat_affine, "bad-affine", "singular"),
        (lambda affine: affine * 0, "bad-affine", "singular"),
        (lambda affine: affine @ np.diag([20, 1, 1, 1]), "bad-voxel-size", "10 x 0.5 x 0.5 mm"),
        (lambda affine: affine @ np.diag([1, 1, 0.05, 1]), "bad-voxel-size", "mm; check the unit"),
        (lambda affine: affine * 0.001, "bad-voxel-size", "may be in meters, write it in mm"),
        (lambda affine: affine * 0.08, "bad-voxel-size", "may be in centimeters"),
        (lambda affine: affine * 1000, "bad-voxel-size", "may be in micrometers"),
    ],
)
def test_impossible_affines_are_refused(tmp_path, change, reason, message):
    with pytest.raises(InputError, match=message) as caught:
        read_label_volume(make_item(with_affine(tmp_path / "a.nii", change)))
    assert caught.value.reason == reason


def test_two_sizes_of_voxels_in_one_header_are_refused(tmp_path):
    path = save(tmp_path / "a.nii", make_labels())
    content = bytearray(path.read_bytes())
    pixdim = np.frombuffer(content, dtype="<f4", count=8, offset=76)
    pixdim[3] = 0.504
    path.write_bytes(content)
    read_label_volume(make_item(path))
    pixdim[3] = 0.6
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"0.5 mm by the sform, but 0.5 x 0.5 x 0.6 mm") as caught:
        read_label_volume(make_item(path))
    assert caught.value.reason == "bad-affine"


def with_forms(path, qform, sform=AFFINE, unit="mm"):
    """Write an image with a qform and a sform of their own."""
    image = nib.Nifti1Image(make_labels(), sform)
    image.set_sform(sform, code=1)
    image.set_qform(qform, code=1)
    image.header.set_xyzt_units(unit)
    nib.save(image, path)
    return make_item(path)


def turned(degrees):
    """Turn the image about its first voxel, up to 28 mm from labels and margin."""
    turn = AFFINE.copy()
    turn[:3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix() @ AFFINE[:3, :3]
    return turn


@pytest.mark.parametrize(
    ("qform", "note"),
    [
        (AFFINE, None),
        (nib.affines.from_matvec(np.eye(3), [0.05, 0, 0]) @ AFFINE, None),
        (nib.affines.from_matvec(np.eye(3), [2.3, 0, 0]) @ AFFINE, "2.3 mm and 0.0 degrees"),
        (turned(2), "1.0 mm and 2.0 degrees"),
        (turned(180), "55.2 mm and 180.0 degrees"),
    ],
)
def test_a_qform_elsewhere_than_the_sform_is_noted(tmp_path, qform, note):
    volume = read_label_volume(with_forms(tmp_path / "a.nii", qform))
    np.testing.assert_allclose(volume.affine[:3, :3], AFFINE[:3, :3], atol=1e-6)
    assert len(volume.notes) == (note is not None)
    start = f"a.nii: sform and qform place the labels {note}"
    assert note is None or volume.notes[0].startswith(start)


def test_shear_of_the_sform_is_noted(tmp_path):
    sheared = AFFINE @ np.array([[1, 0.05, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    (note,) = read_label_volume(with_forms(tmp_path / "a.nii", sheared, sheared)).notes
    assert "0.7 mm and 0.0 degrees apart" in note


def test_the_qform_of_half_a_turn_is_rounded(tmp_path):
    """Quaternions near half a turn are rounded to 0.0005 rad, a tenth of a mm at these labels."""
    random = np.random.default_rng(2)
    errors = []
    for number in range(40):
        small = Rotation.from_rotvec(random.normal(size=3) * 10 ** random.uniform(-5, -2))
        linear = small.as_matrix() @ np.diag([-0.5, -0.5, 0.5])
        affine = nib.affines.from_matvec(linear, random.uniform(-100, 100, 3))
        item = with_forms(tmp_path / f"{number}.nii", affine, affine)
        header = nib.load(item.files[0]).header
        errors.append(np.abs(header.get_qform() - header.get_sform())[:3, :3].max() / 0.5)
        assert read_label_volume(item).notes == ()
    assert max(errors) > 1e-4


def test_a_mirrored_qform_is_refused(tmp_path):
    with pytest.raises(InputError, match="mirror images of each other") as caught:
        read_label_volume(with_forms(tmp_path / "a.nii", np.diag([-1, 1, 1, 1]) @ AFFINE))
    assert caught.value.reason == "bad-affine"


@pytest.mark.parametrize(("code", "is_refused"), [(1, True), (0, False)])
def test_sizes_of_one_are_stated_if_there_is_a_qform(tmp_path, code, is_refused):
    image = nib.Nifti1Image(make_labels(), AFFINE)
    image.set_qform(AFFINE, code=code)
    image.header["pixdim"][1:4] = 1
    nib.save(image, tmp_path / "a.nii")
    item = make_item(tmp_path / "a.nii")
    with pytest.raises(InputError, match="1 x 1 x 1 mm by pixdim") if is_refused else nullcontext():
        assert read_label_volume(item).notes == ()


def test_a_qform_without_a_rotation_is_not_used(tmp_path):
    image = nib.Nifti1Image(make_labels(), AFFINE)
    image.set_qform(AFFINE, code=1)
    image.header["quatern_b"] = image.header["quatern_c"] = 0.9
    nib.save(image, tmp_path / "a.nii")
    assert read_label_volume(make_item(tmp_path / "a.nii")).notes == ()


@pytest.mark.parametrize(("unit", "name"), [("meter", "meters"), ("micron", "micrometers")])
def test_another_unit_than_mm_is_noted(tmp_path, unit, name):
    (note,) = read_label_volume(with_forms(tmp_path / "a.nii", AFFINE, unit=unit)).notes
    assert note.startswith(f"a.nii: the header states {name} (xyzt_units), but was read in mm")


def test_nifti_without_orientation_is_refused(tmp_path):
    image = nib.Nifti1Image(make_labels(), AFFINE)
    image.set_sform(AFFINE, code=0)
    image.set_qform(AFFINE, code=0)
    nib.save(image, tmp_path / "a.nii")
    with pytest.raises(InputError, match="no sform and no qform") as caught:
        read_label_volume(make_item(tmp_path / "a.nii"))
    assert caught.value.reason == "bad-affine"


def test_qform_alone_is_enough(tmp_path):
    image = nib.Nifti1Image(make_labels(), None)
    image.set_qform(AFFINE, code=1)
    image.set_sform(None, code=0)
    nib.save(image, tmp_path / "a.nii")
    volume = read_label_volume(make_item(tmp_path / "a.nii"))
    # The quaternion is stored in single precision.
    np.testing.assert_allclose(volume.affine[:3, :3], AFFINE[:3, :3], atol=1e-5)


def test_labels_of_another_protocol_name_those_that_fit(tmp_path):
    data = np.zeros(SHAPE, np.int32)
    data[20:25, 20, 20] = [204, 205, 206, 208, 209]
    path = save(tmp_path / "a.mgz", data)
    with pytest.raises(
        ProtocolError, match=r"a\.mgz: .*the labels fit freesurferCA and freesurferFS60"
    ) as caught:
        read_label_volume(make_item(path, protocol="freesurfer"))
    assert caught.value.reason == "wrong-scheme"
    with pytest.raises(ProtocolError, match="labels 204, 205, 206, 208, 209 are not in") as caught:
        read_label_volume(make_item(path, protocol="ashsPMC"))
    assert caught.value.reason == "unknown-labels"


def test_label_values_lists_what_occurs(tmp_path):
    assert label_values(save(tmp_path / "a.mgz", make_labels(np.int32))) == {1, 2}
    with pytest.raises(InputError, match="all labels are zero"):
        label_values(save(tmp_path / "b.nii", np.zeros(SHAPE, np.uint8)))


def peak_memory(path):
    """Peak memory, MB, of a process of its own that lists and reads labels."""
    code = (
        "import sys; from pathlib import Path\n"
        "from hipsta_bids.inputs.labels import label_values\n"
        "from hipsta_bids.io.volumes import read_labels\n"
        "from hipsta_bids.participant.job import peak_memory\n"
        "path = Path(sys.argv[1]); assert label_values(path) == {1, 2}\n"
        "image = read_labels(path, 1.0); assert (image.data > 0).sum() == 2000\n"
        "print(*image.shape, int(peak_memory() / 2**20))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True
    )
    *shape, peak = map(int, done.stdout.split())
    assert shape == [600, 600, 900]
    return peak


def write_large(path):
    """Labels in 600 x 600 x 900 voxels (324 MB), written without holding them."""
    header = nib.Nifti1Header()
    header.set_data_shape((600, 600, 900))
    header.set_data_dtype(np.uint8)
    header.set_sform(np.diag([0.3, 0.3, 0.3, 1.0]), code=1)
    header["vox_offset"] = 352
    header["magic"] = b"n+1"
    plane = np.zeros((600, 600), np.uint8, order="F")
    labeled = plane.copy()
    labeled[300:310, 200:210], labeled[310:320, 200:210] = 1, 2
    with gzip.open(path, "wb", compresslevel=1) as stream:
        stream.write(header.binaryblock + bytes(4))
        for number in range(900):
            stream.write((labeled if 500 <= number < 510 else plane).tobytes(order="F"))


def test_large_images_are_read_by_their_labels(tmp_path):
    path = tmp_path / "large.nii.gz"
    write_large(path)
    small = save(tmp_path / "small.nii.gz", make_labels(np.uint8))
    assert read_labels(path).data.shape == (20, 10, 10)
    assert read_labels(path, 0.9).start == (297, 197, 497)
    np.testing.assert_array_equal(
        read_labels(path).file_affine[:3, 3], np.array([300, 200, 500]) * np.float32(0.3)
    )
    assert label_values(small) == {1, 2}
    assert peak_memory(path) < 250  # the whole image has 309


def test_slabs_give_what_the_whole_gives(tmp_path, monkeypatch):
    path = save(tmp_path / "a.nii.gz", make_labels(np.int32))
    whole = read_labels(path, 1.0)
    monkeypatch.setattr(volumes, "_SLAB", 5000)
    parts = read_labels(path, 1.0)
    np.testing.assert_array_equal(parts.data, whole.data)
    assert parts.start == whole.start
    assert label_values(path) == {1, 2}


def test_labels_that_fill_a_huge_part_are_refused(tmp_path, monkeypatch):
    path = save(tmp_path / "a.nii.gz", make_labels(np.int32))
    monkeypatch.setattr(volumes, "MOST_LABELED", 100)
    with pytest.raises(InputError, match="are these labels") as caught:
        read_labels(path)
    assert caught.value.reason == "image-too-large"


@pytest.mark.parametrize("kind", [np.complex64, [("R", "u1"), ("G", "u1"), ("B", "u1")]])
def test_labels_that_are_no_numbers(tmp_path, kind):
    path = save(tmp_path / "a.nii", np.zeros(SHAPE, np.dtype(kind)))
    with pytest.raises(InputError, match="colors or complex numbers") as caught:
        label_values(path)
    assert caught.value.reason == "non-integer-labels"


def test_memory_bounds_slabs_and_what_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(volumes, "_memory", ContextVar("memory", default=np.inf))
    path = save(tmp_path / "a.nii.gz", make_labels(np.int16))  # slices of 3000 voxels, 22 B each
    whole = read_labels(path, 1.0)
    slabs = []
    read = volumes._voxels
    monkeypatch.setattr(volumes, "_voxels", lambda *a: slabs.append(read(*a)) or slabs[-1])
    limit_memory(8 * 2.5 * 3000 * 22e-9)  # an eighth: two slices
    np.testing.assert_array_equal(read_labels(path, 1.0).data, whole.data)
    assert [part.shape[2] for part in slabs[:-1]] == [2] * 20
    assert label_values(path) == {1, 2}
    limit_memory(2 * 2999 * 22e-9)  # a half: less than a slice
    del slabs[:]
    for reader in (read_labels, label_values):
        with pytest.raises(InputError, match=r"one slice .* raise --mem") as caught:
            reader(path)
        assert caught.value.reason == "image-too-large"
    assert not slabs


def test_memory_bounds_the_part_with_labels(tmp_path, monkeypatch):
    monkeypatch.setattr(volumes, "_memory", ContextVar("memory", default=np.inf))
    labels = make_labels(np.int16)
    labels[0, 0, 0] = labels[-1, -1, -1] = 2  # all of it: 120 000 voxels
    path = save(tmp_path / "a.nii.gz", labels)
    limit_memory(2 * 119_999 * 22e-9)
    with pytest.raises(InputError, match=r"the part with labels .* raise --mem") as caught:
        read_labels(path)
    assert caught.value.reason == "image-too-large"
    limit_memory(2 * 120_001 * 22e-9)
    assert read_labels(path).data.shape == SHAPE
    limit_memory(None)
    assert read_labels(path).data.shape == SHAPE


def test_voxels_beyond_two_gigabytes_are_read_where_they_are(tmp_path):
    path, edge = tmp_path / "a.mgh", 1300
    header = nib.freesurfer.MGHImage(np.zeros((1, 1, 1), np.uint8), np.eye(4)).header
    header.set_data_shape((edge, edge, edge))
    with path.open("wb") as file:  # the rest is a hole, which takes no space
        header.writehdr_to(file)
        file.seek(header.get_data_offset() + edge**3 - 3)
        file.write(bytes([1, 2, 3]))
    last = (slice(edge - 4, edge), slice(edge - 1, edge), slice(edge - 1, edge))
    assert read_labels(path, part=last).data.ravel().tolist() == [0, 1, 2, 3]


def test_memory_bounds_maps_of_several_volumes(tmp_path, monkeypatch):
    monkeypatch.setattr(volumes, "_memory", ContextVar("memory", default=np.inf))
    path = tmp_path / "map.nii"
    nib.save(nib.Nifti1Image(np.ones((20, 20, 20, 50), np.float32), np.eye(4)), path)
    points = np.array([[5.0, 5, 5], [8, 8, 8]])  # 6 x 6 x 6 voxels, 12 B each
    limit_memory(2 * 12 * 6**3 * 50e-9 - 1e-9)
    said = r"the part round the sheet .* give fewer volumes"
    with pytest.raises(InputError, match=said) as caught:
        read_scalars(path, points)
    assert caught.value.reason == "image-too-large"
    limit_memory(2 * 12 * 6**3 * 50e-9 + 1e-9)
    assert read_scalars(path, points).values.shape == (6, 6, 6, 50)
