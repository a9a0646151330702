"""Lengths and areas of the walls and the mid-surface, line by line.

Where a rim is rounded, no edge says where a wall ends: it depends on the boundary strip. The
mid-surface does reach to the rim. So both walls are continued along it: next to the rims, steps
of a wall are those of the mid-surface times the ratio of the two just before.
"""

import numpy as np

from hipsta_bids.artifacts import Float, Sheet
from hipsta_bids.geometry.measures import layer_area
from hipsta_bids.settings import MeasureSettings


def extent_x(whole: Sheet) -> Float:
    """Length of each mid-surface line from rim to rim, (Ny,), mm."""
    return np.asarray(_steps(whole, whole.middle, 0).sum(axis=0))


def extent_y(whole: Sheet) -> Float:
    """Length of each mid-surface line from end to end, (Nx,), mm."""
    return np.asarray(_steps(whole, whole.middle, 1).sum(axis=1))


def wall_length(whole: Sheet, level: int, settings: MeasureSettings) -> Float:
    """Length of each line of a wall from rim to rim, (Ny,), mm.

    Parameters
    ----------
    whole : Sheet
        From rim to rim.
    level : int
        0 for the interior and -1 for the exterior wall.
    settings : MeasureSettings

    Returns
    -------
    (Ny,) array
        One length per cross-section.
    """
    steps, middle = _steps(whole, level, 0), _steps(whole, whole.middle, 0)
    return np.asarray(_continued(steps, middle, settings).sum(axis=0))


def wall_area(whole: Sheet, level: int, settings: MeasureSettings) -> float:
    """Area of a wall from rim to rim and end to end, mm2; parameters as for lengths."""
    cells = layer_area(whole.points[:, :, level])
    middle = layer_area(whole.points[:, :, whole.middle])
    return float(_continued(cells, middle, settings).sum())


def at_columns(values: Float, extent: float, count: int) -> Float:
    """Interpolate values at lines from -1 to 1 to ``count`` lines within plus and minus extent."""
    return np.interp(np.linspace(-extent, extent, count), np.linspace(-1, 1, len(values)), values)


def _steps(sheet: Sheet, level: int, axis: int) -> Float:
    """Distances of neighbors along x or y in one layer, mm."""
    return np.asarray(np.linalg.norm(np.diff(sheet.points[:, :, level], axis=axis), axis=-1))


def _continued(wall: Float, middle: Float, settings: MeasureSettings) -> Float:
    """Replace steps (Nx - 1, M) of a wall next to the rims."""
    count = len(wall)
    rim = round((1 - settings.rim_start) / 2 * count)
    window = max(round(settings.rim_window / 2 * count), 1)
    if not rim or 2 * (rim + window) > count:
        return wall
    result = wall.copy()
    for near, before in (
        (slice(None, rim), slice(rim, rim + window)),
        (slice(-rim, None), slice(-rim - window, -rim)),
    ):
        result[near] = middle[near] * (wall[before].sum(axis=0) / middle[before].sum(axis=0))
    return result
