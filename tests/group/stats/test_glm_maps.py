"""Maps as covariates at each point: against statsmodels, and on planted and null cohorts."""

import numpy as np
import pytest
import statsmodels.api as sm

from hipsta_bids.errors import ModelError
from hipsta_bids.group.design.contrasts import Contrast
from hipsta_bids.group.design.settings import GlmSettings
from hipsta_bids.group.stats.glm import fit_points


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
