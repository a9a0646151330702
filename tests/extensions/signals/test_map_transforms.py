"""Maps of another space: a transform of each format gives the values of the image in place."""

import h5py
import nibabel as nib
import numpy as np
import pandas as pd
import pytest
from nibabel.affines import apply_affine

from hipsta_bids.cli.main import main
from hipsta_bids.derivatives.results import list_results
from hipsta_bids.errors import InputError
from hipsta_bids.extensions.signals.inputs import attach, map_requests, signals_of
from hipsta_bids.extensions.signals.transforms import read_transform
from hipsta_bids.inputs.scan import InputRequest
from hipsta_bids.inputs.search import find_inputs
from hipsta_bids.phantom import Hemisphere, PhantomSpec, write_dataset

SPEC = PhantomSpec(kind="arc", thickness=2.0, length=8.0)
LPS = np.diag([-1.0, -1, 1, 1])
#: From scanner RAS of the labels to that of the image, mm.
MOTION = np.eye(4)
MOTION[:3, :3] = np.array([[0.96, -0.28, 0], [0.28, 0.96, 0], [0, 0, 1]])
MOTION[:3, 3] = 12, -7, 4


def itk_text(path):
    """ITK's text form: rows of the matrix and the offset, in LPS, from labels to image."""
    matrix = LPS @ MOTION @ LPS
    numbers = " ".join(f"{value:.12g}" for value in [*matrix[:3, :3].ravel(), *matrix[:3, 3]])
    lines = "#Insight Transform File V1.0", "#Transform 0", "Transform: AffineTransform_double_3_3"
    path.write_text("\n".join([*lines, f"Parameters: {numbers}", "FixedParameters: 0 0 0", ""]))


def itk_composite(path):
    """ITK's composite transform of one affine, as of antsRegistration."""
    matrix = LPS @ MOTION @ LPS
    with h5py.File(path, "w") as file:
        group = file.create_group("TransformGroup")
        group.create_group("0")["TransformType"] = [b"CompositeTransform_double_3_3"]
        affine = group.create_group("1")
        affine["TransformType"] = [b"AffineTransform_double_3_3"]
        affine["TransformParameters"] = np.append(matrix[:3, :3].ravel(), matrix[:3, 3])
        affine["TransformFixedParameters"] = np.zeros(3)


def itk_field(path):
    """Displacements of ITK (LPS) from points of the labels to points of the image."""
    affine = np.diag([5.0, 5, 5, 1])
    affine[:3, 3] = -75
    places = apply_affine(affine, np.moveaxis(np.indices((31, 31, 31)), 0, -1))
    moves = (apply_affine(MOTION, places) - places) * [-1, -1, 1]
    image = nib.Nifti1Image(moves[:, :, :, None].astype(np.float32), affine)
    image.header.set_intent("vector")
    nib.save(image, path)


def scaled(image):
    """FSL's coordinates from voxels: mm, the first axis turned round where the determinant is
    positive (https://fsl.fmrib.ox.ac.uk/fsl/docs/#/registration/flirt/faq)."""
    size = np.linalg.norm(image.affine[:3, :3], axis=0)
    matrix = np.diag([*size, 1.0])
    if np.linalg.det(image.affine[:3, :3]) > 0:
        matrix[0, 0], matrix[0, 3] = -size[0], size[0] * (image.shape[0] - 1)
    return matrix


def fsl_text(path, image, reference):
    """FSL's matrix from the image to the reference."""
    to_labels = np.linalg.inv(MOTION)
    voxels = np.linalg.inv(reference.affine) @ to_labels @ image.affine
    np.savetxt(path, scaled(reference) @ voxels @ np.linalg.inv(scaled(image)), fmt="%.12g")


def lta_text(path, image, reference):
    """FreeSurfer's LTA from scanner to scanner (type 1), image to labels."""
    to_labels = np.linalg.inv(MOTION)
    lines = [
        "type      = 1",
        "nxforms   = 1",
        "mean      = 0.0000 0.0000 0.0000",
        "sigma     = 1.0",
    ]
    lines += ["1 4 4", *(" ".join(f"{v:.12e}" for v in row) for row in to_labels)]
    for title, grid in (("src", image), ("dst", reference)):
        size = np.linalg.norm(grid.affine[:3, :3], axis=0)
        center = apply_affine(grid.affine, np.array(grid.shape) / 2)
        axes = (grid.affine[:3, :3] / size).T
        lines += [f"{title} volume info", "valid = 1  # volume info valid", "filename = none"]
        lines += ["volume = " + " ".join(map(str, grid.shape))]
        lines += ["voxelsize = " + " ".join(f"{v:.12e}" for v in size)]
        for name, row in zip(
            ("xras  ", "yras  ", "zras  ", "cras  "), [*axes, center], strict=True
        ):
            lines.append(f"{name} = " + " ".join(f"{v:.12e}" for v in row))
    path.write_text("\n".join([*lines, ""]))


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    root = tmp_path_factory.mktemp("transforms")
    bids = root / "bids"
    write_dataset(bids, [Hemisphere(subject="01", hemi="L", spec=SPEC)], voxel_size=(0.5,) * 3)
    labels = nib.load(next(bids.rglob("lh.hippoAmygLabels*.mgz")))
    index = np.argwhere(np.asanyarray(labels.dataobj) > 0)
    low, high = index.min(axis=0) - 8, index.max(axis=0) + 8
    affine = labels.affine.copy()
    affine[:3, 3] = apply_affine(labels.affine, low)
    field = np.random.default_rng(0).normal(size=high - low).astype(np.float32)
    here, there = nib.Nifti1Image(field, affine), nib.Nifti1Image(field, MOTION @ affine)
    nib.save(here, root / "here.nii.gz")
    nib.save(there, root / "there.nii.gz")
    reference = nib.Nifti1Image(np.zeros((60, 50, 40), np.uint8), np.diag([1.0, 1.2, 1.5, 1]))
    nib.save(reference, root / "reference.nii.gz")
    itk_text(root / "itk.txt")
    fsl_text(root / "fsl.mat", there, reference)
    lta_text(root / "freesurfer.lta", there, reference)
    itk_composite(root / "composite.h5")
    itk_field(root / "field.nii.gz")
    (root / "broken.txt").write_text("#Insight Transform File V1.0\nnothing\n")
    return root, bids


def test_values_are_those_of_the_image_in_place(study):
    root, bids = study
    names = {"itk": "itk.txt", "fsl": "fsl.mat", "lta": "freesurfer.lta"}
    maps = [f"{name}={root}/there.nii.gz" for name in (*names, "without", "broken")]
    transforms = [f"{name}={root}/{file}" for name, file in names.items()]
    transforms.append(f"broken={root}/broken.txt")
    options = "--map", f"here={root}/here.nii.gz", *maps, "--map-transform", *transforms
    options += ("--map-reference", f"fsl={root}/reference.nii.gz", "--n-procs", "1")
    assert main([str(bids), str(root / "out"), "participant", *options]) == 0
    (place,) = list_results(root / "out")

    def values(name):
        return pd.read_csv(place.path("map_table", name), sep="\t")[name]

    for name in names:
        np.testing.assert_allclose(values(name), values("here"), atol=2e-3)
    assert values("without").isna().all()  # the image is elsewhere
    record = place.path("qc").read_text(encoding="utf-8")
    assert "broken.txt: not readable as a transform" in record
    assert not place.path("map_table", "broken").exists()


def test_points_go_from_the_labels_to_the_image(study):
    root, _ = study
    points = np.random.default_rng(1).uniform(-30, 30, (20, 3))
    images = root / "there.nii.gz", root / "reference.nii.gz"
    for file in ("itk.txt", "fsl.mat", "freesurfer.lta", "composite.h5", "field.nii.gz"):
        to_image = read_transform(root / file, *images)
        np.testing.assert_allclose(to_image(points), apply_affine(MOTION, points), atol=1e-4)
    with pytest.raises(InputError, match="needs --map-reference"):
        read_transform(root / "fsl.mat", images[0])


def test_a_pattern_of_a_transform_becomes_a_path_or_a_reason(study):
    root, bids = study
    items = find_inputs(InputRequest(bids_dir=bids)).items
    patterns = [(name, f"{root}/there.nii.gz") for name in ("found", "lacks", "plain")]
    transforms = [("found", f"{root}/i*.txt"), ("lacks", f"{root}/sub-{{subject}}.lta")]
    requests = map_requests(patterns, (), (), transforms, [("found", f"{root}/ref*.nii.gz")])
    assert [source.transform_pattern for source in requests] == [*dict(transforms).values(), None]
    assert not any(source.transform or source.reference for source in requests)
    (item,), notes, warnings = attach(items, requests, None, bids)
    found, lacks, plain = signals_of(item).maps
    assert len(warnings) == 1
    assert (found.transform, found.reference) == (root / "itk.txt", root / "reference.nii.gz")
    assert (found.path, found.missing) == (root / "there.nii.gz", None)
    assert (lacks.path, lacks.transform) == (None, None)
    assert lacks.missing == f"no file {root}/sub-01.lta"
    assert (plain.path, plain.transform) == (root / "there.nii.gz", None)
    assert notes[1] == (
        f"map lacks: 0 of 1 hemispheres have a file; not sub-01 hemi-L ({lacks.missing})"
    )


def test_transforms_of_unknown_maps_are_refused(study, capsys):
    root, bids = study
    options = "--map-transform", f"pet={root}/itk.txt"
    assert main([str(bids), str(root / "refused"), "participant", *options]) == 64
    assert "there is no --map pet" in capsys.readouterr().err
