"""Comparisons of groups, from files to files."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pandas as pd

from hipsta_bids.derivatives import dataset
from hipsta_bids.derivatives.analyses import GroupResults
from hipsta_bids.errors import ModelError
from hipsta_bids.group import model as modeling
from hipsta_bids.group.cohort import collect
from hipsta_bids.group.cohort.data import SHEET
from hipsta_bids.group.cohort.quality import quality_notes, quality_table
from hipsta_bids.group.output.results import Analysis
from hipsta_bids.group.output.shapes import average_shapes, write_shapes
from hipsta_bids.group.output.steps import blocks, extend_surfaces, plan_blocks, plan_steps
from hipsta_bids.group.output.write import draw, write_results, write_table
from hipsta_bids.group.questions import study as studies
from hipsta_bids.group.questions.analysis import analyze_cohort, analyze_points
from hipsta_bids.group.questions.mixing import with_mixes
from hipsta_bids.group.questions.notes import notes_of
from hipsta_bids.group.request import Request
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.io import files
from hipsta_bids.joints import Writer, find_steps, fitted_contrasts, load, load_all
from hipsta_bids.progress import tell
from hipsta_bids.protocols.toml import resolve
from hipsta_bids.stats.formula import folder_name
from hipsta_bids.stats.grammar import closed_formula
from hipsta_bids.types import PARTICIPANT


def run_group(options: studies.GroupOptions, settings: GroupSettings) -> studies.GroupResult:
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
    dataset.check_own_dataset(options.out_dir)
    return studies.with_page(options, _analyze(options, settings))


def _analyze(options: studies.GroupOptions, settings: GroupSettings) -> studies.GroupResult:
    """Analyze and write all but the page, for which the memory that it takes is free again."""
    study = studies.read_study(options, settings).with_alignment()
    document, request = _request(study)
    study = _with_labels(study, request)
    templates = studies.read_templates(options.template, study.cohort)
    analysis = analyze_cohort(replace(request, templates=templates))
    analyses = {
        surface: analysis if surface == SHEET else analyze_points(cohort, analysis)
        for surface, cohort in study.cohorts.items()
    }
    discoveries = {key: test for part in analyses.values() for key, test in part.found.items()}
    analyses[SHEET] = replace(analysis, found=discoveries)
    return _write(study, extend_surfaces(analyses), document=document)


def _request(study: studies.Study) -> tuple[Mapping[str, Any], Request]:
    """Choose the model, as a document and as what the line is asked."""
    options, cohort = study.options, study.cohort
    document, model, groups, references = modeling.choose_model(
        replace(options.model, contrasts=fitted_contrasts(options.model.contrasts)),
        cohort.table,
        study.settings,
        comparison=options.comparison,
        visits=study.time,
        summaries={str(name) for side in cohort.sides.values() for name in side.summary.columns},
    )
    if model.summaries and len(study.cohorts) > 1:
        raise ModelError(
            f"{model.summaries[0]} in the formula: maps of other programs have no summary measures;"
            " remove one"
        )
    request = Request(
        cohort=cohort,
        model=model,
        groups=groups,
        settings=study.settings,
        measures=study.measures,
        surfaces=[name for name in study.cohorts if name != SHEET],
        references=references,
        comparison=options.comparison,
        time=study.time.column if study.time else None,
        icv=study.icv,
        contrasts=options.model.contrasts,
        options=options.further,
    )
    return document, plan_steps(request)


def _with_labels(study: studies.Study, request: Request) -> studies.Study:
    """Find in what labels differ, also from those that plans of extensions rest on."""
    rows = request.table if request.comparison.sessions.later else request.cohort.table
    source: tuple[str, Mapping[str, Sequence[str]]]
    source = next(plan_blocks("source", request), ("", {}))
    names = [*closed_formula(request.model.formula).names, request.model.random]
    return with_mixes(study, rows, names, source=source)


def _write(
    study: studies.Study,
    analyses: Mapping[str, Analysis],
    *,
    document: Mapping[str, Any],
) -> studies.GroupResult:
    """Write the results of all surfaces."""
    options, settings, cohort = study.options, study.settings, study.cohort
    analysis, groups = analyses[SHEET], analyses[SHEET].groups
    table = analysis.compared.table
    incomplete = study.incomplete(analysis.design.dropped, table[PARTICIPANT])
    exclusions = [*study.exclusions, *collect.exclude_visits(table, incomplete)]
    quality = quality_table(study.quality, groups.column) if groups else pd.DataFrame()
    notes = [*study.notes, *notes_of(study, analysis), *quality_notes(quality)]
    notes += [remark(cohort.table, groups.column if groups else None) for remark in study.remarks]
    writers, notes_of_parts = _parts(study, analysis)
    notes += notes_of_parts
    tell("average surfaces")
    shapes = average_shapes(study.collection.records, cohort, analysis, settings.shapes)
    # One is enough from here on, and all may take much memory.
    study = replace(
        study, collection=replace(study.collection, records=study.collection.records[:1])
    )

    def fill(folder: Path) -> dict[str, Any]:
        write_results(
            folder,
            study.cohorts,
            analyses,
            settings,
            exclusions,
            averages={hemi: shape.middle.points for hemi, shape in shapes.items()},
            region=options.sheets.region,
            ratings=study.collection.ratings,
            labels=study.labels,
            sentences=study.sentences(),
        )
        files.write_json(folder / "model.json", document)
        if len(quality):
            write_table(folder, "quality", quality)
        for write_part in writers:
            write_part(folder)
        write_shapes(folder, shapes)
        if analysis.registered and study.collection.records and not shapes:
            notes.append("no average surfaces: the surfaces of the participant level are missing")
        record = _record(analysis, study.collection.ratings)
        inputs = options.record_of_sources
        saved_record = {**record, "inputs": inputs, "settings": resolve(settings)}
        saved = GroupResults(folder=folder, record=saved_record)
        notes.extend(draw(saved, study.cohorts, analyses, shapes, prints=options.figures))
        return record

    measures = modeling.wanted_measures(options.model, options.measures)
    return study.write_folder(
        folder_name(analysis.model.text, measures) + options.comparison.sessions.suffix,
        notes=notes,
        counts=(analysis.n_participants, len(exclusions)),
        fill=fill,
    )


def _parts(study: studies.Study, analysis: Analysis) -> tuple[list[Writer], list[str]]:
    """Make what extensions add, and the parts that their options ask for; with notes."""
    pairs = [make(study, analysis) for make in load_all("addition")]
    pairs += [load(part.make)(study, analysis, value) for part, value in study.options.parts]
    return [writer for writer, _ in pairs], [note for _, notes in pairs for note in notes]


def _record(analysis: Analysis, ratings: Mapping[str, int] | None) -> dict[str, Any]:
    """Record what was fitted to what."""
    steps, options, compared = find_steps(), analysis.request.options, analysis.comparison
    choices = {name: options.get(name) for step in steps for name in step.comparison}
    return {
        **{key: None for step in steps for key in step.records},
        **dict(blocks("record", analysis.request, analysis)),
        "measures": {"maps": analysis.measured.maps, "summaries": analysis.measured.summaries},
        "formula": analysis.model.text,
        "columns": analysis.design.columns,
        "references": analysis.design.references,
        "contrasts": {c.name: c.weights.tolist() for c in analysis.design.contrasts},
        "one_sided": {c.name: c.hypothesis for c in analysis.design.contrasts if c.side},
        "comparison": {**compared.sessions.record(), "asymmetry": compared.asymmetry, **choices},
        "groups": None if analysis.groups is None else asdict(analysis.groups),
        "participants": analysis.n_participants,
        "rows": len(analysis.design.rows),
        "ratings": ratings,
        "hemispheres": {hemi: len(maps.used) for hemi, maps in analysis.fitted.items()},
    }
