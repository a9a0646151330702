"""The group level from files to files."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids.bids import derivative, files, group_outputs
from hipsta_bids.bids.covariates import read_covariates, read_icv
from hipsta_bids.bids.group_inputs import Exclusion, collect_sheets
from hipsta_bids.bids.measure_names import check_summaries, choose_measures
from hipsta_bids.bids.sheets import Measured, read_sheets
from hipsta_bids.bids.volume_join import add_volumes, check_volumes
from hipsta_bids.errors import ModelError
from hipsta_bids.group.analysis import Analysis, analyze_cohort
from hipsta_bids.group.comparison import Comparison, choose_visits
from hipsta_bids.group.model_spec import parse_model
from hipsta_bids.group.template_json import templates_from_json
from hipsta_bids.group.visit_time import VisitTime, add_time
from hipsta_bids.group_data import PARTICIPANT, SESSION, Cohort
from hipsta_bids.group_model import choose_references, folder_name, model_document, wanted_measures
from hipsta_bids.group_record import GroupOptions, notes_of, record_of
from hipsta_bids.group_settings import GroupSettings
from hipsta_bids.group_shapes import average_shapes, write_shapes
from hipsta_bids.group_writer import draw, write_results

#: Column that takes the intracranial volume estimated by the segmentation's program.
_ICV = "icv"


@dataclass(frozen=True, kw_only=True)
class GroupResult:
    """What was done."""

    folder: Path
    n_participants: int
    """In the model."""
    n_excluded: int
    """Hemispheres and visits."""
    notes: tuple[str, ...]
    """What to know, one line each."""


def run_group(options: GroupOptions, settings: GroupSettings) -> GroupResult:
    """Collect sheets and covariates, analyze them, and write all results or none.

    Parameters
    ----------
    options : GroupOptions
        Files, model.
    settings : GroupSettings
        What changes results.

    Returns
    -------
    GroupResult

    Raises
    ------
    HipstaError
        If inputs, model or output folder do not allow it.
    """
    derivative.check_not_foreign(options.out_dir)
    found = collect_sheets(options.sheets)
    wanted = wanted_measures(options.model, options.measures)
    measures = choose_measures(wanted, found.records)
    check_volumes(options.volumes)
    measured = read_sheets(found.records, found.settings, measures.maps)
    measured, volume_notes = add_volumes(measured, found.records, options.volumes, options.bids_dir)
    check_summaries(measures, measured.sides)
    cohort, reasons = choose_visits(_cohort(measured, options), options.comparison)
    cohort, icv = _with_icv(cohort, measured, settings)
    cohort, visits = _with_time(cohort, options.comparison, settings)
    references, groups = choose_references(options.model, cohort.table, settings)
    document = model_document(
        options.model,
        cohort.table,
        groups,
        settings,
        comparison=options.comparison,
        visits=visits,
    )
    model = parse_model(document)
    templates = None
    if options.template is not None:
        templates = templates_from_json(files.read_json(options.template), str(options.template))
        _check_templates(templates, cohort, options.template)
    analysis = analyze_cohort(
        cohort,
        model,
        groups,
        settings,
        measures=measures,
        references=references,
        comparison=options.comparison,
        time=visits.column if visits else None,
        icv=icv,
        templates=templates,
    )
    later = _other_visits(measured, reasons, options.comparison)
    exclusions = [*found.exclusions, *later, *_incomplete(analysis)]
    name = options.model.name or folder_name(model.formula, wanted) + options.comparison.suffix
    notes = volume_notes + notes_of(found, analysis, n_other_visits=len(later))
    shapes = average_shapes(found.records, cohort, analysis, settings)
    files.make_folder(options.out_dir)
    if not (options.out_dir / "dataset_description.json").exists():
        roots = derivative.source_names((root.name, root) for root in options.sheets.roots)
        derivative.write_description(options.out_dir, roots)
    with group_outputs.model_folder(options.out_dir, name) as folder:
        write_results(folder, cohort, analysis, settings, exclusions)
        files.write_json(folder / "model.json", document)
        write_shapes(folder, shapes)
        if analysis.sides and not shapes:
            notes.append("no average surfaces: those of the participant level are missing")
        notes += draw(folder, cohort, analysis, shapes)
        record = record_of(options, found, settings, analysis, notes)
        files.write_json(folder / "analysis.json", record)
    return GroupResult(
        folder=options.out_dir / group_outputs.GROUP_FOLDER / name,
        n_participants=analysis.n_participants,
        n_excluded=len(exclusions),
        notes=tuple(notes),
    )


def _cohort(measured: Measured, options: GroupOptions) -> Cohort:
    return Cohort(
        table=read_covariates(measured.visits, options.bids_dir, options.covariates),
        sides=measured.sides,
        x=measured.x,
        y=measured.y,
        units=measured.units,
    )


def _other_visits(
    measured: Measured, reasons: Mapping[str, str], comparison: Comparison
) -> list[Exclusion]:
    """List the sessions that are not compared."""
    return [
        Exclusion(
            participant=row[PARTICIPANT],
            session=row[SESSION],
            hemi=files.MISSING,
            reason="other-session" if comparison.pair else "later-session",
            message=message,
        )
        for visit, message in reasons.items()
        for row in measured.visits.loc[[visit]].to_dict("records")
    ]


def _with_time(
    cohort: Cohort, comparison: Comparison, settings: GroupSettings
) -> tuple[Cohort, VisitTime | None]:
    """Add the time of visits, if it is needed."""
    if not comparison.longitudinal:
        return cohort, None
    visits = add_time(cohort.table, settings)
    return replace(cohort, table=visits.table), visits


def _with_icv(
    cohort: Cohort, measured: Measured, settings: GroupSettings
) -> tuple[Cohort, str | None]:
    """Find the column of intracranial volume, or make one from what the programs estimated."""
    by_name = {str(column).casefold(): str(column) for column in cohort.table.columns}
    for name in settings.model.icv_columns:
        if name in by_name:
            return cohort, by_name[name]
    row_of = {name: row for row, name in enumerate(measured.visits.index)}
    rows = [row_of[name] for name in cohort.table.index]
    volumes = read_icv([measured.sources[i] for i in rows], [measured.roots[i] for i in rows])
    if all(volume is None for volume in volumes):
        return cohort, None
    table = cohort.table.assign(**{_ICV: pd.array(volumes, dtype=np.float64)})
    return replace(cohort, table=table), _ICV


def _check_templates(templates: Mapping[str, Any], cohort: Cohort, path: Path) -> None:
    if missing := sorted(set(cohort.sides) - set(templates)):
        raise ModelError(
            f"{path}: has no template of hemisphere {', '.join(missing)}", reason="template-file"
        )


def _incomplete(analysis: Analysis) -> list[Exclusion]:
    """Visits that lack a variable of the model."""
    result = []
    for variable, visits in analysis.design.dropped.items():
        for visit in visits:
            row = analysis.compared.table.loc[[visit], [PARTICIPANT, SESSION]].to_dict("records")[0]
            result.append(
                Exclusion(
                    participant=row[PARTICIPANT],
                    session=row[SESSION],
                    hemi=files.MISSING,
                    reason="incomplete",
                    message=f"{variable} is missing",
                )
            )
    return result
