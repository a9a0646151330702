"""Probabilities of labels: which files have them, and whether no label of the sheet lacks one.

They are searched for where a program writes them (``layouts.toml``), and next to the labels as BIDS
names them: ``*_hemi-H_*label-LABEL_probseg``, where LABEL is a name, an abbreviation or a code of
the protocol, or one ``*_hemi-H_*_probseg`` with a volume per label, in the order of ``LabelMap`` in
its sidecar or of the label table.
"""

import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain
from pathlib import Path

from hipsta_bids.derivatives.dataset import counts_text
from hipsta_bids.errors import InputError
from hipsta_bids.inputs import freesurfer, scan, tree
from hipsta_bids.inputs.generic import find_table, read_table
from hipsta_bids.inputs.labels import label_values
from hipsta_bids.inputs.layouts import layout_of
from hipsta_bids.io.files import entities, read_json
from hipsta_bids.opening import not_fetched
from hipsta_bids.protocols.load import covered_labels, identify_tissue
from hipsta_bids.protocols.protocol import Tissue

_SIDES = {"L": "left", "R": "right"}
_PROBSEG = re.compile(r"(?=.*_?hemi-[LR]_).*_probseg\.(?:nii|nii\.gz|mgz)")
#: Entities in which probabilities and labels may differ.
_FREE = {"label", "desc", "suffix", "extension"}

NO_FILES = "no probabilities of its labels"
Files = dict[Path, list[tuple[Tissue, frozenset[int]]]]
"""Files with the tissue and the codes of each volume."""


def attach_probabilities(
    items: Sequence[scan.HemisphereInput], choice: str | Path
) -> tuple[tuple[scan.HemisphereInput, ...], tuple[str, ...]]:
    """Attach the probabilities that are complete, and count them.

    Hemispheres without are measured by labels alone, unless a folder was chosen: then they fail.
    """
    if choice == "never":
        return tuple(items), ()
    folder = choice if isinstance(choice, Path) else None
    if folder is not None:
        tree.list_folder(folder)
    attached = [item if item.problem else _attached(item, folder) for item in items]
    notes = []
    if kinds := Counter(item.probabilities.kind for item in attached if item.probabilities):
        text = f"probabilities: {counts_text(kinds)} of {len(items)} hemispheres"
        notes.append(f"{text}; --probabilities never uses labels alone")
    lacking = [new for new, old in zip(attached, items, strict=True) if new.notes != old.notes]
    if lacking:
        first = f"sub-{lacking[0].subject} {lacking[0].hemi}: {lacking[0].notes[-1]}"
        notes.append(f"labels alone: {len(lacking)} of {len(items)} hemispheres; {first}")
    return tuple(attached), tuple(notes)


def _attached(item: scan.HemisphereInput, folder: Path | None) -> scan.HemisphereInput:
    """Attach the files of one hemisphere, or note why they are not used."""
    kinds = (
        entry
        for place in _places(item, folder)
        for entry in chain(_bids_files(item, place), _posteriors(item, place))
    )
    kind, weights, files = "", False, Files()
    try:
        kind, weights, files = next((entry for entry in kinds if entry[2]), (kind, weights, files))
        fault = _fault(item, files, weights=weights) if files else NO_FILES
    except InputError as error:  # of a sidecar or table
        fault = str(error)
    if fault and folder is None:
        notes = () if fault == NO_FILES else (f"probabilities not used: {fault}",)
        return replace(item, notes=item.notes + notes)
    if fault:
        place = f"{folder}, sub-{item.subject} {item.hemi}"
        problem = InputError(f"{place}: {fault}; add it", reason="bad-probabilities")
        return replace(item, problem=problem)
    probabilities = scan.Probabilities(
        kind=kind,
        weights=weights,
        files=tuple((path, tuple(t for t, _ in volumes)) for path, volumes in files.items()),
        source="probabilities" if folder else item.source,
        source_path=folder or item.source_path,
    )
    return replace(item, probabilities=probabilities)


def _places(item: scan.HemisphereInput, folder: Path | None) -> Iterator[Path]:
    """List the folders that may hold the probabilities of a hemisphere."""
    labels_folder = item.files[0].parent
    if folder is None:
        yield labels_folder
        return
    if labels_folder.is_relative_to(item.source_path):
        yield folder / labels_folder.relative_to(item.source_path)
    yield folder / f"sub-{item.subject}" / (f"ses-{item.session}" if item.session else "") / "anat"


def _bids_files(item: scan.HemisphereInput, place: Path) -> Iterator[tuple[str, bool, Files]]:
    """List the probabilities of BIDS in a folder."""
    name = item.files[0].name
    labels = entities(name) | {"hemi": item.hemi, "sub": item.subject, "ses": item.session or ""}
    files: Files = {}
    for path in _list(place):
        pairs = entities(path.name) if _PROBSEG.fullmatch(path.name) else {}
        fixed = [(key, text) for key, text in pairs.items() if key not in _FREE]
        if fixed and all(labels.get(key, text) == text for key, text in fixed):
            texts = [pairs["label"]] if "label" in pairs else _label_map(path, item)
            files[path] = [_volume(text, item) for text in texts]
    yield "probseg", False, files


def _posteriors(item: scan.HemisphereInput, place: Path) -> Iterator[tuple[str, bool, Files]]:
    """List the posteriors of the program whose labels these are, for a folder."""
    name = item.files[0].name
    layout = layout_of(name)
    match = layout and layout.pattern.fullmatch(name)
    groups = match.groupdict("") if match else {}
    # Posteriors are of FreeSurfer's full hierarchy, and not resampled.
    if layout and layout.probabilities and not (groups.get("hierarchy") or groups.get("coarse")):
        values = {key: re.escape(text) for key, text in groups.items()}
        run = freesurfer.posterior_run(groups.get("analysis", ""))
        pattern = re.compile(layout.probabilities.format(**values, side=_SIDES[item.hemi], run=run))
        paths = (path for near in layout.near for path in _list(place / near))
        matches = ((path, pattern.fullmatch(path.name)) for path in paths)
        files = {path: [_volume(match["label"], item)] for path, match in matches if match}
        yield layout.name, layout.weights, files


def _label_map(path: Path, item: scan.HemisphereInput) -> list[str]:
    """Read which labels the volumes of one file are."""
    sidecar = path.with_name(f"{path.name.partition('.')[0]}.json")
    names = read_json(sidecar).get("LabelMap") if sidecar.is_file() else None
    if names is None and (table := find_table(item.files[0], item.source_path)):
        return [str(row.code) for row in read_table(table)]
    return [str(name) for name in names or ()]


def _volume(text: str, item: scan.HemisphereInput) -> tuple[Tissue, frozenset[int]]:
    """Return the tissue and the codes that a code or name stands for in one hemisphere."""
    if text.isdecimal():
        text = str(max(int(text) - item.code_offset, 0))
    labels = covered_labels(text, item.protocol)
    if len({label.tissue for label in labels}) == 1:
        return labels[0].tissue, frozenset(label.code for label in labels)
    if text == "0" or identify_tissue(text)[0] is Tissue.BACKGROUND:
        return Tissue.BACKGROUND, frozenset([0])
    return Tissue.OTHER, frozenset()


def _fault(item: scan.HemisphereInput, files: Files, *, weights: bool) -> str:
    """Describe why files cannot be used; empty if they can."""
    paths: dict[int, Path] = {}
    for path, volumes in files.items():
        if not volumes:
            return f"neither LabelMap nor a table names the volumes of {path.name}"
        if not_fetched(path):
            return f"the content of {path.name} was not fetched"
        for code in (code for _, codes in volumes for code in codes):
            if paths.setdefault(code, path) != path:
                return f"{paths[code].name} and {path.name} both have code {code}"
    sheet = (*item.protocol.sheet, *item.protocol.layer)
    needed = {label.code: label.name for label in item.protocol.labels if label.tissue in sheet}
    needed |= {0: "background"} if weights else {}
    lacking = needed.keys() - paths.keys()
    with suppress(InputError):  # reading the labels reports it
        if lacking:  # some may not occur
            present = {0, *(code - item.code_offset for code in label_values(item.files[0]))}
            lacking &= present
    return f"no file of {needed[min(lacking)]} (code {min(lacking)})" if lacking else ""


def _list(folder: Path) -> list[Path]:
    """List the files of a folder; none if there is no folder."""
    folder = Path(os.path.normpath(folder))
    with suppress(InputError):
        return [folder / name for name in tree.list_folder(folder)[1]]
    return []
