"""`hipsta-bids correlate`: from files to a table, figure and text."""

import json

import numpy as np
import pandas as pd
import pytest

import hipsta_bids as hb
from hipsta_bids.cli.main import main
from hipsta_bids.io import files, gifti

NX, NY = 14, 10


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A bent sheet, a map with a gap as GIFTI, and a table with a map of two groups."""
    root = tmp_path_factory.mktemp("correlate")
    u, v = np.meshgrid(np.arange(NX), np.arange(NY), indexing="ij")
    points = np.stack([5 * np.sin(u / 8), 1.5 * v, 5 * np.cos(u / 8)], axis=-1).reshape(-1, 3)
    content = gifti.surface_bytes(
        points, gifti.sheet_triangles(NX, NY), hemi="L", secondary=None, unfolded=False
    )
    files.write_bytes(root / "mid.surf.gii", content)
    wave = (np.sin(u * 1.3) * np.cos(v * 1.1)).ravel()
    one = np.where(np.arange(NX * NY) < 5, np.nan, wave)
    files.write_bytes(root / "one.shape.gii", gifti.shape_bytes(one, hemi="L", name="a", unit="1"))
    random = np.random.default_rng(0)
    means = {"CN": wave + 0.5 * random.standard_normal(len(wave)), "AD": np.zeros(len(wave))}
    rows = [(group, value) for group, values in means.items() for value in values]
    pd.DataFrame(rows, columns=["group", "mean"]).to_csv(root / "means.tsv", sep="\t", index=False)
    return root, one, means["CN"]


def test_files_and_arrays_have_the_same_correlation(folder, capsys):
    root, one, two = folder
    out = root / "out"
    command = ["correlate", str(root / "one.shape.gii"), f"{root / 'means.tsv'}:mean:group=CN"]
    command += [str(out), "--surface", str(root / "mid.surf.gii"), "--permutations", "500"]
    assert main([*command, "--seed", "4"]) == 0
    (row,) = pd.read_table(out / "correlation.tsv").to_dict("records")
    present = np.isfinite(one)
    assert row["n"] == NX * NY - 5
    # Maps are written in single precision.
    expected = np.corrcoef(one[present], two[present])[0, 1]
    assert row["pearson"] == pytest.approx(expected, abs=1e-6)
    assert row["pearson_p"] == pytest.approx(1 / 500)
    assert f"r = {expected:.3f}" in capsys.readouterr().out
    mesh = gifti.read_mesh(root / "mid.surf.gii")
    again = hb.correlate(one, two, (mesh.points, mesh.triangles), permutations=500, seed=4)
    assert again["spearman_p"] == row["spearman_p"]
    assert again["spearman"] == pytest.approx(row["spearman"], abs=1e-4)
    described = json.loads((out / "correlation.json").read_text())
    assert list(described) == list(row)
    text = (out / "methods.md").read_text()
    assert "500 surrogates of the first map (seed 4)" in text
    assert "Wagner HH, Dray S" in text
    assert "first map" in (out / "figures" / "correlation.svg").read_text()
    assert main([*command, "--seed", "5"]) == 0  # over an earlier correlation


@pytest.mark.parametrize(
    ("second", "out", "code", "said"),
    [
        ("means.tsv:mean", "a", 65, "maps of 140 and 280 points, surface of 140 vertices"),
        ("means.tsv:mena", "a", 65, "no column 'mena'; did you mean mean?"),
        ("means.tsv:group", "a", 65, "column group has other cells than numbers"),
        ("means.tsv:mean:group=AD", "a", 65, "one value everywhere"),
        ("means.tsv:mean:group=MCI", "a", 65, "no row has group=MCI; group is AD, CN"),
        ("two.shape.gii", "a", 65, "two.shape.gii: file not found; check its name"),
        ("one.shape.gii", ".", 64, "exists and is no correlation"),
    ],
)
def test_problems_are_one_line(folder, capsys, second, out, code, said):  # noqa: PLR0917 -- cases
    root, *_ = folder
    command = ["correlate", str(root / "one.shape.gii"), str(root / second), str(root / out)]
    assert main([*command, "--surface", str(root / "mid.surf.gii")]) == code
    error = capsys.readouterr().err
    assert said in error, error
    assert error.count("\n") == 1


def test_a_missing_surface_is_not_found(folder, capsys):
    root, *_ = folder
    one = str(root / "one.shape.gii")
    surface = root / "none.surf.gii"
    assert main(["correlate", one, one, str(root / "a"), "--surface", str(surface)]) == 65
    assert f"{surface}: file not found; check its name" in capsys.readouterr().err


def test_conditions_are_combined(folder, tmp_path, capsys):
    root, *_ = folder
    table = tmp_path / "means.tsv"
    table.write_text("hemi\tgroup\tmean\nL\tCN\t1\nR\tAD\t2\n")
    choice = f"{table}:mean:hemi=L:group=AD"
    command = ["correlate", choice, choice, str(tmp_path / "a")]
    assert main([*command, "--surface", str(root / "mid.surf.gii")]) == 65
    assert "no row has hemi=L and group=AD; group is CN" in capsys.readouterr().err
