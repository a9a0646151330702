"""Writes the results of one model: all of them or none."""

import contextlib
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
from pyarrow import parquet

from hipsta_bids.bids import files, gifti
from hipsta_bids.bids.names import DATASET_FILES
from hipsta_bids.group_data import PARTICIPANT, SESSION, Cohort, Float, ResultTable, SideMaps

#: Folder of all models, in the output dataset.
GROUP_FOLDER = DATASET_FILES["group"]

#: Sheets per row group of the Parquet file; bounds the memory.
_BLOCK = 500


@contextlib.contextmanager
def model_folder(root: Path, name: str) -> Iterator[Path]:
    """Give a folder to write into, which takes its name when all went well.

    Parameters
    ----------
    root : Path
        The output dataset.
    name : str
        Of the model; earlier results of this name are replaced.

    Yields
    ------
    Path
        Where to write meanwhile.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    parent = root / GROUP_FOLDER
    aside = parent / f".{name}.{os.getpid()}.tmp"
    files.make_folder(parent)
    try:
        aside.mkdir()
        try:
            yield aside
            _take_place(aside, parent / name)
        except BaseException:
            shutil.rmtree(aside, ignore_errors=True)
            raise
        # What runs that were killed have left.
        for left in parent.glob(f".{name}.*.tmp"):
            shutil.rmtree(left, ignore_errors=True)
    except OSError as error:
        raise files.output_error(parent / name, error) from error


def _take_place(aside: Path, final: Path) -> None:
    """Rename over an earlier folder, which cannot be done in one step."""
    old = final.with_name(f".{final.name}.old.{os.getpid()}.tmp")
    if final.exists():
        final.rename(old)
    aside.rename(final)
    shutil.rmtree(old, ignore_errors=True)


def write_result_table(folder: Path, table: ResultTable, meanings: Mapping[str, str]) -> None:
    """Write a table and its sidecar.

    Parameters
    ----------
    folder : Path
        Where.
    table : ResultTable
        Booleans become ``true`` and ``false``, missing values ``n/a``.
    meanings : mapping of str to str
        Meaning of each column; columns ``node_<i>`` are the registered coordinates of nodes.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    columns = [str(name) for name in table.rows.columns]
    cells = [_cells(table.rows[name]) for name in table.rows.columns]
    files.write_tsv(folder / f"{table.name}.tsv", columns, zip(*cells, strict=True))
    described = {
        name: {
            "Description": meanings.get(name)
            or f"registered coordinate of node {name.removeprefix('node_')}, 0..1"
        }
        for name in columns
    }
    files.write_json(folder / f"{table.name}.json", described)


def _cells(values: pd.Series) -> list[str]:
    def spell(value: object) -> str:
        if isinstance(value, (bool, np.bool_)):
            return "true" if value else "false"
        if value is None or value is pd.NA or value != value:  # noqa: PLR0124 -- NaN is not itself
            return files.MISSING
        return format(value, ".10g") if isinstance(value, float) else str(value)

    return [spell(value) for value in values.tolist()]


def write_covariates(path: Path, table: pd.DataFrame) -> None:
    """Write the table that models were fitted to."""
    columns = [str(name) for name in table.columns]
    files.write_tsv(path, columns, zip(*(_cells(table[name]) for name in columns), strict=True))


def write_maps(path: Path, cohort: Cohort, registered: Mapping[str, SideMaps]) -> None:
    """Write all maps as one Parquet file, for work in R or Python.

    One row per visit, hemisphere and node: original and registered maps, with units in the
    columns' metadata.

    Parameters
    ----------
    path : Path
        The file.
    cohort : Cohort
        Original maps.
    registered : mapping of str to SideMaps
        The same after registration.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    measures = list(next(iter(cohort.sides.values())).maps)
    schema = _schema(cohort, measures)
    try:
        with parquet.ParquetWriter(path, schema, compression="zstd") as writer:
            for hemi, side in cohort.sides.items():
                for start in range(0, len(side.rows), _BLOCK):
                    part = slice(start, start + _BLOCK)
                    columns = _block(cohort, hemi, side, registered[hemi], part)
                    arrays = [
                        pa.array(columns[name], schema.field(name).type) for name in schema.names
                    ]
                    writer.write_table(pa.table(arrays, schema=schema))
    except OSError as error:
        raise files.output_error(path, error) from error


def _schema(cohort: Cohort, measures: Sequence[str]) -> pa.Schema:
    word = pa.dictionary(pa.int32(), pa.string())
    fields = [pa.field(name, word) for name in (PARTICIPANT, SESSION, "hemi")]
    fields += [pa.field("node_x", pa.int16()), pa.field("node_y", pa.int16())]
    fields += [pa.field("x", pa.float32()), pa.field("y", pa.float32())]
    for suffix, text in (("", "as measured"), ("_registered", "after registration")):
        fields.append(pa.field(f"subfield{suffix}", word, metadata={"description": text}))
        for name in measures:
            about = {"unit": cohort.units.get(name, "1"), "description": f"{name}, {text}"}
            fields.append(pa.field(f"{name}{suffix}", pa.float32(), metadata=about))
    return pa.schema(
        fields,
        metadata={
            "description": "one row per visit, hemisphere and node of the sheet; x from medial to"
            " lateral, y from posterior to anterior"
        },
    )


def _block(
    cohort: Cohort, hemi: str, side: SideMaps, registered: SideMaps, part: slice
) -> dict[str, object]:
    rows = side.rows[part]
    nx, ny = side.shape
    points = nx * ny
    x, y = np.divmod(np.tile(np.arange(points), len(rows)), ny)
    visits = cohort.table.iloc[rows]
    places = np.repeat(np.arange(len(rows), dtype=np.int32), points)

    def words(values: Sequence[str | None]) -> pa.DictionaryArray:
        return pa.array(list(values), pa.string()).dictionary_encode().take(pa.array(places))

    columns: dict[str, object] = {
        PARTICIPANT: words(visits[PARTICIPANT].tolist()),
        SESSION: words([s if isinstance(s, str) else None for s in visits[SESSION]]),
        "hemi": words([hemi] * len(rows)),
        "node_x": x + 1,
        "node_y": y + 1,
        "x": cohort.x[x],
        "y": cohort.y[y],
    }
    for suffix, source in (("", side), ("_registered", registered)):
        columns[f"subfield{suffix}"] = _subfields(source, part)
        for name, maps in source.maps.items():
            values: Float = maps[part].ravel()
            columns[f"{name}{suffix}"] = pa.array(values, pa.float32(), from_pandas=True)
    return columns


def _subfields(side: SideMaps, part: slice) -> pa.DictionaryArray:
    codes = side.subfield[part].ravel().astype(np.int32)
    indices = pa.array(codes, pa.int32(), mask=codes < 0)
    return pa.DictionaryArray.from_arrays(indices, pa.array(side.names, pa.string()))


def write_sheet_surface(path: Path, x: Float, y: Float, hemi: str) -> None:
    """Write the unfolded sheet, on which maps of statistics can be drawn.

    Parameters
    ----------
    path : Path
        The ``.surf.gii`` file.
    x, y : ndarray
        Sheet coordinates of the nodes, medial to lateral and posterior to anterior.
    hemi : str
        ``L`` or ``R``.
    """
    flat = np.zeros((len(x) * len(y), 3))
    flat[:, 0], flat[:, 1] = np.repeat(x, len(y)), np.tile(y, len(x))
    triangles = gifti.sheet_triangles(len(x), len(y))
    files.write_bytes(
        path,
        gifti.surface_bytes(flat, triangles, hemi=hemi, secondary="MidThickness", unfolded=True),
    )
