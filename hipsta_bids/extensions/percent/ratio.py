"""Differences of groups in percent of the reference: ratios of two means of a model."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import chain

import numpy as np
from scipy.special import stdtrit

from hipsta_bids.errors import ModelError
from hipsta_bids.extensions.percent import NAME
from hipsta_bids.group.model import Groups
from hipsta_bids.group.output.citations import escaped
from hipsta_bids.group.output.results import Analysis
from hipsta_bids.group.output.tables import read_columns
from hipsta_bids.group.questions.analysis import row_models
from hipsta_bids.group.questions.summaries import fit_summaries
from hipsta_bids.group.request import Request
from hipsta_bids.stats import contrasts as texts
from hipsta_bids.stats.arrays import Bool, Float
from hipsta_bids.stats.design import build_design
from hipsta_bids.stats.formula import ModelSpec
from hipsta_bids.stats.glm import PointTest, PointwiseFit, fit_maps
from hipsta_bids.stats.grammar import closed_formula

#: Units of measures whose means are positive: lengths, areas and volumes.
_UNITS = ("mm", "mm^2", "mm^3")


def is_asked(request: Request) -> bool:
    """Check whether differences are also written in percent."""
    return bool(request.options.get(NAME))


def choose_groups(request: Request) -> Groups:
    """Return the groups; ModelError without, and for changes, whose mean may be zero."""
    groups, terms = request.groups, closed_formula(request.model.formula).names
    if groups is None or groups.column not in terms or request.comparison.sessions.later:
        raise ModelError(f"--{NAME} needs groups in the model, and not --paired; remove it")
    return groups


def meaning(groups: Groups) -> Iterator[Mapping[str, str]]:  # noqa: ARG001  (as of all steps)
    """Return the meaning of the columns."""
    yield read_columns(__package__)


def methods(analysis: Analysis, cite: Callable[[str], str]) -> Iterator[str]:
    """Write how differences were written in percent."""
    confidence = analysis.request.settings.glm.confidence
    yield (
        "Differences of groups are also percent of the mean of the reference"
        f" ({escaped(analysis.request.plans[NAME].reference)}). Both means are estimates of the"
        " model at equal weights of other factors and at the means of covariates"
        f" {cite('marginal-means')}. Their ratio has {confidence:.0%} confidence limits by"
        f" Fieller's theorem {cite('fieller')}. Limits are missing where they are unbounded."
    )


def percent_of(
    reference: PointTest, group: PointTest, difference: PointTest, confidence: float
) -> dict[str, Float]:
    """Compute the percent difference from the reference's mean, with limits (Fieller 1954).

    Of tests of both means and of their difference, (points,) each. The variance of the difference
    gives the covariance of the means. NaN where the reference's mean is not positive; limits are
    NaN where they are unbounded, because this mean may be zero.
    """
    (r,), (a,), (r_se,), (a_se,) = reference.estimate, group.estimate, reference.se, group.se
    squared = stdtrit(difference.df, (1 + confidence) / 2) ** 2
    covariance = (r_se**2 + a_se**2 - difference.se[0] ** 2) / 2
    # Limits are the ratios q at which a - q r is t standard errors from zero.
    square, middle = r**2 - squared * r_se**2, a * r - squared * covariance
    square = np.where((square > 0) & (r > 0), square, np.nan)
    root = np.sqrt(middle**2 - square * (a**2 - squared * a_se**2))
    ratios = a / np.where(r > 0, r, np.nan), (middle - root) / square, (middle + root) / square
    names = NAME, f"{NAME}_low", f"{NAME}_high"
    return {name: 100 * (ratio - 1) for name, ratio in zip(names, ratios, strict=True)}


def add_percent(analysis: Analysis, groups: Groups) -> Analysis:
    """Add percent differences to the tests of maps and summary measures."""
    request, units = analysis.request, analysis.compared.units
    rows_of = row_models(request)
    confidence, (pairs, model) = request.settings.glm.confidence, _means_of(analysis, groups)
    design = build_design(
        request.table, model, request.settings.design, request.references, has_random=True
    )
    rows, fitted, measures = rows_of(design), dict(analysis.fitted), dict(analysis.measures)
    for hemi, side in analysis.fitted.items():
        names = [name for name in side.fits if units.get(name) in _UNITS]
        fits = dict(side.fits)
        for name, means in fit_maps(hemi, side.maps.only(names), rows).fits.items():
            fits[name] = _with_percent(fits[name], means, pairs, confidence, np.array(True))
        fitted[hemi] = replace(side, fits=fits)
    summaries, _ = fit_summaries(
        analysis.compared,
        model,
        design,
        request.settings.design,
        names=request.measures.summaries if measures else (),
        references=request.references,
        icv=request.icv,
        rows_of=rows_of,
    )
    for key, (columns, fit, n) in analysis.measures.items():
        is_positive = np.array([units.get(name) in _UNITS for name in columns])
        added = _with_percent(fit, summaries[key][1], pairs, confidence, is_positive)
        measures[key] = columns, added, n
    note = f"--{NAME}: only of {groups.column} against {groups.reference}, in mm, mm^2 and mm^3"
    return replace(analysis, fitted=fitted, measures=measures).noted([note])


def _means_of(analysis: Analysis, groups: Groups) -> tuple[dict[str, tuple[str, ...]], ModelSpec]:
    """Return reference and other mean by the contrast of both, and the model of these means."""
    levels = analysis.design.levels
    cells = {f"{factor}[{level}]" for factor in levels for level in levels[factor]}
    first, *compared = (f"{groups.column}[{level}]" for level in groups.levels)
    defaults = map(texts.parse_contrast, map(texts.contrast_json, groups.contrasts()))
    pairs = {
        spec.name: pair
        for spec in analysis.model.contrasts or defaults
        for pair in (spec.conditions, spec.conditions[::-1])
        if pair[1:] in [(pair[0].replace(first, cell),) for cell in compared]
        and cells.issuperset(texts.split_name(pair[0])[0])
    }
    names = dict.fromkeys(chain.from_iterable(pairs.values()))
    # With a condition, if an empty one, no name is a column of the design.
    marginal = {name: name if texts.CONDITION in name else name + texts.CONDITION for name in names}
    means = (texts.ContrastSpec(name, (text,), ((1.0,),), "t") for name, text in marginal.items())
    return pairs, replace(analysis.model, contrasts=tuple(means), dummy=None)


def _with_percent(
    fit: PointwiseFit,
    means: PointwiseFit,
    pairs: Mapping[str, tuple[str, ...]],
    confidence: float,
    is_positive: Bool,
) -> PointwiseFit:
    """Add percent differences to the tests whose weights are of the difference of two means."""
    mean_of, tests = {test.contrast.name: test for test in means.tests}, list(fit.tests)
    for i, test in enumerate(fit.tests):
        if test.contrast.name in pairs:
            first, second = (mean_of[name] for name in pairs[test.contrast.name])
            weights = np.abs(first.contrast.weights - second.contrast.weights)
            if np.allclose(weights, np.abs(test.contrast.weights)):
                percent = percent_of(first, second, test, confidence)
                columns = {name: np.where(is_positive, v, np.nan) for name, v in percent.items()}
                tests[i] = replace(test, further={**test.further, **columns})
    return replace(fit, tests=tuple(tests))
