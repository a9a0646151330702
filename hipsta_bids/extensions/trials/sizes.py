"""Sample size: how many participants a trial needs for an effect on a measure or at a point."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special, stats

from hipsta_bids.errors import ModelError, UsageError
from hipsta_bids.extensions.trials.settings import PowerSettings
from hipsta_bids.stats.arrays import Bool, Float
from hipsta_bids.stats.settings import MultiplicitySettings

#: More participants per arm are not looked for.
MOST_PARTICIPANTS = 10_000

#: Kinds of effects: a share of the mean, or of the change over time.
THINNING, SLOWING = "thinning", "slowing"
_YEAR = 12.0
#: Lower limit of a variance over its estimate, where the limit is zero.
_LEAST_VARIANCE = 1e-6
_TURNS = 200  # of the fixed point of the level; it settles in some tens


@dataclass(frozen=True, kw_only=True)
class Reference:
    """Estimates of a reference cohort, of some measures or points."""

    n: NDArray[np.int64]
    """Participants with a value."""
    mean: Float
    """In units of the measure."""
    variance: Float
    """Between participants at one visit, or with several visits within participants."""
    freedom: Float
    """Degrees of freedom of the variance, about."""
    mean_limits: Float | None = None
    """(2, points); None if the mean is taken to be known."""
    slope: Float | None = None
    """Change per month."""
    slope_limits: Float | None = None
    """(2, points)"""
    slope_variance: Float | None = None
    """Of true changes per month between participants; None if they are taken to change alike."""
    slope_freedom: Float | None = None
    """Degrees of freedom of the variance between the slopes of participants."""
    spread: float = 0.0
    """Sum of squared deviations of a participant's visits from their mean, months squared."""


@dataclass(frozen=True, kw_only=True)
class TrialEffect:
    """What a trial of two arms is to find, and when it measures."""

    kind: str
    """``thinning``: the arms differ by a share of the mean, at the last visit; ``slowing``: the
    change of the treated arm is smaller by a share of that of the other."""
    share: float
    """0..1"""
    visits: tuple[float, ...] = ()
    """Months; empty for a single visit."""

    def __post_init__(self) -> None:
        if self.kind == SLOWING and not self.visits:
            raise UsageError(
                "--power slowing= needs visits; name the months of the trial, as --visits 0,12,24"
            )

    @property
    def duration(self) -> float:
        """Time from the first to the last visit, months."""
        return self.visits[-1] - self.visits[0] if self.visits else 0.0

    @property
    def spread(self) -> float:
        """Sum of squared deviations of the visits' times from their mean, months squared."""
        return float(np.var(self.visits) * len(self.visits)) if self.visits else 0.0


def sample_size(
    effect: TrialEffect,
    reference: Reference,
    settings: PowerSettings,
    *,
    alpha: float,
    confidence: float | None = None,
) -> dict[str, Any]:
    """Return the columns of the table of sample sizes: participants per arm for the power asked.

    With one visit the end point is a participant's value. With several it is the slope by least
    squares over the visits, as in a mixed model with random slopes and complete data: its variance
    is the variance of true slopes plus the variance within participants over the sum of squared
    times (Ard and Edland 2011). The test is Student's for two groups, so that power follows the
    non-central t. With unequal arms, numbers are of the smaller one.
    """
    sd = endpoint_sd(effect, reference)
    difference = _difference(effect, reference.mean, reference.slope)
    goal, ratio = settings.power, settings.allocation
    per_arm = participants_needed(difference / sd, alpha, goal, MOST_PARTICIPANTS, ratio)
    ends = {}
    if confidence is not None:
        d = difference / sd * _effect_limits(effect, reference, confidence)
        low, high = participants_needed(d, alpha, goal, MOST_PARTICIPANTS, ratio)
        ends = {"per_arm_low": low, "per_arm_high": high}
    larger = np.ceil(np.round(ratio * per_arm, 9))
    per_year = _YEAR if effect.visits else 1.0
    left = information_left(effect, reference, settings.dropout)
    unequal = {"larger_arm": larger, "enrolled_larger_arm": np.ceil(np.round(larger / left, 9))}
    return {
        "n": reference.n,
        "mean": reference.mean,
        "change_per_year": np.nan if reference.slope is None else reference.slope * _YEAR,
        "arm_difference": difference * per_year,
        "sd_endpoint": sd * per_year,
        "cohen_d": difference / sd,
        "alpha": alpha,
        "per_arm": per_arm,
        **ends,
        "enrolled_per_arm": np.ceil(np.round(per_arm / left, 9)),
        **(unequal if ratio > 1 else {}),
        "power": power_of(difference / sd, per_arm, alpha, ratio),
    }


def _effect_limits(effect: TrialEffect, reference: Reference, confidence: float) -> Float:
    """Limits (2, points) of the effect size over its estimate, the better one first.

    Limits of the mean or of the change, by t, and of the SD, by chi squared, are joined on the
    scale of logarithms (Zou and Donner 2008). Where the change may be zero, the worse one is zero.
    """
    is_slowing = effect.kind == SLOWING
    center = np.abs(
        reference.slope if is_slowing and reference.slope is not None else reference.mean
    )
    limits = reference.slope_limits if is_slowing else reference.mean_limits
    low, high = np.stack([center, center]) if limits is None else np.sort(np.abs(limits), axis=0)
    if limits is not None:
        low = np.where(limits[0] * limits[1] > 0, low, 0.0)
    variance = _variance_limits(effect, reference, confidence)
    with np.errstate(divide="ignore"):
        parts = np.log(np.stack([high, low]) / center), np.log(variance) / 2
    reach = np.hypot(*parts)
    return np.asarray(np.exp([reach[0], -reach[1]]), dtype=np.float64)


def _variance_limits(effect: TrialEffect, reference: Reference, confidence: float) -> Float:
    """Limits (2, points) of the variance of the end point over its estimate, by chi squared.

    The variance of slopes in the trial is the variance in the reference, plus the error of a slope
    in the trial, minus this error in the reference; errors depend on the visits. Limits of such a
    sum join the limits of its parts (Graybill and Wang 1980).
    """
    tails = np.array([[1 + confidence], [1 - confidence]]) / 2
    within = reference.freedom / stats.chi2.ppf(tails, reference.freedom)
    if not effect.visits or reference.slope_variance is None or reference.slope_freedom is None:
        return np.asarray(within, dtype=np.float64)
    observed = reference.slope_variance + reference.variance / reference.spread
    change = reference.variance * (1 / effect.spread - 1 / reference.spread)
    slopes = reference.slope_freedom / stats.chi2.ppf(tails, reference.slope_freedom)
    reach = np.abs(change) * np.where(change < 0, within[::-1] - 1, within - 1)
    reach = np.hypot(observed * (slopes - 1), reach) / (observed + change)
    return np.stack([np.maximum(1 - reach[0], _LEAST_VARIANCE), 1 + reach[1]])


def endpoint_sd(effect: TrialEffect, reference: Reference) -> Float:
    """SD of what the trial compares: a value, or a slope per month."""
    if not effect.visits:
        return np.sqrt(reference.variance)
    slopes = 0.0 if reference.slope_variance is None else reference.slope_variance
    return np.asarray(np.sqrt(slopes + reference.variance / effect.spread), dtype=np.float64)


def information_left(effect: TrialEffect, reference: Reference, dropout: float) -> Float:
    """Mean information of an enrolled participant, over the information of all visits.

    A constant hazard leaves ``1 - dropout`` at the last visit, and who leaves is in the mixed model
    with the visits before: the information of a pattern is the inverse variance of its slope, if
    it has two visits. With a single visit, who leaves gives none.
    """
    if not effect.visits:
        return np.asarray(1.0 - dropout)
    passed = (np.array(effect.visits) - effect.visits[0]) / effect.duration
    stay = np.append((1 - dropout) ** passed, 0.0)
    whole, total = endpoint_sd(effect, reference) ** 2, np.zeros(reference.mean.shape)
    for count in range(2, len(effect.visits) + 1):
        part = replace(effect, visits=effect.visits[:count])
        total += (stay[count - 1] - stay[count]) * whole / endpoint_sd(part, reference) ** 2
    return total


def _difference(effect: TrialEffect, mean: Float, slope: Float | None) -> Float:
    if effect.kind == SLOWING:
        if slope is None:
            raise ModelError(
                "--power slowing= needs a reference cohort that was followed; test-retest has no"
                " change, give thinning="
            )
        return effect.share * np.abs(slope)
    return effect.share * np.abs(mean) / (effect.duration if effect.visits else 1.0)


def power_of(d: Float, per_arm: Float, alpha: float, ratio: float = 1.0) -> Float:
    """Power of Student's two-sided t test of two groups, by its non-central form.

    The larger group has ``ratio`` times as many members as the smaller one, rounded up.
    """
    ready = np.isfinite(d) & np.isfinite(per_arm) & (per_arm > 1)
    size = np.where(ready, per_arm, 2.0)
    larger = np.ceil(np.round(ratio * size, 9))
    weight, df = size * larger / (size + larger), size + larger - 2
    center = np.abs(np.where(ready, d, 0.0)) * np.sqrt(weight)
    limit = stats.t.isf(alpha / 2, df)
    power = 1 - special.nctdtr(df, center, limit) + special.nctdtr(df, center, -limit)
    # SciPy has no value for some centers far beyond the limit, where power is 1.
    power = np.where(np.isnan(power) & (center > limit), 1.0, power)
    return np.where(ready, power, np.nan)


def participants_needed(
    d: Float, alpha: float, power: float, limit: int, ratio: float = 1.0
) -> Float:
    """Smallest number in the smaller arm that reaches a power, by halving; NaN beyond ``limit``."""
    d = np.asarray(d, dtype=np.float64)
    low, high = np.ones(d.shape), np.full(d.shape, float(limit))
    is_enough = power_of(d, high, alpha, ratio) >= power
    while (high - low > 1).any():
        middle = np.floor((low + high) / 2)
        reached = power_of(d, middle, alpha, ratio) >= power
        low, high = np.where(reached, low, middle), np.where(reached, middle, high)
    return np.where(is_enough, high, np.nan)


def point_level(rules: MultiplicitySettings, plan: PowerSettings) -> float:
    """Level of the test at a point that holds the false discovery rate, on average.

    If a share a of the points differs, and is rejected with the power P, and the rest at the
    level t, a share a P + (1 - a) t of the points is rejected. The procedure of Benjamini and
    Hochberg has then t = q (a P + (1 - a) t), which gives t (Jung 2005; Liu and Hwang 2007). The
    two-stage procedure does it with q / (1 + q), and again with q / (1 + q) over the share of
    points not rejected in the first stage; its power in the first stage is the power at the level
    there.
    """
    if rules.method not in {"fdr2", "bh"}:
        raise UsageError(
            f"--power: participants per point are known for false discovery rates, not for"
            f" {rules.method}; give --correction fdr2 or bh"
        )
    if rules.method == "bh":
        return rules.alpha * plan.affected * plan.power / (1 - rules.alpha * (1 - plan.affected))
    rate, affected = rules.alpha / (1 + rules.alpha), plan.affected
    second = first = rate * affected * plan.power
    for _ in range(_TURNS):
        center = stats.norm.isf(second / 2) + stats.norm.ppf(plan.power)
        power_first = stats.norm.sf(stats.norm.isf(first / 2) - center)
        share = affected * power_first + (1 - affected) * first
        first = rate * share
        second = rate * affected * plan.power / (1 - share - rate * (1 - affected))
    return float(second)


#: Smallest detectable change over the within-subject SD, for 95 % of changes by chance.
DETECTABLE = 1.96 * np.sqrt(2)


def repeatability(
    values: Float, *, confidence: float = 0.95, least: int = 3
) -> dict[str, NDArray[Any]]:
    """Return the columns of test-retest tables for values (participants, sessions, points).

    The variance is split between and within participants; NaN where it cannot be.

    Where one session is missing, the participant is excluded at that point; points with fewer
    complete participants than ``least`` are NaN. The within-subject SD is the root of the mean
    variance of a participant's values (Bland and Altman 1996), with limits of chi squared. ICC(2,1)
    follows Shrout and Fleiss (1979), with the limits of McGraw and Wong (1996, table 7, ICC(A,1)).
    """
    k = values.shape[1]
    complete: Bool = np.asarray(np.isfinite(values).all(axis=1))
    n = complete.sum(axis=0)
    usable = n >= max(least, 2)
    size = np.where(usable, n, 2).astype(np.float64)
    filled = np.where(complete[:, None], values, 0.0)
    grand = filled.sum(axis=(0, 1)) / (size * k)
    people = filled.mean(axis=1)
    sessions = filled.sum(axis=0) / size
    residual = np.where(complete[:, None], filled - people[:, None] - sessions + grand, 0.0)
    rows = k * np.where(complete, (people - grand) ** 2, 0.0).sum(axis=0) / (size - 1)
    columns = size * ((sessions - grand) ** 2).sum(axis=0) / (k - 1)
    error = (residual**2).sum(axis=(0, 1)) / ((size - 1) * (k - 1))
    usable &= error > 0
    rows, columns, error = (np.where(usable, squares, np.nan) for squares in (rows, columns, error))
    freedom = size * (k - 1)
    within = np.sqrt(((k - 1) * columns + (size - 1) * (k - 1) * error) / freedom)
    tails = np.array([[(1 + confidence) / 2], [(1 - confidence) / 2]])
    icc = (rows - error) / (rows + (k - 1) * error + k * (columns - error) / size)
    low, high = within * np.sqrt(freedom / stats.chi2.ppf(tails, freedom))
    icc_low, icc_high = _icc_limits(icc, rows, columns, error, n=size, k=k, tails=tails)
    return {
        "n": n,
        "mean": np.where(usable, grand, np.nan),
        "sd_between": np.sqrt(np.maximum((rows - error) / k, 0.0)),
        "sd_within": within,
        "sd_within_low": low,
        "sd_within_high": high,
        "icc": icc,
        "icc_low": icc_low,
        "icc_high": icc_high,
        "detectable_change": DETECTABLE * within,
        "p_sessions": stats.f.sf(columns / error, k - 1, (size - 1) * (k - 1)),
    }


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
    denominator = k * columns + (k * n - k - n) * error
    low = n * (rows - down * error) / (down * denominator + n * rows)
    high = n * (up * rows - error) / (denominator + n * up * rows)
    return np.stack([low, high])
