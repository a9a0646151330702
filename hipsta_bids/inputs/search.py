"""Finding the segmentations of each hemisphere.

The flow: which datasets to search, and which subjects and sessions they hold (``scan``), which
files are segmentations (``layouts``; ``freesurfer``, ``ashs`` and ``generic`` have what is
special), and which of several to take. No image is opened, except where ASHS's atlas
can only be identified from the labels.

A picture of labels on an image from another space misleads, so pages show only these images:

- FreeSurfer: ``norm.mgz``, else ``brain.mgz``, of the same ``mri`` folder;
- ASHS: the T2-weighted image that it segmented, ``tse.nii.gz`` or one with that ending, next to the
  segmentation or in the folder above ``final``;
- any other: a T1w or T2w image next to the labels or of the same visit in the BIDS dataset, if its
  space is that in the name of the labels (HippUnfold's ``space-cropT1w``), or if it has the same
  grid of voxels.
"""

import os
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from hipsta_bids.derivatives.dataset import PROVENANCE, counts_text, read_description
from hipsta_bids.errors import InputError, NothingToDoError, UsageError, did_you_mean
from hipsta_bids.inputs import scan, tree
from hipsta_bids.inputs.account import looked_into, unused_of_visit
from hipsta_bids.inputs.ashs import choose_atlas
from hipsta_bids.inputs.edits import EditedFile, attach_edits, each_once, edits_of_visit, list_edits
from hipsta_bids.inputs.generic import forget_tables, without_side
from hipsta_bids.inputs.layouts import LAYOUTS, Layout, atlas_finder, find, volume_table
from hipsta_bids.inputs.probabilities import attach_probabilities
from hipsta_bids.inputs.scan import HEMIS, HemisphereInput, InputRequest, Source
from hipsta_bids.inputs.selection import Context, Selection, make_selection
from hipsta_bids.io.files import entities
from hipsta_bids.io.labels import refuse_alike
from hipsta_bids.opening import not_fetched
from hipsta_bids.protocols.protocol import Protocol
from hipsta_bids.types import Hemisphere, VisitKey

__all__ = [
    "HEMIS",
    "Findings",
    "HemisphereInput",
    "InputRequest",
    "count_names",
    "dataset_notes",
    "find_hemispheres",
    "find_inputs",
    "list_subjects",
]

_LOOKED_FOR = (
    "FreeSurfer's mri/[lr]h.hippoAmygLabels*, ASHS's *_lfseg_*, HippUnfold's "
    "*_desc-subfields*_dseg, HSF's *_hippocampus_seg, NextBrain's seg*, and *_hemi-*_dseg with a "
    "table"
)

#: How many names an error message lists.
_LISTED_NAMES = 6


@dataclass(frozen=True, kw_only=True)
class Findings:
    """Results of a search."""

    items: tuple[HemisphereInput, ...]
    """Sorted by subject, session, hemisphere, protocol. Some may have a ``problem``."""
    notes: tuple[str, ...] = ()
    """One line for each edited file that is not used, and for what is named anew or ignored."""
    ignored: tuple[tree.Ignored, ...] = ()
    """What was not used though it seems meant to be, and templates, sorted by path."""
    other_entries: tuple[tree.Ignored, ...] = ()
    """All other entries: nothing in them is a segmentation."""


def find_hemispheres(request: InputRequest) -> tuple[HemisphereInput, ...]:
    """Find all segmentations that are asked for.

    Different protocols of one hemisphere (as FreeSurfer's and ASHS's) are separate inputs. Where
    two datasets offer the same protocol, the one that the user named takes precedence, then
    ``derivatives`` over ``sourcedata``; usable before unusable.

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
    """Find all segmentations that are asked for, and files like them that are not used."""
    selection = make_selection(request)
    option = choose_atlas(request)
    forget_tables()
    results = _Search()
    sources = scan.list_sources(request, results.unused)
    results.edited = list_edits(request, selection, results.unused)
    for source in sources:
        _search(source, selection, option, results)
    results.unused += _without_dataset(request, sources)
    entries = [entry for entry in results.entries(sources) if selection.misses(entry)]
    ignored = tuple(entry for entry in entries if not entry.quiet)
    accounted = {item.subject for item in results.items} | {entry.subject for entry in ignored}
    missing = {e.path: e for e in _unlabeled(request, selection) if e.subject not in accounted}
    unmissed = [entry for entry in entries if entry.quiet and entry.path not in missing]
    if not results.items:
        error = _nothing(request, sources, ignored)
        for entry in ignored:
            error.add_note(f"not used: {entry.path}: {entry.reason}")
        raise error
    _check_analysis(results.items, request)
    unedited, used_notes = attach_probabilities(
        _without_clashes(results.items, sources), request.probabilities
    )
    items, notes = attach_edits(unedited, each_once(results.edited), selection)
    notes = (*notes, *used_notes, *_search_notes(items, results.renamed, ignored))
    unmissed += missing.values()
    return Findings(items=items, notes=notes, ignored=ignored, other_entries=tuple(unmissed))


def _unlabeled(request: InputRequest, selection: Selection) -> Iterator[tree.Ignored]:
    """List the subjects' folders of the BIDS dataset, as without labels."""
    folders = [] if request.bids_database_dir else tree.sort_folders(request.bids_dir)[0]
    for folder in filter(selection.wants_folder, folders):
        reason = "no dataset has labels of it"
        yield tree.Ignored(path=folder.path, subject=folder.subject, reason=reason, quiet=True)


def _without_dataset(request: InputRequest, sources: Sequence[Source]) -> list[tree.Ignored]:
    """List the folders of ``--participants-map`` that no dataset has."""
    lacking = [
        folder
        for folder in tree.read_people(request.participants_map)
        if not any((source.path / folder).is_dir() for source in sources)
    ]
    present = [name for s in sources if lacking for name in tree.list_folder(s.path)[0]]
    refuse_alike(lacking, present, f"{request.participants_map}: column folder")
    reason = "named in --participants-map, but no dataset has it"
    return [tree.Ignored(path=Path(folder), reason=reason) for folder in lacking]


def _search_notes(
    items: Iterable[HemisphereInput],
    renamed: Iterable[tree.SubjectFolder],
    ignored: Sequence[tree.Ignored],
) -> Iterator[str]:
    """Note renamed folders, visits with one hemisphere, and entries that are not used."""
    subjects = {item.subject for item in items}
    names = [
        f"{f.path.name} as sub-{f.subject}{f'_ses-{f.session}' if f.session else ''}"
        for f in renamed
        if f.subject in subjects
    ]
    if names:
        yield f"renamed: {count_names(names, 'folder')}"
    if sides := [f"{e.inside.name} {e.hemi}" for e in ignored if e.hemi and e.inside]:
        yield f"no labels of one hemisphere: {count_names(sides, 'visit')}"
    if text := _unused(ignored):
        yield f"not used: {text}; see --dry-run and the log for the reasons"


@dataclass(kw_only=True)
class _Search:
    """Results of the search so far."""

    items: list[HemisphereInput] = field(default_factory=list)
    edited: list[EditedFile] = field(default_factory=list)
    unused: list[tree.Ignored] = field(default_factory=list)
    renamed: list[tree.SubjectFolder] = field(default_factory=list)
    """Folders of wanted subjects whose names are not their labels."""

    def entries(self, sources: Sequence[Source]) -> list[tree.Ignored]:
        """List each entry that was not used once, sorted by path."""
        # What is known about an entry inside of a subject's folder comes first.
        templates = [entry for entry in self.unused if entry.inside and entry.template]
        strays = [entry for entry in self.unused if entry.inside is None]
        missed = [entry for entry in self.unused if entry.inside and not entry.template]
        searched = {os.path.realpath(source.path) for source in sources}
        searched |= {_place(folder.path) for folder in self.renamed} if strays else set()
        entry_of: dict[tuple[str, str | None], tree.Ignored] = {}
        for entry in (*missed, *strays):
            entry_of.setdefault((_place(entry.path), entry.hemi), entry)
        listed = map(looked_into, _with_row(entry_of, searched))
        return sorted(listed, key=lambda entry: (entry.path, entry.hemi or "")) + templates


def _with_row(
    entry_of: Mapping[tuple[str, str | None], tree.Ignored], searched: Collection[str]
) -> Iterator[tree.Ignored]:
    """Select entries that have a row: not what holds other entries, or is used by an option."""
    claims = [place for (place, _), entry in entry_of.items() if not entry.quiet]
    above = {str(parent) for path in (*searched, *claims) for parent in Path(path).parents}
    for (place, _), entry in entry_of.items():
        if place not in (above if entry.quiet else ()) and (entry.inside or place not in searched):
            yield entry


def _renaming(folders: Iterable[tree.SubjectFolder]) -> dict[VisitKey, list[str]]:
    """Write a note for each visit whose folders have names that are not its labels."""
    names: dict[VisitKey, list[str]] = {}
    for folder in folders:
        if folder.renamed:
            names.setdefault((folder.subject, folder.session), []).append(folder.path.name)
    return {key: [f"the folder of sub-{key[0]} is {' and '.join(names[key])}"] for key in names}


def _place(path: Path) -> str:
    """Where an entry is, however its folder was reached; the entry itself may be any link."""
    return os.path.join(os.path.realpath(path.parent), path.name)  # noqa: PTH118 (many of them)


def list_subjects(request: InputRequest) -> tuple[str, ...]:
    """List the subjects that are asked for and have a folder in any dataset to be searched."""
    selection = make_selection(request)
    return tuple(
        sorted(
            {
                folder.subject
                for source in scan.list_sources(request)
                for folder in source.folders()[0]
                if selection.wants_folder(folder)
            }
        )
    )


def dataset_notes(
    request: InputRequest, items: Iterable[HemisphereInput], part: Sequence[str] | None = None
) -> tuple[str, ...]:
    """List what a user should know about the dataset, or about a part of its subjects."""
    notes = []
    if read_description(request.bids_dir) is None:
        notes.append(
            f"{request.bids_dir} has no dataset_description.json, which BIDS requires; going on"
        )
    selection = make_selection(request)
    expected = selection.subjects or scan.list_participants(request)
    expected &= expected if part is None else set(part)
    present = {item.subject for item in items}
    if without := sorted(expected - selection.excluded - present):
        hint = did_you_mean(selection.subjects.intersection(without), present)
        notes.append(f"no segmentation found for {count_names(without, 'participant')}{hint}")
    usable = [item for item in items if item.problem is None]
    segmentations = Counter(item.protocol.name for item in usable)
    if len(segmentations) > 1:
        notes.append(f"several protocols: {counts_text(segmentations)}; group takes one: --seg")
    for name in PROVENANCE if len(segmentations) == 1 else ():
        # Sizes of voxels vary a little within a protocol; the group level compares them.
        kinds = Counter(item.origin[name] for item in usable if name != "voxel_size")
        if len(kinds) > 1:
            notes.append(
                f"labels differ in {name}: {counts_text(kinds)}; group refuses this mix"
                f" unless --mixed {name} allows it"
            )
    return tuple(notes)


def _search(
    source: Source, selection: Selection, option: Protocol | None, results: _Search
) -> None:
    """Search one dataset for all kinds of segmentations, and add the edited files next to them."""
    all_folders, strays = source.folders()
    refused = tree.same_labels(all_folders)
    folders = list(filter(selection.wants_folder, all_folders))
    results.unused += strays
    results.renamed += [folder for folder in folders if folder.renamed]
    renaming = _renaming(folders)
    context = Context(source=source, selection=selection, atlas=option)
    context = replace(context, identify_atlas=atlas_finder(context).identify)
    searched = [layout for layout in LAYOUTS if layout.kind in source.layouts]
    closed: list[tree.Ignored] = []
    visits = list(filter(selection.wants_visit, tree.list_visits(folders, closed)))
    results.unused += closed
    # Folders that cannot be listed have separate rows, and the parents of sessions need none.
    explained = {entry.subject for entry in closed} | {
        visit.subject for visit in visits if visit.session
    }
    for visit in visits:
        results.edited += edits_of_visit(visit, source.path, source.name, in_dataset=True)
        visit_context = replace(context, visit=visit)
        fitting = _with_mark(searched, visit)
        items = [item for layout in fitting for item in find(layout, visit_context)]
        results.unused += without_side(visit) if "named" in source.layouts else ()
        explain = visit.subject not in explained
        results.unused += unused_of_visit(visit_context, items, explain=explain)
        notes = renaming.get((visit.subject, visit.session), ())
        results.items += [_noted(item, refused.get(item.subject), notes) for item in items]


def _with_mark(layouts: Iterable[Layout], visit: tree.VisitFolders) -> list[Layout]:
    """Return the layouts whose names of files a visit can have."""
    names = "\n".join(name for folder in visit.folders for name in folder.names)
    return [layout for layout in layouts if layout.mark in names]


def _noted(
    item: HemisphereInput, refusal: InputError | None, notes: Sequence[str]
) -> HemisphereInput:
    """Add notes and the first problem, if there are any."""
    problem = refusal or item.problem or _not_fetched(item.files)
    if problem is item.problem and not notes:
        return item
    return replace(item, problem=problem, notes=(*item.notes, *notes))


def _not_fetched(paths: Sequence[Path]) -> InputError | None:
    """Describe that the content of a file is elsewhere."""
    for path in paths:
        if message := not_fetched(path):
            return InputError(f"{path}: {message}", reason="not-fetched")
    return None


def _without_clashes(
    candidates: list[HemisphereInput], sources: tuple[Source, ...]
) -> tuple[HemisphereInput, ...]:
    """Keep one input per hemisphere and protocol."""
    order = {source.path: index for index, source in enumerate(sources)}
    origin = {source.path: source.origin for source in sources}
    items: dict[tuple[str, str, str, str], HemisphereInput] = {}
    for item in sorted(
        candidates, key=lambda item: (item.problem is not None, order[item.source_path])
    ):
        first = items.setdefault(item.key, item)
        if first is not item:
            reason = f"same hemisphere and protocol as in {first.source}, which is preferred"
            problem = first.problem
            if item.problem is not None and first.problem is None:
                reason = f"not usable ({item.problem.reason})"
            elif origin[item.source_path] and origin[item.source_path] == origin[first.source_path]:
                problem = problem or InputError(
                    f"{first.source} and {item.source} both have labels of {item.protocol.name};"
                    f" choose one: -d {first.source}={first.source_path}",
                    reason="several-pipelines",
                )
            rejected = (str(item.files[0]), reason)
            passed_over = (*first.passed_over, rejected)
            items[item.key] = replace(first, passed_over=passed_over, problem=problem)
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
    request: InputRequest, sources: tuple[Source, ...], ignored: tuple[tree.Ignored, ...]
) -> NothingToDoError:
    """Describe what was looked for, and where, and what was not used."""
    searched = ", ".join(str(source.path) for source in sources)
    limits: dict[str, Sequence[object]] = {
        "--participant-label": request.participant_labels,
        "--exclude-participant-label": request.excluded_labels,
        "--session-label": request.session_labels,
        "--hemi": () if request.hemis == HEMIS else request.hemis,
        "--bids-filter-file": list(filter(None, [request.bids_filter_file])),
    }
    restricted = [
        f"{option} {value}" for option, values in limits.items() for value in values[:_LISTED_NAMES]
    ]
    missed = [entry for entry in ignored if not entry.template]
    unused = f". Not used: {_unused(missed)}: {missed[0].reason}" if missed else ""
    if not sources:
        return NothingToDoError(
            f"{request.bids_dir}: no derivatives/* or sourcedata/* with sub-* folders; "
            f"name the dataset with the segmentations: -d NAME=PATH{unused}"
        )
    if restricted:
        hint, contents = _labels_hint(request, sources)
        return NothingToDoError(
            f"no hippocampal segmentation matches {' '.join(restricted)} in {searched} (which hold"
            f" {contents}; looked for {_LOOKED_FOR}){hint}{unused}"
        )
    return NothingToDoError(
        f"no hippocampal segmentation in {searched} (looked for {_LOOKED_FOR}); "
        f"name another dataset: -d NAME=PATH{unused}"
    )


def _labels_hint(request: InputRequest, sources: Sequence[Source]) -> tuple[str, str]:
    """Return labels like unmatched ones, and the subjects and sessions that datasets hold."""
    folders = [folder for source in sources for folder in source.folders()[0]]
    subjects = {folder.subject for folder in folders}
    unmatched = {label.removeprefix("sub-") for label in request.participant_labels} - subjects
    hint, contents = (
        did_you_mean(sorted(unmatched), subjects),
        count_names(sorted(subjects), "subject"),
    )
    if request.session_labels:
        sessions = {visit.session for visit in tree.list_visits(folders) if visit.session}
        absent = {label.removeprefix("ses-") for label in request.session_labels} - sessions
        hint = hint or did_you_mean(sorted(absent), sessions)
        contents += f" and {count_names(sorted(sessions), 'session')}"
    return hint, contents


def _unused(ignored: Iterable[tree.Ignored]) -> str:
    """Count and name what somebody may miss; empty if there is nothing."""
    missed = [entry for entry in ignored if not (entry.template or entry.hemi)]
    kinds = {entry.path.is_file() for entry in missed}
    noun = "name" if len(kinds) > 1 else "file" if kinds == {True} else "folder"
    return count_names([entry.name for entry in missed], noun) if missed else ""


def count_names(names: list[str], noun: str) -> str:
    """Count names, and list the first ones."""
    ellipsis = ", ..." if len(names) > _LISTED_NAMES else ""
    plural = "" if len(names) == 1 else "s"
    listed = f" ({', '.join(names[:_LISTED_NAMES])}{ellipsis})" if names else ""
    return f"{len(names)} {noun}{plural}{listed}"


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
                # An image whose name has no space defines one.
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
        return tuple(sorted(tree.list_folder(folder)[1]))
    except InputError:
        return ()
