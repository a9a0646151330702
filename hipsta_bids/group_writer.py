"""Writes all results of one model into its folder."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from hipsta_bids.bids import files, gifti, group_outputs
from hipsta_bids.bids.group_inputs import Exclusion
from hipsta_bids.bids.group_scores import write_score_maps
from hipsta_bids.bids.map_parquet import write_maps
from hipsta_bids.group.analysis import Analysis
from hipsta_bids.group.columns import COLUMNS
from hipsta_bids.group.figure_tables import design_table
from hipsta_bids.group.multiplicity import MapKey
from hipsta_bids.group.report import methods_text
from hipsta_bids.group.shapes import AverageShape
from hipsta_bids.group.tables import entity_label, map_name, point_tables, result_tables
from hipsta_bids.group.template_json import templates_to_json
from hipsta_bids.group_data import PARTICIPANT, SESSION, Cohort, ResultTable
from hipsta_bids.group_figures import draw_figures
from hipsta_bids.group_settings import GroupSettings


def write_results(
    folder: Path,
    cohort: Cohort,
    analysis: Analysis,
    settings: GroupSettings,
    exclusions: Sequence[Exclusion],
    *,
    others: Mapping[str, tuple[Cohort, Analysis]],
) -> None:
    """Write tables, maps and text.

    Parameters
    ----------
    folder : Path
        Where; see :func:`~hipsta_bids.bids.group_outputs.model_folder`.
    cohort : Cohort
        What was analyzed.
    analysis : Analysis
        Results.
    settings : GroupSettings
    exclusions : sequence of Exclusion
        Who was left out.
    others : mapping of str to (Cohort, Analysis)
        Maps that lie on surfaces of their own, by name.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    for table in result_tables(cohort, analysis, settings):
        group_outputs.write_result_table(folder, table, COLUMNS)
    for name, other in others.items():
        for table in point_tables(name, *other, settings):
            group_outputs.write_result_table(folder, table, COLUMNS)
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
    group_outputs.write_result_table(folder, excluded, COLUMNS)
    rows_of_model = analysis.compared.table.iloc[analysis.design.rows]
    group_outputs.write_plain_table(folder / "covariates.tsv", rows_of_model)
    group_outputs.write_plain_table(folder / "design.tsv", design_table(analysis))
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
    text = methods_text(cohort, analysis, settings, len(exclusions), tuple(others))
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
            group_outputs.write_sheet_surface(surface, cohort.x, cohort.y, hemi)
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
