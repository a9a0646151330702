"""How far each subject is from what a reference group would have, given the covariates."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from hipsta_bids.errors import ModelError
from hipsta_bids.group.glm import chunks, fit_block
from hipsta_bids.group_settings import GlmSettings

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class NormativeScores:
    """Scores of all subjects at all points; NaN where a value or the model is missing."""

    w: FloatArray
    """(subjects, points) observed minus expected, in residual standard deviations of the reference
    group (Jack et al. 1997)."""
    p: FloatArray
    """(subjects, points) two-sided, with the uncertainty of the expectation."""
    n_reference: NDArray[np.int64]
    """(points,) reference subjects with a value."""


def w_scores(
    maps: FloatArray, matrix: FloatArray, reference: BoolArray, settings: GlmSettings
) -> NormativeScores:
    """Score each subject against a reference group, adjusted for covariates.

    Members of the reference group are scored against the others: as if the model had been
    fitted without them (from their leverage, so that nothing is fitted again). Their scores
    thus mean the same as those of everybody else.

    Parameters
    ----------
    maps : ndarray, shape (subjects, points)
        NaN is missing.
    matrix : ndarray, shape (subjects, columns)
        Covariates, with an intercept, and without the group.
    reference : ndarray of bool, shape (subjects,)
        Who belongs to the reference group.
    settings : GlmSettings
        When a point is left out.

    Returns
    -------
    NormativeScores

    Raises
    ------
    ModelError
        If the reference group is too small for the covariates or lacks one of them, or the
        settings ask for unequal variances.
    """
    if settings.covariance != "ordinary":
        raise ModelError(
            "normative scores assume equal variances; set glm.covariance to ordinary",
            reason="normative-covariance",
        )
    own = matrix[reference]
    if not np.isfinite(matrix).all():
        raise ModelError(
            "normative scores: covariates are missing; keep complete rows only",
            reason="design-missing",
        )
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
    return NormativeScores(
        w=np.hstack([part.w for part in parts]),
        p=np.hstack([part.p for part in parts]),
        n_reference=np.concatenate([part.n_reference for part in parts]),
    )


def _score(
    maps: FloatArray,
    rotated: FloatArray,
    basis: FloatArray,
    reference: BoolArray,
    settings: GlmSettings,
) -> NormativeScores:
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
    return NormativeScores(w, np.asarray(p, dtype=np.float64), fit.n)
