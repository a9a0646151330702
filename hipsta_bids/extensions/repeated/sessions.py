"""Which sessions are compared: two, all by a mixed model or as categories, or those of a trial."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids.derivatives.names import natural_order
from hipsta_bids.errors import ModelError, UsageError, did_you_mean
from hipsta_bids.extensions.repeated.methods import random_effects, slopes_text, visits_text
from hipsta_bids.extensions.repeated.mmrm import visit_model
from hipsta_bids.group.cohort.covariates import order_sessions
from hipsta_bids.group.model import AllSessions, Cite, Groups, Sessions, VisitTime
from hipsta_bids.group.output.steps import COVARIATES
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.stats.arrays import Bool, Int, SideMaps, some_sheets
from hipsta_bids.stats.design import VISIT, Design
from hipsta_bids.stats.formula import listed
from hipsta_bids.stats.glm import PointwiseFit, RowModel
from hipsta_bids.stats.mixed import longitudinal_model
from hipsta_bids.types import PARTICIPANT, SESSION

#: Analyses of end points: adjusted for the baseline as a covariate, or with equal arms there.
_ENDPOINTS = ("ancova", "mmrm", "clda")
#: What cannot be done with visits as categories.
_EXCLUDED = ("--correction by permutation", "--joint", *COVARIATES)


def _check_sessions(table: pd.DataFrame, named: Sequence[str], option: str) -> None:
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
        return f"_change-{_label(self.first)}-{_label(self.second)}"

    @property
    def later(self) -> str:
        return self.second

    @property
    def subject(self) -> str:
        change = f" to the change from {self.first} to {self.second}"
        return f"{change}, with the covariates of {self.first}"

    def record(self) -> dict[str, Any]:
        return {**super().record(), "pair": (self.first, self.second)}

    def choose(self, table: pd.DataFrame) -> tuple[Bool, pd.Series]:
        pair = self.first, self.second
        _check_sessions(table, pair, "--paired")
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
        first = table[table[SESSION] == self.first]
        return first.set_axis(first[PARTICIPANT])

    def compare(
        self, table: pd.DataFrame, sides: Mapping[str, SideMaps], covariates: Sequence[str]
    ) -> Mapping[str, SideMaps]:
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
                baseline = {name: side.covariate(name)[first[a]] for name in covariates}
                compared[hemi] = replace(changes, covariates=baseline)
        if sides and not compared:
            raise ModelError(
                f"no hemisphere was measured in both sessions {self.first} and {self.second}"
            )
        return compared


class Longitudinal(AllSessions):
    """All sessions, with random intercepts or slopes of participants."""

    has_changes = True
    sd = "the standard deviation of single visits"

    @property
    def suffix(self) -> str:
        return "_longitudinal"

    def row_models(
        self, table: pd.DataFrame, time: str | None, groups: Groups | None, settings: GroupSettings
    ) -> Callable[[Design], RowModel]:
        return partial(
            longitudinal_model,
            table=table,
            time=time,
            settings=settings.glm,
            longitudinal=settings.longitudinal,
        )

    def check_default(self, table: pd.DataFrame, time: str | None, settings: GroupSettings) -> None:
        if not self.has_changes:
            return
        if not table[PARTICIPANT].duplicated().any():
            raise ModelError(
                "longitudinal model: no participant has a second session; remove --longitudinal"
            )
        if time is None:
            raise ModelError(
                "the default longitudinal model needs the time of each session: a column"
                f" {', '.join(settings.longitudinal.time_columns)}, acq_time or age in sessions.tsv"
            )

    def contrasts(
        self, groups: Groups | None, visits: VisitTime | None, bends: Sequence[str]
    ) -> list[str]:
        time = visits.column if visits else None
        if groups is None:
            return [*([time] if time else []), *bends]
        contrasts = super().contrasts(groups, visits, bends)
        if time is None:
            return contrasts
        slopes = {level: f"{groups.column}[T.{level}]:{time}" for level in groups.levels[1:]}
        contrasts.append(f"{time} in {groups.reference} = {time}")
        for level, slope in slopes.items():
            contrasts.append(f"{time} in {level} = {time} + {slope}")
            contrasts.append(f"{time} in {groups.reference}-{level} = -1*{slope}")
        return contrasts

    def methods(
        self, model: RowModel, fits: Sequence[PointwiseFit], settings: GroupSettings, cite: Cite
    ) -> str:
        return random_effects(model, cite)

    def findings(self, fits: Sequence[PointwiseFit], cite: Cite) -> str:
        return slopes_text(fits, cite)


@dataclass(frozen=True)
class Visits(Longitudinal):
    """All sessions, as categories with any covariance."""

    sd = "the root of the mean variance of visits"
    endpoint: tuple[str, ...] = ()
    """Of a trial: ``ancova``, ``mmrm`` or ``clda``, the baseline's session, and later ones."""

    @property
    def is_adjusted(self) -> bool:
        """Whether the baseline is a covariate, and not a row."""
        return self.endpoint[:1] in {("ancova",), ("mmrm",)}

    def record(self) -> dict[str, Any]:
        return {**super().record(), "endpoint": self.endpoint}

    def excludes(self) -> Mapping[str, Sequence[str]]:
        return {"--endpoint" if self.endpoint else "--longitudinal visits": _EXCLUDED}

    def with_visits(self, time: VisitTime, settings: GroupSettings) -> VisitTime:
        labels = time.table[SESSION].astype(object).map(lambda name: _label(str(name or "")))
        order = [*map(_label, self.endpoint[1:] or order_sessions(time.table, settings))]
        if "" in set(labels) or len(order) < 2:  # noqa: PLR2004 -- visits to compare
            raise ModelError("visits as categories need two sessions, with labels (ses-LABEL)")
        table = time.table.assign(**{VISIT: pd.Categorical(labels, categories=order)})
        after = tuple(order[int(self.is_adjusted) :])
        return replace(time, table=table, column=VISIT if len(after) > 1 else None, labels=after)

    def row_models(
        self, table: pd.DataFrame, time: str | None, groups: Groups | None, settings: GroupSettings
    ) -> Callable[[Design], RowModel]:
        arms = groups.column if groups and self.endpoint[:1] == ("clda",) else None
        rules = settings.longitudinal
        return partial(
            visit_model, table=table, settings=settings.glm, longitudinal=rules, arms=arms
        )

    def contrasts(
        self, groups: Groups | None, visits: VisitTime | None, bends: Sequence[str]
    ) -> list[str]:
        if visits is None or visits.column is None:
            return super().contrasts(groups, visits, bends)
        return [*self.of_visits(groups.contrasts() if groups else [], visits.labels), *bends]

    def of_visits(self, groups: Sequence[str], labels: Sequence[str]) -> list[str]:
        first, *after = labels
        changes = {f"change to {name}": f"{VISIT}[{name}] - {VISIT}[{first}]" for name in after}
        if not groups:
            tests = [f"{name} = {change}" for name, change in changes.items()]
            return [] if self.endpoint else tests
        terms = {name: f"({change})" for name, change in changes.items()}
        if self.endpoint:
            terms = {name: f"{VISIT}[{name}]" for name in (labels if self.is_adjusted else after)}
        pairs = [contrast.split(" = ") for contrast in groups]
        return [
            *([] if self.endpoint else groups),
            *(f"{name} in {p} = ({d}):{term}" for name, term in terms.items() for p, d in pairs),
        ]

    def methods(
        self, model: RowModel, fits: Sequence[PointwiseFit], settings: GroupSettings, cite: Cite
    ) -> str:
        return visits_text(self.endpoint, fits, settings.longitudinal, cite)


@dataclass(frozen=True)
class Trial(Visits):
    """The baseline and later sessions of a trial."""

    has_changes = False
    is_classified = False
    group_columns = ("arm", "treatment")
    reason = "other-session"

    def __post_init__(self) -> None:
        (kind, *sessions), is_known = self.endpoint, self.endpoint[0] in _ENDPOINTS
        count = len(set(sessions))
        if not is_known or count < max(len(sessions), 2):
            hint = "" if is_known else did_you_mean([kind], _ENDPOINTS)
            raise UsageError(
                f"--endpoint {' '.join(self.endpoint)}: give ancova, mmrm or clda, the session of"
                f" the baseline, and later sessions{hint}"
            )
        if kind == "ancova" and count > 2:  # noqa: PLR2004 -- with the baseline
            raise UsageError("--endpoint ancova has one later session; use mmrm for several")

    @property
    def baseline(self) -> str:
        """The baseline's session."""
        return self.endpoint[1]

    @property
    def suffix(self) -> str:
        return f"_{'-'.join(map(_label, self.endpoint))}"

    def choose(self, table: pd.DataFrame) -> tuple[Bool, pd.Series]:
        sessions = self.endpoint[1:]
        _check_sessions(table, sessions, "--endpoint")
        in_trial = table[SESSION].isin(sessions).to_numpy()
        first = table[PARTICIPANT][table[SESSION] == self.baseline]
        keep = in_trial & (table[PARTICIPANT].isin(first).to_numpy() | (not self.is_adjusted))
        reasons = pd.Series("the session of the baseline is missing", index=table.index)
        reasons[~in_trial] = f"sessions {' and '.join(sessions)} are compared"
        return keep, reasons

    def rows(self, table: pd.DataFrame) -> pd.DataFrame:
        return table[(table[SESSION] != self.baseline).to_numpy()] if self.is_adjusted else table

    def compare(
        self, table: pd.DataFrame, sides: Mapping[str, SideMaps], covariates: Sequence[str]
    ) -> Mapping[str, SideMaps]:
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
        if self.is_adjusted:
            rows = table[table[PARTICIPANT].isin(rows[PARTICIPANT])]
        return rows.iloc[np.argsort(rows[SESSION].ne(self.baseline).to_numpy(), kind="stable")]


def _label(session: str) -> str:
    return session.removeprefix("ses-")


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
