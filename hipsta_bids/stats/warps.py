"""Monotone warps of the sheet along x, and the template of profiles that they are fitted to.

Warps are fitted to curves and applied to maps. A template is a mean profile and principal
components, estimated by expectation-maximization, and can be kept as JSON.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from hipsta_bids.stats.arrays import Float, Int, blocks

#: Most steps of expectation and maximization for the components.
EM_ITERATIONS = 50
#: They end when squared coefficients, of profiles over their SD, change by less than this.
EM_TOLERANCE = 1e-4
#: Most steps of a warp's fit.
WARP_STEPS = 60
#: A warp's fit ends when its loss falls by less than this fraction.
WARP_TOLERANCE = 1e-10
#: No increment of a warp's coefficients starts below this; sheet = 1.
LEAST_STRETCH = 0.02

#: Cubic B-splines on the unit interval, clamped at its ends.
DEGREE = 3
#: Damping of the first step, its factor when a step fails or succeeds, and its limits.
_DAMPING, _FACTOR, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 5.0, 1e-9, 1e9
#: Subjects in memory at once, of curves and of maps; does not change a result.
_BLOCK, _MAPS = 2000, 250


def inner_knots(values: Float, splines: int) -> Float:
    """Knots at quantiles of the values, for ``splines`` functions."""
    shares = np.linspace(0.0, 1.0, splines - DEGREE + 1)[1:-1]
    return np.asarray(np.quantile(values, shares), dtype=np.float64)


def make_basis(knots: Float) -> BSpline[np.float64]:
    """All B-splines of the inner knots as one function, of shape (..., splines)."""
    ends = np.repeat([0.0, 1.0], DEGREE + 1)
    padded = np.concatenate([ends[: DEGREE + 1], knots, ends[DEGREE + 1 :]])
    return BSpline(padded, np.eye(len(padded) - DEGREE - 1), DEGREE)


def _along(knots: Float, coefficients: Float, places: Float) -> tuple[Float, Float]:
    """Values and slopes (curves, places) of curves of coefficients (curves, splines).

    By the cubic of each interval, which takes a third of the time of all splines.
    """
    ends, basis = np.concatenate([[0.0], knots]), make_basis(knots)
    interval = np.searchsorted(knots, places, side="right")
    step = places - ends[interval]
    interval += np.arange(len(places))[:, None] * len(ends)
    zero, second, two, three = (
        (coefficients @ part(ends).T).take(interval)
        for part in (basis, *(basis.derivative(order) for order in (1, 2, 3)))
    )
    slope = second + step * (two + step * three / 2)
    return zero + step * (second + step * (two / 2 + step * three / 6)), slope


@dataclass(frozen=True)
class Template:
    """A mean profile and the directions in which single ones differ from it.

    Frozen, it takes in new subjects without changing earlier ones.
    """

    knots: Float
    """Inner knots on 0..1, medial to lateral."""
    mean: Float
    """(splines,) coefficients, in units of ``scale`` or of each profile's standard deviation."""
    components: Float
    """(splines, components), times scores of variance 1."""
    noise: float
    """Variance of what is left, in squares of the same."""
    scale: float | None
    """Standard deviation of the profiles that made it, in their unit; None where each profile
    was standardized by its mean and standard deviation."""
    turns: int
    """Iterations of template and warps, which new subjects take as well."""
    center: Float
    """(nodes,) mean warp of the subjects that made it, when they are registered to it as new ones
    are; warps are followed by its inverse."""


class _Moments:
    """What the steps need to know of the profiles at their registered coordinates.

    ``squares`` (subjects, splines, splines) of the splines there, their ``products`` with profiles
    (subjects, splines), the mean of the splines at each node, and the sum of squared profiles.
    """

    def __init__(self, profiles: Float, warps: Float, knots: Float) -> None:
        splines = make_basis(knots)
        size = splines.c.shape[1]
        self.squares, self.products = (
            np.empty((len(warps), size, size)),
            np.empty((len(warps), size)),
        )
        self.grid, self.power = np.zeros((warps.shape[1], size)), float(np.sum(profiles**2))
        for part in blocks(len(warps), _BLOCK):
            basis = splines(warps[part])
            self.squares[part] = np.swapaxes(basis, 1, 2) @ basis
            self.products[part] = np.einsum("sdk,sd->sk", basis, profiles[part])
            self.grid += basis.sum(axis=0)
        self.grid /= len(warps)


def fit_template(
    profiles: Float, warps: Float, splines: int, components: int
) -> tuple[Template, Float]:
    """Estimate mean, components and noise of profiles at given warps.

    Probabilistic principal components with spline coefficients (Tipping and Bishop 1999; Wrobel
    et al. 2018), all subjects at once.
    """
    knots = inner_knots(warps, splines)
    moments = _Moments(profiles, warps, knots)
    mean = np.linalg.solve(moments.squares.sum(axis=0), moments.products.sum(axis=0))
    expected = BSpline(make_basis(knots).t, mean, DEGREE)(warps)
    parts = _start(profiles - expected, moments.grid, components)
    noise = 1.0
    scores, *_ = _expect(moments, mean, parts, noise)  # the answer if there are no steps
    for _ in range(EM_ITERATIONS - 1):
        scores, covariance, new_noise = _expect(moments, mean, parts, noise)
        new_mean, new_parts = _maximize(moments, scores, covariance)
        change = np.sum((new_parts - parts) ** 2) + np.sum((new_mean - mean) ** 2)
        change += (new_noise - noise) ** 2
        mean, parts, noise = new_mean, new_parts, new_noise
        if change < EM_TOLERANCE:
            break
    grid = np.linspace(0.0, 1.0, warps.shape[1])
    template = Template(knots, mean, parts, noise, scale=1.0, turns=0, center=grid)
    return template, mean + scores @ parts.T


def subject_curves(template: Template, profiles: Float, warps: Float) -> Float:
    """Each subject's curve, by a template that does not change."""
    moments = _Moments(profiles, warps, template.knots)
    scores, *_ = _expect(moments, template.mean, template.components, template.noise)
    return template.mean + scores @ template.components.T


def _start(residuals: Float, grid: Float, components: int) -> Float:
    """Principal components of the residuals on the grid; the steps do not depend on the start."""
    _, size, axes = np.linalg.svd(residuals, full_matrices=False)
    parts = np.linalg.lstsq(grid, axes[:components].T, rcond=None)[0]
    return np.asarray(parts * size[:components] / np.sqrt(len(residuals)), dtype=np.float64)


def _expect(
    moments: _Moments, mean: Float, parts: Float, noise: float
) -> tuple[Float, Float, float]:
    """Mean (subjects, components) and covariance of the scores' posterior.

    Also the mean square, as expected, of what the subjects' templates leave.
    """
    squares = parts.T @ moments.squares @ parts
    covariance = np.linalg.inv(squares / noise + np.eye(parts.shape[1]))
    projection = (moments.products - moments.squares @ mean) @ parts
    scores = np.einsum("spq,sq->sp", covariance, projection) / noise
    total = moments.power - 2 * float(moments.products.sum(axis=0) @ mean)
    total += float(mean @ moments.squares.sum(axis=0) @ mean)
    total -= 2 * float(np.sum(scores * projection))
    second = covariance + scores[:, :, None] * scores[:, None, :]
    total += float(np.sum(squares * second))
    noise = total / (len(moments.products) * len(moments.grid))
    return scores, np.asarray(covariance, dtype=np.float64), noise


def _maximize(moments: _Moments, scores: Float, covariance: Float) -> tuple[Float, Float]:
    """Mean and components that fit the profiles best, given the scores' posterior."""
    subjects, components = scores.shape
    first = np.column_stack([scores, np.ones(subjects)])
    second = first[:, :, None] * first[:, None, :]
    second[:, :components, :components] += covariance
    splines = moments.squares.shape[1]
    size = splines * (components + 1)
    system = np.einsum("sij,spq->ipjq", moments.squares, second, optimize=True)
    right = np.einsum("si,sp->ip", moments.products, first)
    solution = np.linalg.solve(system.reshape(size, size), right.ravel()).reshape(splines, -1)
    return solution[:, components], solution[:, :components]


@dataclass(frozen=True)
class WarpBasis:
    """Monotone functions of 0..1 onto itself.

    A warp is a sum of B-splines whose coefficients start at 0, end at 1 and rise by the softmax
    of as many parameters as there are steps: monotone for any parameters.
    """

    at_nodes: Float
    """(nodes, splines)"""
    identity: Float
    """(steps,) logarithms of the increments of the identity."""

    @classmethod
    def make(cls, nodes: int, splines: int) -> "WarpBasis":
        """Splines with knots at quantiles of the grid."""
        grid = np.linspace(0.0, 1.0, nodes)
        at_nodes = np.asarray(make_basis(inner_knots(grid, splines))(grid), dtype=np.float64)
        coefficients = np.linalg.lstsq(at_nodes, grid, rcond=None)[0]
        return cls(at_nodes, np.log(np.diff(coefficients)))

    def evaluate(self, parameters: Float) -> tuple[Float, Float]:
        """Warps (subjects, nodes) and their derivatives (subjects, nodes, steps)."""
        logs = self.identity + parameters
        steps = np.exp(logs - logs.max(axis=1, keepdims=True))
        steps /= steps.sum(axis=1, keepdims=True)
        sums = np.cumsum(steps, axis=1)
        warps = np.clip(sums @ self.at_nodes[:, 1:].T, 0.0, 1.0)
        lower = np.tril(np.ones((steps.shape[1], steps.shape[1])))
        slopes = lower * steps[:, None, :] - sums[:, :, None] * steps[:, None, :]
        return warps, self.at_nodes[:, 1:] @ slopes

    def lifted(self, parameters: Float, least: float) -> Float:
        """Parameters whose increments are all at least ``least``.

        An increment of nearly zero has no slope, and could never grow again.
        """
        logs = self.identity + parameters
        steps = np.exp(logs - logs.max(axis=1, keepdims=True))
        steps /= steps.sum(axis=1, keepdims=True)
        steps = np.maximum(steps, least)
        lifted = np.log(steps) - self.identity
        lifted -= lifted.mean(axis=1, keepdims=True)
        return np.where((steps > least).all(axis=1)[:, None], parameters, lifted)


def fit_warps(
    profiles: Float, knots: Float, coefficients: Float, basis: WarpBasis, parameters: Float
) -> tuple[Float, Float]:
    """Warp each profile onto its curve, by damped Gauss-Newton steps for all at once.

    Minimizes the sum of squared differences, from ``parameters`` (subjects, steps) on. Returns
    parameters, and warps (subjects, nodes): registered coordinate of each node, 0..1.
    """
    fits = [
        _fit_block(profiles[block], knots, coefficients[block], basis, parameters[block])
        for block in blocks(len(profiles), _BLOCK)
    ]
    best, warps = zip(*fits, strict=True)
    return np.concatenate(best), np.concatenate(warps)


def _fit_block(
    profiles: Float, knots: Float, coefficients: Float, basis: WarpBasis, parameters: Float
) -> tuple[Float, Float]:
    """Fit warps of some subjects; those that are done drop out."""
    best = basis.lifted(parameters, LEAST_STRETCH)
    # Adding a constant to all parameters changes nothing: keep their sum.
    level = np.full((parameters.shape[1], parameters.shape[1]), 1 / parameters.shape[1])
    active = np.arange(len(profiles))
    damping = np.full(len(profiles), _DAMPING)
    for _ in range(WARP_STEPS):
        curves = coefficients[active]
        loss, residuals, jacobian = _evaluate(best[active], profiles[active], knots, curves, basis)
        matrix = np.swapaxes(jacobian, 1, 2) @ jacobian
        right = np.einsum("sdi,sd->si", jacobian, residuals)
        size = np.maximum(np.trace(matrix, axis1=1, axis2=2), _LEAST_DAMPING)
        ridge = size[:, None, None] * (level + damping[active, None, None] * np.eye(len(level)))
        step = np.linalg.solve(matrix + ridge, right[:, :, None])[:, :, 0]
        trial = best[active] + step
        gained = loss - _evaluate(trial, profiles[active], knots, curves, basis)[0]
        better = gained > 0
        best[active[better]] = trial[better]
        eased = np.maximum(damping[active] / _FACTOR, _LEAST_DAMPING)
        damping[active] = np.where(better, eased, damping[active] * _FACTOR)
        is_settled = better & (gained < WARP_TOLERANCE * loss)
        active = active[~is_settled & (damping[active] < _MOST_DAMPING)]
        if not len(active):
            break
    return best, basis.evaluate(best)[0]


def _evaluate(
    parameters: Float, profiles: Float, knots: Float, coefficients: Float, basis: WarpBasis
) -> tuple[Float, Float, Float]:
    """Loss (subjects,), residuals (subjects, nodes), and slopes (subjects, nodes, steps)."""
    warps, slopes = basis.evaluate(parameters)
    expected, along = _along(knots, coefficients, warps)
    residuals = profiles - expected
    return 0.5 * np.sum(residuals**2, axis=1), residuals, along[:, :, None] * slopes


def warp_values(maps: Float, warps: Float) -> Float:
    """Carry maps of values to registered coordinates, linearly; NaN where a value lacks."""
    carried = np.empty(maps.shape, np.result_type(maps, np.float32))
    for block in blocks(len(maps), _MAPS):
        left, weight = _sources(warps[block])
        rows = np.arange(len(left))[:, None]
        share = weight[:, :, None]
        values = maps[block]
        low, high = values[rows, left], values[rows, left + 1]
        mixed = (1 - share) * low + share * high
        carried[block] = np.where(share == 0, low, np.where(share == 1, high, mixed))
    return carried


def warp_labels(labels: NDArray[np.int8], warps: Float) -> NDArray[np.int8]:
    """Carry maps of labels to registered coordinates, from the nearest node."""
    carried = np.empty_like(labels)
    for block in blocks(len(labels), _MAPS):
        left, weight = _sources(warps[block])
        rows = np.arange(len(left))[:, None]
        carried[block] = labels[block][rows, left + (weight >= 0.5)]  # noqa: PLR2004 -- nearest
    return carried


def _sources(warps: Float) -> tuple[Int, Float]:
    """For each registered node the original node before it, and the way to the next, 0..1."""
    nodes = warps.shape[1]
    grid = np.linspace(0.0, 1.0, nodes)
    below = (warps[:, None, :] <= grid[None, :, None]).sum(axis=2)
    left = np.clip(below - 1, 0, nodes - 2)
    start = np.take_along_axis(warps, left, axis=1)
    gap = np.take_along_axis(warps, left + 1, axis=1) - start
    weight = np.where(gap > 0, (grid - start) / np.where(gap > 0, gap, 1.0), 0.0)
    return left, np.clip(weight, 0.0, 1.0)
