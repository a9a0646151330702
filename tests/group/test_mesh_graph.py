"""Clusters and cluster enhancement on meshes: as on the grid where the mesh is one."""

import numpy as np
import pytest

from hipsta_bids.group.adjacency import (
    enhance,
    enhance_on_mesh,
    find_mesh_clusters,
    label_mesh,
    mesh_edges,
)
from hipsta_bids.group.formula import Contrast
from hipsta_bids.group.permutation import PermutationPart, permute
from hipsta_bids.group.settings import MultiplicitySettings
from hipsta_bids.io.gifti import sheet_triangles

SHAPE = (9, 6)


def grid_edges(shape, *, diagonals):
    """Edges between the four neighbors of a grid, or the eight."""
    index = np.arange(np.prod(shape)).reshape(shape)
    pairs = [(index[1:], index[:-1]), (index[:, 1:], index[:, :-1])]
    if diagonals:
        pairs += [(index[1:, 1:], index[:-1, :-1]), (index[1:, :-1], index[:-1, 1:])]
    return np.concatenate([np.column_stack([a.ravel(), b.ravel()]) for a, b in pairs])


def test_each_edge_of_a_mesh_stands_once():
    triangles = np.array([[0, 1, 2], [2, 1, 3]])
    assert mesh_edges(triangles).tolist() == [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]]
    # A grid of n x m nodes with one diagonal per cell: Euler's formula counts its edges.
    nx, ny = SHAPE
    edges = mesh_edges(sheet_triangles(nx, ny))
    assert len(edges) == nx * ny + 2 * (nx - 1) * (ny - 1) - 1


def test_regions_are_those_that_edges_connect():
    edges = np.array([[0, 1], [1, 2], [3, 4]])
    labels, count = label_mesh(np.array([True, False, True, True, True]), edges)
    assert count == 3
    assert labels[1] == 0
    assert labels[3] == labels[4]
    assert len({labels[0], labels[2], labels[3]}) == 3
    assert label_mesh(np.zeros(5, dtype=bool), edges)[1] == 0


@pytest.mark.parametrize("neighbors", [4, 8])
def test_enhancement_is_that_of_the_grid(neighbors):
    settings = MultiplicitySettings(neighbors=neighbors)
    t = np.random.default_rng(0).normal(0, 2, (3, *SHAPE))
    t[0, :2] = np.nan
    edges = grid_edges(SHAPE, diagonals=neighbors == 8)
    found = enhance_on_mesh(t.reshape(3, -1), edges, settings)
    # The same sums in the same order.
    np.testing.assert_allclose(found, enhance(t, settings).reshape(3, -1), rtol=1e-12)


def test_clusters_have_one_sign_and_their_peak():
    edges = grid_edges((5, 1), diagonals=False)
    statistic = np.array([3.0, 4.0, -5.0, -2.5, 6.0])[:, None]
    significant = np.array([True, True, True, False, True])[:, None]
    names = np.array(["a", "b", "b", "b", "b"])[:, None]
    first, *others = find_mesh_clusters(significant, statistic, names, edges)
    assert (first.extent, first.peak, first.shares) == (2, (1, 0), {"a": 0.5, "b": 0.5})
    assert sorted(one.peak[0] for one in others) == [2, 4]


def test_permutations_on_a_mesh_are_those_on_its_grid():
    random = np.random.default_rng(3)
    matrix = np.column_stack([np.ones(20), np.arange(20) % 2])
    maps = random.normal(size=(20, np.prod(SHAPE))) + matrix[:, [1]] * (np.arange(54) < 12)
    settings = MultiplicitySettings(permutations=60, neighbors=4, method="permutation-tfce")
    contrast = Contrast("b", np.array([0.0, 1.0]))
    people = np.arange(20)
    edges = grid_edges(SHAPE, diagonals=False)
    (grid,) = permute([PermutationPart(maps, matrix, people)], contrast, SHAPE, settings=settings)
    (mesh,) = permute(
        [PermutationPart(maps, matrix, people, edges)], contrast, SHAPE, settings=settings
    )
    np.testing.assert_array_equal(grid.p_enhanced, mesh.p_enhanced)
