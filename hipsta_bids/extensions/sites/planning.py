"""The plan of a harmonization: which sites, what is kept, and what is inseparable."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from formulaic import Formula

from hipsta_bids.errors import ModelError
from hipsta_bids.extensions.sites import combat
from hipsta_bids.extensions.sites.saved import SavedEffects, damaged, load_effects
from hipsta_bids.extensions.sites.settings import HarmonizationSettings
from hipsta_bids.group.cohort.data import SIZES
from hipsta_bids.group.output.results import Analysis
from hipsta_bids.group.request import Request
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.io.labels import refuse_alike
from hipsta_bids.stats import formula as formulas
from hipsta_bids.stats.arrays import Bool, Float
from hipsta_bids.stats.design import DEPENDENCE, Design, build_design
from hipsta_bids.stats.grammar import closed_formula, term_text, without_variable
from hipsta_bids.types import PARTICIPANT, SESSION

#: Share of a contrast's weights that counts as rounding.
_UNTOUCHED = 1e-8


@dataclass(frozen=True, eq=False, kw_only=True)
class SitePlan:
    """Effects to remove, and effects to keep."""

    column: str
    sites: tuple[str, ...]
    """Known ones of a file first."""
    estimated: tuple[str, ...]
    """Sites whose effects are estimated from this cohort."""
    counts: Mapping[str, int]
    """Participants by site whose visits are harmonized."""
    visits: combat.Visits
    """Rows of the cohort's table; columns whose effects are kept, without an intercept."""
    names: tuple[str, ...]
    """Columns whose effects are kept, by this formula and these levels of factors."""
    formula: str
    levels: Mapping[str, Sequence[str]]
    portable: bool
    """Whether the columns of other people can be made from the formula."""
    icv: str | None
    """Column that volumes keep besides."""
    icv_values: Float
    """(visits,) NaN where not known or not used."""
    explained: Mapping[str, float]
    """Share of the variance of each column that sites explain."""
    saved: SavedEffects | None
    lost: int
    """Visits without a site or a variable that is kept."""


def is_asked(request: Request) -> bool:
    """Check whether effects of sites are taken out."""
    return bool(
        request.options.get("harmonize_model") or request.settings.of(HarmonizationSettings).column
    )


def plan_sites(request: Request) -> SitePlan:
    """Plan the harmonization, or refuse inseparable effects.

    All terms of the model without the site are kept; in changes between two sessions, also their
    interactions with the session. Of an earlier analysis, its own terms are. ModelError if sites
    are too small, or explain a column of the model.
    """
    cohort, model, settings = request.cohort, request.model, request.settings
    path = request.options.get("harmonize_model")
    saved = load_effects(path) if path else None
    column = saved.column if saved else settings.of(HarmonizationSettings).column
    formulas.check_names([column], cohort.table.columns)
    _check_terms(model, column)
    if request.comparison.sessions.later:
        _check_constant(cohort.table, column)
    levels: Mapping[str, Sequence[str]]
    if saved:
        formula, levels, portable = saved.formula, saved.levels, True
        matrix, names = _saved_columns(cohort.table, saved)
    else:
        formula = without_variable(model.formula, column).removeprefix("1 + ")
        spec = replace(model, formula=formula, contrasts=(), dummy=None)
        matrix, names, levels, portable = _own_columns(request, spec)
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
    volume = saved.icv if saved else request.icv
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
    request: Request, spec: formulas.ModelSpec
) -> tuple[Float, tuple[str, ...], Mapping[str, Sequence[str]], bool]:
    """Make the columns of a model without the site; of two sessions, with their interactions.

    Returns columns, names, levels of factors, and whether other people's can be made from these.
    """
    table, visits, session = request.table, request.cohort.table, request.comparison.sessions.later
    variables = closed_formula(spec.formula).names
    levels = {name: text for name, text in request.references.items() if name in variables}
    design = build_design(table, spec, request.settings.design, levels)
    positions = [i for i, name in enumerate(design.columns) if name != formulas.INTERCEPT]
    names = tuple(design.columns[i] for i in positions)
    values = np.full((len(table), len(names)), np.nan)
    values[design.rows] = design.matrix[:, positions]
    portable = not session and _is_portable(table, spec.formula, design)
    if session:
        values = values[table.index.get_indexer(pd.Index(visits[PARTICIPANT]))]
        is_later = (visits[SESSION] == session).to_numpy(np.float64)[:, None]
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
    least = settings.of(HarmonizationSettings).least_participants
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


def without_tests_of_sites(analysis: Analysis, plan: SitePlan) -> Analysis:
    """Refuse a model without the sites' degrees of freedom, or a test of sites.

    Tests of single columns that are about sites are omitted where no contrast was named. A test
    after it would take shifts that were estimated from the same data for known, and reject too
    often where groups are not balanced over sites (Nygaard et al. 2016,
    doi:10.1093/biostatistics/kxv027). With the sites in the model, it pays for them.
    """
    # Effects of sites from a file are those of registered nodes.
    request = replace(analysis.request, has_unregistered=plan.saved is None)
    analysis, design = replace(analysis, request=request), analysis.design
    if request.comparison.sessions.later or not plan.estimated:
        return analysis
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
    named = {spec.name for spec in request.model.contrasts}
    if about and (named.intersection(about) or len(about) == len(design.contrasts)):
        raise ModelError(
            f"--harmonize {plan.column}: contrast {about[0]} tests an effect that is "
            "removed; choose other contrasts by --contrast"
        )
    contrasts = tuple(one for one in design.contrasts if one.name not in about)
    return replace(analysis, design=replace(design, contrasts=contrasts))
