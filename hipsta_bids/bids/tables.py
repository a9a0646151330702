"""The tables of one hemisphere and their sidecars: columns, units, definitions, formats.

Columns of measures come from the catalog of measures; here are those that say where a row is.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from hipsta_bids.artifacts import Bool, Float, HemisphereMaps, Sheet
from hipsta_bids.bids import files
from hipsta_bids.geometry.catalog import MAPS, SECTIONS, Column
from hipsta_bids.geometry.layers import layer_depth
from hipsta_bids.geometry.summary import PER_SUBFIELD, SUMMARY
from hipsta_bids.schemes import Label, Part, Scheme, Tissue

NODES: dict[str, tuple[str, str | None]] = {
    "x": ("node number along x, 1 at the medial end (subiculum)", None),
    "y": ("node number along y, 1 at the posterior end", None),
}

#: Columns of the sheet table that are no measures: definition and unit.
PLACE: dict[str, tuple[str, str | None]] = {
    "r": ("position on the mid-surface, scanner RAS, left to right", "mm"),
    "a": ("position on the mid-surface, scanner RAS, posterior to anterior", "mm"),
    "s": ("position on the mid-surface, scanner RAS, inferior to superior", "mm"),
}
STATE: dict[str, tuple[str, str | None]] = {
    "subfield": ("subfield at the mid-surface", None),
    "valid": ("true where measured directly, false where filled or missing", None),
    "repaired": ("true where a repair of the labels' topology touched the column", None),
}

#: Columns of each table, in order.
SHEET_COLUMNS = (*NODES, *PLACE, *(row.name for row in MAPS), *STATE)
SUMMARY_COLUMNS = tuple(row.name for row in SUMMARY)
PROFILE_COLUMNS = ("axis", "node", *(row.name for row in MAPS))
SECTION_COLUMNS = ("y", *(row.name for row in SECTIONS))

LAYERS: dict[str, tuple[str, str | None]] = {
    **NODES,
    "layer": ("number of the layer, 1 on the interior and the last on the exterior wall", None),
    "depth": ("distance from the interior wall along the column", "mm"),
    "relative_depth": ("the same over the length of the column", None),
    **{
        axis: (definition.replace("on the mid-surface", "of the point"), unit)
        for axis, (definition, unit) in PLACE.items()
    },
}

#: What all of these tables are about, whatever the columns.
MEASURED_REGION = (
    "the sheet between the two end planes of the hippocampal body; head and tail are not measured"
    " and not part of any number"
)

_MILLIMETER_DIGITS = 4


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
        **_formatted(MAPS, maps.maps),
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
    definitions = _definitions(NODES) | _definitions(PLACE)
    definitions |= {row.name: _measure(row) for row in MAPS} | _definitions(STATE)
    definitions["subfield"]["Levels"] = {
        label.abbreviation: label.name for label in labels.values()
    }
    _write_sidecar(sidecar, definitions)


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
    definitions = {row.name: _measure(row) for row in SUMMARY}
    digits = {row.name: row.digits for row in SUMMARY}
    definitions |= {name: _subfield_definition(name) for name in summary if name not in definitions}
    cells = [
        format_column(
            np.array([summary.get(name, np.nan)], dtype=np.float64),
            digits.get(name, _MILLIMETER_DIGITS),
        )
        for name in definitions
    ]
    files.write_tsv(table, list(definitions), [[cell[0] for cell in cells]])
    _write_sidecar(sidecar, definitions)


def write_profile(table: Path, sidecar: Path, maps: HemisphereMaps) -> None:
    """Write the profile table, first along x and then along y, and its sidecar.

    Parameters
    ----------
    table, sidecar : Path
        The ``.tsv`` and ``.json`` files.
    maps : HemisphereMaps
        What was measured.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    rows: list[tuple[str, ...]] = []
    for axis, profile in maps.profiles.items():
        columns = _formatted(MAPS, profile)
        nodes = [str(k + 1) for k in range(len(columns[MAPS[0].name]))]
        rows += zip([axis] * len(nodes), nodes, *columns.values(), strict=True)
    files.write_tsv(table, list(PROFILE_COLUMNS), rows)
    definitions: dict[str, dict[str, object]] = {
        "axis": {
            "Description": "axis along which the profile runs; the other one is averaged over",
            "Levels": {
                "x": "one row per x from medial to lateral, mean over y",
                "y": "one row per y from posterior to anterior, mean over x",
            },
        },
        "node": _definition("node number along that axis, from 1", None),
    }
    for row in MAPS:
        definitions[row.name] = _measure(
            row, "{}; mean over the area of the columns measured directly"
        )
    _write_sidecar(sidecar, definitions)


def write_sections(table: Path, sidecar: Path, sections: Mapping[str, Float]) -> None:
    """Write the table of cross-sections, from posterior to anterior, and its sidecar.

    Parameters
    ----------
    table, sidecar : Path
        The ``.tsv`` and ``.json`` files.
    sections : mapping of str to (Ny,) float64
        What was measured, by the names in the catalog.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    columns = _formatted(SECTIONS, sections)
    nodes = [str(k + 1) for k in range(len(columns[SECTIONS[0].name]))]
    files.write_tsv(table, list(SECTION_COLUMNS), zip(nodes, *columns.values(), strict=True))
    definitions = {
        "y": _definition("number of the section, from the posterior to the anterior end", None)
    }
    _write_sidecar(sidecar, definitions | {row.name: _measure(row) for row in SECTIONS})


def write_layers(table: Path, sidecar: Path, layers: Sheet) -> None:
    """Write all points of the three-dimensional grid, layers fastest, and the table's sidecar.

    Parameters
    ----------
    table, sidecar : Path
        The ``.tsv`` and ``.json`` files.
    layers : Sheet
        The points, layer by layer.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    depth = layer_depth(layers)
    length = np.where(depth[:, :, -1:] > 0, depth[:, :, -1:], np.nan)
    x, y, layer = (index.ravel() + 1 for index in np.indices(depth.shape))
    columns = [
        *([str(k) for k in index.tolist()] for index in (x, y, layer)),
        format_column(depth, _MILLIMETER_DIGITS),
        format_column(depth / length, _MILLIMETER_DIGITS),
        *(format_column(layers.points[..., k], _MILLIMETER_DIGITS) for k in range(3)),
    ]
    files.write_tsv(table, list(LAYERS), zip(*columns, strict=True))
    _write_sidecar(sidecar, _definitions(LAYERS))


def _truths(values: Bool) -> list[str]:
    return ["true" if value else "false" for value in values.ravel().tolist()]


def _formatted(rows: Sequence[Column], values: Mapping[str, Float]) -> dict[str, list[str]]:
    """Format columns in the catalog's order, each with its own number of decimals."""
    return {row.name: format_column(values[row.name], row.digits) for row in rows}


def _write_sidecar(path: Path, definitions: Mapping[str, object]) -> None:
    files.write_json(path, {**definitions, "MeasuredRegion": MEASURED_REGION})


def _definition(description: str, unit: str | None) -> dict[str, object]:
    definition: dict[str, object] = {"Description": description}
    return definition | ({"Units": unit} if unit else {})


def _definitions(entries: Mapping[str, tuple[str, str | None]]) -> dict[str, dict[str, object]]:
    return {name: _definition(*entry) for name, entry in entries.items()}


def _measure(row: Column, wording: str = "{}") -> dict[str, object]:
    """Define the column of a measure, with where its formula comes from."""
    return {
        "Description": wording.format(row.definition),
        "Units": row.unit,
        "Source": row.source,
    }


def _subfield_definition(column: str) -> dict[str, object]:
    """Define a per-subfield column from its prefix; the rest of its name is the subfield."""
    for row in PER_SUBFIELD:
        if column.startswith(f"{row.name}_"):
            subfield = column.removeprefix(f"{row.name}_")
            return _measure(row) | {"Description": row.definition.format(subfield)}
    return _definition(column.replace("_", " "), None)
