"""Writes and removes the files of one hemisphere: tables, surfaces, maps, quality record.

The quality record is written last and removed first, so that it stands for a complete set.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hipsta_bids.derivatives.dataset import describe_columns
from hipsta_bids.derivatives.names import EXTRA_OUTPUTS, OUTPUTS, SHARED, describe, sources
from hipsta_bids.derivatives.results import LAYERS, NODES, POSITION, STATE, ResultPlace
from hipsta_bids.errors import HipstaError
from hipsta_bids.geometry.catalog import MAPS, PER_SUBFIELD, SECTIONS, SUMMARY, Column
from hipsta_bids.geometry.sheet import is_left_handed, layer_depth
from hipsta_bids.io import files, gifti
from hipsta_bids.io.volumes import mask_bytes
from hipsta_bids.protocols import EXPERIMENTAL
from hipsta_bids.protocols.protocol import Label, Part, Protocol, Tissue
from hipsta_bids.types import BodyMask, Bool, Decision, Flag, Float, HemisphereMaps, Sheet

_SUMMARY_ROWS = {row.name: row for row in SUMMARY}

#: What all of these tables are about, whatever the columns.
_MEASURED_REGION = (
    "the sheet between the two end planes of the hippocampal body; head and tail are in no number"
)
_WHOLE_REGION = "the hippocampal sheet with head, and tail where it has subfields; experimental"
_MILLIMETER_DIGITS = 4

#: Most words of a message in a table.
_HEADLINE = 25
_WORD = re.compile(r"[^\s()]*\((?:[^()]|\([^()]*\))*\)\S*|\S+")

#: Names of surfaces in Workbench, where there is one that fits.
_SECONDARY = {"interior": None, "midthickness": "MidThickness", "exterior": None}


def remove_results(result: ResultPlace) -> None:
    """Remove every file of one hemisphere, whole or half-written."""
    files.remove([*reversed(result.paths(optional=True)), *result.extra_paths()])
    folder = result.path("qc").parent
    if folder.is_dir():
        files.remove_leftovers(folder, result.name.pattern)


def sheet_labels(protocol: Protocol) -> dict[Tissue, Label]:
    """Choose one label per sheet tissue: the body's, since the sheet is the body's."""
    first_labels: dict[Tissue, Label] = {}
    for label in sorted(protocol.labels, key=lambda label: label.part != Part.BODY):
        first_labels.setdefault(label.tissue, label)
    return {tissue: first_labels[tissue] for tissue in protocol.sheet if tissue in first_labels}


def format_column(values: Float, digits: int) -> list[str]:
    """Format numbers with fixed decimals, so that equal values give equal bytes; NaN is ``n/a``."""
    rounded = np.round(values.ravel(), digits) + 0.0  # turns -0.0 into 0.0
    return [f"{v:.{digits}f}" if np.isfinite(v) else files.MISSING for v in rounded.tolist()]


def write_table(
    result: ResultPlace,
    key: str,
    columns: Mapping[str, Sequence[str]],
    definitions: Mapping[str, object],
) -> None:
    """Write a table, and the sidecar that defines its columns."""
    files.write_tsv(result.path(key), list(columns), zip(*columns.values(), strict=True))
    region = _WHOLE_REGION if result.name.region in EXPERIMENTAL else _MEASURED_REGION
    sidecar = {**definitions, "MeasuredRegion": region}
    files.write_json(result.path(f"{key}_sidecar"), sidecar)


def _write_sheet(result: ResultPlace, maps: HemisphereMaps, protocol: Protocol) -> None:
    """Write one row per sheet point, y fastest."""
    points = maps.sheet.points
    nx, ny, nz = points.shape[:3]
    labels = sheet_labels(protocol)
    short = {int(tissue): label.abbreviation for tissue, label in labels.items()}
    columns = {
        **number_nodes(NODES, (nx, ny)),
        **_positions(points[:, :, nz // 2]),
        **format_measures(MAPS, maps.maps),
        "subfield": [short.get(code, files.MISSING) for code in maps.subfield.ravel().tolist()],
        "valid": _truths(maps.sheet.valid),
        "repaired": _truths(maps.repaired),
        "doubtful": _truths(maps.doubtful),
    }
    definitions = describe_columns(NODES | POSITION)
    definitions |= {row.name: define_measure(row) for row in MAPS} | describe_columns(STATE)
    definitions["subfield"]["Levels"] = {
        label.abbreviation: label.name for label in labels.values()
    }
    if "x_coordinate" in maps.qc:
        definitions["x"]["Coordinate"] = maps.qc["x_coordinate"]
    write_table(result, "sheet", columns, definitions)


def _write_summary(result: ResultPlace, summary: Mapping[str, float]) -> None:
    """Write one row of summary measures: those of the catalog, then those of subfields."""
    names = dict.fromkeys((*_SUMMARY_ROWS, *summary))
    columns = {name: summary_cell(name, summary.get(name, np.nan)) for name in names}
    write_table(result, "summary", columns, {name: summary_definition(name) for name in names})


def summary_cell(name: str, value: float) -> list[str]:
    """Write the value of a summary measure as the one cell of its column."""
    row = _SUMMARY_ROWS.get(name)
    return format_column(np.array([value]), row.digits if row else _MILLIMETER_DIGITS)


def _write_profile(result: ResultPlace, maps: HemisphereMaps) -> None:
    """Write the means along x, then those along y."""
    parts = []
    for axis, profile in maps.profiles.items():
        measures = format_measures(MAPS, profile)
        count = len(measures[MAPS[0].name])
        parts.append({"axis": [axis] * count, **number_nodes(("node",), (count,)), **measures})
    columns = {name: [cell for part in parts for cell in part[name]] for name in parts[0]}
    definitions: dict[str, object] = {
        "axis": {
            "Description": "axis along which the profile runs; the other one is averaged over",
            "Levels": {
                "x": "one row per x from medial to lateral, mean over y",
                "y": "one row per y from posterior to anterior, mean over x",
            },
        },
        "node": {"Description": "node number along that axis, from 1"},
    }
    wording = "{}; mean over the area of the columns measured directly"
    definitions |= {row.name: define_measure(row, wording) for row in MAPS}
    write_table(result, "profile", columns, definitions)


def _write_sections(result: ResultPlace, sections: Mapping[str, Float]) -> None:
    """Write one row per cross-section, from posterior to anterior."""
    measures = format_measures(SECTIONS, sections)
    count = len(measures[SECTIONS[0].name])
    text = "number of the section, from the posterior to the anterior end"
    definitions = {"y": {"Description": text}} | {row.name: define_measure(row) for row in SECTIONS}
    write_table(result, "sections", {**number_nodes(("y",), (count,)), **measures}, definitions)


def _write_layers(result: ResultPlace, layers: Sheet) -> None:
    """Write one row per point of the three-dimensional grid, layers fastest."""
    depth = layer_depth(layers)
    length = np.where(depth[:, :, -1:] > 0, depth[:, :, -1:], np.nan)
    columns = {
        **number_nodes(("x", "y", "layer"), depth.shape),
        "depth": format_column(depth, _MILLIMETER_DIGITS),
        "relative_depth": format_column(depth / length, _MILLIMETER_DIGITS),
        **_positions(layers.points),
    }
    write_table(result, "layers", columns, describe_columns(LAYERS))


def number_nodes(axes: Iterable[str], shape: tuple[int, ...]) -> dict[str, list[str]]:
    """Node numbers of all points of a grid, from 1, last axis fastest."""
    numbers = (index.ravel() + 1 for index in np.indices(shape))
    return {axis: [str(n) for n in v.tolist()] for axis, v in zip(axes, numbers, strict=True)}


def write_nodes(path: Path, names: Sequence[str], values: Float, digits: int = 7) -> None:
    """Write values (Nx, Ny, columns) of a sheet as a table with one row per node."""
    x, y = np.indices(values.shape[:2]).reshape(2, -1) + 1
    cells = [format_cells(column, digits) for column in values.reshape(len(x), -1).T]
    rows = zip(map(str, x.tolist()), map(str, y.tolist()), *cells, strict=True)
    files.write_tsv(path, ["x", "y", *names], rows)


def format_cells(values: Float, digits: int = 7) -> list[str]:
    """Format numbers of unknown size."""
    return [f"{v:.{digits}g}" if np.isfinite(v) else files.MISSING for v in values.tolist()]


def _positions(points: Float) -> dict[str, list[str]]:
    return {
        axis: format_column(points[..., k], _MILLIMETER_DIGITS) for k, axis in enumerate(POSITION)
    }


def _truths(values: Bool) -> list[str]:
    return ["true" if value else "false" for value in values.ravel().tolist()]


def format_measures(rows: Sequence[Column], values: Mapping[str, Float]) -> dict[str, list[str]]:
    """Format columns in the catalog's order, each with its number of decimals."""
    return {row.name: format_column(values[row.name], row.digits) for row in rows}


def define_measure(row: Column, wording: str = "{}") -> dict[str, object]:
    """Define the column of a measure, with the source of its formula."""
    return {"Description": wording.format(row.definition), "Units": row.unit, "Source": row.source}


def summary_definition(column: str) -> dict[str, object]:
    """Define a summary measure; the name of a subfield's begins with the measure's."""
    if column in _SUMMARY_ROWS:
        return define_measure(_SUMMARY_ROWS[column])
    for row in PER_SUBFIELD:
        if column.startswith(f"{row.name}_"):
            subfield = column.removeprefix(f"{row.name}_")
            return define_measure(row) | {"Description": row.definition.format(subfield)}
    return {"Description": column.replace("_", " ")}


def write_results(
    result: ResultPlace,
    maps: HemisphereMaps,
    protocol: Protocol,
    record: Mapping[str, Any],
    *,
    write_meshes: bool,
    write_more: Callable[[], None] = lambda: None,
) -> None:
    """Write all files of one hemisphere; earlier ones are removed first."""
    remove_results(result)
    _write_sheet(result, maps, protocol)
    _write_summary(result, maps.summary)
    _write_profile(result, maps)
    _write_sections(result, maps.sections)
    for key, content in gifti_files(maps, protocol, result.name.hemi):
        files.write_bytes(result.path(key), content)
    files.write_bytes(result.path("body_mask"), mask_bytes(maps.body_mask))
    if write_meshes:
        _write_layers(result, maps.layers)
        files.write_bytes(result.path("mesh"), gifti.mesh_bytes(maps.mesh, maps.coordinates))
    write_more()
    write_sources(result, record)
    undefined = int(np.isnan(maps.sheet.points[:, :, [0, -1]]).any(axis=(2, 3)).sum())
    decision, reason, message = verdict(maps)
    files.write_json(
        result.path("qc"),
        {
            "decision": decision,
            "reason": reason,
            "message": message,
            **record,
            "repairs": maps.repairs,
            "flags": [_flag_entry(flag) for flag in maps.flags],
            "undefined_columns": undefined,
            "metrics": maps.qc,
        },
    )


def write_sources(result: ResultPlace, record: Mapping[str, Any]) -> None:
    """Write sidecars with the sources of the images of a hemisphere.

    Their other entries are in the root of the dataset, except for images that few datasets have.
    """
    for row in (*OUTPUTS, *EXTRA_OUTPUTS):
        if any(result.path(image.key).exists() for image in row.images):
            about = {} if row in SHARED else describe(row)
            files.write_json(result.path(row.key), {**about, "Sources": sources(record)})


def _flag_entry(flag: Flag) -> dict[str, Any]:
    return {
        "reason": flag.reason,
        "message": flag.message,
        "value": flag.value,
        "limit": flag.limit,
        "position_ras_mm": flag.points.mean(axis=0).round(2) if len(flag.points) else None,
        "columns_share": flag.share,
        "mean_change_mm": flag.change,
    }


def write_failure(
    result: ResultPlace, error: HipstaError, record: Mapping[str, Any], body: BodyMask | None = None
) -> None:
    """Leave nothing of a failed hemisphere but its quality record, and its body to be corrected."""
    remove_results(result)
    if body is not None:
        files.write_bytes(result.path("body_mask"), mask_bytes(body))
        write_sources(result, record)
    ending = {"decision": Decision.FAILED, "reason": error.reason, "message": str(error)}
    files.write_json(result.path("qc"), ending | dict(record))


def verdict(maps: HemisphereMaps) -> tuple[Decision, str | None, str | None]:
    """Return the decision on a measured hemisphere, its reasons, and the message of the first."""
    reasons = dict.fromkeys(flag.reason for flag in maps.flags)
    message = maps.flags[0].message if maps.flags else None
    return maps.decision, "+".join(reasons) or None, message


def headline(message: str) -> str:
    """Shorten a message to 25 words at most, at the end of a clause where one is near.

    Brackets, such as the subfields at a place, are one word.
    """
    words = _WORD.findall(" ".join(message.split()))
    if len(words) <= _HEADLINE:
        return " ".join(words)
    head = words[:_HEADLINE]
    clauses = [n for n, word in enumerate(head, 1) if word[-1] in ".;:," and n > _HEADLINE // 3]
    if clauses:
        return " ".join(head[: clauses[-1]]).rstrip(".;:,")
    return f"{' '.join(head)}..."


def gifti_files(maps: HemisphereMaps, protocol: Protocol, hemi: str) -> Iterator[tuple[str, bytes]]:
    """Encode the surfaces and the maps on them.

    Vertices are the sheet's columns, y fastest, as the rows of the sheet table are. Surfaces
    need finite vertices: a column without a position gets its nearest neighbor's on the grid, while
    the maps keep their NaN.
    """
    points = maps.sheet.points
    nx, ny = points.shape[:2]
    levels = {"interior": 0, "midthickness": points.shape[2] // 2, "exterior": -1}
    for surface, level in levels.items():
        for key, vertices in (
            ("surface", fill_from_nearest(points[:, :, level])),
            ("unfold", _unfolded_points(maps, surface)),
        ):
            unfolded = key == "unfold"
            yield (
                f"{surface}_{key}",
                gifti.surface_bytes(
                    vertices.reshape(-1, 3),
                    gifti.sheet_triangles(nx, ny, flip=not unfolded and is_left_handed(points)),
                    hemi=hemi,
                    secondary=_SECONDARY[surface],
                    unfolded=unfolded,
                ),
            )
    for row in MAPS:
        values = maps.maps[row.name].ravel()
        yield row.name, gifti.shape_bytes(values, hemi=hemi, name=row.name, unit=row.unit)
    labels = sheet_labels(protocol)
    table = {int(tissue): (label.name, label.color) for tissue, label in labels.items()}
    yield (
        "subfields",
        gifti.label_bytes(maps.subfield.ravel(), hemi=hemi, name="subfields", table=table),
    )


def _unfolded_points(maps: HemisphereMaps, surface: str) -> Float:
    """Lay one surface of the sheet flat, (Nx, Ny, 3) mm."""
    nx, ny = maps.sheet.points.shape[:2]
    extents = [maps.summary.get(f"extent_{axis}", np.nan) for axis in "xyz"]
    width, length, height = (e if np.isfinite(e) and e > 0 else 1.0 for e in extents)
    x = np.linspace(-width / 2, width / 2, nx)
    y = np.linspace(-length / 2, length / 2, ny)
    z = height * {"interior": -0.5, "midthickness": 0.0, "exterior": 0.5}[surface]
    return np.stack(np.broadcast_arrays(x[:, None], y[None, :], np.float64(z)), axis=-1)


def fill_from_nearest(points: Float) -> Float:
    """Give each undefined (NaN) grid node the position of the nearest defined one."""
    undefined: Bool = np.asarray(np.isnan(points).any(axis=-1))
    if not undefined.any() or undefined.all():
        return points
    from scipy.ndimage import distance_transform_edt  # noqa: PLC0415  (rarely needed)

    nearest = distance_transform_edt(undefined, return_distances=False, return_indices=True)
    filled: Float = points[tuple(nearest)]
    return filled
