"""The user's table of participants to leave out."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from hipsta_bids.bids import files
from hipsta_bids.bids.names import HemisphereName
from hipsta_bids.errors import InputError

#: How many names a note lists.
_SHOWN = 4


def read_exclusions(path: Path | None) -> list[dict[str, str]]:
    """Read the user's table of participants, or single sessions and hemispheres, to leave out.

    Raises
    ------
    InputError
        If it cannot be read, or names no participants.
    """
    if path is None:
        return []
    rows = files.read_tsv(path)
    if rows and "participant_id" not in rows[0]:
        raise InputError(
            f"{path}: no column participant_id; it may have session_id, hemi and reason besides",
            reason="bad-table",
        )
    return rows


def lost_exclusions(
    path: Path | None, rows: Sequence[Mapping[str, str]], found: Sequence[HemisphereName]
) -> tuple[str, ...]:
    """Say which rows of the user's table are about nobody here: labels may be misspelled."""
    if path is None:
        return ()
    if not rows:
        return (f"{path}: lists nobody to exclude",)
    lost = [
        row["participant_id"] for row in rows if not any(is_listed(name, row) for name in found)
    ]
    if not lost:
        return ()
    more = f" and {len(lost) - _SHOWN} more" if len(lost) > _SHOWN else ""
    return (f"{path}: not here, or not so, are {', '.join(lost[:_SHOWN])}{more}",)


def is_listed(name: HemisphereName, row: Mapping[str, str]) -> bool:
    """Whether a row of the user's table means this hemisphere; empty cells mean any."""
    own = {"participant_id": name.subject, "session_id": name.session or "", "hemi": name.hemi}
    for key, value in own.items():
        cell = row.get(key, files.MISSING).removeprefix("sub-").removeprefix("ses-")
        if cell not in {files.MISSING, "", value}:
            return False
    return True
