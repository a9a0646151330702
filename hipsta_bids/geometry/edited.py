"""A body mask that a person corrected takes the place of the labels' own."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from hipsta_bids.artifacts import EditedMask, Flag, LabelVolume
from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.ends import EndPlanes
from hipsta_bids.settings import BodySettings


@dataclass(frozen=True, kw_only=True)
class MaskChange:
    """What an edited mask changed of the body, in voxels."""

    before: int
    """Voxels of the body as labeled."""
    added: int
    removed: int

    @property
    def share(self) -> float:
        """Changed voxels over those of the body as labeled."""
        return (self.added + self.removed) / max(self.before, 1)


def apply_mask(
    volume: LabelVolume, tissue: NDArray[np.uint8], mask: EditedMask, ends: EndPlanes
) -> tuple[LabelVolume, NDArray[np.uint8], MaskChange]:
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
    change : MaskChange

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
    change = MaskChange(
        before=int(np.count_nonzero(old)),
        added=int(np.count_nonzero(bare)),
        removed=int(np.count_nonzero((old > 0) & ~inside)),
    )
    return replace(volume, tissue=labels), edited, change


def check_mask(
    mask: EditedMask, change: MaskChange, voxel: float, settings: BodySettings
) -> list[Flag]:
    """Flag an edited mask that is coarser than the labels, or differs very much from them.

    Parameters
    ----------
    mask : EditedMask
    change : MaskChange
    voxel : float
        Edge of the labels' voxels in plane, mm.
    settings : BodySettings

    Returns
    -------
    list of Flag
        Empty if the mask is as it should be.
    """
    flags = []
    if mask.voxel > settings.max_mask_ratio * voxel:
        coarse = (
            f"the edited mask has voxels of {mask.voxel:.2f} mm, the labels of {voxel:.2f} mm: "
            "draw it on the grid of the labels"
        )
        flags.append(Flag(reason="edited-mask-coarse", message=coarse))
    if change.share > settings.max_mask_change:
        different = (
            f"the edited mask adds {change.added} voxels to the body and removes {change.removed} "
            f"of {change.before}: check that it is in the space of the labels"
        )
        flags.append(Flag(reason="edited-mask-different", message=different))
    return flags
