"""Each kind of bad input, through the command line: one line, the right code, nothing lost."""

import ctypes
import errno
import gzip
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest

from hipsta_bids.cli import main
from hipsta_bids.derivatives.dataset import read_status, settle_settings
from hipsta_bids.derivatives.names import OUTPUTS, HemisphereName, output_path
from hipsta_bids.errors import ExitCode
from hipsta_bids.io import files
from hipsta_bids.phantom import Hemisphere, PhantomSpec, write_dataset
from hipsta_bids.settings import BodySettings, Settings

GOOD = PhantomSpec(kind="spiral", thickness=2.0, length=8.0)
COARSE = "[grid]\nspacing = 0.5\n"  # mm; these tests look at files, not at maps
SHORT = PhantomSpec(kind="spiral", thickness=2.0, length=3.0, end_length=10.0)  # 5 mm are needed
FREESURFER = Path("bids/derivatives/freesurfer")
COMMAND = (sys.executable, "-m", "hipsta_bids.cli.main")


def label_file(bids_dir, subject, side="lh"):
    folder = bids_dir / "derivatives" / "freesurfer" / f"sub-{subject}" / "mri"
    return folder / f"{side}.hippoAmygLabels-T1.v22.mgz"


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """Two sound hemispheres and a body that is too short."""
    folder = tmp_path_factory.mktemp("good")
    write_dataset(
        folder,
        [
            Hemisphere(subject="good", hemi="L", spec=GOOD),
            Hemisphere(subject="good", hemi="R", spec=GOOD),
            Hemisphere(subject="short", hemi="L", spec=SHORT),
        ],
        voxel_size=(0.5, 0.5, 0.5),
    )
    (folder / "coarse.toml").write_text(COARSE)
    return folder


@pytest.fixture
def bids_dir(good, tmp_path):
    """A dataset of one subject with both hemispheres, to be spoiled."""
    folder = tmp_path / "bids"
    shutil.copytree(good, folder)
    shutil.rmtree(label_file(folder, "short").parents[1])
    shutil.rmtree(folder / "sub-short")
    return folder


def arguments(bids_dir, out, *options):
    settings = ["--settings", str(bids_dir / "coarse.toml")]
    return [str(bids_dir), str(out), "participant", *settings, *options]


def spoil_header(path, field, value):
    """Overwrite one float32 of the MGH header: 0-2 voxel sizes, 3-11 direction cosines."""
    content = bytearray(gzip.decompress(path.read_bytes()))
    start = 30 + 4 * field  # after version, shape, type, dof and the flag for RAS
    content[start : start + 4] = np.array(value, ">f4").tobytes()
    path.write_bytes(gzip.compress(bytes(content)))


def save_labels(path, change, dtype=np.int32):
    """Write the labels of a file anew, changed."""
    image = nib.load(path)
    data = np.asarray(image.dataobj)
    nib.save(nib.MGHImage(change(data).astype(dtype), image.affine), path)


def truncate(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def declare(path, *shape):
    """Let the MGH header declare another shape than the file has voxels."""
    content = bytearray(gzip.decompress(path.read_bytes()))
    content[4:16] = np.array(shape, ">i4").tobytes()
    path.write_bytes(gzip.compress(bytes(content)))


def swap_sides(path):
    shutil.copy(path.with_name(path.name.replace("lh.", "rh.")), path)


#: How to spoil a good label file, and the reason that has to come out.
FAULTS = {
    "truncated": (truncate, "unreadable-image"),
    "noimage": (lambda path: path.write_text("no image at all"), "unreadable-image"),
    "empty": (lambda path: save_labels(path, np.zeros_like), "empty-labels"),
    "otherscheme": (
        lambda path: save_labels(path, lambda data: np.where(data > 0, data % 5 + 1, 0)),
        "wrong-scheme",
    ),
    "nanaffine": (lambda path: spoil_header(path, 3, np.nan), "bad-affine"),
    "singular": (lambda path: [spoil_header(path, k, 0) for k in (3, 4, 5)], "bad-affine"),
    "fourd": (lambda path: save_labels(path, lambda data: np.stack([data, data], -1)), "not-3d"),
    "huge": (lambda path: declare(path, 3000, 3000, 1000), "image-too-large"),
    "longslices": (lambda path: declare(path, 32767, 32767, 1), "image-too-large"),
    "large": (lambda path: declare(path, 1500, 1500, 1500), "unreadable-image"),
    "fractions": (
        lambda path: save_labels(path, lambda data: data * 0.999, np.float32),
        "non-integer-labels",
    ),
    "swapped": (swap_sides, "left-right-swapped"),
}


def spoiled(good, folder, faults):
    """Copy the good dataset and add a subject per fault."""
    shutil.copytree(good, folder)
    for name in faults:
        subject = label_file(folder, name).parents[1]
        shutil.copytree(label_file(folder, "good").parents[1], subject)
        FAULTS[name][0](label_file(folder, name))
        label_file(folder, name, "rh").unlink()
    return folder


def outputs(out, subject, hemi):
    name = HemisphereName(subject=subject, session=None, hemi=hemi, seg="freesurfer")
    return {row.key for row in OUTPUTS if (out / output_path(name, row.key)).exists()}


COMPLETE = {row.key for row in OUTPUTS if not row.optional}


def test_bad_hemispheres_fail_alone(good, tmp_path, capsys):
    bids_dir, out = spoiled(good, tmp_path / "bids", FAULTS), tmp_path / "out"
    code = main.main(arguments(bids_dir, out, "--n-procs", "2"))
    said = capsys.readouterr()
    assert code == ExitCode.SOME_FAILED
    found = {(row["subject"], row["hemi"]): row for row in read_status(out)}
    expected = {name: reason for name, (_, reason) in FAULTS.items()} | {"short": "body-too-short"}
    assert {subject: found[f"sub-{subject}", "L"]["reason"] for subject in expected} == expected
    for subject in expected:
        assert found[f"sub-{subject}", "L"]["decision"] == "failed"
        # Where the labels tell, the body is left for a person to look at.
        body = {"body_mask", "body_sources"} if subject == "swapped" else set()
        assert outputs(out, subject, "L") == {"qc"} | body
    for hemi in ("L", "R"):
        assert found["sub-good", hemi]["decision"] != "failed"
        assert outputs(out, "good", hemi) == COMPLETE
    *lines, warning = said.err.splitlines()
    assert len(lines) == len(expected)
    # The file of the swapped side is a copy of another participant's.
    names = "sub-good_hemi-R_seg-freesurfer, sub-swapped_hemi-L_seg-freesurfer"
    assert warning.startswith(f"warning: {names} have the same labels, byte for byte; ")
    for subject, reason in expected.items():
        (line,) = [line for line in lines if line.startswith(f"sub-{subject}_")]
        assert f"[{reason}]" in line
    assert f"{len(expected)} failed" in said.out


def enlarge(path, *shape):
    """Put the labels into the middle of a large image, where they were."""
    image = nib.load(path)
    start = [(count - own) // 2 for count, own in zip(shape, image.shape, strict=True)]
    data = np.zeros(shape, np.int16)
    inner = tuple(slice(a, a + own) for a, own in zip(start, image.shape, strict=True))
    data[inner] = np.asarray(image.dataobj)
    affine = image.affine.copy()
    affine[:3, 3] -= affine[:3, :3] @ start
    nib.save(nib.MGHImage(data, affine), path)


@pytest.mark.usefixtures("workers")  # have little memory before
def test_memory_decides_what_is_read(good, tmp_path, capsys):
    """0.6 GB for one process: half of it is 12.5 million voxels of 24 bytes."""
    bids_dir, out = tmp_path / "bids", tmp_path / "out"
    shutil.copytree(good, bids_dir)
    enlarge(label_file(bids_dir, "good"), 600, 600, 300)
    declare(label_file(bids_dir, "good", "rh"), 4000, 4000, 10)
    wanted = ("--participant-label", "good", "--n-procs", "1")
    line = arguments(bids_dir, out, *wanted, "--mem", "600")
    assert main.main(line) == ExitCode.SOME_FAILED
    (said,) = capsys.readouterr().err.splitlines()
    path = label_file(bids_dir, "good", "rh")
    assert f"{path}: one slice (16.0 million voxels) needs 384 of 300 MB; raise --mem" in said
    rows = {row["hemi"]: row for row in read_status(out)}
    assert rows["R"]["reason"] == "image-too-large"
    assert rows["L"]["decision"] != "failed"
    assert outputs(out, "good", "L") == COMPLETE
    assert float(rows["L"]["peak_memory_mb"]) < 600  # which is --mem
    # With more of it, the voxels are looked for, and are not there.
    assert main.main([*line[:-3], "1", "--mem", "800"]) == ExitCode.SOME_FAILED
    assert read_status(out)[1]["reason"] == "unreadable-image"


def test_repairs_of_headers_are_no_messages(tmp_path, caplog):
    hemisphere = Hemisphere(subject="good", hemi="L", spec=GOOD)
    write_dataset(tmp_path, [hemisphere], layouts=("ashs",), voxel_size=(0.5, 0.5, 0.5))
    (path,) = tmp_path.rglob("*_usegray.nii.gz")
    content = bytearray(gzip.decompress(path.read_bytes()))
    content[:4] = bytes(4)  # the size of the header, which nibabel puts right and tells
    path.write_bytes(gzip.compress(bytes(content)))
    assert main.main([str(tmp_path), str(tmp_path / "out"), "participant", "--dry-run"]) == 0
    assert not caplog.records


def test_all_inputs_unusable_is_bad_data(good, tmp_path, capsys):
    bids_dir = spoiled(good, tmp_path / "bids", ["empty", "noimage"])
    wanted = ("--participant-label", "empty", "noimage", "--n-procs", "1")
    code = main.main(arguments(bids_dir, tmp_path / "out", *wanted))
    assert code == ExitCode.BAD_DATA
    assert len(capsys.readouterr().err.splitlines()) == 2
    assert {row["decision"] for row in read_status(tmp_path / "out")} == {"failed"}


def a_file(path):
    path.write_text("")


@pytest.mark.parametrize(
    ("prepare", "options", "expected"),
    [
        (Path.exists, (), (ExitCode.BAD_DATA, "folder not found")),
        (a_file, (), (ExitCode.BAD_DATA, "is a file, but a folder is needed")),
        (Path.mkdir, (), (ExitCode.NOTHING_TO_DO, "no hippocampal segmentation")),
        (Path.mkdir, ("--ashs-dir", "nowhere"), (ExitCode.BAD_DATA, "nowhere: folder not found")),
        (Path.mkdir, ("-d", "a=nowhere"), (ExitCode.BAD_DATA, "nowhere: folder not found")),
        (Path.mkdir, ("--protocol", "x" * 3000), (ExitCode.BAD_DATA, "File name too long")),
        (Path.mkdir, ("--scheme", "nowhere.toml"), (ExitCode.BAD_DATA, "nowhere.toml")),
        (Path.mkdir, ("--bids-filter-file", "nowhere.json"), (ExitCode.BAD_DATA, "nowhere.json")),
    ],
)
def test_unusable_folders_get_one_line(tmp_path, capsys, prepare, options, expected):
    prepare(tmp_path / "bids")
    code, message = expected
    folders = map(str, (tmp_path / "bids", tmp_path / "out"))
    assert main.main([*folders, "participant", *options]) == code
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("option", ["--settings", "--scheme", "--bids-filter-file"])
def test_endless_nesting_is_bad_input(tmp_path, capsys, option):
    path = tmp_path / "deep.txt"
    path.write_text(("" if option == "--bids-filter-file" else "a = ") + "[" * 100_000)
    code = main.main([str(tmp_path), str(tmp_path / "out"), "participant", option, str(path)])
    assert code in {ExitCode.USAGE, ExitCode.BAD_DATA}
    assert f"{path}: " in capsys.readouterr().err


def obey_permissions():
    """Take from root what lets it ignore permissions (linux/prctl.h, linux/capability.h)."""
    drop, override, search = 24, 1, 2
    for capability in (override, search):
        ctypes.CDLL(None).prctl(drop, capability)


FORBIDDEN = f"""
import os, sys
from hipsta_bids.cli.main import main
for folder, mode in (("bids", 0), ("{FREESURFER}", 0), ("out", 0o111)):
    os.chmod(folder, mode)
    try:
        code = main(["bids", "out", "participant", "--freesurfer-dir", "{FREESURFER}"])
    finally:
        os.chmod(folder, 0o700)
    print(int(code), os.listdir("out"), file=sys.stderr)
"""


@pytest.mark.skipif(
    os.geteuid() == 0 and sys.platform != "linux", reason="root may read and write everything"
)
@pytest.mark.usefixtures("bids_dir")
def test_forbidden_folders_get_one_line(tmp_path):
    (tmp_path / "out").mkdir()
    done = subprocess.run(
        [sys.executable, "-c", FORBIDDEN],
        cwd=tmp_path,
        preexec_fn=obey_permissions,
        capture_output=True,
        text=True,
        check=False,
    )
    bad, refused = int(ExitCode.BAD_DATA), int(ExitCode.NOT_WRITABLE)
    dataset, first, freesurfer, second, out, third = done.stderr.splitlines()
    assert [first, second, third] == [f"{bad} []", f"{bad} []", f"{refused} []"]
    assert "cannot list the folder" in dataset
    assert "cannot list the folder" in freesurfer
    assert "not allowed to write there" in out


def test_wanted_participant_that_does_not_exist(bids_dir, tmp_path, capsys):
    wanted = ("--participant-label", "gone")
    code = main.main(arguments(bids_dir, tmp_path / "out", *wanted))
    assert code == ExitCode.NOTHING_TO_DO
    assert "gone" in capsys.readouterr().err


def test_read_only_output_is_refused_before_work(bids_dir, tmp_path, monkeypatch, capsys):
    def read_only(*_):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(files, "_write_through", read_only)
    code = main.main(arguments(bids_dir, tmp_path / "out"))
    said = capsys.readouterr()
    assert code == ExitCode.NOT_WRITABLE
    assert "not allowed to write there" in said.err
    assert said.err.count("\n") == 1
    assert list((tmp_path / "out").iterdir()) == []


def test_output_in_place_of_a_file(bids_dir, tmp_path, capsys):
    (tmp_path / "out").write_text("precious")
    code = main.main(arguments(bids_dir, tmp_path / "out"))
    assert code == ExitCode.NOT_WRITABLE
    assert capsys.readouterr().err.count("\n") == 1
    assert (tmp_path / "out").read_text() == "precious"


def limit_file_size():
    """Let the system refuse any file above 20 kB: enough for records, not for maps."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))


def test_full_disk_then_space_again(bids_dir, tmp_path):
    command = [*COMMAND, *arguments(bids_dir, tmp_path / "out", "--hemi", "L")]
    done = subprocess.run(
        command, preexec_fn=limit_file_size, capture_output=True, text=True, check=False
    )
    assert done.returncode == ExitCode.NOT_WRITABLE
    assert "no space left" in done.stderr
    assert done.stderr.count("\n") == 1
    assert [row["reason"] for row in read_status(tmp_path / "out")] == ["disk-full"]
    assert outputs(tmp_path / "out", "good", "L") == {"qc"}
    assert not list((tmp_path / "out").rglob("*.tmp"))

    assert main.main(command[len(COMMAND) :]) == ExitCode.OK
    assert outputs(tmp_path / "out", "good", "L") == COMPLETE


def test_killed_in_the_middle_then_rerun_completes(bids_dir, tmp_path, capsys):
    out = tmp_path / "out"
    command = [*COMMAND, *arguments(bids_dir, out, "--n-procs", "1")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        _opening, _counts, first = (process.stdout.readline() for _ in range(3))
        process.send_signal(signal.SIGKILL)
    assert first.startswith("sub-good_hemi-L")
    assert process.returncode == -signal.SIGKILL
    assert outputs(out, "good", "L") == COMPLETE
    status = {row["hemi"]: row["decision"] for row in read_status(out)}
    assert status["L"] != "failed"
    assert status["R"] == "failed"
    record = output_path(
        HemisphereName(subject="good", session=None, hemi="L", seg="freesurfer"), "qc"
    )
    before = (out / record).stat().st_mtime_ns

    assert main.main(command[len(COMMAND) :]) == ExitCode.OK
    said = capsys.readouterr().out
    assert "sub-good_hemi-R" in said
    assert "1 unchanged, skipped" in said
    assert (out / record).stat().st_mtime_ns == before
    for hemi in ("L", "R"):
        assert outputs(out, "good", hemi) == COMPLETE
    assert not list(out.rglob("*.tmp"))
    assert json.loads((out / record).read_text())["reason"] != "not-finished"


def test_other_settings_into_the_same_folder(bids_dir, tmp_path, capsys):
    out = tmp_path / "out"
    settle_settings(out, Settings(body=BodySettings(layer_rule="nearest-label")))
    before = {path: path.read_bytes() for path in out.iterdir()}
    assert main.main([str(bids_dir), str(out), "participant"]) == ExitCode.USAGE
    said = capsys.readouterr().err
    assert "body.layer_rule was nearest-label, now nearest-sheet" in said
    assert said.count("\n") == 1
    assert {path: path.read_bytes() for path in out.iterdir() if path.is_file()} == before


def test_group_level_says_first_that_it_cannot_write(bids_dir, tmp_path, capsys, monkeypatch):
    def refuse(_):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(os, "fsync", refuse)
    command = [str(bids_dir), str(tmp_path), "group"]
    assert main.main(command) == ExitCode.NOT_WRITABLE
    assert f"{tmp_path}: not allowed to write there" in capsys.readouterr().err
