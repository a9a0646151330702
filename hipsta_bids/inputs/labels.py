"""Segmentations as label volumes, with what a person corrected: labels, and the body's mask."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from hipsta_bids.errors import InputError, ProtocolError
from hipsta_bids.geometry.grid import in_plane_voxel
from hipsta_bids.inputs.scan import HemisphereInput
from hipsta_bids.inputs.shares import read_shares
from hipsta_bids.io.volumes import LabelImage, box_with_margin, label_codes, moved, read_labels
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

#: Labels may be off a whole number by this much: scaled integers and floats are rounded.
_ROUNDING = 1e-3

#: How many values an error message lists.
_LISTED_VALUES = 5


def read_label_volume(item: HemisphereInput, region: str = "body") -> LabelVolume:
    """Read one hemisphere's segmentation.

    The volume is cropped to the hippocampal labels, and the cortical ones of the region, plus 5 mm
    on each side, as far as the image extends; with the shares of voxels, if it has probabilities.
    The affine of the image is moved by the crop:
    scanner RAS for MGZ, sform before qform for NIfTI. A NIfTI without either has no known left and
    right, and is refused. Labels and masks edited by hand are separate files, on any grid.

    Parameters
    ----------
    item : HemisphereInput
        Which files, and the protocol of their codes.
    region : str
        The region to measure (``body.region`` of the settings).

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
        ``edited-elsewhere``, ``edited-mask-not-binary`` or ``edited-mask-empty``; of
        probabilities, ``bad-probabilities``.
    ProtocolError
        ``unknown-labels`` or ``wrong-scheme``; ``no-cortex-labels`` if the protocol has none.
    """
    if item.problem is not None:
        raise item.problem
    labels, mask = item.edit("labels"), item.edit("mask")
    path = labels.path if labels else item.files[0]
    image = read_labels(path, MARGIN)
    if not image.data.size:
        raise _empty(path)
    codes = _integers(image.data, path, has_nan=image.has_nan)
    if item.bilateral:
        codes = _one_hemisphere(codes, item.protocol, item.hemi, path)
    tissue, part = _translate(codes, item.protocol, path)
    for added_path in item.files[1:]:
        added_image = _added_labels(added_path, path, image, edited=labels is not None)
        _, parts = _translate(
            _integers(added_image, added_path), item.parts_protocol or item.protocol, added_path
        )
        part = np.where(parts == Part.UNKNOWN, part, parts)
    volume = _cropped(tissue, part, image, item.protocol, region=region, path=path)
    if labels:
        needed = _wanted(volume.tissue, item.protocol, region)
        _check_same_place(needed, volume.affine, item, path)
    if item.probabilities:
        volume = read_shares(volume, item.probabilities, edited=labels is not None)
    if mask is None and not item.ends:
        return volume
    edited, notes = None, volume.notes
    if mask:
        around = read_labels(mask.path, 1.0)
        edited = _sample_mask(around, volume.affine, volume.tissue.shape, mask.path)
        notes += _notes(around, mask.path)
    return replace(volume, edited_mask=edited, given_ends=item.ends, notes=notes)


def label_volume(
    image: LabelImage,
    protocol: Protocol,
    hemi: str,
    region: str = "body",
    *,
    path: Path = Path("the labels"),
) -> LabelVolume:
    """Translate and crop an image, as :func:`read_label_volume` does a hemisphere of a dataset.

    Where codes of the side that the protocol shifts occur, the other side is excluded. ``path`` is
    what messages call the image.
    """
    whole = _integers(image.data, path, has_nan=image.has_nan)
    if protocol.offset and (whole > protocol.offset).any():
        whole = _one_hemisphere(whole, protocol, hemi, path)
    tissue, part = _translate(whole, protocol, path)
    return _cropped(tissue, part, image, protocol, region=region, path=path)


def _wanted(tissue: NDArray[np.uint8], protocol: Protocol, region: str) -> Bool:
    """Mark the hippocampal labels, and the cortical ones of the region."""
    sheet = for_region(protocol, region).sheet
    return np.asarray(~np.isin(tissue, tuple(OUTSIDE.difference(sheet))))


def _cropped(
    tissue: NDArray[np.uint8],
    part: NDArray[np.uint8],
    image: LabelImage,
    protocol: Protocol,
    *,
    region: str,
    path: Path,
) -> LabelVolume:
    """Crop what was translated to the labels that are wanted, and a margin."""
    part = np.where(tissue == Tissue.BACKGROUND, np.uint8(Part.UNKNOWN), part)
    needed = _wanted(tissue, protocol, region)
    if not needed.any():
        raise _empty(path)
    hits = [np.asarray(needed.any(axis=axes)) for axes in ((1, 2), (0, 2), (0, 1))]
    inner = box_with_margin(hits, MARGIN, image.affine)
    first, second, third = (a + b.start for a, b in zip(image.start, inner, strict=True))
    return LabelVolume(
        tissue=tissue[inner],
        part=part[inner],
        affine=moved(image.affine, (first, second, third)),
        protocol=protocol,
        start=(first, second, third),
        file_shape=image.shape,
        notes=_notes(image, path),
    )


def _notes(image: LabelImage, path: Path) -> tuple[str, ...]:
    """Write what is doubtful about an image, with its name."""
    nan = ("NaN was read as background (0)",) if image.has_nan else ()
    return tuple(f"{path.name}: {note}" for note in (*image.notes, *nan))


def _added_labels(added_path: Path, path: Path, image: LabelImage, *, edited: bool) -> NDArray[Any]:
    """Read a second file where the first has labels, at nearest voxels if that one was edited."""
    added = read_labels(added_path, part=image.box)
    if added.shape == image.shape and np.allclose(
        added.affine, image.affine, rtol=0, atol=_SAME_GRID
    ):
        return added.data
    if edited:
        added_image = read_labels(added_path, MARGIN)
        to_file = np.linalg.inv(added_image.file_affine) @ image.file_affine
        sampled: NDArray[Any] = ndimage.affine_transform(
            _integers(added_image.data, added_path),
            to_file[:3, :3],
            to_file[:3, 3],
            output_shape=image.data.shape,
            order=0,
        )
        return sampled
    raise InputError(
        f"{added_path}: its grid is not the grid of {path.name}, with which it is combined; "
        "use files of one run",
        reason="grid-mismatch",
    )


def _check_same_place(hippocampal: Bool, affine: Float, item: HemisphereInput, path: Path) -> None:
    """Refuse edited labels that lie elsewhere than those which they correct."""
    original = item.files[0]
    try:
        image = read_labels(original, MARGIN)
    except InputError:  # that may be why a person made others
        return
    to_file = np.linalg.inv(image.file_affine) @ affine
    index = np.argwhere(hippocampal) @ to_file[:3, :3].T + to_file[:3, 3]
    share = float(((index >= 0) & (index < image.data.shape)).all(axis=1).mean())
    if image.data.size and share < _SAME_PLACE:
        raise InputError(
            f"{path}: {1 - share:.0%} of the edited labels lie outside the labels of "
            f"{original.name}; keep the image's position",
            reason="edited-elsewhere",
        )


def label_values(path: Path) -> frozenset[int]:
    """List the distinct codes of a segmentation, without the background."""
    codes = np.array(label_codes(path))
    values = _integers(codes[~np.isnan(codes)], path, has_nan=bool(np.isnan(codes).any()))
    if not values.size:
        raise _empty(path)
    return frozenset(values.tolist())


def _empty(path: Path) -> InputError:
    return InputError(
        f"{path}: all labels are zero; check that the segmentation finished", reason="empty-labels"
    )


def _integers(data: NDArray[Any], path: Path, *, has_nan: bool = False) -> NDArray[np.integer[Any]]:
    """Convert labels to integers, if they are whole numbers but for rounding."""
    if np.issubdtype(data.dtype, np.integer):
        return data
    whole = np.issubdtype(data.dtype, np.floating) and bool(
        (np.isfinite(data) & (np.abs(data) < np.iinfo(np.int32).max)).all()
        and (np.abs(data - np.rint(data)) < _ROUNDING).all()
    )
    if not whole:
        nan = ", and some are NaN" if has_nan else ""
        raise InputError(
            f"{path}: labels are not whole numbers{nan}; was it resampled with interpolation? "
            "Use nearest neighbor",
            reason="non-integer-labels",
        )
    rounded: NDArray[np.integer[Any]] = np.rint(data).astype(np.int32)
    return rounded


def _one_hemisphere(
    codes: NDArray[np.integer[Any]], protocol: Protocol, hemi: str, path: Path
) -> NDArray[np.integer[Any]]:
    """Keep one hemisphere's labels of a file that carries both, without the offset."""
    offset, shift = protocol.offset, protocol.shift(hemi)
    of_side = codes > offset if shift else (codes > 0) & (codes < offset)
    if not of_side.any():
        raise InputError(
            f"{path}: no labels of hemisphere {hemi} in this file of both hemispheres",
            reason="empty-labels",
        )
    return np.where(of_side, codes - np.asarray(shift, codes.dtype), 0)


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


def _sample_mask(mask: LabelImage, affine: Float, shape: tuple[int, ...], path: Path) -> EditedMask:
    """Bring an edited mask from its affine to the grid of the labels."""
    values = np.unique(mask.data)
    if mask.data.shape != mask.shape:  # around it everything is zero
        values = np.unique(np.append(values, 0))
    value_text = ", ".join(f"{value:g}" for value in values[:_LISTED_VALUES].tolist())
    value_text += ", ..." if len(values) > _LISTED_VALUES else ""
    if len(values) > 2 or (len(values) == 2 and 0 not in values):  # noqa: PLR2004 (two)
        raise InputError(
            f"{path}: a mask has the value 0 and one other, this has {value_text}; save edited "
            "labels as desc-edited_dseg instead",
            reason="edited-mask-not-binary",
        )
    if not values.any():
        raise InputError(
            f"{path}: the edited mask is empty; delete it, or save it again",
            reason="edited-mask-empty",
        )
    # A border of zeros, so that interpolation ends next to the mask.
    inside = np.pad((mask.data != 0).astype(np.float32), 1)
    to_mask = np.linalg.inv(mask.file_affine) @ affine
    sampled = ndimage.affine_transform(
        inside, to_mask[:3, :3], to_mask[:3, 3] + 1, output_shape=shape, order=1, mode="constant"
    )
    return EditedMask(inside=sampled >= _HALF, voxel=in_plane_voxel(mask.affine))
