"""Repeated sessions without change between them: how repeatable measures and maps are."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy import stats

from hipsta_bids.errors import ModelError
from hipsta_bids.group.data import PARTICIPANT, SESSION, Bool, Cohort, Float, Int
from hipsta_bids.group.formula import listed
from hipsta_bids.group.settings import RetestSettings

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
    """Split the variance of repeated measurements into that between and that within participants.

    Parameters
    ----------
    values : array
        (participants, sessions, points); where one session is missing, the participant is left out
        at that point.
    confidence : float, optional
        Coverage of the limits.
    least : int, optional
        Points with fewer complete participants are NaN.

    Returns
    -------
    Repeatability
        The within-subject SD is the root of the mean variance of a participant's values (Bland and
        Altman 1996), its limits those of chi squared. ICC(2,1) is that of Shrout and Fleiss (1979),
        with the limits of McGraw and Wong (1996, table 7, ICC(A,1)).
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
