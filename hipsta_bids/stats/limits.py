"""Limits of effect sizes, by non-central distributions."""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from scipy import special
from scipy.optimize import elementwise

from hipsta_bids.stats.arrays import Float

#: SciPy's inverse is exact to some 1e-5 only; the root is looked for this far around it.
_BRACKET = 0.01
#: SciPy's inverse for F goes no farther than 10000; beyond it the root is looked for between a
#: tenth of this and this many times the numerator's sum.
_FARTHEST, _WIDEST = 9990.0, 20.0


def t_limits(t: Float, df: Float, confidence: float) -> tuple[Float, Float]:
    """Limits of the non-centrality of t statistics (Steiger 2004).

    At the lower and upper limit, ``t`` is the upper and lower ``(1 - confidence) / 2`` quantile.
    """
    tail = (1 - confidence) / 2

    def limit(probability: float) -> Float:
        def excess(center: Float, t: Float, df: Float) -> Float:
            return np.asarray(special.nctdtr(df, center, t) - probability)

        return _root(excess, special.nctdtrinc(df, probability, t), t, df)

    return limit(1 - tail), limit(tail)


def f_limits(f: Float, df1: int, df2: Float, confidence: float) -> tuple[Float, Float]:
    """Limits of the non-centrality of F statistics, as :func:`t_limits`."""
    tail = (1 - confidence) / 2
    first = float(df1)

    def limit(probability: float) -> Float:
        def excess(center: Float, f: Float, df: Float) -> Float:
            at = np.maximum(center, 0.0)
            return np.asarray(special.ncfdtr(first, df, at, f) - probability)

        reachable = special.fdtr(first, df2, f) > probability
        inside = np.where(reachable, f, np.nan)
        start = special.ncfdtrinc(first, df2, probability, inside)
        root = np.maximum(_root(excess, start, inside, df2), 0.0)
        far = start >= _FARTHEST
        if far.any():
            wide = (np.full(far.sum(), _FARTHEST / 10), _WIDEST * first * inside[far])
            solution = elementwise.find_root(excess, wide, args=(inside[far], df2[far]))
            root[far] = np.where(solution.success, solution.x, np.nan)
        return np.where(reachable | np.isnan(f), root, 0.0)

    return limit(1 - tail), limit(tail)


def _root(function: Callable[..., Float], near: ArrayLike, statistic: Float, df: Float) -> Float:
    """Polish approximate roots; keep those that cannot be bracketed."""
    start: Float = np.asarray(near, dtype=np.float64)
    reach = _BRACKET * (1 + np.abs(start))
    root = elementwise.find_root(function, (start - reach, start + reach), args=(statistic, df))
    return np.where(root.success, root.x, start)
