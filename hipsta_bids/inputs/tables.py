"""Label tables beside the images: ITK-SNAP's ``snaplabels.txt`` and BIDS's ``_dseg.tsv``."""

import csv
import re
from collections.abc import Mapping
from functools import cache, lru_cache
from pathlib import Path

from hipsta_bids.errors import InputError
from hipsta_bids.inputs.scan import list_folder
from hipsta_bids.io.files import entities
from hipsta_bids.protocols.load import NamedCode, protocol_from_names
from hipsta_bids.protocols.protocol import Protocol

#: IDX R G B A VIS MSH "LABEL" (the header of ITK-SNAP's label description files).
_SNAP_LINE = re.compile(
    r'\s*(?P<code>\d+)\s+(?P<r>\d+)\s+(?P<g>\d+)\s+(?P<b>\d+)\s+[\d.]+\s+\d+\s+\d+\s+"(?P<name>[^"]*)"'
)

_SNAP_NAME = "snaplabels.txt"


def find_table(image: Path, root: Path) -> Path | None:
    """Find the label table that applies to an image, beside it or above it in the dataset."""
    own = entities(image.name)
    for folder in (image.parent, *image.parent.parents):
        specific = [
            (len(pairs), name)
            for name, pairs in _tables_in(folder)[0].items()
            if all(own.get(key) == value for key, value in pairs.items())
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
        text = path.read_text("utf-8-sig")
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
        names = list_folder(folder)[1]
    except InputError:  # no such folder, which is the usual case for "snap"
        return {}, False
    parsed = {name: entities(name) for name in names if name.endswith("dseg.tsv")}
    tables = {
        name: {key: value for key, value in pairs.items() if key not in {"suffix", "extension"}}
        for name, pairs in parsed.items()
        if pairs["suffix"] == "dseg"
    }
    return tables, _SNAP_NAME in names
