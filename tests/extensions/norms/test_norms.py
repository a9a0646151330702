"""Norms against libraries and known truth: spline, mean and SD, shape, sites."""

from dataclasses import replace

import numpy as np
import statsmodels.api as sm
from scipy import integrate, interpolate, optimize, stats

from hipsta_bids.extensions.norms import centiles as norms_module
from hipsta_bids.extensions.norms.centiles import (
    People,
    age_columns,
    fit_norms,
    from_normal,
    to_normal,
)
from hipsta_bids.extensions.norms.settings import NormSettings

SETTINGS = NormSettings()
KNOTS = np.array([20.0, 35, 50, 70, 90])
SHAPES = np.array([[0.0, 0.8, -2.0, 0.3], [0.0, 0.0, -0.4, 0.5]])


def test_spline_has_every_natural_cubic_spline_of_its_knots():
    spline = interpolate.CubicSpline(KNOTS, [1.0, 3, -2, 0, 5], bc_type="natural")
    age = np.linspace(20, 90, 200)
    columns = np.column_stack([np.ones(200), age_columns(age, KNOTS)])
    assert columns.shape[1] == len(KNOTS)
    left = spline(age) - columns @ np.linalg.lstsq(columns, spline(age), rcond=None)[0]
    np.testing.assert_allclose(left, 0, atol=1e-10)


def test_distributions_have_mean_zero_and_sd_one_and_an_inverse():
    z = np.linspace(-3, 3, 13)[:, None] * np.ones(4)
    np.testing.assert_allclose(to_normal(from_normal(z, SHAPES), SHAPES), z, atol=1e-9)
    for shape in SHAPES.T[:, :, None]:
        moments = [
            integrate.quad(
                lambda z, k=k, s=shape: (
                    from_normal(np.array([[z]]), s)[0, 0] ** k * stats.norm.pdf(z)
                ),
                -12,
                12,
            )[0]
            for k in (1, 2)
        ]
        np.testing.assert_allclose(moments, [0, 1], atol=1e-7)


def test_mean_and_sd_are_those_of_statsmodels(cohort):
    values, people = cohort
    norms = fit_norms(values, people, 2, KNOTS, SETTINGS)
    mean, sd = norms.expected(people)
    mean = mean + norms.shift[people.site]
    sd = sd * norms.scale[people.site]
    member = np.eye(2)[people.site]
    design = np.column_stack([member, age_columns(people.age, KNOTS), people.sex])
    kept = 1 - np.sum(np.linalg.qr(design)[0] ** 2, axis=1)
    spread = np.column_stack([member, people.age])
    for point in range(5):
        weighted = sm.WLS(values[:, point], design, weights=sd[:, point] ** -2).fit()
        np.testing.assert_allclose(mean[:, point], weighted.fittedvalues, atol=1e-5)
        square = weighted.resid**2 / kept
        gamma = sm.GLM(square, spread, sm.families.Gamma(sm.families.links.Log())).fit()
        np.testing.assert_allclose(sd[:, point], np.sqrt(gamma.fittedvalues), rtol=1e-3)


def test_shape_is_the_most_likely_one_and_only_where_it_is_needed(monkeypatch):
    random = np.random.default_rng(1)
    n = 400
    people = People(age=random.uniform(20, 90, n), sex=np.zeros((n, 0)), site=np.zeros(n, int))
    shape = np.array([[0.6, 0.0], [-0.1, 0.0]])
    values = from_normal(random.standard_normal((n, 2)), shape)
    monkeypatch.setattr(norms_module, "SHAPE_LEVEL", 1e-3)
    norms = fit_norms(values, people, 1, KNOTS, SETTINGS)
    assert norms.shape[:, 1].tolist() == [0, 0]
    mean, sd = norms.expected(people)
    rest = ((values - mean) / sd)[:, 0]

    def loss(shape):
        shape = np.asarray(shape)[:, None]
        step = 1e-5
        up, down = (to_normal(rest[:, None] + s * step, shape) for s in (1, -1))
        slope = (up - down)[:, 0] / (2 * step)
        return -np.sum(stats.norm.logpdf(to_normal(rest[:, None], shape)[:, 0]) + np.log(slope))

    best = optimize.minimize(loss, [0.1, 0.1], method="Nelder-Mead", options={"fatol": 1e-7})
    np.testing.assert_allclose(norms.shape[:, 0], best.x, atol=0.01)


def test_missing_values_stay_local(cohort):
    values, people = cohort
    holes = values.copy()
    holes[people.site == 1, 1] = np.nan  # a site without values at a point
    holes[:, 2] = 1.0  # constant
    holes[:5, 3] = np.nan
    whole, norms = (fit_norms(one, people, 2, KNOTS, SETTINGS) for one in (values, holes))
    np.testing.assert_allclose(norms.mean[:, [0, 4]], whole.mean[:, [0, 4]], rtol=1e-6)
    assert np.isnan(norms.shift[1, 1])
    assert np.isfinite(norms.score(values, people)[people.site == 0, 1]).all()
    assert np.isnan(norms.score(values, people)[people.site == 1, 1]).all()
    assert np.isnan(norms.mean[:, 2]).all()
    fewer = fit_norms(values[5:, [3]], people.take(slice(5, None)), 2, KNOTS, SETTINGS)
    # Leverages are those of all people.
    np.testing.assert_allclose(norms.shift[:, 3], fewer.shift[:, 0], atol=0.01)
    assert norms.n[:, 3].tolist() == [65, 50]


def test_a_new_site_takes_its_shift_and_scale_from_controls(cohort):
    values, people = cohort
    norms = fit_norms(values, people, 2, KNOTS, SETTINGS)
    same = replace(people, site=people.site + 2)  # as if nobody knew these sites
    moved = norms.extended(values, same, 4, 25)
    np.testing.assert_allclose(moved.shift[2:], norms.shift, atol=0.01)
    np.testing.assert_allclose(moved.scale[2:], norms.scale, rtol=0.04)
    np.testing.assert_array_equal(moved.mean, norms.mean)
    # A site is known from its controls only: Student's distribution.
    mean, sd = moved.expected(same)
    r = (values - mean - moved.shift[same.site]) / (sd * moved.scale[same.site])
    n = np.array([0, 0, 70, 50])[same.site][:, None]
    wider = np.sqrt(1 + 1 / n + 5 / 240)  # five columns of age and sex
    p = stats.t.cdf(to_normal(r, moved.shape) / wider, n - 1)
    np.testing.assert_allclose(stats.norm.cdf(moved.score(values, same)), p, atol=1e-12)
    few = norms.extended(values[:80], same.take(slice(0, 80)), 4, 25)
    assert np.isnan(few.shift[3]).all()


def test_centiles_and_the_average_site_go_with_scores(cohort):
    values, people = cohort
    norms = fit_norms(values, people, 2, KNOTS, SETTINGS)
    low, middle, high = norms.centiles(people, (0.05, 0.5, 0.95))
    assert (low < middle).all()
    assert (middle < high).all()
    average = norms.average_site(values, people)
    z = norms.score(values, people)
    inside = np.abs(z - stats.norm.ppf(0.05)) > 0.05
    np.testing.assert_array_equal((average < low)[inside], (z < stats.norm.ppf(0.05))[inside])
