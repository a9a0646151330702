"""Repeated sessions: mixed models at each point."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import special
from scipy.optimize.elementwise import find_root

from hipsta_bids.errors import ModelError
from hipsta_bids.stats import glm, random_slope
from hipsta_bids.stats.arrays import Bool, Float, Int
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.design import Design
from hipsta_bids.stats.exchangeability import Visits
from hipsta_bids.stats.settings import GlmSettings, LongitudinalSettings
from hipsta_bids.types import PARTICIPANT

#: Largest correlation between a participant's sessions that is looked for.
MAX_CORRELATION = 0.999
#: Correlations at which the likelihood is looked at first.
CORRELATIONS = 40

#: Sessions of one participant that distinguish a slope from noise.
_SLOPE_SESSIONS = 3
#: A gain in minus twice the restricted likelihood by slopes that is none.
_NO_GAIN = 1e-6
#: Degrees of freedom of t statistics that differ by less are the same.
_SAME_DF = 1e-8


@dataclass(frozen=True)
class Sums:
    """What the likelihood depends on: sums of products of columns, the values being the last."""

    n: Int
    """(points,) sessions."""
    repeated: Bool
    """(points,) whether any participant has two."""
    squares: Float
    """(points, columns + 1, columns + 1) over sessions."""
    sizes: Float
    """(sizes, 1) numbers of sessions of a participant that occur; or, where these are more than
    participants, (participants, points) sessions of each."""
    people: Float
    """(sizes, points) participants with that number."""
    person_squares: Float
    """(sizes, points, columns + 1, columns + 1) of each participant's sums, over participants."""

    def is_distinct(self) -> Bool:
        """(points,) whether the columns leave something of the intercepts to estimate."""
        inverse = np.linalg.inv(self.squares[:, :-1, :-1])
        fixed = inverse @ self.person_squares.sum(axis=0)[:, :-1, :-1]
        return np.asarray(1 - np.trace(fixed, axis1=1, axis2=2) / self.n > glm.MIN_INFORMATION)

    def take(self, points: Int) -> "Sums":
        """Keep some points."""
        is_shared = self.sizes.shape[1] == 1
        return Sums(
            n=self.n[points],
            repeated=self.repeated[points],
            squares=self.squares[points],
            sizes=self.sizes if is_shared else self.sizes[:, points],
            people=self.people[:, points],
            person_squares=self.person_squares[:, points],
        )

    def where(self, usable: Bool) -> "Sums":
        """Replace points that cannot be fitted by harmless ones."""
        size = self.squares.shape[1]
        mask = usable[:, None, None]
        return replace(
            self,
            n=np.where(usable, self.n, size + 1),
            squares=np.where(mask, self.squares, np.eye(size)),
            person_squares=np.where(mask, self.person_squares, 0.0),
        )

    def at(self, ratio: Float) -> tuple[Float, Float, Float, Float, Float]:
        """Fit by generalized least squares with one ratio of variances per point.

        Returns coefficients (points, columns); the inverse of X' V^-1 X, and the derivative of that
        matrix for the ratio, (points, columns, columns); the sum of squared residuals with its
        first and second derivative, and log |V| + log |X' V^-1 X| with these, (3, points).
        """
        sizes = self.sizes
        spread = 1 + sizes * ratio
        take = (ratio / spread, 1 / spread**2, -2 * sizes / spread**3)
        off, first, second = (-np.einsum("kp,kpij->pij", w, self.person_squares) for w in take)
        whole = self.squares + off
        inverse = np.linalg.inv(whole[:, :-1, :-1])
        scores = np.einsum("pij,pj->pi", inverse, whole[:, :-1, -1])
        # What is left of the values: minus the scores times the columns, plus the values.
        left = np.column_stack([-scores, np.ones(len(scores))])
        moved = np.einsum("pij,pj->pi", first, left)
        change = np.einsum("pij,pj->pi", inverse, moved[:, :-1])
        gradient, bent = (np.einsum("pij,pj->pi", matrices, left) for matrices in (whole, second))
        residual_second = np.einsum("pi,pi->p", left, bent)
        residual_second -= 2 * np.einsum("pi,pi->p", change, moved[:, :-1])
        relative = inverse @ first[:, :-1, :-1]
        bend = inverse @ second[:, :-1, :-1] - relative @ relative
        share = sizes / spread
        log_spread = np.sum(self.people * np.log(spread), axis=0)
        residual = (
            np.einsum("pi,pi->p", left, gradient),
            np.einsum("pi,pi->p", left, moved),
            residual_second,
        )
        penalty = (
            log_spread - np.linalg.slogdet(inverse)[1],
            np.sum(self.people * share, axis=0) + np.trace(relative, axis1=1, axis2=2),
            np.trace(bend, axis1=1, axis2=2) - np.sum(self.people * share**2, axis=0),
        )
        return scores, inverse, first[:, :-1, :-1], np.stack(residual), np.stack(penalty)


def collect_sums(maps: Float, basis: Float, participants: Int) -> Sums:
    """Sum over sessions and participants."""
    present = np.isfinite(maps)
    counts = glm.sum_by(participants, present.astype(np.float64))
    columns = np.empty((*maps.shape, basis.shape[-1] + 1))
    columns[..., :-1] = present[:, :, None] * glm.by_row(basis)
    columns[..., -1] = np.where(present, maps, 0.0)
    sums = glm.sum_by(participants, columns)
    sizes = np.unique(np.maximum(counts, 1.0))[:, None]
    masks = [np.where(counts == size, 1.0, 0.0) for size in sizes]

    def squares(rows: Float, weight: Float) -> Float:
        weighted = np.moveaxis(rows * weight[:, :, None], 0, 2)
        return np.asarray(weighted @ np.swapaxes(rows, 0, 1))

    if len(sizes) > len(counts):
        sizes, people = counts, np.ones(counts.shape)
        person_squares = sums[..., :, None] * sums[..., None, :]
    else:
        people = np.array([mask.sum(axis=0) for mask in masks])
        person_squares = np.array([squares(sums, mask) for mask in masks])
    return Sums(
        n=present.sum(axis=0),
        repeated=np.asarray((counts > 1).any(axis=0)),
        squares=squares(columns, np.ones(maps.shape)),
        sizes=sizes,
        people=people,
        person_squares=person_squares,
    )


def best_ratio(sums: Sums) -> Float:
    """Ratio r of variances that maximizes the restricted likelihood at each point.

    The best of a grid of correlations r / (1 + r), then the root of the derivative next to it.
    """
    freedom = sums.n - sums.squares.shape[1] + 1
    grid = np.linspace(0.0, MAX_CORRELATION, CORRELATIONS)
    losses = []
    for ratio in grid / (1 - grid):
        *_, residual, penalty = sums.at(np.full(len(sums.n), ratio))
        losses.append(freedom * np.log(residual[0]) + penalty[0])
    best = np.argmin(losses, axis=0)

    def rising(correlation: Float, points: Int) -> Float:
        part = sums.take(points)
        *_, residual, penalty = part.at(correlation / (1 - correlation))
        return np.asarray(freedom[points] * residual[1] / residual[0] + penalty[1])

    points = np.arange(len(best))
    low, high = grid[np.maximum(best - 1, 0)], grid[np.minimum(best + 1, len(grid) - 1)]
    root = find_root(rising, (low, high), args=(points,))
    # Without a valley, the loss rises or falls all the way, and the best is at an end of the grid.
    has_valley = root.success & (rising(low, points) < 0)
    correlation = np.where(has_valley, root.x, grid[best])
    return np.asarray(correlation / (1 - correlation))


def fit_mixed(
    maps: Float,
    matrix: Float,
    participants: Sequence[str] | NDArray[np.str_],
    contrasts: Sequence[Contrast],
    settings: LongitudinalSettings | GlmSettings,
    *,
    times: Float | None = None,
    covariates: Float | None = None,
    within: bool = False,
) -> glm.PointwiseFit:
    """Fit ``value = matrix @ coefficients + participant + residual`` at each point.

    ``participants`` are levels of any grouping, as sites. Effect sizes are in standard deviations
    of single rows or, ``within`` levels, of the residual.

    With times, participants also have a separate slope, correlated with the intercept, except
    at points whose restricted likelihood slopes do not raise: there intercepts alone are fitted.
    Whether slopes vary is tested by the ratio of restricted likelihoods, whose distribution is an
    equal mixture of chi squared with 1 and 2 degrees of freedom (Stram and Lee 1994).

    By restricted maximum likelihood, which for one random intercept depends on one number: the
    ratio of the two variances. It is estimated for all points at once. Degrees of freedom are
    Satterthwaite's, from the curvature of the likelihood at the optimum, as in R's ``lmerTest``
    (Kuznetsova et al. 2017); where the variance between participants is 0, they are the linear
    model's. Several rows are tested by F: the mean of the squared t of combinations that are
    independent, with the degrees of freedom that give F its expectation (Fai and Cornelius 1996).
    Covariates (maps, rows, points) are as of :func:`~hipsta_bids.stats.glm.fit_points`.
    """
    contrasts, basis, inverse, covariates = glm.orthonormal(maps, matrix, contrasts, covariates)
    _, numbers, counts = np.unique(
        np.asarray(participants), return_inverse=True, return_counts=True
    )
    if counts.max() == 1:
        unit = "level has two rows" if within else "participant has two sessions"
        raise ModelError(f"mixed model: no {unit}; use a linear model")
    if times is not None and counts.max() < _SLOPE_SESSIONS:
        raise ModelError(
            "longitudinal model: no participant has three sessions, so that slopes cannot be"
            " separated from noise; use random intercepts"
        )
    rotated = tuple(contrast.weights @ inverse for contrast in contrasts)
    parts = []
    for values, columns in glm.parts_of_points(maps, basis, covariates):
        part = _fit(values, columns, numbers, rotated)
        if times is not None:
            full = _fit_slopes(values, columns, numbers, rotated, times=times)
            part = _larger_where_better(part, full)
        parts.append(part)
    whole = {name: np.concatenate([part[name] for part in parts], axis=-1) for name in parts[0]}
    # That of single visits: effect sizes are those of independent rows.
    sigma = np.sqrt(whole["residual"] + (0.0 if within else whole["participant"]))
    return glm.PointwiseFit(
        coefficients=inverse @ whole["scores"],
        sigma=sigma,
        n=whole["n"].astype(np.int64),
        tests=tuple(_tests(contrasts, whole, sigma, settings.confidence)),
        variances={name: whole[name] for name in ("residual", "participant", "slope")},
        slopes_p=whole.get("slopes_p"),
    )


def _larger_where_better(
    intercepts: dict[str, Float], slopes: dict[str, Float]
) -> dict[str, Float]:
    """Join the fits of some points: with slopes, except where the likelihood gains nothing."""
    gain = intercepts["loss"] - slopes["loss"]
    is_worse = gain < _NO_GAIN
    chosen_values = {name: np.where(is_worse, intercepts[name], v) for name, v in slopes.items()}
    chosen_values["slope"] = np.where(is_worse, 0.0, slopes["slope"])
    gain = np.where(gain < 0, 0.0, gain)
    chosen_values["slopes_p"] = (special.chdtrc(1, gain) + special.chdtrc(2, gain)) / 2
    return chosen_values


def _tests(
    contrasts: Sequence[Contrast], whole: Mapping[str, Float], sigma: Float, confidence: float
) -> Iterator[glm.PointTest]:
    """Test contrasts, whose rows follow each other in what was fitted."""
    start = 0
    for contrast in contrasts:
        rows = slice(start, start + contrast.n_rows)
        start = rows.stop
        estimate, se, t, df = (whole[name][rows] for name in ("estimate", "se", "t", "df"))
        single = contrast.n_rows == 1
        values_of = {"df": df[0] if single else denominator(df), "estimate": estimate, "se": se}
        statistic = t[0] if single else np.mean(t**2, axis=0)
        yield glm.with_effects(contrast, statistic, **values_of, sigma=sigma, confidence=confidence)


def denominator(df: Float) -> Float:
    """Denominator's degrees of freedom of F, from (rows, points) degrees of its t statistics."""
    rows, least = len(df), 2.0  # F has no expectation below
    expected = np.sum(df / np.where(df > least, df - least, np.nan), axis=0)
    df_residual = np.asarray(2 * expected / (expected - rows), dtype=np.float64)
    df_residual = np.where(np.ptp(df, axis=0) < _SAME_DF, df.mean(axis=0), df_residual)
    return np.where(np.isfinite(df).all(axis=0) & np.isnan(df_residual), least, df_residual)


def _tested(
    rotated: Sequence[Float], scores: Float, inverse: Float, variance: Float
) -> tuple[Float, dict[str, Float]]:
    """Rows that make those of each contrast independent, and estimates of these; points last.

    Rows are (rows, points, columns), scores (points, columns), the inverse (points, columns,
    columns).
    """
    fixed, turned = [], []
    for rows in rotated:
        weights = np.broadcast_to(rows[:, None], (len(rows), *inverse.shape[:2]))
        fixed.append(weights)
        if len(rows) > 1:
            axes = np.linalg.eigh(rows @ inverse @ rows.T)[1]
            weights = np.einsum("pjk,ji->kpi", axes, rows)
        turned.append(weights)
    joined = np.concatenate(fixed), np.concatenate(turned)
    (estimate, se), (scale, root) = (
        (
            np.einsum("cpj,pj->cp", rows, scores),
            np.sqrt(random_slope.forms(inverse, rows) * variance),
        )
        for rows in joined
    )
    state_values = {"scores": scores.T, "residual": variance, "estimate": estimate, "se": se}
    return joined[1], state_values | {"t": scale / root}


def _fit(
    maps: Float, basis: Float, participants: Int, rotated: Sequence[Float]
) -> dict[str, Float]:
    """Fit intercepts at some points; points last."""
    sums = collect_sums(maps, basis, participants)
    columns = basis.shape[-1]
    usable = np.linalg.eigvalsh(sums.squares[:, :-1, :-1])[:, 0] > glm.MIN_INFORMATION
    usable &= (sums.n > columns + 1) & sums.repeated
    usable &= sums.where(usable).is_distinct()
    sums = sums.where(usable)
    ratio = best_ratio(sums)
    scores, inverse, information_first, residual, penalty = sums.at(ratio)
    freedom = sums.n - columns
    variance = residual[0] / freedom
    turned, values_of = _tested(rotated, scores, inverse, variance)
    slope = -random_slope.forms(inverse @ information_first @ inverse, turned)
    relative = slope / random_slope.forms(inverse, turned)
    df = _satterthwaite(relative, freedom, ratio, residual, penalty)
    blank = np.where(usable, 1.0, np.nan)
    values_of |= {
        "participant": variance * ratio,
        "df": df,
        "loss": freedom * np.log(residual[0]) + penalty[0],
    }
    values_of = {name: values * blank for name, values in values_of.items()}
    return values_of | {"slope": np.full(len(blank), np.nan), "n": sums.n.astype(np.float64)}


def _fit_slopes(
    maps: Float, basis: Float, participants: Int, rotated: Sequence[Float], *, times: Float
) -> dict[str, Float]:
    """Fit intercepts and slopes at some points; points last."""
    unit = float(times.std())
    standard = (times - times.mean()) / unit
    sums = random_slope.collect_slope_sums(maps, basis, participants, standard)
    usable = np.linalg.eigvalsh(sums.squares)[:, 0] > glm.MIN_INFORMATION
    usable &= sums.moments[0].max(axis=1) >= _SLOPE_SESSIONS
    usable &= sums.n > basis.shape[-1] + _SLOPE_SESSIONS
    subset = sums.take(np.flatnonzero(usable))
    triangles = random_slope.best_triangles(subset)
    scores, inverse, residual, penalty = random_slope.solve_slopes(subset, triangles)
    variance = residual / (subset.n - basis.shape[-1])
    turned, values_of = _tested(rotated, scores, inverse, variance)
    values_of |= {
        "participant": variance * triangles[:, 0] ** 2,
        "slope": variance * np.sum(triangles[:, 1:] ** 2, axis=1) / unit**2,
        "df": random_slope.slope_freedom(subset, triangles, turned),
        "loss": (subset.n - basis.shape[-1]) * np.log(residual) + penalty,
    }

    def spread(values: Float) -> Float:
        full = np.full((*values.shape[:-1], len(usable)), np.nan)
        full[..., usable] = values
        return full

    spaced = {name: spread(values) for name, values in values_of.items()}
    return spaced | {"n": sums.n.astype(np.float64)}


def _satterthwaite(
    relative: Float, freedom: Int, ratio: Float, residual: Float, penalty: Float
) -> Float:
    """Degrees of freedom of contrasts: 2 f^2 / Var(f), f the estimated variance of one.

    With s the logarithm of the residual variance and r the ratio, f = exp(s) form(r), so its
    gradient is f (1, ``relative``), the slope of form over form. The covariance of (s, r) is twice
    the inverse of the Hessian of minus twice the restricted likelihood, whose entry for s is the
    residual ``freedom``.
    """
    variance = residual[0] / freedom
    mixed, second = -residual[1] / variance, penalty[2] + residual[2] / variance
    determinant = freedom * second - mixed**2
    safe = (ratio > 0) & (determinant > 0)
    spread = second - 2 * mixed * relative + freedom * relative**2
    df_of = np.where(safe, determinant, 1.0) / np.where(safe, spread, 1.0)
    return np.where(safe, df_of, freedom.astype(np.float64))


@dataclass(frozen=True, eq=False)
class RowsOfPeople(glm.RowModel):
    """A model of a design in which participants have several rows."""

    participants: NDArray[np.str_]
    """(rows,)"""

    def people(self, rows: Int) -> Int:
        """Return the number of the participant of each row."""
        return np.asarray(
            np.unique(self.participants, return_inverse=True)[1][rows], dtype=np.int64
        )

    def fit_measures(
        self, values: Float, rows: Int, contrasts: tuple[Contrast, ...]
    ) -> glm.PointwiseFit:
        """Fit some rows of the design to each summary measure, as if it were a point."""
        return self.fit(values, rows, contrasts)


@dataclass(frozen=True, eq=False)
class RepeatedRows(RowsOfPeople):
    """A mixed model of random intercepts, and perhaps slopes."""

    kind = "linear mixed model"
    times: Float | None
    """(rows,) of each visit, if known."""
    slopes: bool
    """Whether participants have slopes over time, or intercepts only."""
    longitudinal: LongitudinalSettings

    @property
    def visits(self) -> Visits | None:
        """Whose each row is, and when."""
        people = np.unique(self.participants, return_inverse=True)[1]
        return Visits(np.asarray(people, dtype=np.int64), self.times, self.slopes)

    def fit(
        self,
        values: Float,
        rows: Int,
        contrasts: tuple[Contrast, ...],
        covariates: Float | None = None,
    ) -> glm.PointwiseFit:
        """Fit some rows of the design at each point, perhaps with maps as covariates."""
        return fit_mixed(
            values,
            self.design.matrix[rows],
            self.participants[rows],
            contrasts,
            self.longitudinal,
            times=self.times[rows] if self.times is not None and self.slopes else None,
            covariates=covariates,
        )


def longitudinal_model(
    design: Design,
    table: pd.DataFrame,
    time: str | None,
    settings: GlmSettings,
    longitudinal: LongitudinalSettings,
) -> RepeatedRows:
    """Assign visits to participants, with their times if slopes are random."""
    if settings.covariance != "ordinary":
        raise ModelError(
            "longitudinal model: it assumes equal variances; set glm.covariance to ordinary"
        )
    rows_table = table.iloc[design.rows]
    times = None if time is None else rows_table[time].to_numpy(dtype=np.float64)
    visits = rows_table[PARTICIPANT].value_counts()
    n_repeated = int((visits >= _SLOPE_SESSIONS).sum())
    has_slopes = times is not None and n_repeated >= longitudinal.slope_participants
    random = longitudinal.random
    slopes = random == "slope" or (random == "auto" and has_slopes)
    if slopes and times is None:
        raise ModelError(
            "longitudinal model: random slopes need the time of each session; give a column"
            f" {longitudinal.time_columns[0]} or acq_time in sessions.tsv"
        )
    if times is not None and not np.isfinite(times).all():
        if slopes:
            lacking = ", ".join(map(str, rows_table.index[~np.isfinite(times)][:8]))
            raise ModelError(f"longitudinal model: no {time} of {lacking}")
        times = None
    people = rows_table[PARTICIPANT].to_numpy(dtype=np.str_)
    return RepeatedRows(design, settings, people, times, slopes, longitudinal)
