"""Regions drawn on the sheet (``--roi``)."""

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hipsta_bids.derivatives.results import SHEET_COLUMNS
from hipsta_bids.errors import InputError
from hipsta_bids.io import files
from hipsta_bids.types import Bool

#: Columns of a file of regions: node numbers as in the sheet table, and the region's name.
COLUMNS = ("x", "y", "region")


@dataclass(frozen=True, eq=False, kw_only=True)
class Regions:
    """Sets of sheet points, which may overlap."""

    names: tuple[str, ...]
    """Name of each region."""
    member: Bool
    """(R, Nx, Ny) whether a point belongs to a region."""


def _check_columns(path: Path, columns: Collection[str]) -> None:
    lacking = [name for name in COLUMNS if name not in columns]
    unknown = [name for name in columns if name not in {*COLUMNS, *SHEET_COLUMNS}]
    if lacking or unknown:
        fault = f"lacks {', '.join(lacking)}" if lacking else f"has unknown {', '.join(unknown)}"
        raise InputError(
            f"{path}: {fault}; its columns are {', '.join(COLUMNS)} (and any of the sheet table)"
        )


def read_regions(path: Path, shape: tuple[int, int]) -> Regions:
    """Read regions drawn on the sheet, one row per point and region."""
    rows = files.read_tsv(path)
    if rows:
        _check_columns(path, rows[0])
    drawn = [row for row in rows if not files.is_missing(row["region"])]
    if not drawn:
        raise InputError(f"{path}: no point belongs to a region; draw one")
    nodes = _nodes(path, drawn, shape)
    names = [row["region"].strip() for row in drawn]
    counts = Counter(zip(names, *nodes.T.tolist(), strict=True))
    (name, x, y), times = counts.most_common(1)[0]
    if times > 1:
        raise InputError(
            f"{path}: point x={x + 1}, y={y + 1} occurs {times} times in region {name}; keep one"
        )
    regions = tuple(dict.fromkeys(names))
    member = np.zeros((len(regions), *shape), dtype=bool)
    member[[regions.index(name) for name in names], nodes[:, 0], nodes[:, 1]] = True
    return Regions(names=regions, member=member)


def _nodes(
    path: Path, rows: list[dict[str, str]], shape: tuple[int, int]
) -> np.ndarray[tuple[int, int], np.dtype[np.intp]]:
    """Find the nodes of the rows, (N, 2) indices."""
    wrong = [row for row in rows if not (row["x"].isdecimal() and row["y"].isdecimal())]
    off = [
        row
        for row in rows
        if not wrong and not (1 <= int(row["x"]) <= shape[0] and 1 <= int(row["y"]) <= shape[1])
    ]
    if wrong or off:
        first, count = (wrong or off)[0], len(wrong or off)
        fault = "is no pair of whole numbers" if wrong else "lies off the sheet"
        raise InputError(
            f"{path}: point x={first['x']}, y={first['y']} {fault} ({count} in all); x runs from 1"
            f" to {shape[0]}, y from 1 to {shape[1]}"
        )
    return np.array([[int(row["x"]) - 1, int(row["y"]) - 1] for row in rows], dtype=np.intp)
