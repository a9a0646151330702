"""Grid points that count as missing: those of repairs, and those of tables."""

import json

import numpy as np
import pytest
from small_cohorts import NODES, PLAN, place_of, table, write_dataset

from hipsta_bids.cli.main import main
from hipsta_bids.errors import ExitCode
from hipsta_bids.io import files

FAST = ("--align", "none", "--measures", "thickness", "--no-classification", "--no-reports")
COUNT = sum(PLAN.sizes)


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """The first ten columns of x of every fourth left hemisphere were repaired."""
    data, out = write_dataset(tmp_path_factory.mktemp("masks"))
    for i in range(COUNT):
        for hemi in "LR":
            path = place_of(out, f"{i + 1:02d}", hemi).path("sheet")
            rows = files.read_tsv(path)
            for row in rows:
                is_repaired = hemi == "L" and i % 4 == 0 and int(row["x"]) <= 10
                row["repaired"] = str(is_repaired).lower()
            files.write_tsv(path, list(rows[0]), [list(row.values()) for row in rows])
    return data, out


def run(study, name, *options):
    data, out = study
    code = main([str(data), str(out), "group", "--name", name, *FAST, *map(str, options)])
    folder = out / "group" / name
    if code:
        return code, None, ""
    record = json.loads((folder / "analysis.json").read_text())
    notes = [note for note in record["notes"] if "--mask" in note]
    return code, table(folder / "hemi-L_contrast-CNAD_desc-thickness_statmap.tsv"), notes


def test_repaired_columns_are_missing_and_counted_by_group(study):
    _, plain, notes = run(study, "plain")
    assert notes == []
    _, masked, (note,) = run(study, "repaired", "--mask", "repaired")
    repaired = len(range(0, COUNT, 4))
    expected = np.where(plain["node_x"] <= 10, COUNT - repaired, COUNT)
    np.testing.assert_array_equal(plain["n"], COUNT)
    np.testing.assert_array_equal(masked["n"], expected)
    same = masked["node_x"] > 10
    np.testing.assert_array_equal(masked["estimate"][same], plain["estimate"][same])
    share = 10 / NODES[0] * repaired / COUNT / 2
    assert f"{share:.1%} of points are missing (AD " in note
    assert "CN " in note


def test_points_of_a_table(study, tmp_path, capsys):
    path = tmp_path / "points.tsv"
    rows = [["1", "lh", "1", "2"], ["n/a", "L", "3", "n/a"], ["sub-02", "R", "n/a", "n/a"]]
    files.write_tsv(path, ["participant_id", "hemi", "x", "y"], rows)
    _, masked, notes = run(study, "table", "--mask", path)
    n = masked.set_index(["node_x", "node_y"])["n"]
    assert n[1, 2] == COUNT - 1
    assert n[1, 1] == COUNT
    assert 3 not in n.index.get_level_values(0) or n.loc[3].isin([0]).all()
    assert len(notes) == 1
    files.write_tsv(path, ["participant_id", "x", "y"], [["sub-99", "1", "1"]])
    assert run(study, "nobody", "--mask", path)[0] == ExitCode.BAD_DATA
    assert "matches no hemisphere here: sub-99; correct the labels" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("participant_id\tx\nsub-01\t1\n", "no column y"),
        ("x\ty\n22\t1\n", "x is '22'; nodes have numbers 1 to 21"),
        ("x\ty\n0\t1\n", "x is '0'"),
        ("x\ty\n1\tb\n", "y is 'b'"),
    ],
)
def test_wrong_tables_are_refused_in_one_line(study, tmp_path, capsys, text, said):
    path = tmp_path / "wrong.tsv"
    path.write_text(text)
    assert run(study, "wrong", "--mask", path)[0] == ExitCode.BAD_DATA
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert run(study, "wrong", "--mask", tmp_path / "none.tsv")[0] == ExitCode.BAD_DATA
    assert "file not found" in capsys.readouterr().err
