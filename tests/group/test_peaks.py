"""Peak tables of planted effects, and families of tests."""

from dataclasses import replace

import numpy as np
import pytest

from hipsta_bids.group.formula import Contrast
from hipsta_bids.group.glm import fit_points
from hipsta_bids.group.inference import MapKey, discover, fdr_two_stage
from hipsta_bids.group.peaks import SheetFrame, peak_table
from hipsta_bids.group.settings import GlmSettings, MultiplicitySettings

SHAPE = (12, 8)
FRAME = SheetFrame(
    np.linspace(-0.95, 0.95, 12),
    np.linspace(-1, 1, 8),
    np.where(np.arange(12)[:, None] < 5, "SUB", "CA1") + np.zeros(8, dtype="U1"),
)


def planted(effect):
    random = np.random.default_rng(0)
    matrix = np.column_stack([np.ones(60), np.arange(60) % 2])
    maps = random.standard_normal((60, *SHAPE))
    maps[1::2, 3:6, 2:5] -= effect
    maps[1::2, 4, 3] -= effect
    contrasts = [Contrast("patients", np.eye(2)[1]), Contrast("any", np.eye(2))]
    return fit_points(maps.reshape(60, -1), matrix, contrasts, GlmSettings()).tests


def test_planted_effect_is_the_first_row():
    test, _ = planted(2.0)
    found = fdr_two_stage(test.p, 0.05)
    first = peak_table(test, found, FRAME, 8).iloc[0]
    assert first["x"] == FRAME.x[4]
    assert first["y"] == FRAME.y[3]
    assert first["subfield"] == "SUB"
    assert first["extent"] >= 9
    shares = [float(part.split()[1].rstrip("%")) for part in first["shares"].split("; ")]
    assert sum(shares) == pytest.approx(100, abs=1)  # each is rounded
    point = 4 * 8 + 3
    assert first["statistic"] == test.statistic[point] < -5
    assert first["p"] == test.p[point]
    assert first["p_corrected"] == found.adjusted[point]
    assert first["effect"] == "cohen_d"
    assert first["effect_low"] < first["effect_size"] == test.cohen_d[point] < first["effect_high"]


def test_without_findings_the_largest_statistic_is_told():
    test, _ = planted(0.0)
    found = fdr_two_stage(test.p, 0.001)
    (row,) = peak_table(test, found, FRAME, 8).to_dict("records")
    assert row["extent"] == 0
    assert abs(row["statistic"]) == np.abs(test.statistic).max()


def test_f_tests_tell_eta_squared_and_empty_maps_nothing():
    _, test = planted(2.0)
    table = peak_table(test, fdr_two_stage(test.p, 0.05), FRAME, 4)
    assert set(table["effect"]) == {"partial_eta_squared"}
    blank = replace(test, statistic=np.full(96, np.nan), p=np.full(96, np.nan))
    assert peak_table(blank, fdr_two_stage(blank.p, 0.05), FRAME, 4).empty


def test_families_are_maps_or_both_hemispheres():
    random = np.random.default_rng(1)
    maps = {
        MapKey("thickness", "group", "L"): random.random(SHAPE) * 1e-4,
        MapKey("thickness", "group", "R"): random.random(SHAPE),
        MapKey("thickness", "age", "R"): random.random(SHAPE),
    }
    each = discover(maps, MultiplicitySettings())
    both = discover(maps, MultiplicitySettings(scope="hemispheres"))
    assert list(each) == list(maps)
    for key, p in maps.items():
        alone = fdr_two_stage(p, 0.05)
        np.testing.assert_array_equal(each[key].adjusted, alone.adjusted)
    left, right, age = maps
    pooled = fdr_two_stage(np.stack([maps[left], maps[right]]), 0.05)
    np.testing.assert_array_equal(both[left].adjusted, pooled.adjusted[0])
    np.testing.assert_array_equal(both[right].rejected, pooled.rejected[1])
    assert both[right].cutoff == pooled.cutoff
    np.testing.assert_array_equal(both[age].adjusted, each[age].adjusted)
    single = discover(maps, MultiplicitySettings(method="bh"))
    assert single[left].n_null == pytest.approx(96)
