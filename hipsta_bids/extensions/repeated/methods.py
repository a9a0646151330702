"""Texts of methods: how repeated visits were modeled."""

from collections.abc import Sequence

import numpy as np

from hipsta_bids.group.model import Cite
from hipsta_bids.group.output.citations import escaped
from hipsta_bids.stats.glm import PointwiseFit, RowModel
from hipsta_bids.stats.settings import LongitudinalSettings

#: Level at which slopes are said to differ.
_LEVEL = 0.05


def random_effects(model: RowModel, cite: Cite) -> str:
    """Return the random effects of a mixed model."""
    visits = model.visits
    effects = "intercepts and slopes" if visits is not None and visits.slopes else "intercepts"
    return (
        f" It had random {effects} of participants, and was estimated by restricted maximum"
        f" likelihood. Degrees of freedom were Satterthwaite's {cite('mixed')}."
    )


def slopes_text(fits: Sequence[PointwiseFit], cite: Cite) -> str:
    """Return at how many points slopes vary, and at how many they were omitted."""
    p = np.concatenate([fit.slopes_p for fit in fits if fit.slopes_p is not None] or [np.empty(0)])
    tested = int(np.isfinite(p).sum())
    if not tested:
        return ""
    share = np.sum(p == 1) / tested
    omitted = (
        f" Slopes were omitted at {share:.0%} of the points, where their variance was zero."
        if share
        else ""
    )
    return (
        f" Slopes differed between participants at {np.sum(p < _LEVEL) / tested:.0%} of the points"
        f" (p < {_LEVEL:g}, uncorrected). The test was the ratio of restricted likelihoods, with an"
        f" equal mixture of chi-squared distributions with 1 and 2 degrees of freedom"
        f" {cite('mixture')}.{omitted}"
    )


def visits_text(
    endpoint: Sequence[str],
    fits: Sequence[PointwiseFit],
    settings: LongitudinalSettings,
    cite: Cite,
) -> str:
    """Return how visits as categories, and the baseline, were modeled.

    ``endpoint`` is the analysis of a trial and its sessions, or empty.
    """
    kind, *sessions = endpoint or ("",)
    first = escaped(sessions[0] if sessions else "")
    if kind == "ancova":
        text = f" The value at {first} was a covariate at each point (analysis of covariance)."
    else:
        text = (
            " Visits were categories with an unstructured covariance, estimated by restricted"
            f" maximum likelihood {cite('mmrm')}."
        )
    if kind == "mmrm":
        text += f" The value at {first} was a covariate at each point, with a slope for each visit."
    if kind == "clda":
        text += (
            f" {first} was one of the visits, with the same mean in all arms (constrained"
            f" longitudinal data analysis) {cite('clda')}."
        )
    if kind != "ancova" and settings.freedom == "kenward-roger":
        text += (
            " Standard errors and degrees of freedom followed Kenward and Roger"
            f" {cite('kenward-roger')}."
        )
    elif kind != "ancova":
        text += f" Degrees of freedom were Satterthwaite's {cite('mixed')}."
    n_missing = sum(int((np.isnan(fit.sigma) & (fit.n > 0)).sum()) for fit in fits)
    return f"{text} The model could not be fitted at {n_missing} points." if n_missing else text
