"""Lengths and areas of walls whose lengths are known, with whole and with rounded rims."""

import numpy as np
import pytest
from sheet_cases import grid, plates, sheet_of, tube

from hipsta_bids.geometry import measures
from hipsta_bids.geometry.measures import at_columns, extent_x, extent_y, wall_area, wall_length
from hipsta_bids.settings import MeasureSettings

MEASURES = MeasureSettings()
CHORDS = 3e-4  # chords of pi / 40 instead of arcs: short by (pi / 40)^2 / 24


def test_extents_of_plates():
    sheet = plates()
    assert extent_x(sheet) == pytest.approx(np.full(21, 12.0))
    assert extent_y(sheet) == pytest.approx(np.full(41, 8.0))


def test_extents_differ_from_line_to_line():
    x, y, z = grid()
    trapezoid = sheet_of(np.stack([(10 + 4 * y) * x, 8 * y, z], axis=-1))
    assert extent_x(trapezoid) == pytest.approx(np.linspace(10, 14, 21))
    assert extent_y(trapezoid) == pytest.approx(np.hypot(8, 4 * np.linspace(0, 1, 41)))


@pytest.mark.parametrize(("level", "radius"), [(0, 3.0), (-1, 5.0)])
def test_walls_of_a_tube(level, radius):
    sheet = tube()
    lengths = wall_length(sheet, level)
    np.testing.assert_allclose(lengths, np.pi * radius, rtol=CHORDS)
    assert wall_area(sheet, level) == pytest.approx(np.pi * radius * 10, rel=CHORDS)


def test_walls_do_not_depend_on_how_edges_are_rounded(monkeypatch):
    """Lines of a wall that stop short at the edges, as where strips reach round them."""
    whole = tube()
    points = whole.points.copy()
    points[:3, :, 0], points[-3:, :, -1] = points[3:4, :, 0], points[-4:-3, :, -1]
    rounded = sheet_of(points)
    for level in (0, -1):
        expected = wall_length(whole, level)
        np.testing.assert_allclose(wall_length(rounded, level), expected)
        assert wall_area(rounded, level) == pytest.approx(wall_area(whole, level))
    monkeypatch.setattr(measures, "ROUNDED_EDGE_START", 1.0)
    assert wall_length(rounded, 0).max() < 0.95 * wall_length(tube(), 0).min()


def test_small_grids_have_no_room_to_continue_walls():
    x, y, z = grid(5, 4, 3)
    sheet = sheet_of(np.stack([12 * x, 8 * y, 2 * z], axis=-1))
    assert wall_length(sheet, 0) == pytest.approx(np.full(4, 12.0))


def test_lines_between_lines():
    values = np.linspace(0, 40, 41)
    assert at_columns(values, 0.9, 41) == pytest.approx(np.linspace(2, 38, 41))
    assert at_columns(values, 1.0, 41) == pytest.approx(values)
    assert at_columns(values, 1 / 0.9, 41)[[0, -1]] == pytest.approx([0, 40])  # no line beyond
