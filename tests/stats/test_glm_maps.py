"""Maps as covariates at each point: against statsmodels, permutations, null and planted cohorts."""

import warnings
from itertools import permutations

import numpy as np
import pytest
import statsmodels.api as sm
from statsmodels.regression.mixed_linear_model import MixedLM

from hipsta_bids.errors import ModelError
from hipsta_bids.stats.clusters import sheet_edges
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.glm import fit_points
from hipsta_bids.stats.inference import PermutationPart, permute
from hipsta_bids.stats.mixed import fit_mixed
from hipsta_bids.stats.settings import GlmSettings, LongitudinalSettings, MultiplicitySettings


def cohort(n=60, points=25, seed=0, r=0.0):
    """Groups and ages, a covariate map and a map that correlates with it by r at each point."""
    random = np.random.default_rng(seed)
    matrix = np.column_stack([np.ones(n), np.arange(n) % 2, random.normal(70, 8, n)])
    covariate = random.normal(2, 0.3, (n, points)) + 0.01 * matrix[:, [2]]
    unit = (covariate - covariate.mean(axis=0)) / covariate.std(axis=0)
    maps = r * unit + np.sqrt(1 - r**2) * random.standard_normal((n, points))
    return maps + 0.3 * matrix[:, [1]], matrix, covariate


CONTRASTS = (
    Contrast("group", [[0, 1, 0]]),
    Contrast("map", [[0, 0, 0, 1, 0]]),
    Contrast("any", [[0, 1, 0, 0, 0], [0, 0, 0, 1, 0], [0, 0, 0, 0, 1]]),
)


@pytest.mark.parametrize("kind", ["ordinary", "hc3"])
def test_each_point_is_the_model_of_statsmodels(kind):
    maps, matrix, covariate = cohort(r=0.4)
    second = np.random.default_rng(9).standard_normal(covariate.shape) * 1000 + covariate
    maps[3, :10] = np.nan
    covariate[7, 5:15] = np.nan
    fit = fit_points(
        maps, matrix, CONTRASTS, GlmSettings(covariance=kind), np.stack([covariate, second])
    )
    for point in range(maps.shape[1]):
        present = np.isfinite(maps[:, point]) & np.isfinite(covariate[:, point])
        design = np.column_stack([matrix, covariate[:, point], second[:, point]])[present]
        cov = "HC3" if kind == "hc3" else "nonrobust"
        expected = sm.OLS(maps[present, point], design).fit(cov_type=cov, use_t=True)
        assert fit.n[point] == present.sum()
        np.testing.assert_allclose(fit.coefficients[1:, point], expected.params[1:], rtol=1e-8)
        for test, contrast in zip(fit.tests, CONTRASTS, strict=True):
            weights = np.zeros((contrast.n_rows, 5))
            weights[:, : contrast.weights.shape[1]] = contrast.weights
            whole = expected.t_test(weights) if contrast.n_rows == 1 else expected.f_test(weights)
            assert test.statistic[point] == pytest.approx(np.ravel(whole.statistic)[0], rel=1e-8)
            assert test.p[point] == pytest.approx(np.ravel(whole.pvalue)[0], rel=1e-7)
            assert test.df[point] == expected.df_resid


def test_points_at_which_a_covariate_does_not_vary_are_left_out():
    maps, matrix, covariate = cohort()
    covariate[:, 4] = 2.0
    covariate[:, 6] = matrix[:, 2]  # the same as age
    fit = fit_points(maps, matrix, CONTRASTS[:1], GlmSettings(), covariate[None])
    assert np.flatnonzero(np.isnan(fit.sigma)).tolist() == [4, 6]
    assert np.isnan(fit.tests[0].p[[4, 6]]).all()


def test_weights_that_do_not_fit_are_refused():
    maps, matrix, covariate = cohort()
    contrast = Contrast("wide", [[0, 0, 0, 1, 0, 0]])
    with pytest.raises(ModelError, match="has 6 weights, the design 4 columns"):
        fit_points(maps, matrix, [contrast], GlmSettings(), covariate[None])


@pytest.mark.slow
def test_null_rate_and_planted_correlation():
    """200 cohorts without an effect, and a correlation of .4 in 100 participants."""
    contrast = Contrast("map", [[0, 0, 0, 1]])
    shares = []
    for seed in range(200):
        maps, matrix, covariate = cohort(points=20, seed=seed)
        (test,) = fit_points(maps, matrix, [contrast], GlmSettings(), covariate[None]).tests
        shares.append((test.p < 0.05).mean())
    assert 0.02 <= np.mean(shares) <= 0.08
    maps, matrix, covariate = cohort(n=100, points=400, seed=1, r=0.4)
    (test,) = fit_points(maps, matrix, [contrast], GlmSettings(), covariate[None]).tests
    assert (test.p < 0.05).mean() >= 0.8


GROUP_AND_MAP = CONTRASTS[0], Contrast("map", [[0, 0, 0, 1]])
RULES = MultiplicitySettings(method="permutation-tfce", permutations=6000)


def permuted(maps, matrix, covariate, contrast, rules):
    """Permutation test on a grid of 5 points along y."""
    edges = sheet_edges(maps.shape[1] // 5, 5)
    part = PermutationPart(maps, matrix, np.arange(len(maps)), edges, covariates=covariate[None])
    return permute([part], contrast, settings=rules)[0]


@pytest.mark.parametrize("contrast", [*GROUP_AND_MAP, Contrast("F", np.eye(4)[1:])])
def test_permutations_test_the_statistic_of_the_model(contrast):
    maps, matrix, covariate = cohort(r=0.4)
    covariate[:, 4] = 2.0  # no covariate there
    (test,) = fit_points(maps, matrix, [contrast], GlmSettings(), covariate[None]).tests
    found = permuted(maps, matrix, covariate, contrast, RULES.changed(permutations=2))
    np.testing.assert_allclose(found.statistic, test.statistic, rtol=1e-9)  # rounding
    assert np.flatnonzero(np.isnan(found.p_max)).tolist() == [4]


@pytest.mark.slow
def test_permutations_of_a_map_are_those_of_a_correlation():
    """Seven participants have 5040 orders; a fair sample of them has their p-value."""
    random = np.random.default_rng(3)
    covariate = random.standard_normal((7, 5))
    maps = 0.8 * covariate + random.standard_normal((7, 5))
    found = permuted(maps, np.ones((7, 1)), covariate, Contrast("map", [[0, 1]]), RULES)
    orders = np.array(list(permutations(range(7))))
    for point in range(5):
        unit = (covariate[:, point] - covariate[:, point].mean()) / covariate[:, point].std()
        r = np.abs(maps[orders, point] @ unit)
        # Three standard deviations of a share of 6000, at most .0194.
        exact = (r >= r[0] - 1e-9).mean()
        assert found.p_uncorrected[point] == pytest.approx(exact, abs=0.02)


@pytest.mark.slow
def test_permutations_refit_the_model_with_each_point_s_covariate():
    maps, matrix, covariate = cohort(n=80, seed=4, r=0.3)
    for contrast in GROUP_AND_MAP:
        (test,) = fit_points(maps, matrix, [contrast], GlmSettings(), covariate[None]).tests
        found = permuted(maps, matrix, covariate, contrast, RULES.changed(permutations=3000))
        # Four standard deviations of a share of 3000 (25 of them are compared).
        np.testing.assert_allclose(found.p_uncorrected, test.p, atol=0.037)


@pytest.mark.slow
@pytest.mark.parametrize("contrast", GROUP_AND_MAP)
def test_family_wise_error_with_maps_is_kept(contrast):
    smallest = []
    for seed in range(120):
        maps, matrix, covariate = cohort(n=24, seed=seed)
        maps -= 0.3 * matrix[:, [1]]
        maps += np.where(contrast.name == "map", 0, 2) * covariate
        found = permuted(
            maps, matrix, covariate, contrast, RULES.changed(permutations=40, seed=seed)
        )
        smallest.append((found.p_max.min(), found.p_enhanced.min()))
    rates = (np.array(smallest) <= 0.1).mean(axis=0)
    # Binomial SD .027 around .1; three of them.
    assert (rates <= 0.182).all(), rates
    assert (rates >= 0.018).all(), rates


def visits(seed=0, people=30, points=4):
    """Three visits, a covariate that changes between them, and a slope of .5 on it."""
    random = np.random.default_rng(seed)
    who, time = np.repeat(np.arange(people), 3), np.tile(np.arange(3.0), people)
    matrix = np.column_stack([np.ones(len(who)), who % 2, time])
    covariate = random.normal(0, 1, (people, points))[who] + random.normal(0, 1, (len(who), points))
    slopes = 0.3 * random.standard_normal((people, points))[who] * time[:, None]
    maps = 2 + random.normal(0, 0.6, (people, points))[who] + slopes + 0.5 * covariate
    maps += random.normal(0, 0.4, maps.shape)
    return np.array([f"sub-{i:02d}" for i in who]), time, matrix, maps, covariate


@pytest.mark.slow
@pytest.mark.parametrize("slopes", [False, True])
def test_a_mixed_model_has_the_covariate_of_each_point(slopes):
    who, time, matrix, maps, covariate = visits()
    maps[4, :2], covariate[11, 1:3] = np.nan, np.nan
    times = time if slopes else None
    contrasts = GROUP_AND_MAP
    settings = LongitudinalSettings()
    fit = fit_mixed(maps, matrix, who, contrasts, settings, times=times, covariates=covariate[None])
    for point in range(maps.shape[1]):
        kept = np.isfinite(maps[:, point]) & np.isfinite(covariate[:, point])
        design = np.column_stack([matrix, covariate[:, point]])[kept]
        wide = [Contrast("group", np.eye(4)[1]), Contrast("map", np.eye(4)[3])]
        here = None if times is None else times[kept]
        alone = fit_mixed(maps[kept, point, None], design, who[kept], wide, settings, times=here)
        for test, single in zip(fit.tests, alone.tests, strict=True):
            # The searches stop at different last digits.
            np.testing.assert_allclose(test.estimate[0, point], single.estimate[0, 0], rtol=1e-4)
            np.testing.assert_allclose(test.statistic[point], single.statistic[0], rtol=1e-4)
            np.testing.assert_allclose(test.df[point], single.df[0], rtol=1e-3)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of statsmodels, on its way to the optimum
            random = np.column_stack([np.ones(kept.sum()), time[kept]]) if slopes else None
            model = MixedLM(maps[kept, point], design, who[kept], exog_re=random)
            other = model.fit(reml=True, method="lbfgs", gtol=1e-9)
        # The accuracy of that optimizer; its standard errors are of the joint Hessian.
        assert fit.tests[1].estimate[0, point] == pytest.approx(other.fe_params[3], rel=1e-4)
        assert fit.variances["residual"][point] == pytest.approx(other.scale, rel=1e-3)
