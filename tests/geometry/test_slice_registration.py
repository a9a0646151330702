"""The way from each slice to the next."""

import numpy as np

from hipsta_bids.geometry.slices import register_slices
from hipsta_bids.settings import Settings

SETTINGS = Settings().slices
PIXEL = 0.4  # mm, of the segmentation
FINE = PIXEL / SETTINGS.upsampling


def disc(center, radius, size=100):
    """Signed distance from a circle, mm, clipped as outlines are."""
    grid = np.indices((size, size)) * FINE
    gap = np.hypot(grid[0] - center[0], grid[1] - center[1])
    return np.clip(radius - gap, -SETTINGS.reach, SETTINGS.reach).astype(np.float32)


def test_equal_slices_do_not_move():
    flow = register_slices(np.stack([disc((8, 10), 2.0)] * 3), PIXEL, SETTINGS)
    assert flow.shape == (2, 2, 50, 50)
    assert (flow == 0).all()


def test_a_shift_is_found():
    """Twice the distance over which blending in place would still overlap half."""
    flow = register_slices(np.stack([disc((8, 10), 2.0), disc((10, 9), 2.0)]), PIXEL, SETTINGS)
    middle = flow[:, 0, 22, 23] * FINE  # at the middle of both, mm
    # The ridge, 0.02 of a mean squared slope of up to 1, holds back some per cent.
    np.testing.assert_allclose(middle, [2, -1], atol=0.15)


def test_the_way_back_is_the_way_there():
    pair = np.stack([disc((8, 10), 2.0), disc((10, 9), 2.5)])
    there, back = (register_slices(stack, PIXEL, SETTINGS) for stack in (pair, pair[::-1]))
    np.testing.assert_allclose(there, -back, atol=1e-4)  # pixels; float32


def test_slices_are_registered_independently():
    shapes = [disc((8, 10), 2.0), disc((9, 10), 2.0), disc((9, 11), 2.5)]
    together = register_slices(np.stack(shapes), PIXEL, SETTINGS)
    alone = register_slices(np.stack(shapes[1:]), PIXEL, SETTINGS)
    np.testing.assert_allclose(together[:, 1:], alone, atol=1e-6)  # float32


def test_odd_sizes_are_covered():
    flow = register_slices(np.stack([disc((4, 5), 2.0, 54)] * 2), PIXEL, SETTINGS)
    assert flow.shape == (2, 1, 27, 27)
