"""Methods texts of sample sizes and of agreement between sessions."""

from collections.abc import Callable

from hipsta_bids.extensions.trials.settings import PowerSettings, RetestSettings
from hipsta_bids.extensions.trials.sizes import THINNING, TrialEffect, point_level
from hipsta_bids.group.output.methods import PROCEDURES
from hipsta_bids.group.settings import GroupSettings

Cite = Callable[[str], str]
"""Numbers a work by its key."""


def power_text(
    effect: TrialEffect,
    settings: GroupSettings,
    source: Callable[[Cite], str],
    cite: Cite,
) -> str:
    """Return the design of the trial; ``source`` names what variances were estimated from."""
    plan, rules = settings.of(PowerSettings), settings.multiplicity
    months = ", ".join(f"{month:g}" for month in effect.visits)
    question = f"treatment prevents {100 * effect.share:g} % of the change over time"
    if effect.kind == THINNING:
        question = f"the arms differ by {100 * effect.share:g} % of the mean"
        question += f" after {effect.duration:g} months" if effect.visits else ""
    end = "The end point was the value of a participant."
    if effect.visits:
        end = (
            f"The end point was the slope over visits at months {months}. Its variance was the"
            " variance of true slopes between participants plus the variance within participants"
            f" over the sum of squared times {cite('ard')}."
        )
    dropout = f" We assumed that {100 * plan.dropout:g} % drop out." if plan.dropout else ""
    if dropout and effect.visits:
        dropout = (
            f" We assumed that {100 * plan.dropout:g} % drop out at a constant hazard, and that"
            " their earlier visits are analyzed."
        )
    sizes = f"allocated {plan.allocation:g}:1" if plan.allocation > 1 else "of equal size"
    return (
        f"Sample sizes are for a trial with two arms {sizes} and a power of {plan.power:g}."
        f" In this trial, {question}.{dropout} {end} Means, changes and variances were estimated"
        f" from {source(cite)}. Power was computed for Student's two-sided t test, by the"
        f" non-central t distribution. The level was {plan.alpha:g} for summary measures, without"
        " correction, because a trial has one primary end point. At single points the level was"
        f" {point_level(rules, plan):.2g}. At this level, {PROCEDURES[rules.method]}"
        f" {cite(rules.method)} controls the false discovery rate at {rules.alpha:g}. This assumes"
        f" that {100 * plan.affected:g} % of the points differ and are found with this power on"
        f" average {cite('jung')} {cite('liu')}. Limits of sample sizes of summary measures include"
        " the uncertainty of the mean or change and of the standard deviation"
        f" {cite('mover')}. If the measure with the smallest sample size is"
        " selected among many, its sample size is underestimated on average."
    )


def retest_text(sessions: int, participants: int, settings: RetestSettings, cite: Cite) -> str:
    """Return how agreement was estimated."""
    return (
        f"Agreement between {sessions} sessions of {participants} participants was estimated at"
        " each point of the maps and for each summary measure. The within-subject standard"
        f" deviation was the root of the mean variance within participants {cite('bland')}. The"
        " minimal detectable change of one participant was 1.96 √2 times this standard deviation"
        f" {cite('weir')}. The intraclass correlation was ICC(2,1), for two-way random effects,"
        f" absolute agreement and single measurements {cite('shrout')}, with"
        f" {settings.confidence:.0%} confidence limits {cite('mcgraw')}. It depends on the variance"
        " between participants; the within-subject standard deviation does not."
    )
