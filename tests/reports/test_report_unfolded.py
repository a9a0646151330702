"""Drawings of the pages of participants: where values lie, and what is missing."""

import re
from dataclasses import replace
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from hipsta_bids.reports import unfolded
from hipsta_bids.reports.display import CURVATURE, THICKNESS
from hipsta_bids.reports.results import find_results

AXES = unfolded._Axes(left=10, top=20, width=100, height=50, x=(0.0, 4.0), y=(-1.0, 1.0))


def test_lines_are_interrupted_where_points_are_missing():
    y = np.array([-1.0, 0.0, np.nan, 1.0, 1.0])
    line = AXES.line(np.arange(5.0), y)
    assert line == "M10.00,70.00L35.00,45.00M85.00,20.00L110.00,20.00"
    assert AXES.line(np.arange(5.0), np.full(5, np.nan)) == ""


@pytest.mark.parametrize(
    ("ends", "texts"),
    [
        ((0.5, 3.0), ["0.5", "1.0", "1.5", "2.0", "2.5", "3.0"]),
        ((-0.5, 0.5), ["\N{MINUS SIGN}0.4", "\N{MINUS SIGN}0.2", "0.0", "0.2", "0.4"]),
        ((-0.3, 22.9), ["0", "5", "10", "15", "20"]),
        ((0.0, 0.0012), ["0.0000", "0.0002", "0.0004", "0.0006", "0.0008", "0.0010", "0.0012"]),
    ],
)
def test_ticks_are_round_numbers(ends, texts):
    ticks = unfolded._ticks(*ends)
    assert [text for _, text in ticks] == texts
    values = [float(text.replace("\N{MINUS SIGN}", "-")) for text in texts]
    assert [value for value, _ in ticks] == pytest.approx(values)


def test_pins_are_at_the_columns_that_are_nearest(out):
    hemisphere = next(find_results(out, "01"))
    corners = [hemisphere.sheet.points["midthickness"][i, j] for i, j in ((0, 0), (-1, -1))]
    picture = unfolded.draw_map(THICKNESS, [hemisphere], pins=[tuple(c) for c in corners])
    root = ET.fromstring(picture.content)  # noqa: S314  (written here)
    width, height = (float(size) for size in root.get("viewBox").split()[2:])
    image = root.find("{*}image")
    left, top, wide, high = (float(image.get(key)) for key in ("x", "y", "width", "height"))
    columns, rows = hemisphere.sheet.shape
    half = wide / columns / 2, high / rows / 2
    (x1, y1), (x2, y2) = picture.pins
    assert x1 * width / 100 == pytest.approx(left + half[0], abs=0.2)  # medial
    assert y1 * height / 100 == pytest.approx(top + high - half[1], abs=0.2)  # posterior
    assert x2 * width / 100 == pytest.approx(left + wide - half[0], abs=0.2)
    assert y2 * height / 100 == pytest.approx(top + half[1], abs=0.2)


def test_names_are_escaped_and_rows_without_a_value_leave_a_gap(out):
    hemisphere = next(find_results(out, "01"))
    sheet = hemisphere.sheet
    values = sheet.columns["curvature"].copy()
    values[3] = np.nan
    subfield = np.full(sheet.shape, "<b>")
    columns = {**sheet.columns, "curvature": values}
    hemisphere.__dict__["sheet"] = replace(sheet, columns=columns, subfield=subfield)
    with np.errstate(all="ignore"), pytest.warns(RuntimeWarning):
        picture = unfolded.draw_profiles(CURVATURE, [hemisphere], {})
    root = ET.fromstring(picture.content)  # noqa: S314  (written here)
    assert "<b>" in [text.text for text in root.iterfind(".//{*}text")]
    mean = next(p for p in root.iterfind(".//{*}path") if "stroke-width: 1.5" in p.get("style", ""))
    assert [len(re.findall("[ML]", part)) for part in mean.get("d").split("M")[1:]] == [2, 36]


def test_a_map_of_one_value_has_a_profile(out):
    hemisphere = next(find_results(out, "01"))
    sheet = hemisphere.sheet
    columns = {**sheet.columns, "thickness": np.full(sheet.shape, 2.0)}
    hemisphere.__dict__["sheet"] = replace(sheet, columns=columns)
    picture = unfolded.draw_profiles(THICKNESS, [hemisphere], {})
    assert b"nan" not in picture.content
