"""The group level from sheets and covariates to results."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np
import pandas as pd
from scipy import special

from hipsta_bids.errors import ModelError
from hipsta_bids.group import model as modeling
from hipsta_bids.group.cohort import data
from hipsta_bids.group.cohort.read import leave_rare
from hipsta_bids.group.output import results
from hipsta_bids.group.output.saved import SavedEffects
from hipsta_bids.group.output.tables import JointMap
from hipsta_bids.group.questions import harmonize
from hipsta_bids.group.questions.scores import classify_groups, fit_summaries, score_cohort
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.progress import each, tell
from hipsta_bids.stats import arrays, inference, registration
from hipsta_bids.stats.clusters import edges_of
from hipsta_bids.stats.design import Design, build_design
from hipsta_bids.stats.formula import ModelSpec, listed
from hipsta_bids.stats.glm import FittedMaps, RowModel, fit_maps, with_mean
from hipsta_bids.stats.grammar import closed_formula
from hipsta_bids.stats.mixed import longitudinal_model
from hipsta_bids.stats.mmrm import visit_model
from hipsta_bids.stats.settings import GlmSettings
from hipsta_bids.stats.warps import Template, warp_labels, warp_values
from hipsta_bids.types import BOTH_SIDES, JOINT, PARTICIPANT, SIDES, parts_of

#: Ratio of variances of a difference, true to that with equal ones, of which a note is made: then
#: 9 % of tests of nothing have p below 0.05.
_UNEQUAL = 1.3


def analyze_cohort(
    cohort: data.Cohort,
    model: ModelSpec,
    groups: modeling.Groups | None,
    settings: GroupSettings,
    *,
    measures: data.Measures,
    references: Mapping[str, str],
    comparison: modeling.Comparison | None = None,
    time: str | None = None,
    icv: str | None = None,
    templates: Mapping[str, Template] | None = None,
    site_effects: SavedEffects | None = None,
) -> results.Analysis:
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
        Reference levels of factors, as ``choose_model`` gives them.
    comparison : Comparison, optional
        Which sessions and sides; by default one visit per participant.
    time : str, optional
        Column of the time of visits, for random slopes.
    icv : str, optional
        Column of intracranial volume, for volumes, areas and extents.
    templates : mapping of str to Template, optional
        By hemisphere; else they are made from this cohort.
    site_effects : SavedEffects, optional
        Parameters of harmonization of another cohort.

    Raises
    ------
    ModelError
        If the model cannot be fitted to these data.
    """
    comparison = comparison or modeling.Comparison()
    _check_covariates(model, comparison, settings, measures, is_harmonized=site_effects is not None)
    has_visits = bool(comparison.endpoint) or (
        comparison.longitudinal and settings.longitudinal.random == "visits"
    )
    is_harmonized = bool(settings.harmonization.column) or site_effects is not None
    if has_visits:
        _check_visits(comparison, settings, maps=model.maps, is_harmonized=is_harmonized)
    table = data.modeled_table(cohort.table, comparison)
    plan = harmonize.plan_sites(
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
        design = harmonize.without_tests_of_sites(plan, design, model, comparison)
    if comparison.pair or not design.contrasts:
        design = replace(design, contrasts=with_mean(design))

    make_rows: Callable[[Design], RowModel] = partial(RowModel, settings=settings.glm)
    if has_visits:
        arms = groups.column if groups and comparison.endpoint[:1] == ("clda",) else None
        make_rows = partial(
            visit_model,
            table=table,
            settings=settings.glm,
            longitudinal=settings.longitudinal,
            arms=arms,
        )
    elif comparison.longitudinal:
        make_rows = partial(
            longitudinal_model,
            table=table,
            time=time,
            settings=settings.glm,
            longitudinal=settings.longitudinal,
        )
    rows = make_rows(design)
    design = rows.design
    joint = bool(settings.joint.measures)
    _check_margins(design, cohort, measures)
    inference.check_permutations(settings.multiplicity, settings.glm, design.contrasts, joint=joint)
    sides = {
        hemi: register_side(cohort, hemi, groups=groups, settings=settings, templates=templates)
        for hemi in each("registration", list(cohort.sides) if measures.maps else [])
    }
    registrations = {hemi: result for hemi, (result, _) in sides.items()}
    registered = {hemi: maps for hemi, (_, maps) in sides.items()}
    measured = replace(cohort, sides=registered or cohort.sides)
    fit = partial(
        _fit_cohort,
        plan=plan,
        measures=measures,
        rows=rows,
        comparison=comparison,
        covariates=model.maps,
        settings=settings,
    )
    harmonization, compared, fitted, discoveries = fit(measured, registrations=registrations)
    unregistered: Mapping[inference.MapKey, tuple[arrays.Float, inference.Discoveries]] = {}
    # Effects of sites from a file are those of registered nodes.
    is_repeated = settings.registration.align != "none" and (plan is None or plan.saved is None)
    if is_repeated and settings.multiplicity.method not in inference.PERMUTATIONS:
        *_, maps_before, before = fit(cohort)
        unregistered = {
            (key := inference.MapKey(measure, test.contrast.name, hemi)): (
                test.statistic,
                before[key],
            )
            for hemi, side in maps_before.items()
            for measure, point_fit in side.fits.items()
            for test in point_fit.tests
        }
    reference, scored, scores = score_cohort(
        compared,
        model,
        comparison.normative,
        settings,
        measures=measures,
        references=references,
    )
    tell("summary measures")
    # A covariate that is a map has no value for a whole hemisphere.
    summaries, notes = fit_summaries(
        compared,
        model,
        design,
        settings.design,
        names=() if model.maps else measures.summaries,
        references=references,
        icv=icv,
        rows_of=make_rows,
    )
    if model.maps:
        terms = listed(f"map({name})" for name in model.maps)
        notes.append(f"summary measures are not tested: {terms} has values at points only")
    classified = compared
    if harmonization is not None and groups is not None and harmonization.leaks(groups.column):
        classified = data.compare_sessions(measured, comparison)
    first_visits = classified.take(~table[PARTICIPANT].duplicated().to_numpy())
    classification = settings.classification
    classes = None if comparison.endpoint else groups
    pairs, more = classify_groups(first_visits, classes, classification) if classes else ([], [])
    return results.Analysis(
        model=model,
        comparison=comparison,
        design=design,
        groups=groups,
        registrations=registrations,
        registered=registered,
        harmonization=harmonization,
        measured=measures,
        compared=compared,
        row_model=rows,
        fitted=fitted,
        found=discoveries,
        unregistered=unregistered,
        reference=reference,
        scored=scored,
        scores=scores,
        measures=summaries,
        pairs=pairs,
        skipped=[*(harmonization.notes if harmonization else ()), *notes, *more],
    )


def _check_covariates(
    model: ModelSpec,
    comparison: modeling.Comparison,
    settings: GroupSettings,
    measures: data.Measures,
    *,
    is_harmonized: bool,
) -> None:
    """Refuse what a model with maps as covariates cannot do."""
    if not model.maps:
        return
    excluded = {
        "--normative": comparison.normative is not None,
        "--harmonize": is_harmonized or bool(settings.harmonization.column),
        "summary measures alone": not measures.maps,
    }
    if problems := [name for name, is_asked in excluded.items() if is_asked]:
        raise ModelError(f"map() in a formula: not with {listed(problems)}; remove one of them")
    if comparison.pair is None and (outcomes := [m for m in model.maps if m in measures.maps]):
        raise ModelError(
            f"map({outcomes[0]}) in the formula explains itself; choose other maps by --measures"
        )


def _check_visits(
    comparison: modeling.Comparison,
    settings: GroupSettings,
    *,
    maps: Sequence[str],
    is_harmonized: bool,
) -> None:
    """Refuse what models of visits as categories cannot do."""
    method = settings.multiplicity.method
    option = f"--endpoint {comparison.endpoint[0]}" if comparison.endpoint else ""
    excluded = {
        f"--correction {method}": method in inference.PERMUTATIONS,
        "--joint": bool(settings.joint.measures),
        "--harmonize": bool(comparison.endpoint) and is_harmonized,
        "map() in the formula": bool(maps),
    }
    if problems := [name for name, is_asked in excluded.items() if is_asked]:
        raise ModelError(
            f"{option or '--longitudinal visits'}: not with {listed(problems)}; remove it"
        )


def _check_margins(design: Design, cohort: data.Cohort, measures: data.Measures) -> None:
    """Refuse one margin for measures of several units."""
    names = [one.name for one in design.contrasts if one.margin]
    columns = {str(name) for side in cohort.sides.values() for name in side.summary.columns}
    summaries = columns if measures.summaries is None else columns & {*measures.summaries}
    units = {cohort.units[name] for name in (*measures.maps, *summaries) if name in cohort.units}
    if names and len(units) > 1:
        raise ModelError(
            f"contrast {names[0]!r}: a margin has one unit, but maps and summary measures have"
            f" {listed(sorted(units))}; choose both, as --measures thickness thickness_mean"
        )


def analyze_points(
    cohort: data.Cohort, analysis: results.Analysis, settings: GroupSettings
) -> results.Analysis:
    """Fit the model of an analysis to further maps, which are not registered."""
    maps = tuple(dict.fromkeys(name for side in cohort.sides.values() for name in side.maps))
    measured = data.Measures(maps=maps, summaries=())
    harmonization, compared, fitted, discoveries = _fit_cohort(
        cohort,
        plan=analysis.harmonization.plan if analysis.harmonization else None,
        measures=measured,
        rows=analysis.row_model,
        comparison=analysis.comparison,
        settings=settings,
    )
    reference, scored, scores = score_cohort(
        compared,
        analysis.model,
        analysis.comparison.normative,
        settings,
        measures=measured,
        references=analysis.design.references,
    )
    return replace(
        analysis,
        registrations={},
        registered={},
        harmonization=harmonization,
        measured=measured,
        compared=compared,
        fitted=fitted,
        found=discoveries,
        unregistered={},
        measures={},
        pairs=(),
        reference=reference,
        scored=scored,
        scores=scores,
        skipped=(),
    )


def _fit_cohort(
    cohort: data.Cohort,
    *,
    plan: results.SitePlan | None,
    measures: data.Measures,
    rows: RowModel,
    comparison: modeling.Comparison,
    settings: GroupSettings,
    covariates: Sequence[str] = (),
    registrations: Mapping[str, registration.Registration] | None = None,
) -> tuple[
    results.Harmonization | None,
    data.Cohort,
    dict[str, FittedMaps],
    dict[inference.MapKey, inference.Discoveries],
]:
    """Harmonize, compare sessions, and fit each hemisphere, and left minus right if asked for."""
    harmonization, maps = None, measures.maps
    if plan is not None:
        harmonization = harmonize.harmonize_cohort(
            cohort, plan, settings, measures, registrations or {}
        )
    compared = data.compare_sessions(
        cohort if harmonization is None else harmonization.cohort, comparison, covariates
    )
    fitted = {
        hemi: fit_maps(hemi, side.only(maps), rows)
        for hemi, side in each("models", list(compared.sides.items()) if maps else [])
    }
    if comparison.asymmetry and maps:
        # A change may be zero or of any sign: nothing to divide by.
        relative = () if comparison.pair else settings.asymmetry.relative
        difference = data.asymmetry_maps(compared, maps, relative)
        contrasts = with_mean(rows.design)
        fitted[modeling.BOTH] = fit_maps(modeling.BOTH, difference, rows, contrasts=contrasts)
    return (
        harmonization,
        compared,
        fitted,
        inference.correct(
            fitted,
            rows,
            compared.table,
            settings.multiplicity,
            report=partial(tell, "permutations"),
        ),
    )


def register_side(
    cohort: data.Cohort,
    hemi: str,
    *,
    groups: modeling.Groups | None,
    settings: GroupSettings,
    templates: Mapping[str, Template] | None,
) -> tuple[registration.Registration, arrays.SideMaps]:
    """Register the sheets of one hemisphere, to a template or to each other; also the maps."""
    side = cohort.sides[hemi]
    profiles = registration.mean_profiles(side.curvature, settings.registration)
    if cohort.shared:
        people = pd.factorize(cohort.table[PARTICIPANT].iloc[side.rows])[0]
        profiles = pd.DataFrame(profiles).groupby(people).transform("mean").to_numpy()
    if templates is None:
        least = settings.registration.min_subjects
        if settings.registration.align == "registr" and len(profiles) < least:
            raise ModelError(
                f"registration: {len(profiles)} profiles are too few for a template (least"
                f" {least}); use --align none or --template FILE"
            )
        result = registration.register(profiles, settings.registration)
    else:
        result = registration.register_to(profiles, templates[hemi], settings.registration)
    if groups is not None:
        names = cohort.table[groups.column].iloc[side.rows]
        has_group = names.notna().to_numpy()
        grouped = replace(result, warps=result.warps[has_group])
        members = names[has_group].astype(str).to_numpy(dtype=np.str_)
        difference: Mapping[str, float] = {}
        if result.template is not None:
            difference = registration.shift_difference(
                grouped,
                members,
                cohort.table[PARTICIPANT].iloc[side.rows][has_group].to_numpy(),
                permutations=settings.registration.group_permutations,
                seed=settings.multiplicity.seed,
            )
        by_group = registration.shift_by_group(grouped, members)
        result = replace(result, by_group=by_group, difference=difference)
    arrays.return_memory()
    return result, _register_maps(side, result.warps, parts_of(cohort.y) is not None)


def _register_maps(side: arrays.SideMaps, warps: arrays.Float, rims: bool) -> arrays.SideMaps:
    """Carry all maps of sheets; a point beside ``rims`` that came to be known of few is none."""
    is_small = len(warps) <= arrays.MOST_KEPT
    maps = arrays.WarpedMaps(side.maps, warps, warp_values)
    labels = arrays.WarpedLabels(side.subfield[:], warps, warp_labels)
    registered = dict(maps) if is_small or rims else maps
    for values in registered.values() if rims else ():
        leave_rare(values)
    return replace(
        side,
        maps=registered,
        subfield=labels[:] if is_small else labels,
    )


def unequal_spread(analysis: results.Analysis, settings: GlmSettings) -> Iterator[str]:
    """List pairs of groups that differ in size and SD so that ordinary tests find too much.

    One line per group, about the map in which it differs most from the first.
    """
    groups, worst = analysis.groups, dict[str, tuple[float, str]]()
    named = groups is not None and groups.column in closed_formula(analysis.model.formula).names
    if not named or settings.covariance != "ordinary" or analysis.comparison.longitudinal:
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


def check_joint(
    available: Sequence[str], comparison: modeling.Comparison, settings: GroupSettings
) -> None:
    """Refuse measures that cannot be tested together, before anything is fitted."""
    available = [
        *available,
        *(modeling.asymmetry_name(name) for name in available if comparison.asymmetry),
    ]
    names, sides = settings.joint.measures, settings.joint.sides
    problem = None
    if unknown := [name for name in names if name not in available]:
        problem = f"no map is called {unknown[0]!r}; there are {', '.join(available)}"
    elif names and JOINT in available:
        problem = f"a map is called {JOINT}, as its results would be; give it another name"
    elif len(set(names)) < len(names):
        problem = "a measure is named twice; remove it"
    elif len(names) < 1 + (not sides) and (names or sides):
        problem = "name two measures, or one and --joint-sides"
    if problem is not None:
        raise ModelError(f"--joint {' '.join(names)}".strip() + f": {problem}")


def combine_maps(
    analyses: Sequence[results.Analysis], settings: GroupSettings
) -> dict[inference.MapKey, JointMap]:
    """Test the measures of the setting ``joint`` together; empty without any.

    The first analysis has the model; further ones may have maps of other programs.
    """
    names, sides = settings.joint.measures, settings.joint.sides
    if not names:
        return {}
    fits = {
        (m, hemi): one for each in analyses for hemi, one in each.fitted.items() for m in one.fits
    }
    cohort = next(
        each.compared
        for each in analyses
        if any(names[0] in one.fits for one in each.fitted.values())
    )
    groups: dict[inference.MapKey, dict[str, tuple[FittedMaps, str]]] = {}
    contrasts = {}
    for hemis in [("L", "R")] if sides else [("L",), ("R",), (modeling.BOTH,)]:
        if not all((name, hemi) in fits for hemi, name in product(hemis, names)):
            continue
        parts = {
            name if len(hemis) == 1 else f"{name} {SIDES[hemi]}": (
                fits[name, hemi],
                name,
            )
            for hemi, name in product(hemis, names)
        }
        _check_points(names, [one for one, _ in parts.values()])
        for test in fits[names[0], hemis[0]].fits[names[0]].tests:
            key = inference.MapKey(
                JOINT,
                test.contrast.name,
                BOTH_SIDES if len(hemis) > 1 else hemis[0],
            )
            groups[key], contrasts[test.contrast.name] = parts, test.contrast
    if not groups:
        raise ModelError(f"--joint {' '.join(names)}: no side has them all; remove one")
    model = analyses[0].row_model
    tests_found = inference.correct_joint(
        groups,
        contrasts,
        model,
        analyses[0].compared.table,
        settings.multiplicity,
        combine=settings.joint.combine,
        report=partial(tell, "permutations"),
    )
    return {
        key: JointMap(key=key, parts=groups[key], cohort=cohort, test=test, found=own)
        for key, (test, own) in tests_found.items()
    }


def _check_points(names: Sequence[str], parts: Sequence[FittedMaps]) -> None:
    """Refuse maps whose points do not correspond."""
    first, *remaining = [one.maps for one in parts]
    equal = [
        one.shape == first.shape
        and np.array_equal(edges_of(one, 4), edges_of(first, 4))  # the triangles of meshes
        for one in remaining
    ]
    if not all(equal):
        counts = ", ".join(str(np.prod(one.maps.shape)) for one in parts)
        raise ModelError(
            f"--joint {' '.join(names)}: maps lie on different surfaces ({counts} points); choose"
            " maps of one surface" + (", or leave --joint-sides out" if len(names) == 1 else "")
        )
