"""Writes the files of one hemisphere, and removes and recognizes them.

The quality record goes last and is removed first, so that it stands for a complete set.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hipsta_bids.derivatives.names import (
    EXTRA_OUTPUTS,
    OUTPUTS,
    HemisphereName,
    output_name,
    output_path,
)
from hipsta_bids.errors import HipstaError
from hipsta_bids.geometry.catalog import MAPS, PER_SUBFIELD, SECTIONS, SUMMARY, Column
from hipsta_bids.geometry.sheet import is_left_handed, layer_depth
from hipsta_bids.io import files, gifti
from hipsta_bids.io.volumes import mask_bytes
from hipsta_bids.protocols.protocol import Label, Part, Protocol, Tissue
from hipsta_bids.types import BodyMask, Bool, Float, HemisphereMaps, Sheet, Status

# The tables of one hemisphere and their sidecars: columns, units, definitions, formats.


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


def sheet_labels(protocol: Protocol) -> dict[Tissue, Label]:
    """Choose one label per sheet tissue: that of the body, since the sheet is the body's."""
    preferred = sorted(protocol.labels, key=lambda label: label.part != Part.BODY)
    found: dict[Tissue, Label] = {}
    for tissue in protocol.sheet:
        match = next((label for label in preferred if label.tissue == tissue), None)
        if match is not None:
            found[tissue] = match
    return found


def format_column(values: Float, digits: int) -> list[str]:
    """Format numbers with a fixed number of decimals, so that equal values give equal bytes.

    Returns ````n/a```` for NaN.
    """
    rounded = np.round(values.ravel(), digits) + 0.0  # turns -0.0 into 0.0
    return [f"{v:.{digits}f}" if np.isfinite(v) else files.MISSING for v in rounded.tolist()]


def write_sheet(table: Path, sidecar: Path, maps: HemisphereMaps, protocol: Protocol) -> None:
    """Write the sheet table, one row per sheet point, y fastest, and its sidecar."""
    points = maps.sheet.points
    nx, ny, nz = points.shape[:3]
    x, y = np.divmod(np.arange(nx * ny), ny)
    middle = points[:, :, nz // 2].reshape(-1, 3)
    labels = sheet_labels(protocol)
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
    """Write the summary table, one row, and its sidecar."""
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
    """Write the profile table, first along x and then along y, and its sidecar."""
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
    """Write the table of cross-sections, from posterior to anterior, and its sidecar."""
    columns = _formatted(SECTIONS, sections)
    nodes = [str(k + 1) for k in range(len(columns[SECTIONS[0].name]))]
    files.write_tsv(table, list(SECTION_COLUMNS), zip(nodes, *columns.values(), strict=True))
    definitions = {
        "y": _definition("number of the section, from the posterior to the anterior end", None)
    }
    _write_sidecar(sidecar, definitions | {row.name: _measure(row) for row in SECTIONS})


def write_layers(table: Path, sidecar: Path, layers: Sheet) -> None:
    """Write all points of the three-dimensional grid, layers fastest, and the table's sidecar."""
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


#: Workbench's word for a surface, where it has one that fits.
_SECONDARY = {"interior": None, "midthickness": "MidThickness", "exterior": None}


@dataclass(frozen=True, kw_only=True)
class ResultPlace:
    """Where the results of one hemisphere are."""

    root: Path
    """The output dataset."""
    name: HemisphereName

    def path(self, key: str, desc: str | None = None) -> Path:
        """Path of one output, by its key in the output table and, for maps, the user's name."""
        return self.root / output_path(self.name, key, desc)

    def paths(self, *, optional: bool) -> list[Path]:
        """Paths of all outputs, with the optional ones or without."""
        return [self.path(row.key) for row in OUTPUTS if optional or not row.optional]

    def extra_paths(self) -> list[Path]:
        """Existing files that came with an option or another command."""
        folder = self.root / self.name.folder
        names = [output_name(self.name, row.key) for row in EXTRA_OUTPUTS]
        return [path for name in names for path in sorted(folder.glob(name))]


def remove_results(place: ResultPlace) -> None:
    """Remove every file of one hemisphere, whole or half-written."""
    files.remove([*reversed(place.paths(optional=True)), *place.extra_paths()])
    folder = place.path("qc").parent
    if folder.is_dir():
        files.remove_leftovers(folder, place.name.pattern)


def write_results(
    place: ResultPlace,
    maps: HemisphereMaps,
    protocol: Protocol,
    record: Mapping[str, Any],
    *,
    write_meshes: bool,
    write_more: Callable[[], None] = lambda: None,
) -> None:
    """Write all files of one hemisphere; earlier ones are removed first."""
    remove_results(place)
    write_sheet(place.path("sheet"), place.path("sheet_sidecar"), maps, protocol)
    write_summary(place.path("summary"), place.path("summary_sidecar"), maps.summary)
    write_profile(place.path("profile"), place.path("profile_sidecar"), maps)
    write_sections(place.path("sections"), place.path("sections_sidecar"), maps.sections)
    for key, content in gifti_files(maps, protocol, place.name.hemi):
        files.write_bytes(place.path(key), content)
    files.write_bytes(place.path("body_mask"), mask_bytes(maps.body_mask))
    if write_meshes:
        write_layers(place.path("layers"), place.path("layers_sidecar"), maps.layers)
        from hipsta_bids.io.gifti import mesh_bytes  # noqa: PLC0415  (meshio is slow to load)

        files.write_bytes(place.path("mesh"), mesh_bytes(maps.mesh, maps.coordinates))
    write_more()
    undefined = int(np.isnan(maps.sheet.points[:, :, [0, -1]]).any(axis=(2, 3)).sum())
    status, reason, message = verdict(maps)
    files.write_json(
        place.path("qc"),
        {
            "status": status,
            "reason": reason,
            "message": message,
            **record,
            "repairs": maps.repairs,
            "flags": [{"reason": f.reason, "message": f.message} for f in maps.flags],
            "undefined_columns": undefined,
            "metrics": maps.qc,
        },
    )


def write_failure(
    place: ResultPlace,
    error: HipstaError,
    record: Mapping[str, Any],
    body: BodyMask | None = None,
) -> None:
    """Leave nothing of a failed hemisphere but its quality record, and its body to be corrected."""
    remove_results(place)
    if body is not None:
        files.write_bytes(place.path("body_mask"), mask_bytes(body))
    verdict = {"status": Status.FAILED, "reason": error.reason, "message": str(error)}
    files.write_json(place.path("qc"), verdict | dict(record))


def verdict(maps: HemisphereMaps) -> tuple[Status, str | None, str | None]:
    """Sum up how a measured hemisphere ended."""
    notes = [flag.message for flag in maps.flags] or list(maps.repairs)
    reasons = list(dict.fromkeys(flag.reason for flag in maps.flags))
    if maps.repairs:
        reasons.append("repaired")
    return maps.status, "+".join(reasons) or None, "; ".join(notes) or None


def gifti_files(maps: HemisphereMaps, protocol: Protocol, hemi: str) -> Iterator[tuple[str, bytes]]:
    """Encode the surfaces and the maps on them.

    Vertices are the sheet's columns, y fastest, as the rows of the sheet table are. Surfaces
    need finite vertices: a column without a position gets that of its nearest neighbor on the
    grid, while the maps keep their NaN.
    """
    points = maps.sheet.points
    nx, ny = points.shape[:2]
    levels = {"interior": 0, "midthickness": points.shape[2] // 2, "exterior": -1}
    triangles = gifti.sheet_triangles(nx, ny, flip=is_left_handed(points))
    flat_triangles = gifti.sheet_triangles(nx, ny)
    for surface, level in levels.items():
        yield (
            f"{surface}_surface",
            gifti.surface_bytes(
                fill_from_nearest(points[:, :, level]).reshape(-1, 3),
                triangles,
                hemi=hemi,
                secondary=_SECONDARY[surface],
                unfolded=False,
            ),
        )
        yield (
            f"{surface}_unfold",
            gifti.surface_bytes(
                unfolded_points(maps, surface).reshape(-1, 3),
                flat_triangles,
                hemi=hemi,
                secondary=_SECONDARY[surface],
                unfolded=True,
            ),
        )
    for row in MAPS:
        values = maps.maps[row.name].ravel()
        yield row.name, gifti.shape_bytes(values, hemi=hemi, name=row.name, unit=row.unit)
    table = {
        int(tissue): (label.name, label.color) for tissue, label in sheet_labels(protocol).items()
    }
    yield (
        "subfields",
        gifti.label_bytes(maps.subfield.ravel(), hemi=hemi, name="subfields", table=table),
    )


def unfolded_points(maps: HemisphereMaps, surface: str) -> Float:
    """Lay one surface of the sheet flat.

    Returns All in mm.
    """
    nx, ny = maps.sheet.points.shape[:2]
    extents = [maps.summary.get(f"extent_{axis}", np.nan) for axis in "xyz"]
    width, length, height = (e if np.isfinite(e) and e > 0 else 1.0 for e in extents)
    x = np.linspace(-width / 2, width / 2, nx)
    y = np.linspace(-length / 2, length / 2, ny)
    z = height * {"interior": -0.5, "midthickness": 0.0, "exterior": 0.5}[surface]
    return np.stack(np.broadcast_arrays(x[:, None], y[None, :], np.float64(z)), axis=-1)


def fill_from_nearest(points: Float) -> Float:
    """Give each undefined grid node the position of the nearest defined one.

    ``points`` NaN where undefined.
    """
    undefined: Bool = np.asarray(np.isnan(points).any(axis=-1))
    if not undefined.any() or undefined.all():
        return points
    from scipy.ndimage import distance_transform_edt  # noqa: PLC0415  (rarely needed)

    nearest = distance_transform_edt(undefined, return_distances=False, return_indices=True)
    filled: Float = points[tuple(nearest)]
    return filled
