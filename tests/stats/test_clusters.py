"""Edges, cluster enhancement and families of tests on grids and meshes."""

import numpy as np
import pytest
from grids import grid_triangles
from scipy import ndimage

from hipsta_bids.stats import clusters
from hipsta_bids.stats.clusters import (
    TFCE_STEP,
    enhance,
    label_regions,
    mesh_edges,
    sheet_edges,
)
from hipsta_bids.stats.inference import MapKey, control_fdr, discover
from hipsta_bids.stats.settings import MultiplicitySettings

SHAPE = (12, 8)
EDGES = sheet_edges(*SHAPE)


def test_edges_of_a_small_grid():
    """Nodes 0 1 / 2 3 / 4 5, y along rows."""
    four = [[0, 2], [1, 3], [2, 4], [3, 5], [0, 1], [2, 3], [4, 5]]
    assert sheet_edges(3, 2, 4).tolist() == four
    assert sheet_edges(3, 2, 8).tolist() == [*four, [0, 3], [2, 5], [1, 2], [3, 4]]
    assert sheet_edges(1, 3).tolist() == [[0, 1], [1, 2]]


def test_each_edge_of_a_mesh_stands_once():
    triangles = np.array([[0, 1, 2], [2, 1, 3]])
    assert mesh_edges(triangles).tolist() == [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]]
    # A grid of n x m nodes with one diagonal per cell: Euler's formula counts its edges.
    nx, ny = SHAPE
    edges = mesh_edges(grid_triangles(nx, ny))
    assert len(edges) == nx * ny + 2 * (nx - 1) * (ny - 1) - 1


def test_regions_are_those_that_edges_connect():
    edges = np.array([[0, 1], [1, 2], [3, 4]])
    labels, count = label_regions(np.array([True, False, True, True, True]), edges)
    assert count == 3
    assert labels.tolist() == [1, 0, 2, 3, 3]
    assert label_regions(np.zeros(5, dtype=bool), edges)[1] == 0


def structure(neighbors):
    return ndimage.generate_binary_structure(2, 1 if neighbors == 4 else 2)


@pytest.mark.parametrize("neighbors", [4, 8])
def test_regions_of_a_grid_are_those_of_scipy(neighbors):
    mask = np.random.default_rng(0).random(SHAPE) < 0.5
    labels, count = label_regions(mask.ravel(), sheet_edges(*SHAPE, neighbors))
    expected, number = ndimage.label(mask, structure(neighbors))
    assert count == number
    np.testing.assert_array_equal(labels.reshape(SHAPE), expected)


@pytest.mark.parametrize("neighbors", [4, 8])
def test_enhancement_is_its_definition(neighbors):
    """Height by height, each sign and each map by itself, with regions of scipy."""
    t = np.random.default_rng(0).normal(0, 2, (3, *SHAPE))
    t[0, :2] = np.nan
    t[1] = 0.05  # below the first height
    expected = np.zeros(t.shape)
    for sign in (1, -1):
        for own, values in zip(expected, sign * np.nan_to_num(t), strict=True):
            height = TFCE_STEP
            while (above := values >= height).any():
                labels, _ = ndimage.label(above, structure(neighbors))
                extent = np.bincount(labels.ravel())[labels]
                own[:] += sign * above * extent**0.5 * height**2 * TFCE_STEP
                height += TFCE_STEP
    found = enhance(t.reshape(3, -1), sheet_edges(*SHAPE, neighbors))
    np.testing.assert_allclose(found, expected.reshape(3, -1), rtol=1e-12)  # order of sums


def test_enhancement_of_a_plateau_is_the_sum_of_its_heights(monkeypatch):
    sheet = np.zeros((6, 5))
    sheet[1:3, 1:4] = 1.0  # six points of height 1
    sheet[4, 0] = -0.5
    monkeypatch.setattr(clusters, "TFCE_STEP", 0.25)
    raised = enhance(sheet.reshape(1, -1), sheet_edges(6, 5)).reshape(6, 5)
    heights = np.array([0.25, 0.5, 0.75, 1.0])
    assert raised[1, 1] == pytest.approx(np.sqrt(6) * (heights**2).sum() * 0.25)
    assert raised[4, 0] == pytest.approx(-(heights[:2] ** 2).sum() * 0.25)
    assert np.count_nonzero(raised) == 7


@pytest.mark.parametrize("count", range(1, 31))
def test_enhancement_reaches_the_height_that_a_point_has(count):
    """Sums of steps are rounded: a tenth, ten times, is less than 1 and counts as ten heights."""
    heights = np.cumsum(np.full(count, 0.1))
    (found,) = enhance(heights[None, -1:], np.zeros((0, 2), dtype=int))
    assert found.item() == pytest.approx((heights**2).sum() * 0.1, rel=1e-12)  # order of sums


def test_families_are_maps_hemispheres_or_all_maps_of_a_contrast():
    random = np.random.default_rng(1)
    maps = {
        MapKey("thickness", "group", "L"): random.random(np.prod(SHAPE)) * 1e-4,
        MapKey("thickness", "group", "R"): random.random(np.prod(SHAPE)),
        MapKey("thickness", "age", "R"): random.random(np.prod(SHAPE)),
    }
    each = discover(maps, MultiplicitySettings())
    both = discover(maps, MultiplicitySettings(scope="hemispheres"))
    assert list(each) == list(maps)
    for key, p in maps.items():
        alone = control_fdr(p, 0.05)
        np.testing.assert_array_equal(each[key].adjusted, alone.adjusted)
    left, right, age = maps
    pooled = control_fdr(np.stack([maps[left], maps[right]]), 0.05)
    np.testing.assert_array_equal(both[left].adjusted, pooled.adjusted[0])
    np.testing.assert_array_equal(both[right].rejected, pooled.rejected[1])
    assert both[right].cutoff == pooled.cutoff
    np.testing.assert_array_equal(both[age].adjusted, each[age].adjusted)
    more = maps | {MapKey("curvature", "group", "L"): random.random(np.prod(SHAPE))}
    every = discover(more, MultiplicitySettings(scope="all"))
    of_group = [key for key in more if key.contrast == "group"]
    pooled = control_fdr(np.stack([more[key] for key in of_group]), 0.05)
    for key, adjusted in zip(of_group, pooled.adjusted, strict=True):
        np.testing.assert_array_equal(every[key].adjusted, adjusted)
    np.testing.assert_array_equal(every[age].adjusted, each[age].adjusted)
    single = discover(maps, MultiplicitySettings(method="bh"))
    expected = control_fdr(maps[left], 0.05, "bh")
    np.testing.assert_array_equal(single[left].adjusted, expected.adjusted)
