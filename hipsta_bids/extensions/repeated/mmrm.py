"""Visits as categories: linear models whose visits have any covariance, at many points (MMRM).

The covariance S of a participant's visits is estimated by restricted likelihood, with its entries
as parameters. With M = S^-1 of the visits that a participant has, 0 elsewhere, X its columns and C
the covariance of the coefficients, all that is needed are sums over participants of products of
M, B = M X and the weighted residuals (Kenward and Roger 1997; SAS' ``PROC MIXED``, R's ``mmrm``).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from hipsta_bids.errors import ModelError
from hipsta_bids.stats import glm
from hipsta_bids.stats.arrays import Bool, Float, Int
from hipsta_bids.stats.contrasts import Contrast, split_name
from hipsta_bids.stats.design import VISIT, Design
from hipsta_bids.stats.mixed import RowsOfPeople, denominator
from hipsta_bids.stats.settings import GlmSettings, LongitudinalSettings
from hipsta_bids.types import PARTICIPANT

#: Most visits; V visits have V (V + 1) / 2 variances and covariances.
MOST_VISITS = 8

#: Most steps, and halvings of a step.
_STEPS, _HALVINGS = 50, 12
#: Expected fall of minus twice the likelihood by a step that needs no check, and by the last one.
_NEAR, _SETTLED = 1e-5, 1e-11
#: Smallest eigenvalue of the covariance over its mean: at the start, and of one that is none.
_START, _SINGULAR = 0.05, 1e-6
#: The likelihood bends less than this share of the most: a covariance is not known.
_BENT = 1e-7


@dataclass(frozen=True)
class _Data:
    """Values and columns of some points, zero where a visit is missing."""

    maps: Float
    """(points, participants, visits)"""
    present: Bool
    """(points, participants, visits)"""
    columns: Float
    """(points or 1, participants, visits, columns)"""

    def take(self, points: Int) -> "_Data":
        """Keep some points."""
        columns = self.columns if len(self.columns) == 1 else self.columns[points]
        return _Data(self.maps[points], self.present[points], columns)


@dataclass(frozen=True)
class _Fit:
    """Generalized least squares with one covariance of visits per point."""

    weights: Float
    """(points, participants, visits, visits) M."""
    columns: Float
    """(points, participants, visits, columns) B, in coordinates in which C is the identity."""
    root: Float
    """(points, columns, columns) R with C = R R'."""
    scores: Float
    """(points, columns)"""
    residuals: Float
    """(points, participants, visits) weighted by M."""
    loss: Float
    """(points,) minus twice the restricted likelihood, but for a constant."""


def fit_visits(
    maps: Float,
    matrix: Float,
    rows: tuple[NDArray[np.generic], Int],
    contrasts: Sequence[Contrast],
    settings: LongitudinalSettings,
    *,
    baseline: Float | None = None,
) -> glm.PointwiseFit:
    """Fit ``value = matrix @ coefficients + residual`` with any covariance between visits.

    ``rows`` are the participant of each row, and its visit as a number from 0. ``baseline`` (rows,
    points) is a covariate at each point with a coefficient for each visit, as difference from its
    mean over participants. Points at which the covariance cannot be estimated are NaN. Degrees of
    freedom and standard errors are as ``settings.freedom``.
    """
    participants, visits = rows
    n_visits = int(visits.max()) + 1
    if n_visits > MOST_VISITS:
        raise ModelError(
            f"visits as categories: {n_visits} visits have too many covariances; choose at most"
            f" {MOST_VISITS}, or use random slopes"
        )
    glm.check_design(maps, matrix, contrasts)
    people, numbers = np.unique(participants, return_inverse=True)
    basis, triangle = np.linalg.qr(matrix)
    inverse = np.linalg.inv(triangle)
    rotated = [contrast.weights @ inverse for contrast in contrasts]
    columns = np.zeros((1, len(people), n_visits, basis.shape[1]))
    columns[0, numbers, visits] = basis
    parts = []
    for points in glm.chunks(maps.shape, 2 * (basis.shape[1] + n_visits)):
        values = np.full((maps[:, points].shape[1], len(people), n_visits), np.nan)
        values[:, numbers, visits] = maps[:, points].T
        data = _Data(values, np.isfinite(values), columns)
        if baseline is not None:
            first = np.full(values.shape[:2], np.nan)
            first[:, numbers] = baseline[:, points].T
            data = _with_baseline(data, first)
        parts.append(_fit(replace(data, maps=np.nan_to_num(data.maps)), rotated, settings))
    whole = [np.concatenate(arrays, axis=-1) for arrays in zip(*parts, strict=True)]
    scores, sigma, n, *tested = whole
    tests = []
    for i, contrast in enumerate(contrasts):
        statistic, df, estimate, se = tested[4 * i : 4 * i + 4]
        values_of = {"df": df[0], "estimate": estimate, "se": se, "sigma": sigma[0]}
        confidence = settings.confidence
        tests.append(glm.with_effects(contrast, statistic[0], **values_of, confidence=confidence))
    coefficients = inverse @ scores[: len(inverse)]
    return glm.PointwiseFit(coefficients, sigma[0], n[0].astype(np.int64), tuple(tests))


def _with_baseline(data: _Data, first: Float) -> _Data:
    """Add columns of the first values (points, participants), one for each visit."""
    present = data.present & np.isfinite(first)[:, :, None]
    is_used = present.any(axis=2)
    count = np.maximum(is_used.sum(axis=1, keepdims=True), 1)
    mean = np.where(is_used, first, 0.0).sum(axis=1, keepdims=True) / count
    centered = np.where(is_used, first - mean, 0.0)
    scale = np.sqrt(np.sum(centered**2, axis=1, keepdims=True))
    centered /= np.where(scale > 0, scale, 1.0)
    n_visits = data.present.shape[2]
    shape = (len(first), *data.columns.shape[1:])
    extra = centered[:, :, None, None] * np.eye(n_visits)
    columns = np.concatenate([np.broadcast_to(data.columns, shape), extra], axis=3)
    return _Data(np.where(present, data.maps, np.nan), present, columns)


def _fit(data: _Data, rotated: Sequence[Float], settings: LongitudinalSettings) -> list[Float]:
    """Fit some points: scores, SD and rows, and of each contrast test, df, estimate and SE."""
    covariance, usable = _start(data)
    subset = data.take(np.flatnonzero(usable))
    covariance, hessian = _estimate(subset, covariance[usable])
    size = np.linalg.eigvalsh(hessian)
    good = size[:, 0] > _BENT * np.abs(size[:, -1])
    good &= _eigenvalue(covariance) > _SINGULAR
    usable[usable] = good
    subset, covariance, hessian = subset.take(np.flatnonzero(good)), covariance[good], hessian[good]
    fit = _solve(subset, covariance)
    variances = np.trace(covariance, axis1=1, axis2=2) / covariance.shape[1]
    results = [fit.scores.T, np.sqrt(variances)[None]]
    spread = 2 * np.linalg.inv(hessian)
    for rows in rotated:
        padded = np.pad(rows, ((0, 0), (0, fit.scores.shape[1] - rows.shape[1])))
        results += _test(fit, padded, spread, settings.freedom == "kenward-roger")

    def spaced(values: Float) -> Float:
        full = np.full((len(values), len(usable)), np.nan)
        full[:, usable] = values
        return full

    first, second, *tests = map(spaced, results)
    return [first, second, data.present.sum(axis=(1, 2))[None].astype(np.float64), *tests]


def _start(data: _Data) -> tuple[Float, Bool]:
    """Covariances of the residuals of least squares, and the points that can be fitted."""
    present = data.present.astype(np.float64)
    size = data.columns.shape[-1]
    wide = present[..., None] * data.columns
    columns = wide.reshape(len(present), wide.shape[1] * wide.shape[2], size)
    information = columns.swapaxes(1, 2) @ columns
    usable = np.linalg.eigvalsh(information)[:, 0] > glm.MIN_INFORMATION
    information[~usable] = np.eye(size)
    moments = columns.swapaxes(1, 2) @ data.maps.reshape(*columns.shape[:2], 1)
    fitted = columns @ np.linalg.solve(information, moments)
    left = data.maps - fitted.reshape(data.maps.shape)
    pairs = present.swapaxes(1, 2) @ present
    rows = present.sum(axis=(1, 2))
    usable &= (pairs > 1).all(axis=(1, 2)) & (rows > size)
    share = np.where(usable, rows / np.maximum(rows - size, 1), 1.0)[:, None, None]
    covariance = share * (left.swapaxes(1, 2) @ left) / np.maximum(pairs, 1)
    usable &= np.trace(covariance, axis1=1, axis2=2) > np.finfo(np.float64).eps * np.einsum(
        "pnv,pnv->p", data.maps, data.maps
    )
    covariance[~usable] = np.eye(present.shape[2])
    values, axes = np.linalg.eigh(covariance)
    values = np.maximum(values, _START * values.mean(axis=1, keepdims=True))
    return (axes * values[:, None]) @ axes.swapaxes(1, 2), usable


def _eigenvalue(covariance: Float) -> Float:
    """Smallest eigenvalue over the mean of all."""
    values = np.linalg.eigvalsh(covariance)
    return np.asarray(values[:, 0] / np.abs(values).mean(axis=1))


def _pairs(n_visits: int) -> Float:
    """(visits, visits, parameters) derivative of the covariance for each of its entries."""
    rows, columns = np.triu_indices(n_visits)
    result = np.zeros((n_visits, n_visits, len(rows)))
    result[rows, columns, np.arange(len(rows))] = 1.0
    result[columns, rows, np.arange(len(rows))] = 1.0
    return result


def _solve(data: _Data, covariance: Float) -> _Fit:
    """Fit by generalized least squares."""
    n_visits = covariance.shape[1]
    codes = data.present @ (1 << np.arange(n_visits))
    patterns, places = np.unique(codes, return_inverse=True)
    is_seen = (patterns[:, None] >> np.arange(n_visits)) & 1
    block = (is_seen[:, :, None] * is_seen[:, None, :]).astype(np.float64)
    filled = covariance[:, None] * block + np.eye(n_visits) * (1 - is_seen)[:, None, :]
    points = np.arange(len(codes))[:, None]
    places = places.reshape(codes.shape)
    weights = (np.linalg.inv(filled) * block)[points, places]
    logs = np.linalg.slogdet(filled)[1][points, places].sum(axis=1)
    weighted = weights @ data.columns
    size, rows = weighted.shape[-1], codes.shape[1] * n_visits
    flat = weighted.reshape(len(codes), rows, size)
    information = data.columns.reshape(-1, rows, size).swapaxes(1, 2) @ flat
    lower = np.linalg.cholesky((information + information.swapaxes(1, 2)) / 2)
    root = np.linalg.inv(lower).swapaxes(1, 2)
    values = data.maps.reshape(len(codes), rows, 1)
    scores = (root @ (root.swapaxes(1, 2) @ (flat.swapaxes(1, 2) @ values)))[:, :, 0]
    residuals = (weights @ data.maps[..., None])[..., 0]
    residuals -= (flat @ scores[:, :, None])[:, :, 0].reshape(residuals.shape)
    loss = logs + 2 * np.log(np.diagonal(lower, axis1=1, axis2=2)).sum(axis=1)
    # Residuals weighted once are at right angles to the columns, and need the values only.
    loss += np.einsum("pnv,pnv->p", residuals, data.maps)
    columns = (flat @ root).reshape(weighted.shape)
    return _Fit(weights, columns, root, scores, residuals, loss)


def _sums(left: Float, right: Float) -> Float:
    """Sum over participants: (points, a, b) of (points, participants, a) and (..., b)."""
    return np.asarray(left.swapaxes(1, 2) @ right)


def _products(left: Float, right: Float, entries: Float) -> Float:
    """Sum tr(left E_j right E_k) over participants: (points, parameters, parameters)."""
    count, people, n_visits = left.shape[:3]
    size = n_visits**2
    flat = (factors.reshape(count, people, size) for factors in (left, right))
    sums = _sums(*flat).reshape(count, *[n_visits] * 4)  # a, b, c, d
    turned = sums.transpose(0, 2, 3, 4, 1).reshape(count, size, size)
    pairs = entries.reshape(size, -1)
    return np.asarray(pairs.T @ turned @ pairs)


def _derivatives(fit: _Fit) -> tuple[Float, Float, Float]:
    """Gradient of the loss for the covariance, its Hessian, and the expectation of this."""
    n_visits = fit.weights.shape[2]
    entries = _pairs(n_visits)
    count, people, _, size = fit.columns.shape
    squares = fit.residuals[..., :, None] * fit.residuals[..., None, :]
    shares = fit.columns @ fit.columns.swapaxes(2, 3)
    gradient = np.tensordot((fit.weights - shares - squares).sum(axis=1), entries, 2)
    plain = _products(fit.weights, fit.weights, entries)
    by_columns = _products(shares, fit.weights, entries)
    flat = fit.columns.reshape(count, people, n_visits * size)
    moments = _sums(flat, flat).reshape(count, n_visits, size, n_visits, size)
    moments = np.einsum("paibj,abq->pqij", moments, entries, optimize=True)
    turned = moments.reshape(count, entries.shape[2], size**2)
    squared = turned @ turned.swapaxes(1, 2)
    crossed = _sums(flat, fit.residuals).reshape(count, n_visits, size, n_visits)
    crossed = np.einsum("paib,abq->pqi", crossed, entries, optimize=True)
    expected = plain - 2 * by_columns + squared
    hessian = 2 * by_columns + 2 * _products(squares, fit.weights, entries)
    hessian -= plain + squared + 2 * crossed @ crossed.swapaxes(1, 2)
    return gradient, hessian, expected


def _estimate(data: _Data, covariance: Float) -> tuple[Float, Float]:
    """Maximize the restricted likelihood: covariances, and Hessians of minus twice its logarithm.

    Newton's steps where these go down, else Fisher's, and halved until the likelihood rises. Where
    they do not settle, the Hessian is zero.
    """
    entries = _pairs(covariance.shape[1])
    active = np.arange(len(covariance))
    result = np.zeros((len(covariance), entries.shape[2], entries.shape[2]))
    fits = None
    for _ in range(_STEPS):
        part = data.take(active)
        fits = _solve(part, covariance[active])
        gradient, hessian, expected = _derivatives(fits)
        step, fall = _direction(gradient, hessian, expected)
        moves = np.tensordot(step, entries, axes=(1, 2))
        is_near = fall < _NEAR
        trial = covariance[active] + moves
        open_points = np.flatnonzero(~is_near | (_eigenvalue(trial) <= 0))
        length = np.ones(len(active))
        for _ in range(_HALVINGS):
            if not len(open_points):
                break
            trial = (
                covariance[active[open_points]]
                + length[open_points, None, None] * moves[open_points]
            )
            valid = _eigenvalue(trial) > _SINGULAR
            worse = np.ones(len(open_points), dtype=bool)
            tried = part.take(open_points[valid])
            worse[valid] = _solve(tried, trial[valid]).loss > fits.loss[open_points[valid]]
            length[open_points[worse]] /= 2
            open_points = open_points[worse]
        length[open_points] = 0.0  # a bound, or rounding
        covariance[active] += length[:, None, None] * moves
        is_settled = fall < _SETTLED
        result[active[is_settled]] = hessian[is_settled]
        active = active[~is_settled & (length > 0)]
        if not len(active):
            break
    return covariance, result


def _direction(gradient: Float, hessian: Float, expected: Float) -> tuple[Float, Float]:
    """Step to a smaller loss, and by how much it falls along it at first."""
    right = -gradient[:, :, None]
    size = np.linalg.eigvalsh(hessian)
    bent = size[:, 0] > _BENT * np.abs(size[:, -1])
    ridge = np.trace(expected, axis1=1, axis2=2) * np.finfo(np.float64).eps
    expected = expected + ridge[:, None, None] * np.eye(expected.shape[1])
    step = np.linalg.solve(np.where(bent[:, None, None], hessian, expected), right)[:, :, 0]
    return np.asarray(step, np.float64), np.asarray(-np.einsum("pq,pq->p", gradient, step))


def _test(fit: _Fit, rows: Float, spread: Float, is_adjusted: bool) -> list[Float]:
    """Test the rows of a contrast: t or F, df, and estimates and standard errors of the rows.

    ``spread`` is the covariance of the parameters. ``is_adjusted`` is for the covariance and F
    of Kenward and Roger (1997), else degrees of freedom are Satterthwaite's.
    """
    entries = _pairs(fit.weights.shape[2])
    count, people, n_visits, size = fit.columns.shape
    n_rows = len(rows)
    turned = fit.root.swapaxes(1, 2) @ rows.T  # (points, columns, rows)
    values, axes = np.linalg.eigh(turned.swapaxes(1, 2) @ turned)
    # Independent combinations of the rows, with variance 1.
    mixing = axes / np.sqrt(values)[:, None]
    estimate = fit.scores @ rows.T
    t = np.einsum("pr,prs->ps", estimate, mixing)
    se = np.sqrt(np.einsum("pir,pir->pr", turned, turned))
    parts = fit.columns @ (turned @ mixing)[:, None]
    flat = parts.reshape(count, people, n_visits * n_rows)
    outer = _sums(flat, flat).reshape(count, n_visits, n_rows, n_visits, n_rows)
    slopes = np.einsum("parbs,abq->pqrs", outer, entries, optimize=True)
    if not is_adjusted:
        squares = np.einsum("pqrr->prq", slopes)
        df = 2 / np.einsum("prq,pqk,prk->rp", squares, spread, squares, optimize=True)
        if n_rows == 1:
            return [estimate.T / se.T, df, estimate.T, se.T]
        return [np.mean(t**2, axis=1)[None], denominator(df)[None], estimate.T, se.T]
    columns = fit.columns.reshape(count, people, n_visits * size)
    crossed = _sums(columns, flat).reshape(count, n_visits, size, n_visits, n_rows)
    crossed = np.einsum("paibs,abq->pqis", crossed, entries, optimize=True)
    factors = np.einsum("pqk,pkis->pqis", spread, crossed, optimize=True)
    whole = np.einsum("abq,pqk,cdk->pabcd", entries, spread, entries, optimize=True)
    pairs = (flat[..., :, None] * flat[..., None, :]).reshape(count, people, flat.shape[2] ** 2)
    sums = _sums(pairs, fit.weights.reshape(count, people, n_visits**2))
    sums = sums.reshape(count, n_visits, n_rows, n_visits, n_rows, n_visits, n_visits)
    inner = np.einsum("pbrascd,pbcda->prs", sums, whole, optimize=True)
    excess = inner - np.einsum("pqir,pqis->prs", crossed, factors, optimize=True)
    adjusted = np.eye(n_rows) + excess + excess.swapaxes(1, 2)
    traces = np.einsum("pqrr->pq", slopes)
    first = np.einsum("pq,pqk,pk->p", traces, spread, traces, optimize=True)
    second = np.einsum("pqrs,pqk,pksr->p", slopes, spread, slopes, optimize=True)
    if n_rows == 1:
        se = se * np.sqrt(adjusted[:, 0])
        return [estimate.T / se.T, 2 / first[None], estimate.T, se.T]
    df, scale = _kenward_roger(first, second, n_rows)
    wald = np.einsum("pr,pr->p", t, np.linalg.solve(adjusted, t[:, :, None])[:, :, 0])
    return [(scale * wald / n_rows)[None], df[None], estimate.T, se.T]


def _kenward_roger(first: Float, second: Float, rows: int) -> tuple[Float, Float]:
    """Denominator's degrees of freedom and scale of F, from A1 and A2 of Kenward and Roger."""
    b = (first + 6 * second) / (2 * rows)
    g = ((rows + 1) * first - (rows + 4) * second) / ((rows + 2) * second)
    divisor = 3 * rows + 2 * (1 - g)
    c1, c2, c3 = g / divisor, (rows - g) / divisor, (rows + 2 - g) / divisor
    expected = 1 / (1 - second / rows)
    variance = 2 / rows * (1 + c1 * b) / ((1 - c2 * b) ** 2 * (1 - c3 * b))
    ratio = variance / (2 * expected**2)
    df: Float = np.asarray(4 + (rows + 2) / (rows * ratio - 1), dtype=np.float64)
    return df, df / (expected * (df - 2))


@dataclass(frozen=True, eq=False)
class VisitRows(RowsOfPeople):
    """A model of a design whose rows are visits of participants, as categories."""

    numbers: Int
    """(rows,) of each row's visit, from 0."""
    longitudinal: LongitudinalSettings

    def fit(
        self,
        values: Float,
        rows: Int,
        contrasts: tuple[Contrast, ...],
        covariates: Float | None = None,
    ) -> glm.PointwiseFit:
        """Fit some rows of the design at each point, perhaps with the baseline as covariate."""
        matrix, people, numbers = self.design.matrix, self.participants, self.numbers
        visits = people[rows], numbers[rows]
        baseline = None if covariates is None else covariates[0]
        return fit_visits(
            values, matrix[rows], visits, contrasts, self.longitudinal, baseline=baseline
        )


def visit_model(
    design: Design,
    table: pd.DataFrame,
    settings: GlmSettings,
    longitudinal: LongitudinalSettings,
    *,
    arms: str | None = None,
) -> VisitRows:
    """Assign rows to participants and visits; ``arms`` do not differ at the first visit."""
    if settings.covariance != "ordinary":
        raise ModelError(
            "visits as categories: the covariance is estimated; set glm.covariance to ordinary"
        )
    rows = table.iloc[design.rows]
    visits = pd.Categorical(rows[VISIT]).remove_unused_categories()
    numbers = np.asarray(visits.codes, dtype=np.int64)
    people = rows[PARTICIPANT].to_numpy(dtype=np.str_)
    if len(set(zip(people, numbers, strict=True))) < len(rows):
        raise ModelError("visits as categories: a participant has two sessions of one visit")
    if arms is not None:
        design = _equal_at_first(design, arms)
    return VisitRows(design, settings, people, numbers, longitudinal)


def _equal_at_first(design: Design, arms: str) -> Design:
    """Remove columns of arms at the first visit, which is the reference of visits."""
    names = [[atom.partition("[")[0] for atom in split_name(c)[0]] for c in design.columns]
    is_first = np.array([arms in atoms and VISIT not in atoms for atoms in names])
    if not any(arms in atoms and VISIT in atoms for atoms in names):
        raise ModelError(
            f"--endpoint clda: the formula needs {arms} * {VISIT}, so that arms differ later"
        )
    keep = ~is_first
    return replace(
        design,
        matrix=design.matrix[:, keep],
        columns=tuple(np.array(design.columns)[keep].tolist()),
        contrasts=tuple(
            c if c.weights.shape[1] == keep.sum() else replace(c, weights=c.weights[:, keep])
            for c in design.contrasts
        ),
    )
