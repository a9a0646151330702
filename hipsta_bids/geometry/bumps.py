"""Bumps and dents of a wall of the sheet, also at its ends.

Each column is compared with a line through the columns round it but not next to it, along either
axis of the sheet: folds and subfield borders run along one axis and pass both comparisons. At an
edge the line is extrapolated. The limit is a multiple of the roughness of the smoother wall.
"""

from dataclasses import replace

import numpy as np
from scipy import ndimage

from hipsta_bids.geometry.measures import measure_thickness
from hipsta_bids.geometry.sheet_checks import node_step
from hipsta_bids.settings import CheckSettings
from hipsta_bids.types import MAD_TO_SD, Bool, Finding, Float, Sheet

#: Columns nearer than this do not predict a column, mm: a bump may cover them.
GAP = 2.2
#: SD of the Gaussian weight of the other columns, mm.
REACH = 2.5
#: Roughness is measured within this many columns on both sides, along x.
BAND = 4
#: Swellings of an end are averaged over this many rows, and this width along x, mm.
END_ROWS, END_WIDTH = 2, 4.0
#: They are compared with rows at these distances from the end, mm.
END_COURSE = (3.0, 8.0)
WALLS = ("interior", "exterior")
#: A patch consists of the columns beyond this share of the limit.
_PATCH = 0.5


def check_bumps(sheet: Sheet, settings: CheckSettings) -> list[Finding]:
    """Flag patches in which the sheet is thicker or thinner than the columns round them predict.

    One finding for each patch with more than half of the limit.
    """
    points = _filled(sheet)
    middle, walls = points[:, :, sheet.middle], points[:, :, [0, -1]]
    counts, steps = middle.shape[:2], [node_step(middle, axis) for axis in (0, 1)]
    if any((n - 1) * step < 3 * GAP for n, step in zip(counts, steps, strict=True)):
        return []
    along_x, along_y = map(predictor, counts, steps)
    stands = _stand_out(walls, along_y)
    thickness = measure_thickness(replace(sheet, points=points))
    excess = thickness - thickness @ along_y.T
    across = (thickness - along_x @ thickness) / _size(along_x)[:, None]
    # Zero where the two differ in sign.
    joint = np.sign(excess) * np.sqrt(np.maximum(excess / _size(along_y) * across, 0))
    score = joint / np.maximum(_roughness(stands).min(axis=-1), settings.smooth_wall)
    findings = []
    for sign, reason, limit, verb, kind, remedy in (
        (1, "wall-bump", settings.flag_bump, "stands out", "thicker", "labels that leaked"),
        (-1, "wall-dent", settings.flag_dent, "recedes", "thinner", "missing labels"),
    ):
        for patch in _patches(sign * score, limit):
            peak = np.unravel_index(np.where(patch, sign * score, 0).argmax(), score.shape)
            wall, count = int((sign * stands[peak]).argmax()), int(patch.sum())
            findings.append(
                Finding(
                    reason=reason,
                    value=float(abs(score[peak])),
                    limit=limit,
                    text=f"the {WALLS[wall]} wall {verb}: the sheet is {abs(excess[peak]):.1f} mm "
                    f"{kind} than round about, over {count} grid point{'s' * (count > 1)}",
                    remedy=f"look for {remedy}",
                    points=walls[patch, wall],
                )
            )
    # Next to a bump, lines through it predict too much: no dents. The same next to a dent.
    largest = max(findings, key=lambda finding: finding.margin, default=None)
    return [finding for finding in findings if largest and finding.reason == largest.reason]


def check_swollen_ends(sheet: Sheet, settings: CheckSettings) -> list[Finding]:
    """Flag an end that is thicker than the sheet farther in, over more than bumps cover.

    The outer rows, averaged along x, are compared with the median of rows farther in.
    """
    points = _filled(sheet)
    middle, thickness = points[:, :, sheet.middle], measure_thickness(replace(sheet, points=points))
    step_x, step_y = (node_step(middle, axis) for axis in (0, 1))
    half = round(END_WIDTH / step_x / 2)
    inner = slice(*(round(distance / step_y) for distance in END_COURSE))
    if inner.start >= middle.shape[1]:  # too short
        return []
    findings = []
    for end, way in (("posterior", 1), ("anterior", -1)):
        inward = thickness[:, ::way]
        above = inward[:, :END_ROWS].mean(axis=1) - np.median(inward[:, inner], axis=1)
        swelling = ndimage.uniform_filter1d(above, 2 * half + 1)
        column = int(swelling.argmax())
        near = slice(max(column - half, 0), column + half + 1)
        findings.append(
            Finding(
                reason="end-swollen",
                value=float(swelling[column]),
                limit=settings.flag_swollen_end,
                text=f"the {end} end of the sheet is {swelling[column]:.1f} mm thicker than "
                "the sheet farther in",
                remedy="look for labels that leaked",
                points=middle[near, ::way][:, :END_ROWS].reshape(-1, 3),
            )
        )
    return findings


def _stand_out(walls: Float, along_y: Float) -> Float:
    """Compute how far walls (Nx, Ny, 2, 3) lie outside their lines along y, (Nx, Ny, 2).

    In standard deviations of unit white noise.
    """
    predicted = np.einsum("jk,ikwc->ijwc", along_y, walls)
    outward = np.diff(predicted, axis=2) * np.array([-1, 1])[:, None]
    outward /= np.maximum(np.linalg.norm(outward, axis=-1, keepdims=True), 1e-9)
    return np.asarray(((walls - predicted) * outward).sum(axis=-1) / _size(along_y)[:, None])


def predictor(count: int, step: float) -> Float:
    """Compute the matrix (N, N) that predicts equidistant values by local lines.

    Row i is the value at i of the weighted least-squares line through the values farther than
    ``GAP`` from i (local regression without the middle; Cleveland 1979, JASA 74:829-836).
    ``step`` is their distance, mm.
    """
    at = step * np.arange(count)
    offset = at - at[:, None]
    weight = np.exp(-0.5 * (offset / REACH) ** 2) * (np.abs(offset) > GAP)
    zeroth, first, second = ((weight * offset**k).sum(axis=1, keepdims=True) for k in range(3))
    return np.asarray(weight * (second - first * offset) / (zeroth * second - first**2))


def _size(matrix: Float) -> Float:
    """Compute the standard deviation (N,) of departures from predictions, for unit white noise."""
    return np.asarray(np.linalg.norm(np.eye(len(matrix)) - matrix, axis=1))


def _roughness(departure: Float) -> Float:
    """Compute the robust SD (Nx, 1, 2), mm, of each wall's departures (Nx, Ny, 2) along x.

    Half of the variance is that of the wall, half that of the band of columns.
    """
    size = np.abs(departure)
    bands = [size[max(i - BAND, 0) : i + BAND + 1] for i in range(len(size))]
    band = np.array([np.median(part, axis=(0, 1)) for part in bands])
    wall = np.median(size, axis=(0, 1))
    return np.asarray(MAD_TO_SD * np.sqrt((band**2 + wall**2) / 2))[:, None]


def _filled(sheet: Sheet) -> Float:
    """Points (Nx, Ny, Nz, 3), RAS mm, of which undefined columns are those of the nearest."""
    missing = np.asarray(~np.isfinite(sheet.points).all(axis=(2, 3)))
    nearest = ndimage.distance_transform_edt(missing, return_distances=False, return_indices=True)
    return np.asarray(sheet.points[tuple(nearest)])


def _patches(score: Float, limit: float) -> list[Bool]:
    """Find connected columns (Nx, Ny) beyond part of the limit."""
    number, count = ndimage.label(score > _PATCH * limit)
    return [number == k for k in range(1, count + 1)]
