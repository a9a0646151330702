"""Two sessions of a participant: the second minus the first is analyzed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids.derivatives.names import natural_order
from hipsta_bids.errors import ModelError
from hipsta_bids.group.model import Sessions
from hipsta_bids.stats.arrays import Bool, Int, SideMaps
from hipsta_bids.stats.formula import listed
from hipsta_bids.types import PARTICIPANT, SESSION


def check_sessions(table: pd.DataFrame, named: Sequence[str], option: str) -> None:
    """Refuse sessions that a table of visits does not have."""
    sessions = sorted(table[SESSION].dropna().unique(), key=natural_order)
    if unknown := sorted(set(named) - set(sessions)):
        if not sessions:
            raise ModelError(f"{option}: no sessions in this dataset; remove it")
        raise ModelError(
            f"{option}: there is no session {listed(unknown)}, only {listed(sessions)}"
        )


@dataclass(frozen=True)
class Pair(Sessions):
    """Differences of two sessions, which have the ``ses-`` of their names."""

    has_changes = True
    reason = "other-session"
    first: str
    second: str

    @property
    def suffix(self) -> str:
        """The part of names that distinguishes folders of results of one formula."""
        return f"_change-{self.first.removeprefix('ses-')}-{self.second.removeprefix('ses-')}"

    @property
    def later(self) -> str:
        """The session from which the first one is subtracted."""
        return self.second

    def record(self) -> dict[str, Any]:
        """Return the entries of the record."""
        return {**super().record(), "pair": (self.first, self.second)}

    def choose(self, table: pd.DataFrame) -> tuple[Bool, pd.Series]:
        """Choose the visits of participants who have both sessions."""
        pair = self.first, self.second
        check_sessions(table, pair, "--paired")
        in_pair = table[SESSION].isin(pair)
        complete = in_pair.groupby(table[PARTICIPANT]).transform("sum") == len(pair)
        keep = (in_pair & complete).to_numpy()
        reasons = pd.Series("the other session of the pair is missing", index=table.index)
        reasons[~in_pair] = f"sessions {' and '.join(pair)} are compared"
        if not keep.any():
            raise ModelError(
                f"no participant has both sessions {' and '.join(pair)}; choose two other sessions"
            )
        return keep, reasons

    def rows(self, table: pd.DataFrame) -> pd.DataFrame:
        """Return participants, with the covariates of their first session."""
        first = table[table[SESSION] == self.first]
        return first.set_axis(first[PARTICIPANT])

    def compare(
        self, table: pd.DataFrame, sides: Mapping[str, SideMaps], covariates: Sequence[str]
    ) -> Mapping[str, SideMaps]:
        """Return differences; maps that are covariates are of the first session, as others are."""
        row_of = {participant: row for row, participant in enumerate(self.rows(table).index)}
        compared = {}
        for hemi, side in sides.items():
            visits = table.iloc[side.rows]
            rows = np.array([row_of[participant] for participant in visits[PARTICIPANT]])
            first, second = (
                np.flatnonzero((visits[SESSION] == session).to_numpy())
                for session in (self.first, self.second)
            )
            common, a, b = np.intersect1d(rows[first], rows[second], return_indices=True)
            if len(common):
                changes = _change(side, common, first[a], second[b])
                baseline = {name: side.maps[name][first[a]] for name in covariates}
                compared[hemi] = replace(changes, covariates=baseline)
        if sides and not compared:
            raise ModelError(
                f"no hemisphere was measured in both sessions {self.first} and {self.second}"
            )
        return compared

    def words(self) -> tuple[str, str, str]:
        """Return the kind of model, its subject, and Cohen's d."""
        kind, _, d = super().words()
        change = f" to the change from {self.first} to {self.second}"
        return kind, f"{change}, with the covariates of {self.first}", d


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
