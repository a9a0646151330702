"""Writes all results of one model into its folder."""

import contextlib
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
from pyarrow import parquet

from hipsta_bids.derivatives.names import DATASET_FILES
from hipsta_bids.group.analysis import Analysis
from hipsta_bids.group.collect import Exclusion
from hipsta_bids.group.data import PARTICIPANT, SESSION, Cohort, Float, Int, ResultTable, SideMaps
from hipsta_bids.group.figures import draw_figures
from hipsta_bids.group.inference import MapKey
from hipsta_bids.group.methods import methods_text
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.group.shapes import AverageShape
from hipsta_bids.group.tables import (
    COLUMNS,
    design_table,
    entity_label,
    map_name,
    point_tables,
    result_tables,
)
from hipsta_bids.group.template import templates_to_json
from hipsta_bids.io import files, gifti

# Writes the results of one model: all of them or none.


#: Folder of all models, in the output dataset.
GROUP_FOLDER = DATASET_FILES["group"]


@contextlib.contextmanager
def model_folder(root: Path, name: str) -> Iterator[Path]:
    """Give a folder to write into, which takes its name when all went well."""
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
    """Write a table and its sidecar."""
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
    """Write the unfolded sheet, on which maps of statistics can be drawn."""
    flat = np.zeros((len(x) * len(y), 3))
    flat[:, 0], flat[:, 1] = np.repeat(x, len(y)), np.tile(y, len(x))
    triangles = gifti.sheet_triangles(len(x), len(y))
    files.write_bytes(
        path,
        gifti.surface_bytes(flat, triangles, hemi=hemi, secondary="MidThickness", unfolded=True),
    )


# Writes maps of single participants' scores.


#: Participants per row group; bounds the memory.
_ROWS_OF_SCORES = 500


def write_score_maps(
    path: Path,
    table: pd.DataFrame,
    sides: Mapping[str, tuple[Int, Mapping[str, Float]]],
    x: Float,
    y: Float,
) -> None:
    """Write scores at all points as one Parquet file: one row per participant, side and node."""
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
                for start in range(0, len(rows), _ROWS_OF_SCORES):
                    part = slice(start, start + _ROWS_OF_SCORES)
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


# All analyzed maps as one Parquet file, the hand-over to R or Python.


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
    """Write all maps: one row per visit, hemisphere and point."""
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


def write_results(
    folder: Path,
    cohort: Cohort,
    analysis: Analysis,
    settings: GroupSettings,
    exclusions: Sequence[Exclusion],
    *,
    others: Mapping[str, tuple[Cohort, Analysis]],
    region: str = "body",
) -> None:
    """Write tables, maps and text."""
    for table in result_tables(cohort, analysis, settings):
        write_result_table(folder, table, COLUMNS)
    for name, other in others.items():
        for table in point_tables(name, *other, settings):
            write_result_table(folder, table, COLUMNS)
        _write_gifti(folder, *other)
        _write_scores(folder, *other)
    rows = pd.DataFrame(
        [
            {
                PARTICIPANT: one.participant,
                SESSION: one.session,
                "hemi": one.hemi,
                "reason": one.reason,
                "message": one.message,
            }
            for one in exclusions
        ],
        columns=[PARTICIPANT, SESSION, "hemi", "reason", "message"],
    )
    excluded = ResultTable(name="excluded", rows=rows)
    write_result_table(folder, excluded, COLUMNS)
    rows_of_model = analysis.compared.table.iloc[analysis.design.rows]
    write_plain_table(folder / "covariates.tsv", rows_of_model)
    write_plain_table(folder / "design.tsv", design_table(analysis))
    registered = {hemi: side.registered for hemi, side in analysis.sides.items()}
    if registered or others:
        points = {name: other for name, (other, _) in others.items()}
        write_maps(folder / "maps.parquet", cohort, registered, points)
    templates = {
        hemi: side.registration.template
        for hemi, side in analysis.sides.items()
        if side.registration.template is not None
    }
    if templates:
        files.write_json(folder / "template.json", templates_to_json(templates))
    _write_gifti(folder, cohort, analysis)
    _write_scores(folder, cohort, analysis)
    text = methods_text(
        cohort, analysis, settings, len(exclusions), others=tuple(others), region=region
    )
    files.write_text(folder / "methods.md", text)


def draw(
    folder: Path,
    cohort: Cohort,
    analysis: Analysis,
    shapes: Mapping[str, AverageShape],
    *,
    others: Mapping[str, tuple[Cohort, Analysis]],
) -> None:
    """Draw the figures."""
    for one in ((cohort, analysis, shapes), *((*one, {}) for one in others.values())):
        for drawing in draw_figures(*one):
            files.write_bytes(folder / "figures" / f"{drawing.name}.png", drawing.png)
            files.write_bytes(folder / "figures" / f"{drawing.name}.svg", drawing.svg)


def _write_gifti(folder: Path, cohort: Cohort, analysis: Analysis) -> None:
    """Write statistics, effect sizes and corrected p-values on the sheet."""
    for hemi, one in analysis.fitted.items():
        if one.maps.mesh is not None and hemi in cohort.sides:
            name = next(iter(one.fits))
            surface = folder / f"hemi-{hemi}_space-{name}_midthickness.surf.gii"
            mesh = one.maps.mesh
            content = gifti.surface_bytes(
                mesh.points,
                mesh.triangles.astype(np.int32),
                hemi=hemi,
                secondary=None,
                unfolded=True,
            )
            files.write_bytes(surface, content)
        elif hemi in cohort.sides:
            surface = folder / f"hemi-{hemi}_space-unfold_midthickness.surf.gii"
            write_sheet_surface(surface, cohort.x, cohort.y, hemi)
        for measure, fit in one.fits.items():
            for test in fit.tests:
                found = analysis.found[MapKey(measure, test.contrast.name, hemi)]
                single = test.kind == "t"
                for stat, values in (
                    (test.kind, test.statistic),
                    ("d", test.cohen_d) if single else ("eta2", test.eta_squared),
                    ("pcorrected", found.adjusted),
                ):
                    stem = map_name(hemi, measure, test.contrast.name).replace(
                        "_desc-", f"_stat-{stat}_desc-"
                    )
                    # Of both sides, maps lie on the left sheet: they say left minus right.
                    content = gifti.shape_bytes(values, hemi=hemi[0], name=stem, unit="1")
                    files.write_bytes(folder / f"{stem}.shape.gii", content)


def _write_scores(folder: Path, cohort: Cohort, analysis: Analysis) -> None:
    """Write each participant's w-scores as maps; those of the sheet also as one table."""
    scores, table = analysis.scores, analysis.compared.table
    if scores is None:
        return
    for hemi, side in scores.sides.items():
        names = [str(name) for name in table.index[side.rows]]
        for measure, found in side.scores.items():
            content = gifti.maps_bytes(found.w.T, hemi=hemi, names=names, series=False)
            name = f"hemi-{hemi}_stat-w_desc-{entity_label(measure)}_statmap.shape.gii"
            files.write_bytes(folder / name, content)
    if analysis.sides and scores.sides:
        maps = {
            hemi: (side.rows, {name: found.w for name, found in side.scores.items()})
            for hemi, side in scores.sides.items()
        }
        write_score_maps(folder / "wscores.parquet", table, maps, cohort.x, cohort.y)
