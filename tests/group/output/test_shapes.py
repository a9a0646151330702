"""Average shapes: motion is undone, size and handedness are kept, groups are told apart."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hipsta_bids.group.output.shapes import align_rigidly, average_shape
from hipsta_bids.group.settings import ShapeSettings

SETTINGS = ShapeSettings()
NODES = (15, 6)


def sheet(radius=4.0, thickness=1.5):
    """(3, x, y, 3): three quarters of a tube, slightly bent along y; mm."""
    u, y = np.meshgrid(np.linspace(0, 1.5 * np.pi, NODES[0]), np.linspace(-8, 8, NODES[1]))
    u, y = u.T, y.T
    radii = radius + thickness * np.array([-0.5, 0.0, 0.5])[:, None, None]
    return np.stack(
        [radii * np.cos(u), np.broadcast_to(y, (3, *NODES)), radii * np.sin(u) + 0.02 * y**2], -1
    )


def moved(shape, random):
    turn = Rotation.from_euler("xyz", random.normal(0, 15, 3), degrees=True)
    place = random.normal(0, 30, 3)
    return turn.apply(shape.reshape(-1, 3)).reshape(shape.shape) + place


def distances(points):
    flat = points.reshape(-1, 3)
    return np.linalg.norm(flat[:, None] - flat, axis=2)


def identity(n):
    return np.tile(np.linspace(0, 1, NODES[0]), (n, 1))


def one_group(n):
    return {"a": np.ones(n, dtype=bool)}


def test_copies_of_one_shape_are_averaged_to_that_shape():
    random = np.random.default_rng(0)
    copies = np.array([moved(sheet(), random) for _ in range(12)])
    found = average_shape(copies, identity(12), one_group(12))
    # The mean settles to 1e-6 mm.
    np.testing.assert_allclose(distances(found.mean), distances(sheet()), atol=1e-5)
    np.testing.assert_allclose(found.by_group["a"], found.mean, atol=1e-12)
    # It lies where the shapes lay, on average.
    centers = copies[:, 1].reshape(12, -1, 3).mean(axis=1).mean(axis=0)
    np.testing.assert_allclose(found.mean[1].reshape(-1, 3).mean(axis=0), centers, atol=1e-6)


def test_size_is_kept_and_groups_are_laid_upon_each_other():
    random = np.random.default_rng(1)
    sizes = np.repeat([1.0, 1.2], 10)
    shapes = np.array([moved(size * sheet(), random) for size in sizes])
    groups = {"small": sizes == 1.0, "large": sizes > 1.0}
    found = average_shape(shapes, identity(20), groups)
    for name, size in (("small", 1.0), ("large", 1.2)):
        own = distances(found.by_group[name])
        np.testing.assert_allclose(own, size * distances(sheet()), atol=1e-4)
    assert found.counts == {"small": 10, "large": 10}
    # Both groups lie alike: nothing is left to turn.
    small, large = (found.by_group[name][1].reshape(-1, 3) for name in ("small", "large"))
    turn, _ = Rotation.align_vectors(small - small.mean(axis=0), large - large.mean(axis=0))
    assert np.degrees(turn.magnitude()) < 1e-3


def test_mirror_images_are_not_mirrored():
    random = np.random.default_rng(2)
    shapes = np.array(
        [moved(sheet() * [-1, 1, 1] if i == 0 else sheet(), random) for i in range(9)]
    )
    middle = shapes[:, 1].reshape(9, -1, 3)
    turns, _, _ = align_rigidly(middle)
    np.testing.assert_allclose(np.linalg.det(turns), 1, atol=1e-9)


def test_rotations_are_the_identity_on_average():
    random = np.random.default_rng(3)
    shapes = np.array([moved(sheet(), random) for _ in range(15)])[:, 1].reshape(15, -1, 3)
    turns, _, _ = align_rigidly(shapes)
    left, _, right = np.linalg.svd(turns.mean(axis=0))
    np.testing.assert_allclose(left @ right, np.eye(3), atol=1e-6)


def test_missing_points_do_not_move_the_others():
    random = np.random.default_rng(4)
    shapes = np.array([moved(sheet(), random) for _ in range(8)])
    shapes[2, :, :3, 0] = np.nan
    shapes[:, :, -1, -1] = np.nan  # nobody has it
    found = average_shape(shapes, identity(8), one_group(8))
    known = np.isfinite(found.mean).all(axis=-1)
    assert not known[:, -1, -1].any()
    assert known.sum() == 3 * (NODES[0] * NODES[1] - 1)
    expected = distances(sheet()[known])
    np.testing.assert_allclose(distances(found.mean[known]), expected, atol=1e-5)


def test_nodes_are_those_of_registration():
    random = np.random.default_rng(5)
    grid = np.linspace(0, 1, NODES[0])
    shapes = np.array([moved(sheet(), random) for _ in range(6)])
    shift = grid + 0.05 * np.sin(np.pi * grid)
    found = average_shape(shapes, np.tile(shift, (6, 1)), one_group(6))
    # The node at 0.5 shows what lies before it: the tube's angle there is smaller.
    x = np.interp(0.5, shift, grid)
    place = np.array([np.interp(x, grid, sheet()[1, :, 0, i]) for i in range(3)])
    plain = average_shape(shapes, identity(6), one_group(6)).mean[1, :, 0]
    expected = np.linalg.norm(place - sheet()[1, 0, 0])
    got = np.linalg.norm(found.mean[1, NODES[0] // 2, 0] - plain[0])
    # Chords between nodes are shorter than arcs, and alignment sees another surface.
    assert got == pytest.approx(expected, abs=0.15)
