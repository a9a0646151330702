"""w-scores: how far maps and measures are from those of a reference group, given covariates."""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
import pandas as pd
from formulaic import Formula

from hipsta_bids.errors import ModelError
from hipsta_bids.group.cohort.data import Cohort, Measures, hemispheres, summary_values
from hipsta_bids.group.design.formula import ModelSpec, check_names, listed
from hipsta_bids.group.design.grammar import closed_formula
from hipsta_bids.group.design.model import build_design
from hipsta_bids.group.design.settings import GroupSettings
from hipsta_bids.group.output.results import ScoredMaps, Scores
from hipsta_bids.group.stats.arrays import Int
from hipsta_bids.group.stats.glm import most_frequent
from hipsta_bids.group.stats.norms import w_scores
from hipsta_bids.progress import tell
from hipsta_bids.types import PARTICIPANT, SESSION

#: Region of a score that is the mean over the whole sheet.
WHOLE = "all"


def score_cohort(
    cohort: Cohort,
    model: ModelSpec,
    normative: tuple[str, str] | None,
    settings: GroupSettings,
    *,
    measures: Measures,
    references: Mapping[str, str],
) -> Scores | None:
    """Score all participants who have the covariates of a model, whatever their group."""
    if normative is None:
        return None
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
    for hemi in hemispheres(cohort):
        values = summary_values(cohort, hemi, measures.summaries).iloc[design.rows]
        among = values[reference]
        values = values.loc[:, (among.max() > among.min()).to_numpy()]
        if values.columns.empty:
            continue
        numbers = values.to_numpy(dtype=np.float64)
        scores_of = w_scores(numbers, design.matrix, reference, settings.glm)
        for i, measure in enumerate(map(str, values.columns)):
            labels = {"hemi": hemi, "measure": measure, "region": None, "reference": reference}
            numbers_of = {
                "w": scores_of.w[:, i],
                "p": scores_of.p[:, i],
                "low": np.nan,
                "high": np.nan,
            }
            parts.append(score_rows(cohort, design.rows, **labels, **numbers_of))
    return Scores(
        factor=factor,
        level=level,
        formula=formula,
        n_reference=int(reference.sum()),
        sides=sides,
        table=pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(),
    )


def without_variable(formula: str, factor: str) -> str:
    """Leave out all terms in which a variable has a part."""
    terms = [
        str(term)
        for term in Formula(closed_formula(formula).text)
        if factor not in closed_formula(str(term)).names
    ]
    return " + ".join(terms) or "1"


def map_rows(
    cohort: Cohort, sides: Mapping[str, ScoredMaps], settings: GroupSettings
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


def score_rows(cohort: Cohort, rows: Int, **columns: object) -> pd.DataFrame:
    """Put participants and sessions before columns."""
    visits = cohort.table.iloc[rows]
    names = {name: visits[name].to_numpy() for name in (PARTICIPANT, SESSION)}
    return pd.DataFrame({**names, **columns})
