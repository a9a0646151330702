"""Grid points that count as missing: columns that a repair touched, or rows of a table."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from hipsta_bids.derivatives.results import read_sheet
from hipsta_bids.errors import InputError, UsageError
from hipsta_bids.group.cohort.collect import SheetRecord
from hipsta_bids.group.cohort.exclusions import UserTable
from hipsta_bids.group.cohort.read import Measured, visit_name
from hipsta_bids.io import files
from hipsta_bids.stats.arrays import Bool
from hipsta_bids.types import PARTICIPANT, VisitKey

#: Mask of the columns that a repair of the labels touched.
REPAIRED = "repaired"
_NODES = ("x", "y")


def mask_sheets(
    measured: Measured, records: Sequence[SheetRecord], masks: Sequence[str]
) -> tuple[Measured, pd.DataFrame, list[str]]:
    """Set masked points of all maps on the grid to missing.

    Returns the sheets, a table with the share of masked points of each sheet (columns ``visit``,
    ``side``, ``share``), and notes. InputError if a table cannot be read.
    """
    if not records:
        raise UsageError("--mask is about sheets of the participant level, and there are none")
    visits_of = [(r.result.name.subject, r.result.name.session) for r in records]
    tables = [_read(Path(mask), visits_of) for mask in masks if mask != REPAIRED]
    by_place = {
        (visit_name(r.result.name.subject, r.result.name.session), r.result.name.hemi): r
        for r in records
    }
    sides, shares = {}, []
    for hemi, side in measured.sides.items():
        is_masked = np.zeros((len(side.rows), *side.shape), dtype=bool)
        visits = measured.table.index[side.rows]
        for sheet, record in enumerate(by_place[visit, hemi] for visit in visits):
            _mask(is_masked[sheet], record, tables, repaired=REPAIRED in masks)
        maps = {name: np.where(is_masked, np.nan, values) for name, values in side.maps.items()}
        sides[hemi] = replace(side, maps=maps, unmasked=side.maps["curvature"])
        share = is_masked.mean(axis=(1, 2))
        shares.append(pd.DataFrame({"visit": visits, "side": hemi, "share": share}))
    names = [(record.result.name, None) for record in records]
    notes = [note for table in tables for note in table.notes(names)]
    return replace(measured, sides=sides), pd.concat(shares, ignore_index=True), notes


def _mask(
    is_masked: Bool, record: SheetRecord, tables: Sequence[UserTable], *, repaired: bool
) -> None:
    """Mark masked points of a sheet (x, y)."""
    shape = is_masked.shape[0], is_masked.shape[1]
    if repaired:
        columns = read_sheet(record.result.path("sheet"), [], [REPAIRED], shape)
        is_masked |= columns[REPAIRED] == "true"
    for table in tables:
        for row in table.about(record.result.name):
            is_masked[_node(row, shape, table.path)] = True


def mask_note(shares: pd.DataFrame, groups: pd.Series | None) -> str:
    """Report the mean share of masked points, by group if there are groups."""
    text = f"--mask: {shares['share'].mean():.1%} of points are missing"
    if groups is not None:
        means = shares.groupby(shares["visit"].map(groups).astype(str))["share"].mean()
        text += f" ({', '.join(f'{group} {mean:.1%}' for group, mean in means.items())})"
    return f"{text}; summary measures are of all points"


def _read(path: Path, visits: Sequence[VisitKey]) -> UserTable:
    """Read a table of grid points; participants, sessions and sides without a cell mean all."""
    rows = files.read_tsv(path)
    if rows and (lacking := [name for name in _NODES if name not in rows[0]]):
        raise InputError(
            f"{path}: no column {lacking[0]}; it needs x and y, numbers of nodes, and may have"
            f" {PARTICIPANT}, session_id, hemi, protocol",
            reason="bad-table",
        )
    return UserTable.of(path, rows, visits)


def _node(
    row: Mapping[str, str], shape: tuple[int, int], path: Path | None
) -> tuple[int | slice, int | slice]:
    """Return the place of a node; a missing number means all."""
    places: list[int | slice] = []
    for name, size in zip(_NODES, shape, strict=True):
        cell = row[name]
        if files.is_missing(cell):
            places.append(slice(None))
            continue
        if not cell.isdecimal() or not 1 <= int(cell) <= size:
            raise InputError(
                f"{path}: {name} is {cell!r}; nodes have numbers 1 to {size}", reason="bad-table"
            )
        places.append(int(cell) - 1)
    return places[0], places[1]
