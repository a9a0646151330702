"""Protocols described by names instead of numbers: label tables that come with a dataset."""

import re
from collections.abc import Iterable
from dataclasses import dataclass

from hipsta_bids.errors import SchemeError
from hipsta_bids.schemes.loader import check_scheme
from hipsta_bids.schemes.scheme import Label, Scheme
from hipsta_bids.schemes.tissues import FAR_TO_NEAR, MEDIAL_TO_LATERAL, Part, Tissue

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
    """Understand a label's name.

    Parameters
    ----------
    name : str
        For example ``Left-CA1-head``, ``hippocampal_tail``, ``CA2/3`` or ``dentate_gyrus``.

    Returns
    -------
    tissue, part
        ``Tissue.OTHER`` for a name that is not known.
    """
    words = re.findall("[a-z0-9]+", name.lower())
    part = next((_PARTS[word] for word in words if word in _PARTS), Part.UNKNOWN)
    rest = "".join(word for word in words if word not in _FILLERS and word not in _PARTS)
    if rest:
        return _TISSUES.get(rest, Tissue.OTHER), part
    if part is not Part.UNKNOWN or not _WHOLE.isdisjoint(words):
        return Tissue.HIPPOCAMPUS, part
    return Tissue.OTHER, part


def scheme_from_names(rows: Iterable[NamedCode], *, name: str, origin: str) -> Scheme:
    """Make a protocol from a label table.

    Parameters
    ----------
    rows : iterable of NamedCode
    name : str
        The protocol's name; alphanumeric.
    origin : str
        Where the table comes from, for the title and for error messages.

    Returns
    -------
    Scheme

    Raises
    ------
    SchemeError
        ``unclear-names`` if the table names no subiculum or no CA1; ``invalid-scheme`` if a code
        is listed twice.
    """
    labels = tuple(
        label
        for index, row in enumerate(rows)
        if row.code > 0 and (label := _label(row, index)).tissue is not Tissue.BACKGROUND
    )
    tissues = {label.tissue for label in labels}
    if not tissues >= {Tissue.SUBICULUM, Tissue.CA1}:
        raise SchemeError(
            f"{origin}: its names do not include a subiculum and a CA1; "
            "describe the labels in a TOML file and pass it with --scheme",
            reason="unclear-names",
        )
    inside = (Tissue.DENTATE_GYRUS, Tissue.CA4, Tissue.MOLECULAR_LAYER)
    scheme = Scheme(
        name=name,
        title=f"Labels named in {origin}",
        citation="",
        sheet=tuple(tissue for tissue in MEDIAL_TO_LATERAL if tissue in tissues),
        layer=tuple(tissue for tissue in (Tissue.MOLECULAR_LAYER,) if tissue in tissues),
        interior=tuple(tissue for tissue in inside if tissue in tissues),
        labels=labels,
        neighbors=tuple(t for t in FAR_TO_NEAR if t in tissues and t in _NEIGHBORS),
    )
    check_scheme(scheme, origin=origin)
    return scheme


def agrees(scheme: Scheme, rows: Iterable[NamedCode]) -> bool:
    """Say whether a label table describes a given protocol.

    The table has to list every label of the sheet and its interior, and each code that it lists
    has to mean the same tissue in the protocol. Codes whose names say nothing may be missing there.
    """
    table = {row.code: _label(row, 0).tissue for row in rows if row.code > 0}
    protocol = {label.code: label.tissue for label in scheme.labels}
    needed = {*scheme.sheet, *scheme.interior}
    complete = all(code in table for code, tissue in protocol.items() if tissue in needed)
    silent = {Tissue.OTHER, Tissue.BACKGROUND}
    return complete and all(
        protocol.get(code, tissue if tissue in silent else None) is tissue
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
