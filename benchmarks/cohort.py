"""How many hemispheres an hour ``hipsta-bids`` measures with one and with more processes.

Runs the command on a BIDS dataset, or on a cohort of phantoms if none is given::

    .venv/bin/python benchmarks/cohort.py [BIDS_DIR] [--n-procs 1 2] [--json FILE]

``--tables DIR`` writes the CPU time of the whole command there, with and without pages, in the
form of a validation suite.

Wall time, so nothing else should run on the machine. The time that the command takes to find out
that all is done is taken off: it is start-up of the command itself, and the same for any number of
processes. Start-up of the workers is part of it.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import pandas as pd
from report import describe_machine, print_table, write_report

from validation.report import Cells, Suite, Table, describe, write

COMMAND = (sys.executable, "-m", "hipsta_bids.cli.main")


@dataclass(frozen=True, kw_only=True)
class Run:
    """One run of the participant level."""

    hemispheres: int
    """That were measured, not failed."""
    wall: float
    """s, without what a run takes that has nothing to do."""
    idle: float
    """The latter, s."""
    cpu_per_hemisphere: float
    """Median, s, TetGen's included."""
    cpu: float
    """Of the whole command, s, with all its processes."""
    wall_per_hemisphere: float
    """Median, s."""
    memory: float
    """Peak of the largest worker, MB."""

    @property
    def per_hour(self) -> float:
        """Hemispheres per hour."""
        return self.hemispheres * 3600 / self.wall


def run(data: Path, n_procs: int, *options: str) -> Run:
    """Measure a dataset into a new folder, twice: the second run finds all done."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        command = [*COMMAND, str(data), str(out), "participant", "--n-procs", str(n_procs)]
        command += options
        seconds, used = [], [_children()]
        for _ in range(2):
            start = time.perf_counter()
            # Failed hemispheres show in the exit code and in the table.
            subprocess.run(command, check=False, stdout=subprocess.DEVNULL)  # noqa: S603
            seconds.append(time.perf_counter() - start)
            used.append(_children())
        status = pd.read_csv(out / "status.tsv", sep="\t", na_values="n/a")
    measured = status[status["decision"] != "failed"]
    return Run(
        hemispheres=len(measured),
        wall=seconds[0] - seconds[1],
        idle=seconds[1],
        cpu=used[1] - used[0],
        cpu_per_hemisphere=float(measured["cpu_seconds"].median()),
        wall_per_hemisphere=float(measured["seconds"].median()),
        memory=float(measured["peak_memory_mb"].max()),
    )


def _children() -> float:
    """Return the CPU time of all processes that were started and have ended, s."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def write_tables(data: Path, out: Path) -> None:
    """Write what the whole command costs on a dataset, with and without pages."""
    rows: list[Cells] = []
    for pages, options in (("with pages", ()), ("without pages", ("--no-reports",))):
        found = run(data, 1, *options)
        rows.append(
            {
                "command": pages,
                "hemispheres": found.hemispheres,
                "CPU s": f"{found.cpu:.1f}",
                "CPU s per hemisphere": f"{found.cpu / found.hemispheres:.2f}",
                "CPU s of measuring, median": f"{found.cpu_per_hemisphere:.2f}",
                "peak memory, MB": f"{found.memory:.0f}",
            }
        )
    notes = (
        f"One process on {describe_machine()['processor']}; CPU time of all its children counts."
    )
    name = "Cost of the participant level"
    table = Table(name="command", title=f"{name}, whole command", rows=rows, notes=notes)
    text = "The command is run on a dataset of real labels, from start to report.html."
    suite = Suite(name="cost", title=name, text=text, tables=(table,))
    write(suite, out, describe("cost", "benchmarks/cohort.py BIDS_DIR --tables DIR"))


def main(arguments: Sequence[str] | None = None) -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("bids_dir", type=Path, nargs="?", help="default: phantoms")
    parser.add_argument("--n-procs", type=int, nargs="+", default=(1, 2), metavar="N")
    parser.add_argument("--n-subjects", type=int, default=6, metavar="N", help="of phantoms")
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--tables", type=Path, metavar="DIR", help="only this")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        data = options.bids_dir
        if data is None:
            data = Path(folder) / "phantoms"
            make = [*COMMAND, "phantom", str(data), "--n-subjects", str(options.n_subjects)]
            subprocess.run(make, check=True, stdout=subprocess.DEVNULL)  # noqa: S603
        if options.tables:
            write_tables(data, options.tables)
            return
        runs = {n: run(data, n) for n in options.n_procs}
    print(f"{os.cpu_count()} processors")
    first = runs[options.n_procs[0]].per_hour
    header = ["processes", "measured", "wall s", "per hour", "times", "CPU s", "s", "memory MB"]
    print_table(
        header,
        {
            str(n): [
                found.hemispheres,
                found.wall,
                found.per_hour,
                found.per_hour / first,
                found.cpu_per_hemisphere,
                found.wall_per_hemisphere,
                found.memory,
            ]
            for n, found in runs.items()
        },
    )
    if options.json:
        write_report(options.json, {"runs": {n: asdict(found) for n, found in runs.items()}})


if __name__ == "__main__":
    main()
