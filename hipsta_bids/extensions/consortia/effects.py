"""Meta-analysis: estimates of several sites become one, at all points at once.

Fixed effect: the mean of the sites' estimates, weighted by inverse variances.
Random effects: sites differ in their true effects, with a variance that is estimated.
"""

from dataclasses import dataclass

import numpy as np
from scipy import stats

from hipsta_bids.extensions.consortia.settings import MetaSettings
from hipsta_bids.stats.arrays import Bool, Float

#: Steps of the scoring end when no variance changes by more than this, relative to its scale.
_TOLERANCE, _MOST_STEPS = 1e-10, 200
#: What the two models are called.
FIXED, RANDOM = "fixed effect", "random effects"
#: Estimate of the variance between sites, and test, by ``meta.random``.
_METHODS = {"reml": ("reml", "knha"), "reml-adhoc": ("reml", "adhoc"), "dl": ("dl", "z")}


@dataclass(frozen=True, kw_only=True)
class Combined:
    """One estimate out of several at each point; NaN where too few sites have one."""

    estimate: Float
    """(points,) in the unit of the estimates."""
    se: Float
    """(points,)"""
    df: Float
    """(points,) degrees of freedom of t; infinite for the normal distribution."""

    @property
    def statistic(self) -> Float:
        """(points,) t, or z where the degrees of freedom are infinite."""
        return self.estimate / np.where(self.se > 0, self.se, np.nan)

    @property
    def p(self) -> Float:
        """(points,) two-sided."""
        return np.asarray(2 * stats.t.sf(np.abs(self.statistic), self.df), dtype=np.float64)

    def limits(self, confidence: float) -> tuple[Float, Float]:
        """Confidence limits of the estimates."""
        reach = stats.t.ppf((1 + confidence) / 2, self.df) * self.se
        return self.estimate - reach, self.estimate + reach


@dataclass(frozen=True, kw_only=True)
class RandomEffects(Combined):
    """Random effects, and how much the sites differ."""

    tau2: Float
    """(points,) variance of the true effects between sites."""
    q: Float
    """(points,) Cochran's Q; chi squared with ``sites - 1`` degrees of freedom where all sites have
    the same effect."""
    i2: Float
    """(points,) share of the estimates' variance that is between sites."""
    sites: Float
    """(points,) sites with an estimate."""
    weights: Float
    """(sites, points) share of each site in the estimate; 0 without one."""

    @property
    def q_p(self) -> Float:
        """(points,) p-value of Q."""
        return np.asarray(stats.chi2.sf(self.q, self.sites - 1), dtype=np.float64)

    def prediction(self, confidence: float) -> tuple[Float, Float]:
        """Limits of the true effect of a further site, by t with ``sites - 2`` degrees of freedom.

        Higgins, Thompson and Spiegelhalter (2009); NaN below three sites.
        """
        df = np.where(self.sites > 2, self.sites - 2, np.nan)  # noqa: PLR2004
        reach = stats.t.ppf((1 + confidence) / 2, df) * np.sqrt(self.tau2 + self.se**2)
        return self.estimate - reach, self.estimate + reach


def combine(
    estimates: Float,
    variances: Float,
    method: str,
    *,
    test: str = "z",
    least: int = 2,
) -> RandomEffects:
    """Combine independent estimates (sites, points) with known variances; NaN is none.

    ``method`` is how the variance between sites is estimated: ``fixed`` (it is zero, so that
    weights are inverse variances), ``dl`` (DerSimonian and Laird 1986) or ``reml`` (restricted
    maximum likelihood by Fisher scoring, Viechtbauer 2005).

    ``test`` is named as in R's metafor. ``z`` is normal. ``knha``: standard errors from the spread
    of the sites' estimates, and t with ``sites - 1`` degrees of freedom (Knapp and Hartung 2003).
    ``adhoc``: the same, but no standard error smaller than with ``z`` (Roever, Knapp and Friede
    2015). Points of fewer sites than ``least`` have no result.

    I squared follows Higgins and Thompson (2002) in terms of tau squared: tau squared over its
    sum with the typical variance within sites. For ``fixed`` and ``dl`` it is (Q - df) / Q.
    """
    usable_sites = np.isfinite(estimates) & np.isfinite(variances) & (variances > 0)
    sites = usable_sites.sum(axis=0).astype(np.float64)
    usable = sites >= least
    values = np.where(usable_sites, estimates, 0.0)
    plain = np.where(usable_sites, 1 / np.where(usable_sites, variances, 1.0), 0.0)
    center = _mean(values, plain)
    q = np.sum(plain * (values - center) ** 2, axis=0)
    total, squares = plain.sum(axis=0), np.sum(plain**2, axis=0)
    spread = np.where(usable, total - squares / np.where(total > 0, total, 1.0), 1.0)
    tau2 = np.maximum(0.0, (q - (sites - 1)) / spread)
    if method == "reml":
        tau2 = _reml(values, np.where(usable_sites, variances, 1.0), usable_sites, usable, tau2)
    i2 = tau2 / (tau2 + np.where(usable, sites - 1, 1.0) / spread)
    if method == "fixed":
        tau2 = np.zeros_like(q)
    weights = np.where(usable_sites, 1 / (np.where(usable_sites, variances, 1.0) + tau2), 0.0)
    estimate = _mean(values, weights)
    share = weights / np.where(usable, weights.sum(axis=0), 1.0)
    se = np.sqrt(1 / np.where(usable, weights.sum(axis=0), 1.0))
    df = np.full_like(se, np.inf)
    if test != "z":
        df = np.where(usable, sites - 1, 1.0)
        factor = np.sum(weights * (values - estimate) ** 2, axis=0) / df
        se = se * np.sqrt(np.maximum(factor, 1.0) if test == "adhoc" else factor)
    values_of = {"estimate": estimate, "se": se, "df": df, "tau2": tau2, "q": q, "i2": i2}
    combined = {name: np.where(usable, value, np.nan) for name, value in values_of.items()}
    return RandomEffects(**combined, sites=sites, weights=np.where(usable, share, 0.0))


def _mean(values: Float, weights: Float) -> Float:
    total = weights.sum(axis=0)
    return np.asarray(np.sum(weights * values, axis=0) / np.where(total > 0, total, 1.0))


def _reml(values: Float, variances: Float, usable_sites: Bool, usable: Bool, start: Float) -> Float:
    """Between-site variance that maximizes the restricted likelihood, not below zero.

    A step of Fisher scoring is (y'PPy - tr P) / tr PP with P = W - W1(1'W1)^-1 1'W; here for all
    points, which drop out when they have settled.
    """
    tau2 = start.copy()
    active = np.flatnonzero(usable)
    for _ in range(_MOST_STEPS):
        variance = tau2[active]
        present = usable_sites[:, active]
        w = np.where(present, 1 / (variances[:, active] + variance), 0.0)
        weight_sum, two, three = (np.sum(w**power, axis=0) for power in (1, 2, 3))
        squares = np.sum((w * (values[:, active] - _mean(values[:, active], w))) ** 2, axis=0)
        information = two - 2 * three / weight_sum + (two / weight_sum) ** 2
        step = (squares - (weight_sum - two / weight_sum)) / information
        new = np.maximum(0.0, variance + step)
        tau2[active] = new
        scale = present.sum(axis=0) / weight_sum
        active = active[np.abs(new - variance) > _TOLERANCE * scale]
        if not len(active):
            break
    return tau2


@dataclass(frozen=True, eq=False, kw_only=True)
class MetaResult:
    """One contrast, combined over sites."""

    fixed: RandomEffects
    random: RandomEffects
    sd: Float
    """(points,) residual standard deviation within sites."""
    estimates: Float
    """(sites, points)"""
    ses: Float
    """(sites, points)"""
    without: list["MetaResult"]
    """The same without each of the sites; empty for these, and with fewer than three."""

    @property
    def models(self) -> dict[str, RandomEffects]:
        """Both results, by name."""
        return {FIXED: self.fixed, RANDOM: self.random}


def meta_analyze(
    estimates: Float,
    ses: Float,
    sds: Float,
    df: Float,
    settings: MetaSettings,
    *,
    leave_out: bool = True,
) -> MetaResult:
    """Combine a contrast by both models, with all sites and without each of them.

    Estimates, standard errors and residual standard deviations are (sites, points), NaN where a
    site has none; ``df`` (sites,) are residual degrees of freedom.
    """
    least, n_sites = settings.min_sites, len(estimates)
    method, test = _METHODS[settings.random]
    freedom = np.where(np.isfinite(sds), df[:, None], np.nan)
    without = []
    if leave_out and n_sites > least:
        for site in range(n_sites):
            kept = np.arange(n_sites) != site
            values = estimates[kept], ses[kept], sds[kept], df[kept]
            without.append(meta_analyze(*values, settings, leave_out=False))
    with np.errstate(invalid="ignore"):  # of points that no site has
        sd = np.sqrt(np.nansum(freedom * sds**2, axis=0) / np.nansum(freedom, axis=0))
    return MetaResult(
        fixed=combine(estimates, ses**2, "fixed", least=least),
        random=combine(estimates, ses**2, method, test=test, least=least),
        sd=sd,
        estimates=estimates,
        ses=ses,
        without=without,
    )
