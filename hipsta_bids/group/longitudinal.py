"""Repeated sessions: mixed models at each point."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from hipsta_bids.errors import ModelError
from hipsta_bids.group.contrasts import Contrast
from hipsta_bids.group.random_intercept import best_ratio, collect_sums, curvature
from hipsta_bids.group.random_slope import (
    best_triangles,
    collect_slope_sums,
    slope_freedom,
    solve_slopes,
)
from hipsta_bids.group_settings import LongitudinalSettings

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Sessions of one participant that tell a slope from noise.
_SLOPE_SESSIONS = 3
#: Values in memory at once; bounds the temporaries, and does not change a result.
_CHUNK = 4_000_000


@dataclass(frozen=True)
class MixedTest:
    """One contrast of one row at each point; NaN where the model could not be fitted."""

    contrast: Contrast
    estimate: FloatArray
    """(points,) in units of the map."""
    se: FloatArray
    """(points,)"""
    t: FloatArray
    """(points,)"""
    df: FloatArray
    """(points,) Satterthwaite's."""
    p: FloatArray
    """(points,) two-sided."""
    limits: FloatArray
    """(2, points) of the estimate."""


@dataclass(frozen=True)
class MixedFit:
    """A random-intercept model at each point."""

    coefficients: FloatArray
    """(columns, points)"""
    residual_variance: FloatArray
    """(points,) within participants."""
    participant_variance: FloatArray
    """(points,) between them, given the columns; with random slopes, at the mean time."""
    slope_variance: FloatArray
    """(points,) of slopes between them, per squared unit of time; NaN without random slopes."""
    n: IntArray
    """(points,) sessions with a value."""
    tests: tuple[MixedTest, ...]


def fit_mixed(
    maps: FloatArray,
    matrix: FloatArray,
    participants: Sequence[str] | NDArray[np.str_],
    contrasts: Sequence[Contrast],
    settings: LongitudinalSettings,
    *,
    times: FloatArray | None = None,
) -> MixedFit:
    """Fit ``value = matrix @ coefficients + participant + residual`` at each point.

    With times, participants also have a slope of their own, correlated with the intercept.

    By restricted maximum likelihood, which for one random intercept depends on one number: the
    ratio of the two variances. It is found for all points at once. Degrees of freedom are
    Satterthwaite's, from the curvature of the likelihood at the optimum, as in R's ``lmerTest``
    (Kuznetsova et al. 2017); where no variance between participants is found they are those of
    the linear model.

    Parameters
    ----------
    maps : ndarray, shape (sessions, points)
        NaN is missing; each point is fitted to the sessions that it has.
    matrix : ndarray, shape (sessions, columns)
        Design, of full column rank.
    participants : sequence of str, length (sessions,)
        Whose session it is.
    contrasts : sequence of Contrast
        Of one row each.
    settings : LongitudinalSettings
        Search and limits.
    times : ndarray, shape (sessions,), optional
        For random slopes, in any unit; the fixed slope is the business of the design.

    Raises
    ------
    ModelError
        If shapes differ, a contrast has several rows, or nobody has two sessions.
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
    step = max(1, _CHUNK // (matrix.shape[0] * matrix.shape[1]))
    rotated = np.array([contrast.weights[0] @ back for contrast in contrasts])
    parts = []
    for start in range(0, max(maps.shape[1], 1), step):
        values = np.asarray(maps[:, start : start + step], dtype=np.float64)
        if times is None:
            parts.append(_fit(values, basis, numbers, rotated, settings))
        else:
            data = _SlopeData(values, basis, numbers, times)
            parts.append(_fit_slopes(data, rotated, settings))
    stacked = {
        name: np.concatenate([getattr(part, name) for part in parts], axis=-1)
        for name in ("scores", "residual", "between", "slopes", "n", "estimate", "se", "df")
    }
    tests = tuple(
        _test(contrast, stacked["estimate"][i], stacked["se"][i], stacked["df"][i], settings)
        for i, contrast in enumerate(contrasts)
    )
    return MixedFit(
        coefficients=back @ stacked["scores"],
        residual_variance=stacked["residual"],
        participant_variance=stacked["between"],
        slope_variance=stacked["slopes"],
        n=stacked["n"],
        tests=tests,
    )


@dataclass(frozen=True)
class _Part:
    """Results at some points; points last."""

    scores: FloatArray
    residual: FloatArray
    between: FloatArray
    slopes: FloatArray
    n: IntArray
    estimate: FloatArray
    se: FloatArray
    df: FloatArray


def _check(
    maps: FloatArray,
    matrix: FloatArray,
    participants: Sequence[str] | NDArray[np.str_],
    contrasts: Sequence[Contrast],
) -> IntArray:
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
    maps: FloatArray,
    basis: FloatArray,
    participants: IntArray,
    rotated: FloatArray,
    settings: LongitudinalSettings,
) -> _Part:
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
    return _Part(
        scores=state.scores.T * blank,
        residual=variance * blank,
        between=variance * ratio * blank,
        slopes=np.full(len(blank), np.nan),
        n=sums.n,
        estimate=estimate * blank,
        se=np.sqrt(form * variance) * blank,
        df=df * blank,
    )


@dataclass(frozen=True)
class _SlopeData:
    maps: FloatArray
    basis: FloatArray
    participants: IntArray
    times: FloatArray


def _fit_slopes(data: _SlopeData, rotated: FloatArray, settings: LongitudinalSettings) -> _Part:
    unit = float(data.times.std())
    standard = (data.times - data.times.mean()) / unit
    sums = collect_slope_sums(data.maps, data.basis, data.participants, standard)
    usable = np.linalg.eigvalsh(sums.squares)[:, 0] > settings.min_information
    usable &= sums.moments[0].max(axis=1) >= _SLOPE_SESSIONS
    usable &= sums.n > data.basis.shape[1] + _SLOPE_SESSIONS
    kept = sums.take(np.flatnonzero(usable))
    triangles = best_triangles(kept, settings)
    state = solve_slopes(kept, triangles)
    variance = state.residual / (kept.n - data.basis.shape[1])
    form = np.einsum("ci,pij,cj->cp", rotated, state.inverse, rotated)

    def spread(values: FloatArray) -> FloatArray:
        full = np.full((*values.shape[:-1], len(usable)), np.nan)
        full[..., usable] = values
        return full

    return _Part(
        scores=spread(state.scores.T),
        residual=spread(variance),
        between=spread(variance * triangles[:, 0] ** 2),
        slopes=spread(variance * np.sum(triangles[:, 1:] ** 2, axis=1) / unit**2),
        n=sums.n,
        estimate=spread(np.einsum("cj,pj->cp", rotated, state.scores)),
        se=spread(np.sqrt(form * variance)),
        df=spread(slope_freedom(kept, triangles, rotated)),
    )


def _satterthwaite(
    form: FloatArray,
    slope: FloatArray,
    freedom: FloatArray,
    ratio: FloatArray,
    hessian: tuple[FloatArray, FloatArray],
) -> FloatArray:
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


def _test(
    contrast: Contrast,
    estimate: FloatArray,
    se: FloatArray,
    df: FloatArray,
    settings: LongitudinalSettings,
) -> MixedTest:
    t = estimate / se
    reach = special.stdtrit(df, (1 + settings.confidence) / 2) * se
    return MixedTest(
        contrast=contrast,
        estimate=estimate,
        se=se,
        t=t,
        df=df,
        p=np.asarray(2 * special.stdtr(df, -np.abs(t)), dtype=np.float64),
        limits=np.stack([estimate - reach, estimate + reach]),
    )
