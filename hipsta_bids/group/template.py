"""What profiles have in common: a mean and principal components, by expectation-maximization."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from hipsta_bids.errors import ModelError
from hipsta_bids.group.settings import RegistrationSettings

# Cubic B-splines on the unit interval, clamped at its ends.


FloatArray = NDArray[np.float64]

_DEGREE = 3


def inner_knots(values: FloatArray, splines: int) -> FloatArray:
    """Knots at quantiles of the values, so many that there are ``splines`` functions."""
    shares = np.linspace(0.0, 1.0, splines - _DEGREE + 1)[1:-1]
    return np.asarray(np.quantile(values, shares), dtype=np.float64)


def make_basis(knots: FloatArray) -> BSpline[np.float64]:
    """All B-splines of the inner knots as one function, of shape (..., splines)."""
    ends = np.repeat([0.0, 1.0], _DEGREE + 1)
    padded = np.concatenate([ends[: _DEGREE + 1], knots, ends[_DEGREE + 1 :]])
    return BSpline(padded, np.eye(len(padded) - _DEGREE - 1), _DEGREE)


@dataclass(frozen=True)
class Template:
    """A mean profile and the directions in which single ones differ from it.

    Frozen, it takes in new subjects without changing those before.
    """

    knots: FloatArray
    """Inner knots on 0..1, medial to lateral."""
    mean: FloatArray
    """(splines,) coefficients, in units of ``scale``."""
    components: FloatArray
    """(splines, components), times scores of variance 1."""
    noise: float
    """Variance of what is left, in squares of ``scale``."""
    scale: float
    """Standard deviation of the profiles that made it, in their unit."""
    align: str
    """How it was made."""
    warp_variance: float
    """Of the logarithms of local stretch; infinite without a penalty."""
    turns: int
    """Turns of template and warps, which new subjects take as well."""
    center: FloatArray
    """(nodes,) mean warp of the subjects that made it, when they are registered to it as new ones
    are; warps are followed by its inverse."""

    def curves(self, at: FloatArray) -> FloatArray:
        """Mean profile at coordinates 0..1, in the profiles' unit."""
        return np.asarray(make_basis(self.knots)(at) @ self.mean, dtype=np.float64) * self.scale


@dataclass(frozen=True)
class _Moments:
    """What the steps need to know of the profiles at their registered coordinates."""

    basis: FloatArray
    """(subjects, nodes, splines)"""
    squares: FloatArray
    """(subjects, splines, splines)"""
    products: FloatArray
    """(subjects, splines)"""
    profiles: FloatArray

    @classmethod
    def collect(cls, profiles: FloatArray, warps: FloatArray, knots: FloatArray) -> "_Moments":
        basis = np.asarray(make_basis(knots)(warps), dtype=np.float64)
        squares = np.swapaxes(basis, 1, 2) @ basis
        products = np.einsum("sdk,sd->sk", basis, profiles)
        return cls(basis, squares, products, profiles)


@dataclass(frozen=True)
class _Scores:
    mean: FloatArray
    """(subjects, components)"""
    covariance: FloatArray
    """(subjects, components, components)"""
    squares: FloatArray
    """(subjects, components, components) of the components at the subject's nodes."""
    projection: FloatArray
    """(subjects, components)"""


def fit_template(
    profiles: FloatArray,
    warps: FloatArray,
    splines: int,
    components: int,
    settings: RegistrationSettings,
) -> tuple[Template, FloatArray]:
    """Estimate mean, components and noise of profiles at given warps.

    Probabilistic principal components with spline coefficients (Tipping and Bishop 1999; Wrobel
    et al. 2018), all subjects at once.
    """
    knots = inner_knots(warps, splines)
    moments = _Moments.collect(profiles, warps, knots)
    mean = np.linalg.solve(moments.squares.sum(axis=0), moments.products.sum(axis=0))
    parts = _start(moments, mean, components)
    noise = 1.0
    for _ in range(settings.em_iterations - 1):
        scores = _expect(moments, mean, parts, noise)
        new_mean, new_parts = _maximize(moments, scores)
        new_noise = _noise(moments, mean, scores)
        change = np.sum((new_parts - parts) ** 2) + np.sum((new_mean - mean) ** 2)
        change += (new_noise - noise) ** 2
        mean, parts, noise = new_mean, new_parts, new_noise
        if change < settings.em_tolerance:
            break
    grid = np.linspace(0.0, 1.0, warps.shape[1])
    template = Template(knots, mean, parts, noise, 1.0, "none", np.inf, 0, grid)
    return template, mean + scores.mean @ parts.T


def subject_curves(template: Template, profiles: FloatArray, warps: FloatArray) -> FloatArray:
    """Each subject's own template, given one that is not to change."""
    moments = _Moments.collect(profiles, warps, template.knots)
    scores = _expect(moments, template.mean, template.components, template.noise)
    return template.mean + scores.mean @ template.components.T


def _start(moments: _Moments, mean: FloatArray, components: int) -> FloatArray:
    """Principal components of the residuals on the grid.

    The steps end at the same place from other starts.
    """
    residuals = moments.profiles - moments.basis @ mean
    _, size, axes = np.linalg.svd(residuals, full_matrices=False)
    grid = moments.basis.mean(axis=0)
    parts = np.linalg.lstsq(grid, axes[:components].T, rcond=None)[0]
    return np.asarray(parts * size[:components] / np.sqrt(len(residuals)), dtype=np.float64)


def _expect(moments: _Moments, mean: FloatArray, parts: FloatArray, noise: float) -> _Scores:
    """Posterior of the scores."""
    squares = parts.T @ moments.squares @ parts
    covariance = np.linalg.inv(squares / noise + np.eye(parts.shape[1]))
    projection = (moments.products - moments.squares @ mean) @ parts
    scores = np.einsum("spq,sq->sp", covariance, projection) / noise
    return _Scores(scores, np.asarray(covariance, dtype=np.float64), squares, projection)


def _noise(moments: _Moments, mean: FloatArray, scores: _Scores) -> float:
    """Mean square, as expected, of what the subjects' templates leave."""
    total = float(np.sum((moments.profiles - moments.basis @ mean) ** 2))
    total -= 2 * float(np.sum(scores.mean * scores.projection))
    second = scores.covariance + scores.mean[:, :, None] * scores.mean[:, None, :]
    total += float(np.sum(scores.squares * second))
    return total / moments.profiles.size


def _maximize(moments: _Moments, scores: _Scores) -> tuple[FloatArray, FloatArray]:
    """Mean and components that fit the profiles best, given the scores' posterior."""
    subjects, components = scores.mean.shape
    first = np.column_stack([scores.mean, np.ones(subjects)])
    second = first[:, :, None] * first[:, None, :]
    second[:, :components, :components] += scores.covariance
    splines = moments.squares.shape[1]
    size = splines * (components + 1)
    system = np.einsum("sij,spq->ipjq", moments.squares, second, optimize=True)
    right = np.einsum("si,sp->ip", moments.products, first)
    found = np.linalg.solve(system.reshape(size, size), right.ravel()).reshape(splines, -1)
    return found[:, components], found[:, :components]


# Templates of registration as JSON objects, so that they can be kept and used again.


_ARRAYS = {"knots", "mean", "components", "center"}
#: JSON has no infinity; that of the penalty's variance is left out.
_INFINITE = "warp_variance"


def templates_to_json(templates: Mapping[str, Template]) -> dict[str, Any]:
    """Spell templates by hemisphere."""
    entries = {}
    for hemi, template in templates.items():
        entry = {
            name: value.tolist() if name in _ARRAYS else value
            for name, value in asdict(template).items()
        }
        if not np.isfinite(template.warp_variance):
            entry[_INFINITE] = None
        entries[hemi] = entry
    return {"Description": "template of curvature profiles along x", "Hemispheres": entries}


def templates_from_json(content: Mapping[str, Any], where: str) -> dict[str, Template]:
    """Read templates by hemisphere."""
    try:
        found = {}
        for hemi, entry in content["Hemispheres"].items():
            values = {field.name: entry[field.name] for field in fields(Template)}
            for name in _ARRAYS:
                values[name] = np.array(values[name], dtype=np.float64)
            if values[_INFINITE] is None:
                values[_INFINITE] = np.inf
            found[str(hemi)] = Template(**values)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ModelError(
            f"{where}: not a template ({type(error).__name__}: {error}); use the template.json of"
            " another analysis",
            reason="template-file",
        ) from error
    return found
