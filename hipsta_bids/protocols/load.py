"""Reading and checking protocol files."""

import difflib
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

from hipsta_bids.errors import ProtocolError
from hipsta_bids.protocols.protocol import (
    FAR_TO_NEAR,
    MEDIAL_TO_LATERAL,
    Label,
    Part,
    Protocol,
    Tissue,
)

_Member = TypeVar("_Member", Tissue, Part)

_KEYS = {
    "name": str,
    "title": str,
    "citation": str,
    "sheet": list,
    "layer": list,
    "interior": list,
    "labels": list,
}
_OPTIONAL_KEYS = {"tool": str, "unlisted": str, "right_offset": int, "neighbors": list}
_LABEL_KEYS = {"code": int, "tissue": str, "name": str, "abbreviation": str, "color": str}
_OPTIONAL_LABEL_KEYS = {"part": str}


@cache
def protocol_names() -> tuple[str, ...]:
    """List the names of the bundled protocols, in alphabetical order."""
    files = resources.files("hipsta_bids.protocols").iterdir()
    return tuple(sorted(f.name.removesuffix(".toml") for f in files if f.name.endswith(".toml")))


def load_protocol(name_or_path: str | Path) -> Protocol:
    """Load a bundled protocol by name, or a user's protocol file."""
    if isinstance(name_or_path, Path) or name_or_path.endswith(".toml"):
        return _load_file(Path(name_or_path))
    if name_or_path not in protocol_names():
        raise ProtocolError(
            f"no protocol is called {name_or_path!r}"
            f"{_did_you_mean(name_or_path, protocol_names())}; "
            f"bundled: {', '.join(protocol_names())} (a file's name has to end in .toml)",
            reason="unknown-scheme",
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
    protocol = parse_protocol(tomllib.loads(text), origin=f"{name}.toml")
    if protocol.name != name:
        raise _invalid(
            f"{name}.toml", f"its name is {protocol.name!r}; name and file have to agree"
        )
    return protocol


def _load_file(path: Path) -> Protocol:
    try:
        table = tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        raise ProtocolError(
            f"{path}: cannot read the protocol ({error.strerror}); check the path",
            reason="unreadable-scheme",
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ProtocolError(
            f"{path}: not a TOML file ({error}); start from a bundled protocol",
            reason="unreadable-scheme",
        ) from error
    return parse_protocol(table, origin=str(path))


def parse_protocol(table: Mapping[str, Any], *, origin: str) -> Protocol:
    """Check the contents of a protocol file."""
    _check_keys(table, _KEYS, _OPTIONAL_KEYS, origin)
    labels = tuple(_parse_label(entry, origin) for entry in table["labels"])
    protocol = Protocol(
        name=table["name"],
        title=table["title"],
        citation=table["citation"],
        sheet=_tissues(table, "sheet", origin),
        layer=_tissues(table, "layer", origin),
        interior=_tissues(table, "interior", origin),
        labels=labels,
        tool=table.get("tool", ""),
        unlisted=table.get("unlisted", "error"),
        right_offset=table.get("right_offset", 0),
        neighbors=_tissues(table, "neighbors", origin) if "neighbors" in table else (),
    )
    check_protocol(protocol, origin=origin)
    return protocol


def check_protocol(protocol: Protocol, *, origin: str) -> None:
    """Check that the parts of a protocol agree with each other."""
    codes = [label.code for label in protocol.labels]
    twice = sorted({code for code in codes if codes.count(code) > 1})
    used = {label.tissue for label in protocol.labels}
    named = (*protocol.sheet, *protocol.layer, *protocol.interior, *protocol.neighbors)
    absent = [tissue.name for tissue in dict.fromkeys(named) if tissue not in used]
    order = tuple(tissue for tissue in MEDIAL_TO_LATERAL if tissue in protocol.sheet)
    beside = tuple(tissue for tissue in FAR_TO_NEAR if tissue in protocol.neighbors)
    problems = {
        f"name {protocol.name!r} has to consist of letters and digits": not re.fullmatch(
            "[A-Za-z0-9]+", protocol.name
        ),
        "there are no labels": not codes,
        f"code {', '.join(map(str, twice))} is listed twice": bool(twice),
        "unlisted has to be 'error' or 'other'": protocol.unlisted not in {"error", "other"},
        "right_offset has to exceed every code": bool(codes)
        and protocol.right_offset != 0
        and protocol.right_offset <= max(codes),
        f"no label has tissue {', '.join(absent)}": bool(absent),
        "sheet has to list each tissue once, medial to lateral, out of "
        + ", ".join(t.name for t in MEDIAL_TO_LATERAL): protocol.sheet != order,
        "neighbors has to list each tissue once, far to near, out of "
        + ", ".join(t.name for t in FAR_TO_NEAR): protocol.neighbors != beside,
        "a tissue is in both sheet and layer": not set(protocol.sheet).isdisjoint(protocol.layer),
        "a tissue is in both sheet and interior": not set(protocol.sheet).isdisjoint(
            protocol.interior
        ),
        "layer, interior or neighbors is given without a sheet": not protocol.sheet and bool(named),
        "there is neither a sheet nor a label with a part": not protocol.sheet
        and all(label.part is Part.UNKNOWN for label in protocol.labels),
    }
    for problem, wrong in problems.items():
        if wrong:
            raise _invalid(origin, problem)


def _parse_label(entry: object, origin: str) -> Label:
    if not isinstance(entry, dict):
        raise _invalid(origin, f"label {entry!r} is not a table")
    where = f"{origin}, label {entry.get('code', '?')}"
    _check_keys(entry, _LABEL_KEYS, _OPTIONAL_LABEL_KEYS, where)
    if entry["code"] <= 0:
        raise _invalid(where, "codes are positive (0 is background)")
    if not re.fullmatch("#[0-9a-fA-F]{6}", entry["color"]):
        raise _invalid(where, f"color {entry['color']!r} is not of the form #rrggbb")
    return Label(
        code=entry["code"],
        tissue=_member(Tissue, entry["tissue"], where),
        part=_member(Part, entry.get("part", "unknown"), where),
        name=entry["name"],
        abbreviation=entry["abbreviation"],
        color=entry["color"].lower(),
    )


def _tissues(table: Mapping[str, Any], key: str, origin: str) -> tuple[Tissue, ...]:
    return tuple(_member(Tissue, name, f"{origin}, {key}") for name in table[key])


def _member(kind: type[_Member], name: object, where: str) -> _Member:
    """Find an enumeration's member by its name in any case."""
    names = {member.name.lower(): member for member in kind}
    if not isinstance(name, str) or name.lower() not in names:
        hint = _did_you_mean(str(name).lower(), names)
        raise _invalid(where, f"unknown {kind.__name__.lower()} {name!r}{hint}")
    return names[name.lower()]


def _check_keys(
    table: Mapping[str, Any],
    required: Mapping[str, type],
    optional: Mapping[str, type],
    where: str,
) -> None:
    kinds = {**required, **optional}
    for key, value in table.items():
        if key not in kinds:
            raise _invalid(where, f"unknown key {key!r}{_did_you_mean(key, kinds)}")
        # bool is a subclass of int, and "code = true" is a mistake.
        if not isinstance(value, kinds[key]) or isinstance(value, bool):
            raise _invalid(where, f"{key} has to be of type {kinds[key].__name__}")
    for key in required:
        if key not in table:
            raise _invalid(where, f"key {key!r} is missing")


def _did_you_mean(name: str, names: Iterable[str]) -> str:
    near = difflib.get_close_matches(name, list(names), n=1)
    return f" (did you mean {near[0]!r}?)" if near else ""


def _invalid(where: str, problem: str) -> ProtocolError:
    return ProtocolError(f"{where}: {problem}", reason="invalid-scheme")


# Protocols described by names instead of numbers: label tables that come with a dataset.


#: What laboratories call the tissues, after :func:`identify_tissue` has reduced a name.
_NAMES = {
    Tissue.BACKGROUND: {"background", "clear", "unknown"},
    Tissue.PRESUBICULUM: {"presubiculum", "presub", "prs"},
    Tissue.SUBICULUM: {"subiculum", "sub", "subicularcomplex"},
    Tissue.CA1: {"ca1"},
    Tissue.CA2: {"ca2"},
    Tissue.CA2_3: {"ca23", "ca2ca3"},
    Tissue.CA3: {"ca3"},
    Tissue.CA4: {"ca4", "hilus"},
    Tissue.DENTATE_GYRUS: {
        *("dg", "dentate", "dentategyrus", "fasciadentata", "gcdg", "gcmldg"),
        *("ca4dg", "dgca4", "ca4dentategyrus", "dentategyrusca4", "ca4gcdg", "ca4gcmldg"),
        *("dghilus", "hilusdg"),
    },
    Tissue.MOLECULAR_LAYER: {
        *("molecularlayer", "ml", "srlm", "slrm", "srlslm", "slm"),
        "stratumradiatumlacunosummoleculare",
        "stratumradiatumstratumlacunosumstratummoleculare",
    },
    Tissue.PARASUBICULUM: {"parasubiculum", "parasub", "paras"},
    Tissue.HATA: {"hata", "amygdalatransitionarea"},
    Tissue.FIMBRIA: {"fimbria", "fim"},
    Tissue.FISSURE: {"fissure", "fis"},
    Tissue.CYST: {"cyst", "cysts"},
    Tissue.ENTORHINAL: {"entorhinal", "erc", "ec"},
    Tissue.BA35: {"ba35", "br35", "a35", "area35"},
    Tissue.BA36: {"ba36", "br36", "a36", "area36"},
    Tissue.PARAHIPPOCAMPAL: {"parahippocampal", "parahippocampalgyrus", "phc", "phg"},
}
_TISSUES = {name: tissue for tissue, names in _NAMES.items() for name in names}
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

#: Colors of tissues in tables that give none (ColorBrewer's qualitative sets, recycled).
_COLORS = ("#1b9e77", "#d95f02", "#7570b3", "#e7298a", "#66a61e", "#e6ab02", "#a6761d", "#666666")


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
    rest = "".join(word for word in words if word not in _FILLERS and word not in _PARTS)
    if rest:
        return _TISSUES.get(rest, Tissue.OTHER), part
    if part is not Part.UNKNOWN or not _WHOLE.isdisjoint(words):
        return Tissue.HIPPOCAMPUS, part
    return Tissue.OTHER, part


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
            f"{origin}: its names do not include a subiculum and a CA1; "
            "describe the labels in a TOML file and pass it with --scheme",
            reason="unclear-names",
        )
    inside = (Tissue.DENTATE_GYRUS, Tissue.CA4, Tissue.MOLECULAR_LAYER)
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
    check_protocol(protocol, origin=origin)
    return protocol


def agrees(protocol: Protocol, rows: Iterable[NamedCode]) -> bool:
    """Say whether a label table describes a given protocol.

    The table has to list every label of the sheet and its interior, and each code that it lists
    has to mean the same tissue in the protocol. Codes whose names say nothing may be missing there.
    """
    table = {row.code: _label(row, 0).tissue for row in rows if row.code > 0}
    known = {label.code: label.tissue for label in protocol.labels}
    needed = {*protocol.sheet, *protocol.interior}
    complete = all(code in table for code, tissue in known.items() if tissue in needed)
    silent = {Tissue.OTHER, Tissue.BACKGROUND}
    return complete and all(
        known.get(code, tissue if tissue in silent else None) is tissue
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


# What is measured: the hippocampal body, with the cortex beside it, or that cortex alone.


def for_region(protocol: Protocol, region: str) -> Protocol:
    """Give a protocol the sheet of a region."""
    if region == "body":
        return protocol
    if not protocol.neighbors:
        able = [name for name in protocol_names() if load_protocol(name).neighbors]
        raise ProtocolError(
            f"region {region}: the protocol {protocol.name} has no labels of neighboring cortex; "
            f"{', '.join(able)} have; measure the body, or list them as neighbors in a protocol "
            "file for --scheme",
            reason="no-cortex-labels",
        )
    hippocampal = protocol.sheet if region == "extended" else ()
    return replace(protocol, sheet=(*protocol.neighbors, *hippocampal))
