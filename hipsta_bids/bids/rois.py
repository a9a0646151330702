"""Tables of regions drawn on the sheet (``--roi``), and of what the maps are in them."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from hipsta_bids.artifacts import Float
from hipsta_bids.bids import files, tables
from hipsta_bids.errors import InputError
from hipsta_bids.geometry.regions import Regions, RegionStatistics

#: Columns of a region file: node numbers as in the sheet table, and the region's name.
COLUMNS = ("x", "y", "region")

_DIGITS = 6


def read_regions(path: Path, shape: tuple[int, int]) -> Regions:
    """Read regions drawn on the sheet.

    Parameters
    ----------
    path : Path
        TSV with the columns ``x``, ``y`` (node numbers, from 1, as in the sheet table) and
        ``region``; rows whose region is ``n/a`` or empty belong to none. Other columns of the sheet
        table may be there too and are not looked at. A point may belong to several regions.
    shape : tuple of int
        Nodes of the sheet along x and y.

    Returns
    -------
    Regions
        In the order in which their names first occur.

    Raises
    ------
    InputError
        ``unreadable-table``, ``bad-table``, ``roi-columns``, ``roi-point``, ``roi-duplicate`` or
        ``roi-empty``.
    """
    rows = files.read_tsv(path)
    columns = tuple(rows[0]) if rows else ()
    lacking = [name for name in COLUMNS if name not in columns]
    unknown = [name for name in columns if name not in {*COLUMNS, *tables.SHEET_COLUMNS}]
    if rows and (lacking or unknown):
        fault = f"lacks {', '.join(lacking)}" if lacking else f"has unknown {', '.join(unknown)}"
        raise InputError(
            f"{path}: {fault}; its columns are {', '.join(COLUMNS)} (and any of the sheet table)",
            reason="roi-columns",
        )
    drawn = [row for row in rows if row["region"].strip() not in ("", files.MISSING)]
    if not drawn:
        raise InputError(f"{path}: no point belongs to a region; draw one", reason="roi-empty")
    nodes = _nodes(path, drawn, shape)
    names = [row["region"].strip() for row in drawn]
    seen = Counter(zip(names, *nodes.T.tolist(), strict=True))
    (name, x, y), times = seen.most_common(1)[0]
    if times > 1:
        raise InputError(
            f"{path}: point x={x + 1}, y={y + 1} occurs {times} times in region {name}; keep one",
            reason="roi-duplicate",
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
        what = "is no pair of whole numbers" if wrong else "lies off the sheet"
        raise InputError(
            f"{path}: point x={first['x']}, y={first['y']} {what} ({count} in all); x runs from 1"
            f" to {shape[0]}, y from 1 to {shape[1]}",
            reason="roi-point",
        )
    return np.array([[int(row["x"]) - 1, int(row["y"]) - 1] for row in rows], dtype=np.intp)


def write_regions(
    table: Path, sidecar: Path, regions: Regions, found: RegionStatistics, units: Mapping[str, str]
) -> None:
    """Write one row per region, and the sidecar.

    Parameters
    ----------
    table, sidecar : Path
    regions : Regions
    found : RegionStatistics
    units : mapping of str to str
        Unit of each map that has a known one.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    definitions: dict[str, dict[str, object]] = {
        "region": {"Description": "region, as the user named it"},
        "n_points": {"Description": "sheet points in the region"},
        "n_valid": {"Description": "... whose columns were measured directly"},
        "area": {"Description": "area of the mid-surface round these points", "Units": "mm^2"},
    }
    columns: dict[str, list[str]] = {
        "region": list(regions.names),
        "n_points": _cells(found.n_points),
        "n_valid": _cells(found.n_valid),
        "area": tables.format_column(found.area, _DIGITS),
    }
    parts = (
        ("mean", "mean of {} over valid points", found.mean),
        ("sd", "standard deviation of {} over valid points", found.sd),
        ("mode", "most frequent value of {} at valid points", found.mode),
    )
    for suffix, text, values in parts:
        for name, column in values.items():
            unit = {"Units": units[name]} if name in units else {}
            definitions[f"{name}_{suffix}"] = {"Description": text.format(name), **unit}
            columns[f"{name}_{suffix}"] = (
                tables.format_column(column, _DIGITS) if name in units else _cells(column)
            )
    files.write_tsv(table, list(columns), zip(*columns.values(), strict=True))
    files.write_json(sidecar, definitions)


def _cells(values: Float) -> list[str]:
    """Numbers of unknown size, to seven digits."""
    return [f"{v:.7g}" if np.isfinite(v) else files.MISSING for v in values.tolist()]
