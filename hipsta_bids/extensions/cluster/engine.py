"""Dask as the engine of the same jobs.

Each Dask worker hands its jobs to a process of its own, as the pool does on one machine, so that a
crash or a time limit costs one job and not the worker. Where a whole worker is lost, with its
machine or its allocation, Dask gives its jobs to others.
"""

import contextlib
import multiprocessing
import subprocess
import sys
import threading
import time
from collections.abc import Generator, Iterable
from dataclasses import dataclass, replace
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any

from hipsta_bids import __version__
from hipsta_bids.errors import HipstaError, UsageError
from hipsta_bids.extensions.cluster.worker import Worker
from hipsta_bids.participant.pool import WorkerLost, WorkerPlan

_PATIENCE = 60.0  # s that an idle process stays, should the run have died
_ANSWER_TIME = 30  # s that a scheduler gets to answer, and before to write its file
_PAUSE = 0.2  # s between looks at that file
_WINDOW = 5000  # jobs at the scheduler at a time: more than there are workers, less than it minds
_JOB_MEMORY = "1 GB"  # of a SLURM job: a hemisphere, and Dask's own worker

#: In a Dask worker: the processes that measure, for all of its threads, and those without a job.
_WORKERS: list[Worker] = []
_IDLE: list[Worker] = []
_LOCK = threading.Lock()


@dataclass(frozen=True, kw_only=True)
class Cluster:
    """Which workers to use."""

    scheduler: str | None = None
    """Address of a Dask scheduler, or the file that it writes."""
    slurm: str | None = None
    """Options of ``sbatch``, for workers of our own."""


def check_cluster(cluster: Cluster) -> None:
    """Check that Dask is there."""
    if cluster.scheduler is not None and cluster.slurm is not None:
        raise UsageError("give --dask-scheduler or --slurm, not both")
    try:
        # Workers that come and go are no news; what was lost is reported per job.
        import_module("dask").config.set({"logging.distributed": "error"})
        import_module("distributed")
        if cluster.slurm is not None:
            import_module("dask_jobqueue")
    except ModuleNotFoundError as error:
        option = "--dask-scheduler" if cluster.slurm is None else "--slurm"
        raise UsageError(
            f"{option}: {error.name} is not installed; pip install 'hipsta_bids[cluster]'"
        ) from error


def run_on_cluster(
    cluster: Cluster, plan: WorkerPlan, jobs: Iterable[Any]
) -> Generator[tuple[Any, Any]]:
    """Work off jobs on a cluster; closing the generator stops what runs there."""
    check_cluster(cluster)
    with contextlib.ExitStack() as stack:
        client = _connect(cluster, plan, stack)
        yield from _work_off(client, replace(plan, patience=_PATIENCE), jobs)


def _connect(cluster: Cluster, plan: WorkerPlan, stack: contextlib.ExitStack) -> Any:  # noqa: ANN401  (Dask is optional)
    connect = import_module("distributed").Client
    if cluster.slurm is not None:
        return stack.enter_context(connect(stack.enter_context(_slurm(cluster.slurm, plan))))
    address = str(cluster.scheduler)
    path, end = Path(address), time.monotonic() + _ANSWER_TIME
    # The scheduler that writes the file may just have been started.
    while "/" in address.replace("://", "") and not path.is_file() and time.monotonic() < end:
        time.sleep(_PAUSE)
    arguments = {"scheduler_file": address} if path.is_file() else {"address": address}
    try:
        return stack.enter_context(connect(**arguments, timeout=_ANSWER_TIME))
    except (OSError, ValueError) as error:
        raise UsageError(
            f"--dask-scheduler {address}: no answer ({error}); give its address as"
            " tcp://HOST:PORT, or the file that `dask scheduler --scheduler-file` writes"
        ) from error


@contextlib.contextmanager
def _slurm(options: str, plan: WorkerPlan) -> Generator[Any]:
    """Have SLURM run workers, and end them when the block ends."""
    with import_module("dask_jobqueue").SLURMCluster(
        cores=1,
        processes=1,
        memory=_JOB_MEMORY,
        python=sys.executable,
        job_extra_directives=[options] if options.strip() else [],
        job_directives_skip=["-t "],  # the time limit is the partition's, or in the options
        log_directory=str(plan.log.parent),
        scheduler_options={"dashboard_address": None},
    ) as workers:
        _check_script(workers.job_script())
        # Constant: those that are lost are replaced.
        workers.adapt(minimum_jobs=plan.n_workers, maximum_jobs=plan.n_workers)
        yield workers


def _check_script(script: str) -> None:
    """Ask SLURM whether it would run a job: Dask would submit it over and over."""
    try:
        subprocess.run(
            ["sbatch", "--test-only"],  # noqa: S607  (where it is differs)
            input=script,
            text=True,
            capture_output=True,
            check=True,
        )
    except FileNotFoundError as error:
        raise UsageError(
            "--slurm: there is no sbatch here; run this where jobs can be submitted"
        ) from error
    except subprocess.CalledProcessError as error:
        raise UsageError(f"--slurm: sbatch refuses ({' '.join(error.stderr.split())})") from error


def _work_off(client: Any, plan: WorkerPlan, jobs: Iterable[Any]) -> Generator[tuple[Any, Any]]:  # noqa: ANN401  (Dask is optional)
    queue = iter(jobs)
    pending = {}
    completed = import_module("distributed").as_completed()

    def submit(number: int) -> None:
        for job in islice(queue, number):
            future = client.submit(_answer, __version__, plan, job, pure=False)
            pending[future] = job
            completed.add(future)

    try:
        submit(_WINDOW)
        for future in completed:
            job = pending.pop(future)
            yield job, _result(future)
            submit(1)
    finally:
        if pending:
            client.cancel(list(pending))
            # What runs already is not stopped by this.
            client.run(_dismiss, plan, on_error="ignore")


def _result(future: Any) -> Any:  # noqa: ANN401  (Dask is optional)
    killed_error = import_module("distributed").KilledWorker
    error = None if future.cancelled() else future.exception()
    if future.cancelled() or isinstance(error, killed_error):
        return WorkerLost(timed_out=False, exit_code=None, seconds=0.0)
    if error is None:
        return future.result()
    if isinstance(error, HipstaError):
        raise error
    raise UsageError(
        f"Dask's workers cannot do this job ({type(error).__name__}: {error}); they need"
        f" hipsta_bids {__version__} and the same folders"
    ) from error


def _answer(version: str, plan: WorkerPlan, job: Any) -> Any:  # noqa: ANN401  (jobs are the caller's)
    """Run in a Dask worker: let a separate process do the job."""
    if version != __version__:
        raise UsageError(f"Dask's workers have hipsta_bids {__version__}, this run has {version}")
    # Dask's workers are daemons, which may have no children: those would outlive them. Ours do not.
    multiprocessing.current_process()._config["daemon"] = False  # type: ignore[attr-defined]  # noqa: SLF001
    worker = _take(plan)
    try:
        return worker(job)
    finally:
        _IDLE.append(worker)


def _take(plan: WorkerPlan) -> Worker:
    """Take an idle process of the same run, or a new one: several runs may share a cluster."""
    with _LOCK:
        for worker in _IDLE:
            if worker.plan == plan:
                _IDLE.remove(worker)
                return worker
        worker = Worker(plan)
        _WORKERS.append(worker)
        return worker


def _dismiss(plan: WorkerPlan) -> None:
    """Run in a Dask worker: end what a run has left there."""
    for worker in _WORKERS:
        if worker.plan == plan:
            worker.kill()
