"""Simulated trials have the power that their sample size was to give."""

from dataclasses import replace

import pytest

from validation import trials
from validation.trials import DESIGNS, simulate_design


@pytest.mark.parametrize("design", [DESIGNS[3], DESIGNS[6]], ids=["retest", "dropouts"])
def test_stated_power_is_observed(design):
    found = simulate_design(design, 300)
    # Four standard errors of 300 trials, and the reference's own error.
    assert found["observed power"] == pytest.approx(
        found["stated power"], abs=4 * found["SE"] + 0.02
    )
    assert found["enrolled"] > found["per arm"] or design.retest


def test_stated_power_of_maps_is_observed():
    # Coarse and rough maps: fast, and many points tell the share that is found.
    found = simulate_design(replace(DESIGNS[4], nodes=(20, 10), smoothness=0.5), 60)
    assert found["observed power"] == pytest.approx(found["stated power"], abs=0.05)


def test_a_wrong_size_is_noticed(monkeypatch):
    real = trials.sample_size

    def half(*args, **options):
        found = real(*args, **options)
        return found | {"enrolled_per_arm": found["enrolled_per_arm"] // 2}

    monkeypatch.setattr(trials, "sample_size", half)
    found = simulate_design(DESIGNS[0], 300)
    assert found["stated power"] - found["observed power"] > 2 * trials.MAX_DIFFERENCE
