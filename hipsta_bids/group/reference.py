"""What a reference cohort says about measures: agreement of sessions, means, changes, variances."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import stats

from hipsta_bids.errors import ModelError
from hipsta_bids.group.analysis import mean_of_known
from hipsta_bids.group.covariates import VisitTime
from hipsta_bids.group.data import PARTICIPANT, SESSION, Bool, Cohort, Float, Int, SideMaps
from hipsta_bids.group.formula import listed, model_from_shortcut, parse_model
from hipsta_bids.group.glm import FittedMaps, PointwiseFit, RowModel, fit_maps, most_frequent
from hipsta_bids.group.mixed import longitudinal_model
from hipsta_bids.group.model import ModelRequest, build_design, default_formula
from hipsta_bids.group.settings import GroupSettings, RetestSettings
from hipsta_bids.group.summaries import (
    fit_summaries,
    hemispheres,
    participants_with,
    summary_values,
)

#: Months per unit of columns of time with these names.
_MONTHS = {"years": 12.0, "months": 1.0, "days": 12 / 365.25}
#: Sessions that tell a participant's change from noise.
_SLOPE_SESSIONS = 3

Tables = Mapping[str, Mapping[str, Any]]
"""Columns of the tables of each question, ``retest`` and ``power``."""


#: Smallest detectable change over the within-subject SD, for 95 % of changes by chance.
DETECTABLE = 1.96 * np.sqrt(2)


@dataclass(frozen=True, kw_only=True)
class Repeatability:
    """How well values of the same participants agree; NaN where it cannot be told."""

    n: Int
    """(points,) participants with a value in all sessions."""
    mean: Float
    """(points,) in units of the map."""
    between: Float
    """(points,) SD between participants, of their true values."""
    within: Float
    """(points,) SD within participants, differences between sessions included."""
    within_limits: Float
    """(2, points)"""
    icc: Float
    """(points,) ICC(2,1): two-way random effects, absolute agreement, single measurement."""
    icc_limits: Float
    """(2, points)"""
    p_sessions: Float
    """(points,) of the F test that sessions have the same mean."""

    @property
    def detectable(self) -> Float:
        """(points,) smallest change in one participant that measurement hardly explains."""
        return np.asarray(DETECTABLE * self.within)


def repeatability(values: Float, *, confidence: float = 0.95, least: int = 3) -> Repeatability:
    """Split the variance of values (participants, sessions, points) between and within people.

    Where one session is missing, the participant is left out at that point; points with fewer
    complete participants than ``least`` are NaN. The within-subject SD is the root of the mean
    variance of a participant's values (Bland and Altman 1996), its limits those of chi squared.
    ICC(2,1) is that of Shrout and Fleiss (1979), with the limits of McGraw and Wong (1996, table 7,
    ICC(A,1)).
    """
    k = values.shape[1]
    complete: Bool = np.asarray(np.isfinite(values).all(axis=1))
    n = complete.sum(axis=0)
    usable = n >= max(least, 2)
    size = np.where(usable, n, 2).astype(np.float64)
    known = np.where(complete[:, None], values, 0.0)
    grand = known.sum(axis=(0, 1)) / (size * k)
    people = known.mean(axis=1)
    sessions = known.sum(axis=0) / size
    rest = np.where(complete[:, None], known - people[:, None] - sessions + grand, 0.0)
    rows = k * np.where(complete, (people - grand) ** 2, 0.0).sum(axis=0) / (size - 1)
    columns = size * ((sessions - grand) ** 2).sum(axis=0) / (k - 1)
    error = (rest**2).sum(axis=(0, 1)) / ((size - 1) * (k - 1))
    usable &= error > 0
    rows, columns, error = (np.where(usable, one, np.nan) for one in (rows, columns, error))
    freedom = size * (k - 1)
    within = np.sqrt(((k - 1) * columns + (size - 1) * (k - 1) * error) / freedom)
    tails = np.array([[(1 + confidence) / 2], [(1 - confidence) / 2]])
    icc = (rows - error) / (rows + (k - 1) * error + k * (columns - error) / size)
    return Repeatability(
        n=n,
        mean=np.where(usable, grand, np.nan),
        between=np.sqrt(np.maximum((rows - error) / k, 0.0)),
        within=within,
        within_limits=within * np.sqrt(freedom / stats.chi2.ppf(tails, freedom)),
        icc=icc,
        icc_limits=_icc_limits(icc, rows, columns, error, n=size, k=k, tails=tails),
        p_sessions=stats.f.sf(columns / error, k - 1, (size - 1) * (k - 1)),
    )


def _icc_limits(
    icc: Float, rows: Float, columns: Float, error: Float, *, n: Float, k: int, tails: Float
) -> Float:
    """Limits of ICC(A,1) from mean squares, with Satterthwaite's degrees of freedom."""
    a = k * icc / (n * (1 - icc))
    b = 1 + k * icc * (n - 1) / (n * (1 - icc))
    mixed = a * columns + b * error
    freedom = mixed**2 / ((a * columns) ** 2 / (k - 1) + (b * error) ** 2 / ((n - 1) * (k - 1)))
    down = stats.f.ppf(tails[0], n - 1, freedom)
    up = stats.f.ppf(tails[0], freedom, n - 1)
    other = k * columns + (k * n - k - n) * error
    low = n * (rows - down * error) / (down * other + n * rows)
    high = n * (up * rows - error) / (other + n * up * rows)
    return np.stack([low, high])


@dataclass(frozen=True, eq=False, kw_only=True)
class RetestCohort:
    """Participants who have all sessions."""

    cohort: Cohort
    """Their visits."""
    participants: tuple[str, ...]
    sessions: tuple[str, ...]
    left_out: Mapping[str, str]
    """By visit, what is missing."""

    def arrange(self, values: Float, rows: Int) -> Float:
        """Arrange values of visits as (participants, sessions, points); NaN where missing."""
        visits = self.cohort.table.iloc[rows]
        filled = np.full((len(self.participants), len(self.sessions), values.shape[1]), np.nan)
        who = np.searchsorted(self.participants, visits[PARTICIPANT].astype(str))
        when = np.searchsorted(self.sessions, visits[SESSION].astype(str))
        filled[who, when] = values
        return filled


def retest_cohort(cohort: Cohort, least: int) -> RetestCohort:
    """Keep the participants who have every session that occurs, or say which sessions to name."""
    table = cohort.table
    counts = table[SESSION].fillna("").value_counts().sort_index()
    sessions = tuple(str(name) for name in counts.index if name)
    own = table[PARTICIPANT].map(table.groupby(PARTICIPANT)[SESSION].nunique())
    complete = (own == len(sessions)).to_numpy()
    n = int(table.loc[complete, PARTICIPANT].nunique())
    found = listed([f"{name or 'without a name'} ({count})" for name, count in counts.items()])
    if len(sessions) < 2:  # noqa: PLR2004 -- two sessions
        raise ModelError(
            f"--retest: there is no second session, only {found}; measure repeated sessions first",
            reason="one-session",
        )
    if n < least:
        raise ModelError(
            f"--retest: {n} participants have all of the sessions {found}, at least {least} are"
            " needed; name sessions that more have by --session-label",
            reason="few-sessions",
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


def retest_columns(found: Repeatability) -> Mapping[str, Float | Int]:
    """Columns of the tables of test-retest."""
    return {
        "n": found.n,
        "mean": found.mean,
        "sd_between": found.between,
        "sd_within": found.within,
        "sd_within_low": found.within_limits[0],
        "sd_within_high": found.within_limits[1],
        "icc": found.icc,
        "icc_low": found.icc_limits[0],
        "icc_high": found.icc_limits[1],
        "detectable_change": found.detectable,
        "p_sessions": found.p_sessions,
    }


def retest_text(one: RetestCohort, settings: RetestSettings, cite: Callable[[str], str]) -> str:
    """Word how agreement was measured."""
    return (
        f"Agreement between {len(one.sessions)} sessions of {len(one.participants)} participants"
        " was estimated at each point of the maps and for each summary measure. The"
        " within-subject standard deviation is the root of the mean variance of a participant's"
        f" values {cite('bland')}; a change beyond 1.96 √2 times this is unlikely to be measurement"
        f" alone (minimal detectable change {cite('weir')}). The intraclass correlation is"
        " ICC(2,1), of two-way random effects, absolute agreement and single measurements"
        f" {cite('shrout')}, with {settings.confidence:.0%} limits {cite('mcgraw')}. It depends on"
        " how much these participants differ; the within-subject standard deviation does not."
    )


@dataclass(frozen=True, kw_only=True)
class Reference:
    """What a reference cohort says about some measures or points."""

    n: NDArray[np.int64]
    """Participants with a value."""
    mean: Float
    """In units of the measure."""
    variance: Float
    """Between participants at one visit, or with several visits within participants."""
    freedom: Float
    """Degrees of freedom of the variance, about."""
    slope: Float | None = None
    """Change per month."""
    slope_limits: Float | None = None
    """(2, points)"""
    slope_variance: Float | None = None
    """Of true changes per month between participants; None if they are taken to change alike."""


def place_of(side: SideMaps) -> FittedMaps:
    """Locate the points of maps of one hemisphere, to which nothing was fitted."""
    every = np.arange(len(side.rows))
    subfield = most_frequent(side.subfield[:], len(side.names))
    return FittedMaps(maps=side, used=every, rows=every, subfield=subfield, fits={})


class Retested:
    """Means and variances of repeated sessions."""

    time: str | None = None

    def __init__(
        self, retest: RetestCohort, settings: GroupSettings, *, repeated: bool = False
    ) -> None:
        self.retest = retest
        self._repeated, self._how = repeated, settings.retest

    def place(self, _: str, side: SideMaps) -> FittedMaps:
        """Locate the points of maps of one hemisphere."""
        return place_of(side)

    def of_map(self, one: FittedMaps, measure: str) -> tuple[Tables, Reference]:
        """Describe the points of one map."""
        return self._describe(one.maps.rows, one.values(measure))

    def of_summaries(
        self, cohort: Cohort, only: Sequence[str] | None
    ) -> Iterator[tuple[str, tuple[str, ...], Float, Tables, Reference]]:
        """Describe summary measures of each hemisphere, and of the mean of both."""
        for hemi in hemispheres(cohort):
            values = summary_values(cohort, hemi, only)
            values = values.loc[:, (values.max() > values.min()).to_numpy()]
            numbers = values.to_numpy(dtype=np.float64)
            if numbers.size:
                found = self._describe(np.arange(len(numbers)), numbers)
                yield hemi, tuple(map(str, values.columns)), numbers, *found

    def _describe(self, rows: Int, values: Float) -> tuple[Tables, Reference]:
        agreed = repeatability(
            self.retest.arrange(values, rows),
            confidence=self._how.confidence,
            least=self._how.min_participants,
        )
        # Of one visit, the variance between and within; of several, that within.
        freedom = agreed.n * (len(self.retest.sessions) - 1) if self._repeated else agreed.n - 1
        reference = Reference(
            n=agreed.n,
            mean=agreed.mean,
            variance=agreed.within**2 + (0.0 if self._repeated else agreed.between**2),
            freedom=np.maximum(freedom, 1.0),
        )
        return {"retest": retest_columns(agreed)}, reference

    def words(self, cite: Callable[[str], str]) -> str:
        """Name what means and variances rest on."""
        text = f"these repeated sessions {cite('bland')}"
        if self._repeated:
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
        self.model = RowModel(replace(design, contrasts=()))
        if self.time is not None:
            slopes = settings.changed(longitudinal={"random": "slope"})
            self.model = longitudinal_model(design, table, self.time, slopes)

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

    def place(self, hemi: str, side: SideMaps) -> FittedMaps:
        """Fit the model at the points of maps of one hemisphere."""
        return fit_maps(hemi, side, self.model, self._settings)

    def of_map(self, one: FittedMaps, measure: str) -> tuple[Tables, Reference]:
        """Describe the points of one map."""
        rows = one.maps.rows[one.used]
        return {}, self._reference(rows, one.values(measure), one.fits[measure])

    def of_summaries(
        self, cohort: Cohort, only: Sequence[str] | None
    ) -> Iterator[tuple[str, tuple[str, ...], Float, Tables, Reference]]:
        """Describe summary measures of each hemisphere, and of the mean of both."""
        fits, _ = fit_summaries(
            cohort,
            self.spec,
            self.model.design,
            self._settings,
            only=only,
            references={},
            icv=None,
            rows_of=lambda _: self.model,
        )
        rows = self.model.design.rows
        for one in fits:
            values = summary_values(cohort, one.hemi, one.measures)[list(one.measures)]
            numbers = values.to_numpy(dtype=np.float64)[rows]
            reference = self._reference(rows, numbers, one.fit)
            yield one.hemi, one.measures, numbers, {}, reference

    def _reference(self, rows: Int, values: Float, fit: PointwiseFit) -> Reference:
        """At one visit with the residual variance; over time with changes and both variances."""
        who = self._table[PARTICIPANT].iloc[rows].to_numpy()
        n = participants_with(np.isfinite(values), who)
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
            f" {', '.join(settings.longitudinal.time_columns)}, acq_time or age in sessions.tsv",
            reason="no-time",
        )
    if table[PARTICIPANT].value_counts().max() < _SLOPE_SESSIONS:
        raise ModelError(
            "--power with --visits: no participant of the reference has three sessions, so that"
            " changes cannot be told from noise; leave --visits out, or give --retest",
            reason="few-sessions",
        )
