"""``hipsta-bids resample``: maps of the whole sheet on HippUnfold's unfolded surfaces, and back."""

import nibabel as nib
import numpy as np
import pandas as pd
import pytest
from hippunfold_like import write_cifti, write_map, write_surface
from scipy.ndimage import binary_dilation
from scipy.spatial import Delaunay, cKDTree

from hipsta_bids.cli.main import main
from hipsta_bids.extensions.regions.unfolded import Correspondence
from hipsta_bids.geometry.sheet import sheet_levels
from hipsta_bids.settings import Settings

X, Y, _ = sheet_levels(Settings().sheet, "whole")
SHEET = "sub-01_hemi-{}_seg-hippunfold_label-whole_desc-sheet_morph.tsv"
STEM = "sub-01_hemi-{}_space-T1w_den-1mm_label-hipp"


@pytest.fixture(scope="module")
def flat(tmp_path_factory):
    """An unfolded surface as HippUnfold writes it, denser than the sheet, and its vertices."""
    posterior, medial = np.meshgrid(np.linspace(-39.8, -0.2, 101), np.linspace(-199.8, -180.2, 81))
    points = np.column_stack([posterior.ravel(), medial.ravel(), np.full(posterior.size, 1.17)])
    path = tmp_path_factory.mktemp("flat") / "tpl-avg_space-unfold_label-hipp_midthickness.surf.gii"
    write_surface(path, points, Delaunay(points[:, :2]).simplices)
    return path, points


def write_sheet(folder, values, hemi="L", name=SHEET):
    """A table of the sheet, as the participant level writes it, y fastest."""
    nodes = np.argwhere(np.ones(values.shape, dtype=bool)) + 1
    table = pd.DataFrame({"x": nodes[:, 0], "y": nodes[:, 1], "thickness": values.ravel()})
    path = folder / name.format(hemi)
    table.assign(subfield="CA1").to_csv(path, sep="\t", index=False, na_rep="n/a")
    return path


def resample(*arguments, surface):
    return main(["resample", *map(str, arguments), "--surface", str(surface)])


def sheet_values(path):
    return pd.read_csv(path, sep="\t")["thickness"].to_numpy().reshape(len(X), len(Y))


def test_sides_meet_the_same_sides(flat, tmp_path):
    """x is medial to lateral there and here, y posterior to anterior, each a share of the way."""
    surface, points = flat
    anterior, lateral = (points[:, 0] + 40) / 40, (points[:, 1] + 200) / 20
    x, y = np.meshgrid((X + 1) / 2, (Y - Y[0]) / (Y[-1] - Y[0]), indexing="ij")
    for ours, theirs in ((y, anterior), (x, lateral)):
        out = tmp_path / "vertices.shape.gii"
        assert resample(write_sheet(tmp_path, ours), out, surface=surface) == 0
        image = nib.load(out)
        assert image.meta["AnatomicalStructurePrimary"] == "HippocampusLeft"
        assert image.darrays[0].meta["Units"] == "mm"
        found = image.agg_data()
        on_grid = np.abs(2 * lateral - 1) <= X[-1]
        np.testing.assert_allclose(found[on_grid], theirs[on_grid], atol=1e-6)
        nearest = cKDTree(np.column_stack([40 * y.ravel(), 20 * x.ravel()])).query(
            np.column_stack([40 * anterior, 20 * lateral])
        )
        # Beyond the grid, which ends 1 mm before the edges, the nearest node has the value.
        expected = ours.ravel()[nearest[1]]
        np.testing.assert_allclose(found[~on_grid], expected[~on_grid], atol=1e-6)
        note = image.darrays[0].meta["Description"]
        far = nearest[0][~on_grid].max()
        assert note == f"{(~on_grid).sum()} have the nearest value, up to {far:.2f} mm away"
        path = tmp_path / f"{STEM.format('R')}_thickness.shape.gii"
        write_map(path, theirs)
        assert resample(path, tmp_path / "nodes.tsv", surface=surface) == 0
        nodes = sheet_values(tmp_path / "nodes.tsv")
        assert np.isfinite(nodes[:, 1:-1]).all()  # its vertices end half a voxel before the ends
        np.testing.assert_allclose(nodes[:, 1:-1], ours[:, 1:-1], atol=1e-6)


def test_the_own_coordinate_of_a_sheet_takes_the_place_of_x(flat, tmp_path, capsys):
    surface, points = flat
    across = np.broadcast_to(np.sign(X) * np.abs(X) ** 1.5, (len(Y), len(X))).T
    own = tmp_path / "sub-01_hemi-L_seg-hippunfold_label-whole_desc-proximodistal_morph.shape.gii"
    write_map(own, across.ravel())
    sheet, out = write_sheet(tmp_path, across), tmp_path / "vertices.shape.gii"
    assert resample(sheet, out, "--sheet", own, surface=surface) == 0
    found, lateral = nib.load(out).agg_data(), 2 * (points[:, 1] + 200) / 20 - 1
    expected = np.clip(lateral, across.min(), across.max())  # of the nearest node beyond the edges
    np.testing.assert_allclose(found, expected, atol=1e-5)
    for wrong in (across.ravel()[:-1], across.ravel() + 1):  # the latter may be thickness
        write_map(own, wrong)
        capsys.readouterr()
        assert resample(sheet, out, "--sheet", own, surface=surface) == 65
        assert "give the sheet's desc-proximodistal map" in capsys.readouterr().err


def test_a_map_comes_back_and_what_is_missing_stays_missing(flat, tmp_path, capsys):
    surface, _ = flat
    x, y = np.meshgrid(X, Y, indexing="ij")
    values = 2 + 0.5 * np.sin(2 * x) * np.cos(2 * y)
    values[15:20, 22:30] = np.nan
    out, back = tmp_path / "hemi-L_thickness.func.gii", tmp_path / "back.tsv"
    assert resample(write_sheet(tmp_path, values), out, surface=surface) == 0
    assert "of HippUnfold" in capsys.readouterr().out
    assert resample(out, back, surface=surface) == 0
    assert "nodes of the whole sheet" in capsys.readouterr().out
    found = sheet_values(back)
    inner = (slice(1, -1), slice(1, -1))
    known = np.isfinite(found)
    gap = np.isnan(values)
    assert np.isnan(found[gap]).all()
    assert not (np.isnan(found)[inner] & ~binary_dilation(gap, np.ones((3, 3)))[inner]).any()
    assert np.abs(found - values)[known].max() < 0.01
    assert np.abs(found - values)[known].mean() < 0.002


def test_vertices_far_from_the_grid_or_beside_missing_values_have_no_value():
    """A grid up to 0.8 ends 2 mm before the edges of 20 mm; 1.75 mm are filled."""
    sheet = Settings().sheet.changed(x_extent=0.8)
    x, y, _ = sheet_levels(sheet, "whole")
    lateral = np.array([0.05, 0.95, 0.03, 0.0, 1.0, 0.5])  # 1, 1, 1.4, 2, 2 mm beyond, and inside
    shares = np.column_stack([np.full(6, 0.5), lateral])
    values = np.where(x[:, None] > 0.7, np.nan, np.ones((len(x), len(y))))
    moved, distance = Correspondence(shares, sheet).to_vertices(values)
    np.testing.assert_array_equal(moved, [1, np.nan, 1, np.nan, np.nan, 1])
    # The middle of the sheet lies on no row: the nearest is up to 0.4 mm away along y.
    assert distance[0] == pytest.approx(np.hypot(1, 40 * np.abs((y + 2) / 5 - 0.5).min()))
    assert (distance[[1, 3, 4, 5]] == 0).all()


def test_both_sides_go_into_one_cifti_file_and_out_of_it(flat, tmp_path):
    surface, points = flat
    sheets = [
        write_sheet(tmp_path, np.full((len(X), len(Y)), v), h) for h, v in (("R", 3), ("L", 2))
    ]
    out = tmp_path / "thickness.dscalar.nii"
    assert resample(*sheets, out, surface=surface) == 0
    image = nib.load(out)
    models = {name: s for name, s, _ in image.header.get_axis(1).iter_structures()}
    assert list(models) == [f"CIFTI_STRUCTURE_HIPPOCAMPUS_{side}" for side in ("LEFT", "RIGHT")]
    assert image.header.get_axis(0).name == ["thickness"]
    data = image.get_fdata()[0]
    for part, value in zip(models.values(), (2, 3), strict=True):
        assert len(data[part]) == len(points)
        assert set(data[part][np.isfinite(data[part])]) == {value}
    theirs = (
        tmp_path / "sub-01_den-1mm_label-hipp_thickness.dscalar.nii"
    )  # as Workbench writes them
    write_cifti(theirs, {"L": np.full(len(points), 1.5), "R": np.full(len(points), 1.75)})
    assert resample(theirs, out, surface=surface) == 0
    nodes = nib.load(out).get_fdata().reshape(2, len(X), len(Y))
    assert [set(side[:, 1:-1].ravel()) for side in nodes] == [{1.5}, {1.75}]


def test_files_that_do_not_fit_are_refused_in_one_line(flat, tmp_path, capsys):
    surface, points = flat
    sheet = write_sheet(tmp_path, np.ones((len(X), len(Y))))
    body = write_sheet(tmp_path, np.ones((41, 21)), name="sub-01_hemi-L_seg-hippunfold_morph.tsv")
    coarse = write_sheet(tmp_path, np.ones((11, len(Y))), name="hemi-L_desc-sheet_morph.tsv")
    unsided = write_sheet(tmp_path, np.ones((len(X), len(Y))), name="sub-01_morph.tsv")
    folded, turned, right = (
        tmp_path / f"{name}.surf.gii" for name in ("folded", "turned", "hemi-R_unfold")
    )
    triangles = Delaunay(points[:, :2]).simplices
    write_surface(folded, points + np.outer(np.sin(points[:, 0]), [0, 0, 1]), triangles)
    write_surface(turned, -points, triangles)
    write_surface(right, points, triangles)
    out = tmp_path / "out.shape.gii"
    cases = (
        ([body, out], surface, 65, "is of region body"),
        ([coarse, out], surface, 65, f"{11 * len(Y)} points fit neither the sheet (41 x {len(Y)})"),
        ([unsided, out], surface, 65, "put hemi-L or hemi-R in its name"),
        ([sheet, sheet, out], surface, 65, "both are of side L"),
        ([sheet, out], folded, 65, "is no unfolded surface of HippUnfold"),
        ([sheet, out], turned, 65, "is no unfolded surface of HippUnfold"),
        ([sheet, out], right, 65, "no unfolded surface of side L"),
        ([sheet, out], tmp_path / "none.surf.gii", 65, "none.surf.gii"),
        ([tmp_path / "none_hemi-L_morph.tsv", out], surface, 65, "file not found"),
        ([sheet, tmp_path / "out.nii.gz"], surface, 64, "results end with .shape.gii"),
        ([sheet, tmp_path / "out.tsv"], surface, 64, "tables are of sheets"),
        ([sheet, sheet], surface, 64, "is an input"),
        (
            [sheet, write_sheet(tmp_path, np.ones((len(X), len(Y))), "R"), out],
            surface,
            64,
            "one side",
        ),
    )
    for arguments, given, code, message in cases:
        assert resample(*arguments, surface=given) == code, message
        said = capsys.readouterr().err
        assert message in said
        assert said.count("\n") == 1
    assert not out.exists()
