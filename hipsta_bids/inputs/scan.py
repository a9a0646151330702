"""Which datasets to search, which subjects and sessions they hold, and what is ignored there.

Folders are listed once each, and no image is opened. An entry that cannot be listed, or whose name
is not understood, hides nothing but itself, and is named.
"""

import os
import re
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from hipsta_bids.derivatives.dataset import NAME, PROVENANCE, generated_by, read_description
from hipsta_bids.errors import HipstaError, InputError
from hipsta_bids.inputs import tree
from hipsta_bids.io.files import MISSING
from hipsta_bids.protocols.protocol import Protocol, Tissue
from hipsta_bids.types import GivenEnd, Hemisphere

# Values of the search for inputs: requests and results.


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
    participants_map: Path | None = None
    """Table with the participant and session of each folder."""
    probabilities: str | Path = "never"
    """``auto`` (next to the labels), ``never``, or the folder that has all probabilities."""

    @property
    def uses_pybids(self) -> bool:
        """Whether PyBIDS selects participants or files."""
        return self.bids_filter_file is not None or self.bids_database_dir is not None

    @property
    def any_name(self) -> bool:
        """Whether an option takes folders of any name."""
        return any((self.freesurfer_dir, self.ashs_dir, self.hippunfold_dir))

    @property
    def is_whole(self) -> bool:
        """Whether all participants and sessions are asked for."""
        limits = (self.participant_labels, self.excluded_labels, self.session_labels)
        return not any(limits) and self.bids_filter_file is None and self.hemis == HEMIS


def unknown_protocol(name: str, title: str) -> Protocol:
    """Stand in where codes are not understood: the hemisphere fails, but has a name in outputs."""
    return Protocol(name=name, title=title, citation="", sheet=(), layer=(), interior=(), labels=())


@dataclass(frozen=True, kw_only=True)
class Edit:
    """A file corrected by hand."""

    kind: str
    """``labels`` (it replaces the label image) or ``mask`` (of the body)."""
    path: Path
    source: str
    """Name of the dataset that it is in."""
    source_path: Path


@dataclass(frozen=True, kw_only=True)
class Probabilities:
    """Files with the share of each voxel that a label fills."""

    kind: str
    """``probseg``, as BIDS names the files, or the program that names them so."""
    files: tuple[tuple[Path, tuple[Tissue, ...]], ...]
    """Each file, with the tissue of each of its volumes."""
    weights: bool = False
    """Whether the values are weights, which their sum makes probabilities."""
    source: str
    """Name of the dataset."""
    source_path: Path


class Addition(typing.Protocol):
    """What an extension adds to the inputs of a hemisphere."""

    @property
    def origins(self) -> Sequence[tuple[str, Path]]:
        """Datasets of its files: their names and folders."""

    def describe(self) -> list[object]:
        """List what decides about its results: contents of files, and how they are read."""


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
    """Why it is not usable: this hemisphere fails, the others go on."""
    notes: tuple[str, ...] = ()
    """What a reader should know about this choice."""
    provenance: Mapping[str, str] = field(default_factory=dict, hash=False)
    """Tool, version and so on, as far as names show (``PROVENANCE`` of ``derivatives``)."""
    edits: tuple[Edit, ...] = ()
    """Corrections by a person that take the place of what the files say."""
    ends: tuple[GivenEnd, ...] = ()
    """Ends of the body that a person has placed."""
    probabilities: Probabilities | None = None
    """Probabilities of the labels, if they are used."""
    further: Mapping[str, Addition] = field(default_factory=dict, hash=False)
    """What extensions add to the inputs, by name."""

    def edit(self, kind: str) -> Edit | None:
        """Return the edit of one kind, if there is one."""
        return next((edit for edit in self.edits if edit.kind == kind), None)

    @property
    def side(self) -> tuple[str, str, str]:
        """Return what visits on a common sheet have in common: participant, side and protocol."""
        return self.subject, self.hemi, self.protocol.name

    def path_of(self, name: str) -> Path:
        """Return the path of a file that was passed over: next to the labels, or as written."""
        return self.files[0].parent / name if Path(name).name == name else Path(name)

    @property
    def probability_files(self) -> tuple[Path, ...]:
        """Files with probabilities of the labels; none if labels are used alone."""
        return tuple(path for path, _ in self.probabilities.files) if self.probabilities else ()

    @property
    def edited(self) -> tuple[str, ...]:
        """Kinds of edits, each once."""
        return tuple(dict.fromkeys(edit.kind for edit in self.edits))

    @property
    def origin(self) -> dict[str, str]:
        """Origin of the labels, as far as is known before they are read."""
        return {**dict.fromkeys(PROVENANCE, MISSING), **self.provenance} | {
            "edited": "+".join(self.edited) or MISSING,
            "probabilities": self.probabilities.kind if self.probabilities else MISSING,
        }

    @property
    def code_offset(self) -> int:
        """Number to subtract from the codes of this hemisphere."""
        return self.protocol.shift(self.hemi) if self.bilateral else 0

    @property
    def key(self) -> tuple[str, str, str, str]:
        """What the names of the outputs consist of: two inputs may not share it."""
        return self.subject, self.session or "", self.hemi, self.protocol.name


#: Never indexed: nothing in them says who takes part.
_IGNORED = tuple(
    re.compile(rf"^/{name}(/|$)")
    for name in ("derivatives", "sourcedata", "code", "stimuli", r"\.\w+")
)


LAYOUTS = ("freesurfer", "ashs", "hippunfold", "tools", "named")
"""Kinds of folders that can be searched; ``tools`` are those without a separate option, and
``named`` is any ``_hemi-?_..._dseg`` file with names."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """A dataset that may hold segmentations."""

    name: str
    path: Path
    explicit: bool
    """Given by the user, not by default."""
    origin: str = ""
    """Its folder if searched by default: ``derivatives`` or ``sourcedata``."""
    layouts: tuple[str, ...] = LAYOUTS
    """Kinds of segmentation to look for here."""
    generators: Mapping[str, str] = field(default_factory=dict)
    """Software named in its ``dataset_description.json``, with versions."""

    people: tree.People = field(default_factory=dict)
    """Of ``--participants-map``."""

    @property
    def any_name(self) -> str:
        """The program whose folders may have other names than ``sub-*``; empty if none may."""
        return self.layouts[0] if len(self.layouts) == 1 else ""

    def folders(self) -> tuple[list[tree.SubjectFolder], list[tree.Ignored]]:
        """List the subjects' folders, and all other entries."""
        return tree.sort_folders(self.path, any_name=self.any_name, people=self.people)


def list_sources(
    request: InputRequest, ignored: list[tree.Ignored] | None = None
) -> tuple[Source, ...]:
    """List the datasets to search; earlier ones take precedence.

    Datasets that the user names are first (``-d``, then ``--freesurfer-dir``, ``--ashs-dir`` and
    ``--hippunfold-dir``), then ``BIDS_DIR/derivatives``, ``BIDS_DIR/sourcedata``, and ``BIDS_DIR``
    itself where it is a derivative dataset. Folders of these that hold no ``sub-*`` are searched
    two levels down, and ``sourcedata`` inside of derivatives too (fMRIPrep keeps FreeSurfer's
    folder there). Outputs are excluded. What cannot be listed, unless the user named it,
    and what looks like a subject outside of these datasets is added to ``ignored``.
    """
    sources: dict[Path, Source] = {}
    for source in _candidates(request, [] if ignored is None else ignored):
        description = read_description(source.path)
        made_by = {name.lower(): version for name, version in generated_by(description).items()}
        key = Path(os.path.realpath(source.path))  # also where links go round in circles
        if NAME not in {name.replace("-", "_") for name in made_by} and key not in sources:
            sources[key] = replace(source, generators=made_by)
    return tuple(sources.values())


def _candidates(request: InputRequest, ignored: list[tree.Ignored]) -> Iterator[Source]:
    top, _ = tree.list_folder(request.bids_dir)
    people = tree.read_people(request.participants_map)
    options = (request.freesurfer_dir, request.ashs_dir, request.hippunfold_dir)
    named: list[tuple[str, Path, tuple[str, ...]]]
    named = [(name, path, LAYOUTS) for name, path in request.derivatives.items()]
    named += [(name, path, (name,)) for name, path in zip(LAYOUTS, options, strict=False) if path]
    for name, path, layouts in named:
        tree.list_folder(path)  # what the user named has to be readable
        source = Source(name=name, path=path, explicit=True, layouts=layouts, people=people)
        roots = [] if tree.people_in(path, people) else _datasets(source, 1, ignored)
        for root in roots or [path]:
            yield replace(source, path=root)
    for folder in filter(top.__contains__, ("derivatives", "sourcedata")):
        path = request.bids_dir / folder
        source = Source(name=folder, path=path, explicit=False, origin=folder, people=people)
        for root in _datasets(source, 2, ignored):
            yield replace(source, name=root.name, path=root)
    # A dataset without a description may be a bare folder of subjects.
    description = read_description(request.bids_dir)
    derived = description is None or description.get("DatasetType") == "derivative"
    if derived or generated_by(description):
        name = request.bids_dir.resolve().name
        yield Source(name=name, path=request.bids_dir, explicit=False, people=people)
    else:
        ignored += [e for e in tree.sort_folders(request.bids_dir)[1] if not e.template]


def _datasets(source: Source, depth: int, ignored: list[tree.Ignored]) -> list[Path]:
    """Find the folders that hold subjects' folders by name, or by program where that is asked for.

    Searched are ``depth`` levels below the root, and the folders in each ``sourcedata`` on the way.
    What cannot be listed is left out: ``sourcedata`` is often closed to all but a few. Several
    folders of which none but the program's names say whose they are may be people with sessions as
    well as datasets, so these are not used.
    """
    datasets: list[Path] = []
    unsure: dict[Path, list[tree.SubjectFolder]] = {}
    unused: list[tree.Ignored] = []
    for path, folders, unclaimed in _walk(source, depth, ignored):
        if unclaimed is not None:
            unused += [entry for entry in unclaimed if entry.path.name != "sourcedata"]
            continue
        datasets.append(path)
        if path != source.path and all(folder.renamed for folder in folders):
            unsure[path] = folders
    if len(unsure) > 1:
        datasets = [path for path in datasets if path not in unsure]
        unused += [
            tree.Ignored(path=folder.path, reason=tree.UNSURE, subject=folder.subject)
            for folders in unsure.values()
            for folder in folders
        ]
    ignored += _with_row(unused, source.path, datasets)
    return datasets


def _with_row(
    unused: Sequence[tree.Ignored], root: Path, datasets: Sequence[Path]
) -> list[tree.Ignored]:
    """Select entries that have a row; a folder's row stands for its content."""
    # A folder of datasets may hold one that is called mri.
    claims = (*datasets, *(entry.path for entry in unused if not entry.template))
    inside = {root, *(parent for path in claims for parent in path.parents)}
    rows = (entry for entry in unused if entry.path not in inside.union(datasets))
    return [entry for entry in rows if entry.path.parent in inside or not entry.template]


def _walk(
    source: Source, depth: int, ignored: list[tree.Ignored]
) -> Iterator[tuple[Path, list[tree.SubjectFolder], list[tree.Ignored] | None]]:
    """Walk down to the datasets: folders of subjects or, in a folder that is none, its entries."""
    visited: set[str] = set()
    waiting = [(source.path, depth)]
    while waiting:
        path, below = waiting.pop()
        key = os.path.realpath(path)
        listed = None if key in visited else tree.try_to_list(path, ignored)
        visited.add(key)
        if listed is None:
            continue
        entries = tree.read_names(path, listed[0], any_name=source.any_name)
        folders = [entry for entry in entries.values() if isinstance(entry, tree.SubjectFolder)]
        unclaimed = [entry for entry in entries.values() if isinstance(entry, tree.Ignored)]
        is_named = any(name.startswith("sub-") for name in entries)
        if folders or is_named or tree.people_in(path, source.people):
            yield path, folders, None
            inner = [e.path.name for e in unclaimed if e.reason == tree.NO_SUBJECT]
            waiting += _next_folders(path, inner, 0)
        else:
            files = [tree.no_segmentation(path / name, tree.NO_SUBJECT) for name in listed[1]]
            yield path, [], unclaimed + files
            waiting += _next_folders(path, list(entries), below)


def _next_folders(path: Path, names: Sequence[str], depth: int) -> list[tuple[Path, int]]:
    """List the folders to search, last first, and their depths; ``sourcedata`` has one level."""
    depths = {name: 1 if name == "sourcedata" else depth - 1 for name in reversed(names)}
    return [(path / name, n) for name, n in depths.items() if n >= 0]


def list_participants(request: InputRequest) -> frozenset[str]:
    """List the participants of the BIDS dataset.

    From pybids's index where the user gave a place for it (made there on first use); otherwise from
    the names of the folders, as indexing thousands of subjects takes minutes.
    """
    if request.bids_database_dir is None:
        return frozenset(folder.subject for folder in tree.sort_folders(request.bids_dir)[0])
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
