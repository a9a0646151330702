"""Volumes of structures, in mm^3, from the tables that segmentation programs write.

FreeSurfer's ``mri/{lh,rh}.hippoSfVolumes*.txt`` (a name and a number per line), ASHS's
``*_volumes.txt`` (subject, side, name, number of slices and volume per line), and HippUnfold's
``*_volumes.tsv`` (a row per hemisphere, a column per subfield).
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from hipsta_bids.bids import ashs, files, freesurfer
from hipsta_bids.bids.label_tables import entities
from hipsta_bids.bids.measure_names import VOLUME
from hipsta_bids.errors import InputError

#: Unit of all of them.
UNIT = "mm^3"

Volumes = Mapping[str, Mapping[str, float]]
"""By hemisphere, then by structure."""

_SIDES = {"left": "L", "right": "R", "lh": "L", "rh": "R", "L": "L", "R": "R"}
_FREESURFER = re.compile(r"(?P<side>[lr]h)\.hippoSfVolumes.*\.txt")


@dataclass(frozen=True, kw_only=True)
class VolumeTable:
    """A table of one visit."""

    name: str
    """What its measures are called after: the program, or the user's word."""
    visit: str
    """Row of the covariates."""
    path: Path
    hemi: str | None = None
    """The only hemisphere to take; ``None`` for all that are there."""


def table_beside(segmentation: Path) -> tuple[str, Path] | None:
    """Find the table that belongs to a segmentation.

    Parameters
    ----------
    segmentation : Path
        The participant level's input.

    Returns
    -------
    (str, Path) or None
        Program and file, if it exists.
    """
    for name, beside in _BESIDE.items():
        path = beside(segmentation)
        if path is not None and path.is_file():
            return name, path
    return None


def _hippunfold(segmentation: Path) -> Path | None:
    """Find the table of the same space and atlas."""
    own = entities(segmentation.name)
    if own.get("desc") != "subfields":
        return None
    keys = ("sub", "ses", "space", "atlas")
    found = [
        path
        for path in sorted(segmentation.parent.glob("sub-*_volumes.tsv"))
        if all(entities(path.name).get(key) == own.get(key) for key in keys)
    ]
    return found[0] if found else None


_BESIDE: Mapping[str, Callable[[Path], Path | None]] = {
    "freesurfer": freesurfer.volume_table,
    "ashs": ashs.volume_table,
    "hippunfold": _hippunfold,
}


def read_volumes(path: Path) -> Volumes:
    """Read one table, in whichever form it is.

    Parameters
    ----------
    path : Path

    Returns
    -------
    mapping of str to mapping of str to float
        mm^3 by hemisphere (``L``, ``R``) and structure.

    Raises
    ------
    InputError
        If it is not such a table.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
        found: dict[str, dict[str, float]] = {}
        for hemi, structure, volume in _entries(path, text):
            found.setdefault(hemi, {})[re.sub(r"\W+", "_", structure)] = volume
    except (OSError, ValueError, KeyError) as error:
        raise InputError(
            f"{path}: not readable as a table of volumes ({error}); FreeSurfer's hippoSfVolumes,"
            " ASHS's and HippUnfold's _volumes are known",
            reason="unreadable-volumes",
        ) from error
    return found


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
    if text in {files.MISSING, "nan", "NaN"}:
        return float("nan")
    value = float(text)
    if not 0 <= value < float("inf"):
        raise ValueError(f"{text} is no volume")
    return value


def join_volumes(
    tables: Iterable[VolumeTable], visits: pd.Index, *, strict: Sequence[str] = ()
) -> tuple[dict[str, pd.DataFrame], list[str]]:
    """Read tables into one measure per structure.

    Parameters
    ----------
    tables : iterable of VolumeTable
    visits : Index
        Rows of the covariates.
    strict : sequence of str, optional
        Names whose tables must be readable; others are left out with a note.

    Returns
    -------
    dict of str to DataFrame
        By hemisphere: rows are visits, columns ``volume_<name>_<structure>``; NaN is missing.
    list of str
        What was left out, one line each.

    Raises
    ------
    InputError
        If a table that must be readable is not, or two give the same structure of one hemisphere.
    """
    cells: dict[str, dict[str, dict[str, float]]] = {}
    origin: dict[tuple[str, str, str], Path] = {}
    notes = []
    for table in tables:
        try:
            volumes = read_volumes(table.path)
        except InputError as error:
            if table.name in strict:
                raise
            notes.append(f"volumes of {table.visit} are left out: {error}")
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
