"""Worker processes of which any may die without harm to the others. Knows nothing of hemispheres.

Each worker has a pipe of its own: an abort in a mesh library, an out-of-memory kill or a time limit
costs that worker's job only. The standard library's executors lose every pending job then. Pebble's
pool (5.2) does not, but its workers share one pipe and one lock, so that a kill at the wrong moment
stops all; a time limit kills the worker and leaves its helper processes (TetGen); limits follow the
wall clock, which may be set during a run; nothing ends a busy worker if the parent is killed; and
its threads forbid forking, so that each worker would load all libraries itself.
"""

import contextlib
import ctypes
import faulthandler
import math
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass, field
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psutil

if TYPE_CHECKING:
    from types import FrameType

#: Read by the numerical libraries when they load, so they have to be set before. One thread per
#: process: hemispheres are the unit of parallel work, not matrices.
THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMEXPR_NUM_THREADS",
)

_PR_SET_PDEATHSIG = 1  # linux/prctl.h
_OOM_SCORE = "500"  # of -1000 to 1000: if memory runs out, a worker is lost and not the run
_GRACE = 5.0  # s that an idle worker gets to end by itself
_START_TIME = 300.0  # s that a worker gets to load its libraries, on a slow network disk
STARTS = 3
"""Attempts: a worker that never gets ready is a broken installation, not bad luck."""


def pin_threads() -> None:
    """Give the numerical libraries that this process is going to load one thread each.

    More would compete with each other and with other processes, and sums would be taken in another
    order. A process without threads can also be forked.
    """
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))


def processors() -> int:
    """Count the processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _ignore(_jobs: list[Any]) -> None:
    pass


@dataclass(frozen=True, kw_only=True)
class WorkerPlan:
    """How workers run."""

    work: Callable[[Any], Any]
    """Importable function of one job; has to catch its own errors."""
    n_workers: int
    timeout: float
    """Seconds per job."""
    log: Path
    """Receives what workers and the libraries in them print."""
    warm_up: Callable[[], None] | None = None
    """Importable function that loads libraries before the clock of the first job starts."""
    environment: tuple[tuple[str, str], ...] = ()
    """Further environment variables."""
    begun: Callable[[list[Any]], None] = _ignore
    """Importable function that hears of all jobs in work whenever one begins."""
    patience: float | None = None
    """Seconds that an idle worker waits for a job before it ends; ``None`` is forever."""


@dataclass(frozen=True, kw_only=True)
class WorkerLost:
    """Result of a job whose worker died or was stopped."""

    timed_out: bool
    exit_code: int | None
    seconds: float

    @property
    def cause(self) -> str:
        """The signal's name or the exit code, for messages."""
        code = self.exit_code
        if code is None:
            return "its machine or allocation was lost several times"
        with contextlib.suppress(ValueError):
            return signal.Signals(-code).name
        return f"exit code {code}"


@dataclass(eq=False)
class Slot:
    """A worker process, as its parent knows it."""

    process: BaseProcess
    connection: Connection
    ready: bool = False
    """Whether it has loaded everything, which its first message says."""
    job: Any = None
    started: float = field(default_factory=time.monotonic)

    def deadline(self, timeout: float) -> float:
        """When to give up on it (monotonic clock); an idle worker may wait forever."""
        if not self.ready:
            return self.started + _START_TIME
        return self.started + timeout if self.job is not None else math.inf

    def give(self, job: Any) -> None:  # noqa: ANN401  (jobs are the caller's)
        """Send a job; ``None`` ends the worker."""
        self.job, self.started = job, time.monotonic()
        # A worker that died idle is noticed when it is polled.
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.connection.send(job)

    def lose(self, *, timed_out: bool) -> WorkerLost:
        """End a worker that died or took too long, and return how it ended."""
        if not timed_out:
            # The pipe breaks a moment before the process ends; its exit code tells more than ours.
            wait([self.process.sentinel], _GRACE)
        self.kill()
        seconds = time.monotonic() - self.started
        return WorkerLost(timed_out=timed_out, exit_code=self.process.exitcode, seconds=seconds)

    def kill_group(self) -> None:
        """Kill a worker and the helpers it started, which share its process group.

        It must not have been waited for before: until then its number cannot be another's.
        """
        with contextlib.suppress(ProcessLookupError, PermissionError, TypeError):
            os.killpg(self.process.pid, signal.SIGKILL)  # type: ignore[arg-type]  # None: TypeError

    def kill(self) -> None:
        """End a worker and its helpers, and wait for it."""
        self.kill_group()
        self.process.kill()
        self.process.join()
        self.connection.close()


#: Works off jobs as :func:`run_jobs` does; yields each job with its answer.
RunJobs = Callable[[WorkerPlan, Iterable[Any]], Generator[tuple[Any, Any]]]


def run_jobs(plan: WorkerPlan, jobs: Iterable[Any]) -> Generator[tuple[Any, Any]]:
    """Work off jobs in parallel; closing the generator stops all workers."""
    queue: Iterator[Any] = iter(jobs)
    waiting = next(queue, None)
    slots: list[Slot] = []
    failed_starts = 0
    try:
        while waiting is not None or any(slot.job is not None for slot in slots):
            for slot in slots:
                if waiting is not None and slot.ready and slot.job is None:
                    slot.give(waiting)
                    waiting = next(queue, None)
                    plan.begun([slot.job for slot in slots if slot.job is not None])
            if waiting is not None and len(slots) < plan.n_workers:
                slots.append(start(plan))
                continue
            for slot, message in poll(slots, plan.timeout):
                if isinstance(message, WorkerLost):
                    slots.remove(slot)
                    failed_starts += not slot.ready
                    if failed_starts >= STARTS:
                        raise RuntimeError(f"worker processes do not start; see {plan.log}")
                elif not slot.ready:
                    slot.ready, failed_starts = True, 0
                    continue
                job, slot.job = slot.job, None
                if job is not None:
                    yield job, message
    finally:
        _stop(slots)


def poll(slots: list[Slot], timeout: float) -> list[tuple[Slot, Any]]:
    """Wait for messages, deaths, or the next deadline."""
    nearest = min(slot.deadline(timeout) for slot in slots)
    patience = None if math.isinf(nearest) else max(0.0, nearest - time.monotonic())
    heard = set(wait([slot.connection for slot in slots], patience))
    events: list[tuple[Slot, Any]] = []
    for slot in slots:
        if slot.connection in heard:
            try:
                events.append((slot, slot.connection.recv()))
            except (EOFError, OSError):
                events.append((slot, slot.lose(timed_out=False)))
        elif time.monotonic() >= slot.deadline(timeout):
            events.append((slot, slot.lose(timed_out=True)))
    return events


def start(plan: WorkerPlan) -> Slot:
    """Start a worker process."""
    context = _context()
    if plan.warm_up is not None and context.get_start_method() == "fork":
        # Once for all workers. An error shows again in them, and in the log.
        with contextlib.suppress(Exception):
            plan.warm_up()
    parent_end, child_end = context.Pipe()
    # Not daemonic: stages may start helper processes of their own.
    process = context.Process(target=_serve, args=(child_end, plan, os.getpid()), daemon=False)
    try:
        with _inherited(plan):
            process.start()
    except BaseException:  # Ctrl-C: nothing would reach the worker
        if process.pid is not None:
            process.kill()
        raise
    finally:
        child_end.close()
    return Slot(process=process, connection=parent_end)


def _context() -> Any:  # noqa: ANN401  (the contexts have no common type that can start processes)
    """Choose fork, so that nothing is loaded twice, unless threads or the system make it unsafe."""
    if sys.platform == "linux" and psutil.Process().num_threads() == 1:
        return multiprocessing.get_context("fork")
    resource_tracker.ensure_running()  # its start would let Ctrl-C through
    return multiprocessing.get_context("spawn")


@contextlib.contextmanager
def _inherited(plan: WorkerPlan) -> Iterator[None]:
    """Set what a new process inherits: one thread per library, and no reaction to Ctrl-C.

    The terminal sends Ctrl-C to every process; it is this one that stops the workers. Here it is
    only put off until the process is started.
    """
    variables = dict.fromkeys(THREAD_VARIABLES, "1") | dict(plan.environment)
    before = {name: os.environ.get(name) for name in variables}
    caught: list[tuple[int, FrameType | None]] = []
    in_main = threading.current_thread() is threading.main_thread()
    # An exception would get lost within a fork; the mask is what the new process inherits.
    handler = signal.signal(signal.SIGINT, lambda *event: caught.append(event)) if in_main else None
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        if handler is not None:  # none where it was not Python that set it
            signal.signal(signal.SIGINT, handler)
        if caught and callable(handler):
            handler(*caught[0])


def _stop(slots: list[Slot]) -> None:
    """Let idle workers end by themselves, so that they tidy up; then kill the others."""
    idle = [slot for slot in slots if slot.ready and slot.job is None]
    for slot in idle:
        slot.give(None)
    for slot in idle:
        wait([slot.process.sentinel], _GRACE)
    for slot in slots:
        slot.kill()
    slots.clear()


def _serve(connection: Connection, plan: WorkerPlan, parent: int) -> None:
    """Run in the worker: answer jobs until there are no more, or none comes for too long."""
    _separate(parent)
    _redirect(plan.log)
    from threadpoolctl import threadpool_limits  # noqa: PLC0415  (loads libraries)

    if plan.warm_up is not None:
        plan.warm_up()
    with threadpool_limits(1):
        connection.send(None)  # ready
        while connection.poll(plan.patience):
            try:
                job = connection.recv()
            except EOFError:
                return
            if job is None:
                return
            connection.send(plan.work(job))


def _separate(parent: int) -> None:
    """Make a process group of its own, and die with the parent even if that is killed."""
    with contextlib.suppress(OSError):
        os.setsid()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            Path("/proc/self/oom_score_adj").write_text(_OOM_SCORE)
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            raise SystemExit(1)


def _redirect(log: Path) -> None:
    """Send all output, also that of compiled libraries and crash reports, to the log file."""
    handle = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
    os.dup2(handle, 1)
    os.dup2(handle, 2)
    os.close(handle)
    # A forked worker has the streams of its parent, whatever those are.
    sys.stdout = sys.stderr = os.fdopen(
        2, "w", buffering=1, encoding="utf-8", errors="backslashreplace", closefd=False
    )
    faulthandler.enable()
