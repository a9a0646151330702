"""What one hemisphere costs: time per stage, processor time, memory."""

import contextlib
import resource
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_MEGABYTE = 1e6


class CostClock:
    """Times stages, and measures what they cost in this process since the clock was made."""

    def __init__(self) -> None:
        self._stages: dict[str, float] = {}
        self._start = time.perf_counter()
        self._cpu = cpu_seconds()
        reset_peak_memory()

    @contextlib.contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Time a stage; several times with the same name add up."""
        start = time.perf_counter()
        try:
            yield
        finally:
            spent = time.perf_counter() - start
            self._stages[stage] = self._stages.get(stage, 0.0) + spent

    def spent(self) -> dict[str, Any]:
        """Give what was spent so far: seconds per stage and in all, and peak memory in MB."""
        return {
            "stages": dict(self._stages),
            "seconds": time.perf_counter() - self._start,
            "cpu_seconds": cpu_seconds() - self._cpu,
            "peak_memory_mb": peak_memory() / _MEGABYTE,
        }


def cpu_seconds() -> float:
    """Processor time of this process and its helpers, running or ended, in s."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    return (
        time.process_time() + ended.ru_utime + ended.ru_stime + sum(map(_cpu_of_helper, helpers()))
    )


def helpers() -> list[str]:
    """List the process numbers of running children, where the system tells."""
    with contextlib.suppress(OSError):
        lists = [path.read_text() for path in Path("/proc/self/task").glob("*/children")]
        return " ".join(lists).split()
    return []


def reset_peak_memory(process: str = "self") -> None:
    """Forget how much memory a process needed so far, where Linux allows it."""
    with contextlib.suppress(OSError):
        Path(f"/proc/{process}/clear_refs").write_text("5")


def peak_memory(process: str = "self") -> float:
    """Largest resident memory of a process since the last reset, in bytes.

    Where there is no ``/proc``: of this process since it began, whichever was asked for.
    """
    with contextlib.suppress(OSError, StopIteration, ValueError):
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
        return 1024.0 * int(next(line for line in lines if line.startswith("VmHWM")).split()[1])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return float(peak if sys.platform == "darwin" else 1024 * peak)  # getrusage(2): bytes, or KiB


def _cpu_of_helper(process: str) -> float:
    """Processor time of a running process in s, 0 if it is gone."""
    # Its main thread's alone, but in ns; TetGen has no other.
    with contextlib.suppress(OSError, ValueError, IndexError):
        return int(Path(f"/proc/{process}/schedstat").read_text().split()[0]) * 1e-9
    return 0.0
