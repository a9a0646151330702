"""What a search did not use, and labels that occur twice, through the command line."""

import os
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from stand_ins import make_input, stand_in_jobs

from hipsta_bids.cli import main
from hipsta_bids.derivatives.dataset import read_status
from hipsta_bids.errors import ExitCode
from hipsta_bids.inputs import search
from hipsta_bids.inputs.search import Findings
from hipsta_bids.io import files
from hipsta_bids.participant import run as runner
from hipsta_bids.reports.cohort import cohort_page, read_cohort

CLOSED = "cannot list the folder (Permission denied); check its permissions"


@pytest.fixture
def measured(monkeypatch):
    """A measurement that takes no time."""
    for name in ("hipsta_bids.inputs.labels", "hipsta_bids.participant.measure"):
        monkeypatch.setitem(sys.modules, name, None)  # put back afterwards
    monkeypatch.setattr(
        runner, "run_jobs", lambda _, jobs: ((job, stand_in_jobs(job)) for job in jobs)
    )


@pytest.fixture
def dataset(tmp_path, monkeypatch):
    """FreeSurfer's folders, one of them closed; the files say what the stand-in does.

    They are no images, whose labels a dry run could check.
    """
    monkeypatch.setattr("hipsta_bids.participant.job.check_item", lambda *_: [])
    root = tmp_path / "bids" / "derivatives" / "freesurfer"
    for name in ("sub-01", "sub-AD_05", "bert", "fsaverage", "sub-07"):
        for side in "lr":
            path = root / name / "mri" / f"{side}h.hippoAmygLabels.mgz"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"ok {name} {side}")
    real = os.scandir

    def scandir(path):
        if Path(path) == root / "sub-07" / "mri":
            raise PermissionError(13, "Permission denied")
        return real(path)

    monkeypatch.setattr(os, "scandir", scandir)
    return root


def call(capsys, *arguments, code=ExitCode.OK):
    assert main.main([str(word) for word in arguments]) == code
    return capsys.readouterr()


def the_log(out):
    (path,) = (out / "logs").glob("run-*.log")
    return path.read_text("utf-8")


@pytest.mark.usefixtures("measured")
def test_what_was_not_used_is_listed(dataset, tmp_path, capsys):
    bids, out = tmp_path / "bids", tmp_path / "out"
    said = call(capsys, bids, out, "participant", "--dry-run").out
    folders = "3 folders (bert, sub-07/mri, sub-AD_05)"
    note = f"note: not used: {folders}; see --dry-run and the log for the reasons"
    assert note in said
    for name, reason in (
        ("sub-AD_05", "takes it as sub-AD05"),
        ("bert", "takes it as sub-bert"),
        ("fsaverage", "part of FreeSurfer, and no subject"),
        ("sub-07/mri", CLOSED),
    ):
        (line,) = (line for line in said.splitlines() if line.startswith(f"{dataset / name} "))
        assert line.endswith(reason)
    said = call(capsys, bids, out, "participant", "--no-reports").out
    assert note in said
    assert str(dataset / "bert") not in said
    assert f"note: not used: {dataset / 'sub-07' / 'mri'}: {CLOSED}\n" in the_log(out)
    assert f"note: not used: {dataset / 'fsaverage'}: part of FreeSurfer" in the_log(out)
    assert [row["subject"] for row in read_status(out)] == ["sub-01", "sub-01"]


def test_what_was_not_used_is_listed_if_nothing_was(dataset, tmp_path, capsys):
    (dataset / "sub-01").rename(tmp_path / "away")
    command = (tmp_path / "bids", tmp_path / "out", "participant")
    said = call(capsys, *command, "--dry-run", code=ExitCode.NOTHING_TO_DO)
    for name in ("bert", "fsaverage", "sub-07/mri", "sub-AD_05"):
        assert f"\nnot used: {dataset / name}: " in said.out
    assert "Not used: 3 folders (bert, sub-07/mri, sub-AD_05): its name is not" in said.err
    assert said.err.count("\n") == 1
    assert "not used" not in call(capsys, *command, code=ExitCode.NOTHING_TO_DO).out


@pytest.mark.usefixtures("measured")
def test_freesurfer_folders_of_any_name(dataset, tmp_path, capsys):
    bids, out = tmp_path / "bids", tmp_path / "out"
    options = ("--freesurfer-dir", dataset, "--no-reports")
    said = call(capsys, bids, out, "participant", *options).out
    renamed = "renamed: 2 folders (bert as sub-bert, sub-AD_05 as sub-AD05)"
    assert f"note: {renamed}" in said
    assert f"note: {renamed}" in the_log(out)
    assert "sub-AD05_hemi-L_seg-freesurfer: note: the folder of sub-AD05 is sub-AD_05" in (
        the_log(out)
    )
    (record,) = (out / "sub-AD05" / "anat").glob("*hemi-L*_desc-qc_metrics.json")
    assert files.read_json(record)["notes"] == ["the folder of sub-AD05 is sub-AD_05"]
    assert {row["subject"] for row in read_status(out)} == {"sub-01", "sub-AD05", "sub-bert"}


@pytest.mark.parametrize("label", ["AD05", "AD_05", "sub-AD_05"])
def test_subjects_by_the_name_of_the_folder(dataset, tmp_path, capsys, label):
    command = (tmp_path / "bids", tmp_path / "out", "participant", "--participant-label", label)
    said = call(capsys, *command, "--dry-run", "--freesurfer-dir", dataset).out
    assert "derivatives" not in said.splitlines()[0].removeprefix(str(tmp_path))
    assert [line.split()[0] for line in said.splitlines() if "hippoAmyg" in line] == ["AD05"] * 2
    code = ExitCode.USAGE if "_" in label else ExitCode.NOTHING_TO_DO
    said = call(capsys, *command, "--dry-run", code=code).err
    assert ("is not a BIDS label" if "_" in label else "Not used: 1 folder (sub-AD_05)") in said
    assert said.count("\n") == 1


@pytest.mark.usefixtures("measured")
def test_two_folders_for_one_label(dataset, tmp_path, capsys):
    (dataset / "AD05").symlink_to(dataset / "bert")
    bids, out = tmp_path / "bids", tmp_path / "out"
    options = ("--freesurfer-dir", dataset, "--no-reports")
    said = call(capsys, bids, out, "participant", *options, code=ExitCode.SOME_FAILED)
    assert said.err.count("[same-label] AD05 and sub-AD_05 would all be sub-AD05; ") == 2
    rows = {(row["subject"], row["decision"], row["reason"]) for row in read_status(out)}
    assert rows == {
        ("sub-01", "use", "n/a"),
        ("sub-bert", "use", "n/a"),
        ("sub-AD05", "failed", "same-label"),
    }


def messages(out, column="message"):
    return {f"{row['subject']} {row['hemi']}": row[column] for row in read_status(out)}


@pytest.mark.usefixtures("measured")
def test_the_same_labels_twice(monkeypatch, tmp_path, capsys):
    inputs, out = tmp_path / "in", tmp_path / "out"
    acts = {"01": "ok", "02": "flagged", "03": "ok"}
    items = [make_input(inputs, sub, hemi=hemi, act=acts[sub]) for sub in acts for hemi in "LR"]
    # One file with both hemispheres, and a participant whose sides are copies of each other.
    items[1] = make_input(inputs, "01", hemi="R")
    both = items[0].files
    items[1] = replace(items[1], files=both, bilateral=True)
    items[0] = replace(items[0], bilateral=True)
    monkeypatch.setattr(search, "dataset_notes", lambda *_: ())
    command = ("x", out, "participant")

    def run(*chosen):
        monkeypatch.setattr(search, "find_inputs", lambda _: Findings(items=tuple(chosen)))
        return call(capsys, *command).err

    assert run(*items) == ""
    assert set(messages(out).values()) == {"n/a", "look at it"}
    seconds = [row["seconds"] for row in read_status(out)]

    # A file of the third is overwritten by that of the second: both are marked, times are kept.
    items[5].files[0].write_bytes(items[2].files[0].read_bytes())
    line = (
        "warning: sub-02_hemi-L_seg-demo, sub-03_hemi-R_seg-demo have the same labels, byte for"
        " byte; check that no file was copied\n"
    )
    assert run(*items) == line
    expected = {f"sub-{subject} {hemi}": "n/a" for subject in acts for hemi in "LR"}
    expected |= {"sub-02 L": "sub-03_hemi-R_seg-demo", "sub-03 R": "sub-02_hemi-L_seg-demo"}
    assert messages(out, "same_labels") == expected
    assert messages(out)["sub-02 L"] == "look at it"
    assert [row["seconds"] for row in read_status(out)][:5] == seconds[:5]
    assert "WARNING sub-02_hemi-L_seg-demo, sub-03" in "".join(
        path.read_text("utf-8") for path in (out / "logs").glob("*.log")
    )
    assert line.removeprefix("warning: ").strip() in cohort_page(read_cohort(out))

    # Also if a run is about one of them; nobody else is told.
    assert run(items[5]) == line
    assert run(items[0]) == ""
    assert messages(out, "same_labels") == expected

    # Put right, the marks go.
    items[5].files[0].write_text("ok again")
    assert run(*items) == ""
    assert set(messages(out, "same_labels").values()) == {"n/a"}
    assert "the same labels" not in cohort_page(read_cohort(out))
