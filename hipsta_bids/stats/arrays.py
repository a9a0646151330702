"""Maps of one hemisphere as arrays, in blocks that fit in memory."""

import contextlib
import ctypes
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from hipsta_bids.types import Mesh

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]
Key = tuple[str, str]
"""Hemisphere and measure."""
#: More sheets of a side are kept in single precision, whose rounding is less than a hundredth of
#: that of the tables, and registered whenever they are asked for, to save memory.
MOST_KEPT = 10_000
#: Sheets in memory at once, where each is processed alone.
SHEETS = 4000


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

    def __getitem__(self, rows: slice | Bool | Int) -> NDArray[np.int8]:
        return self.carry(self.source[rows], self.warps[rows])


def some_sheets(maps: Mapping[str, Float], rows: slice | Bool | Int) -> Mapping[str, Float]:
    """Keep some sheets of maps."""
    if isinstance(maps, WarpedMaps):
        return WarpedMaps(some_sheets(maps.source, rows), maps.warps[rows], maps.carry)
    return {name: values[rows] for name, values in maps.items()}


def sheets_of(maps: Mapping[str, Float], name: str, rows: Bool | Int) -> Float:
    """Take some sheets of one map; only these are registered, if need be."""
    if isinstance(maps, WarpedMaps):
        return maps.carry(maps.source[name][rows], maps.warps[rows])
    return maps[name][rows]


def parts_of_sheets(maps: Mapping[str, Float], name: str, selected: Bool | Int) -> Iterator[Float]:
    """Take sheets of one map, some at a time; the order is kept."""
    rows = np.flatnonzero(selected) if selected.dtype == np.bool_ else selected
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
    mesh: Mesh | None = None
    """Surface of the points if they are not on the grid: x are its vertices then, and y is 1."""
    covariates: Mapping[str, Float] = field(default_factory=dict)
    """(sheets, x, y) covariates of the model at each point, by name: maps, or summary measures."""

    first: "SideMaps | None" = None
    """Values at the baseline, a covariate at each point: the sheets of the same participants."""
    unmasked: Float | None = None
    """(sheets, x, y) curvature that registration uses, where a mask has points of that map."""

    @property
    def curvature(self) -> Float:
        """(sheets, x, y) map that registration uses."""
        return self.maps["curvature"] if self.unmasked is None else self.unmasked

    @property
    def shape(self) -> tuple[int, int]:
        """Nodes along x and y."""
        return self.subfield.shape[1], self.subfield.shape[2]

    def covariate(self, name: str) -> Float:
        """Return a map, or a summary measure at each point (sheets, x, y)."""
        if name in self.maps:
            return self.maps[name]
        values = self.summary[name].to_numpy(dtype=np.float64)
        return np.broadcast_to(values[:, None, None], self.subfield.shape)

    def only(self, measures: Sequence[str]) -> "SideMaps":
        """Keep some maps."""
        if set(measures) == set(self.maps):
            return self
        first = self.first and self.first.only(measures)
        return replace(self, maps={name: self.maps[name] for name in measures}, first=first)

    def with_summary(self, columns: pd.DataFrame) -> "SideMaps":
        """Add summary measures."""
        joined = pd.concat([self.summary, columns.set_axis(self.summary.index)], axis=1)
        return replace(self, summary=joined)

    def take(self, keep: NDArray[np.bool_]) -> "SideMaps":
        """Keep some rows of the cohort's table, which are renumbered."""
        side = self.sheets(keep[self.rows])
        return replace(side, rows=(np.cumsum(keep) - 1)[side.rows])

    def sheets(self, keep: NDArray[np.bool_]) -> "SideMaps":
        """Keep some sheets; of all, no copy is made."""
        if keep.all():
            return self
        return replace(
            self,
            rows=self.rows[keep],
            maps=some_sheets(self.maps, keep),
            covariates=some_sheets(self.covariates, keep),
            first=None if self.first is None else self.first.sheets(keep),
            unmasked=None if self.unmasked is None else self.unmasked[keep],
            subfield=self.subfield[keep],
            summary=self.summary[keep].reset_index(drop=True),
        )


def return_memory() -> None:
    """Give memory that is free back to the system: glibc keeps what lies between pieces in use."""
    with contextlib.suppress(AttributeError):  # other C libraries have no such function
        ctypes.CDLL(None).malloc_trim(0)


def mean_of_known(values: Float, axis: int) -> Float:
    """Mean without missing values; NaN where nothing is known."""
    finite = np.isfinite(values)
    count = finite.sum(axis=axis)
    total = values.sum(axis=axis, dtype=np.float64, where=finite)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def describe_known(parts: Iterable[Float]) -> tuple[Bool, Float, Float]:
    """Determine the known cells of a table in parts, (rows, columns), and mean and SD by column.

    Means and sums of squares of parts are put together as by Chan et al. (1983).
    """
    finite, count, mean, squares = [], np.zeros(1, np.int64), np.zeros(1), np.zeros(1)
    for values in parts:
        finite.append(np.isfinite(values))
        n = finite[-1].sum(axis=0)
        total = np.maximum(count + n, 1)
        block_mean = np.nan_to_num(mean_of_known(values, 0))
        squares = squares + np.sum(
            (values - block_mean) ** 2, axis=0, dtype=np.float64, where=finite[-1]
        )
        squares += (block_mean - mean) ** 2 * count * n / total
        mean = mean + (block_mean - mean) * n / total
        count = count + n
    spread = np.sqrt(squares / np.maximum(count - 1, 1))
    return (
        np.concatenate(finite),
        np.where(count > 0, mean, np.nan),
        np.where(count > 1, spread, np.nan),
    )
