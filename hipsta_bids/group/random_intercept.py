"""Restricted likelihood of a random-intercept model at many points, from sums.

With V = I + r Z Z' for a ratio r of variances, and n sessions of a participant, the inverse of
V takes c(r) = r / (1 + n r) times the squared sum over these sessions off a sum of squares. So
everything that depends on the data is summed once for each n, and any r is cheap.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.group_settings import LongitudinalSettings

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class State:
    """Generalized least squares at one ratio per point, with derivatives for the ratio."""

    information: FloatArray
    """(points, columns, columns) X' V^-1 X."""
    first: FloatArray
    second: FloatArray
    scores: FloatArray
    """(points, columns) coefficients."""
    residual: FloatArray
    """(points,) generalized sum of squared residuals Q, its first and second derivative."""
    residual_first: FloatArray
    residual_second: FloatArray
    penalty_first: FloatArray
    """(points,) derivatives of log |V| + log |X' V^-1 X|."""
    penalty_second: FloatArray
    penalty: FloatArray


@dataclass(frozen=True)
class Sums:
    """What a likelihood needs to know of the data."""

    n: IntArray
    """(points,) sessions."""
    repeated: BoolArray
    """(points,) whether anybody has two."""
    squares: FloatArray
    """(points, columns, columns)"""
    products: FloatArray
    """(points, columns)"""
    total: FloatArray
    """(points,) sum of squares."""
    sizes: FloatArray
    """(sizes,) numbers of sessions that occur."""
    people: FloatArray
    """(sizes, points) participants with so many."""
    own_squares: FloatArray
    """(sizes, points, columns, columns) squared sums over a participant's sessions."""
    own_products: FloatArray
    """(sizes, points, columns)"""
    own_total: FloatArray
    """(sizes, points)"""

    def where(self, usable: BoolArray) -> "Sums":
        """Replace points that cannot be fitted by harmless ones."""
        columns = self.squares.shape[1]
        return replace(
            self,
            n=np.where(usable, self.n, columns + 2),
            squares=np.where(usable[:, None, None], self.squares, np.eye(columns)),
            total=np.where(usable, self.total, 1.0),
            products=np.where(usable[:, None], self.products, 0.0),
            own_squares=np.where(usable[:, None, None], self.own_squares, 0.0),
            own_products=np.where(usable[:, None], self.own_products, 0.0),
            own_total=np.where(usable, self.own_total, 0.0),
        )

    def at(self, ratio: FloatArray) -> State:
        """Fit with one ratio per point."""
        spread = 1 + self.sizes[:, None] * ratio
        take = (ratio / spread, 1 / spread**2, -2 * self.sizes[:, None] / spread**3)
        squares = [np.einsum("kp,kpij->pij", c, self.own_squares) for c in take]
        products = [np.einsum("kp,kpi->pi", c, self.own_products) for c in take]
        totals = [np.einsum("kp,kp->p", c, self.own_total) for c in take]
        information = self.squares - squares[0]
        right = self.products - products[0]
        inverse = np.linalg.inv(information)
        scores = np.einsum("pij,pj->pi", inverse, right)
        first, second = -squares[1], -squares[2]
        moved = np.einsum("pij,pj->pi", first, scores)
        change = np.einsum("pij,pj->pi", inverse, -products[1] - moved)
        residual = self.total - totals[0] - np.einsum("pi,pi->p", scores, right)
        residual_first = -totals[1] + np.einsum("pi,pi->p", scores, 2 * products[1] + moved)
        bent = np.einsum("pij,pj->pi", second, scores)
        residual_second = -totals[2] + np.einsum("pi,pi->p", scores, 2 * products[2] + bent)
        residual_second -= 2 * np.einsum("pi,pij,pj->p", change, information, change)
        turned = inverse @ first
        share = self.sizes[:, None] / spread
        return State(
            information=information,
            first=first,
            second=second,
            scores=scores,
            residual=residual,
            residual_first=residual_first,
            residual_second=residual_second,
            penalty=np.sum(self.people * np.log(spread), axis=0)
            + np.linalg.slogdet(information)[1],
            penalty_first=np.sum(self.people * share, axis=0) + np.trace(turned, axis1=1, axis2=2),
            penalty_second=-np.sum(self.people * share**2, axis=0)
            + np.trace(inverse @ second - turned @ turned, axis1=1, axis2=2),
        )


def collect_sums(maps: FloatArray, basis: FloatArray, participants: IntArray) -> Sums:
    """Sum over sessions and participants.

    Parameters
    ----------
    maps : ndarray, shape (sessions, points)
        NaN is missing.
    basis : ndarray, shape (sessions, columns)
        Design, orthonormal.
    participants : ndarray of int, shape (sessions,)
        Numbers from 0.
    """
    present = np.isfinite(maps)
    weight = present.astype(np.float64)
    values = np.where(present, maps, 0.0)
    order = np.argsort(participants, kind="stable")
    starts = np.searchsorted(participants[order], np.arange(participants.max() + 1))
    counts = np.add.reduceat(weight[order], starts, axis=0)
    sums_x = np.add.reduceat(weight[order][:, :, None] * basis[order][:, None, :], starts, axis=0)
    sums_y = np.add.reduceat(values[order], starts, axis=0)
    products = (basis[:, :, None] * basis[:, None, :]).reshape(len(basis), -1)
    columns = basis.shape[1]
    sizes = np.unique(counts[counts > 0])
    chosen = [np.where(counts == size, 1.0, 0.0) for size in sizes]
    return Sums(
        n=present.sum(axis=0),
        repeated=np.asarray((counts > 1).any(axis=0)),
        squares=(weight.T @ products).reshape(-1, columns, columns),
        products=values.T @ basis,
        total=np.einsum("sp,sp->p", values, values),
        sizes=sizes,
        people=np.array([who.sum(axis=0) for who in chosen]),
        own_squares=np.array(
            [np.einsum("gp,gpi,gpj->pij", who, sums_x, sums_x, optimize=True) for who in chosen]
        ),
        own_products=np.array(
            [np.einsum("gp,gp,gpi->pi", who, sums_y, sums_x, optimize=True) for who in chosen]
        ),
        own_total=np.array([np.einsum("gp,gp->p", who, sums_y**2) for who in chosen]),
    )


def best_ratio(sums: Sums, settings: LongitudinalSettings) -> FloatArray:
    """Ratio of variances that maximizes the restricted likelihood at each point.

    The best of a grid of correlations r / (1 + r), then halving of the interval around it by
    the sign of the derivative. Zero if the likelihood falls from there.
    """
    freedom = sums.n - sums.squares.shape[1]
    grid = np.linspace(0.0, settings.max_correlation, settings.grid)
    ratios = grid / (1 - grid)
    losses = []
    for ratio in ratios:
        state = sums.at(np.full(len(sums.n), ratio))
        losses.append(freedom * np.log(state.residual) + state.penalty)
    best = np.argmin(losses, axis=0)
    low, high = grid[np.maximum(best - 1, 0)], grid[np.minimum(best + 1, len(grid) - 1)]
    for _ in range(settings.halvings):
        middle = (low + high) / 2
        state = sums.at(middle / (1 - middle))
        rising = freedom * state.residual_first / state.residual + state.penalty_first > 0
        low, high = np.where(rising, low, middle), np.where(rising, middle, high)
    at_zero = sums.at(np.zeros(len(sums.n)))
    rises = freedom * at_zero.residual_first / at_zero.residual + at_zero.penalty_first >= 0
    return np.where((best == 0) & rises, 0.0, low / (1 - low))


def curvature(sums: Sums, state: State) -> tuple[FloatArray, FloatArray]:
    """Hessian of minus twice the restricted likelihood at the optimum.

    Returns
    -------
    mixed, second : ndarray, shape (points,)
        For log residual variance and ratio, and twice for the ratio. Twice for the log variance
        it is the residual degrees of freedom.
    """
    variance = state.residual / (sums.n - sums.squares.shape[1])
    return (
        -state.residual_first / variance,
        state.penalty_second + state.residual_second / variance,
    )
