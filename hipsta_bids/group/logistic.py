"""Logistic models: by maximum likelihood, or by Firth's method where they separate the groups."""

import warnings
from dataclasses import dataclass

import numpy as np
from scipy import optimize, special
from statsmodels.discrete.discrete_model import Logit

from hipsta_bids.errors import ModelError
from hipsta_bids.group.data import Bool, Float
from hipsta_bids.group.settings import ClassificationSettings

#: Largest sum of margins, per subject, that still counts as rounding of the linear program.
_NO_MARGIN = 1e-7
#: Most steps of Newton's method, which takes some eight, and the length of the last; columns have
#: a mean square of one.
_NEWTON_STEPS, _SETTLED = 25, 1e-8
#: Maximum likelihood has converged when coefficients of unit columns change by less.
_CONVERGED = 1e-10
#: Longest step of Firth's method, in standard deviations of a column, as in ``logistf``.
_LONGEST_STEP = 5.0
#: A step must gain at least this share of what the slope promises, or it is halved.
_SHARE = 0.1
#: Log likelihoods differ by rounding by no more than this, relatively.
_ROUNDING = 1e-12
#: Steps of Firth's method by the information, before those of Newton's method.
_FISHER_STEPS = 20
#: Step of derivatives, least curvature and flattest direction of Firth's method, where one is that
#: of the information.
_DIFFERENCE, _LEAST_BEND, _FLATTEST = 1e-4, 1e-3, 1e-12
#: Halvings of a step that does not gain.
_HALVINGS = 30
#: Directions of a training set with less than this share of the largest are no columns.
RANK = 1e-9


@dataclass(frozen=True)
class LogisticFit:
    """One logistic model."""

    coefficients: Float
    """Log odds per unit of each column."""
    se: Float
    """From the inverse of Fisher's information at the estimate."""
    log_likelihood: float
    """With Firth the penalized one: half the log determinant of the information comes on top."""
    firth: bool
    """Whether Firth's penalty was used."""


def is_separated(matrix: Float, case: Bool) -> bool:
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
    matrix: Float,
    case: Bool,
    settings: ClassificationSettings,
    *,
    firth: bool,
    free: Bool | None = None,
) -> LogisticFit:
    """Fit a logistic regression by maximum likelihood, or by Firth's method.

    Of Firth's, columns that are not ``free`` stay zero but count in the penalty, as the penalized
    likelihood-ratio test needs it (Heinze and Schemper 2002).
    """
    if firth:
        return _fit_firth(matrix, case, settings, free)
    fit = _fit_maximum(matrix, case, settings)
    if fit is None:
        raise _no_convergence(settings.iterations)
    return fit


def fit_overlapping_or_firth(
    matrix: Float, case: Bool, settings: ClassificationSettings
) -> LogisticFit:
    """Fit by maximum likelihood if the groups overlap, else by Firth's method."""
    if not overlaps(matrix, case) and is_separated(matrix, case):
        return _fit_firth(matrix, case, settings)
    return fit_logistic(matrix, case, settings, firth=False)


def overlaps(matrix: Float, case: Bool) -> bool:
    """Whether maximum likelihood converges, which it does not if the groups are separated.

    Where it does not, :func:`is_separated` decides.
    """
    return bool(maxima(orthonormal(matrix), case, np.ones((1, len(case))))[1][0])


def orthonormal(matrix: Float) -> Float:
    """Give an orthonormal basis of the columns, times the root of the number of rows."""
    basis, size, _ = np.linalg.svd(matrix / _scales(matrix), full_matrices=False)
    return np.asarray(basis[:, size > RANK * size[0]] * np.sqrt(len(matrix)), dtype=np.float64)


def maxima(basis: Float, case: Bool, kept: Float) -> tuple[Float, Bool]:
    """Maximize the likelihood in several sets of subjects at once, by Newton's method.

    ``kept`` is (sets, subjects), 1 for members. Gives coefficients (sets, columns), and in which
    sets the steps converged: with separated groups each step is about as long as the one before.
    """
    columns = basis.shape[1]
    products = (basis[:, :, None] * basis[:, None, :]).reshape(len(basis), -1)
    beta = np.zeros((len(kept), columns))
    settled = np.zeros(len(kept), dtype=bool)
    lost = np.zeros(len(kept), dtype=bool)
    for _ in range(_NEWTON_STEPS):
        chance = special.expit(beta @ basis.T)
        information = ((kept * chance * (1 - chance)) @ products).reshape(-1, columns, columns)
        size = np.linalg.eigvalsh(information)
        lost |= ~(size[:, 0] > RANK * size[:, -1])
        information[lost] = np.eye(columns)
        score = (kept * (case - chance)) @ basis
        step = np.linalg.solve(information, score[:, :, None])[:, :, 0]
        beta[~lost] += step[~lost]
        settled = ~lost & (np.abs(step).max(axis=1) < _SETTLED)
        if (settled | lost).all():
            break
    return beta, settled


def _no_convergence(limit: int) -> ModelError:
    return ModelError(
        f"logistic model: no convergence in {limit} steps; the groups may be separated, or columns"
        " nearly the same",
        reason="logistic-convergence",
    )


def _scales(matrix: Float) -> Float:
    """Take standard deviations of columns, and the size of those that are constant."""
    spread = matrix.std(axis=0)
    size = np.maximum(np.abs(matrix).max(axis=0), 1e-300)
    return np.asarray(np.where(spread > 0, spread, size), dtype=np.float64)


def _fit_maximum(matrix: Float, case: Bool, settings: ClassificationSettings) -> LogisticFit | None:
    """Maximize the likelihood by statsmodels; None if that does not converge."""
    scale = _scales(matrix)
    model = Logit(case.astype(np.float64), matrix / scale, check_rank=False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of separation, which the caller looks for
        try:
            found = model.fit(
                method="newton",
                maxiter=settings.iterations,
                tol=_CONVERGED,
                disp=False,
                warn_convergence=False,
            )
        except np.linalg.LinAlgError:
            return None
    if not found.mle_retvals["converged"]:
        return None
    return LogisticFit(found.params / scale, found.bse / scale, float(found.llf), firth=False)


def _fit_firth(
    matrix: Float, case: Bool, settings: ClassificationSettings, free: Bool | None = None
) -> LogisticFit:
    """Penalize the likelihood by the root of the information's determinant (Firth 1993).

    This is Jeffreys' prior: estimates are finite under separation, and less biased.
    """
    scale = _scales(matrix)
    scaled = matrix / scale
    kept = np.ones(matrix.shape[1], dtype=bool) if free is None else free
    beta = np.zeros(matrix.shape[1])
    value = _penalized(scaled, case, beta)
    for number in range(settings.firth_iterations):
        bent = number >= _FISHER_STEPS
        step, promised = _firth_step(scaled, case, beta, kept, bent=bent)
        for halving in range(_HALVINGS):
            new = _penalized(scaled, case, beta + step)
            least = _SHARE * promised / 2**halving - _ROUNDING * (1 + abs(value))
            if new >= value + least:
                break
            step = step / 2
        beta, value = beta + step, new
        if promised < settings.tolerance:
            break
    else:
        raise _no_convergence(settings.firth_iterations)
    covariance = np.linalg.inv(_information(scaled, beta))
    return LogisticFit(
        coefficients=beta / scale,
        se=np.sqrt(np.diagonal(covariance)) / scale,
        # The penalty is that of the columns as given.
        log_likelihood=value + float(np.log(scale).sum()),
        firth=True,
    )


def _information(matrix: Float, beta: Float) -> Float:
    chance = special.expit(matrix @ beta)
    weighted: Float = matrix.T @ (matrix * (chance * (1 - chance))[:, None])
    return weighted


def _penalized(matrix: Float, case: Bool, beta: Float) -> float:
    """Penalized log likelihood."""
    margin = np.where(case, 1.0, -1.0) * (matrix @ beta)
    penalty = 0.5 * float(np.linalg.slogdet(_information(matrix, beta))[1])
    return float(special.log_expit(margin).sum()) + penalty


def _firth_step(
    matrix: Float, case: Bool, beta: Float, kept: Bool, *, bent: bool
) -> tuple[Float, float]:
    """Next step by the information, or by Newton's method, and the gain that the slope promises.

    The penalty bends as much as the likelihood where groups are far apart, so that steps by the
    information alone may take thousands. For Newton's, the slope is differentiated along directions
    in which the information is one.
    """
    size, axes = np.linalg.eigh(_information(matrix, beta)[np.ix_(kept, kept)])
    directions = np.zeros((len(beta), len(size)))
    directions[kept] = axes / np.sqrt(np.maximum(size, _FLATTEST * size[-1]))
    gradient = directions.T @ _firth_score(matrix, case, beta)
    if not bent:
        step = directions @ gradient
        share = min(1.0, _LONGEST_STEP / max(float(np.abs(step).max()), 1e-300))
        return step * share, float(gradient @ gradient) * share
    changes = [
        directions.T
        @ (
            _firth_score(matrix, case, beta + _DIFFERENCE * one)
            - _firth_score(matrix, case, beta - _DIFFERENCE * one)
        )
        for one in directions.T
    ]
    bend = -np.array(changes) / (2 * _DIFFERENCE)
    curvature, turned = np.linalg.eigh((bend + bend.T) / 2)
    along = (turned.T @ gradient) / np.maximum(np.abs(curvature), _LEAST_BEND)
    shortened = turned @ along
    step = directions @ shortened
    share = min(1.0, _LONGEST_STEP / max(float(np.abs(step).max()), 1e-300))
    return step * share, float(gradient @ shortened) * share


def _firth_score(matrix: Float, case: Bool, beta: Float) -> Float:
    """Slope of the penalized log likelihood."""
    chance = special.expit(matrix @ beta)
    information = _information(matrix, beta)
    leverage = np.sum(matrix @ np.linalg.pinv(information, hermitian=True) * matrix, axis=1)
    residual = case - chance + chance * (1 - chance) * leverage * (0.5 - chance)
    return np.asarray(matrix.T @ residual, dtype=np.float64)
