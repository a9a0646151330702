"""Reads the participant level's tables of many hemispheres into arrays, for chosen measures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids.derivatives.names import NAMED_TABLES
from hipsta_bids.derivatives.results import read_alike, read_sheet, read_summary, read_units
from hipsta_bids.errors import InputError, did_you_mean
from hipsta_bids.geometry.catalog import MAPS, why_impossible
from hipsta_bids.geometry.sheet import sheet_levels
from hipsta_bids.group.cohort.collect import Exclusion, SheetRecord
from hipsta_bids.group.cohort.data import Cohort, Grid, Measures
from hipsta_bids.protocols import EXPERIMENTAL
from hipsta_bids.settings import SheetSettings
from hipsta_bids.stats.arrays import MOST_KEPT, Float, SideMaps, blocks
from hipsta_bids.stats.formula import listed
from hipsta_bids.types import PARTICIPANT, REGION, SESSION, VisitKey

#: Map that registration rests on.
CURVATURE = "curvature"
#: Maps that are analyzed unless other maps are asked for.
THICKNESS = "thickness"
DEFAULT = (THICKNESS, CURVATURE)
#: Names of all maps in the sheet tables.
SHEET_MAPS = tuple(row.name for row in MAPS)
#: Prefix of the names of volumes from other programs.
VOLUME = "volume_"
#: Unit of sampled maps whose own unit is not known.
ARBITRARY = "arbitrary"
#: Share of the sheets that need a value at a point, where sheets have rims without values.
LEAST_SHARE = 0.5
#: Number of measures that a message lists.
_MOST_NAMES = 12
_ROWS = 1000  # of summaries that are words at once
_TABLES = 8  # of sheets that are read at once


def choose_measures(
    requested: Sequence[str], records: Sequence[SheetRecord], further: Sequence[str] = ()
) -> Measures:
    """Separate maps from summary measures."""
    if not requested:
        return Measures(maps=(*(DEFAULT if records else ()), *further))
    summaries = tuple(read_summary(records[0].result)) if records else ()
    maps, numbers = [], []
    for name in requested:
        if (
            name in further
            or (records and name in SHEET_MAPS)
            or any(_sampled_table(record, name) for record in records)
        ):
            maps.append(name)
        elif name in summaries or name.startswith(VOLUME):
            numbers.append(name)
        else:
            raise _no_measure(name, records, (*further, *_sampled(records), *summaries))
    return Measures(maps=tuple(maps), summaries=tuple(numbers) or None)


def _no_measure(name: str, records: Sequence[SheetRecord], further: Sequence[str]) -> InputError:
    """Return the error of a name that is neither a map nor a summary measure."""
    # Maps and summary measures share some names.
    names = list(dict.fromkeys([*(SHEET_MAPS if records else ()), *further]))
    hint = f"there are {listed(names, _MOST_NAMES)}"
    if records and len(names) > _MOST_NAMES:
        hint += f"; {records[0].result.path('summary')} has all summary measures"
    return _unknown(name, names, hint)


def check_summaries(measures: Measures, sides: Mapping[str, SideMaps]) -> Measures:
    """Refuse summary measures that no hemisphere has, and add means over regions."""
    available = sorted({str(name) for side in sides.values() for name in side.summary.columns})
    for name in measures.summaries or ():
        if name not in available:
            raise _unknown(name, available, "are its tables there?")
    if measures.summaries is None:
        return measures
    regions = [name for name in available if REGION in name]
    return replace(measures, summaries=tuple(dict.fromkeys((*measures.summaries, *regions))))


def _unknown(name: str, available: Sequence[str], hint: str) -> InputError:
    near = did_you_mean([name], available) or f"; {hint}"
    return InputError(f"no measure is called {name!r}{near}")


def _sampled(records: Sequence[SheetRecord]) -> list[str]:
    """Names of the sampled maps of the first hemisphere."""
    if not records:
        return []
    names = set()
    for key in NAMED_TABLES:
        pattern = records[0].result.path(key, "*")
        start, _, end = pattern.name.partition("*")
        paths = pattern.parent.glob(pattern.name)
        names |= {path.name.removeprefix(start).removesuffix(end) for path in paths}
    return sorted(names)


@dataclass(frozen=True, eq=False, kw_only=True)
class Measured(Cohort):
    """Sheets and summaries, before covariates are known."""

    sources: Mapping[str, tuple[str, Path]]
    """Address of one segmentation, and the dataset whose record has it, of visits with sheets."""
    damaged: tuple[Exclusion, ...] = ()
    """Hemispheres left out because maps are empty, or maps or summaries impossible."""


def read_sheets(
    records: Sequence[SheetRecord],
    grid: Grid,
    maps: Sequence[str],
    visits: Sequence[VisitKey] | None = None,
    *,
    max_gap: float,
) -> Measured:
    """Read all sheets and summaries.

    Hemispheres with empty or impossible maps or summaries are excluded, as are maps without a value
    in more than ``max_gap`` of the curvature profile.
    """
    region = records[0].result.name.region if records else "body"
    x, y = node_coordinates(grid, region)
    shape = len(x), len(y)
    visits = visits_of(records) if visits is None else visits
    row_of = {visit: row for row, visit in enumerate(visits)}
    names = tuple(dict.fromkeys((*maps, CURVATURE)))
    sides, damaged = {}, list[Exclusion]()
    for hemi in "LR":
        records_of_side = [record for record in records if record.result.name.hemi == hemi]
        rows = [row_of[r.result.name.subject, r.result.name.session] for r in records_of_side]
        if records_of_side:
            side = _read_side(records_of_side, np.array(rows, dtype=np.int64), shape, names)
            sides[hemi], excluded = _usable(side, records_of_side, max_gap)
            damaged += excluded
            if region in EXPERIMENTAL:
                for values in sides[hemi].maps.values():
                    leave_rare(values)
    return Measured(
        table=table_of(visits),
        sides=sides,
        x=x,
        y=y,
        shared=grid.frame != "visit",
        units=(read_units(records[0].result) if records else {})
        | {n: ARBITRARY for n in names if n not in SHEET_MAPS},
        sources={
            visit_name(r.result.name.subject, r.result.name.session): (r.source, r.result.root)
            for r in reversed(records)
        },
        damaged=tuple(damaged),
    )


def _usable(
    side: SideMaps, records: Sequence[SheetRecord], max_gap: float
) -> tuple[SideMaps, list[Exclusion]]:
    """Return the sheets of a side that can be used, and the exclusions of the others."""
    columns = {str(name): one.to_numpy() for name, one in side.summary.items()}
    doubtful = {name: one for name, one in columns.items() if why_impossible(name, one)}
    problems = [_damage(side, i, doubtful, max_gap) for i in range(len(records))]
    impossible = [
        Exclusion.of_sheet(record.result.name, "damaged-map", text)
        for record, text in zip(records, problems, strict=True)
        if text
    ]
    if len(impossible) == len(records):
        raise InputError(
            f"hemisphere {records[0].result.name.hemi}: no sheet can be used;"
            f" {impossible[0].participant}: {impossible[0].message}"
        )
    return side.sheets(np.array([not text for text in problems])), impossible


def leave_rare(values: Float) -> None:
    """Take points that few sheets have out of a map (sheets, x, y): beside rims, a selection."""
    finite = np.isfinite(values)
    measured = finite.any(axis=(1, 2))  # other volumes may lack in a participant
    values[:, finite[measured].sum(axis=0) < LEAST_SHARE * measured.sum()] = np.nan


def _damage(side: SideMaps, i: int, doubtful: Mapping[str, Float], max_gap: float) -> str | None:
    """Say why a hemisphere cannot be used, if it cannot, by maps and ``doubtful`` summaries."""
    curvature = side.maps[CURVATURE][i]
    gap = float((~np.isfinite(curvature)).all(axis=1).mean())
    if gap > max_gap:
        return f"{gap:.0%} of the curvature profile has no value"
    if THICKNESS in side.maps and not np.isfinite(side.maps[THICKNESS][i]).any():
        return "no point of the thickness map has a value"
    values = [(name, one[i]) for name, one in side.maps.items()]
    values += [(name, column[i : i + 1]) for name, column in doubtful.items()]
    problems = (why_impossible(name, one) for name, one in values)
    return next((text for text in problems if text), None)


def visits_of(records: Sequence[SheetRecord]) -> list[VisitKey]:
    """List subjects and sessions that have sheets, each once."""
    return list(dict.fromkeys((r.result.name.subject, r.result.name.session) for r in records))


def table_of(visits: Sequence[VisitKey]) -> pd.DataFrame:
    """Return a row of participant and session per visit; the index names the visits."""
    return pd.DataFrame(
        {
            PARTICIPANT: [f"sub-{subject}" for subject, _ in visits],
            SESSION: pd.array([s and f"ses-{s}" for _, s in visits], dtype=object),
        },
        index=[visit_name(*visit) for visit in visits],
    )


def node_coordinates(grid: SheetSettings, region: str) -> tuple[Float, Float]:
    """Coordinates of the nodes along x and y, without rounding errors that tables would show."""
    x, y, _ = sheet_levels(grid, region)
    return x.round(10) + 0.0, y.round(10) + 0.0


def visit_name(subject: str, session: str | None) -> str:
    """Name a visit as the covariates' rows; labels have no prefixes."""
    return f"sub-{subject}_ses-{session}" if session else f"sub-{subject}"


def _read_side(
    records: Sequence[SheetRecord],
    rows: np.ndarray[Any, Any],
    shape: tuple[int, int],
    names: Sequence[str],
) -> SideMaps:
    precision = np.float64 if len(records) <= MOST_KEPT else np.float32
    maps = {name: np.full((len(records), *shape), np.nan, precision) for name in names}
    measured = [name for name in names if name in SHEET_MAPS]
    sampled = [name for name in names if name not in SHEET_MAPS]
    subfield = np.empty((len(records), *shape), dtype=np.int8)
    codes: dict[str, int] = {}
    for part in blocks(len(records), _TABLES):
        paths = [record.result.path("sheet") for record in records[part]]
        columns = read_alike(paths, measured, ["subfield"], shape)
        for name in measured:
            maps[name][part] = columns[name]
        subfield[part] = _encode(columns["subfield"], codes)
    for i, name in product(range(len(records)), sampled):
        if path := _sampled_table(records[i], name):
            maps[name][i] = read_sheet(path, [name], shape=shape)[name]
    summary = pd.concat(
        [
            pd.DataFrame(
                [read_summary(record.result) for record in records[part]],
                dtype=np.float64,
            )
            for part in blocks(len(records), _ROWS)
        ],
        ignore_index=True,
    )
    return SideMaps(rows=rows, maps=maps, subfield=subfield, names=tuple(codes), summary=summary)


def _sampled_table(record: SheetRecord, name: str) -> Path | None:
    """Find the table of the sampled map of a column: ``bold_3`` is the third of ``bold``."""
    paths = (record.result.path(key, name.partition("_")[0]) for key in NAMED_TABLES)
    return next((path for path in paths if path.is_file()), None)


def _encode(words: np.ndarray[Any, Any], codes: dict[str, int]) -> np.ndarray[Any, Any]:
    """Replace names by numbers, new names at the end; -1 where missing."""
    numbers, names = pd.factorize(words.ravel())
    known = np.array([codes.setdefault(name, len(codes)) if name else -1 for name in names])
    return np.asarray(known[numbers], dtype=np.int8).reshape(words.shape)
