"""Logistic regression: by maximum likelihood, and Firth's for separated groups."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special

from hipsta_bids.errors import ModelError
from hipsta_bids.group.settings import ClassificationSettings

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

#: Largest sum of margins, per subject, that still counts as rounding of the linear program.
_NO_MARGIN = 1e-7
#: Longest step of a coefficient, in standard deviations of its column, as in ``logistf``.
_LONGEST_STEP = 5.0
#: A step must gain at least this share of what the slope promises, or it is halved.
_SHARE = 0.1
#: Log likelihoods differ by rounding by no more than this, relatively.
_ROUNDING = 1e-12
#: Halvings of a step that does not gain.
_HALVINGS = 30


@dataclass(frozen=True)
class LogisticFit:
    """One logistic model."""

    coefficients: FloatArray
    """Log odds per unit of each column."""
    se: FloatArray
    """From the inverse of Fisher's information at the estimate."""
    log_likelihood: float
    """With Firth the penalized one: half the log determinant of the information comes on top."""
    firth: bool
    """Whether Firth's penalty was used."""


def is_separated(matrix: FloatArray, case: BoolArray) -> bool:
    """Whether a combination of the columns tells the groups apart without overlap.

    Then maximum-likelihood estimates are infinite (Albert and Anderson 1984). Found exactly, by
    a linear program (Konis 2007): the largest sum of margins under which none is negative.
    """
    scale = np.abs(matrix).max(axis=0)
    margins = np.where(case, 1.0, -1.0)[:, None] * matrix / np.where(scale > 0, scale, 1.0)
    solution = optimize.linprog(
        -margins.sum(axis=0), A_ub=-margins, b_ub=np.zeros(len(margins)), bounds=(-1, 1)
    )
    return bool(margins.sum(axis=0) @ solution.x > _NO_MARGIN * len(margins))


def fit_logistic(
    matrix: FloatArray,
    case: BoolArray,
    settings: ClassificationSettings,
    *,
    firth: bool,
    free: BoolArray | None = None,
) -> LogisticFit:
    """Fit a logistic regression by Newton's method.

    ``firth`` Penalize the likelihood by the square root of the information's determinant, Jeffreys'
    prior (Firth 1993): finite under separation, and less biased; ``free`` the others stay zero but
    count in the penalty, as the penalized likelihood-ratio test needs it (Heinze and Schemper
    2002).
    """
    spread = matrix.std(axis=0)
    scale = np.where(spread > 0, spread, np.maximum(np.abs(matrix).max(axis=0), 1e-300))
    scaled = matrix / scale
    kept = np.ones(matrix.shape[1], dtype=bool) if free is None else free
    beta = np.zeros(matrix.shape[1])
    value = _log_likelihood(scaled, case, beta, firth=firth)
    limit = settings.firth_iterations if firth else settings.iterations
    for _ in range(limit):
        step, promised = _newton_step(scaled, case, beta, kept, firth=firth)
        for halving in range(_HALVINGS):
            new = _log_likelihood(scaled, case, beta + step, firth=firth)
            least = _SHARE * promised / 2**halving - _ROUNDING * (1 + abs(value))
            if new >= value + least:
                break
            step = step / 2
        beta, value = beta + step, new
        if promised < settings.tolerance:
            break
    else:
        raise ModelError(
            f"logistic model: no convergence in {limit} steps; the groups may be"
            " separated, or columns nearly the same",
            reason="logistic-convergence",
        )
    covariance = np.linalg.inv(_information(scaled, beta))
    return LogisticFit(
        coefficients=beta / scale,
        se=np.sqrt(np.diagonal(covariance)) / scale,
        # The penalty is that of the columns as given.
        log_likelihood=value + (np.log(scale).sum() if firth else 0.0),
        firth=firth,
    )


def _information(matrix: FloatArray, beta: FloatArray) -> FloatArray:
    chance = special.expit(matrix @ beta)
    weighted: FloatArray = matrix.T @ (matrix * (chance * (1 - chance))[:, None])
    return weighted


def _log_likelihood(matrix: FloatArray, case: BoolArray, beta: FloatArray, *, firth: bool) -> float:
    margin = np.where(case, 1.0, -1.0) * (matrix @ beta)
    value = float(special.log_expit(margin).sum())
    if firth:
        value += 0.5 * float(np.linalg.slogdet(_information(matrix, beta))[1])
    return value


def _newton_step(
    matrix: FloatArray, case: BoolArray, beta: FloatArray, kept: BoolArray, *, firth: bool
) -> tuple[FloatArray, float]:
    """Next step, and the gain that the slope promises."""
    chance = special.expit(matrix @ beta)
    weight = chance * (1 - chance)
    information = matrix.T @ (matrix * weight[:, None])
    residual = case - chance
    if firth:
        leverage = weight * np.sum(matrix @ np.linalg.pinv(information) * matrix, axis=1)
        residual = residual + leverage * (0.5 - chance)
    score = (matrix.T @ residual)[kept]
    step = np.zeros(len(beta))
    step[kept] = np.linalg.pinv(information[np.ix_(kept, kept)], hermitian=True) @ score
    step *= min(1.0, _LONGEST_STEP / max(float(np.abs(step).max()), 1e-300))
    return step, float(score @ step[kept])
