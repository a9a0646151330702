"""Scores of participants against a reference group, and models and classifiers of measures."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
from formulaic import Formula

from hipsta_bids.errors import ModelError, UsageError
from hipsta_bids.group.cohort import data
from hipsta_bids.group.model import Groups
from hipsta_bids.group.output.results import ScoredMaps
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.progress import tell
from hipsta_bids.stats.arrays import Float, Int
from hipsta_bids.stats.classify import ModelComparison, compare_pairs, forget_models
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.design import Design, build_design
from hipsta_bids.stats.formula import ModelSpec, check_names, listed, typed
from hipsta_bids.stats.glm import MEAN, PointwiseFit, RowModel, most_frequent, with_mean
from hipsta_bids.stats.grammar import closed_formula, term_text
from hipsta_bids.stats.scores import w_scores
from hipsta_bids.stats.settings import ClassificationSettings, DesignSettings
from hipsta_bids.types import PARTICIPANT, SESSION

#: Region of a score that is the mean over the whole sheet.
WHOLE = "all"


def score_cohort(
    cohort: data.Cohort,
    model: ModelSpec,
    normative: tuple[str, str] | None,
    settings: GroupSettings,
    *,
    measures: data.Measures,
    references: Mapping[str, str],
) -> tuple[tuple[str, int] | None, dict[str, ScoredMaps], pd.DataFrame]:
    """Score all participants who have the covariates of a model, whatever their group.

    Returns covariates and size of the reference group, scores of maps by hemisphere, and a table.
    """
    if normative is None:
        return None, {}, pd.DataFrame()
    tell("w-scores")
    factor, level = normative
    formula = without_variable(model.formula, factor)
    variables = closed_formula(formula).names
    check_names([factor], cohort.table.columns)
    levels = {name: text for name, text in references.items() if name in variables}
    spec = replace(model, formula=formula, contrasts=(), dummy=None)
    design = build_design(cohort.table, spec, settings.design, levels)
    column = cohort.table[factor].astype(object).iloc[design.rows]
    reference = (column.astype(str) == level).to_numpy()
    if not reference.any():
        raise ModelError(
            f"w-scores: no participant with the covariates has {factor!r} {level!r}; there are"
            f" {listed(sorted(column.dropna().astype(str).unique()))}"
        )
    sides = {}
    for hemi, side in cohort.sides.items() if measures.maps else ():
        _, positions, rows = np.intersect1d(side.rows, design.rows, return_indices=True)
        matrix, is_reference = design.matrix[rows], reference[rows]
        sides[hemi] = ScoredMaps(
            rows=design.rows[rows],
            reference=is_reference,
            scores={
                name: w_scores(
                    side.maps[name][positions].reshape(len(positions), -1),
                    matrix,
                    is_reference,
                    settings.glm,
                )
                for name in measures.maps
            },
            subfield=most_frequent(side.subfield[positions], len(side.names)),
            names=side.names,
        )
    parts = list(map_rows(cohort, sides, settings))
    for hemi in data.hemispheres(cohort):
        values = data.summary_values(cohort, hemi, measures.summaries).iloc[design.rows]
        among = values[reference]
        values = values.loc[:, (among.max() > among.min()).to_numpy()]
        if values.columns.empty:
            continue
        numbers = values.to_numpy(dtype=np.float64)
        scores_of = w_scores(numbers, design.matrix, reference, settings.glm)
        for i, measure in enumerate(map(str, values.columns)):
            labels = {"hemi": hemi, "measure": measure, "region": None, "reference": reference}
            w, p = scores_of.w[:, i], scores_of.p[:, i]
            parts.append(
                score_rows(cohort, design.rows, **labels, w=w, p=p, low=np.nan, high=np.nan)
            )
    table = pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()
    return (formula, int(reference.sum())), sides, table


def without_variable(formula: str, factor: str) -> str:
    """Remove all terms in which a variable has a part."""
    terms = [
        term_text(term)
        for term in Formula(closed_formula(formula).text)
        if factor not in closed_formula(term_text(term)).names
    ]
    return " + ".join(terms) or "1"


def map_rows(
    cohort: data.Cohort, sides: Mapping[str, ScoredMaps], settings: GroupSettings
) -> Iterator[pd.DataFrame]:
    """Means over the sheet and over each subfield, and the share of points that are outliers."""
    alpha = 1 - settings.glm.confidence
    for hemi, side in sides.items():
        fields = side.subfield.ravel()
        regions = {WHOLE: np.ones(len(fields), dtype=bool)}
        regions |= {name: fields == i for i, name in enumerate(side.names)}
        for measure, scored in side.scores.items():
            out = scored.p < alpha
            for region, points in regions.items():
                if not points.any():
                    continue
                w = scored.w[:, points]
                count = np.isfinite(w).sum(axis=1).astype(np.float64)
                count[count == 0] = np.nan
                yield score_rows(
                    cohort,
                    side.rows,
                    hemi=hemi,
                    measure=measure,
                    region=region,
                    reference=side.reference,
                    w=np.nansum(w, axis=1) / count,
                    p=np.nan,
                    low=(out[:, points] & (w < 0)).sum(axis=1) / count,
                    high=(out[:, points] & (w > 0)).sum(axis=1) / count,
                )


def score_rows(cohort: data.Cohort, rows: Int, **columns: object) -> pd.DataFrame:
    """Put participants and sessions before columns."""
    visits = cohort.table.iloc[rows]
    names = {name: visits[name].to_numpy() for name in (PARTICIPANT, SESSION)}
    return pd.DataFrame({**names, **columns})


def fit_summaries(
    cohort: data.Cohort,
    model: ModelSpec,
    design: Design,
    settings: DesignSettings,
    *,
    names: Sequence[str] | None,
    references: Mapping[str, str],
    icv: str | None,
    rows_of: Callable[[Design], RowModel],
) -> tuple[dict[tuple[str, str], tuple[list[str], PointwiseFit, Int]], list[str]]:
    """Fit the model of the maps to all summary measures; sizes also with intracranial volume."""
    fits: dict[tuple[str, str], tuple[list[str], PointwiseFit, Int]] = {}
    first = data.baselines(cohort)

    def fit(formula: str, model: RowModel, is_included: Callable[[str], bool]) -> None:
        rows = model.design.rows
        for hemi in data.hemispheres(cohort):
            values = data.summary_values(cohort, hemi, names).iloc[rows]
            varied = values.columns[(values.max() > values.min()).to_numpy(dtype=bool)]
            values = values[[name for name in varied if is_included(str(name))]]
            if not values.columns.size:
                continue
            fit_values = model.fit_measures
            if first is not None:
                baseline = data.summary_values(first, hemi, names).iloc[rows][values.columns]
                values = values.where(baseline.notna())
            present = np.flatnonzero(values.notna().any(axis=1).to_numpy())
            if first is not None:
                covariates = baseline.to_numpy(dtype=np.float64)[None, present]
                fit_values = partial(model.fit, covariates=covariates)
            maps: Float = values.to_numpy(dtype=np.float64)[present]
            participants = cohort.table[PARTICIPANT].iloc[rows[present]].to_numpy()
            fits[hemi, formula] = (
                list(values.columns),
                fit_values(maps, present, model.design.contrasts),
                data.participants_with(np.isfinite(maps), participants),
            )

    fit(model.formula, rows_of(design), lambda _: True)
    if not any(
        data.grows_with_head(str(name)) for columns, *_ in fits.values() for name in columns
    ):
        return fits, []
    if icv is None:
        return fits, [f"{data.SIZES} are not adjusted: no intracranial volume is known"]
    if icv in closed_formula(model.formula).names:
        return fits, []
    try:
        adjusted = replace(model, formula=f"{model.formula} + {icv}")
        larger = build_design(cohort.table, adjusted, settings, references)
        larger = replace(larger, contrasts=_same_names(larger, design))
    except ModelError as error:
        return fits, [f"{data.SIZES} are not adjusted for {icv}: {error}"]
    fit(adjusted.formula, rows_of(larger), data.grows_with_head)
    return fits, [f"{data.SIZES} are also tested with head size ({icv})"]


def _same_names(larger: Design, design: Design) -> tuple[Contrast, ...]:
    """Contrasts of the larger design; with that of the mean, if the smaller one has it."""
    names = {contrast.name for contrast in design.contrasts}
    contrasts = with_mean(larger) if MEAN in names else larger.contrasts
    return tuple(contrast for contrast in contrasts if contrast.name in names)


def classify_groups(
    cohort: data.Cohort, groups: Groups, settings: ClassificationSettings
) -> tuple[list[tuple[str, str, tuple[str, str], ModelComparison]], list[str]]:
    """Compare each pair of groups by base measures, and by each further measure on top."""
    names = cohort.table[groups.column].astype(object)
    labels = names.where(names.notna(), "").astype(str).to_numpy(dtype=np.str_)
    results: list[tuple[str, str, tuple[str, str], ModelComparison]] = []
    notes: list[str] = []
    if groups.column in settings.base:
        raise UsageError(
            f"--base {groups.column}: this column has the groups to classify; remove it there"
        )
    hemis, added = data.hemispheres(cohort), settings.added
    for part, hemi in enumerate(hemis):
        values = data.summary_values(cohort, hemi)
        if values.columns.empty:
            continue  # other programs' maps have no summaries
        base = _base(cohort, values, settings)
        measured = values.columns[values.notna().any().to_numpy()]
        for number, measure in enumerate(added, start=part * len(added)):
            tell("classification", number, len(hemis) * len(added))
            if measure not in measured or measure in settings.base:
                continue
            try:
                pairs = compare_pairs(
                    labels,
                    base,
                    values[[measure]].to_numpy(dtype=np.float64),
                    settings,
                    order=groups.levels,
                )
            except ModelError as error:
                notes.append(f"classification by {measure}, hemisphere {hemi}: {error}")
                continue
            results += [(hemi, measure, pair, one) for pair, one in pairs.items()]
    forget_models()
    return results, notes


def _base(cohort: data.Cohort, values: pd.DataFrame, settings: ClassificationSettings) -> Float:
    """Columns of the base model, from the summaries or the covariates."""
    names = settings.base
    check_names(names, values.columns.union(cohort.table.columns, sort=False))
    columns = []
    for name in names:
        if name in values.columns:
            columns.append(values[name].to_numpy(dtype=np.float64))
            continue
        column = typed(cohort.table[name])
        if pd.api.types.is_numeric_dtype(column):
            columns.append(column.to_numpy(dtype=np.float64))
        else:
            levels = sorted(column.dropna().unique())
            columns += [
                np.where(column.notna(), (column == level).to_numpy(dtype=np.float64), np.nan)
                for level in levels[1:]
            ]
    return np.column_stack(columns)
