"""Norms from sums: against statsmodels, the norms of all values, and known truth at a new site."""

from dataclasses import replace

import numpy as np
import pytest
import statsmodels.api as sm
from scipy import stats

from hipsta_bids.extensions.norms.centiles import (
    LEVELS,
    NORM_ARRAYS,
    People,
    age_columns,
    fit_norms,
)
from hipsta_bids.extensions.norms.settings import NormSettings
from hipsta_bids.extensions.norms.sums import fit_sums, fit_values, sum_columns, sum_values

KNOTS = np.array([20.0, 40, 60, 85])
#: Shift in mm, and scale of the SD; the last site is new.
SITES = ((0.0, 1.0), (0.2, 1.3), (-0.1, 0.8), (0.3, 1.1), (0.1, 1.2))


def draw(random, sizes, points):
    """Values of sites by number: a curve of age, an SD that grows by 80 % over all ages."""
    site = np.repeat(list(sizes), list(sizes.values()))
    age = random.uniform(20, 85, len(site))
    sex = (np.arange(len(site)) % 2).astype(float)
    shift, scale = np.array(SITES)[site].T
    from_youngest = (age - 20) / 65
    sd = 0.1 * 1.8**from_youngest * scale
    mean = 2 - 0.4 * from_youngest**2 + 0.05 * sex + shift
    values = mean[:, None] + sd[:, None] * random.standard_normal((len(site), points))
    return values, People(age=age, sex=sex[:, None], site=site)


@pytest.fixture(scope="module")
def cohort():
    return draw(np.random.default_rng(4), {0: 70, 1: 90, 2: 60, 3: 80}, 300)


@pytest.fixture(scope="module")
def norms(cohort):
    return fit_values(*cohort, 4, KNOTS)


def test_mean_is_weighted_least_squares_of_statsmodels(cohort, norms):
    """Weights are inverse variances of sites, over all ages, with residual degrees of freedom."""
    values, people = cohort
    member = np.eye(4)[people.site]
    design = np.column_stack([member, age_columns(people.age, KNOTS), people.sex])
    expected = norms.expected(people)[0] + norms.shift[people.site]
    for point in range(3):
        variance = np.ones(4)
        for _ in range(60):
            fit = sm.WLS(values[:, point], design, weights=1 / variance[people.site]).fit()
            hat = np.sum(
                np.linalg.qr(design / np.sqrt(variance)[people.site, None])[0] ** 2, axis=1
            )
            variance = member.T @ fit.resid**2 / (member.sum(axis=0) - member.T @ hat)
        np.testing.assert_allclose(expected[:, point], fit.fittedvalues, atol=1e-8)


def test_spread_is_that_of_the_norms_of_all_values(cohort, norms):
    """Sums know as much of the SD and of its change over age, nearly, as the values themselves."""
    full = fit_norms(*cohort, 4, KNOTS, NormSettings())
    assert norms.spread[1].mean() == pytest.approx(np.log(1.8), abs=0.03)
    assert norms.spread[1].std() < 1.1 * full.spread[1].std()
    np.testing.assert_allclose(norms.scale.mean(axis=1), full.scale.mean(axis=1), rtol=0.01)
    shifts = np.array(SITES)[:4, 0] - np.average(np.array(SITES)[:4, 0], weights=norms.n[:, 0])
    errors = [np.std(fit.shift - shifts[:, None]) for fit in (norms, full)]
    assert errors[0] < 1.1 * errors[1] < 0.025
    assert (norms.shape == 0).all()


def test_sites_together_are_the_fit_of_all_values(cohort, norms):
    values, people = cohort
    columns, sums = [], []
    for site in (0, 1, 2, 3):
        rows = people.site == site
        alone = replace(people.take(rows), site=np.zeros(rows.sum(), dtype=int))
        order = np.random.default_rng(site).permutation(rows.sum())  # sums have no order
        columns.append(sum_columns(alone.take(order), 1, KNOTS))
        sums.append(sum_values(values[rows][order], alone.take(order), 1, KNOTS))
    merged = fit_sums(np.concatenate(columns), np.concatenate(sums), KNOTS)
    for name in NORM_ARRAYS:
        np.testing.assert_allclose(getattr(merged, name), getattr(norms, name), atol=1e-6)


def test_missing_values_stay_at_their_point_and_site(cohort, norms):
    values, people = cohort[0].copy(), cohort[1]
    values[people.site == 2, 0] = np.nan
    values[5, 1] = np.nan  # of site 0
    values[:, 2] = 1.5
    found = fit_values(values, people, 4, KNOTS)
    np.testing.assert_allclose(found.mean[:, 3:], norms.mean[:, 3:], atol=1e-9)
    assert np.isnan(found.shift[[2, 0], [0, 1]]).all()
    assert found.n[:, :3].T.tolist() == [[70, 90, 0, 80], [0, 90, 60, 80], [70, 90, 60, 80]]
    # Without site 2, the others are those of a cohort without it.
    rows = people.site != 2
    three = replace(people.take(rows), site=np.array([0, 1, 9, 2])[people.site[rows]])
    without = fit_values(values[rows, :1], three, 3, KNOTS)
    np.testing.assert_allclose(found.mean[:, 0], without.mean[:, 0], atol=1e-9)
    assert np.isnan(found.spread[1, 2])
    assert np.isnan(found.mean[1:, 2]).all()


def test_centiles_hold_at_a_new_site(norms):
    """Within two points: 4,000 people of a site whose shift and scale come from 60 controls."""
    random = np.random.default_rng(9)
    moved = norms.extended(*draw(random, {4: 60}, 300), 5, 25)
    scores = moved.score(*draw(random, {4: 4000}, 300))
    below = np.array([np.mean(scores < stats.norm.ppf(level)) for level in LEVELS])
    np.testing.assert_allclose(below, LEVELS, atol=0.02)
