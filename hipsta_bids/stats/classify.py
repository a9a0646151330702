"""How well measures discriminate two groups, beyond a base model: classifiers and their curves."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special, stats
from sklearn import metrics
from sklearn.model_selection import RepeatedStratifiedKFold

from hipsta_bids.errors import ModelError
from hipsta_bids.stats import logistic
from hipsta_bids.stats.arrays import Bool, Float
from hipsta_bids.stats.settings import ClassificationSettings

#: Groups of equal size in the table of calibration.
CALIBRATION_BINS = 10

#: Points of a curve that are written and drawn.
_MOST_POINTS = 1001
#: Ends of the columns of areas.
_AREAS = ("", "_low", "_high", "_cv", "_cv_sd")
#: Members of training sets that are fitted at once; does not change a result.
_CHUNK = 100_000
#: Subjects in a group of the table of calibration, or there are fewer groups.
_LEAST_IN_BIN = 5


@dataclass(frozen=True)
class Area:
    """Area under a curve."""

    area: float
    """Chance that a case scores higher than a control, ties counted half."""
    se: float
    low: float
    """Confidence limits, clipped to 0..1."""
    high: float


def delong(score: Float, case: Bool, confidence: float) -> Area:
    """Area under the curve with its interval (DeLong, DeLong and Clarke-Pearson 1988).

    From mid-ranks (Sun and Xu 2014).
    """
    cases, controls = score[case], score[~case]
    ranks = stats.rankdata(np.concatenate([cases, controls]))
    of_cases = (ranks[: len(cases)] - stats.rankdata(cases)) / len(controls)
    of_controls = 1 - (ranks[len(cases) :] - stats.rankdata(controls)) / len(cases)
    area = float(of_cases.mean())
    se = float(np.sqrt(of_cases.var(ddof=1) / len(cases) + of_controls.var(ddof=1) / len(controls)))
    reach = float(stats.norm.ppf((1 + confidence) / 2)) * se
    return Area(area, se, max(area - reach, 0.0), min(area + reach, 1.0))


def roc_curve(score: Float, case: Bool) -> tuple[Float, Float]:
    """Shares of controls and of cases at or above each score, from none to all.

    Of more than a thousand scores, a thousand are taken.
    """
    wrong, right, _ = metrics.roc_curve(case, score, drop_intermediate=False)
    positions = (
        np.linspace(0, len(wrong) - 1, min(len(wrong), _MOST_POINTS)).round().astype(np.int64)
    )
    return wrong[positions], right[positions]


@dataclass(frozen=True)
class Calibration:
    """Whether predicted chances are right, on subjects that were not fitted."""

    intercept: float
    """Log odds by which cases are more frequent than predicted, given the slope of one; NaN where
    a group is too small to judge calibration, as the slope."""
    slope: float
    """Below one if predictions are too extreme (Cox 1958)."""
    brier: float
    """Mean squared error of the predicted chance."""
    predicted: Float
    """(bins,) mean predicted chance in groups of equal size; empty where a group is too small."""
    observed: Float
    """(bins,) share of cases in them."""

    @property
    def judged(self) -> bool:
        """Whether both groups are large enough."""
        return len(self.predicted) > 0


@dataclass(frozen=True)
class ClassifierResult:
    """One logistic model as a classifier."""

    fit: logistic.LogisticFit
    curve: tuple[Float, Float]
    """(points,) shares of controls and of cases at or above each of the fitted scores."""
    auc: Area
    """Of the subjects fitted: optimistic."""
    validated: tuple[float, float]
    """Area of subjects that were not fitted, and its SD over repeats of the cross-validation."""
    calibration: Calibration


@dataclass(frozen=True)
class ModelComparison:
    """A base model and the same with measures added, on the same subjects."""

    base: ClassifierResult
    full: ClassifierResult
    columns: Mapping[str, Any]
    """Of the table of classification; ``separated`` if either model separates the groups, where
    both are Firth's."""


def compare_models(
    base: Float,
    added: Float,
    case: Bool,
    settings: ClassificationSettings,
    *,
    n_incomplete: int = 0,
) -> ModelComparison:
    """Test whether measures add to a base model, and how well both classify complete subjects.

    The likelihood-ratio test is the only test between the two. If a model separates the groups,
    both are fitted by Firth's method, and the test is of the penalized likelihood (Heinze
    and Schemper 2002).
    """
    full = np.column_stack([base, added])
    _check(full, case)
    separated = not logistic.overlaps(full, case) and logistic.is_separated(full, case)
    free = np.arange(full.shape[1]) < base.shape[1]
    models = [
        _classified(matrix.tobytes(), matrix.shape[1], case.tobytes(), settings, firth=separated)
        for matrix in (full[:, free], full)
    ]
    fits = [model.fit for model in models]
    if separated:
        fits[0] = logistic.fit_logistic(full, case, firth=True, free=free)
    ratio = 2 * (fits[1].log_likelihood - fits[0].log_likelihood)
    df = int((~free).sum())
    calibration = models[1].calibration
    columns = {
        "n": len(case),
        "n_cases": int(case.sum()),
        "n_incomplete": n_incomplete,
        **_areas("base", models[0]),
        **_areas("full", models[1]),
        "calibration_intercept": calibration.intercept,
        "calibration_slope": calibration.slope,
        "brier": calibration.brier,
        "likelihood_ratio": ratio,
        "lr_df": df,
        "p": float(stats.chi2.sf(ratio, df)),
        "separated": separated,
    }
    return ModelComparison(base=models[0], full=models[1], columns=columns)


def _areas(name: str, result: ClassifierResult) -> dict[str, float]:
    values = result.auc.area, result.auc.low, result.auc.high, *result.validated
    return dict(zip((f"auc_{name}{end}" for end in _AREAS), values, strict=True))


@lru_cache(maxsize=32)
def _classified(
    values: bytes, columns: int, cases: bytes, settings: ClassificationSettings, *, firth: bool
) -> ClassifierResult:
    """Fit one model and describe how well it classifies; the base is the same for each measure."""
    matrix, case = np.frombuffer(values).reshape(-1, columns), np.frombuffer(cases, dtype=bool)
    fit = logistic.fit_logistic(matrix, case, firth=firth)
    score = matrix @ fit.coefficients
    area, spread, validated_score = cross_validate(matrix, case, settings)
    return ClassifierResult(
        fit=fit,
        curve=roc_curve(score, case),
        auc=delong(score, case, settings.confidence),
        validated=(area, spread),
        calibration=calibrate(validated_score, case, settings),
    )


def forget_models() -> None:
    """Free the memory of models that several comparisons share."""
    _classified.cache_clear()
    _folds.cache_clear()


def _check(matrix: Float, case: Bool) -> None:
    if not np.isfinite(matrix).all():
        raise ModelError("classification: values are missing; keep complete rows only")
    smaller = min(int(case.sum()), int((~case).sum()))
    if smaller < 2:  # noqa: PLR2004 -- said below
        raise ModelError(
            f"classification: the smaller group has {smaller} subjects; at least 2 are needed"
        )
    if np.linalg.matrix_rank(matrix / np.abs(matrix).max(axis=0).clip(1e-300)) < matrix.shape[1]:
        raise ModelError(
            f"classification: the {matrix.shape[1]} columns are not independent; remove one"
        )


def cross_validate(
    matrix: Float, case: Bool, settings: ClassificationSettings
) -> tuple[float, float, Float]:
    """Area under the curve by repeated stratified cross-validation.

    In each training set separation is looked for, and answered by Firth's method. Returns the mean
    over folds and repeats, the SD of the repeats' means, and log odds (subjects,), mean over these.
    """
    folds = min(settings.folds, int(case.sum()), int((~case).sum()))
    basis = logistic.orthonormal(matrix)
    total, means = np.zeros(len(case)), []
    fold_of = _folds(case.tobytes(), folds, settings.repeats, settings.seed)
    # What all subjects give is near what training sets do.
    coefficients_of_all, settled = logistic.maxima(basis, case, np.ones((1, len(case))))
    start = coefficients_of_all[0] if settled[0] else None
    parts = min(-(-fold_of.size * folds // _CHUNK), settings.repeats)
    for folds_here in np.array_split(fold_of, parts):
        train = folds_here[:, None] != np.arange(folds)[:, None]
        beta = _coefficients(basis, case, train.reshape(-1, len(case)), start)
        for fold_numbers, by_fold, coefficients in zip(
            folds_here, train, beta.reshape(len(folds_here), folds, -1), strict=True
        ):
            score = np.einsum("sj,sj->s", basis, coefficients[fold_numbers])
            for fold in np.flatnonzero(np.isnan(coefficients[:, 0])):
                test = ~by_fold[fold]
                score[test] = _predict(matrix[~test], case[~test], matrix[test])
            total += score
            areas = [_area(score[~is_test & case], score[~is_test & ~case]) for is_test in by_fold]
            means.append(np.mean(areas))
    spread = float(np.std(means, ddof=1)) if settings.repeats > 1 else float("nan")
    return float(np.mean(means)), spread, total / settings.repeats


def _coefficients(basis: Float, case: Bool, train: Bool, start: Float | None) -> Float:
    """Coefficients (sets, columns) of training sets (sets, subjects); NaN of those to look at."""
    weights = train.astype(np.float64)
    beta, settled = logistic.maxima(basis, case, weights, start)
    # Steps that do not end lead to where groups are apart, if they are.
    wild = np.flatnonzero(~settled)
    is_separated = ((beta[wild] @ basis.T > 0) == case) | ~train[wild]
    separated = wild[is_separated.all(axis=1)]
    beta[wild] = np.nan
    if len(separated):
        beta[separated] = logistic.firth_maxima(basis, case, weights[separated])[0]
    return beta


@lru_cache(maxsize=16)
def _folds(cases: bytes, folds: int, repeats: int, seed: int) -> NDArray[np.int16]:
    """(repeats, subjects) fold of each subject, the same for all measures."""
    case = np.frombuffer(cases, dtype=bool)
    splits = RepeatedStratifiedKFold(n_splits=folds, n_repeats=repeats, random_state=seed)
    numbers = np.empty((repeats, len(case)), dtype=np.int16)
    for i, (_, test) in enumerate(splits.split(case, case)):
        numbers[i // folds, test] = i % folds
    return numbers


def _area(cases: Float, controls: Float) -> float:
    """Chance that a case scores higher than a control, ties counted half."""
    cases, ordered = np.sort(cases), np.sort(controls)  # sorted ones are looked up faster
    below = np.searchsorted(ordered, cases, "left") + np.searchsorted(ordered, cases, "right")
    return float(below.mean()) / (2 * len(controls))


def _predict(train: Float, case: Bool, test: Float) -> Float:
    """Log odds of new subjects; a level that the training set lacks has no effect."""
    scale = np.abs(train).max(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    _, size, axes = np.linalg.svd(train / scale, full_matrices=False)
    axes = axes[size > logistic.RANK * size[0]].T
    fit = logistic.fit_overlapping_or_firth(train / scale @ axes, case)
    score: Float = test / scale @ axes @ fit.coefficients
    return score


def calibrate(score: Float, case: Bool, settings: ClassificationSettings) -> Calibration:
    """Compare predicted chances with what happened; the Brier score alone if groups are small."""
    chance = special.expit(score)
    brier = float(metrics.brier_score_loss(case, chance))
    if min(case.sum(), (~case).sum()) < settings.least_calibrated:
        return Calibration(np.nan, np.nan, brier, np.empty(0), np.empty(0))
    line = np.column_stack([np.ones(len(score)), score])
    slope = np.nan
    if np.ptp(score) > 0:
        slope = float(logistic.fit_overlapping_or_firth(line, case).coefficients[1])
    count = min(CALIBRATION_BINS, max(len(score) // _LEAST_IN_BIN, 2))
    bins = np.array_split(np.argsort(score, kind="stable"), count)
    return Calibration(
        intercept=_shift(score, case),
        slope=slope,
        brier=brier,
        predicted=np.array([chance[members].mean() for members in bins]),
        observed=np.array([case[members].mean() for members in bins]),
    )


def _shift(score: Float, case: Bool) -> float:
    """Log odds to add for the predicted number of cases to be right."""
    reach = float(np.abs(score).max()) + 2 * float(np.log(len(score))) + 1
    cases = float(case.sum())
    return float(
        optimize.brentq(lambda add: special.expit(score + add).sum() - cases, -reach, reach)
    )


def compare_pairs(
    groups: NDArray[np.str_],
    base: Float,
    added: Float,
    settings: ClassificationSettings,
    *,
    order: Sequence[str],
) -> dict[tuple[str, str], ModelComparison]:
    """Compare the two models in each pair of control and case, on the same complete subjects."""
    if unknown := sorted(set(order) - set(groups.tolist())):
        raise ModelError(
            f"classification: no participant is in group {', '.join(unknown)}; known are"
            f" {', '.join(sorted(set(groups.tolist())))}"
        )
    complete = np.isfinite(base).all(axis=1) & np.isfinite(added).all(axis=1)
    results = {}
    for control, case in combinations(order, 2):
        in_pair = (groups == control) | (groups == case)
        rows_used = in_pair & complete
        # Without their means, columns like years of birth are not nearly the constant.
        centered = [values[rows_used] - values[rows_used].mean(axis=0) for values in (base, added)]
        matrix = np.column_stack([np.ones(rows_used.sum()), centered[0]])
        try:
            results[control, case] = compare_models(
                matrix,
                centered[1],
                groups[rows_used] == case,
                settings,
                n_incomplete=int((in_pair & ~complete).sum()),
            )
        except ModelError as error:
            raise ModelError(f"{control} against {case}: {error}") from error
    return results
