"""Permutation tests: statistics of the model, exact counts, family-wise error, power."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from scipy import stats

from hipsta_bids.errors import ModelError
from hipsta_bids.stats import exchangeability
from hipsta_bids.stats.clusters import sheet_edges
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.exchangeability import Visits, choose_exchange
from hipsta_bids.stats.glm import fit_points
from hipsta_bids.stats.inference import PROCESSORS, PermutationPart
from hipsta_bids.stats.inference import permute as permute_parts
from hipsta_bids.stats.settings import GlmSettings, MultiplicitySettings

SETTINGS = MultiplicitySettings(method="permutation-tfce", permutations=400)
SHEET = (9, 7)
GROUP = Contrast("group", np.array([0.0, 1.0, 0.0]))


def permute(maps, matrix, contrast, shape, *, settings, blocks=None):
    """One part."""
    part = PermutationPart(maps, matrix, np.arange(len(maps)), sheet_edges(*shape))
    (found,) = permute_parts([part], contrast, settings=settings, blocks=blocks)
    return found


def case(seed=0, subjects=40):
    random = np.random.default_rng(seed)
    group = np.arange(subjects) % 2
    matrix = np.column_stack([np.ones(subjects), group, random.normal(70, 5, subjects)])
    return random, matrix, random.standard_normal((subjects, 63)) + 0.02 * matrix[:, 2:]


@pytest.mark.parametrize("contrast", [GROUP, Contrast("both", np.eye(3)[1:])])
def test_statistic_is_that_of_the_model(contrast):
    _, matrix, maps = case()
    maps[:, 5] = 1.0
    few = SETTINGS.changed(permutations=2)
    (expected,) = fit_points(maps, matrix, [contrast], GlmSettings()).tests
    found = permute(maps, matrix, contrast, SHEET, settings=few)
    np.testing.assert_allclose(found.statistic, expected.statistic, rtol=1e-9)  # rounding
    covariate = np.random.default_rng(9).normal(2, 0.3, (1, *maps.shape))
    (expected,) = fit_points(maps, matrix, [contrast], GlmSettings(), covariate).tests
    part = PermutationPart(maps, matrix, np.arange(40), sheet_edges(*SHEET), covariates=covariate)
    (found,) = permute_parts([part], contrast, settings=few)
    np.testing.assert_allclose(found.statistic, expected.statistic, rtol=1e-9)


@pytest.mark.slow
def test_uncorrected_p_approaches_that_of_all_permutations():
    """Six subjects have 720 orders; a fair sample of them has their p-value."""
    random = np.random.default_rng(1)
    matrix = np.column_stack([np.ones(6), np.arange(6.0)])
    maps = random.standard_normal((6, 4)) + 0.5 * matrix[:, 1:]
    slope = Contrast("slope", np.array([0.0, 1.0]))
    found = permute(maps, matrix, slope, (2, 2), settings=SETTINGS.changed(permutations=6000))
    orders = np.array(list(permutations(range(6))))
    for point in range(4):
        r = np.abs([np.corrcoef(maps[order, point], matrix[:, 1])[0, 1] for order in orders])
        exact = (r >= r[0] - 1e-9).mean()
        # Three standard deviations of a share of 6000, at most .0194.
        assert found.p_uncorrected[point] == pytest.approx(exact, abs=0.02)


@pytest.mark.slow
def test_large_samples_give_the_p_of_the_t_test():
    _, matrix, maps = case(2, subjects=80)
    found = permute(maps, matrix, GROUP, SHEET, settings=SETTINGS.changed(permutations=4000))
    (test,) = fit_points(maps, matrix, [GROUP], GlmSettings()).tests
    # Four standard deviations of a share of 4000 (63 of them are compared).
    np.testing.assert_allclose(found.p_uncorrected, test.p, atol=0.032)


@pytest.mark.slow
def test_family_wise_error_is_kept_on_null_maps():
    few = SETTINGS.changed(permutations=40)
    smallest = []
    for seed in range(120):
        _, matrix, maps = case(seed, subjects=24)
        found = permute(maps, matrix, GROUP, SHEET, settings=few.changed(seed=seed))
        smallest.append((found.p_max.min(), found.p_enhanced.min()))
    rates = (np.array(smallest) <= 0.1).mean(axis=0)
    # Binomial SD .027 around .1; three of them.
    assert (rates <= 0.182).all()
    assert (rates >= 0.018).all()


@pytest.mark.slow
def test_enhancement_finds_weak_wide_effects_that_the_maximum_misses():
    hits = np.zeros(2)
    for seed in range(10):
        _, matrix, maps = case(seed)
        maps.reshape(-1, *SHEET)[matrix[:, 1] == 1, 2:7, 1:6] += 0.75
        found = permute(maps, matrix, GROUP, SHEET, settings=SETTINGS.changed(permutations=200))
        hits += [(p <= 0.05).sum() for p in (found.p_max, found.p_enhanced)]
    assert hits[1] > 2 * hits[0]


@pytest.mark.slow
def test_blocks_keep_a_site_effect_from_looking_like_a_group_effect():
    """Group and site go together and the site shifts values: only shuffling inside sites holds."""
    rejections = np.zeros(2)
    trials = 60
    for seed in range(trials):
        random = np.random.default_rng(seed)
        site = np.repeat([0, 1], 20)
        group = random.random(40) < np.where(site, 0.8, 0.2)
        matrix = np.column_stack([np.ones(40), group])
        maps = random.standard_normal((40, 4)) + 1.0 * site[:, None]
        few = SETTINGS.changed(permutations=40, seed=seed)
        for i, blocks in enumerate((None, site)):
            contrast = Contrast("group", np.array([0.0, 1.0]))
            found = permute(maps, matrix, contrast, (2, 2), settings=few, blocks=blocks)
            rejections[i] += found.p_max.min() <= 0.05
    free, within = rejections / trials
    assert within <= 0.05 + 3 * np.sqrt(0.05 * 0.95 / trials)  # three binomial SDs
    assert free > 0.4


def test_mean_is_tested_by_flipping_signs():
    random = np.random.default_rng(3)
    maps = random.standard_normal((20, 63))
    maps[:, 30] += 2
    mean = Contrast("mean", np.array([1.0]))
    found = permute(maps, np.ones((20, 1)), mean, SHEET, settings=SETTINGS)
    expected = stats.ttest_1samp(maps, 0).statistic
    np.testing.assert_allclose(found.statistic, expected, rtol=1e-9)  # rounding
    assert found.p_max[30] == 1 / 400
    assert (np.delete(found.p_max, 30) > 0.05).all()


def test_seed_repeats_and_missing_points_stay_missing():
    _, matrix, maps = case(4)
    maps[:, 7] = np.nan
    maps[3, 8] = np.nan
    one, two = (permute(maps, matrix, GROUP, SHEET, settings=SETTINGS) for _ in range(2))
    np.testing.assert_array_equal(one.p_enhanced, two.p_enhanced)
    assert np.isnan(one.p_max[7])
    assert np.isfinite(np.delete(one.p_max, 7)).all()


def repeated(random, slope_sd=0.3, people=30):
    """Three or four visits, with a group of every third; nothing differs but people."""
    who = np.repeat(np.arange(people), random.integers(3, 5, people))
    time = np.arange(len(who)) - np.searchsorted(who, who)
    group = (who % 3 == 0).astype(float)
    own, change = random.normal(0, 1, (2, people, 10))
    maps = own[who] + slope_sd * change[who] * time[:, None]
    maps += random.normal(0, 0.5, maps.shape)
    return who, time, np.column_stack([np.ones(len(who)), group, time, group * time]), maps


@pytest.mark.slow
@pytest.mark.parametrize(("column", "slope_sd"), [(3, 0.3), (2, 0.3), (2, 0.0)])
def test_repeated_visits_keep_the_level(column, slope_sd):
    """Blocks change places for the difference of changes; for the change of the others, signs flip
    where changes differ, and visits change places where they do not."""
    random = np.random.default_rng(3)
    how = MultiplicitySettings(method="permutation-max", permutations=100)
    cohorts, found = 120, 0
    for seed in range(cohorts):
        who, time, matrix, maps = repeated(random, slope_sd)
        visits = Visits(who, time, slopes=slope_sd > 0)
        none = np.empty((0, 2), dtype=np.int64)
        part = PermutationPart(maps, matrix, np.arange(len(who)), none, visits)
        contrast = Contrast("change", np.eye(4)[column])
        (test,) = permute_parts([part], contrast, settings=how.changed(seed=seed))
        found += test.p_max.min() <= 0.05
    # Six are expected, with an SD of 2.4.
    assert 0 < found <= 13


def test_number_of_processors_changes_nothing():
    _, matrix, maps = case()
    one = permute(maps, matrix, GROUP, SHEET, settings=SETTINGS)
    token = PROCESSORS.set(3)
    try:
        three = permute(maps, matrix, GROUP, SHEET, settings=SETTINGS)
    finally:
        PROCESSORS.reset(token)
    for name in ("p_uncorrected", "p_max", "p_enhanced"):
        np.testing.assert_array_equal(getattr(one, name), getattr(three, name))
    assert one.p_max.min() < 1


def test_what_repeated_visits_exchange():
    random = np.random.default_rng(1)
    who, time, matrix, _ = repeated(random)
    single = [Contrast(name, np.eye(4)[i]) for i, name in enumerate(("0", "group", "time", "both"))]
    either = Contrast("either", np.eye(4)[[1, 3]])
    expected = [
        (single[0], "flip", "flip"),  # of all
        (single[1], "whole", "whole"),
        (single[2], "within", "flip"),  # of all, if changes are alike, and if not
        (single[3], "whole", "whole"),
        (either, "whole", "whole"),
    ]
    for contrast, alike, differ in expected:
        for slopes, wanted in ((False, alike), (True, differ)):
            assert choose_exchange(matrix, contrast, Visits(who, time, slopes), "auto") == wanted
    # Without times nobody knows what is common; few with as many visits cannot change places.
    assert choose_exchange(matrix, single[3], Visits(who), "auto") == "within"
    assert choose_exchange(matrix, single[1], Visits(who), "auto") == "flip"
    few = who < 6
    alone = Visits(who[few], time[few])
    assert choose_exchange(matrix[few], single[1], alone, "auto") == "flip"
    for wanted, contrast in (("whole", single[2]), ("within", single[1])):
        with pytest.raises(ModelError, match=f"multiplicity.visits {wanted} does not"):
            choose_exchange(matrix, contrast, Visits(who, time), wanted)


@pytest.mark.parametrize("order", ["sorted", "mixed"])
def test_blocks_move_whole_and_visits_stay_at_home(order):
    random = np.random.default_rng(2)
    who, time, _, _ = repeated(random)
    rows = random.permutation(len(who)) if order == "mixed" else np.arange(len(who))
    visits = Visits(who, time).take(rows)
    basis = np.column_stack([who, time])[rows].astype(float)
    keys, own = random.random(len(who)), random.random(len(who))
    moved = visits.shuffle(basis, "whole", keys, own)
    np.testing.assert_array_equal(moved[:, 1], visits.times)  # each visit to the same visit
    pairs = np.unique(np.column_stack([visits.people, moved[:, 0]]), axis=0)
    assert len(pairs) == len(np.unique(who))  # all visits of one go to one
    assert (pairs[:, 0] != pairs[:, 1]).sum() > 15
    inside = replace(visits, blocks=visits.people % 2).shuffle(basis, "whole", keys, own)
    np.testing.assert_array_equal(inside[:, 0] % 2, visits.people % 2)
    np.testing.assert_array_equal(inside[:, 1], visits.times)
    assert (inside[:, 0] != visits.people).sum() > 40
    sizes = np.bincount(who)
    np.testing.assert_array_equal(*(sizes[pairs[:, i].astype(int)] for i in range(2)))
    inside = visits.shuffle(basis, "within", keys, own)
    np.testing.assert_array_equal(inside[:, 0], visits.people)
    assert (inside[:, 1] != visits.times).sum() > 20
    assert sorted(map(tuple, inside)) == sorted(map(tuple, basis))


@pytest.mark.parametrize("contrast", [GROUP, Contrast("both", np.eye(3)[1:])])
def test_designs_are_split_into_tested_and_other_columns(contrast):
    """Tested columns give the estimate over its standard error's factor; together they span."""
    _, matrix, maps = case()
    designs = np.stack([matrix, matrix * [1, 2, 3]])
    tested, nuisance = exchangeability.split(designs, contrast)
    for part, design in zip(np.concatenate([tested, nuisance], axis=-1), designs, strict=True):
        np.testing.assert_allclose(part.T @ part, np.eye(3), atol=1e-9)
        np.testing.assert_allclose(part @ (part.T @ design), design, atol=1e-9)
        estimate = contrast.weights @ np.linalg.lstsq(design, maps, rcond=None)[0]
        spread = contrast.weights @ np.linalg.inv(design.T @ design) @ contrast.weights.T
        gained = np.sum(estimate * np.linalg.solve(spread, estimate), axis=0)
        scores = part[:, : contrast.n_rows].T @ maps
        np.testing.assert_allclose(np.sum(scores**2, axis=0), gained, rtol=1e-9)
    assert exchangeability.spans_constant(matrix, contrast)
    assert not exchangeability.spans_constant(matrix, Contrast("mean", np.eye(3)[0]))
    assert exchangeability.spans_constant(matrix[:, :1], Contrast("map", np.array([0.0, 1.0])))


@pytest.mark.parametrize("count", [7, 5000, 70_000])
def test_keys_are_the_order_of_rows(count):
    key = np.random.default_rng(count).random(count)
    rows = np.arange(count)[:, None].astype(float)
    np.testing.assert_array_equal(exchangeability.shuffle(rows, None, key)[:, 0], np.argsort(key))
    inside = exchangeability.shuffle(rows[:5], np.array([1, 0, 1, 0, 1]), np.arange(5) * -1.0)
    assert inside[:, 0].tolist() == [4, 3, 2, 1, 0]
    flipped = exchangeability.flip(rows[1:4], np.array([0.49, 0.5, 0.51]))
    assert flipped[:, 0].tolist() == [-1, 2, 3]


def two_visits(people, between=0.0):
    """A group of every second participant, and a number that changes by two, with times."""
    who = np.repeat(np.arange(people), 2)
    change = np.tile([-1.0, 1.0], people) + np.sqrt(between) * np.where(who // 2 % 2, 1, -1)
    return who, np.column_stack([np.ones(len(who)), who % 2, change])


def test_exchange_is_chosen_by_classes_and_by_what_changes():
    group, change = Contrast("group", np.eye(3)[1]), Contrast("change", np.eye(3)[2])
    for people, wanted in ((4, "flip"), (5, "whole")):
        who, matrix = two_visits(people)
        assert choose_exchange(matrix, group, Visits(who), "auto") == wanted
        assert choose_exchange(matrix, change, Visits(who), "auto") == "within"
    # Of the sum of squares 1 / 11 and 12 / 112 lie between participants.
    for between, wanted in ((0.1, "within"), (0.12, "flip")):
        who, matrix = two_visits(40, between)
        assert choose_exchange(matrix, change, Visits(who), "auto") == wanted
        assert choose_exchange(matrix, change, Visits(who, slopes=True), "auto") == "flip"
    with pytest.raises(ModelError, match="change differs between participants, which"):
        choose_exchange(matrix, change, Visits(who), "within")
    with pytest.raises(ModelError, match="change is the same in all participants, which"):
        choose_exchange(matrix, change, Visits(who), "whole")
    assert choose_exchange(matrix, change, Visits(who), "flip") == "flip"
    assert choose_exchange(matrix, group, Visits(who), "whole") == "whole"
    who, matrix = two_visits(40)
    visits = Visits(who, np.tile([0.0, 2.0], 40), blocks=who % 2)
    assert visits.classes().tolist() == [[2] * 80, (who % 2).tolist()]
    signs = visits.shuffle(matrix, "flip", np.where(np.arange(80) < 20, 0.1, 0.9), np.zeros(80))
    np.testing.assert_array_equal(signs, matrix * np.where(who < 20, -1, 1)[:, None])
    text = exchangeability.exchange_text(matrix, [group, change, GROUP], visits, "auto")
    assert text == (
        "For group, group, participants with the same number of visits were exchanged; for change,"
        " visits were exchanged within participants"
    )
    # A curve of time that all have, or that all of a block have, differs between nobody.
    own = np.where(who % 2, 3.0, 1.0) * visits.times[:, None].T
    for tested, is_varying in ((own, False), (own + who // 2 % 2, True)):
        assert exchangeability.varies_between(tested.T, visits) == is_varying
    assert exchangeability.varies_between(own.T, replace(visits, blocks=None))
    assert not exchangeability.varies_inside(np.column_stack([who % 2, who]), who)
    assert exchangeability.varies_inside(np.column_stack([who % 2, who]), who % 2)


def test_effects_that_blocks_determine_are_refused():
    random = np.random.default_rng(0)
    who, matrix = two_visits(20)
    maps, none = random.standard_normal((40, 3)), np.empty((0, 2), dtype=np.int64)
    few = MultiplicitySettings(method="permutation-max", permutations=120)
    group, change = Contrast("group", np.eye(3)[1]), Contrast("change", np.eye(3)[2])
    for visits in (None, Visits(who)):
        part = PermutationPart(maps, matrix, np.arange(40), none, visits)
        with pytest.raises(ModelError, match="group does not vary inside the blocks"):
            permute_parts([part], group, settings=few, blocks=who % 2)
        done = []
        blocks = who // 2 % 2
        (found,) = permute_parts([part], change, settings=few, blocks=blocks, report=done.append)
        assert done == [0, 50, 100]
        assert np.isnan(found.p_enhanced).all()
    mean = Contrast("mean", np.eye(3)[0])  # signs are flipped, blocks or not
    (found,) = permute_parts([part], mean, settings=few, blocks=who)
    assert (found.p_max >= found.p_uncorrected).all()
