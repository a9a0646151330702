"""What a person corrected or placed: labels, masks, and the end planes of the body.

``*_desc-edited_dseg`` and ``*_desc-edited_mask`` lie next to the labels that they correct, in the
output dataset, or in a separate folder (``--edited-dir``), arranged like a BIDS derivative:
``sub-X[/ses-Y]/anat/sub-X[_ses-Y]_hemi-H[_seg-P]_desc-edited_dseg``.

The table of ``--ends`` has one row per end: ``participant_id``, ``session`` where there are
sessions, ``hemi``, ``end``, a point ``r``, ``a``, ``s`` and, if the plane's direction is given too,
its normal ``nr``, ``na``, ``ns``.
"""

import contextlib
import math
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from hipsta_bids.errors import HipstaError, InputError
from hipsta_bids.inputs import scan, tree
from hipsta_bids.inputs.generic import is_edited, table_protocol
from hipsta_bids.inputs.selection import Selection
from hipsta_bids.io import files
from hipsta_bids.io.files import entities
from hipsta_bids.io.labels import match_labels
from hipsta_bids.types import End, GivenEnd, Visit

#: Names under which ``--edited-dir`` and the output dataset appear in addresses.
_EDITED, _OUTPUT = "edited", "output"

#: What an edited file replaces, by its suffix.
_KINDS = {"dseg": "labels", "mask": "mask"}

#: Columns of the table of ends.
_POINT, _NORMAL = ("r", "a", "s"), ("nr", "na", "ns")
_NAMES = ("participant_id", "hemi", "end")
_ENDS = ("posterior", "anterior")


@dataclass(frozen=True, kw_only=True)
class EditedFile(Visit):
    """An edited file, and whose it is."""

    edit: scan.Edit
    in_dataset: bool
    """Whether it is in a dataset of segmentations, not in the folder of edits."""

    @property
    def names(self) -> dict[str, str]:
        """Entities of its name."""
        return entities(self.edit.path.name)


def edits_of_visit(
    visit: tree.VisitFolders, root: Path, source: str, *, in_dataset: bool
) -> Iterator[EditedFile]:
    """List the edited files in the folders of one visit."""
    for folder in visit.folders:
        for name in filter(is_edited, folder.names):
            kind = _KINDS[entities(name)["suffix"]]
            edit = scan.Edit(kind=kind, path=folder.path / name, source=source, source_path=root)
            yield EditedFile(
                edit=edit, subject=visit.subject, session=visit.session, in_dataset=in_dataset
            )


def list_edits(
    request: scan.InputRequest, selection: Selection, ignored: list[tree.Ignored]
) -> list[EditedFile]:
    """List the edited files of ``--edited-dir`` and of the output dataset."""
    edited_files = []
    if request.edited_dir is not None:
        edited_files += _edits_of_dataset(request.edited_dir, _EDITED, selection, ignored)
    # Whether the output folder can be used is checked where results are written.
    with contextlib.suppress(InputError):
        if request.output_dir is not None:
            edited_files += _edits_of_dataset(request.output_dir, _OUTPUT, selection, ignored)
    return each_once(edited_files)


def _edits_of_dataset(
    root: Path, name: str, selection: Selection, ignored: list[tree.Ignored]
) -> list[EditedFile]:
    folders, other_entries = tree.sort_folders(root)
    ignored += [entry for entry in other_entries if not entry.quiet]
    selected_folders = filter(selection.wants_folder, folders)
    return [
        file
        for visit in filter(selection.wants_visit, tree.list_visits(selected_folders, ignored))
        for file in edits_of_visit(visit, root, name, in_dataset=False)
    ]


def each_once(edited: Iterable[EditedFile]) -> list[EditedFile]:
    """Keep the first of entries for the same file: folders may be given twice."""
    return list(
        {os.path.realpath(file.edit.path): file for file in reversed(list(edited))}.values()
    )[::-1]


def attach_edits(
    items: Iterable[scan.HemisphereInput], edited: Iterable[EditedFile], selection: Selection
) -> tuple[tuple[scan.HemisphereInput, ...], tuple[str, ...]]:
    """Attach the files that correct each hemisphere, and note files that correct none."""
    corrected = list(items)
    corrections: dict[int, list[EditedFile]] = {}
    notes = []
    for file in edited:
        hemi = file.names.get("hemi")
        if hemi in scan.HEMIS and hemi not in selection.wanted_hemis():
            continue
        matching = [n for n, item in enumerate(corrected) if _corrects(file, item)]
        for n in matching:
            corrections.setdefault(n, []).append(file)
        if not matching:
            notes.append(f"{file.edit.path}: edited file not used: {_why_not(file, corrected)}")
        elif len(matching) > 1:
            names = " and ".join(corrected[n].protocol.name for n in matching)
            problem = InputError(
                f"{file.edit.path}: corrects the labels of {names}; name one, as in "
                f"_seg-{corrected[matching[0]].protocol.name}_desc-edited_",
                reason="edit-ambiguous",
            )
            for n in matching:
                corrected[n] = replace(corrected[n], problem=corrected[n].problem or problem)
    for n, corrected_by in corrections.items():
        corrected[n] = _corrected(corrected[n], [file.edit for file in corrected_by])
    return tuple(corrected), tuple(notes)


def _corrects(file: EditedFile, item: scan.HemisphereInput) -> bool:
    names = file.names
    return (
        _misnamed(file) is None
        and (file.subject, file.session, names["hemi"]) == (item.subject, item.session, item.hemi)
        and names.get("seg", item.protocol.name) == item.protocol.name
        and (not file.in_dataset or file.edit.path.parent in {path.parent for path in item.files})
    )


def _misnamed(file: EditedFile) -> str | None:
    """Describe what is wrong with a name, if anything."""
    names = file.names
    if names.get("hemi") not in scan.HEMIS:
        return "its name has no hemi-L or hemi-R"
    for key, folder_label in (("sub", file.subject), ("ses", file.session)):
        if names.get(key, folder_label) != folder_label:
            return f"its name has {key}-{names[key]}, but its folder is another one's"
    return None


def _why_not(file: EditedFile, items: list[scan.HemisphereInput]) -> str:
    """Explain why a file corrects nothing."""
    misnamed = _misnamed(file)
    if misnamed:
        return misnamed
    hemi = file.names["hemi"]
    hemisphere = f"sub-{file.subject}{f' ses-{file.session}' if file.session else ''} hemi-{hemi}"
    candidates = [
        item
        for item in items
        if (item.subject, item.session, item.hemi) == (file.subject, file.session, hemi)
    ]
    if not candidates:
        return f"no labels of {hemisphere} are processed"
    protocols = {item.protocol.name for item in candidates}
    if file.names.get("seg", candidates[0].protocol.name) not in protocols:
        return (
            f"its name has seg-{file.names['seg']}, but {hemisphere} has "
            f"seg-{', seg-'.join(protocols)}"
        )
    return (
        f"it does not lie beside the labels of {hemisphere} ({candidates[0].files[0].parent}); move"
        " it there, or name its folder with --edited-dir"
    )


def _corrected(item: scan.HemisphereInput, edits: list[scan.Edit]) -> scan.HemisphereInput:
    """Attach the edits of one hemisphere, if there is one of each kind at most."""
    for kind in _KINDS.values():
        candidates = [edit.path for edit in edits if edit.kind == kind]
        if len(candidates) > 1:
            problem = InputError(
                f"{' and '.join(map(str, candidates))}: two edited files with the {kind} of one "
                "hemisphere; keep one",
                reason="edit-ambiguous",
            )
            return replace(item, edits=tuple(edits), problem=item.problem or problem)
    return _described(replace(item, edits=tuple(edits)))


def _described(item: scan.HemisphereInput) -> scan.HemisphereInput:
    """Let a label table of the same name as the edited labels say what their codes are."""
    labels = item.edit("labels")
    if labels is None:
        return item
    name = labels.path.name.partition(".")[0]
    table = labels.path.with_name(f"{name}.tsv")
    if not table.exists():
        return item
    try:
        protocol = table_protocol(table, item.protocol.name)
    except HipstaError as error:
        return replace(item, problem=item.problem or error)
    # The citation is that of the protocol; a table has none.
    description = {"title": item.protocol.title, "citation": item.protocol.citation}
    protocol = protocol.model_copy(update=description)
    return replace(
        item,
        protocol=protocol,
        parts_protocol=None,
        files=item.files[:1],
        bilateral=False,
        notes=(*item.notes, f"edited labels are named by {table.name}"),
    )


@dataclass(frozen=True, kw_only=True)
class EndRow(Visit):
    """A row of the table, and whose it is."""

    hemi: str
    origin: str
    """The file and its line."""
    end: GivenEnd | HipstaError
    """The plane, or what is wrong with the row."""

    def is_of(self, item: scan.HemisphereInput) -> bool:
        """Check whether a hemisphere is meant; a row without a session means any."""
        return (self.subject, self.hemi) == (item.subject, item.hemi) and (
            self.session in (None, item.session)
        )


def read_ends(path: Path) -> list[EndRow]:
    """Read the table; refuse one in which it is unclear whose end a row is."""
    rows = files.read_tsv(path)
    known_columns = {*_NAMES, "session", *_POINT, *_NORMAL}
    columns = set(rows[0]) if rows else set()
    lacking = [name for name in (*_NAMES, *_POINT) if name not in columns]
    lacking += [name for name in _NORMAL if columns & set(_NORMAL) and name not in columns]
    if lacking or columns - known_columns:
        fault = f"has unknown {', '.join(sorted(columns - known_columns))}"
        if lacking:
            fault = f"lacks {', '.join(lacking)}" if rows else "has no rows"
        raise InputError(
            f"{path}: {fault}; its columns are {', '.join((*_NAMES, *_POINT))}, and if needed "
            f"session, {', '.join(_NORMAL)}"
        )
    return [_row(f"{path}, line {number}", row) for number, row in enumerate(rows, 2)]


def _row(origin: str, row: dict[str, str]) -> EndRow:
    cells = {name: cell.strip() for name, cell in row.items()}
    subject = cells["participant_id"].removeprefix("sub-")
    session = cells.get("session", "").removeprefix("ses-")
    hemi = cells["hemi"].upper()
    if hemi not in scan.HEMIS or files.is_missing(subject):
        fault = f"hemi {cells['hemi']!r} is not L or R" if subject else "it has no participant_id"
        raise InputError(f"{origin}: {fault}; correct it", reason="unreadable-table")
    end: GivenEnd | HipstaError
    try:
        end = _given(cells)
    except ValueError as error:
        end = InputError(f"{origin}: {error}", reason="unreadable-table")
    return EndRow(
        subject=subject,
        session=None if files.is_missing(session) else session,
        hemi=hemi,
        origin=origin,
        end=end,
    )


def _given(cells: dict[str, str]) -> GivenEnd:
    """Read a plane; ``ValueError`` says what is wrong."""
    if cells["end"] not in _ENDS:
        raise ValueError(f"end {cells['end']!r} is not posterior or anterior; correct it")
    point = _vector(cells, _POINT)
    if point is None:
        raise ValueError("it has no point; give r, a and s in mm, scanner coordinates")
    normal = _vector(cells, _NORMAL)
    if normal is not None and math.hypot(*normal) == 0:
        raise ValueError("nr, na, ns are all zero; give a direction, or n/a for none")
    return GivenEnd(end=cast("End", cells["end"]), point=point, normal=normal)


def _vector(cells: dict[str, str], names: Sequence[str]) -> tuple[float, float, float] | None:
    """Read three numbers; none if all are missing."""
    texts = [cells.get(name, "") for name in names]
    if all(map(files.is_missing, texts)):
        return None
    numbers = []
    for name, text in zip(names, texts, strict=True):
        try:
            number = float(text)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise ValueError(f"{name} is {text!r}, not a number; correct it")
        numbers.append(number)
    return numbers[0], numbers[1], numbers[2]


def _with_labels_of(
    items: Sequence[scan.HemisphereInput], path: Path
) -> tuple[list[EndRow], list[str]]:
    """Read a table of ends, and spell subjects and sessions as the hemispheres do."""
    rows, notes = read_ends(path), list[str]()
    for name in ("subject", "session"):
        labels = [getattr(row, name) or "" for row in rows]
        data = [label for item in items if (label := getattr(item, name))]
        matches, lines = match_labels(filter(None, labels), data, str(path))
        changes: list[dict[str, Any]] = [{name: matches.get(x, x) or None} for x in labels]
        rows = [replace(row, **change) for row, change in zip(rows, changes, strict=True)]
        notes += lines
    return rows, notes


def attach_ends(
    items: Sequence[scan.HemisphereInput], path: Path | None
) -> tuple[tuple[scan.HemisphereInput, ...], tuple[str, ...]]:
    """Attach the ends that a table has to the hemispheres, and note how many rows are of others.

    A row that cannot be used, or may be of several sessions, makes its hemispheres fail.
    """
    if path is None:
        return tuple(items), ()
    rows, notes = _with_labels_of(items, path)
    attached = tuple(_attached(item, [r for r in rows if r.is_of(item)], items) for item in items)
    unused_rows = [row for row in rows if not any(row.is_of(item) for item in items)]
    if not unused_rows:
        return attached, tuple(notes)
    first = unused_rows[0]
    session = f" ses-{first.session}" if first.session else ""
    note = (
        f"{first.origin}: not used, no labels of sub-{first.subject}{session} hemi-{first.hemi}"
        " are "
        f"processed ({len(unused_rows)} of {len(rows)} rows are of no hemisphere here)"
    )
    return attached, (*notes, note)


def _attached(
    item: scan.HemisphereInput, rows: list[EndRow], items: Sequence[scan.HemisphereInput]
) -> scan.HemisphereInput:
    problem: HipstaError | None = item.problem
    ends: dict[End, GivenEnd] = {}
    sessions = {hemisphere.session for hemisphere in items if hemisphere.subject == item.subject}
    for row in rows:
        if isinstance(row.end, HipstaError):
            problem = problem or row.end
        elif row.session is None and len(sessions) > 1:
            problem = problem or InputError(
                f"{row.origin}: sub-{item.subject} has several sessions; name one in a column "
                "session",
                reason="unreadable-table",
            )
        elif row.end.end in ends:
            problem = problem or InputError(
                f"{row.origin}: a second {row.end.end} end of this hemisphere; keep one",
                reason="unreadable-table",
            )
        else:
            ends[row.end.end] = row.end
    return replace(item, ends=tuple(ends[end] for end in sorted(ends)), problem=problem)
