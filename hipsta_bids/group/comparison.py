"""What a row of the model is: a visit, or a difference of sessions or of sides."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from hipsta_bids.errors import ModelError, UsageError
from hipsta_bids.group.data import PARTICIPANT, SESSION, Cohort, Float, Int, SideMaps
from hipsta_bids.group.formula import listed

#: Both sides of a participant, in names of hemispheres.
BOTH = "LR"


def asymmetry(left: Float, right: Float, *, relative: bool) -> Float:
    """Left minus right, on sheets whose axes mean the same on both sides."""
    difference: Float = left - right
    if relative:
        mean = (left + right) / 2
        difference = difference / np.where(mean > 0, mean, np.nan)
    return difference


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Which sessions and sides of a participant are compared; by default the first session."""

    longitudinal: bool = False
    """All sessions, by a mixed model."""
    pair: tuple[str, str] | None = None
    """Two sessions, with ``ses-``: the second minus the first is analyzed."""
    asymmetry: bool = False
    """Also left minus right."""
    normative: tuple[str, str] | None = None
    """Factor and level of the group against which each participant is scored."""

    @property
    def suffix(self) -> str:
        """What tells folders of results of the same formula apart."""
        if self.pair:
            return f"_change-{'-'.join(one.removeprefix('ses-') for one in self.pair)}"
        return "_longitudinal" if self.longitudinal else ""

    def __post_init__(self) -> None:
        if self.longitudinal and self.pair:
            raise UsageError(
                "give --longitudinal (all sessions) or --paired (two), not both",
                reason="session-choice",
            )
        if self.longitudinal and self.normative:
            raise UsageError(
                "w-scores need one visit per participant, as others of the same participant would"
                " be in the reference; leave --longitudinal out, or use --paired",
                reason="session-choice",
            )


def choose_visits(cohort: Cohort, comparison: Comparison) -> tuple[Cohort, Mapping[str, str]]:
    """Keep the visits that are compared."""
    table = cohort.table
    if comparison.longitudinal:
        return cohort, {}
    if comparison.pair is None:
        keep = ~table[PARTICIPANT].duplicated().to_numpy()
        why = pd.Series("the first session of each participant is analyzed", index=table.index)
    else:
        known = sorted(table[SESSION].dropna().unique())
        if unknown := sorted(set(comparison.pair) - set(known)):
            raise ModelError(
                f"there is no session {listed(unknown)}, only {listed(known) or 'none'}",
                reason="unknown-level",
            )
        asked = table[SESSION].isin(comparison.pair)
        both = asked.groupby(table[PARTICIPANT]).transform("sum") == len(comparison.pair)
        keep = (asked & both).to_numpy()
        why = pd.Series("the other session of the pair is missing", index=table.index)
        why[~asked] = f"sessions {' and '.join(comparison.pair)} are compared"
        if not keep.any():
            raise ModelError(
                f"no participant has both sessions {' and '.join(comparison.pair)}; choose two"
                " others",
                reason="one-session",
            )
    return cohort.take(keep), dict(why[~keep])


def modeled_table(table: pd.DataFrame, comparison: Comparison) -> pd.DataFrame:
    """Rows of the model: visits, or participants with the covariates of their first session."""
    if comparison.pair is None:
        return table
    first = table[table[SESSION] == comparison.pair[0]]
    return first.set_axis(first[PARTICIPANT])


def compare_sessions(cohort: Cohort, comparison: Comparison) -> Cohort:
    """Take differences of two sessions, if that is what is compared."""
    if comparison.pair is None:
        return cohort
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
            sides[hemi] = _change(side, common, first[a], second[b])
    if not sides:
        raise ModelError(
            f"no hemisphere was measured in both sessions {' and '.join(comparison.pair)}",
            reason="one-session",
        )
    return replace(cohort, table=table, sides=sides)


def _change(side: SideMaps, rows: Int, first: Int, second: Int) -> SideMaps:
    summary = side.summary.iloc[second].to_numpy() - side.summary.iloc[first].to_numpy()
    return replace(
        side,
        rows=rows,
        maps={name: m[second] - m[first] for name, m in side.maps.items()},
        subfield=side.subfield[first],
        summary=pd.DataFrame(summary, columns=side.summary.columns),
    )


def asymmetry_name(measure: str) -> str:
    """Name of the map of left minus right."""
    return f"{measure}_asymmetry"


def asymmetry_maps(cohort: Cohort, measures: Sequence[str], relative: Sequence[str]) -> SideMaps:
    """Left minus right at each point, of those who have both."""
    if set(cohort.sides) != set(BOTH):
        raise ModelError(
            f"asymmetry: hemisphere {', '.join(cohort.sides)} only; both are needed",
            reason="no-hemisphere",
        )
    left, right = (cohort.sides[hemi] for hemi in BOTH)
    if left.shape != right.shape:
        raise ModelError(
            f"asymmetry: maps of {', '.join(measures)} have different numbers of points left and"
            " right",
            reason="mixed-grids",
        )
    rows, a, b = np.intersect1d(left.rows, right.rows, return_indices=True)
    if not len(rows):
        raise ModelError("asymmetry: no participant has both hemispheres", reason="no-hemisphere")
    names = tuple(dict.fromkeys((*left.names, *right.names)))
    codes = np.array([*(names.index(name) for name in left.names), -1], dtype=np.int8)
    return SideMaps(
        rows=rows,
        maps={
            asymmetry_name(name): asymmetry(
                left.maps[name][a], right.maps[name][b], relative=name in relative
            )
            for name in measures
        },
        subfield=codes[left.subfield[a]],
        names=names,
        summary=pd.DataFrame(index=range(len(rows))),
        mesh=left.mesh,
    )
