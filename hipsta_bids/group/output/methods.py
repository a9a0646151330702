"""A methods and results paragraph with the numbers of one analysis filled in."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from hipsta_bids import __version__
from hipsta_bids.group.cohort.data import SIZES, Cohort
from hipsta_bids.group.cohort.read import LEAST_SHARE
from hipsta_bids.group.output.citations import Citations, code, escaped, joined
from hipsta_bids.group.output.results import Analysis
from hipsta_bids.group.output.steps import blocks
from hipsta_bids.group.output.tables import opposite_notes
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.protocols import EXPERIMENTAL
from hipsta_bids.reports.group_tables import demographic_tests
from hipsta_bids.stats import inference
from hipsta_bids.stats.clusters import TFCE_EXTENT, TFCE_HEIGHT
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.exchangeability import exchange_text, spans_constant
from hipsta_bids.stats.formula import interactions
from hipsta_bids.stats.settings import MultiplicitySettings
from hipsta_bids.types import PARTICIPANT

#: Points that are one family of tests.
_FAMILIES = {
    "map": "the points of each map",
    "hemispheres": "the points of both hemispheres",
    "all": "the points of all maps of a contrast",
}
_SIDES = {"L": "left", "R": "right"}
#: Of sheets that visits share.
COMMON_SHEETS = (
    " All visits of a participant were measured on one sheet. It was laid out from the mean labels."
)
#: Procedures that hold false discovery rates.
PROCEDURES: Mapping[str, str] = {
    "bh": "the procedure of Benjamini and Hochberg",
    "fdr2": "the two-stage procedure of Benjamini, Krieger and Yekutieli",
}


def _sample_notes(demographics: pd.DataFrame, ratings: Mapping[str, int] | None) -> str:
    text = ""
    if tests := escaped(joined(demographic_tests(demographics))):
        text = f" Demographics of the groups were compared by {tests}."
    if ratings is not None:
        counts = ", ".join(f"{n} {rating}" for rating, n in ratings.items())
        text += (
            f" Hemispheres were rated on their report pages ({counts}); hemispheres rated exclude"
            " were excluded."
        )
    return text


def methods_text(
    cohort: Cohort,
    analysis: Analysis,
    settings: GroupSettings,
    n_out: int,
    *,
    surfaces: Sequence[str] = (),
    sentences: Sequence[str] = (),
    region: str = "body",
    ratings: Mapping[str, int] | None = None,
    demographics: pd.DataFrame,
) -> str:
    """Return methods and results, as a paper prints them."""
    cite = Citations()
    paragraphs = [_sample(cohort, analysis, n_out, cite, surfaces)]
    paragraphs[0] += _sample_notes(demographics, ratings)
    aligned = [_registration(analysis, settings, cite)] if analysis.registrations else []
    aligned += sentences
    if aligned:
        paragraphs.append(" ".join(aligned))
    if region in EXPERIMENTAL and analysis.fitted:
        paragraphs.append(_rims(analysis))
    paragraphs += blocks("methods", analysis.request, analysis, cite)
    paragraphs.append(_models(analysis, settings, cite))
    paragraphs += blocks("methods-model", analysis.request, analysis, cite)
    if analysis.comparison.asymmetry:
        paragraphs.append(_asymmetry(analysis, settings, cite))
    paragraphs += blocks("methods-after", analysis.request, analysis, cite)
    if analysis.pairs:
        paragraphs.append(_classification(analysis, settings, cite))
    if analysis.found:
        paragraphs.append(_findings(analysis))
    paragraphs += [escaped(line) for line in opposite_notes(cohort, analysis, settings)]
    if analysis.skipped:
        points = (f"- {escaped(line)}" for line in analysis.skipped)
        paragraphs.append("\n".join(["Notes:", "", *points]))
    return cite.page(paragraphs, region)


def _sample(
    cohort: Cohort,
    analysis: Analysis,
    n_out: int,
    cite: Callable[[str], str],
    surfaces: Sequence[str],
) -> str:
    rows = analysis.design.rows
    table = analysis.compared.table.iloc[rows]
    people = cohort.table[PARTICIPANT].nunique()
    visits = f" ({len(cohort.table)} visits)" if len(cohort.table) > people else ""
    names = [name.replace("_", " ") for name in (*analysis.measured.maps, *surfaces)]
    maps = f"maps of {joined(names)}" if names else "summary measures"
    # Maps of other programs alone are none of the sheet.
    has_sheets = bool(analysis.measured.maps) or not surfaces
    subject = f"Measures of the hippocampal body {cite('method')} ({maps})" if has_sheets else maps
    text = (
        f"{subject[:1].upper()}{subject[1:]} of {people} participants{visits} were analyzed with"
        f" hipsta_bids {__version__}. All variables of the model were known for"
        f" {analysis.n_participants} participants"
    )
    if analysis.groups is not None:
        members = table[analysis.groups.column][~table[PARTICIPANT].duplicated()]
        counts = Counter(members.dropna().astype(str))
        text += f" ({', '.join(f'{counts[g]} {escaped(g)}' for g in analysis.groups.levels)})"
    sheets = [
        f"{len(side.used)} {_SIDES[hemi]}"
        for hemi, side in analysis.fitted.items()
        if hemi in _SIDES
    ]
    text += f", with {joined(sheets)} sheets" if sheets else ""
    excluded = "1 hemisphere or visit was" if n_out == 1 else f"{n_out} hemispheres or visits were"
    text += f". In addition, {excluded} excluded." if n_out else "."
    return text + COMMON_SHEETS * (cohort.shared and has_sheets)


def _registration(analysis: Analysis, settings: GroupSettings, cite: Callable[[str], str]) -> str:
    rules = settings.registration
    if rules.align == "none":
        fewest = min(len(registration.warps) for registration in analysis.registrations.values())
        reason = f", since a template needs {rules.min_subjects} sheets per hemisphere"
        return f"Maps were not registered to each other{reason * (fewest < rules.min_subjects)}."
    shares = "; ".join(
        f"{fit.explained_before:.0%} before and {fit.explained_after:.0%} after registration"
        f" ({_SIDES[hemi]})"
        for hemi, fit in analysis.registrations.items()
    )
    extreme = sum(int(r.extreme.sum()) for r in analysis.registrations.values())
    standardization = (
        " Each profile was standardized to mean 0 and standard deviation 1."
        if rules.standardize
        else ""
    )
    groups = joined(
        [
            f"{registration.difference['difference']:.2f} nodes ({_SIDES[hemi]};"
            f" p = {registration.difference['difference_p']:.2g})"
            for hemi, registration in analysis.registrations.items()
            if registration.difference
        ]
    )
    moved = (
        f" The largest difference of mean displacement between groups was {groups}, corrected for"
        f" all positions by {rules.group_permutations} permutations of participants."
        if groups
        else ""
    )
    outliers = {0: "No warp was an outlier", 1: "One warp was an outlier"}
    return (
        "Maps of each hemisphere were registered along the medial-to-lateral axis by their profiles"
        f" of mean curvature, averaged from posterior to anterior.{standardization} A template and"
        f" monotone B-spline warps were estimated alternately {cite('registr')}. The warps were"
        " applied to all maps. The variance of the profiles explained by their mean was"
        f" {shares}.{moved} {outliers.get(extreme, f'{extreme} warps were outliers')}."
    )


def _rims(analysis: Analysis) -> str:
    """Return how points were handled that some participants lack."""
    fits = [fit for side in analysis.fitted.values() for fit in side.fits.values()]
    n = np.concatenate([fit.n[np.isfinite(fit.tests[0].p)] for fit in fits])
    span = f" ({n.min()} to {n.max()} per point)" if len(n) else ""
    return (
        "Points within 1 mm of edges, ends and filled holes of a sheet had no value. Points with a"
        f" value in fewer than {LEAST_SHARE:.0%} of the participants were excluded. Missing values"
        " were not imputed; each point was tested in the participants with a value"
        f"{span}. Profiles for registration were means of available values, interpolated at"
        " positions without any."
    )


def _models(analysis: Analysis, settings: GroupSettings, cite: Callable[[str], str]) -> str:
    contrasts = analysis.design.contrasts
    levels = escaped(", ".join(map(" ".join, analysis.design.references.items())))
    fits = [fit for maps in analysis.fitted.values() for fit in maps.fits.values()]
    sessions = analysis.comparison.sessions
    place = "at each point of the sheet" if analysis.fitted else "to each summary measure"
    text = (
        f"A {analysis.row_model.kind}, {code(analysis.model.text)}, was fitted {place}"
        f"{sessions.subject}{f' (reference levels: {levels})' if levels else ''}."
    )
    if analysis.model.maps:
        text += f" Maps were covariates, with the value of each point {cite('point-covariates')}."
    if analysis.model.summaries:
        text += " Summary measures in it were covariates of the same hemisphere."
    if interactions(analysis.model.formula):
        text += (
            " Levels were compared at equal weights of other factors and at the means of covariates"
            f" {cite('marginal-means')}."
        )
    if settings.glm.covariance == "hc3":
        text += f" Standard errors allowed for unequal variances (HC3) {cite('hc3')}."
    text += sessions.methods(analysis.row_model, fits, settings, cite)
    text += _tests(contrasts)
    if "Satterthwaite" in text and any(contrast.n_rows > 1 for contrast in contrasts):
        text += f" Contrasts of several rows were tested by F {cite('fai')}."
    text += sessions.findings(fits, cite)
    text += f" {_correction(settings.multiplicity, cite, analysis)}" if analysis.fitted else ""
    text += _effect_sizes(analysis, settings, cite)
    return f"{text}{_nonlinear(analysis, settings)}"


def _effect_sizes(analysis: Analysis, settings: GroupSettings, cite: Callable[[str], str]) -> str:
    """Return the definitions of effect sizes, and how summary measures were tested."""
    contrasts = analysis.design.contrasts
    d = f"Cohen's d (the estimate divided by {analysis.comparison.sessions.sd})"
    kinds = [d] * any(contrast.n_rows == 1 for contrast in contrasts)
    kinds += ["partial eta squared"] * any(contrast.n_rows > 1 for contrast in contrasts)
    adjusted = any(formula != analysis.model.formula for _, formula in analysis.measures)
    sizes = f"; {SIZES} were also adjusted for intracranial volume" if adjusted else ""
    text = (
        f" Effect sizes are {' or '.join(kinds)}, with {settings.glm.confidence:.0%} confidence"
        f" limits from non-central distributions {cite('steiger')}."
    )
    if analysis.measures:
        tests = [test for _, fit, _ in analysis.measures.values() for test in fit.tests]
        n_families = len({test.contrast.name for test in tests})
        text += (
            f" Summary measures were tested with the same model{sizes}. Their false discovery"
            " rate was controlled over all measures, sides and models of a contrast (families of"
            f" tests: {n_families})."
        )
    return text


def _tests(contrasts: Sequence[Contrast]) -> str:
    """Return the names of contrasts, and the alternatives of one-sided tests."""
    names = escaped(joined([contrast.name for contrast in contrasts]))
    text = f" Contrasts were {names}." if len(contrasts) > 1 else f" The contrast was {names}."
    if sided := [f"{escaped(c.name)} ({c.hypothesis})" for c in contrasts if c.side]:
        text += f" Tests were one-sided, with this alternative and margin: {joined(sided)}."
    return text


def _nonlinear(analysis: Analysis, settings: GroupSettings) -> str:
    """Return how age was modeled, and in how many summary measures it was not linear."""
    names = [c.name for c in analysis.design.contrasts if c.name.endswith(" nonlinear")]
    if not names or settings.model.age == "linear":
        return ""
    curve = "its square" if settings.model.age == "quadratic" else "a natural cubic spline"
    p = [
        test.p
        for _, fit, _ in analysis.measures.values()
        for test in fit.tests
        if test.contrast.name in names
    ]
    result = inference.control_fdr(np.concatenate(p or [np.empty(0)]), settings.multiplicity.alpha)
    return (
        f" Age was modeled with {curve}. The contrast {escaped(names[0])} tested the departure from"
        f" a line; it was significant in {int(result.rejected.sum())} of {result.n_tests} tests of"
        " summary measures (false discovery rate)."
    )


def _correction(rules: MultiplicitySettings, cite: Callable[[str], str], analysis: Analysis) -> str:
    if rules.method not in inference.PERMUTATIONS:
        return f"{discovery_text(rules, cite, analysis.found)}."
    inside = f" within levels of {escaped(rules.blocks)}" if rules.blocks else ""
    visits, design = analysis.row_model.visits, analysis.design
    kind = "model" if visits is None else "linear model"
    text = (
        f"The family-wise error rate was controlled at {rules.alpha:g} over"
        f" {_families(rules, analysis.found)}, by {rules.permutations} permutations{inside} (seed"
        f" {rules.seed}) {cite('permutation')}. Residuals of the {kind} without the contrast were"
        f" permuted {cite('freedman')}."
    )
    if visits is not None:
        visits = replace(
            visits, blocks=inference.row_blocks(analysis.row_model, analysis.compared.table, rules)
        )
        exchanged = exchange_text(design.matrix, design.contrasts, visits, rules.visits)
        text += f" {escaped(exchanged)} {cite('repeated')}."
    elif analysis.comparison.asymmetry or not all(
        spans_constant(design.matrix, contrast) for contrast in design.contrasts
    ):
        text += " For means, the signs of residuals were flipped instead."
    if rules.method == "permutation-tfce":
        return (
            f"{text} The statistic was the largest threshold-free cluster enhancement"
            f" {cite('tfce')} (extent {TFCE_EXTENT:g}, height {TFCE_HEIGHT:g})."
        )
    return f"{text} The statistic was the largest absolute statistic of all points."


def _families(rules: MultiplicitySettings, maps: Iterable[inference.MapKey]) -> str:
    """Return which points are one family of tests, and the number of families."""
    n = len(inference.families(maps, rules.scope))
    return f"{_FAMILIES[rules.scope]} ({n} {'family' if n == 1 else 'families'} of tests)"


def discovery_text(
    rules: MultiplicitySettings, cite: Callable[[str], str], maps: Iterable[inference.MapKey]
) -> str:
    """Return how the false discovery rate was controlled."""
    return (
        f"The false discovery rate was controlled at {rules.alpha:g} by {PROCEDURES[rules.method]}"
        f" {cite(rules.method)}, over {_families(rules, maps)}"
    )


def _asymmetry(analysis: Analysis, settings: GroupSettings, cite: Citations) -> str:
    definition = "The asymmetry of each map was left minus right, in the unit of the measure."
    if (relative := settings.asymmetry.relative) and not analysis.comparison.sessions.later:
        definition = (
            f"The asymmetry of {joined(relative)} was (L - R) / ((L + R) / 2) {cite('asymmetry')};"
            " the asymmetry of other maps was L - R, in the unit of the measure."
        )
    return (
        f"{definition} Points of the registered sheets correspond between sides. The contrast"
        " `mean` tested the mean asymmetry of all participants."
    )


def _classification(analysis: Analysis, settings: GroupSettings, cite: Citations) -> str:
    rules, base = settings.classification, escaped(" + ".join(settings.classification.base))
    delong = cite("delong")
    separated = sum(models.columns["separated"] for *_, models in analysis.pairs)
    by_firth = (
        f" In {separated} comparisons a model separated the groups completely; both models were"
        f" then fitted by Firth's method {cite('firth')}."
        if separated
        else ""
    )
    is_judged = any(models.full.calibration.judged for *_, models in analysis.pairs)
    calibration = (
        f" Calibration was assessed if both groups had {rules.least_calibrated} members or more"
        f" {cite('snell')}."
        if is_judged
        else ""
    )
    return (
        f"Pairs of groups were classified by logistic models of {base}, without and with one"
        " further measure. A likelihood-ratio test compared both models in the same participants."
        f" Areas under the curve had DeLong confidence intervals {delong}. They were also estimated"
        f" by stratified {rules.folds}-fold cross-validation with {rules.repeats} repeats (seed"
        f" {rules.seed}).{by_firth}{calibration}"
    )


def _findings(analysis: Analysis) -> str:
    lines = []
    for key, discoveries in analysis.found.items():
        count = int(discoveries.rejected.sum())
        text = f"{key.measure}, {key.contrast}, {key.hemi}: {count} of {discoveries.n_tests} points"
        if count and np.isfinite(discoveries.cutoff):
            text += f" (p up to {discoveries.cutoff:.2g}, uncorrected)"
        if discoveries.lenient:
            text += (
                ", a cut-off above the level, as widespread effects or shifts of all values permit"
            )
        lines.append(f"- {escaped(text)}")
    return "\n".join(["Significant points after correction:", "", *lines])
