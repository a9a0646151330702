"""How well measures tell two groups apart, beyond a base model."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special, stats
from sklearn.model_selection import RepeatedStratifiedKFold

from hipsta_bids.errors import ModelError
from hipsta_bids.group.logistic import LogisticFit, fit_logistic, is_separated
from hipsta_bids.group.settings import ClassificationSettings

# Receiver operating characteristics: areas with DeLong intervals, and their difference.


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
    """Area under the curve with its interval (DeLong, DeLong and Clarke-Pearson 1988)."""
    areas, covariance = _components(np.atleast_2d(score), case)
    area, se = float(areas[0]), float(np.sqrt(covariance[0, 0]))
    reach = float(stats.norm.ppf((1 + confidence) / 2)) * se
    return Area(area, se, max(area - reach, 0.0), min(area + reach, 1.0))


def roc_curve(score: FloatArray, case: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Shares of controls and of cases at or above each score, from none to all."""
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
    """Compare two areas of the same subjects (DeLong, DeLong and Clarke-Pearson 1988)."""
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


#: Directions of a training set with less than this share of the largest are no columns.
_RANK = 1e-9
#: Subjects in a group of the table of calibration, or there are fewer groups.
_LEAST_IN_BIN = 5


@dataclass(frozen=True)
class CrossValidation:
    """Performance on subjects that were not fitted."""

    auc: float
    """Mean over folds and repeats."""
    auc_sd: float
    """Standard deviation of the repeats' means."""
    score: FloatArray
    """(subjects,) log odds, mean over repeats."""
    folds: int


@dataclass(frozen=True)
class Calibration:
    """Whether predicted chances are right, on subjects that were not fitted."""

    intercept: float
    """Log odds by which cases are more frequent than predicted, given the slope of one."""
    slope: float
    """Below one if predictions are too extreme (Cox 1958)."""
    brier: float
    """Mean squared error of the predicted chance."""
    predicted: FloatArray
    """(bins,) mean predicted chance in groups of equal size."""
    observed: FloatArray
    """(bins,) share of cases in them."""


@dataclass(frozen=True)
class ClassifierResult:
    """One logistic model as a classifier."""

    fit: LogisticFit
    score: FloatArray
    """(subjects,) fitted log odds."""
    auc: Area
    """Of the subjects fitted: optimistic."""
    cross_validation: CrossValidation
    calibration: Calibration


@dataclass(frozen=True)
class ModelComparison:
    """A base model and the same with measures added, on the same subjects."""

    base: ClassifierResult
    full: ClassifierResult
    separated: bool
    """Whether either model separates the groups; then both are Firth's."""
    likelihood_ratio: float
    df: int
    p: float
    n: int
    n_cases: int


def compare_models(
    base: FloatArray, added: FloatArray, case: BoolArray, settings: ClassificationSettings
) -> ModelComparison:
    """Test whether measures add to a base model, and tell how well both classify.

    The likelihood-ratio test is the only test between the two. If a model separates the groups,
    both are fitted by Firth's method, and the test is that of the penalized likelihood (Heinze
    and Schemper 2002).
    """
    full = np.column_stack([base, added])
    _check(full, case)
    separated = is_separated(full, case)
    whole = fit_logistic(full, case, settings, firth=separated)
    free = np.arange(full.shape[1]) < base.shape[1]
    if separated:
        nested = fit_logistic(full, case, settings, firth=True, free=free)
    else:
        nested = fit_logistic(base, case, settings, firth=False)
    ratio = 2 * (whole.log_likelihood - nested.log_likelihood)
    df = int((~free).sum())
    return ModelComparison(
        base=classify(base, case, settings, firth=separated),
        full=classify(full, case, settings, firth=separated),
        separated=separated,
        likelihood_ratio=ratio,
        df=df,
        p=float(stats.chi2.sf(ratio, df)),
        n=len(case),
        n_cases=int(case.sum()),
    )


def classify(
    matrix: FloatArray, case: BoolArray, settings: ClassificationSettings, *, firth: bool
) -> ClassifierResult:
    """Fit one model and tell how well it classifies; see :func:`compare_models`."""
    _check(matrix, case)
    fit = fit_logistic(matrix, case, settings, firth=firth)
    score = matrix @ fit.coefficients
    validation = cross_validate(matrix, case, settings)
    return ClassifierResult(
        fit=fit,
        score=score,
        auc=delong(score, case, settings.confidence),
        cross_validation=validation,
        calibration=calibrate(validation.score, case, settings),
    )


def _check(matrix: FloatArray, case: BoolArray) -> None:
    if not np.isfinite(matrix).all():
        raise ModelError(
            "classification: values are missing; keep complete rows only", reason="design-missing"
        )
    smaller = min(int(case.sum()), int((~case).sum()))
    if smaller < 2:  # noqa: PLR2004 -- said below
        raise ModelError(
            f"classification: the smaller group has {smaller} subjects; at least 2 are needed",
            reason="group-size",
        )
    if np.linalg.matrix_rank(matrix / np.abs(matrix).max(axis=0).clip(1e-300)) < matrix.shape[1]:
        raise ModelError(
            f"classification: the {matrix.shape[1]} columns are not independent; leave one out",
            reason="design-rank",
        )


def cross_validate(
    matrix: FloatArray, case: BoolArray, settings: ClassificationSettings
) -> CrossValidation:
    """Area under the curve by repeated stratified cross-validation.

    Separation is looked for, and answered by Firth's method, in each training set anew.
    """
    folds = min(settings.folds, int(case.sum()), int((~case).sum()))
    splits = RepeatedStratifiedKFold(
        n_splits=folds, n_repeats=settings.repeats, random_state=settings.seed
    )
    total, areas = np.zeros(len(case)), []
    for train, test in splits.split(matrix, case):
        score = _predict(matrix[train], case[train], matrix[test], settings)
        total[test] += score
        areas.append(area_under(score, case[test]))
    means = np.reshape(areas, (settings.repeats, folds)).mean(axis=1)
    spread = float(means.std(ddof=1)) if settings.repeats > 1 else float("nan")
    return CrossValidation(float(means.mean()), spread, total / settings.repeats, folds)


def _predict(
    train: FloatArray, case: BoolArray, test: FloatArray, settings: ClassificationSettings
) -> FloatArray:
    """Log odds of new subjects; a level that the training set lacks has no say."""
    scale = np.abs(train).max(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    _, size, axes = np.linalg.svd(train / scale, full_matrices=False)
    axes = axes[size > _RANK * size[0]].T
    known = train / scale @ axes
    fit = fit_logistic(known, case, settings, firth=is_separated(known, case))
    score: FloatArray = test / scale @ axes @ fit.coefficients
    return score


def calibrate(score: FloatArray, case: BoolArray, settings: ClassificationSettings) -> Calibration:
    """Compare predicted chances with what happened."""
    line = np.column_stack([np.ones(len(score)), score])
    slope = np.nan
    if np.ptp(score) > 0:
        apart = is_separated(line, case)
        slope = float(fit_logistic(line, case, settings, firth=apart).coefficients[1])
    chance = special.expit(score)
    count = min(settings.bins, max(len(score) // _LEAST_IN_BIN, 2))
    bins = np.array_split(np.argsort(score, kind="stable"), count)
    return Calibration(
        intercept=_shift(score, case),
        slope=slope,
        brier=float(np.mean((chance - case) ** 2)),
        predicted=np.array([chance[members].mean() for members in bins]),
        observed=np.array([case[members].mean() for members in bins]),
    )


def _shift(score: FloatArray, case: BoolArray) -> float:
    """Log odds to add for the predicted number of cases to be right."""
    reach = float(np.abs(score).max()) + 2 * float(np.log(len(score))) + 1
    cases = float(case.sum())
    return float(
        optimize.brentq(lambda add: special.expit(score + add).sum() - cases, -reach, reach)
    )


# Classification of each pair of groups, as in the paper's tables.


@dataclass(frozen=True)
class PairComparison:
    """Two groups told apart by a base model, and by one with measures added."""

    control: str
    case: str
    comparison: ModelComparison
    is_case: NDArray[np.bool_]
    """(subjects,) in the order of the models' scores."""
    n_incomplete: int
    """Subjects of the two groups left out of both models, as they lack a value."""


def compare_pairs(
    groups: NDArray[np.str_],
    base: FloatArray,
    added: FloatArray,
    settings: ClassificationSettings,
    *,
    order: Sequence[str],
) -> list[PairComparison]:
    """Compare the two models in each pair of groups, on the same complete subjects.

    ``base`` NaN is missing.
    """
    if unknown := sorted(set(order) - set(groups.tolist())):
        raise ModelError(
            f"classification: nobody is in group {', '.join(unknown)}; known are"
            f" {', '.join(sorted(set(groups.tolist())))}",
            reason="unknown-level",
        )
    complete = np.isfinite(base).all(axis=1) & np.isfinite(added).all(axis=1)
    results = []
    for control, case in combinations(order, 2):
        both = (groups == control) | (groups == case)
        used = both & complete
        matrix = np.column_stack([np.ones(used.sum()), base[used]])
        try:
            found = compare_models(matrix, added[used], groups[used] == case, settings)
        except ModelError as error:
            raise ModelError(f"{control} against {case}: {error}", reason=error.reason) from error
        results.append(
            PairComparison(
                control=control,
                case=case,
                comparison=found,
                is_case=groups[used] == case,
                n_incomplete=int((both & ~complete).sum()),
            )
        )
    return results
