"""All analyzed maps as one Parquet file, the hand-over to R or Python."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from hipsta_bids.bids import files
from hipsta_bids.group_data import PARTICIPANT, SESSION, Cohort, SideMaps

#: What the surface of the sheets is called.
SHEET = "sheet"

#: Values per row group; bounds the memory.
_BLOCK = 500_000

_WORD = pa.dictionary(pa.int32(), pa.string())
_SUFFIXES = {"": "as measured", "_registered": "after registration"}


def write_maps(
    path: Path,
    cohort: Cohort,
    registered: Mapping[str, SideMaps],
    others: Mapping[str, Cohort],
) -> None:
    """Write all maps: one row per visit, hemisphere and point.

    Parameters
    ----------
    path : Path
        The file.
    cohort : Cohort
        Original maps of the sheets.
    registered : mapping of str to SideMaps
        The same after registration, by hemisphere; perhaps none.
    others : mapping of str to Cohort
        Maps with points of their own, by name.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    schema = _schema(cohort, registered, others)
    try:
        with parquet.ParquetWriter(path, schema, compression="zstd") as writer:
            for columns in _blocks(cohort, registered, others):
                count = len(columns["vertex"])
                arrays = [
                    pa.array(columns[field.name], field.type)
                    if field.name in columns
                    else pa.nulls(count, field.type)
                    for field in schema
                ]
                writer.write_table(pa.table(arrays, schema=schema))
    except OSError as error:
        raise files.output_error(path, error) from error


def _schema(
    cohort: Cohort, registered: Mapping[str, SideMaps], others: Mapping[str, Cohort]
) -> pa.Schema:
    fields = [pa.field(name, _WORD) for name in (PARTICIPANT, SESSION, "hemi")]
    about = {"description": f"{SHEET}, or the name of maps with points of their own"}
    fields.append(pa.field("surface", _WORD, metadata=about))
    about = {"description": "point of the surface, the first is 0; on the sheet y is the faster"}
    fields.append(pa.field("vertex", pa.int32(), metadata=about))
    about = {"description": "node of the sheet, the first is 1"}
    fields += [pa.field(f"node_{axis}", pa.int16(), metadata=about) for axis in "xy"]
    about = {"description": "coordinate on the sheet, -1 to 1", "unit": "1"}
    fields += [pa.field(axis, pa.float32(), metadata=about) for axis in "xy"]
    measures = list(next(iter(registered.values())).maps) if registered else []
    for suffix, text in _SUFFIXES.items() if registered else ():
        fields.append(pa.field(f"subfield{suffix}", _WORD, metadata={"description": text}))
        fields += [_number(f"{name}{suffix}", cohort, name, text) for name in measures]
    fields += [_number(name, other, name, "as given") for name, other in others.items()]
    return pa.schema(
        fields,
        metadata={
            "description": "one row per visit, hemisphere and point; x from medial to lateral, y"
            " from posterior to anterior; a column is empty where the surface lacks the measure"
        },
    )


def _number(column: str, cohort: Cohort, measure: str, text: str) -> pa.Field:
    about = {"unit": cohort.units.get(measure, "1"), "description": f"{measure}, {text}"}
    return pa.field(column, pa.float32(), metadata=about)


def _blocks(
    cohort: Cohort, registered: Mapping[str, SideMaps], others: Mapping[str, Cohort]
) -> Iterator[dict[str, pa.Array]]:
    for hemi, side in registered.items():
        original = cohort.sides[hemi]
        for part in _parts(side):
            columns = _places(cohort, hemi, SHEET, side, part) | _nodes(cohort, side, part)
            for suffix, source in zip(_SUFFIXES, (original, side), strict=True):
                columns[f"subfield{suffix}"] = _subfields(source, part)
                columns |= {f"{k}{suffix}": v for k, v in _values(source, part).items()}
            yield columns
    for name, other in others.items():
        for hemi, side in other.sides.items():
            for part in _parts(side):
                columns = _places(other, hemi, name, side, part) | _values(side, part)
                yield columns | (_nodes(other, side, part) if side.mesh is None else {})


def _parts(side: SideMaps) -> Iterator[slice]:
    step = max(_BLOCK // int(np.prod(side.shape)), 1)
    for start in range(0, len(side.rows), step):
        yield slice(start, start + step)


def _places(
    cohort: Cohort, hemi: str, surface: str, side: SideMaps, part: slice
) -> dict[str, pa.Array]:
    """Whose, and which point."""
    rows = side.rows[part]
    points = int(np.prod(side.shape))
    visits = cohort.table.iloc[rows]
    places = pa.array(np.repeat(np.arange(len(rows), dtype=np.int32), points))

    def words(values: Sequence[str | None]) -> pa.Array:
        return pa.array(list(values), pa.string()).dictionary_encode().take(places)

    return {
        PARTICIPANT: words(visits[PARTICIPANT].tolist()),
        SESSION: words([s if isinstance(s, str) else None for s in visits[SESSION]]),
        "hemi": words([hemi] * len(rows)),
        "surface": words([surface] * len(rows)),
        "vertex": pa.array(np.tile(np.arange(points, dtype=np.int32), len(rows))),
    }


def _nodes(cohort: Cohort, side: SideMaps, part: slice) -> dict[str, pa.Array]:
    """Where the points of the sheet lie."""
    nx, ny = side.shape
    x, y = np.divmod(np.tile(np.arange(nx * ny), len(side.rows[part])), ny)
    return {
        "node_x": pa.array((x + 1).astype(np.int16)),
        "node_y": pa.array((y + 1).astype(np.int16)),
        "x": pa.array(cohort.x[x].astype(np.float32)),
        "y": pa.array(cohort.y[y].astype(np.float32)),
    }


def _values(side: SideMaps, part: slice) -> dict[str, pa.Array]:
    return {
        name: pa.array(maps[part].ravel(), pa.float32(), from_pandas=True)
        for name, maps in side.maps.items()
    }


def _subfields(side: SideMaps, part: slice) -> pa.Array:
    codes = side.subfield[part].ravel().astype(np.int32)
    indices = pa.array(codes, pa.int32(), mask=codes < 0)
    return pa.DictionaryArray.from_arrays(indices, pa.array(side.names, pa.string()))
