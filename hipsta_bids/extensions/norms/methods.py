"""Methods texts of norms."""

from collections.abc import Callable, Iterator, Sequence

import pandas as pd

from hipsta_bids import __version__
from hipsta_bids.extensions.norms import STEP
from hipsta_bids.extensions.norms.centiles import CENTILE_FOLDS, LEVELS, SHAPE_LEVEL
from hipsta_bids.extensions.norms.file import NormsFile
from hipsta_bids.group.output.citations import Citations, code, escaped
from hipsta_bids.group.output.methods import COMMON_SHEETS
from hipsta_bids.group.output.results import Analysis

Cite = Callable[[str], str]
"""Numbers a work by its key."""


def _coverage_text(coverage: pd.DataFrame) -> str:
    of_maps = coverage["n_points"] > 1
    kinds = {"points of maps": coverage[of_maps], "summary measures": coverage[~of_maps]}
    parts = []
    for kind, numbers in kinds.items():
        below = [numbers[name].mean() for name in numbers.columns if name.startswith("below_")]
        if len(numbers):
            parts.append(f"{', '.join(f'{100 * share:.1f}' for share in below)} % of {kind}")
    levels = ", ".join(f"{100 * level:g}" for level in LEVELS)
    return (
        f"In {CENTILE_FOLDS}-fold cross-validation, {' and '.join(parts)} lay below the"
        f" centiles {levels}."
    )


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
        paragraphs.append(_coverage_text(coverage))
    if new:
        counts = ", ".join(f"{escaped(site)} ({file.sites[site]})" for site in new)
        paragraphs.append(
            "Shift and scale of sites without norms were estimated from their controls"
            f" {escaped('='.join(controls or ()))}: {counts}. All other parameters were unchanged."
        )
    return cite.page(paragraphs, file.region)


def scores_text(analysis: Analysis, cite: Callable[[str], str]) -> Iterator[str]:
    """Write how participants were scored."""
    scores, group = analysis.parts[STEP], " ".join(analysis.request.plans[STEP])
    yield (
        f"Each participant was scored against {scores.count} participants with {escaped(group)}."
        " The score (w) was the difference from the value predicted by a linear model"
        f" {code(scores.formula.removeprefix('1 + '))} of the reference, divided by its residual"
        f" standard deviation {cite('normative')}."
        " Members of the reference were scored by the model without themselves. Points were low or"
        " high if the two-sided p, including the uncertainty of the model, was below"
        f" {1 - analysis.request.settings.glm.confidence:.2g}."
    )
