"""What the output dataset holds of one hemisphere, as the pages need it: numbers and images."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from nibabel.affines import apply_affine
from nibabel.orientations import apply_orientation, inv_ornt_aff, io_orientation
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from hipsta_bids.derivatives.dataset import linked_path, read_links
from hipsta_bids.derivatives.results import (
    ResultPlace,
    list_results,
    read_record,
    read_sheet,
    read_summary,
)
from hipsta_bids.errors import HipstaError, InputError
from hipsta_bids.inputs.search import Candidate, find_anatomy
from hipsta_bids.io import files, gifti, volumes
from hipsta_bids.io.volumes import LabelImage, read_grid, read_labels, read_scalars
from hipsta_bids.joints import find_columns, load
from hipsta_bids.protocols import body_ends
from hipsta_bids.protocols.load import load_protocol, protocol_names
from hipsta_bids.protocols.protocol import Protocol
from hipsta_bids.reports.display import palette
from hipsta_bids.reports.page import number
from hipsta_bids.types import Bool, Decision, Float, ScalarVolume

SURFACES = ("interior", "midthickness", "exterior")
SIDES = {"L": "left", "R": "right"}

_NUMBER = r"(-?\d+(?:\.\d+)?)"
#: How messages name a point.
_PLACE = re.compile(rf"RAS {_NUMBER} {_NUMBER} {_NUMBER} mm")
#: Folders before a file's name, which may reveal more about a person than BIDS labels do.
_FOLDERS = re.compile(r"(?:[^\s:;,()/]*/){2,}(?=[^\s:;,()/])")

#: mm of the image that are kept round the body, and more of the anatomical image.
_MARGIN, _BEYOND = 5.0, 8.0

#: Share of the body's voxels that an anatomical image has to cover.
_COVERED = 0.99
#: mm by which corners of two images may differ if they have the same grid: headers are rounded.
_ROUNDING = 0.05
#: Percentiles of the anatomical image that are black and white.
_GRAYS = (1.0, 99.5)
_HALF = 0.5
#: Most voxels of an anatomical image that are read: those round a long hippocampus at 0.24 mm take
#: some 500 MB meanwhile.
_MOST_VOXELS = 25_000_000


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One fact that the user should know or look at."""

    kind: str
    """``failure``, ``flag`` or ``repair``."""
    message: str
    point: tuple[float, float, float] | None
    """RAS mm, where the message names a point."""
    reason: str = ""
    """Of a flag."""
    share: float = float("nan")
    """Share of the columns concerned, as far as the record of a flag says."""
    change: float = float("nan")
    """By how much they raise the mean thickness, mm, likewise."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SheetTable:
    """The sheet of one hemisphere."""

    columns: Mapping[str, Float]
    """(Nx, Ny) each, NaN where missing."""
    subfield: NDArray[np.str_]
    """(Nx, Ny), empty where missing."""
    valid: NDArray[np.bool_]
    repaired: NDArray[np.bool_]
    doubtful: NDArray[np.bool_]
    points: Mapping[str, Float]
    """(Nx, Ny, 3) RAS mm, by name of the surface."""
    ends: tuple[int, int] | None = None
    """First and last row of the body, where head or tail are on the sheet."""

    @property
    def parts(self) -> list[tuple[str, int, int]]:
        """Name, first and last row of tail, body and head, where not all is body."""
        if self.ends is None:
            return []
        first, last = self.ends
        end = self.shape[1] - 1
        rows = (("tail", 0, first - 1), ("body", first, last), ("head", last + 1, end))
        return [part for part in rows if part[1] <= part[2]]

    @property
    def end_rows(self) -> list[int]:
        """Rows of the ends of the body that lie on the sheet, not at its edge."""
        return [row for row in self.ends or () if 0 < row < self.shape[1] - 1]

    def rows_at(self, shares: Sequence[float]) -> list[int]:
        """Choose rows by their share of the way from posterior to anterior.

        On a sheet with a head, half of a row that is worth a picture has values.
        """
        rows = np.flatnonzero((self.valid.mean(axis=0) >= _HALF) | (self.ends is None)).tolist()
        return [rows[round(share * (len(rows) - 1))] for share in shares]

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of nodes along x and y."""
        nx, ny = self.valid.shape
        return nx, ny


@dataclass(frozen=True, eq=False)
class Hemisphere:
    """All files of one hemisphere, read when first used."""

    result: ResultPlace
    record: Mapping[str, Any]
    """The quality record."""

    @property
    def decision(self) -> Decision:
        """The decision on it."""
        return Decision(self.record["decision"])

    @property
    def measured(self) -> bool:
        """Whether there are maps."""
        return self.decision != Decision.FAILED

    @property
    def side(self) -> str:
        """``left`` or ``right``."""
        return SIDES[self.result.name.hemi]

    @property
    def metrics(self) -> Mapping[str, Any]:
        """Numbers of the quality record; empty for failed hemispheres."""
        metrics: Mapping[str, Any] = self.record.get("metrics") or {}
        return metrics

    @property
    def protocol(self) -> Protocol | None:
        """Its protocol; ``None`` if the package does not have it."""
        name = str(self.record.get("scheme", ""))
        try:
            return load_protocol(name) if name in protocol_names() else None
        except HipstaError:
            return None

    @property
    def message(self) -> str:
        """What happened and what to try, without names of folders."""
        return _FOLDERS.sub("", str(self.record.get("message") or ""))

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The problem that stopped it, or its doubtful places, and its repairs."""
        if not self.measured:
            return (_finding("failure", self.message or "no message"),)
        flags = [
            replace(
                _finding("flag", str(flag["message"])),
                reason=str(flag.get("reason")),
                share=number(flag, "columns_share"),
                change=number(flag, "mean_change_mm"),
            )
            for flag in self.record.get("flags") or []
        ]
        repairs = [_finding("repair", str(r)) for r in self.record.get("repairs") or []]
        # A large repair is also a flag.
        texts = [finding.message for finding in flags]
        new = (r for r in repairs if not any(m.startswith(r.message.split(";")[0]) for m in texts))
        return (*flags, *new)

    @cached_property
    def summary(self) -> Mapping[str, float]:
        """One number per column of the summary; empty for failed hemispheres."""
        return read_summary(self.result) if self.measured else {}

    @cached_property
    def profile(self) -> Mapping[str, Float]:
        """(Nx,) means over y by column; empty where the table cannot be read."""
        try:
            rows = files.read_tsv(self.result.path("profile"))
        except InputError:
            return {}
        rows = [row for row in rows if row.pop("axis", None) == "x"]
        return {
            column: np.array([number_of(row[column]) for row in rows])
            for column in (rows[0] if rows else ())
        }

    @cached_property
    def sheet(self) -> SheetTable:
        """Its sheet."""
        words = ("subfield", "valid", "repaired", "doubtful")
        columns = read_sheet(self.result.path("sheet"), words=words)
        subfield, valid, repaired, doubtful = (columns.pop(name) for name in words)
        for place in find_columns():
            columns |= {name: v.reshape(valid.shape) for name, v in load(place)(self).items()}
        return SheetTable(
            columns=columns,
            subfield=subfield.astype(np.str_),
            valid=valid == "true",
            repaired=repaired == "true",
            doubtful=doubtful == "true",
            points={name: _surface_points(self.result, name, valid.shape) for name in SURFACES},
            ends=body_ends(self.result.name.region, valid.shape[1]),
        )


def find_results(
    root: Path, subject: str | None = None, session: str | None = None
) -> Iterator[Hemisphere]:
    """Find the hemispheres of an output dataset."""
    for result in list_results(root, subject, session):
        try:
            record = read_record(result)
            Decision(record.get("decision", ""))
        except (InputError, ValueError):
            continue
        yield Hemisphere(result, record)


def _finding(kind: str, message: str) -> Finding:
    match = _PLACE.search(message)
    point = (float(match[1]), float(match[2]), float(match[3])) if match else None
    return Finding(kind=kind, message=_FOLDERS.sub("", message), point=point)


def _surface_points(result: ResultPlace, name: str, shape: tuple[int, ...]) -> Float:
    path = result.path(f"{name}_surface")
    points = gifti.read_mesh(path).points
    if len(points) != shape[0] * shape[1]:
        raise InputError(
            f"{path}: has {len(points)} vertices, the sheet {shape[0]} x {shape[1]} nodes; run the"
            " participant level again with --force"
        )
    return points.reshape(*shape, 3)


def number_of(cell: str) -> float:
    """Read a cell; NaN where it is no number."""
    try:
        return float(cell)
    except ValueError:
        return float("nan")


@dataclass(frozen=True, eq=False, kw_only=True)
class Anatomy:
    """The part of an anatomical image round the body."""

    path: Path
    """Of the file."""
    shares: NDArray[np.float32]
    """(I, J, K) from 0, black, to 1, white."""
    affine: Float
    """(4, 4), index to RAS mm."""

    @property
    def voxel(self) -> Float:
        """(3,) spacing, mm, along the axes of the scanner."""
        spacing: Float = 1 / np.linalg.norm(np.linalg.inv(self.affine[:3, :3]), axis=0)
        return spacing

    def grays(self, points: Float) -> NDArray[np.uint8]:
        """Interpolate at (..., 3) points, RAS mm; 0 is black, 255 white, also outside."""
        index = np.moveaxis(apply_affine(np.linalg.inv(self.affine), points), -1, 0)
        shares = map_coordinates(self.shares, index, order=1, cval=1.0)
        return np.round(255 * shares).astype(np.uint8)


def anatomy_of(path: Path, volume: ScalarVolume) -> Anatomy | None:
    """Scale an image between its percentiles; ``None`` where it has one value."""
    values = volume.values[..., 0]
    finite = values[np.isfinite(values)]
    low, high = np.percentile(finite, _GRAYS).tolist() if finite.size else (0.0, 0.0)
    if not low < high:
        return None
    shares = np.interp(np.nan_to_num(values, nan=low), (low, high), (0, 1)).astype(np.float32)
    return Anatomy(path=path, shares=shares, affine=volume.affine)


@dataclass(frozen=True, eq=False, kw_only=True)
class Views:
    """Labels and mask of one hemisphere, cropped to the part of interest."""

    labels: NDArray[np.int32] | None
    """(I, J, K) codes; ``None`` if the input is no longer available."""
    mask: Bool | None
    """(I, J, K) the body; ``None`` if its file is missing."""
    affine: Float
    """(4, 4), voxel index to RAS mm; the axes run to the right, anterior and superior."""
    names: Mapping[int, tuple[str, str]]
    """Name and color (``#rrggbb``) of labels, by code."""
    missing: str | None
    """Why there are no labels, in one phrase."""
    anatomy: Anatomy | None = None
    """The image that lies behind the labels."""
    unused: str | None = None
    """Which anatomical image is not shown and why, in one phrase."""

    @property
    def body(self) -> Bool:
        """(I, J, K) the mask, or without one the labels of the protocol."""
        if self.mask is None and self.labels is not None:
            return np.isin(self.labels, list(self.names))
        return np.zeros((0, 0, 0), dtype=bool) if self.mask is None else self.mask

    @property
    def shape(self) -> tuple[int, int, int]:
        """Numbers of voxels."""
        i, j, k = (self.body if self.labels is None else self.labels).shape
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


def _box(interest: Bool, affine: Float) -> tuple[slice, ...]:
    if not interest.any():
        return tuple(slice(0, n) for n in interest.shape)
    hits = [np.asarray(interest.any(axis=axes)) for axes in ((1, 2), (0, 2), (0, 1))]
    return volumes.box_with_margin(hits, _MARGIN, affine)


def read_views(hemisphere: Hemisphere, bids_dir: Path | None = None) -> Views | None:
    """Read what slices are drawn from; without ``bids_dir`` no anatomical images."""
    mask = _read_mask(hemisphere)
    labels, missing = _read_labels(hemisphere, mask)
    if mask is not None and labels is not None and mask.shape != labels.shape:
        labels, missing = None, "the image of the labels has changed since"
    first = mask if mask is not None else labels
    if first is None:
        return None
    affine = _reoriented(first.data, first.file_affine)[1]
    data = None if labels is None else _reoriented(labels.data, labels.file_affine)[0]
    inside = None if mask is None else _reoriented(mask.data, mask.file_affine)[0] != 0
    names = _names(hemisphere, data)
    interest = inside if inside is not None else np.isin(data, list(names))  # type: ignore[arg-type]  # one is there
    box = _box(interest, affine)
    anatomy, unused = None, None
    if bids_dir is not None and interest.any():
        points = apply_affine(affine, np.argwhere(interest)[::7])
        anatomy, unused = _read_anatomy(hemisphere, bids_dir, first, points)
    return Views(
        labels=None if data is None else data[box].astype(np.int32),
        mask=None if inside is None else inside[box],
        affine=volumes.moved(affine, (box[0].start, box[1].start, box[2].start)),
        names=names,
        missing=missing,
        anatomy=anatomy,
        unused=unused,
    )


def _read_anatomy(
    hemisphere: Hemisphere, bids_dir: Path, labels: LabelImage, points: Float
) -> tuple[Anatomy | None, str | None]:
    """Read the image that lies behind the labels, or why one is not shown.

    ``points``, RAS mm, are those of the body.
    """
    path = _linked(hemisphere, hemisphere.record.get("inputs") or [])
    if path is None:
        return None, None
    unused = None
    for candidate in find_anatomy(path, hemisphere.result.name, bids_dir):
        try:
            problem = _unfit(candidate, labels, points)
            if problem is None:
                beyond = _MARGIN + _BEYOND
                corners = np.stack([points.min(axis=0) - beyond, points.max(axis=0) + beyond])
                box = np.stack(np.meshgrid(*corners.T), axis=-1)
                anatomy = anatomy_of(candidate.path, read_scalars(candidate.path, box))
                if anatomy is not None:
                    return anatomy, None
                problem = "has one value everywhere round the body"
        except InputError as error:
            problem = _unusable(candidate.path, error)
        unused = unused or f"{candidate.path.name} {problem}"
    return None, unused


def _unusable(path: Path, error: InputError) -> str:
    """Write why a file cannot be read, without names of folders."""
    return "is unusable: " + _FOLDERS.sub("", str(error).removeprefix(f"{path}: "))


def _unfit(candidate: Candidate, labels: LabelImage, points: Float) -> str | None:
    """Say why an image cannot lie behind the labels, by its header."""
    shape, affine = read_grid(candidate.path)
    ends = np.array([[0, 0, 0], labels.shape]) - 0.5
    corners = np.stack(np.meshgrid(*ends.T), axis=-1)
    distance = apply_affine(affine, corners) - apply_affine(labels.affine, corners)
    if not candidate.proven and (shape != labels.shape or np.abs(distance).max() > _ROUNDING):
        return "has another grid than the labels, so its space may be another"
    index = np.round(apply_affine(np.linalg.inv(affine), points))
    if np.mean(((index >= 0) & (index < shape)).all(axis=-1)) < _COVERED:
        return "does not cover the body"
    size = np.prod(np.ptp(points, axis=0) + 2 * (_MARGIN + _BEYOND))
    if size / abs(np.linalg.det(affine[:3, :3])) > _MOST_VOXELS:
        return "has too many voxels round the body"
    return None


def input_path(hemisphere: Hemisphere) -> Path | None:
    """Find the file with the labels that were measured."""
    record = hemisphere.record
    edited = [e for e in record.get("edited") or [] if e.get("what") == "labels"]
    return _linked(hemisphere, edited or record.get("inputs") or [])


def _linked(hemisphere: Hemisphere, entries: Sequence[Mapping[str, Any]]) -> Path | None:
    """Find the first file of a list in the quality record."""
    address = str(entries[0].get("file", "")) if entries else ""
    root = hemisphere.result.root
    return linked_path(address, root, read_links(root))


def _read_mask(hemisphere: Hemisphere) -> LabelImage | None:
    path = hemisphere.result.path("body_mask")
    image = read_labels(path, _MARGIN) if path.exists() else None
    return image if image is not None and image.data.size else None


def _read_labels(
    hemisphere: Hemisphere, mask: LabelImage | None
) -> tuple[LabelImage | None, str | None]:
    """Read labels round the body, or why there are none."""
    path = input_path(hemisphere)
    if path is None:
        return None, "the record names no file"
    try:
        return read_labels(path, _MARGIN, mask.box if mask is not None else None), None
    except InputError as error:
        reason = "is not there any more" if not path.exists() else _unusable(path, error)
        return None, f"{path.name} {reason}"


def _reoriented(data: NDArray[np.generic], affine: Float) -> tuple[NDArray[np.generic], Float]:
    """Flip and swap axes so that they run to the right, anterior and superior."""
    orientation = io_orientation(affine)
    turned = np.asarray(affine @ inv_ornt_aff(orientation, data.shape), dtype=np.float64)
    return apply_orientation(data, orientation), turned


def _names(hemisphere: Hemisphere, data: NDArray[np.generic] | None) -> dict[int, tuple[str, str]]:
    """Names and colors of the codes that occur."""
    if data is None:
        return {}
    codes = [int(code) for code in np.unique(data) if code != 0]
    protocol = hemisphere.protocol
    if protocol is None:
        colors = palette(None, [f"label {code}" for code in codes])
        return dict(zip(codes, colors.items(), strict=True))
    labels = {label.code: label for label in protocol.labels}
    offset = protocol.shift(hemisphere.result.name.hemi)
    # Files of one hemisphere may have the same codes on both sides.
    shift = offset if any(code - offset in labels for code in codes) else 0
    return {
        code: (label.abbreviation or label.name, label.color)
        for code in codes
        if (label := labels.get(code - shift)) is not None
    }
