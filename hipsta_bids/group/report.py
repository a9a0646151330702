"""A methods and results paragraph with the numbers of one analysis filled in."""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from hipsta_bids import __version__
from hipsta_bids.group.analysis import Analysis
from hipsta_bids.group_data import Cohort
from hipsta_bids.group_settings import GroupSettings

#: Key and entry of each work that the methods rest on.
_REFERENCES = {
    "method": "Diers K, Baumeister H, Jessen F, Düzel E, Berron D, Reuter M. An automated,"
    " geometry-based method for hippocampal shape and thickness analysis. NeuroImage"
    " 2023;276:120182. doi:10.1016/j.neuroimage.2023.120182",
    "registr": "Wrobel J. register: registration for exponential family functional data. Journal"
    " of Open Source Software 2018;3(22):557. doi:10.21105/joss.00557",
    "two-stage": "Benjamini Y, Krieger AM, Yekutieli D. Adaptive linear step-up procedures that"
    " control the false discovery rate. Biometrika 2006;93(3):491-507."
    " doi:10.1093/biomet/93.3.491",
    "benjamini-hochberg": "Benjamini Y, Hochberg Y. Controlling the false discovery rate: a"
    " practical and powerful approach to multiple testing. Journal of the Royal Statistical"
    " Society B 1995;57(1):289-300.",
    "delong": "DeLong ER, DeLong DM, Clarke-Pearson DL. Comparing the areas under two or more"
    " correlated receiver operating characteristic curves: a nonparametric approach. Biometrics"
    " 1988;44(3):837-845.",
    "firth": "Heinze G, Schemper M. A solution to the problem of separation in logistic"
    " regression. Statistics in Medicine 2002;21(16):2409-2419. doi:10.1002/sim.1047",
}


def methods_text(cohort: Cohort, analysis: Analysis, settings: GroupSettings, n_out: int) -> str:
    """Word what was done and what came out.

    Parameters
    ----------
    cohort : Cohort
        What was analyzed.
    analysis : Analysis
        Results.
    settings : GroupSettings
        Those in use.
    n_out : int
        Hemispheres and visits that were left out.

    Returns
    -------
    str
        Markdown.
    """
    cited: list[str] = []

    def cite(key: str) -> str:
        if key not in cited:
            cited.append(key)
        return f"[{cited.index(key) + 1}]"

    paragraphs = [_sample(cohort, analysis, n_out, cite("method"))]
    if analysis.sides:
        paragraphs.append(_registration(analysis, settings, cite("registr")))
    paragraphs.append(_models(analysis, settings, cite(settings.multiplicity.method)))
    if analysis.pairs:
        paragraphs.append(_classification(analysis, settings, cite("delong"), cite("firth")))
    if analysis.sides:
        paragraphs.append(_findings(analysis))
    lines = ["# Methods and findings", "", "This text may be used freely, as it stands or changed."]
    for paragraph in paragraphs:
        lines += ["", paragraph]
    if analysis.skipped:
        lines += ["", "Left out:", "", *(f"- {note}" for note in analysis.skipped)]
    lines += ["", "# References", ""]
    lines += [f"{i}. {_REFERENCES[key]}" for i, key in enumerate(cited, start=1)]
    return "\n".join(lines) + "\n"


def _sample(cohort: Cohort, analysis: Analysis, n_out: int, method: str) -> str:
    rows = analysis.design.rows
    text = (
        f"Measures of the hippocampus {method} ({_words(analysis.measured.maps) or 'summaries'}) of"
        f" {len(cohort.table)} participants were analyzed with hipsta_bids {__version__};"
        f" {len(rows)} had all variables of the model"
    )
    if analysis.groups is not None:
        names = cohort.table[analysis.groups.column].iloc[rows]
        counts = Counter(names.dropna().astype(str))
        text += f" ({', '.join(f'{counts[g]} {g}' for g in analysis.groups.levels)})"
    if sheets := ", ".join(f"{len(side.used)} {hemi}" for hemi, side in analysis.sides.items()):
        text += f", with hemispheres {sheets}"
    return f"{text}. {n_out} hemispheres or visits were left out; the table of exclusions says why."


def _words(names: Sequence[str]) -> str:
    return ", ".join(f"map of {name.replace('_', ' ')}" for name in names)


def _registration(analysis: Analysis, settings: GroupSettings, registr: str) -> str:
    how = settings.registration
    if how.align == "none":
        return "Maps were not registered to each other."
    method = f"alternating fits of a template and of monotone B-spline warps {registr}"
    if how.align == "penalized":
        method += ", with a penalty on local stretch that was estimated from the data"
    shares = "; ".join(
        f"{hemi}: {side.registration.explained_before:.0%} to"
        f" {side.registration.explained_after:.0%}"
        for hemi, side in analysis.sides.items()
    )
    extreme = sum(int(side.registration.extreme.sum()) for side in analysis.sides.values())
    return (
        "Curvature profiles from medial to lateral (means from posterior to anterior) were"
        f" registered by {method}, and the warps were applied to all maps. The share of the"
        f" variance of the profiles that their mean explains went from {shares}."
        f" {extreme} warps were out of line with the others."
    )


def _models(analysis: Analysis, settings: GroupSettings, fdr: str) -> str:
    names = ", ".join(contrast.name for contrast in analysis.design.contrasts)
    kind = (
        "the two-stage procedure of Benjamini, Krieger and Yekutieli"
        if settings.multiplicity.method == "two-stage"
        else "the procedure of Benjamini and Hochberg"
    )
    family = "each map" if settings.multiplicity.scope == "map" else "both hemispheres together"
    levels = ", ".join(f"{name} {level}" for name, level in analysis.design.references.items())
    errors = " with HC3 standard errors" if settings.glm.covariance == "hc3" else ""
    return (
        f"At each point of the sheet a linear model `{analysis.model.formula}` was fitted{errors}"
        f" (reference levels: {levels or 'none'}); contrasts: {names}. The false discovery rate was"
        f" held at {settings.multiplicity.alpha:g} by {kind} {fdr}, for {family}. Effect sizes are"
        " Cohen's d (estimate over residual standard deviation) or partial eta squared, with"
        f" {settings.glm.confidence:.0%} confidence limits from non-central distributions. Summary"
        " measures were tested in the same model, volumes also with intracranial volume."
    )


def _classification(analysis: Analysis, settings: GroupSettings, delong: str, firth: str) -> str:
    how = settings.classification
    separated = sum(pair.comparison.separated for _, _, pair in analysis.pairs)
    by_firth = (
        f" {separated} comparisons were separated and fitted by Firth's method {firth}."
        if separated
        else f" No comparison was separated (else Firth's method {firth} is used)."
    )
    return (
        f"Pairs of groups were told apart by logistic models of {' + '.join(how.base)}, and of the"
        " same with one measure added; a likelihood-ratio test compares the two, on the same"
        f" participants. Areas under the curve have DeLong intervals {delong}, and are also given"
        f" from {how.folds}-fold stratified cross-validation repeated {how.repeats} times (seed"
        f" {how.seed}).{by_firth}"
    )


def _findings(analysis: Analysis) -> str:
    parts = []
    for key, found in analysis.found.items():
        count = int(found.rejected.sum())
        text = f"{key.measure}, {key.contrast}, {key.hemi}: {count} of {found.n_tests} points"
        if count and np.isfinite(found.cutoff):
            text += f" (p up to {found.cutoff:.2g})"
        if found.lenient:
            text += " - this cut-off is above the level, as happens with widespread effects"
        parts.append(text)
    return "Points that survive: " + "; ".join(parts) + "."
