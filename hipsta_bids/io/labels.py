"""Labels of a user's table and labels of the data that differ in zeros, signs or capitals."""

import re
from collections.abc import Iterable, Mapping, Sequence

from hipsta_bids.errors import InputError
from hipsta_bids.io.files import is_missing

_ZEROS = re.compile(r"(?<!\d)0+(?=\d)")
_PREFIX = re.compile(r"((sub|ses)-)+")  # of sub-SUB-01, too
_DECIMALS = re.compile(r"(?<=\d)\.0+$")  # 1.0, as spreadsheets write numbers

#: Spellings of hemispheres, without capitals.
_HEMIS = {"l": "L", "lh": "L", "left": "L", "r": "R", "rh": "R", "right": "R"}


def match_labels(
    labels: Iterable[str], data: Iterable[str], place: str
) -> tuple[dict[str, str], list[str]]:
    """Match labels of a table with labels of the data, exactly or one to one; also note it.

    Labels match that differ in leading zeros, signs and capitals only, as ``1`` and ``sub-01``.
    InputError where several labels of the table or of the data would match.
    """
    of_table, of_data = dict.fromkeys(labels), dict.fromkeys(data)
    by_key: dict[str, tuple[list[str], list[str]]] = {}
    for side, names in enumerate((of_table, of_data)):
        for name in names:
            by_key.setdefault(_key(name), ([], []))[side].append(name)
    matches: dict[str, str] = {}
    for table_names, data_names in by_key.values():
        if not table_names or not data_names or set(table_names) == set(data_names):
            continue
        if len(table_names) > 1 or len(data_names) > 1:
            raise InputError(
                f"{place}: {' and '.join(table_names)} may be {' or '.join(data_names)} of the"
                " data; write the labels as in the data",
                reason="bad-table",
            )
        matches[table_names[0]] = data_names[0]
    if not matches:
        return {}, []
    first = next(iter(matches))
    count = f" ({len(matches)} labels alike)" if len(matches) > 1 else ""
    return matches, [f"{place}: {first} is read as {matches[first]}{count}"]


def refuse_alike(labels: Iterable[str], data: Iterable[str], place: str) -> None:
    """Refuse labels that would match others, where another label is a new one."""
    for label, name in match_labels(labels, data, place)[0].items():
        raise InputError(f"{place}: {label} may be {name}; write it so, or choose another name")


def match_rows(
    rows: Sequence[Mapping[str, str]], data: Mapping[str, Iterable[str | None]], place: str
) -> tuple[list[dict[str, str]], list[str]]:
    """Write labels in some columns of a table as in the data, without prefixes; also note it.

    A hemisphere may be spelled ``lh`` or ``left``. InputError where it is neither side, and as of
    `match_labels`.
    """
    written = [{name: cell.strip() for name, cell in row.items()} for row in rows]
    notes = []
    for column, labels in data.items():
        for row in written:
            cell = row.get(column, "")
            label = cell.removeprefix("sub-").removeprefix("ses-")
            row[column] = cell if is_missing(label) else label  # sub-NA is a participant
        cells = [row[column] for row in written if not is_missing(row[column])]
        matches, lines = match_labels(cells, [label for label in labels if label], place)
        for row in written:
            row[column] = matches.get(row[column], row[column])
        notes += lines
    for line, row in enumerate(written, start=2):
        cell = row.get("hemi", "")
        row["hemi"] = _HEMIS.get(cell.casefold(), "")
        if not row["hemi"] and not is_missing(cell):
            raise InputError(
                f"{place}: line {line}: hemi {cell!r} is not L or R; correct it", reason="bad-table"
            )
    return written, notes


def _key(label: str) -> str:
    """Return a label without prefix, leading zeros, signs and capitals."""
    name = _DECIMALS.sub("", _PREFIX.sub("", label.casefold()).strip())
    return _ZEROS.sub("", re.sub(r"[\W_]+", "", name))
