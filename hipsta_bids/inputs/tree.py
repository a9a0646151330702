"""Whose folders are, by their names or a table, and which folders and files are inside.

Folders are listed once each. An entry that cannot be listed, or whose name is not understood,
hides nothing but itself, and is named.
"""

import os
import re
import unicodedata
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from hipsta_bids.errors import InputError, MissingFileError
from hipsta_bids.io.files import is_missing, read_tsv
from hipsta_bids.types import Visit

#: ``sub-X``, ``sub-X_ses-Y``, and FreeSurfer's longitudinal ``sub-X_ses-Y.long.BASE``.
_SUBJECT = re.compile(r"sub-(?P<subject>[A-Za-z0-9+]+)(?:_ses-(?P<session>[A-Za-z0-9+]+))?")

_LABEL = re.compile("[A-Za-z0-9+]+")

#: The same for folders of any name.
_ANY_NAME = re.compile(r"(?:sub-)?(?P<subject>.+?)(?:_ses-(?P<session>[A-Za-z0-9+]+))?")

#: Ends of a name of FreeSurfer's base that are no part of the person's.
_BASE_END = re.compile(r"[-_.]*(?:base|template)$", re.IGNORECASE)

#: What comes with FreeSurfer and is nobody's: its template brains and averages.
_TEMPLATE = re.compile(r"fsaverage.*|cvs_avg35.*|[lr]h\.EC_average|V1_average")

_SESSION = re.compile(r"ses-(?P<session>[A-Za-z0-9+]+)")
_NO_SESSION = ("its name is not ses-LABEL, of letters and digits", "a session inside of a session")

#: Folders below a subject or a session that can hold segmentations.
_INNER = re.compile(r"anat|mri|final|seg\w*")

#: Folders on the way to HippUnfold's and FreeSurfer's of the Human Connectome Project, below
#: ``SUBJECT/T1w``.
_HCP = re.compile(r"T1w|T2w|T1wT2w|HippUnfold|hippunfold|sub-[A-Za-z0-9+]+")

#: What lies in a subject's folder of each program, and the option that takes folders of any name.
_MARKS = {
    "freesurfer": {"mri"},
    "ashs": {"final", "bootstrap", "multiatlas"},
    "hippunfold": {"T1w/HippUnfold"},
}


@dataclass(frozen=True, kw_only=True)
class SubjectFolder(Visit):
    """A folder that belongs to a subject, by its name or a table."""

    path: Path
    spelling: str
    """What stands for the subject in its name."""
    renamed: bool = False
    """Whether the labels are not what the folder is called."""

    @property
    def longitudinal(self) -> bool:
        """Whether it is of one of FreeSurfer's longitudinal runs."""
        return ".long." in self.path.name


IS_USED, FAILED, NOT_USED = "used", "failed", "not used"
NO_SEGMENTATION = "not a segmentation"


@dataclass(frozen=True, kw_only=True)
class Ignored:
    """An entry that was not used."""

    path: Path
    reason: str
    """In one phrase."""
    subject: str | None = None
    """Label of the subject that it seems to belong to; ``None`` for a whole dataset."""
    session: str | None = None
    hemi: str | None = None
    """The hemisphere that is missing, if it is one."""
    status: str = NOT_USED
    """Or ``NO_SEGMENTATION``, which nobody misses."""
    quiet: bool = False
    """For the full list only."""
    inside: Path | None = None
    """The subject's folder that it is in, if it is not that itself."""

    @property
    def template(self) -> bool:
        """Whether it is expected to hold no participant."""
        return self.status == NO_SEGMENTATION

    @property
    def name(self) -> str:
        """Its name, with the name of the subject's folder."""
        return str(self.path.relative_to(self.inside.parent)) if self.inside else self.path.name


#: Why an entry of a dataset is nobody's.
NO_SUBJECT = "no subject's folder"


def no_segmentation(path: Path, reason: str) -> Ignored:
    """Describe an entry that holds no participant."""
    return Ignored(path=path, reason=reason, status=NO_SEGMENTATION, quiet=True)


@dataclass(frozen=True, kw_only=True)
class Folder:
    """A folder and the names of the files and folders directly in it."""

    path: Path
    names: tuple[str, ...]
    inner: tuple[str, ...] = ()
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
        raise MissingFileError(f"{path}: folder not found; check the path") from error
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


People = Mapping[str, tuple[str, str | None]]
"""Participant and session of each folder, by its name or its path in the dataset."""


def plain_label(name: str) -> str:
    """Make a BIDS label of a name: ``AD_05`` becomes ``AD05``, ``sub-Müller`` ``Muller``.

    It is empty where letters have no counterpart among letters of labels.
    """
    text = unicodedata.normalize("NFKD", name.removeprefix("sub-"))
    if any(letter.isalnum() and not letter.isascii() for letter in text):
        return ""
    return re.sub(r"[^A-Za-z0-9+]", "", text)


UNSURE = (
    "its folder may be a participant or a dataset; name the dataset itself, or all folders "
    "with --participants-map"
)
_NOT_NAMED = "not named in --participants-map, which names others of this dataset"


def sort_folders(
    root: Path, *, any_name: str = "", people: People = MappingProxyType({})
) -> tuple[list[SubjectFolder], list[Ignored]]:
    """List the subjects' folders of a dataset, and all other entries, each sorted by name.

    Folders of the program ``any_name`` need not be called ``sub-*``. If ``people`` names
    folders of this dataset, it alone decides.
    """
    names, files = list_folder(root)
    entries = read_names(root, names, any_name=any_name).values()
    folders = [entry for entry in entries if isinstance(entry, SubjectFolder)]
    other_entries = [entry for entry in entries if isinstance(entry, Ignored)]
    if named := people_in(root, people):
        other_entries = _not_named(root, entries, named)
        folders = [
            SubjectFolder(
                subject=subject, session=session, path=root / folder, spelling=subject, renamed=True
            )
            for folder, (subject, session) in named.items()
        ]
    for name in files:
        entry = no_segmentation(root / name, NO_SUBJECT)
        if match := _SUBJECT.fullmatch(name):
            reason = "no folder, or a link that leads nowhere"
            entry = Ignored(path=root / name, reason=reason, subject=match["subject"])
        other_entries.append(entry)
    return folders, sorted(other_entries, key=lambda entry: entry.path)


def _not_named(
    root: Path, entries: Iterable[SubjectFolder | Ignored], named: Iterable[str]
) -> list[Ignored]:
    """List the entries of a dataset, and folders of subjects, that a table does not name."""
    paths = {root / folder for folder in named}
    above = {parent for path in paths for parent in path.parents if root in parent.parents}
    others = [
        entry
        if isinstance(entry, Ignored)
        else Ignored(path=entry.path, reason=_NOT_NAMED, subject=entry.subject)
        for entry in entries
        if entry.path not in paths | above
    ]
    return others + [
        Ignored(path=parent / name, reason=_NOT_NAMED)
        for parent in above
        for name in list_folder(parent)[0]
        if parent / name not in paths | above and _tools_inside(parent / name, if_closed="any")
    ]


def read_names(
    root: Path, names: Sequence[str], *, any_name: str
) -> dict[str, SubjectFolder | Ignored]:
    """Determine the participants of folders by their names, or why they have none."""
    stems, base_of = _long_runs(names)
    inside = _tools_of_unmatched(root, stems, any_name)
    visits_of = Counter(base_of.values())
    bases = {*visits_of, *(name for name, tools in inside.items() if "base" in tools)}
    entries: dict[str, SubjectFolder | Ignored] = {}
    for name, stem in stems.items():
        path, match = root / name, _SUBJECT.fullmatch(stem)
        base = base_of.get(stem) or ("" if match else _base_before(stem, bases))
        tools = inside.get(name, frozenset())
        if name in bases and name not in base_of:
            entries[name] = no_segmentation(path, "the base of longitudinal runs, no visit")
        elif match and (match["session"] or visits_of[base] < 2):  # noqa: PLR2004 (two visits)
            spelling = stem.partition("_ses-")[0]
            subject, session = match["subject"], match["session"]
            entries[name] = SubjectFolder(
                subject=subject, session=session, path=path, spelling=spelling
            )
        elif name.startswith("sub-") or tools:
            allowed = match is not None or any_name in tools
            entries[name] = _renamed(path, stem, base, tools=tools, allowed=allowed)
        else:
            entries[name] = no_segmentation(path, NO_SUBJECT)
    return entries


def _long_runs(names: Iterable[str]) -> tuple[dict[str, str], dict[str, str]]:
    """Return the parts of names before ``.long.``, and for these parts the bases after it."""
    stems = {name: name.partition(".long.")[0] for name in names}
    bases = {stem: name.partition(".long.")[2] for name, stem in stems.items() if stem != name}
    return stems, bases


def _tools_of_unmatched(
    root: Path, stems: Mapping[str, str], any_name: str
) -> dict[str, frozenset[str]]:
    """Find the programs of folders whose stems are not of the form ``sub-X``."""
    unmatched = [name for name, stem in stems.items() if not _SUBJECT.fullmatch(stem)]
    return {name: _tools_inside(root / name, if_closed=any_name) for name in unmatched}


def _base_before(stem: str, bases: Collection[str]) -> str:
    """Return the base with which a time point begins, followed by no letter or digit."""
    heads = (stem[:n] for n, letter in enumerate(stem) if not letter.isalnum())
    return max((head for head in heads if head in bases), key=len, default="")


def _spelled(stem: str, base: str) -> tuple[str, str | None]:
    """Return what stands for the participant and for the session in a folder's name."""
    if not base:
        match = _ANY_NAME.fullmatch(stem)
        return (match["subject"], match["session"]) if match else (stem, None)
    spelling = _BASE_END.sub("", base) or base
    return spelling, stem.removeprefix(spelling).strip("-_.").removeprefix("ses-") or None


def _renamed(
    path: Path, stem: str, base: str, *, tools: frozenset[str], allowed: bool
) -> SubjectFolder | Ignored:
    """Make labels of a folder's name, if the option of its program is given."""
    spelling, session = _spelled(stem, base)
    label, visit = plain_label(spelling), plain_label(session or "") or None
    if _TEMPLATE.fullmatch(path.name):
        reason = "part of FreeSurfer, and no subject"
        return Ignored(path=path, reason=reason, subject=label, status=NO_SEGMENTATION)
    reason = ""
    if not label or bool(session) != bool(visit):
        reason = "no letter or digit in its name"
        if any(letter.isalnum() for letter in spelling):
            reason = "its name has letters that labels cannot have; --participants-map names it"
    elif not allowed:
        reason = "its name is not sub-LABEL or sub-LABEL_ses-LABEL, of letters and digits"
        for tool in sorted(tools.intersection(_MARKS)):
            reason += f"; --{tool}-dir {path.parent} takes it as sub-{label}"
            reason += f"_ses-{visit}" if base and visit else ""
    if reason:
        return Ignored(path=path, reason=reason, subject=label)
    return SubjectFolder(
        subject=label,
        session=visit,
        path=path,
        spelling=base or stem.partition("_ses-")[0],
        renamed=True,
    )


def _tools_inside(path: Path, *, if_closed: str) -> frozenset[str]:
    """Return programs whose subject's folder it may be, and ``base`` of longitudinal runs."""
    try:
        with os.scandir(path) as entries:
            names = {entry.name for entry in entries}
    except PermissionError:
        return frozenset([if_closed]) - {""}
    except OSError:
        return frozenset()
    if "T1w" in names:  # the Human Connectome Project's
        inner = {"HippUnfold": "T1w/HippUnfold", f"{path.name}/mri": "mri"}
        names |= {mark for name, mark in inner.items() if (path / "T1w" / name).is_dir()}
    tools = {tool for tool, marks in _MARKS.items() if not marks.isdisjoint(names)}
    if path.name not in _MARKS["ashs"] and any("lfseg_" in name for name in names):
        tools.add("ashs")
    return frozenset(tools | ({"base"} if "base-tps" in names else set()))


def read_people(path: Path | None) -> People:
    """Read ``--participants-map``: columns ``folder``, ``participant_id`` and ``session_id``."""
    people: dict[str, tuple[str, str | None]] = {}
    for number, row in enumerate(read_tsv(path) if path else (), start=2):
        folder = os.path.normpath(row.get("folder") or "..").strip("/")
        subject = row.get("participant_id", "").removeprefix("sub-")
        cell = row.get("session_id", "")
        session = "" if is_missing(cell) else cell.removeprefix("ses-")
        # Nothing outside of a dataset, nor the dataset itself.
        is_inside = not folder.startswith(".")
        if not (is_inside and _LABEL.fullmatch(subject) and (_LABEL.fullmatch(session or "0"))):
            raise InputError(
                f"{path}: line {number}: needs folder and participant_id (and session_id), labels"
                " of letters and digits"
            )
        if folder in people:
            raise InputError(f"{path}: line {number}: folder {folder} occurs twice; keep one")
        people[folder] = subject, session or None
    return people


def people_in(root: Path, people: People) -> People:
    """Select the folders of a dataset that ``--participants-map`` names."""
    return {folder: visit for folder, visit in people.items() if (root / folder).is_dir()}


def same_labels(folders: Iterable[SubjectFolder]) -> dict[str, InputError]:
    """Describe, by label, the folders of several names that would get the same labels."""
    spellings: dict[tuple[str, str | None], set[str]] = {}
    renamed = set()
    for folder in folders:
        spellings.setdefault((folder.subject, None), set()).add(folder.spelling)
        stem = folder.path.name.partition(".long.")[0]
        spellings.setdefault((folder.subject, folder.session or ""), set()).add(stem)
        if folder.renamed:
            renamed.add(folder.subject)
    return {
        label: InputError(
            f"{' and '.join(sorted(names))} would all be "
            f"sub-{label}{f'_ses-{session}' if session else ''}; name their participants "
            "with --participants-map",
            reason="same-label",
        )
        for (label, session), names in reversed(spellings.items())
        if len(names) > 1 and label in renamed
    }


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


def is_inner(name: str) -> bool:
    """Check whether a folder with this name inside a subject's is searched."""
    return any(pattern.fullmatch(name) for pattern in (_INNER, _SESSION, _HCP))


def _inner_folders(
    folder: SubjectFolder, ignored: list[Ignored]
) -> Iterator[tuple[str | None, Folder]]:
    """Walk over a subject's folder: itself, its sessions, and the folders inside both."""
    waiting = [(folder.session, folder.path, True)]
    connectome = False
    while waiting:
        session, path, outer = waiting.pop()
        listed = try_to_list(path, ignored, folder)
        if listed is None:
            continue
        names, files = listed
        inner, is_long = tuple(names), folder.longitudinal
        yield session, Folder(path=path, names=tuple(files), inner=inner, longitudinal=is_long)
        connectome |= path == folder.path and "T1w" in names
        for name in names:
            match = _SESSION.fullmatch(name)
            if outer and match and session is None:
                waiting.append((match["session"], path / name, True))
            elif outer and _INNER.fullmatch(name):
                waiting.append((session, path / name, False))
            elif outer and name.startswith("ses-"):
                ignored.append(_inside(folder, path / name, _NO_SESSION[bool(match)]))
            elif connectome and (_HCP.fullmatch(name) or name == folder.path.name):
                # Below T1w are FreeSurfer's folder of this name, and HippUnfold's dataset.
                waiting.append((session, path / name, name not in {"T1w", "T2w", "T1wT2w"}))


def try_to_list(
    path: Path, ignored: list[Ignored], folder: SubjectFolder | None = None
) -> tuple[list[str], list[str]] | None:
    """List a folder, or add it to the ignored ones."""
    try:
        return list_folder(path)
    except InputError as error:
        reason = str(error).removeprefix(f"{path}: ")
        entry = Ignored(path=path, reason=reason)
        ignored.append(_inside(folder, path, reason) if folder else entry)
        return None


def _inside(folder: SubjectFolder, path: Path, reason: str) -> Ignored:
    return Ignored(path=path, reason=reason, subject=folder.subject, inside=folder.path)
