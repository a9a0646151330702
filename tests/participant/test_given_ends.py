"""Ends placed by hand (``--ends``), through the command line: used, recorded, hashed, refused."""

import numpy as np
import pytest
from measured_phantoms import results

from hipsta_bids.cli import main
from hipsta_bids.errors import ExitCode, InputError
from hipsta_bids.inputs.edits import read_ends
from hipsta_bids.io import files
from hipsta_bids.phantom import Hemisphere, Phantom, PhantomSpec, write_dataset

SPEC = PhantomSpec(kind="spiral", thickness=2.0, length=12.0)
SEG = "freesurfer"
HEADER = "participant_id\themi\tend\tr\ta\ts"


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    hemispheres = [Hemisphere(subject="01", hemi=hemi, spec=SPEC) for hemi in "LR"]
    write_dataset(folder, hemispheres, layouts=(SEG,), voxel_size=(0.5, 0.5, 0.5))
    (folder / "coarse.toml").write_text("[grid]\nspacing = 0.5\n")
    return folder


def run(data, out, *options):
    settings = ["--settings", data / "coarse.toml", "--no-reports"]
    return main.main(list(map(str, [data, out, "participant", *settings, *options])))


def table(path, *rows, header=HEADER):
    path.write_text("\n".join((header, *rows)) + "\n")
    return path


def point_at(v, hemi="L"):
    """Cells of a point in the middle of the sheet."""
    place = Phantom(SPEC).body.place(np.array([0.5]), v, 0.0, hemi=hemi)[0]
    return "\t".join(f"{value:.3f}" for value in place)


def metrics(out, hemi="L"):
    return results(out, "01", hemi, SEG).metrics


def test_a_row_moves_one_end_of_one_hemisphere_and_its_removal_moves_it_back(
    data, tmp_path, capsys
):
    def lines(*options):
        capsys.readouterr()
        assert run(data, out, "-v", *options) == ExitCode.OK
        said = capsys.readouterr().out.splitlines()
        return {
            hemi: "skipped" not in next(line for line in said if f"hemi-{hemi}" in line)
            for hemi in "LR"
        }

    out = tmp_path / "out"
    lines()
    before = metrics(out)["metrics"]
    ends = table(tmp_path / "ends.tsv", f"sub-01\tL\tanterior\t{point_at(0.75)}")
    assert lines("--ends", ends) == {"L": True, "R": False}
    record = metrics(out)
    after = record["metrics"]
    assert (after["posterior_end_rule"], after["anterior_end_rule"]) == ("labels", "user")
    assert after["posterior_plane"] == before["posterior_plane"]
    assert after["anterior_plane"]["normal_ras"] == before["anterior_plane"]["normal_ras"]
    assert after["body_length_mm"] == pytest.approx(0.75 * before["body_length_mm"], abs=0.3)
    (given,) = record["given_ends"]
    assert given["end"] == "anterior"
    assert "given_ends" not in metrics(out, "R")
    assert lines("--ends", ends) == {"L": False, "R": False}
    tilted = f"sub-01\tL\tanterior\t{point_at(0.75)}\t0.2\t-1.0\t0.0"
    assert lines("--ends", table(ends, tilted, header=f"{HEADER}\tnr\tna\tns"))["L"]
    normal = np.array([-0.2, 1.0, 0.0]) / np.hypot(0.2, 1.0)
    found = metrics(out)["metrics"]["anterior_plane"]["normal_ras"]
    np.testing.assert_allclose(found, normal, atol=1e-3)
    assert lines() == {"L": True, "R": False}
    assert metrics(out)["metrics"]["anterior_plane"] == before["anterior_plane"]


@pytest.mark.parametrize(
    ("row", "what"),
    [
        ("01\tL\tfront\t0\t0\t0", "end 'front' is not posterior or anterior"),
        ("01\tL\tanterior\t0\tabout 3\t0", "a is 'about 3', not a number"),
        ("01\tL\tanterior\t0\tnan\t0", "a is 'nan', not a number"),
        ("01\tL\tanterior\tn/a\tn/a\tn/a", "it has no point"),
        (f"01\tL\tanterior\t{point_at(0.7)}\n01\tL\tanterior\t1\t2\t3", "a second anterior end"),
    ],
)
def test_a_bad_row_fails_its_hemisphere_alone(data, tmp_path, row, what, capsys):
    out = tmp_path / "out"
    ends = table(tmp_path / "ends.tsv", row)
    assert run(data, out, "--ends", ends) == ExitCode.SOME_FAILED
    rows = {row["hemi"]: row for row in files.read_tsv(out / "status.tsv")}
    assert (rows["L"]["decision"], rows["L"]["reason"]) == ("failed", "unreadable-table")
    assert what in rows["L"]["message"]
    assert f"{ends}, line" in rows["L"]["message"]
    assert rows["R"]["decision"] == "use"
    assert capsys.readouterr().err.count(what) <= 1


@pytest.mark.parametrize(
    ("content", "what"),
    [
        ("participant_id\themi\tend\tr\ta\n01\tL\tanterior\t0\t0\n", "lacks s"),
        (f"{HEADER}\tnr\n01\tL\tanterior\t0\t0\t0\t1\n", "lacks na, ns"),
        (f"{HEADER}\tcolor\n01\tL\tanterior\t0\t0\t0\tred\n", "has unknown color"),
        (f"{HEADER}\n01\tleft\tanterior\t0\t0\t0\n", "line 2: hemi 'left' is not L or R"),
        (f"{HEADER}\n\tL\tanterior\t0\t0\t0\n", "line 2: it has no participant_id"),
        (f"{HEADER}\n", "has no rows"),
        ("", "has no rows"),
        (None, "file not found"),
    ],
)
def test_a_bad_table_stops_the_run_with_one_line(data, tmp_path, content, what, capsys):
    path = tmp_path / "ends.tsv"
    if content is not None:
        path.write_text(content)
    with pytest.raises(InputError) as error:
        read_ends(path)
    assert what in str(error.value)
    assert "\n" not in str(error.value)
    assert run(data, tmp_path / "out", "--ends", path) == ExitCode.BAD_DATA
    assert what in capsys.readouterr().err


def test_rows_of_hemispheres_that_are_not_there_are_reported(data, tmp_path, capsys):
    rows = ("09\tL\tanterior\t0\t0\t0", f"01\tR\tanterior\t{point_at(0.75, 'R')}")
    ends = table(tmp_path / "ends.tsv", *rows)
    assert run(data, tmp_path / "out", "--ends", ends, "--dry-run") == ExitCode.OK
    said = capsys.readouterr().out
    assert "line 2: not used, no labels of sub-09 hemi-L are processed (1 of 2 rows" in said


def test_labels_of_a_spreadsheet_are_matched(data, tmp_path, capsys):
    ends = table(tmp_path / "ends.tsv", f"1\tR\tanterior\t{point_at(0.75, 'R')}")
    assert run(data, tmp_path / "out", "--ends", ends, "--dry-run") == ExitCode.OK
    printed = capsys.readouterr().out
    assert "ends.tsv: 1 is read as 01" in printed
    assert "not used, no labels of" not in printed


def test_a_plane_far_from_the_labels_is_refused(data, tmp_path):
    ends = table(tmp_path / "ends.tsv", "01\tL\tanterior\t100\t100\t100")
    out = tmp_path / "out"
    assert run(data, out, "--ends", ends, "--hemi", "L") == ExitCode.SOME_FAILED
    (row,) = files.read_tsv(out / "status.tsv")
    assert row["reason"] == "given-end-outside"
