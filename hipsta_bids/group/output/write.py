"""Writes the results of one model, all or none: tables, maps, surfaces, figures and text."""

import contextlib
import gc
import logging
import os
import re
import shutil
import warnings
from collections import ChainMap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids.derivatives.analyses import GroupResults
from hipsta_bids.derivatives.names import DATASET_FILES
from hipsta_bids.group.cohort.collect import Exclusion
from hipsta_bids.group.cohort.data import SHEET, Cohort
from hipsta_bids.group.output import results, tables
from hipsta_bids.group.output.demographics import demographics_of
from hipsta_bids.group.output.figures import draw_figures
from hipsta_bids.group.output.methods import methods_text
from hipsta_bids.group.output.shapes import AverageShape
from hipsta_bids.group.output.steps import blocks, plan_blocks
from hipsta_bids.group.output.style import KINDS, Drawing, encode
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.io import files, gifti
from hipsta_bids.progress import tell
from hipsta_bids.stats.arrays import Float, return_memory
from hipsta_bids.stats.arrays import blocks as split_rows
from hipsta_bids.stats.glm import FittedMaps, PointTest
from hipsta_bids.stats.inference import Discoveries, MapKey
from hipsta_bids.types import FAMILY, PARTICIPANT, SESSION

_LOGGER = logging.getLogger(__name__)

#: Folder of all models, in the output dataset.
GROUP_FOLDER = DATASET_FILES["group"]
_ROWS = 10_000  # of tables that are spelled at once


@contextlib.contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Make a folder to write into, which is renamed to its final name if all succeeds."""
    parent, name = path.parent, path.name
    scratch = parent / f".{name}.{os.getpid()}.tmp"
    files.make_folder(parent)
    try:
        scratch.mkdir()
        try:
            yield scratch
            _replace(scratch, path)
        except BaseException:
            shutil.rmtree(scratch, ignore_errors=True)
            raise
        # What runs that were killed have left.
        for left in parent.glob(f".{name}.*.tmp"):
            shutil.rmtree(left, ignore_errors=True)
    except OSError as error:
        raise files.output_error(path, error) from error


def _replace(scratch: Path, final: Path) -> None:
    """Rename over an earlier folder, which cannot be done in one step."""
    old = final.with_name(f".{final.name}.old.{os.getpid()}.tmp")
    if final.exists():
        final.rename(old)
    scratch.rename(final)
    shutil.rmtree(old, ignore_errors=True)


def write_results(
    folder: Path,
    cohorts: Mapping[str, Cohort],
    analyses: Mapping[str, results.Analysis],
    settings: GroupSettings,
    exclusions: Sequence[Exclusion],
    *,
    averages: tables.Averages,
    region: str = "body",
    ratings: Mapping[str, int] | None = None,
    labels: Mapping[str, list[str]],
    sentences: Sequence[str] = (),
) -> None:
    """Write tables, maps and text; cohorts and analyses are by surface."""
    cohort, analysis = cohorts[SHEET], analyses[SHEET]
    meaning = dict(ChainMap(*plan_blocks("columns", analysis.request), dict(tables.COLUMNS)))
    for surface in cohorts:
        tables_of_surface = tables.result_tables(
            surface, cohorts[surface], analyses[surface], settings, averages
        )
        for name, table in tables_of_surface:
            described = tables.with_references(table, analysis)
            write_table(folder, name, described, meaning=meaning)
        _write_further(folder, surface, cohorts[surface], analyses[surface])
    if analysis.found:
        overview = tables.overview_table(analysis.found)
        write_table(folder, "maps", tables.with_references(overview, analysis))
    write_exclusions(folder, exclusions)
    rows_of_model = analysis.compared.table.iloc[analysis.design.rows]
    write_table(folder, "covariates", rows_of_model, described=False)
    people = demographics_of(cohort, analysis, settings)
    write_table(folder, "demographics", people, meaning=tables.DEMOGRAPHIC_COLUMNS)
    write_table(folder, "design", tables.design_table(analysis), described=False)
    registered = analysis.registered
    if (registered or len(cohorts) > 1) and can_write_parquet():
        from hipsta_bids.group.output import parquet  # noqa: PLC0415  (an optional extra)

        states = [cohort.sides, registered]
        if analysis.is_adjusted:
            states.append(analysis.cohort.sides)
        parquet.write_maps(folder / "maps.parquet", cohorts, states if registered else [])
    if templates := results.templates_of(analysis.registrations):
        files.write_json(folder / "template.json", templates)
    for surface, of_surface in analyses.items():
        _write_surfaces(folder, cohorts[surface], of_surface)
        tests = stats_of(results.tested_maps(of_surface))
        write_stats(folder, tests, _about_tests(of_surface, settings))
    for write in blocks("files", analysis.request, cohorts, analyses, labels, averages):
        write(folder)
    text = methods_text(
        cohort,
        analysis,
        settings,
        sum(exclusion.reason != "incomplete" for exclusion in exclusions),
        surfaces=[surface for surface in cohorts if surface != SHEET],
        sentences=sentences,
        region=region,
        ratings=ratings,
        demographics=people,
    )
    files.write_text(folder / "methods.md", text)


def _write_further(folder: Path, surface: str, cohort: Cohort, analysis: results.Analysis) -> None:
    """Write the tables of extensions about the maps of one surface."""
    prefix = f"{surface}_" if surface else ""
    for name, table, meaning in blocks("tables", analysis.request, cohort, analysis, prefix):
        write_table(folder, name, table, meaning=meaning)


def write_exclusions(folder: Path, exclusions: Sequence[Exclusion]) -> None:
    """Write who is not in the analysis, and why."""
    columns = {"participant": PARTICIPANT, "session": SESSION}
    excluded = pd.DataFrame(exclusions, columns=[*columns, "hemi", "reason", "message"])
    write_table(folder, "excluded", excluded.rename(columns=columns))


def draw(
    saved: GroupResults,
    cohorts: Mapping[str, Cohort],
    analyses: Mapping[str, results.Analysis],
    shapes: Mapping[str, AverageShape],
    *,
    prints: bool,
) -> list[str]:
    """Draw the figures of an analysis that was written, and return their problems."""
    drawings = draw_figures(saved, cohorts, analyses, shapes, prints)
    return write_figures(saved.folder, drawings, prints=prints)


def write_figures(
    folder: Path, drawings: Iterable[tuple[str, Drawing]], *, prints: bool = False
) -> list[str]:
    """Draw figures by name; return missing figures and missing letters, one line each.

    The page shows SVG; ``prints`` asks for PDF and PNG, too.
    """
    tell("figures")
    return_memory()
    problems, missing = [], set()
    gc.freeze()  # what is there need not be looked at whenever a figure's memory is taken back
    for number, (name, drawing) in enumerate(drawings, start=1):
        tell("figures", number)
        try:
            with warnings.catch_warnings(record=True) as warned:
                warnings.simplefilter("always")
                encoded = encode(name, drawing, KINDS if prints else ("svg",))
        except Exception as error:  # results are worth more than figures
            _LOGGER.exception("figure %s", name)
            problems.append(f"figure {name}: not drawn ({type(error).__name__}: {error})")
            continue
        for warning in warned:
            missing |= set(re.findall(r"^Glyph (\d+) ", str(warning.message)))
        for title, content in encoded:
            files.write_bytes(folder / "figures" / title, content)
        gc.collect()
    gc.unfreeze()
    if missing:
        letters = "".join(sorted(chr(int(number)) for number in missing))
        problems.append(f"figures: PDF and PNG show boxes for {letters}; SVG has them as text")
    return problems


def write_table(
    folder: Path,
    name: str,
    table: pd.DataFrame,
    *,
    described: bool = True,
    meaning: Mapping[str, str] = tables.COLUMNS,
) -> None:
    """Write a table, with a sidecar unless the columns are the user's or the model's."""
    columns = [str(column) for column in table.columns]
    lines = ["\t".join(columns)]
    for part in split_rows(len(table), _ROWS):
        rows = zip(*(_cells(values.iloc[part]) for _, values in table.items()), strict=True)
        lines += map("\t".join, rows)
    files.write_text(folder / f"{name}.tsv", "\n".join(lines) + "\n")
    if described:
        nodes = {
            column: f"registered coordinate of node {column.removeprefix('node_')}, 0..1"
            for column in columns
            if column.startswith("node_")
        }
        texts = {column: text for column in columns if (text := {**nodes, **meaning}.get(column))}
        sidecar = {column: {"Description": text} for column, text in texts.items()}
        files.write_json(folder / f"{name}.json", sidecar)


def _cells(values: pd.Series) -> list[str]:
    """Spell a column, numbers all at once."""
    numbers = values.to_numpy()
    if numbers.dtype.kind == "f" and len(numbers):
        text = "\t".join(["%.10g"] * len(numbers)) % tuple(numbers.tolist())
        return text.replace("nan", files.MISSING).split("\t")
    return [_cell(value) for value in values.tolist()]


def _cell(value: object) -> str:
    if isinstance(value, str):
        return " ".join(value.split()) or files.MISSING
    if isinstance(value, (bool, np.bool_)):
        return "true" if value else "false"
    if value is None or value is pd.NA or value != value:  # noqa: PLR0124 -- NaN is not itself
        return files.MISSING
    return format(value, ".10g") if isinstance(value, float) else str(value)


def _write_surfaces(folder: Path, cohort: Cohort, analysis: results.Analysis) -> None:
    """Write the surfaces to draw statistics on."""
    for hemi, fitted in analysis.fitted.items():
        if hemi in cohort.sides:
            write_surface(folder, cohort, fitted, hemi)


#: Maps of one contrast by the value of ``stat-``.
_Stats = dict[str, Float]


def stats_of(tested: Iterable[tuple[MapKey, PointTest, Discoveries]]) -> dict[MapKey, _Stats]:
    """Collect statistics, effect sizes and corrected p-values."""
    return {
        key: {
            test.kind: test.statistic,
            **({"d": test.cohen_d} if test.kind == "t" else {"eta2": test.eta_squared}),
            "pcorrected": discoveries.adjusted,
            **{stat: test.further[stat] for stat in _MAP_TYPES if stat in test.further},
        }
        for key, test, discoveries in tested
    }


#: ``StatMapType``, in the letters of NeuroVault, and description by the value of ``stat-``.
_MAP_TYPES = {
    "t": ("T", "t statistic"),
    "F": ("F", "F statistic"),
    "d": ("Other", "Cohen's d"),
    "eta2": ("Other", "partial eta squared"),
    "pcorrected": ("P", "p-value, corrected for the number of points"),
    "percent": ("Other", "difference in percent of the mean of the reference group"),
}
_About = Mapping[MapKey, Mapping[str, Any]]


def _about_tests(analysis: results.Analysis, settings: GroupSettings) -> _About:
    """Describe tests for the sidecars of their maps."""
    rules, about = settings.multiplicity, {}
    names = [*analysis.design.columns, *analysis.model.added_terms]
    for key, test, discoveries in results.tested_maps(analysis):
        fitted = np.isfinite(test.df)
        df, n = test.df[fitted], analysis.fitted[key.hemi].fits[key.measure].n[fitted]
        about[key] = {
            "Measure": key.measure,
            "Contrast": key.contrast,
            "ContrastWeights": dict(zip(names, test.contrast.weights.T.tolist(), strict=True)),
            "Model": analysis.model.text,
            "Mixed": analysis.comparison.sessions.is_repeated or bool(analysis.model.random),
            "DegreesOfFreedom": [float(df.min()), float(df.max())] if len(df) else None,
            "DegreesOfFreedomNumerator": test.contrast.n_rows if test.kind == "F" else None,
            "NumberOfParticipants": analysis.n_participants,
            "NumberOfRows": [int(n.min()), int(n.max())] if len(n) else None,
            "Correction": rules.method,
            "Level": discoveries.alpha,
            "Family": f"all points of equal {', '.join(FAMILY[rules.scope])}",
            "NumberOfTests": discoveries.n_tests,
        }
    return about


def write_stats(folder: Path, maps: Mapping[MapKey, _Stats], about: _About | None = None) -> None:
    """Write maps of statistics as GIFTI, with sidecars if described, and of both sides as CIFTI."""
    grouped: dict[str, dict[str, _Stats]] = {}
    for key, stats in maps.items():
        for stat, values in stats.items():
            stem = tables.map_name(key.hemi, key.measure, key.contrast)
            stem = stem.replace("_desc-", f"_stat-{stat}_desc-")
            # Left minus right, and both, lie on the left sheet; the name has no hemisphere.
            hemi = key.hemi if key.hemi in {"L", "R"} else "L"
            content = gifti.shape_bytes(values, hemi=hemi, name=stem, unit="1")
            files.write_bytes(folder / f"{stem}.shape.gii", content)
            if about is not None and key in about:
                words = dict(zip(("StatMapType", "Description"), _MAP_TYPES[stat], strict=True))
                files.write_json(folder / f"{stem}.json", words | dict(about[key]))
        if key.hemi in {"L", "R"}:
            name = tables.map_name("", key.measure, key.contrast)
            grouped.setdefault(name, {})[key.hemi] = stats
    for name, sides in grouped.items():
        names = list(next(iter(sides.values())))
        stacked = {hemi: np.stack([v[stat] for stat in names]) for hemi, v in sides.items()}
        files.write_bytes(folder / f"{name}.dscalar.nii", gifti.cifti_bytes(stacked, names))


def write_surface(folder: Path, cohort: Cohort, fitted: FittedMaps, hemi: str) -> None:
    """Write the unfolded sheet, or the surface of other programs' maps."""
    if fitted.maps.mesh is not None:
        space, secondary = next(iter(fitted.maps.maps)), None
        points, triangles = fitted.maps.mesh.points, fitted.maps.mesh.triangles.astype(np.int32)
    else:
        space, secondary = "unfold", "MidThickness"
        nx, ny = len(cohort.x), len(cohort.y)
        points = np.zeros((nx * ny, 3))
        points[:, 0], points[:, 1] = np.repeat(cohort.x, ny), np.tile(cohort.y, nx)
        triangles = gifti.sheet_triangles(nx, ny)
    flat = fitted.maps.mesh is None or fitted.maps.mesh.flat
    content = gifti.surface_bytes(points, triangles, hemi=hemi, secondary=secondary, unfolded=flat)
    files.write_bytes(folder / f"hemi-{hemi}_space-{space}_midthickness.surf.gii", content)


@cache
def can_write_parquet() -> bool:
    """Return whether pyarrow is installed; report once which files are missing without it."""
    possible = find_spec("pyarrow") is not None
    if not possible:
        _LOGGER.info(
            "Parquet files (maps.parquet and scores of participants) are not written: install"
            " pyarrow, or hipsta_bids with it: hipsta_bids[arrow]"
        )
    return possible
