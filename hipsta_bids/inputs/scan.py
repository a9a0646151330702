"""Which datasets to search, which subjects and sessions they hold, and which of these are wanted.

Folders are listed once each, and no image is opened.
"""

import difflib
import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

from hipsta_bids.derivatives.dataset import NAME, generated_by, read_description
from hipsta_bids.errors import HipstaError, InputError, ProtocolError, UsageError
from hipsta_bids.protocols.load import load_protocol
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


def several_files(folder: Path, names: Iterable[str]) -> InputError:
    """Say that several files of a folder are equally good for a hemisphere."""
    return InputError(
        f"{folder}: {' and '.join(names)} are equally good; "
        "keep one of them in the subject's folder",
        reason="several-files",
    )


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
class HemisphereInput(Hemisphere):
    """One hemisphere's segmentation: which files, which protocol, and why these."""

    protocol: Protocol
    files: tuple[Path, ...]
    """The file with subfields and, if parts come from another file, that one."""
    parts_protocol: Protocol | None = None
    """The protocol of the second file."""
    bilateral: bool = False
    """The file carries both hemispheres, the codes of one shifted by ``protocol.offset``."""
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
    def key(self) -> tuple[str, str, str, str]:
        """What the names of the outputs consist of: two inputs may not share it."""
        return self.subject, self.session or "", self.hemi, self.protocol.name


#: ``sub-X``, ``sub-X_ses-Y``, and FreeSurfer's longitudinal ``sub-X_ses-Y.long.BASE``.
_SUBJECT = re.compile(
    r"sub-(?P<subject>[A-Za-z0-9+]+)(?:_ses-(?P<session>[A-Za-z0-9+]+))?(?P<long>\.long\..+)?"
)
_SESSION = re.compile(r"ses-(?P<session>[A-Za-z0-9+]+)")

#: Folders below a subject or a session that can hold segmentations.
_INNER = re.compile(r"anat|mri|final|seg\w*")

LAYOUTS = ("freesurfer", "ashs", "hippunfold", "tools", "named")
"""Kinds of folders that can be searched; ``tools`` are those without an option of their own, and
``named`` is any ``_hemi-?_..._dseg`` file with names."""

#: The entry of the filter file that applies to segmentations.
_QUERY = "dseg"

#: Never indexed: nothing in them says who takes part.
_IGNORED = tuple(
    re.compile(rf"^/{name}(/|$)")
    for name in ("derivatives", "sourcedata", "code", "stimuli", r"\.\w+")
)

_Wanted = Callable[[str | None], bool]


@dataclass(frozen=True, kw_only=True)
class SubjectFolder(Visit):
    """A folder that belongs to a subject, by its name."""

    longitudinal: bool
    path: Path


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
        raise InputError(
            f"{path}: no such folder; check the path", reason="missing-folder"
        ) from error
    except NotADirectoryError as error:
        raise InputError(
            f"{path}: is a file, but a folder is needed", reason="not-a-folder"
        ) from error
    except OSError as error:
        raise InputError(
            f"{path}: cannot list the folder ({error.strerror}); check its permissions",
            reason="unreadable-folder",
        ) from error
    return sorted(folders), sorted(files)


def _is_folder(entry: os.DirEntry[str]) -> bool:
    """Whether it can be listed as a folder; a link that leads back to itself cannot."""
    try:
        return entry.is_dir()
    except OSError:
        return False


def subject_folders(root: Path) -> list[SubjectFolder]:
    """List the subjects' folders of a dataset, sorted by name."""
    matches = ((name, _SUBJECT.fullmatch(name)) for name in list_folder(root)[0])
    return [
        SubjectFolder(
            subject=match["subject"],
            session=match["session"],
            longitudinal=match["long"] is not None,
            path=root / name,
        )
        for name, match in matches
        if match
    ]


def list_visits(folders: Iterable[SubjectFolder]) -> list[VisitFolders]:
    """List the candidate files of some subjects."""
    found: dict[tuple[str, str | None], list[Folder]] = {}
    for folder in folders:
        for session, inner in _inner_folders(folder):
            found.setdefault((folder.subject, session), []).append(inner)
    return [
        VisitFolders(subject=subject, session=session, folders=tuple(inner))
        for (subject, session), inner in found.items()
    ]


def _inner_folders(folder: SubjectFolder) -> Iterator[tuple[str | None, Folder]]:
    """Walk over a subject's folder: itself, its sessions, and the folders inside both."""
    waiting = [(folder.session, folder.path, True)]
    while waiting:
        session, path, outer = waiting.pop()
        names, files = list_folder(path)
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


def list_sources(request: InputRequest) -> tuple[Source, ...]:
    """List the datasets to search; earlier ones take precedence.

    What the user names comes first (``-d``, then ``--freesurfer-dir``, ``--ashs-dir`` and
    ``--hippunfold-dir``), then ``BIDS_DIR/derivatives``, ``BIDS_DIR/sourcedata``, and ``BIDS_DIR``
    itself where it is a derivative dataset. Folders of these that hold no ``sub-*`` are searched
    two levels down, and ``sourcedata`` inside of derivatives too (fMRIPrep keeps FreeSurfer's
    folder there). Our own outputs are left out.
    """
    sources: dict[Path, Source] = {}
    for source in _candidates(request):
        description = read_description(source.path)
        made_by = frozenset(name.lower() for name in generated_by(description))
        key = Path(os.path.realpath(source.path))  # also where links go round in circles
        if NAME not in {name.replace("-", "_") for name in made_by} and key not in sources:
            sources[key] = replace(source, generators=made_by)
    return tuple(sources.values())


def _candidates(request: InputRequest) -> Iterator[Source]:
    top, _ = list_folder(request.bids_dir)
    options = (request.freesurfer_dir, request.ashs_dir, request.hippunfold_dir)
    named: list[tuple[str, Path, tuple[str, ...]]]
    named = [(name, path, LAYOUTS) for name, path in request.derivatives.items()]
    named += [(name, path, (name,)) for name, path in zip(LAYOUTS, options, strict=False) if path]
    for name, path, layouts in named:
        for root in _datasets(path, depth=1) or [path]:
            yield Source(name=name, path=root, explicit=True, layouts=layouts)
    for folder in ("derivatives", "sourcedata"):
        if folder in top:
            for root in _datasets(request.bids_dir / folder, depth=2, lenient=True):
                yield Source(name=root.name, path=root, explicit=False)
    # A dataset without a description may be a bare folder of subjects.
    description = read_description(request.bids_dir)
    derived = description is None or description.get("DatasetType") == "derivative"
    if derived or generated_by(description):
        yield Source(name=request.bids_dir.resolve().name, path=request.bids_dir, explicit=False)


def _datasets(root: Path, *, depth: int, lenient: bool = False) -> list[Path]:
    """Find the folders that hold ``sub-*`` folders.

    ``lenient`` leaves out what cannot be listed: ``sourcedata`` is often closed to all but a few.
    """
    try:
        folders, _ = list_folder(root)
    except InputError:
        if lenient:
            return []
        raise
    if any(name.startswith("sub-") for name in folders):
        inner, found, depth = [name for name in folders if name == "sourcedata"], [root], 2
    else:
        inner, found = folders if depth else [], []
    for name in inner:
        found += _datasets(root / name, depth=depth - 1, lenient=lenient)
    return found


@dataclass(frozen=True, kw_only=True)
class Selection:
    """What the user asked for, ready to be applied."""

    subjects: frozenset[str] = frozenset()
    """Empty for all, as in ``sessions``."""
    excluded: frozenset[str] = frozenset()
    sessions: frozenset[str] = frozenset()
    hemis: tuple[str, ...] = HEMIS
    rules: Mapping[str, _Wanted] = field(default_factory=dict)
    """By entity, in pybids's long names; from the filter file."""
    fs_analysis: str | None = None
    """The FreeSurfer analysis to take."""
    protocol: Protocol | None = None
    """The user's protocol."""

    def describes(self, tool: str) -> bool:
        """Check whether the user's protocol is one for the files of a tool."""
        return self.protocol is not None and self.protocol.tool in ("", tool)

    def wants_folder(self, folder: SubjectFolder) -> bool:
        """Check whether a subject's folder has to be looked into."""
        return (
            (not self.subjects or folder.subject in self.subjects)
            and folder.subject not in self.excluded
            and (not self.sessions or folder.session is None or folder.session in self.sessions)
            and self._passes("subject", folder.subject)
        )

    def wants_visit(self, visit: VisitFolders) -> bool:
        """Check whether a session of a subject is wanted."""
        asked = not self.sessions or visit.session in self.sessions
        return asked and self._passes("session", visit.session)

    def wanted_hemis(self) -> tuple[str, ...]:
        """List the hemispheres that are wanted."""
        return tuple(hemi for hemi in HEMIS if hemi in self.hemis and self._passes("hemi", hemi))

    def wants_file(self, path: Path) -> bool:
        """Check whether a file with BIDS entities in its name is wanted."""
        if not self.rules:
            return True
        found = _parse(path)
        return all(rule(found.get(key)) for key, rule in self.rules.items())

    def _passes(self, entity: str, value: str | None) -> bool:
        rule = self.rules.get(entity)
        return rule is None or rule(value)


def make_selection(request: InputRequest) -> Selection:
    """Prepare what the user asked for."""
    wrong = [hemi for hemi in request.hemis if hemi not in HEMIS]
    if wrong or not request.hemis:
        raise UsageError(
            f"--hemi {' '.join(map(str, wrong))}: choose among {', '.join(HEMIS)}",
            reason="bad-hemisphere",
        )
    return Selection(
        subjects=_labels(request.participant_labels, "sub-", "--participant-label"),
        excluded=_labels(request.excluded_labels, "sub-", "--exclude-participant-label"),
        sessions=_labels(request.session_labels, "ses-", "--session-label"),
        hemis=request.hemis,
        rules=_rules(request.bids_filter_file) if request.bids_filter_file else {},
        fs_analysis=request.fs_analysis,
        protocol=_chosen_protocol(request.protocol) if request.protocol else None,
    )


def _chosen_protocol(choice: str | Path) -> Protocol:
    """Load a protocol by the name of a file or of a bundled one."""
    return measurable(load_protocol(Path(choice) if Path(choice).is_file() else str(choice)))


def measurable(protocol: Protocol) -> Protocol:
    """Return a protocol, unless it is known to have no subfields."""
    if protocol.refused:
        raise ProtocolError(protocol.refused, reason="no-subfields")
    return protocol


def _labels(labels: Iterable[str], prefix: str, option: str) -> frozenset[str]:
    bare = frozenset(label.removeprefix(prefix) for label in labels)
    wrong = sorted(label for label in bare if not re.fullmatch("[A-Za-z0-9+]+", label))
    if wrong:
        raise UsageError(
            f"{option} {' '.join(wrong)}: labels consist of letters and digits "
            f"(with or without {prefix!r})",
            reason="bad-label",
        )
    return bare


def _rules(path: Path) -> dict[str, _Wanted]:
    """Read a filter file: ``{"dseg": {"session": "01", "space": ["T1w", "T2w"]}}``."""
    try:
        contents = json.loads(path.read_text("utf-8"))
    except OSError as error:
        raise InputError(
            f"{path}: cannot read the filter file ({error.strerror}); check the path",
            reason="unreadable-filter",
        ) from error
    except ValueError as error:
        raise InputError(
            f"{path}: the filter file is not JSON ({error})", reason="unreadable-filter"
        ) from error
    query = contents.get(_QUERY, {}) if isinstance(contents, dict) else None
    if not isinstance(query, dict):
        raise UsageError(
            f'{path}: the filter file is not of the form {{"{_QUERY}": {{ENTITY: VALUE}}}}',
            reason="bad-filter",
        )
    known = _entities()
    for key in query:
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise UsageError(
                f"{path}: {key!r} in {_QUERY!r} is not a BIDS entity{hint}", reason="bad-filter"
            )
    return {key: _rule(value) for key, value in query.items()}


def _rule(value: Any) -> _Wanted:  # noqa: ANN401 (JSON)
    """Make one entity's test; null, ``*`` and ``Query.…`` mean what they mean in fMRIPrep."""
    if value is None or value == "Query.NONE":
        return lambda found: found is None
    if value in ("*", "Query.ANY"):
        return lambda found: found is not None
    if value == "Query.OPTIONAL":
        return lambda _: True
    values = value if isinstance(value, list) else [value]
    rules = [_rule(entry) for entry in values] if isinstance(value, list) else []
    texts = {str(entry) for entry in values}
    return lambda found: found in texts or any(rule(found) for rule in rules)


# pybids takes seconds to import and is needed only where a filter is given.
@cache
def _entities() -> dict[str, Any]:
    from bids.layout import Config  # noqa: PLC0415 (see above)

    configs = (Config.load(name) for name in ("bids", "derivatives"))
    return {name: entity for config in configs for name, entity in config.entities.items()}


def _parse(path: Path) -> dict[str, str]:
    from bids.layout import parse_file_entities  # noqa: PLC0415 (see above)

    found = parse_file_entities(str(path), entities=list(_entities().values()))
    return {key: str(value) for key, value in found.items()}


def list_participants(request: InputRequest) -> frozenset[str]:
    """List the participants of the BIDS dataset.

    From pybids's index where the user gave a place for it (made there on first use); otherwise from
    the names of the folders, as indexing thousands of subjects takes minutes.
    """
    if request.bids_database_dir is None:
        return frozenset(folder.subject for folder in subject_folders(request.bids_dir))
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
            "give an empty folder, and it will be made",
            reason="unreadable-database",
        ) from error
    if made_for.resolve() != bids_dir.resolve():
        raise InputError(
            f"{database_dir}: this database was made for {made_for}; give an empty folder",
            reason="unreadable-database",
        )
    return subjects
