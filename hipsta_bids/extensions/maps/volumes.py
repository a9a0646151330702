"""Tables of volumes of other programs, of segmentations and named (``--volumes``)."""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from hipsta_bids import opening
from hipsta_bids.errors import InputError, NothingToDoError, UsageError
from hipsta_bids.group.cohort.collect import SheetRecord
from hipsta_bids.group.cohort.covariates import locate_sources
from hipsta_bids.group.cohort.read import VOLUME, Measured, visit_name
from hipsta_bids.inputs.layouts import volume_table
from hipsta_bids.inputs.maps import check_pattern, fields_of, scan
from hipsta_bids.io import files
from hipsta_bids.io.files import entities

#: Volume that no structure reaches, mm^3: 10 liters.
_LARGEST_VOLUME = 1e7
#: Unit of all of them.
UNIT = "mm^3"
Volumes = Mapping[str, Mapping[str, float]]
"""In mm^3 by hemisphere (L, R) and structure."""
_SIDES = {"left": "L", "right": "R", "lh": "L", "rh": "R", "L": "L", "R": "R"}
_FREESURFER = re.compile(r"(?P<side>[lr]h)\.hippoSfVolumes.*\.txt")


@dataclass(frozen=True, kw_only=True)
class VolumeTable:
    """A table of one visit."""

    name: str
    """Name in those of its measures: the program, or the user's word."""
    visit: str
    """Row of the covariates."""
    path: Path
    hemi: str | None = None
    """The only hemisphere to take; ``None`` for all that are there."""


def table_of(segmentation: Path) -> tuple[str, Path] | None:
    """Find the table that belongs to a segmentation."""
    for name, locate in _TABLES.items():
        path = locate(segmentation)
        if path is not None and path.is_file():
            return name, path
    return None


def _hippunfold(segmentation: Path) -> Path | None:
    """Find the table of the same space and atlas."""
    pairs = entities(segmentation.name)
    if pairs.get("desc") != "subfields":
        return None
    keys = ("sub", "ses", "space", "atlas")
    tables = [
        path
        for path in sorted(segmentation.parent.glob("sub-*_volumes.tsv"))
        if all(entities(path.name).get(key) == pairs.get(key) for key in keys)
    ]
    return tables[0] if tables else None


_TABLES: Mapping[str, Callable[[Path], Path | None]] = {
    "freesurfer": lambda path: volume_table(path, "freesurfer"),
    "ashs": lambda path: volume_table(path, "ashs"),
    "hippunfold": _hippunfold,
}


def read_volumes(path: Path) -> Volumes:
    """Read one table of any program."""
    try:
        text = opening.read_text(path, opening.SETTINGS, encoding="utf-8-sig")
        volumes: dict[str, dict[str, float]] = {}
        for hemi, structure, volume in _entries(path, text):
            volumes.setdefault(hemi, {})[re.sub(r"\W+", "_", structure)] = volume
    except (OSError, ValueError, KeyError) as error:
        raise InputError(
            f"{path}: not readable as a table of volumes ({error}); FreeSurfer's hippoSfVolumes,"
            " ASHS's and HippUnfold's _volumes are known"
        ) from error
    return volumes


def _entries(path: Path, text: str) -> Iterator[tuple[str, str, float]]:
    lines = [line.split() for line in text.splitlines() if line.strip()]
    if not lines:
        raise ValueError("it is empty")
    if match := _FREESURFER.fullmatch(path.name):
        for name, volume in lines:
            yield _SIDES[match["side"]], name, _volume(volume)
    elif path.suffix == ".tsv":
        header, *rows = [line.split("\t") for line in text.splitlines() if line.strip()]
        for row in rows:
            cells = dict(zip(header, row, strict=True))
            hemi = _SIDES[cells.pop("hemi")]
            cells.pop("subject", None)
            for name, volume in cells.items():
                yield hemi, name, _volume(volume)
    else:
        for _, side, name, _, volume in lines:
            yield _SIDES[side], name, _volume(volume)


def _volume(text: str) -> float:
    if files.is_missing(text):
        return float("nan")
    value = float(text)
    if not 0 <= value < _LARGEST_VOLUME:
        raise ValueError(f"{text} is no volume")
    return value


def join_volumes(
    tables: Iterable[VolumeTable], visits: pd.Index, *, strict: Sequence[str] = ()
) -> tuple[dict[str, pd.DataFrame], list[str]]:
    """Read tables into one measure per structure, by hemisphere; NaN where missing."""
    cells: dict[str, dict[str, dict[str, float]]] = {}
    origin: dict[tuple[str, str, str], Path] = {}
    notes = []
    for table in tables:
        try:
            volumes = read_volumes(table.path)
        except InputError as error:
            if table.name in strict:
                raise
            notes.append(f"volumes of {table.visit} are excluded: {error}")
            continue
        for hemi, structures in volumes.items():
            if table.hemi not in {None, hemi}:
                continue
            for structure, volume in structures.items():
                column = f"{VOLUME}{table.name}_{structure}"
                first = origin.setdefault((hemi, column, table.visit), table.path)
                if first != table.path:
                    raise InputError(
                        f"volumes {table.name}: both {first} and {table.path} have {structure} of"
                        f" {table.visit}; make the pattern match one of them",
                        reason="several-files",
                    )
                cells.setdefault(hemi, {}).setdefault(column, {})[table.visit] = volume
    frames = {
        hemi: pd.DataFrame(cells[hemi], index=visits, dtype=np.float64) for hemi in sorted(cells)
    }
    return frames, notes


def check_volumes(patterns: Sequence[tuple[str, str]]) -> None:
    """Refuse wrong names and patterns of volume tables."""
    names = [name for name, _ in patterns]
    for name, pattern in patterns:
        if not (name.isalnum() and name.isascii()) or names.count(name) > 1:
            problem = (
                "occurs twice" if names.count(name) > 1 else "has more than letters and digits"
            )
            raise UsageError(f"--volumes: the name {name!r} {problem}")
        check_pattern("--volumes", name, pattern)
        if "subject" not in fields_of(pattern):
            raise UsageError(f"--volumes {name}: the pattern needs {{subject}}")


def add_volumes(
    measured: Measured,
    records: Sequence[SheetRecord],
    patterns: Sequence[tuple[str, str]],
    root: Path,
) -> tuple[Measured, list[str]]:
    """Add volumes of the segmentations, and from the user's patterns, as summaries."""
    named = [name for name, _ in patterns]
    tables = [table for table in _tables_of(records) if table.name not in named]
    for name, pattern in patterns:
        tables += _matching(name, pattern, root, measured)
    frames, notes = join_volumes(tables, measured.table.index, strict=named)
    sides = {
        hemi: side.with_summary(frames[hemi].iloc[side.rows]) if hemi in frames else side
        for hemi, side in measured.sides.items()
    }
    units = {str(column): UNIT for frame in frames.values() for column in frame.columns}
    for name in dict.fromkeys(table.name for table in tables):
        count = len({table.path for table in tables if table.name == name})
        notes.append(f"volumes {name}: {count} tables")
    return replace(measured, sides=sides, units={**measured.units, **units}), notes


def _tables_of(records: Sequence[SheetRecord]) -> Iterator[VolumeTable]:
    paths = locate_sources([r.source for r in records], [r.result.root for r in records])
    for record, path in zip(records, paths, strict=True):
        entry = None if path is None else table_of(path)
        if entry is not None:
            name, table = entry
            place = record.result.name
            visit = visit_name(place.subject, place.session)
            yield VolumeTable(name=name, visit=visit, path=table, hemi=place.hemi)


def _matching(name: str, pattern: str, root: Path, measured: Measured) -> list[VolumeTable]:
    matches = [(visit_name(file.subject, file.session), file) for file in scan(pattern, root)]
    tables = [
        VolumeTable(name=name, visit=visit, path=file.path, hemi=file.hemi)
        for visit, file in matches
        if visit in measured.table.index
    ]
    if not tables:
        raise NothingToDoError(
            f"--volumes {name}: no file matches {pattern} (in {root}) for any participant here"
        )
    return tables
