"""Time and memory of the group level's analysis, by the number of participants.

Simulated sheets of both hemispheres (see ``hipsta_bids/group/simulation.py``) are registered, and
group + age + sex is fitted to thickness with the contrasts of three groups, with FDR2::

    .venv/bin/python benchmarks/group.py [--sizes 100 1500 5000] [--json FILE]

Each size has a process of its own, so that memory is its own. Reading and writing of files is not
part of it: ``hipsta-bids validate --group`` and the tests do that.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
from report import print_table, write_report

from hipsta_bids.group.analysis import analyze_cohort
from hipsta_bids.group.data import PARTICIPANT, SESSION, Cohort, Measures, SideMaps
from hipsta_bids.group.formula import model_from_shortcut, parse_model
from hipsta_bids.group.model import Groups
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.validation.group import SimulationPlan, simulate_cohort

GROUPS = ("CN", "MCI", "AD")
#: Drawn at once: a simulation needs several times the memory of its maps.
BLOCK = 500
MB = 1024.0


@dataclass(frozen=True, kw_only=True)
class Run:
    """One analysis."""

    participants: int
    wall: float
    """s"""
    cpu: float
    """s"""
    maps: float
    """What the sheets themselves take, MB."""
    memory: float
    """Peak of the process, MB, the maps and libraries included."""
    found: int
    """Points at which any contrast survives, of both hemispheres."""


def simulate(size: int) -> Cohort:
    """Draw a cohort of three groups with both hemispheres."""
    plan = SimulationPlan()
    groups = np.resize(GROUPS, size)
    table = pd.DataFrame(
        {PARTICIPANT: [f"sub-{i:06d}" for i in range(size)], SESSION: None, "group": groups}
    )
    sides = {}
    for seed, hemi in enumerate("LR"):
        maps = {name: np.empty((size, *plan.nodes)) for name in ("thickness", "curvature")}
        table["age"], table["sex"] = 0.0, "F"
        for start in range(0, size, BLOCK):
            rows = slice(start, min(start + BLOCK, size))
            count = rows.stop - rows.start
            sizes = (count // 2, count - count // 2)
            drawn = simulate_cohort(replace(plan, sizes=sizes), seed=1000 * seed + start)
            maps["thickness"][rows], maps["curvature"][rows] = drawn.thickness, drawn.curvature
            table.loc[table.index[rows], "age"] = drawn.age
            table.loc[table.index[rows], "sex"] = np.where(drawn.sex, "M", "F")
            table.loc[table.index[rows], "group"] = np.where(
                drawn.group, "AD", np.resize(GROUPS[:2], count)
            )
        sides[hemi] = SideMaps(
            rows=np.arange(size),
            maps=maps,
            subfield=np.zeros((size, *plan.nodes), dtype=np.int8),
            names=("CA1",),
            summary=pd.DataFrame(
                {name: maps["thickness"].mean(axis=(1, 2)) for name in ("volume", "thickness_mean")}
            ),
        )
    x, y = (np.linspace(-0.9, 0.9, n) for n in plan.nodes)
    units = {"thickness": "mm", "curvature": "mm^-1", "volume": "mm^3", "thickness_mean": "mm"}
    return Cohort(
        table=table.set_index(PARTICIPANT, drop=False), sides=sides, x=x, y=y, units=units
    )


def run(size: int) -> Run:
    """Simulate and analyze in this process."""
    cohort = simulate(size)
    contrasts = [f"group[{a}]-group[{b}]" for a, b in combinations(GROUPS, 2)]
    formula = "thickness ~ group + age + sex"
    model = parse_model(model_from_shortcut(formula, contrasts, "benchmark"))
    groups = Groups(column="group", levels=GROUPS)
    maps = sum(one.nbytes for side in cohort.sides.values() for one in side.maps.values())
    start = time.perf_counter(), time.process_time()
    result = analyze_cohort(
        cohort,
        model,
        groups,
        GroupSettings(),
        measures=Measures(maps=("thickness",), summaries=()),
        references={"group": "CN"},
    )
    return Run(
        participants=size,
        wall=time.perf_counter() - start[0],
        cpu=time.process_time() - start[1],
        maps=maps / MB**2,
        memory=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / MB,
        found=sum(int(one.rejected.sum()) for one in result.found.values()),
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=(100, 1500, 5000), metavar="N")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args(arguments)
    if options.one:
        print(json.dumps(asdict(run(options.one))))
        return
    runs = []
    for size in options.sizes:
        command = [sys.executable, __file__, "--one", str(size)]
        done = subprocess.run(command, check=True, capture_output=True, text=True)  # noqa: S603
        runs.append(Run(**json.loads(done.stdout)))
    header = ["participants", "wall s", "CPU s", "maps MB", "memory MB", "found"]
    rows = {
        str(one.participants): [one.wall, one.cpu, one.maps, one.memory, one.found] for one in runs
    }
    print_table(header, rows)
    if options.json:
        write_report(options.json, {"runs": [asdict(one) for one in runs]})


if __name__ == "__main__":
    main()
