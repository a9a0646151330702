"""The general linear model at every point of a map."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special
from scipy.optimize import elementwise

from hipsta_bids.errors import ModelError
from hipsta_bids.group.formula import Contrast
from hipsta_bids.group.settings import GlmSettings

# Confidence limits of standardized effects, by inverting non-central distributions.


FloatArray = NDArray[np.float64]

#: SciPy's inverse is exact to some 1e-5 only; the root is looked for this far around it.
_BRACKET = 0.01
#: SciPy's inverse for F goes no farther than 10000; beyond it the root is looked for between a
#: tenth of this and so many times the numerator's sum.
_FARTHEST, _WIDEST = 9990.0, 20.0


def t_limits(t: FloatArray, df: FloatArray, confidence: float) -> tuple[FloatArray, FloatArray]:
    """Limits of the non-centrality of a t statistic.

    ``t, df`` Statistics and degrees of freedom, of one shape. Returns Non-centralities at which the
    statistic is the upper, or lower, ````(1 - confidence) / 2```` quantile (Steiger 2004).
    """
    tail = (1 - confidence) / 2

    def limit(probability: float) -> FloatArray:
        def excess(center: FloatArray, t: FloatArray, df: FloatArray) -> FloatArray:
            return _floats(special.nctdtr(df, center, t)) - probability

        return _root(excess, _floats(special.nctdtrinc(df, probability, t)), t, df)

    return limit(1 - tail), limit(tail)


def f_limits(
    f: FloatArray, df1: int, df2: FloatArray, confidence: float
) -> tuple[FloatArray, FloatArray]:
    """Limits of the non-centrality of an F statistic.

    ``f, df2`` Statistics and denominator degrees of freedom, of one shape; ``df1`` Numerator
    degrees of freedom.
    """
    tail = (1 - confidence) / 2
    first = float(df1)

    def limit(probability: float) -> FloatArray:
        def excess(center: FloatArray, f: FloatArray, df: FloatArray) -> FloatArray:
            at = np.maximum(center, 0.0)
            return _floats(special.ncfdtr(first, df, at, f)) - probability

        reachable = special.fdtr(first, df2, f) > probability
        inside = np.where(reachable, f, np.nan)
        start = _floats(special.ncfdtrinc(first, df2, probability, inside))
        root = np.maximum(_root(excess, start, inside, df2), 0.0)
        far = start >= _FARTHEST
        if far.any():
            wide = (np.full(far.sum(), _FARTHEST / 10), _WIDEST * first * inside[far])
            found = elementwise.find_root(excess, wide, args=(inside[far], df2[far]))
            root[far] = np.where(found.success, found.x, np.nan)
        return np.where(reachable | np.isnan(f), root, 0.0)

    return limit(1 - tail), limit(tail)


def _root(
    function: Callable[..., FloatArray], start: FloatArray, statistic: FloatArray, df: FloatArray
) -> FloatArray:
    """Polish approximate roots; keep those that cannot be bracketed."""
    reach = _BRACKET * (1 + np.abs(start))
    found = elementwise.find_root(function, (start - reach, start + reach), args=(statistic, df))
    return np.where(found.success, found.x, start)


def _floats(values: object) -> FloatArray:
    return np.asarray(values, dtype=np.float64)


IntArray = NDArray[np.int64]

#: Values in memory at once; bounds the temporaries, and does not change a result.
_CHUNK = 4_000_000


@dataclass(frozen=True)
class PointTest:
    """One contrast at each point; NaN where the model could not be fitted."""

    contrast: Contrast
    statistic: FloatArray
    """(points,) t, or F for contrasts of several rows."""
    p: FloatArray
    """(points,) two-sided."""
    df: FloatArray
    """(points,) residual degrees of freedom."""
    estimate: FloatArray
    """(rows, points) in units of the map."""
    se: FloatArray
    """(rows, points) standard errors."""
    cohen_d: FloatArray
    """(points,) estimate over residual standard deviation; NaN for several rows."""
    cohen_d_limits: FloatArray
    """(2, points)"""
    eta_squared: FloatArray
    """(points,) partial: share of the variance that the covariates leave."""
    eta_squared_limits: FloatArray
    """(2, points)"""

    @property
    def kind(self) -> str:
        """``t`` or ``F``."""
        return "t" if self.contrast.n_rows == 1 else "F"


@dataclass(frozen=True)
class PointwiseFit:
    """A linear model at each point."""

    coefficients: FloatArray
    """(columns, points) in units of the map per unit of the column."""
    sigma: FloatArray
    """(points,) residual standard deviation."""
    n: IntArray
    """(points,) subjects with a value."""
    tests: tuple[PointTest, ...]
    """In the order of the contrasts."""


@dataclass(frozen=True)
class PointBlock:
    """The fit at some points, in coordinates in which the complete design is orthonormal."""

    scores: FloatArray
    """(points, columns)"""
    covariance: FloatArray
    """(points, columns, columns)"""
    sigma: FloatArray
    """(points,) NaN where the model cannot be fitted."""
    n: IntArray
    """(points,) subjects with a value."""


def fit_points(
    maps: FloatArray, matrix: FloatArray, contrasts: Sequence[Contrast], settings: GlmSettings
) -> PointwiseFit:
    """Fit the same linear model to each column of a table, with values missing anywhere.

    ``maps`` NaN is missing.
    """
    _check(maps, matrix, contrasts)
    basis, triangle = np.linalg.qr(matrix)
    back = np.linalg.inv(triangle)
    blocks = [
        fit_block(np.asarray(maps[:, part], dtype=np.float64), basis, settings)
        for part in chunks(maps.shape, matrix.shape[1])
    ]
    fit = PointBlock(
        scores=np.concatenate([block.scores for block in blocks]),
        covariance=np.concatenate([block.covariance for block in blocks]),
        sigma=np.concatenate([block.sigma for block in blocks]),
        n=np.concatenate([block.n for block in blocks]),
    )
    df = np.where(np.isfinite(fit.sigma), fit.n - matrix.shape[1], np.nan)
    tests = tuple(
        _test(contrast, contrast.weights @ back, fit, df, settings) for contrast in contrasts
    )
    return PointwiseFit(back @ fit.scores.T, fit.sigma, fit.n, tests)


def _check(maps: FloatArray, matrix: FloatArray, contrasts: Sequence[Contrast]) -> None:
    if maps.ndim != 2 or matrix.ndim != 2 or maps.shape[0] != matrix.shape[0]:  # noqa: PLR2004 -- tables
        raise ModelError(
            f"model: maps of shape {maps.shape} do not fit a design of shape {matrix.shape};"
            " both need one row per subject",
            reason="design-shape",
        )
    if not np.isfinite(matrix).all():
        raise ModelError(
            "model: the design has missing values; keep complete rows only",
            reason="design-missing",
        )
    if np.linalg.matrix_rank(matrix) < matrix.shape[1]:
        raise ModelError(
            f"model: the design's {matrix.shape[1]} columns are not independent, given"
            f" {matrix.shape[0]} subjects; leave one out",
            reason="design-rank",
        )
    for contrast in contrasts:
        if contrast.weights.shape[1] != matrix.shape[1]:
            raise ModelError(
                f"contrast {contrast.name!r} has {contrast.weights.shape[1]} weights, the design"
                f" {matrix.shape[1]} columns",
                reason="contrast-shape",
            )


def chunks(shape: tuple[int, ...], columns: int) -> Iterator[slice]:
    """Split points into ranges that fit into memory together."""
    step = max(1, _CHUNK // (shape[0] * columns))
    return (slice(start, start + step) for start in range(0, max(shape[1], 1), step))


def fit_block(maps: FloatArray, basis: FloatArray, settings: GlmSettings) -> PointBlock:
    """Solve least squares at some points, by normal equations in orthonormal coordinates.

    There the equations of a complete point are the identity, and those of others stay well
    conditioned unless the missing subjects really carried a column.

    ``maps`` NaN is missing.
    """
    present = np.isfinite(maps)
    values = np.where(present, maps, 0.0)
    n = present.sum(axis=0)
    columns = basis.shape[1]
    if present.all():
        inverse = np.repeat(np.eye(columns)[None], maps.shape[1], axis=0)
        usable = n - columns >= settings.min_residual_df
    else:
        products = (basis[:, :, None] * basis[:, None, :]).reshape(len(basis), -1)
        information = (present.T.astype(np.float64) @ products).reshape(-1, columns, columns)
        usable = np.linalg.eigvalsh(information)[:, 0] > settings.min_information
        usable &= n - columns >= settings.min_residual_df
        information[~usable] = np.eye(columns)
        inverse = np.asarray(np.linalg.inv(information), dtype=np.float64)
    scores = np.einsum("pij,jp->pi", inverse, basis.T @ values)
    residuals = np.where(present, values - basis @ scores.T, 0.0)
    squares = np.einsum("sp,sp->p", residuals, residuals)
    total = np.einsum("sp,sp->p", values, values)
    usable &= squares > total * np.finfo(np.float64).eps  # else the model leaves rounding only
    sigma = np.sqrt(squares / np.where(usable, n - columns, 1))
    sigma[~usable] = np.nan
    if settings.covariance == "hc3":
        covariance = _hc3(residuals, basis, inverse)
    else:
        covariance = inverse * (sigma**2)[:, None, None]
    return PointBlock(
        scores=np.where(usable[:, None], scores, np.nan),
        covariance=np.where(usable[:, None, None], covariance, np.nan),
        sigma=sigma,
        n=n,
    )


def _hc3(residuals: FloatArray, basis: FloatArray, inverse: FloatArray) -> FloatArray:
    """Sandwich covariance with residuals over (1 - leverage) (MacKinnon and White 1985).

    NaN where one subject alone determines a coefficient.
    """
    leverage = np.einsum("psi,si->sp", basis @ inverse, basis)
    alone = (1 - leverage < np.sqrt(np.finfo(np.float64).eps)) & (residuals != 0)
    weights = np.where(alone, np.nan, residuals / np.where(alone, 1.0, 1 - leverage)) ** 2
    products = (basis[:, :, None] * basis[:, None, :]).reshape(len(basis), -1)
    meat = (weights.T @ products).reshape(inverse.shape)
    sandwich: FloatArray = inverse @ meat @ inverse
    return sandwich


def _test(
    contrast: Contrast, rotated: FloatArray, fit: PointBlock, df: FloatArray, settings: GlmSettings
) -> PointTest:
    """Wald test of a contrast at each point."""
    estimate = fit.scores @ rotated.T
    spread = rotated @ fit.covariance @ rotated.T
    rows = contrast.n_rows
    se = np.sqrt(np.diagonal(spread, axis1=1, axis2=2))
    if rows == 1:
        statistic = estimate[:, 0] / se[:, 0]
        p = 2 * special.stdtr(df, -np.abs(statistic))
        squared = statistic**2
        cohen_d = estimate[:, 0] / fit.sigma
        unit = se[:, 0] / fit.sigma
        d_limits = np.stack(t_limits(statistic, df, settings.confidence)) * unit
    else:
        squared = statistic = _wald(estimate, spread)
        p = special.fdtrc(float(rows), df, statistic)
        cohen_d = np.full(len(df), np.nan)
        d_limits = np.full((2, len(df)), np.nan)
    eta_limits = np.stack(f_limits(squared, rows, df, settings.confidence))
    return PointTest(
        contrast=contrast,
        statistic=statistic,
        p=np.asarray(p, dtype=np.float64),
        df=df,
        estimate=estimate.T,
        se=se.T,
        cohen_d=cohen_d,
        cohen_d_limits=d_limits,
        eta_squared=squared * rows / (squared * rows + df),
        eta_squared_limits=eta_limits / (eta_limits + df),
    )


def _wald(estimate: FloatArray, spread: FloatArray) -> FloatArray:
    """F statistic of several combinations at once, at each point."""
    rows = estimate.shape[1]
    valid = np.asarray(np.isfinite(spread).all(axis=(1, 2)))
    safe = np.where(valid[:, None, None], spread, np.eye(rows))
    solved = np.linalg.solve(safe, estimate[:, :, None])[:, :, 0]
    return np.where(valid, np.sum(estimate * solved, axis=1) / rows, np.nan)
