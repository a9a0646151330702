"""An account of all that a search came upon: used, failed, not used, or not a segmentation.

A folder that has no row for what is in it stands for all of that. Names that begin with a dot are
passed over.
"""

import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from hipsta_bids.inputs import tree
from hipsta_bids.inputs.generic import find_table
from hipsta_bids.inputs.layouts import layout_of
from hipsta_bids.inputs.scan import HemisphereInput
from hipsta_bids.inputs.selection import Context
from hipsta_bids.io.files import hide_home

Owner = tree.Ignored | HemisphereInput

#: Folders of a subject in which nobody looks for labels.
_OTHER_FOLDERS = {
    *("label", "scripts", "stats", "surf", "tmp", "touch", "trash", "src", "bem"),  # FreeSurfer's
    *("affine_t1_to_template", "ants_t1_to_temp", "bootstrap", "dump", "flirt_t2_to_t1"),  # ASHS's
    *("multiatlas", "qa", "sge", "coords", "metric", "cifti", "qc", "warps", "xfm", "transforms"),
    *("func", "dwi", "fmap", "perf", "pet", "meg", "eeg", "beh", "figures", "log", "logs"),
}

#: How deep, and at how many entries, labels are looked for where they do not belong.
_DEPTH, _MOST_ENTRIES = 5, 3000


def selection_table(items: Iterable[HemisphereInput]) -> list[dict[str, str]]:
    """Describe what was found and reason, one row per hemisphere and protocol."""
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
            "passed over": "; ".join(f"{name}: {reason}" for name, reason in item.passed_over)
            or "n/a",
        }
        for item in items
    ]


def ignored_table(ignored: Iterable[tree.Ignored]) -> list[dict[str, str]]:
    """Describe what was not used, one row per folder."""
    return [
        {
            "not used": f"{entry.path} hemi-{entry.hemi}" if entry.hemi else str(entry.path),
            "why": entry.reason,
        }
        for entry in ignored
    ]


def other_entries_table(other_entries: Iterable[tree.Ignored]) -> list[dict[str, str]]:
    """Describe what is no segmentation, one row per entry; those inside of subjects' are counted.

    All have a row of their own in ``inputs.tsv``.
    """
    other_entries = [entry for entry in other_entries if entry.status == tree.NO_SEGMENTATION]
    inner = Counter(entry.path.parent for entry in other_entries if entry.subject)
    rows = {str(e.path): e.reason for e in other_entries if not e.subject}
    rows |= {f"{path}/*/*": f"in the folders of {n} visits" for path, n in inner.items()}
    return [{"not a segmentation": path, "why": reason} for path, reason in rows.items()]


def input_table(
    items: Iterable[HemisphereInput], unused: Iterable[tree.Ignored], bids_dir: Path
) -> list[dict[str, str]]:
    """Account for all that a search found, one row per hemisphere, file or folder."""

    def row(
        path: Path, visit: tree.Ignored | HemisphereInput, status: str, reason: str
    ) -> dict[str, str]:
        cells = {
            "path": hide_home(_relative(path, bids_dir)),
            "status": status,
            "reason": hide_home(reason),
        }
        if visit.subject:
            cells["subject"] = f"sub-{visit.subject}"
        if visit.session:
            cells["session"] = f"ses-{visit.session}"
        return cells | ({"hemi": visit.hemi} if visit.hemi else {})

    rows = []
    for item in items:
        status, reason = (
            (tree.FAILED, str(item.problem)) if item.problem else (tree.IS_USED, item.explanation)
        )
        of_item = [item.origin | row(item.files[0], item, status, reason)]
        beside = "head, body and tail of the same labels"
        of_item += [row(path, item, status, beside) for path in item.files[1:]]
        of_item += [
            # An absolute path replaces the folder.
            row(item.files[0].parent / name, item, tree.NOT_USED, reason)
            for name, reason in item.passed_over
        ]
        rows += [cells | {"seg": item.protocol.name} for cells in of_item]
    return rows + [row(entry.path, entry, entry.status, entry.reason) for entry in unused]


def count_inputs(rows: Iterable[Mapping[str, str]]) -> str:
    """Count the rows of each status."""
    counts = Counter(row["status"] for row in rows)
    return ", ".join(
        f"{counts[name]} {name}"
        for name in (tree.IS_USED, tree.FAILED, tree.NOT_USED, tree.NO_SEGMENTATION)
    )


def looked_into(entry: tree.Ignored) -> tree.Ignored:
    """Look for labels in an entry that seems to be nobody's."""
    if entry.reason != tree.NO_SUBJECT:
        return entry
    name = _first_labels(entry.path)
    if name is None:
        return entry
    reason = "labels, but in no subject's folder"
    if name:
        reason = f"labels in it ({name}), but it is no subject's by its name"
    reason += "; --participants-map FILE says entry_of folders are"
    return replace(entry, reason=reason, status=tree.NOT_USED, quiet=False)


def _first_labels(path: Path) -> str | None:
    """Find a file of labels in a folder, at some depth; empty if the path is one itself."""
    if layout_of(path.name):
        return ""
    n_entries = 0
    for folder, inner, names in os.walk(path):
        depth = len(Path(folder).relative_to(path).parts)
        n_entries += len(names) + len(inner)
        for name in sorted(names + inner):
            if (layout := layout_of(name)) and layout.distinct:
                return str((Path(folder) / name).relative_to(path))
        if depth >= _DEPTH or n_entries > _MOST_ENTRIES:
            inner.clear()
    return None


def unused_of_visit(
    context: Context, items: Sequence[HemisphereInput], *, explain: bool
) -> Iterator[tree.Ignored]:
    """Account for all that was not used in the folders of a visit."""
    visit, root = context.visit, context.source.path
    top = root / visit.folders[0].path.relative_to(root).parts[0]
    entry_of = partial(tree.Ignored, subject=visit.subject, session=visit.session, inside=top)
    used_paths = {path for item in items for path in item.files}
    used_paths |= {item.files[0].parent / name for item in items for name, _ in item.passed_over}
    n_other = sum(len(folder.names) for folder in visit.folders) - len(used_paths)
    has_labels = bool(items)
    for folder in visit.folders:
        for name in filter(layout_of, folder.names):
            path = folder.path / name
            if path not in used_paths:
                has_labels = True
                reason, quiet = _why_not(path, context)
                yield entry_of(path=path, reason=reason, quiet=quiet)
        for name in folder.inner:
            if text := _inner_reason(folder.path, name):
                yield entry_of(path=folder.path / name, reason=text)
    sides = {item.hemi for item in items}
    for hemi in context.selection.wanted_hemis() if sides else ():
        if hemi not in sides:
            path = items[0].files[0].parent
            yield entry_of(
                path=path, hemi=hemi, reason="no labels of this hemisphere, but of the other"
            )
    if not has_labels and explain | bool(visit.session):
        yield _without_labels(context, entry_of)
    elif n_other:
        reason = f"{n_other} other files beside the labels"
        yield replace(
            tree.no_segmentation(top, reason), subject=visit.subject, session=visit.session
        )


def _inner_reason(folder: Path, name: str) -> str:
    """Tell reason a folder inside of a subject's is not searched, if somebody may miss it."""
    if layout_of(name):
        return "a folder, though it is named as labels are"
    if name in _OTHER_FOLDERS or tree.is_inner(name):
        return ""
    labels = _first_labels(folder / name)
    return f"labels in it ({labels}), a place where none are looked for" if labels else ""


def _why_not(path: Path, context: Context) -> tuple[str, bool]:
    """Explain reason a file with a name of labels was not taken, and whether nobody misses it."""
    layout = layout_of(path.name)
    if layout is None:
        raise ValueError(path.name)
    hemis, selection = context.selection.wanted_hemis(), context.selection
    side = layout.side(path.name)
    if (side and side not in hemis) or (layout.bids and not selection.wants_file(path)):
        return "not asked for (--hemi, --bids-filter-file)", True
    if layout.kind not in context.source.layouts:
        return f"{layout.title}'s, which the option of its folder does not read", True
    if not layout.distinct:
        return "labels of unknown meaning; --scheme or dataset_description.json says which", True
    if layout.beside:
        return f"no {' or '.join(sorted(layout.beside))} beside it", False
    if find_table(path, context.source.path) is None:
        return "no _dseg.tsv says what its labels are; -d NAME=PATH names its dataset", False
    return "its table names no subiculum and CA1", True


def _without_labels(context: Context, entry_of: Callable[..., tree.Ignored]) -> tree.Ignored:
    """Explain reason a visit has no labels."""
    folders = context.visit.folders
    inner = {name for folder in folders for name in folder.inner}
    top = next((folder.path for folder in folders if folder.path.name == "mri"), None)
    if top is not None:
        return entry_of(path=top.parent, reason="its mri folder holds no hippocampal subfields")
    path = folders[0].path
    if not inner.isdisjoint({"final", "bootstrap", "multiatlas"}):
        reason = "ASHS has not finished: no labels in final/"
        if "final" in inner:
            reason = "ASHS has not finished: final/ holds no labels"
        return entry_of(path=path, reason=reason)
    quiet = not context.source.explicit
    status = tree.NO_SEGMENTATION if quiet else tree.NOT_USED
    return entry_of(path=path, reason="no labels of subfields in it", status=status, quiet=quiet)


def _relative(path: Path, root: Path) -> str:
    return str(path.relative_to(root)) if path.is_relative_to(root) else str(path)
