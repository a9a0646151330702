"""Thickness, curvature and areas of a sheet, point by point."""

import numpy as np

from hipsta_bids.artifacts import Bool, Float, Sheet
from hipsta_bids.geometry.local_polynomials import differentiate
from hipsta_bids.settings import MeasureSettings


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

    Parameters
    ----------
    sheet : Sheet
    level : int
        Number of the layer along z.
    settings : MeasureSettings

    Returns
    -------
    (Nx, Ny) array

    Notes
    -----
    From the first and second fundamental form of local polynomials (do Carmo 1976, Differential
    Geometry of Curves and Surfaces, section 3.3; smoothing differentiation by Savitzky & Golay
    1964, Anal Chem 36:1627-1639).
    """
    windows = (settings.curvature_window, settings.curvature_window)
    low, high = _principal_curvatures(sheet, level, windows, settings)
    return (low + high) / 2


def gaussian_curvature(sheet: Sheet, level: int, settings: MeasureSettings) -> Float:
    """Gaussian curvature of one layer of the sheet, (Nx, Ny), 1/mm2.

    Zero where the layer could be laid flat without stretching; positive where it is a bowl or a
    dome, negative where it is a saddle. It does not depend on which side is interior.

    Parameters
    ----------
    sheet : Sheet
    level : int
        Number of the layer along z.
    settings : MeasureSettings

    Returns
    -------
    (Nx, Ny) array

    Notes
    -----
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
    """Area of the mid-surface round each column, (Nx, Ny), mm2; none beside undefined points."""
    return node_shares(np.nan_to_num(layer_area(sheet.points[:, :, sheet.middle])))


def away_from_edges(shape: tuple[int, ...], settings: MeasureSettings) -> Bool:
    """Nodes (Nx, Ny) on both sides of which local polynomials are fitted, or else the middle."""
    margin = settings.curvature_window // 2
    away = np.zeros(shape, dtype=np.bool_)
    away[tuple(slice(m, n - m) for n in shape for m in (min(margin, (n - 1) // 2),))] = True
    return away


def node_shares(cells: Float) -> Float:
    """Give each quadrilateral in quarters to its corners: (Nx - 1, Ny - 1) to (Nx, Ny)."""
    shares = np.zeros((cells.shape[0] + 1, cells.shape[1] + 1))
    for x in (slice(None, -1), slice(1, None)):
        for y in (slice(None, -1), slice(1, None)):
            shares[x, y] += cells / 4
    return shares


def _principal_curvatures(
    sheet: Sheet, level: int, windows: tuple[int, int], settings: MeasureSettings
) -> tuple[Float, Float]:
    """Both principal curvatures (Nx, Ny), 1/mm, for the normal that points to the interior.

    They are bounded: where lines of the sheet meet or turn back, next to rims and ends, the
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
