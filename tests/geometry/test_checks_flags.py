"""What a finding means for the map: which columns, and what they do to the mean thickness."""

import numpy as np
import pytest
from sheet_cases import plates, sheet_of

from hipsta_bids.geometry import checks
from hipsta_bids.geometry.checks import (
    add_consequence,
    flag_margins,
    raise_flags,
    spread_over,
)
from hipsta_bids.geometry.measures import column_area, measure_thickness
from hipsta_bids.types import Finding


def finding(value=2.0, limit=1.0, **others):
    return Finding(
        reason="section-bump", value=value, limit=limit, text="odd", remedy="look", **others
    )


def thicker(size, columns=slice(18, 23), rows=slice(9, 12)):
    """Plates 1.7 mm apart that bulge by ``size`` mm in 5 x 3 of 41 x 21 columns."""
    sheet = plates(thickness=1.7)
    points = sheet.points.copy()
    share = np.linspace(0, 1, points.shape[2])
    points[columns, rows, :, 2] += size * share
    return sheet_of(points), points[columns, rows, sheet.middle].reshape(-1, 3)


def test_margins_are_the_largest_by_reason():
    several = [finding(0.5), finding(0.8), finding(0.0, 0.0), finding(0.2, 0.5)]
    assert flag_margins(several) == {"section-bump": 0.8}
    assert flag_margins([finding(1.0, 0.0)]) == {"section-bump": np.inf}
    assert flag_margins([]) == {}


def test_only_what_is_beyond_its_limit_becomes_a_flag():
    assert raise_flags([finding(1.0)], plates(), str) == []
    (flag,) = raise_flags([finding(1.1)], plates(), str)
    assert (flag.message, flag.value, flag.limit) == ("odd: look", 1.1, 1.0)


@pytest.mark.parametrize("size", [0.6, -0.6])
def test_a_flag_says_what_it_does_to_the_mean(size, monkeypatch):
    """Columns measure 0.3 x 0.4 mm: those within 0.05 mm of the finding are its own."""
    sheet, points = thicker(size)
    monkeypatch.setattr(checks, "FLAG_REACH", 0.05)
    (flag,) = raise_flags([finding(points=points)], sheet, lambda at: f"P{len(at)}")
    assert flag.share == pytest.approx(15 / 861)
    mean = np.average(measure_thickness(sheet), weights=column_area(sheet))
    assert flag.change == pytest.approx(mean - 1.7)  # mm, the other columns
    assert flag.message == "odd, near P15: look"


def test_columns_are_concerned_within_the_reach(monkeypatch):
    sheet, points = thicker(0.0)
    shares = []
    for reach in (0.05, 0.35, 20.0):
        monkeypatch.setattr(checks, "FLAG_REACH", reach)
        shares.append(add_consequence(finding(points=points), sheet).share)
    # 0.3 mm apart along x and 0.4 mm along y: one more column on both sides of each row.
    assert shares == pytest.approx([15 / 861, 21 / 861, 1.0])


def test_all_columns_or_none_are_concerned(monkeypatch):
    sheet, points = thicker(0.0)
    monkeypatch.setattr(checks, "FLAG_REACH", 20.0)
    everywhere = add_consequence(finding(points=points), sheet)
    assert (everywhere.share, np.isnan(everywhere.change)) == (1.0, True)
    beside = add_consequence(finding(points=points + 50.0), sheet)
    assert (beside.share, beside.change) == (0.0, 0.0)
    assert np.isnan(add_consequence(finding(), sheet).share)


def test_a_gap_is_filled_by_a_harmonic_function():
    x, y = np.meshgrid(np.arange(12.0), np.arange(9.0), indexing="ij")
    values = 2 * x - 3 * y + 1  # harmonic itself
    hole = np.zeros(values.shape, dtype=bool)
    hole[3:7, 2:6] = True
    damaged = np.where(hole, np.nan, values)
    np.testing.assert_allclose(spread_over(damaged, hole), values, atol=1e-9)
    np.testing.assert_array_equal(spread_over(values, np.zeros_like(hole)), values)
