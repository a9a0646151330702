"""Segmentations as label volumes, with what a person corrected: labels, and the body's mask."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from hipsta_bids.errors import InputError, ProtocolError
from hipsta_bids.geometry.grid import in_plane_voxel
from hipsta_bids.inputs.scan import HemisphereInput
from hipsta_bids.io.volumes import read_voxels
from hipsta_bids.protocols.load import for_region, load_protocol, protocol_names
from hipsta_bids.protocols.protocol import OUTSIDE, Part, Protocol, Tissue, translate
from hipsta_bids.types import Bool, EditedMask, Float, LabelVolume

#: Kept around the hippocampal labels [mm], where the image extends that far.
MARGIN = 5.0

#: How far the affines of files that are combined may differ [mm, and 1 per voxel].
_SAME_GRID = 1e-3

#: Least share of edited labels that has to lie where the original labels are.
_SAME_PLACE = 0.5

#: A voxel belongs to a mask of another grid if this much of it does, by linear interpolation; a
#: little less than a half, so that rounding does not decide where borders coincide.
_HALF = 0.5 - 1e-6

#: How many values an error message lists.
_SHOWN = 5

_Box = tuple[slice, slice, slice]


def read_label_volume(item: HemisphereInput, region: str = "body") -> LabelVolume:
    """Read one hemisphere's segmentation.

    The volume is cropped to the hippocampal labels, and the cortical ones of the region, plus 5 mm
    on each side, as far as the image goes. The affine is the image's own, moved by the crop:
    scanner RAS for MGZ, sform before qform for NIfTI. A NIfTI without either has no known left and
    right, and is refused. Labels and mask that a person edited come from their own files, on any
    grid.

    Parameters
    ----------
    item : HemisphereInput
        Which files, and the protocol of their codes.
    region : str
        What is going to be measured (``body.region`` of the settings).

    Returns
    -------
    LabelVolume
        Tissues and parts per voxel, with the affine to RAS mm.

    Raises
    ------
    HipstaError
        ``item.problem``, if there is one.
    InputError
        ``unreadable-image``, ``not-3d``, ``bad-affine``, ``bad-voxel-size``,
        ``non-integer-labels``, ``empty-labels``, ``grid-mismatch``, or, of edited files,
        ``edited-elsewhere``, ``edited-mask-not-binary`` or ``edited-mask-empty``.
    ProtocolError
        ``unknown-labels`` or ``wrong-scheme``; ``no-cortex-labels`` if the protocol has none.
    """
    if item.problem is not None:
        raise item.problem
    sheet = for_region(item.protocol, region).sheet
    labels, mask = item.edit("labels"), item.edit("mask")
    path = labels.path if labels else item.files[0]
    data, affine = read_voxels(path)
    # A first crop in the type on disk saves memory; it is wide enough for the final one.
    box = _bounding_box(data != 0, affine, path)
    codes = _one_hemisphere(_integers(data[box], path), item, path)
    shape = data.shape
    del data
    tissue, part = _translate(codes, item.protocol, path)
    for other in item.files[1:]:
        more = _beside(other, path, shape, affine, edited=labels is not None)
        _, parts = _translate(
            _integers(more[box], other), item.parts_protocol or item.protocol, other
        )
        part = np.where(parts == Part.UNKNOWN, part, parts)
    part = np.where(tissue == Tissue.BACKGROUND, np.uint8(Part.UNKNOWN), part)
    hippocampal = ~np.isin(tissue, tuple(OUTSIDE.difference(sheet)))
    inner = _bounding_box(hippocampal, affine, path)
    start = np.array([a.start + b.start for a, b in zip(box, inner, strict=True)])
    cropped = affine.copy()
    cropped[:3, 3] += affine[:3, :3] @ start
    if labels:
        _check_same_place(hippocampal[inner], cropped, item, path)
    return LabelVolume(
        tissue=tissue[inner],
        part=part[inner],
        affine=cropped,
        protocol=item.protocol,
        edited_mask=(
            _sample_mask(*read_voxels(mask.path), cropped, tissue[inner].shape, mask.path)
            if mask
            else None
        ),
        start=(int(start[0]), int(start[1]), int(start[2])),
        file_shape=(int(shape[0]), int(shape[1]), int(shape[2])),
    )


def _beside(
    other: Path, path: Path, shape: tuple[int, ...], affine: Float, *, edited: bool
) -> NDArray[Any]:
    """Read a second file on the grid of the first, at nearest voxels if that one was edited."""
    data, own = read_voxels(other)
    if data.shape == shape and np.allclose(own, affine, rtol=0, atol=_SAME_GRID):
        return data
    if edited:
        to_own = np.linalg.inv(own) @ affine
        sampled: NDArray[Any] = ndimage.affine_transform(
            _integers(data, other), to_own[:3, :3], to_own[:3, 3], output_shape=shape, order=0
        )
        return sampled
    raise InputError(
        f"{other}: its grid differs from that of {path.name}, with which it is combined; "
        "use files of the same run",
        reason="grid-mismatch",
    )


def _check_same_place(hippocampal: Bool, affine: Float, item: HemisphereInput, path: Path) -> None:
    """Refuse edited labels that lie elsewhere than those which they correct."""
    original = item.files[0]
    try:
        data, own = read_voxels(original)
        box = _bounding_box(data != 0, own, original)
    except InputError:  # that may be why a person made others
        return
    to_own = np.linalg.inv(own) @ affine
    index = np.argwhere(hippocampal) @ to_own[:3, :3].T + to_own[:3, 3]
    low, high = ([getattr(side, name) for side in box] for name in ("start", "stop"))
    share = float(((index >= low) & (index < high)).all(axis=1).mean())
    if share < _SAME_PLACE:
        raise InputError(
            f"{path}: {1 - share:.0%} of the edited labels lie elsewhere than those of "
            f"{original.name}; keep the orientation and position of the image that was edited",
            reason="edited-elsewhere",
        )


def label_values(path: Path) -> frozenset[int]:
    """List the distinct codes of a segmentation, without the background."""
    data, _ = read_voxels(path)
    values = np.unique(_integers(data[data != 0], path))
    if not values.size:
        raise _empty(path)
    return frozenset(values.tolist())


def _empty(path: Path) -> InputError:
    return InputError(
        f"{path}: all labels are zero; check that the segmentation finished",
        reason="empty-labels",
    )


def _bounding_box(inside: Bool, affine: Float, path: Path) -> _Box:
    """Bounding box of all true voxels, with the margin as far as the image goes."""
    if not inside.any():
        raise _empty(path)
    # Each axis is projected on its own; ranges of indices are all that is kept.
    hits = [np.flatnonzero(inside.any(axis=axes)) for axes in ((1, 2), (0, 2), (0, 1))]
    # Headers keep single precision: 0.4999999 mm voxels are 0.5 mm voxels.
    extra = np.ceil(MARGIN / np.linalg.norm(affine[:3, :3], axis=0) - 1e-4).astype(int)
    first, second, third = (
        slice(max(int(hit[0] - pad), 0), min(int(hit[-1] + pad) + 1, size))
        for hit, pad, size in zip(hits, extra, inside.shape, strict=True)
    )
    return first, second, third


def _integers(data: NDArray[Any], path: Path) -> NDArray[np.integer[Any]]:
    """Convert labels to integers, if they are whole numbers."""
    if np.issubdtype(data.dtype, np.integer):
        return data
    whole = np.issubdtype(data.dtype, np.floating) and bool(
        (
            np.isfinite(data) & (data == np.rint(data)) & (np.abs(data) < np.iinfo(np.int32).max)
        ).all()
    )
    if not whole:
        raise InputError(
            f"{path}: labels are not whole numbers; was it resampled with interpolation? "
            "Use nearest neighbor",
            reason="non-integer-labels",
        )
    return data.astype(np.int32)


def _one_hemisphere(
    codes: NDArray[np.integer[Any]], item: HemisphereInput, path: Path
) -> NDArray[np.integer[Any]]:
    """Keep one hemisphere's labels of a file that carries both, without the offset."""
    if not item.bilateral:
        return codes
    offset = item.protocol.offset
    own = codes > offset if item.code_offset else (codes > 0) & (codes < offset)
    if not own.any():
        raise InputError(
            f"{path}: no labels of hemisphere {item.hemi} in this file of both hemispheres",
            reason="empty-labels",
        )
    return np.where(own, codes - np.asarray(item.code_offset, codes.dtype), 0)


def _translate(
    codes: NDArray[np.integer[Any]], protocol: Protocol, path: Path
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Translate codes; on failure name the file and the protocols that would fit."""
    try:
        return translate(codes, protocol)
    except ProtocolError as error:
        values = frozenset(np.unique(codes[codes != 0]).tolist())
        fitting = [name for name in protocol_names() if load_protocol(name).fits(values)]
        hint = f"; the labels fit {' and '.join(fitting)}" if fitting else ""
        raise ProtocolError(f"{path}: {error}{hint}", reason=error.reason) from error


def _sample_mask(
    data: NDArray[Any], own: Float, affine: Float, shape: tuple[int, ...], path: Path
) -> EditedMask:
    """Bring an edited mask from its own affine to the grid of the labels."""
    values = np.unique(data)
    shown = ", ".join(f"{value:g}" for value in values[:_SHOWN].tolist())
    shown += ", ..." if len(values) > _SHOWN else ""
    if len(values) > 2 or not np.isfinite(values).all() or (len(values) == 2 and 0 not in values):  # noqa: PLR2004 (two)
        raise InputError(
            f"{path}: a mask has the value 0 and one other, this has {shown}; save edited "
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
