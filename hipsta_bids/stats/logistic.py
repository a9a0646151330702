"""Logistic models: by maximum likelihood, or by Firth's method where they separate the groups."""

from dataclasses import dataclass

import numpy as np
from scipy import optimize, special

from hipsta_bids.errors import ModelError
from hipsta_bids.stats.arrays import Bool, Float
from hipsta_bids.stats.glm import products_of

#: Most steps of a fit by Firth's method, which takes hundreds where groups are far apart.
FIRTH_STEPS = 2000
#: Steps end when they promise to raise the log likelihood by less than this.
FIT_TOLERANCE = 1e-16

#: Largest sum of margins, per subject, that still counts as rounding of the linear program.
_NO_MARGIN = 1e-7
#: Most steps of Newton's method, which takes some eight, and the length of the last; columns have
#: a mean square of one.
_NEWTON_STEPS, _SETTLED = 25, 1e-8
#: Members of sets that are worked on together, which the processor's cache holds.
_BLOCK = 100_000
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
    log_likelihood: float
    """With Firth the penalized one: half the log determinant of the information comes on top."""
    firth: bool
    """Whether Firth's penalty was used."""


def is_separated(matrix: Float, case: Bool) -> bool:
    """Whether a combination of the columns separates the groups without overlap.

    Then maximum-likelihood estimates are infinite (Albert and Anderson 1984). Detected exactly, by
    a linear program (Konis 2007): the largest sum of margins under which none is negative.
    """
    scale = np.abs(matrix).max(axis=0)
    margins = np.where(case, 1.0, -1.0)[:, None] * matrix / np.where(scale > 0, scale, 1.0)
    solution = optimize.linprog(
        -margins.sum(axis=0), A_ub=-margins, b_ub=np.zeros(len(margins)), bounds=(-1, 1)
    )
    return bool(margins.sum(axis=0) @ solution.x > _NO_MARGIN * len(margins))


def fit_logistic(
    matrix: Float, case: Bool, *, firth: bool, free: Bool | None = None
) -> LogisticFit:
    """Fit a logistic regression by maximum likelihood, or by Firth's method.

    Of Firth's, columns that are not ``free`` stay zero but count in the penalty, as the penalized
    likelihood-ratio test needs it (Heinze and Schemper 2002).
    """
    members = np.ones((1, len(case)))
    if firth:
        scale = _scales(matrix)
        beta, value = firth_maxima(matrix / scale, case, members, free)
        # The penalty is that of the columns as given.
        return LogisticFit(beta[0] / scale, float(value[0] + np.log(scale).sum()), firth=True)
    basis = orthonormal(matrix)
    beta, settled = maxima(basis, case, members)
    if not settled[0]:
        raise _no_convergence(_NEWTON_STEPS)
    score = basis @ beta[0]
    value = special.log_expit(np.where(case, score, -score)).sum()
    return LogisticFit(np.linalg.lstsq(matrix, score)[0], float(value), firth=False)


def fit_overlapping_or_firth(matrix: Float, case: Bool) -> LogisticFit:
    """Fit by maximum likelihood if the groups overlap, else by Firth's method."""
    separated = not overlaps(matrix, case) and is_separated(matrix, case)
    return fit_logistic(matrix, case, firth=separated)


def overlaps(matrix: Float, case: Bool) -> bool:
    """Whether maximum likelihood converges, which it does not if the groups are separated.

    Where it does not, :func:`is_separated` decides.
    """
    return bool(maxima(orthonormal(matrix), case, np.ones((1, len(case))))[1][0])


def orthonormal(matrix: Float) -> Float:
    """Give an orthonormal basis of the columns, times the root of the number of rows."""
    basis, size, _ = np.linalg.svd(matrix / _scales(matrix), full_matrices=False)
    return np.asarray(basis[:, size > RANK * size[0]] * np.sqrt(len(matrix)), dtype=np.float64)


def maxima(
    basis: Float, case: Bool, weights: Float, start: Float | None = None
) -> tuple[Float, Bool]:
    """Maximize the likelihood in several sets of subjects at once, by Newton's method.

    ``weights`` is (sets, subjects), 1 for members. Gives coefficients (sets, columns), and in which
    sets the steps converged: with separated groups each step is about as long as the one before.
    """
    columns = basis.shape[1]
    products = products_of(basis)
    beta = np.tile(np.zeros(columns) if start is None else start, (len(weights), 1))
    settled = np.zeros(len(weights), dtype=bool)
    is_lost = np.zeros(len(weights), dtype=bool)
    starts = range(0, len(case), max(_BLOCK // len(weights), 1))
    blocks = [slice(first, first + starts.step) for first in starts]
    for number in range(_NEWTON_STEPS):
        information, score = np.zeros((len(weights), columns**2)), np.zeros(beta.shape)
        for block in blocks:
            # All sets begin at the same place.
            with np.errstate(over="ignore"):
                chance = 1 / (1 + np.exp((beta if number else beta[:1]) @ -basis[block].T))
            score += (weights[:, block] * (case[block] - chance)) @ basis[block]
            information += (weights[:, block] * (chance * (1 - chance))) @ products[block]
        information = information.reshape(-1, columns, columns)
        size = np.linalg.eigvalsh(information)
        is_lost |= ~(size[:, 0] > RANK * size[:, -1])
        information[is_lost] = np.eye(columns)
        step = np.linalg.solve(information, score[:, :, None])[:, :, 0]
        beta[~is_lost] += step[~is_lost]
        settled = ~is_lost & (np.abs(step).max(axis=1) < _SETTLED)
        if (settled | is_lost).all():
            break
    return beta, settled


def _no_convergence(limit: int) -> ModelError:
    return ModelError(
        f"logistic model: no convergence in {limit} steps; the groups may be separated, or columns"
        " nearly the same"
    )


def _scales(matrix: Float) -> Float:
    """Take standard deviations of columns, and the size of those that are constant."""
    spread = matrix.std(axis=0)
    size = np.maximum(np.abs(matrix).max(axis=0), 1e-300)
    return np.asarray(np.where(spread > 0, spread, size), dtype=np.float64)


def firth_maxima(
    matrix: Float, case: Bool, weights: Float, free: Bool | None = None
) -> tuple[Float, Float]:
    """Penalize the likelihood by the root of the information's determinant (Firth 1993).

    This is Jeffreys' prior: estimates are finite under separation, and less biased. ``weights`` is
    (sets, subjects), 1 for members. Gives coefficients (sets, columns), and the penalized log
    likelihood of each set.
    """
    free = np.ones(matrix.shape[1], dtype=bool) if free is None else free
    likelihood = _Penalized(matrix, case)
    beta = np.zeros((len(weights), matrix.shape[1]))
    value = likelihood.value(weights, beta)
    active = np.arange(len(weights))
    for number in range(FIRTH_STEPS):
        members, bent = weights[active], number >= _FISHER_STEPS
        step, promised = likelihood.step(members, beta[active], free, bent=bent)
        for halving in range(_HALVINGS):
            new = likelihood.value(members, beta[active] + step)
            least = _SHARE * promised / 2**halving - _ROUNDING * (1 + np.abs(value[active]))
            short = new < value[active] + least
            if not short.any():
                break
            step[short] /= 2
        beta[active] += step
        value[active] = new
        active = active[promised >= FIT_TOLERANCE]
        if not len(active):
            return beta, value
    raise _no_convergence(FIRTH_STEPS)


class _Penalized:
    """The penalized log likelihood of sets of subjects (sets, subjects), 1 for members.

    Coefficients are (sets, columns).
    """

    def __init__(self, matrix: Float, case: Bool) -> None:
        self._matrix, self._case, self._products = matrix, case, products_of(matrix)

    def information(self, weights: Float, beta: Float) -> Float:
        chance = special.expit(beta @ self._matrix.T)
        information = (weights * chance * (1 - chance)) @ self._products
        return np.asarray(information.reshape(*beta.shape, -1), dtype=np.float64)

    def value(self, weights: Float, beta: Float) -> Float:
        margins = np.where(self._case, 1.0, -1.0) * (beta @ self._matrix.T)
        penalty = 0.5 * np.linalg.slogdet(self.information(weights, beta))[1]
        return np.asarray((weights * special.log_expit(margins)).sum(axis=1) + penalty)

    def slope(self, weights: Float, beta: Float) -> Float:
        chance = special.expit(beta @ self._matrix.T)
        inverse = np.linalg.pinv(self.information(weights, beta), hermitian=True)
        leverage = inverse.reshape(len(beta), -1) @ self._products.T
        residual = self._case - chance + chance * (1 - chance) * leverage * (0.5 - chance)
        return np.asarray((weights * residual) @ self._matrix, dtype=np.float64)

    def step(self, weights: Float, beta: Float, free: Bool, *, bent: bool) -> tuple[Float, Float]:
        """Next step by the information, or by Newton's method, and the gain the slope promises.

        The penalty bends as much as the likelihood where groups are far apart, so that steps by the
        information alone may take thousands. For Newton's, the slope is differentiated along
        directions in which the information is one.
        """
        size, axes = np.linalg.eigh(self.information(weights, beta)[:, free][:, :, free])
        directions = np.zeros((*beta.shape, size.shape[1]))
        directions[:, free] = axes / np.sqrt(np.maximum(size, _FLATTEST * size[:, -1:]))[:, None]
        gradient = np.einsum("sck,sc->sk", directions, self.slope(weights, beta))
        along = gradient
        if bent:
            moved = [_DIFFERENCE * direction for direction in np.moveaxis(directions, 2, 0)]
            changes = [self.slope(weights, beta + d) - self.slope(weights, beta - d) for d in moved]
            bend = np.einsum("sck,lsc->slk", directions, changes) / (-2 * _DIFFERENCE)
            curvature, turned = np.linalg.eigh((bend + np.swapaxes(bend, 1, 2)) / 2)
            along = np.einsum("slk,sl->sk", turned, gradient)
            along = along / np.maximum(np.abs(curvature), _LEAST_BEND)
            along = np.einsum("slk,sk->sl", turned, along)
        step = np.einsum("sck,sk->sc", directions, along)
        longest = np.maximum(np.abs(step).max(axis=1), 1e-300)
        share = np.minimum(1.0, _LONGEST_STEP / longest)
        return step * share[:, None], np.sum(gradient * along, axis=1) * share
