"""The group level from sheets and covariates to results."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import special

from hipsta_bids.errors import ModelError
from hipsta_bids.group.classify import PairComparison
from hipsta_bids.group.combat import SavedEffects
from hipsta_bids.group.comparison import (
    BOTH,
    Comparison,
    asymmetry_maps,
    compare_sessions,
    modeled_table,
)
from hipsta_bids.group.data import (
    MOST_KEPT,
    PARTICIPANT,
    Bool,
    Cohort,
    Float,
    Measures,
    SideMaps,
    WarpedLabels,
    WarpedMaps,
    parts_of_sheets,
    return_memory,
)
from hipsta_bids.group.formula import ModelSpec
from hipsta_bids.group.glm import FittedMaps, PointTest, RowModel, fit_maps, with_mean
from hipsta_bids.group.grammar import closed_formula
from hipsta_bids.group.harmonize import (
    Harmonization,
    SitePlan,
    harmonize_cohort,
    plan_sites,
    without_tests_of_sites,
)
from hipsta_bids.group.inference import (
    PERMUTATIONS,
    Discoveries,
    MapKey,
    check_permutations,
    correct,
)
from hipsta_bids.group.mixed import longitudinal_model
from hipsta_bids.group.model import Design, Groups, build_design
from hipsta_bids.group.normative import Scores, score_cohort
from hipsta_bids.group.read import leave_rare
from hipsta_bids.group.registration import (
    GroupShift,
    Registration,
    ShiftDifference,
    mean_profiles,
    register,
    register_to,
    shift_by_group,
    shift_difference,
)
from hipsta_bids.group.settings import GlmSettings, GroupSettings
from hipsta_bids.group.summaries import MeasureFit, classify_groups, fit_summaries
from hipsta_bids.group.warps import Template, templates_to_json, warp_labels, warp_values
from hipsta_bids.progress import each, tell
from hipsta_bids.reports.display import parts_of

#: Group of all, where there are no groups.
ALL = "all"
#: Ratio of variances of a difference, true to that with equal ones, of which a note is made: then
#: 9 % of tests of nothing have p below 0.05.
_UNEQUAL = 1.3


@dataclass(frozen=True, eq=False, kw_only=True)
class SideResult:
    """Sheets of one hemisphere, registered."""

    registration: Registration
    registered: SideMaps
    """Maps of all visits that were chosen."""
    shifts: Mapping[str, GroupShift]
    """Shifts by group; empty without groups."""
    difference: ShiftDifference | None
    """Between the groups, if there are groups."""


def templates_of(sides: Mapping[str, SideResult]) -> dict[str, Any] | None:
    """Write the templates of registration for ``template.json``; ``None`` without registration."""
    found = {hemi: side.registration.template for hemi, side in sides.items()}
    known = {hemi: template for hemi, template in found.items() if template is not None}
    return templates_to_json(known) if known else None


@dataclass(frozen=True, eq=False, kw_only=True)
class Analysis:
    """Results of one model."""

    model: ModelSpec
    comparison: Comparison
    design: Design
    groups: Groups | None
    sides: Mapping[str, SideResult]
    """Registered sheets by hemisphere."""
    harmonization: Harmonization | None
    """Effects of sites that were taken out after registration, if this was asked for."""
    measured: Measures
    """What the model was fitted to."""
    compared: Cohort
    """Rows of the model's table with registered maps; of two sessions, their differences."""
    row_model: RowModel
    """What was fitted to each row."""
    fitted: Mapping[str, FittedMaps]
    """Fitted maps by hemisphere; ``LR`` is left minus right."""
    found: Mapping[MapKey, Discoveries]
    unregistered: Mapping[MapKey, Discoveries]
    """The same of maps that were not registered; empty without registration, with permutations,
    which are too slow to do twice, and with harmonization from a file."""
    scores: Scores | None
    """Scores of participants against a reference group, if there is one."""
    measures: Sequence[MeasureFit]
    pairs: Sequence[tuple[str, str, PairComparison]]
    """Hemisphere, added measure, and result."""
    skipped: Sequence[str]
    """What was left out, and why; one line each."""

    @property
    def n_participants(self) -> int:
        """Number of participants in the model; some may have several rows."""
        return int(self.compared.table[PARTICIPANT].iloc[self.design.rows].nunique())


def analyze_cohort(
    cohort: Cohort,
    model: ModelSpec,
    groups: Groups | None,
    settings: GroupSettings,
    *,
    measures: Measures,
    references: Mapping[str, str],
    comparison: Comparison | None = None,
    time: str | None = None,
    icv: str | None = None,
    templates: Mapping[str, Template] | None = None,
    site_effects: SavedEffects | None = None,
) -> Analysis:
    """Register, fit a model at each point and to each summary measure, and classify.

    Parameters
    ----------
    cohort : Cohort
        The visits that are compared.
    model : ModelSpec
        Formula and contrasts.
    groups : Groups or None
        For classification and for figures by group.
    settings : GroupSettings
        All of the group level.
    measures : Measures
        What to fit the model to.
    references : mapping of str to str
        Reference levels of factors.
    comparison : Comparison, optional
        Which sessions and sides; by default one visit per participant.
    time : str, optional
        Column of the time of visits, for random slopes.
    icv : str, optional
        Column of intracranial volume, for volumes.
    templates : mapping of str to Template, optional
        By hemisphere; else they are made from this cohort.
    site_effects : SavedEffects, optional
        Parameters of harmonization of another cohort.

    Raises
    ------
    ModelError
        If the model cannot be fitted to these data.
    """
    comparison = comparison or Comparison()
    references = _references(model, groups, references)
    table = modeled_table(cohort.table, comparison)
    plan = plan_sites(
        cohort,
        model,
        settings,
        references=references,
        comparison=comparison,
        icv=icv,
        saved=site_effects,
    )
    design = build_design(table, model, settings.design, references)
    if plan is not None:
        design = without_tests_of_sites(plan, design, model, comparison)
    if comparison.pair or not design.contrasts:
        design = replace(design, contrasts=with_mean(design))

    rows_of: Callable[[Design], RowModel] = RowModel
    if comparison.longitudinal:
        rows_of = partial(longitudinal_model, table=table, time=time, settings=settings)
    rows = rows_of(design)
    check_permutations(settings)
    _check_weights(comparison, settings)
    sides = {
        hemi: register_side(cohort, hemi, groups=groups, settings=settings, templates=templates)
        for hemi in each("registration", list(cohort.sides) if measures.maps else [])
    }
    registered = {hemi: side.registered for hemi, side in sides.items()} or cohort.sides
    measured = replace(cohort, sides=registered)
    fit = partial(
        _fit_cohort,
        plan=plan,
        measures=measures,
        rows=rows,
        comparison=comparison,
        settings=settings,
    )
    how = {hemi: side.registration for hemi, side in sides.items()}
    done, compared, fitted, found = fit(measured, registrations=how)
    unregistered: Mapping[MapKey, Discoveries] = {}
    # Effects of sites from a file are those of registered nodes.
    again = settings.registration.align != "none" and (plan is None or plan.saved is None)
    if again and settings.multiplicity.method not in PERMUTATIONS:
        unregistered = fit(cohort)[3]
    scores = score_cohort(
        compared,
        model,
        comparison.normative,
        settings,
        measures=measures,
        references=references,
    )
    tell("summary measures")
    summaries, notes = fit_summaries(
        compared,
        model,
        design,
        settings,
        only=measures.summaries,
        references=references,
        icv=icv,
        rows_of=rows_of,
    )
    told = compared
    if done is not None and groups is not None and done.leaks(groups.column):
        told = compare_sessions(measured, comparison)
    once = told.take(~table[PARTICIPANT].duplicated().to_numpy())
    pairs, more = classify_groups(once, groups, settings) if groups else ([], [])
    return Analysis(
        model=model,
        comparison=comparison,
        design=design,
        groups=groups,
        sides=sides,
        harmonization=done,
        measured=measures,
        compared=compared,
        row_model=rows,
        fitted=fitted,
        found=found,
        unregistered=unregistered,
        scores=scores,
        measures=summaries,
        pairs=pairs,
        skipped=[*(done.notes if done else ()), *notes, *more],
    )


def analyze_points(cohort: Cohort, analysis: Analysis, settings: GroupSettings) -> Analysis:
    """Fit the model of an analysis to further maps, which are not registered."""
    maps = tuple(dict.fromkeys(name for side in cohort.sides.values() for name in side.maps))
    measured, done = Measures(maps=maps, summaries=()), analysis.harmonization
    done, compared, fitted, found = _fit_cohort(
        cohort,
        plan=None if done is None else done.plan,
        measures=measured,
        rows=analysis.row_model,
        comparison=analysis.comparison,
        settings=settings,
    )
    scores = score_cohort(
        compared,
        analysis.model,
        analysis.comparison.normative,
        settings,
        measures=measured,
        references=analysis.design.references,
    )
    return replace(
        analysis,
        sides={},
        harmonization=done,
        measured=measured,
        compared=compared,
        fitted=fitted,
        found=found,
        unregistered={},
        measures=(),
        pairs=(),
        scores=scores,
        skipped=(),
    )


def _check_weights(comparison: Comparison, settings: GroupSettings) -> None:
    """Refuse weights where there is no rule for them."""
    others = {
        "--longitudinal": comparison.longitudinal,
        "--paired": comparison.pair,
        "--asymmetry": comparison.asymmetry,
        "--normative": comparison.normative,
        "permutations": settings.multiplicity.method in PERMUTATIONS,
        "--joint": settings.joint.measures,
    }
    wrong = [name for name, given in others.items() if given]
    if settings.glm.weights != "none" and wrong:
        raise ModelError(
            f"--weights {settings.glm.weights}: not together with {', '.join(wrong)}; leave one"
            " out",
            reason="weights-alone",
        )


def _fit_cohort(
    cohort: Cohort,
    *,
    plan: SitePlan | None,
    measures: Measures,
    rows: RowModel,
    comparison: Comparison,
    settings: GroupSettings,
    registrations: Mapping[str, Registration] | None = None,
) -> tuple[Harmonization | None, Cohort, dict[str, FittedMaps], dict[MapKey, Discoveries]]:
    """Harmonize, compare sessions, and fit each hemisphere, and left minus right if asked for."""
    done, maps = None, measures.maps
    if plan is not None:
        done = harmonize_cohort(cohort, plan, settings, measures, registrations or {})
    compared = compare_sessions(cohort if done is None else done.cohort, comparison)
    fitted = {
        hemi: fit_maps(hemi, side.only(maps), rows, settings)
        for hemi, side in each("models", list(compared.sides.items()) if maps else [])
    }
    if comparison.asymmetry and maps:
        # A change may be zero or of any sign: nothing to divide by.
        relative = () if comparison.pair else settings.asymmetry.relative
        both = asymmetry_maps(compared, maps, relative)
        contrasts = with_mean(rows.design)
        fitted[BOTH] = fit_maps(BOTH, both, rows, settings, contrasts=contrasts)
    return done, compared, fitted, correct(fitted, rows, compared.table, settings)


def _references(
    model: ModelSpec, groups: Groups | None, references: Mapping[str, str]
) -> dict[str, str]:
    """Take reference levels of the user, and that of the groups if they are in the model."""
    chosen = dict(references)
    if groups is not None and groups.column in closed_formula(model.formula).names:
        chosen.setdefault(groups.column, groups.reference)
    return chosen


def register_side(
    cohort: Cohort,
    hemi: str,
    *,
    groups: Groups | None,
    settings: GroupSettings,
    templates: Mapping[str, Template] | None,
) -> SideResult:
    """Register the sheets of one hemisphere, to a template or to each other."""
    side = cohort.sides[hemi]
    profiles = mean_profiles(side.maps["curvature"], settings.registration)
    if templates is None:
        registration = register(profiles, settings.registration)
    else:
        registration = register_to(profiles, templates[hemi], settings.registration)
    shifts: Mapping[str, GroupShift] = {}
    difference = None
    if groups is not None:
        names = cohort.table[groups.column].iloc[side.rows]
        known = names.notna().to_numpy()
        grouped = replace(registration, warps=registration.warps[known])
        members = names[known].astype(str).to_numpy(dtype=np.str_)
        shifts = shift_by_group(grouped, members)
        if registration.template is not None:
            difference = shift_difference(
                grouped,
                members,
                cohort.table[PARTICIPANT].iloc[side.rows][known].to_numpy(),
                permutations=settings.registration.group_permutations,
                seed=settings.multiplicity.seed,
            )
    return_memory()
    return SideResult(
        registration=registration,
        registered=_register_maps(side, registration.warps, parts_of(cohort.y) is not None),
        shifts=shifts,
        difference=difference,
    )


def _register_maps(side: SideMaps, warps: Float, rims: bool) -> SideMaps:
    """Carry all maps of sheets; a point beside ``rims`` that came to be known of few is none."""
    kept = len(warps) <= MOST_KEPT
    maps, errors = (WarpedMaps(one, warps, warp_values) for one in (side.maps, side.errors))
    labels = WarpedLabels(side.subfield[:], warps, warp_labels)
    registered = dict(maps) if kept or rims else maps
    for values in registered.values() if rims else ():
        leave_rare(values)
    return replace(
        side,
        maps=registered,
        errors=dict(errors) if kept else errors,
        subfield=labels[:] if kept else labels,
    )


def tested_maps(analysis: Analysis) -> Iterator[tuple[MapKey, PointTest, Discoveries]]:
    """Tests of all maps, with what survives correction."""
    for hemi, one in analysis.fitted.items():
        for measure, fit in one.fits.items():
            for test in fit.tests:
                key = MapKey(measure, test.contrast.name, hemi)
                yield key, test, analysis.found[key]


def rows_of(analysis: Analysis, one: FittedMaps) -> pd.DataFrame:
    """Rows of the model's table of the sheets that were used."""
    return analysis.compared.table.iloc[one.maps.rows[one.used]]


def members_of(analysis: Analysis, table: pd.DataFrame) -> Mapping[str, NDArray[np.bool_]]:
    """Tell which rows belong to each group; all to one where there are no groups."""
    if analysis.groups is None:
        return {ALL: np.ones(len(table), dtype=bool)}
    names = table[analysis.groups.column]
    return {level: (names == level).to_numpy() for level in analysis.groups.levels}


def mean_of_known(values: Float, axis: int) -> Float:
    """Mean without what is missing; NaN where nothing is known."""
    known = np.isfinite(values)
    count = known.sum(axis=axis)
    total = values.sum(axis=axis, dtype=np.float64, where=known)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def describe_known(parts: Iterable[Float]) -> tuple[Bool, Float, Float]:
    """Tell what is known of a table in parts, (rows, columns), and mean and SD of its columns.

    Means and sums of squares of parts are put together as by Chan et al. (1983).
    """
    known, count, mean, squares = [], np.zeros(1, np.int64), np.zeros(1), np.zeros(1)
    for values in parts:
        known.append(np.isfinite(values))
        n = known[-1].sum(axis=0)
        both = np.maximum(count + n, 1)
        own = np.nan_to_num(mean_of_known(values, 0))
        squares = squares + np.sum((values - own) ** 2, axis=0, dtype=np.float64, where=known[-1])
        squares += (own - mean) ** 2 * count * n / both
        mean = mean + (own - mean) * n / both
        count = count + n
    spread = np.sqrt(squares / np.maximum(count - 1, 1))
    return (
        np.concatenate(known),
        np.where(count > 0, mean, np.nan),
        np.where(count > 1, spread, np.nan),
    )


def unequal_spread(analysis: Analysis, settings: GlmSettings) -> Iterator[str]:
    """Say which pairs of groups differ in size and SD so that ordinary tests find too much.

    One line per group, about the map in which it differs most from the first.
    """
    groups, worst = analysis.groups, dict[str, tuple[float, str]]()
    named = groups is not None and groups.column in closed_formula(analysis.model.formula).names
    ordinary = (settings.covariance, settings.weights) == ("ordinary", "none")
    if not (named and ordinary) or analysis.comparison.longitudinal:
        return
    for hemi, one in analysis.fitted.items():
        members = members_of(analysis, rows_of(analysis, one))
        sizes = {group: int(own.sum()) for group, own in members.items() if own.sum() > 1}
        for measure in one.fits:
            sds = {g: describe_known(one.parts(measure, members[g]))[2] for g in sizes}
            (first, n), *others = sizes.items()
            for group, m in others:
                squares, other = sds[first] ** 2, sds[group] ** 2
                pooled = ((n - 1) * squares + (m - 1) * other) / (n + m - 2) * (1 / n + 1 / m)
                ratio = float(np.nansum(squares / n + other / m) / np.nansum(pooled))
                if ratio > max(_UNEQUAL, worst.get(group, (0.0,))[0]):
                    worst[group] = ratio, f"{first} ({n}) and {group} ({m}), {measure}, {hemi}"
    for ratio, where in worst.values():
        share = 2 * special.ndtr(special.ndtri(0.025) / np.sqrt(ratio))
        yield (
            f"{where}: the smaller group varies more, so that about {share:.0%} of tests of nothing"
            ' have p below 0.05; glm.covariance = "hc3" in --settings allows for that if each group'
            " has 20 or more"
        )


def profiles_of(maps: Mapping[str, Float], name: str, own: Bool) -> Float:
    """(sheets, x) means over y of some sheets of a map."""
    return np.concatenate([mean_of_known(part, 2) for part in parts_of_sheets(maps, name, own)])
