"""Labels that occur twice in an output dataset, by hashes of quality records."""

import contextlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hipsta_bids.derivatives.dataset import agrees, name_of, read_status, update_status
from hipsta_bids.derivatives.names import HemisphereName
from hipsta_bids.derivatives.results import ResultPlace, read_record
from hipsta_bids.errors import InputError
from hipsta_bids.io import files

_COLUMN = "same_labels"
_LISTED_NAMES = 6  # names in a message


def _label_files(record: Mapping[str, Any]) -> Sequence[Mapping[str, Any]]:
    edited = [e for e in record.get("edited") or [] if e.get("what") == "labels"]
    return edited or record.get("inputs") or []


def same_labels(
    records: Iterable[tuple[HemisphereName, Mapping[str, Any]]],
) -> list[tuple[HemisphereName, ...]]:
    """Group hemispheres whose label files have the same content, by their quality records.

    One file with both hemispheres of a visit is no copy, nor is it one if the same hemisphere is
    measured in several ways.
    """
    groups: dict[tuple[str, ...], list[tuple[HemisphereName, tuple[str, ...]]]] = {}
    for name, record in records:
        entries = _label_files(record)
        hashes = tuple(str(entry.get("sha256") or "") for entry in entries)
        if hashes and all(hashes):
            addresses = tuple(str(entry.get("file")) for entry in entries)
            groups.setdefault(hashes, []).append((name, addresses))
    return [
        tuple(name for name, _ in members)
        for members in groups.values()
        if len({(name.subject, name.session, addresses) for name, addresses in members}) > 1
        and len({(name.subject, name.session, name.hemi) for name, _ in members}) > 1
    ]


def describe_copies(names: Sequence[HemisphereName]) -> str:
    """Write one line about hemispheres with the same labels."""
    return f"{_list(names)} have the same labels, byte for byte; check that no file was copied"


def _list(names: Sequence[HemisphereName]) -> str:
    titles = [name.title for name in names]
    hidden = len(titles) - _LISTED_NAMES
    return ", ".join(titles[:_LISTED_NAMES]) + (f" and {hidden} more" if hidden > 0 else "")


def mark_copies(root: Path) -> list[tuple[HemisphereName, ...]]:
    """Write into ``status.tsv`` which hemispheres have the same labels.

    Rows that do not agree with their quality record are left as they are: another run is at them.
    Returns the groups, see :func:`same_labels`.
    """
    rows, records = {}, {}
    for row in read_status(root):
        name = name_of(row)
        with contextlib.suppress(InputError):
            record = read_record(ResultPlace(root=root, name=name))
            if agrees(row, record):
                rows[name], records[name] = row, record
    groups = same_labels(records.items())
    copies_of = {name: _list([n for n in group if n != name]) for group in groups for name in group}
    cells = {name: copies_of.get(name, files.MISSING) for name in rows}
    changed = [
        row | {_COLUMN: cells[name]}
        for name, row in rows.items()
        if row.get(_COLUMN, files.MISSING) != cells[name]
    ]
    if changed:
        update_status(root, changed)
    return groups
