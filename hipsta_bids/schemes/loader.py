"""Reading and checking protocol files."""

import difflib
import re
import tomllib
from collections.abc import Iterable, Mapping
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

from hipsta_bids.errors import SchemeError
from hipsta_bids.schemes.scheme import Label, Scheme
from hipsta_bids.schemes.tissues import FAR_TO_NEAR, MEDIAL_TO_LATERAL, Part, Tissue

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
def scheme_names() -> tuple[str, ...]:
    """List the names of the bundled protocols, in alphabetical order."""
    files = resources.files("hipsta_bids.schemes").iterdir()
    return tuple(sorted(f.name.removesuffix(".toml") for f in files if f.name.endswith(".toml")))


def load_scheme(name_or_path: str | Path) -> Scheme:
    """Load a bundled protocol by name, or a user's protocol file.

    Parameters
    ----------
    name_or_path : str or Path
        A name of :func:`scheme_names`, or the path of a TOML file (a ``Path``, or a string that
        ends in ``.toml``).

    Returns
    -------
    Scheme

    Raises
    ------
    SchemeError
        ``unknown-scheme`` (with the nearest name), ``unreadable-scheme`` or ``invalid-scheme``.
    """
    if isinstance(name_or_path, Path) or name_or_path.endswith(".toml"):
        return _load_file(Path(name_or_path))
    if name_or_path not in scheme_names():
        raise SchemeError(
            f"no protocol is called {name_or_path!r}{_did_you_mean(name_or_path, scheme_names())}; "
            f"bundled: {', '.join(scheme_names())} (a file's name has to end in .toml)",
            reason="unknown-scheme",
        )
    return _load_bundled(name_or_path)


def scheme_table() -> list[dict[str, str]]:
    """Describe each bundled protocol in one row.

    Returns
    -------
    list of dict
        Keys ``name``, ``tool``, ``title``, ``sheet`` (tissues from medial to lateral),
        ``neighbors`` (cortex beyond the medial end), ``labels`` (how many), ``parts`` (of head,
        body, tail: those that have labels) and ``citation``.
    """
    rows = []
    for name in scheme_names():
        scheme = load_scheme(name)
        parts = sorted({label.part for label in scheme.labels} - {Part.UNKNOWN})
        rows.append(
            {
                "name": name,
                "tool": scheme.tool,
                "title": scheme.title,
                "sheet": ", ".join(tissue.name for tissue in scheme.sheet),
                "neighbors": ", ".join(tissue.name for tissue in scheme.neighbors) or "none",
                "labels": str(len(scheme.labels)),
                "parts": ", ".join(part.name.lower() for part in parts),
                "citation": scheme.citation,
            }
        )
    return rows


@cache
def _load_bundled(name: str) -> Scheme:
    text = resources.files("hipsta_bids.schemes").joinpath(f"{name}.toml").read_text("utf-8")
    scheme = parse_scheme(tomllib.loads(text), origin=f"{name}.toml")
    if scheme.name != name:
        raise _invalid(f"{name}.toml", f"its name is {scheme.name!r}; name and file have to agree")
    return scheme


def _load_file(path: Path) -> Scheme:
    try:
        table = tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        raise SchemeError(
            f"{path}: cannot read the protocol ({error.strerror}); check the path",
            reason="unreadable-scheme",
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SchemeError(
            f"{path}: not a TOML file ({error}); start from a bundled protocol",
            reason="unreadable-scheme",
        ) from error
    return parse_scheme(table, origin=str(path))


def parse_scheme(table: Mapping[str, Any], *, origin: str) -> Scheme:
    """Check the contents of a protocol file.

    Parameters
    ----------
    table : mapping
        The parsed TOML file.
    origin : str
        Where it comes from, for error messages.

    Returns
    -------
    Scheme

    Raises
    ------
    SchemeError
        ``invalid-scheme``, naming the key or label.
    """
    _check_keys(table, _KEYS, _OPTIONAL_KEYS, origin)
    labels = tuple(_parse_label(entry, origin) for entry in table["labels"])
    scheme = Scheme(
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
    check_scheme(scheme, origin=origin)
    return scheme


def check_scheme(scheme: Scheme, *, origin: str) -> None:
    """Check that the parts of a protocol agree with each other.

    Parameters
    ----------
    scheme : Scheme
    origin : str
        Where it comes from, for error messages.

    Raises
    ------
    SchemeError
        ``invalid-scheme``, naming the first thing that is wrong.
    """
    codes = [label.code for label in scheme.labels]
    twice = sorted({code for code in codes if codes.count(code) > 1})
    used = {label.tissue for label in scheme.labels}
    named = (*scheme.sheet, *scheme.layer, *scheme.interior, *scheme.neighbors)
    absent = [tissue.name for tissue in dict.fromkeys(named) if tissue not in used]
    order = tuple(tissue for tissue in MEDIAL_TO_LATERAL if tissue in scheme.sheet)
    beside = tuple(tissue for tissue in FAR_TO_NEAR if tissue in scheme.neighbors)
    problems = {
        f"name {scheme.name!r} has to consist of letters and digits": not re.fullmatch(
            "[A-Za-z0-9]+", scheme.name
        ),
        "there are no labels": not codes,
        f"code {', '.join(map(str, twice))} is listed twice": bool(twice),
        "unlisted has to be 'error' or 'other'": scheme.unlisted not in {"error", "other"},
        "right_offset has to exceed every code": bool(codes)
        and scheme.right_offset != 0
        and scheme.right_offset <= max(codes),
        f"no label has tissue {', '.join(absent)}": bool(absent),
        "sheet has to list each tissue once, medial to lateral, out of "
        + ", ".join(t.name for t in MEDIAL_TO_LATERAL): scheme.sheet != order,
        "neighbors has to list each tissue once, far to near, out of "
        + ", ".join(t.name for t in FAR_TO_NEAR): scheme.neighbors != beside,
        "a tissue is in both sheet and layer": not set(scheme.sheet).isdisjoint(scheme.layer),
        "a tissue is in both sheet and interior": not set(scheme.sheet).isdisjoint(scheme.interior),
        "layer, interior or neighbors is given without a sheet": not scheme.sheet and bool(named),
        "there is neither a sheet nor a label with a part": not scheme.sheet
        and all(label.part is Part.UNKNOWN for label in scheme.labels),
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


def _invalid(where: str, problem: str) -> SchemeError:
    return SchemeError(f"{where}: {problem}", reason="invalid-scheme")
