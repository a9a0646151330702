"""Cubic B-splines on the unit interval, clamped at its ends."""

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

FloatArray = NDArray[np.float64]

_DEGREE = 3


def inner_knots(values: FloatArray, splines: int) -> FloatArray:
    """Knots at quantiles of the values, so many that there are ``splines`` functions."""
    shares = np.linspace(0.0, 1.0, splines - _DEGREE + 1)[1:-1]
    return np.asarray(np.quantile(values, shares), dtype=np.float64)


def make_basis(knots: FloatArray) -> BSpline[np.float64]:
    """All B-splines of the inner knots as one function, of shape (..., splines)."""
    ends = np.repeat([0.0, 1.0], _DEGREE + 1)
    padded = np.concatenate([ends[: _DEGREE + 1], knots, ends[_DEGREE + 1 :]])
    return BSpline(padded, np.eye(len(padded) - _DEGREE - 1), _DEGREE)
