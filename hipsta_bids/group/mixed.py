"""Repeated sessions: mixed models at each point."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from hipsta_bids.errors import ModelError
from hipsta_bids.group.data import PARTICIPANT, Bool, Float, Int
from hipsta_bids.group.formula import Contrast
from hipsta_bids.group.glm import PointwiseFit, RowModel, chunks, t_test
from hipsta_bids.group.model import Design
from hipsta_bids.group.random_slope import (
    best_triangles,
    collect_slope_sums,
    slope_freedom,
    solve_slopes,
)
from hipsta_bids.group.settings import GroupSettings, LongitudinalSettings

#: Sessions of one participant that tell a slope from noise.
_SLOPE_SESSIONS = 3


@dataclass(frozen=True)
class State:
    """Generalized least squares at one ratio per point, with derivatives for the ratio."""

    information: Float
    """(points, columns, columns) X' V^-1 X."""
    first: Float
    second: Float
    scores: Float
    """(points, columns) coefficients."""
    residual: Float
    """(points,) generalized sum of squared residuals Q, its first and second derivative."""
    residual_first: Float
    residual_second: Float
    penalty_first: Float
    """(points,) derivatives of log |V| + log |X' V^-1 X|."""
    penalty_second: Float
    penalty: Float


@dataclass(frozen=True)
class Sums:
    """What a likelihood needs to know of the data."""

    n: Int
    """(points,) sessions."""
    repeated: Bool
    """(points,) whether anybody has two."""
    squares: Float
    """(points, columns, columns)"""
    products: Float
    """(points, columns)"""
    total: Float
    """(points,) sum of squares."""
    sizes: Float
    """(sizes,) numbers of sessions that occur."""
    people: Float
    """(sizes, points) participants with so many."""
    own_squares: Float
    """(sizes, points, columns, columns) squared sums over a participant's sessions."""
    own_products: Float
    """(sizes, points, columns)"""
    own_total: Float
    """(sizes, points)"""

    def where(self, usable: Bool) -> "Sums":
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

    def at(self, ratio: Float) -> State:
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


def collect_sums(maps: Float, basis: Float, participants: Int) -> Sums:
    """Sum over sessions and participants.

    ``maps`` NaN is missing.
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


def best_ratio(sums: Sums, settings: LongitudinalSettings) -> Float:
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


def curvature(sums: Sums, state: State) -> tuple[Float, Float]:
    """Hessian of minus twice the restricted likelihood at the optimum.

    Returns Twice for the log variance it is the residual degrees of freedom.
    """
    variance = state.residual / (sums.n - sums.squares.shape[1])
    return (
        -state.residual_first / variance,
        state.penalty_second + state.residual_second / variance,
    )


def fit_mixed(
    maps: Float,
    matrix: Float,
    participants: Sequence[str] | NDArray[np.str_],
    contrasts: Sequence[Contrast],
    settings: LongitudinalSettings,
    *,
    times: Float | None = None,
) -> PointwiseFit:
    """Fit ``value = matrix @ coefficients + participant + residual`` at each point.

    With times, participants also have a slope of their own, correlated with the intercept.

    By restricted maximum likelihood, which for one random intercept depends on one number: the
    ratio of the two variances. It is found for all points at once. Degrees of freedom are
    Satterthwaite's, from the curvature of the likelihood at the optimum, as in R's ``lmerTest``
    (Kuznetsova et al. 2017); where no variance between participants is found they are those of
    the linear model.

    ``maps`` NaN is missing.
    """
    numbers = _check(maps, matrix, participants, contrasts)
    if times is not None and np.bincount(numbers).max() < _SLOPE_SESSIONS:
        raise ModelError(
            "longitudinal model: nobody has three sessions, so that slopes cannot be told from"
            " noise; use random intercepts",
            reason="few-sessions",
        )
    basis, triangle = np.linalg.qr(matrix)
    back = np.linalg.inv(triangle)
    rotated = np.array([contrast.weights[0] @ back for contrast in contrasts])
    parts = []
    for points in chunks(maps.shape, matrix.shape[1]):
        values = np.asarray(maps[:, points], dtype=np.float64)
        if times is None:
            parts.append(_fit(values, basis, numbers, rotated, settings))
        else:
            parts.append(_fit_slopes(values, basis, numbers, rotated, settings, times=times))
    whole = {name: np.concatenate([part[name] for part in parts], axis=-1) for name in parts[0]}
    # The standard deviation of single visits: effect sizes are those of independent rows.
    sigma = np.sqrt(whole["residual"] + whole["participant"])
    return PointwiseFit(
        coefficients=back @ whole["scores"],
        sigma=sigma,
        n=whole["n"].astype(np.int64),
        tests=tuple(
            t_test(contrast, estimate, se, df=df, sigma=sigma, confidence=settings.confidence)
            for contrast, estimate, se, df in zip(
                contrasts, whole["estimate"], whole["se"], whole["df"], strict=True
            )
        ),
        variances={name: whole[name] for name in ("residual", "participant", "slope")},
    )


def _check(
    maps: Float,
    matrix: Float,
    participants: Sequence[str] | NDArray[np.str_],
    contrasts: Sequence[Contrast],
) -> Int:
    """Refuse what cannot be fitted; participants as numbers otherwise."""
    if not len(maps) == len(matrix) == len(participants):
        raise ModelError(
            f"longitudinal model: {len(maps)} maps, {len(matrix)} rows of the design and"
            f" {len(participants)} participants; all need one per session",
            reason="design-shape",
        )
    if np.linalg.matrix_rank(matrix) < matrix.shape[1]:
        raise ModelError(
            f"longitudinal model: the design's {matrix.shape[1]} columns are not independent;"
            " leave one out",
            reason="design-rank",
        )
    if several := [contrast.name for contrast in contrasts if contrast.n_rows > 1]:
        raise ModelError(
            f"longitudinal model: contrast {several[0]!r} has several rows; test each by itself",
            reason="contrast-shape",
        )
    _, numbers, counts = np.unique(
        np.asarray(participants), return_inverse=True, return_counts=True
    )
    if counts.max() == 1:
        raise ModelError(
            "longitudinal model: nobody has two sessions; use a linear model",
            reason="one-session",
        )
    return np.asarray(numbers, dtype=np.int64)


def _fit(
    maps: Float,
    basis: Float,
    participants: Int,
    rotated: Float,
    settings: LongitudinalSettings,
) -> dict[str, Float]:
    """Fit intercepts at some points; points last."""
    sums = collect_sums(maps, basis, participants)
    usable = np.linalg.eigvalsh(sums.squares)[:, 0] > settings.min_information
    usable &= (sums.n > basis.shape[1] + 1) & sums.repeated
    sums = sums.where(usable)
    ratio = best_ratio(sums, settings)
    state = sums.at(ratio)
    freedom = sums.n - basis.shape[1]
    variance = state.residual / freedom
    inverse = np.linalg.inv(state.information)
    estimate = np.einsum("cj,pj->cp", rotated, state.scores)
    form = np.einsum("ci,pij,cj->cp", rotated, inverse, rotated)
    slope = -np.einsum("ci,pij,pjk,pkl,cl->cp", rotated, inverse, state.first, inverse, rotated)
    df = _satterthwaite(form, slope, freedom, ratio, curvature(sums, state))
    blank = np.where(usable, 1.0, np.nan)
    return {
        "scores": state.scores.T * blank,
        "residual": variance * blank,
        "participant": variance * ratio * blank,
        "slope": np.full(len(blank), np.nan),
        "n": sums.n.astype(np.float64),
        "estimate": estimate * blank,
        "se": np.sqrt(form * variance) * blank,
        "df": df * blank,
    }


def _fit_slopes(
    maps: Float,
    basis: Float,
    participants: Int,
    rotated: Float,
    settings: LongitudinalSettings,
    *,
    times: Float,
) -> dict[str, Float]:
    """Fit intercepts and slopes at some points; points last."""
    unit = float(times.std())
    standard = (times - times.mean()) / unit
    sums = collect_slope_sums(maps, basis, participants, standard)
    usable = np.linalg.eigvalsh(sums.squares)[:, 0] > settings.min_information
    usable &= sums.moments[0].max(axis=1) >= _SLOPE_SESSIONS
    usable &= sums.n > basis.shape[1] + _SLOPE_SESSIONS
    kept = sums.take(np.flatnonzero(usable))
    triangles = best_triangles(kept, settings)
    state = solve_slopes(kept, triangles)
    variance = state.residual / (kept.n - basis.shape[1])
    form = np.einsum("ci,pij,cj->cp", rotated, state.inverse, rotated)

    def spread(values: Float) -> Float:
        full = np.full((*values.shape[:-1], len(usable)), np.nan)
        full[..., usable] = values
        return full

    return {
        "scores": spread(state.scores.T),
        "residual": spread(variance),
        "participant": spread(variance * triangles[:, 0] ** 2),
        "slope": spread(variance * np.sum(triangles[:, 1:] ** 2, axis=1) / unit**2),
        "n": sums.n.astype(np.float64),
        "estimate": spread(np.einsum("cj,pj->cp", rotated, state.scores)),
        "se": spread(np.sqrt(form * variance)),
        "df": spread(slope_freedom(kept, triangles, rotated)),
    }


def _satterthwaite(
    form: Float,
    slope: Float,
    freedom: Float,
    ratio: Float,
    hessian: tuple[Float, Float],
) -> Float:
    """Degrees of freedom of contrasts: 2 f^2 / Var(f), f the estimated variance of one.

    With s the logarithm of the residual variance and r the ratio, f = exp(s) form(r), so its
    gradient is f (1, slope / form); the covariance of (s, r) is twice the inverse of the Hessian
    of minus twice the restricted likelihood.
    """
    mixed, second = hessian
    inner = ratio > 0
    determinant = freedom * second - mixed**2
    safe = inner & (determinant > 0)
    scale = np.where(safe, determinant, 1.0)
    relative = slope / form
    spread = second - 2 * mixed * relative + freedom * relative**2
    found = np.where(safe, scale / np.where(safe, spread, 1.0), freedom)
    return np.broadcast_to(found, form.shape)


@dataclass(frozen=True, eq=False)
class RepeatedRows(RowModel):
    """A mixed model of a design in which participants have several rows."""

    participants: NDArray[np.str_]
    """(rows,)"""
    times: Float | None
    """(rows,) of each visit, for random slopes; else random intercepts."""
    independent: ClassVar[bool] = False

    def fit(
        self, values: Float, rows: Int, contrasts: tuple[Contrast, ...], settings: GroupSettings
    ) -> PointwiseFit:
        """Fit some rows of the design at each point."""
        return fit_mixed(
            values,
            self.design.matrix[rows],
            self.participants[rows],
            contrasts,
            settings.longitudinal,
            times=None if self.times is None else self.times[rows],
        )

    def fit_measures(
        self, values: Float, rows: Int, contrasts: tuple[Contrast, ...], settings: GroupSettings
    ) -> PointwiseFit:
        """Fit some rows of the design to each summary measure, as if it were a point."""
        return self.fit(values, rows, contrasts, settings)


def longitudinal_model(
    design: Design, table: pd.DataFrame, time: str | None, settings: GroupSettings
) -> RepeatedRows:
    """Assign visits to participants, with their times if slopes are random."""
    if settings.glm.covariance != "ordinary":
        raise ModelError(
            "longitudinal model: it assumes equal variances; set glm.covariance to ordinary",
            reason="longitudinal-covariance",
        )
    own = table.iloc[design.rows]
    times = None
    if settings.longitudinal.random == "slope":
        if time is None:
            raise ModelError(
                "longitudinal model: random slopes need the time of each session; give a column"
                f" {settings.longitudinal.time_columns[0]} or acq_time in sessions.tsv",
                reason="no-time",
            )
        times = own[time].to_numpy(dtype=np.float64)
        if not np.isfinite(times).all():
            lacking = ", ".join(map(str, own.index[~np.isfinite(times)][:8]))
            raise ModelError(f"longitudinal model: no {time} of {lacking}", reason="no-time")
    return RepeatedRows(design, own[PARTICIPANT].to_numpy(dtype=np.str_), times)
