"""Marks of repairs, on a flat sheet in a straight grid where every distance is known."""

import numpy as np
import pytest

from hipsta_bids.geometry.grid import Field, WedgeGrid
from hipsta_bids.geometry.topology import STUMP_REACH, SolidField, repaired_columns
from hipsta_bids.settings import MeasureSettings
from hipsta_bids.types import Sheet

SETTINGS = MeasureSettings()
#: The wall, y from 5 to 7 mm; columns stand 1 mm apart, grid nodes 0.5 mm.
WALL = (5.0, 7.0)
SPACING = 0.5


def make_sheet(undefined=()):
    x, z, y = np.meshgrid(
        2.0 + np.arange(16), 2.0 + 1.0 * np.arange(11), np.linspace(*WALL, 5), indexing="ij"
    )
    points = np.stack([x, y, z], axis=-1)
    valid = np.ones((16, 11), dtype=bool)
    for column in undefined:
        points[column], valid[column] = np.nan, False
    return Sheet(points=points, valid=valid)


def make_solid(*, added=(), removed=(), stumps=()):
    """A slab with changes at points (x, y, z), mm; ``stumps`` stand on it."""
    grid = WedgeGrid(
        shape=(40, 40, 29),
        spacing=SPACING,
        origin=np.zeros(3),
        across=np.eye(3)[:2],
        axis=np.eye(3)[2],
        posterior=np.zeros(3),
        anterior=np.array([28 * SPACING, 0, 0]),
    )
    values = np.full(grid.shape, -0.5, dtype=np.float32)
    b = np.arange(40) * SPACING
    values[:, (b >= WALL[0]) & (b <= WALL[1])] = 0.5
    touched = np.zeros(grid.shape, dtype=bool)
    for points, value, change in ((stumps, 0.5, False), (added, 0.5, True), (removed, -0.5, True)):
        for point in points:
            node = tuple(np.rint(np.array(point) / SPACING).astype(int))
            values[node] = value
            touched[node] = change
    return SolidField(
        field=Field(grid=grid, values=values),
        before=Field(grid=grid, values=values),
        repairs=(),
        touched=touched,
        euler_before=1,
        euler_after=1,
        changed_fraction=0.0,
    )


def marked(solid, sheet=None):
    found = repaired_columns(sheet or make_sheet(), solid)
    return {tuple(column) for column in np.argwhere(found).tolist()}


def test_nothing_changed_marks_nothing():
    assert marked(make_solid()) == set()


def test_a_filled_hole_marks_the_column_that_passes_through_it():
    hole = [(9.0, y, 7.0) for y in (5.0, 5.5, 6.0, 6.5, 7.0)]
    assert marked(make_solid(added=hole)) == {(7, 5)}


def test_a_change_between_columns_marks_both():
    assert marked(make_solid(added=[(9.5, 6.0, 7.0)])) == {(7, 5), (8, 5)}
    assert marked(make_solid(added=[(9.0, 6.0, 7.5)])) == {(7, 5), (7, 6)}


def test_a_piece_that_was_removed_elsewhere_marks_nothing():
    assert marked(make_solid(removed=[(9.0, 10.0, 7.0), (9.0, 10.5, 7.0)])) == set()


def test_undefined_columns_are_never_marked():
    hole = [(9.0, y, 7.0) for y in (5.0, 6.0, 7.0)]
    assert marked(make_solid(added=hole), make_sheet([(7, 5)])) == set()
    assert marked(make_solid(added=hole), make_sheet([(8, 5)])) == {(7, 5)}


def test_all_columns_undefined():
    every = [(i, j) for i in range(16) for j in range(11)]
    assert marked(make_solid(added=[(9.0, 6.0, 7.0)]), make_sheet(every)) == set()


@pytest.mark.parametrize("height", [1.0, 2.0])
def test_a_cut_marks_what_its_stump_stands_on(height):
    """A bar over column (7, 5); cut ``height`` mm above the wall, its other end in the air."""
    bar = [(9.0, WALL[1] + k * SPACING, 7.0) for k in range(1, 12)]
    cut = (9.0, WALL[1] + height, 7.0)
    found = marked(make_solid(stumps=[point for point in bar if point != cut], removed=[cut]))
    assert (7, 5) in found
    # The farther face of the cut stands a node above it; from there the sphere that touches the
    # wall plus ``STUMP_REACH`` reaches this far along the wall, and columns half their distance.
    farthest = height + SPACING
    reach = np.sqrt((farthest + STUMP_REACH) ** 2 - farthest**2) + 0.5 * np.sqrt(2)
    assert all(np.hypot(i - 7, j - 5) <= reach for i, j in found)
    # Round the bar alike on all sides.
    assert found == {(14 - i, j) for i, j in found} == {(i, 10 - j) for i, j in found}
