"""Values passed between reading, analyzing and writing at the group level."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from hipsta_bids.derivatives.names import natural_order
from hipsta_bids.errors import ModelError
from hipsta_bids.group.model import BOTH, Comparison, asymmetry_name
from hipsta_bids.stats.arrays import Bool, Float, Int, SideMaps, some_sheets
from hipsta_bids.stats.formula import listed
from hipsta_bids.types import PARTICIPANT, SESSION


@dataclass(frozen=True, kw_only=True)
class Measures:
    """What the model is fitted to."""

    maps: tuple[str, ...]
    """Maps of the sheet, by the names of their columns or by those that a user gave."""
    summaries: tuple[str, ...] | None = None
    """Summary measures; ``None`` for all."""


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

    One row per visit of the cohort's table, NaN where missing.
    """
    if hemi == BOTH:
        left, right = (summary_values(cohort, side, names) for side in BOTH)
        return (left + right) / 2
    side = cohort.sides[hemi]
    table = side.summary.set_axis(cohort.table.index[side.rows])
    selected = table if names is None else table[[name for name in names if name in table.columns]]
    return selected.reindex(cohort.table.index)


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


def choose_visits(cohort: Cohort, comparison: Comparison) -> tuple[Cohort, Mapping[str, str]]:
    """Keep the visits that are compared."""
    table = cohort.table
    named = comparison.pair or comparison.endpoint[1:]
    sessions = sorted(table[SESSION].dropna().unique(), key=natural_order)
    if unknown := sorted(set(named) - set(sessions)):
        option = "--paired" if comparison.pair else "--endpoint"
        if not sessions:
            raise ModelError(f"{option}: no sessions in this dataset; remove it")
        raise ModelError(
            f"{option}: there is no session {listed(unknown)}, only {listed(sessions)}"
        )
    if comparison.endpoint:
        in_trial = table[SESSION].isin(named).to_numpy()
        first = table[PARTICIPANT][table[SESSION] == comparison.adjusted]
        keep = in_trial & (table[PARTICIPANT].isin(first).to_numpy() | (not comparison.adjusted))
        reasons = pd.Series("the session of the baseline is missing", index=table.index)
        reasons[~in_trial] = f"sessions {' and '.join(named)} are compared"
    elif comparison.longitudinal:
        return cohort, {}
    elif comparison.pair is None:
        keep = ~table[PARTICIPANT].duplicated().to_numpy()
        reasons = pd.Series("the first session of each participant is analyzed", index=table.index)
    else:
        in_pair = table[SESSION].isin(comparison.pair)
        complete = in_pair.groupby(table[PARTICIPANT]).transform("sum") == len(comparison.pair)
        keep = (in_pair & complete).to_numpy()
        reasons = pd.Series("the other session of the pair is missing", index=table.index)
        reasons[~in_pair] = f"sessions {' and '.join(comparison.pair)} are compared"
        if not keep.any():
            raise ModelError(
                f"no participant has both sessions {' and '.join(comparison.pair)}; choose"
                " two other sessions"
            )
    return cohort.take(keep), dict(reasons[~keep])


def modeled_table(table: pd.DataFrame, comparison: Comparison) -> pd.DataFrame:
    """Rows of the model: visits, or participants with the covariates of their first session.

    Without the baseline, if that is a covariate.
    """
    if comparison.adjusted:
        return table[(table[SESSION] != comparison.adjusted).to_numpy()]
    if comparison.pair is None:
        return table
    first = table[table[SESSION] == comparison.pair[0]]
    return first.set_axis(first[PARTICIPANT])


def compare_sessions(
    cohort: Cohort, comparison: Comparison, covariates: Sequence[str] = ()
) -> Cohort:
    """Take differences of two sessions, if these are compared.

    Maps that are covariates are of the first session, as other covariates are.
    """
    if comparison.adjusted:
        return _after_baseline(cohort, comparison)
    if comparison.pair is None:
        sides = {
            hemi: replace(side, covariates={name: side.maps[name] for name in covariates})
            for hemi, side in cohort.sides.items()
        }
        return replace(cohort, sides=sides) if covariates else cohort
    table = modeled_table(cohort.table, comparison)
    if not cohort.sides:
        return replace(cohort, table=table)
    row_of = {participant: row for row, participant in enumerate(table.index)}
    sides = {}
    for hemi, side in cohort.sides.items():
        visits = cohort.table.iloc[side.rows]
        rows = np.array([row_of[participant] for participant in visits[PARTICIPANT]])
        first, second = (
            np.flatnonzero((visits[SESSION] == session).to_numpy()) for session in comparison.pair
        )
        common, a, b = np.intersect1d(rows[first], rows[second], return_indices=True)
        if len(common):
            changes = _change(side, common, first[a], second[b])
            baseline = {name: side.maps[name][first[a]] for name in covariates}
            sides[hemi] = replace(changes, covariates=baseline)
    if not sides:
        raise ModelError(
            f"no hemisphere was measured in both sessions {' and '.join(comparison.pair)}"
        )
    return replace(cohort, table=table, sides=sides)


def _after_baseline(cohort: Cohort, comparison: Comparison) -> Cohort:
    """Keep later sessions, with the values of the baseline in ``first``."""
    table = modeled_table(cohort.table, comparison)
    row_of = {visit: row for row, visit in enumerate(table.index)}
    sides = {}
    for hemi, side in cohort.sides.items():
        visits = cohort.table.iloc[side.rows]
        is_first = (visits[SESSION] == comparison.adjusted).to_numpy()
        sheet_of = dict(zip(visits[PARTICIPANT][is_first], np.flatnonzero(is_first), strict=True))
        has_first = ~is_first & visits[PARTICIPANT].isin(sheet_of).to_numpy()
        if has_first.any():
            rows = np.array([row_of[visit] for visit in visits.index[has_first]])
            sheets = np.array(
                [sheet_of[participant] for participant in visits[PARTICIPANT][has_first]]
            )
            first = replace(
                side,
                rows=rows,
                maps=some_sheets(side.maps, sheets),
                subfield=side.subfield[sheets],
                unmasked=None,
                summary=side.summary.iloc[sheets].reset_index(drop=True),
            )
            sides[hemi] = replace(side.sheets(has_first), rows=rows, first=first)
    if cohort.sides and not sides:
        raise ModelError(f"no hemisphere was measured in {comparison.adjusted} and later")
    return replace(cohort, table=table, sides=sides)


def baselines(cohort: Cohort) -> Cohort | None:
    """Return values of the baseline instead of the later values; ``None`` without these."""
    sides = {hemi: side.first for hemi, side in cohort.sides.items() if side.first is not None}
    return replace(cohort, sides=sides) if sides else None


def _change(side: SideMaps, rows: Int, first: Int, second: Int) -> SideMaps:
    summary = side.summary.iloc[second].to_numpy() - side.summary.iloc[first].to_numpy()
    return replace(
        side,
        rows=rows,
        maps={name: m[second] - m[first] for name, m in side.maps.items()},
        subfield=side.subfield[first],
        unmasked=None,
        summary=pd.DataFrame(summary, columns=side.summary.columns),
    )


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
