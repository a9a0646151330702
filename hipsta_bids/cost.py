"""What one hemisphere costs: time per stage, processor time, memory."""

import contextlib
import os
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
        self._cpu = _cpu_seconds()
        _reset_peak_memory()

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
            "cpu_seconds": _cpu_seconds() - self._cpu,
            "peak_memory_mb": _peak_memory() / _MEGABYTE,
        }


def _cpu_seconds() -> float:
    """Processor time of this process and its helpers, running or ended, in s."""
    own = os.times()
    total = own.user + own.system + own.children_user + own.children_system
    tick = os.sysconf("SC_CLK_TCK")
    for child in _children():
        # Fields 14 and 15 of proc(5) stat; counted after the name, which may contain blanks.
        with contextlib.suppress(OSError, IndexError):
            stat = Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()
            total += (int(stat[11]) + int(stat[12])) / tick
    return total


def _children() -> list[str]:
    """List the process numbers of running children, where the system tells."""
    with contextlib.suppress(OSError):
        lists = [path.read_text() for path in Path("/proc/self/task").glob("*/children")]
        return " ".join(lists).split()
    return []


def _reset_peak_memory() -> None:
    """Forget the peak of the earlier hemispheres of this process, where Linux allows it."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _peak_memory() -> float:
    """Largest resident memory of this process since the last reset, in bytes."""
    with contextlib.suppress(OSError, StopIteration, ValueError):
        lines = Path("/proc/self/status").read_text().splitlines()
        return 1024.0 * int(next(line for line in lines if line.startswith("VmHWM")).split()[1])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return float(peak if sys.platform == "darwin" else 1024 * peak)  # getrusage(2): bytes, or KiB
