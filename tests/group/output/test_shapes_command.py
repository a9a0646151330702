"""Average surfaces and cross-sections of the group level, from files to files."""

import json
import os
import subprocess
import sys
from pathlib import Path

import nibabel as nib
import numpy as np
import pandas as pd
import pytest
from extension_marks import needs
from small_cohorts import NODES, PLAN, place_of, write_dataset

from hipsta_bids.cli.main import main
from hipsta_bids.io import files, gifti

AVERAGE = "hemi-L_desc-average_midthickness.surf.gii"
RADII = np.array([3.0, 4.0, 5.0])


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Left sheets are tubes that lie anywhere; patients' are smaller. The right has no surfaces."""
    folder = tmp_path_factory.mktemp("shapes")
    data, out = write_dataset(folder)
    random = np.random.default_rng(0)
    u = np.repeat(np.linspace(0, 1.5 * np.pi, NODES[0]), NODES[1])
    y = np.tile(np.linspace(-8, 8, NODES[1]), NODES[0])
    triangles = gifti.sheet_triangles(*NODES)
    for i in range(sum(PLAN.sizes)):
        size = 1.0 if i < PLAN.sizes[0] else 0.8
        place = place_of(out, f"{i + 1:02d}", "L")
        move = random.normal(0, 20, 3)
        for radius, key in zip(RADII, ("interior", "midthickness", "exterior"), strict=True):
            points = np.stack([-radius * np.sin(u), y, radius * np.cos(u)], axis=1) * size + move
            content = gifti.surface_bytes(
                points, triangles, hemi="L", secondary=None, unfolded=False
            )
            files.write_bytes(place.path(f"{key}_surface"), content)
    place_of(out, "03", "L").path("exterior_surface").write_bytes(b"damaged")
    settings = folder / "group.toml"
    settings.write_text("[classification]\nrepeats = 1\nfolds = 2\n")
    options = ["--settings", str(settings), "--align", "none", "--name", "shapes"]
    assert main([str(data), str(out), "group", *options]) == 0
    return out / "group" / "shapes"


def test_average_surface_is_that_of_all_and_takes_the_maps(results):
    image = nib.load(results / "hemi-L_desc-average_midthickness.surf.gii")
    points, triangles = image.agg_data()
    patients = PLAN.sizes[1] / (sum(PLAN.sizes) - 1)  # one of the others is damaged
    size = 1 - 0.2 * patients
    flat = points.reshape(*NODES, 3)
    # Distances from end to end of the long axis, and across the tube (chord of 270 degrees).
    assert np.linalg.norm(flat[:, -1] - flat[:, 0], axis=1) == pytest.approx(16 * size, rel=1e-4)
    chord = np.linalg.norm(flat[-1] - flat[0], axis=1)
    assert chord == pytest.approx(np.sqrt(2) * RADII[1] * size, rel=1e-4)
    values = nib.load(results / "hemi-L_contrast-CNAD_stat-t_desc-thickness_statmap.shape.gii")
    assert len(values.darrays[0].data) == len(points)
    peaks = pd.read_table(results / "peaks.tsv").query("hemi == 'L'")
    at = (peaks.node_x - 1) * NODES[1] + peaks.node_y - 1
    np.testing.assert_allclose(peaks[["x_mm", "y_mm", "z_mm"]], points[at], atol=6e-4)  # rounded
    assert pd.read_table(results / "peaks.tsv").query("hemi == 'R'").x_mm.isna().all()
    corners = points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = (corners.mean(axis=1) - _center(flat)) * [1, 0, 1]
    assert (np.sum(normals * outward, axis=1) > 0).all()
    assert not (results / "hemi-R_desc-average_midthickness.surf.gii").exists()


@needs("export")
def test_template_is_a_dataset_to_which_others_are_registered(results, tmp_path, capsys):
    """Registration to the dataset is that to the file of the analysis."""
    data, out = results.parents[2] / "bids", results.parents[1]
    line = [str(data), str(out), "group", "--formula", "group", "--measures", "thickness"]
    line += ["--no-classification", "--no-reports", "--name"]
    assert main([*line, "made"]) == 0
    made, root = out / "group" / "made", tmp_path / "tpl"
    command = ["export", str(made), str(root), "--format", "template", "--name", "lab"]
    assert main(command) == 0
    assert "3 files" in capsys.readouterr().out
    start = root / "tpl-lab" / "anat"
    copied = [start / "tpl-lab_hemi-L_midthickness.surf.gii", made.joinpath(AVERAGE)]
    first, second = (nib.load(path).agg_data() for path in copied)
    np.testing.assert_array_equal(first[0], second[0])
    for template, name in ((root, "dataset"), (made / "template.json", "file")):
        assert main([*line, name, "--template", str(template)]) == 0
    maps = [out / "group" / name / "warps.tsv" for name in ("dataset", "file")]
    assert maps[0].read_bytes() == maps[1].read_bytes()
    record = json.loads((out / "group" / "dataset" / "analysis.json").read_text())
    assert record["inputs"]["template"] == str(root)
    validator = Path(sys.executable).with_name("bids-validator-deno")
    environment = os.environ | {"DENO_DIR": str(tmp_path / "deno"), "DENO_NO_UPDATE_CHECK": "1"}
    call = [str(validator), str(root), "--json"]
    done = subprocess.run(call, capture_output=True, text=True, check=False, env=environment)
    issues = json.loads(done.stdout)["issues"]["issues"]
    assert [one["code"] for one in issues if one["severity"] == "error"] == []
    # A second template of the dataset: the option has to name a file.
    assert main([*command[:-1], "other"]) == 0
    assert main([*line, "two", "--template", str(root)]) == 64
    assert "has 2 templates of registration" in capsys.readouterr().err


@needs("export")
def test_template_is_not_written_into_other_datasets(results, tmp_path, capsys):
    data, out = results.parents[2] / "bids", results.parents[1]
    command = ["export", str(results), "--format", "template"]
    before = (out / "dataset_description.json").read_bytes()
    assert main([*command, str(out)]) == 64
    assert "is another dataset" in capsys.readouterr().err
    assert (out / "dataset_description.json").read_bytes() == before
    assert main(["export", str(data), str(tmp_path / "t"), "--format", "template"]) == 66
    assert main([*command, str(tmp_path / "t"), "--name", "my_lab"]) == 64


def _center(flat):
    """Center of the tube: as far from all nodes of a section."""
    x, z = flat[:, 0, 0], flat[:, 0, 2]
    matrix = np.column_stack([2 * x, 2 * z, np.ones(len(x))])
    a, b, _ = np.linalg.lstsq(matrix, x**2 + z**2, rcond=None)[0]
    return np.array([a, 0.0, b])


def test_cross_sections_of_the_groups_are_drawn(results):
    drawing = (results / "figures" / "sections.svg").read_text()
    assert ">CN (n = 15)<" in drawing
    assert ">AD (n = 14)<" in drawing
    assert ">CA1<" in drawing
    assert "right" not in drawing
