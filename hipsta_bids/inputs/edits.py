"""Labels and masks that a person corrected: ``*_desc-edited_dseg`` and ``*_desc-edited_mask``.

They lie beside the labels that they correct, in the output dataset, or in a folder of their own
(``--edited-dir``), laid out like a BIDS derivative:
``sub-X[/ses-Y]/anat/sub-X[_ses-Y]_hemi-H[_seg-P]_desc-edited_dseg``.
"""

import contextlib
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from hipsta_bids.errors import HipstaError, InputError
from hipsta_bids.inputs.generic import is_edited, table_protocol
from hipsta_bids.inputs.scan import (
    Edit,
    HemisphereInput,
    Ignored,
    InputRequest,
    VisitFolders,
    list_visits,
    sort_folders,
)
from hipsta_bids.inputs.selection import Selection
from hipsta_bids.io.files import entities
from hipsta_bids.types import Visit

#: Names under which ``--edited-dir`` and the output dataset appear in addresses.
_EDITED, _OUTPUT = "edited", "output"

#: What an edited file replaces, by its suffix.
_KINDS = {"dseg": "labels", "mask": "mask"}


@dataclass(frozen=True, kw_only=True)
class EditedFile(Visit):
    """An edited file, and whose it is."""

    edit: Edit
    beside: bool
    """Found in a dataset of segmentations, not in the folder of edits."""

    @property
    def names(self) -> dict[str, str]:
        """Entities of its name."""
        return entities(self.edit.path.name)


def edits_of_visit(
    visit: VisitFolders, root: Path, source: str, *, beside: bool
) -> Iterator[EditedFile]:
    """List the edited files in the folders of one visit."""
    for folder in visit.folders:
        for name in filter(is_edited, folder.names):
            kind = _KINDS[entities(name)["suffix"]]
            edit = Edit(kind=kind, path=folder.path / name, source=source, source_path=root)
            yield EditedFile(edit=edit, subject=visit.subject, session=visit.session, beside=beside)


def list_edits(
    request: InputRequest, selection: Selection, ignored: list[Ignored]
) -> list[EditedFile]:
    """List the edited files of ``--edited-dir`` and of the output dataset."""
    found = []
    if request.edited_dir is not None:
        found += _edits_of_dataset(request.edited_dir, _EDITED, selection, ignored)
    # Whether the output folder can be used is checked where results are written.
    with contextlib.suppress(InputError):
        if request.output_dir is not None:
            found += _edits_of_dataset(request.output_dir, _OUTPUT, selection, ignored)
    return each_once(found)


def _edits_of_dataset(
    root: Path, name: str, selection: Selection, ignored: list[Ignored]
) -> list[EditedFile]:
    folders, others = sort_folders(root)
    ignored += others
    wanted = filter(selection.wants_folder, folders)
    return [
        file
        for visit in filter(selection.wants_visit, list_visits(wanted, ignored))
        for file in edits_of_visit(visit, root, name, beside=False)
    ]


def each_once(edited: Iterable[EditedFile]) -> list[EditedFile]:
    """Keep the first of entries for the same file: folders may be given twice."""
    return list(
        {os.path.realpath(file.edit.path): file for file in reversed(list(edited))}.values()
    )[::-1]


def attach_edits(
    items: Iterable[HemisphereInput], edited: Iterable[EditedFile], selection: Selection
) -> tuple[tuple[HemisphereInput, ...], tuple[str, ...]]:
    """Attach the files that correct each hemisphere, and note those that correct none."""
    found = list(items)
    corrections: dict[int, list[EditedFile]] = {}
    notes = []
    for file in edited:
        hemi = file.names.get("hemi")
        if hemi in ("L", "R") and hemi not in selection.wanted_hemis():
            continue
        matching = [n for n, item in enumerate(found) if _corrects(file, item)]
        for n in matching:
            corrections.setdefault(n, []).append(file)
        if not matching:
            notes.append(f"{file.edit.path}: edited file not used: {_why_not(file, found)}")
        elif len(matching) > 1:
            names = " and ".join(found[n].protocol.name for n in matching)
            problem = InputError(
                f"{file.edit.path}: corrects the labels of {names}; say in its name which ones, "
                f"as in _seg-{found[matching[0]].protocol.name}_desc-edited_",
                reason="edit-ambiguous",
            )
            for n in matching:
                found[n] = replace(found[n], problem=found[n].problem or problem)
    for n, files in corrections.items():
        found[n] = _corrected(found[n], [file.edit for file in files])
    return tuple(found), tuple(notes)


def _corrects(file: EditedFile, item: HemisphereInput) -> bool:
    names = file.names
    return (
        _misnamed(file) is None
        and (file.subject, file.session, names["hemi"]) == (item.subject, item.session, item.hemi)
        and names.get("seg", item.protocol.name) == item.protocol.name
        and (not file.beside or file.edit.path.parent in {path.parent for path in item.files})
    )


def _misnamed(file: EditedFile) -> str | None:
    """Describe what is wrong with a name, if anything."""
    names = file.names
    if names.get("hemi") not in ("L", "R"):
        return "its name has no hemi-L or hemi-R"
    for key, own in (("sub", file.subject), ("ses", file.session)):
        if names.get(key, own) != own:
            return f"its name says {key}-{names[key]}, but its folder is another one's"
    return None


def _why_not(file: EditedFile, items: list[HemisphereInput]) -> str:
    """Explain why a file corrects nothing."""
    misnamed = _misnamed(file)
    if misnamed:
        return misnamed
    hemi = file.names["hemi"]
    whose = f"sub-{file.subject}{f' ses-{file.session}' if file.session else ''} hemi-{hemi}"
    rivals = [
        item
        for item in items
        if (item.subject, item.session, item.hemi) == (file.subject, file.session, hemi)
    ]
    if not rivals:
        return f"no labels of {whose} are processed"
    protocols = {item.protocol.name for item in rivals}
    if file.names.get("seg", rivals[0].protocol.name) not in protocols:
        return (
            f"its name says seg-{file.names['seg']}, but {whose} has seg-{', seg-'.join(protocols)}"
        )
    return (
        f"it does not lie beside the labels of {whose} ({rivals[0].files[0].parent}); move it "
        "there, or name its folder with --edited-dir"
    )


def _corrected(item: HemisphereInput, edits: list[Edit]) -> HemisphereInput:
    """Attach the edits of one hemisphere, if there is one of each kind at most."""
    for kind in _KINDS.values():
        rivals = [edit.path for edit in edits if edit.kind == kind]
        if len(rivals) > 1:
            problem = InputError(
                f"{' and '.join(map(str, rivals))}: two edited files with the {kind} of one "
                "hemisphere; keep one",
                reason="edit-ambiguous",
            )
            return replace(item, edits=tuple(edits), problem=item.problem or problem)
    return _described(replace(item, edits=tuple(edits)))


def _described(item: HemisphereInput) -> HemisphereInput:
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
    known = {"title": item.protocol.title, "citation": item.protocol.citation}
    protocol = protocol.model_copy(update=known)
    return replace(
        item,
        protocol=protocol,
        parts_protocol=None,
        files=item.files[:1],
        bilateral=False,
        code_offset=0,
        notes=(*item.notes, f"edited labels are named by {table.name}"),
    )
