"""Any other BIDS derivative: ``*_hemi-{L,R}_*_dseg`` with a table that names its labels."""

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path

from hipsta_bids import opening
from hipsta_bids.errors import HipstaError, InputError, ProtocolError
from hipsta_bids.inputs import scan, tree
from hipsta_bids.inputs.selection import Context, LabelFile, Verdict
from hipsta_bids.io.files import entities
from hipsta_bids.protocols.load import NamedCode, protocol_from_names
from hipsta_bids.protocols.protocol import Protocol

# Label tables next to the images: ITK-SNAP's ``snaplabels.txt`` and BIDS's ``_dseg.tsv``.


#: IDX R G B A VIS MSH "LABEL" (the header of ITK-SNAP's label description files).
_SNAP_LINE = re.compile(
    r'\s*(?P<code>\d+)\s+(?P<r>\d+)\s+(?P<g>\d+)\s+(?P<b>\d+)\s+[\d.]+\s+\d+\s+\d+\s+"(?P<name>[^"]*)"'
)

_SNAP_NAME = "snaplabels.txt"


def find_table(image: Path, root: Path) -> Path | None:
    """Find the label table that applies to an image, next to it or above it in the dataset."""
    image_entities = entities(image.name)
    for folder in (image.parent, *image.parent.parents):
        specific = [
            (len(pairs), name)
            for name, pairs in _tables_in(folder)[0].items()
            if all(image_entities.get(key) == value for key, value in pairs.items())
        ]
        if specific:
            return folder / max(specific)[1]
        for inner in (folder, folder / "snap"):
            if _tables_in(inner)[1]:
                return inner / _SNAP_NAME
        if folder == root:
            break
    return None


# One table at the top of a dataset describes all of its files.
@lru_cache(maxsize=64)
def table_protocol(path: Path, name: str) -> Protocol:
    """Derive a protocol from the names in a label table."""
    return protocol_from_names(read_table(path), name=name, origin=path.name)


def read_table(path: Path) -> tuple[NamedCode, ...]:
    """Read a label table."""
    try:
        text = opening.read_text(path, opening.SETTINGS, encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path}: cannot read the label table ({error}); it has to be UTF-8 text",
            reason="unreadable-table",
        ) from error
    rows = _read_snap(text) if path.name == _SNAP_NAME else _read_tsv(text)
    if not rows:
        raise InputError(
            f"{path}: no labels in this table; a TSV needs the columns 'index' and 'name'",
            reason="unreadable-table",
        )
    return rows


def _read_snap(text: str) -> tuple[NamedCode, ...]:
    matches = filter(None, map(_SNAP_LINE.match, text.splitlines()))
    return tuple(
        NamedCode(
            code=int(match["code"]),
            name=match["name"],
            color=f"#{int(match['r']):02x}{int(match['g']):02x}{int(match['b']):02x}",
        )
        for match in matches
    )


def _read_tsv(text: str) -> tuple[NamedCode, ...]:
    rows = csv.DictReader(text.splitlines(), delimiter="\t")
    return tuple(
        NamedCode(
            code=int(row["index"]),
            name=_text(row, "name"),
            abbreviation=_text(row, "abbreviation"),
            color=_text(row, "color"),
        )
        for row in rows
        if re.fullmatch(r"\d+", row.get("index") or "")
        and (_text(row, "name") or _text(row, "abbreviation"))
    )


def _text(row: Mapping[str, str | None], key: str) -> str:
    value = row.get(key) or ""
    return "" if value == "n/a" else value


def forget_tables() -> None:
    """List folders and read tables again from now on."""
    _tables_in.cache_clear()
    table_protocol.cache_clear()


# The same few folders are asked for again for every image below them.
@cache
def _tables_in(folder: Path) -> tuple[dict[str, dict[str, str]], bool]:
    """List a folder's ``dseg.tsv`` tables by the entities they require, and look for ITK-SNAP's."""
    try:
        names = tree.list_folder(folder)[1]
    except InputError:  # no such folder, which is the usual case for "snap"
        return {}, False
    parsed = {name: entities(name) for name in names if name.endswith("dseg.tsv")}
    tables = {
        name: {key: value for key, value in pairs.items() if key not in {"suffix", "extension"}}
        for name, pairs in parsed.items()
        if pairs["suffix"] == "dseg"
    }
    return tables, _SNAP_NAME in names


_IMAGES = {".nii.gz", ".nii", ".mgz", ".mgh"}

#: Spaces of the subject's anatomy; the others are templates of another size.
_NATIVE_SPACE = re.compile(r"|T1w|T2w|orig|scanner|individual|crop\w*")


def is_edited(name: str) -> bool:
    """Check whether a file name is of edited labels or an edited mask."""
    if "desc-edited" not in name:
        return False
    pairs = entities(name)
    return (
        pairs.get("desc") == "edited"
        and pairs["suffix"] in {"dseg", "mask"}
        and pairs["extension"] in _IMAGES
    )


def choose_described(
    files: Sequence[LabelFile], context: Context, hemi: str
) -> Iterator[scan.HemisphereInput]:
    """Choose one hemisphere's files among the files that a table or the user's protocol describes.

    Files whose table names no subiculum and CA1 are of something else, and are excluded; so are
    files without any table in datasets that the user did not name.
    """
    described = [(file, verdict) for file in files if (verdict := _describe(file, context))]
    groups: dict[str, list[tuple[LabelFile, Verdict]]] = {}
    ranked = [(replace(file, rank=_rank(file, verdict)), verdict) for file, verdict in described]
    for file, verdict in sorted(ranked, key=lambda pair: (pair[0].rank, pair[0].path.name)):
        name = "" if verdict.problem else verdict.protocol.name
        groups.setdefault(name, []).append((file, verdict))
    for name, group in groups.items():
        # A file that nothing describes matters only if there is no other.
        if name or (context.source.explicit and len(groups) == 1):
            yield _choose(group, context, hemi)


def _rank(file: LabelFile, verdict: Verdict) -> tuple[bool, bool, bool, int]:
    """Rank files in the subject's space, cropped or in no named space, with fewest entities."""
    space, name = file.traits.get("space") or "", file.path.name
    coarse = bool(space) and not space.startswith("crop")
    problem = verdict.problem is not None
    return problem, not _NATIVE_SPACE.fullmatch(space), coarse, name.count("_")


def without_side(visit: tree.VisitFolders) -> Iterator[tree.Ignored]:
    """List label images whose names have a ``hemi`` that is neither L nor R."""
    for folder in visit.folders:
        for name in folder.names:
            if "_hemi-" not in name or "dseg." not in name:
                continue
            pairs = entities(name)
            hemi = pairs.get("hemi", "")
            if (
                hemi not in scan.HEMIS
                and pairs["suffix"] == "dseg"
                and pairs["extension"] in _IMAGES
            ):
                reason = f"hemi-{hemi} is neither hemi-L nor hemi-R"
                yield tree.Ignored(path=folder.path / name, reason=reason, subject=visit.subject)


def _choose(
    group: list[tuple[LabelFile, Verdict]], context: Context, hemi: str
) -> scan.HemisphereInput:
    """Take the first of several files of one protocol."""
    (best, verdict), visit = group[0], context.visit
    problem, space = verdict.problem, best.traits.get("space") or ""
    if problem is None and not _NATIVE_SPACE.fullmatch(space):
        problem = InputError(
            f"{best.path}: space {space} is a template's, which changes thickness; "
            "use labels in the subject's own space",
            reason="template-space",
        )
    tool = next(iter(context.source.generators), "")
    order = "the subject's own space, the finest grid and the shortest name are preferred"
    mismatches = [
        f"{key}-{best.traits[key]}"
        for key, label in {"sub": visit.subject, "ses": visit.session}.items()
        if label and best.traits.get(key, label) != label
    ]
    verdict = replace(
        verdict,
        problem=problem,
        notes=(f"the file's name has {'_'.join(mismatches)}",) if mismatches else (),
        provenance={"atlas": verdict.protocol.name},
    )
    files = [file for file, _ in group]
    passed_over = [(file.path, order) for file in files[1:]]
    return context.first(files, verdict, hemi, passed_over, tool=tool)


def _describe(file: LabelFile, context: Context) -> Verdict | None:
    """Find out what a file's labels mean; None if they are not the hippocampus's."""
    path, users, root = file.path, context.selection.protocol, context.source.path
    # A tool's protocol, which the user chose for the files of that tool, replaces no table.
    table = find_table(path, root) if users is None or users.tool else None
    problem: HipstaError = ProtocolError(
        f"{path}: no _dseg.tsv defines its labels; add one, or pass a TOML file with --scheme",
        reason="undescribed-labels",
    )
    try:
        protocol = table_protocol(table, _protocol_name(file, context)) if table else users
        if protocol is not None:
            origin = table.name if table else "--scheme"
            return Verdict(protocol=protocol, explanation=f"labels named by {origin}")
    except (InputError, ProtocolError) as error:
        if error.reason == "unclear-names":
            return None
        problem = error
    unknown = scan.unknown_protocol("unknown", f"Labels of {path.name}, not described")
    return Verdict(protocol=unknown, explanation="labels not described", problem=problem)


def _protocol_name(file: LabelFile, context: Context) -> str:
    """Name a protocol after the file's atlas, or else its dataset."""
    for text in (file.traits.get("atlas"), file.traits.get("seg"), context.source.name):
        plain = re.sub("[^A-Za-z0-9]", "", text or "")
        if plain:
            return plain
    return "labels"
