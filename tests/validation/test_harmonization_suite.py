"""The suite of harmonization: what has to fail without it fails, and what is offered passes."""

from dataclasses import replace

import numpy as np
import pytest

from hipsta_bids.group.settings import GroupSettings
from validation import harmonization
from validation.harmonization import SitesPlan, analyze_sites, left_over, simulate_sites

PLAN = SitesPlan(nodes=(11, 9))
SETTINGS = GroupSettings()
SEEDS = range(12)


def test_cohort_has_what_was_planted():
    plan = replace(PLAN, sizes=(400,) * 5, missing=0.0)
    values, visits, shift, scale = simulate_sites(plan, 1)
    sd = np.array([values[visits.site == site].std(axis=0).mean() for site in range(5)])
    # The group and age add 0.35 to the SD of 1, squared.
    expected = np.sqrt(np.mean(scale**2, axis=1) + 0.1)
    np.testing.assert_allclose(sd, expected, rtol=0.06)
    assert np.ptp(shift.mean(axis=1)) == pytest.approx(1.1, abs=0.15)


def test_means_of_sites_are_taken_out():
    found = left_over(PLAN, SEEDS, SETTINGS)
    # Known to .16 SD / .45 SD / sqrt(60 sites), times what points have in common: .02.
    assert abs(found["shift left"]) < 0.06
    assert abs(found["scale left"]) < 0.08
    assert 0.2 < found["of shift, local part left"] < 0.7


def test_sites_that_are_ignored_bias_effects_and_sites_in_the_model_do_not():
    how = {"with_combat": False, "with_site": False}
    ignored, few = analyze_sites(PLAN, SEEDS, SETTINGS, repeated=False, **how)
    assert abs(ignored / PLAN.effect - 1) > 0.2
    how = {"with_combat": True, "with_site": True}
    kept, more = analyze_sites(PLAN, SEEDS, SETTINGS, repeated=False, **how)
    assert kept == pytest.approx(PLAN.effect, abs=0.08)  # .2 / sqrt(12), two of them
    assert more > few


def test_suite_judges_what_is_offered(monkeypatch):
    monkeypatch.setattr(harmonization, "FEW_COHORTS", 2)
    monkeypatch.setattr(harmonization, "_FEW_NODES", (5, 4))
    removal, effects = harmonization.run(full=False).tables
    assert removal.targets == 1
    assert effects.targets == 2
    assert len(effects.rows) == 6
