"""Labels of a user's table and labels of the data that differ in zeros, signs or capitals."""

import re
from collections.abc import Iterable

from hipsta_bids.errors import InputError

_ZEROS = re.compile(r"(?<!\d)0+(?=\d)")
_DECIMALS = re.compile(r"(?<=\d)\.0+$")  # 1.0, as spreadsheets write numbers


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


def _key(label: str) -> str:
    """Return a label without prefix, leading zeros, signs and capitals."""
    name = _DECIMALS.sub("", label.removeprefix("sub-").removeprefix("ses-").strip())
    return _ZEROS.sub("", re.sub(r"[\W_]+", "", name).casefold())
