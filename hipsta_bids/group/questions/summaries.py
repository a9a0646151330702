"""Summary measures in the models of the maps, and as classifiers, as in the paper's tables."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from hipsta_bids.errors import ModelError, UsageError
from hipsta_bids.group.cohort.data import Cohort, hemispheres, participants_with, summary_values
from hipsta_bids.group.design.formula import Contrast, ModelSpec, check_names, typed
from hipsta_bids.group.design.grammar import closed_formula
from hipsta_bids.group.design.model import Design, Groups, build_design
from hipsta_bids.group.design.settings import ClassificationSettings, DesignSettings
from hipsta_bids.group.output.results import MeasureFit
from hipsta_bids.group.stats.arrays import Float
from hipsta_bids.group.stats.classify import ModelComparison, compare_pairs, forget_models
from hipsta_bids.group.stats.glm import MEAN, RowModel, with_mean
from hipsta_bids.progress import tell
from hipsta_bids.types import PARTICIPANT


def fit_summaries(
    cohort: Cohort,
    model: ModelSpec,
    design: Design,
    settings: DesignSettings,
    *,
    names: Sequence[str] | None,
    references: Mapping[str, str],
    icv: str | None,
    rows_of: Callable[[Design], RowModel],
) -> tuple[list[MeasureFit], list[str]]:
    """Fit the model of the maps to all summary measures; volumes also with intracranial volume."""
    fits: list[MeasureFit] = []

    def fit(formula: str, model: RowModel, start: str = "") -> None:
        rows = model.design.rows
        for hemi in hemispheres(cohort):
            values = summary_values(cohort, hemi, names).iloc[rows]
            named = values.columns.astype(str).str.startswith(start)
            values = values.loc[:, named & (values.max() > values.min()).to_numpy()]
            if not values.columns.size:
                continue
            present = np.flatnonzero(values.notna().any(axis=1).to_numpy())
            maps: Float = values.to_numpy(dtype=np.float64)[present]
            participants = cohort.table[PARTICIPANT].iloc[rows[present]].to_numpy()
            fits.append(
                MeasureFit(
                    hemi=hemi,
                    measures=tuple(values.columns),
                    formula=formula,
                    fit=model.fit_measures(maps, present, model.design.contrasts),
                    participants=participants_with(np.isfinite(maps), participants),
                )
            )

    fit(model.formula, rows_of(design))
    if not fits:
        return fits, []
    if icv is None:
        return fits, ["volumes are not adjusted: no intracranial volume is known"]
    if icv in closed_formula(model.formula).names:
        return fits, []
    try:
        adjusted = replace(model, formula=f"{model.formula} + {icv}")
        larger = build_design(cohort.table, adjusted, settings, references)
        larger = replace(larger, contrasts=_same_names(larger, design))
    except ModelError as error:
        return fits, [f"volumes are not adjusted for {icv}: {error}"]
    fit(adjusted.formula, rows_of(larger), "volume")
    return fits, []


def _same_names(larger: Design, design: Design) -> tuple[Contrast, ...]:
    """Contrasts of the larger design; with that of the mean, if the smaller one has it."""
    names = {contrast.name for contrast in design.contrasts}
    contrasts = with_mean(larger) if MEAN in names else larger.contrasts
    return tuple(contrast for contrast in contrasts if contrast.name in names)


def classify_groups(
    cohort: Cohort, groups: Groups, settings: ClassificationSettings
) -> tuple[list[tuple[str, str, tuple[str, str], ModelComparison]], list[str]]:
    """Compare each pair of groups by base measures, and by each further measure on top."""
    names = cohort.table[groups.column].astype(object)
    labels = names.where(names.notna(), "").astype(str).to_numpy(dtype=np.str_)
    results: list[tuple[str, str, tuple[str, str], ModelComparison]] = []
    notes: list[str] = []
    if groups.column in settings.base:
        raise UsageError(f"--base {groups.column}: that is what is told apart")
    hemis, added = hemispheres(cohort), settings.added
    for part, hemi in enumerate(hemis):
        values = summary_values(cohort, hemi)
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


def _base(cohort: Cohort, values: pd.DataFrame, settings: ClassificationSettings) -> Float:
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
