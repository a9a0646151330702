"""What is asked for, and what was found: the values that the search for inputs works with."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from hipsta_bids.errors import HipstaError
from hipsta_bids.protocols.protocol import Protocol

#: Hemispheres as BIDS spells them.
HEMIS = ("L", "R")


@dataclass(frozen=True, kw_only=True)
class InputRequest:
    """Where to look for segmentations, and which of them are wanted."""

    bids_dir: Path
    derivatives: Mapping[str, Path] = field(default_factory=dict)
    """Datasets to search, by name (``-d NAME=PATH``)."""
    freesurfer_dir: Path | None = None
    ashs_dir: Path | None = None
    hippunfold_dir: Path | None = None
    participant_labels: tuple[str, ...] = ()
    """Empty for all; with or without ``sub-``."""
    session_labels: tuple[str, ...] = ()
    """Empty for all; with or without ``ses-``."""
    hemis: tuple[str, ...] = HEMIS
    fs_analysis: str | None = None
    """The FreeSurfer analysis to take, such as ``T1`` or ``T1-T2.v21``."""
    ashs_atlas: str | None = None
    """Name of a bundled ASHS protocol (with or without ``ashs``), or a protocol file."""
    protocol: Path | None = None
    """The user's protocol file, for labels that no bundled protocol describes (for ASHS's, see
    ``ashs_atlas``)."""
    edited_dir: Path | None = None
    """Labels and masks that a person corrected."""
    output_dir: Path | None = None
    """Where results go, and where a person may have corrected them."""
    bids_filter_file: Path | None = None
    bids_database_dir: Path | None = None


def unknown_protocol(name: str, title: str) -> Protocol:
    """Stand in where codes are not understood: the hemisphere fails, but has a name in outputs."""
    return Protocol(name=name, title=title, citation="", sheet=(), layer=(), interior=(), labels=())


@dataclass(frozen=True, kw_only=True)
class Edit:
    """A file that a person corrected."""

    kind: str
    """``labels`` (it replaces the label image) or ``mask`` (of the body)."""
    path: Path
    source: str
    """Name of the dataset that it is in."""
    source_path: Path


@dataclass(frozen=True, kw_only=True)
class MapSource:
    """Another volume of the same person, to be sampled on the sheet."""

    name: str
    """What its outputs are called."""
    sampling: str
    """``depth`` or ``mid``, see :func:`~hipsta_bids.geometry.sampling.sample_on_sheet`."""
    interpolation: str
    """``linear`` or ``nearest``."""
    path: Path | None
    """None where there is no file, or more than one that it could be."""
    missing: str | None = None
    """Why there is no path, in one phrase."""
    source_path: Path | None = None
    """The dataset that it is in, if it is in the one that was given."""


@dataclass(frozen=True, kw_only=True)
class HemisphereInput:
    """One hemisphere's segmentation: which files, which protocol, and why these."""

    subject: str
    """Without ``sub-``."""
    session: str | None
    """Without ``ses-``; None where the dataset has no sessions."""
    hemi: str
    """``L`` or ``R``."""
    protocol: Protocol
    files: tuple[Path, ...]
    """The file with subfields and, if parts come from another file, that one."""
    parts_protocol: Protocol | None = None
    """The protocol of the second file."""
    bilateral: bool = False
    """The file carries both hemispheres, the right-hand codes shifted by
    ``protocol.right_offset``."""
    code_offset: int = 0
    """To be subtracted from the codes of this hemisphere."""
    source: str
    """Name of the dataset."""
    source_path: Path
    why: str
    """Why this file, in one phrase."""
    passed_over: tuple[tuple[str, str], ...] = ()
    """Other files of this hemisphere and why they were not taken."""
    problem: HipstaError | None = None
    """Found, but not usable: this hemisphere fails, the others go on."""
    notes: tuple[str, ...] = ()
    """What a reader should know about this choice."""
    edits: tuple[Edit, ...] = ()
    """Corrections by a person that take the place of what the files say."""
    maps: tuple[MapSource, ...] = ()
    """Other volumes to be sampled on the sheet."""
    regions: Path | None = None
    """Table of regions drawn on the sheet."""

    def edit(self, kind: str) -> Edit | None:
        """Return the edit of one kind, if there is one."""
        return next((edit for edit in self.edits if edit.kind == kind), None)

    @property
    def edited(self) -> tuple[str, ...]:
        """Kinds of edits, each once."""
        return tuple(dict.fromkeys(edit.kind for edit in self.edits))

    @property
    def key(self) -> tuple[str, str, str, str]:
        """What the names of the outputs consist of: two inputs may not share it."""
        return self.subject, self.session or "", self.hemi, self.protocol.name
