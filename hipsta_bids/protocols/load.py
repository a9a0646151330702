"""Bundled protocols, users' protocol files, and protocols made of label tables; regions."""

import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from hipsta_bids import opening
from hipsta_bids.errors import MissingProtocolError, ProtocolError
from hipsta_bids.protocols import EXPERIMENTAL
from hipsta_bids.protocols.protocol import (
    CORE,
    FAR_TO_NEAR,
    MEDIAL_TO_LATERAL,
    Label,
    Part,
    Protocol,
    Tissue,
)
from hipsta_bids.types.tables import did_you_mean, first_mistake

#: What laboratories call the tissues, after :func:`identify_tissue` has reduced a name.
_NAMES = {
    Tissue.BACKGROUND: "background clear unknown",
    Tissue.PRESUBICULUM: "presubiculum presub prs",
    Tissue.SUBICULUM: "subiculum sub subicularcomplex",
    Tissue.CA1: "ca1",
    Tissue.CA2: "ca2",
    Tissue.CA2_3: "ca23 ca2ca3",
    Tissue.CA3: "ca3",
    Tissue.CA4: "ca4 hilus",
    Tissue.DENTATE_GYRUS: "dg dentate dentategyrus fasciadentata gcdg gcmldg ca4dg dgca4"
    " ca4dentategyrus dentategyrusca4 ca4gcdg ca4gcmldg dghilus hilusdg",
    Tissue.MOLECULAR_LAYER: "molecularlayer ml srlm slrm srlslm slm"
    " stratumradiatumlacunosummoleculare stratumradiatumstratumlacunosumstratummoleculare",
    Tissue.PARASUBICULUM: "parasubiculum parasub paras",
    Tissue.HATA: "hata amygdalatransitionarea",
    Tissue.FIMBRIA: "fimbria fim",
    Tissue.FISSURE: "fissure fis",
    Tissue.CYST: "cyst cysts",
    Tissue.ENTORHINAL: "entorhinal erc ec",
    Tissue.BA35: "ba35 br35 a35 area35",
    Tissue.BA36: "ba36 br36 a36 area36",
    Tissue.PARAHIPPOCAMPAL: "parahippocampal parahippocampalgyrus phc phg",
}
_TISSUES = {name: tissue for tissue, names in _NAMES.items() for name in names.split()}
_PARTS = {"head": Part.HEAD, "body": Part.BODY, "tail": Part.TAIL}

#: Words that do not change what a label is.
_FILLERS = {
    *("left", "right", "lh", "rh", "l", "r", "hemi", "hemisphere"),
    *("hippocampus", "hippocampal", "hipp", "hp", "cortex", "label", "region"),
    *("and", "with", "including", "of", "the", "proper"),
}
#: Cortex that continues the sheet where a table names it, as in the bundled protocols.
_NEIGHBORS = {Tissue.BA35, Tissue.ENTORHINAL, Tissue.PARAHIPPOCAMPAL}
_WHOLE = {"hippocampus", "hippocampal", "hipp", "hp"}

#: Colors of tissues in tables without any (ColorBrewer's qualitative sets, recycled).
_COLORS = ("#1b9e77", "#d95f02", "#7570b3", "#e7298a", "#66a61e", "#e6ab02", "#a6761d", "#666666")


@cache
def protocol_names() -> tuple[str, ...]:
    """List the names of the bundled protocols, in alphabetical order.

    Returns
    -------
    tuple of str
        Names that :func:`load_protocol` and ``--scheme`` take.
    """
    files = resources.files("hipsta_bids.protocols").iterdir()
    return tuple(sorted(f.name.removesuffix(".toml") for f in files if f.name.endswith(".toml")))


def load_protocol(name_or_path: str | Path) -> Protocol:
    """Load a bundled protocol by name, or a user's protocol file.

    Parameters
    ----------
    name_or_path : str or Path
        A name of :func:`protocol_names`, or the path of a TOML file (a ``Path``, or a string that
        ends in ``.toml``).

    Returns
    -------
    Protocol

    Raises
    ------
    ProtocolError
        ``unknown-scheme`` (with the nearest name), ``unreadable-scheme`` or ``invalid-scheme``.
    """
    if isinstance(name_or_path, Path) or name_or_path.endswith(".toml"):
        return _load_file(Path(name_or_path))
    if name_or_path not in protocol_names():
        raise ProtocolError(
            f"no protocol is called {name_or_path!r}"
            f"{did_you_mean(name_or_path, protocol_names())}; "
            f"bundled: {', '.join(protocol_names())} (a file's name has to end in .toml)"
        )
    return _load_bundled(name_or_path)


def protocol_table() -> list[dict[str, str]]:
    """Describe each bundled protocol in one row."""
    rows = []
    for name in protocol_names():
        protocol = load_protocol(name)
        parts = sorted({label.part for label in protocol.labels} - {Part.UNKNOWN})
        rows.append(
            {
                "name": name,
                "tool": protocol.tool,
                "title": protocol.title,
                "sheet": ", ".join(tissue.name for tissue in protocol.sheet),
                "neighbors": ", ".join(tissue.name for tissue in protocol.neighbors) or "none",
                "labels": str(len(protocol.labels)),
                "parts": ", ".join(part.name.lower() for part in parts),
                "citation": protocol.citation,
            }
        )
    return rows


@cache
def _load_bundled(name: str) -> Protocol:
    text = resources.files("hipsta_bids.protocols").joinpath(f"{name}.toml").read_text("utf-8")
    return parse_protocol(tomllib.loads(text), origin=f"{name}.toml")


def _load_file(path: Path) -> Protocol:
    try:
        table = tomllib.loads(opening.read_text(path, opening.SETTINGS))
    except OSError as error:
        is_missing = isinstance(error, FileNotFoundError)
        raise (MissingProtocolError if is_missing else ProtocolError)(
            f"{path}: cannot read the protocol ({error.strerror}); check the path"
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ProtocolError(
            f"{path}: not a TOML file ({error}); start from a bundled protocol"
        ) from error
    return parse_protocol(table, origin=str(path))


def parse_protocol(table: Mapping[str, Any], *, origin: str) -> Protocol:
    """Check the contents of a protocol file."""
    try:
        protocol = Protocol.model_validate(table)
    except ValidationError as error:
        mistake = first_mistake(error, Protocol)
        raise ProtocolError(f"{origin}: {mistake}") from error
    _check_agreement(protocol, origin=origin)
    return protocol


def _check_agreement(protocol: Protocol, *, origin: str) -> None:
    """Check that the parts of a protocol agree with each other."""
    codes = [label.code for label in protocol.labels]
    top = max(codes, default=0)
    repeated = sorted({code for code in codes if codes.count(code) > 1})
    labeled = {label.tissue for label in protocol.labels}
    named = (*protocol.sheet, *protocol.layer, *protocol.interior, *protocol.neighbors)
    named += protocol.recognized_by
    absent = [tissue.name for tissue in dict.fromkeys(named) if tissue not in labeled]
    sheet_order = tuple(filter(protocol.sheet.__contains__, MEDIAL_TO_LATERAL))
    neighbors_order = tuple(filter(protocol.neighbors.__contains__, FAR_TO_NEAR))
    sheet = set(protocol.sheet)
    problems = {
        f"name {protocol.name!r} has to consist of letters and digits": not re.fullmatch(
            "[A-Za-z0-9]+", protocol.name
        ),
        "there are no labels": not codes,
        f"code {', '.join(map(str, repeated))} is listed twice": repeated,
        "right_offset has to exceed every code": protocol.right_offset in range(1, top + 1),
        "left_offset has to exceed every code": protocol.left_offset in range(1, top + 1),
        "only one of left_offset and right_offset can be given": protocol.left_offset
        and protocol.right_offset,
        f"no label has tissue {', '.join(absent)}": absent,
        "sheet has to list each tissue once, medial to lateral, out of "
        + ", ".join(t.name for t in MEDIAL_TO_LATERAL): protocol.sheet != sheet_order,
        "neighbors has to list each tissue once, far to near, out of "
        + ", ".join(t.name for t in FAR_TO_NEAR): protocol.neighbors != neighbors_order,
        "a tissue is in both sheet and layer": not sheet.isdisjoint(protocol.layer),
        "a tissue is in both sheet and interior": not sheet.isdisjoint(protocol.interior),
        "layer, interior, neighbors or recognized_by is given without a sheet": named and not sheet,
        "there is neither a sheet nor a label with a part": not sheet
        and all(label.part is Part.UNKNOWN for label in protocol.labels),
    }
    for problem, wrong in problems.items():
        if wrong:
            raise ProtocolError(f"{origin}: {problem}")


@dataclass(frozen=True, kw_only=True)
class NamedCode:
    """One row of a label table."""

    code: int
    name: str
    abbreviation: str = ""
    color: str = ""


def identify_tissue(name: str) -> tuple[Tissue, Part]:
    """Understand a label's name."""
    words = re.findall("[a-z0-9]+", name.lower())
    part = next((_PARTS[word] for word in words if word in _PARTS), Part.UNKNOWN)
    text = "".join(word for word in words if word not in _FILLERS and word not in _PARTS)
    if text:
        return _TISSUES.get(text, Tissue.OTHER), part
    if part is not Part.UNKNOWN or not _WHOLE.isdisjoint(words):
        return Tissue.HIPPOCAMPUS, part
    return Tissue.OTHER, part


def covered_labels(text: str, protocol: Protocol) -> tuple[Label, ...]:
    """List the labels that a code, a name or an abbreviation in the name of a file stands for."""
    key = plain_name(text)
    spellings = (
        [str(label.code) for label in protocol.labels],
        [plain_name(label.name) for label in protocol.labels],
        [plain_name(label.abbreviation) for label in protocol.labels],
    )
    names = next((names for names in spellings if key in names), ())
    return tuple(label for label, name in zip(protocol.labels, names, strict=False) if name == key)


def plain_name(name: str) -> str:
    """Reduce a name to letters and digits, without words that do not change what a label is."""
    words = re.findall("[a-z0-9]+", name.lower())
    return "".join(word for word in words if word not in _FILLERS) or "".join(words)


def protocol_from_names(rows: Iterable[NamedCode], *, name: str, origin: str) -> Protocol:
    """Make a protocol from a label table."""
    labels = tuple(
        label
        for index, row in enumerate(rows)
        if row.code > 0 and (label := _label(row, index)).tissue is not Tissue.BACKGROUND
    )
    tissues = {label.tissue for label in labels}
    if not tissues >= {Tissue.SUBICULUM, Tissue.CA1}:
        raise ProtocolError(
            f"{origin}: no names of subiculum and CA1; describe the labels in a TOML file "
            "and pass it with --scheme",
            reason="unclear-names",
        )
    inside = (*CORE, Tissue.MOLECULAR_LAYER)
    protocol = Protocol(
        name=name,
        title=f"Labels named in {origin}",
        citation="",
        sheet=tuple(tissue for tissue in MEDIAL_TO_LATERAL if tissue in tissues),
        layer=tuple(tissue for tissue in (Tissue.MOLECULAR_LAYER,) if tissue in tissues),
        interior=tuple(tissue for tissue in inside if tissue in tissues),
        labels=labels,
        neighbors=tuple(t for t in FAR_TO_NEAR if t in tissues and t in _NEIGHBORS),
    )
    _check_agreement(protocol, origin=origin)
    return protocol


def agrees(protocol: Protocol, rows: Iterable[NamedCode]) -> bool:
    """Check whether a label table describes a given protocol.

    The table has to list every label of the sheet and its interior, and each code that it lists
    has to mean the same tissue in the protocol. Codes with names without meaning may be missing
    there.
    """
    table = {row.code: _label(row, 0).tissue for row in rows if row.code > 0}
    tissue_of = {label.code: label.tissue for label in protocol.labels}
    needed = {*protocol.sheet, *protocol.interior}
    complete = all(code in table for code, tissue in tissue_of.items() if tissue in needed)
    silent = {Tissue.OTHER, Tissue.BACKGROUND}
    return complete and all(
        tissue_of.get(code, tissue if tissue in silent else None) is tissue
        for code, tissue in table.items()
    )


def _label(row: NamedCode, index: int) -> Label:
    tissue, part = identify_tissue(row.name)
    if tissue is Tissue.OTHER and row.abbreviation:
        tissue, part_too = identify_tissue(row.abbreviation)
        part = part or part_too
    valid = re.fullmatch("#[0-9a-fA-F]{6}", row.color)
    return Label(
        code=row.code,
        tissue=tissue,
        part=part,
        name=row.name,
        abbreviation=row.abbreviation or row.name,
        color=row.color.lower() if valid else _COLORS[index % len(_COLORS)],
    )


def for_region(protocol: Protocol, region: str) -> Protocol:
    """Return a protocol with the sheet of a region: hippocampal, extended by cortex, cortex alone.

    Head and tail are refused where they have no subfields.
    """
    if region == "body":
        return protocol
    if region in EXPERIMENTAL:
        parts = (Part.HEAD, Part.TAIL) if region == "whole" else (Part.HEAD,)
        for label in protocol.labels:
            if label.tissue is Tissue.HIPPOCAMPUS and label.part in parts:
                tail = label.part is Part.TAIL
                raise ProtocolError(
                    f"region {region}: the {label.part.name.lower()} has no subfields in the "
                    f"protocol {protocol.name}; measure the "
                    f"{'head and body (headbody)' if tail else 'body'}",
                    reason="whole-subfields",
                )
        return protocol
    if not protocol.neighbors:
        able = [name for name in protocol_names() if load_protocol(name).neighbors]
        raise ProtocolError(
            f"region {region}: the protocol {protocol.name} has no neighboring cortex; "
            f"{', '.join(able)} have; measure the body, or pass --scheme",
            reason="no-cortex-labels",
        )
    hippocampal = protocol.sheet if region == "extended" else ()
    return protocol.model_copy(update={"sheet": (*protocol.neighbors, *hippocampal)})
