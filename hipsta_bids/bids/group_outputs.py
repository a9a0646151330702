"""Writes the results of one model: all of them or none."""

import contextlib
import os
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from hipsta_bids.bids import files, gifti
from hipsta_bids.bids.names import DATASET_FILES
from hipsta_bids.group_data import Float, ResultTable

#: Folder of all models, in the output dataset.
GROUP_FOLDER = DATASET_FILES["group"]


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


def write_plain_table(path: Path, table: pd.DataFrame) -> None:
    """Write a table whose columns are the user's or the model's, without a sidecar."""
    columns = [str(name) for name in table.columns]
    files.write_tsv(path, columns, zip(*(_cells(table[name]) for name in columns), strict=True))


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
