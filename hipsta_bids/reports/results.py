"""What the output dataset holds of one hemisphere, as the pages need it."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.artifacts import Float, Status
from hipsta_bids.bids import files, gifti
from hipsta_bids.bids.names import name_of_record
from hipsta_bids.bids.results import ResultPlace
from hipsta_bids.errors import InputError

SURFACES = ("interior", "midthickness", "exterior")
SIDES = {"L": "left", "R": "right"}

_NUMBER = r"(-?\d+(?:\.\d+)?)"
#: How messages name a place.
_PLACE = re.compile(rf"RAS {_NUMBER} {_NUMBER} {_NUMBER} mm")
#: Folders before a file's name, which may tell more about a person than BIDS labels do.
_FOLDERS = re.compile(r"(?:[^\s:;,()/]*/){2,}(?=[^\s:;,()/])")


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One thing that a person should know or look at."""

    kind: str
    """``failure``, ``flag`` or ``repair``."""
    message: str
    point: tuple[float, float, float] | None
    """RAS mm, where the message names a place."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SheetTable:
    """The sheet of one hemisphere."""

    columns: Mapping[str, Float]
    """(Nx, Ny) each, NaN where missing."""
    subfield: NDArray[np.str_]
    """(Nx, Ny), empty where missing."""
    valid: NDArray[np.bool_]
    repaired: NDArray[np.bool_]
    points: Mapping[str, Float]
    """(Nx, Ny, 3) RAS mm, by name of the surface."""

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of nodes along x and y."""
        nx, ny = self.valid.shape
        return nx, ny

    def nearest(self, point: tuple[float, float, float]) -> tuple[int, int]:
        """Node of the mid-surface that is nearest to a place."""
        distance = np.linalg.norm(self.points["midthickness"] - np.array(point), axis=-1)
        i, j = np.unravel_index(int(np.argmin(distance)), distance.shape)
        return int(i), int(j)


@dataclass(frozen=True, eq=False)
class Hemisphere:
    """All files of one hemisphere, read when they are first asked for."""

    place: ResultPlace
    record: Mapping[str, Any]
    """The quality record."""

    @property
    def status(self) -> Status:
        """How it ended."""
        return Status(self.record["status"])

    @property
    def measured(self) -> bool:
        """Whether there are maps."""
        return self.status != Status.FAILED

    @property
    def side(self) -> str:
        """``left`` or ``right``."""
        return SIDES[self.place.name.hemi]

    @property
    def metrics(self) -> Mapping[str, Any]:
        """Numbers of the quality record; empty for failed hemispheres."""
        found: Mapping[str, Any] = self.record.get("metrics") or {}
        return found

    @property
    def message(self) -> str:
        """What happened and what to try, without names of folders."""
        return _FOLDERS.sub("", str(self.record.get("message") or ""))

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What stopped it, or what is doubtful about it, and what was repaired."""
        if not self.measured:
            return (_finding("failure", self.message or "no message"),)
        flags = [_finding("flag", str(f["message"])) for f in self.record.get("flags") or []]
        repairs = [_finding("repair", str(r)) for r in self.record.get("repairs") or []]
        # A large repair is also a flag.
        said = {finding.message for finding in flags}
        return (*flags, *(r for r in repairs if not any(m.startswith(r.message) for m in said)))

    @cached_property
    def summary(self) -> Mapping[str, float]:
        """One number per column of the summary; empty for failed hemispheres."""
        return read_summary(self.place) if self.measured else {}

    @cached_property
    def sheet(self) -> SheetTable:
        """Its sheet.

        Raises
        ------
        InputError
            If a file is missing or cannot be read.
        """
        rows = files.read_tsv(self.place.path("sheet"))
        try:
            return _sheet(rows, self.place)
        except (KeyError, ValueError) as error:
            raise InputError(
                f"{self.place.path('sheet')}: not a sheet ({error}); run the participant level"
                " again with --force",
                reason="bad-table",
            ) from error

    @cached_property
    def sections(self) -> list[dict[str, str]]:
        """Rows of the table of cross-sections."""
        return files.read_tsv(self.place.path("sections"))


def find_results(
    root: Path, subject: str | None = None, session: str | None = None
) -> Iterator[Hemisphere]:
    """Find the hemispheres of an output dataset.

    Parameters
    ----------
    root : Path
        The output dataset.
    subject, session : str, optional
        Labels of one visit; without subject, all visits.

    Yields
    ------
    Hemisphere
        Sorted by subject, session, protocol, region and hemisphere. Records that cannot be read
        are left out: the next run writes them anew.
    """
    if subject is None:
        folders = ["sub-*/anat", "sub-*/ses-*/anat"]
    else:
        folders = [f"sub-{subject}/{f'ses-{session}/' if session else ''}anat"]
    found = [
        ResultPlace(root=root, name=name)
        for folder in folders
        for path in root.glob(f"{folder}/*_desc-qc_metrics.json")
        if (name := name_of_record(path.name)) is not None
    ]
    for place in sorted(found, key=_order):
        try:
            record = files.read_json(place.path("qc"))
            Status(record.get("status", ""))
        except (InputError, ValueError):
            continue
        yield Hemisphere(place, record)


def _order(place: ResultPlace) -> tuple[str, ...]:
    name = place.name
    return name.subject, name.session or "", name.seg, name.region, name.hemi


def read_summary(place: ResultPlace) -> dict[str, float]:
    """Read the summary's row of numbers.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    rows = files.read_tsv(place.path("summary"))
    return {name: number_of(cell) for name, cell in rows[0].items()} if rows else {}


def _finding(kind: str, message: str) -> Finding:
    match = _PLACE.search(message)
    point = (float(match[1]), float(match[2]), float(match[3])) if match else None
    return Finding(kind=kind, message=_FOLDERS.sub("", message), point=point)


def number_of(cell: str) -> float:
    """Read a cell; NaN where it is no number."""
    try:
        return float(cell)
    except ValueError:
        return float("nan")


def _sheet(rows: list[dict[str, str]], place: ResultPlace) -> SheetTable:
    """Shape the table's rows, which are sorted by x, then y, as the grid."""
    shape = (int(rows[-1]["x"]), int(rows[-1]["y"]))

    def column(name: str) -> NDArray[np.str_]:
        return np.array([row[name] for row in rows]).reshape(shape)

    words = {"x", "y", "subfield", "valid", "repaired"}
    missing = files.MISSING
    subfield = column("subfield")
    return SheetTable(
        columns={
            name: np.vectorize(number_of, otypes=[np.float64])(column(name))
            for name in rows[0]
            if name not in words
        },
        subfield=np.where(subfield == missing, "", subfield),
        valid=column("valid") == "true",
        repaired=column("repaired") == "true",
        points={
            name: gifti.read_points(place.path(f"{name}_surface")).reshape(*shape, 3)
            for name in SURFACES
        },
    )
