"""What the long checks share: runs of the command line, and comparisons of what they wrote."""

import csv
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

COMMAND = (sys.executable, "-m", "hipsta_bids.cli.main")

_START = time.monotonic()

#: Begins of the columns that tell what a run cost.
_COSTS = ("seconds", "cpu_seconds", "peak_memory")


def echo(text: str) -> None:
    """Print a line with the time since the start."""
    sys.stdout.write(f"[{time.monotonic() - _START:4.0f} s] {text}\n")
    sys.stdout.flush()


def demand(claim: bool, text: str) -> None:
    """Say that something holds, or end with exit code 1."""
    if not claim:
        sys.exit(f"FAILED: {text}")
    echo(f"ok: {text}")


def hipsta(
    *arguments: object, code: int | None = 0, environment: Mapping[str, str] | None = None
) -> str:
    """Run the command line and give what it prints.

    Parameters
    ----------
    *arguments
        Of the command.
    code : int, optional
        What it has to return; ``None`` for anything.
    environment : mapping, optional
        Further environment variables.
    """
    done = subprocess.run(  # noqa: S603  (ours)
        [*COMMAND, *map(str, arguments)],
        env=os.environ | dict(environment or {}),
        capture_output=True,
        text=True,
        check=False,
    )
    if code is not None and done.returncode != code:
        sys.exit(f"FAILED: {arguments} returned {done.returncode}:\n{done.stdout}{done.stderr}")
    return done.stdout + done.stderr


def phantoms(folder: Path, n_subjects: int) -> Path:
    """Write a synthetic dataset."""
    hipsta("phantom", folder, "--n-subjects", n_subjects)
    return folder


def break_one(data: Path) -> None:
    """Damage the first segmentation of a dataset, so that its hemisphere fails."""
    first = min(path for path in data.rglob("*hippoAmygLabels*") if path.is_file())
    first.write_bytes(first.read_bytes()[:1000])


def outputs(out: Path) -> dict[str, bytes]:
    """Read all files of an output dataset but logs, pages to look at, and what runs cost."""
    found = {
        str(path.relative_to(out)): path.read_bytes()
        for path in sorted(out.rglob("*"))
        if path.is_file()
        and path.suffix not in {".html", ".svg"}
        and path.relative_to(out).parts[0] not in {"logs", "group"}
    }
    found["status.tsv"] = repr(status(out)).encode()
    return found


def status(out: Path) -> list[dict[str, str]]:
    """Read ``status.tsv`` without what runs cost."""
    with (out / "status.tsv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    return [{k: v for k, v in row.items() if not k.startswith(_COSTS)} for row in rows]


def reasons(out: Path) -> list[str]:
    """List the reasons in ``status.tsv``."""
    return [row["reason"] for row in status(out)]


def demand_equal(out: Path, reference: dict[str, bytes], what: str) -> None:
    """Say that an output dataset is a reference byte for byte, or end."""
    found = outputs(out)
    differ = sorted(
        name for name in found.keys() | reference.keys() if found.get(name) != reference.get(name)
    )
    demand(not differ, f"{what}: {len(found)} files, byte for byte{listed(differ)}")


def listed(names: Sequence[str]) -> str:
    """List what is wrong, if anything is."""
    return f"; these differ: {', '.join(names[:5])}" if names else ""
