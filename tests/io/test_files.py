import errno
import json
import os
import platform
import resource
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest

from hipsta_bids.errors import InputError, OutputError
from hipsta_bids.io import files


def test_written_file_replaces_and_leaves_nothing_aside(tmp_path):
    path = tmp_path / "a" / "b.txt"
    files.write_text(path, "one")
    files.write_text(path, "two")
    assert path.read_text() == "two"
    assert list(path.parent.iterdir()) == [path]


def test_failed_write_keeps_the_earlier_file(tmp_path, monkeypatch):
    path = tmp_path / "b.txt"
    files.write_text(path, "one")

    def no_space(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", no_space)
    with pytest.raises(OutputError, match="no space left") as caught:
        files.write_text(path, "two")
    assert caught.value.reason == "disk-full"
    assert caught.value.exit_code == 73
    assert path.read_text() == "one"
    assert list(tmp_path.iterdir()) == [path]


def test_interrupted_write_leaves_nothing_aside(tmp_path, monkeypatch):
    def interrupt(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        files.write_text(tmp_path / "b.txt", "two")
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def file_size_limit():
    """The kernel's own refusal to write more than 1 kB into any file."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1024, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)
    signal.signal(signal.SIGXFSZ, handler)


@pytest.mark.usefixtures("file_size_limit")
def test_writability_is_proven_by_a_block(tmp_path):
    with pytest.raises(OutputError, match="no space left"):
        files.check_writable(tmp_path)


@pytest.mark.parametrize(
    ("number", "reason"),
    [
        (errno.ENOSPC, "disk-full"),
        (errno.EDQUOT, "disk-full"),
        (errno.EROFS, "read-only"),
        (errno.EACCES, "read-only"),
        (errno.EIO, "not-writable"),
    ],
)
def test_system_errors_get_a_reason(number, reason):
    assert files.output_error(Path("x"), OSError(number, "text")).reason == reason


def test_file_in_place_of_a_folder_is_not_writable(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        files.check_writable(tmp_path / "file" / "out")


def test_json_is_strict_and_knows_numpy(tmp_path):
    path = tmp_path / "a.json"
    files.write_json(
        path,
        {
            "nan": np.float64("nan"),
            "infinite": float("inf"),
            "array": np.array([[1.5, np.nan]]),
            "count": np.int32(3),
            "flag": np.bool_(True),
            "path": Path("a/b"),
            "tuple": (1, None),
        },
    )
    assert "NaN" not in path.read_text()
    assert json.loads(path.read_text()) == {
        "nan": None,
        "infinite": None,
        "array": [[1.5, None]],
        "count": 3,
        "flag": True,
        "path": "a/b",
        "tuple": [1, None],
    }
    assert files.read_json(path)["count"] == 3


DEEP = "[" * 400 + "]" * 400


@pytest.mark.parametrize("content", ["{", "[1]", r'{"name": "\ud800"}', f'{{"a": {DEEP}}}'])
def test_bad_json_is_named(tmp_path, content):
    path = tmp_path / "a.json"
    path.write_text(content)
    with pytest.raises(InputError, match=r"a\.json"):
        files.read_json(path)


def test_table_round_trip_keeps_rows_whole(tmp_path):
    path = tmp_path / "a.tsv"
    files.write_tsv(path, ["a", "b"], [["1", "x\ty\nz"], ["", "n/a"]])
    assert path.read_text() == "a\tb\n1\tx y z\nn/a\tn/a\n"
    assert files.read_tsv(path) == [{"a": "1", "b": "x y z"}, {"a": "n/a", "b": "n/a"}]


@pytest.mark.parametrize(
    "text",
    [
        "a\tb\n1\t2\t\n3\t4\n",  # a tab at the end of a row
        "a\tb\t\n1\t2\t\n3\t4\t\n",  # a column without name and cells
        "a\tb\n1\t2\n\n3\t4\n\t\n\n",
        "\ufeffa\tb\r\n1\t2\r\n3\t4\r\n",
        "a\tb\r1\t2\r3\t4",
    ],
)
def test_tables_of_spreadsheets_are_read(tmp_path, text):
    path = tmp_path / "a.tsv"
    path.write_bytes(text.encode())
    assert files.read_tsv(path) == [{"a": "1", "b": "2"}, {"a": "3", "b": "4"}]


def test_lines_of_errors_count_blank_lines(tmp_path):
    path = tmp_path / "a.tsv"
    path.write_text("a\tb\n\n1\t2\n1\t2\t3\n")
    with pytest.raises(InputError, match="line 4 has 3 cells, the header 2"):
        files.read_tsv(path)


def test_broken_table_is_named(tmp_path):
    path = tmp_path / "a.tsv"
    path.write_text("a\tb\n1\n")
    with pytest.raises(InputError, match="line 2 has 1 cells, the header 2; separate cells by"):
        files.read_tsv(path)
    with pytest.raises(InputError, match="file not found"):
        files.read_tsv(tmp_path / "missing.tsv")


def test_hash_is_sha256(tmp_path):
    (tmp_path / "abc").write_text("abc")
    # FIPS 180-2, appendix B.1
    assert files.sha256_of(tmp_path / "abc") == (
        "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    )
    with pytest.raises(InputError, match="cannot be read"):
        files.sha256_of(tmp_path / "missing")


def test_leftovers_of_a_killed_run_are_removed_but_no_others(tmp_path):
    for name in (".s_seg-a_x.tsv.12.tmp", ".s_seg-b_x.tsv.12.tmp", "s_seg-a_x.tsv"):
        (tmp_path / name).write_text("")
    files.remove_leftovers(tmp_path, "s_*seg-a_*")
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        ".s_seg-b_x.tsv.12.tmp",
        "s_seg-a_x.tsv",
    ]


def test_names_that_the_locale_cannot_spell_keep_their_bytes(tmp_path):
    name = "ıİß".encode().decode("ascii", errors="surrogateescape")  # as in LC_ALL=C
    files.write_text(tmp_path / "text", name)
    assert (tmp_path / "text").read_text(encoding="utf-8") == "ıİß"


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "sub-01_T1w.nii.gz",
        "sub-01_ses-pre_acq-mprage_run-2_T2w.nii",
        "sub-01_hemi-L_space-cropT1w_desc-subfields_atlas-bigbrain_dseg.nii.gz",
        "sub-01_ses-02_hemi-R_seg-freesurfer_label-extended_desc-sheet_morph.tsv",
        "sub-01_hemi-L_space-T1w_den-0p5mm_label-hipp_thickness.shape.gii",
        "sub-01_hemi-L_desc-edited_mask.nii.gz",
        "dseg.tsv",
    ],
)
def test_names_are_split_as_by_pybids(name):
    pybids = pytest.importorskip("bids.layout")
    known = [e for c in ("bids", "derivatives") for e in pybids.Config.load(c).entities.values()]
    keys = {"subject": "sub", "session": "ses", "acquisition": "acq", "density": "den"}
    keys["segmentation"] = "seg"
    theirs = pybids.parse_file_entities(f"/{name}", entities=known)
    assert files.entities(name) == {keys.get(key, key): str(v) for key, v in theirs.items()}


def test_scratch_of_dead_processes_is_removed(tmp_path, monkeypatch):
    monkeypatch.setattr(files.tempfile, "tempdir", str(tmp_path))
    own = files.scratch_folder("fonts")
    done = subprocess.Popen(["true"])
    done.wait()
    node = platform.node()
    dead = tmp_path / f"hipsta-bids-{node}-{done.pid}-tetgen-abc"
    elsewhere = tmp_path / f"hipsta-bids-other{node}-{done.pid}-tetgen-abc"
    foreign = tmp_path / f"hipsta-{done.pid}"
    for folder in (dead, elsewhere, foreign):
        folder.mkdir()
        (folder / "file").touch()
    files.check_scratch()
    assert not dead.exists()
    assert all(folder.exists() for folder in (own, elsewhere, foreign))
