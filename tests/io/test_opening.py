"""Files that somebody else may have made: pipes, devices, endless and absent ones."""

import json
import os
import subprocess
import sys
from types import SimpleNamespace

import pytest
from input_cases import touch

from hipsta_bids import opening
from hipsta_bids.cli import main
from hipsta_bids.errors import ExitCode

FS = "derivatives/fs/sub-01/mri"
LABELS = tuple(f"{side}h.hippoAmygLabels-T1.v22.mgz" for side in "lr")

#: Seconds after which a command has hung; the start of Python is among them.
PATIENCE = 40


def make(path, kind):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    if kind == "fifo":
        os.mkfifo(path)
    else:
        path.symlink_to({"zero": "/dev/zero", "memory": "/proc/self/mem"}[kind])


@pytest.mark.parametrize("kind", ["fifo", "zero", "memory"])
def test_what_is_no_regular_file_is_not_read(tmp_path, kind):
    make(tmp_path / "x", kind)
    with pytest.raises(OSError, match="no regular file"):
        opening.read_text(tmp_path / "x")


def test_a_file_of_any_size_is_read_up_to_a_limit(tmp_path):
    path = tmp_path / "x"
    with path.open("wb") as file:
        file.truncate(1_000_000_000_000)
    with pytest.raises(OSError, match="larger than 2 MB"):
        opening.read_bounded(path, opening.SETTINGS)
    path.write_bytes(b"a\r\nb\xc3\xbc")
    assert opening.read_text(path) == "a\nbü"
    assert opening.read_bounded(path, 6) == b"a\r\nb\xc3\xbc"
    with pytest.raises(OSError, match="larger"):
        opening.read_bounded(path, 5)
    with pytest.raises(FileNotFoundError):
        opening.open_regular(tmp_path / "y")
    with pytest.raises(OSError, match="no regular file"):
        opening.open_regular(tmp_path)


def test_a_file_that_grows_while_it_is_read_is_read_whole(tmp_path, monkeypatch):
    path, true_status = tmp_path / "x", os.fstat
    path.write_bytes(b"12345678")

    def before(descriptor):
        return SimpleNamespace(st_size=3, st_mode=true_status(descriptor).st_mode)

    monkeypatch.setattr(opening.os, "fstat", before)
    assert opening.read_bounded(path, 8) == b"12345678"
    with pytest.raises(OSError, match="larger"):
        opening.read_bounded(path, 7)


@pytest.mark.parametrize(
    "content",
    [None, b"/annex/objects/MD5E-s1--x.mgz\n", b"version https://git-lfs.github.com/spec"],
)
def test_content_that_was_not_fetched(tmp_path, content):
    path = tmp_path / "x.mgz"
    if content is None:
        path.symlink_to(".git/annex/objects/aa/bb/MD5E-s1--x/MD5E-s1--x.mgz")
    else:
        path.write_bytes(content)
    assert opening.not_fetched(path) == f"its content was not fetched; run `datalad get {path}`"
    with pytest.raises(OSError, match="datalad get"):
        opening.open_regular(path)
    path.unlink()
    assert opening.not_fetched(path) is None
    path.write_bytes(b"/annex")
    assert opening.not_fetched(path) is None


def run(*arguments, cwd):
    """Run a command that must not hang; return its exit code and what it said."""
    done = subprocess.run(
        [sys.executable, "-m", "hipsta_bids.cli", *map(str, arguments)],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    return done.returncode, done.stderr


@pytest.mark.parametrize(
    ("place", "options"),
    [
        ("filter.json", ["--bids-filter-file", "filter.json"]),
        ("s.toml", ["--settings", "s.toml"]),
        ("p.toml", ["--scheme", "p.toml"]),
        ("a.toml", ["--ashs-atlas", "a.toml"]),
        ("people.tsv", ["--participants-map", "people.tsv"]),
        ("ends.tsv", ["--ends", "ends.tsv"]),
    ],
)
def test_texts_of_the_command_line_end_at_once(tmp_path, capsys, monkeypatch, place, options):
    touch(tmp_path / FS, *LABELS)
    monkeypatch.chdir(tmp_path)
    for kind in ("fifo", "zero"):
        make(tmp_path / place, kind)
        code = main.main([".", "out", "participant", "--dry-run", *options])
        error = capsys.readouterr().err
        assert code in {ExitCode.USAGE, ExitCode.BAD_DATA}
        assert "no regular file" in error
        assert error.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["fifo", "zero"])
def test_label_files_and_descriptions_end_at_once(tmp_path, kind):
    touch(tmp_path / FS, *LABELS)
    for name in LABELS:
        make(tmp_path / FS / name, kind)
    make(tmp_path / "derivatives" / "fs" / "dataset_description.json", kind)
    code, error = run(".", "out", "participant", "--no-reports", "--n-procs", 1, cwd=tmp_path)
    assert code == ExitCode.BAD_DATA
    assert error.count("no regular file") == 2
    # The same again, where the results that are there ask for the hash of the input.
    code, error = run(".", "out", "participant", "--no-reports", "--n-procs", 1, cwd=tmp_path)
    assert code == ExitCode.BAD_DATA
    assert error.count("no regular file") == 2
    assert json.loads((tmp_path / "out" / "dataset_description.json").read_text())
