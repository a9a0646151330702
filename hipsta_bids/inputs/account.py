"""A list of all entries of a search: used, failed, not used, or not a segmentation.

A folder that has no row for what is in it stands for all of that. Names that begin with a dot are
passed over.
"""

import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import filterfalse
from pathlib import Path

from hipsta_bids.inputs import tree
from hipsta_bids.inputs.generic import find_table
from hipsta_bids.inputs.layouts import layout_of
from hipsta_bids.inputs.scan import HemisphereInput
from hipsta_bids.inputs.selection import Context
from hipsta_bids.io.files import MISSING, hide_home

Owner = tree.Ignored | HemisphereInput

#: Folders of a subject in which nobody looks for labels.
_OTHER_FOLDERS = {
    *("label", "scripts", "stats", "surf", "tmp", "touch", "trash", "src", "bem"),  # FreeSurfer's
    *("affine_t1_to_template", "ants_t1_to_temp", "bootstrap", "dump", "flirt_t2_to_t1"),  # ASHS's
    *("multiatlas", "qa", "sge", "coords", "metric", "cifti", "qc", "warps", "xfm", "transforms"),
    *("func", "dwi", "fmap", "perf", "pet", "meg", "eeg", "beh", "figures", "log", "logs"),
}

#: Folders with the labels of one subject: FreeSurfer's, and ASHS's.
_OF_ONE_SUBJECT = {"mri", "final"}

#: How deep, and at how many entries, labels are looked for where they do not belong.
_DEPTH, _MOST_ENTRIES = 5, 3000


def selection_table(items: Iterable[HemisphereInput]) -> list[dict[str, str]]:
    """Describe the selected segmentations with reasons, one row per hemisphere and protocol."""
    return [
        {
            "subject": item.subject,
            "session": item.session or MISSING,
            "hemisphere": item.hemi,
            "file": " + ".join(_relative(path, item.source_path) for path in item.files),
            "scheme": item.protocol.name,
            "why": "; ".join((f"{item.source}: {item.explanation}", *item.notes))
            + (f"; NOT USABLE: {item.problem}" if item.problem else ""),
            "edited": " + ".join(_relative(edit.path, edit.source_path) for edit in item.edits)
            or MISSING,
            "passed over": "; ".join(map(": ".join, item.passed_over)) or MISSING,
        }
        for item in items
    ]


def ignored_table(ignored: Iterable[tree.Ignored]) -> list[dict[str, str]]:
    """Describe the entries not used, one row per folder."""
    return [
        {"not used": " hemi-".join(filter(None, (str(e.path), e.hemi))), "why": e.reason}
        for e in ignored
    ]


def other_entries_table(other_entries: Iterable[tree.Ignored]) -> list[dict[str, str]]:
    """Describe the entries without a segmentation, one row each; inside of subjects, a count.

    All have a separate row in ``inputs.tsv``.
    """
    entries = [entry for entry in other_entries if entry.template]
    inner = Counter(entry.path.parent for entry in entries if entry.subject)
    rows = {str(entry.path): entry.reason for entry in entries if not entry.subject}
    rows |= {f"{path}/*/*": f"in the folders of {n} visits" for path, n in inner.items()}
    return [{"not a segmentation": path, "why": reason} for path, reason in rows.items()]


def input_table(
    items: Iterable[HemisphereInput], unused: Iterable[tree.Ignored], bids_dir: Path
) -> list[dict[str, str]]:
    """List all that a search read, one row per hemisphere, file or folder."""

    def row(path: Path, visit: Owner, status: str, reason: str) -> dict[str, str]:
        labels = {"subject": visit.subject, "session": visit.session, "hemi": visit.hemi}
        place = hide_home(_relative(path, bids_dir))
        return {"path": place, "status": status, "reason": hide_home(reason)} | {
            key: {"subject": "sub-", "session": "ses-"}.get(key, "") + label
            for key, label in labels.items()
            if label
        }

    rows = []
    for item in items:
        status = tree.FAILED if item.problem else tree.IS_USED
        main, *parts = item.files
        reasons = [(main, status, str(item.problem or item.explanation))]
        reasons += [(path, status, "head, body and tail of the same labels") for path in parts]
        if item.probabilities:
            text = f"probabilities of the same labels, files: {len(item.probabilities.files)}"
            reasons.append((item.probabilities.files[0][0], status, text))
        reasons += [(item.path_of(name), tree.NOT_USED, r) for name, r in item.passed_over]
        of_item = [row(path, item, *reason) for path, *reason in reasons]
        of_item[0] = item.origin | of_item[0]
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
    """Look for labels in an entry that seems to be of no participant."""
    if entry.reason != tree.NO_SUBJECT:
        return entry
    name = _first_labels(entry.path)
    if name is None:
        return entry
    reason = f"labels in it ({name}), but it is no subject's by its name"
    reason = reason if name else "labels, but in no subject's folder"
    folder = entry.path if name else entry.path.parent
    reason += (
        f"; give the folder of all subjects, {folder.parent.parent}"
        if folder.name in _OF_ONE_SUBJECT
        else "; name the participants of the folders with --participants-map FILE"
    )
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
    """List all that was not used in the folders of a visit."""
    visit, root = context.visit, context.source.path
    top = root / visit.folders[0].path.relative_to(root).parts[0]
    entry_of = partial(tree.Ignored, subject=visit.subject, session=visit.session, inside=top)
    used_paths = {
        str(path)
        for item in items
        for path in (*item.files, *map(item.path_of, dict(item.passed_over)))
    }
    n_other = sum(len(folder.names) for folder in visit.folders) - len(used_paths)
    has_labels = bool(items)
    for folder in visit.folders:
        for name in filter(layout_of, folder.names):
            if os.path.join(folder.path, name) not in used_paths:  # noqa: PTH118 (many of them)
                path, has_labels = folder.path / name, True
                reason, quiet = _why_not(path, context)
                yield entry_of(path=path, reason=reason, quiet=quiet)
        for name in folder.inner:
            if text := _inner_reason(folder.path, name):
                yield entry_of(path=folder.path / name, reason=text)
    present = [item.hemi for item in items] or context.selection.wanted_hemis()
    for hemi in filterfalse(present.__contains__, context.selection.wanted_hemis()):
        reason = "no labels of this hemisphere, but of the other"
        yield entry_of(path=items[0].files[0].parent, hemi=hemi, reason=reason)
    if not has_labels and explain | bool(visit.session):
        yield _without_labels(context, entry_of)
    elif n_other:
        reason = f"{n_other} other files beside the labels"
        yield entry_of(path=top, reason=reason, status=tree.NO_SEGMENTATION, quiet=True)


def _inner_reason(folder: Path, name: str) -> str:
    """Describe why a folder inside of a subject's is not searched, if somebody may miss it."""
    if layout_of(name):
        return "a folder, though it is named as labels are"
    if name in _OTHER_FOLDERS or tree.is_inner(name):
        return ""
    labels = _first_labels(folder / name)
    return f"labels in it ({labels}), a place where none are looked for" if labels else ""


def _why_not(path: Path, context: Context) -> tuple[str, bool]:
    """Explain why a file with a name of labels was not taken, and whether nobody misses it."""
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
        return (
            "labels of unknown meaning; name them with --scheme or in dataset_description.json",
            True,
        )
    if layout.companions:
        return f"no {' or '.join(sorted(layout.companions))} beside it", False
    if find_table(path, context.source.path) is None:
        return "no _dseg.tsv defines the labels; -d NAME=PATH names the dataset", False
    return "its table names no subiculum and CA1", True


def _without_labels(context: Context, entry_of: Callable[..., tree.Ignored]) -> tree.Ignored:
    """Explain why a visit has no labels."""
    folders = context.visit.folders
    inner = {name for folder in folders for name in folder.inner}
    top = next((folder.path for folder in folders if folder.path.name == "mri"), None)
    if top is not None:
        return entry_of(path=top.parent, reason="its mri folder holds no hippocampal subfields")
    path = folders[0].path
    if not inner.isdisjoint({"final", "bootstrap", "multiatlas"}):
        reason = "final/ holds no labels" if "final" in inner else "no labels in final/"
        return entry_of(path=path, reason=f"ASHS has not finished: {reason}")
    quiet = not context.source.explicit
    status = tree.NO_SEGMENTATION if quiet else tree.NOT_USED
    return entry_of(path=path, reason="no labels of subfields in it", status=status, quiet=quiet)


def _relative(path: Path, root: Path) -> str:
    return str(path.relative_to(root)) if path.is_relative_to(root) else str(path)
