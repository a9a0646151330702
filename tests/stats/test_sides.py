"""One-sided contrasts: how they are written, and Student's test against a margin."""

import numpy as np
import pytest
from scipy import stats

from hipsta_bids.errors import ModelError
from hipsta_bids.stats.contrasts import Contrast, contrast_json, parse_contrast
from hipsta_bids.stats.glm import fit_measures, fit_points
from hipsta_bids.stats.mixed import fit_mixed
from hipsta_bids.stats.settings import GlmSettings, LongitudinalSettings


@pytest.mark.parametrize(
    ("text", "name", "side", "margin"),
    [
        ("arm[B]-arm[A] > -0.05", "arm[B]-arm[A] > -0.05", "greater", -0.05),
        ("ni = arm[B] - arm[A]<5e-2", "ni", "less", 0.05),
        ("b-a > 0.1 | sex=M", "b-a > 0.1 | sex=M", "greater", 0.1),
        ("b-a | sex=M, age=70 > .1", "b-a > 0.1 | sex=M, age=70", "greater", 0.1),
        ("group[<5]-group[>5]", "group[<5]-group[>5]", "", 0.0),
    ],
)
def test_sides_are_read(text, name, side, margin):
    document = contrast_json(text)
    spec = parse_contrast(document)
    assert (spec.name, spec.side, spec.margin, spec.test) == (name, side, margin, "t")
    assert ("Alternative" in document) == bool(side)
    plain = parse_contrast(contrast_json("b-a | sex=M"))
    if "sex=M" in text and "age" not in text:
        assert (spec.conditions, spec.weights) == (plain.conditions, plain.weights)


@pytest.mark.parametrize("text", ["b >= 0", "b > 0 > 1", "0 < b", "b > c", "b > -"])
def test_other_signs_are_refused(text):
    with pytest.raises(ModelError, match="one > or <"):
        contrast_json(text)


def test_model_files_have_sides():
    contrast = {"Name": "x", "ConditionList": ["b"], "Weights": [1]}
    assert parse_contrast({**contrast, "Alternative": "less", "Margin": 1}).side == "less"
    for wrong in ({"Alternative": "both"}, {"Alternative": "less", "Margin": "1"}):
        with pytest.raises(ModelError, match="greater or less"):
            parse_contrast({**contrast, **wrong})


def test_several_rows_have_no_side():
    with pytest.raises(ModelError, match="no direction"):
        Contrast("x", np.eye(2), "greater")


@pytest.mark.parametrize("margin", [0.0, -0.3, 0.2])
@pytest.mark.parametrize("side", ["greater", "less"])
def test_student_against_a_margin(side, margin):
    random = np.random.default_rng(1)
    values = random.standard_normal((30, 4))
    arm = np.arange(30) % 2
    matrix = np.column_stack([np.ones(30), arm])
    contrasts = [Contrast("x", [0.0, 1.0], side, margin), Contrast("y", [0.0, 1.0])]
    exact = stats.ttest_ind(values[arm == 1] - margin, values[arm == 0], alternative=side)
    for fit in (fit_points, fit_measures):
        test, plain = fit(values, matrix, contrasts, GlmSettings()).tests
        np.testing.assert_allclose(test.statistic, exact.statistic)
        np.testing.assert_allclose(test.p, exact.pvalue)
        # Effects are those of the difference from zero.
        for name in ("estimate", "se", "cohen_d", "cohen_d_limits", "eta_squared"):
            np.testing.assert_array_equal(getattr(test, name), getattr(plain, name))
    two = stats.ttest_ind(values[arm == 1], values[arm == 0]).pvalue
    np.testing.assert_allclose(plain.p, two)


def test_mixed_models_have_sides():
    random = np.random.default_rng(2)
    people = np.repeat(np.arange(20), 3)
    values = random.standard_normal((20, 2))[people] + random.standard_normal((60, 2))
    matrix = np.column_stack([np.ones(60), people % 2])
    contrasts = [Contrast("x", [0.0, 1.0], "greater", -0.4), Contrast("y", [0.0, 1.0])]
    test, plain = fit_mixed(values, matrix, people, contrasts, LongitudinalSettings()).tests
    t = (plain.estimate[0] + 0.4) / plain.se[0]
    np.testing.assert_allclose(test.p, stats.t.sf(t, plain.df))


def test_size_at_the_margin():
    """At the margin itself 5 % of tests are significant; 4000 trials have an SE of 0.3 %."""
    random = np.random.default_rng(3)
    arm = np.arange(24) % 3 == 0
    values = random.standard_normal((24, 4000)) - 0.5 * arm[:, None]
    contrasts = [Contrast("x", [0.0, 1.0], "greater", -0.5)]
    (test,) = fit_points(
        values, np.column_stack([np.ones(24), arm]), contrasts, GlmSettings()
    ).tests
    assert abs(np.mean(test.p < 0.05) - 0.05) < 0.01
