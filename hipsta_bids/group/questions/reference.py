"""What a reference cohort says about measures: agreement of sessions, means, changes, variances."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from hipsta_bids.errors import ModelError
from hipsta_bids.group.cohort.data import Cohort, Layer, participants_with
from hipsta_bids.group.design.formula import listed, model_from_shortcut, parse_model
from hipsta_bids.group.design.model import ModelRequest, VisitTime, build_design, default_formula
from hipsta_bids.group.design.settings import GroupSettings
from hipsta_bids.group.output.results import RetestCohort
from hipsta_bids.group.stats.arrays import Float, Int, SideMaps, mean_of_known
from hipsta_bids.group.stats.glm import FittedMaps, PointwiseFit, RowModel, fit_maps, most_frequent
from hipsta_bids.group.stats.mixed import longitudinal_model
from hipsta_bids.group.stats.trials import Reference, repeatability
from hipsta_bids.types import PARTICIPANT, SESSION

#: Months per unit of columns of time with these names.
_MONTHS = {"years": 12.0, "months": 1.0, "days": 12 / 365.25}
#: Sessions that tell a participant's change from noise.
_SLOPE_SESSIONS = 3

Tables = Mapping[str, Mapping[str, Any]]
"""Columns of the tables of each question, ``retest`` and ``power``."""


def retest_cohort(cohort: Cohort, least: int) -> RetestCohort:
    """Keep the participants who have every session that occurs, or say which sessions to name."""
    table = cohort.table
    counts = table[SESSION].fillna("").value_counts().sort_index()
    sessions = tuple(str(name) for name in counts.index if name)
    session_counts = table[PARTICIPANT].map(table.groupby(PARTICIPANT)[SESSION].nunique())
    complete = (session_counts == len(sessions)).to_numpy()
    n = int(table.loc[complete, PARTICIPANT].nunique())
    sessions_text = listed(
        [f"{name or 'without a name'} ({count})" for name, count in counts.items()]
    )
    if len(sessions) < 2:  # noqa: PLR2004 -- two sessions
        raise ModelError(
            f"--retest: there is no second session, only {sessions_text}; measure repeated sessions"
            " first"
        )
    if n < least:
        raise ModelError(
            f"--retest: {n} participants have all of the sessions {sessions_text}, at least {least}"
            " are needed; name sessions that more have by --session-label"
        )
    lacking = {
        str(visit): "the participant lacks one of the sessions " + " ".join(sessions)
        for visit in table.index[~complete]
    }
    return RetestCohort(
        cohort=cohort.take(complete),
        participants=tuple(sorted(table.loc[complete, PARTICIPANT].unique())),
        sessions=sessions,
        left_out=lacking,
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class Described:
    """What is known of a layer."""

    layer: Layer
    tables: dict[str, Mapping[str, Any]]
    """Columns of the tables of each question, ``retest`` and ``power``."""
    reference: Reference
    data: Float
    """(rows, points) that it rests on."""
    points: FittedMaps | None
    """Where the points are; ``None`` for a summary measure."""


def points_of(side: SideMaps) -> FittedMaps:
    """Locate the points of maps of one hemisphere, to which nothing was fitted."""
    rows = np.arange(len(side.rows))
    subfield = most_frequent(side.subfield[:], len(side.names))
    return FittedMaps(maps=side, used=rows, rows=rows, subfield=subfield, fits={})


class Retested:
    """Means and variances of repeated sessions."""

    time: str | None = None

    rows: Int | None = None
    """Rows of the table of which summary measures are taken; all."""

    def __init__(
        self, retest: RetestCohort, settings: GroupSettings, *, has_visits: bool = False
    ) -> None:
        """Take variances of one visit of a trial, or of several."""
        self.retest = retest
        self._has_visits, self._settings = has_visits, settings.retest

    def describe(self, layer: Layer) -> Described:
        """Describe the agreement of sessions at each point, and mean and variance."""
        data = layer.data
        agreed = repeatability(
            self.retest.arrange(data, layer.rows),
            confidence=self._settings.confidence,
            least=self._settings.min_participants,
        )
        # Of one visit, the variance between and within; of several, that within.
        n = agreed["n"]
        freedom = n * (len(self.retest.sessions) - 1) if self._has_visits else n - 1
        between = 0.0 if self._has_visits else agreed["sd_between"] ** 2
        reference = Reference(
            n=n,
            mean=agreed["mean"],
            variance=agreed["sd_within"] ** 2 + between,
            freedom=np.maximum(freedom, 1.0),
        )
        return Described(
            layer=layer,
            tables={"retest": agreed},
            reference=reference,
            data=data,
            points=points_of(layer.source) if isinstance(layer.source, SideMaps) else None,
        )

    def words(self, cite: Callable[[str], str]) -> str:
        """Name what means and variances rest on."""
        text = f"these repeated sessions {cite('bland')}"
        if self._has_visits:
            text += (
                "; true changes were taken to be the same in all participants, so that the numbers"
                " are lower limits"
            )
        return text


class Modeled:
    """Means, changes and variances of a cohort, by a model of its visits."""

    def __init__(
        self,
        cohort: Cohort,
        request: ModelRequest,
        settings: GroupSettings,
        visits: VisitTime | None = None,
    ) -> None:
        table, covariates = cohort.table, None
        self.time: str | None = None
        if visits is not None:
            self.time, covariates = visits.column, visits.covariates
            _check_times(table, self.time, settings)
        formula = request.formula or default_formula(
            table, None, settings, covariates=covariates, time=self.time
        )
        contrasts = [self.time] if self.time else []
        self.spec = parse_model(model_from_shortcut(formula, contrasts, "reference"))
        design = build_design(table, self.spec, settings.design, dict(request.references))
        self._table, self._settings = table, settings
        self.model = RowModel(replace(design, contrasts=()), settings.glm)
        if self.time is not None:
            slopes = settings.longitudinal.changed(random="slope")
            self.model = longitudinal_model(design, table, self.time, settings.glm, slopes)

    @property
    def months(self) -> float:
        """Months per unit of time."""
        return _MONTHS.get(str(self.time).casefold(), self._settings.power.months_per_time)

    @property
    def follow_up(self) -> float:
        """Months from the earliest to the latest visit."""
        if self.time is None:
            return 0.0
        times = self._table[self.time].to_numpy(dtype=np.float64)
        return float(np.ptp(times[np.isfinite(times)])) * self.months

    @property
    def rows(self) -> Int:
        """Rows of the table of which summary measures are taken: those of the model."""
        return self.model.design.rows

    def describe(self, layer: Layer) -> Described:
        """Fit the model, and describe mean, change and variances at each point."""
        points = None
        if isinstance(layer.source, SideMaps):
            points = fit_maps(layer.hemi, layer.source, self.model)
            data, fit = points.values(layer.measure), points.fits[layer.measure]
            rows = layer.rows[points.used]
        else:
            rows, data = layer.rows, layer.data
            rows_known = np.flatnonzero(np.isfinite(data[:, 0]))
            contrasts = self.model.design.contrasts
            fit = self.model.fit_measures(data[rows_known], rows_known, contrasts)
        return Described(
            layer=layer,
            tables={},
            reference=self._reference(rows, data, fit),
            data=data,
            points=points,
        )

    def _reference(self, rows: Int, values: Float, fit: PointwiseFit) -> Reference:
        """At one visit with the residual variance; over time with changes and both variances."""
        participants = self._table[PARTICIPANT].iloc[rows].to_numpy()
        n = participants_with(np.isfinite(values), participants)
        plain = Reference(
            n=n,
            mean=mean_of_known(values, 0),
            variance=fit.sigma**2,
            freedom=np.maximum(n - float(len(self.model.design.columns)), 1.0),
        )
        if self.time is None:
            return plain
        (test,) = (one for one in fit.tests if one.contrast.name == self.time)
        slope, se = test.estimate[0] / self.months, test.se[0] / self.months
        reach = stats.t.ppf((1 + self._settings.glm.confidence) / 2, test.df) * se
        return replace(
            plain,
            variance=fit.variances["residual"],
            slope=slope,
            slope_limits=np.stack([slope - reach, slope + reach]),
            slope_variance=fit.variances["slope"] / self.months**2,
        )

    def words(self, cite: Callable[[str], str]) -> str:
        """Name what means, changes and variances rest on."""
        model = f"`{self.spec.formula}`"
        if self.time is None:
            return f"these participants, after a linear model {model}"
        unit = "a month" if self.months == 1 else f"{self.months:.3g} months"
        return (
            f"these participants, by a linear mixed model {model} with intercepts and"
            f" slopes of participants {cite('mixed')}; a unit of {self.time} is {unit}"
        )


Source = Retested | Modeled


def _check_times(table: pd.DataFrame, time: str | None, settings: GroupSettings) -> None:
    """Refuse a reference in which change cannot be told from noise."""
    if time is None:
        raise ModelError(
            "--power with --visits needs the time of each session of the reference: a column"
            f" {', '.join(settings.longitudinal.time_columns)}, acq_time or age in sessions.tsv"
        )
    if table[PARTICIPANT].value_counts().max() < _SLOPE_SESSIONS:
        raise ModelError(
            "--power with --visits: no participant of the reference has three sessions, so that"
            " changes cannot be told from noise; leave --visits out, or give --retest"
        )
