"""The x coordinate that is harmonic on the mid-surface."""

import numpy as np
import pytest
from lapy import TriaMesh
from scipy.spatial import cKDTree

from hipsta_bids.geometry.fem import Laplace, bare_mesh
from hipsta_bids.geometry.sheet import hull, sample_sheet, straighten_rows
from hipsta_bids.settings import SheetSettings


def test_the_highest_chords_close_a_notch_and_leave_the_rest():
    position = np.arange(0.0, 20.1, 0.5)
    notch = np.where(np.abs(position - 10) < 1.9, -1.4, 0.0)
    np.testing.assert_allclose(hull(notch, position, 8.0), 0.0, atol=1e-12)
    np.testing.assert_allclose(hull(notch, position, 2.0).min(), -1.4)  # wider than that
    slope = 0.3 * position
    np.testing.assert_allclose(hull(slope, position, 8.0), slope, atol=1e-12)
    np.testing.assert_allclose(-hull(-np.abs(position - 10), position, 4.0).min(), 10.0)


@pytest.fixture(scope="module")
def straight(slab):
    return straighten_rows(slab.mesh, slab.coordinates, "two-level")


def test_rows_of_a_slab_are_even(slab, straight):
    sheet = sample_sheet(slab.mesh, straight, SheetSettings())
    steps = np.linalg.norm(np.diff(sheet.points[:, :, sheet.middle], axis=0), axis=-1)
    assert steps[2:-2].std() / steps[2:-2].mean() < 0.02


@pytest.mark.slow
def test_columns_are_numbered_anew_and_stay_where_they_are(slab, straight):
    """A line of equal y and z is the same, and thickness at a place."""
    np.testing.assert_array_equal(straight.values[:, 1:], slab.coordinates.values[:, 1:])
    order = np.argsort(slab.coordinates.values[:, 0])
    middle = np.abs(slab.coordinates.values[:, 1]) < 0.05
    row = order[middle[order]]
    assert np.diff(straight.values[row, 0]).min() > -0.05  # rises, but for the width of the row
    dense = SheetSettings(x_nodes=161, y_nodes=81)
    new, old = (sample_sheet(slab.mesh, c, dense) for c in (straight, slab.coordinates))
    thickness = [np.linalg.norm(np.diff(s.points, axis=2), axis=3).sum(axis=2) for s in (new, old)]
    points = [s.points[:, :, s.middle].reshape(-1, 3) for s in (new, old)]
    gap, nearest = cKDTree(points[1]).query(points[0])
    close = gap < 0.1
    assert close.mean() > 0.9
    np.testing.assert_allclose(
        thickness[0].ravel()[close], thickness[1].ravel()[nearest[close]], atol=0.05
    )


def test_edges_have_the_coordinates_of_edges(slab, straight):
    b = slab.boundaries
    np.testing.assert_allclose(straight.values[b.medial, 0], -1.0, atol=1e-9)
    np.testing.assert_allclose(straight.values[b.lateral, 0], 1.0, atol=1e-9)


def test_a_field_is_integrated_exactly():
    x, y = np.meshgrid(np.arange(6.0), np.arange(5.0), indexing="ij")
    points = np.stack([x, y, 0.2 * x * y], axis=-1).reshape(-1, 3)
    number = np.arange(30, dtype=np.int32).reshape(6, 5)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    halves = [np.stack(half, axis=-1).reshape(-1, 3) for half in ((a, b, c), (a, c, d))]
    laplace = Laplace(bare_mesh(TriaMesh, points, np.concatenate(halves)))
    values = np.random.default_rng(0).random(30)
    again = laplace.integrate(laplace.gradient(values))
    np.testing.assert_allclose(again - again[0], values - values[0], atol=1e-10)
