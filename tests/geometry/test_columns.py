"""Columns of a sheet, cut at the walls of a body."""

import numpy as np
import pytest
from plates import BENT, HIGH, LOW, NX, NY, at, flat_sheet, plate_field

from hipsta_bids.geometry import columns


@pytest.fixture
def sheet():
    return flat_sheet()


def test_moved_walls_are_found(sheet):
    walls = columns.find_walls(sheet, np.eye(4), plate_field(at(8.3), at(10.2)))
    assert walls.raw[..., 0] == pytest.approx(0.3, abs=BENT)
    assert walls.raw[..., 1] == pytest.approx(0.2, abs=BENT)
    assert walls.moves == pytest.approx(walls.raw, abs=1e-3)
    assert walls.distance == pytest.approx(np.sqrt((0.09 + 0.04) / 2), abs=BENT)


def test_a_fold_beside_the_sheet_is_not_its_wall(sheet):
    walls = columns.find_walls(sheet, np.eye(4), plate_field(at(8.0), at(10.0), [(10.8, 12.0)]))
    assert walls.known.all()
    assert walls.raw == pytest.approx(0.0, abs=BENT)


def test_columns_that_run_into_a_fold_follow_their_neighbors(sheet):
    def joined(points):
        touching = np.abs(points[..., 1] - 10) < 0.8
        return np.where(touching, 13.0, 10.1)

    walls = columns.find_walls(sheet, np.eye(4), plate_field(at(8.0), joined))
    assert 0 < (~walls.known).sum() < NX * NY / 4
    # Where the field turns from one wall to the other, it is not exact.
    assert walls.moves[~walls.known][:, 1] == pytest.approx(0.1, abs=0.15)


@pytest.mark.slow
def test_a_wall_that_moves_away_loses_its_weight_gradually(sheet):
    def moves(distance):
        field = plate_field(
            at(LOW), lambda p: HIGH + distance * np.exp(-((p[..., 1] - 10) ** 2) / 0.72)
        )
        return columns.find_walls(sheet, np.eye(4), field).moves[..., 1]

    distances, spacing = np.arange(0.0, 1.45, 0.02), 12 / (NX - 1)
    maps = np.stack([moves(distance) for distance in distances])
    largest = np.abs(np.diff(maps, axis=0)).max(axis=(1, 2))
    assert largest.max() < 2 * 0.02
    assert maps[distances.searchsorted(0.4)].max() == pytest.approx(0.4, abs=0.12)
    # There, the neighbors decide.
    assert maps[-1].max() == pytest.approx(distances[-1] * np.exp(-(spacing**2) / 0.72), abs=0.05)


def test_a_body_far_from_the_sheet_has_no_walls(sheet):
    walls = columns.find_walls(sheet, np.eye(4), plate_field(at(13.0), at(15.0)))
    assert not walls.known.any()
    assert not walls.moves.any()


def test_smoothing_keeps_a_slope_of_walls_and_lowers_noise(sheet):
    slope = plate_field(at(8.0), lambda p: 10 + 0.03 * (p[..., 1] - 10))
    moves = columns.find_walls(sheet, np.eye(4), slope).moves[2:-2, :, 1]
    expected = 0.03 * (sheet.points[2:-2, :, 0, 1] - 10)
    assert moves == pytest.approx(expected, abs=BENT)


def test_columns_are_continued_in_equal_steps(sheet):
    points, depth = columns._continued(sheet)
    steps = np.linspace(-columns.BEYOND, HIGH - LOW + columns.BEYOND, 101)  # of 0.05 mm
    np.testing.assert_allclose(depth[3, 4], steps, atol=1e-12)
    np.testing.assert_allclose(points[3, 4, :, 0], LOW + steps)
