"""The voxel grid that a phantom is drawn on."""

from dataclasses import dataclass

import numpy as np

from hipsta_bids.artifacts import Float
from hipsta_bids.errors import SettingsError
from hipsta_bids.phantom.body import check_rotation


@dataclass(frozen=True, eq=False, kw_only=True)
class Grid:
    """A voxel grid: number of voxels and the affine from index to RAS mm."""

    shape: tuple[int, int, int]
    affine: Float


def make_grid(
    points: Float,
    *,
    voxel_size: tuple[float, float, float],
    axes: str,
    rotation: Float | None,
    border: float,
) -> Grid:
    """Lay a grid round points.

    The lattice is fixed in space (a voxel center lies at the origin of RAS), so that moving the
    phantom by part of a voxel changes its voxels.

    Parameters
    ----------
    points : (N, 3) array
        RAS mm, to be covered.
    voxel_size : tuple of float
        mm along the three voxel axes.
    axes : str
        Where the voxel axes point, such as ``RAS`` or ``LIA``.
    rotation : (3, 3) array, optional
        Turns the grid, for oblique slices.
    border : float
        mm of background to add on every side.

    Raises
    ------
    SettingsError
        If the axes, the voxel size or the rotation make no sense.
    """
    if not all(size > 0.0 for size in voxel_size):
        raise SettingsError(
            f"phantom: voxel size {voxel_size} must be positive", reason="phantom-setting"
        )
    directions = _axis_directions(axes)
    if rotation is not None:
        rotation = np.asarray(rotation, dtype=np.float64)
        check_rotation(rotation)
        directions = rotation @ directions
    matrix = directions * np.asarray(voxel_size)
    index = points @ np.linalg.inv(matrix).T
    pad = border / np.asarray(voxel_size)
    low = np.floor(index.min(axis=0) - pad)
    count = (np.ceil(index.max(axis=0) + pad) - low).astype(int) + 1
    affine = np.eye(4)
    affine[:3, :3] = matrix
    affine[:3, 3] = matrix @ low
    return Grid(shape=(int(count[0]), int(count[1]), int(count[2])), affine=affine)


def _axis_directions(axes: str) -> Float:
    """Matrix (3, 3) whose columns are the unit directions of the voxel axes in RAS."""
    names = {"R": 0, "L": 0, "A": 1, "P": 1, "S": 2, "I": 2}
    if sorted(names.get(letter, -1) for letter in axes) != [0, 1, 2]:
        raise SettingsError(
            f"phantom: axes {axes!r} must name each direction once, such as RAS or LIA",
            reason="phantom-setting",
        )
    directions = np.zeros((3, 3))
    for column, letter in enumerate(axes):
        directions[names[letter], column] = 1.0 if letter in "RAS" else -1.0
    return directions
