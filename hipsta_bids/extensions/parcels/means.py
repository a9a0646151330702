"""Means of maps over regions of each participant's sheet, before registration."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids.errors import InputError, UsageError
from hipsta_bids.extensions.parcels import EXTENSION, SUBFIELDS, THIRDS
from hipsta_bids.group.cohort.data import Cohort
from hipsta_bids.group.cohort.read import THICKNESS
from hipsta_bids.group.cohort.sources import Reading, Search, Source
from hipsta_bids.group.output.results import Analysis
from hipsta_bids.group.output.tables import read_columns
from hipsta_bids.group.output.write import write_table
from hipsta_bids.group.questions.study import Study
from hipsta_bids.inputs.maps import read_regions
from hipsta_bids.joints import Writer
from hipsta_bids.stats.arrays import Bool, Float, Int, SideMaps
from hipsta_bids.types import PARTICIPANT, REGION, SESSION, VisitKey

_THIRDS = ("posterior", "middle", "anterior")


@dataclass(frozen=True, kw_only=True)
class Regions(Source):
    """Regions of the sheet, and the maps whose means are summary measures."""

    choice: str
    """``subfields``, ``subfields-axis``, or a table of nodes."""
    measures: tuple[str, ...]
    """Names that are asked for; of the default maps, thickness is taken."""

    @property
    def record(self) -> Mapping[str, Any]:
        """Return the choice."""
        return {"regions": self.choice}

    def find(self, search: Search) -> tuple[Source, set[VisitKey]]:
        """Choose the maps."""
        maps = [name for name in self.measures or (THICKNESS,) if name in search.maps]
        return replace(self, measures=tuple(maps or sorted(search.maps))), set()

    def add(self, reading: Reading) -> Reading:
        """Add means over regions to the summary measures."""
        measured = reading.measured
        means = {
            hemi: {
                f"{measure}{REGION}{region}": mean
                for measure, region, mean, _ in measure_regions(side, self.choice, self.measures)
            }
            for hemi, side in measured.sides.items()
        }
        names = list(dict.fromkeys(name for side in means.values() for name in side))
        if not names:
            raise UsageError(
                f"--regions {self.choice}: no map or subfield of the sheets; name a map by"
                " --measures, or a table with x, y, region"
            )
        _check_names(self.choice, names, means)
        sides = {
            hemi: side.with_summary(pd.DataFrame(means[hemi]))
            for hemi, side in measured.sides.items()
        }
        units = {name: measured.units.get(name.partition(REGION)[0], "1") for name in names}
        measured = replace(measured, sides=sides, units={**measured.units, **units})
        return replace(reading, measured=measured)

    def sentences(self, maps: Sequence[str], surfaces: Sequence[str]) -> Iterator[str]:  # noqa: ARG002  (of all)
        """Describe the means."""
        regions = {SUBFIELDS: "its subfields", THIRDS: "thirds of its subfields"}
        where = regions.get(self.choice, "regions drawn on the grid")
        yield f"Means over {where} were taken on each sheet, before registration."


def _check_names(
    choice: str, names: Sequence[str], means: Mapping[str, Mapping[str, Float]]
) -> None:
    """Refuse regions of a table without any value, and names that differ in case only."""
    lower = [name.casefold() for name in names]
    for name in names if choice not in {SUBFIELDS, THIRDS} else ():
        measure, _, region = name.partition(REGION)
        if lower.count(name.casefold()) > 1:
            raise InputError(f"{choice}: two regions are called {region}, but for case; rename one")
        if not any(np.isfinite(side[name]).any() for side in means.values() if name in side):
            raise InputError(f"{choice}: no sheet has {measure} in region {region}; draw it anew")


def find_regions(side: SideMaps, choice: str) -> Iterator[tuple[str, Bool]]:
    """Find the nodes of regions: of subfields (sheets, x, y), of a table (1, x, y).

    Thirds are rows of nodes from posterior to anterior, in equal numbers as far as possible.
    """
    if choice not in {SUBFIELDS, THIRDS}:
        regions = read_regions(Path(choice), side.shape)
        yield from zip(regions.names, regions.member[:, None], strict=True)
        return
    third = np.arange(side.shape[1]) * len(_THIRDS) // side.shape[1]
    for number, name in enumerate(side.names):
        nodes = side.subfield[:] == number
        if choice == SUBFIELDS:
            yield name, nodes
            continue
        for part, end in enumerate(_THIRDS):
            yield f"{name}_{end}", nodes & (third == part)


def measure_regions(
    side: SideMaps, choice: str, measures: Sequence[str]
) -> Iterator[tuple[str, str, Float, Int]]:
    """Return measure, region, means (sheets,) over nodes with a value, and the nodes' numbers."""
    for region, nodes in find_regions(side, choice):
        for measure in measures:
            if measure in side.maps:
                values = side.maps[measure]
                known = np.isfinite(values) & nodes
                count = known.sum(axis=(1, 2))
                total = values.sum(axis=(1, 2), dtype=np.float64, where=known)
                mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
                yield measure, region, mean, count


def prepare_tables(study: Study, analysis: Analysis) -> tuple[Writer, list[str]]:  # noqa: ARG001  (of all)
    """Make the tables of means and of nodes, where regions are asked for."""
    choices = [source.choice for source in study.options.sources if isinstance(source, Regions)]
    return partial(_write, cohort=study.cohort, choices=choices), []


def _write(folder: Path, *, cohort: Cohort, choices: Sequence[str]) -> None:
    for choice in choices:
        for name, rows in (("regions", _mean_rows), ("region_nodes", _node_rows)):
            parts = [rows(cohort, hemi, choice) for hemi in cohort.sides]
            table = pd.concat(parts, ignore_index=True)
            write_table(folder, name, table, meaning=read_columns(EXTENSION.package))


def _mean_rows(cohort: Cohort, hemi: str, choice: str) -> pd.DataFrame:
    """List means by region and visit; the columns of summary measures name their maps."""
    side = cohort.sides[hemi]
    visits = cohort.table.iloc[side.rows]
    names = [str(name).partition(REGION) for name in side.summary.columns]
    measures = list(dict.fromkeys(measure for measure, is_region, _ in names if is_region))
    parts = [
        pd.DataFrame(
            {
                PARTICIPANT: visits[PARTICIPANT].to_numpy(),
                SESSION: visits[SESSION].to_numpy(),
                "hemi": hemi,
                "region": region,
                "measure": measure,
                "unit": cohort.units.get(measure, "1"),
                "mean": mean,
                "n_nodes": count,
            }
        )
        for measure, region, mean, count in measure_regions(side, choice, measures)
    ]
    return pd.concat(parts, ignore_index=True)


def _node_rows(cohort: Cohort, hemi: str, choice: str) -> pd.DataFrame:
    """List the nodes with the region that most sheets have there; the first of equals."""
    side = cohort.sides[hemi]
    names, counts = [""], [np.zeros(side.shape, dtype=np.int64)]
    for name, nodes in find_regions(side, choice):
        names.append(name)
        counts.append(nodes.sum(axis=0))
    x, y = np.indices(side.shape)
    region = np.array(names, dtype=object)[np.argmax(counts, axis=0)]
    columns = {"node_x": x.ravel() + 1, "node_y": y.ravel() + 1, "region": region.ravel()}
    return pd.DataFrame({"hemi": hemi, **columns})
