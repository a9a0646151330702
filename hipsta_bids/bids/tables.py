"""The tables of one hemisphere and their sidecars: columns, units, definitions, formats."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from hipsta_bids.artifacts import Bool, Float, HemisphereMaps
from hipsta_bids.bids import files
from hipsta_bids.schemes import Label, Part, Scheme, Tissue

#: Columns of the sheet table: definition and unit.
SHEET_COLUMNS: dict[str, tuple[str, str | None]] = {
    "x": ("node number along x, 1 at the medial end (subiculum)", None),
    "y": ("node number along y, 1 at the posterior end", None),
    "r": ("position on the mid-surface, scanner RAS, left to right", "mm"),
    "a": ("position on the mid-surface, scanner RAS, posterior to anterior", "mm"),
    "s": ("position on the mid-surface, scanner RAS, inferior to superior", "mm"),
    "thickness": ("length of the line from the interior to the exterior wall", "mm"),
    "curvature": ("mean curvature of the mid-surface, positive round the interior", "1/mm"),
    "curvature_interior": ("mean curvature of the interior surface, sign as above", "1/mm"),
    "curvature_exterior": ("mean curvature of the exterior surface, sign as above", "1/mm"),
    "subfield": ("subfield at the mid-surface", None),
    "valid": ("true where measured directly, false where filled or missing", None),
    "repaired": ("true where a repair of the labels' topology touched the column", None),
}

#: Columns of the summary table that every hemisphere has.
SUMMARY_COLUMNS: dict[str, tuple[str, str]] = {
    "thickness_mean": ("mean thickness over the sheet", "mm"),
    "extent_x": ("mean extent of the sheet from medial to lateral, along the sheet", "mm"),
    "extent_y": ("mean extent of the sheet from posterior to anterior, along the sheet", "mm"),
    "extent_z": ("mean extent of the sheet from interior to exterior", "mm"),
    "volume": ("volume of the sheet", "mm^3"),
    "area_interior": ("area of the interior surface", "mm^2"),
    "area_mid": ("area of the mid-surface", "mm^2"),
    "area_exterior": ("area of the exterior surface", "mm^2"),
}

#: Columns of the summary table per subfield.
SUBFIELD_COLUMNS: dict[str, tuple[str, str]] = {
    "thickness_mean": ("mean thickness over the part of the sheet in {}", "mm"),
    "area": ("area of the mid-surface in {}", "mm^2"),
    "volume": ("volume of the sheet in {}", "mm^3"),
}

_MILLIMETER_DIGITS = 4
_CURVATURE_DIGITS = 5


def sheet_labels(scheme: Scheme) -> dict[Tissue, Label]:
    """Choose one label per sheet tissue: that of the body, since the sheet is the body's.

    Parameters
    ----------
    scheme : Scheme
        Protocol of the segmentation.

    Returns
    -------
    dict of Tissue to Label
        In medial-to-lateral order.
    """
    preferred = sorted(scheme.labels, key=lambda label: label.part != Part.BODY)
    found: dict[Tissue, Label] = {}
    for tissue in scheme.sheet:
        match = next((label for label in preferred if label.tissue == tissue), None)
        if match is not None:
            found[tissue] = match
    return found


def format_column(values: Float, digits: int) -> list[str]:
    """Format numbers with a fixed number of decimals, so that equal values give equal bytes.

    Parameters
    ----------
    values : float64
        Any shape; taken in C order.
    digits : int
        Decimals.

    Returns
    -------
    list of str
        ``n/a`` for NaN; never a negative zero.
    """
    rounded = np.round(values.ravel(), digits) + 0.0  # turns -0.0 into 0.0
    return [f"{v:.{digits}f}" if np.isfinite(v) else files.MISSING for v in rounded.tolist()]


def write_sheet(table: Path, sidecar: Path, maps: HemisphereMaps, scheme: Scheme) -> None:
    """Write the sheet table, one row per sheet point, y fastest, and its sidecar.

    Parameters
    ----------
    table, sidecar : Path
        The ``.tsv`` and ``.json`` files.
    maps : HemisphereMaps
        What was measured.
    scheme : Scheme
        Protocol of the segmentation, for the names of the subfields.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    points = maps.sheet.points
    nx, ny, nz = points.shape[:3]
    x, y = np.divmod(np.arange(nx * ny), ny)
    middle = points[:, :, nz // 2].reshape(-1, 3)
    labels = sheet_labels(scheme)
    short = {int(tissue): label.abbreviation for tissue, label in labels.items()}
    columns = {
        "x": [str(i) for i in (x + 1).tolist()],
        "y": [str(j) for j in (y + 1).tolist()],
        **{
            axis: format_column(middle[:, k], _MILLIMETER_DIGITS)
            for k, axis in enumerate(("r", "a", "s"))
        },
        "thickness": format_column(maps.thickness, _MILLIMETER_DIGITS),
        **{
            name: format_column(getattr(maps, name), _CURVATURE_DIGITS)
            for name in ("curvature", "curvature_interior", "curvature_exterior")
        },
        "subfield": [short.get(code, files.MISSING) for code in maps.subfield.ravel().tolist()],
        "valid": _truths(maps.sheet.valid),
        "repaired": _truths(maps.repaired),
    }
    # One order of columns, stated once.
    files.write_tsv(
        table,
        list(SHEET_COLUMNS),
        zip(*(columns[name] for name in SHEET_COLUMNS), strict=True),
    )
    definitions = {name: _definition(*entry) for name, entry in SHEET_COLUMNS.items()}
    definitions["subfield"]["Levels"] = {
        label.abbreviation: label.name for label in labels.values()
    }
    files.write_json(sidecar, definitions)


def write_summary(table: Path, sidecar: Path, summary: Mapping[str, float]) -> None:
    """Write the summary table, one row, and its sidecar.

    Parameters
    ----------
    table, sidecar : Path
        The ``.tsv`` and ``.json`` files.
    summary : mapping of str to float
        One number per column; a column of :data:`SUMMARY_COLUMNS` without one is ``n/a``.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    definitions = {name: _definition(*entry) for name, entry in SUMMARY_COLUMNS.items()}
    definitions |= {name: _subfield_definition(name) for name in summary if name not in definitions}
    cells = [
        format_column(np.array([summary.get(name, np.nan)], dtype=np.float64), _MILLIMETER_DIGITS)
        for name in definitions
    ]
    files.write_tsv(table, list(definitions), [[cell[0] for cell in cells]])
    files.write_json(sidecar, definitions)


def _truths(values: Bool) -> list[str]:
    return ["true" if value else "false" for value in values.ravel().tolist()]


def _definition(description: str, unit: str | None) -> dict[str, object]:
    definition: dict[str, object] = {"Description": description}
    return definition | ({"Units": unit} if unit else {})


def _subfield_definition(column: str) -> dict[str, object]:
    """Define a per-subfield column from its prefix; the rest of its name is the subfield."""
    for prefix, (description, unit) in SUBFIELD_COLUMNS.items():
        if column.startswith(f"{prefix}_"):
            return _definition(description.format(column.removeprefix(f"{prefix}_")), unit)
    return _definition(column.replace("_", " "), None)
