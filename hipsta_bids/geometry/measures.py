"""Measures of a sheet: by point, by line, by cross-section, and by subfield."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from hipsta_bids.geometry.body import Body
from hipsta_bids.geometry.mesh import tetra_volumes
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.settings import MeasureSettings
from hipsta_bids.types import Bool, Float, Sheet, TetMesh

#: Beyond this x, and its negative, the lengths and areas of both walls follow those of the mid-
#: surface: where a rounded edge ends a wall is arbitrary.
ROUNDED_EDGE_START = 0.8
#: Extent in x, before rounded edges, over which the ratio of wall and mid-surface is taken.
ROUNDED_EDGE_WINDOW = 0.2

#: Points per cell along x and y, about a tenth of a millimeter apart along x on the default grid.
_POINTS = 4


def differentiate(values: Float, window: int, degree: int, times: int, axis: int) -> Float:
    """Differentiate along one axis with polynomials fitted to windows of nodes.

    The derivative at a node is the slope of the polynomial fitted to the window around it; within
    half a window of either end, to the first or last window.

    Savitzky & Golay 1964, Anal Chem 36:1627-1639. The same as SciPy's ``savgol_filter``, to which
    a test compares it; importing that takes longer than measuring half a hemisphere, and 36 MB.
    """
    weights = _weights(values.shape[axis], window, degree, times)
    return np.asarray(np.moveaxis(np.tensordot(weights, values, axes=(1, axis)), 0, axis))


@lru_cache(maxsize=64)
def _weights(count: int, window: int, degree: int, times: int) -> Float:
    """Matrix (count, count) that maps values to derivatives."""
    result = np.zeros((count, count))
    if times > degree:
        return result
    position = np.arange(window)
    steps = position - position[:, None]  # from each position in the window to all of it
    powers = steps[..., None] ** np.arange(degree + 1.0)
    rows = math.factorial(times) * np.linalg.pinv(powers)[:, times]
    node = np.arange(count)
    first = np.clip(node - window // 2, 0, count - window)
    result[node[:, None], first[:, None] + position] = rows[node - first]
    return result


def measure_thickness(sheet: Sheet) -> Float:
    """Length of each column from the interior to the exterior wall, (Nx, Ny), mm.

    The columns follow the interior-exterior coordinate (Diers et al. 2023, section 2.2).
    """
    steps = np.linalg.norm(np.diff(sheet.points, axis=2), axis=3)
    return np.asarray(steps.sum(axis=2))


def mean_curvature(sheet: Sheet, level: int, settings: MeasureSettings) -> Float:
    """Mean curvature of one layer of the sheet, (Nx, Ny), 1/mm.

    Positive where the layer curls round its interior side, as on a cylinder whose axis lies on the
    interior side: there it is half of 1 / radius.

    From the first and second fundamental form of local polynomials (do Carmo 1976, Differential
    Geometry of Curves and Surfaces, section 3.3; smoothing differentiation by Savitzky & Golay
    1964, Anal Chem 36:1627-1639).
    """
    windows = (settings.curvature_window, settings.curvature_window)
    low, high = _principal_curvatures(sheet, level, windows, settings)
    return (low + high) / 2


def gaussian_curvature(sheet: Sheet, level: int, settings: MeasureSettings) -> Float:
    """Gaussian curvature of one layer of the sheet, (Nx, Ny), 1/mm2.

    Zero where the layer could be flattened without stretching; positive where it is a bowl or a
    dome, negative where it is a saddle. It does not depend on which side is interior.

    As in :func:`mean_curvature`, but with longer windows along y: noise in the small curvature
    along the axis is multiplied by the large one across it.
    """
    windows = (settings.curvature_window, settings.gaussian_window)
    low, high = _principal_curvatures(sheet, level, windows, settings)
    return low * high


def bending_angle(sheet: Sheet, settings: MeasureSettings) -> float:
    """Angle by which the mid lines turn round the interior side from medial to lateral, rad.

    The mean over y of the curvature integrated along x; negative if the sheet curls the other way.
    """
    mid = sheet.points[:, :, sheet.middle]
    outward = sheet.points[:, :, -1] - sheet.points[:, :, 0]
    windows = (settings.curvature_window, settings.curvature_window)
    du = _derivative(mid, windows, settings.curvature_order, (1, 0))
    duu = _derivative(mid, windows, settings.curvature_order, (2, 0))
    outward = outward / np.linalg.norm(outward, axis=-1, keepdims=True)
    speed = np.linalg.norm(du, axis=-1)
    bend = -(duu * outward).sum(axis=-1) / speed  # curvature times step length
    return float(bend.sum(axis=0).mean())


def layer_area(points: Float) -> Float:
    """Area of each quadrilateral of a layer (Nx, Ny, 3), (Nx - 1, Ny - 1), mm2."""
    a, b = points[1:, 1:] - points[:-1, :-1], points[1:, :-1] - points[:-1, 1:]
    return np.asarray(0.5 * np.linalg.norm(np.cross(a, b), axis=-1))


def column_area(sheet: Sheet) -> Float:
    """Area of the mid-surface round each column, (Nx, Ny), mm2; none next to undefined points."""
    return node_shares(np.nan_to_num(layer_area(sheet.points[:, :, sheet.middle])))


def away_from_edges(shape: tuple[int, ...], settings: MeasureSettings) -> Bool:
    """Nodes (Nx, Ny) on both sides of which local polynomials are fitted, or else the middle."""
    margin = settings.curvature_window // 2
    inner = np.zeros(shape, dtype=np.bool_)
    inner[tuple(slice(m, n - m) for n in shape for m in (min(margin, (n - 1) // 2),))] = True
    return inner


def node_shares(cells: Float) -> Float:
    """Give each quadrilateral in quarters to its corners: (Nx - 1, Ny - 1) to (Nx, Ny)."""
    shares = np.zeros((cells.shape[0] + 1, cells.shape[1] + 1))
    for x in (slice(None, -1), slice(1, None)):
        for y in (slice(None, -1), slice(1, None)):
            shares[x, y] += cells / 4
    return shares


def pool_sd(sd: Float, window: int) -> Float:
    """Average variances of maps (..., Nx, Ny) over ``window`` nodes along x and y, as SD."""
    finite = np.isfinite(sd)
    size = (1,) * (sd.ndim - 2) + (window, window)
    total, count = (
        uniform_filter(values, size, mode="nearest")
        for values in (np.where(finite, sd, 0.0) ** 2, finite.astype(np.float64))
    )
    mean = np.maximum(total, 0.0) / np.where(finite, count, 1.0)
    return np.where(finite, np.sqrt(mean), np.nan)


def _principal_curvatures(
    sheet: Sheet, level: int, windows: tuple[int, int], settings: MeasureSettings
) -> tuple[Float, Float]:
    """Both principal curvatures (Nx, Ny), 1/mm, for the normal that points to the interior.

    They are bounded: where lines of the sheet meet or turn back, next to its edges and ends, the
    formulas divide by nearly zero.
    """
    degree, bound = settings.curvature_order, settings.max_curvature
    points = sheet.points[:, :, level]
    outward = sheet.points[:, :, -1] - sheet.points[:, :, 0]
    du, dv, duu, duv, dvv = (
        _derivative(points, windows, degree, order)
        for order in ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    )
    normal = np.cross(du, dv)
    normal *= -np.sign((normal * outward).sum(axis=-1, keepdims=True))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    e, f, g = ((p * q).sum(axis=-1) for p, q in ((du, du), (du, dv), (dv, dv)))
    l, m, n = ((p * normal).sum(axis=-1) for p in (duu, duv, dvv))  # noqa: E741 -- textbook names
    area = e * g - f**2
    mean = (e * n - 2 * f * m + g * l) / (2 * area)
    spread = np.sqrt(np.maximum(mean**2 - (l * n - m**2) / area, 0))
    return np.clip(mean - spread, -bound, bound), np.clip(mean + spread, -bound, bound)


def _derivative(
    points: Float, windows: tuple[int, int], degree: int, order: tuple[int, int]
) -> Float:
    """Smoothed partial derivative with respect to the node numbers."""
    for axis, times in enumerate(order):
        window = min(windows[axis], points.shape[axis] - 1 + points.shape[axis] % 2)
        points = differentiate(points, window, min(degree, window - 1), times, axis)
    return points


def extent_x(whole: Sheet) -> Float:
    """Length of each mid-surface line from medial to lateral edge, (Ny,), mm."""
    return np.asarray(_steps(whole, whole.middle, 0).sum(axis=0))


def extent_y(whole: Sheet) -> Float:
    """Length of each mid-surface line from end to end, (Nx,), mm."""
    return np.asarray(_steps(whole, whole.middle, 1).sum(axis=1))


def wall_length(whole: Sheet, level: int) -> Float:
    """Length of each line of a wall from medial to lateral edge, (Ny,), mm."""
    steps, middle = _steps(whole, level, 0), _steps(whole, whole.middle, 0)
    return np.asarray(_continued(steps, middle).sum(axis=0))


def wall_area(whole: Sheet, level: int) -> float:
    """Area of a wall from medial to lateral edge and end to end, mm2."""
    cells = layer_area(whole.points[:, :, level])
    middle = layer_area(whole.points[:, :, whole.middle])
    return float(_continued(cells, middle).sum())


def at_columns(values: Float, extent: float, count: int) -> Float:
    """Interpolate values at lines from -1 to 1 to ``count`` lines within plus and minus extent."""
    return np.interp(np.linspace(-extent, extent, count), np.linspace(-1, 1, len(values)), values)


def _steps(sheet: Sheet, level: int, axis: int) -> Float:
    """Distances of neighbors along x or y in one layer, mm."""
    return np.asarray(np.linalg.norm(np.diff(sheet.points[:, :, level], axis=axis), axis=-1))


def _continued(wall: Float, middle: Float) -> Float:
    """Replace steps (Nx - 1, M) of a wall next to the sheet's edges by scaled middle ones."""
    count = len(wall)
    rim = round((1 - ROUNDED_EDGE_START) / 2 * count)
    window = max(round(ROUNDED_EDGE_WINDOW / 2 * count), 1)
    if not rim or 2 * (rim + window) > count:
        return wall
    result = wall.copy()
    for near, before in (
        (slice(None, rim), slice(rim, rim + window)),
        (slice(-rim, None), slice(-rim - window, -rim)),
    ):
        result[near] = middle[near] * (wall[before].sum(axis=0) / middle[before].sum(axis=0))
    return result


@dataclass(frozen=True, eq=False, kw_only=True)
class CrossSections:
    """One value per cross-section, where y is constant (Diers et al. 2023, section 2.2).

    All are (Ny,), from posterior to anterior.
    """

    position: Float
    """Distance from the posterior end plane along the mid-surface, mean over x, mm."""
    interior: Float
    """Length of the interior wall, mm."""
    middle: Float
    """Length of the mid-line, mm."""
    exterior: Float
    """Length of the exterior wall, mm."""
    area: Float
    """mm2."""
    thickness: Float
    """Mean over the columns of the section, mm."""

    @property
    def circumference(self) -> Float:
        """Length of both walls, mm."""
        return self.interior + self.exterior

    @property
    def ratio(self) -> Float:
        """Interior over exterior length."""
        return self.interior / self.exterior

    @property
    def shape_index(self) -> Float:
        """Circumference over area, 1/mm; 2 / thickness in a sheet of even thickness."""
        return self.circumference / self.area

    def mean(self, values: Float) -> float:
        """Mean of values (Ny,) over the body; every millimeter of its length counts the same."""
        return float(np.trapezoid(values, self.position) / np.ptp(self.position))


def cut_sections(whole: Sheet, thickness: Float) -> CrossSections:
    """Measure the cross-sections of a body, given the mean thickness (Ny,) of each."""
    steps = _steps(whole, whole.middle, 1).mean(axis=0)
    return CrossSections(
        position=np.concatenate([[0.0], steps.cumsum()]),
        interior=wall_length(whole, 0),
        middle=extent_x(whole),
        exterior=wall_length(whole, -1),
        area=section_area(whole),
        thickness=thickness,
    )


def section_area(whole: Sheet) -> Float:
    """Area of each cross-section, (Ny,), mm2.

    Half the length of the sum of the cells' diagonals' cross products: in a plane the area of the
    polygon round the section, whatever its cells do next to rounded rims. The area that chords cut
    off is proportional to the square of their length; it is extrapolated from every second one
    (Richardson 1911).
    """
    area = _polygon_area(whole.points)
    if whole.points.shape[0] % 2 == 0:  # the last line would be left out
        return area
    return area + (area - _polygon_area(whole.points[::2])) / 3


def _polygon_area(points: Float) -> Float:
    p = np.moveaxis(points, 1, 0)
    first, second = p[:, 1:, 1:] - p[:, :-1, :-1], p[:, 1:, :-1] - p[:, :-1, 1:]
    return np.asarray(0.5 * np.linalg.norm(np.cross(first, second).sum(axis=(1, 2)), axis=-1))


def labels_at(points: Float, body: Body) -> NDArray[np.uint8]:
    """Tissue (N,) at points (N, 3), RAS mm: of the body's voxel there, or else of the nearest."""
    voxel = np.rint(body.to_voxels(points)).astype(np.intp)
    clipped = np.clip(voxel, 0, np.array(body.inside.shape) - 1)
    index = tuple(clipped.T)
    labels = body.tissue[index]
    # Along sheared axes, the clipped voxel is not the nearest.
    outside = np.flatnonzero(~body.inside[index] | (clipped != voxel).any(axis=1))
    if len(outside):
        voxels, _ = body.inside_points()
        labels[outside] = body.tissue[tuple(voxels[body.nearest(points[outside])].T)]
    return np.asarray(labels, dtype=np.uint8)


def subfield_areas(whole: Sheet, body: Body) -> dict[Tissue, float]:
    """Area of the mid-surface in each subfield that it has, mm2."""
    at = (np.arange(_POINTS) + 0.5) / _POINTS
    inner = whole.points[:, :, 1:-1]  # walls lie next to the voxels as often as in them
    along_x = _between(inner[:-1], inner[1:], at)
    points = _between(along_x[:, :, :-1], along_x[:, :, 1:], at)
    shares = layer_area(whole.points[:, :, whole.middle])[..., None] / points[..., 0, 0, :, 0].size
    weights = np.broadcast_to(shares, points.shape[:-1])
    return _sums(labels_at(points.reshape(-1, 3), body), weights.ravel())


def subfield_volumes(mesh: TetMesh, body: Body) -> dict[Tissue, float]:
    """Volume in each subfield between the end planes, mm3."""
    centers = mesh.vertices.take(mesh.tetrahedra.T, axis=0).mean(axis=0)
    depth = body.ends.depth(mesh.vertices).take(mesh.tetrahedra.T)
    between = np.maximum(depth, 0).sum(axis=0) / np.maximum(np.abs(depth).sum(axis=0), 1e-12)
    return _sums(labels_at(centers, body), between * tetra_volumes(mesh.vertices, mesh.tetrahedra))


def _between(start: Float, end: Float, at: Float) -> Float:
    """Points at fractions of the way, along a new first axis."""
    return np.stack([start + fraction * (end - start) for fraction in at])


def _sums(labels: NDArray[np.uint8], weights: Float) -> dict[Tissue, float]:
    total = np.bincount(labels, weights)
    return {Tissue(int(kind)): float(total[kind]) for kind in np.unique(labels)}
