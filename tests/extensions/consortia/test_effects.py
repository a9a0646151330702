"""Estimates of several sites become one: published values, and statsmodels."""

import numpy as np
import pytest
from statsmodels.stats.meta_analysis import combine_effects

from hipsta_bids.extensions.consortia.effects import combine, meta_analyze
from hipsta_bids.extensions.consortia.settings import MetaSettings

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
    plain = combine(estimates, variances, "dl", test="knha")
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
        combine(alike, variances, "reml", test=test) for test in ("z", "knha", "adhoc")
    )
    assert plain.se[0] < 0.1 * normal.se[0]
    assert modified.se[0] == pytest.approx(normal.se[0])
    assert modified.p[0] > normal.p[0]  # t with four degrees of freedom
    apart = [combine(*bcg, "reml", test=test).se[0] for test in ("knha", "adhoc")]
    np.testing.assert_allclose(apart, 0.1808, atol=5e-5)


def test_too_few_sites_give_nothing():
    estimates = np.array([[1.0, 1.0], [np.nan, 1.2], [np.nan, 1.1]])
    found = combine(estimates, np.ones((3, 2)), "reml")
    assert np.isnan(found.estimate[0])
    assert np.isnan(found.p[0])
    assert found.estimate[1] == pytest.approx(1.1)
    assert np.isnan(found.prediction(0.95)[0][0])


def test_knapp_hartung_limits_of_the_bcg_trials_are_those_of_metafor(bcg):
    """``rma(yi, vi, data=dat.bcg, test="knha")`` of its manual: -0.7145, 0.1808, t -3.9522 of 12
    degrees of freedom, limits -1.1084 and -0.3206, p 0.0019."""
    found = combine(*bcg, "reml", test="knha")
    low, high = found.limits(0.95)
    values = np.concatenate([found.estimate, found.se, found.statistic, low, high, found.p])
    published = [-0.7145, 0.1808, -3.9522, -1.1084, -0.3206, 0.0019]
    np.testing.assert_allclose(values, published, atol=5e-5)
    assert found.df[0] == 12


@pytest.fixture(scope="module")
def sites():
    """Estimates, their errors, residual SDs and degrees of freedom of three sites, four points."""
    random = np.random.default_rng(1)
    df = np.array([27, 21, 38])
    sds = np.sqrt(random.chisquare(df[:, None], (3, 4)) / df[:, None])
    ses = sds * np.array([0.37, 0.42, 0.31])[:, None]
    return random.normal(0.3, ses), ses, sds, df


def test_the_default_is_the_fixed_effect_and_reml_with_limits_of_knapp_and_hartung(sites):
    estimates, ses, sds, df = sites
    found = meta_analyze(*sites, MetaSettings())
    weights = 1 / ses**2
    np.testing.assert_allclose(
        found.fixed.estimate, np.sum(weights * estimates, axis=0) / weights.sum(axis=0)
    )
    np.testing.assert_allclose(found.fixed.se, 1 / np.sqrt(weights.sum(axis=0)))
    np.testing.assert_allclose(found.fixed.q, found.random.q)
    random = combine(estimates, ses**2, "reml", test="knha")
    np.testing.assert_allclose(found.random.se, random.se)
    np.testing.assert_allclose(found.sd, np.sqrt(df @ sds**2 / df.sum()))
    adhoc = meta_analyze(*sites, MetaSettings(random="reml-adhoc")).random
    plain = combine(estimates, ses**2, "reml").se
    np.testing.assert_allclose(adhoc.se, np.maximum(random.se, plain))
    assert (adhoc.se > random.se).any()


def test_without_a_site_is_the_analysis_of_the_others(sites):
    found = meta_analyze(*sites, MetaSettings())
    rest = meta_analyze(*(values[1:] for values in sites), MetaSettings())
    np.testing.assert_allclose(found.without[0].random.estimate, rest.random.estimate)
    np.testing.assert_allclose(found.without[0].fixed.se, rest.fixed.se)
    assert rest.without == []


def test_levels_hold_where_the_model_does():
    """Shares of p below 0.05 among tests of nothing; the fixed effect fails where sites differ."""
    random = np.random.default_rng(0)
    df, size = np.full(5, 37), (5, 3000)
    for tau in (0.0, 0.3):
        sds = np.sqrt(random.chisquare(37, size) / 37)
        estimates = random.normal(0, np.sqrt(0.1 + tau**2), size)
        found = meta_analyze(
            estimates, np.sqrt(0.1) * sds, sds, df, MetaSettings(), leave_out=False
        )
        adhoc = combine(estimates, found.ses**2, "reml", test="adhoc")
        assert np.mean(found.random.p < 0.05) == pytest.approx(0.05, abs=0.015)
        assert np.mean(adhoc.p < 0.05) < 0.035
        assert 0.1 < np.mean(found.random.tau2 == 0) < 0.8
        share = np.mean(found.fixed.p < 0.05)
        # Errors of the sites are estimated, with 37 degrees of freedom each.
        assert share > 0.12 if tau else share == pytest.approx(0.06, abs=0.015)
