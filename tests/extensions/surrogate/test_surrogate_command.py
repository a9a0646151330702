"""``hipsta-bids surrogate``, through the command line."""

import json
import shutil
from fnmatch import fnmatch

import numpy as np
import pandas as pd
import pytest

from hipsta_bids.cli import main
from hipsta_bids.derivatives.names import HemisphereName, output_path
from hipsta_bids.errors import ExitCode, SettingsError
from hipsta_bids.phantom import Hemisphere, PhantomSpec, write_dataset
from hipsta_bids.settings import Settings
from hipsta_bids.types.tables import settings_from

SPEC = PhantomSpec(kind="spiral", thickness=2.0, length=8.0, variation=0.3)
SETTINGS = "[surrogate]\npositions = [0.3, 0.6]\n"


@pytest.fixture(scope="module")
def bids_dir(tmp_path_factory):
    """Two hemispheres, with settings that ask for two slices."""
    root = tmp_path_factory.mktemp("surrogate")
    hemispheres = [Hemisphere(subject="01", hemi=hemi, spec=SPEC) for hemi in "LR"]
    write_dataset(root / "bids", hemispheres, voxel_size=(0.4, 0.4, 0.4))
    (root / "two.toml").write_text(SETTINGS)
    return root / "bids"


def run(bids_dir, out, *options):
    settings = ["--settings", str(bids_dir.parent / "two.toml")]
    return main.main(["surrogate", str(bids_dir), str(out), *settings, *options])


def path_of(out, key, hemi="L"):
    name = HemisphereName(subject="01", session=None, hemi=hemi, seg="freesurfer")
    return out / output_path(name, key)


@pytest.mark.parametrize(
    ("positions", "message"),
    [
        ([], "positions is .*, but has to be a list of at least 1"),
        ([0.5, 1.0], r"entry 2 of .*positions is 1\.0, .* below 1"),
    ],
)
def test_slices_outside_the_body_are_refused(positions, message):
    with pytest.raises(SettingsError, match=message):
        settings_from({"surrogate": {"positions": positions}}, Settings, origin="f")


def test_it_stands_alone(bids_dir, tmp_path, capsys):
    assert run(bids_dir, tmp_path / "out") == ExitCode.OK
    said = capsys.readouterr().out.splitlines()
    assert len(said) == 4
    assert all("(no sheet to compare with)" in line for line in said)
    for hemi in "LR":
        table = pd.read_csv(path_of(tmp_path / "out", "surrogate", hemi), sep="\t")
        assert set(table["slice"]) == {0.3, 0.6}
        assert (table["sampling"] == "proportional").sum() == 2 * 41
        assert table["thickness_mesh"].isna().all()
        # The body has 2 mm, more or less 30 %; half a voxel may be added or missing.
        inner = table[table["fraction"].between(0.1, 0.9)]
        assert inner["thickness"].between(1.4 - 0.2, 2.6 + 0.2).all()
        sidecar = json.loads(path_of(tmp_path / "out", "surrogate_sidecar", hemi).read_text())
        assert list(sidecar) == list(table.columns)
    ignored = (tmp_path / "out" / ".bidsignore").read_text().splitlines()
    assert any(fnmatch("sub-01_hemi-L_seg-P_desc-surrogate_morph.tsv", line) for line in ignored)


def test_it_agrees_with_the_mesh_and_goes_when_the_mesh_is_redone(bids_dir, tmp_path, capsys):
    out = tmp_path / "out"
    options = ["--settings", str(bids_dir.parent / "two.toml"), "--hemi", "L", "--n-procs", "1"]
    assert main.main([str(bids_dir), str(out), "participant", *options]) == ExitCode.OK
    capsys.readouterr()
    assert run(bids_dir, out, "--hemi", "L") == ExitCode.OK
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2
    assert all("slope" in line for line in lines)
    table = pd.read_csv(path_of(out, "surrogate"), sep="\t")
    even = table[(table["sampling"] == "proportional") & table["thickness_mesh"].notna()]
    assert len(even) > 70
    # As the validation suite asks of phantoms whose thickness varies by as much.
    assert np.corrcoef(even["thickness"], even["thickness_mesh"])[0, 1] > 0.9
    assert np.polyfit(even["thickness_mesh"], even["thickness"], 1)[0] == pytest.approx(1, abs=0.15)
    assert path_of(out, "thickness").exists()
    redo = ["participant", *options, "--force"]
    assert main.main([str(bids_dir), str(out), *redo]) == ExitCode.OK
    assert not path_of(out, "surrogate").exists()


def test_a_hemisphere_that_fails_stops_no_other(bids_dir, tmp_path, capsys):
    data = tmp_path / "bids"
    shutil.copytree(bids_dir, data)
    shutil.copy(bids_dir.parent / "two.toml", tmp_path)
    files = sorted(data.rglob("*hippoAmygLabels*.mgz"))
    files[0].write_bytes(b"nothing")
    out = tmp_path / "out"
    assert run(data, out) == ExitCode.SOME_FAILED
    said = capsys.readouterr()
    assert "cannot be read as an image" in said.err
    assert said.err.count("\n") == 1
    assert path_of(out, "surrogate", "R").exists()
    files[1].write_bytes(b"nothing")
    assert run(data, out) == ExitCode.BAD_DATA
    assert not path_of(out, "surrogate", "R").exists()


def test_other_settings_are_refused(bids_dir, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(bids_dir, out, "--hemi", "L") == ExitCode.OK
    assert main.main(["surrogate", str(bids_dir), str(out)]) == ExitCode.USAGE
    assert "other settings (surrogate.positions was" in capsys.readouterr().err


def test_a_dry_run_writes_nothing(bids_dir, tmp_path, capsys):
    assert run(bids_dir, tmp_path / "out", "--dry-run") == ExitCode.OK
    assert "lh.hippoAmygLabels" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["in"], "required: OUT_DIR"),
        (["in", "out", "--hemi", "X"], "'X' is not a hemisphere"),
        (["in", "in"], "the output folder is the BIDS dataset itself"),
    ],
)
def test_wrong_use_gets_one_line(arguments, message, capsys):
    assert main.main(["surrogate", *arguments]) == ExitCode.USAGE
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1


def test_nothing_to_do(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    command = ["surrogate", str(tmp_path / "empty"), str(tmp_path / "out")]
    assert main.main(command) == ExitCode.NOTHING_TO_DO
    assert capsys.readouterr().err.count("\n") == 1


def test_a_dataset_may_be_called_surrogate(bids_dir, tmp_path, monkeypatch):
    shutil.copytree(bids_dir, tmp_path / "surrogate")
    monkeypatch.chdir(tmp_path)
    assert main.main(["surrogate", "out", "participant", "--dry-run"]) == ExitCode.OK
