"""Level and power of robust alternatives to least squares, for docs/statistics.md.

    python benchmarks/robust_models.py      print the table (two minutes)

Two equal groups and a covariate; errors have SD 1. Huber's regression has the tuning constant
1.345, the scale of the median absolute residual, and the standard errors of Huber (1981, equation
6.5). Ranks are normal scores of residuals of the covariate (van der Waerden 1952).
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Float = NDArray[np.float64]
COHORTS = 20_000
EFFECTS = {20: 1.0, 40: 0.7}
_TUNING, _STEPS, _LEVEL = 1.345, 30, 0.05
_RARE = 0.1  # share of contaminated errors, of three times the SD


def draw_errors(kind: str, n: int, random: np.random.Generator) -> Float:
    """Draw errors (cohorts, participants) of SD 1; ``unequal`` has SD .5 and 1.32 by group."""
    shape = COHORTS, n
    if kind == "t, 3 df":
        return np.asarray(random.standard_t(3, shape) / np.sqrt(3))
    normal = random.standard_normal(shape)
    if kind == "contaminated":
        wide = np.where(random.random(shape) < _RARE, 3, 1)
        return np.asarray(normal * wide / np.sqrt(1 + 8 * _RARE))
    if kind == "lognormal":
        variance = 0.75**2
        spread = np.sqrt(np.expm1(variance) * np.exp(variance))
        return np.asarray((np.exp(0.75 * normal) - np.exp(variance / 2)) / spread)
    return normal * np.repeat([0.5, 1.32], n // 2) if kind == "unequal SD" else normal


def _p(estimate: Float, variance: Float, df: int) -> Float:
    return np.asarray(2 * stats.t.sf(np.abs(estimate) / np.sqrt(variance), df))


def least_squares(y: Float, design: Float) -> Float:
    """p-values of the second column."""
    n, columns = design.shape
    inverse = np.linalg.pinv(design)
    residual = y - y @ inverse.T @ design.T
    variance = (residual**2).sum(axis=1) / (n - columns) * (inverse[1] @ inverse[1])
    return _p(y @ inverse[1], variance, n - columns)


def hc3(y: Float, design: Float) -> Float:
    """p-values with unequal variances (MacKinnon and White 1985)."""
    n, columns = design.shape
    inverse = np.linalg.pinv(design)
    leverage = np.einsum("ij,ji->i", design, inverse)
    scaled = (y - y @ inverse.T @ design.T) / (1 - leverage)
    return _p(y @ inverse[1], scaled**2 @ inverse[1] ** 2, n - columns)


def normal_scores(y: Float, design: Float) -> Float:
    """p-values of least squares on normal scores of residuals of the covariate."""
    fixed = np.delete(design, 1, axis=1)
    residual = y - y @ np.linalg.pinv(fixed).T @ fixed.T
    ranks = stats.rankdata(residual, axis=1)
    return least_squares(stats.norm.ppf(ranks / (y.shape[1] + 1)), design)


def huber(y: Float, design: Float) -> Float:
    """p-values of Huber's regression."""
    n, columns = design.shape
    weight = np.ones_like(y)
    for _ in range(_STEPS):
        equations = np.einsum("ri,ij,ik->rjk", weight, design, design)
        scores = np.einsum("ri,ij->rj", weight * y, design)
        coefficients = np.linalg.solve(equations, scores[..., None])[..., 0]
        residual = y - coefficients @ design.T
        scale = np.median(np.abs(residual), axis=1, keepdims=True) / stats.norm.ppf(0.75)
        scale *= np.sqrt(n / (n - columns))
        distance = np.maximum(np.abs(residual) / scale, 1e-12)
        weight = np.minimum(1, _TUNING / distance)
    inner = distance <= _TUNING
    slope = inner.mean(axis=1)
    correction = 1 + columns / n * inner.var(axis=1) / slope**2
    squares = (np.clip(residual / scale, -_TUNING, _TUNING) ** 2).sum(axis=1) / (n - columns)
    unit = np.linalg.inv(design.T @ design)[1, 1]
    variance = correction**2 * squares / slope**2 * scale[:, 0] ** 2 * unit
    return _p(coefficients[:, 1], variance, n - columns)


TESTS: dict[str, Callable[[Float, Float], Float]] = {
    "least squares": least_squares,
    "HC3": hc3,
    "normal scores": normal_scores,
    "Huber": huber,
}


def main() -> None:
    """Print level, and power at equal level, in percent."""
    random = np.random.default_rng(20261128)
    print("| n | errors |", *(f"{name} |" for name in TESTS))
    print("|--:|---|", *("--:|" for _ in TESTS))
    for n, effect in EFFECTS.items():
        group = np.repeat([0.0, 1.0], n // 2)
        for kind in ("normal", "t, 3 df", "contaminated", "lognormal", "unequal SD"):
            age = random.standard_normal(n)
            design = np.column_stack([np.ones(n), group, age])
            null = draw_errors(kind, n, random) + 0.3 * age
            effects = draw_errors(kind, n, random) + 0.3 * age + effect * group
            cells = []
            for test in TESTS.values():
                p = test(null, design)
                power = np.mean(test(effects, design) < np.quantile(p, _LEVEL))
                cells.append(f"{100 * np.mean(p < _LEVEL):.1f}; {100 * power:.0f}")
            print(f"| {n} | {kind} |", *(f"{cell} |" for cell in cells))


if __name__ == "__main__":
    main()
