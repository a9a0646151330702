"""Conjugate gradients on two levels against a factorization."""

import numpy as np
import pytest
from scipy import sparse

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.fem import compact_groups, solve_two_level, volume_laplace


def test_groups_are_compact_and_of_equal_size():
    axis = np.arange(16.0)
    points = np.stack(np.meshgrid(axis, axis, axis[:4], indexing="ij"), axis=-1).reshape(-1, 3)
    groups = compact_groups(points)
    sizes = np.bincount(groups)
    assert len(sizes) == 64  # a power of two next to 2 sqrt(1024)
    assert sizes.min() == sizes.max() == 16
    for group in range(64):
        assert np.ptp(points[groups == group], axis=0).max() <= 4  # 2 x 2 x 4 nodes, or 4 x 4 x 1


@pytest.mark.parametrize("count", [50, 1000, 1001])
def test_every_point_has_a_group(count):
    points = np.random.default_rng(count).random((count, 3))
    groups = compact_groups(points)
    assert groups.shape == (count,)
    sizes = np.bincount(groups)
    assert sizes.sum() == count
    assert sizes.min() > 0


@pytest.mark.parametrize("share", [0.05, 0.5])
def test_solution_is_that_of_the_factorization(arc, share):
    matrix, points = arc.laplace.stiffness, arc.mesh.vertices
    rng = np.random.default_rng(8)
    free = rng.random(len(points)) >= share
    values = np.where(free, 0, rng.standard_normal(len(points)))
    problem = (matrix, -(matrix @ values), free, compact_groups(points))
    found = values + solve_two_level(*problem, residual=1e-9)
    fixed = np.flatnonzero(~free)
    wanted = volume_laplace(arc.mesh, "lapy").solve(fixed, values[fixed])
    # The residual times the condition number, some hundreds on this mesh.
    np.testing.assert_allclose(found, wanted, atol=1e-8)
    np.testing.assert_array_equal(found[fixed], values[fixed])
    # The default leaves at most 1e-7 of the right-hand side, in units in which the diagonal is one.
    root, right = np.sqrt(matrix.diagonal()[free]), problem[1]
    rest = (right - matrix @ solve_two_level(*problem))[free] / root
    assert np.linalg.norm(rest) <= 1e-7 * np.linalg.norm(right[free] / root)


def test_what_is_not_free_stays_zero():
    matrix = sparse.csr_array(np.array([[2.0, -1, 0], [-1, 2, -1], [0, -1, 2]]))
    free = np.array([True, True, False])
    found = solve_two_level(matrix, np.array([3.0, 0.0, 5.0]), free, np.zeros(3, dtype=np.intp))
    np.testing.assert_allclose(found, [2.0, 1.0, 0.0], atol=1e-12)  # 2a - b = 3, 2b = a


@pytest.mark.parametrize("entry", [0.0, np.nan, -1.0])
def test_a_system_without_solution_is_refused(entry):
    matrix = sparse.csr_array(np.diag([1.0, entry, 1.0]))
    with pytest.raises(GeometryError, match="no solution") as caught:
        solve_two_level(matrix, np.ones(3), np.ones(3, dtype=bool), np.arange(3))
    assert caught.value.reason == "laplace"


def test_an_unconnected_piece_without_values_is_refused():
    """Its function is known up to a constant only."""
    path = sparse.diags_array([[-1.0] * 5, [2.0] * 6, [-1.0] * 5], offsets=[-1, 0, 1]).toarray()
    path[2, 3] = path[3, 2] = 0
    path[[2, 3, 5], [2, 3, 5]] = 1  # two paths of three: the first held at its end, the other free
    groups = np.array([0, 0, 0, 1, 1, 1])
    with pytest.raises(GeometryError, match="no solution"):
        solve_two_level(sparse.csr_array(path), np.arange(6.0), np.ones(6, dtype=bool), groups)
