"""The group level from files to files."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hipsta_bids.bids import derivative, files, group_outputs
from hipsta_bids.bids.group_inputs import Exclusion
from hipsta_bids.bids.names import group_report
from hipsta_bids.errors import ModelError
from hipsta_bids.group.analysis import Analysis, analyze_cohort, analyze_points
from hipsta_bids.group.model_spec import parse_model
from hipsta_bids.group.template_json import templates_from_json
from hipsta_bids.group_data import PARTICIPANT, SESSION, Cohort
from hipsta_bids.group_model import choose_references, folder_name, model_document
from hipsta_bids.group_reading import read_inputs
from hipsta_bids.group_record import GroupOptions, notes_of, record_of
from hipsta_bids.group_settings import GroupSettings
from hipsta_bids.group_shapes import average_shapes, write_shapes
from hipsta_bids.group_writer import draw, write_results
from hipsta_bids.reporting import write_group_report


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
    page: Path | None
    """To look at; ``None`` if there is none."""
    problem: str | None = None
    """Why the page could not be made."""


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
    read = read_inputs(options, settings)
    cohort = read.cohort
    references, groups = choose_references(options.model, cohort.table, settings)
    document = model_document(
        options.model,
        cohort.table,
        groups,
        settings,
        comparison=options.comparison,
        visits=read.time,
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
        measures=read.measures,
        references=references,
        comparison=options.comparison,
        time=read.time.column if read.time else None,
        icv=read.icv,
        templates=templates,
    )
    others = {
        name: (other, analyze_points(other, analysis, settings))
        for name, other in read.others.items()
    }
    found = dict(analysis.found)
    for _, other in others.values():
        found |= other.found
    analysis = replace(analysis, found=found)
    exclusions = [*read.exclusions, *_incomplete(analysis)]
    name = options.model.name
    name = name or folder_name(model.formula, read.wanted) + options.comparison.suffix
    notes = [*read.notes, *notes_of(read.found, analysis, n_other_visits=read.n_other_visits)]
    shapes = average_shapes(read.found.records, cohort, analysis, settings)
    _describe(options)
    with group_outputs.model_folder(options.out_dir, name) as folder:
        write_results(folder, cohort, analysis, settings, exclusions, others=others)
        files.write_json(folder / "model.json", document)
        write_shapes(folder, shapes)
        if analysis.sides and read.found.records and not shapes:
            notes.append("no average surfaces: those of the participant level are missing")
        draw(folder, cohort, analysis, shapes, others=others)
        record = record_of(options, read.found, settings, analysis, notes)
        files.write_json(folder / "analysis.json", record)
    page, problem = _report(options, name)
    return GroupResult(
        folder=options.out_dir / group_outputs.GROUP_FOLDER / name,
        page=page,
        problem=problem,
        n_participants=analysis.n_participants,
        n_excluded=len(exclusions),
        notes=tuple(notes),
    )


def _report(options: GroupOptions, name: str) -> tuple[Path | None, str | None]:
    """Make the page, and say why if it is not there."""
    path = options.out_dir / group_report(name)
    if not options.reports:
        files.remove([path])  # it would be that of an earlier analysis of this name
        return None, None
    problem = write_group_report(options.out_dir, name)
    return (path if problem is None else None), problem


def _describe(options: GroupOptions) -> None:
    """Describe the output dataset, if the participant level has not."""
    files.make_folder(options.out_dir)
    if not (options.out_dir / "dataset_description.json").exists():
        roots = [root for root in options.sheets.roots if root != options.out_dir]
        roots += [options.bids_dir] if options.maps else []
        names = derivative.source_names((root.resolve().name, root) for root in roots)
        derivative.write_description(options.out_dir, names)


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
