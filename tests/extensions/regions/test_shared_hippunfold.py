"""HippUnfold's labels and surfaces: its own walls are known, so thickness can be compared."""

import re
from functools import cache
from pathlib import Path

import nibabel as nib
import numpy as np
import pandas as pd
import pytest
from hippunfold_like import write_map, write_surface
from measured_phantoms import measure
from scipy.spatial import cKDTree

from hipsta_bids.cli.main import main
from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.sheet import sheet_levels
from hipsta_bids.inputs.labels import read_label_volume
from hipsta_bids.inputs.scan import HemisphereInput
from hipsta_bids.inputs.search import InputRequest, find_hemispheres
from hipsta_bids.io.gifti import read_mesh
from hipsta_bids.io.hippunfold import unfolded_shares
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.settings import Settings
from validation import hippunfold

DATA = (Path(__file__).parents[3] / ".." / "shared" / "data" / "hippunfold").resolve()
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="shared test data not found")

TEMPLATES = DATA / "templates"


@cache
def person(hemi):
    """Our maps of the person, and HippUnfold's thickness at our points, mm."""
    (item,) = find_hemispheres(InputRequest(bids_dir=DATA, hemis=(hemi,)))
    return hippunfold.measure_person(item)


def test_thickness_of_a_person_is_hippunfolds_but_for_where_the_walls_are():
    maps, own = person("R")  # the suite of HippUnfold has the left side, too
    difference = maps.thickness - own
    # Its walls lie inside its labels: labels are 0.18 to 0.19 mm thicker, volume over area.
    assert 0.1 < difference.mean() < 0.25
    assert difference.std() < 0.25  # with the SRLM in the sheet 0.84 and 0.91
    assert np.corrcoef(maps.thickness.ravel(), own.ravel())[0, 1] > 0.6  # 0.33
    assert maps.qc["layer_voxels"] == 0


def test_the_body_of_a_person_ends_where_the_dentate_gyrus_does():
    maps, own = person("R")
    assert maps.qc["posterior_end_rule"] == "core"
    assert maps.flags == ()
    excess = (maps.thickness - own).mean(axis=0)
    # The end row was 1.9 and 3.3 mm too thick with the paper's rule alone.
    assert excess[0] < 0.7
    assert excess.max() == excess[0]


def test_labels_drawn_from_hippunfolds_walls_have_its_thickness():
    """Of one of the four sides; the others are in the suite of HippUnfold."""
    maps, own = hippunfold.measure_template((TEMPLATES / "tpl-OASIS30ANTs", "L"))
    difference = maps.thickness - own
    assert maps.qc["posterior_end_rule"] == "core"
    # Phantoms: a thirteenth of a voxel; here, the nearest vertex is not on the same line.
    assert abs(difference.mean()) < 0.03
    assert difference.std() < 0.2
    assert difference.mean(axis=0).max() < 0.5  # no row runs away


@pytest.mark.parametrize("hemi", ["L", "R"])
def test_labels_of_a_millimeter_are_refused(hemi):
    name = f"tpl-OASIS30ANTs_hemi-{hemi}_space-T1w_desc-subfields_dseg.nii.gz"
    item = HemisphereInput(
        subject="x",
        session=None,
        hemi=hemi,
        protocol=load_protocol("hippunfold"),
        files=(TEMPLATES / "tpl-OASIS30ANTs" / name,),
        source="hippunfold",
        source_path=DATA,
        explanation="",
    )
    volume = read_label_volume(item)
    with pytest.raises(GeometryError, match=r"voxels of 1\.00 mm are too") as caught:
        measure(volume, hemi)
    assert caught.value.reason == "sheet-too-thin"


MAPS = DATA.parent / "hippomaps"
FLAT = "tpl-avg_space-{}_den-{}_label-{}_midthickness.surf.gii"
#: Label, densities, and the error that the coarser one allows: the dentate gyrus has 8 rows of
#: vertices over its fold in 2k, and 4 in 512.
MOVES = [
    ("hipp", "0p5mm", "2k", 0.01),
    ("hipp", "0p5mm", "512", 0.01),
    ("hipp", "2k", "512", 0.01),
    ("dentate", "0p5mm", "2k", 0.03),
    ("dentate", "0p5mm", "512", 0.08),
]


def canonical(density, label):
    return read_mesh(MAPS / FLAT.format("canonical", density, label)).points


@pytest.mark.parametrize(("label", "dense", "coarse", "most"), MOVES)
def test_maps_move_between_versions_of_hippunfold(tmp_path, label, dense, coarse, most):
    """What has one canonical position is one point: version 1 (mm) and version 2 (vertices)."""
    start, goal = canonical(dense, label), canonical(coarse, label)
    values = np.sin(start[:, 1] / 6) + 0.05 * start[:, 0]
    surfaces = [MAPS / FLAT.format("unfold", one, label) for one in (dense, coarse)]
    there, moved, back = (tmp_path / f"hemi-L_{n}.shape.gii" for n in ("a", "b", "c"))
    write_map(there, values)
    for source, out, (flat, target) in (
        (there, moved, surfaces),
        (moved, back, surfaces[::-1]),
    ):
        arguments = source, out, "--surface", flat, "--to-surface", target
        assert main(["resample", *map(str, arguments)]) == 0
    found, returned = (nib.load(path).agg_data() for path in (moved, back))
    nearest = cKDTree(start).query(goal)[1]
    assert np.corrcoef(found, values[nearest])[0, 1] >= 0.99
    error = (returned - values) / np.ptp(values)
    assert np.sqrt(np.mean(error**2)) < most


def test_labels_of_surfaces_that_are_moved_have_to_agree(tmp_path, capsys):
    path = tmp_path / "hemi-L_a.shape.gii"
    write_map(path, np.ones(7262))
    flat, dentate = (
        str(MAPS / FLAT.format("unfold", *name)) for name in (("0p5mm", "hipp"), ("2k", "dentate"))
    )
    out = str(tmp_path / "out.shape.gii")
    assert main(["resample", str(path), out, "--surface", flat, "--to-surface", dentate]) == 65
    assert "give surfaces of one label" in capsys.readouterr().err
    assert main(["resample", str(path), out, "--surface", dentate]) == 65
    assert "the sheet has no dentate" in capsys.readouterr().err


@pytest.mark.parametrize("label", ["hipp", "dentate"])
@pytest.mark.parametrize("order", ["x first", "y first", "y first, left"])
def test_maps_are_the_same_on_canonical_surfaces_by_both_orders_of_axes(tmp_path, label, order):
    """HippUnfold 2 swapped x and y late; then x of left surfaces has the other sign."""
    start, goal = canonical("0p5mm", label), read_mesh(MAPS / FLAT.format("unfold", "2k", label))
    assert np.ptp(goal.points[:, 1]) > np.ptp(goal.points[:, 0])  # the published file: y is long
    turned = {
        "x first": goal.points[:, [1, 0, 2]],
        "y first": goal.points,
        "y first, left": goal.points * [-1, 1, 1],
    }[order]
    moved = []
    values, source = np.sin(start[:, 1] / 6) + 0.05 * start[:, 0], tmp_path / "hemi-L_a.shape.gii"
    write_map(source, values)
    for number, points in enumerate((goal.points, turned)):
        flat = tmp_path / f"{number}_unfold.surf.gii"
        write_surface(flat, points, goal.triangles)
        out = tmp_path / f"hemi-L_{number}.shape.gii"
        dense = MAPS / FLAT.format("unfold", "0p5mm", label)
        given = source, out, "--surface", dense, "--to-surface", flat
        assert main(["resample", *map(str, given)]) == 0
        moved.append(nib.load(out).agg_data())
    np.testing.assert_allclose(moved[1], moved[0], atol=1e-6)  # of 32-bit floats
    nearest = cKDTree(start).query(canonical("2k", label))[1]
    assert np.corrcoef(moved[1], values[nearest])[0, 1] >= 0.99


@pytest.mark.parametrize("density", ["0p5mm", "2k", "512"])
def test_all_vertices_of_both_versions_have_a_value_of_a_whole_sheet(tmp_path, density, capsys):
    x, y, _ = sheet_levels(Settings().sheet, "whole")
    rows = [
        (i + 1, j + 1, (1 + at) / 2) for i, at in enumerate(x) for j in range(len(y))
    ]  # the share of the way to CA3
    sheet = tmp_path / "sub-01_hemi-L_seg-hippunfold_label-whole_desc-sheet_morph.tsv"
    pd.DataFrame(rows, columns=["x", "y", "thickness"]).to_csv(sheet, sep="\t", index=False)
    flat, out = MAPS / FLAT.format("unfold", density, "hipp"), tmp_path / "hemi-L_a.shape.gii"
    assert main(["resample", str(sheet), str(out), "--surface", str(flat)]) == 0
    _, shares = unfolded_shares(read_mesh(flat))
    expected = np.clip(shares[:, 1], (1 + x[0]) / 2, (1 + x[-1]) / 2)
    np.testing.assert_allclose(nib.load(out).agg_data(), expected, atol=1e-6)  # 32-bit floats
    assert "0% without a value; " in capsys.readouterr().out
    text = nib.load(out).darrays[0].meta["Description"]
    far = float(re.search(r"up to ([\d.]+) mm", text)[1])
    assert 0.8 < far < 1.1  # 1 mm between grid and edge, and up to half a row of 0.8 mm
