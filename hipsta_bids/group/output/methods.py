"""A methods and results paragraph with the numbers of one analysis filled in."""

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from hipsta_bids import __version__
from hipsta_bids.derivatives.dataset import references
from hipsta_bids.group.cohort.data import Cohort
from hipsta_bids.group.cohort.read import LEAST_SHARE
from hipsta_bids.group.design import settings as group_settings
from hipsta_bids.group.output.results import Analysis
from hipsta_bids.group.output.saved import NormsFile
from hipsta_bids.group.stats.clusters import TFCE_EXTENT, TFCE_HEIGHT
from hipsta_bids.group.stats.exchangeability import exchange_text
from hipsta_bids.group.stats.inference import PERMUTATIONS, control_fdr, row_blocks
from hipsta_bids.group.stats.norms import CENTILE_FOLDS, LEVELS, SHAPE_LEVEL
from hipsta_bids.group.stats.trials import THINNING, TrialEffect, point_level
from hipsta_bids.protocols import EXPERIMENTAL
from hipsta_bids.types import PARTICIPANT

REFERENCES = "# References"
#: Level at which slopes are said to differ.
_LEVEL = 0.05

#: What was measured, by region.
_MEASURED = {
    "body": "the hippocampus",
    "extended": "the hippocampus and the neighboring cortex",
    "entorhinal": "the cortex beside the hippocampus",
    "headbody": "the head and the body of the hippocampus on one sheet (experimental)",
    "whole": "the whole hippocampus on one sheet (experimental)",
}

_FAMILIES = {"map": "each map", "hemispheres": "both hemispheres together"}
#: Procedures that hold false discovery rates.
PROCEDURES: Mapping[str, str] = {
    "bh": "the procedure of Benjamini and Hochberg",
    "fdr2": "the two-stage procedure of Benjamini, Krieger and Yekutieli",
}


#: Signs in a name that Markdown, or the HTML in it, would take for its own.
_SIGNS = re.compile(r"([\\`*~<$]|\](?=\()|&(?=#?\w+;)|(?<!\w)_|_(?!\w))")


def escaped(text: object) -> str:
    """Escape a name, or a text with names, that Markdown should show as it is."""
    return _SIGNS.sub(r"\\\1", " ".join(str(text).split()))


def code(formula: str) -> str:
    """Write a formula as Markdown's code; it may have backticks."""
    return f"`` {formula} ``" if "`" in formula else f"`{formula}`"


class Citations:
    """Numbers works in the order in which a text names them."""

    def __init__(self) -> None:
        self._keys: list[str] = []

    def __call__(self, key: str) -> str:
        """Return the number of a work in brackets."""
        if key not in self._keys:
            self._keys.append(key)
        return f"[{self._keys.index(key) + 1}]"

    def page(self, paragraphs: Sequence[str], region: str = "body") -> str:
        """Return the text with its references; the first paragraph names the measures."""
        region_text = _MEASURED["body"]
        first = paragraphs[0].replace(region_text, _MEASURED.get(region, region_text), 1)
        bibliography = references()
        works = "\n".join(f"{i}. {bibliography[key]}" for i, key in enumerate(self._keys, start=1))
        use = "This text may be used freely, as it stands or changed."
        parts = ["# Methods and findings", use, first, *paragraphs[1:], REFERENCES, works]
        return "\n\n".join(parts) + "\n"


def methods_text(
    cohort: Cohort,
    analysis: Analysis,
    settings: group_settings.GroupSettings,
    n_out: int,
    *,
    surfaces: Sequence[str] = (),
    region: str = "body",
    ratings: Mapping[str, int] | None = None,
) -> str:
    """Word the methods and the results."""
    cite = Citations()
    paragraphs = [_sample(cohort, analysis, n_out, cite("method"), surfaces)]
    if ratings is not None:
        counts = ", ".join(f"{n} {rating}" for rating, n in ratings.items())
        paragraphs[0] += (
            f" Hemispheres were rated on their report pages ({counts}); hemispheres"
            " rated exclude were excluded."
        )
    aligned = [_registration(analysis, settings, cite)] if analysis.registrations else []
    if surfaces:
        aligned.append(
            f"Maps of other programs ({', '.join(surfaces)}) were taken as they are, point by"
            " point, without registration."
        )
    if aligned:
        paragraphs.append(" ".join(aligned))
    if region in EXPERIMENTAL and analysis.fitted:
        paragraphs.append(_rims(analysis))
    paragraphs += _harmonization(analysis, cite)
    paragraphs.append(_models(analysis, settings, cite))
    paragraphs += [_joint(settings, cite)] if settings.joint.measures else []
    if analysis.comparison.asymmetry:
        paragraphs.append(_asymmetry(analysis, settings, cite))
    if analysis.reference is not None:
        group = " ".join(analysis.comparison.normative or ())
        paragraphs.append(_normative(*analysis.reference, group, settings, cite("normative")))
    if analysis.pairs:
        paragraphs.append(_classification(analysis, settings, cite))
    if analysis.found:
        paragraphs.append(_findings(analysis))
    if analysis.skipped:
        points = (f"- {escaped(line)}" for line in analysis.skipped)
        paragraphs.append("\n".join(["Excluded:", "", *points]))
    return cite.page(paragraphs, region)


def _sample(
    cohort: Cohort, analysis: Analysis, n_out: int, method: str, surfaces: Sequence[str]
) -> str:
    rows = analysis.design.rows
    table = analysis.compared.table.iloc[rows]
    people = cohort.table[PARTICIPANT].nunique()
    visits = f" ({len(cohort.table)} visits)" if len(cohort.table) > people else ""
    names = [name.replace("_", " ") for name in (*analysis.measured.maps, *surfaces)]
    maps = ", ".join(f"map of {name}" for name in names) or "summaries"
    text = (
        f"Measures of the hippocampus {method} ({maps}) of"
        f" {people} participants{visits} were analyzed with hipsta_bids {__version__};"
        f" {analysis.n_participants} had all variables of the model"
    )
    if analysis.groups is not None:
        members = table[analysis.groups.column][~table[PARTICIPANT].duplicated()]
        counts = Counter(members.dropna().astype(str))
        text += f" ({', '.join(f'{counts[g]} {escaped(g)}' for g in analysis.groups.levels)})"
    if sheets := ", ".join(f"{len(one.used)} {hemi}" for hemi, one in analysis.fitted.items()):
        text += f", with hemispheres {sheets}"
    return f"{text}. {n_out} hemispheres or visits were excluded (see the table of exclusions)."


def _registration(
    analysis: Analysis, settings: group_settings.GroupSettings, cite: Callable[[str], str]
) -> str:
    rules = settings.registration
    if rules.align == "none":
        return "Maps were not registered to each other."
    method = f"alternating fits of a template and of monotone B-spline warps {cite('registr')}"
    shares = "; ".join(
        f"{hemi}: {one.explained_before:.0%} to {one.explained_after:.0%}"
        for hemi, one in analysis.registrations.items()
    )
    extreme = sum(int(one.extreme.sum()) for one in analysis.registrations.values())
    standardization = (
        ", each less its mean and over its standard deviation," if rules.standardize else ""
    )
    groups = "; ".join(
        f"{hemi}: {one.difference['difference']:.2f} nodes,"
        f" p = {one.difference['difference_p']:.2g}"
        for hemi, one in analysis.registrations.items()
        if one.difference
    )
    moved = (
        " The largest difference of mean displacement between groups, with its p-value corrected"
        f" for all positions by {rules.group_permutations} permutations of participants, was"
        f" {groups}."
        if groups
        else ""
    )
    return (
        "Curvature profiles from medial to lateral (means from posterior to"
        f" anterior){standardization} were registered by {method}, and the warps were applied to"
        " all maps. The mean profile explained this share of the variance, before to after:"
        f" {shares}.{moved} Warps out of line with the others: {extreme}."
    )


def _rims(analysis: Analysis) -> str:
    """Word the handling of points that some participants lack."""
    fits = [fit for one in analysis.fitted.values() for fit in one.fits.values()]
    n = np.concatenate([fit.n[np.isfinite(fit.tests[0].p)] for fit in fits])
    span = f" ({n.min()} to {n.max()} per point)" if len(n) else ""
    return (
        "Sheets have no values within 1 mm of edges, ends and filled holes, which differ between"
        f" participants; points present in fewer than {LEAST_SHARE:.0%} were excluded. No value"
        f" was imputed: a point was tested in participants with a value{span}. Profiles for"
        " registration are means of known values, interpolated where a whole position has none."
    )


def _harmonization(analysis: Analysis, cite: Callable[[str], str]) -> list[str]:
    harmonization = analysis.harmonization
    if harmonization is None:
        return []
    plan = harmonization.plan
    counts = ", ".join(f"{escaped(site)} {n}" for site, n in plan.counts.items())
    column = escaped(plan.column)
    sources = f"{cite('johnson')}, {cite('combat')}"
    preserved = code(plan.formula) if plan.names else "no variable"
    if plan.icv is not None:
        preserved += f", for volumes also {escaped(plan.icv)}"
    text = (
        f"ComBat {sources} removed effects of {column} ({counts} participants) from"
        f"{' the registered' if analysis.registered else ''} maps and summary measures."
        " At each point it estimates a shift and a scale of the residuals of a linear model that"
        f" keeps {preserved}. The two were pooled over the points of a map by empirical Bayes, and"
        " estimated for each summary measure by itself. Missing values were excluded point by"
        " point."
    )
    if plan.visits.participant is not None:
        text += (
            " Participants had random intercepts, which were kept, so that the scale"
            f" describes differences within participants {cite('beer')}."
        )
    if plan.saved is not None:
        saved_sites = sum(site in plan.saved.sites for site in plan.counts)
        text += f" Parameters of {saved_sites} of these were from an earlier analysis"
        new = escaped(", ".join(plan.estimated))
        text += f"; parameters of {new} were new." if new else "."
    if plan.estimated and not analysis.comparison.pair:
        columns_lost = len(plan.counts) - 1
        text += (
            f" The shifts were estimated from the same participants, therefore {column} is also a"
            f" factor of the model, which costs {columns_lost}"
            f" degree{'s' if columns_lost > 1 else ''} of freedom. Without it, tests would reject"
            f" too often {cite('nygaard')}."
        )
    if analysis.pairs and analysis.groups and harmonization.leaks(analysis.groups.column):
        text += (
            " Classifiers were given the measures before harmonization: parameters estimated with"
            " the groups known would reveal the groups of held-out participants."
        )
    return [text]


def _models(
    analysis: Analysis, settings: group_settings.GroupSettings, cite: Callable[[str], str]
) -> str:
    names = escaped(", ".join(contrast.name for contrast in analysis.design.contrasts))
    levels = escaped(", ".join(map(" ".join, analysis.design.references.items())))
    errors = " with HC3 standard errors" if settings.glm.covariance == "hc3" else ""
    kind, subject, d = "linear model", "", "estimate over residual standard deviation"
    if analysis.comparison.pair:
        first, second = analysis.comparison.pair
        subject = f" to the change from {first} to {second}, with the covariates of {first}"
    if analysis.comparison.longitudinal:
        visits = analysis.row_model.visits
        effects = "intercepts and slopes" if visits is not None and visits.slopes else "intercepts"
        kind = f"linear mixed model with {effects} of participants"
        errors = (
            " by restricted maximum likelihood, with Satterthwaite's degrees of freedom"
            f" {cite('mixed')}{_slopes(analysis, cite)}"
        )
        d = "estimate over the standard deviation of single visits"
    corrected = _correction(settings.multiplicity, cite, analysis)
    adjusted = any(formula != analysis.model.formula for _, formula in analysis.measures)
    volumes = ", volumes also with intracranial volume" if adjusted else ""
    return (
        f"At each point of the sheet a {kind} {code(analysis.model.formula)} was"
        f" fitted{subject}{errors} (reference levels: {levels or 'none'}); contrasts: {names}."
        f" {corrected} Effect sizes are"
        f" Cohen's d ({d}) or partial eta squared, with"
        f" {settings.glm.confidence:.0%} confidence limits from non-central distributions. Summary"
        f" measures were tested in the same model{volumes}; their"
        " false discovery rate was held over all measures, sides and models of a contrast."
        f"{_nonlinear(analysis, settings)}"
    )


def _slopes(analysis: Analysis, cite: Callable[[str], str]) -> str:
    """Word at how many points slopes vary, and where their variance is zero."""
    fits = [fit for one in analysis.fitted.values() for fit in one.fits.values()]
    p = np.concatenate([fit.slopes_p for fit in fits if fit.slopes_p is not None] or [np.empty(0)])
    tested = int(np.isfinite(p).sum())
    if not tested:
        return ""
    return (
        f". Slopes differed between participants at {np.sum(p < _LEVEL) / tested:.0%} of the points"
        f" (p < {_LEVEL:g}, uncorrected). The test is a ratio of restricted likelihoods against an"
        f" equal mixture of chi squared with 1 and 2 degrees of freedom {cite('mixture')}. At"
        f" {np.sum(p == 1) / tested:.0%} the variance of slopes was zero, and the model had none"
    )


def _nonlinear(analysis: Analysis, settings: group_settings.GroupSettings) -> str:
    """Word the model of age, and the number of summary measures in which it bends."""
    names = [one.name for one in analysis.design.contrasts if one.name.endswith(" nonlinear")]
    if not names or settings.model.age == "linear":
        return ""
    curve = "its square" if settings.model.age == "quadratic" else "a natural cubic spline"
    p = [
        test.p
        for _, fit, _ in analysis.measures.values()
        for test in fit.tests
        if test.contrast.name in names
    ]
    result = control_fdr(np.concatenate(p or [np.empty(0)]), settings.multiplicity.alpha)
    return (
        f" Age was in the model with {curve}; the contrast {escaped(names[0])} tests whether that"
        f" differs from a line. It did in {int(result.rejected.sum())} of {result.n_tests} tests"
        " of summary measures (false discovery rate)."
    )


def _correction(
    rules: group_settings.MultiplicitySettings, cite: Callable[[str], str], analysis: Analysis
) -> str:
    family = _FAMILIES[rules.scope]
    if rules.method in PERMUTATIONS:
        statistic = "the largest absolute statistic"
        if rules.method == "permutation-tfce":
            statistic = (
                f"the largest threshold-free cluster enhancement {cite('tfce')} (extent"
                f" {TFCE_EXTENT:g}, height {TFCE_HEIGHT:g})"
            )
        inside = f" within levels of {escaped(rules.blocks)}" if rules.blocks else ""
        shuffled = (
            "the residuals of the model without the contrast (Freedman and Lane's; of signs, where"
            " a mean was tested"
        )
        visits, end = analysis.row_model.visits, ""
        if visits is not None:
            shuffled = (
                "the residuals of the linear model without the contrast (Freedman and Lane's;"
                f" repeated visits {cite('repeated')}"
            )
            design = analysis.design
            blocks = row_blocks(analysis.row_model, analysis.compared.table, rules)
            visits = replace(visits, blocks=blocks)
            end = escaped(exchange_text(design.matrix, design.contrasts, visits, rules.visits))
        return (
            f"The family-wise error rate was held at {rules.alpha:g} by {statistic} in"
            f" {rules.permutations} permutations{inside} of {shuffled}; seed"
            f" {rules.seed}) {cite('permutation')}, for {family}.{end}"
        )
    return f"{discovery_text(rules, cite)}."


def discovery_text(rules: group_settings.MultiplicitySettings, cite: Callable[[str], str]) -> str:
    """Word how the false discovery rate was held."""
    return (
        f"The false discovery rate was held at {rules.alpha:g} by {PROCEDURES[rules.method]}"
        f" {cite(rules.method)}, for {_FAMILIES[rules.scope]}"
    )


def _joint(settings: group_settings.GroupSettings, cite: Callable[[str], str]) -> str:
    rules, joint = settings.multiplicity, settings.joint
    by = (
        "minus twice the sum of the logarithms of their two-sided p-values (Fisher)"
        if joint.combine == "fisher"
        else "the smallest of their two-sided p-values (Tippett)"
    )
    statistic = "the combined evidence"
    if rules.method == "permutation-tfce":
        statistic = f"its threshold-free cluster enhancement {cite('tfce')}"
    family = "" if joint.sides else " of each side" if rules.scope == "map" else " of both sides"
    names = " and ".join(name.replace("_", " ") for name in joint.measures)
    return (
        f"Maps of {names}{', of the left and the right side,' if joint.sides else ''} were also"
        f" tested together by non-parametric combination {cite('joint')}. At each point the"
        f" evidence is {by}, as the normal quantile of its two-sided p-value for independent maps."
        f" In each of {rules.permutations} permutations of residuals (Freedman and Lane's; seed"
        f" {rules.seed}) {cite('permutation')} all maps were shuffled alike to keep"
        f" their dependence. The largest value of {statistic} in each holds the"
        f" family-wise error rate at {rules.alpha:g} over the points{family}. The null hypothesis"
        " of a point is that no map has an effect there. The effect sizes of each map show the"
        " source of a finding."
    )


def norms_text(
    file: NormsFile,
    *,
    sample: str,
    coverage: pd.DataFrame | None,
    new: Sequence[str],
    controls: tuple[str, str] | None,
) -> str:
    """Word how norms were made, or how participants were scored by them.

    ``coverage`` is of norms that were made; ``new`` sites are last.
    """
    cite = Citations()
    ages = f"{file.knots[0]:g} to {file.knots[-1]:g} years"
    first = f"Measures of the hippocampus {cite('method')} of {sample} were "
    if coverage is not None:
        first += f"taken as norms for ages of {ages} with hipsta_bids {__version__}."
    else:
        first += (
            f"compared with norms of {file.participants} participants of {ages} from"
            f" {len(file.sites) - len(new)} sites (hipsta_bids {__version__}; norms made by"
            f" {file.version})."
        )
    if file.template is not None:
        template = "each other" if coverage is not None else "the template of the norms"
        first += f" Sheets were registered to {template} by curvature profiles {cite('registr')}."
    model = (
        f"Norms have a mean with a natural cubic spline of age ({len(file.knots)} knots) and"
        f" constants for {'sex and ' if file.sexes else ''}site. The logarithm of their SD is"
        f" linear in age with a constant for each site {cite('gamlss')}. They were fitted at each"
        f" point and for each summary measure. Where a likelihood-ratio test (p < {SHAPE_LEVEL:g})"
        f" rejected a normal distribution, residuals have a sinh-arcsinh distribution"
        f" {cite('shash')}, as in {cite('warped')}. Deviations z are normal quantiles of the"
        " probability of a value. It includes the uncertainty of the site's shift and scale"
        " (Student's t)."
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
            f"In {CENTILE_FOLDS}-fold cross-validation {' and '.join(parts)} lay below centiles"
            f" {levels}."
        )
    if new:
        counts = ", ".join(f"{escaped(site)} ({file.sites[site]})" for site in new)
        paragraphs.append(
            "Shift and scale of sites without norms were estimated from their controls"
            f" {escaped('='.join(controls or ()))}: {counts}. All else was kept."
        )
    return cite.page(paragraphs, file.region)


def _asymmetry(analysis: Analysis, settings: group_settings.GroupSettings, cite: Citations) -> str:
    unit = "their own unit"
    if (relative := settings.asymmetry.relative) and not analysis.comparison.pair:
        ratio = f"{' and '.join(relative)} as (L - R) / ((L + R) / 2) {cite('asymmetry')}"
        unit = f"{unit}, but of {ratio}"
    return (
        "Left minus right was taken at each point of the registered sheets, which are numbered"
        f" alike on both sides, in {unit}. The contrast `mean` tests it over all participants."
    )


def _normative(
    formula: str, n_reference: int, group: str, settings: group_settings.GroupSettings, source: str
) -> str:
    return (
        f"Each participant was scored against {n_reference} with {escaped(group)}. The score w is"
        f" the difference from the prediction of their linear model {code(formula)}, over its"
        f" residual standard deviation {source}. Members of the reference group were scored by"
        " the model without themselves."
        " Points count as low or high where the two-sided p, with the uncertainty of the model, is"
        " below"
        f" {1 - settings.glm.confidence:.2g}."
    )


def _classification(
    analysis: Analysis, settings: group_settings.GroupSettings, cite: Citations
) -> str:
    rules, base = settings.classification, escaped(" + ".join(settings.classification.base))
    delong, firth, snell = map(cite, ("delong", "firth", "snell"))
    separated = sum(one.columns["separated"] for *_, one in analysis.pairs)
    by_firth = (
        f" {separated} comparisons were separated and fitted by Firth's method {firth}."
        if separated
        else f" No comparison was separated (else Firth's method {firth} is used)."
    )
    return (
        f"Pairs of groups were discriminated by logistic models of {base}, and by the same models"
        " with one measure added. A likelihood-ratio test compares the two, on the same"
        f" participants. Areas under the curve have DeLong intervals {delong}. They are also given"
        f" from {rules.folds}-fold stratified cross-validation repeated {rules.repeats} times (seed"
        f" {rules.seed}).{by_firth} Calibration is judged where both groups have"
        f" {rules.least_calibrated} members or more {snell}."
    )


def _findings(analysis: Analysis) -> str:
    parts = []
    for key, discoveries in analysis.found.items():
        count = int(discoveries.rejected.sum())
        text = f"{key.measure}, {key.contrast}, {key.hemi}: {count} of {discoveries.n_tests} points"
        if count and np.isfinite(discoveries.cutoff):
            text += f" (p up to {discoveries.cutoff:.2g})"
        if discoveries.lenient:
            text += " - this cut-off is above the level, as happens with widespread effects"
        parts.append(text)
    return "Points that survive: " + escaped("; ".join(parts)) + "."


Cite = Callable[[str], str]
"""Numbers a work by its key."""


def power_text(
    effect: TrialEffect,
    settings: group_settings.GroupSettings,
    source: Callable[[Cite], str],
    cite: Cite,
) -> str:
    """Word the question and its answer; ``source`` words the origin of the variances."""
    plan, rules = settings.power, settings.multiplicity
    months = ", ".join(f"{month:g}" for month in effect.visits)
    question = f"{100 * effect.share:g} % of the change over time is prevented"
    if effect.kind == THINNING:
        question = f"the arms differ by {100 * effect.share:g} % of the mean"
        question += f" after {effect.duration:g} months" if effect.visits else ""
    end = "A participant's value is the end point."
    if effect.visits:
        end = (
            f"The end point is the slope over visits at months {months}. Its variance has two"
            " terms: true slopes between participants, and the variance within participants over"
            f" the sum of squared times {cite('ard')}."
        )
    dropout = f", if {100 * plan.dropout:g} % drop out" if plan.dropout else ""
    if dropout and effect.visits:
        dropout += " at a constant hazard and are analyzed with the visits before"
    return (
        f"Sample sizes are for a trial of two equal arms in which {question}, with a"
        f" power of {plan.power:g}{dropout}. {end} Means, changes and variances are from"
        f" {source(cite)}. Power follows Student's two-sided t test (non-central t), at the"
        f" level {plan.alpha:g} for a summary measure. It is not corrected, since a trial has one"
        f" primary end point. At single points the level is {point_level(rules, plan):.2g}:"
        f" {PROCEDURES[rules.method]} {cite(rules.method)} then holds the false discovery rate at"
        f" {rules.alpha:g} {cite('jung')} {cite('liu')}. It is assumed that"
        f" {100 * plan.affected:g} % of the points of a map differ and are found with this power"
        " on average. Of many measures the one that needs fewest"
        " does so partly by chance; its number is too small on average."
    )


def retest_text(
    sessions: int, participants: int, settings: group_settings.RetestSettings, cite: Cite
) -> str:
    """Word how agreement was measured."""
    return (
        f"Agreement between {sessions} sessions of {participants}"
        " participants was estimated at each point of the maps and for each summary measure. The"
        " within-subject standard deviation is the root of the mean variance of a participant's"
        f" values {cite('bland')}. A change beyond 1.96 √2 times this is unlikely to be measurement"
        f" alone (minimal detectable change {cite('weir')}). The intraclass correlation is"
        " ICC(2,1), of two-way random effects, absolute agreement and single measurements"
        f" {cite('shrout')}, with {settings.confidence:.0%} limits {cite('mcgraw')}. It depends on"
        " how much these participants differ; the within-subject standard deviation does not."
    )
