"""Registration against R, known warps and frozen templates; what warps do to maps."""

from dataclasses import replace
from time import process_time

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import minimize

from hipsta_bids.errors import ModelError
from hipsta_bids.stats import registration
from hipsta_bids.stats import warps as warps_module
from hipsta_bids.stats.registration import (
    mean_profiles,
    register,
    register_to,
    shift_by_group,
    shift_difference,
)
from hipsta_bids.stats.settings import RegistrationSettings
from hipsta_bids.stats.warps import (
    WarpBasis,
    fit_template,
    fit_warps,
    inner_knots,
    make_basis,
    warp_labels,
    warp_values,
)

NODES = 41
GRID = np.linspace(0, 1, NODES)
DEFAULT = RegistrationSettings()
SETTINGS = RegistrationSettings(align="registr", standardize=False)  # as R's


def root_mean_square(values):
    return np.sqrt(np.mean(np.square(values)))


def shape(s):
    """Profile with a narrow and a wide bump, 1/mm."""
    return 0.1 + 0.2 * np.exp(-(((s - 0.3) / 0.08) ** 2)) + 0.3 * np.exp(-(((s - 0.7) / 0.12) ** 2))


def simulated(subjects=60, seed=0, shift=0.0, spread=1.0):
    """Profiles, and the warps that register them (centered over subjects); nodes."""
    random = np.random.default_rng(seed)
    group = np.arange(subjects) % 2
    one = (spread * random.standard_normal(subjects) + shift * (group - 0.5)) / (NODES - 1)
    two = 0.4 * spread * random.standard_normal(subjects) / (NODES - 1)
    one, two = one - one.mean() + (shift * (group.mean() - 0.5)) / (NODES - 1), two - two.mean()
    warps = GRID + one[:, None] * np.sin(np.pi * GRID) + two[:, None] * np.sin(2 * np.pi * GRID)
    amplitude = 1 + 0.15 * random.standard_normal((subjects, 1))
    noise = 0.01 * random.standard_normal((subjects, NODES))
    return amplitude * shape(warps) + noise, warps, group


def recentered(warps):
    """Warps after the inverse of their mean."""
    return np.interp(warps.ravel(), warps.mean(axis=0), GRID).reshape(warps.shape)


def test_agrees_with_r(oracle):
    """Limits from the requirements; nodes of the sheet are .025 apart."""
    run = oracle["registr"]["A"]
    expected = np.array(run["t_hat_R"])
    profiles = np.array(run["Y"])
    plain = register(profiles, SETTINGS.changed(center=False))
    assert np.abs(plain.warps - expected).max() <= 0.005
    assert root_mean_square(plain.warps - expected) <= 0.001
    centered = register(profiles, SETTINGS)
    assert np.abs(centered.warps - recentered(expected)).max() <= 0.005
    assert root_mean_square(centered.warps - recentered(expected)) <= 0.001


def test_known_warps_are_recovered():
    profiles, warps, _ = simulated()
    found = register(profiles, SETTINGS)
    before = root_mean_square(warps - GRID)
    assert root_mean_square(found.warps - warps) < 0.5 * before
    assert found.converged
    assert found.explained_after > found.explained_before + 0.05
    assert (np.diff(found.warps, axis=1) >= 0).all()
    np.testing.assert_array_equal(found.warps[:, 0], 0.0)
    np.testing.assert_allclose(found.warps[:, -1], 1.0, rtol=1e-12)
    np.testing.assert_allclose(found.warps.mean(axis=0), GRID, atol=2e-3)  # a tenth of a node


def test_a_single_step_gives_principal_components(monkeypatch):
    """The variance that they explain is that of the profiles, whose shapes are splines here."""
    random = np.random.default_rng(4)
    warps = np.tile(GRID, (40, 1))
    curve = make_basis(inner_knots(warps, 12))(GRID)
    scores = random.standard_normal((40, 2)) * [0.5, 0.2]
    profiles = (scores @ random.standard_normal((2, 12)) + random.standard_normal(12)) @ curve.T
    monkeypatch.setattr(warps_module, "EM_ITERATIONS", 1)
    template, _ = fit_template(profiles, warps, 12, 2)
    parts = curve @ template.components
    expected = np.cov(profiles.T, ddof=0)
    np.testing.assert_allclose(parts @ parts.T, expected, atol=1e-9)  # rounding
    np.testing.assert_allclose(curve @ template.mean, profiles.mean(axis=0), rtol=1e-9, atol=1e-9)


def test_warps_are_the_optimum_of_their_loss():
    """A general optimizer, one subject at a time, finds nothing better and the same warp."""
    profiles, _, _ = simulated(6)
    basis = WarpBasis.make(NODES, 5)
    knots = inner_knots(GRID, 12)
    curve = make_basis(knots)
    mean = np.linalg.lstsq(curve(GRID), shape(GRID), rcond=None)[0]

    def loss(parameters, profile):
        warps, _ = basis.evaluate(parameters[None])
        return 0.5 * np.sum((profile - curve(warps[0]) @ mean) ** 2)

    start = np.zeros((6, 4))
    curves = np.tile(mean, (6, 1))
    parameters, found = fit_warps(profiles, knots, curves, basis, start)
    for i, profile in enumerate(profiles):
        best = minimize(loss, start[i], args=(profile,), method="BFGS", options={"gtol": 1e-9})
        own = loss(parameters[i], profile)
        assert own == pytest.approx(best.fun, rel=1e-6)  # numerical gradients
        warps, _ = basis.evaluate(best.x[None])
        np.testing.assert_allclose(found[i], warps[0], atol=1e-3)  # a flat optimum


def test_units_do_not_matter():
    profiles, _, _ = simulated(20)
    one, other = register(profiles, SETTINGS), register(profiles * 1e3, SETTINGS)
    np.testing.assert_allclose(one.warps, other.warps, atol=1e-6)  # rounding over many steps


def test_profiles_that_fit_already_stay():
    same = register(np.tile(shape(GRID), (30, 1)), SETTINGS)
    assert same.displacement.max() < 1e-9  # rounding
    amplitude = np.linspace(0.8, 1.2, 30)[:, None]
    found = register(amplitude * shape(GRID), SETTINGS)
    # The first turn takes some of the amplitude for displacement (.30 and .20 of a node).
    assert found.displacement.max() < 0.35


def test_frozen_template_places_new_subjects_as_if_they_had_been_there():
    profiles, warps, _ = simulated(120, seed=1)
    found = register(profiles[:80], SETTINGS)
    new = register_to(profiles[80:], found.template, SETTINGS)
    error = root_mean_square(new.warps - recentered(warps)[80:])
    assert error < 0.5 * root_mean_square(warps[80:] - GRID)
    again = register_to(profiles[:80], found.template, SETTINGS)
    # The template was estimated after the last warps: a fifth of a node.
    assert root_mean_square(again.warps - found.warps) < 0.2 / (NODES - 1)
    alone = register_to(profiles[[85]], found.template, SETTINGS)
    np.testing.assert_allclose(alone.warps[0], new.warps[5], atol=1e-10)


def test_shift_between_groups_is_reported():
    profiles, warps, group = simulated(200, seed=2, shift=2.0)
    found = register(profiles, SETTINGS)
    shifts = shift_by_group(found, np.array(["a", "b"])[group])
    difference = shifts["b"]["shift"] - shifts["a"]["shift"]
    truth = (warps[group == 1].mean(axis=0) - warps[group == 0].mean(axis=0)) * (NODES - 1)
    assert shifts["a"]["n"] == 100
    # Two coefficients per warp follow the middle best: a third of a node where features are.
    np.testing.assert_allclose(difference[8:34], truth[8:34], atol=0.35)
    for number, name in enumerate("ab"):
        part = (found.warps[group == number] - GRID) * (NODES - 1)
        np.testing.assert_allclose(shifts[name]["shift"], part.mean(axis=0), atol=1e-12)
        np.testing.assert_allclose(shifts[name]["shift_se"], stats.sem(part, axis=0), atol=1e-12)


@pytest.mark.slow
def test_curvature_that_is_larger_everywhere_moves_nobody():
    profiles, warps, group = simulated(100, seed=5)
    larger = profiles * np.where(group, 1.3, 1.0)[:, None] + 0.05 * group[:, None]
    truth = warps[group == 1].mean(axis=0) - warps[group == 0].mean(axis=0)

    def bias(settings):
        found = register(larger, settings).warps
        moved = found[group == 1].mean(axis=0) - found[group == 0].mean(axis=0)
        return np.abs(moved - truth).max() * (NODES - 1)

    assert bias(DEFAULT) < 0.1
    assert bias(SETTINGS) > 0.3  # what the default cures
    same = register(profiles, DEFAULT)
    np.testing.assert_allclose(register(larger, DEFAULT).warps, same.warps, atol=1e-6)
    new = register_to(larger, same.template, DEFAULT)
    assert root_mean_square(new.warps - same.warps) < 0.2 / (NODES - 1)


@pytest.mark.slow
def test_groups_that_are_moved_apart_are_told_from_those_that_are_not():
    def tested(shift, seed, people=None, groups=("a", "b")):
        profiles, _, group = simulated(60, seed=seed, shift=shift)
        found = register(profiles, DEFAULT)
        names = np.array(groups)[group]
        people = np.arange(60) if people is None else people
        return shift_difference(found, names, people, permutations=199, seed=0)

    apart = tested(2.0, 6)
    assert apart["difference_p"] == 1 / 200
    assert apart["difference"] == pytest.approx(2.0, abs=0.5)
    assert 8 < apart["difference_node"] - 1 < 34
    together = [tested(0.0, seed)["difference_p"] for seed in range(12)]
    assert sum(p <= 0.05 for p in together) <= 3  # of 12 at .05: more by chance in .2 %
    assert np.mean(together) > 0.25
    assert np.isnan(tested(0.0, 6, groups=("a", "a"))["difference_p"])
    # Two warps in each group that are the same: F has no residuals, and no p.
    registered = register(simulated(20, seed=1)[0], SETTINGS)
    exact = replace(registered, warps=registered.warps[[0, 0, 1, 1]])
    names = np.array(["a", "a", "b", "b"])
    result = shift_difference(exact, names, np.arange(4), permutations=19, seed=0)
    assert not result["difference_p"] <= 0.05
    # Visits are not people: thirty of each group who come ten times are three of each.
    visits = np.arange(60) % 6
    assert tested(2.0, 6, people=visits)["difference_p"] > 1 / 200


def test_extreme_warp_is_flagged():
    profiles, _, _ = simulated(80, seed=3, spread=0.5)
    profiles[7] = shape(GRID + 6 / (NODES - 1) * np.sin(np.pi * GRID))
    found = register(profiles, SETTINGS)
    assert found.extreme[7]
    assert found.extreme.sum() <= 2


def test_no_alignment_leaves_all_alone():
    profiles, _, _ = simulated(5)
    found = register(profiles, SETTINGS.changed(align="none"))
    np.testing.assert_array_equal(found.warps, np.tile(GRID, (5, 1)))
    assert found.template is None
    assert found.explained_before == found.explained_after
    maps = np.random.default_rng(0).random((5, NODES, 3))
    np.testing.assert_array_equal(warp_values(maps, found.warps), maps)


def test_maps_are_warped_exactly_where_they_are_linear():
    """A warp carries the original coordinate, and any line in it, to the inverse warp."""
    warps = GRID[None] ** np.array([[0.7], [1.0], [1.6]])
    maps = np.broadcast_to(GRID[None, :, None], (3, NODES, 2)).copy()
    carried = warp_values(maps, warps)
    for row in range(3):
        expected = np.interp(GRID, warps[row], GRID)
        np.testing.assert_allclose(carried[row, :, 0], expected, atol=1e-12)
    labels = np.broadcast_to((np.arange(NODES) // 10)[None, :, None], (3, NODES, 2))
    nearest = warp_labels(labels, warps)
    assert set(np.unique(nearest)) == {0, 1, 2, 3, 4}
    np.testing.assert_array_equal(nearest[1], labels[1])
    border = np.interp(GRID, warps[0], GRID) * (NODES - 1)
    np.testing.assert_array_equal(nearest[0, :, 0], np.floor(border + 0.5) // 10)


def test_missing_values_stay_missing_and_do_not_spread():
    warps = np.stack([GRID, GRID**1.2])
    maps = np.ones((2, NODES, 3))
    maps[:, 10:13, 1] = np.nan
    maps[0, -2, 1] = np.nan
    carried = warp_values(maps, warps)
    np.testing.assert_array_equal(np.isnan(carried[0]), np.isnan(maps[0]))
    assert np.isnan(carried[1, :, 1]).sum() in range(2, 6)
    assert np.isfinite(carried[:, :, [0, 2]]).all()


def test_profiles_are_means_over_rows_with_short_gaps_filled():
    maps = np.random.default_rng(1).random((4, NODES, 5))
    maps[0, 3, 2] = np.nan
    maps[1, 5:8] = np.nan
    profiles = mean_profiles(maps, SETTINGS)
    assert profiles[0, 3] == pytest.approx(np.nanmean(maps[0, 3]))
    np.testing.assert_allclose(
        profiles[1, 4:9], np.linspace(profiles[1, 4], profiles[1, 8], 5), rtol=1e-12
    )
    maps[2, :20] = np.nan
    with pytest.raises(ModelError, match="rows 2 of"):
        mean_profiles(maps, SETTINGS)


def test_refuses_what_gives_no_template():
    profiles, _, _ = simulated(20)
    with pytest.raises(ModelError, match="too few"):
        register(profiles[:5], SETTINGS)
    with pytest.raises(ModelError, match="constant"):
        register(np.ones((20, NODES)), SETTINGS)
    template = register(profiles, SETTINGS).template
    with pytest.raises(ModelError, match="align registr"):
        register_to(profiles, template, SETTINGS.changed(align="none"))
    with pytest.raises(ModelError, match="setting of standardize, not true"):
        register_to(profiles, template, SETTINGS.changed(standardize=True))
    flat = profiles.copy()
    flat[4] = 0.1
    with pytest.raises(ModelError, match="profiles 4 are constant"):
        register(flat, DEFAULT)
    profiles[3, 3] = np.nan
    for call in (register, lambda p, s: register_to(p, template, s)):
        with pytest.raises(ModelError, match="profiles 3 have"):
            call(profiles, SETTINGS)


@pytest.mark.slow
def test_large_cohorts_are_quick():
    profiles, _, _ = simulated(1500)
    start = process_time()
    register(profiles, SETTINGS)
    # Measured .7 s; the requirement is 60 s for two hemispheres with the models.
    assert process_time() - start < 15


def test_what_a_mean_explains_and_which_warps_are_extreme():
    """Displacements of 1 to 9 nodes have a median of 5, and a median deviation of 2."""
    sizes = np.arange(1.0, 10)
    warps = GRID + np.where(np.arange(NODES) % 2, 1, -1) * sizes[:, None] / (NODES - 1)
    profiles = shape(GRID) + 0.01 * (sizes - 5)[:, None]
    deviation = 2 / stats.norm.ppf(0.75)
    for times, count in ((4.1 / deviation, 0), (3.9 / deviation, 1), (1.9 / deviation, 3)):
        settings = SETTINGS.changed(extreme=times)
        found = registration._finish(profiles, warps, None, settings, 3, converged=False)
        assert found.extreme.sum() == count
        np.testing.assert_allclose(found.displacement, sizes)
    between, within = shape(GRID).var(), 0.01**2 * 60 / 9
    assert found.explained_before == pytest.approx(between / (between + within))
