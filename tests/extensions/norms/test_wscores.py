"""Normative scores: the definition by refitting, no leakage, and calibrated p-values."""

import numpy as np
import pytest
from scipy import stats
from statsmodels.regression.linear_model import OLS

from hipsta_bids.errors import ModelError
from hipsta_bids.extensions.norms.wscores import w_scores
from hipsta_bids.stats.settings import GlmSettings

SETTINGS = GlmSettings()


def case(seed=0, n=50, points=6):
    random = np.random.default_rng(seed)
    matrix = np.column_stack([np.ones(n), random.normal(70, 8, n), random.integers(0, 2, n)])
    maps = 2.5 - 0.01 * matrix[:, 1:2] + 0.2 * random.standard_normal((n, points))
    return random, matrix, maps, np.arange(n) < 30


def by_refitting(maps, matrix, reference, subject):
    """Score of one subject against the reference group without it."""
    others = reference & (np.arange(len(reference)) != subject)
    scores = []
    for column in maps.T:
        used = others & np.isfinite(column)
        beta = np.linalg.lstsq(matrix[used], column[used], rcond=None)[0]
        left = column[used] - matrix[used] @ beta
        sigma = np.sqrt(left @ left / (used.sum() - matrix.shape[1]))
        scores.append((column[subject] - matrix[subject] @ beta) / sigma)
    return np.array(scores)


@pytest.mark.parametrize("missing", [False, True])
def test_every_subject_is_scored_against_others_only(missing):
    random, matrix, maps, reference = case()
    if missing:
        maps[random.random(maps.shape) < 0.1] = np.nan
    found = w_scores(maps, matrix, reference, SETTINGS)
    for subject in range(len(maps)):
        expected = by_refitting(maps, matrix, reference, subject)
        np.testing.assert_allclose(found.w[subject], expected, rtol=1e-8)  # rounding
    np.testing.assert_array_equal(np.isnan(found.w), np.isnan(maps))


def test_p_values_are_those_of_statsmodels():
    """Of members, externally studentized residuals; of others, the error of a prediction."""
    _, matrix, maps, reference = case(5)
    found = w_scores(maps, matrix, reference, SETTINGS)
    for point in range(maps.shape[1]):
        fit = OLS(maps[reference, point], matrix[reference]).fit()
        inside = fit.get_influence().resid_studentized_external
        new = fit.get_prediction(matrix[~reference])
        outside = (maps[~reference, point] - new.predicted_mean) / new.se_obs
        expected = [2 * stats.t.sf(abs(inside), 26), 2 * stats.t.sf(abs(outside), 27)]
        np.testing.assert_allclose(found.p[reference, point], expected[0], rtol=1e-9)
        np.testing.assert_allclose(found.p[~reference, point], expected[1], rtol=1e-9)


def test_a_subject_cannot_hide_in_the_reference_group():
    _, matrix, maps, reference = case(1)
    maps[4] -= 5.0
    members = reference.copy()
    members[4] = False
    inside = w_scores(maps, matrix, reference, SETTINGS).w[4]
    outside = w_scores(maps, matrix, members, SETTINGS).w[4]
    np.testing.assert_allclose(inside, outside, rtol=1e-8)  # rounding


def test_p_values_are_uniform_inside_and_outside_the_reference_group():
    _, matrix, maps, reference = case(2, points=400)
    p = w_scores(maps, matrix, reference, SETTINGS).p
    for part in (p[reference], p[~reference]):
        # Subjects share a reference: one column of each is independent.
        share = (part < 0.05).mean()
        assert share == pytest.approx(0.05, abs=0.01)  # SD .003 with the dependence
    assert stats.kstest(p[40], "uniform").pvalue > 0.01  # one in a hundred; the seed is fixed
    assert stats.kstest(p[4], "uniform").pvalue > 0.01


def test_unequal_variances_are_refused():
    _, matrix, maps, reference = case(3)
    with pytest.raises(ModelError, match="ordinary"):
        w_scores(maps, matrix, reference, GlmSettings(covariance="hc3"))


def test_refusals():
    _, matrix, maps, reference = case(4)
    few = np.arange(50) < 6
    same = matrix.copy()
    same[reference, 2] = 1.0
    for message, arguments in {
        "reference subjects are too few": (maps, matrix, few),
        "not independent": (maps, same, reference),
    }.items():
        with pytest.raises(ModelError, match=message):
            w_scores(*arguments, SETTINGS)
