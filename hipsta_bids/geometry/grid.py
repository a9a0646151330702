"""The working grid, which turns from one end plane to the other, and the smoothed body on it."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree
from scipy.special import ndtr

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry import digital
from hipsta_bids.geometry.body import Body
from hipsta_bids.geometry.completion import Index
from hipsta_bids.geometry.outlines import SLIT_HALF_WIDTH, TOUCH_DISTANCE
from hipsta_bids.geometry.shares import SHARE_SMOOTHING, SOFT_WINDOW, softness
from hipsta_bids.geometry.slices import has_thick_slices, points_of_ends, sample_slices
from hipsta_bids.settings import CheckSettings, GridSettings, SliceSettings
from hipsta_bids.types import Bool, End, Float, LabelVolume

#: Free space around the body, mm.
GRID_MARGIN = 1.5
#: How cross-sections change towards an end plane is taken from this depth behind it, mm, and a
#: slice more, so that there is one in any case, ...
MOTION_REACH = 3.0
#: ... of the mask smoothed by this SD, mm, and of half a voxel at least.
MOTION_SD = 0.4
#: A change of size or shape weighs against it this share of what it explains.
MOTION_PRIOR = 0.02

#: SD of the window, mm, in which the sheet's thickness is looked at: it holds both walls.
THICKNESS_WINDOW = 1.0

_MAX_REPEATS = 1.3
"""Median number of equal slices in a row, along two axes, of labels that were resampled: 1 in
labels of four brains as their programs wrote them, 2 if each voxel was divided."""


@dataclass(frozen=True, eq=False, kw_only=True)
class WedgeGrid:
    """A grid whose lines run along the long axis between the two end planes.

    Grid coordinates (a, b, w) count nodes: a and b across the axis, w along it from the posterior
    plane (0) to the anterior plane (``shape[2] - 1``). So the end planes are grid planes, and
    nothing has to be cut later.
    """

    shape: tuple[int, int, int]
    """Number of nodes along a, b and w."""
    spacing: float
    """Distance of nodes across the axis, mm; along the axis it is close to it."""
    origin: Float
    """(3,) RAS mm of a = b = 0, anywhere along the axis."""
    across: Float
    """(2, 3) unit vectors of a and b; in a right hemisphere a, b and w are left-handed, so that
    a mirrored body has the same nodes."""
    axis: Float
    """(3,) unit vector of w."""
    posterior: Float
    """(3,) height c0 + c1 a + c2 b of the posterior plane above ``origin`` along the axis, mm."""
    anterior: Float
    """(3,) height of the anterior plane, likewise."""

    def to_ras(self, nodes: Float) -> Float:
        """RAS mm of (N, 3) grid coordinates."""
        a, b, w = nodes.T
        low, high = self._heights(a, b)
        along = low + (high - low) * w / (self.shape[2] - 1)
        return np.asarray(
            self.origin
            + self.spacing * (a[:, None] * self.across[0] + b[:, None] * self.across[1])
            + along[:, None] * self.axis
        )

    def to_nodes(self, points: Float) -> Float:
        """Grid coordinates of (N, 3) RAS mm: the inverse of :meth:`to_ras`."""
        local = points - self.origin
        a, b = (local @ self.across.T / self.spacing).T
        low, high = self._heights(a, b)
        w = (local @ self.axis - low) / (high - low) * (self.shape[2] - 1)
        return np.column_stack([a, b, w])

    def node_points(self) -> Float:
        """RAS mm of all nodes, (A, B, W, 3)."""
        counts = (np.arange(n, dtype=np.float64) for n in self.shape[:2])
        a, b = np.meshgrid(*counts, indexing="ij")
        low, high = self._heights(a, b)
        share = np.linspace(0, 1, self.shape[2])
        along = low[..., None] + (high - low)[..., None] * share
        base = self.spacing * (a[..., None] * self.across[0] + b[..., None] * self.across[1])
        return np.asarray(self.origin + base[:, :, None, :] + along[..., None] * self.axis)

    @property
    def step(self) -> float:
        """Mean distance of nodes along the axis in the middle of the grid, mm."""
        a, b = (np.array([0.5 * (n - 1)]) for n in self.shape[:2])
        low, high = self._heights(a, b)
        return float((high - low)[0]) / (self.shape[2] - 1)

    @property
    def frame(self) -> Float:
        """(3, 3) unit vectors of a, b and w."""
        return np.vstack([self.across, self.axis])

    def _heights(self, a: Float, b: Float) -> tuple[Float, Float]:
        """Heights of both end planes at nodes across the axis, mm."""
        low, high = (
            np.asarray(c[0] + c[1] * a + c[2] * b) for c in (self.posterior, self.anterior)
        )
        return low, high


@dataclass(frozen=True, eq=False, kw_only=True)
class Field:
    """A smooth function on a wedge grid, positive inside the body."""

    grid: WedgeGrid
    """Grid with the nodes."""
    beyond: int = 0
    """Number of levels along w that lie beyond each end plane."""
    values: NDArray[np.float32]
    """(A, B, W), -0.5 far outside and 0.5 deep inside; a little beyond near the wall."""
    separated: Bool | None = None
    """(A, B, W) nodes of the body that were taken out between turns that touch, if any."""
    slits: Bool | None = None
    """(A, B, W) nodes in slits of the labels that were filled, if any."""
    cavities: Bool | None = None
    """(A, B, W) nodes in cavities of the labels that became a part of the sheet, if any."""
    interior: Bool | None = None
    """(A, B, W) nodes in interior labels outside the sheet, if any."""


def resample_body(body: Body, hemi: str, settings: GridSettings, slices: SliceSettings) -> Field:
    """Sample the body's mask on a wedge grid and smooth it.

    Beyond its end planes the body is continued unchanged.
    """
    grid = _fit_grid(body, hemi, settings)
    separated = None
    if has_thick_slices(body.affine, slices) and cut_across(body):
        points = continued_nodes(grid, body, 0.0).reshape(-1, 3)
        values = sample_slices(body, points, slices)
    else:
        points = continued_nodes(grid, body, body.ends.half_slice).reshape(-1, 3)
        values = _sample(body, points, body.soft.values if body.soft else body.tissue > 0)
        between = _between_turns(body, points)
        separated = (between & (values > 0.5)).reshape(grid.shape)  # noqa: PLR2004 -- in the mask
        values[between] = 0
    cavities = body.cavities.all
    cavities = cavities[body.tissue[tuple(cavities.T)] > 0]
    sigma = max(settings.smoothing * in_plane_voxel(body.affine), settings.min_smoothing)
    values = values.reshape(grid.shape)
    weight = None
    if body.soft:
        # Less where shares already say where the wall is; as much as ever where they are 0 or 1.
        weights = _soft_weights(body.soft.values, np.linalg.norm(body.affine[:3, :3], axis=0))
        weight = _sample(body, points, weights).reshape(grid.shape)
    smooth = smooth_body(values, sigma, in_plane_voxel(body.affine), settings.spacing, weight)
    return Field(
        grid=grid,
        beyond=round(settings.beyond / grid.step),
        values=smooth - np.float32(0.5),
        separated=separated,
        slits=_nodes_in(body.filled, body, points, grid.shape),
        cavities=_nodes_in(cavities, body, points, grid.shape),
        interior=_nodes_in(
            digital.positions(body.interior & (body.tissue == 0)), body, points, grid.shape
        ),
    )


def cut_across(body: Body) -> bool:
    """Whether slices, along the longest edges of the voxels, lie rather across the body."""
    edges = np.linalg.norm(body.affine[:3, :3], axis=0)
    along = abs(body.ends.axis @ body.affine[:3, int(np.argmax(edges))]) / edges.max()
    return bool(along > 0.5)  # noqa: PLR2004 -- 60 degrees


def continued_nodes(grid: WedgeGrid, body: Body, depth: float) -> Float:
    """Where to read the labels of all nodes, (A, B, W, 3), RAS mm.

    Nodes less than ``depth``, mm, inside an end plane, and nodes beyond it, are moved to that depth
    along the body: it is continued there as behind the plane. Its cross-sections move, and change
    linearly: walls that lean against its direction would be read too thick without that.
    """
    points = grid.node_points()
    for end, outward in body.outward.items():
        plane = body.ends[end]
        slope = float(outward @ plane.normal)
        missing = depth + (points - plane.point) @ plane.normal * np.sign(slope)
        short = missing > 0
        depths, inward = missing[short], -outward / abs(slope)
        center, across, change = _motion(body, end, inward, grid.across)
        flat = points[short] + depths[:, None] * inward
        first, second = ((flat - center) @ across.T).T
        # Solve (1 - depth change) x = moved on the plane.
        (a, b), (c, d) = -depths * change[:, :, None]
        scale = (1 + a) * (1 + d) - b * c
        step = np.stack([(1 + d) * first - b * second, (1 + a) * second - c * first], axis=1)
        step = step / scale[:, None] - np.stack([first, second], axis=1)
        points[short] = flat + step @ across
    return points


def _motion(body: Body, end: End, inward: Float, directions: Float) -> tuple[Float, Float, Float]:
    """Fit how a cross-section changes behind an end plane.

    Returns its center (3,), the given directions (2, 3) turned into the plane, and the change
    (2, 2) per mm of depth: a point at x from the center, along these directions, moves by
    ``inward`` (3,) and by change @ x.
    Along such motions the smoothed mask stays as it is, in the sense of least squares (optical
    flow; Lucas and Kanade 1981, Proc. IJCAI, 674-679).
    """
    plane = body.ends[end]
    normal = plane.normal * np.sign(plane.normal @ inward)
    reach = MOTION_REACH + 2 * body.ends.half_slice
    index, points = body.inside_points()
    near = index[(points - plane.point) @ normal < reach]
    around = digital.box(np.maximum(near.min(axis=0) - 4, 0), near.max(axis=0) + 5)
    mask = body.tissue[around] > 0
    places = digital.voxel_points(np.ones_like(mask), body.affine)
    places += body.affine[:3, :3] @ digital.low_corner(around)
    depth = (places - plane.point) @ normal
    behind = (depth > 0).reshape(mask.shape).astype(np.float64)
    sigma = np.maximum(MOTION_SD / np.linalg.norm(body.affine[:3, :3], axis=0), 0.5)
    weight = ndimage.gaussian_filter(behind, sigma)
    smooth = ndimage.gaussian_filter(behind * mask, sigma) / np.maximum(weight, 1e-6)
    slopes = np.stack([*np.gradient(smooth)], axis=-1).reshape(-1, 3)
    slopes = slopes @ np.linalg.inv(body.affine[:3, :3])
    edge = (depth > body.ends.half_slice) & (depth < reach) & (slopes != 0).any(axis=1)
    slopes, depth, places = slopes[edge], depth[edge], places[edge]
    weight = reach - depth
    flat = places - depth[:, None] * inward  # moved back to the plane
    center = np.average(flat, axis=0, weights=weight * np.linalg.norm(slopes, axis=1))
    # A mirror image has mirrored directions, and the same numbers along them.
    first = directions[0] - (directions[0] @ normal) * normal
    first /= np.linalg.norm(first)
    second = directions[1] - (directions[1] @ normal) * normal
    second -= (second @ first) * first
    across = np.stack([first, second / np.linalg.norm(second)])
    step, offset = slopes @ across.T, (flat - center) @ across.T
    columns = np.column_stack([step, (step[:, :, None] * offset[:, None]).reshape(-1, 4)])
    matrix = columns.T @ (weight[:, None] * columns)
    matrix[2:, 2:] += MOTION_PRIOR * np.trace(matrix[2:, 2:]) / 4 * np.eye(4)
    solution = np.linalg.solve(matrix, columns.T @ (weight * -(slopes @ inward)))
    return center, across, solution[2:].reshape(2, 2)


def _nodes_in(voxels: Index, body: Body, points: Float, shape: tuple[int, int, int]) -> Bool | None:
    """Which nodes, at points (N, 3), lie in some voxels (M, 3) of the body; None without any."""
    if not len(voxels):
        return None
    selection = np.zeros(body.inside.shape, dtype=np.uint8)
    selection[tuple(voxels.T)] = 1
    hit = ndimage.map_coordinates(selection, body.to_voxels(points).T, order=0) > 0
    return np.asarray(hit.reshape(shape))


def _sample(body: Body, points: Float, values: NDArray[Any]) -> NDArray[np.float32]:
    """Linear interpolation of values (I, J, K) of the body's voxels at (N, 3) points, RAS mm."""
    return np.asarray(
        ndimage.map_coordinates(
            values.astype(np.float32),
            body.to_voxels(points).T,
            order=1,
            output=np.float32,
            mode="nearest",
        )
    )


def _between_turns(body: Body, points: Float) -> Bool:
    """Which of (N, 3) points, RAS mm, lie in a slit between ends of the sheet that touch."""
    medial, lateral = points_of_ends(body)
    slit = np.zeros(len(points), dtype=bool)
    if not (len(medial) and len(lateral)):
        return slit
    trees = cKDTree(medial), cKDTree(lateral)
    reach = TOUCH_DISTANCE + 0.5 * in_plane_voxel(body.affine)  # labels end beyond their centers
    gap = np.asarray(trees[1].query(medial, distance_upper_bound=reach)[0])
    touching = medial[np.isfinite(gap)]
    if not len(touching):
        return slit
    low, high = touching.min(axis=0) - reach, touching.max(axis=0) + reach
    close = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
    first, second = (
        np.asarray(tree.query(points[close], distance_upper_bound=reach)[0]) for tree in trees
    )
    between = np.isfinite(first) & np.isfinite(second)
    first, second = first[between], second[between]
    slit[close[between]] = np.abs(first - second) < 2 * SLIT_HALF_WIDTH
    return slit


def _smooth(values: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    """Smooth by a Gaussian and add what it removed, smoothed too: 2 G - G * G.

    A Gaussian alone moves bent walls towards their center of curvature, by sigma^2 / (2 radius),
    and rounds off edges; here the leading term cancels (twicing: Tukey 1977, Exploratory Data
    Analysis, chapter 16).
    """
    smooth = partial(
        ndimage.gaussian_filter,
        sigma=sigma,
        mode=("constant", "constant", "nearest"),
        truncate=3.0,
    )
    smoothed = smooth(values)
    return np.asarray(2 * smoothed - smooth(smoothed))


def smooth_body(
    values: NDArray[np.float32],
    sigma: float,
    voxel: float,
    spacing: float,
    weight: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Smooth a mask (A, B, W) by ``sigma``, mm, and leave the walls of thin sheets where they are.

    Where ``weight``, 0 to 1, is 1, the mask is known by shares and smoothed less. It was
    interpolated between voxels with edges ``voxel``, mm; its nodes are ``spacing`` mm apart.
    Smoothing makes a step at z = 0 to 2 F(z / sigma) - F(z / (sigma 2**0.5)), with the normal
    distribution function F: below zero beyond two SDs. So the second wall of a thin sheet raises
    the values at the first, and both would move outward. This is taken off again, by the local
    thickness: twice the volume over the area of walls in a window.
    """
    smooth = _smooth(values, sigma / spacing)
    parts: list[tuple[Any, float, float]] = [(1.0, sigma, voxel**2 / 6)]
    if weight is not None:
        fine = SHARE_SMOOTHING * sigma
        smooth += weight * (_smooth(values, fine / spacing) - smooth)
        parts = [(1 - weight, sigma, voxel**2 / 6), (weight, fine, voxel**2 / 4)]
    window = partial(
        ndimage.gaussian_filter,
        sigma=THICKNESS_WINDOW / spacing,
        mode=("constant", "constant", "nearest"),
        truncate=2.0,
    )
    sharp: NDArray[np.float32] = smooth - np.float32(0.5)
    sharp = np.clip(sharp / np.maximum(_slope(smooth), 1e-3) + 0.5, 0, 1, dtype=np.float32)
    ratio = window(sharp) / np.maximum(window(_slope(sharp)), 1e-3) * spacing / THICKNESS_WINDOW
    thickness = np.linspace(0.3, 4.0, 75)
    scaled = thickness / THICKNESS_WINDOW
    expected = (ndtr(scaled) - 0.5) / ((1 + np.exp(-(scaled**2) / 2)) / np.sqrt(2 * np.pi))
    shift = 0.0
    for part, sd, variance in parts:
        near, far = (thickness / np.sqrt(times * sd**2 + variance) for times in (1, 2))
        raised = np.maximum(ndtr(-far) - 2 * ndtr(-near), 0)
        shift = shift + part * np.interp(ratio, expected, raised)
    return np.asarray(smooth - shift * np.clip(4 * smooth * (1 - smooth), 0, 1), dtype=np.float32)


def _slope(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Length of the gradient, per node."""
    return np.asarray(np.sqrt(sum(step * step for step in np.gradient(values))))


def _soft_weights(share: NDArray[np.float32], edges: Float) -> NDArray[np.float32]:
    """Softness of walls, up to 1, of voxels (I, J, K) with edges (3,), mm; 0 far from any wall."""
    reach = SOFT_WINDOW / edges
    wall = digital.positions((share > 0) & (share < 1))
    weights = np.zeros_like(share)
    if len(wall):
        room = np.ceil(2 * reach).astype(int)
        near = digital.box(np.maximum(wall.min(axis=0) - room, 0), wall.max(axis=0) + room + 1)
        weights[near] = np.minimum(softness(share[near], reach), 1)
    return weights


def in_plane_voxel(affine: Float) -> float:
    """Geometric mean of the two smaller voxel edges, mm."""
    edges = np.sort(np.linalg.norm(affine[:3, :3], axis=0))
    return float(np.sqrt(edges[0] * edges[1]))


def check_voxel(volume: LabelVolume, settings: CheckSettings) -> None:
    """Refuse labels that are too coarse for any sheet, before anything is computed from them."""
    voxel = in_plane_voxel(volume.affine)
    if voxel > settings.max_voxel:
        raise GeometryError(
            f"voxels of {voxel:.2f} mm are too coarse (limit {settings.max_voxel:g} mm); use "
            "finer labels (HippUnfold: space-crop*, FreeSurfer: without .FSvoxelSpace)",
            reason="sheet-too-thin",
        )
    steps = np.array([_repeats(np.moveaxis(volume.tissue, axis, 0)) for axis in range(3)])
    if np.sum(steps > _MAX_REPEATS) > 1:
        larger = np.max(np.linalg.norm(volume.affine[:3, :3], axis=0) * steps)
        raise GeometryError(
            f"voxels of {voxel:.2f} mm were resampled from about {larger:.2f} mm; use the "
            "labels before resampling",
            reason="sheet-too-thin",
        )


def _repeats(slices: NDArray[np.uint8]) -> float:
    """Median number of equal slices in a row, of labels (I, J, K), along the first axis.

    It is 1 where some are much longer than the median: these are straight, not resampled.
    """
    runs = np.diff(np.flatnonzero((slices[1:] != slices[:-1]).any(axis=(1, 2))))
    median = float(np.median(runs)) if len(runs) else 1.0
    return median if median <= 4 and runs.max(initial=0) <= 3 * median else 1.0  # noqa: PLR2004 -- 1.2 mm in 0.3


def _fit_grid(body: Body, hemi: str, settings: GridSettings) -> WedgeGrid:
    """Fit the grid to the body.

    Its nodes across the axis form a lattice through the center of one voxel and along one edge of
    the voxels, so that damage or an edit of the labels does not move the nodes elsewhere.
    """
    _, points = body.inside_points()
    axis = body.ends.axis
    nearest = np.rint(body.to_voxels(body.ends.posterior.point))
    anchor = body.affine[:3, :3] @ nearest + body.affine[:3, 3]
    flat = (points - anchor) - np.outer((points - anchor) @ axis, axis)
    across = _directions_across(body, hemi, flat)
    reach = flat @ across.T
    shifts = [settings.beyond * (way @ across.T) / abs(way @ axis) for way in body.outward.values()]
    margin = GRID_MARGIN + float(np.linalg.norm(body.affine[:3, :3], axis=0).min())
    first = np.floor(
        (reach.min(axis=0) + np.min(shifts, axis=0).clip(max=0) - margin) / settings.spacing
    )
    last = np.ceil(
        (reach.max(axis=0) + np.max(shifts, axis=0).clip(min=0) + margin) / settings.spacing
    )
    size = (last - first).astype(int) + 1
    origin = anchor + settings.spacing * first @ across
    ends = body.ends.beyond(settings.beyond)
    # Heights above the grid's base as linear functions of the node numbers.
    steps = across * settings.spacing
    planes = [
        np.array([(point - origin) @ normal, *(-(steps @ normal))]) / (normal @ axis)
        for point, normal, *_ in (ends.posterior, ends.anterior)
    ]
    corners = np.array([[1, a, b] for a in (0, size[0]) for b in (0, size[1])])
    gaps = corners @ (planes[1] - planes[0])
    mean_gap = float(gaps.mean())
    if gaps.min() < 0.15 * mean_gap or mean_gap <= 0:
        raise GeometryError(
            f"the end planes meet beside the body (gap {gaps.min():.1f} to {gaps.max():.1f} mm): "
            "check the head and tail labels",
            reason="ends-crossed",
        )
    length = ends.length(points)
    return WedgeGrid(
        shape=(int(size[0]), int(size[1]), max(round(length / settings.spacing) + 1, 8)),
        spacing=settings.spacing,
        origin=origin,
        across=across,
        axis=axis,
        posterior=planes[0],
        anterior=planes[1],
    )


def _directions_across(body: Body, hemi: str, flat: Float) -> Float:
    """Find two unit vectors (2, 3) across the axis, the first along the most lateral voxel edge.

    ``flat`` holds the body's points (N, 3) without their part along the axis, mm.
    """
    axis = body.ends.axis
    edges = body.affine[:3, :3].T
    edges = edges / np.linalg.norm(edges, axis=1, keepdims=True)
    projected = edges - np.outer(edges @ axis, axis)
    length = np.linalg.norm(projected, axis=1)
    lateral = (flat - flat.mean(axis=0)).T @ (body.lateral - body.lateral.mean())
    along = projected @ lateral
    usable = length > 0.5  # noqa: PLR2004 -- not the edge along the axis
    best = int(np.argmax(np.where(usable, np.abs(along) / np.maximum(length, 0.5), -1.0)))
    side = -1.0 if along[best] < 0 else 1.0
    first = side * projected[best] / length[best]
    second = np.cross(axis, first)
    return np.stack([first, second if hemi == "L" else -second])
