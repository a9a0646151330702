"""Sheets of one side in parts, some of them, and means of what is known."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from hipsta_bids.stats import arrays
from hipsta_bids.stats.arrays import SideMaps, WarpedLabels, WarpedMaps

VALUES = np.arange(5 * 3 * 2.0).reshape(5, 3, 2)


def side(**changes):
    """Five sheets of rows 1, 3, 4, 6 and 8 of a table."""
    plain = SideMaps(
        rows=np.array([1, 3, 4, 6, 8]),
        maps={"thickness": VALUES, "curvature": VALUES + 100},
        subfield=(VALUES % 3).astype(np.int8),
        names=("SUB", "CA1", "CA3"),
        summary=pd.DataFrame({"volume": 10.0 * np.arange(5)}, index=[7, 8, 9, 10, 11]),
    )
    return replace(plain, **changes)


@pytest.mark.parametrize("count", [0, 1, 3, 4, 7])
def test_blocks_hold_each_row_once(count):
    parts = list(arrays.blocks(count, 3))
    assert np.concatenate([np.arange(count)[part] for part in parts]).tolist() == [*range(count)]
    assert len(parts) == max(-(-count // 3), 1)


def test_known_cells_of_parts_are_described_as_those_of_the_table():
    table = np.random.default_rng(0).normal([5.0, -300.0, 0.1, 0.0, 7.0], [1, 2, 1e-3, 1, 1], (9, 5))
    table[[0, 4, 8], 0] = np.nan
    table[:6, 1] = np.nan  # none in the first part
    table[:, 3] = np.nan
    table[1:, 4] = np.nan  # a single value
    known, mean, spread = arrays.describe_known([table[:5], table[5:6], table[6:]])
    np.testing.assert_array_equal(known, np.isfinite(table))
    np.testing.assert_allclose(mean[[0, 1, 2, 4]], np.nanmean(table[:, [0, 1, 2, 4]], axis=0))
    np.testing.assert_allclose(spread[:3], np.nanstd(table[:, :3], axis=0, ddof=1), rtol=1e-9)
    assert np.isnan([mean[3], spread[3], spread[4]]).all()
    np.testing.assert_allclose(arrays.mean_of_known(table[:, :3], 1), np.nanmean(table[:, :3], 1))


def test_sheets_of_some_rows_keep_all_that_belongs_to_them():
    first, table = side(), np.isin(np.arange(9), [0, 3, 6, 7])
    cut = side(first=first, unmasked=VALUES - 1, covariates={"x": VALUES * 2}).take(table)
    assert cut.rows.tolist() == [1, 2]  # rows 3 and 6 of the table are its second and third
    for found, expected in (
        (cut.maps["curvature"], VALUES + 100),
        (cut.subfield, VALUES % 3),
        (cut.unmasked, VALUES - 1),
        (cut.curvature, VALUES - 1),
        (cut.covariates["x"], VALUES * 2),
        (cut.first.maps["thickness"], VALUES),
    ):
        np.testing.assert_array_equal(found, expected[[1, 3]])
    assert cut.summary.to_dict("list") == {"volume": [10.0, 30.0]}
    assert cut.summary.index.tolist() == [0, 1]
    plain = side().sheets(np.arange(5) > 2)
    assert (plain.first, plain.unmasked, plain.shape) == (None, None, (3, 2))
    np.testing.assert_array_equal(plain.curvature, VALUES[3:] + 100)
    assert first.sheets(np.ones(5, dtype=bool)) is first


def test_maps_and_summary_measures_are_chosen_by_name():
    whole = side(first=side())
    assert whole.only(["curvature", "thickness"]) is whole
    cut = whole.only(["curvature"])
    assert [*cut.maps] == [*cut.first.maps] == ["curvature"]
    assert side().only(["curvature"]).first is None
    np.testing.assert_array_equal(whole.covariate("thickness"), VALUES)
    volumes = np.broadcast_to(10.0 * np.arange(5)[:, None, None], VALUES.shape)
    np.testing.assert_array_equal(whole.covariate("volume"), volumes)
    more = whole.with_summary(pd.DataFrame({"area": np.arange(5.0)}))
    np.testing.assert_array_equal(more.covariate("area"), volumes / 10)


def test_warped_maps_are_carried_when_they_are_asked_for(monkeypatch):
    warps, rows = np.arange(5.0), np.array([4, 1, 2])

    def carry(values, by):
        return values + 1000 * by[:, None, None]

    moved = carry(VALUES, warps)
    maps = WarpedMaps({"thickness": VALUES}, warps, carry)
    assert ([*maps], len(maps)) == (["thickness"], 1)
    np.testing.assert_array_equal(maps["thickness"], moved)
    np.testing.assert_array_equal(arrays.some_sheets(maps, rows)["thickness"], moved[rows])
    labels = WarpedLabels(VALUES, warps, carry)
    assert labels.shape == VALUES.shape
    np.testing.assert_array_equal(labels[rows], moved[rows])
    monkeypatch.setattr(arrays, "SHEETS", 2)
    for source, expected in ((maps, moved), ({"thickness": VALUES}, VALUES)):
        for selected in (rows, np.isin(np.arange(5), rows)):
            parts = [*arrays.parts_of_sheets(source, "thickness", selected)]
            assert [len(part) for part in parts] == [2, 1]
            np.testing.assert_array_equal(np.concatenate(parts), expected[selected])
