"""Values passed between reading, analyzing and writing at the group level."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from hipsta_bids.errors import ModelError
from hipsta_bids.group.model import BOTH, Sessions, asymmetry_name
from hipsta_bids.settings import SheetSettings
from hipsta_bids.stats.arrays import Bool, Float, Int, SideMaps
from hipsta_bids.types import REGION


@dataclass(frozen=True, kw_only=True)
class Measures:
    """What the model is fitted to."""

    maps: tuple[str, ...]
    """Maps of the sheet, by the names of their columns or by those that a user gave."""
    summaries: tuple[str, ...] | None = None
    """Summary measures; ``None`` for all."""


class Grid(SheetSettings):
    """The grid of the sheets of an output dataset."""

    frame: Literal["visit", "person", "shared"] = "visit"
    """Whose sheet it is; all but the first are shared by the visits of a participant."""


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
    shared: bool = False
    """Whether the visits of a participant share a sheet, and therefore a warp."""

    def take(self, keep: NDArray[np.bool_]) -> "Cohort":
        """Keep some visits; ``keep`` has one value per visit."""
        return replace(
            self,
            table=self.table[keep],
            sides={hemi: side.take(keep) for hemi, side in self.sides.items()},
        )


def summary_values(cohort: Cohort, hemi: str, names: Sequence[str] | None = None) -> pd.DataFrame:
    """Summary measures by visit.

    One row per visit of the cohort's table, NaN where missing. Asymmetries of regions, which both
    sides have, are of both only.
    """
    if hemi == BOTH:
        left, right = (_side_values(cohort, side, names) for side in BOTH)
        return (left + right) / 2
    values = _side_values(cohort, hemi, names)
    ending = asymmetry_name("") + REGION
    return values[[name for name in values.columns if ending not in str(name)]]


def _side_values(cohort: Cohort, hemi: str, names: Sequence[str] | None) -> pd.DataFrame:
    side = cohort.sides[hemi]
    table = side.summary.set_axis(cohort.table.index[side.rows])
    selected = table if names is None else table[[name for name in names if name in table.columns]]
    return selected.reindex(cohort.table.index)


def covariate_values(cohort: Cohort, hemi: str, names: Sequence[str]) -> pd.DataFrame:
    """Summary measures that are covariates, by visit: one row per visit, NaN where missing."""
    if hemi == BOTH:
        left, right = (covariate_values(cohort, side, names) for side in BOTH)
        return (left + right) / 2
    side = cohort.sides[hemi]
    columns = {name: side.covariates[name][:, 0, 0] for name in names}
    table = pd.DataFrame(columns, index=cohort.table.index[side.rows])
    return table.reindex(cohort.table.index)


def hemispheres(cohort: Cohort) -> list[str]:
    """Hemispheres that are there, and both together if both are."""
    sides = list(cohort.sides)
    return [*sides, BOTH] if len(sides) == len(BOTH) else sides


def participants_with(finite: Bool, participants: NDArray[np.object_]) -> Int:
    """Count participants (columns,) of whom any row (rows, columns) is known."""
    names, numbers = np.unique(participants.astype(str), return_inverse=True)
    if len(names) == len(participants):
        return np.asarray(finite.sum(axis=0), dtype=np.int64)
    order = np.argsort(numbers, kind="stable")
    starts = np.searchsorted(numbers[order], np.arange(len(names)))
    return np.asarray(
        np.logical_or.reduceat(finite[order], starts, axis=0).sum(axis=0), dtype=np.int64
    )


def compare_sessions(cohort: Cohort, sessions: Sessions, covariates: Sequence[str] = ()) -> Cohort:
    """Return the rows of the model, with their maps, of which some are covariates."""
    sides = sessions.compare(cohort.table, cohort.sides, covariates)
    return replace(cohort, table=sessions.rows(cohort.table), sides=sides)


def baselines(cohort: Cohort) -> Cohort | None:
    """Return values of the baseline instead of the later values; ``None`` without these."""
    sides = {hemi: side.first for hemi, side in cohort.sides.items() if side.first is not None}
    return replace(cohort, sides=sides) if sides else None


def asymmetry_maps(cohort: Cohort, measures: Sequence[str], relative: Sequence[str]) -> SideMaps:
    """Left minus right at each point, of participants who have both."""
    if set(cohort.sides) != set(BOTH):
        raise ModelError(f"asymmetry: hemisphere {', '.join(cohort.sides)} only; both are needed")
    left, right = (cohort.sides[hemi] for hemi in BOTH)
    if left.shape != right.shape:
        raise ModelError(
            f"asymmetry: maps of {', '.join(measures)} have different numbers of points left and"
            " right"
        )
    rows, a, b = np.intersect1d(left.rows, right.rows, return_indices=True)
    if not len(rows):
        raise ModelError("asymmetry: no participant has both hemispheres")
    names = tuple(dict.fromkeys((*left.names, *right.names)))
    codes = np.array([*(names.index(name) for name in left.names), -1], dtype=np.int8)

    def difference(name: str, of_left: Float, of_right: Float) -> Float:
        mean = (of_left + of_right) / 2
        unit = np.where(mean > 0, mean, np.nan) if name in relative else 1.0
        return np.asarray((of_left - of_right) / unit)

    return SideMaps(
        rows=rows,
        maps={
            asymmetry_name(name): difference(name, left.maps[name][a], right.maps[name][b])
            for name in measures
        },
        covariates={
            name: difference(name, values[a], right.covariates[name][b])
            for name, values in left.covariates.items()
        },
        subfield=codes[left.subfield[a]],
        names=names,
        summary=pd.DataFrame(index=range(len(rows))),
        mesh=left.mesh,
    )


#: Summary measures that grow with the head.
_SIZES = re.compile(r"(volume|area|section_area|extent)(?!_ratio)")
#: What these are in texts.
SIZES = "volumes, areas and extents"


def grows_with_head(measure: str) -> bool:
    """Check whether a summary measure is also tested with intracranial volume."""
    return _SIZES.match(measure) is not None


#: Surfaces: the sheet, and that of summary measures, which is one point. Those of other programs'
#: maps have names.
SHEET, SUMMARY = "", "summary"


@dataclass(frozen=True, eq=False, kw_only=True)
class Layer:
    """Values of one measure at the points of one surface in one hemisphere, or in both."""

    surface: str
    """``SHEET``, ``SUMMARY``, or the name of another program's maps."""
    hemi: str
    measure: str
    unit: str
    rows: Int
    """(rows,) rows of the cohort's table."""
    source: SideMaps | Float
    """Maps of this measure alone, or the values (rows, 1) of a summary measure."""

    @property
    def data(self) -> Float:
        """(rows, points), NaN where missing; registered anew each time in large cohorts."""
        if isinstance(self.source, SideMaps):
            return self.source.maps[self.measure].reshape(len(self.rows), -1)
        return self.source


def layers(
    cohorts: Mapping[str, Cohort],
    maps: Sequence[str],
    summaries: Sequence[str] | None,
    rows: Int | None = None,
) -> Iterator[Layer]:
    """Return layers of maps and then of summary measures.

    Parameters
    ----------
    cohorts : mapping of str to Cohort
        By surface.
    maps : sequence of str
        Maps of the sheet; maps of other surfaces are all taken.
    summaries : sequence of str or None
        Summary measures of the sheet's cohort; ``None`` for all.
    rows : (rows,) array, optional
        Rows of the table whose summary measures are taken; by default all.
    """
    for surface, cohort in cohorts.items():
        names = maps if surface == SHEET else (surface,)
        for hemi, side in cohort.sides.items():
            for name in names:
                if name in side.maps:
                    yield Layer(
                        surface=surface,
                        hemi=hemi,
                        measure=name,
                        unit=cohort.units.get(name, "1"),
                        rows=side.rows,
                        source=side.only([name]),
                    )
    cohort = cohorts[SHEET]
    rows = np.arange(len(cohort.table)) if rows is None else rows
    for hemi in hemispheres(cohort):
        table = summary_values(cohort, hemi, summaries).iloc[rows]
        for name in table.columns:
            yield Layer(
                surface=SUMMARY,
                hemi=hemi,
                measure=str(name),
                unit=cohort.units.get(str(name), "1"),
                rows=rows,
                source=table[[name]].to_numpy(dtype=np.float64),
            )
