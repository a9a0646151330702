"""Receiver operating characteristics: areas with DeLong intervals, and their difference."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class Area:
    """Area under a curve."""

    area: float
    """Chance that a case scores higher than a control, ties counted half."""
    se: float
    low: float
    """Confidence limits, clipped to 0..1."""
    high: float


@dataclass(frozen=True)
class AreaDifference:
    """Comparison of two scores of the same subjects."""

    difference: float
    """First minus second."""
    z: float
    p: float
    """Two-sided. Not valid between nested models fitted to these data: there the statistic is
    not normal (Demler et al. 2012); use the likelihood-ratio test."""


def delong(score: FloatArray, case: BoolArray, confidence: float) -> Area:
    """Area under the curve with its interval (DeLong, DeLong and Clarke-Pearson 1988).

    Parameters
    ----------
    score : ndarray, shape (subjects,)
        Higher for cases.
    case : ndarray of bool, shape (subjects,)
        Which subjects are cases; both kinds must occur.
    confidence : float
        Two-sided coverage of the normal interval.
    """
    areas, covariance = _components(np.atleast_2d(score), case)
    area, se = float(areas[0]), float(np.sqrt(covariance[0, 0]))
    reach = float(stats.norm.ppf((1 + confidence) / 2)) * se
    return Area(area, se, max(area - reach, 0.0), min(area + reach, 1.0))


def roc_curve(score: FloatArray, case: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Shares of controls and of cases at or above each score, from none to all.

    Parameters
    ----------
    score : ndarray, shape (subjects,)
        Higher for cases.
    case : ndarray of bool, shape (subjects,)
        Which subjects are cases; both kinds must occur.

    Returns
    -------
    ndarray, ndarray
        One minus specificity, and sensitivity, at each cut.
    """
    cuts = np.concatenate([[np.inf], np.unique(score)[::-1]])
    controls, cases = np.sort(score[~case]), np.sort(score[case])
    above = [1 - np.searchsorted(part, cuts) / len(part) for part in (controls, cases)]
    return above[0], above[1]


def area_under(score: FloatArray, case: BoolArray) -> float:
    """Chance that a case scores higher than a control, ties counted half (Mann and Whitney)."""
    cases = int(case.sum())
    ranks = float(stats.rankdata(score)[case].sum())
    return (ranks - cases * (cases + 1) / 2) / (cases * (len(case) - cases))


def delong_difference(first: FloatArray, second: FloatArray, case: BoolArray) -> AreaDifference:
    """Compare two areas of the same subjects (DeLong, DeLong and Clarke-Pearson 1988).

    Parameters
    ----------
    first, second : ndarray, shape (subjects,)
        Scores that were not fitted to these subjects by nested models.
    case : ndarray of bool, shape (subjects,)
        Which subjects are cases.
    """
    areas, covariance = _components(np.stack([first, second]), case)
    weights = np.array([1.0, -1.0])
    difference = float(weights @ areas)
    se = float(np.sqrt(weights @ covariance @ weights))
    z = difference / se if se > 0 else 0.0
    return AreaDifference(difference, z, float(2 * stats.norm.sf(abs(z))))


def _components(scores: FloatArray, case: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Areas and their covariance, from mid-ranks (Sun and Xu 2014)."""
    cases, controls = scores[:, case], scores[:, ~case]
    m, n = cases.shape[1], controls.shape[1]
    ranks = stats.rankdata(np.hstack([cases, controls]), axis=1)
    of_cases = (ranks[:, :m] - stats.rankdata(cases, axis=1)) / n
    of_controls = 1 - (ranks[:, m:] - stats.rankdata(controls, axis=1)) / m
    spread = np.atleast_2d(np.cov(of_cases)) / m + np.atleast_2d(np.cov(of_controls)) / n
    return of_cases.mean(axis=1), np.asarray(spread, dtype=np.float64)
