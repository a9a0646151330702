"""Limits of sample sizes: coverage in simulated reference cohorts, and unequal arms."""

import numpy as np
import pandas as pd
import pytest
from statsmodels.stats.power import TTestIndPower

from hipsta_bids.extensions.trials.settings import PowerSettings
from hipsta_bids.extensions.trials.sizes import (
    Reference,
    TrialEffect,
    endpoint_sd,
    participants_needed,
    power_of,
    sample_size,
)
from hipsta_bids.extensions.trials.trial import Modeled, Retested
from hipsta_bids.group.cohort.data import SHEET, Cohort, layers
from hipsta_bids.group.model import ModelRequest, VisitTime
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.types import PARTICIPANT, SESSION
from validation.group import thickness_side

MEAN, BETWEEN, WITHIN = 1.6, 0.3, 0.05  # mm
SLOPE, SLOPE_SD = -0.006, 0.004  # mm per month
COHORTS = 2000


def reference(people, visits, *, retest=False, seed=0):
    """Describe reference cohorts: each point is one of its own."""
    random = np.random.default_rng(seed)
    shape = people, COHORTS
    first = MEAN + BETWEEN * random.standard_normal(shape)
    slopes = 0.0 if retest else SLOPE + SLOPE_SD * random.standard_normal(shape)
    values = first + slopes * np.array(visits)[:, None, None]
    values += WITHIN * random.standard_normal(values.shape)
    names = [f"sub-{i:03d}" for i in range(people)]
    table = pd.DataFrame(
        {
            PARTICIPANT: np.repeat(names, len(visits)),
            SESSION: [f"ses-{j}" for j in range(len(visits))] * people,
            "months": np.tile(visits, people),
        }
    )
    maps = values.transpose(1, 0, 2).reshape(-1, COHORTS, 1)
    side = thickness_side(maps)
    axes = np.linspace(-1, 1, COHORTS), np.zeros(1)
    cohort = Cohort(table=table, sides={"L": side}, x=axes[0], y=axes[1], units={})
    settings = GroupSettings()
    if retest:
        source = Retested(cohort, settings)
    else:
        time = VisitTime(table, "months", ()) if len(visits) > 1 else None
        source = Modeled(cohort, ModelRequest(), settings, time)
    (layer,) = layers({SHEET: cohort}, ["thickness"], ())
    return source.describe(layer).reference


@pytest.mark.parametrize(
    ("people", "followed", "effect"),
    [
        (40, (0, 12, 24), TrialEffect(kind="slowing", share=0.2, visits=(0, 12, 24))),
        (40, (0, 12, 24), TrialEffect(kind="slowing", share=0.2, visits=(0, 6, 12, 18, 24, 36))),
        (25, (0, 12, 24, 36), TrialEffect(kind="slowing", share=0.2, visits=(0, 12))),
        (20, (0,), TrialEffect(kind="thinning", share=0.05)),
        (30, (0, 12, 24), TrialEffect(kind="thinning", share=0.04, visits=(0, 12, 24))),
    ],
)
def test_limits_cover_the_true_size(people, followed, effect):
    """Of 2000 cohorts 95 % have limits around the size that the true values need, to 2 %."""
    found = sample_size(
        effect, reference(people, followed), PowerSettings(), alpha=0.05, confidence=0.95
    )
    one = np.ones(1)
    noise = WITHIN**2 if effect.visits else WITHIN**2 + BETWEEN**2
    truth = Reference(n=one, mean=MEAN * one, variance=noise * one, freedom=one)
    truth = Reference(**vars(truth) | {"slope": SLOPE * one, "slope_variance": SLOPE_SD**2 * one})
    exact = sample_size(effect, truth, PowerSettings(), alpha=0.05)["per_arm"][0]
    assert 50 < exact < 1000  # large numbers, which rounding hardly changes
    is_above = np.nan_to_num(found["per_arm_high"], nan=np.inf) >= exact
    is_below = found["per_arm_low"] <= exact
    assert np.isfinite(found["per_arm_low"]).all()

    assert abs(np.mean(is_above & is_below) - 0.95) < 0.02
    # Limits of the SD or of the change alone would be narrower than this.
    assert np.mean(~is_above) > 0.005


def test_limits_of_repeated_sessions_cover_the_true_size():
    effect = TrialEffect(kind="thinning", share=0.2)
    found = sample_size(
        effect,
        reference(20, (0, 0), retest=True),
        PowerSettings(),
        alpha=0.05,
        confidence=0.95,
    )
    d = 0.2 * MEAN / np.hypot(BETWEEN, WITHIN)
    exact = participants_needed(np.array([d]), 0.05, 0.8, 10_000)[0]
    covered = (found["per_arm_low"] <= exact) & (found["per_arm_high"] >= exact)
    assert abs(covered.mean() - 0.95) < 0.02


def test_slopes_of_the_trial_have_their_variance():
    effect = TrialEffect(kind="slowing", share=0.2, visits=(0, 12, 24))
    own = reference(40, (0, 12, 24))
    # The median of estimates is near the truth; of 2000 its error is 3 % of the spread.
    truth = np.sqrt(SLOPE_SD**2 + WITHIN**2 / 288)
    assert np.median(endpoint_sd(effect, own)) == pytest.approx(truth, rel=0.01)
    assert own.spread == pytest.approx(288)


@pytest.mark.parametrize("ratio", [1.0, 1.5, 2.0, 3.0])
def test_unequal_arms_are_those_of_statsmodels(ratio):
    d = np.array([0.2, 0.5, 0.9])
    found = participants_needed(d, 0.05, 0.8, 10_000, ratio)
    for size, own in zip(d, found, strict=True):
        exact = [
            TTestIndPower().power(size, n, 0.05, np.ceil(round(n * ratio, 9)) / n)
            for n in (own - 1, own)
        ]
        assert exact[0] < 0.8 <= exact[1]
        assert power_of(np.array([size]), np.array([own]), 0.05, ratio) == pytest.approx(exact[1])


def test_unequal_arms_in_the_table():
    own = Reference(
        n=np.array([50]), mean=np.array([1.6]), variance=np.array([0.04]), freedom=np.array([48.0])
    )
    effect = TrialEffect(kind="thinning", share=0.05)
    plan = PowerSettings(allocation=2.0, dropout=0.1)
    found = sample_size(effect, own, plan, alpha=0.05, confidence=0.95)
    equal = sample_size(effect, own, PowerSettings(dropout=0.1), alpha=0.05, confidence=0.95)
    assert "larger_arm" not in equal
    assert found["larger_arm"] == 2 * found["per_arm"]
    assert found["enrolled_larger_arm"] == np.ceil(found["larger_arm"] / 0.9)
    assert found["per_arm"] < equal["per_arm"]
    assert found["per_arm"] + found["larger_arm"] > 2 * equal["per_arm"]
