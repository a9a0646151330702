"""Random intercepts of sites: exact answers, an independent likelihood, statsmodels, and levels."""

import itertools
import warnings

import numpy as np
import pytest
from scipy import optimize, stats
from statsmodels.regression.mixed_linear_model import MixedLM, MixedLMParams

from hipsta_bids.extensions.multilevel.rows import NestedRows
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.design import Design
from hipsta_bids.stats.glm import fit_points
from hipsta_bids.stats.settings import GlmSettings

#: Yields of Dyestuff (Davies 1957), five of each batch, and what lme4 and lmerTest print for
#: ``Yield ~ 1 + (1 | Batch)`` (Bates et al. 2015).
DYESTUFF = (
    *(1545, 1440, 1440, 1520, 1580, 1540, 1555, 1490, 1560, 1495),
    *(1595, 1550, 1605, 1510, 1560, 1445, 1440, 1595, 1465, 1545),
    *(1595, 1630, 1515, 1635, 1625, 1520, 1455, 1450, 1480, 1445),
)


def fit_rows(values, matrix, levels, weights, covariates=None):
    """Fit values (rows, points), and test contrasts of these weights."""
    matrix = np.asarray(matrix, dtype=float)
    contrasts = tuple(Contrast(f"c{i}", np.atleast_2d(row)) for i, row in enumerate(weights))
    design = Design(
        matrix=matrix,
        columns=tuple(map(str, range(matrix.shape[1]))),
        rows=np.arange(len(matrix)),
        dropped={},
        references={},
        contrasts=contrasts,
        random=np.asarray(levels, dtype=np.str_),
    )
    rows = NestedRows(design, GlmSettings())
    return rows.fit(values, design.rows, contrasts, covariates)


def unbalanced(seed):
    """Sites of 1 to 14 participants; age and share of patients differ between them."""
    random = np.random.default_rng(seed)
    counts = random.integers(1, 15, random.integers(6, 12))
    site = np.repeat(np.arange(len(counts)), counts)
    group = random.random(len(site)) < random.uniform(0.2, 0.8, len(counts))[site]
    age = random.normal(random.normal(70, 4, len(counts))[site], 6)
    field = random.random(len(counts))[site] < 0.5
    field[site == 0], field[site == 1] = True, False
    matrix = np.column_stack([np.ones(len(site)), group, age - 70, field])
    effects = random.normal(0, random.uniform(0.05, 0.15), len(counts))[site]
    return matrix, site, 2 - 0.1 * group + effects + random.normal(0, 0.12, len(site))


class Dense:
    """The restricted likelihood of two variances, written out with whole matrices."""

    def __init__(self, matrix, site, values):
        self.matrix, self.values = matrix, values
        self.same = (site[:, None] == site).astype(float)

    def parts(self, residual, between):
        v = residual * np.eye(len(self.values)) + between * self.same
        inverse = np.linalg.inv(v)
        covariance = np.linalg.inv(self.matrix.T @ inverse @ self.matrix)
        projected = inverse - inverse @ self.matrix @ covariance @ self.matrix.T @ inverse
        return v, covariance, projected

    def loss(self, logs):
        """Minus twice the restricted log likelihood, of logarithms of the variances."""
        v, covariance, projected = self.parts(*np.exp(logs))
        determinants = np.linalg.slogdet(v)[1] - np.linalg.slogdet(covariance)[1]
        return determinants + self.values @ projected @ self.values

    def best(self):
        """Variances with the largest likelihood, by the root of its derivative."""
        df = len(self.values) - self.matrix.shape[1]

        def slope(ratio):
            _, _, p = self.parts(1.0, ratio)
            left = p @ self.values
            return np.trace(p @ self.same) - df * (left @ self.same @ left) / (self.values @ left)

        ratio = optimize.brentq(slope, 1e-6, 1e3, xtol=1e-15, rtol=1e-14)
        residual = self.values @ self.parts(1.0, ratio)[2] @ self.values / df
        return residual, residual * ratio

    def freedom(self, logs, row):
        """Satterthwaite's degrees of freedom, by numerical derivatives as lmerTest has them."""

        def variance(at):
            return row @ self.parts(*np.exp(at))[1] @ row

        steps = np.eye(2)
        gradient = [
            extrapolate(lambda h, e=e: (variance(logs + h * e) - variance(logs - h * e)) / (2 * h))
            for e in steps
        ]
        hessian = [[self.curvature(logs, a, b) for a in steps] for b in steps]
        covariance = 2 * np.linalg.inv(hessian)
        return 2 * variance(logs) ** 2 / (gradient @ covariance @ gradient)

    def curvature(self, logs, a, b):
        def mixed(h):
            corners = [
                (s, t, self.loss(logs + h * (s * a + t * b))) for s in (1, -1) for t in (1, -1)
            ]
            return sum(s * t * loss for s, t, loss in corners) / (4 * h**2)

        return extrapolate(mixed)


def extrapolate(difference, step=0.08):
    """Remove the errors of order 2, 4 and 6 of central differences (Richardson 1911)."""
    values = [difference(step / 2**k) for k in range(4)]
    for order in (4, 16, 64):
        values = [(order * b - a) / (order - 1) for a, b in itertools.pairwise(values)]
    return values[0]


@pytest.mark.parametrize("seed", range(20))
def test_unbalanced_designs_have_the_values_of_lmer(seed):
    matrix, site, values = unbalanced(seed)
    rows = [*np.eye(4), np.array([0.3, 1, -2, 0.5])]
    fit = fit_rows(values[:, None], matrix, site, rows)
    dense = Dense(matrix, site, values)
    residual, between = dense.best()
    _, covariance, _ = dense.parts(residual, between)
    v = residual * np.eye(len(site)) + between * dense.same
    expected = np.linalg.solve(
        matrix.T @ np.linalg.solve(v, matrix), matrix.T @ np.linalg.solve(v, values)
    )
    np.testing.assert_allclose(fit.variances["residual"], residual, rtol=1e-7)
    np.testing.assert_allclose(fit.variances["participant"], between, rtol=1e-6)
    np.testing.assert_allclose(fit.coefficients[:, 0], expected, rtol=1e-6)
    np.testing.assert_allclose(fit.sigma, np.sqrt(residual), rtol=1e-7)
    for test, row in zip(fit.tests, rows, strict=True):
        se = np.sqrt(row @ covariance @ row)
        df = dense.freedom(np.log([residual, between]), row)
        np.testing.assert_allclose(test.se[0], se, rtol=1e-7)
        np.testing.assert_allclose(test.df, df, rtol=1e-6)
        np.testing.assert_allclose(test.statistic, row @ expected / se, rtol=1e-6)
        p = 2 * stats.t.sf(np.abs(test.statistic), test.df)
        np.testing.assert_allclose(test.p, p, rtol=1e-9)


@pytest.mark.parametrize("seed", range(20))
def test_unbalanced_designs_have_the_values_of_statsmodels(seed):
    """At the root of its score, which its optimizers stop short of."""
    matrix, site, values = unbalanced(seed)
    fit = fit_rows(values[:, None], matrix, site, np.eye(4))
    model = MixedLM(values, matrix, site)
    with warnings.catch_warnings(action="ignore"):  # of convergence
        model.fit(reml=True, method="bfgs")

    def at(ratio):
        relative = np.array([[ratio]])
        coefficients, _ = model.get_fe_params(relative, np.empty(0))
        return MixedLMParams.from_components(fe_params=coefficients, cov_re=relative)

    def score(ratio):
        return model.score_full(at(ratio), calc_fe=False)[1][0]

    ratio = optimize.brentq(score, 1e-3, 1e2, xtol=1e-14, rtol=1e-12)
    coefficients = at(ratio).fe_params
    scale = model.get_scale(coefficients, np.array([[ratio]]), np.empty(0))
    np.testing.assert_allclose(fit.variances["residual"], scale, rtol=1e-6)
    np.testing.assert_allclose(fit.variances["participant"], scale * ratio, rtol=1e-6)
    np.testing.assert_allclose(fit.coefficients[:, 0], coefficients, rtol=1e-6)


def test_dyestuff_has_the_published_values():
    """Bates et al. (2015) print 1764 and 2451; lmerTest 19.38 and 5 degrees of freedom."""
    batch = np.repeat(list("ABCDEF"), 5)
    values = np.array(DYESTUFF, dtype=float)[:, None]
    fit = fit_rows(values, np.ones((30, 1)), batch, np.eye(1))
    assert fit.variances["participant"][0] == pytest.approx(1764.05, abs=0.005)
    assert fit.variances["residual"][0] == pytest.approx(2451.25, abs=0.005)
    assert fit.coefficients[0, 0] == pytest.approx(1527.5)
    assert fit.tests[0].se[0, 0] == pytest.approx(19.383, abs=0.0005)
    assert fit.tests[0].df[0] == pytest.approx(5, rel=1e-6)


def test_balanced_sites_give_the_analysis_of_variance():
    """Between sites: the test of their means. Within: the test with fixed sites. F: of both."""
    random = np.random.default_rng(3)
    site = np.repeat(np.arange(12), 10)
    arm, dose = site % 3, np.tile(np.arange(10) % 5, 12)
    values = random.normal(2, 0.1, (120, 6)) + random.normal(0, 0.1, (12, 6))[site]
    matrix = np.column_stack([np.ones(120), arm == 1, arm == 2, dose])
    pair = np.eye(4)[1:3]
    fit = fit_rows(values, matrix, site, [np.eye(4)[1], np.eye(4)[3], pair])
    used = fit.variances["participant"] > 0
    assert used.sum() >= 4
    means = values.reshape(12, 10, -1).mean(axis=1)
    plain = fit_points(means, matrix[::10, :3], [Contrast("t", np.eye(3)[1])], GlmSettings())
    np.testing.assert_allclose(fit.tests[0].statistic[used], plain.tests[0].statistic[used])
    np.testing.assert_allclose(fit.tests[0].df[used], 9, rtol=1e-6)
    fixed = np.column_stack([np.eye(12)[site], dose])
    within = fit_points(values, fixed, [Contrast("t", np.eye(13)[12])], GlmSettings()).tests[0]
    np.testing.assert_allclose(fit.tests[1].statistic[used], within.statistic[used])
    np.testing.assert_allclose(fit.tests[1].df[used], 107, rtol=1e-6)
    np.testing.assert_allclose(
        fit.sigma[used], np.sqrt(np.linalg.lstsq(fixed, values, rcond=None)[1] / 107)[used]
    )
    f = stats.f_oneway(*(means[k::3] for k in range(3)))
    np.testing.assert_allclose(fit.tests[2].statistic[used], f.statistic[used])
    np.testing.assert_allclose(fit.tests[2].df[used], 9, rtol=1e-6)
    np.testing.assert_allclose(fit.tests[2].p[used], f.pvalue[used], rtol=1e-5)


def test_no_variance_between_sites_gives_the_linear_model():
    matrix, site, _ = unbalanced(1)
    values = np.random.default_rng(1).normal(2, 0.1, (len(site), 40))
    fit = fit_rows(values, matrix, site, np.eye(4))
    zero = fit.variances["participant"] == 0
    assert 0.2 < zero.mean() < 0.9
    plain = fit_points(values, matrix, [Contrast("c", row) for row in np.eye(4)], GlmSettings())
    for mixed, linear in zip(fit.tests, plain.tests, strict=True):
        np.testing.assert_allclose(mixed.statistic[zero], linear.statistic[zero], rtol=1e-8)
        np.testing.assert_array_equal(mixed.df[zero], len(site) - 4)


def test_points_with_missing_values_are_fitted_as_without_these_rows():
    """Sites are counted at each point; one site with a value leaves nothing to estimate."""
    matrix, site, column = unbalanced(2)
    random = np.random.default_rng(2)
    values = np.repeat(column[:, None], 30, axis=1) + random.normal(0, 0.02, (len(site), 30))
    values[random.random(values.shape) < 0.2] = np.nan
    values[site != site.max(), 0] = np.nan
    fit = fit_rows(values, matrix, site, np.eye(4))
    assert np.isnan(fit.sigma[0])
    for point in range(1, 30):
        known = np.isfinite(values[:, point])
        alone = fit_rows(values[known, point][:, None], matrix[known], site[known], np.eye(4))
        np.testing.assert_allclose(fit.sigma[point], alone.sigma[0], rtol=1e-8)
        for test, other in zip(fit.tests, alone.tests, strict=True):
            np.testing.assert_allclose(test.se[:, point], other.se[:, 0], rtol=1e-7)
            np.testing.assert_allclose(test.df[point], other.df[0], rtol=1e-6)


def test_points_where_fixed_terms_explain_the_sites_have_no_result():
    """Two sites remain at a point, one of each group: their difference is the group's."""
    site = np.repeat(np.arange(4), 8)
    matrix = np.column_stack([np.ones(32), site % 2])
    values = np.random.default_rng(4).normal(2, 0.1, (32, 2))
    values[site > 1, 0] = np.nan
    fit = fit_rows(values, matrix, site, np.eye(2))
    assert np.isnan(fit.tests[1].p[0])
    assert np.isfinite(fit.tests[1].p[1])


def test_maps_as_covariates_equal_columns_of_the_design():
    matrix, site, values = unbalanced(6)
    covariate = matrix[:, 2] - matrix[:, 2].mean()
    inside = fit_rows(values[:, None], matrix, site, np.eye(4))
    outside = fit_rows(
        values[:, None], matrix[:, [0, 1, 3]], site, np.eye(4), covariate[None, :, None]
    )
    np.testing.assert_allclose(outside.tests[3].statistic, inside.tests[2].statistic, rtol=1e-8)
    np.testing.assert_allclose(outside.tests[3].df, inside.tests[2].df, rtol=1e-6)


def test_level_holds_where_a_test_without_sites_does_not():
    """1,000 cohorts of six sites in which the share of patients and the wall differ."""
    random = np.random.default_rng(11)
    counts = np.array([60, 40, 30, 25, 15, 10])
    site = np.repeat(np.arange(6), counts)
    share = np.array([0.2, 0.7, 0.4, 0.8, 0.3, 0.6])[site]
    group = random.random(len(site)) < share
    matrix = np.column_stack([np.ones(len(site)), group])
    values = random.normal(0, 0.06, (6, 1000))[site] + random.normal(2, 0.12, (len(site), 1000))
    mixed = fit_rows(values, matrix, site, np.eye(2)).tests[1].p
    plain = fit_points(values, matrix, [Contrast("c", np.eye(2)[1])], GlmSettings()).tests[0].p
    assert np.mean(mixed < 0.05) == pytest.approx(0.05, abs=0.02)  # three standard errors
    assert np.mean(plain < 0.05) > 0.15
