"""w-scores: how far maps and measures are from those of a reference group, given covariates."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from formulaic import Formula
from numpy.typing import NDArray
from scipy import special

from hipsta_bids.errors import ModelError
from hipsta_bids.group.data import PARTICIPANT, SESSION, Bool, Cohort, Float, Int, Measures
from hipsta_bids.group.formula import ModelSpec, check_names, listed
from hipsta_bids.group.glm import chunks, fit_block, most_frequent
from hipsta_bids.group.grammar import closed_formula
from hipsta_bids.group.model import build_design
from hipsta_bids.group.settings import GlmSettings, GroupSettings
from hipsta_bids.group.summaries import hemispheres, summary_values
from hipsta_bids.progress import tell

#: Region of a score that is the mean over the whole sheet.
WHOLE = "all"


@dataclass(frozen=True)
class NormativeScores:
    """Scores of all subjects at all points; NaN where a value or the model is missing."""

    w: Float
    """(subjects, points) observed minus expected, in residual standard deviations of the reference
    group (Jack et al. 1997)."""
    p: Float
    """(subjects, points) two-sided, with the uncertainty of the expectation."""


def w_scores(maps: Float, matrix: Float, reference: Bool, settings: GlmSettings) -> NormativeScores:
    """Score each subject against a reference group, adjusted for covariates.

    Members of the reference group are scored against the others: as if the model had been
    fitted without them (from their leverage, so that nothing is fitted again). Their scores
    thus mean the same as those of everybody else.
    """
    if settings.covariance != "ordinary":
        raise ModelError(
            "normative scores assume equal variances; set glm.covariance to ordinary",
            reason="normative-covariance",
        )
    own = matrix[reference]
    if len(own) - matrix.shape[1] <= settings.min_residual_df:
        raise ModelError(
            f"normative scores: {len(own)} reference subjects are too few for"
            f" {matrix.shape[1]} columns",
            reason="group-size",
        )
    if np.linalg.matrix_rank(own) < matrix.shape[1]:
        raise ModelError(
            "normative scores: in the reference group the columns are not independent; leave out"
            " a covariate that does not vary there",
            reason="design-rank",
        )
    basis, triangle = np.linalg.qr(own)
    rotated = matrix @ np.linalg.inv(triangle)
    parts = [
        _score(np.asarray(maps[:, part], dtype=np.float64), rotated, basis, reference, settings)
        for part in chunks(maps.shape, matrix.shape[1])
    ]
    return NormativeScores(*map(np.hstack, zip(*parts, strict=True)))


def _score(
    maps: Float,
    rotated: Float,
    basis: Float,
    reference: Bool,
    settings: GlmSettings,
) -> tuple[Float, Float]:
    fit = fit_block(maps[reference], basis, settings)
    inverse = fit.covariance / (fit.sigma**2)[:, None, None]
    leverage = np.einsum("psi,si->sp", rotated @ inverse, rotated)
    residuals = maps - rotated @ fit.scores.T
    df = np.broadcast_to(
        np.where(np.isfinite(fit.sigma), fit.n - basis.shape[1], np.nan), maps.shape
    )
    variance = np.broadcast_to(fit.sigma**2, maps.shape)
    member = reference[:, None]
    # A subject that alone determines a coefficient cannot be told without it.
    kept = np.where(member, 1 - leverage, 1.0)
    kept = np.where(kept > np.sqrt(np.finfo(np.float64).eps), kept, np.nan)
    without = (variance * df - residuals**2 / kept) / (df - 1)
    sigma = np.sqrt(np.where(member, np.maximum(without, 0.0), variance))
    error = residuals / kept
    w = error / np.where(sigma > 0, sigma, np.nan)
    # Variance of the expectation, with the subject itself left out: h / (1 - h).
    spread = np.where(member, leverage / kept, leverage)
    freedom = np.where(member, df - 1, df)
    p = 2 * special.stdtr(freedom, -np.abs(w) / np.sqrt(1 + spread))
    return w, np.asarray(p, dtype=np.float64)


@dataclass(frozen=True, eq=False, kw_only=True)
class ScoredMaps:
    """Scores of one hemisphere."""

    rows: Int
    """(sheets,) rows of the cohort's table."""
    reference: NDArray[np.bool_]
    """(sheets,) who belongs to the reference group."""
    scores: Mapping[str, NormativeScores]
    """By measure; points in the order of the sheet."""
    subfield: Int
    """(x, y) most frequent subfield, position in ``names``."""
    names: tuple[str, ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class Scores:
    """All scores against one reference group."""

    factor: str
    level: str
    formula: str
    """Covariates that are adjusted for."""
    n_reference: int
    sides: Mapping[str, ScoredMaps]
    """By hemisphere; empty without maps."""
    table: pd.DataFrame
    """One row per participant, hemisphere and summary measure or region of a map."""


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
    known = closed_formula(formula).names
    check_names([factor], cohort.table.columns)
    chosen = {name: text for name, text in references.items() if name in known}
    spec = replace(model, formula=formula, contrasts=(), dummy=None)
    design = build_design(cohort.table, spec, settings.design, chosen)
    column = cohort.table[factor].astype(object).iloc[design.rows]
    reference = (column.astype(str) == level).to_numpy()
    if not reference.any():
        raise ModelError(
            f"w-scores: no participant with the covariates has {factor!r} {level!r}; there are"
            f" {listed(sorted(column.dropna().astype(str).unique()))}",
            reason="unknown-level",
        )
    sides = {}
    for hemi, side in cohort.sides.items() if measures.maps else ():
        _, used, rows = np.intersect1d(side.rows, design.rows, return_indices=True)
        matrix, own = design.matrix[rows], reference[rows]
        sides[hemi] = ScoredMaps(
            rows=design.rows[rows],
            reference=own,
            scores={
                name: w_scores(
                    side.maps[name][used].reshape(len(used), -1), matrix, own, settings.glm
                )
                for name in measures.maps
            },
            subfield=most_frequent(side.subfield[used], len(side.names)),
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
        found = w_scores(numbers, design.matrix, reference, settings.glm)
        for i, measure in enumerate(map(str, values.columns)):
            what = {"hemi": hemi, "measure": measure, "region": None, "reference": reference}
            numbers_of = {"w": found.w[:, i], "p": found.p[:, i], "low": np.nan, "high": np.nan}
            parts.append(score_rows(cohort, design.rows, **what, **numbers_of))
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
        for measure, found in side.scores.items():
            out = found.p < alpha
            for region, points in regions.items():
                if not points.any():
                    continue
                w = found.w[:, points]
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
