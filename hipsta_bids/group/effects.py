"""Confidence limits of standardized effects, by inverting non-central distributions."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import special
from scipy.optimize import elementwise

FloatArray = NDArray[np.float64]

#: SciPy's inverse is exact to some 1e-5 only; the root is looked for this far around it.
_BRACKET = 0.01
#: SciPy's inverse for F goes no farther than 10000; beyond it the root is looked for between a
#: tenth of this and so many times the numerator's sum.
_FARTHEST, _WIDEST = 9990.0, 20.0


def t_limits(t: FloatArray, df: FloatArray, confidence: float) -> tuple[FloatArray, FloatArray]:
    """Limits of the non-centrality of a t statistic.

    Parameters
    ----------
    t, df : ndarray
        Statistics and degrees of freedom, of one shape.
    confidence : float
        Two-sided coverage.

    Returns
    -------
    low, high : ndarray
        Non-centralities at which the statistic is the upper, or lower, ``(1 - confidence) / 2``
        quantile (Steiger 2004). Times ``se / sigma`` they are limits of Cohen's d.
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

    Parameters
    ----------
    f, df2 : ndarray
        Statistics and denominator degrees of freedom, of one shape.
    df1 : int
        Numerator degrees of freedom.
    confidence : float
        Two-sided coverage.

    Returns
    -------
    low, high : ndarray
        As in :func:`t_limits`; zero where even no effect would give a smaller statistic too
        seldom. ``limit / (limit + df2)`` is a limit of partial eta squared.
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
