"""Writes maps of single participants' scores."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
from pyarrow import parquet

from hipsta_bids.bids import files
from hipsta_bids.group_data import PARTICIPANT, SESSION, Float, Int

#: Participants per row group; bounds the memory.
_BLOCK = 500


def write_score_maps(
    path: Path,
    table: pd.DataFrame,
    sides: Mapping[str, tuple[Int, Mapping[str, Float]]],
    x: Float,
    y: Float,
) -> None:
    """Write scores at all points as one Parquet file: a row per participant, hemisphere and node.

    Parameters
    ----------
    path : Path
        The file.
    table : DataFrame
        Participants.
    sides : mapping
        By hemisphere: rows of the table, and (sheets, points) scores by measure.
    x, y : ndarray
        Sheet coordinates of the nodes.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    measures = list(next(iter(sides.values()))[1])
    word = pa.dictionary(pa.int32(), pa.string())
    schema = pa.schema(
        [
            *(pa.field(name, word) for name in (PARTICIPANT, SESSION, "hemi")),
            *(pa.field(name, pa.int16()) for name in ("node_x", "node_y")),
            *(pa.field(f"{name}_w", pa.float32(), metadata={"unit": "1"}) for name in measures),
        ],
        metadata={
            "description": "w-scores, one row per participant, hemisphere and node of the"
            " registered sheet; nodes along x from medial to lateral, y from posterior to"
            " anterior"
        },
    )
    nodes_x, nodes_y = np.divmod(np.arange(len(x) * len(y)), len(y))
    try:
        with parquet.ParquetWriter(path, schema, compression="zstd") as writer:
            for hemi, (rows, scores) in sides.items():
                for start in range(0, len(rows), _BLOCK):
                    part = slice(start, start + _BLOCK)
                    people = table.iloc[rows[part]]
                    names = {
                        PARTICIPANT: people[PARTICIPANT].tolist(),
                        SESSION: [s if isinstance(s, str) else None for s in people[SESSION]],
                        "hemi": [hemi] * len(people),
                    }
                    place = pa.array(np.repeat(np.arange(len(people)), len(nodes_x)))
                    arrays = [
                        pa.array(values, pa.string()).dictionary_encode().take(place)
                        for values in names.values()
                    ]
                    arrays += [
                        pa.array(np.tile(nodes + 1, len(people)), pa.int16())
                        for nodes in (nodes_x, nodes_y)
                    ]
                    arrays += [
                        pa.array(scores[name][part].ravel(), pa.float32(), from_pandas=True)
                        for name in measures
                    ]
                    writer.write_table(pa.table(arrays, schema=schema))
    except OSError as error:
        raise files.output_error(path, error) from error
