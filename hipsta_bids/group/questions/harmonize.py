"""Harmonization of a cohort: which sites, what is kept, and what cannot be told apart."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from formulaic import Formula

from hipsta_bids.errors import ModelError
from hipsta_bids.group.cohort.data import SIZES, Cohort, Measures, grows_with_head, modeled_table
from hipsta_bids.group.model import Comparison
from hipsta_bids.group.output.results import Harmonization, SitePlan, digests
from hipsta_bids.group.output.saved import SavedEffects, damaged
from hipsta_bids.group.questions.scores import without_variable
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.io.labels import refuse_alike
from hipsta_bids.stats import combat
from hipsta_bids.stats import formula as formulas
from hipsta_bids.stats.arrays import Bool, Float
from hipsta_bids.stats.design import DEPENDENCE, Design, build_design
from hipsta_bids.stats.grammar import closed_formula, term_text
from hipsta_bids.stats.registration import Registration
from hipsta_bids.types import PARTICIPANT, SESSION

#: Share of a contrast's weights that counts as rounding.
_UNTOUCHED = 1e-8


def plan_sites(
    cohort: Cohort,
    model: formulas.ModelSpec,
    settings: GroupSettings,
    *,
    references: Mapping[str, str],
    comparison: Comparison,
    icv: str | None,
    saved: SavedEffects | None,
) -> SitePlan | None:
    """Plan the harmonization, or refuse inseparable effects; ``None`` if there is none.

    All terms of the model without the site are kept; in changes between two sessions, also their
    interactions with the session. Of an earlier analysis, its own terms are. ModelError if sites
    are too small, or explain a column of the model.
    """
    column = saved.column if saved else settings.harmonization.column
    if not column:
        return None
    formulas.check_names([column], cohort.table.columns)
    _check_terms(model, column)
    if comparison.pair:
        _check_constant(cohort.table, column)
    levels: Mapping[str, Sequence[str]]
    if saved:
        formula, levels, portable = saved.formula, saved.levels, True
        matrix, names = _saved_columns(cohort.table, saved)
    else:
        formula = without_variable(model.formula, column).removeprefix("1 + ")
        spec = replace(model, formula=formula, contrasts=(), dummy=None)
        matrix, names, levels, portable = _own_columns(
            cohort, spec, settings, references, comparison
        )
    labels = formulas.level_labels(cohort.table[column])
    usable = labels.notna().to_numpy() & np.isfinite(matrix).all(axis=1)
    old = tuple(saved.sites) if saved else ()
    present = set(labels[usable])
    new = tuple(sorted(present - set(old)))
    refuse_alike(new, old, f"--harmonize: column {column}")
    sites = (*old, *new)
    people = cohort.table[PARTICIPANT].to_numpy()
    counts = {one: len(set(people[usable & (labels == one).to_numpy()])) for one in sites}
    counts = {one: n for one, n in counts.items() if n}
    _check_sizes(column, new, counts, settings, is_single=saved is None)
    site = np.where(usable, pd.Categorical(labels, categories=sites).codes, -1).astype(np.int64)
    member = np.eye(len(sites))[site[usable]]
    columns = dict(zip(names, matrix[usable].T, strict=True))
    explained = _explained(column, member, columns, refuse=saved is None)
    repeated = pd.Series(people[usable]).duplicated().any() if saved is None else saved.repeated
    volume = saved.icv if saved else icv
    volume, values = _icv(cohort.table, usable, volume, formula)
    if saved and saved.icv and volume is None:
        raise ModelError(
            f"{saved.file}: {SIZES} kept {saved.icv} there, which not all have here; complete it"
        )
    return SitePlan(
        column=column,
        sites=sites,
        estimated=new,
        counts=counts,
        visits=combat.Visits(
            site=site,
            columns=matrix,
            participant=np.unique(people, return_inverse=True)[1] if repeated else None,
        ),
        names=names,
        formula=formula,
        levels=levels,
        portable=portable,
        icv=volume,
        icv_values=values,
        explained=explained,
        saved=saved,
        lost=int((~usable).sum()),
    )


def _saved_columns(table: pd.DataFrame, saved: SavedEffects) -> tuple[Float, tuple[str, ...]]:
    """Make the columns of an earlier analysis for these visits."""
    matrix, names, complete = formulas.columns_of(
        table, saved.formula, saved.levels, f"{saved.file}: "
    )
    if list(names) != saved.columns:
        raise damaged(
            saved.file, f"columns {formulas.listed(saved.columns)}, not {formulas.listed(names)}"
        )
    values = np.full((len(table), len(names)), np.nan)
    values[complete] = matrix
    return values, names


def _own_columns(
    cohort: Cohort,
    spec: formulas.ModelSpec,
    settings: GroupSettings,
    references: Mapping[str, str],
    comparison: Comparison,
) -> tuple[Float, tuple[str, ...], Mapping[str, Sequence[str]], bool]:
    """Make the columns of a model without the site; of two sessions, with their interactions.

    Returns columns, names, levels of factors, and whether other people's can be made from these.
    """
    table = modeled_table(cohort.table, comparison)
    variables = closed_formula(spec.formula).names
    levels = {name: text for name, text in references.items() if name in variables}
    design = build_design(table, spec, settings.design, levels)
    positions = [i for i, name in enumerate(design.columns) if name != formulas.INTERCEPT]
    names = tuple(design.columns[i] for i in positions)
    values = np.full((len(table), len(names)), np.nan)
    values[design.rows] = design.matrix[:, positions]
    portable = not comparison.pair and _is_portable(table, spec.formula, design)
    if comparison.pair:
        session = comparison.pair[1]
        values = values[table.index.get_indexer(pd.Index(cohort.table[PARTICIPANT]))]
        is_later = (cohort.table[SESSION] == session).to_numpy(np.float64)[:, None]
        values = np.hstack([values, is_later, is_later * values])
        names = (*names, session, *(f"{name} x {session}" for name in names))
    return values, names, design.levels, portable


def _check_terms(model: formulas.ModelSpec, column: str) -> None:
    """Refuse interactions with the site."""
    for term in Formula(closed_formula(model.formula).text):
        names = closed_formula(term_text(term)).names
        if column in names and len(names) > 1:
            raise ModelError(
                f"--harmonize {column}: the model has {term}, an effect of sites to keep; "
                "remove this term, or --harmonize"
            )


def _check_constant(table: pd.DataFrame, column: str) -> None:
    """Refuse changes between two sessions of people who changed the site."""
    pairs = table[[PARTICIPANT, column]].drop_duplicates()[PARTICIPANT]
    changing = pairs[pairs.duplicated()].unique()
    if len(changing):
        raise ModelError(
            f"--harmonize {column}: {formulas.listed(changing)} changed {column} between "
            "sessions, so changes depend on its effects; use --longitudinal"
        )


def _check_sizes(
    column: str,
    new: Sequence[str],
    counts: Mapping[str, int],
    settings: GroupSettings,
    *,
    is_single: bool,
) -> None:
    least = settings.harmonization.least_participants
    if is_single and len(new) < 2:  # noqa: PLR2004 -- one is like all
        raise ModelError(
            f"--harmonize {column}: all participants with the variables of the model have "
            f"{column} {formulas.listed(new) or 'n/a'}; remove --harmonize"
        )
    if small := [f"{one} ({counts[one]})" for one in new if counts[one] < least]:
        raise ModelError(
            f"--harmonize {column}: too few participants in {formulas.listed(small)} (least "
            f"{least}); exclude them by --exclude, or join similar ones"
        )


def _explained(
    column: str,
    member: Float,
    columns: Mapping[str, Float],
    *,
    refuse: bool,
) -> dict[str, float]:
    """Share of the variance of each column that sites explain; refuses what they explain wholly."""
    dummies = member[:, member.any(axis=0)]
    shares: dict[str, float] = {}
    basis = dummies
    for name, values in columns.items():
        around = values - values.mean()
        inside = around - dummies @ np.linalg.lstsq(dummies, around, rcond=None)[0]
        total = float(around @ around)
        shares[name] = 1 - float(inside @ inside) / total if total > 0 else 0.0
        left = values - basis @ np.linalg.lstsq(basis, values, rcond=None)[0]
        if np.linalg.norm(left) > DEPENDENCE * np.linalg.norm(values):
            basis = np.column_stack([basis, left / np.linalg.norm(left)])
        elif refuse:
            raise ModelError(
                f"--harmonize {column}: {name} does not vary within {column}s, effects "
                "are inseparable; use sites with all groups, or drop --harmonize"
            )
    return shares


def _is_portable(table: pd.DataFrame, formula: str, design: Design) -> bool:
    """Tell whether columns of some people alone are the same as among all; splines' are not."""
    half = design.rows[::2]
    matrix, names, _ = formulas.columns_of(table.iloc[half], formula, design.levels, "")
    columns = [name for name in design.columns if name != formulas.INTERCEPT]
    among = design.matrix[::2][:, [design.columns.index(name) for name in columns]]
    return list(names) == columns and bool(np.allclose(matrix, among, rtol=1e-9, atol=1e-12))


def _icv(
    table: pd.DataFrame,
    usable: Bool,
    icv: str | None,
    formula: str,
) -> tuple[str | None, Float]:
    """Find intracranial volume, which models of volumes adjust for, if all have it."""
    values = np.full(len(table), np.nan)
    if icv is None or icv in closed_formula(formula).names:
        return None, values
    formulas.check_names([icv], table.columns)
    column = formulas.typed(table[icv])
    if not pd.api.types.is_numeric_dtype(column):
        return None, values
    values = column.to_numpy(np.float64)
    values_used = values[usable]
    return (icv if np.isfinite(values_used).all() and np.ptp(values_used) > 0 else None), values


def without_tests_of_sites(
    plan: SitePlan, design: Design, model: formulas.ModelSpec, comparison: Comparison
) -> Design:
    """Refuse a model without the sites' degrees of freedom, or a test of sites.

    Tests of single columns that are about sites are omitted where no contrast was named. A test
    after it would take shifts that were estimated from the same data for known, and reject too
    often where groups are not balanced over sites (Nygaard et al. 2016,
    doi:10.1093/biostatistics/kxv027). With the sites in the model, it pays for them.
    """
    if comparison.pair or not plan.estimated:
        return design
    member = np.eye(len(plan.sites))[plan.visits.site[design.rows]]
    joined = np.hstack([design.matrix, member])
    if np.linalg.matrix_rank(joined) > np.linalg.matrix_rank(design.matrix):
        raise ModelError(
            f"--harmonize {plan.column}: the model needs {plan.column}, estimated from the "
            f"same participants; add + C({plan.column}) to the formula"
        )
    weights = np.linalg.pinv(design.matrix) @ (member - member.mean(axis=0))
    about = [
        one.name
        for one in design.contrasts
        if np.abs(one.weights @ weights).max() > _UNTOUCHED * np.abs(one.weights).max()
    ]
    named = {spec.name for spec in model.contrasts}
    if about and (named.intersection(about) or len(about) == len(design.contrasts)):
        raise ModelError(
            f"--harmonize {plan.column}: contrast {about[0]} tests an effect that is "
            "removed; choose other contrasts by --contrast"
        )
    contrasts = tuple(one for one in design.contrasts if one.name not in about)
    return replace(design, contrasts=contrasts)


def harmonize_cohort(
    cohort: Cohort,
    plan: SitePlan,
    settings: GroupSettings,
    measures: Measures,
    registrations: Mapping[str, Registration],
) -> Harmonization:
    """Estimate or take effects of sites, and take them out of maps and summary measures."""
    if plan.saved and registrations:
        _check_templates(plan.saved, registrations)
    effects: dict[tuple[str, str, str], tuple[combat.SiteEffects, combat.SiteMoments]] = {}
    sides, unknown = {}, set()
    for hemi, side in cohort.sides.items():
        visits = plan.visits.take(side.rows)
        changed, summary = dict(side.maps), side.summary.astype(np.float64)
        for measure in measures.maps:
            key = "map", hemi, measure
            values = side.maps[measure].reshape(len(side.rows), -1)
            effects[key] = _effects(values, visits, plan, settings, key)
            harmonized = combat.harmonize(values, visits, effects[key][0])
            changed[measure] = harmonized.reshape(side.maps[measure].shape)
        for name in summary.columns:
            key = "summary", hemi, name
            values = summary[[name]].to_numpy()
            saved = plan.saved and plan.saved.effects_on_summaries.get((hemi, name))
            # Earlier files adjust volumes alone.
            is_adjusted = len(saved.slopes) > len(plan.names) if saved else grows_with_head(name)
            adjusted = _with_icv(visits, plan, side.rows) if is_adjusted else visits
            if plan.saved and not saved:
                unknown.add(name)
                summary[name] = np.nan
            elif len(np.unique(values[np.isfinite(values)])) > 1:
                effects[key] = _effects(values, adjusted, plan, settings, key)
                summary[name] = combat.harmonize(values, adjusted, effects[key][0])[:, 0]
        sides[hemi] = replace(side, maps=changed, summary=summary)
    maps = [("map", hemi, name) for name in measures.maps for hemi in sides]
    return Harmonization(
        plan=plan,
        cohort=replace(cohort, sides=sides),
        effects={key: effects.pop(key) for key in maps} | effects,
        notes=tuple(_notes(plan, settings, unknown)),
    )


def _with_icv(visits: combat.Visits, plan: SitePlan, rows: Any) -> combat.Visits:  # noqa: ANN401  (an array)
    if plan.icv is None:
        return visits
    icv = plan.icv_values[rows]
    columns = np.column_stack([visits.columns, icv])
    return replace(visits, site=np.where(np.isfinite(icv), visits.site, -1), columns=columns)


def _effects(
    values: Float,
    visits: combat.Visits,
    plan: SitePlan,
    settings: GroupSettings,
    key: tuple[str, str, str],
) -> tuple[combat.SiteEffects, combat.SiteMoments]:
    kind, hemi, measure = key
    pooled = settings.harmonization.pooling and kind == "map"
    if plan.saved is None:
        n, longitudinal = len(plan.sites), settings.longitudinal
        return combat.fit_effects(values, visits, n, longitudinal, pooled=pooled)
    known_effects = plan.saved.effects_on_maps if kind == "map" else plan.saved.effects_on_summaries
    effects = known_effects.get((hemi, measure))
    if effects is None:
        raise ModelError(
            f"{plan.saved.file}: has no map of {measure} of hemisphere {hemi}; choose other maps"
            " by --measures, or harmonize anew"
        )
    if len(effects.mean) != values.shape[1]:
        raise ModelError(
            f"{plan.saved.file}: its map of {measure} has {len(effects.mean)} points, these "
            f"participants {values.shape[1]}; use one grid"
        )
    return combat.extend_effects(effects, values, visits, pooled=pooled)


def _notes(plan: SitePlan, settings: GroupSettings, unknown: set[str]) -> Iterator[str]:
    if plan.lost:
        yield (
            f"{plan.lost} visits lack {plan.column} or an effect that is kept, and are not "
            "harmonized"
        )
    for name, share in plan.explained.items():
        if share > settings.harmonization.explained:
            yield f"{plan.column} explains {share:.0%} of {name}: its effect is poorly known"
    if unknown and plan.saved:
        names = formulas.listed(unknown)
        yield f"{plan.saved.file} lacks these measures, which are excluded: {names}"
    if plan.saved is None and not plan.portable:
        yield "harmonization.json is not written: this model's columns depend on all participants"


def _check_templates(saved: SavedEffects, registrations: Mapping[str, Registration]) -> None:
    """Refuse parameters of other points than those of this cohort."""
    for hemi, digest in digests(registrations).items():
        if saved.templates.get(hemi) != digest:
            is_unregistered = saved.templates.get(hemi) == "none"
            remedy = (
                "--align none" if is_unregistered else "--template with the template.json beside it"
            )
            raise ModelError(
                f"{saved.file}: hemisphere {hemi} was registered to another template there; give"
                f" {remedy}"
            )
