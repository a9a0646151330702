"""Worker processes of which any may die without harm to the others.

The standard library's executors lose every pending job when one worker is killed. Here each
worker has a pipe of its own: an abort in a mesh library, an out-of-memory kill or a time limit
costs that worker's job only, and a fresh worker takes its place. Knows nothing of hemispheres.
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
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

# One thread per process: hemispheres are the unit of parallel work, not matrices.


#: Read by the numerical libraries when they load, so they have to be set before.
THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMEXPR_NUM_THREADS",
)


def pin_threads() -> None:
    """Give the numerical libraries that this process is going to load one thread each.

    More would compete with each other and with other processes, and sums would be taken in another
    order. A process without threads can also be forked.
    """
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))


_PR_SET_PDEATHSIG = 1  # linux/prctl.h
_FIRST_TO_GO = "500"  # of -1000 to 1000: if memory runs out, a worker is lost and not the run
_GRACE = 5.0  # s that an idle worker gets to end by itself
_START_TIME = 300.0  # s that a worker gets to load its libraries, on a slow network disk
_STARTS = 3  # a worker that never gets ready is a broken installation, not bad luck


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


@dataclass(frozen=True, kw_only=True)
class WorkerLost:
    """Result of a job whose worker died or was stopped."""

    timed_out: bool
    exit_code: int | None
    seconds: float

    @property
    def cause(self) -> str:
        """For people: the signal's name or the exit code."""
        code = self.exit_code
        if code is None:
            return "its machine or allocation was lost several times"
        if code is not None and code < 0:
            with contextlib.suppress(ValueError):
                return signal.Signals(-code).name
        return f"exit code {code}"


@dataclass(eq=False)
class _Slot:
    process: BaseProcess
    connection: Connection
    ready: bool = False
    job: Any = None
    started: float = field(default_factory=time.monotonic)

    def deadline(self, timeout: float) -> float:
        """When to give up on it (monotonic clock); an idle worker may wait forever."""
        if not self.ready:
            return self.started + _START_TIME
        return self.started + timeout if self.job is not None else math.inf


def run_jobs(plan: WorkerPlan, jobs: Iterable[Any]) -> Generator[tuple[Any, Any]]:
    """Work off jobs in parallel; closing the generator stops all workers."""
    queue: Iterator[Any] = iter(jobs)
    waiting = next(queue, None)
    slots: list[_Slot] = []
    failed_starts = 0
    try:
        while waiting is not None or any(slot.job is not None for slot in slots):
            for slot in slots:
                if waiting is not None and slot.ready and slot.job is None:
                    _give(slot, waiting)
                    waiting = next(queue, None)
            if waiting is not None and len(slots) < plan.n_workers:
                slots.append(_start(plan))
                continue
            for slot, message in _poll(slots, plan.timeout):
                if isinstance(message, _Ready):
                    slot.ready = True
                    failed_starts = 0
                    continue
                job, slot.job = slot.job, None
                if isinstance(message, WorkerLost):
                    slots.remove(slot)
                    failed_starts += not slot.ready
                    if failed_starts >= _STARTS:
                        raise RuntimeError(f"worker processes do not start; see {plan.log}")
                if job is not None:
                    yield job, message
    finally:
        _stop(slots)


class Worker:
    """One worker process, for callers that hand out jobs themselves; replaced when it dies."""

    def __init__(self, plan: WorkerPlan, *, patience: float) -> None:
        self.plan = plan
        self._patience = patience
        self._slot: _Slot | None = None

    def __call__(self, job: Any) -> Any:  # noqa: ANN401  (jobs are the caller's)
        """Do one job."""
        slot = self._ready()
        _give(slot, job)
        answer = self._heard(slot)
        slot.job = None
        return answer

    def kill(self) -> None:
        """End the process, whatever it is doing; may be called by another thread."""
        slot = self._slot
        if slot is None:
            return
        if slot.job is None:
            _kill(slot)
        else:
            _kill_group(slot)  # who waits for it sees to the rest

    def _ready(self) -> _Slot:
        for _ in range(_STARTS):
            if self._slot is not None and not self._slot.process.is_alive():
                _kill(self._slot)
                self._slot = None
            self._slot = self._slot or _start(self.plan, self._patience)
            slot = self._slot
            if slot.ready or isinstance(self._heard(slot), _Ready):
                slot.ready = True
                return slot
        raise RuntimeError(f"worker processes do not start; see {self.plan.log}")

    def _heard(self, slot: _Slot) -> Any:  # noqa: ANN401  (jobs are the caller's)
        events: list[tuple[_Slot, Any]] = []
        while not events:
            events = _poll([slot], self.plan.timeout)
        ((_, message),) = events
        if isinstance(message, WorkerLost):
            self._slot = None
        return message


class _Ready:
    """Message of a worker that has loaded everything."""


class _Enough:
    """Message to a worker that there are no more jobs."""


def _give(slot: _Slot, job: Any) -> None:  # noqa: ANN401  (jobs are the caller's)
    slot.job, slot.started = job, time.monotonic()
    _tell(slot, job)


def _tell(slot: _Slot, message: Any) -> None:  # noqa: ANN401  (jobs are the caller's)
    # A worker that died idle is noticed when it is polled.
    with contextlib.suppress(BrokenPipeError, ConnectionResetError):
        slot.connection.send(message)


def _poll(slots: list[_Slot], timeout: float) -> list[tuple[_Slot, Any]]:
    """Wait for messages, deaths, or the next deadline."""
    nearest = min(slot.deadline(timeout) for slot in slots)
    patience = None if math.isinf(nearest) else max(0.0, nearest - time.monotonic())
    heard = set(wait([slot.connection for slot in slots], patience))
    events: list[tuple[_Slot, Any]] = []
    for slot in slots:
        if slot.connection in heard:
            try:
                events.append((slot, slot.connection.recv()))
            except (EOFError, OSError):
                events.append((slot, _lose(slot, timed_out=False)))
        elif time.monotonic() >= slot.deadline(timeout):
            events.append((slot, _lose(slot, timed_out=True)))
    return events


def _lose(slot: _Slot, *, timed_out: bool) -> WorkerLost:
    if not timed_out:
        # The pipe breaks a moment before the process ends; its exit code tells more than ours.
        wait([slot.process.sentinel], _GRACE)
    _kill(slot)
    return WorkerLost(
        timed_out=timed_out,
        exit_code=slot.process.exitcode,
        seconds=time.monotonic() - slot.started,
    )


def _start(plan: WorkerPlan, patience: float | None = None) -> _Slot:
    context = _context()
    if plan.warm_up is not None and context.get_start_method() == "fork":
        # Once for all workers. What is wrong with it shows again in them, and in the log.
        with contextlib.suppress(Exception):
            plan.warm_up()
    ours, theirs = context.Pipe()
    # Not daemonic: stages may start helper processes of their own.
    process = context.Process(
        target=_serve, args=(theirs, plan, os.getpid(), patience), daemon=False
    )
    with _inherited(plan):
        process.start()
    theirs.close()
    return _Slot(process=process, connection=ours)


def _context() -> Any:  # noqa: ANN401  (the contexts have no common type that can start processes)
    """Fork, so that nothing is loaded twice, unless threads or the system make that unsafe."""
    with contextlib.suppress(OSError):
        if len(os.listdir("/proc/self/task")) == 1:  # noqa: PTH208  (a count, not paths)
            return multiprocessing.get_context("fork")
    return multiprocessing.get_context("spawn")


@contextlib.contextmanager
def _inherited(plan: WorkerPlan) -> Iterator[None]:
    """Set what a new process takes over: one thread each, and no reaction to Ctrl-C.

    The terminal sends Ctrl-C to every process; it is this one that stops the workers.
    """
    wanted = dict.fromkeys(THREAD_VARIABLES, "1") | dict(plan.environment)
    before = {name: os.environ.get(name) for name in wanted}
    in_main = threading.current_thread() is threading.main_thread()
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN) if in_main else None
    os.environ.update(wanted)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        if handler is not None:  # none where it was not Python that set it
            signal.signal(signal.SIGINT, handler)


def _kill(slot: _Slot) -> None:
    """End a worker and the helpers it started, which share its process group.

    The worker must not have been waited for before: until then its number cannot be another's.
    """
    _kill_group(slot)
    slot.process.kill()
    slot.process.join()
    slot.connection.close()


def _kill_group(slot: _Slot) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError, TypeError):
        os.killpg(slot.process.pid, signal.SIGKILL)  # type: ignore[arg-type]  # None: TypeError


def _stop(slots: list[_Slot]) -> None:
    """Let idle workers end by themselves, so that they tidy up; then kill all that is left."""
    idle = [slot for slot in slots if slot.ready and slot.job is None]
    for slot in idle:
        _tell(slot, _Enough())
    for slot in idle:
        wait([slot.process.sentinel], _GRACE)
    for slot in slots:
        _kill(slot)
    slots.clear()


def _serve(connection: Connection, plan: WorkerPlan, parent: int, patience: float | None) -> None:
    """Run in the worker: answer jobs until there are no more, or none comes for too long."""
    _separate(parent)
    _redirect(plan.log)
    from threadpoolctl import threadpool_limits  # noqa: PLC0415  (loads libraries)

    if plan.warm_up is not None:
        plan.warm_up()
    with threadpool_limits(1):
        connection.send(_Ready())
        while connection.poll(patience):
            try:
                job = connection.recv()
            except EOFError:
                return
            if isinstance(job, _Enough):
                return
            connection.send(plan.work(job))


def _separate(parent: int) -> None:
    """Make a process group of its own, and die with the parent even if that is killed."""
    with contextlib.suppress(OSError):
        os.setsid()
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            Path("/proc/self/oom_score_adj").write_text(_FIRST_TO_GO)
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
    sys.stdout = sys.stderr = os.fdopen(2, "w", buffering=1, closefd=False)
    faulthandler.enable()
