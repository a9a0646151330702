"""Cross-sections of pipes and wedges, whose lengths and areas are known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sheet_cases import grid, plates, sheet_of, tube

from hipsta_bids.geometry.measures import cut_sections, measure_thickness, section_area
from hipsta_bids.settings import MeasureSettings

MEASURES = MeasureSettings()
CHORDS = 3e-4  # chords of pi / 40 instead of arcs: lengths are short by (pi / 40)^2 / 24


def cut(sheet):
    return cut_sections(sheet, measure_thickness(sheet).mean(axis=0))


@given(st.floats(2.5, 8.0), st.floats(0.5, 3.0))
@settings(max_examples=20, deadline=None)
def test_sections_of_a_pipe(radius, thickness):
    sections = cut(tube(radius, thickness))
    inner, outer = radius - thickness / 2, radius + thickness / 2
    wanted = {
        "position": np.linspace(0, 10, 21),
        "interior": np.full(21, np.pi * inner),
        "middle": np.full(21, np.pi * radius),
        "exterior": np.full(21, np.pi * outer),
        "area": np.full(21, np.pi / 2 * (outer**2 - inner**2)),
        "thickness": np.full(21, thickness),
        "circumference": np.full(21, 2 * np.pi * radius),
        "ratio": np.full(21, inner / outer),
        "shape_index": np.full(21, 2 / thickness),
    }
    for name, value in wanted.items():
        np.testing.assert_allclose(getattr(sections, name), value, rtol=CHORDS, err_msg=name)


def test_sections_follow_the_axis():
    x, y, z = grid()
    wedge = sheet_of(np.stack([12 * x, 8 * y, (1 + y) * z], axis=-1))
    sections = cut(wedge)
    assert sections.area == pytest.approx(12 * np.linspace(1, 2, 21))
    assert sections.thickness == pytest.approx(np.linspace(1, 2, 21))
    assert sections.mean(sections.area) == pytest.approx(18)


def test_every_millimeter_counts_the_same():
    x, y, z = grid()
    crowded = sheet_of(np.stack([12 * x, 8 * y**3, (1 + y**3) * z], axis=-1))
    sections = cut(crowded)
    # Trapezoids are exact where the area grows linearly with the position.
    assert sections.mean(sections.area) == pytest.approx(18, rel=2e-3)  # mid-lines climb a little
    assert sections.area.mean() < 16


def test_area_does_not_mind_how_the_section_is_cut_up():
    points = plates().points.copy()
    inner = points[1:-1, :, 1:-1]
    inner += np.random.default_rng(2).normal(0, 0.3, inner.shape) * [1, 0, 1]
    assert section_area(sheet_of(points)) == pytest.approx(np.full(21, 12 * 1.7))
    points[-2] = plates().points[-2]  # 11.7 mm up to there
    assert section_area(sheet_of(points[:-1])) == pytest.approx(np.full(21, 11.7 * 1.7))
