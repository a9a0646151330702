"""Sample size: how many participants a trial needs for an effect on a measure or at a point."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy import special, stats

from hipsta_bids.errors import ModelError, UsageError
from hipsta_bids.group.data import Float
from hipsta_bids.group.methods import PROCEDURES
from hipsta_bids.group.reference import Reference
from hipsta_bids.group.settings import GroupSettings, MultiplicitySettings

#: Kinds of effects: a share of the mean, or of the change over time.
THINNING, SLOWING = "thinning", "slowing"
_YEAR = 12.0
_TURNS = 200  # of the fixed point of the level; it settles in some tens


Cite = Callable[[str], str]
"""Numbers a work by its key."""


@dataclass(frozen=True, kw_only=True)
class TrialEffect:
    """What a trial of two arms of equal size is to find, and when it measures."""

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
                "--power slowing= is about change over time; say when the trial measures, as"
                " --visits 0,12,24",
                reason="no-visits",
            )

    @property
    def duration(self) -> float:
        """Time from the first to the last visit, months."""
        return self.visits[-1] - self.visits[0] if self.visits else 0.0

    @property
    def spread(self) -> float:
        """Sum of squared deviations of the visits' times from their mean, months squared."""
        return float(np.var(self.visits) * len(self.visits)) if self.visits else 0.0


@dataclass(frozen=True, kw_only=True)
class SampleSize:
    """Participants per arm of a trial, at each point."""

    difference: Float
    """Between the arms: of means, or with several visits of changes per month."""
    sd: Float
    """Of a participant's value, or of a participant's estimated change per month."""
    alpha: float
    """Two-sided level of the test at one point."""
    per_arm: Float
    """Who complete the trial; NaN beyond ``power.most``."""
    power: Float
    """With that many."""
    enrolled: Float
    """Per arm, so that those who drop out leave as much information."""
    limits: Float | None = None
    """(2, points) participants per arm at the confidence limits of the reference."""

    @property
    def cohen_d(self) -> Float:
        """Difference over SD."""
        return self.difference / self.sd


def sample_size(
    effect: TrialEffect,
    reference: Reference,
    settings: GroupSettings,
    *,
    alpha: float,
    limits: bool = False,
) -> SampleSize:
    """Find the participants per arm that give the power which the settings ask for.

    With one visit the end point is a participant's value. With several it is the slope by least
    squares over the visits, as in a mixed model with random slopes and complete data: its variance
    is that of true slopes plus that within participants over the sum of squared times (Ard and
    Edland 2011). The test is Student's for two groups, so that power is that of the non-central t.
    """
    wanted = settings.power.power
    sd = endpoint_sd(effect, reference)
    difference = _difference(effect, reference.mean, reference.slope)
    per_arm = participants_needed(difference / sd, alpha, wanted, settings.power.most)
    ends = None
    if limits:
        if effect.kind == SLOWING and reference.slope_limits is not None:
            low, high = reference.slope_limits
            # Where the slope may be zero, no number is enough.
            least = np.where(low * high > 0, np.minimum(abs(low), abs(high)), 0.0)
            most = np.maximum(abs(low), abs(high))
            d = np.stack([most, least]) * effect.share / sd
        else:
            tail = (1 - settings.glm.confidence) / 2
            chi = stats.chi2.ppf(np.array([[1 - tail], [tail]]), reference.freedom)
            d = difference / sd * np.sqrt(chi / reference.freedom)
        ends = participants_needed(d, alpha, wanted, settings.power.most)
    return SampleSize(
        difference=difference,
        sd=sd,
        alpha=alpha,
        per_arm=per_arm,
        power=power_of(difference / sd, per_arm, alpha),
        enrolled=np.ceil(
            np.round(per_arm / information_left(effect, reference, settings.power.dropout), 9)
        ),
        limits=ends,
    )


def endpoint_sd(effect: TrialEffect, reference: Reference) -> Float:
    """SD of what the trial compares: a value, or a slope per month."""
    if not effect.visits:
        return np.sqrt(reference.variance)
    slopes = 0.0 if reference.slope_variance is None else reference.slope_variance
    return np.asarray(np.sqrt(slopes + reference.variance / effect.spread), dtype=np.float64)


def information_left(effect: TrialEffect, reference: Reference, dropout: float) -> Float:
    """Information that a participant who is enrolled gives on average, over that of all visits.

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
                " change, give thinning=",
                reason="no-change",
            )
        return effect.share * np.abs(slope)
    return effect.share * np.abs(mean) / (effect.duration if effect.visits else 1.0)


def power_of(d: Float, per_arm: Float, alpha: float) -> Float:
    """Power of Student's two-sided t test of two groups of equal size, by its non-central form."""
    ready = np.isfinite(d) & np.isfinite(per_arm) & (per_arm > 1)
    size = np.where(ready, per_arm, 2.0)
    center, df = np.abs(np.where(ready, d, 0.0)) * np.sqrt(size / 2), 2 * size - 2
    limit = stats.t.isf(alpha / 2, df)
    found = 1 - special.nctdtr(df, center, limit) + special.nctdtr(df, center, -limit)
    # SciPy has no value for some centers far beyond the limit, where power is 1.
    found = np.where(np.isnan(found) & (center > limit), 1.0, found)
    return np.where(ready, found, np.nan)


def participants_needed(d: Float, alpha: float, power: float, most: int) -> Float:
    """Smallest number per arm that reaches a power, by halving; NaN beyond ``most``."""
    d = np.asarray(d, dtype=np.float64)
    low, high = np.ones(d.shape), np.full(d.shape, float(most))
    enough = power_of(d, high, alpha) >= power
    while (high - low > 1).any():
        middle = np.floor((low + high) / 2)
        reached = power_of(d, middle, alpha) >= power
        low, high = np.where(reached, low, middle), np.where(reached, middle, high)
    return np.where(enough, high, np.nan)


def point_level(settings: GroupSettings) -> float:
    """Level of the test at a point that holds the false discovery rate, on average.

    If a share a of the points differs, and is found with the power P, while the others are found
    at the level t, a share a P + (1 - a) t of the points is found. The procedure of Benjamini and
    Hochberg has then t = q (a P + (1 - a) t), which gives t (Jung 2005; Liu and Hwang 2007). The
    two-stage procedure does it with q / (1 + q), and again with q / (1 + q) over the share of
    points not found in the first stage; its power in the first stage is that of the level there.
    """
    how, plan = settings.multiplicity, settings.power
    if how.method not in {"fdr2", "bh"}:
        raise UsageError(
            f"--power: participants per point are known for false discovery rates, not for"
            f" {how.method}; give --correction fdr2 or bh",
            reason="power-correction",
        )
    if how.method == "bh":
        return how.alpha * plan.affected * plan.power / (1 - how.alpha * (1 - plan.affected))
    return _two_stage_level(how, plan.power, plan.affected)


def _two_stage_level(how: MultiplicitySettings, power: float, affected: float) -> float:
    rate = how.alpha / (1 + how.alpha)
    second = first = rate * affected * power
    for _ in range(_TURNS):
        center = stats.norm.isf(second / 2) + stats.norm.ppf(power)
        seen = stats.norm.sf(stats.norm.isf(first / 2) - center)
        found = affected * seen + (1 - affected) * first
        first = rate * found
        second = rate * affected * power / (1 - found - rate * (1 - affected))
    return float(second)


def power_columns(
    effect: TrialEffect, found: SampleSize, reference: Reference
) -> Mapping[str, object]:
    """Columns of the tables of sample sizes; changes are per year."""
    per_year = _YEAR if effect.visits else 1.0
    limits = {}
    if found.limits is not None:
        limits = {"per_arm_low": found.limits[0], "per_arm_high": found.limits[1]}
    return {
        "n": reference.n,
        "mean": reference.mean,
        "change_per_year": np.nan if reference.slope is None else reference.slope * _YEAR,
        "arm_difference": found.difference * per_year,
        "sd_endpoint": found.sd * per_year,
        "cohen_d": found.cohen_d,
        "alpha": found.alpha,
        "per_arm": found.per_arm,
        **limits,
        "enrolled_per_arm": found.enrolled,
        "power": found.power,
    }


def power_text(
    effect: TrialEffect,
    settings: GroupSettings,
    source: Callable[[Cite], str],
    cite: Cite,
) -> str:
    """Word what was asked, and how it was answered; ``source`` words what variances rest on."""
    plan, how = settings.power, settings.multiplicity
    months = ", ".join(f"{month:g}" for month in effect.visits)
    question = f"{100 * effect.share:g} % of the change over time is prevented"
    if effect.kind == THINNING:
        question = f"the arms differ by {100 * effect.share:g} % of the mean"
        question += f" after {effect.duration:g} months" if effect.visits else ""
    end = "A participant's value is the end point."
    if effect.visits:
        end = (
            f"The end point is the slope over visits at months {months}; its variance is that of"
            " true slopes between participants plus the variance within participants over the sum"
            f" of squared times {cite('ard')}."
        )
    lost = f", if {100 * plan.dropout:g} % drop out" if plan.dropout else ""
    if lost and effect.visits:
        lost += " at a constant hazard and are analyzed with the visits before"
    return (
        f"Sample sizes are those of a trial of two arms of equal size in which {question}, with a"
        f" power of {plan.power:g}{lost}. {end} Means, changes and variances are those of"
        f" {source(cite)}. Power is that of Student's two-sided t test (non-central t), at the"
        f" level {plan.alpha:g} for a summary measure, without correction, since a trial has one"
        f" primary end point. At single points the level is {point_level(settings):.2g}: at that"
        f" level {PROCEDURES[how.method]} {cite(how.method)} holds the false discovery rate at"
        f" {how.alpha:g} if"
        f" {100 * plan.affected:g} % of the points of a map differ and are found with this power"
        f" on average {cite('jung')} {cite('liu')}. Of many measures the one that needs fewest"
        " does so partly by chance; its number is too small on average."
    )
