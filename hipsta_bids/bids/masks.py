"""Body masks: what a person corrected, brought to the grid of the labels, and what is written."""

import gzip
from pathlib import Path
from typing import Any

import nibabel as nib
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from hipsta_bids.artifacts import BodyMask, Bool, EditedMask, Float
from hipsta_bids.errors import InputError
from hipsta_bids.geometry.grid import in_plane_voxel

#: A voxel belongs to a mask of another grid if this much of it does, by linear interpolation; a
#: little less than a half, so that rounding does not decide where borders coincide.
_HALF = 0.5 - 1e-6


def sample_mask(
    data: NDArray[Any], own: Float, affine: Float, shape: tuple[int, ...], path: Path
) -> EditedMask:
    """Bring an edited mask to the grid of the labels.

    Parameters
    ----------
    data : (L, M, N) array
        Of zeros and one other value.
    own, affine : (4, 4) float64
        Of the mask and of the labels, voxel index to RAS mm.
    shape : tuple of int
        Of the labels.
    path : Path
        For messages.

    Returns
    -------
    EditedMask

    Raises
    ------
    InputError
        ``edited-mask-not-binary`` or ``edited-mask-empty``.
    """
    values = np.unique(data)
    if len(values) > 2 or not np.isfinite(values).all() or (len(values) == 2 and 0 not in values):  # noqa: PLR2004 (two)
        raise InputError(
            f"{path}: a mask has the value 0 and one other, this has {_some(values)}; save edited "
            "labels as desc-edited_dseg instead",
            reason="edited-mask-not-binary",
        )
    if not values.any():
        raise InputError(
            f"{path}: the edited mask is empty; delete it, or save it again",
            reason="edited-mask-empty",
        )
    inside = data != 0
    index = np.argwhere(inside)
    # A border of zeros, so that interpolation ends beside the mask.
    low = index.min(axis=0) - 1
    size = index.max(axis=0) + 2 - low
    crop = np.zeros(size, dtype=np.float32)
    crop[tuple((index - low).T)] = 1
    to_mask = np.linalg.inv(own) @ affine
    sampled = ndimage.affine_transform(
        crop, to_mask[:3, :3], to_mask[:3, 3] - low, output_shape=shape, order=1, mode="constant"
    )
    return EditedMask(inside=sampled >= _HALF, voxel=in_plane_voxel(own))


def sample_nearest(
    data: NDArray[Any], own: Float, affine: Float, shape: tuple[int, ...]
) -> NDArray[Any]:
    """Take labels at the nearest voxels of another grid; 0 outside of it.

    Parameters
    ----------
    data : (L, M, N) array
    own, affine : (4, 4) float64
        Of the labels, and of the grid that is wanted, voxel index to RAS mm.
    shape : tuple of int
        Of the grid that is wanted.

    Returns
    -------
    array of that shape
    """
    to_own = np.linalg.inv(own) @ affine
    sampled: NDArray[Any] = ndimage.affine_transform(
        data, to_own[:3, :3], to_own[:3, 3], output_shape=shape, order=0, mode="constant"
    )
    return sampled


def within(mask: Bool, affine: Float, box: tuple[slice, ...], own: Float) -> float:
    """Tell which share of a mask lies in a box of another grid.

    Parameters
    ----------
    mask : (I, J, K) bool
    affine, own : (4, 4) float64
        Of the mask, and of the grid of the box, voxel index to RAS mm.
    box : tuple of slice
        Range of indices along each axis.

    Returns
    -------
    float
        0 for an empty mask.
    """
    to_own = np.linalg.inv(own) @ affine
    index = np.argwhere(mask) @ to_own[:3, :3].T + to_own[:3, 3]
    low, high = ([getattr(side, name) for side in box] for name in ("start", "stop"))
    return float(((index >= low) & (index < high)).all(axis=1).mean()) if len(index) else 0.0


def mask_bytes(mask: BodyMask) -> bytes:
    """Encode a mask as a compressed NIfTI image.

    Parameters
    ----------
    mask : BodyMask

    Returns
    -------
    bytes
        The same for the same mask: without a time stamp.
    """
    image: Any = nib.Nifti1Image(mask.inside.astype(np.uint8), mask.affine)
    image.set_sform(mask.affine, code=1)
    # Some viewers read the qform only.
    image.set_qform(mask.affine, code=1)
    image.header.set_xyzt_units("mm")
    return gzip.compress(image.to_bytes(), compresslevel=6, mtime=0)


def _some(values: NDArray[Any]) -> str:
    more = ", ..." if len(values) > 5 else ""  # noqa: PLR2004 (enough to recognize them)
    return ", ".join(f"{value:g}" for value in values[:5].tolist()) + more
