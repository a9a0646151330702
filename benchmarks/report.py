"""Tables on the terminal, and the same with the machine and versions as JSON."""

import json
import os
import platform
import sys
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

# A benchmark runs as a file, which leaves the checkout and its validation off the path.
if find_spec("validation") is None:
    sys.path.append(str(Path(__file__).resolve().parents[1]))

_LIBRARIES = ("hipsta_bids", "numpy", "scipy", "scikit-image", "tetgen")


def print_table(header: Sequence[str], rows: Mapping[str, Sequence[float]]) -> None:
    """Print numbers in columns: three digits at least, times to the millisecond."""
    first = max(map(len, (header[0], *rows)))
    widths = [max(len(title), 8) for title in header[1:]]
    print(header[0].ljust(first), *(t.rjust(w) for t, w in zip(header[1:], widths, strict=True)))
    for title, values in rows.items():
        cells = (_spell(value).rjust(w) for value, w in zip(values, widths, strict=True))
        print(title.ljust(first), *cells)


def describe_machine() -> dict[str, Any]:
    """Return what results depend on: machine and versions."""
    return {
        "machine": platform.machine(),
        "system": platform.platform(),
        "processor": _processor(),
        "processors": os.cpu_count(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in _LIBRARIES},
    }


def write_report(path: Path, found: Mapping[str, Any]) -> None:
    """Write results as JSON, with what they depend on."""
    content = describe_machine() | dict(found)
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _spell(value: float) -> str:
    few = 100  # larger numbers need no decimals
    return f"{value:.0f}" if value >= few or value == int(value) else f"{value:.3f}"


def _processor() -> str:
    """Name the processor, where the system tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(": ")[2] for line in lines if line.startswith("model name")), "")
