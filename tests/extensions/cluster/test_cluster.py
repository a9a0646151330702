"""Dask as the engine. SLURM itself is tested by ``tools/test-cluster``."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from pool_jobs import work

from hipsta_bids.cli.participant import build_parser
from hipsta_bids.errors import UsageError
from hipsta_bids.extensions.cluster import engine
from hipsta_bids.extensions.cluster.engine import Cluster, check_cluster, run_on_cluster
from hipsta_bids.extensions.cluster.worker import Worker
from hipsta_bids.participant.pool import WorkerLost, WorkerPlan

JOBS = ["square 3", "exit 5", "kill 9", "raise", "sleep 60", "square 4"]

#: Two runs on one Dask worker with two threads: one to its end, one that is stopped.
SCRIPT = """
import sys, time
from dataclasses import replace
from pathlib import Path
from distributed import LocalCluster
from pool_jobs import work
from hipsta_bids.extensions.cluster import engine
from hipsta_bids.extensions.cluster.engine import Cluster, run_on_cluster
from hipsta_bids.errors import UsageError
from hipsta_bids.participant.pool import WorkerPlan

if __name__ == "__main__":
    where = Path(sys.argv[1])
    plan = WorkerPlan(work=work, n_workers=2, timeout=4, log=where / "log")
    with LocalCluster(n_workers=1, threads_per_worker=2, dashboard_address=None) as dask:
        there = Cluster(scheduler=dask.scheduler_address)
        for job, answer in run_on_cluster(there, plan, {jobs!r}):
            print(job, "->", getattr(answer, "cause", answer))
        stopped = run_on_cluster(there, replace(plan, timeout=100), ["helper", "sleep 60"])
        _, processes = next(stopped)
        stopped.close()
        deadline = time.monotonic() + 100
        # The helper is left to the system, which may be slow to notice its end.
        while Path(f"/proc/{{processes[0]}}").exists():
            assert time.monotonic() < deadline
            time.sleep(0.05)
        print("ended")
        engine.__version__ = "0.0.0"
        try:
            list(run_on_cluster(there, plan, ["square 2"]))
        except UsageError as error:
            print(error)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
@pytest.mark.long
def test_jobs_on_dask_end_as_in_the_pool(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.format(jobs=JOBS))
    paths = os.pathsep.join([str(Path(__file__).parents[2]), *filter(None, sys.path)])
    done = subprocess.run(
        [sys.executable, script, tmp_path],
        env=os.environ | {"PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    *answers, ended, refused = done.stdout.splitlines()
    assert sorted(answers) == [
        "exit 5 -> exit code 5",
        "kill 9 -> SIGKILL",
        "raise -> exit code 1",
        "sleep 60 -> SIGKILL",  # its time was up
        "square 3 -> 9",
        "square 4 -> 16",
    ]
    assert ended == "ended"
    assert refused.startswith("Dask's workers have hipsta_bids")


def test_a_single_worker_is_replaced_when_it_has_died_or_waited_for_too_long(tmp_path):
    worker = Worker(
        WorkerPlan(work=work, n_workers=1, timeout=30.0, log=tmp_path / "log", patience=0.2)
    )
    assert worker("square 3") == 9
    first = worker._slot.process
    first.join(10)
    assert first.exitcode == 0
    assert worker("square 4") == 16
    assert isinstance(worker("kill 9"), WorkerLost)
    assert worker("square 5") == 25
    worker.kill()


def test_what_is_not_installed_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "dask_jobqueue", None)
    with pytest.raises(UsageError, match=r"--slurm: dask_jobqueue .* 'hipsta_bids\[cluster\]'"):
        check_cluster(Cluster(slurm=""))
    with pytest.raises(UsageError, match="not both"):
        check_cluster(Cluster(slurm="", scheduler="tcp://127.0.0.1:1"))


def test_a_scheduler_that_does_not_answer_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(engine, "_ANSWER_TIME", 0.2)
    plan = WorkerPlan(work=work, n_workers=1, timeout=1.0, log=tmp_path / "log")
    with pytest.raises(UsageError, match=r"--dask-scheduler tcp://127\.0\.0\.1:9: no answer"):
        list(run_on_cluster(Cluster(scheduler="tcp://127.0.0.1:9"), plan, ["square 1"]))


def test_the_file_of_a_scheduler_is_waited_for(tmp_path, monkeypatch):
    given = {}

    def connect(**options):
        given.update(options)
        raise OSError("that is all")

    monkeypatch.setattr("distributed.Client", connect)
    path = tmp_path / "scheduler.json"
    threading.Timer(0.3, path.write_text, ["{}"]).start()
    plan = WorkerPlan(work=work, n_workers=1, timeout=1.0, log=tmp_path / "log")
    with pytest.raises(UsageError, match="that is all"):
        list(run_on_cluster(Cluster(scheduler=str(path)), plan, ["square 1"]))
    assert given["scheduler_file"] == str(path)


def test_what_slurm_refuses_is_told(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UsageError, match="there is no sbatch here"):
        engine._check_script("#!/bin/sh\n")
    sbatch = tmp_path / "sbatch"
    sbatch.write_text("#!/bin/sh\necho 'sbatch: error: no such\npartition' >&2\nexit 1\n")
    sbatch.chmod(0o755)
    with pytest.raises(UsageError, match=r"sbatch refuses \(sbatch: error: no such partition\)"):
        engine._check_script("#!/bin/sh\n")


@pytest.mark.parametrize("options", ["-p short", "--time=1:00", "-p short --mem=2G", "-pshort"])
def test_options_of_sbatch_may_begin_with_dashes(options):
    arguments = ["in", "out", "participant", "--slurm", options, "--n-procs", "3"]
    parsed = build_parser().parse_args(arguments)
    assert (parsed.slurm, parsed.n_procs) == (options, 3)
