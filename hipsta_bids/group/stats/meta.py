"""Meta-analysis: estimates of several sites become one, at all points at once.

Fixed effect: the sites' models are joined to one, as if their participants were in one table.
Random effects: sites differ in their true effects, with a variance that is estimated.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from hipsta_bids.group.design.settings import MetaSettings
from hipsta_bids.group.stats.arrays import Bool, Float

#: Steps of the scoring end when no variance changes by more than this, relative to its scale.
_TOLERANCE, _MOST_STEPS = 1e-10, 200
_ZERO = 1e-9  # of weights that differences leave
#: Golden sections that find the variance between sites, up to this share of the total.
_GOLDEN, _SECTIONS, _MOST_BETWEEN = (np.sqrt(5) - 1) / 2, 30, 0.9999
#: What the two models are called.
FIXED, RANDOM = "fixed effect", "random effects"


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
    method: str | Float,
    *,
    test: str = "normal",
    least: int = 2,
) -> RandomEffects:
    """Combine independent estimates (sites, points) with known variances; NaN is none.

    ``method`` is how the variance between sites is estimated: ``fixed`` (it is zero, so that
    weights are inverse variances), ``dl`` (DerSimonian and Laird 1986) or ``reml`` (restricted
    maximum likelihood by Fisher scoring, Viechtbauer 2005); or that variance (points,).

    ``test`` is ``normal``; ``plain``: standard errors from the spread of the sites' estimates, and
    t with ``sites - 1`` degrees of freedom (Knapp and Hartung 2003); or ``modified``: the same, but
    no standard error smaller than with ``normal`` (Roever, Knapp and Friede 2015). Points of fewer
    sites than ``least`` have no result.

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
    if not isinstance(method, str):
        tau2 = np.where(usable, method, 0.0)
    elif method == "reml":
        tau2 = _reml(values, np.where(usable_sites, variances, 1.0), usable_sites, usable, tau2)
    i2 = tau2 / (tau2 + np.where(usable, sites - 1, 1.0) / spread)
    if isinstance(method, str) and method == "fixed":
        tau2 = np.zeros_like(q)
    weights = np.where(usable_sites, 1 / (np.where(usable_sites, variances, 1.0) + tau2), 0.0)
    estimate = _mean(values, weights)
    share = weights / np.where(usable, weights.sum(axis=0), 1.0)
    se = np.sqrt(1 / np.where(usable, weights.sum(axis=0), 1.0))
    df = np.full_like(se, np.inf)
    if test != "normal":
        df = np.where(usable, sites - 1, 1.0)
        factor = np.sum(weights * (values - estimate) ** 2, axis=0) / df
        se = se * np.sqrt(np.maximum(factor, 1.0) if test == "modified" else factor)
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
class SiteFit:
    """A site's numbers of one model: all evidence of its participants on the coefficients."""

    coefficients: Float
    """(columns, points)"""
    covariance: Float
    """(columns, columns) of the coefficients, over the residual variance."""
    sd: Float
    """(points,) residual standard deviation; NaN where the site has no fit."""
    df: int
    """Residual degrees of freedom."""

    def estimate(self, weights: Float) -> Float:
        """(points,) of a contrast."""
        return np.where(np.isfinite(self.sd), weights @ self.coefficients, np.nan)

    def se(self, weights: Float) -> Float:
        """(points,) standard error of a contrast."""
        return self.sd * np.sqrt(weights @ self.covariance @ weights)


def join(
    fits: list[SiteFit],
    weights: Float,
    intercept: int | None,
    least: int,
    *,
    vary: bool = False,
) -> tuple[Combined, Float]:
    """Test a contrast in the model of all participants with a constant per site.

    The likelihood of that model depends on participants by the sites' coefficients, their
    covariances and residual variances only, so that results equal an analysis of one table with all
    participants and the site as a further factor (Becker and Wu 2007).

    All fits have the same columns; the contrast's ``weights`` (columns,) are 0 for the
    ``intercept``, which differs between sites (``None``: all coefficients are common). Points of
    fewer sites than ``least`` have no result. With ``vary`` each site has a random deviation, a
    random slope: its variance (points,), the second result, is estimated by restricted maximum
    likelihood, and tests are by t with ``sites - 1`` degrees of freedom; else it is 0.
    """
    slopes = np.arange(len(weights)) != (-1 if intercept is None else intercept)
    present = np.stack([np.isfinite(fit.sd) for fit in fits])
    estimate, se, df, tau2 = np.full((4, present.shape[1]), np.nan)
    row = weights[slopes]
    for pattern in np.unique(present, axis=1).T:
        if pattern.sum() < least:
            continue
        points = np.flatnonzero((present == pattern[:, None]).all(axis=0))
        member_fits = [fit for fit, there in zip(fits, pattern, strict=True) if there]
        covariances = np.stack([fit.covariance[np.ix_(slopes, slopes)] for fit in member_fits])
        model = _Joined(
            information=np.asarray(np.linalg.inv(covariances), dtype=np.float64),
            betas=np.stack([fit.coefficients[np.ix_(slopes, points)] for fit in member_fits]),
            residual=np.sum([fit.df * fit.sd[points] ** 2 for fit in member_fits], axis=0),
            freedom=sum(fit.df for fit in member_fits) + (len(member_fits) - 1) * int(slopes.sum()),
            direction=row / (row @ row),
        )
        ratio = model.best_ratio() if vary else np.zeros(len(points))
        _, common, inverse, variance = model.at(ratio)
        estimate[points] = row @ common
        se[points] = np.sqrt(np.einsum("i,pij,j,p->p", row, inverse, row, variance))
        df[points] = len(member_fits) - 1 if vary else model.freedom
        tau2[points] = ratio * variance
    return Combined(estimate=estimate, se=se, df=df), tau2


@dataclass(frozen=True, eq=False, kw_only=True)
class _Joined:
    """The likelihood of all participants, from what sites say about slopes."""

    information: Float
    """(sites, columns, columns) inverse of the covariance over the residual variance."""
    betas: Float
    """(sites, columns, points)"""
    residual: Float
    """(points,) sum of squares within sites."""
    freedom: int
    direction: Float
    """(columns,) in which sites differ by one unit of the contrast."""

    def at(self, ratio: Float) -> tuple[Float, Float, Float, Float]:
        """Restricted log-likelihood, coefficients, their covariance, and residual variance.

        ``ratio`` (points,) is the variance between sites over the residual variance.
        """
        along = self.information @ self.direction
        scale = 1 + np.outer(along @ self.direction, ratio)
        share = ratio / scale
        total = self.information.sum(axis=0) - np.einsum("sp,si,sj->pij", share, along, along)
        right = np.einsum("sij,sjp->pi", self.information, self.betas)
        right -= np.einsum("sp,si,sj,sjp->pi", share, along, along, self.betas, optimize=True)
        inverse = np.linalg.inv(total)
        common = np.einsum("pij,pj->ip", inverse, right)
        deviation = self.betas - common
        squares = self.residual + np.einsum(
            "sip,sij,sjp->p", deviation, self.information, deviation, optimize=True
        )
        squares -= np.sum(share * np.einsum("si,sip->sp", along, deviation) ** 2, axis=0)
        likelihood = self.freedom * np.log(squares) + np.log(scale).sum(axis=0)
        likelihood = -(likelihood + np.linalg.slogdet(total)[1]) / 2
        return likelihood, common, inverse, squares / self.freedom

    def best_ratio(self) -> Float:
        """Ratio (points,) with the largest likelihood, by golden sections of I squared."""
        typical = float(np.mean(self.information @ self.direction @ self.direction))

        def ratio(share: Float) -> Float:
            return share / (1 - share) / typical

        low, high = np.zeros_like(self.residual), np.full_like(self.residual, _MOST_BETWEEN)
        inner = [low + (1 - _GOLDEN) * (high - low), low + _GOLDEN * (high - low)]
        values = [self.at(ratio(share))[0] for share in inner]
        for _ in range(_SECTIONS):
            left = values[0] > values[1]
            low, high = np.where(left, low, inner[0]), np.where(left, inner[1], high)
            new = np.where(left, high - _GOLDEN * (high - low), low + _GOLDEN * (high - low))
            value = self.at(ratio(new))[0]
            inner = [np.where(left, new, inner[1]), np.where(left, inner[0], new)]
            values = [np.where(left, value, values[1]), np.where(left, values[0], value)]
        best = ratio((low + high) / 2)
        zero = np.zeros_like(best)
        return np.where(self.at(best)[0] > self.at(zero)[0], best, zero)


def pooled_sd(fits: list[SiteFit]) -> Float:
    """(points,) residual standard deviation within sites, over all that have the point."""
    sds = np.stack([fit.sd for fit in fits])
    df = np.where(np.isfinite(sds), np.array([[fit.df] for fit in fits]), 0)
    squares = np.sum(df * np.nan_to_num(sds) ** 2, axis=0)
    return np.asarray(np.sqrt(squares / np.where(df.any(axis=0), df.sum(axis=0), np.nan)))


@dataclass(frozen=True, eq=False, kw_only=True)
class MetaResult:
    """One contrast, combined over sites."""

    fixed: Combined
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
    def models(self) -> dict[str, Combined]:
        """Both results, by name."""
        return {FIXED: self.fixed, RANDOM: self.random}


def meta_analyze(
    fits: list[SiteFit],
    weights: list[Float],
    intercept: int | None,
    settings: MetaSettings,
    *,
    leave_out: bool = True,
) -> MetaResult:
    """Combine a contrast by both models, with all sites and without each of them.

    ``weights`` has the contrast at each site, the same at all but for a mean over participants.
    Where the contrast includes the constant, as the mean does, estimates are combined in two
    stages: a model with a constant per site does not estimate it.
    """
    estimates = np.stack([fit.estimate(row) for fit, row in zip(fits, weights, strict=True)])
    ses = np.stack([fit.se(row) for fit, row in zip(fits, weights, strict=True)])
    sd, least = pooled_sd(fits), settings.min_sites
    test = "modified" if settings.random == "reml" else "normal"
    random = combine(estimates, ses**2, settings.random, test=test, least=least)
    own_constant = intercept is not None and abs(weights[0][intercept]) > _ZERO
    if settings.model == "two-stage" or own_constant:
        fixed: Combined = combine(estimates, ses**2, "fixed", least=least)
    else:
        fixed, _ = join(fits, weights[0], intercept, least)
        if settings.random == "reml":
            joined, tau2 = join(fits, weights[0], intercept, least, vary=True)
            common = np.stack([replace(fit, sd=sd).se(weights[0]) for fit in fits]) ** 2
            random = replace(
                combine(estimates, common, tau2, least=least),
                estimate=joined.estimate,
                se=joined.se,
                df=joined.df,
            )
    without = []
    if leave_out and len(fits) > settings.min_sites:
        without = [
            meta_analyze(
                [*fits[:i], *fits[i + 1 :]],
                [*weights[:i], *weights[i + 1 :]],
                intercept,
                settings,
                leave_out=False,
            )
            for i in range(len(fits))
        ]
    return MetaResult(
        fixed=fixed,
        random=random,
        sd=sd,
        estimates=estimates,
        ses=ses,
        without=without,
    )
