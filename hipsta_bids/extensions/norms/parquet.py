"""Scores of participants as a Parquet file, by pyarrow, which is an optional extra."""

from collections.abc import Mapping
from pathlib import Path

import pandas as pd
import pyarrow as pa

from hipsta_bids.extensions.norms.wscores import ScoredMaps
from hipsta_bids.group.cohort.data import Cohort
from hipsta_bids.group.output import parquet
from hipsta_bids.stats.arrays import blocks
from hipsta_bids.types import PARTICIPANT, SESSION

#: Participants per row group; bounds the memory.
_ROWS = 500


def write_scores(
    folder: Path,
    cohort: Cohort,
    table: pd.DataFrame,
    sides: Mapping[str, ScoredMaps],
    letter: str,
) -> None:
    """Write each participant's scores at the points of the sheet."""
    shape = len(cohort.x), len(cohort.y)
    measures = list(next(iter(sides.values())).scores)
    about = {"unit": "1"}
    fields = [pa.field(name, parquet.WORD) for name in (PARTICIPANT, SESSION, "hemi")]
    fields += [pa.field(name, pa.int16()) for name in ("node_x", "node_y")]
    fields += [pa.field(f"{name}_{letter}", pa.float32(), metadata=about) for name in measures]
    about = {
        "description": f"{letter}-scores, one row per participant, hemisphere and registered "
        "node; nodes from medial to lateral, posterior to anterior"
    }
    rows = (
        {
            **parquet.visit_columns(table, side.rows[part], shape[0] * shape[1], hemi=hemi),
            **parquet.node_columns(cohort, shape, len(side.rows[part])),
            **parquet.value_columns(
                {n: one.w for n, one in side.scores.items()}, part, f"_{letter}"
            ),
        }
        for hemi, side in sides.items()
        for part in blocks(len(side.rows), _ROWS)
    )
    parquet.write_blocks(
        folder / f"{letter}scores.parquet", pa.schema(fields, metadata=about), rows
    )
