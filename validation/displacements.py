"""Ways to align sheets by curvature: the package's, and smooth displacements of the whole map."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import ndimage

from hipsta_bids.stats import registration, warps
from hipsta_bids.stats.settings import RegistrationSettings
from hipsta_bids.types import Bool, Float

STIFFNESS = 3.0
"""Weight of mean squared gradients of a displacement beside squared residuals (SD 1). Chosen of
1, 3, 10 and 30 by position errors in other simulated cohorts."""
LEAST_AREA = 0.25
"""No part of a sheet shrinks to less than this of its area."""
TURNS, STEPS, LAST_STEPS = 4, 4, 10
_RIDGE = 1e-6


@dataclass(frozen=True)
class Way:
    """B-splines along x and y of the displacement along each axis; None if there is none."""

    along_x: tuple[int, int] | None = None
    along_y: tuple[int, int] | None = None


#: The first two are those of the package.
WAYS: Mapping[str, Way] = {
    "none": Way(),
    "registr (default)": Way(),
    "map, along x": Way(along_x=(5, 1)),
    "map, along x by row": Way(along_x=(5, 8)),
    "map, two dimensions": Way(along_x=(5, 5), along_y=(5, 5)),
}
NONE, REGISTR, *_ = WAYS

_REGISTRATION = RegistrationSettings(min_subjects=2)


def sample(maps: Float, displacement: Float, order: Literal[0, 1] = 1) -> Float:
    """Return maps (n, x, y) at each node plus its displacement (n, 2, x, y), nodes."""
    sheets = np.broadcast_to(np.arange(len(maps))[:, None, None], maps.shape)
    moved = displacement + np.mgrid[: maps.shape[1], : maps.shape[2]]
    return np.asarray(
        ndimage.map_coordinates(
            maps, [sheets, moved[:, 0], moved[:, 1]], order=order, mode="nearest"
        )
    )


def _splines(nodes: int, count: int) -> Float:
    """Return B-splines at nodes, (nodes, count); one is constant."""
    if count == 1:
        return np.ones((nodes, 1))
    grid = np.linspace(0.0, 1.0, nodes)
    return np.asarray(warps.make_basis(warps.inner_knots(grid, count))(grid), dtype=np.float64)


def make_fields(way: Way, nodes: tuple[int, int]) -> Float:
    """Return displacements (k, 2, x, y) of one coefficient each; none crosses an edge."""
    parts = [np.zeros((0, 2, *nodes))]
    for axis, counts in enumerate((way.along_x, way.along_y)):
        if counts is not None:
            along = [_splines(*one) for one in zip(nodes, counts, strict=True)]
            along[axis] = along[axis][:, 1:-1]
            products = np.einsum("xi,yj->ijxy", *along).reshape(-1, *nodes)
            parts.append(np.zeros((len(products), 2, *nodes)))
            parts[-1][:, axis] = products
    return np.concatenate(parts)


def least_area(displacement: Float) -> Float:
    """Return the smallest determinant of the gradient of x + displacement, (n,)."""
    (xx, xy), (yx, yy) = (np.gradient(displacement[:, k], axis=(1, 2)) for k in (0, 1))
    areas = (1 + xx) * (1 + yy) - xy * yx
    return np.asarray(areas.min(axis=(1, 2)), dtype=np.float64)


def standardize(curvature: Float) -> Float:
    """Subtract the mean of each sheet, and divide by its standard deviation."""
    centered = curvature - curvature.mean(axis=(1, 2), keepdims=True)
    return np.asarray(centered / centered.std(axis=(1, 2), keepdims=True), dtype=np.float64)


class _Fitter:
    """Least squares of displaced maps about a template, with stiff displacements."""

    def __init__(self, maps: Float, way: Way) -> None:
        self.maps, self.fields = maps, make_fields(way, (maps.shape[1], maps.shape[2]))
        slopes = np.stack([np.gradient(self.fields, axis=axis) for axis in (2, 3)], axis=1)
        flat = slopes.reshape(len(self.fields), -1)
        self.penalty = STIFFNESS * (flat @ flat.T) / self.fields[0, 0].size

    def displacements(self, coefficients: Float) -> Float:
        return np.asarray(np.tensordot(coefficients, self.fields, axes=1), dtype=np.float64)

    def _judge(self, coefficients: Float, template: Float) -> tuple[Float, Float, Bool]:
        """Loss (n,), residuals (n, nodes), and which displacements keep the least area."""
        moved = self.displacements(coefficients)
        left = (template - sample(self.maps, moved)).reshape(len(self.maps), -1)
        stiff = np.einsum("nk,kl,nl->n", coefficients, self.penalty, coefficients)
        return (left**2).mean(axis=1) + stiff, left, least_area(moved) > LEAST_AREA

    def fit(self, coefficients: Float, template: Float, steps: int) -> Float:
        """Improve coefficients by Gauss-Newton steps with the slopes of the template."""
        slopes = np.stack([np.gradient(template, axis=axis) for axis in (0, 1)])
        jacobian = (self.fields * slopes).sum(axis=1).reshape(len(self.fields), -1)
        jacobian /= np.sqrt(template.size)
        matrix = jacobian @ jacobian.T + self.penalty
        matrix += _RIDGE * np.trace(matrix) * np.eye(len(matrix))
        loss, left, _ = self._judge(coefficients, template)
        length = np.ones(len(self.maps))
        for _ in range(steps):
            right = left @ jacobian.T / np.sqrt(template.size) - coefficients @ self.penalty
            trial = coefficients + length[:, None] * np.linalg.solve(matrix, right.T).T
            new_loss, new_left, allowed = self._judge(trial, template)
            better = (new_loss < loss) & allowed
            coefficients = np.where(better[:, None], trial, coefficients)
            left = np.where(better[:, None], new_left, left)
            loss = np.where(better, new_loss, loss)
            length = np.where(better, np.minimum(2 * length, 1.0), length / 2)
        return coefficients


def align(curvature: Float, title: str, others: Float | None = None) -> tuple[Float, Float]:
    """Align sheets to each other, and others to their template: displacements of both, nodes.

    A map at a node plus its displacement belongs to that node of the template.
    """
    others = curvature[:0] if others is None else others
    if title == NONE:
        still = (np.zeros((len(maps), 2, *maps.shape[1:])) for maps in (curvature, others))
        return next(still), next(still)
    if title == REGISTR:
        return _align_profiles(curvature, others)
    fitter = _Fitter(standardize(curvature), WAYS[title])
    coefficients = np.zeros((len(curvature), len(fitter.fields)))
    template = fitter.maps.mean(axis=0)
    for turn in range(TURNS):
        steps = STEPS if turn < TURNS - 1 else LAST_STEPS
        coefficients = fitter.fit(coefficients, template, steps)
        coefficients -= coefficients.mean(axis=0)
        template = sample(fitter.maps, fitter.displacements(coefficients)).mean(axis=0)
    rest = _Fitter(standardize(others), WAYS[title])
    fitted = np.zeros((len(others), len(fitter.fields)))
    if len(others):
        fitted = rest.fit(fitted, template, TURNS * STEPS + LAST_STEPS)
    return fitter.displacements(coefficients), rest.displacements(fitted)


def _align_profiles(curvature: Float, others: Float) -> tuple[Float, Float]:
    """Align by the package: warps of mean profiles, inverted."""
    result = registration.register(
        registration.mean_profiles(curvature, _REGISTRATION), _REGISTRATION
    )
    moved = [result.warps]
    if len(others) and result.template is not None:
        profiles = registration.mean_profiles(others, _REGISTRATION)
        moved.append(registration.register_to(profiles, result.template, _REGISTRATION).warps)
    else:
        moved.append(result.warps[:0])
    first, second = (_inverted(one, curvature.shape[2]) for one in moved)
    return first, second


def _inverted(warped: Float, rows: int) -> Float:
    """Return displacements of registered nodes, of warps (n, nodes)."""
    nodes = warped.shape[1]
    grid = np.linspace(0.0, 1.0, nodes)
    places = np.array([np.interp(grid, one, grid) for one in warped]).reshape(len(warped), nodes)
    displacement = np.zeros((len(warped), 2, nodes, rows))
    displacement[:, 0] = ((places - grid) * (nodes - 1))[:, :, None]
    return displacement
