"""Volumes from other programs' tables as further summary measures of the sheets."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from hipsta_bids.bids.group_inputs import SheetRecord
from hipsta_bids.bids.patterns import check_pattern, fields_of, scan
from hipsta_bids.bids.sheets import Measured, visit_name
from hipsta_bids.bids.source_links import locate_sources
from hipsta_bids.bids.volume_tables import UNIT, VolumeTable, join_volumes, table_beside
from hipsta_bids.errors import NothingToDoError, UsageError


def check_volumes(patterns: Sequence[tuple[str, str]]) -> None:
    """Refuse wrong names and patterns of volume tables.

    Parameters
    ----------
    patterns : sequence of (str, str)
        Names and patterns.

    Raises
    ------
    UsageError
        If a name is none or occurs twice, or a placeholder is unknown or lacking.
    """
    names = [name for name, _ in patterns]
    for name, pattern in patterns:
        if not (name.isalnum() and name.isascii()) or names.count(name) > 1:
            why = "occurs twice" if names.count(name) > 1 else "has more than letters and digits"
            raise UsageError(f"--volumes: the name {name!r} {why}", reason="usage")
        check_pattern("--volumes", name, pattern)
        if "subject" not in fields_of(pattern):
            raise UsageError(f"--volumes {name}: the pattern needs {{subject}}", reason="usage")


def add_volumes(
    measured: Measured,
    records: Sequence[SheetRecord],
    patterns: Sequence[tuple[str, str]],
    root: Path,
) -> tuple[Measured, list[str]]:
    """Add the volumes found beside the segmentations, and those that the user names.

    Parameters
    ----------
    measured : Measured
    records : sequence of SheetRecord
        Hemispheres of the sheets, which say where their segmentations are.
    patterns : sequence of (str, str)
        Names and patterns of further tables, checked. A name that a program would have replaces
        what lies beside.
    root : Path
        What patterns are relative to.

    Returns
    -------
    Measured
        Summaries have one column more per structure, ``volume_<name>_<structure>``.
    list of str
        What was found and what was left out, one line each.

    Raises
    ------
    InputError
        If a table that the user names cannot be read, or two are for the same hemisphere.
    NothingToDoError
        If no file matches a pattern.
    """
    named = [name for name, _ in patterns]
    tables = [table for table in _beside(records) if table.name not in named]
    for name, pattern in patterns:
        tables += _matching(name, pattern, root, measured)
    frames, notes = join_volumes(tables, measured.visits.index, strict=named)
    sides = {
        hemi: side.with_summary(frames[hemi].iloc[side.rows]) if hemi in frames else side
        for hemi, side in measured.sides.items()
    }
    units = {str(column): UNIT for frame in frames.values() for column in frame.columns}
    for name in dict.fromkeys(table.name for table in tables):
        count = len({table.path for table in tables if table.name == name})
        notes.append(f"volumes {name}: {count} tables")
    return replace(measured, sides=sides, units={**measured.units, **units}), notes


def _beside(records: Sequence[SheetRecord]) -> Iterator[VolumeTable]:
    paths = locate_sources([r.source for r in records], [r.place.root for r in records])
    for record, path in zip(records, paths, strict=True):
        found = None if path is None else table_beside(path)
        if found is not None:
            name, table = found
            own = record.place.name
            visit = visit_name(own.subject, own.session)
            yield VolumeTable(name=name, visit=visit, path=table, hemi=own.hemi)


def _matching(name: str, pattern: str, root: Path, measured: Measured) -> list[VolumeTable]:
    visits = set(measured.visits.index)
    tables = []
    for one in scan(pattern, root):
        visit = visit_name(one.subject, one.session)
        if visit in visits:
            tables.append(VolumeTable(name=name, visit=visit, path=one.path, hemi=one.hemi))
    if not tables:
        raise NothingToDoError(
            f"--volumes {name}: no file matches {pattern} (in {root}) for any participant here",
            reason="no-volumes",
        )
    return tables
