"""Finding the segmentations of each hemisphere.

The flow: which datasets to search, and which subjects and sessions they hold (``scan``), which
files are segmentations (``layouts``; ``freesurfer``, ``ashs`` and ``generic`` have what is
special), and which of several to take. No image is opened, except where ASHS's atlas
can only be told from the labels.

A picture of labels on an image from another space misleads, so pages show only these images:

- FreeSurfer: ``norm.mgz``, else ``brain.mgz``, of the same ``mri`` folder;
- ASHS: the T2-weighted image that it segmented, ``tse.nii.gz`` or one with that ending, beside the
  segmentation or in the folder above ``final``;
- any other: a T1w or T2w image beside the labels or of the same visit in the BIDS dataset, if its
  space is that in the name of the labels (HippUnfold's ``space-cropT1w``), or if it has the same
  grid of voxels.
"""

import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from hipsta_bids.derivatives.dataset import read_description
from hipsta_bids.errors import InputError, NothingToDoError, UsageError
from hipsta_bids.inputs.ashs import choose_atlas
from hipsta_bids.inputs.edits import EditedFile, attach_edits, each_once, edits_of_visit, list_edits
from hipsta_bids.inputs.freesurfer import same_labels, without_labels
from hipsta_bids.inputs.generic import forget_tables, without_side
from hipsta_bids.inputs.layouts import LAYOUTS, atlas_finder, find, volume_table
from hipsta_bids.inputs.scan import (
    HEMIS,
    HemisphereInput,
    Ignored,
    InputRequest,
    Source,
    SubjectFolder,
    list_folder,
    list_participants,
    list_sources,
    list_visits,
    sort_folders,
)
from hipsta_bids.inputs.selection import Context, Selection, make_selection
from hipsta_bids.io.files import entities
from hipsta_bids.protocols.protocol import Protocol
from hipsta_bids.types import Hemisphere

__all__ = [
    "HEMIS",
    "Findings",
    "HemisphereInput",
    "InputRequest",
    "dataset_notes",
    "find_hemispheres",
    "find_inputs",
    "ignored_table",
    "list_subjects",
    "selection_table",
]

_LOOKED_FOR = (
    "FreeSurfer's mri/[lr]h.hippoAmygLabels*, ASHS's *_lfseg_*, HippUnfold's "
    "*_desc-subfields*_dseg, HSF's *_hippocampus_seg, NextBrain's seg*, and *_hemi-*_dseg with a "
    "table"
)

_NO_LABELS = "its mri folder holds no hippocampal subfields"

#: How many names an error message lists.
_LISTED_NAMES = 6


@dataclass(frozen=True, kw_only=True)
class Findings:
    """What a search found."""

    items: tuple[HemisphereInput, ...]
    """Sorted by subject, session, hemisphere, protocol. Some may have a ``problem``."""
    notes: tuple[str, ...] = ()
    """One line for each edited file that is not used, and for what is named anew or ignored."""
    ignored: tuple[Ignored, ...] = ()
    """What was not used though it seems meant to be, sorted by path."""


def find_hemispheres(request: InputRequest) -> tuple[HemisphereInput, ...]:
    """Find all segmentations that are asked for.

    Different protocols of one hemisphere (say, FreeSurfer's and ASHS's) are separate inputs. Where
    two datasets offer the same protocol, the one that the user named takes precedence, then
    ``derivatives`` over ``sourcedata``; usable comes before unusable.

    Parameters
    ----------
    request : InputRequest
        Where to look, and for what.

    Returns
    -------
    tuple of HemisphereInput
        Sorted by subject, session, hemisphere, protocol. Some may have a ``problem``.

    Raises
    ------
    HipstaError
        If there is none, or if folders, labels or files that the user named are not right.
    """
    return find_inputs(request).items


def find_inputs(request: InputRequest) -> Findings:
    """Find all segmentations that are asked for, and what is like them but not used."""
    selection = make_selection(request)
    option = choose_atlas(request)
    forget_tables()
    results = _Found()
    sources = list_sources(request, results.strays)
    results.edited = list_edits(request, selection, results.ignored)
    for source in sources:
        _search(source, selection, option, results)
    ignored = tuple(filter(selection.misses, results.unused()))
    if not results.items:
        error = _nothing(request, sources, ignored)
        for entry in ignored:
            error.add_note(f"not used: {entry.path}: {entry.reason}")
        raise error
    _check_analysis(results.items, request)
    items, notes = attach_edits(
        _without_clashes(results.items, sources), each_once(results.edited), selection
    )
    subjects = {item.subject for item in items}
    renamed = [
        f"{f.path.name} as sub-{f.subject}" for f in results.renamed if f.subject in subjects
    ]
    if renamed:
        notes += (f"renamed: {_count(renamed, 'FreeSurfer folder')}",)
    if unused := _unused(ignored):
        notes += (f"not used: {unused}; --dry-run and the log say why",)
    return Findings(items=items, notes=notes, ignored=ignored)


@dataclass(kw_only=True)
class _Found:
    """What the search has found so far."""

    items: list[HemisphereInput] = field(default_factory=list)
    edited: list[EditedFile] = field(default_factory=list)
    ignored: list[Ignored] = field(default_factory=list)
    strays: list[Ignored] = field(default_factory=list)
    """Entries that are no subject's by their names, unless an option says otherwise."""
    renamed: list[SubjectFolder] = field(default_factory=list)
    """Folders of wanted subjects whose names are not their labels."""

    def unused(self) -> list[Ignored]:
        """List each entry that was not used once, sorted by path."""
        renamed_paths = {_place(folder.path) for folder in self.renamed} if self.strays else set()
        entry_of = {_place(entry.path): entry for entry in reversed(self.strays)}
        entry_of = {path: entry for path, entry in entry_of.items() if path not in renamed_paths}
        entry_of |= {_place(entry.path): entry for entry in reversed(self.ignored)}
        return sorted(entry_of.values(), key=lambda entry: entry.path)


def _renaming(folders: Iterable[SubjectFolder]) -> dict[tuple[str, str | None], str]:
    """Write a note for each visit whose folders have names that are not its labels."""
    names: dict[tuple[str, str | None], list[str]] = {}
    for folder in folders:
        if folder.renamed:
            names.setdefault((folder.subject, folder.session), []).append(folder.path.name)
    return {
        key: f"FreeSurfer's name of sub-{key[0]} is {' and '.join(known)}"
        for key, known in names.items()
    }


def _place(path: Path) -> str:
    """Where an entry is, however its folder was reached; the entry itself may be any link."""
    return os.path.join(os.path.realpath(path.parent), path.name)  # noqa: PTH118 (many of them)


def ignored_table(ignored: Iterable[Ignored]) -> list[dict[str, str]]:
    """Describe what was not used, one row per folder."""
    return [{"not used": str(entry.path), "why": entry.reason} for entry in ignored]


def list_subjects(request: InputRequest) -> tuple[str, ...]:
    """List the subjects that are asked for and have a folder in any dataset to be searched."""
    selection = make_selection(request)
    return tuple(
        sorted(
            {
                folder.subject
                for source in list_sources(request)
                for folder in sort_folders(source.path, any_name=source.any_name)[0]
                if selection.wants_folder(folder)
            }
        )
    )


def selection_table(items: Iterable[HemisphereInput]) -> list[dict[str, str]]:
    """Describe what was found and why, one row per hemisphere and protocol."""
    return [
        {
            "subject": item.subject,
            "session": item.session or "n/a",
            "hemisphere": item.hemi,
            "file": " + ".join(_relative(path, item.source_path) for path in item.files),
            "scheme": item.protocol.name,
            "why": "; ".join((f"{item.source}: {item.explanation}", *item.notes))
            + (f"; NOT USABLE: {item.problem}" if item.problem else ""),
            "edited": " + ".join(_relative(edit.path, edit.source_path) for edit in item.edits)
            or "n/a",
            "passed over": "; ".join(f"{name}: {why}" for name, why in item.passed_over) or "n/a",
        }
        for item in items
    ]


def dataset_notes(request: InputRequest, items: Iterable[HemisphereInput]) -> tuple[str, ...]:
    """List what a user should know about the dataset as a whole."""
    notes = []
    if read_description(request.bids_dir) is None:
        notes.append(
            f"{request.bids_dir} has no dataset_description.json, which BIDS requires; going on"
        )
    selection = make_selection(request)
    expected = selection.subjects or list_participants(request)
    without = sorted(expected - selection.excluded - {item.subject for item in items})
    if without:
        notes.append(f"no segmentation found for {_count(without, 'participant')}")
    return tuple(notes)


def _search(source: Source, selection: Selection, option: Protocol | None, results: _Found) -> None:
    """Search one dataset for all kinds of segmentations, and add the edited files beside them."""
    all_folders, strays = sort_folders(source.path, any_name=source.any_name)
    refused = same_labels(all_folders)
    folders = list(filter(selection.wants_folder, all_folders))
    results.strays += strays
    results.renamed += [folder for folder in folders if folder.renamed]
    renaming = _renaming(folders)
    context = Context(source=source, selection=selection, atlas=option)
    context = replace(context, atlases=atlas_finder(context))
    searched = [layout for layout in LAYOUTS if layout.kind in source.layouts]
    for visit in filter(selection.wants_visit, list_visits(folders, results.ignored)):
        results.edited += edits_of_visit(visit, source.path, source.name, beside=True)
        items = [i for layout in searched for i in find(layout, replace(context, visit=visit))]
        results.ignored += without_side(visit) if "named" in source.layouts else ()
        used_files = [file for item in items for file in item.files]
        results.ignored += [
            Ignored(path=path, reason=_NO_LABELS, subject=visit.subject)
            for path in (without_labels(visit) if "freesurfer" in source.layouts else ())
            if not any(file.is_relative_to(path) for file in used_files)
        ]
        for item in items:
            problem = item.problem or refused.get(item.subject)
            note = renaming.get((item.subject, item.session))
            notes = item.notes if note is None else (*item.notes, note)
            results.items.append(replace(item, problem=problem, notes=notes))


def _without_clashes(
    candidates: list[HemisphereInput], sources: tuple[Source, ...]
) -> tuple[HemisphereInput, ...]:
    """Keep one input per hemisphere and protocol."""
    order = {source.path: index for index, source in enumerate(sources)}
    items: dict[tuple[str, str, str, str], HemisphereInput] = {}
    for item in sorted(
        candidates, key=lambda item: (item.problem is not None, order[item.source_path])
    ):
        first = items.setdefault(item.key, item)
        if first is not item:
            reason = f"same hemisphere and protocol as in {first.source}, which comes first"
            if item.problem is not None and first.problem is None:
                reason = f"not usable ({item.problem.reason})"
            rejected = (str(item.files[0]), reason)
            items[item.key] = replace(first, passed_over=(*first.passed_over, rejected))
    return tuple(items[key] for key in sorted(items))


def _check_analysis(items: list[HemisphereInput], request: InputRequest) -> None:
    """Refuse an analysis that no hemisphere has: a typing error."""
    analyses = [item for item in items if item.protocol.tool == "freesurfer"]
    missing = [
        item.problem
        for item in analyses
        if item.problem and item.problem.reason == "analysis-missing"
    ]
    if request.fs_analysis and missing and len(missing) == len(analyses):
        raise UsageError(
            f"--fs-analysis {request.fs_analysis}: no hemisphere has it ({missing[0]})"
        )


def _nothing(
    request: InputRequest, sources: tuple[Source, ...], ignored: tuple[Ignored, ...]
) -> NothingToDoError:
    """Describe what was looked for, and where, and what was not used."""
    searched = ", ".join(str(source.path) for source in sources)
    restricted = (
        *(f"--participant-label {label}" for label in request.participant_labels[:_LISTED_NAMES]),
        *(
            f"--exclude-participant-label {label}"
            for label in request.excluded_labels[:_LISTED_NAMES]
        ),
        *(f"--session-label {label}" for label in request.session_labels[:_LISTED_NAMES]),
        *(f"--hemi {hemi}" for hemi in request.hemis if request.hemis != HEMIS),
        *([f"--bids-filter-file {request.bids_filter_file}"] if request.bids_filter_file else []),
    )
    missed = [entry for entry in ignored if not entry.template]
    unused = f". Not used: {_unused(missed)}: {missed[0].reason}" if missed else ""
    if not sources:
        return NothingToDoError(
            f"{request.bids_dir}: no derivatives/* or sourcedata/* with sub-* folders; "
            f"name the dataset with the segmentations: -d NAME=PATH{unused}"
        )
    if restricted:
        subjects = {
            folder.subject
            for source in sources
            for folder in sort_folders(source.path, any_name=source.any_name)[0]
        }
        return NothingToDoError(
            f"no hippocampal segmentation matches {' '.join(restricted)} in {searched} "
            f"(which hold {_count(sorted(subjects), 'subject')}; looked for {_LOOKED_FOR}){unused}"
        )
    return NothingToDoError(
        f"no hippocampal segmentation in {searched} (looked for {_LOOKED_FOR}); "
        f"name another dataset: -d NAME=PATH{unused}"
    )


def _unused(ignored: Iterable[Ignored]) -> str:
    """Count and name what somebody may miss; empty if there is nothing."""
    missed = [entry for entry in ignored if not entry.template]
    kinds = {entry.path.is_file() for entry in missed}
    noun = "name" if len(kinds) > 1 else "file" if kinds == {True} else "folder"
    return _count([entry.name for entry in missed], noun) if missed else ""


def _count(names: list[str], noun: str) -> str:
    ellipsis = ", ..." if len(names) > _LISTED_NAMES else ""
    plural = "" if len(names) == 1 else "s"
    listed = f" ({', '.join(names[:_LISTED_NAMES])}{ellipsis})" if names else ""
    return f"{len(names)} {noun}{plural}{listed}"


def _relative(path: Path, root: Path) -> str:
    return str(path.relative_to(root)) if path.is_relative_to(root) else str(path)


_FREESURFER = ("norm.mgz", "brain.mgz")
_ASHS = re.compile(r"(?:.+_)?tse(?:_native_chunk_(?P<side>left|right))?\.nii(?:\.gz)?")
_SIDES = {"L": "left", "R": "right"}
#: T2-weighted images, which show the subfields, before others.
_SUFFIXES = ("T2w", "T1w")
_IMAGES = {".nii.gz", ".nii", ".mgz"}


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """An image that may be in the space of the labels."""

    path: Path
    proven: bool
    """Its place or name says that it is in this space; else only the same grid of voxels does."""


def find_anatomy(labels: Path, hemisphere: Hemisphere, bids_dir: Path) -> Iterator[Candidate]:
    """List anatomical images that may lie behind a hemisphere's labels, best first, unopened."""
    if volume_table(labels, "freesurfer") is not None:
        for name in _FREESURFER:
            if (path := labels.with_name(name)).is_file():
                yield Candidate(path=path, proven=True)
        return
    if volume_table(labels, "ashs") is not None:
        folder = labels.parent
        for parent in (folder, folder.parent) if folder.name == "final" else (folder,):
            for name in _names(parent):
                match = _ASHS.fullmatch(name)
                if match and match["side"] in (None, _SIDES[hemisphere.hemi]):
                    yield Candidate(path=parent / name, proven=True)
    visit = bids_dir / f"sub-{hemisphere.subject}"
    if hemisphere.session is not None:
        visit /= f"ses-{hemisphere.session}"
    yield from _named(labels, hemisphere, (labels.parent, visit / "anat"))


def _named(labels: Path, hemisphere: Hemisphere, folders: tuple[Path, ...]) -> Iterator[Candidate]:
    """List T1w and T2w images in some folders, those in the space of the labels first."""
    space = entities(labels.name).get("space", "")
    # HippUnfold's crops lie in the space of the whole image.
    whole = space.removeprefix("crop")
    images = []
    for folder in dict.fromkeys(folders):
        for name in _names(folder):
            pairs = entities(name)
            if (
                pairs["suffix"] in _SUFFIXES
                and pairs["extension"] in _IMAGES
                and pairs.get("hemi", hemisphere.hemi) == hemisphere.hemi
                and pairs.get("sub", hemisphere.subject) == hemisphere.subject
                and pairs.get("ses", hemisphere.session) == hemisphere.session
            ):
                # An image whose name has no space is in its own.
                image_space = pairs.get("space", pairs["suffix"])
                images.append((folder / name, image_space, pairs["suffix"]))
    counts = Counter((path.parent, image_space) for path, image_space, _ in images)

    def rank(entry: tuple[Path, str, str]) -> tuple[bool, bool, int]:
        _, image_space, suffix = entry
        return image_space != space, image_space != whole, _SUFFIXES.index(suffix)

    for path, image_space, _ in sorted(images, key=rank):
        # Of several runs, the name does not say in whose space the labels are.
        proven = (
            bool(space) and image_space in (space, whole) and counts[path.parent, image_space] == 1
        )
        yield Candidate(path=path, proven=proven)


def _names(folder: Path) -> tuple[str, ...]:
    """List the files of a folder by name; none where it cannot be listed."""
    try:
        return tuple(sorted(list_folder(folder)[1]))
    except InputError:
        return ()
