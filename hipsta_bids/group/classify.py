"""How well measures tell two groups apart, beyond a base model: logistic models and their curves.

Logistic regression is by maximum likelihood (statsmodels), or by Firth's method where a model
separates the groups.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special, stats
from sklearn import metrics
from sklearn.model_selection import RepeatedStratifiedKFold
from statsmodels.discrete.discrete_model import Logit

from hipsta_bids.errors import ModelError
from hipsta_bids.group.data import Bool, Float, Int
from hipsta_bids.group.settings import ClassificationSettings

#: Largest sum of margins, per subject, that still counts as rounding of the linear program.
_NO_MARGIN = 1e-7
#: Most steps of Newton's method, which takes some eight, and the length of the last; columns have
#: a mean square of one.
_NEWTON_STEPS, _SETTLED = 25, 1e-8
#: Maximum likelihood has converged when coefficients of unit columns change by less.
_CONVERGED = 1e-10
#: Longest step of Firth's method, in standard deviations of a column, as in ``logistf``.
_LONGEST_STEP = 5.0
#: A step must gain at least this share of what the slope promises, or it is halved.
_SHARE = 0.1
#: Log likelihoods differ by rounding by no more than this, relatively.
_ROUNDING = 1e-12
#: Steps of Firth's method by the information, before those of Newton's method.
_FISHER_STEPS = 20
#: Step of derivatives, least curvature and flattest direction of Firth's method, where one is that
#: of the information.
_DIFFERENCE, _LEAST_BEND, _FLATTEST = 1e-4, 1e-3, 1e-12
#: Halvings of a step that does not gain.
_HALVINGS = 30
#: Directions of a training set with less than this share of the largest are no columns.
_RANK = 1e-9
#: Subjects in a group of the table of calibration, or there are fewer groups.
_LEAST_IN_BIN = 5


@dataclass(frozen=True)
class LogisticFit:
    """One logistic model."""

    coefficients: Float
    """Log odds per unit of each column."""
    se: Float
    """From the inverse of Fisher's information at the estimate."""
    log_likelihood: float
    """With Firth the penalized one: half the log determinant of the information comes on top."""
    firth: bool
    """Whether Firth's penalty was used."""


def is_separated(matrix: Float, case: Bool) -> bool:
    """Whether a combination of the columns tells the groups apart without overlap.

    Then maximum-likelihood estimates are infinite (Albert and Anderson 1984). Found exactly, by
    a linear program (Konis 2007): the largest sum of margins under which none is negative.
    """
    scale = np.abs(matrix).max(axis=0)
    margins = np.where(case, 1.0, -1.0)[:, None] * matrix / np.where(scale > 0, scale, 1.0)
    solution = optimize.linprog(
        -margins.sum(axis=0), A_ub=-margins, b_ub=np.zeros(len(margins)), bounds=(-1, 1)
    )
    return bool(margins.sum(axis=0) @ solution.x > _NO_MARGIN * len(margins))


def fit_logistic(
    matrix: Float,
    case: Bool,
    settings: ClassificationSettings,
    *,
    firth: bool,
    free: Bool | None = None,
) -> LogisticFit:
    """Fit a logistic regression by maximum likelihood, or by Firth's method.

    Of Firth's, columns that are not ``free`` stay zero but count in the penalty, as the penalized
    likelihood-ratio test needs it (Heinze and Schemper 2002).
    """
    if firth:
        return _fit_firth(matrix, case, settings, free)
    fit = _fit_maximum(matrix, case, settings)
    if fit is None:
        raise _no_convergence(settings.iterations)
    return fit


def fit_overlapping_or_firth(
    matrix: Float, case: Bool, settings: ClassificationSettings
) -> LogisticFit:
    """Fit by maximum likelihood if the groups overlap, else by Firth's method."""
    if not overlaps(matrix, case) and is_separated(matrix, case):
        return _fit_firth(matrix, case, settings)
    return fit_logistic(matrix, case, settings, firth=False)


def overlaps(matrix: Float, case: Bool) -> bool:
    """Whether maximum likelihood converges, which it does not if the groups are separated.

    Where it does not, :func:`is_separated` decides.
    """
    return bool(_maxima(_orthonormal(matrix), case, np.ones((1, len(case))))[1][0])


def _orthonormal(matrix: Float) -> Float:
    """Give an orthonormal basis of the columns, times the root of the number of rows."""
    basis, size, _ = np.linalg.svd(matrix / _scales(matrix), full_matrices=False)
    return np.asarray(basis[:, size > _RANK * size[0]] * np.sqrt(len(matrix)), dtype=np.float64)


def _maxima(basis: Float, case: Bool, kept: Float) -> tuple[Float, Bool]:
    """Maximize the likelihood in several sets of subjects at once, by Newton's method.

    ``kept`` is (sets, subjects), 1 for members. Gives coefficients (sets, columns), and in which
    sets the steps converged: with separated groups each step is about as long as the one before.
    """
    columns = basis.shape[1]
    products = (basis[:, :, None] * basis[:, None, :]).reshape(len(basis), -1)
    beta = np.zeros((len(kept), columns))
    settled = np.zeros(len(kept), dtype=bool)
    lost = np.zeros(len(kept), dtype=bool)
    for _ in range(_NEWTON_STEPS):
        chance = special.expit(beta @ basis.T)
        information = ((kept * chance * (1 - chance)) @ products).reshape(-1, columns, columns)
        size = np.linalg.eigvalsh(information)
        lost |= ~(size[:, 0] > _RANK * size[:, -1])
        information[lost] = np.eye(columns)
        score = (kept * (case - chance)) @ basis
        step = np.linalg.solve(information, score[:, :, None])[:, :, 0]
        beta[~lost] += step[~lost]
        settled = ~lost & (np.abs(step).max(axis=1) < _SETTLED)
        if (settled | lost).all():
            break
    return beta, settled


def _no_convergence(limit: int) -> ModelError:
    return ModelError(
        f"logistic model: no convergence in {limit} steps; the groups may be separated, or columns"
        " nearly the same",
        reason="logistic-convergence",
    )


def _scales(matrix: Float) -> Float:
    """Take standard deviations of columns, and the size of those that are constant."""
    spread = matrix.std(axis=0)
    size = np.maximum(np.abs(matrix).max(axis=0), 1e-300)
    return np.asarray(np.where(spread > 0, spread, size), dtype=np.float64)


def _fit_maximum(matrix: Float, case: Bool, settings: ClassificationSettings) -> LogisticFit | None:
    """Maximize the likelihood by statsmodels; None if that does not converge."""
    scale = _scales(matrix)
    model = Logit(case.astype(np.float64), matrix / scale, check_rank=False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of separation, which the caller looks for
        try:
            found = model.fit(
                method="newton",
                maxiter=settings.iterations,
                tol=_CONVERGED,
                disp=False,
                warn_convergence=False,
            )
        except np.linalg.LinAlgError:
            return None
    if not found.mle_retvals["converged"]:
        return None
    return LogisticFit(found.params / scale, found.bse / scale, float(found.llf), firth=False)


def _fit_firth(
    matrix: Float, case: Bool, settings: ClassificationSettings, free: Bool | None = None
) -> LogisticFit:
    """Penalize the likelihood by the root of the information's determinant (Firth 1993).

    This is Jeffreys' prior: estimates are finite under separation, and less biased.
    """
    scale = _scales(matrix)
    scaled = matrix / scale
    kept = np.ones(matrix.shape[1], dtype=bool) if free is None else free
    beta = np.zeros(matrix.shape[1])
    value = _penalized(scaled, case, beta)
    for number in range(settings.firth_iterations):
        bent = number >= _FISHER_STEPS
        step, promised = _firth_step(scaled, case, beta, kept, bent=bent)
        for halving in range(_HALVINGS):
            new = _penalized(scaled, case, beta + step)
            least = _SHARE * promised / 2**halving - _ROUNDING * (1 + abs(value))
            if new >= value + least:
                break
            step = step / 2
        beta, value = beta + step, new
        if promised < settings.tolerance:
            break
    else:
        raise _no_convergence(settings.firth_iterations)
    covariance = np.linalg.inv(_information(scaled, beta))
    return LogisticFit(
        coefficients=beta / scale,
        se=np.sqrt(np.diagonal(covariance)) / scale,
        # The penalty is that of the columns as given.
        log_likelihood=value + float(np.log(scale).sum()),
        firth=True,
    )


def _information(matrix: Float, beta: Float) -> Float:
    chance = special.expit(matrix @ beta)
    weighted: Float = matrix.T @ (matrix * (chance * (1 - chance))[:, None])
    return weighted


def _penalized(matrix: Float, case: Bool, beta: Float) -> float:
    """Penalized log likelihood."""
    margin = np.where(case, 1.0, -1.0) * (matrix @ beta)
    penalty = 0.5 * float(np.linalg.slogdet(_information(matrix, beta))[1])
    return float(special.log_expit(margin).sum()) + penalty


def _firth_step(
    matrix: Float, case: Bool, beta: Float, kept: Bool, *, bent: bool
) -> tuple[Float, float]:
    """Next step by the information, or by Newton's method, and the gain that the slope promises.

    The penalty bends as much as the likelihood where groups are far apart, so that steps by the
    information alone may take thousands. For Newton's, the slope is differentiated along directions
    in which the information is one.
    """
    size, axes = np.linalg.eigh(_information(matrix, beta)[np.ix_(kept, kept)])
    directions = np.zeros((len(beta), len(size)))
    directions[kept] = axes / np.sqrt(np.maximum(size, _FLATTEST * size[-1]))
    gradient = directions.T @ _firth_score(matrix, case, beta)
    if not bent:
        step = directions @ gradient
        share = min(1.0, _LONGEST_STEP / max(float(np.abs(step).max()), 1e-300))
        return step * share, float(gradient @ gradient) * share
    changes = [
        directions.T
        @ (
            _firth_score(matrix, case, beta + _DIFFERENCE * one)
            - _firth_score(matrix, case, beta - _DIFFERENCE * one)
        )
        for one in directions.T
    ]
    bend = -np.array(changes) / (2 * _DIFFERENCE)
    curvature, turned = np.linalg.eigh((bend + bend.T) / 2)
    along = (turned.T @ gradient) / np.maximum(np.abs(curvature), _LEAST_BEND)
    shortened = turned @ along
    step = directions @ shortened
    share = min(1.0, _LONGEST_STEP / max(float(np.abs(step).max()), 1e-300))
    return step * share, float(gradient @ shortened) * share


def _firth_score(matrix: Float, case: Bool, beta: Float) -> Float:
    """Slope of the penalized log likelihood."""
    chance = special.expit(matrix @ beta)
    information = _information(matrix, beta)
    leverage = np.sum(matrix @ np.linalg.pinv(information, hermitian=True) * matrix, axis=1)
    residual = case - chance + chance * (1 - chance) * leverage * (0.5 - chance)
    return np.asarray(matrix.T @ residual, dtype=np.float64)


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
    """Shares of controls and of cases at or above each score, from none to all."""
    wrong, right, _ = metrics.roc_curve(case, score, drop_intermediate=False)
    return wrong, right


@dataclass(frozen=True)
class CrossValidation:
    """Performance on subjects that were not fitted."""

    auc: float
    """Mean over folds and repeats."""
    auc_sd: float
    """Standard deviation of the repeats' means."""
    score: Float
    """(subjects,) log odds, mean over repeats."""
    folds: int


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

    fit: LogisticFit
    score: Float
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
    base: Float, added: Float, case: Bool, settings: ClassificationSettings
) -> ModelComparison:
    """Test whether measures add to a base model, and tell how well both classify.

    The likelihood-ratio test is the only test between the two. If a model separates the groups,
    both are fitted by Firth's method, and the test is that of the penalized likelihood (Heinze
    and Schemper 2002).
    """
    full = np.column_stack([base, added])
    _check(full, case)
    separated = not overlaps(full, case) and is_separated(full, case)
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
    matrix: Float, case: Bool, settings: ClassificationSettings, *, firth: bool
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


def _check(matrix: Float, case: Bool) -> None:
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


def cross_validate(matrix: Float, case: Bool, settings: ClassificationSettings) -> CrossValidation:
    """Area under the curve by repeated stratified cross-validation.

    In each training set separation is looked for, and answered by Firth's method.
    """
    return _cross_validated(matrix.tobytes(), matrix.shape[1], case.tobytes(), settings)


@lru_cache(maxsize=128)
def _cross_validated(
    values: bytes, columns: int, cases: bytes, settings: ClassificationSettings
) -> CrossValidation:
    """Keep results: the base model is the same for each measure that is added."""
    matrix, case = np.frombuffer(values).reshape(-1, columns), np.frombuffer(cases, dtype=bool)
    folds = min(settings.folds, int(case.sum()), int((~case).sum()))
    basis = _orthonormal(matrix)
    total, means = np.zeros(len(case)), []
    for fold_of in _folds(cases, folds, settings.repeats, settings.seed):
        train = fold_of != np.arange(folds)[:, None]
        beta, settled = _maxima(basis, case, train.astype(np.float64))
        score = np.einsum("sj,sj->s", basis, beta[fold_of])
        for fold in np.flatnonzero(~settled):
            test = ~train[fold]
            score[test] = _predict(matrix[~test], case[~test], matrix[test], settings)
        total += score
        means.append(np.mean([_area(score[~own & case], score[~own & ~case]) for own in train]))
    spread = float(np.std(means, ddof=1)) if settings.repeats > 1 else float("nan")
    return CrossValidation(float(np.mean(means)), spread, total / settings.repeats, folds)


@lru_cache(maxsize=16)
def _folds(cases: bytes, folds: int, repeats: int, seed: int) -> Int:
    """(repeats, subjects) fold of each subject, the same for all measures."""
    case = np.frombuffer(cases, dtype=bool)
    splits = RepeatedStratifiedKFold(n_splits=folds, n_repeats=repeats, random_state=seed)
    numbers = np.empty((repeats, len(case)), dtype=np.int64)
    for i, (_, test) in enumerate(splits.split(case, case)):
        numbers[i // folds, test] = i % folds
    return numbers


def _area(cases: Float, controls: Float) -> float:
    """Chance that a case scores higher than a control, ties counted half."""
    ordered = np.sort(controls)
    below = np.searchsorted(ordered, cases, "left") + np.searchsorted(ordered, cases, "right")
    return float(below.mean()) / (2 * len(controls))


def _predict(train: Float, case: Bool, test: Float, settings: ClassificationSettings) -> Float:
    """Log odds of new subjects; a level that the training set lacks has no effect."""
    scale = np.abs(train).max(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    _, size, axes = np.linalg.svd(train / scale, full_matrices=False)
    axes = axes[size > _RANK * size[0]].T
    fit = fit_overlapping_or_firth(train / scale @ axes, case, settings)
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
        slope = float(fit_overlapping_or_firth(line, case, settings).coefficients[1])
    count = min(settings.bins, max(len(score) // _LEAST_IN_BIN, 2))
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
    base: Float,
    added: Float,
    settings: ClassificationSettings,
    *,
    order: Sequence[str],
) -> list[PairComparison]:
    """Compare the two models in each pair of groups, on the same complete subjects."""
    if unknown := sorted(set(order) - set(groups.tolist())):
        raise ModelError(
            f"classification: no participant is in group {', '.join(unknown)}; known are"
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
