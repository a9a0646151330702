"""Several runs into one folder at the same time."""

import json
import multiprocessing
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from stand_ins import make_input, stand_in_job

from hipsta_bids import runner
from hipsta_bids.bids.locks import locked
from hipsta_bids.bids.status import read_status
from hipsta_bids.pool import WorkerLost
from hipsta_bids.settings import Settings

RUN = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
from stand_ins import make_input, stand_in_job
from hipsta_bids import runner
from hipsta_bids.settings import Settings
runner.run_job, runner.warm_up = stand_in_job, None
where = Path({where!r})
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
    script = RUN.format(tests=str(Path(__file__).parent), where=str(tmp_path))
    runs = [
        subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    measured = [int(run.communicate(timeout=60)[0]) for run in runs]
    assert [run.returncode for run in runs] == [0, 0]
    assert sum(measured) == 6
    out = tmp_path / "out"
    assert [row["status"] for row in read_status(out)] == ["ok"] * 6
    assert len(list(out.rglob("*_desc-qc_metrics.json"))) == 6
    assert not list(out.rglob("*.tmp"))
    json.loads((out / "dataset_description.json").read_text())


def hold(root, ready, release):
    with locked(root, "this"):
        ready.set()
        release.wait(10)


def test_locks_exclude_others_and_end_with_their_process(tmp_path):
    context = multiprocessing.get_context("spawn")
    ready, release = context.Event(), context.Event()
    holder = context.Process(target=hold, args=(tmp_path, ready, release))
    holder.start()
    assert ready.wait(10)
    with locked(tmp_path, "that") as alone:
        assert alone
    killer = context.Process(target=kill_later, args=(holder.pid,))
    start = time.monotonic()
    killer.start()
    with locked(tmp_path, "this") as alone:
        assert alone
        waited = time.monotonic() - start
    assert waited >= 0.3
    holder.join()
    killer.join()


def kill_later(pid):
    time.sleep(0.3)
    os.kill(pid, 9)


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
            stand_in_job(job)  # as the other run does
            yield job, WorkerLost(timed_out=True, exit_code=-9, seconds=1.0)

    for name in ("hipsta_bids.bids.images", "hipsta_bids.participant"):
        monkeypatch.setitem(sys.modules, name, None)  # put back afterwards
    monkeypatch.setattr(runner, "run_jobs", lose)
    items = [make_input(tmp_path / "in", act=act)]
    result = runner.run_participants(
        items, tmp_path / "out", Settings(), runner.RunOptions(), lambda _: None
    )
    (row,) = read_status(tmp_path / "out")
    assert row["status"] == result.outcomes[0].status == ("ok" if act == "ok" else "failed")
    assert row["reason"] == ("n/a" if act == "ok" else "timeout")
