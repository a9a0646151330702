"""Scores of participants against a reference group of the same cohort (w-scores)."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import special

from hipsta_bids.errors import ModelError
from hipsta_bids.stats.arrays import Bool, Float, Int
from hipsta_bids.stats.glm import chunks, fit_block
from hipsta_bids.stats.settings import GlmSettings


@dataclass(frozen=True)
class NormativeScores:
    """Scores of all subjects at all points; NaN where a value or the model is missing."""

    w: Float
    """(subjects, points) observed minus expected, in residual standard deviations of the reference
    group (Jack et al. 1997)."""
    p: Float
    """(subjects, points) two-sided, with the uncertainty of the expectation."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ScoredMaps:
    """Scores of one hemisphere."""

    rows: Int
    """(sheets,) rows of the cohort's table."""
    reference: Bool
    """(sheets,) who belongs to the reference group."""
    scores: Mapping[str, NormativeScores]
    """By measure; points in the order of the sheet."""
    subfield: Int
    """(x, y) most frequent subfield, position in ``names``."""
    names: tuple[str, ...]


def w_scores(maps: Float, matrix: Float, reference: Bool, settings: GlmSettings) -> NormativeScores:
    """Score each subject against a reference group, adjusted for covariates.

    Members of the reference group are scored against its other members: as if the model were fitted
    without them (from their leverage, so that nothing is fitted again). Their scores are thus
    comparable with the scores of all others.
    """
    if settings.covariance != "ordinary":
        raise ModelError("normative scores assume equal variances; set glm.covariance to ordinary")
    reference_matrix = matrix[reference]
    if len(reference_matrix) - matrix.shape[1] <= settings.min_residual_df:
        raise ModelError(
            f"normative scores: {len(reference_matrix)} reference subjects are too few for"
            f" {matrix.shape[1]} columns"
        )
    if np.linalg.matrix_rank(reference_matrix) < matrix.shape[1]:
        raise ModelError(
            "normative scores: columns are not independent in the reference group; remove a "
            "covariate that does not vary there"
        )
    basis, triangle = np.linalg.qr(reference_matrix)
    rotated = matrix @ np.linalg.inv(triangle)
    member = reference[:, None]
    w, p = np.full((2, *maps.shape), np.nan)
    for part in chunks(maps.shape, matrix.shape[1]):
        values = np.asarray(maps[:, part], dtype=np.float64)
        fit = fit_block(values[reference], basis, settings)
        inverse = fit.covariance / (fit.sigma**2)[:, None, None]
        leverage = np.einsum("psi,si->sp", rotated @ inverse, rotated)
        residuals = values - rotated @ fit.scores.T
        df = np.where(np.isfinite(fit.sigma), fit.n - basis.shape[1], np.nan) - member
        # A subject that alone determines a coefficient cannot be predicted without it.
        left = np.where(member, 1 - leverage, 1.0)
        left[left <= np.sqrt(np.finfo(np.float64).eps)] = np.nan
        # Of members, the variance without themselves.
        squares = fit.sigma**2 * (df + member) - np.where(member, residuals**2 / left, 0.0)
        sigma = np.sqrt(np.maximum(squares, 0.0) / df)
        w[:, part] = residuals / left / np.where(sigma > 0, sigma, np.nan)
        p[:, part] = 2 * tail_probability(
            w[:, part], df, np.where(member, leverage / left, leverage)
        )
    return NormativeScores(w, p)


def tail_probability(z: Float, df: Float, variance: Float) -> Float:
    """Compute the probability of a deviation of this size to one side, by Student's distribution.

    ``variance`` is the variance of the expectation over the variance of values.
    """
    return np.asarray(special.stdtr(df, -np.abs(z) / np.sqrt(1 + variance)))
