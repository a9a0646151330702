"""False positives of slopes without change: the share, its range by chance, and the targets."""

import numpy as np
import pytest
from scipy import ndimage, stats

from validation import unchanged
from validation.unchanged import by_chance, participants, positives, studies
from validation.visits import Result


def noise(count, random, shift=0.0):
    """Smooth slopes of participants."""
    maps = ndimage.gaussian_filter(random.normal(0, 1, (count, 40, 20)), (0, 2, 2))
    return shift + maps


def test_the_share_of_positives_is_the_level_without_change_and_rises_with_change():
    random = np.random.default_rng(1)
    # Independent points: three standard errors of 20,000 of them.
    assert positives(random.normal(0, 1, (20, 200, 100))) == pytest.approx(0.05, abs=0.005)
    maps = noise(20, random)
    assert positives(maps + maps.std()) > 0.9


def test_reversed_visits_give_the_t_test_of_scipy():
    maps = noise(12, np.random.default_rng(2))
    shares = by_chance(maps, np.random.default_rng(3))
    signs = np.random.default_rng(3).choice((-1.0, 1.0), (unchanged.FLIPS, 12))
    for number in range(5):
        p = stats.ttest_1samp(signs[number][:, None, None] * maps, 0.0, axis=0).pvalue
        assert shares[number] == np.mean(p < 0.05)


def test_reversed_visits_show_how_far_the_share_of_new_participants_varies():
    random = np.random.default_rng(4)
    shares = by_chance(noise(20, random), random)
    new = [positives(noise(20, random)) for _ in range(300)]
    assert shares.mean() == pytest.approx(0.05, abs=0.01)
    # Four standard errors of an SD of 300 draws, and the luck of one set of maps.
    assert shares.std() == pytest.approx(np.std(new), rel=0.25)


def test_every_participant_is_in_a_study_and_seeds_differ():
    people = participants(40, [])
    assert len({person.seed for person in people}) == 40
    assert len({person.sources[0] for person in people}) == 40
    assert [len(study) for study in studies(np.zeros((200, 2)))] == [20] * 10


def test_targets_are_those_of_all_participants():
    random = np.random.default_rng(5)

    def group(shift):
        visits = [2 + random.normal(0, 0.1, (3, 60, 40)) for _ in range(40)]
        return [
            Result(
                frame=maps + shift * np.arange(3)[:, None, None],
                smooth=None,
                separate=None,
                true=None,
                smoother=None,
                volume=np.ones(3),
                separate_volume=None,
                labels_volume=np.ones(3),
                ca1=np.zeros((60, 40), dtype=bool),
                filled=0.0,
                overlap=1.0,
                distance=0.0,
                flagged=0,
                cost=1.0,
                memory=1.0,
            )
            for maps in visits
        ]

    rows = unchanged._false_positives({"all": group(0.0), "phantoms": group(0.0)}).rows
    # 2,400 independent points: 0.01 is two standard errors.
    assert rows[0]["met"] is rows[0]["studies met"] is True
    assert rows[1]["met"] is None
    (row,) = unchanged._false_positives({"all": group(0.05)}).rows
    assert row["met"] is row["studies met"] is False
    assert row["slope, mm per year"] == pytest.approx(0.05, abs=0.002)
    assert row["visits reversed"] < 0.1
