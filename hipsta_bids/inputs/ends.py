"""End planes that a person has placed: the table of ``--ends``.

One row per end: ``participant_id``, ``session`` where there are sessions, ``hemi``, ``end``, a
point ``r``, ``a``, ``s`` and, if the plane's direction is given too, its normal ``nr``, ``na``,
``ns``.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

from hipsta_bids.errors import HipstaError, InputError
from hipsta_bids.inputs.scan import HEMIS, HemisphereInput
from hipsta_bids.io import files
from hipsta_bids.types import End, GivenEnd, Visit

_POINT, _NORMAL = ("r", "a", "s"), ("nr", "na", "ns")
_NAMES = ("participant_id", "hemi", "end")
_ENDS = ("posterior", "anterior")


@dataclass(frozen=True, kw_only=True)
class EndRow(Visit):
    """A row of the table, and whose it is."""

    hemi: str
    where: str
    """The file and its line."""
    end: GivenEnd | HipstaError
    """The plane, or what is wrong with the row."""

    def is_of(self, item: HemisphereInput) -> bool:
        """Say whether a hemisphere is meant; a row without a session means any."""
        return (self.subject, self.hemi) == (item.subject, item.hemi) and (
            self.session in (None, item.session)
        )


def read_ends(path: Path) -> list[EndRow]:
    """Read the table.

    Raises
    ------
    InputError
        ``ends-columns``, ``ends-row`` if it is unclear whose end a row is, and those of unreadable
        tables.
    """
    rows = files.read_tsv(path)
    known = {*_NAMES, "session", *_POINT, *_NORMAL}
    columns = set(rows[0]) if rows else set()
    lacking = [name for name in (*_NAMES, *_POINT) if name not in columns]
    lacking += [name for name in _NORMAL if columns & set(_NORMAL) and name not in columns]
    if lacking or columns - known:
        fault = f"has unknown {', '.join(sorted(columns - known))}"
        if lacking:
            fault = f"lacks {', '.join(lacking)}" if rows else "has no rows"
        raise InputError(
            f"{path}: {fault}; its columns are {', '.join((*_NAMES, *_POINT))}, and if needed "
            f"session, {', '.join(_NORMAL)}",
            reason="ends-columns",
        )
    return [_row(f"{path}, line {number}", row) for number, row in enumerate(rows, 2)]


def _row(where: str, row: dict[str, str]) -> EndRow:
    cells = {name: cell.strip() for name, cell in row.items()}
    subject = cells["participant_id"].removeprefix("sub-")
    session = cells.get("session", "").removeprefix("ses-")
    hemi = cells["hemi"].upper()
    if hemi not in HEMIS or not subject or subject == files.MISSING:
        what = f"hemi {cells['hemi']!r} is not L or R" if subject else "it has no participant_id"
        raise InputError(f"{where}: {what}; correct it", reason="ends-row")
    end: GivenEnd | HipstaError
    try:
        end = _given(cells)
    except ValueError as error:
        end = InputError(f"{where}: {error}", reason="ends-row")
    return EndRow(
        subject=subject,
        session=session if session not in ("", files.MISSING) else None,
        hemi=hemi,
        where=where,
        end=end,
    )


def _given(cells: dict[str, str]) -> GivenEnd:
    """Read a plane; ``ValueError`` says what is wrong."""
    if cells["end"] not in _ENDS:
        raise ValueError(f"end {cells['end']!r} is not posterior or anterior; correct it")
    point = _vector(cells, _POINT)
    if point is None:
        raise ValueError("it has no point; give r, a and s in mm, scanner coordinates")
    normal = _vector(cells, _NORMAL)
    if normal is not None and math.hypot(*normal) == 0:
        raise ValueError("nr, na, ns are all zero; give a direction, or n/a for none")
    return GivenEnd(end=cast("End", cells["end"]), point=point, normal=normal)


def _vector(cells: dict[str, str], names: Sequence[str]) -> tuple[float, float, float] | None:
    """Read three numbers; none if all are missing."""
    texts = [cells.get(name, "") for name in names]
    if all(text in ("", files.MISSING) for text in texts):
        return None
    numbers = []
    for name, text in zip(names, texts, strict=True):
        try:
            number = float(text)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise ValueError(f"{name} is {text!r}, not a number; correct it")
        numbers.append(number)
    return numbers[0], numbers[1], numbers[2]


def attach_ends(
    items: Sequence[HemisphereInput], path: Path | None
) -> tuple[tuple[HemisphereInput, ...], tuple[str, ...]]:
    """Attach the ends that a table has to the hemispheres, and note how many rows are of others.

    A row that cannot be used, or may be of several sessions, makes its hemispheres fail.
    """
    if path is None:
        return tuple(items), ()
    rows = read_ends(path)
    found = tuple(_attached(item, [r for r in rows if r.is_of(item)], items) for item in items)
    others = [row for row in rows if not any(row.is_of(item) for item in items)]
    if not others:
        return found, ()
    first = others[0]
    session = f" ses-{first.session}" if first.session else ""
    note = (
        f"{first.where}: not used, no labels of sub-{first.subject}{session} hemi-{first.hemi} are "
        f"processed ({len(others)} of {len(rows)} rows are of no hemisphere here)"
    )
    return found, (note,)


def _attached(
    item: HemisphereInput, rows: list[EndRow], items: Sequence[HemisphereInput]
) -> HemisphereInput:
    problem: HipstaError | None = item.problem
    ends: dict[End, GivenEnd] = {}
    sessions = {other.session for other in items if other.subject == item.subject}
    for row in rows:
        if isinstance(row.end, HipstaError):
            problem = problem or row.end
        elif row.session is None and len(sessions) > 1:
            problem = problem or InputError(
                f"{row.where}: sub-{item.subject} has several sessions; name one in a column "
                "session",
                reason="ends-row",
            )
        elif row.end.end in ends:
            problem = problem or InputError(
                f"{row.where}: a second {row.end.end} end of this hemisphere; keep one",
                reason="ends-row",
            )
        else:
            ends[row.end.end] = row.end
    return replace(item, ends=tuple(ends[end] for end in sorted(ends)), problem=problem)
