"""Differences between two maps of a participant: sessions, and sides."""

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.errors import ModelError

FloatArray = NDArray[np.float64]


def paired_difference(
    first: FloatArray, second: FloatArray, years: FloatArray | None = None
) -> FloatArray:
    """Change from the first to the second session, to be tested by the linear model.

    Parameters
    ----------
    first, second : ndarray, shape (participants, points)
        NaN is missing.
    years : ndarray, shape (participants,), optional
        Time between the sessions; then the change is per year.

    Raises
    ------
    ModelError
        If a time is not positive; names the rows.
    """
    change: FloatArray = second - first
    if years is None:
        return change
    bad = np.flatnonzero(~(years > 0))
    if len(bad):
        raise ModelError(
            f"paired difference: rows {', '.join(map(str, bad[:8]))} have no positive time between"
            " their sessions; correct the dates or the order",
            reason="session-order",
        )
    return change / years[:, None]


def asymmetry(left: FloatArray, right: FloatArray, *, relative: bool) -> FloatArray:
    """Left minus right, on sheets whose axes mean the same on both sides.

    Parameters
    ----------
    left, right : ndarray
        Maps of the same shape.
    relative : bool
        Over the mean of both sides (for measures that are positive); else in the maps' unit.
    """
    difference: FloatArray = left - right
    if relative:
        mean = (left + right) / 2
        difference = difference / np.where(mean > 0, mean, np.nan)
    return difference
