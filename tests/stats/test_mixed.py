"""Random-intercept models: exact answers of balanced designs, statsmodels, and error rates."""

import warnings

import numpy as np
import pytest
from scipy import stats
from statsmodels.regression.mixed_linear_model import MixedLM

from hipsta_bids.errors import ModelError
from hipsta_bids.stats import random_slope
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.glm import fit_points
from hipsta_bids.stats.mixed import CORRELATIONS, MAX_CORRELATION, fit_mixed
from hipsta_bids.stats.settings import GlmSettings, LongitudinalSettings

SETTINGS = LongitudinalSettings()


def case(seed=0, people=24, sessions=3, points=5, *, between=0.3, balanced=True):
    """Group differs between participants, time within them."""
    random = np.random.default_rng(seed)
    who = np.repeat(np.arange(people), sessions)
    time = np.tile(np.arange(sessions), people).astype(float)
    group = (who % 2).astype(float)
    own = between * random.standard_normal((people, points))
    maps = 2.0 - 0.05 * time[:, None] + own[who] + 0.1 * random.standard_normal((len(who), points))
    matrix = np.column_stack([np.ones(len(who)), group, time])
    if not balanced:
        kept = random.random(len(who)) < 0.7
        who, maps, matrix = who[kept], maps[kept], matrix[kept]
    return np.array([f"sub-{i:02d}" for i in who]), matrix, maps


def single(columns):
    return [Contrast(f"b{i}", np.eye(columns)[i]) for i in range(columns)]


def test_balanced_design_gives_exact_tests():
    """Between participants: the t test of their means. Within: the one with participants fixed."""
    who, matrix, maps = case()
    fit = fit_mixed(maps, matrix, who, single(3), SETTINGS)
    means = maps.reshape(24, 3, -1).mean(axis=1)
    group = np.arange(24) % 2 == 1
    between = stats.ttest_ind(means[group], means[~group])
    # The search stops at 2^-50 of an interval; sums of squares lose some digits on the way.
    np.testing.assert_allclose(fit.tests[1].statistic, between.statistic, rtol=1e-6)
    np.testing.assert_allclose(fit.tests[1].df, 22, rtol=1e-4)
    np.testing.assert_allclose(fit.tests[1].p, between.pvalue, rtol=1e-4)
    fixed = np.column_stack([np.arange(72)[:, None] // 3 == np.arange(24), matrix[:, 2]])
    (within,) = fit_points(
        maps, fixed.astype(float), [Contrast("t", np.eye(25)[24])], GlmSettings()
    ).tests
    np.testing.assert_allclose(fit.tests[2].statistic, within.statistic, rtol=1e-6)
    np.testing.assert_allclose(fit.tests[2].df, 47, rtol=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_unbalanced_design_agrees_with_statsmodels(seed):
    who, matrix, maps = case(seed, balanced=False)
    fit = fit_mixed(maps, matrix, who, single(3), SETTINGS)
    for point in range(maps.shape[1]):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            other = MixedLM(maps[:, point], matrix, who).fit(reml=True, method="lbfgs", gtol=1e-9)
        # The accuracy of that optimizer, about 1e-6 of the ratio of variances.
        np.testing.assert_allclose(fit.coefficients[:, point], other.fe_params, rtol=1e-4)
        np.testing.assert_allclose(fit.variances["residual"][point], other.scale, rtol=1e-4)
        np.testing.assert_allclose(
            fit.variances["participant"][point], other.cov_re[0, 0], rtol=1e-4
        )
        # statsmodels takes errors from the joint Hessian; lme4, and this, from X' V^-1 X.
        same = (who[:, None] == who).astype(float)
        v = other.scale * np.eye(len(who)) + other.cov_re[0, 0] * same
        errors = np.sqrt(np.diag(np.linalg.inv(matrix.T @ np.linalg.inv(v) @ matrix)))
        np.testing.assert_allclose([test.se[0, point] for test in fit.tests], errors, rtol=1e-4)


def test_degrees_of_freedom_are_those_of_numerical_derivatives():
    """Satterthwaite's definition with the restricted likelihood written out."""
    who, matrix, maps = case(4, people=12, balanced=False, points=1)
    y = maps[:, 0]
    same = (who[:, None] == who).astype(float)

    def parts(theta):
        residual, between = np.exp(theta)
        v = residual * np.eye(len(y)) + between * same
        inverse = np.linalg.inv(v)
        information = matrix.T @ inverse @ matrix
        beta = np.linalg.solve(information, matrix.T @ inverse @ y)
        left = y - matrix @ beta
        loss = np.linalg.slogdet(v)[1] + np.linalg.slogdet(information)[1] + left @ inverse @ left
        return loss, np.linalg.inv(information)

    fit = fit_mixed(maps, matrix, who, single(3), SETTINGS)
    best = np.log([fit.variances["residual"][0], fit.variances["participant"][0]])
    step = 1e-3
    shift = step * np.eye(2)
    gradient = [(parts(best + d)[0] - parts(best - d)[0]) / (2 * step) for d in shift]
    np.testing.assert_allclose(gradient, 0, atol=1e-4)  # it is the optimum
    hessian = np.array(
        [
            [
                parts(best + a + b)[0]
                - parts(best + a - b)[0]
                - parts(best - a + b)[0]
                + parts(best - a - b)[0]
                for a in shift
            ]
            for b in shift
        ]
    ) / (4 * step**2)
    covariance = 2 * np.linalg.inv(hessian)
    for i, test in enumerate(fit.tests):
        value = parts(best)[1][i, i]
        slope = np.array(
            [(parts(best + d)[1][i, i] - parts(best - d)[1][i, i]) / (2 * step) for d in shift]
        )
        expected = 2 * value**2 / (slope @ covariance @ slope)
        assert test.se[0, 0] == pytest.approx(np.sqrt(value), rel=1e-6)
        assert test.df[0] == pytest.approx(expected, rel=1e-3)  # steps of .001


def test_no_variance_between_participants_gives_the_linear_model():
    who, matrix, maps = case(5, between=0.0, points=40)
    fit = fit_mixed(maps, matrix, who, single(3), SETTINGS)
    zero = fit.variances["participant"] == 0
    assert 0.3 < zero.mean() < 0.8  # about half the time the estimate is at the bound
    plain = fit_points(maps, matrix, single(3), GlmSettings())
    for mixed, linear in zip(fit.tests, plain.tests, strict=True):
        np.testing.assert_allclose(
            mixed.statistic[zero], linear.statistic[zero], rtol=1e-8
        )  # rounding
        np.testing.assert_array_equal(mixed.df[zero], 69)


def test_variances_of_a_balanced_design_are_those_of_mean_squares():
    """Restricted likelihood gives the analysis of variance's, zero where that is negative."""
    who, matrix, maps = case(5, between=0.02, points=60)
    fit = fit_mixed(maps, matrix, who, single(3), SETTINGS)
    means = maps.reshape(24, 3, -1).mean(axis=1)
    left = means - np.stack([means[::2].mean(axis=0), means[1::2].mean(axis=0)])[np.arange(24) % 2]
    fixed = np.column_stack([np.arange(72)[:, None] // 3 == np.arange(24), matrix[:, 2]])
    within = np.linalg.lstsq(fixed.astype(float), maps, rcond=None)[1] / (72 - 25)
    between = np.sum(left**2, axis=0) / (24 - 2) - within / 3
    expected = np.maximum(between, 0)
    # Some estimates lie between zero and half the first step of the grid that is searched.
    share = expected / (expected + within)
    step = MAX_CORRELATION / (CORRELATIONS - 1)
    assert ((share > 0) & (share < step / 2)).any()
    np.testing.assert_allclose(fit.variances["participant"], expected, atol=1e-9)  # of .01


def test_missing_values_give_the_fit_of_those_present():
    who, matrix, maps = case(6, points=12)
    random = np.random.default_rng(6)
    maps[random.random(maps.shape) < 0.15] = np.nan
    maps[:, 0] = np.nan
    maps[matrix[:, 2] > 0, 1] = np.nan  # nobody has two sessions
    fit = fit_mixed(maps, matrix, who, single(3), SETTINGS)
    assert np.isnan(fit.tests[1].p[:2]).all()
    for point in range(2, 12):
        present = np.isfinite(maps[:, point])
        alone = fit_mixed(
            maps[present, point, None], matrix[present], who[present], single(3), SETTINGS
        )
        assert fit.n[point] == present.sum()
        for test, one in zip(fit.tests, alone.tests, strict=True):
            # Orthonormal coordinates differ, and with them the rounding of the search.
            assert test.statistic[point] == pytest.approx(one.statistic[0], rel=1e-6)
            assert test.df[point] == pytest.approx(one.df[0], rel=1e-5)


@pytest.mark.slow
def test_error_rates_are_kept_in_small_samples():
    """Taking sessions for participants would reject a group effect far too often."""
    who, matrix, maps = case(7, people=10, points=4000)
    mixed = fit_mixed(maps, matrix, who, single(3), SETTINGS)
    linear = fit_points(maps, matrix, single(3), GlmSettings())
    # Binomial SD .0034; three of them.
    assert (mixed.tests[1].p < 0.05).mean() == pytest.approx(0.05, abs=0.0105)
    assert (linear.tests[1].p < 0.05).mean() > 0.15
    time = mixed.tests[2]
    inside = np.abs(time.estimate[0] + 0.05) < stats.t.ppf(0.975, time.df) * time.se[0]
    assert inside.mean() == pytest.approx(0.95, abs=0.0105)


def test_two_sessions_give_the_paired_t_test():
    who, matrix, maps = case(8, sessions=2)
    fit = fit_mixed(maps, matrix, who, single(3), SETTINGS)
    expected = stats.ttest_1samp(maps[1::2] - maps[::2], 0)
    np.testing.assert_allclose(fit.tests[2].statistic, expected.statistic, rtol=1e-6)
    np.testing.assert_allclose(fit.tests[2].p, expected.pvalue, rtol=1e-4)


def test_refusals():
    who, matrix, maps = case(9)
    cases = {
        "no participant has two sessions": (maps[::3], matrix[::3, :2], who[::3], single(2)),
        "both need as many rows": (maps, matrix[1:], who, single(3)),
        "not independent": (maps, matrix[:, [0, 1, 1]], who, single(3)),
    }
    for message, arguments in cases.items():
        with pytest.raises(ModelError, match=message):
            fit_mixed(*arguments, SETTINGS)


def slope_case(seed=0, people=30, slope_sd=0.1, points=4, missing=0.0):
    """Participants differ in intercept and slope; groups in neither."""
    random = np.random.default_rng(seed)
    who, time = np.repeat(np.arange(people), 4), np.tile([0.0, 1.0, 2.0, 3.5], people)
    group = (who % 2).astype(float)
    own = 0.3 * random.standard_normal((people, points))
    slopes = slope_sd * random.standard_normal((people, points))
    maps = 2.0 + own[who] + slopes[who] * time[:, None]
    maps += 0.1 * random.standard_normal(maps.shape)
    maps[random.random(maps.shape) < missing] = np.nan
    matrix = np.column_stack([np.ones(len(who)), group, time, group * time])
    return np.array([f"sub-{i:02d}" for i in who]), time, matrix, maps


def test_random_slopes_of_a_balanced_design_give_the_t_test_of_slopes():
    who, time, matrix, maps = slope_case()
    fit = fit_mixed(maps, matrix, who, single(4), SETTINGS, times=time)
    slopes = np.polyfit(time[:4], maps.reshape(30, 4, -1).swapaxes(0, 1).reshape(4, -1), 1)[0]
    slopes = slopes.reshape(30, -1)
    expected = stats.ttest_ind(slopes[1::2], slopes[::2])
    np.testing.assert_allclose(
        fit.tests[3].statistic, expected.statistic, rtol=1e-5
    )  # of the search
    np.testing.assert_allclose(fit.tests[3].df, 28, rtol=1e-4)  # numerical derivatives
    other = fit_mixed(maps, matrix, who, single(4), SETTINGS, times=10 * time + 3)
    np.testing.assert_allclose(fit.tests[3].p, other.tests[3].p, rtol=1e-4)
    np.testing.assert_allclose(fit.variances["slope"], 100 * other.variances["slope"], rtol=1e-4)


@pytest.mark.parametrize("missing", [0.0, 0.25])
def test_random_slopes_agree_with_statsmodels(missing):
    who, time, matrix, maps = slope_case(1, missing=missing)
    fit = fit_mixed(maps, matrix, who, single(4), SETTINGS, times=time)
    for point in range(maps.shape[1]):
        here = np.isfinite(maps[:, point])
        random = np.column_stack([np.ones(len(time)), time])[here]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            other = MixedLM(maps[here, point], matrix[here], who[here], exog_re=random).fit(
                reml=True, method="lbfgs", gtol=1e-9
            )
        # The accuracy of that optimizer, as above.
        np.testing.assert_allclose(fit.coefficients[:, point], other.fe_params, rtol=1e-4)
        np.testing.assert_allclose(fit.variances["residual"][point], other.scale, rtol=1e-4)
        np.testing.assert_allclose(fit.variances["slope"][point], other.cov_re[1, 1], rtol=1e-4)


@pytest.mark.slow
def test_slopes_that_differ_are_not_taken_for_a_change_of_all():
    """With random intercepts only, the error of the mean slope is too small."""
    who, time, matrix, maps = slope_case(2, people=16, points=300)
    slopes = fit_mixed(maps, matrix, who, single(4), SETTINGS, times=time).tests[3]
    intercepts = fit_mixed(maps, matrix, who, single(4), SETTINGS).tests[3]
    # Binomial SD .0126; three of them.
    assert (slopes.p < 0.05).mean() == pytest.approx(0.05, abs=0.038)
    assert (intercepts.p < 0.05).mean() > 0.15


@pytest.mark.slow
def test_slopes_are_tested_by_the_ratio_of_restricted_likelihoods():
    """Half chi squared with 1, half with 2 degrees of freedom."""
    who, time, matrix, maps = slope_case(4, slope_sd=0.0, points=300)
    none = fit_mixed(maps, matrix, who, single(4), SETTINGS, times=time)
    # Binomial SD .0126; three of them.
    assert (none.slopes_p < 0.05).mean() == pytest.approx(0.05, abs=0.038)
    some = fit_mixed(slope_case(4)[3], matrix, who, single(4), SETTINGS, times=time)
    assert (some.slopes_p < 0.001).all()
    plain = fit_mixed(maps, matrix, who, single(4), SETTINGS)
    assert plain.slopes_p is None
    # statsmodels' likelihoods of both models.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        both = np.column_stack([np.ones(len(time)), time])
        fits = [
            MixedLM(maps[:, 0], matrix, who, exog_re=own).fit(reml=True, method="lbfgs", gtol=1e-9)
            for own in (both[:, :1], both)
        ]
    ratio = max(2 * (fits[1].llf - fits[0].llf), 0.0)
    expected = (stats.chi2.sf(ratio, 1) + stats.chi2.sf(ratio, 2)) / 2
    assert none.slopes_p[0] == pytest.approx(expected, abs=2e-3)  # of that optimizer


def test_slopes_without_enough_sessions():
    who, time, matrix, maps = slope_case(3)
    two = time < 1.5
    with pytest.raises(ModelError, match="three sessions"):
        fit_mixed(maps[two], matrix[two], who[two], single(4), SETTINGS, times=time[two])
    maps[:, 1] = np.nan
    maps[~two, 2] = np.nan
    found = fit_mixed(maps, matrix, who, single(4), SETTINGS, times=time).tests[3]
    np.testing.assert_array_equal(np.isnan(found.p), [False, True, True, False])
    none = np.full_like(maps, np.nan)
    assert np.isnan(fit_mixed(none, matrix, who, single(4), SETTINGS, times=time).tests[0].p).all()


@pytest.mark.parametrize("slopes", [False, True])
def test_f_of_groups_in_a_balanced_design_is_analysis_of_variance(slopes):
    """Of participants' means with random intercepts, and of their slopes with random slopes."""
    random = np.random.default_rng(5)
    people, visits, points = 24, 4, 30
    group, who = np.repeat(np.arange(people) % 3, visits), np.repeat(np.arange(people), visits)
    times = np.tile(np.arange(visits, dtype=float) - 1.5, people)
    own = random.normal(0, 1.0, (2, people, points))
    maps = own[0][who] + own[1][who] * times[:, None]
    maps += random.normal(0, 0.2, maps.shape)
    if not slopes:
        maps -= own[1][who] * times[:, None]
    levels = np.column_stack([group == level for level in range(3)]).astype(float)
    matrix = np.hstack([levels, levels * times[:, None]])
    weights = np.zeros((2, 6))
    weights[:, 3 * slopes : 3 * slopes + 3] = [[1, -1, 0], [1, 0, -1]]
    (test,) = fit_mixed(
        maps,
        matrix,
        who.astype(str),
        [Contrast("any", weights)],
        LongitudinalSettings(),
        times=times if slopes else None,
    ).tests
    shape = maps.reshape(people, visits, points)
    line = times[:visits, None] / np.sum(times[:visits] ** 2)
    values = (shape * line).sum(axis=1) if slopes else shape.mean(axis=1)
    expected = stats.f_oneway(*(values[np.arange(people) % 3 == level] for level in range(3)))
    np.testing.assert_allclose(test.statistic, expected.statistic, rtol=1e-4)
    np.testing.assert_allclose(test.df, people - 3, rtol=1e-3)
    np.testing.assert_allclose(test.p, expected.pvalue, rtol=2e-3)


@pytest.mark.slow
def test_slopes_of_participants_keep_the_level_that_intercepts_exceed():
    random = np.random.default_rng(0)
    people, visits, points = 40, 4, 400
    who = np.repeat(np.arange(people), visits)
    times, group = np.tile(np.arange(visits, dtype=float), people), who % 2
    maps = random.normal(0, 1, (people, points))[who] + random.normal(0, 0.5, (len(who), points))
    maps += random.normal(0, 0.2, (people, points))[who] * times[:, None]
    matrix = np.column_stack([np.ones(len(who)), group, times, group * times])
    contrast = Contrast("difference of changes", np.array([0.0, 0, 0, 1]))
    shares = [
        float(np.mean(fit.tests[0].p < 0.05))
        for own in (None, times)
        for fit in [
            fit_mixed(maps, matrix, who.astype(str), [contrast], LongitudinalSettings(), times=own)
        ]
    ]
    # Of 400 tests of nothing, 20 with an SD of 4.4 are expected.
    assert shares[0] > 0.08
    assert shares[1] == pytest.approx(0.05, abs=0.025)


def test_second_derivatives_of_a_quadratic_function_are_its_matrix():
    matrix = np.array([[2.0, -1.0, 0.5], [-1.0, 3.0, 0.7], [0.5, 0.7, -4.0]])
    at = np.array([[0.3, -0.2, 1.0], [2.0, 0.1, -0.4]])

    def value(point):
        return np.einsum("pi,ij,pj->p", point, matrix, point) / 2 + point @ [5.0, 1.0, -2.0]

    values = np.array([value(near) for near in at + random_slope._CROSS])
    np.testing.assert_allclose(random_slope._bend(values), [matrix, matrix], atol=1e-7)
