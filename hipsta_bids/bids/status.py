"""``status.tsv``: one row per hemisphere, kept over all runs into the same folder."""

from collections.abc import Iterable, Mapping
from pathlib import Path

from hipsta_bids.bids import files
from hipsta_bids.bids.locks import DATASET, locked
from hipsta_bids.bids.names import DATASET_FILES, HemisphereName
from hipsta_bids.errors import InputError

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

_KEY = ("subject", "session", "hemi", "seg")


def identity(name: HemisphereName) -> dict[str, str]:
    """Cells that say whose row it is."""
    return {
        "subject": f"sub-{name.subject}",
        "session": f"ses-{name.session}" if name.session else files.MISSING,
        "hemi": name.hemi,
        "seg": name.seg,
        "region": name.region,
    }


def row_key(row: Row) -> tuple[str, ...]:
    """Cells that tell rows apart."""
    region = row.get("region", files.MISSING)
    # Rows of a table without that column are about the body.
    return *(row[key] for key in _KEY), "body" if region == files.MISSING else region


def read_status(root: Path) -> list[dict[str, str]]:
    """Read the rows of all runs so far.

    Parameters
    ----------
    root : Path
        The output dataset.

    Returns
    -------
    list of dict
        Empty if there is no table yet, or not a readable one: it is rebuilt as hemispheres end.
    """
    try:
        rows = files.read_tsv(root / DATASET_FILES["status"])
    except InputError:
        return []
    return [row for row in rows if all(key in row for key in _KEY)]


def update_status(root: Path, rows: Iterable[Row]) -> None:
    """Replace or add rows; those of other hemispheres stay.

    Safe for several runs at a time into the same folder, as on a cluster.

    Parameters
    ----------
    root : Path
        The output dataset.
    rows : iterable of mapping
        Cells by column.

    Raises
    ------
    OutputError
        If the table cannot be written; the earlier one is then unharmed.
    """
    with locked(root, DATASET):
        merged = {row_key(row): row for row in read_status(root)}
        merged |= {row_key(row): dict(row) for row in rows}
        ordered = [merged[key] for key in sorted(merged)]
        stages = dict.fromkeys(
            column for row in ordered for column in row if column.startswith(STAGE_PREFIX)
        )
        columns = (*COLUMNS, *stages)
        files.write_tsv(
            root / DATASET_FILES["status"],
            columns,
            ([row.get(column, files.MISSING) for column in columns] for row in ordered),
        )


def write_sidecar(root: Path) -> None:
    """Write ``status.json``, which says what the columns are.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    described = {name: {"Description": text} for name, text in COLUMNS.items()}
    described[f"{STAGE_PREFIX}*"] = {"Description": "elapsed time of one stage, s"}
    files.write_json(root / DATASET_FILES["status_sidecar"], described)
