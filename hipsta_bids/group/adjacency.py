"""Neighborhoods on the sheet: connected regions, clusters, and cluster enhancement."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from hipsta_bids.group.settings import MultiplicitySettings

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Cluster:
    """Adjacent points that survive, with effects of one sign."""

    extent: int
    """Points."""
    peak: tuple[int, int]
    """Node (x, y) with the largest statistic."""
    members: BoolArray
    """Shape of the sheet."""
    shares: Mapping[str, float]
    """Fraction of the points in each subfield."""


def _structure(neighbors: int) -> BoolArray:
    """Links between the eight (or four) neighbors in a plane, and none between planes."""
    plane = ndimage.generate_binary_structure(2, 2 if neighbors == 8 else 1)  # noqa: PLR2004 -- of the setting
    structure = np.zeros((3, 3, 3), dtype=bool)
    structure[1] = plane
    return structure


def enhance(statistic: FloatArray, settings: MultiplicitySettings) -> FloatArray:
    """Threshold-free cluster enhancement (Smith and Nichols 2009).

    ``statistic`` NaN is outside.
    """
    values = np.nan_to_num(statistic, nan=0.0)
    return _enhance(np.maximum(values, 0), settings) - _enhance(np.maximum(-values, 0), settings)


def _enhance(values: FloatArray, settings: MultiplicitySettings) -> FloatArray:
    result = np.zeros_like(values)
    structure = _structure(settings.neighbors)
    height = settings.tfce_step
    while (above := values >= height).any():
        labels, count = ndimage.label(above, structure)
        sizes = np.bincount(labels.ravel(), minlength=count + 1).astype(np.float64)
        gain = sizes**settings.tfce_extent * (height**settings.tfce_height * settings.tfce_step)
        gain[0] = 0.0
        result += gain[labels]
        height += settings.tfce_step
    return result


def find_clusters(
    significant: BoolArray, statistic: FloatArray, subfield: NDArray[np.str_], neighbors: int
) -> list[Cluster]:
    """Find connected regions of one sign, largest first."""
    clusters = []
    for sign in (1, -1):
        mask = significant & (sign * statistic > 0)
        labels, count = ndimage.label(mask, _structure(neighbors)[1])
        for number in range(1, count + 1):
            members = labels == number
            height = np.where(members, np.abs(statistic), -np.inf)
            names, counts = np.unique(subfield[members], return_counts=True)
            x, y = np.unravel_index(int(np.argmax(height)), height.shape)
            extent = int(members.sum())
            shares = dict(zip(names.tolist(), (counts / extent).tolist(), strict=True))
            clusters.append(Cluster(extent, (int(x), int(y)), members, shares))
    return sorted(clusters, key=lambda cluster: -cluster.extent)


# Neighborhoods on a triangle mesh: clusters and cluster enhancement, as on the sheet's grid.


def mesh_edges(triangles: IntArray) -> IntArray:
    """List the edges of a mesh, each once."""
    pairs = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    return np.asarray(np.unique(np.sort(pairs, axis=1), axis=0), dtype=np.int64)


def label_mesh(mask: BoolArray, edges: IntArray) -> tuple[IntArray, int]:
    """Find the connected regions of a mask, numbered from 1; 0 is outside."""
    inside = np.flatnonzero(mask)
    place = np.cumsum(mask) - 1
    own = place[edges[mask[edges].all(axis=1)]]
    shape = (len(inside), len(inside))
    graph = coo_array((np.ones(len(own), dtype=bool), (own[:, 0], own[:, 1])), shape=shape)
    count, numbers = connected_components(graph, directed=False)
    labels = np.zeros(len(mask), dtype=np.int64)
    labels[inside] = numbers + 1
    return labels, int(count)


def enhance_on_mesh(
    statistic: FloatArray, edges: IntArray, settings: MultiplicitySettings
) -> FloatArray:
    """Threshold-free cluster enhancement; see :func:`~hipsta_bids.group.sheet_graph.enhance`.

    ``statistic`` NaN is outside.
    """
    values = np.nan_to_num(statistic, nan=0.0)
    return np.stack(
        [_enhance_mesh(np.maximum(row, 0), edges, settings) for row in values]
    ) - np.stack([_enhance_mesh(np.maximum(-row, 0), edges, settings) for row in values])


def _enhance_mesh(
    values: FloatArray, edges: IntArray, settings: MultiplicitySettings
) -> FloatArray:
    result = np.zeros_like(values)
    height = settings.tfce_step
    own = edges
    while (above := values >= height).any():
        own = own[above[own].all(axis=1)]  # higher up there are only fewer
        labels, count = label_mesh(above, own)
        sizes = np.bincount(labels, minlength=count + 1).astype(np.float64)
        gain = sizes**settings.tfce_extent * (height**settings.tfce_height * settings.tfce_step)
        gain[0] = 0.0
        result += gain[labels]
        height += settings.tfce_step
    return result


def find_mesh_clusters(
    significant: BoolArray, statistic: FloatArray, subfield: NDArray[np.str_], edges: IntArray
) -> list[Cluster]:
    """Find connected regions of one sign, largest first."""
    clusters = []
    for sign in (1, -1):
        mask = (significant & (sign * statistic > 0))[:, 0]
        labels, count = label_mesh(mask, edges)
        for number in range(1, count + 1):
            members = labels == number
            height = np.where(members, np.abs(statistic[:, 0]), -np.inf)
            names, counts = np.unique(subfield[members], return_counts=True)
            extent = int(members.sum())
            shares = dict(zip(names.tolist(), (counts / extent).tolist(), strict=True))
            peak = (int(np.argmax(height)), 0)
            clusters.append(Cluster(extent, peak, members[:, None], shares))
    return sorted(clusters, key=lambda cluster: -cluster.extent)
