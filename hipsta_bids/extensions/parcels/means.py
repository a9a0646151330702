"""Means of maps over regions of each participant's sheet, before registration."""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids.errors import InputError, UsageError, did_you_mean
from hipsta_bids.extensions.parcels import EXTENSION, SUBFIELDS, THIRDS
from hipsta_bids.group.cohort.data import Cohort
from hipsta_bids.group.cohort.read import THICKNESS
from hipsta_bids.group.cohort.sources import Reading, Search, Source
from hipsta_bids.group.model import asymmetry_name
from hipsta_bids.group.output.results import Analysis
from hipsta_bids.group.output.tables import read_columns
from hipsta_bids.group.output.write import write_table
from hipsta_bids.group.questions.study import Study
from hipsta_bids.inputs.regions import read_regions
from hipsta_bids.joints import Writer
from hipsta_bids.stats.arrays import Bool, SideMaps
from hipsta_bids.stats.formula import left_side
from hipsta_bids.types import PARTICIPANT, REGION, SESSION, VisitKey

_ASYMMETRY = asymmetry_name("")
_ENDS = ("posterior", "middle", "anterior")


@dataclass(frozen=True, kw_only=True)
class Regions(Source):
    """Regions of the sheet, and maps whose means over these are summary measures."""

    choice: str
    """``subfields``, ``subfields-axis``, or a file of nodes."""
    maps: tuple[str, ...]
    """As asked for; without, thickness."""
    asymmetry: bool = False
    """Whether left minus right is a summary measure, too."""

    @property
    def record(self) -> Mapping[str, Any]:
        """Return the choice."""
        return {"regions": self.choice}

    def find(self, search: Search) -> tuple[Source, set[VisitKey]]:
        """Choose the maps."""
        maps = [name for name in self.maps or (THICKNESS,) if name in search.maps]
        return replace(self, maps=tuple(maps or sorted(search.maps))), set()

    def add(self, reading: Reading) -> Reading:
        """Add the means to the summary measures."""
        sides, units = reading.measured.sides, dict(reading.measured.units)
        tables = {}
        for hemi, side in sides.items():
            means = measure_regions(side, self.choice, self.maps)
            columns = {f"{name}{REGION}{region}": mean for name, region, mean, _ in means}
            tables[hemi] = pd.DataFrame(columns, index=side.rows)
        if not any(len(table.columns) for table in tables.values()):
            raise InputError(
                f"--regions {self.choice}: the sheets have no map or no subfield for it"
            )
        empty = pd.concat(tables).isna().all()
        if self.choice not in {SUBFIELDS, THIRDS} and empty.any():
            raise InputError(f"{self.choice}: {empty.idxmax()} has no value on any sheet")
        if self.asymmetry and len(tables) > 1:
            difference = tables["L"] - tables["R"]
            difference.columns = difference.columns.str.replace(REGION, _ASYMMETRY + REGION, n=1)
            tables = {hemi: table.join(difference) for hemi, table in tables.items()}
        for name in {str(name) for table in tables.values() for name in table}:
            units[name] = units.get(name.partition(REGION)[0].removesuffix(_ASYMMETRY), "1")
        sides = {hemi: side.with_summary(tables[hemi]) for hemi, side in sides.items()}
        return replace(reading, measured=replace(reading.measured, sides=sides, units=units))

    def sentences(self, maps: Sequence[str], surfaces: Sequence[str]) -> Iterator[str]:  # noqa: ARG002  (of all)
        """Describe the means."""
        kinds = {SUBFIELDS: "its subfields", THIRDS: "thirds of its subfields along the long axis"}
        yield (
            f"Means over {kinds.get(self.choice, 'drawn regions')} were taken on each sheet, before"
            " registration. The false discovery rate of their tests was controlled over regions and"
            " sides, for each map and contrast."
        )


def make_sources(parsed: argparse.Namespace) -> tuple[Source, ...]:
    """Return the regions that the option names."""
    if not parsed.regions:
        return ()
    maps = tuple(parsed.measures) or left_side(parsed.formula or "")
    return (Regions(choice=parsed.regions, maps=maps, asymmetry=parsed.asymmetry),)


def find_regions(side: SideMaps, choice: str) -> Iterator[tuple[str, Bool]]:
    """Find nodes of regions: of a participant's subfields (sheets, x, y), of a file (1, x, y).

    Thirds have rows of nodes in equal numbers, as far as possible.
    """
    if choice not in {SUBFIELDS, THIRDS}:
        if not Path(choice).exists() and (hint := did_you_mean([choice], (SUBFIELDS, THIRDS))):
            raise UsageError(f"--regions {choice}: file does not exist{hint}")
        regions = read_regions(Path(choice), side.shape)
        yield from zip(regions.names, regions.member[:, None], strict=True)
        return
    third = np.arange(side.shape[1]) * len(_ENDS) // side.shape[1]
    for number, subfield in enumerate(side.names):
        name, nodes = subfield.replace("/", "_"), side.subfield[:] == number
        ends = enumerate(_ENDS if choice == THIRDS else ())
        yield from ((f"{name}_{end}", nodes & (third == i)) for i, end in ends)
        if choice == SUBFIELDS:
            yield name, nodes


def measure_regions(
    side: SideMaps, choice: str, maps: Sequence[str]
) -> Iterator[tuple[str, str, Any, Any]]:
    """Return map, region, mean (sheets,) over nodes with a value, and the number of these nodes."""
    for region, nodes in find_regions(side, choice):
        for name in (name for name in maps if name in side.maps):
            values = side.maps[name]
            valid = nodes & np.isfinite(values)
            count = valid.sum(axis=(1, 2))
            total = values.sum(axis=(1, 2), dtype=np.float64, where=valid)
            yield name, region, np.divide(total, count, where=count > 0, out=total * np.nan), count


def prepare_tables(study: Study, analysis: Analysis) -> tuple[Writer, list[str]]:  # noqa: ARG001  (of all)
    """Make the tables of means and of nodes, where regions are asked for."""
    choices = [source.choice for source in study.options.sources if isinstance(source, Regions)]
    return partial(_write, cohort=study.cohort, choices=choices), []


def _write(folder: Path, *, cohort: Cohort, choices: Sequence[str]) -> None:
    for choice in choices:
        for name, make in (("regions", _mean_rows), ("region_nodes", _node_rows)):
            rows = [part for hemi in cohort.sides for part in make(cohort, hemi, choice)]
            table = pd.concat(rows, ignore_index=True)
            write_table(folder, name, table, meaning=read_columns(EXTENSION.package))


def _mean_rows(cohort: Cohort, hemi: str, choice: str) -> Iterator[pd.DataFrame]:
    """List means by region and visit; the names of summary measures have the maps."""
    side = cohort.sides[hemi]
    visits = cohort.table.iloc[side.rows][[PARTICIPANT, SESSION]].assign(hemi=hemi)
    names = [str(name).partition(REGION) for name in side.summary]
    maps = dict.fromkeys(name for name, is_region, _ in names if is_region)
    for name, region, mean, count in measure_regions(side, choice, list(maps)):
        yield visits.assign(region=region, measure=name, mean=mean, n_nodes=count)


def _node_rows(cohort: Cohort, hemi: str, choice: str) -> Iterator[pd.DataFrame]:
    """List nodes with the region that most sheets have there, the first of equals."""
    side = cohort.sides[hemi]
    counts = {name: nodes.sum(axis=0).ravel() for name, nodes in find_regions(side, choice)}
    table = pd.DataFrame({"": np.zeros(np.prod(side.shape), dtype=np.int64), **counts})
    x, y = np.indices(side.shape).reshape(2, -1) + 1
    yield pd.DataFrame({"hemi": hemi, "node_x": x, "node_y": y, "region": table.idxmax(axis=1)})
