"""``measures.tsv``: one row per hemisphere, with the decision, where labels come from, and numbers.

It follows ``status.tsv``: a row is read from the quality record and the summary table when that of
the status has changed. Whoever ends last, a shard or the run itself, finds all rows there.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from hipsta_bids.derivatives import dataset
from hipsta_bids.derivatives.hemisphere import summary_definition
from hipsta_bids.derivatives.names import DATASET_FILES, HemisphereName
from hipsta_bids.derivatives.outliers import SIZE, TEXT, compare
from hipsta_bids.derivatives.results import ResultPlace, read_record, read_summary_cells
from hipsta_bids.errors import InputError
from hipsta_bids.io import files
from hipsta_bids.types import Decision

#: Cells that identify a hemisphere, as in ``ratings.tsv``.
_KEY = ("participant_id", "session_id", "hemi", "protocol", "region")
_ORIGIN = "labels_"
_MEANINGS = dataset.TABLES["status"] | dataset.TABLES["measures"]
_COLUMNS = {
    **{name: _MEANINGS[name] for name in (*_KEY, "decision", "reason", "rating", "repairs")},
    **{name: _MEANINGS[name] for name in (SIZE, TEXT)},
    **{f"{_ORIGIN}{name}": about for name, about in dataset.TABLES["provenance"].items()},
    **{name: _MEANINGS[name] for name in ("version", "settings_hash", "input_hash")},
}


def identify(name: HemisphereName) -> dict[str, str]:
    """Cells that identify a hemisphere, as ``participants.tsv`` and ``ratings.tsv`` do."""
    session = f"ses-{name.session}" if name.session else files.MISSING
    cells = (f"sub-{name.subject}", session, name.hemi, name.seg, name.region)
    return dict(zip(_KEY, cells, strict=True))


def origin(record: Mapping[str, Any]) -> dict[str, str]:
    """Cells with the origin of the labels of a quality record."""
    return {f"{_ORIGIN}{name}": cell for name, cell in dataset.provenance_of(record).items()}


def write_measures(root: Path, *, complete: bool = False) -> None:
    """Bring the table of a dataset and its sidecar up to date.

    ``complete`` compares hemispheres that are new with the others, which reads all sheets.
    """
    path = root / DATASET_FILES["measures"]
    with files.locked(root, path.name):
        earlier = {_key(row): row for row in dataset.read_table(path, _KEY)}
        ratings = dataset.read_table(root / DATASET_FILES["ratings"], _KEY)
        rated = {_key(row): row for row in ratings}
        rows = [row | {"rating": _rating(row, rated)} for row in _current_rows(root, earlier)]
        if complete:
            _compare_rows(root, rows)
        numbers = dict.fromkeys(name for row in rows for name in row if name not in _COLUMNS)
        columns = (*_COLUMNS, *numbers)
        cells = ([row.get(column, files.MISSING) for column in columns] for row in rows)
        files.write_tsv(path, columns, cells)
        files.write_json(
            root / DATASET_FILES["measures_sidecar"],
            dataset.describe_columns(_COLUMNS)
            | {name: summary_definition(name) for name in numbers},
        )


def _compare_rows(root: Path, rows: Sequence[dict[str, str]]) -> None:
    """Add what differs from other hemispheres, to all of a protocol and region if any is new."""
    measured = {
        ResultPlace(root=root, name=_name(row)): row
        for row in rows
        if row["decision"] != Decision.FAILED
    }
    new = [p.name.protocol for p, row in measured.items() if files.is_missing(row.get(SIZE, ""))]
    for protocol in set(new):
        for place, cells in compare([p for p in measured if p.name.protocol == protocol]):
            measured[place].update(cells)


def _current_rows(
    root: Path, earlier: Mapping[tuple[str, ...], dataset.Row]
) -> Iterator[dict[str, str]]:
    for status in dataset.read_status(root):
        if status.get("reason") == dataset.NOT_FINISHED:
            continue
        name = dataset.name_of(status)
        identity = identify(name)
        row = earlier.get(tuple(identity.values()), {})
        if any(row.get(column) != status.get(column) for column in dataset.RECORDED):
            with suppress(InputError):  # its files are gone, or another run is at them
                row = identity | read_row(ResultPlace(root=root, name=name))
        if row:
            yield dict(row)


def read_compared(root: Path) -> dict[str, dataset.Row]:
    """Read rows of hemispheres that were compared with others, by title of the hemisphere."""
    rows = dataset.read_table(root / DATASET_FILES["measures"], (*_KEY, SIZE, TEXT))
    return {_name(row).title: row for row in rows if not files.is_missing(row[SIZE])}


def read_row(result: ResultPlace) -> dict[str, str]:
    """Read cells of one hemisphere from its quality record and its summary table.

    InputError if there is no readable record, or no summary of a hemisphere that was measured.
    """
    record = read_record(result)
    cells = {
        **{column: str(record.get(column) or files.MISSING) for column in dataset.RECORDED},
        "repairs": str(len(record.get("repairs") or ())),
        **origin(record),
    }
    is_measured = result.path("summary").exists()
    return cells | (read_summary_cells(result) if is_measured else {})


def _key(row: dataset.Row) -> tuple[str, ...]:
    return tuple(row[column] for column in _KEY)


def _name(row: dataset.Row) -> HemisphereName:
    names = {"subject": row["participant_id"], "session": row["session_id"]}
    return dataset.name_of({**row, **names, "seg": row["protocol"]})


def _rating(row: dataset.Row, rated: Mapping[tuple[str, ...], dataset.Row]) -> str:
    """Rating of the same labels, if a person saved one next to the table."""
    rating = rated.get(_key(row), {})
    is_current = rating.get("input_hash") in {files.MISSING, None, row.get("input_hash")}
    return rating.get("rating", files.MISSING) if is_current else files.MISSING
