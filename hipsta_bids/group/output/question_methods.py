"""Methods texts of other questions than a comparison: norms, sample sizes, test-retest."""

from collections.abc import Callable, Sequence

import pandas as pd

from hipsta_bids import __version__
from hipsta_bids.group.output.citations import Citations, escaped
from hipsta_bids.group.output.methods import COMMON_SHEETS, PROCEDURES
from hipsta_bids.group.output.saved import NormsFile
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.stats.norms import CENTILE_FOLDS, LEVELS, SHAPE_LEVEL
from hipsta_bids.stats.settings import RetestSettings
from hipsta_bids.stats.trials import THINNING, TrialEffect, point_level

Cite = Callable[[str], str]
"""Numbers a work by its key."""


def norms_text(
    file: NormsFile,
    *,
    sample: str,
    coverage: pd.DataFrame | None,
    new: Sequence[str],
    controls: tuple[str, str] | None,
    shared: bool = False,
) -> str:
    """Return how norms were estimated, or how participants were scored by them.

    ``coverage`` is the calibration of norms that were estimated; ``new`` sites are last.
    """
    cite = Citations()
    ages = f"{file.knots[0]:g} to {file.knots[-1]:g} years"
    first = f"Measures of the hippocampal body {cite('method')} of {sample} were "
    if coverage is not None:
        first += f"the reference for norms at ages of {ages} (hipsta_bids {__version__})."
    else:
        first += (
            f"compared with norms of {file.participants} participants of {ages} from"
            f" {len(file.sites) - len(new)} sites (hipsta_bids {__version__}; norms made by"
            f" {file.version})."
        )
    first += COMMON_SHEETS * shared
    if file.template is not None:
        template = "each other" if coverage is not None else "the template of the norms"
        first += f" Sheets were registered to {template} by curvature profiles {cite('registr')}."
    sexes = " sex and" if file.sexes else ""
    model = (
        "The mean at each point, and of each summary measure, was a natural cubic spline of age"
        f" ({len(file.knots)} knots) with constants for{sexes} site. The logarithm of the"
        f" standard deviation was linear in age, with a constant for each site {cite('gamlss')}."
    )
    if file.columns:
        model += (
            " Distributions were normal, and all numbers followed from sums of products over the"
            " participants of each site; no value of a participant left its site."
        )
    else:
        model += (
            f" Where a likelihood-ratio test rejected normality (p < {SHAPE_LEVEL:g}), residuals"
            f" had a sinh-arcsinh distribution {cite('shash')}, as in warped normative models"
            f" {cite('warped')}."
        )
    model += (
        " Deviations (z) are normal quantiles of the probability of a value. This probability was"
        " Student's, which allows for the uncertainty of the shift and scale of each site."
    )
    paragraphs = [first, model]
    if coverage is not None:
        of_maps = coverage["n_points"] > 1
        kinds = {"points of maps": coverage[of_maps], "summary measures": coverage[~of_maps]}
        parts = []
        for kind, numbers in kinds.items():
            below = [numbers[name].mean() for name in numbers.columns if name.startswith("below_")]
            if len(numbers):
                parts.append(f"{', '.join(f'{100 * one:.1f}' for one in below)} % of {kind}")
        levels = ", ".join(f"{100 * one:g}" for one in LEVELS)
        paragraphs.append(
            f"In {CENTILE_FOLDS}-fold cross-validation, {' and '.join(parts)} lay below the"
            f" centiles {levels}."
        )
    if new:
        counts = ", ".join(f"{escaped(site)} ({file.sites[site]})" for site in new)
        paragraphs.append(
            "Shift and scale of sites without norms were estimated from their controls"
            f" {escaped('='.join(controls or ()))}: {counts}. All other parameters were unchanged."
        )
    return cite.page(paragraphs, file.region)


def power_text(
    effect: TrialEffect,
    settings: GroupSettings,
    source: Callable[[Cite], str],
    cite: Cite,
) -> str:
    """Return the design of the trial; ``source`` names what variances were estimated from."""
    plan, rules = settings.power, settings.multiplicity
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
