"""What a reader of results should know, one line each."""

from collections.abc import Iterator

import numpy as np
from scipy import special

from hipsta_bids.group import model as modeling
from hipsta_bids.group.output import results
from hipsta_bids.group.output.tables import opposite_notes
from hipsta_bids.group.questions.study import Study
from hipsta_bids.joints import find_sessions
from hipsta_bids.stats import arrays
from hipsta_bids.stats.grammar import closed_formula
from hipsta_bids.stats.settings import GlmSettings

#: Ratio of variances of a difference, true to that with equal ones, of which a note is made: then
#: 9 % of tests of nothing have p below 0.05.
_UNEQUAL = 1.3


def notes_of(study: Study, analysis: results.Analysis) -> list[str]:
    """List what a reader of the results should know, one line each."""
    time = study.time.column if study.time else None
    return [
        *analysis.skipped,
        *(note for name, note in analysis.design.notes.items() if name != time),
        *_of_cohort(study),
        *_of_results(analysis),
        *unequal_spread(analysis, study.settings.glm),
        *opposite_notes(study.cohort, analysis, study.settings),
        *_of_registration(analysis),
    ]


def _of_cohort(study: Study) -> Iterator[str]:
    if study.options.model.formula is None and study.options.model.file is None:
        for name in modeling.empty_covariates(study.cohort.table, study.settings):
            yield (
                f"{name} is n/a for all, and not in the model; fill it in: {name} may explain "
                "differences"
            )
    if n_later := sum(entry.reason == "later-session" for entry in study.exclusions):
        hints = "".join(f"; {one.hint}" for one in find_sessions())
        yield f"{n_later} later sessions are not in it{hints}"
    if doubtful := sum(record.doubtful for record in study.collection.records):
        yield (
            f"{doubtful} hemispheres to look at first are included without a rating; exclude "
            "them with --exclude-look"
        )


def _of_results(analysis: results.Analysis) -> Iterator[str]:
    if separated := sum(comparison.columns["separated"] for *_, comparison in analysis.pairs):
        yield (
            f"{separated} of {len(analysis.pairs)} comparisons of classifiers are separated, and"
            " fitted by Firth's method"
        )
    for key, discoveries in analysis.found.items():
        if discoveries.lenient:
            yield (
                f"{key.measure}, {key.contrast}, {key.hemi}: p up to {discoveries.cutoff:.3g}"
                " survives, above the level; effects are widespread, or all values are"
                " shifted"
            )


def _of_registration(analysis: results.Analysis) -> Iterator[str]:
    for hemi, registration in analysis.registrations.items():
        if not registration.converged:
            yield f"hemisphere {hemi}: registration had not settled when it ended"
        if n_extreme := int(registration.extreme.sum()):
            yield f"hemisphere {hemi}: extreme warps: {n_extreme}, see warps.tsv"


def unequal_spread(analysis: results.Analysis, settings: GlmSettings) -> Iterator[str]:
    """List pairs of groups that differ in size and SD so that ordinary tests find too much.

    One line per group, about the map in which it differs most from the first.
    """
    groups, worst = analysis.groups, dict[str, tuple[float, str]]()
    named = groups is not None and groups.column in closed_formula(analysis.model.formula).names
    is_mixed = analysis.comparison.sessions.is_repeated or analysis.model.random
    if not named or settings.covariance != "ordinary" or is_mixed:
        return
    for hemi, fitted in analysis.fitted.items():
        members = results.members_of(analysis, results.rows_of(analysis, fitted))
        sizes = {group: int(own.sum()) for group, own in members.items() if own.sum() > 1}
        for measure in fitted.fits:
            sds = {g: arrays.describe_known(fitted.parts(measure, members[g]))[2] for g in sizes}
            (first, n), *remaining = sizes.items()
            for group, m in remaining:
                squares, squares_of_group = sds[first] ** 2, sds[group] ** 2
                pooled = (
                    ((n - 1) * squares + (m - 1) * squares_of_group) / (n + m - 2) * (1 / n + 1 / m)
                )
                ratio = float(np.nansum(squares / n + squares_of_group / m) / np.nansum(pooled))
                if ratio > max(_UNEQUAL, worst.get(group, (0.0,))[0]):
                    worst[group] = ratio, f"{first} ({n}) and {group} ({m}), {measure}, {hemi}"
    for ratio, place_text in worst.values():
        share = 2 * special.ndtr(special.ndtri(0.025) / np.sqrt(ratio))
        yield (
            f"{place_text}: the smaller group varies more, {share:.0%} of null tests have p "
            '< 0.05; set glm.covariance = "hc3" from 20 per group'
        )
