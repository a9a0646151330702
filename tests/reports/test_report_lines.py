"""Cuts and outlines against answers known exactly."""

import base64
import io
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from hipsta_bids.reports.cells import FILTERS
from hipsta_bids.reports.participant import _quality_numbers
from hipsta_bids.reports.slices import cut, image_address, outline, path_data


def test_a_cut_through_a_tilted_plane_is_a_straight_line():
    x, y = np.meshgrid(np.arange(4.0), np.arange(5.0), indexing="ij")
    points = np.stack([x, y, 2 * x + 1], axis=-1)
    lines = cut(points, 2, 4.0)  # where x is 1.5
    np.testing.assert_allclose(lines[..., 2], 4.0)
    np.testing.assert_allclose(lines[..., 0], 1.5)
    assert np.linalg.norm(lines[:, 0] - lines[:, 1], axis=1).sum() == 4.0  # from y = 0 to y = 4


def test_a_plane_beside_the_grid_cuts_nothing():
    points = np.zeros((3, 3, 3))
    assert cut(points, 1, 5.0).shape == (0, 2, 3)


def test_the_outline_of_a_rectangle_is_four_lines():
    inside = np.zeros((5, 6), dtype=bool)
    inside[1:3, 2:5] = True
    edges = outline(inside)
    assert len(edges) == 4
    lengths = sorted(np.linalg.norm(edges[:, 0] - edges[:, 1], axis=1))
    assert lengths == [2.0, 2.0, 3.0, 3.0]
    np.testing.assert_array_equal(edges.min(axis=(0, 1)), [0.5, 1.5])
    np.testing.assert_array_equal(edges.max(axis=(0, 1)), [2.5, 4.5])


def test_the_outline_reaches_the_border_of_the_picture():
    assert len(outline(np.ones((2, 2), dtype=bool))) == 4


def test_lines_with_missing_points_are_left_out():
    lines = np.array([[[0, 0], [1, 2.5]], [[np.nan, 0], [1, 1]]])
    assert path_data(lines) == "M0 0l1 2.5"


def test_lines_that_meet_are_joined_whichever_way_they_run():
    lines = np.array([[[1, 0], [2, 0.5]], [[1, 0], [0, 0]], [[2, 0.5], [2, 3]], [[5, 5], [6, 6]]])
    joined, alone = path_data(lines).split("M")[1:]
    start, *steps = (np.fromstring(part, sep=" ") for part in joined.replace("l", "M").split("M"))
    points = np.vstack([start, start + np.cumsum(steps[0].reshape(-1, 2), axis=0)])
    expected = [[0, 0], [1, 0], [2, 0.5], [2, 3]]
    assert points.tolist() in (expected, expected[::-1])
    assert alone == "5 5l1 1"


def test_pictures_come_back_as_they_were():
    pixels = np.arange(2 * 3 * 4, dtype=np.uint8).reshape(2, 3, 4)
    encoded = image_address(pixels, "png").removeprefix("data:image/png;base64,")
    read = np.asarray(Image.open(io.BytesIO(base64.b64decode(encoded))))
    np.testing.assert_array_equal(read, pixels)


@pytest.mark.parametrize(("lengths", "marked"), [((16.0, 18.0), False), ((12.0, 18.0), True)])
def test_bodies_of_both_sides_of_quite_different_length_are_marked(lengths, marked):
    measured = [
        SimpleNamespace(
            side=side,
            summary={"thickness_mean": 2.0},
            metrics={"body_length_mm": length, "anterior_end_uncertainty_mm": 1.0},
        )
        for side, length in zip(("left", "right"), lengths, strict=True)
    ]

    def row(*sides):
        cohort = SimpleNamespace(settings={})
        series = SimpleNamespace(measured=list(sides), cohort=cohort, whole=False)
        rows = _quality_numbers(series)["rows"]
        return {usual["title"]: (usual, values) for usual, values in rows}.get(
            "Difference of these distances"
        )

    usual, values = row(*measured)
    difference = lengths[0] - lengths[1]
    texts = [FILTERS["quality"](value, usual) for value in values]
    assert texts == [f"{difference:g} mm", f"{-difference:g} mm"]
    assert [usual["low"] <= value <= usual["high"] for value in values] == [not marked] * 2
    assert FILTERS["usual_range"](usual) == f"{usual['low']:g} mm to {usual['high']:g} mm"
    assert row(measured[0]) is None  # there is nothing to compare
