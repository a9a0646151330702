"""Monotone warps of the sheet along x: their fit to curves, and their use on maps."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.group.settings import RegistrationSettings
from hipsta_bids.group.template import inner_knots, make_basis

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Damping of the first step, its factor when a step fails or succeeds, and its limits.
_DAMPING, _FACTOR, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 5.0, 1e-9, 1e9

#: Subjects in memory at once; does not change a result.
_BLOCK = 2000


@dataclass(frozen=True)
class WarpBasis:
    """Monotone functions of 0..1 onto itself.

    A warp is a sum of B-splines whose coefficients start at 0, end at 1 and rise by the softmax
    of as many parameters as there are steps: monotone for any parameters.
    """

    at_nodes: FloatArray
    """(nodes, splines)"""
    identity: FloatArray
    """(steps,) logarithms of the increments of the identity."""

    @classmethod
    def make(cls, nodes: int, splines: int) -> "WarpBasis":
        """Splines with knots at quantiles of the grid."""
        grid = np.linspace(0.0, 1.0, nodes)
        at_nodes = np.asarray(make_basis(inner_knots(grid, splines))(grid), dtype=np.float64)
        coefficients = np.linalg.lstsq(at_nodes, grid, rcond=None)[0]
        return cls(at_nodes, np.log(np.diff(coefficients)))

    def evaluate(self, parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Warps (subjects, nodes) and their derivatives (subjects, nodes, steps)."""
        logs = self.identity + parameters
        steps = np.exp(logs - logs.max(axis=1, keepdims=True))
        steps /= steps.sum(axis=1, keepdims=True)
        sums = np.cumsum(steps, axis=1)
        warps = np.clip(sums @ self.at_nodes[:, 1:].T, 0.0, 1.0)
        lower = np.tril(np.ones((steps.shape[1], steps.shape[1])))
        slopes = lower * steps[:, None, :] - sums[:, :, None] * steps[:, None, :]
        return warps, self.at_nodes[:, 1:] @ slopes

    def lifted(self, parameters: FloatArray, least: float) -> FloatArray:
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


@dataclass(frozen=True)
class WarpFit:
    """Warps of all subjects."""

    parameters: FloatArray
    """(subjects, steps)"""
    warps: FloatArray
    """(subjects, nodes) registered coordinate of each node, 0..1."""
    uncertainty: FloatArray
    """(subjects,) mean posterior variance of the parameters, over the noise variance."""


@dataclass(frozen=True)
class _State:
    parameters: FloatArray
    warps: FloatArray
    slopes: FloatArray
    residuals: FloatArray
    loss: FloatArray


@dataclass(frozen=True)
class _Problem:
    """Fits of warps, whatever the subjects."""

    knots: FloatArray
    basis: WarpBasis
    penalty: float
    settings: RegistrationSettings

    def solve(
        self, profiles: FloatArray, coefficients: FloatArray, parameters: FloatArray
    ) -> WarpFit:
        """Damped Gauss-Newton steps; subjects that are done drop out."""
        best = self.basis.lifted(parameters, self.settings.least_stretch)
        # Adding a constant to all parameters changes nothing: keep their sum.
        level = np.full((parameters.shape[1], parameters.shape[1]), 1 / parameters.shape[1])
        active = np.arange(len(profiles))
        damping = np.full(len(profiles), _DAMPING)
        for _ in range(self.settings.warp_steps):
            curves = coefficients[active]
            now = self._state(best[active], profiles[active], curves)
            matrix, right = self._normal(now, curves)
            size = np.maximum(np.trace(matrix, axis1=1, axis2=2), _LEAST_DAMPING)
            ridge = size[:, None, None] * (level + damping[active, None, None] * np.eye(len(level)))
            step = np.linalg.solve(matrix + ridge, right[:, :, None])[:, :, 0]
            trial = self._state(now.parameters + step, profiles[active], curves)
            gained = now.loss - trial.loss
            better = gained > 0
            best[active[better]] = trial.parameters[better]
            eased = np.maximum(damping[active] / _FACTOR, _LEAST_DAMPING)
            damping[active] = np.where(better, eased, damping[active] * _FACTOR)
            done = better & (gained < self.settings.warp_tolerance * now.loss)
            active = active[~done & (damping[active] < _MOST_DAMPING)]
            if not len(active):
                break
        last = self._state(best, profiles, coefficients)
        matrix, _ = self._normal(last, coefficients)
        spread = np.linalg.pinv(matrix, hermitian=True)
        uncertainty = np.trace(spread, axis1=1, axis2=2) / matrix.shape[1]
        return WarpFit(best, last.warps, np.asarray(uncertainty, dtype=np.float64))

    def _state(
        self, parameters: FloatArray, profiles: FloatArray, coefficients: FloatArray
    ) -> _State:
        warps, slopes = self.basis.evaluate(parameters)
        expected = np.einsum("sdk,sk->sd", make_basis(self.knots)(warps), coefficients)
        residuals = profiles - expected
        loss = 0.5 * np.sum(residuals**2, axis=1)
        loss += 0.5 * self.penalty * np.sum(parameters**2, axis=1)
        return _State(parameters, warps, slopes, residuals, loss)

    def _normal(self, now: _State, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Matrix and right-hand side of a Gauss-Newton step."""
        slope = make_basis(self.knots).derivative()
        along = np.einsum("sdk,sk->sd", slope(now.warps), coefficients)
        jacobian = along[:, :, None] * now.slopes
        matrix = np.swapaxes(jacobian, 1, 2) @ jacobian
        right = np.einsum("sdi,sd->si", jacobian, now.residuals) - self.penalty * now.parameters
        return matrix + self.penalty * np.eye(matrix.shape[1]), right


def fit_warps(
    profiles: FloatArray,
    knots: FloatArray,
    coefficients: FloatArray,
    basis: WarpBasis,
    parameters: FloatArray,
    *,
    penalty: float,
    settings: RegistrationSettings,
) -> WarpFit:
    """Warp each profile onto its own curve, by damped Gauss-Newton steps for all at once.

    Minimizes half the sum of squared differences, plus half the penalty times the squared
    parameters (the logarithms of local stretch, in the mean).
    """
    problem = _Problem(knots, basis, penalty, settings)
    fits = [
        problem.solve(profiles[block], coefficients[block], parameters[block])
        for block in _blocks(len(profiles))
    ]
    return WarpFit(
        parameters=np.concatenate([fit.parameters for fit in fits]),
        warps=np.concatenate([fit.warps for fit in fits]),
        uncertainty=np.concatenate([fit.uncertainty for fit in fits]),
    )


def warp_values(maps: FloatArray, warps: FloatArray) -> FloatArray:
    """Carry maps of values to registered coordinates, linearly.

    ``maps`` NaN is missing, and makes missing what would need it.
    """
    carried = np.empty(maps.shape)
    for block in _blocks(len(maps)):
        left, weight = _sources(warps[block])
        rows = np.arange(len(left))[:, None]
        share = weight[:, :, None]
        own = maps[block]
        low, high = own[rows, left], own[rows, left + 1]
        mixed = (1 - share) * low + share * high
        carried[block] = np.where(share == 0, low, np.where(share == 1, high, mixed))
    return carried


def warp_labels(labels: IntArray, warps: FloatArray) -> IntArray:
    """Carry maps of labels to registered coordinates, from the nearest node."""
    left, weight = _sources(warps)
    rows = np.arange(len(labels))[:, None]
    return np.asarray(labels[rows, left + (weight >= 0.5)])  # noqa: PLR2004 -- nearest


def _sources(warps: FloatArray) -> tuple[IntArray, FloatArray]:
    """For each registered node the original node before it, and the way to the next, 0..1."""
    nodes = warps.shape[1]
    grid = np.linspace(0.0, 1.0, nodes)
    below = (warps[:, None, :] <= grid[None, :, None]).sum(axis=2)
    left = np.clip(below - 1, 0, nodes - 2)
    start = np.take_along_axis(warps, left, axis=1)
    gap = np.take_along_axis(warps, left + 1, axis=1) - start
    weight = np.where(gap > 0, (grid - start) / np.where(gap > 0, gap, 1.0), 0.0)
    return left, np.clip(weight, 0.0, 1.0)


def _blocks(subjects: int) -> list[slice]:
    """Subjects that are worked on together, to bound memory."""
    return [slice(start, start + _BLOCK) for start in range(0, max(subjects, 1), _BLOCK)]
