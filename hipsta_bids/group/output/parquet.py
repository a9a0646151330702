"""Maps and scores of all participants as Parquet files, by pyarrow, which is an optional extra."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
from pyarrow import parquet as pq

from hipsta_bids.group.cohort.data import SHEET, Cohort
from hipsta_bids.io import files
from hipsta_bids.stats.arrays import Float, Int, SideMaps, blocks, some_sheets
from hipsta_bids.types import PARTICIPANT, SESSION

#: Name of the surface of the sheets in files.
_SHEET_NAME = "sheet"
#: Values per row group of maps; bounds the memory.
_BLOCK = 500_000

WORD = pa.dictionary(pa.int32(), pa.string())
_SUFFIXES = {
    "": "as measured",
    "_registered": "after registration",
    "_harmonized": "after registration and harmonization",
}

Columns = dict[str, pa.Array]


def write_maps(
    path: Path, cohorts: Mapping[str, Cohort], states: Sequence[Mapping[str, SideMaps]]
) -> None:
    """Write all analyzed maps as one Parquet file: a row per visit, hemisphere and point.

    The states of the sheets are before and after each step; none without sheets.
    """
    fields = [pa.field(name, WORD) for name in (PARTICIPANT, SESSION, "hemi")]
    about = {"description": f"{_SHEET_NAME}, or the name of maps with points of their own"}
    fields.append(pa.field("surface", WORD, metadata=about))
    about = {"description": "point of the surface, the first is 0; on the sheet y is the faster"}
    fields.append(pa.field("vertex", pa.int32(), metadata=about))
    about = {"description": "node of the sheet, the first is 1"}
    fields += [pa.field(f"node_{axis}", pa.int16(), metadata=about) for axis in "xy"]
    about = {"description": "coordinate on the sheet, -1 to 1", "unit": "1"}
    fields += [pa.field(axis, pa.float32(), metadata=about) for axis in "xy"]
    measures = list(next(iter(states[0].values())).maps) if states else []
    for suffix, text in list(_SUFFIXES.items())[: len(states)]:
        if suffix != "_harmonized":
            fields.append(pa.field(f"subfield{suffix}", WORD, metadata={"description": text}))
        fields += [_number(f"{name}{suffix}", cohorts[SHEET], name, text) for name in measures]
    fields += [_number(name, c, name, "as given") for name, c in cohorts.items() if name != SHEET]
    about = {
        "description": "one row per visit, hemisphere and point; x medial to lateral, "
        "y posterior to anterior; empty without the measure"
    }
    rows = _map_blocks(cohorts, states)
    write_blocks(path, pa.schema(fields, metadata=about), rows)


def _number(column: str, cohort: Cohort, measure: str, text: str) -> pa.Field:
    about = {"unit": cohort.units.get(measure, "1"), "description": f"{measure}, {text}"}
    return pa.field(column, pa.float32(), metadata=about)


def write_blocks(path: Path, schema: pa.Schema, rows: Iterable[Columns]) -> None:
    """Write blocks of columns; a column that a block lacks is empty.

    Measured values hardly repeat: a dictionary of them takes longer than it saves.
    """
    repeated = [c.name for c in schema if c.name in "xy" or not pa.types.is_float32(c.type)]
    try:
        with (
            path.open("wb") as file,  # pyarrow opens no path whose bytes are not of the locale
            pq.ParquetWriter(file, schema, compression="zstd", use_dictionary=repeated) as writer,
        ):
            for columns in rows:
                count = len(columns["hemi"])
                arrays = [
                    columns[field.name] if field.name in columns else pa.nulls(count, field.type)
                    for field in schema
                ]
                writer.write_table(pa.table(arrays, schema=schema))
    except OSError as error:
        raise files.output_error(path, error) from error


def _map_blocks(
    cohorts: Mapping[str, Cohort], states: Sequence[Mapping[str, SideMaps]]
) -> Iterator[Columns]:
    for surface, cohort in cohorts.items():
        if surface == SHEET and not states:
            continue
        for hemi, side in cohort.sides.items():
            points = int(np.prod(side.shape))
            for part in blocks(len(side.rows), max(_BLOCK // points, 1)):
                rows = side.rows[part]
                name = surface or _SHEET_NAME
                columns = visit_columns(cohort.table, rows, points, hemi=hemi, surface=name)
                vertices = np.tile(np.arange(points, dtype=np.int32), len(rows))
                columns["vertex"] = pa.array(vertices)
                if side.mesh is None:
                    columns |= node_columns(cohort, side.shape, len(rows))
                if surface == SHEET:
                    for suffix, state in zip(_SUFFIXES, states, strict=False):
                        columns[f"subfield{suffix}"] = _subfields(state[hemi], part)
                        sheet_maps = some_sheets(state[hemi].maps, part)
                        columns |= value_columns(sheet_maps, slice(None), suffix)
                else:
                    columns |= value_columns(side.maps, part)
                yield columns


def visit_columns(table: pd.DataFrame, rows: Int, points: int, **words: str) -> Columns:
    """Participants and sessions of all points of some rows, and words that all have."""
    visits = table.iloc[rows]
    texts = {
        PARTICIPANT: visits[PARTICIPANT].tolist(),
        SESSION: [s if isinstance(s, str) else None for s in visits[SESSION]],
        **{name: [word] * len(rows) for name, word in words.items()},
    }
    index = pa.array(np.repeat(np.arange(len(rows), dtype=np.int32), points))
    return {
        name: pa.array(values, pa.string()).dictionary_encode().take(index)
        for name, values in texts.items()
    }


def node_columns(cohort: Cohort, shape: tuple[int, int], n_rows: int) -> Columns:
    """Nodes of the sheet and their coordinates, for some rows."""
    x, y = np.divmod(np.tile(np.arange(shape[0] * shape[1]), n_rows), shape[1])
    return {
        "node_x": pa.array((x + 1).astype(np.int16)),
        "node_y": pa.array((y + 1).astype(np.int16)),
        "x": pa.array(cohort.x[x].astype(np.float32)),
        "y": pa.array(cohort.y[y].astype(np.float32)),
    }


def value_columns(maps: Mapping[str, Float], part: slice, suffix: str = "") -> Columns:
    """Values of maps at all points of some rows."""
    return {
        f"{name}{suffix}": pa.array(values[part].ravel(), pa.float32(), from_pandas=True)
        for name, values in maps.items()
    }


def _subfields(side: SideMaps, part: slice) -> pa.Array:
    codes = side.subfield[part].ravel().astype(np.int32)
    indices = pa.array(codes, pa.int32(), mask=codes < 0)
    return pa.DictionaryArray.from_arrays(indices, pa.array(side.names, pa.string()))
