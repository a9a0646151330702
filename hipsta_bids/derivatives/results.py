"""The results of hemispheres in an output dataset: where they are, which there are, what they hold.

``hemisphere`` writes them. A hemisphere has results if it has a quality record.
"""

import io
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.derivatives.dataset import TABLES
from hipsta_bids.derivatives.names import (
    EXTRA_OUTPUTS,
    FILE_LISTS,
    OUTPUTS,
    HemisphereName,
    name_of_record,
    output_name,
    output_path,
    output_pattern,
)
from hipsta_bids.errors import InputError
from hipsta_bids.geometry.catalog import MAPS
from hipsta_bids.io import files
from hipsta_bids.opening import TABLE, read_bounded

#: Columns of the tables that are no measures: definition and unit.
NODES, POSITION, STATE = (TABLES[name] for name in ("nodes", "position", "state"))
LAYERS = NODES | TABLES["layers"]

#: Columns of the sheet table, in order.
SHEET_COLUMNS = (*NODES, *POSITION, *(row.name for row in MAPS), *STATE)

_REDO = "run the participant level again with --force"


@dataclass(frozen=True, kw_only=True, slots=True)
class ResultPlace:
    """Where the results of one hemisphere are."""

    root: Path
    """The output dataset."""
    name: HemisphereName

    def path(self, key: str, desc: str | None = None) -> Path:
        """Path of one output, by its key in the output table and, for maps, the user's name."""
        return self.root / output_path(self.name, key, desc)

    def paths(self, *, optional: bool) -> list[Path]:
        """Paths of all outputs, with the optional ones or without."""
        return [self.path(row.key) for row in OUTPUTS if optional or not row.optional]

    def extra_paths(self) -> list[Path]:
        """Existing files of an option or another command."""
        folder = self.root / self.name.folder
        names = [output_name(self.name, row.key) for row in EXTRA_OUTPUTS]
        return [path for name in names for path in sorted(folder.glob(name))]


def list_results(
    root: Path, subject: str | None = None, session: str | None = None
) -> list[ResultPlace]:
    """List the hemispheres of a dataset, or of one visit, that have a quality record."""
    folders = ["sub-*/anat", "sub-*/ses-*/anat"]
    if subject is not None:
        folders = [f"sub-{subject}/{f'ses-{session}/' if session else ''}anat"]
    results = [
        ResultPlace(root=root, name=name)
        for folder in folders
        for path in root.glob(f"{folder}/{output_pattern('qc')}")
        if (name := name_of_record(path.name)) is not None
    ]
    return sorted(results, key=_order)


def _order(result: ResultPlace) -> tuple[str, ...]:
    name = result.name
    return name.subject, name.session or "", name.seg, name.region, name.hemi


def read_record(result: ResultPlace) -> dict[str, Any]:
    """Read the quality record."""
    record = files.read_json(result.path("qc"))
    lists = {name: record.get(name) or [] for name in FILE_LISTS}
    for name, entries in {**lists, "metrics": [record.get("metrics") or {}]}.items():
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            raise InputError(f"{result.path('qc')}: bad {name}; {_REDO}", reason="bad-json")
    return record


def read_summary(result: ResultPlace) -> dict[str, float]:
    """Read the row of summary measures, NaN where missing."""
    cells = read_summary_cells(result)
    try:
        return {name: np.nan if v == files.MISSING else float(v) for name, v in cells.items()}
    except ValueError as error:
        raise _bad_summary(result) from error


def read_summary_cells(result: ResultPlace) -> dict[str, str]:
    """Read the row of summary measures as text."""
    rows = files.read_tsv(result.path("summary"))
    if len(rows) != 1:
        raise _bad_summary(result)
    return rows[0]


def _bad_summary(result: ResultPlace) -> InputError:
    path = result.path("summary")
    return InputError(f"{path}: not one row of numbers; {_REDO}", reason="bad-table")


def read_sheet(
    path: Path,
    numbers: Sequence[str] | None = None,
    words: Sequence[str] = (),
    shape: tuple[int, int] | None = None,
) -> dict[str, NDArray[Any]]:
    """Read columns of a table with one row per sheet point, as (Nx, Ny) arrays.

    Missing numbers are NaN, missing words empty. Without ``numbers`` all columns that hold numbers
    are read; without ``shape`` the last row has the number of nodes.
    """
    try:
        content = read_bounded(path, TABLE)
        if numbers is None:
            columns = content.partition(b"\n")[0].decode().rstrip("\r").split("\t")
            numbers = [name for name in columns if name not in {*NODES, *STATE}]
        x, y, *values = _columns(content, numbers, words)
        nx, ny = shape or (int(x[-1]), int(y[-1]))
    except (OSError, ValueError, KeyError, IndexError) as error:  # pyarrow's are among these
        first = str(error).partition("\n")[0]
        raise InputError(
            f"{path}: not readable as a sheet ({first}); {_REDO}", reason="unreadable-table"
        ) from error
    expected = np.divmod(np.arange(len(x)), max(ny, 1))
    if len(x) != nx * ny or (x != expected[0] + 1).any() or (y != expected[1] + 1).any():
        suffix = " of the settings" if shape else ""
        raise InputError(f"{path}: not a sheet of {nx} x {ny} nodes{suffix}; {_REDO}")
    names = (*numbers, *words)
    return {name: column.reshape(nx, ny) for name, column in zip(names, values, strict=True)}


def read_alike(
    paths: Sequence[Path], numbers: Sequence[str], words: Sequence[str], shape: tuple[int, int]
) -> dict[str, NDArray[Any]]:
    """Read columns of tables of one shape as (tables, Nx, Ny) arrays, in half of the time."""
    with suppress(OSError, ValueError, KeyError):
        contents = [read_bounded(path, TABLE) for path in paths]
        header = contents[0][: contents[0].index(b"\n") + 1]
        if all(content.startswith(header) for content in contents):
            rows = b"".join(content[len(header) :] for content in contents)
            x, y, *values = _columns(header + rows, numbers, words)
            expected = np.divmod(np.arange(shape[0] * shape[1]), shape[1])
            nodes = np.stack([x, y], axis=-1).reshape(len(paths), -1, 2) - 1
            if (nodes == np.stack(expected, axis=-1)).all():
                names = (*numbers, *words)
                return {n: v.reshape(-1, *shape) for n, v in zip(names, values, strict=True)}
    tables = [read_sheet(path, numbers, words, shape) for path in paths]
    return {name: np.stack([table[name] for table in tables]) for name in tables[0]}


def _columns(content: bytes, numbers: Sequence[str], words: Sequence[str]) -> list[NDArray[Any]]:
    """Read node numbers, numbers and words of a table."""
    read = _columns_by_arrow if find_spec("pyarrow") else _columns_by_pandas
    return read(content, numbers, words)


def _columns_by_arrow(
    content: bytes, numbers: Sequence[str], words: Sequence[str]
) -> list[NDArray[Any]]:
    """Read node numbers, numbers and words of a table with pyarrow, an optional extra."""
    import pyarrow as pa  # noqa: PLC0415  (slow to load)
    from pyarrow import csv  # noqa: PLC0415  (likewise)

    types = dict.fromkeys(NODES, pa.int64()) | dict.fromkeys(numbers, pa.float64())
    types |= dict.fromkeys(words, pa.dictionary(pa.int32(), pa.string()))
    table = csv.read_csv(
        pa.BufferReader(content),
        read_options=csv.ReadOptions(use_threads=False),
        parse_options=csv.ParseOptions(delimiter="\t"),
        convert_options=csv.ConvertOptions(
            include_columns=[*NODES, *numbers, *words],
            column_types=types,
            null_values=[files.MISSING],
            strings_can_be_null=True,
        ),
    )
    columns = []
    for name in (*NODES, *numbers, *words):  # pyarrow's to_numpy and fill_null would load pandas
        column = table.column(name).combine_chunks()
        is_word = name in words
        validity, buffer = (column.indices if is_word else column).buffers()
        kind = "i4" if is_word else "i8" if name in NODES else "f8"
        part = slice(column.offset, column.offset + len(column))
        values = np.frombuffer(buffer, kind)[part]
        if column.null_count:
            bits = np.unpackbits(np.frombuffer(validity, np.uint8), bitorder="little")[part]
            values = np.where(bits == 1, values, -1 if is_word else np.nan)
        if is_word:
            values = np.array([*column.dictionary.to_pylist(), ""], dtype=object)[values]
        columns.append(values)
    return columns


def _columns_by_pandas(
    content: bytes, numbers: Sequence[str], words: Sequence[str]
) -> list[NDArray[Any]]:
    """Read the same with pandas, which takes longer."""
    import pandas as pd  # noqa: PLC0415  (slow to load)

    header, *lines = content.splitlines()
    if any(line.count(b"\t") != header.count(b"\t") for line in lines):
        raise ValueError("rows differ in their number of columns")
    table = pd.read_csv(
        io.BytesIO(content),
        sep="\t",
        usecols=[*NODES, *numbers, *words],
        dtype=dict.fromkeys(numbers, float) | dict.fromkeys(words, object),
        na_values=[files.MISSING],
        keep_default_na=False,
    )
    columns = [table[name] for name in (*NODES, *numbers)]
    return [column.to_numpy() for column in (*columns, *(table[name].fillna("") for name in words))]


def read_units(result: ResultPlace) -> dict[str, str]:
    """Read the units of maps and summary measures."""
    return {
        name: str(entry["Units"])
        for key in ("sheet_sidecar", "summary_sidecar")
        for name, entry in files.read_json(result.path(key)).items()
        if isinstance(entry, Mapping) and "Units" in entry
    }
