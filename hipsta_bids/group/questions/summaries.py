"""Models and classifiers of summary measures."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd

from hipsta_bids.errors import ModelError, UsageError
from hipsta_bids.group.cohort import data
from hipsta_bids.group.model import Groups
from hipsta_bids.progress import tell
from hipsta_bids.stats.arrays import Float, Int
from hipsta_bids.stats.classify import ModelComparison, compare_pairs, forget_models
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.design import Design, build_design
from hipsta_bids.stats.formula import ModelSpec, check_names, typed
from hipsta_bids.stats.glm import MEAN, PointwiseFit, RowModel, with_mean
from hipsta_bids.stats.grammar import closed_formula
from hipsta_bids.stats.settings import ClassificationSettings, DesignSettings
from hipsta_bids.types import PARTICIPANT


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
    """Fit the model of the maps to all summary measures; sizes also with intracranial volume.

    Summary measures in the formula are not fitted.
    """
    fits: dict[tuple[str, str], tuple[list[str], PointwiseFit, Int]] = {}
    first, covariates = data.baselines(cohort), model.summaries

    def fit(formula: str, model: RowModel, is_included: Callable[[str], bool]) -> None:
        rows = model.design.rows
        for hemi in data.hemispheres(cohort):
            values = data.summary_values(cohort, hemi, names).iloc[rows]
            varied = values.columns[(values.max() > values.min()).to_numpy(dtype=bool)]
            values = values[[name for name in varied if is_included(str(name))]]
            if not values.columns.size:
                continue
            fit_values, added = model.fit_measures, None
            if first is not None:
                baseline = data.summary_values(first, hemi, names).iloc[rows][values.columns]
                values, added = values.where(baseline.notna()), baseline.to_numpy(np.float64)[None]
            elif covariates:
                added = _repeated(cohort, hemi, covariates, rows, values.shape[1])
            present = np.flatnonzero(values.notna().any(axis=1).to_numpy())
            if added is not None:
                fit_values = partial(model.fit, covariates=added[:, present])
            maps: Float = values.to_numpy(dtype=np.float64)[present]
            participants = cohort.table[PARTICIPANT].iloc[rows[present]].to_numpy()
            fits[hemi, formula] = (
                list(values.columns),
                fit_values(maps, present, model.design.contrasts),
                data.participants_with(np.isfinite(maps), participants),
            )

    fit(model.formula, rows_of(design), lambda name: name not in covariates)
    if not any(
        data.grows_with_head(str(name)) for columns, *_ in fits.values() for name in columns
    ):
        return fits, []
    try:
        adjusted, larger = _with_head_size(cohort, model, design, (settings, references), icv)
    except ModelError as error:
        return fits, [f"{data.SIZES} are not adjusted{error}"]
    if larger is None:
        return fits, []
    fit(
        adjusted.formula, rows_of(larger), lambda n: data.grows_with_head(n) and n not in covariates
    )
    unknown = len(design.rows) - len(larger.rows)
    without = f", which is not known for {unknown} of {len(design.rows)} rows" if unknown else ""
    return fits, [f"{data.SIZES} are also tested with head size ({icv}){without}"]


def _with_head_size(
    cohort: data.Cohort,
    model: ModelSpec,
    design: Design,
    coding: tuple[DesignSettings, Mapping[str, str]],
    icv: str | None,
) -> tuple[ModelSpec, Design | None]:
    """Add intracranial volume to a model; no design if it is there. ModelError says why not."""
    if icv is None:
        raise ModelError(": no intracranial volume is known")
    if icv in closed_formula(model.formula).names:
        return model, None
    adjusted = replace(model, formula=f"{model.formula} + {icv}")
    try:
        larger = build_design(cohort.table, adjusted, *coding, has_random=True)
        return adjusted, replace(larger, contrasts=_same_names(larger, design))
    except ModelError as error:
        raise ModelError(f" for {icv}: {error}") from error


def _repeated(
    cohort: data.Cohort, hemi: str, names: Sequence[str], rows: Int, n_measures: int
) -> Float:
    """Summary measures (names, rows, measures) of a hemisphere, the same for all measures."""
    values = data.covariate_values(cohort, hemi, names).iloc[rows].to_numpy(dtype=np.float64)
    return np.broadcast_to(values.T[:, :, None], (len(names), len(rows), n_measures))


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
