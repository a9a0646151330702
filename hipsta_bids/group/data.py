"""Values passed between reading, analyzing and writing at the group level."""

import contextlib
import ctypes
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from textwrap import shorten
from typing import Annotated, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from hipsta_bids.io import files
from hipsta_bids.protocols.toml import Table, first_mistake
from hipsta_bids.types import Mesh

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]
Key = tuple[str, str]
"""Hemisphere and measure."""
Number = Annotated[float, Field(allow_inf_nan=False)]
Known = list[Number | None]
"""Numbers in JSON; null where one is missing."""
Nested = dict[str, dict[str, dict[str, list[Any]]]]
"""Arrays by hemisphere, measure and name as lists, for JSON."""

#: Characters of a mistake in a file.
_LONGEST = 300
#: Columns that identify visits, with the prefixes of BIDS.
PARTICIPANT, SESSION = "participant_id", "session_id"
#: More sheets of a side are kept in single precision, whose rounding is less than a hundredth of
#: that of the tables, and registered whenever they are asked for, to save memory.
MOST_KEPT = 10_000
#: Sheets in memory at once, where each counts on its own.
SHEETS = 4000


@dataclass(frozen=True, kw_only=True)
class Measures:
    """What the model is fitted to."""

    maps: tuple[str, ...]
    """Maps of the sheet, by the names of their columns or by those that a user gave."""
    summaries: tuple[str, ...] | None = None
    """Summary measures; ``None`` for all."""


@dataclass(frozen=True, eq=False)
class WarpedMaps(Mapping[str, Float]):
    """Maps (sheets, x, y) that are registered whenever they are asked for."""

    source: Mapping[str, Float]
    warps: Float
    carry: Callable[[Float, Float], Float]

    def __getitem__(self, name: str) -> Float:
        return self.carry(self.source[name], self.warps)

    def __iter__(self) -> Iterator[str]:
        return iter(self.source)

    def __len__(self) -> int:
        return len(self.source)


@dataclass(frozen=True, eq=False)
class WarpedLabels:
    """Labels (sheets, x, y) that are registered whenever some are asked for."""

    source: NDArray[np.int8]
    warps: Float
    carry: Callable[[NDArray[np.int8], Float], NDArray[np.int8]]

    @property
    def shape(self) -> tuple[int, ...]:
        """Sheets, x, y."""
        return self.source.shape

    def __getitem__(self, own: slice | Bool | Int) -> NDArray[np.int8]:
        return self.carry(self.source[own], self.warps[own])


def some_sheets(maps: Mapping[str, Float], own: slice | Bool) -> Mapping[str, Float]:
    """Keep some sheets of maps."""
    if isinstance(maps, WarpedMaps):
        return WarpedMaps(some_sheets(maps.source, own), maps.warps[own], maps.carry)
    return {name: values[own] for name, values in maps.items()}


def sheets_of(maps: Mapping[str, Float], name: str, own: Bool | Int) -> Float:
    """Take some sheets of one map; only these are registered, if need be."""
    if isinstance(maps, WarpedMaps):
        return maps.carry(maps.source[name][own], maps.warps[own])
    return maps[name][own]


def parts_of_sheets(maps: Mapping[str, Float], name: str, own: Bool | Int) -> Iterator[Float]:
    """Take sheets of one map, some at a time; the order is kept."""
    rows = np.flatnonzero(own) if own.dtype == np.bool_ else own
    return (sheets_of(maps, name, rows[part]) for part in blocks(len(rows), SHEETS))


def blocks(count: int, size: int) -> Iterator[slice]:
    """Cut rows into blocks, one at least, to bound memory."""
    return (slice(start, start + size) for start in range(0, max(count, 1), size))


@dataclass(frozen=True, eq=False, kw_only=True)
class SideMaps:
    """Sheets of one hemisphere of all visits that have it."""

    rows: Int
    """(sheets,) row of each in the cohort's table, ascending."""
    maps: Mapping[str, Float]
    """(sheets, x, y) per measure; NaN is missing."""
    subfield: NDArray[np.int8] | WarpedLabels
    """(sheets, x, y) index into ``names``; -1 is missing."""
    names: tuple[str, ...]
    """Abbreviations of subfields."""
    summary: pd.DataFrame
    """One row per sheet: the columns of the participant level's summaries, as numbers."""
    errors: Mapping[str, Float] = field(default_factory=dict)
    """(sheets, x, y) SD of the measurement per measure, where it was asked for."""
    mesh: Mesh | None = None
    """Surface of the points if they are not on the grid: x are its vertices then, and y is 1."""

    @property
    def shape(self) -> tuple[int, int]:
        """Nodes along x and y."""
        return self.subfield.shape[1], self.subfield.shape[2]

    def only(self, measures: Sequence[str]) -> "SideMaps":
        """Keep some maps."""
        if set(measures) == set(self.maps):
            return self
        return replace(self, maps={name: self.maps[name] for name in measures})

    def with_summary(self, columns: pd.DataFrame) -> "SideMaps":
        """Add summary measures."""
        joined = pd.concat([self.summary, columns.set_axis(self.summary.index)], axis=1)
        return replace(self, summary=joined)

    def take(self, keep: NDArray[np.bool_]) -> "SideMaps":
        """Keep some rows of the cohort's table, which are renumbered."""
        own = self.sheets(keep[self.rows])
        return replace(own, rows=(np.cumsum(keep) - 1)[own.rows])

    def sheets(self, own: NDArray[np.bool_]) -> "SideMaps":
        """Keep some sheets; of all, no copy is made."""
        if own.all():
            return self
        return replace(
            self,
            rows=self.rows[own],
            maps=some_sheets(self.maps, own),
            errors=some_sheets(self.errors, own),
            subfield=self.subfield[own],
            summary=self.summary[own].reset_index(drop=True),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Cohort:
    """All that the models are fitted to."""

    table: pd.DataFrame
    """One row per visit: participant, session and covariates; the index names the visits."""
    sides: Mapping[str, SideMaps]
    """By hemisphere, ``L`` and ``R``; only those that occur."""
    x: Float
    """(x,) sheet coordinates of the nodes, medial to lateral, -1..1."""
    y: Float
    """(y,) sheet coordinates of the nodes, posterior to anterior, -1..1."""
    units: Mapping[str, str]
    """Units of maps and summary columns."""

    def take(self, keep: NDArray[np.bool_]) -> "Cohort":
        """Keep some visits; ``keep`` has one value per visit."""
        return replace(
            self,
            table=self.table[keep],
            sides={hemi: side.take(keep) for hemi, side in self.sides.items()},
        )


def return_memory() -> None:
    """Give memory that is free back to the system: glibc keeps what lies between pieces in use."""
    with contextlib.suppress(AttributeError):  # other C libraries have no such function
        ctypes.CDLL(None).malloc_trim(0)


def read_foreign(path: Path, kind: type[Table], *, most: float) -> Table:
    """Read a JSON file of other people, which may hold anything; nothing in it is run.

    Raises
    ------
    ValueError
        One line about what is wrong in it, or that it has more bytes than ``most``.
    """
    if path.is_file() and path.stat().st_size > most:
        raise ValueError(f"larger than {most / 1e6:g} MB")
    return checked_foreign(files.read_json(path), kind)


def checked_foreign(content: object, kind: type[Table]) -> Table:
    """Check what a file of other people holds; ValueError of one line if something is wrong."""
    try:
        return kind.model_validate(content)
    except RecursionError as error:
        raise ValueError("lists within lists without end") from error
    except ValidationError as error:
        mistake = first_mistake(error, kind)[1].encode("unicode_escape").decode()
        raise ValueError(shorten(mistake, _LONGEST)) from error


def rounded(value: Any) -> Any:  # noqa: ANN401  (nested lists of numbers)
    """Round numbers to nine digits, in lists and arrays too; null where one is missing."""
    if isinstance(value, (list, np.ndarray)):
        return [rounded(one) for one in (value if isinstance(value, list) else value.tolist())]
    if isinstance(value, int):
        return value
    return float(f"{value:.9g}") if math.isfinite(value) else None


def as_nested(found: Mapping[Key, object], names: Sequence[str]) -> Nested:
    """Write the named arrays of values by hemisphere and measure."""
    nested: Nested = {}
    for (hemi, measure), one in found.items():
        arrays = {name: rounded(getattr(one, name)) for name in names}
        nested.setdefault(hemi, {})[measure] = arrays
    return nested
