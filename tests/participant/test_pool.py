import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from pool_jobs import HEARD, broken_start, hear, work

from hipsta_bids.participant import pool
from hipsta_bids.participant.pool import WorkerLost, WorkerPlan, run_jobs


def plan(tmp_path, **options):
    options = {"work": work, "n_workers": 1, "timeout": 30.0} | options
    return WorkerPlan(log=tmp_path / "log", **options)


def test_losses_stay_alone_and_have_a_cause(tmp_path):
    jobs = ["square 3", "exit 5", "kill 9", "raise", "sleep 60", "square 4"]
    results = dict(run_jobs(plan(tmp_path, n_workers=2, timeout=3.0), jobs))
    assert results["square 3"] == 9
    assert results["square 4"] == 16
    assert results["exit 5"].cause == "exit code 5"
    assert results["kill 9"].cause == "SIGKILL"
    assert results["raise"].cause == "exit code 1"
    assert [job for job in jobs[1:5] if not isinstance(results[job], WorkerLost)] == []
    assert [job for job in jobs[1:5] if results[job].timed_out] == ["sleep 60"]
    # the limit is 3 s; a loaded machine may be slow to notice
    assert 3.0 <= results["sleep 60"].seconds < 20.0
    assert "ValueError: asked to" in (tmp_path / "log").read_text()


def test_workers_end_with_the_generator_and_so_do_their_helpers(tmp_path):
    results = run_jobs(plan(tmp_path), ["helper", "sleep 60"])
    _, numbers = next(results)
    assert all(alive(number) for number in numbers)
    results.close()
    deadline = time.monotonic() + 10
    while any(alive(number) for number in numbers) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(alive(number) for number in numbers)


def alive(number):
    """Running, and not merely waiting for its end to be noticed."""
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return False
    if sys.platform == "linux":
        try:
            return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
        except FileNotFoundError:
            return False
    return True


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_ctrl_c_while_a_worker_starts_is_not_lost(tmp_path, monkeypatch, method):
    context = multiprocessing.get_context(method)
    start = context.Process.start

    def start_under_ctrl_c(process):
        os.kill(os.getpid(), signal.SIGINT)
        start(process)

    monkeypatch.setattr(pool, "_context", lambda: context)
    monkeypatch.setattr(context.Process, "start", start_under_ctrl_c)
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            list(run_jobs(plan(tmp_path), ["square 3"]))
    finally:
        signal.signal(signal.SIGINT, handler)
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


def test_workers_that_cannot_start_are_a_bug(tmp_path):
    with pytest.raises(RuntimeError, match="worker processes do not start"):
        list(run_jobs(plan(tmp_path, warm_up=broken_start), ["square 1"]))
    assert "ModuleNotFoundError" in (tmp_path / "log").read_text()


def test_environment_reaches_workers_and_is_put_back(tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("HIPSTA_TEST", raising=False)
    options = {"environment": (("HIPSTA_TEST", "x"),)}
    ((_, seen),) = run_jobs(plan(tmp_path, **options), ["environment"])
    environment = json.loads(seen)
    assert environment["OMP_NUM_THREADS"] == "1"
    assert environment["HIPSTA_TEST"] == "x"
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "HIPSTA_TEST" not in os.environ


@pytest.mark.skipif(sys.platform != "linux", reason="Linux has such a score")
def test_if_memory_runs_out_workers_go_before_the_run(tmp_path):
    ((_, score),) = run_jobs(plan(tmp_path), ["oom-score"])
    assert score > int(Path("/proc/self/oom_score_adj").read_text())


def test_no_jobs_need_no_workers(tmp_path):
    assert list(run_jobs(plan(tmp_path), [])) == []
    assert not (tmp_path / "log").exists()


THREADLESS = """
import subprocess
import sys
sys.path.insert(0, {tests!r})
from pathlib import Path
from pool_jobs import work
from hipsta_bids.participant import pool
from hipsta_bids.participant.pool import WorkerPlan, run_jobs
from hipsta_bids.participant import pool
from hipsta_bids.participant.pool import pin_threads
def load():
    import colorsys
pin_threads()
import numpy
plan = WorkerPlan(work=work, n_workers=2, timeout=30, log=Path({where!r}, "log"), warm_up=load)
for job, answer in run_jobs(plan, ["kill 9", "square 4", "exit 3", "square 5"]):
    print(job, getattr(answer, "cause", answer))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="forks on Linux only")
def test_without_threads_workers_are_forked_and_nothing_is_loaded_twice(tmp_path):
    script = THREADLESS.format(tests=str(Path(__file__).parents[1]), where=str(tmp_path))
    # A spawned worker would not find ``load``, which is in no module.
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert sorted(done.stdout.splitlines()) == [
        "exit 3 exit code 3",
        "kill 9 SIGKILL",
        "square 4 16",
        "square 5 25",
    ]


def test_the_command_starts_no_thread_that_would_keep_workers_from_being_forked():
    """Libraries such as pyarrow start threads when they are loaded, and pandas loads it."""
    code = (
        "import psutil; from hipsta_bids.participant.pool import pin_threads; pin_threads();"
        "import hipsta_bids.cli.participant, hipsta_bids.participant.run;"
        "import hipsta_bids.inputs.search;"
        "print(psutil.Process().num_threads())"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "1"


def test_what_is_in_work_is_told(tmp_path):
    jobs = ["square 3", "square 4", "square 5"]
    HEARD.clear()
    dict(run_jobs(plan(tmp_path, n_workers=2, begun=hear), jobs))
    assert sorted({job for now in HEARD for job in now}) == jobs
    assert len(HEARD) == 3
    assert max(map(len, HEARD)) <= 2
