"""Comparisons of groups, from files to files."""

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pandas as pd

from hipsta_bids.derivatives import dataset
from hipsta_bids.derivatives.analyses import GroupResults
from hipsta_bids.group import model as modeling
from hipsta_bids.group.cohort import collect
from hipsta_bids.group.cohort.data import SHEET, modeled_table
from hipsta_bids.group.cohort.masks import mask_note
from hipsta_bids.group.cohort.quality import quality_notes, quality_table
from hipsta_bids.group.output.results import Analysis, harmonization_record
from hipsta_bids.group.output.saved import load_effects
from hipsta_bids.group.output.shapes import average_shapes, write_shapes
from hipsta_bids.group.output.tables import opposite_notes
from hipsta_bids.group.output.write import draw, write_results, write_table
from hipsta_bids.group.questions import analysis as fitting
from hipsta_bids.group.questions import study as studies
from hipsta_bids.group.questions.mixing import with_mixes
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.io import files
from hipsta_bids.joints import Writer, load, load_all
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
    settings = study.settings
    fitting.check_joint(study.maps, options.comparison, settings)
    cohort = study.cohort
    document, model, groups, references = modeling.choose_model(
        options.model,
        cohort.table,
        settings,
        comparison=options.comparison,
        visits=study.time,
    )
    table = modeled_table(cohort.table, options.comparison)
    effects = load_effects(options.harmonize_model) if options.harmonize_model else None
    source = (effects.file, effects.labels) if effects else ("", {})
    mixed = cohort.table if options.comparison.adjusted else table
    study = with_mixes(study, mixed, closed_formula(model.formula).names, source=source)
    templates = studies.read_templates(options.template, cohort)
    analysis = fitting.analyze_cohort(
        cohort,
        model,
        groups,
        settings,
        measures=study.measures,
        references=references,
        comparison=options.comparison,
        time=study.time.column if study.time else None,
        icv=study.icv,
        templates=templates,
        site_effects=effects,
    )
    analyses = {
        surface: analysis
        if surface == SHEET
        else fitting.analyze_points(study.cohorts[surface], analysis, settings)
        for surface in study.cohorts
    }
    joint = fitting.combine_maps(list(analyses.values()), settings)
    discoveries = {key: test for one in analyses.values() for key, test in one.found.items()}
    discoveries |= {key: one.found for key, one in joint.items()}
    tested = tuple(joint.values())
    analysis = analyses[SHEET] = replace(analysis, found=discoveries)
    table = analysis.compared.table
    incomplete = study.incomplete(analysis.design.dropped, table[PARTICIPANT])
    exclusions = [*study.exclusions, *collect.exclude_visits(table, incomplete)]
    measures = modeling.wanted_measures(options.model, options.measures)
    notes = [*study.notes, *_notes(study, analysis)]
    quality = quality_table(study.quality, groups.column) if groups else pd.DataFrame()
    notes += quality_notes(quality)
    if study.masked is not None:
        shares = study.masked[study.masked["visit"].isin(cohort.table.index)]
        notes.append(mask_note(shares, cohort.table[groups.column] if groups else None))
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
            averages={hemi: one.middle.points for hemi, one in shapes.items()},
            joint=tested,
            region=options.sheets.region,
            ratings=study.collection.ratings,
            labels=study.labels,
            cropped=[
                name
                for name, pattern in options.maps
                if options.maps_crop and name in study.maps and not pattern.endswith(".tsv")
            ],
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
        saved = GroupResults(
            folder=folder,
            record={
                **record,
                "inputs": {"maps": dict(options.maps)},
                "settings": resolve(settings),
            },
        )
        notes.extend(draw(saved, study.cohorts, analyses, shapes, prints=options.figures))
        return record

    return study.write_folder(
        folder_name(model.formula, measures) + options.comparison.suffix,
        notes=notes,
        counts=(analysis.n_participants, len(exclusions)),
        fill=fill,
    )


def _parts(study: studies.Study, analysis: Analysis) -> tuple[list[Writer], list[str]]:
    """Make what extensions add, and the parts that their options ask for; with notes."""
    pairs = [make(study, analysis) for make in load_all("addition")]
    pairs += [load(part.make)(study, analysis, value) for part, value in study.options.parts]
    return [writer for writer, _ in pairs], [note for _, notes in pairs for note in notes]


def _notes(study: studies.Study, analysis: Analysis) -> list[str]:
    """List what a reader of the results should know, one line each."""
    options, settings, notes = study.options, study.settings, list(analysis.skipped)
    time = study.time.column if study.time else None
    notes += [note for name, note in analysis.design.notes.items() if name != time]
    if options.model.formula is None and options.model.file is None:
        notes += [
            f"{name} is n/a for all, and not in the model; fill it in: {name} may explain "
            "differences"
            for name in modeling.empty_covariates(study.cohort.table, settings)
        ]
    if n_later := sum(one.reason == "later-session" for one in study.exclusions):
        notes.append(
            f"{n_later} later sessions are not in it; --longitudinal takes all, --paired two"
        )
    if doubtful := sum(record.doubtful for record in study.collection.records):
        notes.append(
            f"{doubtful} hemispheres to look at first are included without a rating; exclude "
            "them with --exclude-look"
        )
    if separated := sum(one.columns["separated"] for *_, one in analysis.pairs):
        notes.append(
            f"{separated} of {len(analysis.pairs)} comparisons of classifiers are separated, and"
            " fitted by Firth's method"
        )
    for key, discoveries in analysis.found.items():
        if discoveries.lenient:
            notes.append(
                f"{key.measure}, {key.contrast}, {key.hemi}: p up to {discoveries.cutoff:.3g}"
                " survives, above the level; effects are widespread"
            )
    notes += fitting.unequal_spread(analysis, settings.glm)
    notes += opposite_notes(study.cohort, analysis, settings)
    for hemi, registration in analysis.registrations.items():
        if not registration.converged:
            notes.append(f"hemisphere {hemi}: registration had not settled when it ended")
        if n_extreme := int(registration.extreme.sum()):
            notes.append(f"hemisphere {hemi}: extreme warps: {n_extreme}, see warps.tsv")
    return notes


def _record(analysis: Analysis, ratings: Mapping[str, int] | None) -> dict[str, Any]:
    """Record what was fitted to what."""
    return {
        "harmonization": None
        if analysis.harmonization is None
        else harmonization_record(analysis.harmonization, analysis.groups),
        "measures": {"maps": analysis.measured.maps, "summaries": analysis.measured.summaries},
        "formula": analysis.model.text,
        "columns": analysis.design.columns,
        "references": analysis.design.references,
        "contrasts": {c.name: c.weights.tolist() for c in analysis.design.contrasts},
        "one_sided": {c.name: c.hypothesis for c in analysis.design.contrasts if c.side},
        "comparison": asdict(analysis.comparison),
        "groups": None if analysis.groups is None else asdict(analysis.groups),
        "participants": analysis.n_participants,
        "rows": len(analysis.design.rows),
        "ratings": ratings,
        "hemispheres": {hemi: len(one.used) for hemi, one in analysis.fitted.items()},
    }
