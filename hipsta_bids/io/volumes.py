"""Images: label volumes, masks and maps, opened for reading here only."""

import contextlib
import math
import warnings
import zlib
from collections.abc import Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nibabel as nib
import numpy as np
from nibabel.filebasedimages import ImageFileError
from nibabel.freesurfer.mghformat import MGHError
from nibabel.openers import ImageOpener
from nibabel.spatialimages import HeaderDataError
from nibabel.wrapstruct import WrapStructError
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hipsta_bids.errors import InputError, MissingFileError
from hipsta_bids.geometry.digital import Box, box, to_ras
from hipsta_bids.opening import open_regular
from hipsta_bids.types import BodyMask, Float, ScalarVolume

#: Voxel edges [mm] of segmentations outside of this range are taken for a wrong header ...
VOXEL_SIZES = (0.05, 5.0)

#: ... and of other images, such as those of PET.
MAP_VOXEL_SIZES = (0.05, 30.0)

#: Difference between two statements of a voxel's edges in one header, as a share.
_SAME_SIZE = 0.01

#: Displacement of labels by the qform against the sform that a note names, mm, ...
_SAME_POSITION = 0.1

#: ... besides the rounding of quaternions, rad: up to 0.0013 where programs compute in single
#: precision, since a half turn loses half of the digits.
_ROUNDED_QFORM = 0.002

#: Units of headers that are not millimeters, in mm; and voxel edges that identify them, mm.
_UNITS = {"meters": 1000.0, "centimeters": 10.0, "micrometers": 0.001}
_USUAL_SIZES = (0.1, 4.0)

#: Those that NIfTI can state, by the code of ``xyzt_units``.
_STATED_UNITS = {1: "meters", 3: "micrometers"}

#: All that nibabel and its decompressors raise on damaged files.
_READ_ERRORS = (
    OSError,
    EOFError,
    ValueError,
    KeyError,
    TypeError,  # nibabel's, of an .mgz file without a byte
    OverflowError,
    MemoryError,
    zlib.error,
    ImageFileError,
    MGHError,
    HeaderDataError,
    WrapStructError,
)

_SPACE = 3

#: Most voxels of a label image, of one of its slices, and of the part of it that is not zero: a
#: header may declare anything. 1200 x 1200 x 900 voxels are read; what is read at once fits into
#: some 100 MB, the part with labels into 400 MB.
MOST_VOXELS, _MOST_IN_SLICE, MOST_LABELED = 4_000_000_000, 50_000_000, 100_000_000

#: Voxels that are read at once.
_SLAB = 8_000_000

#: Share of a process' memory that an image may need, be it one slice or the part with labels; the
#: rest is for libraries and for what comes later. A slab of slices takes a quarter of this share.
READ_SHARE = 0.5

#: Bytes per voxel that reading and translating labels takes in addition to the voxel: measured, 16
#: for integers of 1 and 4 bytes, 20 for floats of 4.
_EXTRA_BYTES = 20

#: The same of a map: its values in double precision.
_EXTRA_BYTES_MAP = 8

_memory: ContextVar[float] = ContextVar("memory", default=math.inf)


def limit_memory(gigabytes: float | None) -> None:
    """Set the memory (GB) that this process may use from here on; ``None`` is no limit."""
    _memory.set(math.inf if gigabytes is None else 1e9 * gigabytes)


def _check_fits(
    image: Any,  # noqa: ANN401 (untyped)
    path: Path,
    voxels: int,
    content: str,
    *,
    extra_bytes: int = _EXTRA_BYTES,
    remedy: str = "crop it to the hippocampus",
) -> None:
    """Refuse to read so many voxels at once if they need more than their share of memory."""
    need, share = voxels * _voxel_bytes(image, extra_bytes), READ_SHARE * _memory.get()
    if need > share:
        raise InputError(
            f"{path}: {content} ({voxels / 1e6:.1f} million voxels) needs {need / 1e6:.0f} "
            f"of {share / 1e6:.0f} MB; raise --mem, lower --n-procs, or {remedy}",
            reason="image-too-large",
        )


def _voxel_bytes(image: Any, extra_bytes: int) -> int:  # noqa: ANN401 (untyped)
    """Bytes of memory that reading takes per voxel; scaled numbers become double precision."""
    kind = image.get_data_dtype().itemsize
    scaled = (image.dataobj.slope, image.dataobj.inter) != (1, 0)
    return extra_bytes + (max(kind, 8) if scaled else int(kind))


@dataclass(frozen=True, eq=False)
class LabelImage:
    """The part of a 3-D image of labels, or of a mask, in which not all voxels are zero."""

    data: NDArray[Any]
    """(I, J, K); empty if all voxels are zero."""
    start: tuple[int, int, int]
    """Where it begins in the whole image."""
    shape: tuple[int, int, int]
    """Of the whole image."""
    affine: Float
    """(4, 4), voxel index in the whole image to RAS mm."""
    has_nan: bool = False
    """Whether voxels were NaN; they are zero here."""
    notes: tuple[str, ...] = ()
    """What is doubtful about the header."""

    @property
    def box(self) -> Box:
        """Where the part lies in the whole image."""
        return box(self.start, np.add(self.start, self.data.shape))

    @property
    def file_affine(self) -> Float:
        """(4, 4), voxel index in the part to RAS mm."""
        return moved(self.affine, self.start)


def moved(affine: Float, start: tuple[int, int, int]) -> Float:
    """Affine of a part of an image that begins at a voxel."""
    shifted = affine.copy()
    shifted[:3, 3] += affine[:3, :3] @ start
    return shifted


def read_labels(path: Path, margin: float = 0.0, part: Box | None = None) -> LabelImage:
    """Read the voxels that are not zero in an image of labels or a mask, or a given part.

    NaN, which some programs write as background, becomes zero.
    Shape and type are checked before any voxel is read, and no more than a slab is read at once:
    the size that a header declares does not decide how much memory is needed. Voxels up to
    ``margin`` (mm, along the image's axes) are kept around voxels that are not zero; ``part`` is
    read instead of that, as far as the image extends.
    """
    with _opened(path) as image:
        shape = _label_shape(image, path)
        affine = _checked_affine(image, path, VOXEL_SIZES)
        first = None
        if part is None:
            part, first = _labeled_part(image, shape, margin, affine)
        else:
            low, high = np.array([(side.start, side.stop) for side in part]).T
            part = box(np.minimum(low, shape), np.minimum(high, shape))
        size = math.prod(side.stop - side.start for side in part)
        if size > MOST_LABELED:
            raise InputError(
                f"{path}: voxels other than zero fill a part of {size / 1e6:.0f} million voxels, "
                f"{MOST_LABELED / 1e6:.0f} are the limit; are these labels?",
                reason="image-too-large",
            )
        _check_fits(image, path, size, "the part with labels")
        data = first[part] if first is not None else _voxels(image, shape, part)
        notes = tuple(_header_notes(image, affine, part))
    data, has_nan = without_nan(data)
    if data.dtype.kind == "f" and np.isinf(data).any():
        raise InputError(
            f"{path}: some labels are infinite; write whole numbers", reason="non-integer-labels"
        )
    start = (part[0].start, part[1].start, part[2].start)
    return LabelImage(data, start, shape, affine, has_nan, notes)


def without_nan(data: NDArray[Any]) -> tuple[NDArray[Any], bool]:
    """Return labels with zero for NaN, and whether there was any."""
    if data.dtype.kind != "f" or not (missing := np.isnan(data)).any():
        return data, False
    return np.where(missing, data.dtype.type(0), data), True


def label_codes(path: Path) -> list[float]:
    """List the distinct values of an image of labels other than zero, in order; NaN is last."""
    with _opened(path) as image:
        shape = _label_shape(image, path)
        codes = [np.unique(slab[slab != 0]) for _, slab in _slabs(image, shape)]
    return np.unique(np.concatenate(codes)).tolist() if codes else []


def _label_shape(image: Any, path: Path) -> tuple[int, int, int]:  # noqa: ANN401 (untyped)
    """Shape of an image of labels, by its header; refuse what is none, or too large."""
    shape = _three_axes(image, path, "labels are")
    if image.get_data_dtype().kind not in "iufb":
        raise InputError(
            f"{path}: labels are not whole numbers but colors or complex numbers; save them as "
            "integers",
            reason="non-integer-labels",
        )
    if math.prod(shape) > MOST_VOXELS or shape[0] * shape[1] > _MOST_IN_SLICE:
        text = " x ".join(map(str, image.shape))
        raise InputError(
            f"{path}: its header declares {text} voxels, above the limit of "
            f"{MOST_VOXELS / 1e9:.0f} billion; make it again, or crop it",
            reason="image-too-large",
        )
    _check_fits(image, path, shape[0] * shape[1], "one slice")
    return shape


def _axes(image: Any) -> list[int]:  # noqa: ANN401 (untyped)
    """Shape of an image without further axes of length one."""
    shape = [int(n) for n in image.shape]
    while len(shape) > _SPACE and shape[-1] == 1:
        shape.pop()
    return shape


def _three_axes(image: Any, path: Path, requirement: str) -> tuple[int, int, int]:  # noqa: ANN401 (untyped)
    """Shape of an image without further axes of length one; refuse what has more than three."""
    shape = _axes(image)
    if len(shape) != _SPACE:
        text = " x ".join(map(str, image.shape))
        raise InputError(
            f"{path}: has shape {text}, but {requirement} one 3-D volume; extract the volume",
            reason="not-3d",
        )
    return shape[0], shape[1], shape[2]


def _voxels(image: Any, shape: tuple[int, int, int], box: tuple[slice, ...]) -> NDArray[Any]:  # noqa: ANN401 (untyped)
    """Read a part of an image; further axes have length one."""
    data = image.dataobj[(*box, *(0,) * (len(image.shape) - len(shape)))]
    return np.asarray(data).reshape([side.stop - side.start for side in box])


def _slabs(image: Any, shape: tuple[int, int, int]) -> Iterator[tuple[int, NDArray[Any]]]:  # noqa: ANN401 (untyped)
    """Read slab by slab along the last axis; yields where each begins."""
    slab_voxels = min(_SLAB, READ_SHARE / 4 * _memory.get() / _voxel_bytes(image, _EXTRA_BYTES))
    step = max(int(slab_voxels // max(shape[0] * shape[1], 1)), 1)
    for start in range(0, shape[2], step):
        stop = min(start + step, shape[2])
        yield (
            start,
            _voxels(image, shape, (slice(0, shape[0]), slice(0, shape[1]), slice(start, stop))),
        )


def _labeled_part(
    image: Any,  # noqa: ANN401 (untyped)
    shape: tuple[int, int, int],
    margin: float,
    affine: Float,
) -> tuple[Box, NDArray[Any] | None]:
    """Bounding box of what is not zero; also the voxels, if they were read at once."""
    hits = [np.zeros(count, dtype=bool) for count in shape]
    slab = None
    for start, slab in _slabs(image, shape):
        inside = (slab < 0) | (slab > 0)  # NaN is background
        hits[0] |= inside.any(axis=(1, 2))
        hits[1] |= inside.any(axis=(0, 2))
        hits[2][start : start + slab.shape[2]] = inside.any(axis=(0, 1))
    whole = slab if slab is not None and slab.shape == shape else None
    if not hits[0].any():
        return box((0, 0, 0), (0, 0, 0)), whole
    return box_with_margin(hits, margin, affine), whole


def box_with_margin(hits: Sequence[NDArray[np.bool_]], margin: float, affine: Float) -> Box:
    """Range of true positions along each axis, with a margin (mm) as far as the image extends."""
    # Headers keep single precision: 0.4999999 mm voxels are 0.5 mm voxels.
    extra = np.ceil(margin / np.linalg.norm(affine[:3, :3], axis=0) - 1e-4).astype(int)
    ends = np.array([np.flatnonzero(hit)[[0, -1]] for hit in hits]).T
    size = [len(hit) for hit in hits]
    return box(np.maximum(ends[0] - extra, 0), np.minimum(ends[1] + extra + 1, size))


def read_grid(path: Path) -> tuple[tuple[int, int, int], Float]:
    """Read shape and affine (voxel index to RAS mm) of a 3-D image from its header."""
    with _opened(path) as image:
        _check_scalar(image, path)
        shape = _three_axes(image, path, "an anatomical image is")
        return shape, _checked_affine(image, path, VOXEL_SIZES)


def read_scalars(path: Path, points: Float) -> ScalarVolume:
    """Read the part of an image around some points, (..., 3) RAS mm."""
    with _opened(path) as image:
        _check_scalar(image, path)
        affine = _checked_affine(image, path, MAP_VOXEL_SIZES)
        shape = tuple(int(n) for n in image.shape)
        part = _part_around(affine, points, shape)
        _check_fits(
            image,
            path,
            math.prod(side.stop - side.start for side in part) * math.prod(shape[_SPACE:]),
            "the part round the sheet",
            extra_bytes=_EXTRA_BYTES_MAP,
            remedy="give fewer volumes at once",
        )
        data = np.asarray(image.dataobj[part], dtype=np.float64)
    start = (part[0].start, part[1].start, part[2].start)
    return ScalarVolume(
        values=data.reshape(*data.shape[:_SPACE], -1),
        affine=moved(affine, start),
        start=start,
        shape=(shape[0], shape[1], shape[2]),
    )


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open an image for as long as its voxels are read; errors meanwhile name the file."""
    try:
        open_regular(path).close()  # a pipe would be waited for
        # nibabel leaves files open on some of its paths; a stream that is closed here is not.
        with ImageOpener(str(path)) as stream:
            kind = _format(path, stream.read(4))
            stream.seek(0)
            # Mapped files would break under the reader if someone replaced them.
            with warnings.catch_warnings(action="ignore"):  # of extensions, which are not read
                image = kind.from_file_map(kind.make_file_map({"image": stream}), mmap=False)
            yield image
    except FileNotFoundError as error:
        raise MissingFileError(
            f"{path}: file not found; check its name", reason="unreadable-image"
        ) from error
    except _READ_ERRORS as error:
        message = " ".join(str(error).split()) or type(error).__name__
        raise InputError(
            f"{path}: cannot be read as an image ({message}); copy or make the file again",
            reason="unreadable-image",
        ) from error


class _MGHHeader(nib.freesurfer.mghformat.MGHHeader):
    """nibabel's gives counts of 32 bits: positions in files beyond 2 GB would be wrong."""

    def get_data_shape(self) -> tuple[int, ...]:
        return tuple(map(int, super().get_data_shape()))  # type: ignore[no-untyped-call]


class _MGHImage(nib.MGHImage):
    header_class = _MGHHeader


def _format(path: Path, start: bytes) -> type[Any]:
    """Choose the format by the file's name and, between the versions of NIfTI, its first bytes."""
    if path.suffix in {".mgz", ".mgh"}:
        return _MGHImage
    # NIfTI begins with the size of its header, which distinguishes the versions.
    sizes = {int.from_bytes(start, order) for order in ("little", "big")}
    newer = nib.Nifti2Header.template_dtype.itemsize in sizes
    return nib.Nifti2Image if newer else nib.Nifti1Image


def _check_scalar(image: Any, path: Path) -> None:  # noqa: ANN401 (nibabel's classes are untyped)
    """Refuse voxels that are not one real number each, or a row of them."""
    kind = image.get_data_dtype()
    if kind.kind not in "iufb":
        kind_text = "complex numbers" if kind.kind == "c" else "colors"
        raise InputError(
            f"{path}: its voxels are {kind_text}, a map needs one number each; "
            "extract the magnitude or one channel"
        )
    shape = _axes(image)
    if not _SPACE <= len(shape) <= _SPACE + 1:
        raise InputError(
            f"{path}: has shape {' x '.join(map(str, shape))}; extract a map of three axes, "
            "or four with one volume per column"
        )
    if 0 in shape:
        raise InputError(f"{path}: has no voxels; make the file again", reason="empty-image")


def _part_around(affine: Float, points: Float, shape: tuple[int, ...]) -> Box:
    """Range of voxels along each axis that interpolation at the points can reach."""
    finite = points[np.isfinite(points).all(axis=-1)]
    index = to_ras(finite, np.linalg.inv(affine))
    if not len(index):
        return box((0, 0, 0), (1, 1, 1))
    # One voxel more than needed on either side; at least one voxel where all points lie outside.
    low = np.clip(np.floor(index.min(axis=0)) - 1, 0, np.array(shape[:_SPACE]) - 1).astype(int)
    high = np.clip(np.ceil(index.max(axis=0)) + 2, low + 1, shape[:_SPACE]).astype(int)
    return box(low, high)


def _checked_affine(image: Any, path: Path, limits: tuple[float, float]) -> Float:  # noqa: ANN401 (nibabel's classes are untyped)
    """Return the affine, voxel index to RAS mm; refuse one that cannot be right."""
    affine: Float = np.asarray(image.affine, dtype=np.float64)
    linear = affine[:3, :3]
    if isinstance(image, nib.Nifti1Pair) and not (
        int(image.header["sform_code"]) or int(image.header["qform_code"])
    ):
        raise InputError(
            f"{path}: no sform and no qform, left and right are unknown; copy the "
            "orientation of the segmented image",
            reason="bad-affine",
        )
    if not np.isfinite(affine).all():
        raise InputError(
            f"{path}: the affine contains NaN or infinity; repair the header", reason="bad-affine"
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
        low, high = _USUAL_SIZES
        fits = [
            n for n, mm in _UNITS.items() if low <= mm * sizes.min() and mm * sizes.max() <= high
        ]
        unit = _stated_unit(image) or " or ".join(fits)
        raise InputError(
            f"{path}: voxels of {_times(sizes)} mm are outside of {limits[0]} to {limits[1]} mm; "
            + (f"the header may be in {unit}, write it in mm" if unit else "check the unit"),
            reason="bad-voxel-size",
        )
    if isinstance(image, nib.Nifti1Pair):
        _check_header(image, path, linear)
    return affine


def _check_header(image: Any, path: Path, linear: Float) -> None:  # noqa: ANN401  (as above)
    """Refuse a NIfTI header that contradicts the linear part of the affine."""
    sizes = np.linalg.norm(linear, axis=0)
    qform = _qform(image)
    if qform is not None and np.linalg.det(qform[:3, :3]) * np.linalg.det(linear) < 0:
        raise InputError(
            f"{path}: sform and qform are mirror images of each other, left and right are "
            "unknown; correct the wrong one",
            reason="bad-affine",
        )
    spacing = np.asarray(image.header.get_zooms()[:_SPACE], dtype=np.float64)
    # Some programs without a qform leave it as it was.
    stated = spacing.min() > 0 and (qform is not None or np.any(spacing != 1))
    if stated and np.abs(sizes / spacing - 1).max() > _SAME_SIZE:
        raise InputError(
            f"{path}: voxels are {_times(sizes)} mm by the sform, but {_times(spacing)} "
            "mm by pixdim; correct the wrong one",
            reason="bad-affine",
        )


def _qform(image: Any) -> Float | None:  # noqa: ANN401 (untyped)
    """Return the qform of a NIfTI image, (4, 4); None if there is none, or no valid one."""
    with contextlib.suppress(ValueError, HeaderDataError):
        qform: Float | None = image.header.get_qform(coded=True)[0]
        return qform
    return None


def _stated_unit(image: Any) -> str | None:  # noqa: ANN401 (untyped)
    """Return the unit that a header of NIfTI states, unless it is millimeters."""
    is_nifti = isinstance(image, nib.Nifti1Pair)
    return _STATED_UNITS.get(int(image.header["xyzt_units"]) % 8) if is_nifti else None


def _header_notes(image: Any, affine: Float, part: Box) -> Iterator[str]:  # noqa: ANN401 (untyped)
    """Note another unit than mm, and a qform that displaces or turns a part of the image."""
    unit = _stated_unit(image)
    if unit:
        yield f"the header states {unit} (xyzt_units), but was read in mm; correct the unit"
    qform = _qform(image) if isinstance(image, nib.Nifti1Pair) else None
    if qform is None:
        return
    corners = np.stack(np.meshgrid(*((side.start, side.stop) for side in part)), axis=-1)
    points = to_ras(corners, affine)
    moves = np.linalg.norm(to_ras(corners, qform) - points, axis=-1)
    rounding = _ROUNDED_QFORM * np.linalg.norm(points - affine[:3, 3], axis=-1)
    if np.any(moves > _SAME_POSITION + rounding):
        turn = Rotation.from_matrix(qform[:3, :3] @ np.linalg.inv(affine[:3, :3])).magnitude()
        yield (
            f"sform and qform place the labels {moves.max():.1f} mm and {np.degrees(turn):.1f} "
            "degrees apart; the sform was used, other programs may differ"
        )


def _times(sizes: Float) -> str:
    return " x ".join(f"{size:.3g}" for size in sizes)


def mask_bytes(mask: BodyMask) -> bytes:
    """Encode a mask, on the whole grid of its file, as a compressed NIfTI image.

    It is compressed slice by slice, since the file may be much larger than the body.
    """
    header = nib.Nifti1Header()
    header.set_data_dtype(np.uint8)
    header.set_data_shape(mask.shape)
    header.set_sform(mask.affine, code=1)
    # Some viewers read the qform only.
    header.set_qform(mask.affine, code=1)
    header.set_xyzt_units("mm")
    header["magic"] = header.single_magic
    header["vox_offset"] = header.single_vox_offset
    packed = zlib.compressobj(6, wbits=16 + zlib.MAX_WBITS)
    no_extension = bytes(header.single_vox_offset - header.sizeof_hdr)
    parts = [packed.compress(header.binaryblock + no_extension)]
    columns, rows = (
        slice(a, a + n) for a, n in zip(mask.start[:2], mask.inside.shape, strict=False)
    )
    empty = bytes(mask.shape[0] * mask.shape[1])
    for k in range(mask.shape[2]):
        voxels = empty
        if 0 <= k - mask.start[2] < mask.inside.shape[2]:
            slab = np.zeros(mask.shape[:2], dtype=np.uint8)
            slab[columns, rows] = mask.inside[..., k - mask.start[2]]
            voxels = slab.tobytes(order="F")
        parts.append(packed.compress(voxels))
    return b"".join([*parts, packed.flush()])
