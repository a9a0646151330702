"""The outline of the ribbon in one slice."""

import numpy as np
import pytest
from scipy import ndimage

from hipsta_bids.geometry.slices import outline_slice
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.settings import Settings

SETTINGS = Settings().slices
PIXEL = 0.4  # mm


def outline(tissue):
    return outline_slice(tissue, PIXEL, SETTINGS)


def fine_places(count):
    """Where fine pixels lie, in pixels of the segmentation."""
    return (np.arange(count * SETTINGS.upsampling) + 0.5) / SETTINGS.upsampling - 0.5


def test_a_straight_edge_lies_where_the_pixels_end():
    tissue = np.zeros((30, 30), dtype=np.uint8)
    tissue[:, 10:] = Tissue.CA1
    expected = (fine_places(30) - 9.5) * PIXEL
    near = np.abs(expected) < 1.5
    # Fine pixels sample the Gaussian at a fourth of its sigma; beyond it whole fine pixels count.
    np.testing.assert_allclose(outline(tissue)[30][near], expected[near], atol=0.03)


def test_a_slanting_edge_lies_between_the_pixels():
    """Whole pixels would put it off by up to half of one, 0.2 mm."""
    grid = np.indices((40, 40))
    slope = 1 / np.pi  # no row ends exactly at a pixel center
    tissue = np.where(grid[1] > slope * grid[0] + 8, Tissue.CA1, 0).astype(np.uint8)
    rows, columns = np.meshgrid(fine_places(40), fine_places(40), indexing="ij")
    expected = (columns - slope * rows - 8) / np.hypot(1, slope) * PIXEL
    # Away from the borders of the image, near the edge.
    inner = (np.abs(rows - 20) < 12) & (np.abs(expected) < 0.2)
    error = (outline(tissue) - expected)[inner]
    assert inner.sum() > 50
    # A tenth of a pixel's half: what the Gaussian leaves of steps that are three pixels long.
    assert error.std() < 0.06
    assert abs(error.mean()) < 0.02


def test_an_empty_slice_is_outside_everywhere():
    empty = outline(np.zeros((8, 9), dtype=np.uint8))
    assert empty.shape == (16, 18)
    assert (empty == -SETTINGS.reach).all()


@pytest.mark.parametrize(
    ("gap", "other", "joined"),
    [(2, Tissue.CA1, True), (2, Tissue.SUBICULUM, False), (6, Tissue.CA1, False)],
)
def test_fragments_are_joined_if_near_and_next_in_order(gap, other, joined):
    """0.8 mm may be a torn ribbon, 2.4 mm is not; CA3 and subiculum face each other."""
    tissue = np.zeros((60, 60), dtype=np.uint8)
    tissue[20:26, 5:30] = Tissue.CA3 if other == Tissue.SUBICULUM else Tissue.CA2
    tissue[20:26, 30 + gap : 50] = other
    assert (ndimage.label(outline(tissue) > 0)[1] == 1) == joined


def test_crumbs_are_dropped_and_small_holes_filled():
    tissue = np.zeros((60, 60), dtype=np.uint8)
    tissue[10:24, 5:40] = Tissue.CA1
    tissue[16:18, 20:22] = 0
    tissue[45:47, 45:47] = Tissue.CA1
    found = outline(tissue)
    assert ndimage.label(found > 0)[1] == 1
    assert ndimage.label(found <= 0)[1] == 1
