"""Smoothed derivatives of values on a regular grid."""

import math
from functools import lru_cache

import numpy as np

from hipsta_bids.artifacts import Float


def differentiate(values: Float, window: int, degree: int, times: int, axis: int) -> Float:
    """Differentiate along one axis with polynomials fitted to windows of nodes.

    The derivative at a node is that of the polynomial fitted to the window around it; within half
    a window of either end, to the first or last window.

    Parameters
    ----------
    values : array
    window : int
        Nodes per window, odd, no more than the axis has.
    degree : int
        Of the polynomials, less than ``window``.
    times : int
        Order of the derivative; 0 smooths.
    axis : int

    Returns
    -------
    array
        Of the shape of ``values``; per node distance to the power of ``times``.

    Notes
    -----
    Savitzky & Golay 1964, Anal Chem 36:1627-1639. The same as SciPy's ``savgol_filter``, to which
    a test compares it; importing that takes longer than measuring half a hemisphere, and 36 MB.
    """
    weights = _weights(values.shape[axis], window, degree, times)
    return np.asarray(np.moveaxis(np.tensordot(weights, values, axes=(1, axis)), 0, axis))


@lru_cache(maxsize=64)
def _weights(count: int, window: int, degree: int, times: int) -> Float:
    """Matrix (count, count) that maps values to derivatives."""
    result = np.zeros((count, count))
    if times > degree:
        return result
    place = np.arange(window)
    steps = place - place[:, None]  # from each place in the window to all of it
    powers = steps[..., None] ** np.arange(degree + 1.0)
    rows = math.factorial(times) * np.linalg.pinv(powers)[:, times]
    node = np.arange(count)
    first = np.clip(node - window // 2, 0, count - window)
    result[node[:, None], first[:, None] + place] = rows[node - first]
    return result
