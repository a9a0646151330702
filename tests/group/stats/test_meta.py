"""Estimates of several sites become one: published values, statsmodels, and pooled participants."""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from statsmodels.regression.linear_model import OLS
from statsmodels.stats.meta_analysis import combine_effects

from hipsta_bids.group.design.settings import MetaSettings
from hipsta_bids.group.stats.meta import SiteFit, combine, join, meta_analyze

#: Trials of the BCG vaccine (Colditz et al. 1994): cases and others among the vaccinated, and among
#: controls, as in Viechtbauer (2010), J Stat Softw 36(3), table 1.
BCG = np.array(
    [
        *([4, 119, 11, 128], [6, 300, 29, 274], [3, 228, 11, 209], [62, 13536, 248, 12619]),
        *([33, 5036, 47, 5761], [180, 1361, 372, 1079], [8, 2537, 10, 619]),
        *([505, 87886, 499, 87892], [29, 7470, 45, 7232], [17, 1699, 65, 1600]),
        *([186, 50448, 141, 27197], [5, 2493, 3, 2338], [27, 16886, 29, 17825]),
    ],
    dtype=float,
)


@pytest.fixture(scope="module")
def bcg():
    """Log risk ratios and their variances, (trials, 1)."""
    a, b, c, d = BCG.T
    ratio = np.log(a / (a + b)) - np.log(c / (c + d))
    return ratio[:, None], (1 / a - 1 / (a + b) + 1 / c - 1 / (c + d))[:, None]


def test_reml_of_the_bcg_trials_is_that_of_metafor(bcg):
    """Viechtbauer (2010), section 3.2: estimate, its standard error and limits, tau2, I2, Q."""
    found = combine(*bcg, "reml")
    low, high = found.limits(0.95)
    published = [-0.7145, 0.1798, -1.0669, -0.3622, 0.3132, 0.9222, 152.2330]
    values = [found.estimate, found.se, low, high, found.tau2, found.i2, found.q]
    np.testing.assert_allclose(np.concatenate(values), published, atol=5e-5)
    assert found.q_p[0] < 0.0001
    assert found.statistic[0] == pytest.approx(-3.9744, abs=5e-5)


def test_dersimonian_laird_of_the_bcg_trials_is_that_of_metafor(bcg):
    found = combine(*bcg, "dl")
    values = [found.estimate[0], found.se[0], found.tau2[0], found.i2[0]]
    np.testing.assert_allclose(values, [-0.7141, 0.1787, 0.3088, 0.9212], atol=5e-5)


def test_reml_is_where_the_restricted_likelihood_is_largest(bcg):
    """Against the definition, for the trials and for random studies in which tau2 may be zero."""
    random = np.random.default_rng(5)
    variances = random.uniform(0.2, 2.0, (6, 40))
    many = random.normal(0.3, np.sqrt(variances + random.choice([0, 1.5], 40)), (6, 40))

    def likelihood(y, v, tau2):
        w = 1 / (v + tau2)
        mean = np.sum(w * y, axis=0) / w.sum(axis=0)
        return -0.5 * (
            np.sum(np.log(v + tau2), axis=0)
            + np.log(w.sum(axis=0))
            + np.sum(w * (y - mean) ** 2, axis=0)
        )

    for y, v in (bcg, (many, variances)):
        tau2 = combine(y, v, "reml").tau2
        best = likelihood(y, v, tau2)
        for other in (tau2 + 1e-3, np.maximum(0, tau2 - 1e-3), 0 * tau2, tau2 + 1):
            assert (likelihood(y, v, other) <= best + 1e-12).all()
    assert (tau2 == 0).any()
    assert (tau2 > 0).any()


def test_points_are_those_of_statsmodels_one_by_one():
    """Fixed effect, DerSimonian-Laird, and the plain correction, with studies missing anywhere."""
    random = np.random.default_rng(2)
    variances = random.uniform(0.1, 1.0, (7, 12))
    estimates = random.normal(0, 1, (7, 12))
    estimates[random.random((7, 12)) < 0.2] = np.nan
    fixed = combine(estimates, variances, "fixed")
    moments = combine(estimates, variances, "dl")
    plain = combine(estimates, variances, "dl", test="plain")
    for i in range(12):
        own = np.isfinite(estimates[:, i])
        with np.errstate(invalid="ignore"):
            theirs = combine_effects(estimates[own, i], variances[own, i], method_re="dl")
        assert fixed.estimate[i] == pytest.approx(theirs.mean_effect_fe)
        assert fixed.se[i] == pytest.approx(theirs.sd_eff_w_fe)
        assert moments.q[i] == pytest.approx(theirs.q)
        if theirs.tau2 >= 0:  # it goes on with negative variances
            assert moments.estimate[i] == pytest.approx(theirs.mean_effect_re)
            assert moments.se[i] == pytest.approx(theirs.sd_eff_w_re)
            assert plain.se[i] == pytest.approx(theirs.sd_eff_w_re_hksj)
        assert moments.tau2[i] == pytest.approx(max(0, theirs.tau2))
        assert fixed.df[i] == np.inf
        assert plain.df[i] == own.sum() - 1
        assert moments.sites[i] == own.sum()
    assert (moments.tau2 > 0).sum() > 5
    np.testing.assert_allclose(moments.weights.sum(axis=0), 1)


def test_the_correction_of_knapp_and_hartung_widens_limits_only(bcg):
    alike = np.array([[0.30], [0.31], [0.29], [0.30], [0.30]])
    variances = np.full((5, 1), 0.04)
    normal, plain, modified = (
        combine(alike, variances, "reml", test=test) for test in ("normal", "plain", "modified")
    )
    assert plain.se[0] < 0.1 * normal.se[0]
    assert modified.se[0] == pytest.approx(normal.se[0])
    assert modified.p[0] > normal.p[0]  # t with four degrees of freedom
    apart = [combine(*bcg, "reml", test=test).se[0] for test in ("plain", "modified")]
    np.testing.assert_allclose(apart, 0.1808, atol=5e-5)


def test_too_few_sites_give_nothing():
    estimates = np.array([[1.0, 1.0], [np.nan, 1.2], [np.nan, 1.1]])
    found = combine(estimates, np.ones((3, 2)), "reml")
    assert np.isnan(found.estimate[0])
    assert np.isnan(found.p[0])
    assert found.estimate[1] == pytest.approx(1.1)
    assert np.isnan(found.prediction(0.95)[0][0])


@pytest.fixture(scope="module")
def people():
    """Three sites: design, values at four points, and the site of each row."""
    random = np.random.default_rng(1)
    sizes = [30, 24, 41]
    site = np.repeat([0, 1, 2], sizes)
    group = random.integers(0, 2, len(site)).astype(float)
    age = random.normal(70 + 3 * site, 6)
    matrix = np.column_stack([np.ones(len(site)), group, age])
    values = 0.3 * group[:, None] - 0.02 * age[:, None] + 0.5 * site[:, None]
    return matrix, values + random.normal(0, 1, (len(site), 4)), site


def fit_of(matrix, values):
    inverse = np.linalg.inv(matrix.T @ matrix)
    coefficients = inverse @ matrix.T @ values
    df = len(matrix) - matrix.shape[1]
    sd = np.sqrt(np.sum((values - matrix @ coefficients) ** 2, axis=0) / df)
    return SiteFit(coefficients=coefficients, covariance=inverse, sd=sd, df=df)


def test_joined_models_are_that_of_all_participants(people):
    """What sites send gives the numbers of one table with the site as a factor."""
    matrix, values, site = people
    fits = [fit_of(matrix[site == i], values[site == i]) for i in range(3)]
    fits[1].sd[3] = np.nan  # a point that one site does not have
    found, tau2 = join(fits, np.array([0.0, 1.0, 0.0]), 0, 2)
    np.testing.assert_array_equal(tau2, 0)
    for point in range(4):
        keep = site != 1 if point == 3 else site >= 0
        constants = (site[keep, None] == np.unique(site[keep])).astype(float)
        pooled = OLS(values[keep, point], np.column_stack([matrix[keep, 1:], constants])).fit()
        assert found.estimate[point] == pytest.approx(pooled.params[0])
        assert found.se[point] == pytest.approx(pooled.bse[0])
        assert found.df[point] == pooled.df_resid
        assert found.p[point] == pytest.approx(pooled.pvalues[0])


def mixed(ratio, values, design, slope, site):
    """Restricted log-likelihood by its definition; estimate and SE of the last column, and tau2."""
    between = ratio * np.outer(slope, slope) * (site[:, None] == site)
    inverse = np.linalg.inv(np.eye(len(site)) + between)
    covariance = np.linalg.inv(design.T @ inverse @ design)
    beta = covariance @ design.T @ inverse @ values
    rest = values - design @ beta
    freedom = len(site) - design.shape[1]
    variance = rest @ inverse @ rest / freedom
    like = np.linalg.slogdet(inverse)[1] + np.linalg.slogdet(covariance)[1]
    se = np.sqrt(variance * covariance[-1, -1])
    return (like - freedom * np.log(variance)) / 2, beta[-1], se, ratio * variance


def test_random_slopes_are_those_of_the_mixed_model_of_all_participants(people):
    """Its likelihood, on all values in one table, is largest at what sites' summaries give."""
    matrix, values, site = people
    apart = np.array([-1.0, 0.2, 1.3])[site, None] * matrix[:, [1]] * np.array([0, 0.3, 1, 2])
    values = values + apart
    fits = [fit_of(matrix[site == i], values[site == i]) for i in range(3)]
    found, tau2 = join(fits, np.array([0.0, 1.0, 0.0]), 0, 2, vary=True)
    design = np.column_stack([site[:, None] == np.arange(3), matrix[:, 2], matrix[:, 1]])
    for point in range(4):
        own = values[:, point], design.astype(float), matrix[:, 1], site
        best = minimize_scalar(
            lambda ratio, own=own: -mixed(ratio, *own)[0], bounds=(0, 20), options={"xatol": 1e-9}
        )
        _, estimate, se, between = mixed(best.x, *own)
        assert found.estimate[point] == pytest.approx(estimate, abs=1e-5)
        assert found.se[point] == pytest.approx(se, rel=1e-3)
        assert tau2[point] == pytest.approx(between, rel=1e-3)
    assert tau2[3] > 1
    assert tau2[0] < 0.2
    assert (found.df == 2).all()


def test_two_stages_combine_the_sites_own_estimates(people):
    matrix, values, site = people
    fits = [fit_of(matrix[site == i], values[site == i]) for i in range(3)]
    found = meta_analyze(fits, [np.array([0.0, 1.0, 0.0])] * 3, 0, MetaSettings(model="two-stage"))
    own = combine(found.estimates, found.ses**2, "reml", test="modified")
    np.testing.assert_allclose(found.random.se, own.se)
    plain = 1 / np.sqrt(np.sum(1 / found.ses**2, axis=0))
    np.testing.assert_allclose(found.fixed.se, plain)


def test_without_a_site_is_the_analysis_of_the_others(people):
    matrix, values, site = people
    fits = [fit_of(matrix[site == i], values[site == i]) for i in range(3)]
    weights = [np.array([0.0, 1.0, 0.0])] * 3
    found = meta_analyze(fits, weights, 0, MetaSettings())
    rest = meta_analyze(fits[1:], weights[1:], 0, MetaSettings())
    np.testing.assert_allclose(found.without[0].random.estimate, rest.random.estimate)
    np.testing.assert_allclose(found.without[0].fixed.se, rest.fixed.se)
    assert rest.without == []


def test_contrasts_with_the_constant_are_combined_by_inverse_variances(people):
    """A constant per site leaves nothing to say about the mean."""
    matrix, values, site = people
    fits = [fit_of(matrix[site == i], values[site == i]) for i in range(3)]
    weights = [matrix[site == i].mean(axis=0) for i in range(3)]
    found = meta_analyze(fits, weights, 0, MetaSettings())
    variances = found.ses**2
    assert found.fixed.se == pytest.approx(1 / np.sqrt(np.sum(1 / variances, axis=0)))


def test_levels_hold_where_the_model_does():
    """Shares of p below 0.05 among tests of nothing; the fixed effect fails where sites differ."""
    random = np.random.default_rng(0)
    contrast = np.array([0.0, 1.0, 0.0])
    for tau in (0.0, 0.3):
        fits = []
        for _ in range(5):
            matrix = np.column_stack([np.ones(40), np.arange(40) % 2, random.normal(size=40)])
            effect = tau * random.normal(size=3000)
            fits.append(fit_of(matrix, random.normal(size=(40, 3000)) + matrix[:, [1]] * effect))
        found = meta_analyze(fits, [contrast] * 5, 0, MetaSettings(), leave_out=False)
        plain = combine(found.estimates, found.ses**2, "reml", test="plain")
        assert np.mean(plain.p < 0.05) == pytest.approx(0.05, abs=0.015)
        assert np.mean(found.random.p < 0.05) < 0.035
        assert 0.1 < np.mean(found.random.tau2 == 0) < 0.8
        share = np.mean(found.fixed.p < 0.05)
        assert share > 0.12 if tau else share == pytest.approx(0.05, abs=0.015)
