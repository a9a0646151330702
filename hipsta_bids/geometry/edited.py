"""A body mask that a person corrected takes the place of the labels' own."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from hipsta_bids.artifacts import EditedMask, Flag, LabelVolume
from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.ends import EndPlanes
from hipsta_bids.settings import BodySettings


def apply_mask(
    volume: LabelVolume, tissue: NDArray[np.uint8], mask: EditedMask, ends: EndPlanes
) -> tuple[LabelVolume, NDArray[np.uint8]]:
    """Make the body between its end planes what an edited mask says it is.

    Voxels outside of the mask lose their label, and voxels of the mask without a sheet label get
    that of the nearest voxel of the mask that has one. Beyond the end planes nothing changes: head
    and tail are those of the labels.

    Parameters
    ----------
    volume : LabelVolume
    tissue : (I, J, K) uint8
        Its sheet tissue; 0 elsewhere.
    mask : EditedMask
    ends : EndPlanes

    Returns
    -------
    volume : LabelVolume
        What the labels would be, had they been corrected themselves.
    tissue : (I, J, K) uint8
        Its sheet tissue.

    Raises
    ------
    GeometryError
        ``edited-mask-elsewhere`` if no labeled voxel of the body lies in the mask.
    """
    affine = volume.affine
    index = np.argwhere(mask.inside | (tissue > 0))
    points = index @ affine[:3, :3].T + affine[:3, 3]
    between = (ends.height(points, "posterior") > 0) & (ends.height(points, "anterior") < 0)
    index, points = index[between], points[between]
    old, inside = tissue[tuple(index.T)], mask.inside[tuple(index.T)]
    kept = inside & (old > 0)
    if not kept.any():
        raise GeometryError(
            "the edited mask and the sheet's labels have no voxel in common between the end "
            "planes: check that the mask is of this hemisphere and in the space of the labels",
            reason="edited-mask-elsewhere",
        )
    new = np.where(kept, old, np.uint8(0))
    bare = inside & (old == 0)
    if bare.any():
        _, nearest = cKDTree(points[kept]).query(points[bare])
        new[bare] = old[kept][nearest]
    edited = tissue.copy()
    edited[tuple(index.T)] = new
    labels = np.where(edited == tissue, volume.tissue, edited)
    return replace(volume, tissue=labels), edited


def check_mask(mask: EditedMask | None, voxel: float, settings: BodySettings) -> list[Flag]:
    """Flag an edited mask that is coarser than the labels.

    Parameters
    ----------
    mask : EditedMask or None
    voxel : float
        Edge of the labels' voxels in plane, mm.
    settings : BodySettings

    Returns
    -------
    list of Flag
        Empty if there is no mask, or it is fine enough.
    """
    if mask is None or mask.voxel <= settings.max_mask_ratio * voxel:
        return []
    message = (
        f"the edited mask has voxels of {mask.voxel:.2f} mm, the labels of {voxel:.2f} mm: draw it "
        "on the grid of the labels"
    )
    return [Flag(reason="edited-mask-coarse", message=message)]
