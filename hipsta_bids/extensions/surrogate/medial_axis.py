"""Thickness from single slices without a mesh: a cross-check of unexpected findings.

As in the image-based check of Diers et al. 2023, thickness is measured from the medial axis of the
merged labels in a slice to the closest points of the contour on both sides, at proportional or
equidistant points of the axis, and compared with that of a sheet nearby.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from skimage.measure import find_contours
from skimage.morphology import skeletonize

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.body import Body
from hipsta_bids.geometry.digital import piece_sizes
from hipsta_bids.geometry.grid import in_plane_voxel
from hipsta_bids.settings import SheetSettings
from hipsta_bids.types import Bool, Float

#: Distance of points in the equidistant sampling, mm.
SAMPLING_STEP = 0.5
#: Edge of the pixels on which slices are drawn, mm.
PIXEL = 0.1
#: SD of the Gaussian that rounds the voxels' corners, in-plane voxels.
SMOOTHING = 0.4
#: Standard deviation of the Gaussian that straightens the steps of the medial axis, mm.
AXIS_SMOOTHING = 0.5
#: Smaller holes in a slice are filled, mm2.
HOLE_AREA = 3.0
#: The medial axis forks towards the corners of the edges: so much of its ends is replaced by a
#: straight line, multiples of half the thickness there.
FORK_LENGTH = 1.5


@dataclass(frozen=True, eq=False, kw_only=True)
class SurrogateProfile:
    """Thickness along the medial axis of one slice, from medial to lateral."""

    position: float
    """Fraction of the body's length from its posterior end to the slice."""
    sampling: str
    """Spacing of the points along the axis: ``proportional`` or ``equidistant``."""
    fraction: Float
    """(N,) fraction of the axis, 0 at the medial and 1 at the lateral edge of the sheet."""
    distance: Float
    """(N,) distance from the medial edge along the axis, mm."""
    points: Float
    """(N, 3) RAS mm."""
    thickness: Float
    """(N,) distances to the closest points of the contour on both sides, added, mm."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Slice:
    """A slice of the merged labels, drawn on fine pixels."""

    values: Float
    """(A, B) share of the pixel that is inside; the contour is where it is a half."""
    inside: Bool
    """(A, B) whether a pixel is inside; one piece without small holes."""
    origin: Float
    """(3,) RAS mm of the first pixel."""
    directions: Float
    """(2, 3) RAS mm per pixel along both axes."""

    def to_ras(self, index: Float) -> Float:
        """(N, 3) RAS mm of (N, 2) indices."""
        return np.asarray(self.origin + index @ self.directions)


def surrogate_profiles(
    body: Body, position: float, sheet: SheetSettings
) -> tuple[SurrogateProfile, SurrogateProfile]:
    """Measure thickness in one slice at points proportional and equidistant along its axis.

    Proportional points are the places of the sheet's nodes along x.
    """
    cut = draw_slice(body, position)
    axis = _from_medial(body, cut, _medial_axis(cut, position))
    first, second = (cKDTree(side) for side in _sides(cut, axis))
    along = _path_lengths(axis, PIXEL)
    nodes = np.linspace(-sheet.x_extent, sheet.x_extent, sheet.x_nodes)

    def profile(sampling: str, distance: Float) -> SurrogateProfile:
        index = np.stack([np.interp(distance, along, axis[:, k]) for k in (0, 1)], axis=1)
        return SurrogateProfile(
            position=position,
            sampling=sampling,
            fraction=distance / along[-1],
            distance=distance,
            points=cut.to_ras(index),
            thickness=np.asarray(first.query(index)[0] + second.query(index)[0]) * PIXEL,
        )

    return (
        profile("proportional", along[-1] * (nodes + 1) / 2),
        profile("equidistant", np.arange(SAMPLING_STEP, along[-1], SAMPLING_STEP)),
    )


def _path_lengths(index: Float, pixel: float) -> Float:
    """Length of a path through pixels (N, 2) up to each of its points, (N,)."""
    steps = np.linalg.norm(np.diff(index, axis=0), axis=1) * pixel
    return np.append(0.0, steps.cumsum())


def draw_slice(body: Body, position: float) -> _Slice:
    """Draw the merged labels where a plane between the end planes cuts them.

    The plane rotates from the posterior to the anterior end plane as it moves along the body.
    """
    ends, (_, points) = body.ends, body.inside_points()
    normal = (1 - position) * ends.posterior.normal + position * ends.anterior.normal
    height = (1 - position) * ends.height(points, "posterior")
    height = height + position * ends.height(points, "anterior")
    normal, height = normal / np.linalg.norm(normal), height / np.linalg.norm(normal)
    near = np.abs(height) < 2 * ends.half_slice
    if not near.any():
        raise _empty(position)
    flat = points[near] - height[near, None] * normal
    across = np.eye(3)[np.abs(normal).argmin()]
    first = np.cross(normal, across)
    first /= np.linalg.norm(first)
    directions = np.stack([first, np.cross(normal, first)])
    margin = 2.0  # mm, so that smoothing and contours end inside
    reach = flat @ directions.T
    low, high = reach.min(axis=0) - margin, reach.max(axis=0) + margin
    shape = np.ceil((high - low) / PIXEL).astype(int)
    origin = low @ directions + (flat[0] @ normal) * normal
    steps = directions * PIXEL
    to_voxel = np.linalg.inv(body.affine)
    values = ndimage.affine_transform(
        (body.tissue > 0).astype(np.float64),
        np.column_stack([to_voxel[:3, :3] @ steps.T, np.zeros(3)]),
        to_voxel[:3, :3] @ origin + to_voxel[:3, 3],
        output_shape=(*shape.tolist(), 1),
        order=1,
    )[..., 0]
    sigma = SMOOTHING * in_plane_voxel(body.affine) / PIXEL
    values = ndimage.gaussian_filter(values, sigma)
    return _Slice(
        values=values,
        inside=_one_piece(values > 0.5, position),  # noqa: PLR2004 -- half inside
        origin=origin,
        directions=steps,
    )


def _empty(position: float) -> GeometryError:
    return GeometryError(
        f"no labels at {position:.0%} of the body's length: choose another slice",
        reason="no-medial-axis",
    )


def _one_piece(inside: Bool, position: float) -> Bool:
    """Take the largest piece, fill its small holes, and refuse others."""
    pieces, _ = ndimage.label(inside)
    if not inside.any():
        raise _empty(position)
    largest = pieces == piece_sizes(pieces).argmax()
    # Pixels that touch by corners only separate inside, and connect outside.
    outside, count = ndimage.label(~largest, structure=np.ones((3, 3)))
    small = np.bincount(outside.ravel(), minlength=count + 1) * PIXEL**2
    hole = small < HOLE_AREA
    hole[0] = False
    if count - hole.sum() > 1:
        raise GeometryError(
            f"the ribbon closes on itself at {position:.0%} of the body's length: choose another"
            " slice, or look for a bridge there",
            reason="no-medial-axis",
        )
    return np.asarray(largest | hole[outside])


def _medial_axis(cut: _Slice, position: float) -> Float:
    """Find the smoothed longest path through the skeleton, extended to both edges, (N, 2)."""
    skeleton = skeletonize(cut.inside)  # type: ignore[no-untyped-call]
    pixels = np.argwhere(skeleton)
    path = pixels[_longest_path(pixels)].astype(np.float64)
    depth = ndimage.distance_transform_edt(cut.inside)
    half = depth[tuple(path.astype(int).T)]
    along = _path_lengths(path, 1.0)
    middle = (along > 0.2 * along[-1]) & (along < 0.8 * along[-1])  # without forks
    width = float(np.median(half[middle])) if middle.any() else 0.0
    trim = FORK_LENGTH * width
    trimmed = (along >= trim) & (along <= along[-1] - trim)
    if along[-1] < 4 * trim or not width:
        raise GeometryError(
            f"the medial axis is no line at {position:.0%} of the body's length: choose another"
            " slice, or look at its labels",
            reason="no-medial-axis",
        )
    sigma = AXIS_SMOOTHING / PIXEL
    smooth = ndimage.gaussian_filter1d(path, sigma, axis=0, mode="nearest")[trimmed]
    lag = min(max(int(2 * width), 2), len(smooth) - 1)
    start = _to_the_edge(cut, smooth[0], smooth[0] - smooth[lag])[::-1]
    stop = _to_the_edge(cut, smooth[-1], smooth[-1] - smooth[-1 - lag])
    return np.concatenate([start, smooth, stop])


def _longest_path(pixels: NDArray[np.intp]) -> NDArray[np.intp]:
    """Order the pixels (N, 2) of the longest shortest path through a skeleton."""
    pairs = cKDTree(pixels).query_pairs(1.5, output_type="ndarray")
    length = np.linalg.norm(pixels[pairs[:, 0]] - pixels[pairs[:, 1]], axis=1)
    graph = sparse.csr_matrix((length, pairs.T), shape=(len(pixels), len(pixels)))
    # In a tree, the point farthest from any other is an end of the longest path.
    start = int(dijkstra(graph, directed=False, indices=np.array([0]))[0].argmax())
    from_start = dijkstra(graph, directed=False, indices=np.array([start]))[0]
    from_end = dijkstra(graph, directed=False, indices=np.array([from_start.argmax()]))[0]
    on_path = np.flatnonzero(from_start + from_end < from_start.max() + 1e-6)
    return np.asarray(on_path[np.argsort(from_start[on_path], kind="stable")])


def _to_the_edge(cut: _Slice, start: Float, direction: Float) -> Float:
    """Extend an end of the axis straight to the edge of the slice by points (M, 2)."""
    steps = np.arange(1, sum(cut.inside.shape))[:, None]
    ray = start + steps * direction / np.linalg.norm(direction)
    within = ndimage.map_coordinates(cut.inside.astype(np.uint8), ray.T, order=0) > 0
    return np.asarray(ray[: int(np.argmin(within))])


def _from_medial(body: Body, cut: _Slice, axis: Float) -> Float:
    """Order the axis from medial to lateral, by the labels along it."""
    index = body.to_voxels(cut.to_ras(axis))
    labels = ndimage.map_coordinates(body.tissue, index.T, order=0)
    labeled = np.flatnonzero(labels)
    trend = float(((labeled - labeled.mean()) * labels[labeled]).sum()) if labeled.size else 0.0
    return axis if trend >= 0 else axis[::-1]


def _sides(cut: _Slice, axis: Float) -> tuple[Float, Float]:
    """Cut the contour at both ends of the axis into two lines of points, (M, 2) each."""
    clipped = np.where(cut.inside, np.maximum(cut.values, 0.5 + 1e-6), np.minimum(cut.values, 0.5))
    lines = find_contours(clipped, 0.5 + 5e-7)  # type: ignore[no-untyped-call]
    contour = max(lines, key=len)[:-1]
    first, second = (int(cKDTree(contour).query(end)[1]) for end in (axis[0], axis[-1]))
    contour = np.roll(contour, -first, axis=0)
    middle = (second - first) % len(contour)
    return contour[: middle + 1], np.concatenate([contour[middle:], contour[:1]])
