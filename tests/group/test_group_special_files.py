"""Pipes and devices in place of files of the group level: one line, at once, in little memory."""

import os
import resource
import signal
from pathlib import Path

import pytest
from extension_marks import PRESENT, needs
from small_cohorts import FAST, place_of, write_dataset

from hipsta_bids.cli.main import main

#: Seconds after which a command has hung on a machine under load; a fault takes 0.3 s otherwise.
PATIENCE = 20
#: Most growth of the largest memory of this process, kB; a study takes 30 MB.
MEMORY = 400_000
PHENOTYPE, SIDECAR = "bids/phenotype/scores.tsv", "bids/participants.json"
RECORD = place_of("out", "01", "L").path("qc").as_posix()
SHEET = place_of("out", "01", "L").path("sheet").as_posix()
VOLUMES = ["--volumes", "own=volumes/sub-{subject}.tsv"]
MAPS = ["--maps", "own=maps/sub-{subject}_hemi-{hemi}.shape.gii", "--measures", "own"]
SEGMENTATIONS = ["--segmentations", "fs"]
CASES = [
    ("bids/participants.tsv", []),
    (SIDECAR, []),
    (PHENOTYPE, []),
    ("more.tsv", ["--covariates", "more.tsv"]),
    ("excluded.tsv", ["--exclude", "excluded.tsv"]),
    ("ratings.tsv", ["--ratings", "ratings.tsv"]),
    ("s.toml", ["--settings", "s.toml"]),
    ("model.json", ["--model", "model.json"]),
    ("template.json", ["--template", "template.json"]),
    *[("sites.json", ["--harmonize", "sex", "--harmonize-model", "sites.json"])]
    * ("sites" in PRESENT),
    *[("norms.json", ["--norms", "norms.json"])] * ("norms" in PRESENT),
    ("fs/sub-01/stats/aseg.stats", SEGMENTATIONS),
    ("fs/sub-01/mri/sub-01_icv.txt", SEGMENTATIONS),
    ("out/desc-settings.json", []),
    ("out/dataset_description.json", []),
    (RECORD, []),
    (SHEET, []),
]


def hung(*_):
    raise TimeoutError("hung")


@pytest.fixture(autouse=True)
def watched():
    """End what hangs, as opening a pipe does, and refuse what takes memory."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    handler = signal.signal(signal.SIGALRM, hung)
    signal.alarm(PATIENCE)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, handler)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < MEMORY


def make(path, kind):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    if kind == "fifo":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")


@pytest.mark.parametrize("kind", ["fifo", "zero"])
@pytest.mark.parametrize("case", CASES, ids=[place for place, _ in CASES])
def test_commands_end_at_once(study, capsys, monkeypatch, kind, case):
    place, options = case
    monkeypatch.chdir(study.data.parent)
    make(Path(place), kind)
    fast = ["--no-reports"] if "--norms" in options else FAST
    assert main(["bids", "out", "group", *fast, *options]) in {64, 65}
    error = capsys.readouterr().err
    assert "no regular file" in error
    assert error.count("\n") == 1


def test_sessions_end_at_once(tmp_path, capsys):
    data, out = write_dataset(tmp_path, session="1")
    make(data / "sub-02" / "sub-02_sessions.tsv", "fifo")
    assert main([str(data), str(out), "group", *FAST]) == 65
    assert "sub-02_sessions.tsv: not readable as a table (no regular" in capsys.readouterr().err


@needs("maps")
@pytest.mark.parametrize("kind", ["fifo", "zero"])
@pytest.mark.parametrize("place", ["volumes/sub-01.tsv", "maps/sub-01_hemi-L.shape.gii"])
def test_patterns_match_regular_files_only(study, capsys, kind, place):
    make(study.data / place, kind)
    options = VOLUMES if place.startswith("v") else MAPS
    assert main([str(study.data), str(study.out), "group", "--no-reports", *options]) == 66
    error = capsys.readouterr().err
    assert "no file matches" in error
    assert error.count("\n") == 1
