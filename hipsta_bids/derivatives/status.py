"""``status.tsv``: one row per hemisphere, kept over all runs into the same folder."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hipsta_bids.derivatives.names import DATASET_FILES, HemisphereName, output_path
from hipsta_bids.errors import InputError
from hipsta_bids.io import files
from hipsta_bids.io.files import DATASET, locked

Row = Mapping[str, str]
"""Cells by column."""

STAGE_PREFIX = "seconds_"

#: Columns that every row has, with their meaning; one column per stage follows.
COLUMNS: dict[str, str] = {
    "subject": "subject, with its sub- prefix",
    "session": "session, with its ses- prefix",
    "hemi": "L or R",
    "seg": "segmentation protocol",
    "region": "what was measured: body, extended (and neighboring cortex), entorhinal (that alone)",
    "status": "ok; repaired: small defects were mended; flagged: look before use;"
    " failed: there are no maps",
    "reason": "machine-readable reasons, joined by +",
    "message": "what happened and what to try",
    "edited": "what a person corrected: labels, mask, joined by +",
    "version": "version of hipsta_bids",
    "settings_hash": "SHA-256 of the resolved settings",
    "input_hash": "SHA-256 of the input files and of how they are read",
    "seconds": "elapsed time, s",
    "cpu_seconds": "processor time, s",
    "peak_memory_mb": "largest resident memory of the process, MB (1e6 bytes)",
}

NOT_FINISHED = "not-finished"
"""Reason of a hemisphere that a run has not reached yet."""

_KEY = ("subject", "session", "hemi", "seg")

#: Cells that the quality record has too.
RECORDED = ("status", "reason", "version", "settings_hash", "input_hash")

_SHARD_TABLE = "status_shard-*.tsv"


def identity(name: HemisphereName) -> dict[str, str]:
    """Cells that identify the hemisphere of a row."""
    return {
        "subject": f"sub-{name.subject}",
        "session": f"ses-{name.session}" if name.session else files.MISSING,
        "hemi": name.hemi,
        "seg": name.seg,
        "region": name.region,
    }


def row_key(row: Row) -> tuple[str, ...]:
    """Cells that distinguish rows."""
    region = row.get("region", files.MISSING)
    # Rows of a table without that column are about the body.
    return *(row[key] for key in _KEY), "body" if region == files.MISSING else region


def table_path(shard: str | None = None) -> str:
    """Path in the output dataset of the table, or of that of one shard."""
    if shard is None:
        return DATASET_FILES["status"]
    return f"{DATASET_FILES['logs']}/{_SHARD_TABLE.replace('*', shard)}"


def read_status(root: Path) -> list[dict[str, str]]:
    """Read the rows of all runs so far, shards included.

    Of several rows of the same hemisphere, the one that agrees with the quality record is taken.
    """
    shards = sorted((root / DATASET_FILES["logs"]).glob(_SHARD_TABLE))
    found: dict[tuple[str, ...], list[dict[str, str]]] = {}
    for path in (root / DATASET_FILES["status"], *shards):
        for row in read_table(path):
            found.setdefault(row_key(row), []).append(row)
    return [
        rows[0] if len(rows) == 1 else _current(root, rows) for _, rows in sorted(found.items())
    ]


def read_table(path: Path) -> list[dict[str, str]]:
    """Read one table; empty if there is none, or if it is unreadable."""
    try:
        rows = files.read_tsv(path)
    except InputError:
        return []
    return [row for row in rows if all(key in row for key in _KEY)]


def _current(root: Path, rows: Sequence[dict[str, str]]) -> dict[str, str]:
    """Choose among rows of the same hemisphere."""
    try:
        record = files.read_json(root / output_path(name_of(rows[0]), "qc"))
    except InputError:
        record = {}

    def rank(row: Row) -> tuple[bool, bool, bool]:
        return (
            agrees(row, record),
            # If none agrees, one run has not finished.
            row.get("reason") == NOT_FINISHED,
            row.get("seconds", files.MISSING) != files.MISSING,
        )

    return max(rows, key=rank)


def agrees(row: Row, record: Mapping[str, Any]) -> bool:
    """Check whether a row agrees with a quality record."""
    return all(row.get(key) == (record.get(key) or files.MISSING) for key in RECORDED)


def name_of(row: Row) -> HemisphereName:
    """Identify whose row it is: the inverse of :func:`identity`."""
    *_, seg, region = row_key(row)
    session = row["session"].removeprefix("ses-")
    return HemisphereName(
        subject=row["subject"].removeprefix("sub-"),
        session=None if session == files.MISSING else session,
        hemi=row["hemi"],
        seg=seg,
        region=region,
    )


def update_status(root: Path, rows: Iterable[Row], *, shard: str | None = None) -> None:
    """Replace or add rows; those of other hemispheres stay.

    Safe for several runs at a time into the same folder, as on a cluster.
    """
    path = root / table_path(shard)
    with locked(root, DATASET if shard is None else path.name):
        merged = {row_key(row): row for row in read_table(path)}
        merged |= {row_key(row): dict(row) for row in rows}
        ordered = [merged[key] for key in sorted(merged)]
        stages = dict.fromkeys(
            column for row in ordered for column in row if column.startswith(STAGE_PREFIX)
        )
        columns = (*COLUMNS, *stages)
        files.write_tsv(
            path,
            columns,
            ([row.get(column, files.MISSING) for column in columns] for row in ordered),
        )


def write_sidecar(root: Path) -> None:
    """Write ``status.json``, which says what the columns are."""
    described = {name: {"Description": text} for name, text in COLUMNS.items()}
    described[f"{STAGE_PREFIX}*"] = {"Description": "elapsed time of one stage, s"}
    files.write_json(root / DATASET_FILES["status_sidecar"], described)
