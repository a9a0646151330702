import errno
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from stand_ins import THICKNESS, make_input, stand_in_jobs, thread_jobs

from hipsta_bids.cli.console import summary_line
from hipsta_bids.derivatives.dataset import COLUMNS, read_status
from hipsta_bids.derivatives.names import OUTPUTS, SHARED
from hipsta_bids.errors import ExitCode, InputError, OutputError, SettingsError
from hipsta_bids.inputs.scan import Edit
from hipsta_bids.io import files
from hipsta_bids.participant import run as runner
from hipsta_bids.participant.run import RunOptions, n_workers, run_participants
from hipsta_bids.settings import BodySettings, Settings
from hipsta_bids.types import Decision


@pytest.fixture(autouse=True)
def stand_ins(monkeypatch):
    """No geometry: it is faster."""
    for name in ("hipsta_bids.inputs.labels", "hipsta_bids.participant.measure"):
        monkeypatch.setitem(sys.modules, name, None)  # put back afterwards
    monkeypatch.setattr(runner, "run_alone", stand_in_jobs)
    monkeypatch.setattr(runner, "warm_up", None)


def run(items, out, **options):
    heard = []
    result = run_participants(items, out, Settings(), RunOptions(**options), heard.append)
    assert tuple(heard) == result.outcomes
    return result


def status_of(out):
    return {
        (row["subject"], row["hemi"]): (row["decision"], row["reason"]) for row in read_status(out)
    }


def names(out):
    return {path.name for path in out.rglob("*") if path.is_file() and "logs" not in path.parts}


@pytest.mark.usefixtures("workers")
def test_one_good_hemisphere_gives_a_complete_dataset(tmp_path):
    out = tmp_path / "out"
    result = run([make_input(tmp_path / "in")], out)
    assert result.exit_code == ExitCode.OK
    assert names(out) == {
        "dataset_description.json",
        "README.md",
        "measures.tsv",
        "measures.json",
        *(row.for_all for row in SHARED),
        ".bidsignore",
        "desc-settings.json",
        "CITATION.md",
        "status.tsv",
        "status.json",
        *(path.name for path in result.outcomes[0].job.result.paths(optional=False)),
    }
    (row,) = read_status(out)
    assert list(row)[: len(COLUMNS)] == list(COLUMNS)
    assert list(row)[len(COLUMNS) :] == ["seconds_read", "seconds_surface", "seconds_write"]
    assert row["decision"] == "use"
    assert row["reason"] == "n/a"
    assert float(row["seconds"]) >= float(row["seconds_write"]) > 0
    assert 10 < float(row["peak_memory_mb"]) < 2000  # numpy alone is above, the test host below
    settings = json.loads((out / "desc-settings.json").read_text())
    assert row["settings_hash"] == settings["hash"]
    assert result.outcomes[0].thickness == THICKNESS


def test_quality_record_says_what_came_in(tmp_path):
    item = make_input(tmp_path / "in")
    result = run([item], tmp_path / "out")
    record = json.loads(result.outcomes[0].job.result.path("qc").read_text())
    assert record["inputs"] == [
        {"file": "bids:tests:sub-01_L.txt", "sha256": files.sha256_of(item.files[0])}
    ]
    assert record["passed_over"] == [{"file": "bids:tests:other.txt", "reason": "coarser"}]
    assert record["chosen_because"] == item.explanation
    assert record["scheme"] == "demo"
    (row,) = read_status(tmp_path / "out")
    assert record["input_hash"] == row["input_hash"]
    assert record["settings_hash"] == row["settings_hash"]


@pytest.mark.usefixtures("workers")
def test_notes_on_the_labels_reach_terminal_log_and_record(tmp_path):
    out = tmp_path / "out"
    result = run([make_input(tmp_path / "in", act="noted")], out)
    (outcome,) = result.outcomes
    assert summary_line(outcome).endswith(" s  in.nii: odd header")
    assert result.log.read_text().count("note: in.nii: odd header") == 1
    record = json.loads(outcome.job.result.path("qc").read_text())
    assert record["notes"] == ["in.nii: odd header"]
    assert record["decision"] == "use"


def test_log_has_a_line_per_stage(tmp_path):
    result = run([make_input(tmp_path / "in")], tmp_path / "out")
    text = result.log.read_text()
    assert result.log.parent == tmp_path / "out" / "logs"
    for stage in ("read", "surface", "write"):
        assert f"sub-01_hemi-L_seg-demo: {stage} " in text


def measures_of(out):
    rows = files.read_tsv(out / "measures.tsv")
    return {(row["participant_id"], row["hemi"]): row for row in rows}


def test_the_table_of_measures_follows_the_status(tmp_path):
    out, acts = tmp_path / "out", {"01": "ok", "02": "bad-shape", "03": "flagged", "04": "repaired"}
    items = [make_input(tmp_path / "in", subject, act=act) for subject, act in acts.items()]
    run(items, out)
    rows = measures_of(out)
    assert {who: (row["decision"], row["reason"]) for who, row in rows.items()} == status_of(out)
    assert [row["repairs"] for row in rows.values()] == ["0", "0", "0", "1"]
    (summary,) = files.read_tsv(next((out / "sub-01").rglob("*_desc-summary_morph.tsv")))
    assert summary.items() <= rows["sub-01", "L"].items()
    assert {rows["sub-02", "L"][name] for name in summary} == {"n/a"}
    about = files.read_json(out / "measures.json")
    assert list(about) == list(rows["sub-01", "L"])
    assert all(about[name]["Units"] for name in summary)

    # What has not changed is not read again; what has, is.
    kept = next((out / "sub-03").rglob("*_desc-summary_morph.tsv"))
    kept.write_text("unreadable")
    items[1] = make_input(tmp_path / "in", "02", act="ok")
    run(items[1:2], out)
    again = measures_of(out)
    assert again["sub-02", "L"]["decision"] == "use"
    assert again["sub-02", "L"]["thickness_mean"] == summary["thickness_mean"]
    assert {w: r for w, r in again.items() if w[0] != "sub-02"} == {
        w: r for w, r in rows.items() if w[0] != "sub-02"
    }


def test_ratings_beside_the_table_of_measures_are_in_it(tmp_path):
    out = tmp_path / "out"
    items = [make_input(tmp_path / "in", subject) for subject in ("01", "02", "03")]
    run(items, out)
    digest = measures_of(out)["sub-01", "L"]["input_hash"]
    head = "participant_id\tsession_id\themi\tprotocol\tregion\trating\tnote\tinput_hash\n"
    row = "sub-{}\tn/a\tL\tdemo\tbody\t{}\tn/a\t{}\n"
    (out / "ratings.tsv").write_text(
        head + row.format("01", "use", digest) + row.format("02", "exclude", "earlier")
    )
    run(items, out)
    ratings = {who: row["rating"] for (who, _), row in measures_of(out).items()}
    assert ratings == {"sub-01": "use", "sub-02": "n/a", "sub-03": "n/a"}


@pytest.mark.usefixtures("workers")
def test_every_kind_of_failure_stays_alone(tmp_path):
    """One run with all ways to end; two workers, so that losses happen beside good work."""
    out = tmp_path / "out"
    acts = {
        "01": "ok",
        "02": "crash",
        "03": "bug",
        "04": "bad-input",
        "05": "hang",
        "06": "flagged",
        "07": "repaired",
        "08": "bad-shape",
        "09": "ok",
    }
    items = [make_input(tmp_path / "in", subject, act=act) for subject, act in acts.items()]
    problem = InputError("two atlases fit; use --ashs-atlas", reason="ambiguous-atlas")
    items.append(make_input(tmp_path / "in", "10", problem=problem))
    result = run(items, out, n_procs=2, timeout=4.0)
    assert status_of(out) == {
        ("sub-01", "L"): ("use", "n/a"),
        ("sub-02", "L"): ("failed", "worker-died"),
        ("sub-03", "L"): ("failed", "internal-error"),
        ("sub-04", "L"): ("failed", "empty-labels"),
        ("sub-05", "L"): ("failed", "timeout"),
        ("sub-06", "L"): ("look", "odd-shape"),
        ("sub-07", "L"): ("use", "n/a"),
        ("sub-08", "L"): ("failed", "body-too-short"),
        ("sub-09", "L"): ("use", "n/a"),
        ("sub-10", "L"): ("failed", "ambiguous-atlas"),
    }
    assert result.counts == {"use": 3, "failed": 6, "look": 1}
    assert result.exit_code == ExitCode.INTERNAL
    log = result.log.read_text()
    assert "ZeroDivisionError: tests divide by zero" in log
    assert "Segmentation fault" in log
    messages = {row["subject"]: row["message"] for row in read_status(out)}
    assert "SIGSEGV" in messages["sub-02"]
    for outcome in result.outcomes:
        place = outcome.job.result
        there = {row.key for row in OUTPUTS if place.path(row.key).exists()}
        full = {row.key for row in OUTPUTS if not row.optional}
        assert there == ({"qc"} if outcome.decision == Decision.FAILED else full)
        record = json.loads(place.path("qc").read_text())
        assert (record["decision"], record["reason"]) == (outcome.decision, outcome.reason)


def test_exit_codes_of_failures(tmp_path):
    bad = make_input(tmp_path / "in", "01", act="bad-input")
    good = make_input(tmp_path / "in", "02")
    shape = make_input(tmp_path / "in", "03", act="bad-shape")
    assert run([bad], tmp_path / "a").exit_code == ExitCode.BAD_DATA
    assert run([bad, good], tmp_path / "b", n_procs=2).exit_code == ExitCode.SOME_FAILED
    assert run([shape], tmp_path / "c").exit_code == ExitCode.SOME_FAILED


def test_second_run_skips_what_is_unchanged(tmp_path):
    out = tmp_path / "out"
    items = [make_input(tmp_path / "in", "01"), make_input(tmp_path / "in", "02", act="flagged")]
    run(items, out, n_procs=2)
    before = (out / "status.tsv").read_bytes()
    times = {path: path.stat().st_mtime_ns for path in out.rglob("sub-*") if path.is_file()}
    result = run(items, out)
    assert [outcome.skipped for outcome in result.outcomes] == [True, True]
    assert result.exit_code == ExitCode.OK
    assert result.counts == {"use": 1, "look": 1}
    assert (out / "status.tsv").read_bytes() == before
    assert {path: path.stat().st_mtime_ns for path in times} == times


def with_edit(item, folder, text="corrected", kind="mask"):
    path = folder / "sub-01_hemi-L_desc-edited_mask.nii.gz"
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    edit = Edit(kind=kind, path=path, source="edited", source_path=folder)
    return replace(item, edits=(edit,))


def test_edits_that_appear_change_or_vanish_are_seen(tmp_path):
    out = tmp_path / "out"
    plain = make_input(tmp_path / "in")
    place = run([plain], out).outcomes[0].job.result

    def is_skipped(item):
        return run([item], out).outcomes[0].skipped

    assert is_skipped(plain)
    assert not is_skipped(with_edit(plain, tmp_path / "e"))
    assert is_skipped(with_edit(plain, tmp_path / "e"))
    assert is_skipped(with_edit(plain, tmp_path / "elsewhere"))  # its content counts
    assert not is_skipped(with_edit(plain, tmp_path / "e", kind="labels"))
    assert not is_skipped(with_edit(plain, tmp_path / "e", "once more"))
    record = json.loads(place.path("qc").read_text())
    (edit,) = record["edited"]
    assert edit["file"] == "bids:edited:sub-01_hemi-L_desc-edited_mask.nii.gz"
    assert edit["sha256"] == files.sha256_of(tmp_path / "e" / edit["file"].rsplit(":", 1)[1])
    assert [row["edited"] for row in read_status(out)] == [edit["what"]] == ["mask"]
    description = json.loads((out / "dataset_description.json").read_text())
    assert "edited" in description["DatasetLinks"]
    assert not is_skipped(plain)
    assert [row["edited"] for row in read_status(out)] == ["n/a"]
    assert json.loads(place.path("qc").read_text())["edited"] == []


def test_an_edit_that_cannot_be_read_fails_and_is_named(tmp_path):
    item = with_edit(make_input(tmp_path / "in"), tmp_path / "e")
    item.edits[0].path.unlink()
    result = run([item], tmp_path / "out")
    (row,) = read_status(tmp_path / "out")
    assert (row["decision"], row["edited"]) == ("failed", "mask")
    assert "desc-edited_mask.nii.gz" in row["message"]
    record = json.loads(result.outcomes[0].job.result.path("qc").read_text())
    assert [edit["what"] for edit in record["edited"]] == ["mask"]


@pytest.mark.parametrize("change", ["input", "missing", "version", "mesh", "force", "record"])
def test_what_changed_is_redone(tmp_path, change):
    out = tmp_path / "out"
    item = make_input(tmp_path / "in")
    place = run([item], out).outcomes[0].job.result
    options = {}
    if change == "input":
        item.files[0].write_text("repaired")
    elif change == "missing":
        place.path("thickness").unlink()
    elif change == "version":
        record = json.loads(place.path("qc").read_text())
        place.path("qc").write_text(json.dumps(record | {"version": "0.0.0"}))
    elif change == "record":
        place.path("qc").write_text("{")
    elif change == "mesh":
        options["write_meshes"] = True
    else:
        options["force"] = True
    (outcome,) = run([item], out, **options).outcomes
    assert not outcome.skipped
    assert outcome.decision == "use"
    assert outcome.repairs == (change == "input")
    assert place.path("mesh").exists() == (change == "mesh")


def test_failed_hemispheres_are_tried_again(tmp_path):
    out = tmp_path / "out"
    item = make_input(tmp_path / "in", act="bad-shape")
    run([item], out)
    (outcome,) = run([item], out).outcomes
    assert not outcome.skipped


def test_maps_go_when_the_new_input_fails(tmp_path):
    out = tmp_path / "out"
    item = make_input(tmp_path / "in")
    place = run([item], out).outcomes[0].job.result
    item.files[0].write_text("bad-input")
    run([item], out)
    assert [path for path in place.paths(optional=True) if path.exists()] == [place.path("qc")]


def test_lost_status_table_is_rebuilt_from_records(tmp_path):
    out = tmp_path / "out"
    items = [make_input(tmp_path / "in", act="flagged")]
    run(items, out)
    (out / "status.tsv").unlink()
    run(items, out)
    assert status_of(out) == {("sub-01", "L"): ("look", "odd-shape")}


def test_rows_of_other_runs_stay(tmp_path):
    out = tmp_path / "out"
    run([make_input(tmp_path / "in", "01", act="bad-shape")], out)
    run([make_input(tmp_path / "in", "02")], out)
    assert status_of(out) == {
        ("sub-01", "L"): ("failed", "body-too-short"),
        ("sub-02", "L"): ("use", "n/a"),
    }


def test_stop_on_first_crash(tmp_path):
    out = tmp_path / "out"
    acts = ["bad-shape", "ok", "ok"]
    items = [make_input(tmp_path / "in", f"0{k}", act=act) for k, act in enumerate(acts)]
    result = run(items, out, stop_on_first_crash=True)
    assert len(result.outcomes) == 1
    assert result.exit_code == ExitCode.SOME_FAILED
    assert status_of(out)[("sub-02", "L")] == ("failed", "not-finished")


def test_other_settings_are_refused_and_nothing_is_lost(tmp_path):
    out = tmp_path / "out"
    item = make_input(tmp_path / "in")
    run([item], out)
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    other = Settings(body=BodySettings(layer_rule="nearest-label"))
    for force in (False, True):
        with pytest.raises(SettingsError, match=r"body\.layer_rule"):
            run_participants([item], out, other, RunOptions(force=force), print)
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


def test_full_disk_ends_the_run_but_harms_nothing_else(tmp_path, monkeypatch):
    write = files.write_bytes

    def no_space_for_labels(path, content):
        if path.name.startswith("sub-02") and path.name.endswith(".label.gii"):
            raise files.output_error(path, OSError(errno.ENOSPC, "No space left on device"))
        write(path, content)

    monkeypatch.setattr(files, "write_bytes", no_space_for_labels)
    out = tmp_path / "out"
    items = [make_input(tmp_path / "in", f"0{k}") for k in (1, 2, 3)]
    result = run(items, out)
    assert result.exit_code == ExitCode.NOT_WRITABLE
    assert status_of(out) == {
        ("sub-01", "L"): ("use", "n/a"),
        ("sub-02", "L"): ("failed", "disk-full"),
        ("sub-03", "L"): ("failed", "not-finished"),
    }
    good, bad = (outcome.job.result for outcome in result.outcomes)
    assert all(path.exists() for path in good.paths(optional=False))
    assert [path for path in bad.paths(optional=True) if path.exists()] == [bad.path("qc")]


def test_unwritable_output_is_refused_before_work(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        run([make_input(tmp_path / "in")], tmp_path / "file" / "out")


@pytest.mark.parametrize(
    ("options", "n_jobs", "expected"),
    [
        ({"n_procs": 4}, 10, 4),
        ({"n_procs": 4}, 2, 2),
        ({"n_procs": 4, "mem_gb": 1.3}, 10, 2),
        ({"n_procs": 4, "mem_gb": 0.1}, 10, 1),
        ({"n_procs": 4}, 0, 1),
    ],
)
def test_limits_on_workers(options, n_jobs, expected):
    assert n_workers(RunOptions(**options), n_jobs) == expected


@pytest.mark.usefixtures("workers")
def test_workers_have_one_thread_and_the_scratch_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "run_alone", thread_jobs)
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    run([make_input(tmp_path / "in")], tmp_path / "out", work_dir=tmp_path)
    seen = json.loads((tmp_path / "out" / "seen.json").read_text())
    assert seen == {"OMP_NUM_THREADS": "1", "TMPDIR": str(tmp_path)}
    assert os.environ["OMP_NUM_THREADS"] == "7"


KILLED_RUN = """
import signal
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
if __name__ == "__main__":
    from stand_ins import make_input, stand_in_jobs
    from hipsta_bids.cli import main as cli
    from hipsta_bids.participant import run as runner
    from hipsta_bids.settings import Settings
    # Ignored where the tests run in the background of a shell.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    runner.run_alone, runner.warm_up = stand_in_jobs, None
    where = Path({where!r})
    items = [make_input(where / "in", f"{{k:02d}}", act="slow") for k in range(9)]
    def run(arguments):
        runner.run_participants(
            items, where / "out", Settings(), runner.RunOptions(),
            lambda outcome: print("done", flush=True),
        )
        return 0
    cli._dispatch = run
    sys.exit(cli.main([]))
"""


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGKILL, -9)]
)
def test_run_that_dies_has_a_table_and_a_rerun_completes(tmp_path, number, code):
    out = tmp_path / "out"
    script = tmp_path / "killed_run.py"
    script.write_text(KILLED_RUN.format(tests=str(Path(__file__).parents[1]), where=str(tmp_path)))
    with subprocess.Popen(
        [sys.executable, script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "done\n"
        time.sleep(0.2)
        process.send_signal(number)
        _, errors = process.communicate(timeout=20)
    assert process.returncode == code
    if code > 0:
        assert errors.count("\n") == 1
        assert "run the same command again" in errors
    found = status_of(out)
    assert len(found) == 9
    assert set(found.values()) == {("use", "n/a"), ("failed", "not-finished")}
    complete = list(out.rglob("*_desc-qc_metrics.json"))
    assert len(complete) == list(found.values()).count(("use", "n/a"))
    if code > 0:  # what was half done is gone
        assert len(list(out.rglob("*_thickness.shape.gii"))) == len(complete)

    items = [make_input(tmp_path / "in", f"{k:02d}", act="slow") for k in range(3)]
    result = run(items, out)
    assert result.exit_code == ExitCode.OK
    assert result.outcomes[0].skipped
    assert not list(out.rglob("*.tmp"))
    assert status_of(out)[("sub-02", "L")] == ("use", "n/a")
