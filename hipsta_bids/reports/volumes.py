"""Labels and masks for pictures of slices, with axes that run right, anterior and superior."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote, urlparse

import numpy as np
from nibabel.orientations import apply_orientation, inv_ornt_aff, io_orientation
from numpy.typing import NDArray

from hipsta_bids.artifacts import Bool, Float
from hipsta_bids.bids import files
from hipsta_bids.bids.names import DATASET_FILES
from hipsta_bids.bids.volumes import read_voxels
from hipsta_bids.errors import HipstaError, InputError
from hipsta_bids.reports.results import Hemisphere
from hipsta_bids.schemes import Scheme, load_scheme, scheme_names

#: Kept round what is of interest, mm.
_MARGIN = 5.0

#: Colors of labels whose protocol is not at hand (Okabe and Ito 2008).
_COLORS = ("#E69F00", "#56B4E9", "#009E73", "#F0E442", "#0072B2", "#D55E00", "#CC79A7", "#999999")


@dataclass(frozen=True, eq=False, kw_only=True)
class LabelName:
    """How a label is shown."""

    name: str
    color: str
    """``#rrggbb``"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Views:
    """Labels and mask of one hemisphere, cropped to what is of interest."""

    labels: NDArray[np.int32] | None
    """(I, J, K) codes; ``None`` if the input is not at hand any more."""
    mask: Bool | None
    """(I, J, K) the body; ``None`` if it could not be found."""
    affine: Float
    """(4, 4), voxel index to RAS mm; the axes run to the right, anterior and superior."""
    names: Mapping[int, LabelName]
    """By code."""
    missing: str | None
    """Why there are no labels, in one phrase."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Numbers of voxels."""
        array = self.mask if self.labels is None else self.labels
        i, j, k = array.shape if array is not None else (0, 0, 0)
        return i, j, k

    @property
    def voxel(self) -> Float:
        """(3,) edges, mm."""
        edges: Float = np.linalg.norm(self.affine[:3, :3], axis=0)
        return edges

    def to_index(self, points: Float) -> Float:
        """Turn (..., 3) RAS mm into (..., 3) voxel indices."""
        inverse = np.linalg.inv(self.affine)
        index: Float = points @ inverse[:3, :3].T + inverse[:3, 3]
        return index


def read_views(hemisphere: Hemisphere) -> Views | None:
    """Read what slices are drawn from.

    Parameters
    ----------
    hemisphere : Hemisphere

    Returns
    -------
    Views or None
        ``None`` where there are neither labels nor a mask.
    """
    mask = _read_mask(hemisphere)
    labels, missing = _read_labels(hemisphere)
    if labels is None and mask is None:
        return None
    data, affine = labels or (None, None)
    if mask is not None and labels is not None and mask[0].shape != labels[0].shape:
        missing = "the image of the labels has changed since"
        data = None
    inside = None if mask is None else mask[0] != 0
    affine = mask[1] if mask is not None else affine
    names = _names(hemisphere, data)
    interest = inside if inside is not None else np.isin(data, list(names))  # type: ignore[arg-type]  # one is there
    box = _box(interest, np.linalg.norm(affine[:3, :3], axis=0))  # type: ignore[index]  # likewise
    return Views(
        labels=None if data is None else data[box].astype(np.int32),
        mask=None if inside is None else inside[box],
        affine=_moved(affine, box),  # type: ignore[arg-type]  # likewise
        names=names,
        missing=missing,
    )


def input_path(hemisphere: Hemisphere) -> Path | None:
    """Find the file with the labels that were measured.

    Parameters
    ----------
    hemisphere : Hemisphere

    Returns
    -------
    Path or None
        ``None`` if the record does not tell.
    """
    record = hemisphere.record
    edited = [e for e in record.get("edited") or [] if e.get("what") == "labels"]
    entries = edited or record.get("inputs") or []
    address = str(entries[0].get("file", "")) if entries else ""
    if not address.startswith("bids:"):
        return Path(address) if address else None
    _, dataset, inside = address.split(":", 2)
    root = hemisphere.place.root
    links = files.read_json(root / DATASET_FILES["description"]).get("DatasetLinks") or {}
    if dataset not in links:
        return None
    return Path(unquote(urlparse(str(links[dataset])).path)) / inside


def _read_mask(hemisphere: Hemisphere) -> tuple[NDArray[np.generic], Float] | None:
    path = hemisphere.place.path("body_mask")
    return _turned(*read_voxels(path)) if path.exists() else None


def _read_labels(
    hemisphere: Hemisphere,
) -> tuple[tuple[NDArray[np.generic], Float] | None, str | None]:
    path = input_path(hemisphere)
    if path is None:
        return None, "the record names no file"
    try:
        return _turned(*read_voxels(path)), None
    except InputError as error:
        reason = "is not there any more" if not path.exists() else f"is unusable: {error.reason}"
        return None, f"{path.name} {reason}"


def _turned(data: NDArray[np.generic], affine: Float) -> tuple[NDArray[np.generic], Float]:
    turn = io_orientation(affine)
    turned = np.asarray(affine @ inv_ornt_aff(turn, data.shape), dtype=np.float64)
    return apply_orientation(data, turn), turned


def _names(hemisphere: Hemisphere, data: NDArray[np.generic] | None) -> dict[int, LabelName]:
    """Names and colors of the codes that occur."""
    if data is None:
        return {}
    codes = [int(code) for code in np.unique(data) if code != 0]
    scheme = _scheme(str(hemisphere.record.get("scheme", "")))
    if scheme is None:
        colors = {code: _COLORS[n % len(_COLORS)] for n, code in enumerate(codes)}
        return {code: LabelName(name=f"label {code}", color=colors[code]) for code in codes}
    known = {label.code: label for label in scheme.labels}
    offset = scheme.right_offset if hemisphere.place.name.hemi == "R" else 0
    # Files of one hemisphere may have the left codes on both sides.
    shift = offset if any(code - offset in known for code in codes) else 0
    return {
        code: LabelName(name=label.abbreviation or label.name, color=label.color)
        for code in codes
        if (label := known.get(code - shift)) is not None
    }


def _scheme(name: str) -> Scheme | None:
    try:
        return load_scheme(name) if name in scheme_names() else None
    except HipstaError:
        return None


def _box(interest: NDArray[np.bool_], voxel: Float) -> tuple[slice, ...]:
    """Smallest box of voxels round what is of interest, with a margin."""
    box = []
    for axis in range(interest.ndim):
        others = tuple(other for other in range(interest.ndim) if other != axis)
        where = np.flatnonzero(interest.any(axis=others))
        margin = int(np.ceil(_MARGIN / voxel[axis]))
        first, last = (where[0], where[-1]) if len(where) else (0, interest.shape[axis] - 1)
        box.append(slice(max(0, first - margin), last + margin + 1))
    return tuple(box)


def _moved(affine: Float, box: tuple[slice, ...]) -> Float:
    moved = affine.copy()
    moved[:3, 3] += affine[:3, :3] @ np.array([part.start for part in box])
    return moved
