"""ComBat: shifts and scales of sites at each point of a map, estimated and taken out.

The method of Johnson, Li and Rabinovic (2007, doi:10.1093/biostatistics/kxj037) as Fortin et al.
(2018, doi:10.1016/j.neuroimage.2017.11.024) use it for thickness, and with repeated sessions that
of Beer et al. (2020, doi:10.1016/j.neuroimage.2020.117129). Values may be missing anywhere, and all
points are done at once.
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import numpy as np

from hipsta_bids.stats.arrays import Bool, Float, Int
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.glm import chunks, sum_by
from hipsta_bids.stats.mixed import fit_mixed
from hipsta_bids.stats.settings import LongitudinalSettings
from hipsta_bids.stats.solve import solve_weighted

#: Most steps of the posterior of shift and scale.
POSTERIOR_STEPS = 200
#: They end when no shift, in SD, and no variance, as a fraction, changes by more.
POSTERIOR_TOLERANCE = 1e-6

#: Values of a site at a point, below which its variance says nothing about that of other points.
_LEAST_VISITS = 3


@dataclass(frozen=True, eq=False, kw_only=True)
class Visits:
    """Rows of maps: their sites, and the columns whose effects are kept."""

    site: Int
    """(visits,) position in the sites; -1 for visits that cannot be harmonized."""
    columns: Float
    """(visits, columns) without an intercept; NaN where the site is -1."""
    participant: Int | None
    """(visits,) participants as numbers where some have several visits; else ``None``."""

    def take(self, rows: Int) -> "Visits":
        """Choose rows."""
        person = None if self.participant is None else self.participant[rows]
        return Visits(site=self.site[rows], columns=self.columns[rows], participant=person)


@dataclass(frozen=True, eq=False, kw_only=True)
class SiteEffects:
    """Parameters of ComBat; sites, columns and points as they are numbered elsewhere."""

    mean: Float
    """(points,) mean over sites by their size, at zero of all columns; unit of the map."""
    sd: Float
    """(points,) residual SD; with repeated sessions that within participants."""
    slopes: Float
    """(columns, points) effects that are kept, unit of the map per unit of the column."""
    ratio: Float
    """(points,) variance between participants over that within; 0 without repeated sessions."""
    fixed: Float
    """(sites, points) shifts of the model, before they are pooled over points, in ``sd``."""
    shift: Float
    """(sites, points) what is taken out, in ``sd``."""
    scale: Float
    """(sites, points) what residuals are divided by."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SiteMoments:
    """Residuals of sites at each point, in the SD of all; NaN where there are too few."""

    n: Int
    """(sites, points)"""
    mean: Float
    """(sites, points)"""
    sd: Float
    """(sites, points)"""

    def after(self, effects: SiteEffects) -> "SiteMoments":
        """Moments after harmonization."""
        mean = (self.mean - effects.shift) / effects.scale
        return SiteMoments(n=self.n, mean=mean, sd=self.sd / effects.scale)


def fit_effects(
    values: Float, visits: Visits, n_sites: int, settings: LongitudinalSettings, *, pooled: bool
) -> tuple[SiteEffects, SiteMoments]:
    """Estimate the effects of sites on values (visits, points), NaN where missing.

    Participants with several visits get random intercepts, and the residual SD is the root mean
    square of the conditional residuals, as the variant MSR of Beer et al. (2020): without effects
    of sites it leaves the values as they are. Every one of the ``n_sites`` has visits. Where
    effects are ``pooled``, points inform each other (empirical Bayes), as points of one map do;
    else each site's mean and variance are removed.

    Parameters are NaN at points where missing values leave sites and columns inseparable; moments
    are of residuals before harmonization.
    """
    rows = np.flatnonzero(visits.site >= 0)
    values, visits = values[rows], visits.take(rows)
    member = np.eye(n_sites)[visits.site]
    # Of unit spread around zero, so that the equations are well conditioned.
    center = visits.columns.mean(axis=0)
    spread = visits.columns.std(axis=0)
    spread = np.where(spread > 0, spread, 1.0)
    design = np.hstack([member, (visits.columns - center) / spread])
    coefficients = np.full((design.shape[1], values.shape[1]), np.nan)
    ratio = np.zeros(values.shape[1])
    finite = np.isfinite(values)
    low = values.min(axis=0, where=finite, initial=np.inf)
    varies = np.flatnonzero(low < values.max(axis=0, where=finite, initial=-np.inf))
    if visits.participant is None:
        for part in chunks((len(values), len(varies)), design.shape[1]):
            points = varies[part]
            values_here = values[:, points]
            present = np.isfinite(values_here).astype(np.float64)
            # On the diagonal are numbers of values, but for rounding.
            coefficients[:, points] = solve_weighted(
                np.nan_to_num(values_here), present, design, 0.5
            )
    elif len(varies):
        columns_used = np.flatnonzero(design.any(axis=0))
        any_contrast = Contrast("", np.eye(len(columns_used))[:1])
        names = visits.participant.astype(np.str_)
        values_here, matrix = values[:, varies], design[:, columns_used]
        fit = fit_mixed(values_here, matrix, names, [any_contrast], settings)
        coefficients[:, varies] = 0.0
        coefficients[np.ix_(columns_used, varies)] = fit.coefficients
        ratio[varies] = fit.variances["participant"] / fit.variances["residual"]
    sites, slopes = coefficients[:n_sites], coefficients[n_sites:] / spread[:, None]
    counts = member.T @ finite
    middle = np.einsum("sp,sp->p", counts, sites) / np.maximum(counts.sum(axis=0), 1)
    effects = SiteEffects(
        mean=middle - center @ slopes,
        sd=np.ones(values.shape[1]),
        slopes=slopes,
        ratio=ratio,
        fixed=sites - middle,
        shift=np.zeros_like(sites),
        scale=np.ones_like(sites),
    )
    square, count = np.zeros((2, values.shape[1]))
    for part, residuals in _residuals(effects, values, visits):
        residuals -= effects.fixed[visits.site, part]  # noqa: PLW2901 -- ours
        square[part], count[part] = (
            np.nansum(residuals**2, axis=0),
            np.isfinite(residuals).sum(axis=0),
        )
    sd = np.sqrt(square / np.maximum(count, 1))
    effects = replace(effects, sd=np.where(sd > 0, sd, np.nan), fixed=effects.fixed / sd)
    return _with_shifts(effects, values, visits, pooled=pooled)


def extend_effects(
    effects: SiteEffects, values: Float, visits: Visits, *, pooled: bool
) -> tuple[SiteEffects, SiteMoments]:
    """Estimate the effects of further sites, with all else as it was estimated before.

    Sites beyond the sites of the effects are new. The moments are of the given values.
    """
    n_known = len(effects.fixed)
    rows = np.flatnonzero(visits.site >= 0)
    values, visits = values[rows], visits.take(rows)
    total = max(int(visits.site.max(initial=-1)) + 1, n_known)
    wider = np.zeros((total, values.shape[1]))
    flat = replace(effects, ratio=np.zeros_like(effects.ratio), fixed=wider)
    wider = np.vstack([effects.fixed, _moments(flat, values, visits)[1][n_known:]])
    wide = replace(effects, fixed=wider)
    fitted, moments = _with_shifts(wide, values, visits, pooled=pooled)
    shift, scale = fitted.shift.copy(), fitted.scale.copy()
    shift[:n_known], scale[:n_known] = effects.shift, effects.scale
    return replace(fitted, shift=shift, scale=scale), moments


def harmonize(values: Float, visits: Visits, effects: SiteEffects) -> Float:
    """Take shifts and scales of sites out of values (visits, points).

    What the columns explain stays, and with repeated sessions the effects of participants.
    Visits without a site or column are NaN.
    """
    rows = np.flatnonzero(visits.site >= 0)
    visits_used = visits.take(rows)
    result = np.full(values.shape, np.nan)
    for part, residuals in _residuals(effects, values[rows], visits_used):
        sd, shift, scale = effects.sd[part], effects.shift[visits_used.site, part], effects.scale
        adjusted = (residuals / sd - shift) / scale[visits_used.site, part]
        result[rows, part] = values[rows, part] - residuals + sd * adjusted
    return result


def _residuals(
    effects: SiteEffects, values: Float, visits: Visits
) -> Iterator[tuple[slice, Float]]:
    """Take what columns and participants explain out of values, at one block of points at a time.

    A participant's part is the mean of what the model leaves, shrunk as the best linear
    unbiased prediction is.
    """
    for part in chunks(values.shape, 4):
        residuals = values[:, part] - effects.mean[part] - visits.columns @ effects.slopes[:, part]
        if visits.participant is not None:
            without = residuals - effects.sd[part] * effects.fixed[visits.site, part]
            residuals -= _intercepts(without, visits.participant, effects.ratio[part])
        yield part, residuals


def _intercepts(residuals: Float, participant: Int, ratio: Float) -> Float:
    """(visits, points) predicted random intercepts."""
    _, numbers = np.unique(participant, return_inverse=True)
    finite = np.isfinite(residuals)
    total = sum_by(numbers, np.where(finite, residuals, 0.0))
    count = sum_by(numbers, finite.astype(np.float64))
    return np.asarray((total * ratio / (1 + count * ratio))[numbers])


def _moments(effects: SiteEffects, values: Float, visits: Visits) -> tuple[Float, Float, Float]:
    """Count, mean and sum of squares around it of residuals, in SD, by site and point."""
    sites = len(effects.fixed)
    member = np.eye(sites)[visits.site]
    n, total, square = np.zeros((3, sites, values.shape[1]))
    for part, residuals in _residuals(effects, values, visits):
        unit = residuals / effects.sd[part]
        finite = np.isfinite(unit)
        unit = np.where(finite, unit, 0.0)
        n[:, part], total[:, part] = member.T @ finite, member.T @ unit
        square[:, part] = member.T @ unit**2
    mean = total / np.where(n > 0, n, np.nan)
    return n, mean, np.maximum(square - n * np.where(n > 0, mean, 0.0) ** 2, 0.0)


def _with_shifts(
    effects: SiteEffects, values: Float, visits: Visits, *, pooled: bool
) -> tuple[SiteEffects, SiteMoments]:
    """Complete effects by the shifts and scales that standardized residuals show."""
    n, mean, around = _moments(effects, values, visits)
    variance = np.where(n > 1, around / np.where(n > 1, n - 1, 1), np.nan)
    shift, square = mean.copy(), variance.copy()
    # Without pooling, a few values give no variance, and equal ones none to divide by.
    square[~(n >= _LEAST_VISITS)] = np.nan
    square[square == 0] = 1.0
    shift[~(n >= _LEAST_VISITS)] = np.nan
    for site in range(len(n)) if pooled else ():
        is_informed = (n[site] >= _LEAST_VISITS) & np.isfinite(variance[site])
        if is_informed.sum() > 1:
            shift[site], square[site] = _pool(n[site], mean[site], around[site], is_informed)
    is_fitted = np.isfinite(effects.sd)
    extended = replace(
        effects,
        shift=np.where(is_fitted, shift, np.nan),
        scale=np.where(is_fitted, np.sqrt(square), np.nan),
    )
    return extended, SiteMoments(n=n.astype(np.int64), mean=mean, sd=np.sqrt(variance))


def _pool(n: Float, mean: Float, around: Float, is_informed: Bool) -> tuple[Float, Float]:
    """Posterior shift and variance of one site at each point (Johnson et al. 2007, section 3).

    Over points, shifts are normal and variances inverse gamma; their parameters are moments of the
    points that are ``is_informed`` by enough values. Others take what these say.
    """
    variance = around[is_informed] / (n[is_informed] - 1)
    prior, spread = mean[is_informed].mean(), mean[is_informed].var(ddof=1)
    middle, width = variance.mean(), variance.var(ddof=1)
    if not (width > 0 and middle > 0):
        return np.where(n > 0, mean, prior), np.full_like(mean, middle if middle > 0 else 1.0)
    shape, rate = 2 + middle**2 / width, middle * (1 + middle**2 / width)
    site_mean = np.where(n > 0, mean, 0.0)
    square = np.where(is_informed, around / np.maximum(n - 1, 1), middle)
    shift = np.where(n > 0, mean, prior)
    for _ in range(POSTERIOR_STEPS):
        next_shift = (spread * n * site_mean + square * prior) / (spread * n + square)
        next_square = (rate + (around + n * (site_mean - next_shift) ** 2) / 2) / (
            n / 2 + shape - 1
        )
        change = np.max(np.abs(next_square / square - 1))
        change = max(change, np.max(np.abs(next_shift - shift)))
        shift, square = next_shift, next_square
        if change < POSTERIOR_TOLERANCE:
            break
    return shift, square


#: Names of the arrays of :class:`SiteEffects`, and those that have one value per point.
ARRAYS = tuple(column.name for column in fields(SiteEffects))
