"""Several runs into one folder at the same time."""

import json
import multiprocessing
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from stand_ins import make_input, stand_in_jobs

from hipsta_bids.derivatives.dataset import read_status
from hipsta_bids.io.files import locked
from hipsta_bids.participant import run as runner
from hipsta_bids.participant.pool import WorkerLost
from hipsta_bids.settings import Settings

RUN = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
from stand_ins import make_input, stand_in_jobs
from hipsta_bids.participant import run as runner
from hipsta_bids.settings import Settings
runner.run_alone, runner.warm_up = stand_in_jobs, None
where = Path(sys.argv[1])
items = [make_input(where / "in", f"{{k:02d}}", act="slow") for k in range(6)]
result = runner.run_participants(
    items, where / "out", Settings(), runner.RunOptions(n_procs=2), lambda outcome: None
)
print(sum(not outcome.skipped for outcome in result.outcomes), flush=True)
sys.exit(result.exit_code)
"""


def test_two_runs_measure_each_hemisphere_once_and_lose_nothing(tmp_path):
    for k in range(6):  # an input that is written anew by the second run is another input
        make_input(tmp_path / "in", f"{k:02d}", act="slow")
    script = RUN.format(tests=str(Path(__file__).parents[1]))
    command = [sys.executable, "-c", script, tmp_path]
    runs = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    measured = [int(run.communicate(timeout=200)[0]) for run in runs]
    assert [run.returncode for run in runs] == [0, 0]
    assert sum(measured) == 6
    out = tmp_path / "out"
    assert [row["decision"] for row in read_status(out)] == ["use"] * 6
    assert len(list(out.rglob("*_desc-qc_metrics.json"))) == 6
    assert not list(out.rglob("*.tmp"))
    json.loads((out / "dataset_description.json").read_text())


def test_locale_and_time_zone_change_nothing(tmp_path):
    outs = []
    for name, more in (
        ("plain", {}),
        # not in ASCII, with the letters that Turkish has capitals of its own for
        ("ıİß", {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}),
        ("ßİı", {"LC_ALL": "tr_TR.UTF-8", "TZ": "Pacific/Kiritimati"}),
    ):
        where = tmp_path / name
        for k in range(6):
            make_input(where / "in", f"{k:02d}", act=("repaired", "bug")[k % 2])
        script = RUN.format(tests=str(Path(__file__).parents[1]))
        script = script.replace('"slow"', '("repaired", "bug")[k % 2]')
        script = script.replace("n_procs=2", "n_procs=1")
        command = [sys.executable, "-c", script, where]
        run = subprocess.run(command, env=os.environ | more, check=False)
        assert run.returncode == 70
        outs.append(where / "out")
    plain, *others = ({p.name: p.read_bytes() for p in out.rglob("sub-*.*")} for out in outs)
    for odd in others:
        assert plain.keys() == odd.keys()
        assert [name for name in plain if plain[name] != odd[name]] == []


def test_an_input_that_vanishes_fails_alone(tmp_path, monkeypatch):
    for name in ("hipsta_bids.inputs.labels", "hipsta_bids.participant.measure"):
        monkeypatch.setitem(sys.modules, name, None)  # put back afterwards
    items = [make_input(tmp_path / "in", f"0{k}") for k in range(3)]

    def vanish(_plan, jobs):
        for job in jobs:
            items[1].files[0].unlink(missing_ok=True)
            yield job, stand_in_jobs(job)

    monkeypatch.setattr(runner, "run_jobs", vanish)

    def run():
        out = tmp_path / "out"
        options = runner.RunOptions()
        return runner.run_participants(items, out, Settings(), options, lambda _: None)

    assert run().exit_code == 1
    rows = read_status(tmp_path / "out")
    assert [row["reason"] for row in rows] == ["n/a", "unreadable-file", "n/a"]
    items[1].files[0].write_text("ok")
    monkeypatch.setattr(runner, "run_jobs", lambda _, jobs: ((j, stand_in_jobs(j)) for j in jobs))
    assert run().exit_code == 0


def hold(root, ready, release):
    with locked(root, "this"):
        ready.set()
        release.wait(100)


def test_locks_exclude_others_and_end_with_their_process(tmp_path):
    context = multiprocessing.get_context("spawn")
    ready, release = context.Event(), context.Event()
    holder = context.Process(target=hold, args=(tmp_path, ready, release))
    holder.start()
    assert ready.wait(100)
    with locked(tmp_path, "that") as alone:
        assert alone
    killer = threading.Timer(0.3, holder.kill)
    start = time.monotonic()
    killer.start()
    with locked(tmp_path, "this") as alone:
        assert alone
        waited = time.monotonic() - start
    assert waited >= 0.3
    holder.join()
    killer.join()


def test_without_locks_single_runs_work(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(37, "No locks available")

    monkeypatch.setattr("fcntl.lockf", refuse)
    with locked(tmp_path, "this") as alone:
        assert not alone


@pytest.mark.parametrize("act", ["ok", "bad-shape"])
def test_a_lost_worker_does_not_undo_what_another_run_did(tmp_path, monkeypatch, act):
    """Its time is up while it waits for another run, which then succeeds, or fails as well."""

    def lose(_plan, jobs):
        for job in jobs:
            stand_in_jobs(job)  # as the other run does
            yield job, WorkerLost(timed_out=True, exit_code=-9, seconds=1.0)

    for name in ("hipsta_bids.inputs.labels", "hipsta_bids.participant.measure"):
        monkeypatch.setitem(sys.modules, name, None)  # put back afterwards
    monkeypatch.setattr(runner, "run_jobs", lose)
    items = [make_input(tmp_path / "in", act=act)]
    result = runner.run_participants(
        items, tmp_path / "out", Settings(), runner.RunOptions(), lambda _: None
    )
    (row,) = read_status(tmp_path / "out")
    assert row["decision"] == result.outcomes[0].decision == ("use" if act == "ok" else "failed")
    assert row["reason"] == ("n/a" if act == "ok" else "timeout")


def test_a_worker_can_print_any_letter_in_any_locale(tmp_path):
    script = (
        "import pathlib, sys; from hipsta_bids.participant import pool;"
        "pool._redirect(pathlib.Path(sys.argv[1])); print('\\u0131 \\udcff')"
    )
    locale = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    command = [sys.executable, "-c", script, tmp_path / "log"]
    subprocess.run(command, env=os.environ | locale, check=True)
    assert (tmp_path / "log").read_text(encoding="utf-8") == "\u0131 \\udcff\n"
