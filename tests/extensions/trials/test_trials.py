"""Sample sizes: against statsmodels, and the level that holds the false discovery rate."""

import numpy as np
import pytest
from scipy import stats
from statsmodels.stats.power import TTestIndPower

from hipsta_bids.errors import ModelError, UsageError
from hipsta_bids.extensions.trials.settings import PowerSettings
from hipsta_bids.extensions.trials.sizes import (
    Reference,
    TrialEffect,
    participants_needed,
    point_level,
    power_of,
    sample_size,
)
from hipsta_bids.stats.settings import MultiplicitySettings

SETTINGS = PowerSettings()
REFERENCE = Reference(
    n=np.array([50]),
    mean=np.array([1.6]),
    variance=np.array([0.04]),
    freedom=np.array([48.0]),
    slope=np.array([-0.004]),
    slope_limits=np.array([[-0.005], [-0.003]]),
    slope_variance=np.array([1e-5]),
)


@pytest.mark.parametrize("alpha", [0.05, 0.004])
@pytest.mark.parametrize("power", [0.8, 0.95])
def test_numbers_and_power_are_those_of_statsmodels(alpha, power):
    d = np.array([0.1, 0.35, 0.5, 0.8, 1.2])
    found = participants_needed(d, alpha, power, 10_000)
    exact = [TTestIndPower().solve_power(one, alpha=alpha, power=power, ratio=1) for one in d]
    assert found.tolist() == np.ceil(exact).tolist()
    expected = [TTestIndPower().power(one, n, alpha) for one, n in zip(d, found, strict=True)]
    assert power_of(d, found, alpha) == pytest.approx(expected, rel=1e-6)


def test_numbers_at_the_ends():
    d = np.array([0.0, 1e-3, 30.0, -30.0, np.nan])
    found = participants_needed(d, 0.05, 0.8, 1000)
    assert np.isnan(found[[0, 1, 4]]).all()
    assert found[2:4].tolist() == [2, 2]
    # Power is 1 far out, where SciPy's function has gaps.
    far = power_of(np.full(6, 1.77), np.array([30.0, 100, 300, 1000, 3000, 10_000]), 0.0044)
    assert far == pytest.approx(1.0, abs=1e-6)


def test_end_point_of_one_visit_is_a_value():
    effect = TrialEffect(kind="thinning", share=0.05)
    found = sample_size(effect, REFERENCE, SETTINGS, alpha=0.05, confidence=0.95)
    assert found["arm_difference"][0] == pytest.approx(0.08)
    assert found["sd_endpoint"][0] == pytest.approx(0.2)
    assert found["per_arm"][0] == np.ceil(TTestIndPower().solve_power(0.4, alpha=0.05, power=0.8))
    low, high = (np.sqrt(48 / stats.chi2.ppf(q, 48)) for q in (0.975, 0.025))
    ends = [TTestIndPower().solve_power(0.4 / f, alpha=0.05, power=0.8) for f in (low, high)]
    assert [found["per_arm_low"][0], found["per_arm_high"][0]] == np.ceil(ends).tolist()


def test_end_point_of_several_visits_is_the_slope():
    effect = TrialEffect(kind="slowing", share=0.25, visits=(0, 12, 24))
    settings = PowerSettings(dropout=0.2)
    found = sample_size(effect, REFERENCE, settings, alpha=0.05, confidence=0.95)
    # Squared deviations of 0, 12 and 24 months from 12 are 288 in all.
    sd = found["sd_endpoint"][0] / 12
    assert sd == pytest.approx(np.sqrt(1e-5 + 0.04 / 288))
    assert found["arm_difference"][0] == pytest.approx(0.012)
    # Of those who leave some have two visits, whose slope says less than that of three.
    stay, after_two = 0.8, np.sqrt(0.8) - 0.8
    share = stay + after_two * sd**2 / (1e-5 + 0.04 / 72)
    assert found["enrolled_per_arm"][0] == np.ceil(found["per_arm"][0] / share)
    assert found["per_arm"][0] < found["enrolled_per_arm"][0] < np.ceil(found["per_arm"][0] / 0.8)
    assert found["per_arm_low"][0] < found["per_arm"][0] < found["per_arm_high"][0]
    over_zero = Reference(**vars(REFERENCE) | {"slope_limits": np.array([[-0.01], [0.002]])})
    uncertain = sample_size(effect, over_zero, settings, alpha=0.05, confidence=0.95)
    assert np.isnan(uncertain["per_arm_high"][0])
    thinner = TrialEffect(kind="thinning", share=0.05, visits=(0, 12, 24))
    thinned = sample_size(thinner, REFERENCE, settings, alpha=0.05)
    assert thinned["arm_difference"][0] == pytest.approx(0.08 / 2)


def test_slowing_needs_change_and_visits():
    with pytest.raises(UsageError, match="--visits 0,12,24"):
        TrialEffect(kind="slowing", share=0.25)
    effect = TrialEffect(kind="slowing", share=0.25, visits=(0, 12))
    plain = Reference(**vars(REFERENCE) | {"slope": None})
    with pytest.raises(ModelError, match="was followed"):
        sample_size(effect, plain, SETTINGS, alpha=0.05)


@pytest.mark.parametrize("method", ["bh", "fdr2"])
@pytest.mark.parametrize("affected", [0.05, 0.4])
def test_level_solves_the_procedure_on_average(method, affected):
    """The shares found at the level give the level back, by the definition of the procedure."""
    level = point_level(MultiplicitySettings(method=method), PowerSettings(affected=affected))
    found = affected * 0.8 + (1 - affected) * level
    if method == "bh":
        assert level == pytest.approx(0.05 * found, rel=1e-9)
        return
    rate = 0.05 / 1.05
    center = stats.norm.isf(level / 2) + stats.norm.ppf(0.8)
    first = rate * affected
    for _ in range(500):  # the first stage, by itself
        seen = stats.norm.sf(stats.norm.isf(first / 2) - center)
        first = rate * (affected * seen + (1 - affected) * first)
    not_found = 1 - first / rate
    assert level == pytest.approx(rate / not_found * found, rel=1e-6)


def test_family_wise_corrections_are_refused():
    with pytest.raises(UsageError, match="give --correction fdr2 or bh"):
        point_level(MultiplicitySettings(method="permutation-max"), SETTINGS)
