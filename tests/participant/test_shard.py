"""Parts of a dataset: which there are, and how their results come together."""

import random
import sys
from dataclasses import replace

import pytest
from stand_ins import make_input, stand_in_jobs

from hipsta_bids.cli import main
from hipsta_bids.derivatives.dataset import read_status, read_table, table_path, update_status
from hipsta_bids.errors import ExitCode, NothingToDoError, UsageError
from hipsta_bids.inputs import search
from hipsta_bids.inputs.scan import InputRequest
from hipsta_bids.inputs.search import Findings, list_subjects
from hipsta_bids.participant import run
from hipsta_bids.participant.shard import Shard, parse_shard

SUBJECTS = [f"{k:03d}" for k in range(23)]


@pytest.mark.parametrize("count", [1, 2, 7, 23, 30])
def test_parts_are_disjoint_complete_and_balanced_in_any_order(count):
    def parts(subjects):
        return [Shard(index=k + 1, count=count).take(subjects) for k in range(count)]

    found = parts(SUBJECTS)
    assert sorted(sum(found, ())) == SUBJECTS
    sizes = {len(part) for part in found}
    assert max(sizes) - min(sizes) <= 1
    shuffled = random.Random(0).sample([*SUBJECTS, *SUBJECTS[:4]], 27)  # noqa: S311  (no secret)
    assert parts(shuffled) == found


def array_job(*values):
    names = ("ID", "MIN", "MAX", "COUNT", "STEP")
    return {f"SLURM_ARRAY_TASK_{k}": str(v) for k, v in zip(names, values, strict=True)}


@pytest.mark.parametrize(
    ("text", "array", "expected"),
    [
        ("3/100", None, (3, 100)),
        ("slurm", (1, 1, 8, 8, 1), (1, 8)),
        ("slurm", (7, 0, 7, 8, 1), (8, 8)),
        ("slurm", (9, 1, 13, 4, 4), (3, 4)),
        ("slurm", (5, 5, 5, 1, 1), (1, 1)),
    ],
)
def test_which_part(text, array, expected):
    shard = parse_shard(text, array_job(*array) if array else {})
    assert (shard.index, shard.count) == expected


@pytest.mark.parametrize("text", ["0/4", "5/4", "1/0", "3", "a/b", "1/2/3", "-1/4", ""])
def test_parts_that_do_not_exist(text):
    with pytest.raises(UsageError, match="--shard"):
        parse_shard(text, {})


def test_arrays_that_say_nothing():
    with pytest.raises(UsageError, match="no array job"):
        parse_shard("slurm", {})
    for gaps in [(7, 3, 7, 3, 1), (4, 3, 7, 3, 1), (12, 1, 12, 2, 1)]:
        with pytest.raises(UsageError, match="leave gaps"):
            parse_shard("slurm", array_job(*gaps))


def test_subjects_are_listed_over_all_datasets(tmp_path):
    for name in ("a/sub-02", "a/sub-01_ses-1", "b/sub-02", "b/sub-10", "b/code"):
        (tmp_path / "derivatives" / name).mkdir(parents=True)
    request = InputRequest(bids_dir=tmp_path)
    assert list_subjects(request) == ("01", "02", "10")
    assert list_subjects(replace(request, participant_labels=("10", "01"))) == ("01", "10")


ACTS = {"01": "ok", "02": "bad-shape", "03": "flagged", "04": "ok", "05": "ok"}


@pytest.fixture
def command(monkeypatch, tmp_path):
    """The command line, with stand-ins for the search and the measurement."""
    items = tuple(make_input(tmp_path / "in", subject, act=act) for subject, act in ACTS.items())

    def find(request):
        wanted = request.participant_labels or tuple(ACTS)
        found = tuple(item for item in items if item.subject in wanted)
        if not found:
            raise NothingToDoError("none")
        return Findings(items=found)

    monkeypatch.setattr(search, "find_inputs", find)
    monkeypatch.setattr(search, "list_subjects", lambda _: (*ACTS, "99"))
    monkeypatch.setattr(search, "dataset_notes", lambda *_: ())
    for name in ("hipsta_bids.inputs.labels", "hipsta_bids.participant.measure"):
        monkeypatch.setitem(sys.modules, name, None)  # put back afterwards
    monkeypatch.setattr(
        run, "run_jobs", lambda _, jobs: ((job, stand_in_jobs(job)) for job in jobs)
    )

    def call(out, level, *options):
        return main.main(["x", str(tmp_path / out), level, *options])

    return call


def data_files(out):
    """All files but logs, with times masked in the table."""
    found = {
        path.relative_to(out): path.read_bytes()
        for path in out.rglob("*")
        if path.is_file() and "logs" not in path.parts and path.name != "status.tsv"
    }
    rows = [
        {key: cell for key, cell in row.items() if not key.startswith(("seconds", "cpu", "peak"))}
        for row in read_status(out)
    ]
    return found, rows


@pytest.mark.parametrize("last", ["collect", "participant"])
def test_parts_collected_are_as_if_one_run_had_done_all(last, command, tmp_path, capsys):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert command("whole", "participant") == ExitCode.SOME_FAILED
    codes = [command("parts", "participant", "--shard", f"{k}/4") for k in (3, 1, 4, 2)]
    # 02 is in the second part, 99, which has no segmentation, in the second as well
    assert codes == [0, 0, 0, 1]
    assert not (parts / "status.tsv").exists()
    assert len(list((parts / "logs").glob("run-*_shard-*of4.log"))) == 4
    assert data_files(parts) == data_files(whole)  # the tables of the parts are read as one
    capsys.readouterr()
    assert command("parts", last) == ExitCode.SOME_FAILED
    assert "5 hemispheres: 1 failed, 1 look, 3 use" in capsys.readouterr().out
    assert data_files(parts) == data_files(whole)
    rows = read_table(parts / "status.tsv")
    assert [row["decision"] for row in rows] == ["use", "failed", "look", "use", "use"]
    assert all(row["seconds"] != "n/a" for row in rows)


def test_collect_names_what_no_run_has_finished(command, tmp_path):
    command("out", "participant", "--shard", "1/2")  # 01, 03, 05
    assert command("out", "collect") == ExitCode.SOME_FAILED
    reasons = {row["subject"]: row["reason"] for row in read_table(tmp_path / "out/status.tsv")}
    assert reasons == {
        "sub-01": "n/a",
        "sub-02": "not-finished",
        "sub-03": "odd-shape",
        "sub-04": "not-finished",
        "sub-05": "n/a",
    }
    command("out", "participant", "--shard", "2/2")
    command("out", "collect")
    reasons = {row["subject"]: row["reason"] for row in read_table(tmp_path / "out/status.tsv")}
    assert reasons["sub-02"] == "body-too-short"
    assert reasons["sub-04"] == "n/a"


def test_more_parts_than_subjects_are_no_failure(command, tmp_path, capsys):
    assert command("out", "participant", "--shard", "6/6") == ExitCode.OK  # 99
    assert command("out", "participant", "--shard", "9/9") == ExitCode.OK
    assert capsys.readouterr().out.count("has nothing to process") == 2
    assert not (tmp_path / "out").exists()
    assert command("out", "collect", "--shard", "1/2") == ExitCode.USAGE


def test_where_tables_differ_the_quality_record_decides(command, tmp_path):
    out = tmp_path / "out"
    command("out", "participant", "--shard", "1/1")
    (good, *_) = read_status(out)
    late = good | {"decision": "failed", "reason": "not-finished", "input_hash": "n/a"}
    update_status(out, [late])
    update_status(out, [good | {"seconds": "n/a"}], shard="2of3")
    assert read_status(out)[0] == good
    assert read_table(out / table_path("2of3"))[0]["seconds"] == "n/a"
    next(out.rglob("sub-01*-qc_metrics.json")).unlink()
    assert read_status(out)[0]["reason"] == "not-finished"
