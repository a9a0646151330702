"""Images: label volumes, masks and maps, opened for reading here only."""

import contextlib
import gzip
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nibabel as nib
import numpy as np
from nibabel.filebasedimages import ImageFileError
from nibabel.openers import ImageOpener
from nibabel.spatialimages import HeaderDataError
from nibabel.wrapstruct import WrapStructError
from numpy.typing import NDArray

from hipsta_bids.errors import InputError
from hipsta_bids.geometry.sampling import ScalarVolume
from hipsta_bids.types import BodyMask, Float

#: Voxel edges [mm] of segmentations outside of this range are taken for a wrong header ...
VOXEL_SIZES = (0.05, 5.0)

#: ... and of other images, such as those of PET.
MAP_VOXEL_SIZES = (0.05, 30.0)

#: All that nibabel and its decompressors raise on damaged files.
_READ_ERRORS = (
    OSError,
    EOFError,
    ValueError,
    KeyError,
    OverflowError,
    zlib.error,
    ImageFileError,
    HeaderDataError,
    WrapStructError,
)

_SPACE = 3


def read_voxels(path: Path) -> tuple[NDArray[Any], Float]:
    """Read a 3-D image of labels or a mask, and its affine from voxel index to RAS mm."""
    with _opened(path) as image:
        data = np.asanyarray(image.dataobj)
        affine = np.asarray(image.affine, dtype=np.float64)
    while data.ndim > _SPACE and data.shape[-1] == 1:
        data = data[..., 0]
    if data.ndim != _SPACE:
        raise InputError(
            f"{path}: has shape {' x '.join(map(str, data.shape))}, but labels are one 3-D volume; "
            "extract the volume",
            reason="not-3d",
        )
    _check_affine(image, affine, path, VOXEL_SIZES)
    return data, affine


def read_scalars(path: Path, points: Float) -> ScalarVolume:
    """Read the part of an image around some points, (..., 3) RAS mm."""
    with _opened(path) as image:
        _check_scalar(image, path)
        affine: Float = np.asarray(image.affine, dtype=np.float64)
        _check_affine(image, affine, path, MAP_VOXEL_SIZES)
        shape = tuple(int(n) for n in image.shape)
        box = _box(affine, points, shape)
        data = np.asarray(image.dataobj[tuple(slice(a, b) for a, b in box)], dtype=np.float64)
    start = np.array([a for a, _ in box])
    affine[:3, 3] += affine[:3, :3] @ start
    return ScalarVolume(
        values=data.reshape(*data.shape[:_SPACE], -1),
        affine=affine,
        start=(int(start[0]), int(start[1]), int(start[2])),
        shape=(shape[0], shape[1], shape[2]),
    )


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open an image for as long as its voxels are read; errors meanwhile name the file."""
    try:
        # nibabel leaves files open on some of its paths; a stream that is closed here is not.
        with ImageOpener(str(path)) as stream:
            kind = _format(path, stream.read(4))
            stream.seek(0)
            # Mapped files would break under the reader if someone replaced them.
            yield kind.from_file_map(kind.make_file_map({"image": stream}), mmap=False)
    except _READ_ERRORS as error:
        message = " ".join(str(error).split()) or type(error).__name__
        raise InputError(
            f"{path}: cannot be read as an image ({message}); copy or make the file again",
            reason="unreadable-image",
        ) from error


def _format(path: Path, start: bytes) -> type[Any]:
    """Choose the format by the file's name and, between the versions of NIfTI, its first bytes."""
    if path.suffix in {".mgz", ".mgh"}:
        return nib.MGHImage
    # NIfTI begins with the size of its header, which tells the versions apart.
    sizes = {int.from_bytes(start, order) for order in ("little", "big")}
    newer = nib.Nifti2Header.template_dtype.itemsize in sizes
    return nib.Nifti2Image if newer else nib.Nifti1Image


def _check_scalar(image: Any, path: Path) -> None:  # noqa: ANN401 (nibabel's classes are untyped)
    """Refuse voxels that are not one real number each, or a row of them."""
    kind = image.get_data_dtype()
    if kind.kind not in "iufb":
        what = "complex numbers" if kind.kind == "c" else "colors"
        raise InputError(
            f"{path}: its voxels are {what}, a map needs one number each; "
            "extract the magnitude or one channel",
            reason="not-scalar",
        )
    shape = list(image.shape)
    while len(shape) > _SPACE and shape[-1] == 1:
        shape.pop()
    if not _SPACE <= len(shape) <= _SPACE + 1:
        raise InputError(
            f"{path}: has shape {' x '.join(map(str, shape))}; a map has three axes, or four with "
            "one volume per column: extract what is meant",
            reason="too-many-axes",
        )
    if 0 in shape:
        raise InputError(f"{path}: has no voxels; make the file again", reason="empty-image")


def _box(affine: Float, points: Float, shape: tuple[int, ...]) -> list[tuple[int, int]]:
    """Range of voxels along each axis that interpolation at the points can reach."""
    finite = points[np.isfinite(points).all(axis=-1)]
    to_index = np.linalg.inv(affine)
    index = finite @ to_index[:3, :3].T + to_index[:3, 3]
    if not len(index):
        return [(0, 1)] * _SPACE
    # One voxel more than needed on either side; at least one voxel where all points lie outside.
    low = np.clip(np.floor(index.min(axis=0)) - 1, 0, np.array(shape[:_SPACE]) - 1).astype(int)
    high = np.clip(np.ceil(index.max(axis=0)) + 2, low + 1, shape[:_SPACE]).astype(int)
    return list(zip(low.tolist(), high.tolist(), strict=True))


def _check_affine(
    image: Any,  # noqa: ANN401 (nibabel's classes are untyped)
    affine: Float,
    path: Path,
    limits: tuple[float, float],
) -> None:
    linear = affine[:3, :3]
    no_orientation = isinstance(image, nib.Nifti1Pair) and not (
        int(image.header["sform_code"]) or int(image.header["qform_code"])
    )
    if no_orientation:
        raise InputError(
            f"{path}: the header has neither an sform nor a qform, so left and right are unknown; "
            "copy the orientation from the image that was segmented",
            reason="bad-affine",
        )
    if not np.isfinite(affine).all():
        raise InputError(
            f"{path}: the affine contains NaN or infinity; repair the header",
            reason="bad-affine",
        )
    sizes = np.linalg.norm(linear, axis=0)
    volume = abs(np.linalg.det(linear))
    # Relative, so that small voxels are not mistaken for flat ones.
    if volume <= 1e-6 * np.prod(sizes):
        raise InputError(
            f"{path}: the affine is singular (its axes lie in one plane); repair the header",
            reason="bad-affine",
        )
    if sizes.min() < limits[0] or sizes.max() > limits[1]:
        raise InputError(
            f"{path}: voxels of {' x '.join(f'{size:.3g}' for size in sizes)} mm are outside of "
            f"{limits[0]} to {limits[1]} mm; check the header's units",
            reason="bad-voxel-size",
        )


def mask_bytes(mask: BodyMask) -> bytes:
    """Encode a mask as a compressed NIfTI image."""
    image: Any = nib.Nifti1Image(mask.inside.astype(np.uint8), mask.affine)
    image.set_sform(mask.affine, code=1)
    # Some viewers read the qform only.
    image.set_qform(mask.affine, code=1)
    image.header.set_xyzt_units("mm")
    return gzip.compress(image.to_bytes(), compresslevel=6, mtime=0)
