"""Pairs of groups are compared on the same complete subjects."""

import numpy as np
import pytest

from hipsta_bids.errors import ModelError
from hipsta_bids.group.classify import compare_models, compare_pairs
from hipsta_bids.group.settings import ClassificationSettings

SETTINGS = ClassificationSettings(folds=3, repeats=1)
ORDER = ["CU", "MCI", "DAT"]


def case():
    random = np.random.default_rng(0)
    groups = np.array(ORDER)[np.arange(120) % 3]
    rank = np.arange(120) % 3
    volume = 2.0 - 0.3 * rank + 0.4 * random.standard_normal(120)
    thickness = 1.8 - 0.2 * rank + 0.2 * random.standard_normal(120)
    return groups, volume[:, None], thickness[:, None]


def test_each_pair_is_the_comparison_of_its_subjects():
    groups, volume, thickness = case()
    volume[[0, 4]] = np.nan
    thickness[[0, 5]] = np.nan
    found = compare_pairs(groups, volume, thickness, SETTINGS, order=ORDER)
    assert [(pair.control, pair.case) for pair in found] == [
        ("CU", "MCI"),
        ("CU", "DAT"),
        ("MCI", "DAT"),
    ]
    assert [pair.n_incomplete for pair in found] == [2, 2, 2]
    used = np.isin(groups, ["CU", "DAT"]) & np.isfinite(volume + thickness)[:, 0]
    base = np.column_stack([np.ones(used.sum()), volume[used]])
    alone = compare_models(base, thickness[used], groups[used] == "DAT", SETTINGS)
    assert found[1].comparison.likelihood_ratio == alone.likelihood_ratio
    assert found[1].comparison.n == used.sum()
    # Groups two steps apart are easier to tell than neighbors.
    areas = [pair.comparison.full.auc.area for pair in found]
    assert areas[1] > max(areas[0], areas[2])
    assert found[1].comparison.full.fit.coefficients[2] < 0  # cases are thinner


def test_names_the_pair_that_cannot_be_compared():
    groups, volume, thickness = case()
    thickness[groups == "DAT"] = np.nan
    with pytest.raises(ModelError, match="CU against DAT"):
        compare_pairs(groups, volume, thickness, SETTINGS, order=ORDER)
    with pytest.raises(ModelError, match="nobody is in group SCD"):
        compare_pairs(groups, volume, thickness, SETTINGS, order=["CU", "SCD"])
