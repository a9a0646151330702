"""The demonstration from end to end, and what only real maps can show."""

import re

import nibabel as nib
import numpy as np
import pandas as pd
import pytest
from nilearn.surface import load_surf_data, load_surf_mesh

from hipsta_bids.cli import main
from hipsta_bids.cli.commands import compare_with_truth
from hipsta_bids.derivatives.names import OUTPUTS, HemisphereName, output_path
from hipsta_bids.errors import ExitCode

NX, NY = 41, 21
SIDES = [("demo1", "L"), ("demo1", "R"), ("demo2", "L"), ("demo2", "R")]


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    folder = tmp_path_factory.mktemp("with blank") / "demo"
    assert main.main(["demo", str(folder)]) == ExitCode.OK
    return folder


def place(demo, subject, hemi, key):
    name = HemisphereName(subject=subject, session=None, hemi=hemi, seg="freesurfer")
    return demo / "out" / output_path(name, key)


def test_measured_thickness_is_near_the_truth(demo):
    lines = list(compare_with_truth(demo / "bids", demo / "out"))
    assert len(lines) == len(SIDES)
    differences = [float(re.search(r"difference (\S+) mm", line)[1]) for line in lines]
    # the promise of the demonstration
    assert max(map(abs, differences)) <= 0.05, lines


def test_missing_results_are_said_to_be_missing(demo, tmp_path):
    lines = list(compare_with_truth(demo / "bids", tmp_path))
    assert all(line.endswith("not measured (not run)") for line in lines)


@pytest.mark.parametrize(("subject", "hemi"), SIDES)
def test_files_agree_with_each_other(demo, subject, hemi):
    table = pd.read_csv(place(demo, subject, hemi, "sheet"), sep="\t")
    assert table[["x", "y"]].max().tolist() == [NX, NY]
    assert len(table) == NX * NY
    mesh = load_surf_mesh(str(place(demo, subject, hemi, "midthickness_surface")))
    # four decimals in the table, float32 in the surface
    np.testing.assert_allclose(mesh.coordinates, table[["r", "a", "s"]], atol=1e-4)
    thickness = load_surf_data(str(place(demo, subject, hemi, "thickness")))
    np.testing.assert_allclose(thickness, table.thickness, atol=1e-4)
    summary = pd.read_csv(place(demo, subject, hemi, "summary"), sep="\t")
    corners = mesh.coordinates[mesh.faces]
    area = np.linalg.norm(np.cross(*np.moveaxis(corners[:, 1:] - corners[:, :1], 1, 0)), axis=1)
    mean = np.average(thickness[mesh.faces].mean(axis=1), weights=area)
    np.testing.assert_allclose(summary.thickness_mean, mean, atol=1e-3)
    labels = nib.load(place(demo, subject, hemi, "subfields"))
    names = {key: name for key, name in labels.labeltable.get_labels_as_dict().items() if key}
    assert set(load_surf_data(str(place(demo, subject, hemi, "subfields")))) <= set(names)
    assert table.subfield.nunique() == len(names)


@pytest.mark.parametrize(("subject", "hemi"), SIDES)
def test_sheets_face_outward_and_lie_where_they_should(demo, subject, hemi):
    inner, outer = (
        load_surf_mesh(str(place(demo, subject, hemi, f"{name}_surface")))
        for name in ("interior", "exterior")
    )
    corners = np.asarray(outer.coordinates)[np.asarray(outer.faces)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    wall = np.asarray(outer.coordinates) - np.asarray(inner.coordinates)
    along = np.einsum("ij,ij->i", normals, wall[np.asarray(outer.faces)].mean(axis=1))
    # nearly all: at folds of the outermost rows single triangles may turn
    assert (along > 0).mean() > 0.98
    points = np.asarray(outer.coordinates).reshape(NX, NY, 3)
    assert (points[:, -1, 1] > points[:, 0, 1]).all()  # y runs to anterior
    assert (np.sign(points[..., 0]) == {"L": -1, "R": 1}[hemi]).all()


def test_same_input_gives_the_same_bytes(demo, tmp_path):
    options = ("--participant-label", "demo2", "--hemi", "R")
    assert main.main([str(demo / "bids"), str(tmp_path), "participant", *options]) == ExitCode.OK
    name = HemisphereName(subject="demo2", session=None, hemi="R", seg="freesurfer")
    for output in OUTPUTS:
        path = output_path(name, output.key)
        if not output.optional:
            assert (demo / "out" / path).read_bytes() == (tmp_path / path).read_bytes(), path
