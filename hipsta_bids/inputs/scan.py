"""Which datasets to search, which subjects and sessions they hold, and what is ignored there.

Folders are listed once each, and no image is opened. An entry that cannot be listed, or whose name
is not understood, hides nothing but itself, and is named.
"""

import os
import re
import stat
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from hipsta_bids.derivatives.dataset import NAME, generated_by, read_description
from hipsta_bids.errors import HipstaError, InputError
from hipsta_bids.protocols.protocol import Protocol
from hipsta_bids.types import GivenEnd, Hemisphere, Visit

# What is asked for, and what was found: the values that the search for inputs works with.


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
    excluded_labels: tuple[str, ...] = ()
    """Subjects to leave out."""
    session_labels: tuple[str, ...] = ()
    """Empty for all; with or without ``ses-``."""
    hemis: tuple[str, ...] = HEMIS
    fs_analysis: str | None = None
    """The FreeSurfer analysis to take, such as ``T1`` or ``T1-T2.v21``."""
    ashs_atlas: str | None = None
    """Name of a bundled ASHS protocol (with or without ``ashs``), or a protocol file."""
    protocol: str | Path | None = None
    """The user's protocol file, for labels that no bundled protocol describes, or the name of a
    bundled one, for labels that do not say which it is (for ASHS's, see ``ashs_atlas``)."""
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
    pattern: str = ""
    """Path with placeholders, absolute or relative to the BIDS dataset; may have wildcards."""
    sampling: str
    """``depth`` or ``mid``, see :func:`~hipsta_bids.geometry.sampling.sample_on_sheet`."""
    interpolation: str
    """``linear`` or ``nearest``."""
    path: Path | None = None
    """None where there is no file, or more than one that it could be."""
    missing: str | None = None
    """Why there is no path, in one phrase."""
    source_path: Path | None = None
    """The dataset that it is in, if it is in the one that was given."""


@dataclass(frozen=True, kw_only=True)
class HemisphereInput(Hemisphere):
    """One hemisphere's segmentation: which files, which protocol, and why these."""

    protocol: Protocol
    files: tuple[Path, ...]
    """The file with subfields and, if parts come from another file, that one."""
    parts_protocol: Protocol | None = None
    """The protocol of the second file."""
    bilateral: bool = False
    """The file carries both hemispheres, the codes of one shifted by ``protocol.offset``."""
    source: str
    """Name of the dataset."""
    source_path: Path
    explanation: str
    """Why this file, in one phrase."""
    passed_over: tuple[tuple[str, str], ...] = ()
    """Other files of this hemisphere and why they were not taken."""
    problem: HipstaError | None = None
    """Found, but not usable: this hemisphere fails, the others go on."""
    notes: tuple[str, ...] = ()
    """What a reader should know about this choice."""
    edits: tuple[Edit, ...] = ()
    """Corrections by a person that take the place of what the files say."""
    ends: tuple[GivenEnd, ...] = ()
    """Ends of the body that a person has placed."""
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
    def code_offset(self) -> int:
        """What is to be subtracted from the codes of this hemisphere."""
        return self.protocol.shift(self.hemi) if self.bilateral else 0

    @property
    def key(self) -> tuple[str, str, str, str]:
        """What the names of the outputs consist of: two inputs may not share it."""
        return self.subject, self.session or "", self.hemi, self.protocol.name


#: ``sub-X``, ``sub-X_ses-Y``, and FreeSurfer's longitudinal ``sub-X_ses-Y.long.BASE``.
_SUBJECT = re.compile(
    r"sub-(?P<subject>[A-Za-z0-9+]+)(?:_ses-(?P<session>[A-Za-z0-9+]+))?(?P<long>\.long\..+)?"
)

#: The same for FreeSurfer's folders of any name.
_ANY_NAME = re.compile(
    r"(?:sub-)?(?P<subject>.+?)(?:_ses-(?P<session>[A-Za-z0-9+]+))?(?P<long>\.long\..+)?"
)

#: What comes with FreeSurfer and is nobody's: its template brains and averages.
_TEMPLATE = re.compile(r"fsaverage.*|cvs_avg35.*|[lr]h\.EC_average|V1_average")

_SESSION = re.compile(r"ses-(?P<session>[A-Za-z0-9+]+)")

#: Folders below a subject or a session that can hold segmentations.
_INNER = re.compile(r"anat|mri|final|seg\w*")

LAYOUTS = ("freesurfer", "ashs", "hippunfold", "tools", "named")
"""Kinds of folders that can be searched; ``tools`` are those without an option of their own, and
``named`` is any ``_hemi-?_..._dseg`` file with names."""

#: Never indexed: nothing in them says who takes part.
_IGNORED = tuple(
    re.compile(rf"^/{name}(/|$)")
    for name in ("derivatives", "sourcedata", "code", "stimuli", r"\.\w+")
)


@dataclass(frozen=True, kw_only=True)
class SubjectFolder(Visit):
    """A folder that belongs to a subject, by its name."""

    longitudinal: bool
    path: Path

    @property
    def renamed(self) -> bool:
        """Whether the label is not what the folder is called."""
        return _SUBJECT.fullmatch(self.path.name) is None

    @property
    def spelling(self) -> str:
        """The part of its name that stands for the subject."""
        return re.split(r"_ses-|\.long\.", self.path.name)[0]


@dataclass(frozen=True, kw_only=True)
class Ignored:
    """An entry that looks as if it were meant to be used, but was not."""

    path: Path
    reason: str
    """In one phrase."""
    subject: str | None = None
    """Label of the subject that it seems to belong to; ``None`` for a whole dataset."""
    template: bool = False
    """One of FreeSurfer's template brains, which nobody misses."""
    inside: Path | None = None
    """The subject's folder that it is in, if it is not that itself."""

    @property
    def name(self) -> str:
        """Its name, with that of the subject's folder."""
        return str(self.path.relative_to(self.inside.parent)) if self.inside else self.path.name


@dataclass(frozen=True, kw_only=True)
class Folder:
    """A folder and the names of the files directly in it."""

    path: Path
    names: tuple[str, ...]
    longitudinal: bool = False


@dataclass(frozen=True, kw_only=True)
class VisitFolders(Visit):
    """All candidate folders of one subject, or of one of its sessions."""

    folders: tuple[Folder, ...]


#: Stands for the visit where there is none yet.
NO_VISIT = VisitFolders(subject="", session=None, folders=())


def list_folder(path: Path) -> tuple[list[str], list[str]]:
    """List a folder."""
    folders: list[str] = []
    files: list[str] = []
    try:
        with os.scandir(path) as entries:
            for entry in entries:
                if not entry.name.startswith("."):
                    (folders if _is_folder(entry) else files).append(entry.name)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such folder; check the path") from error
    except NotADirectoryError as error:
        raise InputError(f"{path}: is a file, but a folder is needed") from error
    except OSError as error:
        raise InputError(
            f"{path}: cannot list the folder ({error.strerror}); check its permissions"
        ) from error
    return sorted(folders), sorted(files)


def _is_folder(entry: os.DirEntry[str]) -> bool:
    """Whether it can be listed as a folder; a link that leads back to itself cannot."""
    try:
        return entry.is_dir()
    except OSError:
        return False


def plain_label(name: str) -> str:
    """Make a BIDS label of a name: ``AD_05`` and ``sub-AD_05`` become ``AD05``."""
    return re.sub(r"[^A-Za-z0-9+]", "", name.removeprefix("sub-"))


def sort_folders(
    root: Path, *, any_name: bool = False
) -> tuple[list[SubjectFolder], list[Ignored]]:
    """List the subjects' folders of a dataset, and what looks like one, each sorted by name.

    With ``any_name``, FreeSurfer's folders (they hold ``mri``) need not be called ``sub-*``.
    """
    names, files = list_folder(root)
    entries = [_read_name(root / name, any_name=any_name) for name in names]
    no_folder = "no folder, or a link that leads nowhere"
    return (
        [entry for entry in entries if isinstance(entry, SubjectFolder)],
        [entry for entry in entries if isinstance(entry, Ignored)]
        + [
            Ignored(path=root / name, reason=no_folder, subject=match["subject"])
            for name in files
            if (match := _SUBJECT.fullmatch(name))
        ],
    )


def _read_name(path: Path, *, any_name: bool) -> SubjectFolder | Ignored | None:
    """Tell by the name whose folder it is, or why it is nobody's; ``None`` if it claims nothing."""
    match = _SUBJECT.fullmatch(path.name)
    label = match["subject"] if match else ""
    if match is None:
        claims = path.name.startswith("sub-")
        freesurfer = _holds_mri(path, if_closed=any_name)
        if not (claims or freesurfer):
            return None
        match = _ANY_NAME.fullmatch(path.name)
        label = plain_label(match["subject"]) if match else ""
        if _TEMPLATE.fullmatch(path.name):
            reason = "comes with FreeSurfer, and is no subject"
            return Ignored(path=path, reason=reason, subject=label, template=True)
        if match is None or not label:
            return Ignored(path=path, reason="no letter or digit in its name", subject=label)
        if not (any_name and freesurfer):
            reason = "its name is not sub-LABEL or sub-LABEL_ses-LABEL, of letters and digits"
            if freesurfer:
                reason += f"; --freesurfer-dir {path.parent} takes it as sub-{label}"
            return Ignored(path=path, reason=reason, subject=label)
    return SubjectFolder(
        subject=label,
        session=match["session"],
        longitudinal=match["long"] is not None,
        path=path,
    )


def _holds_mri(path: Path, *, if_closed: bool) -> bool:
    """Whether it looks like a subject's folder of FreeSurfer."""
    try:
        return stat.S_ISDIR((path / "mri").stat().st_mode)
    except PermissionError:
        return if_closed
    except OSError:
        return False


def list_visits(
    folders: Iterable[SubjectFolder], ignored: list[Ignored] | None = None
) -> list[VisitFolders]:
    """List the candidate files of some subjects; what cannot be listed is added to ``ignored``."""
    folders_of: dict[tuple[str, str | None], list[Folder]] = {}
    for folder in folders:
        for session, inner in _inner_folders(folder, [] if ignored is None else ignored):
            folders_of.setdefault((folder.subject, session), []).append(inner)
    return [
        VisitFolders(subject=subject, session=session, folders=tuple(inner))
        for (subject, session), inner in folders_of.items()
    ]


def _inner_folders(
    folder: SubjectFolder, ignored: list[Ignored]
) -> Iterator[tuple[str | None, Folder]]:
    """Walk over a subject's folder: itself, its sessions, and the folders inside both."""
    waiting = [(folder.session, folder.path, True)]
    while waiting:
        session, path, outer = waiting.pop()
        listed = _try_to_list(path, ignored, folder)
        if listed is None:
            continue
        names, files = listed
        if files:
            yield (
                session,
                Folder(path=path, names=tuple(files), longitudinal=folder.longitudinal),
            )
        for name in names if outer else ():
            match = _SESSION.fullmatch(name)
            if match and session is None:
                waiting.append((match["session"], path / name, True))
            elif _INNER.fullmatch(name):
                waiting.append((session, path / name, False))
            elif match is None and name.startswith("ses-"):
                reason = "its name is not ses-LABEL, of letters and digits"
                ignored.append(
                    Ignored(
                        path=path / name, reason=reason, subject=folder.subject, inside=folder.path
                    )
                )


def _try_to_list(
    path: Path, ignored: list[Ignored], folder: SubjectFolder | None = None
) -> tuple[list[str], list[str]] | None:
    """List a folder, or add it to what is ignored."""
    try:
        return list_folder(path)
    except InputError as error:
        reason = str(error).removeprefix(f"{path}: ")
        subject_folder = (folder.subject, folder.path) if folder else (None, None)
        ignored.append(
            Ignored(path=path, reason=reason, subject=subject_folder[0], inside=subject_folder[1])
        )
        return None


@dataclass(frozen=True, kw_only=True)
class Source:
    """A dataset that may hold segmentations."""

    name: str
    path: Path
    explicit: bool
    """Given by the user, not found by default."""
    layouts: tuple[str, ...] = LAYOUTS
    """Kinds of segmentation to look for here."""
    generators: frozenset[str] = frozenset()
    """Software named in its ``dataset_description.json``."""

    @property
    def any_name(self) -> bool:
        """Whether subjects' folders may have other names than ``sub-*``."""
        return self.layouts == ("freesurfer",)


def list_sources(request: InputRequest, ignored: list[Ignored] | None = None) -> tuple[Source, ...]:
    """List the datasets to search; earlier ones take precedence.

    What the user names comes first (``-d``, then ``--freesurfer-dir``, ``--ashs-dir`` and
    ``--hippunfold-dir``), then ``BIDS_DIR/derivatives``, ``BIDS_DIR/sourcedata``, and ``BIDS_DIR``
    itself where it is a derivative dataset. Folders of these that hold no ``sub-*`` are searched
    two levels down, and ``sourcedata`` inside of derivatives too (fMRIPrep keeps FreeSurfer's
    folder there). Our own outputs are left out. What cannot be listed, unless the user named it,
    and what looks like a subject outside of these datasets is added to ``ignored``.
    """
    sources: dict[Path, Source] = {}
    for source in _candidates(request, [] if ignored is None else ignored):
        description = read_description(source.path)
        made_by = frozenset(name.lower() for name in generated_by(description))
        key = Path(os.path.realpath(source.path))  # also where links go round in circles
        if NAME not in {name.replace("-", "_") for name in made_by} and key not in sources:
            sources[key] = replace(source, generators=made_by)
    return tuple(sources.values())


def _candidates(request: InputRequest, ignored: list[Ignored]) -> Iterator[Source]:
    top, _ = list_folder(request.bids_dir)
    options = (request.freesurfer_dir, request.ashs_dir, request.hippunfold_dir)
    named: list[tuple[str, Path, tuple[str, ...]]]
    named = [(name, path, LAYOUTS) for name, path in request.derivatives.items()]
    named += [(name, path, (name,)) for name, path in zip(LAYOUTS, options, strict=False) if path]
    for name, path, layouts in named:
        list_folder(path)  # what the user named has to be readable
        source = Source(name=name, path=path, explicit=True, layouts=layouts)
        for root in _datasets(path, 1, ignored, any_name=source.any_name) or [path]:
            yield replace(source, path=root)
    for folder in ("derivatives", "sourcedata"):
        if folder in top:
            for root in _datasets(request.bids_dir / folder, 2, ignored):
                yield Source(name=root.name, path=root, explicit=False)
    # A dataset without a description may be a bare folder of subjects.
    description = read_description(request.bids_dir)
    derived = description is None or description.get("DatasetType") == "derivative"
    if derived or generated_by(description):
        yield Source(name=request.bids_dir.resolve().name, path=request.bids_dir, explicit=False)
    else:
        ignored += sort_folders(request.bids_dir)[1]


def _datasets(
    root: Path, depth: int, ignored: list[Ignored], *, any_name: bool = False
) -> list[Path]:
    """Find the folders that hold ``sub-*`` folders, or with ``any_name`` FreeSurfer's.

    Searched are ``depth`` levels below the root, and the folders in each ``sourcedata`` on the way.
    What cannot be listed is left out: ``sourcedata`` is often closed to all but a few.
    """
    datasets: list[Path] = []
    unused: list[Ignored] = []
    visited: set[str] = set()
    waiting = [(root, depth)]
    while waiting:
        path, below = waiting.pop()
        key = os.path.realpath(path)
        listed = None if key in visited else _try_to_list(path, ignored)
        visited.add(key)
        if listed is None:
            continue
        entries = {name: _read_name(path / name, any_name=any_name) for name in listed[0]}
        inner = [name for name, entry in entries.items() if entry is None]
        has_subjects = any(isinstance(entry, SubjectFolder) for entry in entries.values())
        if has_subjects or any(name.startswith("sub-") for name in entries):
            datasets.append(path)
            inner, below = [name for name in inner if name == "sourcedata"], 0
        else:
            unused += [entry for entry in entries.values() if isinstance(entry, Ignored)]
            inner = list(entries)
        for name in reversed(inner):
            if name == "sourcedata":
                waiting.append((path / name, 1))
            elif below:
                waiting.append((path / name, below - 1))
    # A folder of datasets may hold one that is called mri.
    ignored += [
        entry for entry in unused if not any(path.is_relative_to(entry.path) for path in datasets)
    ]
    return datasets


def list_participants(request: InputRequest) -> frozenset[str]:
    """List the participants of the BIDS dataset.

    From pybids's index where the user gave a place for it (made there on first use); otherwise from
    the names of the folders, as indexing thousands of subjects takes minutes.
    """
    if request.bids_database_dir is None:
        return frozenset(folder.subject for folder in sort_folders(request.bids_dir)[0])
    return _from_index(request.bids_dir, request.bids_database_dir)


def _from_index(bids_dir: Path, database_dir: Path) -> frozenset[str]:
    # Takes seconds to import.
    from bids import BIDSLayout, BIDSLayoutIndexer  # noqa: PLC0415
    from sqlalchemy.exc import SQLAlchemyError  # noqa: PLC0415 (comes with pybids)

    try:
        layout = BIDSLayout(
            bids_dir,
            validate=False,
            derivatives=False,
            database_path=database_dir,
            indexer=BIDSLayoutIndexer(validate=False, index_metadata=False, ignore=_IGNORED),
        )
        made_for = Path(layout.root)
        subjects = frozenset(layout.get_subjects())
    except (OSError, ValueError, TypeError, SQLAlchemyError) as error:
        first_line = str(error).partition("\n")[0]
        raise InputError(
            f"{database_dir}: pybids cannot use this database ({first_line}); "
            "give an empty folder, and it will be made"
        ) from error
    if made_for.resolve() != bids_dir.resolve():
        raise InputError(
            f"{database_dir}: this database was made for {made_for}; give an empty folder"
        )
    return subjects
