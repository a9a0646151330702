"""Random intercepts and slopes per participant at many points, by restricted likelihood.

The covariance of a participant's intercept and slope, over the residual variance, is L L' with a
lower triangle L of three numbers (as in R's ``lme4``). With A = Z'Z of a participant, the inverse
of V = I + Z L L' Z' takes W = L (I + L' A L)^-1 L' between the sums Z' x of its sessions off a sum
of squares.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np

from hipsta_bids.stats.arrays import Float, Int
from hipsta_bids.stats.glm import by_row, chunks, information, sum_by

#: Most steps of the fit with random slopes.
SLOPE_STEPS = 60
#: They end when minus twice the likelihood falls by less than this.
SLOPE_TOLERANCE = 1e-8

#: Step of numerical derivatives of the three numbers; times have a standard deviation of 1.
_STEP = 1e-4
#: That of second ones, and where these look: at the middle, and to both sides along the sum of
#: each pair of axes.
_WIDE_STEP = 7 * _STEP
_PAIRS = np.array([(0, 0), (1, 1), (2, 2), (1, 0), (2, 0), (2, 1)])
_SHIFTS = _WIDE_STEP * np.eye(3)[_PAIRS].sum(axis=1)
_CROSS = np.concatenate([np.zeros((1, 3)), _SHIFTS, -_SHIFTS])[:, None]
#: Values at a time, so that what is made of them stays in the processor's cache.
_BLOCK = 50_000
#: Damping of the first step, its factor, and when to give up.
_DAMPING, _FACTOR, _MOST_DAMPING = 1e-3, 6.0, 1e8
#: A slope of the loss below this is an optimum.
_FLAT = 1e-6
#: Directions in which the likelihood bends less than this share of the most say nothing.
_BENT = 1e-6


@dataclass(frozen=True)
class SlopeSums:
    """What the likelihood needs to know of the data.

    Where nothing is missing, all points share moments and columns, which then have one point.
    """

    n: Int
    """(points,)"""
    squares: Float
    """(points, columns, columns)"""
    products: Float
    """(points, columns)"""
    total: Float
    """(points,)"""
    moments: Float
    """(3, points or 1, participants) sessions, sums of times and of their squares."""
    person_columns: Float
    """(2, points or 1, participants, columns) sums of columns, plain and times time."""
    person_values: Float
    """(2, points, participants) the same of the values."""

    def take(self, points: Int) -> "SlopeSums":
        """Keep some points."""
        shared = self.moments.shape[1] == 1
        return SlopeSums(
            self.n[points],
            self.squares[points],
            self.products[points],
            self.total[points],
            self.moments if shared else self.moments[:, points],
            self.person_columns if shared else self.person_columns[:, points],
            self.person_values[:, points],
        )


def collect_slope_sums(maps: Float, basis: Float, participants: Int, times: Float) -> SlopeSums:
    """Sum over each participant's sessions."""
    present = np.isfinite(maps)
    weight = present.astype(np.float64)
    values = np.where(present, maps, 0.0)
    powers = np.stack([np.ones_like(times), times, times**2])

    def per_person(table: Float) -> Float:
        return np.moveaxis(sum_by(participants, table), 0, 1)

    is_shared = basis.ndim == 2 and present.all()  # noqa: PLR2004 -- one design for all points
    weight_shown = weight[:, :1] if is_shared else weight
    weighted = weight_shown[:, :, None] * by_row(basis)
    return SlopeSums(
        n=present.sum(axis=0),
        squares=information(present, basis),
        products=(np.swapaxes(basis, -1, -2) @ values.T[:, :, None])[:, :, 0],
        total=np.einsum("sp,sp->p", values, values),
        moments=np.stack([per_person(weight_shown * power[:, None]) for power in powers]),
        person_columns=np.stack(
            [per_person(weighted * power[:, None, None]) for power in powers[:2]]
        ),
        person_values=np.stack([per_person(values * power[:, None]) for power in powers[:2]]),
    )


def solve_slopes(sums: SlopeSums, triangles: Float) -> tuple[Float, Float, Float, Float]:
    """Fit by generalized least squares with one triangle (intercept, covariance, slope) per point.

    Returns coefficients (points, columns), their covariance over the residual variance, the sum of
    squared residuals (points,), and log |V| + log |X' V^-1 X| (points,).
    """
    information, right, squares, log_spread = _equations(sums, triangles)
    inverse = np.asarray(np.linalg.inv(information), dtype=np.float64)
    scores = np.einsum("pij,pj->pi", inverse, right)
    residual = squares - np.einsum("pi,pi->p", scores, right)
    return scores, inverse, residual, log_spread + np.linalg.slogdet(information)[1]


def _equations(sums: SlopeSums, triangles: Float) -> tuple[Float, Float, Float, Float]:
    """Return the normal equations, X' V^-1 X, X' V^-1 y and y' V^-1 y, and log |V|."""
    a, b, c = triangles.T[:, :, None]
    n, s, q = sums.moments
    first = 1 + a**2 * n + 2 * a * b * s + b**2 * q
    cross = c * (a * s + b * q)
    second = 1 + c**2 * q
    determinant = first * second - cross**2
    plain = a**2 * second / determinant
    mixed = a * (b * second - c * cross) / determinant
    timed = (b**2 * second - 2 * b * c * cross + c**2 * first) / determinant
    (x, z), (y, t) = sums.person_columns, sums.person_values
    weighted = plain * y + mixed * t, mixed * y + timed * t
    information = sums.squares - _products(x, z, plain, mixed, timed)
    right = sums.products - _sums(x, weighted[0]) - _sums(z, weighted[1])
    squares = sums.total - np.sum(weighted[0] * y + weighted[1] * t, axis=1)
    return information, right, squares, np.log(determinant).sum(axis=1)


def _products(x: Float, z: Float, plain: Float, mixed: Float, timed: Float) -> Float:
    """Sum products of columns over participants, weighted (points, columns, columns)."""
    if len(x) != 1:
        left = np.swapaxes(x, 1, 2) @ (plain[:, :, None] * x + mixed[:, :, None] * z)
        return left + np.swapaxes(z, 1, 2) @ (mixed[:, :, None] * x + timed[:, :, None] * z)
    columns = x.shape[2]
    squares = [(u[0][:, :, None] * v[0][:, None, :]) for u, v in ((x, x), (x, z), (z, z))]
    squares[1] = squares[1] + np.swapaxes(squares[1], 1, 2)
    total = sum(
        weight @ square.reshape(len(square), -1)
        for weight, square in zip((plain, mixed, timed), squares, strict=True)
    )
    return np.asarray(total, dtype=np.float64).reshape(-1, columns, columns)


def _sums(x: Float, values: Float) -> Float:
    """Sum columns times values over participants (points, columns)."""
    if len(x) != 1:
        return np.asarray((values[:, None, :] @ x)[:, 0])
    return np.asarray(values @ x[0])


def best_triangles(sums: SlopeSums) -> Float:
    """Triangles (points, 3) that maximize the restricted likelihood.

    The best of a few starts, then damped Newton steps with numerical derivatives.
    """
    starts = [np.array(start) for start in product((0.2, 1.0, 3.0), (0.0,), (0.05, 0.3, 1.0))]
    tiled = np.broadcast_to(np.array(starts)[:, None], (len(starts), len(sums.n), 3))
    best: Float = np.array(starts)[np.argmin(_losses(sums, tiled), axis=0)]
    active = np.arange(len(sums.n))
    damping = np.full(len(best), _DAMPING)
    for _ in range(SLOPE_STEPS):
        part = sums.take(active)
        value, gradient, hessian = _derivatives(part, best[active])
        size, axes = np.linalg.eigh(hessian)
        bent = np.abs(size) + damping[active, None] * np.abs(size).max(axis=1, keepdims=True)
        along = np.einsum("pij,pi->pj", axes, gradient) / np.maximum(bent, 1e-12)
        step = -np.einsum("pij,pj->pi", axes, along)
        trial = best[active] + step
        gain = value - _loss(part, trial)
        better = gain > 0
        best[active[better]] = trial[better]
        damping[active] *= np.where(better, 1 / _FACTOR, _FACTOR)
        is_settled = np.abs(gradient).max(axis=1) < _FLAT
        is_settled |= better & (gain < SLOPE_TOLERANCE)
        active = active[~is_settled & (damping[active] < _MOST_DAMPING)]
        if not len(active):
            break
    return best


def slope_freedom(sums: SlopeSums, triangles: Float, rows: Float) -> Float:
    """Satterthwaite's degrees of freedom of rows of weights, (rows, points, columns).

    From the Hessian of minus twice the restricted likelihood for the logarithm of the residual
    variance and the triangle; directions without curvature, as at a bound, are excluded, as in
    R's ``lmerTest``.
    """
    freedom = sums.n - sums.squares.shape[1]
    _, inverse_here, residual_here, _ = solve_slopes(sums, triangles)
    variance = residual_here / freedom
    shifts = _STEP * np.eye(3)
    hessian = np.empty((len(triangles), 4, 4))
    hessian[:, 0, 0] = freedom
    slopes = []
    for i in range(3):
        _, up, residual_up, _ = solve_slopes(sums, triangles + shifts[i])
        _, down, residual_down, _ = solve_slopes(sums, triangles - shifts[i])
        hessian[:, 0, i + 1] = -(residual_up - residual_down) / (2 * _STEP) / variance
        hessian[:, i + 1, 0] = hessian[:, 0, i + 1]
        slopes.append((forms(up, rows) - forms(down, rows)) / (2 * _STEP))

    solved = (solve_slopes(sums, at) for at in triangles + _CROSS)
    values = np.array([penalty + residual / variance for *_, residual, penalty in solved])
    hessian[:, 1:, 1:] = _bend(values)
    form = forms(inverse_here, rows)
    gradient = np.stack([np.ones_like(form), *(slope / form for slope in slopes)], axis=-1)
    size, axes = np.linalg.eigh(hessian)
    valid = size > _BENT * size[:, -1:]
    inverse = np.where(valid, 1 / np.where(valid, size, 1.0), 0.0)
    turned = np.einsum("cpi,pij->cpj", gradient, axes)
    return np.asarray(1 / np.einsum("cpj,pj->cp", turned**2, inverse), dtype=np.float64)


def forms(inverse: Float, rows: Float) -> Float:
    """Variances of rows of weights (rows, points, columns) over the residual variance."""
    return np.asarray(np.einsum("cpi,pij,cpj->cp", rows, inverse, rows))


def _loss(sums: SlopeSums, triangles: Float) -> Float:
    """Minus twice the restricted likelihood, but for a constant."""
    information, right, squares, log_spread = _equations(sums, triangles)
    scores = np.linalg.solve(information, right[:, :, None])[:, :, 0]
    residual = squares - np.einsum("pi,pi->p", scores, right)
    penalty = log_spread + np.linalg.slogdet(information)[1]
    return np.asarray((sums.n - sums.squares.shape[1]) * np.log(residual) + penalty)


def _losses(sums: SlopeSums, triangles: Float) -> Float:
    """Losses (tries, points) of several triangles of each point."""
    tries, points = triangles.shape[:2]
    numbers, flat = np.tile(np.arange(points), tries), triangles.reshape(-1, 3)
    parts = chunks((sums.person_values.shape[2], len(flat)), 1, _BLOCK)
    losses = [_loss(sums.take(numbers[part]), flat[part]) for part in parts]
    return np.concatenate(losses).reshape(tries, points)


def _derivatives(sums: SlopeSums, at: Float) -> tuple[Float, Float, Float]:
    """Loss, gradient and Hessian by central differences."""
    shifts = _STEP * np.eye(3)[:, None]
    losses = _losses(sums, np.concatenate([at + shifts, at - shifts, at + _CROSS]))
    gradient = (losses[:3] - losses[3:6]).T / (2 * _STEP)
    return losses[6], gradient, _bend(losses[6:])


def _bend(values: Float) -> Float:
    """Second derivatives (points, 3, 3) from values (13, points) around, by central differences.

    With H that of second derivatives and e of axes, the bend along a pair is (e + f)' H (e + f).
    """
    bends = (values[1:7] + values[7:] - 2 * values[0]) / _WIDE_STEP**2
    result = np.empty((values.shape[1], 3, 3))
    for (i, j), bend in zip(_PAIRS, bends, strict=True):
        result[:, i, j] = result[:, j, i] = bend / 2 - (bends[i] + bends[j]) / 8
    return result
