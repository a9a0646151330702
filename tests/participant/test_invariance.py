"""What may not change a map: voxel axes, file formats, data types, and where the subject lies."""

from dataclasses import replace

import nibabel as nib
import numpy as np
import pytest
from measured_phantoms import measure, measured, middle, spiral

from hipsta_bids.errors import GeometryError
from hipsta_bids.inputs.labels import read_label_volume
from hipsta_bids.inputs.scan import HemisphereInput
from hipsta_bids.phantom import Phantom, encode, rigid_motion
from hipsta_bids.protocols.load import load_protocol

SCHEME = load_protocol("freesurfer")
SPEC = spiral()

#: Promised for any change of the input's form, mm.
PROMISE = 0.02


def read(path):
    return read_label_volume(
        HemisphereInput(
            subject="01",
            session=None,
            hemi="L",
            protocol=SCHEME,
            files=(path,),
            source="tests",
            source_path=path.parent,
            explanation="test",
        )
    )


def draw(**options):
    return Phantom(SPEC).label_volume(SCHEME, **options)


@pytest.fixture(scope="module")
def image():
    """Codes and affine of the reference; the affine is exact in single precision."""
    volume = draw(voxel_size=(0.375, 0.375, 0.375))
    affine = volume.affine.astype(np.float32).astype(np.float64)
    np.testing.assert_array_equal(affine, volume.affine)
    return encode(volume).astype(np.int16), affine


@pytest.fixture(scope="module")
def reference(image, tmp_path_factory):
    path = tmp_path_factory.mktemp("reference") / "labels.nii.gz"
    nib.save(nib.Nifti1Image(*image), path)
    return measure(read(path))


def assert_same_map(maps, reference):
    # Exact: the rounding of sums in another order does not reach the mesh.
    for name in ("thickness", "curvature", "curvature_interior", "curvature_exterior"):
        np.testing.assert_allclose(maps.maps[name], reference.maps[name], atol=1e-6)
    np.testing.assert_allclose(maps.sheet.points, reference.sheet.points, atol=1e-5)  # mm
    np.testing.assert_array_equal(maps.subfield, reference.subfield)
    assert maps.summary == pytest.approx(reference.summary, abs=1e-5, nan_ok=True)


@pytest.mark.parametrize("axes", ["LIA", "PIR", "ASL"])
def test_order_and_direction_of_voxel_axes(tmp_path, image, reference, axes):
    codes, affine = image
    turn = nib.orientations.ornt_transform(
        nib.orientations.io_orientation(affine), nib.orientations.axcodes2ornt(axes)
    )
    turned = nib.Nifti1Image(codes, affine).as_reoriented(turn)
    assert "".join(nib.aff2axcodes(turned.affine)) == axes
    nib.save(turned, tmp_path / "labels.nii.gz")
    assert_same_map(measure(read(tmp_path / "labels.nii.gz")), reference)


@pytest.mark.parametrize(
    ("form", "dtype"),
    [
        ((".nii", nib.Nifti1Image), np.uint8),
        ((".nii.gz", nib.Nifti2Image), np.uint16),
        ((".nii", nib.Nifti1Image), np.float64),
        ((".mgz", nib.MGHImage), np.int32),
        ((".mgh", nib.MGHImage), np.float32),
    ],
)
def test_file_formats_and_data_types_give_the_same_labels(tmp_path, image, form, dtype):
    codes, affine = image
    extension, kind = form
    nib.save(kind(codes.astype(dtype), affine), tmp_path / f"labels{extension}")
    nib.save(nib.Nifti1Image(codes, affine), tmp_path / "reference.nii.gz")
    found, expected = read(tmp_path / f"labels{extension}"), read(tmp_path / "reference.nii.gz")
    np.testing.assert_array_equal(found.tissue, expected.tissue)
    np.testing.assert_array_equal(found.part, expected.part)
    np.testing.assert_allclose(found.affine, expected.affine, atol=1e-6)  # single precision


def test_a_map_from_mgz_is_that_from_nifti(tmp_path, image, reference):
    codes, affine = image
    nib.save(nib.MGHImage(codes.astype(np.int32), affine), tmp_path / "labels.mgz")
    assert_same_map(measure(read(tmp_path / "labels.mgz")), reference)


def test_a_larger_field_of_view(tmp_path, image, reference):
    codes, affine = image
    pad = (21, 8, 13)
    moved = affine.copy()
    moved[:3, 3] -= affine[:3, :3] @ pad
    wider = nib.Nifti1Image(np.pad(codes, [(n, 2 * n) for n in pad]), moved)
    nib.save(wider, tmp_path / "labels.nii.gz")
    assert_same_map(measure(read(tmp_path / "labels.nii.gz")), reference)


@pytest.mark.parametrize("degrees", [(20, -30, 35), (0, 0, 90)])
def test_the_same_voxels_elsewhere(tmp_path, image, reference, degrees):
    """An oblique affine: same codes, another place in the scanner."""
    codes, affine = image
    motion = rigid_motion(degrees, (5.3, -7.1, 4.7))
    nib.save(nib.Nifti1Image(codes, motion @ affine), tmp_path / "labels.nii.gz")
    maps = measure(read(tmp_path / "labels.nii.gz"))
    # Only the mesh is another one, as TetGen does not commute with rotations.
    assert_near(maps, reference, points=0.03)
    back = (maps.sheet.points - motion[:3, 3]) @ motion[:3, :3]
    assert np.linalg.norm(back - reference.sheet.points, axis=-1).mean() < 0.19  # half a voxel, mm


def assert_near(maps, reference, *, points):
    """Same mean as promised; ``points`` is the standard deviation of the difference, mm."""
    difference = maps.thickness - reference.thickness
    assert abs(difference.mean()) <= PROMISE
    assert middle(difference).std() <= points
    assert maps.decision == reference.decision
    assert maps.qc["posterior_end_rule"] == reference.qc["posterior_end_rule"]


@pytest.mark.parametrize("degrees", [(40, 0, 0), (-40, 0, 0), (0, -40, 0), (0, 0, 40)])
def test_a_turned_subject(degrees):
    """The same shape in other voxels; two drawings each have 0.04 mm of roughness."""
    reference = measured(SPEC).maps
    motion = rigid_motion(degrees, (3.3, -2.1, 1.7))
    assert_near(measure(draw(pose=motion)), reference, points=0.07)


@pytest.mark.parametrize("degrees", [(0, 0, 90), (0, 0, 180)])
def test_a_subject_in_an_odd_position(degrees):
    """Feet first, prone, or a specimen: left and right are still told apart."""
    reference = measured(SPEC).maps
    motion = rigid_motion(degrees, (3.3, -2.1, 1.7))
    assert_near(measure(draw(pose=motion)), reference, points=0.07)


def test_the_wrong_side_in_an_odd_position():
    volume = draw(pose=rigid_motion((0, 0, 180), (0, 0, 0)))
    mirrored = replace(volume, affine=np.diag([1.0, -1, 1, 1]) @ volume.affine)
    with pytest.raises(GeometryError, match="as in a right hemisphere"):
        measure(mirrored)


def test_oblique_slices():
    reference = measured(SPEC).maps
    rotation = rigid_motion((12, -20, 9), (0, 0, 0))[:3, :3]
    assert_near(measure(draw(grid_rotation=rotation)), reference, points=0.07)


def test_a_shift_by_part_of_a_voxel():
    reference = measured(SPEC).maps
    shift = rigid_motion((0, 0, 0), (0.13, 0.2, -0.07))
    assert_near(measure(draw(pose=shift)), reference, points=0.06)


def test_a_mirrored_subject(image, reference):
    codes, affine = image
    mirrored = replace(
        draw(voxel_size=(0.375, 0.375, 0.375)), affine=np.diag([-1.0, 1, 1, 1]) @ affine
    )
    np.testing.assert_array_equal(encode(mirrored), codes)
    maps = measure(mirrored, "R")
    np.testing.assert_allclose(maps.thickness, reference.thickness, atol=1e-6)
    np.testing.assert_array_equal(maps.subfield, reference.subfield)
