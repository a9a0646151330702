"""Two measures of the same thing, at the same places."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from hipsta_bids.artifacts import Float


@dataclass(frozen=True, eq=False, kw_only=True)
class Agreement:
    """How well two measures of thickness at the same places agree."""

    count: int
    """Places where both are known."""
    correlation: float
    slope: float
    """Of the first on the second, by least squares."""
    difference: float
    """Mean of the first minus the second, mm."""
    deviation: float
    """Standard deviation of the difference, mm."""


def compare_nearby(points: Float, surface: Float, values: Float, reach: float) -> Float:
    """Look up values of a surface near points.

    Parameters
    ----------
    points : (N, 3) float64
        RAS mm.
    surface : (M, 3) float64
        RAS mm, NaN where undefined.
    values : (M,) float64
        NaN where missing.
    reach : float
        mm.

    Returns
    -------
    (N,) float64
        Mean of the four nearest, weighted by the inverse of their distance; NaN where the nearest
        lies farther away than ``reach``.
    """
    known = np.isfinite(surface).all(axis=-1) & np.isfinite(values)
    if not known.any():
        return np.full(len(points), np.nan)
    count = min(4, int(known.sum()))
    found = cKDTree(surface[known]).query(points, k=count)
    distance, index = (np.asarray(part).reshape(-1, count) for part in found)
    weight = 1 / np.maximum(distance, 1e-6)
    mean = (weight * values[known][index]).sum(axis=1) / weight.sum(axis=1)
    return np.where(distance[:, 0] <= reach, mean, np.nan)


def agreement(first: Float, second: Float) -> Agreement:
    """Compare two measures (N,), mm, where both are known; NaN with fewer than three places."""
    known = np.isfinite(first) & np.isfinite(second)
    a, b = first[known], second[known]
    few = len(a) < 3  # noqa: PLR2004 -- a line through two points is always perfect
    if few or not np.ptp(a) or not np.ptp(b):
        nan = float("nan")
        off = float((a - b).mean()) if len(a) else nan
        return Agreement(count=len(a), correlation=nan, slope=nan, difference=off, deviation=nan)
    covariance = np.cov(a, b)
    return Agreement(
        count=len(a),
        correlation=float(covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1])),
        slope=float(covariance[0, 1] / covariance[1, 1]),
        difference=float((a - b).mean()),
        deviation=float((a - b).std(ddof=1)),
    )
