"""What a hemisphere costs, stage by stage, at several spacings and with LaPy's own solver.

Measures every hemisphere that ``hipsta-bids`` finds in a BIDS dataset, or four phantoms if none is
given, in this process and TetGen's, with one thread each as in a worker::

    .venv/bin/python benchmarks/hemispheres.py [BIDS_DIR] [--json FILE]

Processor time, so that other work on the machine matters little; of repeated measurements the
quickest counts, stage by stage. Start-up and reading are told apart.
"""

import argparse
import contextlib
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from report import print_table, write_report
from threadpoolctl import threadpool_limits

from hipsta_bids.errors import GeometryError
from hipsta_bids.inputs.scan import HemisphereInput, InputRequest
from hipsta_bids.inputs.search import find_hemispheres
from hipsta_bids.participant.job import (
    cpu_seconds,
    helpers,
    peak_memory,
    reset_peak_memory,
    warm_up,
)
from hipsta_bids.phantom import write_demo_dataset
from hipsta_bids.settings import BoundarySettings, GridSettings, Settings
from hipsta_bids.types import LabelVolume

#: mm; the middle one is the default.
SPACINGS = (0.5, 0.35, 0.25)


class CpuClock:
    """Adds up processor time per stage, TetGen's included."""

    def __init__(self) -> None:
        self.stages: dict[str, float] = {}

    @contextlib.contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Time a stage."""
        start = cpu_seconds()
        try:
            yield
        finally:
            self.stages[stage] = self.stages.get(stage, 0.0) + cpu_seconds() - start


@dataclass(frozen=True, kw_only=True)
class Cost:
    """Of one hemisphere at one spacing."""

    stages: dict[str, float]
    """CPU s."""
    wall: float
    """s."""
    memory: float
    """Peak of this process, MB."""
    helper_memory: float
    """Peak of TetGen's process, MB."""
    tetrahedra: int

    @property
    def cpu(self) -> float:
        """CPU s in all."""
        return sum(self.stages.values())


def measure(volume: LabelVolume, hemi: str, settings: Settings, repeats: int) -> Cost | None:
    """Measure one hemisphere several times; ``None`` if it is refused."""
    from hipsta_bids.participant.measure import measure_hemisphere  # noqa: PLC0415  (part of start-up)

    costs = []
    for _ in range(repeats):
        for process in ("self", *(str(helper.pid) for helper in helpers())):
            reset_peak_memory(process)
        clock, start = CpuClock(), time.perf_counter()
        try:
            maps = measure_hemisphere(volume, hemi, settings, clock)
        except GeometryError:
            return None
        costs.append(
            Cost(
                stages=clock.stages,
                wall=time.perf_counter() - start,
                memory=peak_memory() / 1e6,
                helper_memory=sum(peak_memory(str(helper.pid)) for helper in helpers()) / 1e6,
                tetrahedra=int(maps.qc["tetrahedra"]),
            )
        )
    quickest = min(costs, key=lambda cost: cost.cpu)
    return replace(
        quickest,
        stages={stage: min(c.stages[stage] for c in costs) for stage in quickest.stages},
        memory=max(cost.memory for cost in costs),
        helper_memory=max(cost.helper_memory for cost in costs),
    )


def benchmark(items: Sequence[HemisphereInput], spacings: Sequence[float], repeats: int) -> Any:  # noqa: ANN401  (JSON)
    """Measure all hemispheres at all spacings and print tables."""
    from hipsta_bids.inputs.labels import read_label_volume  # noqa: PLC0415  (part of start-up)

    measure(read_label_volume(items[0]), items[0].hemi, Settings(), 1)  # starts TetGen's process
    reading: list[float] = []
    variants = {
        f"spacing {spacing:g} mm": Settings(grid=GridSettings(spacing=spacing))
        for spacing in spacings
    }
    variants["LaPy's solver"] = Settings(boundaries=BoundarySettings(solver="lapy"))
    costs: dict[str, dict[str, Cost | None]] = {title: {} for title in variants}
    for item in items:
        start = cpu_seconds()
        volume = read_label_volume(item)
        reading.append(cpu_seconds() - start)
        for title, settings in variants.items():
            costs[title][name(item)] = measure(volume, item.hemi, settings, repeats)
    print(f"\nreading: median {np.median(reading):.3f} CPU s")
    return {
        "reading": float(np.median(reading)),
        "variants": {title: report(title, found) for title, found in costs.items()},
    }


def name(item: HemisphereInput) -> str:
    """Name a hemisphere as its outputs are named."""
    return f"sub-{item.subject} {item.hemi} {item.protocol.name}"


def report(title: str, costs: dict[str, Cost | None]) -> Any:  # noqa: ANN401  (JSON)
    """Print a row per hemisphere and the medians; return them for JSON."""
    measured = {item: cost for item, cost in costs.items() if cost is not None}
    print(f"\n{title}: CPU s per stage and in all, wall s, peak memory MB")
    if not measured:
        print("every hemisphere was refused")
        return {}
    stages = list(next(iter(measured.values())).stages)
    header = ["", *stages, "all", "wall", "memory", "TetGen's", "tetrahedra"]
    rows = {
        item: [
            *(cost.stages[stage] for stage in stages),
            cost.cpu,
            cost.wall,
            cost.memory,
            cost.helper_memory,
            cost.tetrahedra,
        ]
        for item, cost in measured.items()
    }
    rows["median"] = np.median(list(rows.values()), axis=0).tolist()
    print_table(header, rows)
    refused = [item for item, cost in costs.items() if cost is None]
    if refused:
        print("refused:", ", ".join(refused))
    return {item: dict(zip(header[1:], row, strict=True)) for item, row in rows.items()}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("bids_dir", type=Path, nargs="?", help="default: four phantoms")
    parser.add_argument("--spacings", type=float, nargs="+", default=SPACINGS, metavar="MM")
    parser.add_argument("--repeats", type=int, default=3, metavar="N")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args(arguments)
    warm_up()
    print(f"start-up: {cpu_seconds():.2f} CPU s, {peak_memory() / 1e6:.0f} MB")
    with tempfile.TemporaryDirectory() as folder:
        if options.bids_dir is None:
            write_demo_dataset(Path(folder))
        items = find_hemispheres(InputRequest(bids_dir=options.bids_dir or Path(folder)))
        usable = [item for item in items if item.problem is None]
        if not usable:
            sys.exit("no usable hemisphere")
        with threadpool_limits(1):
            found = benchmark(usable, options.spacings, options.repeats)
    if options.json:
        write_report(options.json, found)


if __name__ == "__main__":
    main()
