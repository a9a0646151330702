"""Neighbors among the points of a map, cluster enhancement, clusters and tables of their peaks.

The grid of a sheet and a triangle mesh are both graphs, and differ in nothing but their edges.
"""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from hipsta_bids.stats.arrays import Bool, Float, Int, SideMaps

#: Exponent of a cluster's extent (Smith and Nichols 2009).
TFCE_EXTENT = 0.5
#: Exponent of the statistic's height.
TFCE_HEIGHT = 2.0
#: Step of the height, in units of t (of the square root of F).
TFCE_STEP = 0.1


def sheet_edges(nx: int, ny: int, neighbors: int = 8) -> Int:
    """List the edges (edges, 2) between 4 or 8 neighbors of a grid, each once; y runs fastest."""
    node = np.arange(nx * ny).reshape(nx, ny)
    pairs = [(node[:-1], node[1:]), (node[:, :-1], node[:, 1:])]
    if neighbors == 8:  # noqa: PLR2004 -- of the setting
        pairs += [(node[:-1, :-1], node[1:, 1:]), (node[:-1, 1:], node[1:, :-1])]
    return np.concatenate([np.column_stack([first.ravel(), two.ravel()]) for first, two in pairs])


def mesh_edges(triangles: Int) -> Int:
    """List the edges (edges, 2) of a mesh, each once."""
    pairs = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    return np.asarray(np.unique(np.sort(pairs, axis=1), axis=0), dtype=np.int64)


def edges_of(maps: SideMaps, neighbors: int) -> Int:
    """List the edges between the points of maps; on a mesh its triangles define the neighbors."""
    if maps.mesh is not None:
        return mesh_edges(maps.mesh.triangles)
    return sheet_edges(*maps.shape, neighbors)


def label_regions(mask: Bool, edges: Int) -> tuple[Int, int]:
    """Find the connected regions of a mask, numbered from 1 (0 is outside), and their count."""
    inside = np.flatnonzero(mask)
    pairs = (np.cumsum(mask) - 1)[edges[mask[edges].all(axis=1)]]
    count, numbers = _components(pairs, len(inside))
    labels = np.zeros(len(mask), dtype=np.int64)
    labels[inside] = numbers + 1
    return labels, count


def _components(edges: Int, n: int) -> tuple[int, Int]:
    """Count the connected components of n nodes, and number them from 0 by their first node."""
    links = np.ones(len(edges), dtype=bool)
    graph = coo_array((links, (edges[:, 0], edges[:, 1])), shape=(n, n))
    count, numbers = connected_components(graph, directed=False)
    return int(count), numbers.astype(np.int64)


def enhance(statistic: Float, edges: Int) -> Float:
    """Threshold-free cluster enhancement of maps (maps, points) (Smith and Nichols 2009).

    NaN is outside; positive and negative clusters are separate. From the highest threshold down,
    regions only grow: each threshold joins regions of the one above.
    """
    values = np.nan_to_num(statistic, nan=0.0)
    size = np.abs(values).ravel()
    steps = int(size.max(initial=0.0) / TFCE_STEP) + 2
    heights = np.cumsum(np.full(steps, TFCE_STEP))
    level = np.searchsorted(heights, size, side="right")  # thresholds that a point reaches
    # All maps together are one graph without edges between maps.
    ends = (edges + values.shape[1] * np.arange(len(values))[:, None, None]).reshape(-1, 2)
    sign = values.ravel() > 0
    ends = ends[sign[ends[:, 0]] == sign[ends[:, 1]]]
    joined_at = level[ends].min(axis=1)
    order = np.argsort(joined_at, kind="stable")
    ends, start = ends[order], np.searchsorted(joined_at[order], np.arange(steps + 2))
    points = np.argsort(level, kind="stable")
    first = np.searchsorted(level[points], np.arange(steps + 1))
    result = np.zeros(len(size))
    region, count = np.arange(len(size)), len(size)
    for number in range(int(level.max(initial=0)), 0, -1):
        count, merged = _components(region[ends[start[number] : start[number + 1]]], count)
        region = merged[region]
        above = points[first[number] :]
        labels = region[above]
        extent = np.bincount(labels, minlength=count).astype(np.float64)[labels]
        height = heights[number - 1]
        result[above] += extent**TFCE_EXTENT * (height**TFCE_HEIGHT * TFCE_STEP)
    return np.asarray(np.copysign(result, values.ravel()).reshape(values.shape), dtype=np.float64)
