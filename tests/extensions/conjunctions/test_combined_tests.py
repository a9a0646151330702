"""Conjunctions and equivalence against statsmodels and SciPy, on arrays."""

import numpy as np
import pytest
from scipy import stats
from statsmodels.stats.weightstats import ttost_ind

from hipsta_bids.errors import ModelError
from hipsta_bids.extensions.conjunctions import texts
from hipsta_bids.extensions.conjunctions.together import combine_tests
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.glm import fit_measures, fit_points
from hipsta_bids.stats.mixed import fit_mixed
from hipsta_bids.stats.settings import GlmSettings, LongitudinalSettings

GROUP = (0.0, 1.0)


def within(margin, weights=GROUP):
    return [Contrast("low", weights, "greater", -margin), Contrast("high", weights, "less", margin)]


def fitted(values, matrix, contrasts, fit=fit_points):
    return combine_tests("both", fit(values, matrix, contrasts, GlmSettings()).tests, 0.05)


@pytest.mark.parametrize("fit", [fit_points, fit_measures])
@pytest.mark.parametrize("margin", [0.1, 0.6, 3.0])
def test_equivalence_is_that_of_statsmodels(margin, fit):
    random = np.random.default_rng(1)
    values = random.standard_normal((31, 5)) + np.arange(5) / 4
    group = np.arange(31) % 3 == 0
    test = fitted(values, np.column_stack([np.ones(31), group]), within(margin), fit)
    for i, column in enumerate(values.T):
        exact, low, high = ttost_ind(column[group], column[~group], -margin, margin)
        np.testing.assert_allclose(test.p[i], exact, rtol=1e-8, atol=1e-12)
        statistic = low[0] if low[1] > high[1] else -high[0]
        np.testing.assert_allclose(test.statistic[i], statistic, rtol=1e-8)
    # The 90 % interval lies within the margin where p is below 5 %.
    limits = np.stack([test.further["limit_low"], test.further["limit_high"]])
    inside = (limits[0] > -margin) & (limits[1] < margin)
    np.testing.assert_array_equal(inside, test.p < 0.05)
    interval = stats.ttest_ind(values[group], values[~group]).confidence_interval(0.9)
    np.testing.assert_allclose(limits, interval)
    assert test.contrast.hypothesis == f"equivalent within {margin:g}"


def test_conjunction_has_the_largest_p():
    random = np.random.default_rng(2)
    x, z = random.standard_normal((2, 40))
    values = np.outer(x, np.linspace(-1, 1, 9)) + 0.3 * z[:, None]
    values += random.standard_normal(values.shape)
    matrix = np.column_stack([np.ones(40), x, z])
    contrasts = [Contrast("x", [0, 1.0, 0], "greater"), Contrast("z", [0, 0, 1.0], "less", 0.9)]
    singles = fit_points(values, matrix, contrasts, GlmSettings()).tests
    test = combine_tests("both", singles, 0.05)
    df = 37
    t = [
        singles[0].estimate[0] / singles[0].se[0],
        (singles[1].estimate[0] - 0.9) / singles[1].se[0],
    ]
    p = np.stack([stats.t.sf(t[0], df), stats.t.cdf(t[1], df)])
    np.testing.assert_allclose(test.p, p.max(axis=0), rtol=1e-10)
    np.testing.assert_allclose(test.statistic, np.minimum(t[0], -t[1]), rtol=1e-10)
    weakest = p.argmax(axis=0)
    assert set(weakest) == {0, 1}
    estimates = np.stack([single.estimate[0] for single in singles])
    np.testing.assert_array_equal(test.estimate[0], estimates[weakest, np.arange(9)])
    assert (test.kind, test.contrast.hypothesis) == ("t", "> 0 and < 0.9")


def test_a_missing_test_is_no_conjunction():
    random = np.random.default_rng(3)
    values = random.standard_normal((20, 2))
    matrix = np.column_stack([np.ones(20), np.arange(20) % 2])
    singles = fit_points(values, matrix, within(1.0), GlmSettings()).tests
    singles[0].p[0] = np.nan
    test = combine_tests("both", singles, 0.05)
    assert np.isnan(test.p[0])
    assert np.isfinite(test.p[1])


def test_mixed_models_have_conjunctions():
    """Each part has its degrees of freedom: between participants, and within them."""
    random = np.random.default_rng(4)
    people, time = np.repeat(np.arange(20), 3), np.tile([0.0, 1, 2], 20)
    values = random.standard_normal((20, 3))[people] + random.standard_normal((60, 3))
    values += 0.4 * time[:, None] + 0.5 * (people % 2)[:, None]
    matrix = np.column_stack([np.ones(60), people % 2, time])
    contrasts = [Contrast("g", [0, 1.0, 0], "greater"), Contrast("t", [0, 0, 1.0], "greater")]
    singles = fit_mixed(values, matrix, people, contrasts, LongitudinalSettings()).tests
    test = combine_tests("both", singles, 0.05)
    np.testing.assert_array_equal(test.p, np.maximum(singles[0].p, singles[1].p))
    assert singles[0].df.max() < singles[1].df.min()
    np.testing.assert_allclose(test.p, stats.t.sf(test.statistic, test.df), rtol=1e-8)
    assert test.contrast.hypothesis == "> 0 in each of 2 contrasts"


@pytest.mark.parametrize(
    ("text", "name", "parts"),
    [
        ("A & B", "A and B", ["A > 0", "B > 0"]),
        ("both = A&B < -.1 & C", "both", ["A > 0", "B < -.1", "C > 0"]),
        ("g[a&b] - g[c] & g[<5]", "g[a&b] - g[c] and g[<5]", ["g[a&b] - g[c] > 0", "g[<5] > 0"]),
        ("A | sex=M & B", "A | sex=M and B", ["A | sex=M > 0", "B > 0"]),
        ("|B-A| < 0.1", "B-A within 0.1", ["B-A > -0.1", "B-A < 0.1"]),
        (
            "same = |B-A| < 1e-2 | sex=M",
            "same",
            ["B-A > -1e-2 | sex=M", "B-A < 1e-2 | sex=M"],
        ),
        ("x = A - B | sex=M", "", []),
        ("A - B > 0.1", "", []),
        ("A, B", "", []),
    ],
)
def test_texts_are_split(text, name, parts):
    assert texts._split(text) == (name, parts)
    assert texts.fitted_contrasts([text]) == (tuple(parts) or (text,))


def test_each_part_is_fitted_once():
    asked = ("A", "low = A > 0.1", "A > 0", "A & B", "A > 0 & C")
    assert texts.fitted_contrasts(asked) == ("A", "low = A > 0.1", "A > 0", "B > 0", "C > 0")


@pytest.mark.parametrize(
    "text", ["|A| > 0.1", "|A| < 0", "|A| <= 0.1", "|A|", "|A < 0.1", "|| < 1"]
)
def test_other_bounds_are_refused(text):
    with pytest.raises(ModelError, match="write equivalence as"):
        texts.fitted_contrasts([text])


@pytest.mark.parametrize("n", [20, 60])
def test_size_at_the_boundary(n):
    """At the boundary at most 5 % are significant; 4,000 trials have an SE of 0.3 %."""
    random = np.random.default_rng(5)
    noise = random.standard_normal((n, 4000))
    matrix = np.column_stack([np.ones(n), np.arange(n) % 3 == 1, np.arange(n) % 3 == 2])
    groups = [Contrast(str(i), np.eye(3)[i], "greater") for i in (1, 2)]
    # One effect is large, the other is zero; no effect at all.
    large = np.mean(fitted(noise + 5 * matrix[:, [1]], matrix, groups).p < 0.05)
    assert abs(large - 0.05) < 0.01
    assert np.mean(fitted(noise, matrix, groups).p < 0.05) < 0.05
    margin = within(2.0, [0, 1.0, 0])
    at_margin = np.mean(fitted(noise + 2 * matrix[:, [1]], matrix, margin).p < 0.05)
    assert abs(at_margin - 0.05) < 0.01
