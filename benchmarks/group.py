"""Time and memory of the group level's default run, by the number of participants and by stage.

Writes sheets, summaries and surfaces as the participant level leaves them: those of a phantom that
was measured, with simulated maps (``validation/group.py``) and scattered summary
measures, for three groups. Then runs the command::

    .venv/bin/python benchmarks/group.py [--sizes 40 1500 10000 50000] [--json FILE]

Each size has a process of its own, so that memory is its own. Beyond 1,000 participants files are
links to those of the first 1,000, since reading them costs the same; covariates are each one's own.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
from report import print_table, write_report

from hipsta_bids import progress
from hipsta_bids.cli import console
from hipsta_bids.cli.main import main as run_command
from hipsta_bids.derivatives.hemisphere import format_column
from hipsta_bids.derivatives.results import ResultPlace, list_results
from hipsta_bids.io import files
from validation.group import SimulatedCohort, SimulationPlan, simulate_cohort

COMMAND = (sys.executable, "-m", "hipsta_bids.cli.main")
GROUPS = ("CN", "MCI", "AD")
#: Participants with files of their own.
OWN = 1000
#: Spread of summary measures, as a share of the phantom's.
SPREAD = 0.1
#: What all participants have in common with the phantom.
SURFACES = ("interior_surface", "midthickness_surface", "exterior_surface")
SAME = (*SURFACES, "sheet_sidecar", "summary_sidecar", "qc")


@dataclass(frozen=True, kw_only=True)
class Run:
    """One run of the group level."""

    participants: int
    wall: float
    """s"""
    cpu: float
    """s, the system's included."""
    memory: float
    """Peak of the process, MB."""
    stages: dict[str, float]
    """Processor time by stage, s."""


def write_study(data: Path, out: Path, size: int, n_sessions: int = 1) -> None:
    """Write a dataset, and what the participant level leaves of it; sessions are a year apart."""
    for more in (["phantom", data, "--n-subjects", 1], [data, out, "participant", "--no-reports"]):
        command = [*COMMAND, *map(str, more)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)  # noqa: S603
    (out / "status.tsv").unlink()
    random = np.random.default_rng(0)
    names = [f"sub-{i:06d}" for i in range(size)]
    age, sex = random.uniform(55, 85, size), random.choice(["F", "M"], size)
    rows = zip(names, np.resize(GROUPS, size), [f"{years:.1f}" for years in age], sex, strict=True)
    files.write_tsv(data / "participants.tsv", ["participant_id", "group", "age", "sex"], rows)
    years = [(f"ses-{n}", f"{2010 + n}-01-01T00:00:00") for n in range(n_sessions)]
    for name in names if n_sessions > 1 else ():
        table = data / name / f"{name}_sessions.tsv"
        table.parent.mkdir(exist_ok=True)
        files.write_tsv(table, ["session_id", "acq_time"], years)
    sessions = [f"{n}" for n in range(n_sessions)] if n_sessions > 1 else [None]
    visits = [(name.removeprefix("sub-"), session) for name in names for session in sessions]
    for seed, place in enumerate(list_results(out)):
        plan = SimulationPlan(sizes=(min(len(visits), OWN), 0), effect=0)
        _write_side(place, simulate_cohort(plan, seed), visits, random)
        place.path("qc").unlink()


def _write_side(
    place: ResultPlace,
    cohort: SimulatedCohort,
    visits: Sequence[tuple[str, str | None]],
    random: np.random.Generator,
) -> None:
    """Write one hemisphere of all visits, from that of the phantom."""
    sheet, summary = (
        [line.split("\t") for line in place.path(key).read_text(encoding="utf-8").splitlines()]
        for key in ("sheet", "summary")
    )
    every = [
        replace(place, name=replace(place.name, subject=subject, session=session))
        for subject, session in visits
    ]
    for i, new in enumerate(every):
        new.path("qc").parent.mkdir(parents=True, exist_ok=True)
        for key in SAME if i < OWN else ("sheet", "summary", "qc"):
            os.link((place if i < OWN else every[i % OWN]).path(key), new.path(key))
        if i >= OWN:
            continue
        for name, maps, digits in (
            ("thickness", cohort.thickness, 4),
            ("curvature", cohort.curvature, 5),
        ):
            column = sheet[0].index(name)
            for row, value in zip(sheet[1:], format_column(maps[i], digits), strict=True):
                row[column] = value
        files.write_tsv(new.path("sheet"), sheet[0], sheet[1:])
        factors = 1 + SPREAD * random.standard_normal(len(summary[1]))
        values = [
            cell if cell == files.MISSING else f"{float(cell) * factor:.5g}"
            for cell, factor in zip(summary[1], factors, strict=True)
        ]
        files.write_tsv(new.path("summary"), summary[0], [values])


def run(data: Path, out: Path, size: int) -> Run:
    """Run the command in this process."""
    stages: dict[str, float] = {}
    now, since = "start", 0.0

    def note(stage: str, *_: object) -> None:
        nonlocal now, since
        used = time.process_time()
        stages[now] = stages.get(now, 0.0) + used - since
        now, since = stage, used

    start = time.perf_counter()
    with (
        Path(os.devnull).open("w", encoding="utf-8") as nothing,
        redirect_stdout(nothing),
        patch.object(console, "listening", lambda _: progress.listening(note)),
    ):
        code = run_command([str(data), str(out), "group"])
    if code:
        raise SystemExit(code)
    note("end", 0, 0)
    used = resource.getrusage(resource.RUSAGE_SELF)
    return Run(
        participants=size,
        wall=time.perf_counter() - start,
        cpu=used.ru_utime + used.ru_stime,
        memory=used.ru_maxrss * 1024 / 1e6,
        stages=stages,
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=(40, 1500, 10_000), metavar="N")
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args(arguments)
    if options.one:
        done = run(options.one / "bids", options.one / "out", options.sizes[0])
        print(json.dumps(asdict(done)))
        return
    runs = []
    for size in options.sizes:
        with tempfile.TemporaryDirectory() as folder:
            write_study(Path(folder) / "bids", Path(folder) / "out", size)
            command = [sys.executable, __file__, "--one", folder, "--sizes", str(size)]
            said = subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout  # noqa: S603
            runs.append(Run(**json.loads(said)))
    sizes = [str(one.participants) for one in runs]
    rows = {name: [getattr(one, name) for one in runs] for name in ("wall", "cpu", "memory")}
    rows |= {name: [one.stages.get(name, 0.0) for one in runs] for name in runs[0].stages}
    print_table(["s, MB", *sizes], rows)
    if options.json:
        write_report(options.json, {"runs": [asdict(one) for one in runs]})


if __name__ == "__main__":
    main()
