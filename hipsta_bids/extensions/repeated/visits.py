"""Visits as categories: all sessions, or the baseline and later sessions of a trial."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids.errors import ModelError, UsageError, did_you_mean
from hipsta_bids.extensions.repeated.longitudinal import Longitudinal
from hipsta_bids.extensions.repeated.methods import visits_text
from hipsta_bids.extensions.repeated.mmrm import visit_model
from hipsta_bids.extensions.repeated.pair import check_sessions
from hipsta_bids.group.cohort.covariates import order_sessions
from hipsta_bids.group.model import Cite, Groups, VisitTime
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.stats.arrays import Bool, SideMaps, some_sheets
from hipsta_bids.stats.design import VISIT, Design
from hipsta_bids.stats.glm import PointwiseFit, RowModel
from hipsta_bids.stats.grammar import closed_formula
from hipsta_bids.types import PARTICIPANT, SESSION

#: Analyses of end points: adjusted for the baseline as a covariate, or with equal arms there.
_ENDPOINTS = ("ancova", "mmrm", "clda")
#: What cannot be done with visits as categories.
_EXCLUDED = ("--correction by permutation", "--joint", "map() in the formula")


class Visits(Longitudinal):
    """All sessions, as categories with any covariance."""

    def excludes(self) -> Mapping[str, Sequence[str]]:
        """Return flags, and the flags beside which they are refused."""
        return {"--longitudinal visits": _EXCLUDED}

    def with_visits(self, time: VisitTime, settings: GroupSettings) -> VisitTime:
        """Make a factor of the sessions, in the column ``visit``; a single one is none."""
        return self.categorized(time, order_sessions(time.table, settings))

    def categorized(self, time: VisitTime, sessions: Sequence[str], skipped: int = 0) -> VisitTime:
        """Make a factor of these sessions; the first ones may have no rows in the model."""
        labels = (
            time.table[SESSION]
            .astype(object)
            .map(lambda name: str(name or "").removeprefix("ses-"))
        )
        order = [name.removeprefix("ses-") for name in sessions]
        if "" in set(labels) or len(order) < 2:  # noqa: PLR2004 -- visits to compare
            raise ModelError("visits as categories need two sessions, with labels (ses-LABEL)")
        table = time.table.assign(**{VISIT: pd.Categorical(labels, categories=order)})
        after = tuple(order[skipped:])
        return replace(time, table=table, column=VISIT if len(after) > 1 else None, labels=after)

    def row_models(
        self,
        table: pd.DataFrame,
        time: str | None,
        groups: Groups | None,
        settings: GroupSettings,
    ) -> Callable[[Design], RowModel]:
        """Return what makes the model of the visits of a design."""
        return partial(
            visit_model,
            table=table,
            settings=settings.glm,
            longitudinal=settings.longitudinal,
            arms=self.find_arms(groups),
        )

    def find_arms(self, groups: Groups | None) -> str | None:
        """Return the column of arms that do not differ at the first visit; ``None`` if any do."""
        return None

    def contrasts(
        self, groups: Groups | None, visits: VisitTime | None, bends: Sequence[str]
    ) -> list[str]:
        """Return contrasts of the default model."""
        if visits is None or visits.column is None:
            return super().contrasts(groups, visits, bends)
        return [*self.of_visits(groups.contrasts() if groups else [], visits.labels), *bends]

    def visit_contrasts(
        self, formula: str, groups: Groups | None, visits: VisitTime | None
    ) -> list[str] | None:
        """Return contrasts of visits in a user's formula; ``None`` without these."""
        if visits is None or VISIT not in closed_formula(formula).names:
            return None
        return self.of_visits(groups.contrasts() if groups else [], visits.labels)

    def of_visits(self, groups: Sequence[str], labels: Sequence[str]) -> list[str]:
        """Return contrasts of changes since the first visit, from contrasts of groups."""
        first, *after = labels
        changes = {f"change to {name}": f"{VISIT}[{name}] - {VISIT}[{first}]" for name in after}
        if not groups:
            return [f"{name} = {change}" for name, change in changes.items()]
        terms = {name: f"({change})" for name, change in changes.items()}
        return [*groups, *_by_visit(groups, terms)]

    def references(self, formula: str, visits: VisitTime | None) -> dict[str, str]:
        """Return the first visit as reference level."""
        is_modeled = visits is not None and VISIT in closed_formula(formula).names
        return {VISIT: visits.labels[0]} if visits is not None and is_modeled else {}

    def words(self) -> tuple[str, str, str]:
        """Return the kind of model, its subject if that is not the maps, and Cohen's d."""
        return "linear model", "", "the estimate divided by the root of the mean variance of visits"

    def methods(
        self,
        model: RowModel,
        fits: Sequence[PointwiseFit],
        settings: GroupSettings,
        cite: Cite,
    ) -> str:
        """Return sentences of the methods on visits, and on the baseline."""
        endpoint = self.record()["endpoint"]
        return visits_text(endpoint, fits, settings.longitudinal, cite)


@dataclass(frozen=True)
class Trial(Visits):
    """The baseline and later sessions of a trial."""

    has_changes = False
    is_classified = False
    reason = "other-session"
    kind: str
    """``ancova``, ``mmrm`` or ``clda``."""
    sessions: tuple[str, ...]
    """The baseline's session, and later ones, with ``ses-``."""

    def __post_init__(self) -> None:
        is_known, count = self.kind in _ENDPOINTS, len(self.sessions)
        if not is_known or len(set(self.sessions)) < count or count < 2:  # noqa: PLR2004 -- a later
            hint = "" if is_known else did_you_mean([self.kind], _ENDPOINTS)
            raise UsageError(
                f"--endpoint {' '.join((self.kind, *self.sessions))}: give ancova, mmrm or clda,"
                f" the session of the baseline, and later sessions{hint}"
            )
        if self.kind == "ancova" and count > 2:  # noqa: PLR2004 -- a later
            raise UsageError("--endpoint ancova has one later session; use mmrm for several")

    @property
    def baseline(self) -> str:
        """The baseline's session."""
        return self.sessions[0]

    @property
    def is_adjusted(self) -> bool:
        """Whether the baseline is a covariate, and not a row."""
        return self.kind != "clda"

    @property
    def suffix(self) -> str:
        """The part of names that distinguishes folders of results of one formula."""
        names = (name.removeprefix("ses-") for name in self.sessions)
        return f"_{'-'.join((self.kind, *names))}"

    def record(self) -> dict[str, Any]:
        """Return the entries of the record."""
        return {**super().record(), "endpoint": (self.kind, *self.sessions)}

    def excludes(self) -> Mapping[str, Sequence[str]]:
        """Return flags, and the flags beside which they are refused."""
        return {"--endpoint": _EXCLUDED}

    def choose(self, table: pd.DataFrame) -> tuple[Bool, pd.Series]:
        """Choose the visits of the trial, of participants with a baseline if it is a covariate."""
        check_sessions(table, self.sessions, "--endpoint")
        in_trial = table[SESSION].isin(self.sessions).to_numpy()
        first = table[PARTICIPANT][table[SESSION] == self.baseline]
        keep = in_trial & (table[PARTICIPANT].isin(first).to_numpy() | (not self.is_adjusted))
        reasons = pd.Series("the session of the baseline is missing", index=table.index)
        reasons[~in_trial] = f"sessions {' and '.join(self.sessions)} are compared"
        return keep, reasons

    def with_visits(self, time: VisitTime, settings: GroupSettings) -> VisitTime:
        """Make a factor of the sessions, in the column ``visit``; a single one is none."""
        return self.categorized(time, self.sessions, skipped=int(self.is_adjusted))

    def rows(self, table: pd.DataFrame) -> pd.DataFrame:
        """Return visits, without the baseline if it is a covariate."""
        return table[(table[SESSION] != self.baseline).to_numpy()] if self.is_adjusted else table

    def compare(
        self, table: pd.DataFrame, sides: Mapping[str, SideMaps], covariates: Sequence[str]
    ) -> Mapping[str, SideMaps]:
        """Return maps of the rows, with the values of the baseline if these are covariates."""
        if not self.is_adjusted:
            return super().compare(table, sides, covariates)
        row_of = {visit: row for row, visit in enumerate(self.rows(table).index)}
        compared = {}
        for hemi, side in sides.items():
            visits = table.iloc[side.rows]
            is_first = (visits[SESSION] == self.baseline).to_numpy()
            people = visits[PARTICIPANT]
            sheet_of = dict(zip(people[is_first], np.flatnonzero(is_first), strict=True))
            has_first = ~is_first & people.isin(sheet_of).to_numpy()
            if has_first.any():
                rows = np.array([row_of[visit] for visit in visits.index[has_first]])
                sheets = np.array([sheet_of[person] for person in people[has_first]])
                first = replace(
                    side,
                    rows=rows,
                    maps=some_sheets(side.maps, sheets),
                    subfield=side.subfield[sheets],
                    unmasked=None,
                    summary=side.summary.iloc[sheets].reset_index(drop=True),
                )
                compared[hemi] = replace(side.sheets(has_first), rows=rows, first=first)
        if sides and not compared:
            raise ModelError(f"no hemisphere was measured in {self.baseline} and later")
        return compared

    def described(self, rows: pd.DataFrame, table: pd.DataFrame) -> pd.DataFrame:
        """Return visits of the participants, with the baselines first."""
        if self.is_adjusted:
            rows = table[table[PARTICIPANT].isin(rows[PARTICIPANT])]
        return rows.iloc[np.argsort(rows[SESSION].ne(self.baseline).to_numpy(), kind="stable")]

    def find_arms(self, groups: Groups | None) -> str | None:
        """Return the column of arms that do not differ at the first visit."""
        return None if self.is_adjusted or groups is None else groups.column

    def of_visits(self, groups: Sequence[str], labels: Sequence[str]) -> list[str]:
        """Return differences of groups at each later visit."""
        names = labels if self.is_adjusted else labels[1:]
        return list(_by_visit(groups, {name: f"{VISIT}[{name}]" for name in names}))


def _by_visit(groups: Sequence[str], terms: Mapping[str, str]) -> Iterator[str]:
    """Yield contrasts of groups in terms of visits."""
    pairs = [contrast.split(" = ") for contrast in groups]
    return (f"{name} in {p} = ({d}):{term}" for name, term in terms.items() for p, d in pairs)
