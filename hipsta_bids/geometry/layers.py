"""Layers: where along its columns the sheet is sampled.

Cortical layers of a bent sheet keep their share of the volume rather than of the thickness: they
are thinner where they are stretched (Bok 1929, Z Gesamte Neurol Psychiatr 121:682-750; Waehnert et
al. 2014, NeuroImage 93:210-220; Leprince et al. 2015, IEEE ISBI, 1217-1220).
"""

import numpy as np

from hipsta_bids.artifacts import Bool, Flag, Float, Sheet


def equal_volume_layers(sheet: Sheet) -> tuple[Sheet, Bool]:
    """Move the points along their columns so that the same volume lies between any two layers.

    Parameters
    ----------
    sheet : Sheet
        Its points at equal distances along each column.

    Returns
    -------
    layers : Sheet
        Both walls stay; columns in which layers fold keep equal distances.
    folded : (Nx, Ny) array of bool
        Where layers fold, so that there is no such depth.

    Notes
    -----
    The area of a column grows linearly between two layers, so the volume below a depth is a
    quadratic function of it, and inverted exactly.
    """
    area = _column_areas(sheet.points)
    folded = np.asarray(~(area > 0).all(axis=2))
    area = np.where(folded[..., None], 1.0, area)
    count = sheet.points.shape[2]
    volume = np.zeros_like(area)
    volume[:, :, 1:] = (0.5 * (area[:, :, 1:] + area[:, :, :-1])).cumsum(axis=2)
    wanted = volume[:, :, -1:] * np.linspace(0, 1, count)[1:-1]
    below = (volume[:, :, None, 1:-1] <= wanted[..., None]).sum(axis=-1)
    lower = np.take_along_axis(area, below, axis=2)
    growth = np.take_along_axis(area, below + 1, axis=2) - lower
    rest = wanted - np.take_along_axis(volume, below, axis=2)
    share = 2 * rest / (lower + np.sqrt(np.maximum(lower**2 + 2 * growth * rest, 0)))
    start = np.take_along_axis(sheet.points, below[..., None], axis=2)
    end = np.take_along_axis(sheet.points, below[..., None] + 1, axis=2)
    points = sheet.points.copy()
    points[:, :, 1:-1] = start + share[..., None] * (end - start)
    points[folded] = sheet.points[folded]
    return Sheet(points=points, valid=sheet.valid), folded


def check_layers(folded: Bool) -> list[Flag]:
    """Flag a sheet whose layers fold, so that some columns have no equal-volume depths.

    Returns
    -------
    list of Flag
        ``layers-fold``.
    """
    if not folded.any():
        return []
    x, y = np.argwhere(folded)[0] + 1
    return [
        Flag(
            reason="layers-fold",
            message=f"layers fold in {folded.sum()} of {folded.size} columns, the first at x {x}, "
            f"y {y}: their layers are at equal distances instead; set sheet.depths to distance, "
            "or leave these points out",
        )
    ]


def layer_depth(layers: Sheet) -> Float:
    """Distance of each point from the interior wall along its column, (Nx, Ny, Nz), mm."""
    steps = np.linalg.norm(np.diff(layers.points, axis=2), axis=3)
    return np.concatenate([np.zeros((*steps.shape[:2], 1)), steps.cumsum(axis=2)], axis=2)


def _column_areas(points: Float) -> Float:
    """Area of each layer per column, (Nx, Ny, Nz), mm2; negative where the layer is turned over."""
    along_x, along_y = np.gradient(points, axis=(0, 1))
    across = points[:, :, -1:] - points[:, :, :1]
    area = (np.cross(along_x, along_y) * across).sum(axis=-1)
    area /= np.linalg.norm(across, axis=-1)
    return np.asarray(area * np.sign(np.nansum(area)))
