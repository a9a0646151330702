"""Norms: centiles of measures by age, sex and site, and how they move to a new site.

The mean is a natural cubic spline of age with constants for sex and site; the logarithm of the SD
is linear in age with a constant for each site; and where values are not normal, they are so after
the sinh-arcsinh transformation of Jones and Pewsey (2009, doi:10.1093/biomet/asp053), which bends
and stretches the distribution and leaves its mean and SD. All points are fitted at once.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import special

from hipsta_bids.errors import ModelError
from hipsta_bids.extensions.norms.settings import NormSettings
from hipsta_bids.extensions.norms.wscores import tail_probability
from hipsta_bids.stats.arrays import Bool, Float, Int
from hipsta_bids.stats.glm import chunks
from hipsta_bids.stats.solve import solve_weighted

#: Values at a point are transformed if a likelihood-ratio test rejects the normal distribution
#: at this level.
SHAPE_LEVEL = 0.05
#: Folds of the cross-validation of centiles.
CENTILE_FOLDS = 5

#: Probabilities of the centiles that tables and charts show.
LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)
NORM_ARRAYS = ("mean", "spread", "shape", "shift", "scale", "n")
#: Steps of the fits, and changes that end them: of logarithms of the SD, and of the log likelihood.
_STEPS, _SMALLEST, _SHAPE_STEPS, _GAIN = 50, 1e-4, 30, 1e-4
_LARGEST_STEP = 1.0  # of the logarithm of the SD
_FARTHEST = np.array([4.0, 1.2])  # skewness and logarithm of tail weight
_DIFFERENCE = 1e-5
_LEAST_INFORMATION = 1e-8


@dataclass(frozen=True, eq=False, kw_only=True)
class People:
    """What norms know about visits."""

    age: Float
    """(visits,) years; NaN where unknown or out of range."""
    sex: Float
    """(visits, levels - 1) 1 where the visit has this level."""
    site: Int
    """(visits,) position in the sites; -1 where unknown."""

    @property
    def known(self) -> Bool:
        """(visits,) whether each can be scored."""
        return np.isfinite(self.age) & np.isfinite(self.sex).all(axis=1) & (self.site >= 0)

    def take(self, rows: Int | Bool) -> "People":
        """Choose rows."""
        return People(age=self.age[rows], sex=self.sex[rows], site=self.site[rows])


@dataclass(frozen=True, eq=False, kw_only=True)
class Norms:
    """Parameters at each point; NaN where none could be estimated."""

    knots: Float
    """Of the spline of age, years; the outer ones are the ends of the range."""
    mean: Float
    """(1 + ages + sexes, points) coefficients of the mean at the average site, unit of the map."""
    spread: Float
    """(2, points) logarithm of the SD at the first knot, and its change to the last."""
    shape: Float
    """(2, points) skewness and logarithm of the tail weight; zero is normal."""
    shift: Float
    """(sites, points) of the site from the average one, unit of the map."""
    scale: Float
    """(sites, points) SD at the site over that at the average one."""
    n: Int
    """(sites, points) participants."""

    def expected(self, people: People) -> tuple[Float, Float]:
        """(visits, points) mean and SD at the average site."""
        design = np.column_stack(
            [np.ones(len(people.age)), age_columns(people.age, self.knots), people.sex]
        )
        share = (people.age - self.knots[0]) / (self.knots[-1] - self.knots[0])
        log_sd = np.column_stack([np.ones(len(share)), share]) @ self.spread
        return design @ self.mean, np.exp(log_sd)

    def score(self, values: Float, people: People) -> Float:
        """(visits, points) deviations z; their normal probability is the centile.

        Shift and scale of a site are known from its ``n`` participants only, so that a deviation is
        one of Student's distribution with ``n - 1`` degrees of freedom, and a variance larger by
        ``1 / n`` and by the mean leverage of age and sex; z is the normal quantile of the same
        probability.
        """
        scores = np.full(values.shape, np.nan)
        rows = np.flatnonzero(people.known)
        people_known = people.take(rows)
        for part in chunks((len(rows), values.shape[1]), 4):
            norms_here = self.points(part)
            mean, sd = norms_here.expected(people_known)
            residual = values[rows, part] - mean - norms_here.shift[people_known.site]
            z = to_normal(residual / (sd * norms_here.scale[people_known.site]), norms_here.shape)
            n = np.maximum(norms_here.n[people_known.site], 1)  # without any, the shift is missing
            # Mean of the leverage of the spline and of sex.
            mean_leverage = (len(norms_here.mean) - 1) / np.maximum(norms_here.n.sum(axis=0), 1)
            tail = tail_probability(z, n - 1, 1 / n + mean_leverage)
            scores[rows, part] = -np.sign(z) * special.ndtri(tail)
        return scores

    def centiles(self, people: People, levels: Sequence[float]) -> Float:
        """(levels, visits, points) values at these probabilities, at the average site."""
        mean, sd = self.expected(people)
        z = special.ndtri(np.array(levels))[:, None] * np.ones(mean.shape[1])
        return np.asarray(mean + sd * from_normal(z, self.shape)[:, None])

    def average_site(self, values: Float, people: People) -> Float:
        """(visits, points) values as they would be at the average site."""
        mean, _ = self.expected(people)
        site_values = self.shift[people.site], self.scale[people.site]
        moved = mean + (values - mean - site_values[0]) / site_values[1]
        return np.where(people.known[:, None], moved, np.nan)

    def points(self, part: slice) -> "Norms":
        """Choose points."""
        return replace(self, **{name: getattr(self, name)[:, part] for name in NORM_ARRAYS})

    def extended(self, values: Float, people: People, n_sites: int, least: int) -> "Norms":
        """Add sites beyond the known ones: their shift and scale, all else as it is.

        ``values`` (visits, points) are of controls, NaN where missing; sites of ``people`` from
        ``len(self.n)`` on are new, up to ``n_sites``. A point needs ``least`` values at a site.
        """
        blocks: list[list[Any]] = [[self.shift], [self.scale], [self.n]]
        for site in range(len(self.n), n_sites):
            rows = np.flatnonzero(people.known & (people.site == site))
            mean, sd = self.expected(people.take(rows))
            residual = values[rows] - mean
            finite = np.isfinite(residual)
            n = finite.sum(axis=0)
            weight = np.where(finite, sd**-2.0, 0.0)
            residual = np.where(finite, residual, 0.0)
            is_informed = n >= least
            total = np.where(is_informed, weight.sum(axis=0), np.nan)
            shift = (weight * residual).sum(axis=0) / total
            square = (weight * (residual - shift) ** 2).sum(axis=0) / np.maximum(n - 1, 1)
            scale = np.sqrt(np.where(square > 0, square, np.nan))
            for block, row in zip(blocks, (shift, scale, n), strict=True):
                block.append(row[None])
        shift, scale, n = map(np.vstack, blocks)
        return replace(self, shift=shift, scale=scale, n=n)


def age_columns(age: Float, knots: Float) -> Float:
    """(visits, knots - 1) natural cubic spline without constant (Hastie et al. 2009, eq. 5.4)."""
    at, t = ((ages - knots[0]) / (knots[-1] - knots[0]) for ages in (knots, age))
    cubes = np.maximum(t[:, None] - at, 0.0) ** 3
    slopes = (cubes[:, :-1] - cubes[:, -1:]) / (at[-1] - at[:-1])
    return np.column_stack([t, slopes[:, :-1] - slopes[:, -1:]])


def choose_knots(ages: Float, rules: NormSettings) -> Float:
    """Knots at equal shares of participants; some lie beyond the outer ones to hide ages."""
    ages = np.sort(ages[np.isfinite(ages)])
    if len(ages) < rules.least_participants:
        raise ModelError(
            f"--fit-norms: {len(ages)} participants with age, sex and site, "
            f"{rules.least_participants} are needed; join cohorts of several sites by "
            "--derivatives"
        )
    low, high = np.floor(ages[rules.edge - 1]), np.ceil(ages[-rules.edge])
    inside = ages[(ages >= low) & (ages <= high)]
    inner = np.quantile(inside, np.linspace(0, 1, rules.knots)[1:-1]).round(1)
    knots = np.array([low, *inner, high], dtype=np.float64)
    if not (np.diff(knots) > 0).all():
        raise ModelError(
            f"--fit-norms: too few different ages for {rules.knots} knots of a spline"
            f" ({', '.join(f'{age:g}' for age in knots)}); set norms.knots to fewer"
        )
    return knots


def fit_norms(
    values: Float, people: People, n_sites: int, knots: Float, settings: NormSettings
) -> Norms:
    """Estimate norms of each column of values (visits, points), NaN where missing.

    Mean and SD maximize the normal likelihood, which finds both whatever the distribution; squared
    residuals are divided by one minus their leverage. The shape maximizes the likelihood of the
    residuals over their SD, and is kept where it is better than the normal one by a
    likelihood-ratio test.
    """
    rows = np.flatnonzero(people.known)
    values, people = values[rows], people.take(rows)
    parts = [
        _fit(np.asarray(values[:, part], dtype=np.float64), people, n_sites, knots, settings)
        for part in chunks(values.shape, 4 + n_sites)
    ]
    return Norms(
        knots=knots,
        **{name: np.hstack([getattr(part, name) for part in parts]) for name in NORM_ARRAYS},
    )


def _fit(
    values: Float, people: People, n_sites: int, knots: Float, settings: NormSettings
) -> Norms:
    finite = np.isfinite(values)
    filled = np.where(finite, values, 0.0)
    member = np.eye(n_sites)[people.site]
    ages = age_columns(people.age, knots)
    # Around zero, so that constants of sites are those of their mean.
    middle = np.concatenate([ages.mean(axis=0), people.sex.mean(axis=0)])
    design = np.hstack([member, np.hstack([ages, people.sex]) - middle])
    center = ages[:, 0].mean()
    spread = np.hstack([member, ages[:, :1] - center])
    n = member.T @ finite
    is_informed = n >= settings.least_site // 2
    leverage = np.sum(np.linalg.qr(design)[0] ** 2, axis=1)
    one_minus_leverage = np.maximum(1 - leverage, 1 / len(values))[:, None]
    inverse = np.linalg.pinv(spread) / 2
    log_sd = np.zeros((n_sites + 1, values.shape[1]))
    count = np.maximum(finite.sum(axis=0), 1)
    deviation = finite * (filled - filled.sum(axis=0) / count)
    sd = np.sqrt((deviation**2).sum(axis=0) / count)
    log_sd[:n_sites] = np.log(np.where(sd > 0, sd, np.nan))
    coefficients = np.full((design.shape[1], values.shape[1]), np.nan)
    for _ in range(_STEPS):
        weight = finite * np.exp(-2 * (spread @ log_sd))
        coefficients = solve_weighted(filled, weight, design)
        square = (filled - design @ coefficients) ** 2 * weight / one_minus_leverage
        step = inverse @ np.where(finite, square - 1, 0.0)
        log_sd += np.clip(np.nan_to_num(step), -_LARGEST_STEP, _LARGEST_STEP)
        if np.abs(step[np.isfinite(step)]).max(initial=0.0) < _SMALLEST:
            break
    residual = np.where(finite, filled - design @ coefficients, np.nan)
    shape = _fit_shape(residual * np.exp(-(spread @ log_sd)), SHAPE_LEVEL)
    # Of the average site, at which covariates are zero again.
    part = n / np.maximum(n.sum(axis=0), 1)
    means = np.where(is_informed, coefficients[:n_sites], np.nan)
    sds = np.where(is_informed, log_sd[:n_sites], np.nan)
    average = [np.sum(part * np.where(n > 0, values, 0.0), axis=0) for values in (means, sds)]
    slopes = coefficients[n_sites:]
    return Norms(
        knots=knots,
        mean=np.vstack([average[0] - middle @ slopes, slopes]),
        spread=np.vstack([average[1] - center * log_sd[-1], log_sd[-1]]),
        shape=shape,
        shift=means - average[0],
        scale=np.exp(sds - average[1]),
        n=n.astype(np.int64),
    )


def _power(order: Float) -> Float:
    """Mean of ``cosh(order asinh Z)`` of a normal Z (Jones and Pewsey 2009, section 2.3)."""
    sum_of = special.kv((order + 1) / 2, 0.25) + special.kv((order - 1) / 2, 0.25)
    return np.asarray(np.exp(0.25) / np.sqrt(8 * np.pi) * sum_of)


def _moments(shape: Float) -> tuple[Float, Float]:
    """Mean and SD of the sinh-arcsinh distribution without location and scale."""
    skew, tail = shape[0], np.exp(shape[1])
    mean = np.sinh(skew / tail) * _power(1 / tail)
    square = (np.cosh(2 * skew / tail) * _power(2 / tail) - 1) / 2
    return np.asarray(mean), np.asarray(np.sqrt(square - mean**2))


def to_normal(residuals: Float, shape: Float) -> Float:
    """Transform residuals (visits, points) of mean 0 and SD 1 to a normal distribution."""
    mean, sd = _moments(shape)
    return np.asarray(np.sinh(np.exp(shape[1]) * np.arcsinh(mean + sd * residuals) - shape[0]))


def from_normal(z: Float, shape: Float) -> Float:
    """Inverse of :func:`to_normal`."""
    mean, sd = _moments(shape)
    return np.asarray((np.sinh((np.arcsinh(z) + shape[0]) / np.exp(shape[1])) - mean) / sd)


def _fit_shape(residuals: Float, level: float) -> Float:
    """(2, points) most likely shape of standardized residuals, or zero where it is normal.

    Steps are those of scoring, with the squares of single derivatives as information, and damped as
    Levenberg and Marquardt do where they lower the likelihood.
    """
    n_points = residuals.shape[1]
    shape, damping = np.zeros((2, n_points)), np.full(n_points, 1e-3)
    best, gradient, information = _likelihood(residuals, shape)
    normal = best.copy()
    active = np.flatnonzero(np.isfinite(best) & (np.isfinite(residuals).sum(axis=0) > len(shape)))
    for _ in range(_SHAPE_STEPS):
        if not len(active):
            break
        damped = information[active].copy()
        damped[:, [0, 1], [0, 1]] *= 1 + damping[active, None]
        damped[:, [0, 1], [0, 1]] += _LEAST_INFORMATION
        step = np.linalg.solve(damped, gradient[active, :, None])[:, :, 0].T
        tried = np.clip(shape[:, active] + step, -_FARTHEST[:, None], _FARTHEST[:, None])
        new, slope, squares = _likelihood(residuals[:, active], tried)
        better = new > best[active]
        gain = np.where(better, new - best[active], np.inf)
        damping[active] *= np.where(better, 0.2, 8.0)
        improved = active[better]
        shape[:, improved], best[improved] = tried[:, better], new[better]
        gradient[improved], information[improved] = slope[better], squares[better]
        active = active[(gain > _GAIN) & (damping[active] < 1e6)]  # noqa: PLR2004
    # Twice the gain has a chi-squared distribution with two degrees of freedom.
    needed = np.nan_to_num(best - normal) > -np.log(level)
    return np.where(needed, shape, 0.0)


def _likelihood(residuals: Float, shape: Float) -> tuple[Float, Float, Float]:
    """Log likelihood (points,), derivatives (points, 2), and their squares (points, 2, 2)."""
    finite = np.isfinite(residuals)
    r = np.where(finite, residuals, 0.0)
    mean, sd = _moments(shape)
    # Derivatives of mean and SD by skewness and by the logarithm of the tail weight.
    moved = [
        [(a - b) / (2 * _DIFFERENCE) for a, b in zip(up, down, strict=True)]
        for up, down in (
            (_moments(shape + _DIFFERENCE * unit), _moments(shape - _DIFFERENCE * unit))
            for unit in np.eye(2)[:, :, None]
        )
    ]
    tail = np.exp(shape[1])
    x = mean + sd * r
    root = np.sqrt(1 + x**2)
    angle = np.arcsinh(x)
    z = np.sinh(tail * angle - shape[0])
    cosine = np.sqrt(1 + z**2)
    terms = np.log(sd * tail * cosine / root) - z**2 / 2
    by_angle = -(z**3) / cosine
    by_x = by_angle * tail / root - x / root**2
    skewed = -by_angle + by_x * (moved[0][0] + moved[0][1] * r) + moved[0][1] / sd
    tailed = by_angle * tail * angle + by_x * (moved[1][0] + moved[1][1] * r) + moved[1][1] / sd + 1
    single = np.stack([skewed, tailed]) * finite
    information = np.einsum("isp,jsp->pij", single, single)
    return (terms * finite).sum(axis=0), single.sum(axis=1).T, information
