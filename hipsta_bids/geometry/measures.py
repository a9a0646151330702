"""Thickness, curvature, extents and areas of a sheet."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.artifacts import Float, Sheet
from hipsta_bids.geometry.local_polynomials import differentiate
from hipsta_bids.schemes import Tissue
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
    points = sheet.points[:, :, level]
    outward = sheet.points[:, :, -1] - sheet.points[:, :, 0]
    du = _derivative(points, settings, (1, 0))
    dv = _derivative(points, settings, (0, 1))
    duu = _derivative(points, settings, (2, 0))
    dvv = _derivative(points, settings, (0, 2))
    duv = _derivative(points, settings, (1, 1))
    normal = np.cross(du, dv)
    normal *= -np.sign((normal * outward).sum(axis=-1, keepdims=True))  # towards the interior
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    e, f, g = ((p * q).sum(axis=-1) for p, q in ((du, du), (du, dv), (dv, dv)))
    l, m, n = ((p * normal).sum(axis=-1) for p in (duu, duv, dvv))  # noqa: E741 -- textbook names
    return np.asarray((e * n - 2 * f * m + g * l) / (2 * (e * g - f**2)))


def bending_angle(sheet: Sheet, settings: MeasureSettings) -> float:
    """Angle by which the mid lines turn round the interior side from medial to lateral, rad.

    The mean over y of the curvature integrated along x; negative if the sheet curls the other way.
    """
    mid = sheet.points[:, :, sheet.middle]
    outward = sheet.points[:, :, -1] - sheet.points[:, :, 0]
    du = _derivative(mid, settings, (1, 0))
    duu = _derivative(mid, settings, (2, 0))
    outward = outward / np.linalg.norm(outward, axis=-1, keepdims=True)
    speed = np.linalg.norm(du, axis=-1)
    bend = -(duu * outward).sum(axis=-1) / speed  # curvature times step length
    return float(bend.sum(axis=0).mean())


def layer_area(points: Float) -> Float:
    """Area of each quadrilateral of a layer (Nx, Ny, 3), (Nx - 1, Ny - 1), mm2."""
    a, b = points[1:, 1:] - points[:-1, :-1], points[1:, :-1] - points[:-1, 1:]
    return np.asarray(0.5 * np.linalg.norm(np.cross(a, b), axis=-1))


def column_volume(sheet: Sheet) -> Float:
    """Volume round each column, (Nx, Ny), mm3, by the trapezoidal rule over layers."""
    areas = np.stack(
        [node_shares(layer_area(sheet.points[:, :, k])) for k in range(sheet.points.shape[2])],
        axis=2,
    )
    steps = np.linalg.norm(np.diff(sheet.points, axis=2), axis=3)
    return np.asarray((0.5 * (areas[:, :, 1:] + areas[:, :, :-1]) * steps).sum(axis=2))


def node_shares(cells: Float) -> Float:
    """Give each quadrilateral in quarters to its corners: (Nx - 1, Ny - 1) to (Nx, Ny)."""
    shares = np.zeros((cells.shape[0] + 1, cells.shape[1] + 1))
    for x in (slice(None, -1), slice(1, None)):
        for y in (slice(None, -1), slice(1, None)):
            shares[x, y] += cells / 4
    return shares


@dataclass(frozen=True, eq=False, kw_only=True)
class SheetMeasures:
    """A sheet with what was measured on it."""

    sheet: Sheet
    thickness: Float
    """(Nx, Ny) mm."""
    subfield: NDArray[np.uint8]
    """(Nx, Ny) values of Tissue."""


def summarize(
    measured: SheetMeasures, whole: SheetMeasures, tissues: tuple[Tissue, ...], volume: float
) -> dict[str, float]:
    """One number per measure for the whole body and per subfield.

    Parameters
    ----------
    measured : SheetMeasures
        Where thickness is measured.
    whole : SheetMeasures
        The same body from rim to rim, end to end and wall to wall, for lengths, areas and volumes.
    tissues : tuple of Tissue
        The subfields of the protocol; absent ones are NaN.
    volume : float
        Of the mesh, mm3.

    Returns
    -------
    dict
        Keys as in the output table: thickness and extents in mm, areas in mm2, volumes in mm3.
    """
    points, valid = whole.sheet.points, measured.sheet.valid
    mid = points[:, :, whole.sheet.middle]
    mid_area = node_shares(layer_area(mid))
    columns = column_volume(whole.sheet)
    summary = {
        "thickness_mean": float(measured.thickness[valid].mean()),
        "extent_x": float(np.linalg.norm(np.diff(mid, axis=0), axis=-1).sum(axis=0).mean()),
        "extent_y": float(np.linalg.norm(np.diff(mid, axis=1), axis=-1).sum(axis=1).mean()),
        "extent_z": float(measured.thickness.mean()),
        "volume": volume,
        "area_interior": float(layer_area(points[:, :, 0]).sum()),
        "area_mid": float(mid_area.sum()),
        "area_exterior": float(layer_area(points[:, :, -1]).sum()),
    }
    parts = (
        ("thickness_mean", measured.subfield[valid], measured.thickness[valid], np.mean),
        ("area", whole.subfield, mid_area, np.sum),
        ("volume", whole.subfield, columns, np.sum),
    )
    for name, labels, values, merge in parts:
        for tissue in tissues:
            here = values[labels == tissue]
            summary[f"{name}_{tissue.name}"] = float(merge(here)) if here.size else float("nan")
    return summary


def _derivative(points: Float, settings: MeasureSettings, order: tuple[int, int]) -> Float:
    """Smoothed partial derivative with respect to the node numbers."""
    for axis, times in enumerate(order):
        window = min(settings.curvature_window, points.shape[axis] - 1 + points.shape[axis] % 2)
        degree = min(settings.curvature_order, window - 1)
        points = differentiate(points, window, degree, times, axis)
    return points
