"""Least curvature of a triangle mesh and its direction."""

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from hipsta_bids.artifacts import Float, Int

_UPPER = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])
_TINY = 1e-8  # of unit vectors


def least_curvature(vertices: Float, triangles: Int, smoothing: int) -> tuple[Float, Float]:
    """Least of the two principal curvatures per triangle, and its direction.

    Parameters
    ----------
    vertices : (V, 3) array, mm
    triangles : (F, 3) array
        Of one orientation; every edge belongs to one or two of them.
    smoothing : int
        Steps in which the tensor of each vertex becomes the mean of its neighbors'.

    Returns
    -------
    directions : (F, 3) array
        Unit vectors in the triangles' planes.
    curvature : (F,) array
        Angle per edge, rad, where edges have unit mean length; negative where outward triangles
        are convex.

    Notes
    -----
    The curvature tensor of Cohen-Steiner & Morvan 2003 (SoCG '03:312-321) by the formulas of
    Alliez et al. 2003 (ACM Trans Graph 22:485-493), step by step as LaPy's
    ``TriaMesh.curvature_tria``, to which tests compare it. LaPy spends most of the time on finding
    the edges.
    """
    corners = vertices[triangles]
    crossed = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = crossed / np.sqrt((crossed**2).sum(axis=1, keepdims=True))
    count = len(vertices)
    edges, faces = _inner_edges(triangles, count)
    tensor = _smoothed(_edge_tensors(vertices, edges, normals[faces]), triangles, smoothing)
    vertex_normals = _sum_at(triangles.T.ravel(), np.tile(crossed, (3, 1)), count)
    length = np.sqrt((vertex_normals**2).sum(axis=1, keepdims=True))
    directions, curvature = _least_in_plane(tensor, vertex_normals / np.maximum(length, 1e-300))
    mean = (directions / 3)[triangles].sum(axis=1)
    mean -= normals * (normals * mean).sum(axis=1, keepdims=True)
    mean /= np.maximum(np.sqrt((mean**2).sum(axis=1, keepdims=True)), _TINY)
    return mean, (curvature / 3)[triangles].sum(axis=1)


def _inner_edges(triangles: Int, count: int) -> tuple[Int, NDArray[np.intp]]:
    """Edges (E, 2) between two triangles, lower vertex first, and these triangles (E, 2).

    The first of the two runs along the edge, the second against it.
    """
    start, stop = triangles.T.ravel(), np.roll(triangles, -1, axis=1).T.ravel()
    code = np.minimum(start, stop).astype(np.int64) * count + np.maximum(start, stop)
    along = np.flatnonzero(start < stop)
    against = np.flatnonzero(start > stop)
    code, first, second = np.intersect1d(
        code[along], code[against], assume_unique=True, return_indices=True
    )
    faces = np.column_stack([along[first], against[second]]) % len(triangles)
    return np.column_stack([code // count, code % count]).astype(np.int32), faces


def _edge_tensors(vertices: Float, edges: Int, normals: Float) -> Float:
    """Curvature tensor of each vertex, (V, 6), upper triangle: the mean over its edges."""
    cosine = (normals[:, 0] * normals[:, 1]).sum(axis=1).clip(-1, 1)
    along = vertices[edges[:, 1]] - vertices[edges[:, 0]]
    turn = (np.cross(normals[:, 0], normals[:, 1]) * along).sum(axis=1)
    length = np.sqrt((along**2).sum(axis=1))
    weight = -np.sign(turn) * np.arccos(cosine) * (length / length.mean())
    along /= length[:, None]
    tensors = along[:, _UPPER[0]] * along[:, _UPPER[1]] * weight[:, None]
    ends = edges.T.ravel()
    degree = np.bincount(ends, minlength=len(vertices))
    return _sum_at(ends, np.tile(tensors, (2, 1)), len(vertices)) / np.maximum(degree, 1)[:, None]


def _smoothed(values: Float, triangles: Int, steps: int) -> Float:
    """Replace values (V, K) by the means of their neighbors'."""
    count = len(values)
    first, second = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    both = np.concatenate([first, second]), np.concatenate([second, first])
    graph = sparse.csr_array((np.ones(len(both[0])), both), shape=(count, count))
    graph.data[:] = 1  # an edge of two triangles is still one neighbor
    degree = np.maximum(graph.sum(axis=1), 1)[:, None]
    for _ in range(steps):
        values = (graph @ values) / degree
    return values


def _least_in_plane(tensor: Float, normals: Float) -> tuple[Float, Float]:
    """Direction (V, 3) and size (V,) of the least curvature across the normals."""
    matrices = np.empty((len(tensor), 3, 3))
    matrices[:, _UPPER[0], _UPPER[1]] = tensor
    matrices[:, _UPPER[1], _UPPER[0]] = tensor
    values, vectors = np.linalg.eigh(matrices)
    # Edges turn across themselves, so in the plane the direction of the one eigenvalue is the
    # eigenvector of the other.
    across = np.abs((vectors * normals[:, :, None]).sum(axis=1))
    order = np.argsort(-across, axis=1)
    low, high = np.sort(order[:, 1:], axis=1).T  # eigenvalues come in ascending order
    vertex = np.arange(len(tensor))
    return vectors[vertex, :, high], values[vertex, low]


def _sum_at(index: NDArray[np.integer], values: Float, count: int) -> Float:
    """Sum rows of values (N, K) by index (N,), (count, K)."""
    return np.column_stack([np.bincount(index, column, count) for column in values.T])
