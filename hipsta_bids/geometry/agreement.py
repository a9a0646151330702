"""Values of a surface at points nearby, and agreement of two measures at the same points."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from hipsta_bids.types import Float


@dataclass(frozen=True, eq=False, kw_only=True)
class Agreement:
    """How well two measures of thickness at the same points agree."""

    count: int
    """Number of points at which both are known."""
    correlation: float
    """Pearson's correlation."""
    slope: float
    """Slope of the first on the second, by least squares."""
    difference: float
    """Mean of the first minus the second, mm."""
    deviation: float
    """Standard deviation of the difference, mm."""


def compare_nearby(points: Float, surface: Float, values: Float, reach: float) -> Float:
    """Interpolate values (M,) of surface points (M, 3) at points (N, 3) within ``reach`` mm.

    The result is NaN where no known value is near.
    """
    finite = np.isfinite(surface).all(axis=-1) & np.isfinite(values)
    if not finite.any():
        return np.full(len(points), np.nan)
    count = min(4, int(finite.sum()))
    neighbors = cKDTree(surface[finite]).query(points, k=count)
    distance, index = (np.asarray(part).reshape(-1, count) for part in neighbors)
    weight = 1 / np.maximum(distance, 1e-6)
    mean = (weight * values[finite][index]).sum(axis=1) / weight.sum(axis=1)
    return np.where(distance[:, 0] <= reach, mean, np.nan)


def agreement(first: Float, second: Float) -> Agreement:
    """Compare two measures (N,), mm, where both are known; NaN with fewer than three points."""
    finite = np.isfinite(first) & np.isfinite(second)
    a, b = first[finite], second[finite]
    difference = float((a - b).mean()) if len(a) else np.nan
    correlation = slope = deviation = np.nan
    # A line through two points is always perfect.
    if len(a) > 2 and np.ptp(a) and np.ptp(b):  # noqa: PLR2004
        covariance = np.cov(a, b)
        correlation = float(covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]))
        slope = float(covariance[0, 1] / covariance[1, 1])
        deviation = float((a - b).std(ddof=1))
    return Agreement(
        count=len(a),
        correlation=correlation,
        slope=slope,
        difference=difference,
        deviation=deviation,
    )
