"""Scores of participants against a reference group of the same cohort (w-scores)."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from hipsta_bids.errors import ModelError
from hipsta_bids.extensions.norms import EXTENSION, STEP
from hipsta_bids.extensions.norms.wscores import ScoredMaps, w_scores
from hipsta_bids.group.cohort import data
from hipsta_bids.group.output.results import Analysis
from hipsta_bids.group.output.tables import Averages, entity_label, read_columns
from hipsta_bids.group.output.write import can_write_parquet
from hipsta_bids.group.request import Request
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.io import files, gifti
from hipsta_bids.joints import Writer
from hipsta_bids.progress import tell
from hipsta_bids.stats.arrays import Int
from hipsta_bids.stats.design import build_design
from hipsta_bids.stats.formula import check_names, listed
from hipsta_bids.stats.glm import most_frequent
from hipsta_bids.stats.grammar import closed_formula, without_variable
from hipsta_bids.types import PARTICIPANT, SESSION

#: Region of a score that is the mean over the whole sheet.
WHOLE = "all"


@dataclass(frozen=True, eq=False, kw_only=True)
class Scores:
    """Scores of a cohort against its reference group."""

    formula: str
    """Covariates that scores are adjusted for."""
    count: int
    """Participants of the reference group."""
    sides: Mapping[str, ScoredMaps]
    """Of maps, by hemisphere."""
    table: pd.DataFrame
    """One row per participant, hemisphere and summary measure or region of a map."""


def is_asked(request: Request) -> bool:
    """Check whether participants are scored against a group."""
    return request.options.get("normative") is not None


def choose_reference(request: Request) -> tuple[str, str]:
    """Return factor and level of the reference group."""
    factor, level = request.options["normative"]
    return factor, level


def score_cohort(analysis: Analysis, plan: tuple[str, str]) -> Analysis:
    """Score all participants who have the covariates of a model, whatever their group."""
    tell("w-scores")
    request, cohort, (factor, level) = analysis.request, analysis.compared, plan
    model, settings, measures = request.model, request.settings, request.measures
    formula = without_variable(model.formula, factor)
    variables = closed_formula(formula).names
    check_names([factor], cohort.table.columns)
    levels = {name: text for name, text in request.references.items() if name in variables}
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
    scores = Scores(formula=formula, count=int(reference.sum()), sides=sides, table=table)
    return replace(analysis, parts={**analysis.parts, STEP: scores})


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


def tables(
    cohort: data.Cohort,  # noqa: ARG001  (as of all steps)
    analysis: Analysis,
    prefix: str,
) -> Iterator[tuple[str, pd.DataFrame, Mapping[str, str]]]:
    """Table of scores, with the meaning of its columns."""
    table = analysis.parts[STEP].table
    if len(table):
        yield f"{prefix}wscores", table, read_columns(EXTENSION.package)


def score_files(
    cohorts: Mapping[str, data.Cohort],
    analyses: Mapping[str, Analysis],
    labels: Mapping[str, list[str]],  # noqa: ARG001  (as of all steps)
    averages: Averages,  # noqa: ARG001  (as of all steps)
) -> Iterator[Writer]:
    """Write maps of scores of all surfaces."""
    for surface, analysis in analyses.items():
        yield partial(
            write_scores,
            cohort=cohorts[surface],
            table=analysis.compared.table,
            sides=analysis.parts[STEP].sides,
            letter="w",
            sheets=bool(analysis.registered),
        )


def write_scores(
    folder: Path,
    cohort: data.Cohort,
    table: pd.DataFrame,
    sides: Mapping[str, ScoredMaps],
    *,
    letter: str,
    sheets: bool,
) -> None:
    """Write each participant's scores as maps; maps of the sheet also as one Parquet file."""
    for hemi, side in sides.items():
        names = [str(name) for name in table.index[side.rows]]
        for measure, scored in side.scores.items():
            content = gifti.maps_bytes(scored.w.T, hemi=hemi, names=names, series=False)
            name = f"hemi-{hemi}_stat-{letter}_desc-{entity_label(measure)}_statmap.shape.gii"
            files.write_bytes(folder / name, content)
    if sheets and sides and can_write_parquet():
        from hipsta_bids.extensions.norms import parquet  # noqa: PLC0415  (an optional extra)

        parquet.write_scores(folder, cohort, table, sides, letter)
