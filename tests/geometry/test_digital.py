"""Digital topology against brute force and against scikit-image."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy import ndimage
from skimage import measure

from hipsta_bids.geometry.digital import (
    NEIGHBORS,
    are_simple,
    box_around,
    euler_number,
    grow,
    positions,
    shrink,
    to_ras,
    widened,
)

FACES = ndimage.generate_binary_structure(3, 1)
EDGES = ndimage.generate_binary_structure(3, 2)
ALL = np.ones((3, 3, 3), dtype=bool)

masks = arrays.arrays(np.bool_, st.tuples(*[st.integers(3, 8)] * 3), elements=st.booleans())


@given(masks, st.permutations(range(3)))
@settings(max_examples=50, deadline=None)
def test_positions_and_widening_are_those_of_the_libraries(mask, axes):
    turned, before = mask.transpose(axes), mask.copy()  # views, in other orders than C's, too
    np.testing.assert_array_equal(positions(turned), np.argwhere(turned))
    np.testing.assert_array_equal(widened(turned), ndimage.binary_dilation(turned, structure=ALL))
    np.testing.assert_array_equal(mask, before)


def simple_by_counting(block):
    """The definition, by labeling: one object piece and one background piece at the center."""
    around = block.copy()
    around[1, 1, 1] = False
    pieces, _ = ndimage.label(around & EDGES, structure=FACES)
    touching = np.unique(pieces[FACES & (pieces > 0)])
    outside = ~block
    outside[1, 1, 1] = False
    background = ndimage.label(outside, structure=ALL)[1]
    return len(touching) == 1 and background == 1


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_simple_points_are_those_of_the_definition(share):
    blocks = np.random.default_rng(5).random((1500, 3, 3, 3)) < share
    found = are_simple(blocks[:, *(NEIGHBORS + 1).T])
    wanted = [simple_by_counting(block) for block in blocks]
    np.testing.assert_array_equal(found, wanted)
    assert 0 < sum(wanted) < len(wanted)


def test_neighbors_are_all_but_the_center():
    offsets = {tuple(offset) for offset in NEIGHBORS.tolist()}
    assert len(offsets) == len(NEIGHBORS) == 26
    assert np.abs(NEIGHBORS).max() == 1
    assert (0, 0, 0) not in offsets


@given(masks)
@settings(deadline=None)
def test_euler_number_is_that_of_scikit_image(mask):
    assert euler_number(mask) == measure.euler_number(mask, connectivity=1)


@pytest.mark.parametrize(("shape", "wanted"), [("ball", 1), ("ring", 0), ("shell", 2), ("two", 2)])
def test_euler_number_of_known_shapes(shape, wanted):
    mask = np.zeros((7, 7, 7), dtype=bool)
    mask[1:6, 1:6, 1:6] = True
    if shape == "ring":
        mask[3, 3, :] = False
    elif shape == "shell":
        mask[3, 3, 3] = False
    elif shape == "two":
        mask[3] = False
    assert euler_number(mask) == wanted


def framed(seed, *, share=0.6, shape=(9, 10, 11)):
    """A random mask with a free outermost layer, and a random field."""
    rng = np.random.default_rng(seed)
    mask = np.zeros(shape, dtype=bool)
    mask[1:-1, 1:-1, 1:-1] = rng.random([n - 2 for n in shape]) < share
    return mask, rng.random(shape).astype(np.float32)


def counts(mask):
    """Pieces, Euler number and cavities: equal for equal topology."""
    return (
        ndimage.label(mask, structure=FACES)[1],
        euler_number(mask),
        ndimage.label(~mask, structure=ALL)[1],
    )


def add_one_by_one(state, allowed):
    """Any voxel that could still be added."""
    for place in np.argwhere(allowed & ~state):
        block = state[tuple(slice(k - 1, k + 2) for k in place)]
        if simple_by_counting(block):
            return tuple(place)
    return None


@given(st.integers(0, 10**6), st.sampled_from([0.4, 0.6, 0.8]), st.integers(1, 6))
@settings(max_examples=25, deadline=None)
def test_growing_keeps_the_topology_and_ends_when_nothing_can_be_added(seed, share, levels):
    allowed, field = framed(seed, share=share)
    start = np.zeros_like(allowed)
    start[tuple(np.argwhere(allowed)[seed % allowed.sum()])] = True
    grown = grow(start, allowed, field, levels)
    assert not (grown & ~allowed).any()
    assert (grown >= start).all()
    assert counts(grown) == counts(start)
    assert add_one_by_one(grown, allowed) is None


@given(st.integers(0, 10**6), st.sampled_from([0.05, 0.3, 0.6]), st.integers(1, 6))
@settings(max_examples=25, deadline=None)
def test_shrinking_keeps_the_topology(seed, share, levels):
    kept, field = framed(seed, share=share)
    start = np.zeros_like(kept)
    start[1:-1, 1:-1, 1:-1] = True
    shrunk = shrink(start, kept, field, levels)
    assert (shrunk >= kept).all()
    assert counts(shrunk) == counts(start)


def test_growing_fills_a_ball_and_cuts_a_ring():
    ball = np.zeros((9, 9, 9), dtype=bool)
    ball[1:-1, 1:-1, 1:-1] = True
    seed = np.zeros_like(ball)
    seed[2, 4, 4] = True
    field = np.ones(ball.shape, dtype=np.float32)
    np.testing.assert_array_equal(grow(seed, ball, field, 3), ball)
    ring = ball.copy()
    ring[3:6, 3:6] = False
    grown = grow(seed, ring, field, 3)
    assert 0 < np.count_nonzero(ring & ~grown) <= 4 * 7  # one wall of the ring's 2 x 7 section


def test_the_cut_is_made_where_the_field_is_lowest():
    ring = np.zeros((9, 9, 3), dtype=bool)
    ring[1:-1, 1:-1, 1] = True
    ring[3:6, 3:6, 1] = False
    field = np.ones(ring.shape, dtype=np.float32)
    field[6:8, 4, 1] = 0.1
    seed = np.zeros_like(ring)
    seed[1, 4, 1] = True
    left = np.argwhere(ring & ~grow(seed, ring, field, 4))
    assert left.tolist() == [[6, 4, 1], [7, 4, 1]]


def test_start_arrays_are_left_alone():
    allowed, field = framed(3)
    start = np.zeros_like(allowed)
    start[tuple(np.argwhere(allowed)[0])] = True
    before = start.copy()
    grow(start, allowed, field, 3)
    shrink(allowed, start & allowed, field, 3)
    np.testing.assert_array_equal(start, before)


def test_places_of_voxels_follow_from_all_of_the_affine():
    affine = np.array([[0.0, -2.0, 0.5, 10.0], [1.0, 0.0, 0.0, 20.0], [0.0, 0.1, 3.0, 30.0]])
    np.testing.assert_allclose(to_ras(np.array([[1, 2, 3]]), affine), [[7.5, 21.0, 39.2]])


def test_boxes_have_a_voxel_to_spare_where_the_grid_has_one():
    around = box_around(np.array([[0, 3, 5], [2, 7, 5]]))
    assert around == (slice(0, 4), slice(2, 9), slice(4, 7))
