"""The whole chain on simulated cohorts: registration must help, and its absence must hurt."""

from dataclasses import replace

import numpy as np
import pytest

from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.stats.registration import mean_profiles, register
from hipsta_bids.stats.settings import RegistrationSettings
from hipsta_bids.stats.warps import warp_values
from validation.group import SimulationPlan, analyze, run_simulation, simulate_cohort

PLAN = SimulationPlan()
REGISTERED = GroupSettings()
UNREGISTERED = GroupSettings(registration=RegistrationSettings(align="none"))
SEEDS = range(4)


def test_cohort_is_what_the_plan_says():
    plan = replace(PLAN, effect=5.0)
    cohort, null = simulate_cohort(plan, 1), simulate_cohort(replace(plan, effect=0.0), 1)
    grid = np.linspace(0, 1, 41)
    np.testing.assert_allclose(cohort.warps.mean(axis=0), grid, atol=1e-12)
    middle = (cohort.warps[:, 20] - 0.5) * 40
    difference = middle[cohort.group].mean() - middle[~cohort.group].mean()
    assert difference == pytest.approx(2, abs=0.4)  # three standard errors of .12
    assert cohort.group.sum() == 93
    # Carried by the true warps, the effect is where it was planted and as large.
    lost = warp_values(null.thickness - cohort.thickness, cohort.warps)
    mean = lost[cohort.group].mean(axis=0)
    np.testing.assert_allclose(mean[cohort.affected == 1], 5 * 0.2, rtol=0.05)  # interpolation
    np.testing.assert_allclose(mean[[10, 35]], 0, atol=1e-12)
    np.testing.assert_array_equal(lost[~cohort.group], 0)
    again = simulate_cohort(plan, 1)
    np.testing.assert_array_equal(again.thickness, cohort.thickness)


def test_thickness_varies_as_much_as_planned():
    cohort = simulate_cohort(replace(PLAN, age_slope=0.0, effect=0.0, shift=0.0), 2)
    carried = warp_values(cohort.thickness, cohort.warps)
    # Interpolating twice takes a few per cent off noise that is smooth over two nodes.
    assert np.median(carried.std(axis=0)) == pytest.approx(0.2, rel=0.08)


def test_registration_finds_the_warps_of_the_cohort():
    cohort = simulate_cohort(PLAN, 3)
    profiles = mean_profiles(cohort.curvature, REGISTERED.registration)
    found = register(profiles, REGISTERED.registration)
    nodes = 40 * (found.warps - cohort.warps)
    assert np.sqrt(np.mean(nodes**2)) < 0.5  # of displacements of 1.1 nodes
    shift = found.warps[cohort.group].mean(axis=0) - found.warps[~cohort.group].mean(axis=0)
    assert 40 * shift[20] == pytest.approx(2, abs=0.5)


@pytest.mark.long
def test_registered_analysis_passes_where_the_unregistered_one_fails():
    """Limits of the requirements; the same code runs on more cohorts in the validation."""
    registered = run_simulation(PLAN, REGISTERED, SEEDS)
    assert registered["FDR"] <= 0.08
    assert registered["core power"] >= 0.70
    assert registered["peak error, nodes"] <= 1.5
    assert registered["null cohorts with findings"] <= 0.15
    unregistered = run_simulation(PLAN, UNREGISTERED, SEEDS)
    assert unregistered["FDR"] > 0.4
    assert unregistered["null cohorts with findings"] > 0.4


def test_without_a_shift_no_registration_is_needed():
    """So that the failure above is due to the shift and to nothing else."""
    plan = replace(PLAN, shift=0.0)
    found = [analyze(simulate_cohort(plan, seed), plan, UNREGISTERED) for seed in range(3)]
    assert np.mean([one.false_share for one in found]) < 0.15
    assert all(one.core_power > 0.9 for one in found)
