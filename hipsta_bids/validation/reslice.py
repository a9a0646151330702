"""Labels as a scanner with thick slices would give them."""

import numpy as np
from scipy.spatial.transform import Rotation

from hipsta_bids.artifacts import Float, LabelVolume


def reslice(
    volume: LabelVolume,
    axis: Float,
    voxel_size: tuple[float, float, float],
    *,
    offset: float = 0.0,
    tilt: float = 0.0,
) -> LabelVolume:
    """Take the labels at the centers of the voxels of another grid.

    Parameters
    ----------
    volume : LabelVolume
    axis : (3,) array
        Unit vector across the slices, RAS.
    voxel_size : tuple of float
        Pixel, pixel, distance of slices, mm.
    offset : float
        Shift along the slices' normal as a fraction of their distance.
    tilt : float
        Degrees by which the slices miss the perpendicular to ``axis``.

    Returns
    -------
    LabelVolume
        Covers the whole volume; background beyond it.
    """
    aside = np.cross(axis, [0.0, 0.0, 1.0])
    aside /= np.linalg.norm(aside)
    turn = Rotation.from_euler("x", tilt, degrees=True).as_matrix()
    matrix = np.column_stack([aside, np.cross(axis, aside), axis]) @ turn * np.array(voxel_size)
    size = np.array(volume.tissue.shape) - 1
    corners = np.array(np.meshgrid(*([0, n] for n in size))).reshape(3, -1)
    corners = volume.affine[:3, :3] @ corners + volume.affine[:3, 3:]
    middle = corners.mean(axis=1)
    reach = np.linalg.solve(matrix, corners - middle[:, None])
    low = np.floor(reach.min(axis=1)) - 1
    shape = (np.ceil(reach.max(axis=1)) + 2 - low).astype(int)
    affine = np.eye(4)
    affine[:3, :3] = matrix
    affine[:3, 3] = middle + matrix @ (low + np.array([0.0, 0.0, offset]))
    to_volume = np.linalg.inv(volume.affine) @ affine
    index = np.indices(shape).reshape(3, -1)
    nearest = np.rint(to_volume[:3, :3] @ index + to_volume[:3, 3:]).astype(int)
    inside = ((nearest >= 0) & (nearest <= size[:, None])).all(axis=0)
    tissue, part = (np.zeros(index.shape[1], dtype=np.uint8) for _ in range(2))
    tissue[inside] = volume.tissue[tuple(nearest[:, inside])]
    part[inside] = volume.part[tuple(nearest[:, inside])]
    return LabelVolume(
        tissue=tissue.reshape(shape), part=part.reshape(shape), affine=affine, scheme=volume.scheme
    )
