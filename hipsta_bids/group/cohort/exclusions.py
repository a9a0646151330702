"""Which hemispheres a person leaves out: tables, ratings, and conditions on quality metrics."""

import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from hipsta_bids.derivatives.names import HemisphereName
from hipsta_bids.errors import InputError, UsageError, did_you_mean
from hipsta_bids.io import files
from hipsta_bids.io.labels import match_rows
from hipsta_bids.stats.formula import listed
from hipsta_bids.types import PARTICIPANT, RATINGS, SESSION, VisitKey

#: Number of names that a note lists.
SHOWN = 4
_RATING, _HASH = "rating", "input_hash"
_NO_RATING = "unrated"
#: Comparisons of a condition on a quality metric.
_OPERATORS: Mapping[str, Callable[[float, float], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
}

Condition = tuple[str, str, float]
"""Quality metric, a key of ``_OPERATORS``, and the number to compare with."""


@dataclass(frozen=True, eq=False)
class UserTable:
    """Rows about participants, or single sessions and hemispheres."""

    path: Path | None = None
    """``None`` if there is no table."""
    rows: tuple[Mapping[str, str], ...] = ()
    lines: tuple[str, ...] = ()
    """Notes on labels that the table spells in another way than the data."""

    @classmethod
    def of(
        cls, path: Path, rows: Sequence[Mapping[str, str]], visits: Sequence[VisitKey]
    ) -> "UserTable":
        """Write labels of a table as in the data."""
        subjects, sessions = ([visit[n] for visit in visits] for n in (0, 1))
        data = {PARTICIPANT: subjects, SESSION: sessions}
        written, lines = match_rows(rows, data, str(path))
        return cls(path, tuple(written), tuple(lines))

    @cached_property
    def _by_subject(self) -> Mapping[str, list[Mapping[str, str]]]:
        rows_of: dict[str, list[Mapping[str, str]]] = {}
        for row in self.rows:
            cell = row[PARTICIPANT]
            key = "" if files.is_missing(cell) else cell.removeprefix("sub-")
            rows_of.setdefault(key, []).append(row)
        return rows_of

    def about(self, name: HemisphereName) -> list[Mapping[str, str]]:
        """List rows that mean a hemisphere; rows without a participant mean all."""
        rows = [*self._by_subject.get(name.subject, ()), *self._by_subject.get("", ())]
        return [row for row in rows if is_listed(name, row)]

    def applying(self, name: HemisphereName, digest: str | None) -> list[Mapping[str, str]]:
        """List rows that mean a hemisphere with this hash of its input, if both are known."""
        return [row for row in self.about(name) if _is_current(row, digest)]

    def notes(self, names: Iterable[tuple[HemisphereName, str | None]]) -> list[str]:
        """Note rows that match no hemisphere, as by a misspelled label, or earlier labels.

        The ``names`` are of all protocols and regions, as rows of a saved table may be.
        """
        if self.path is None:
            return []
        if not self.rows:
            return [f"{self.path}: has no rows that count; it changes nothing"]
        matched, old = set(), []
        for name, digest in names:
            rows = self.about(name)
            matched |= {id(row) for row in rows}
            if any(not _is_current(row, digest) for row in rows):
                old.append(name.stem)
        unmatched = [f"sub-{row[PARTICIPANT]}" for row in self.rows if id(row) not in matched]
        text = f"{self.path}: matches no hemisphere here: {listed(unmatched, SHOWN)}"
        if len(unmatched) == len(self.rows):
            raise InputError(f"{text}; correct the labels, or omit the table", reason="bad-table")
        notes = [*self.lines, *[text] * bool(unmatched)]
        if old:
            notes.append(
                f"{self.path}: not applied to hemispheres whose labels have changed since they were"
                f" rated: {listed(old, SHOWN)}; rate them again"
            )
        return notes


class Choices:
    """The user's choices of hemispheres: a table of exclusions, and one of ratings.

    A table of ratings may stand for one of exclusions. The ``visits`` are of the data. InputError
    if a table lacks a column, or has another rating than `RATINGS`.
    """

    def __init__(
        self, exclusions: Path | None, ratings: Path | None, visits: Iterable[VisitKey]
    ) -> None:
        self.excluded, self.rated, data = UserTable(), UserTable(), list(visits)
        if exclusions is not None:
            rows = _read(exclusions, ())
            last = [row for row in rows if row.get(_RATING, RATINGS[-1]) == RATINGS[-1]]
            self.excluded = UserTable.of(exclusions, last, data)
        if ratings is not None:
            self.rated = UserTable.of(ratings, _read(ratings, (_RATING,)), data)

    def reason_to_leave_out(
        self, name: HemisphereName, digest: str | None
    ) -> tuple[str, str] | None:
        """Return reason and message if a hemisphere is excluded, given the hash of its input."""
        for row in self.excluded.applying(name, digest):
            return "listed", row.get("reason") or _note(row, "in the table of --exclude")
        for row in self.rated.applying(name, digest):
            if row[_RATING] == RATINGS[-1]:
                return "rated", _note(row, f"rated {RATINGS[-1]}")
        return None

    def approves(self, name: HemisphereName, digest: str | None) -> bool:
        """Check whether all ratings of a hemisphere, given the hash of its input, are for use."""
        return {row[_RATING] for row in self.rated.applying(name, digest)} == {RATINGS[0]}

    def rating(self, name: HemisphereName, digest: str | None) -> str:
        """Return the strictest rating of a hemisphere, ``unrated`` without one."""
        ratings = {row[_RATING] for row in self.rated.applying(name, digest)}
        return next((word for word in reversed(RATINGS) if word in ratings), _NO_RATING)

    def counts(self, names: Iterable[tuple[HemisphereName, str | None]]) -> dict[str, int] | None:
        """Count hemispheres by rating, the strictest of several; ``None`` without a table."""
        if self.rated.path is None:
            return None
        counts = dict.fromkeys((*RATINGS, _NO_RATING), 0)
        for name, digest in names:
            counts[self.rating(name, digest)] += 1
        return counts


def _read(path: Path, needed: Sequence[str]) -> list[dict[str, str]]:
    rows = files.read_tsv(path)
    lacking = [name for name in ("participant_id", *needed) if rows and name not in rows[0]]
    if lacking:
        raise InputError(
            f"{path}: no column {lacking[0]}; it may have session_id, hemi, protocol, region,"
            f" {_HASH}, {'note' if needed else 'reason'} besides",
            reason="bad-table",
        )
    for line, row in enumerate(rows, start=2):
        word = row.get(_RATING, files.MISSING)
        if word not in RATINGS and not files.is_missing(word):
            raise InputError(
                f"{path}: line {line}: {word!r} is no rating; {', '.join(RATINGS)} are",
                reason="bad-table",
            )
    return rows


def _note(row: Mapping[str, str], default: str) -> str:
    note = row.get("note", files.MISSING)
    return default if files.is_missing(note) else note


def _is_current(row: Mapping[str, str], digest: str | None) -> bool:
    rated = row.get(_HASH, files.MISSING)
    return digest in {None, rated} or files.is_missing(rated)


def is_listed(name: HemisphereName, row: Mapping[str, str]) -> bool:
    """Whether a row of the user's table means this hemisphere; empty cells mean any.

    One without a protocol, of other programs' maps, is meant by rows of any protocol and region.
    """
    keys = {PARTICIPANT: name.subject, SESSION: name.session or "", "hemi": name.hemi}
    keys |= {"protocol": name.seg, "region": name.region} if name.seg else {}
    for key, value in keys.items():
        cell = row.get(key, files.MISSING)
        label = cell.removeprefix("sub-").removeprefix("ses-")
        if label != value and not files.is_missing(cell):
            return False
    return True


def fulfilled(conditions: Sequence[Condition], metrics: Mapping[str, Any]) -> str | None:
    """Return the first condition that quality metrics fulfill; missing ones fulfill none."""
    for name, sign, limit in conditions:
        if name not in metrics:
            hint = did_you_mean([name], metrics) or "; see the desc-qc_metrics.json files"
            raise UsageError(f"--exclude-qc: {name!r} is no quality metric{hint}")
        value = metrics[name]
        if value is None:
            continue
        if not isinstance(value, int | float):
            raise UsageError(f"--exclude-qc: {name} is {value!r}, no number; choose another metric")
        if _OPERATORS[sign](value, limit):
            return f"{name} {sign} {limit:.10g}"
    return None
