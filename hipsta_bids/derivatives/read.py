"""The one reader of results: which hemispheres a dataset has, their records, tables and units."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.derivatives.hemisphere import NODES, STATE, ResultPlace
from hipsta_bids.derivatives.names import name_of_record, output_pattern
from hipsta_bids.errors import InputError
from hipsta_bids.io import files

_REDO = "run the participant level again with --force"


def list_results(
    root: Path, subject: str | None = None, session: str | None = None
) -> list[ResultPlace]:
    """List the hemispheres of a dataset, or of one visit, that have a quality record."""
    folders = ["sub-*/anat", "sub-*/ses-*/anat"]
    if subject is not None:
        folders = [f"sub-{subject}/{f'ses-{session}/' if session else ''}anat"]
    found = [
        ResultPlace(root=root, name=name)
        for folder in folders
        for path in root.glob(f"{folder}/{output_pattern('qc')}")
        if (name := name_of_record(path.name)) is not None
    ]
    return sorted(found, key=_order)


def _order(place: ResultPlace) -> tuple[str, ...]:
    name = place.name
    return name.subject, name.session or "", name.seg, name.region, name.hemi


def read_record(place: ResultPlace) -> dict[str, Any]:
    """Read the quality record."""
    return files.read_json(place.path("qc"))


def read_summary(place: ResultPlace) -> dict[str, float]:
    """Read the row of summary measures, NaN where missing."""
    path = place.path("summary")
    rows = files.read_tsv(path)
    try:
        (row,) = rows
        return {name: np.nan if v == files.MISSING else float(v) for name, v in row.items()}
    except ValueError as error:
        raise InputError(f"{path}: not one row of numbers; {_REDO}", reason="bad-table") from error


def read_sheet(
    path: Path,
    numbers: Sequence[str] | None = None,
    words: Sequence[str] = (),
    shape: tuple[int, int] | None = None,
) -> dict[str, NDArray[Any]]:
    """Read columns of a table with one row per sheet point, as (Nx, Ny) arrays.

    Missing numbers are NaN, missing words empty. Without ``numbers`` all columns that hold numbers
    are read; without ``shape`` the last row says how many nodes there are.
    """
    import pyarrow as pa  # noqa: PLC0415  (slow to load)
    from pyarrow import csv  # noqa: PLC0415  (likewise)

    try:
        if numbers is None:
            with path.open(encoding="utf-8") as file:
                columns = file.readline().rstrip("\n").split("\t")
            numbers = [name for name in columns if name not in {*NODES, *STATE}]
        table = csv.read_csv(
            path,
            read_options=csv.ReadOptions(use_threads=False),
            parse_options=csv.ParseOptions(delimiter="\t"),
            convert_options=csv.ConvertOptions(
                include_columns=["x", "y", *numbers, *words],
                column_types={
                    **dict.fromkeys(numbers, pa.float64()),
                    **dict.fromkeys(words, pa.string()),
                },
                null_values=[files.MISSING],
                strings_can_be_null=True,
            ),
        )
        x, y = (table.column(name).to_numpy() for name in NODES)
        nx, ny = shape or (int(x[-1]), int(y[-1]))
    except (OSError, ValueError, KeyError, IndexError) as error:  # pyarrow's are among these
        first = str(error).partition("\n")[0]
        raise InputError(
            f"{path}: not readable as a sheet ({first}); {_REDO}", reason="unreadable-table"
        ) from error
    expected = np.divmod(np.arange(nx * ny), ny)
    if len(x) != nx * ny or (x != expected[0] + 1).any() or (y != expected[1] + 1).any():
        said = ", as the settings say" if shape else ""
        raise InputError(
            f"{path}: not a sheet of {nx} x {ny} nodes{said}; {_REDO}", reason="mixed-grids"
        )
    found = {name: table.column(name) for name in numbers}
    found |= {name: table.column(name).fill_null("") for name in words}
    return {name: column.to_numpy().reshape(nx, ny) for name, column in found.items()}


def read_units(place: ResultPlace) -> dict[str, str]:
    """Read the units of maps and summary measures."""
    return {
        name: str(entry["Units"])
        for key in ("sheet_sidecar", "summary_sidecar")
        for name, entry in files.read_json(place.path(key)).items()
        if isinstance(entry, Mapping) and "Units" in entry
    }
