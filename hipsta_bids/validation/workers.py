"""Cases of a suite on all processors, each in a worker that may die or hang without harm."""

import contextlib
import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hipsta_bids.errors import HipstaError
from hipsta_bids.pool import WorkerLost, WorkerPlan, run_jobs


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """In place of a case's result: the package refused it, or its worker was lost."""

    reason: str
    """Of the error in kebab case; ``timeout``, ``worker-died`` or ``crash`` (a bug)."""
    message: str

    def __str__(self) -> str:
        return f"{self.reason}: {self.message}"

    @property
    def is_bug(self) -> bool:
        """Whether this is anything but a foreseen error."""
        return self.reason in ("timeout", "worker-died", "crash")


def run_cases(
    work: Callable[[Any], Any], cases: Sequence[Any], *, timeout: float = 60.0
) -> list[Any]:
    """Work off cases in parallel, one processor each.

    Parameters
    ----------
    work : callable
        Importable function of one case; case and result have to be picklable.
    cases : sequence
        What to work off.
    timeout : float
        s per case.

    Returns
    -------
    list
        Results in the order of the cases, a :class:`Refusal` where there is none.
    """
    results: list[Any] = [None] * len(cases)
    with tempfile.TemporaryDirectory() as folder:
        plan = WorkerPlan(
            work=_work,
            n_workers=max(1, min(len(cases), processors())),
            timeout=timeout,
            log=Path(folder) / "workers.log",
        )
        jobs = [(number, work, case) for number, case in enumerate(cases)]
        # Closed here and now: what is left of the workers ends before their log goes.
        with contextlib.closing(run_jobs(plan, jobs)) as done:
            for job, result in done:
                results[job[0]] = _lost(result) if isinstance(result, WorkerLost) else result
    return results


def processors() -> int:
    """Count the processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _lost(lost: WorkerLost) -> Refusal:
    if lost.timed_out:
        return Refusal(reason="timeout", message=f"no result after {lost.seconds:.0f} s")
    return Refusal(reason="worker-died", message=f"the worker died ({lost.cause})")


def _work(job: tuple[int, Callable[[Any], Any], Any]) -> Any:  # noqa: ANN401  (any result)
    _, work, case = job
    try:
        return work(case)
    except HipstaError as error:
        return Refusal(reason=error.reason, message=str(error))
    except Exception as error:  # noqa: BLE001  (a bug becomes a row of the report)
        return Refusal(reason="crash", message=f"{type(error).__name__}: {error}")
