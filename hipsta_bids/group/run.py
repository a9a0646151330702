"""The group level from files to files."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from hipsta_bids import __version__
from hipsta_bids.derivatives import dataset
from hipsta_bids.derivatives.names import group_report
from hipsta_bids.errors import InputError, ModelError
from hipsta_bids.group import write
from hipsta_bids.group.analysis import Analysis, analyze_cohort, analyze_points, unequal_spread
from hipsta_bids.group.collect import (
    Collection,
    Exclusion,
    GroupRequest,
    collect_sheets,
    exclude_visits,
    wanted_by,
)
from hipsta_bids.group.combat import load_effects
from hipsta_bids.group.comparison import Comparison, choose_visits
from hipsta_bids.group.covariates import VisitTime, add_icv, add_time, read_covariates
from hipsta_bids.group.data import Cohort, Measures
from hipsta_bids.group.exchange import SUMMARY, summarize, write_summary
from hipsta_bids.group.formula import parse_model, with_factors
from hipsta_bids.group.harmonize import harmonization_record
from hipsta_bids.group.joint import check_joint, combine_maps
from hipsta_bids.group.model import (
    ModelRequest,
    choose_references,
    empty_covariates,
    folder_name,
    model_document,
    wanted_measures,
)
from hipsta_bids.group.read import (
    Measured,
    check_summaries,
    choose_measures,
    read_sheets,
    visits_of,
)
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.group.shapes import average_shapes, write_shapes
from hipsta_bids.group.surfaces import (
    ExternalCohorts,
    MapPattern,
    add_external,
    find_all,
    map_patterns,
    taken_names,
)
from hipsta_bids.group.volumes import add_volumes, check_volumes
from hipsta_bids.group.warps import Template, templates_from_json
from hipsta_bids.group.write import draw, write_results
from hipsta_bids.io import files
from hipsta_bids.progress import tell
from hipsta_bids.protocols.toml import resolve
from hipsta_bids.reports.group import write_group_report

#: Hemispheres that notes name.
_SHOWN = 4


@dataclass(frozen=True, kw_only=True)
class GroupOptions:
    """What the user asked for."""

    bids_dir: Path
    out_dir: Path
    sheets: GroupRequest
    model: ModelRequest
    covariates: tuple[Path, ...] = ()
    maps: tuple[tuple[str, str], ...] = ()
    """Names and patterns of other programs' maps."""
    surfaces: tuple[tuple[str | None, str], ...] = ()
    """Patterns of the surfaces to draw these on, for one or for all."""
    volumes: tuple[tuple[str, str], ...] = ()
    """Names and patterns of other programs' tables of volumes."""
    measures: tuple[str, ...] = ()
    """What to fit the model to; empty for the default or the formula's left-hand side."""
    template: Path | None = None
    harmonize_model: Path | None = None
    """Parameters of the harmonization of another analysis."""
    comparison: Comparison = field(default_factory=Comparison)
    export_summary: str | None = None
    """Name of this site in a summary for others, empty for that of the folder; ``None`` for no
    summary."""
    reports: bool = True
    """Whether a page is made."""
    command: tuple[str, ...] = ()
    """The command line, for the record."""


@dataclass(frozen=True, eq=False, kw_only=True)
class GroupInputs:
    """What was read."""

    found: Collection
    """Hemispheres that were measured."""
    cohort: Cohort
    """Visits that are compared, with covariates and sheets."""
    others: Mapping[str, Cohort]
    """The same visits with other programs' maps, by the names of these."""
    measures: Measures
    """Measures of the sheets."""
    icv: str | None
    """Column of intracranial volume."""
    time: VisitTime | None
    exclusions: tuple[Exclusion, ...]
    """Of hemispheres, and of sessions that are not compared."""
    notes: tuple[str, ...]
    """What to know, one line each."""


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
    warnings: tuple[str, ...]
    """What may make results wrong, one line each."""
    page: Path | None = None
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
    dataset.check_own_dataset(options.out_dir)
    return with_page(options, _analyze(options, settings))


def _analyze(options: GroupOptions, settings: GroupSettings) -> GroupResult:
    """Analyze and write all but the page, for which the memory that it takes is free again."""
    tell("reading")
    inputs = read_inputs(options, settings)
    check_joint([*inputs.measures.maps, *inputs.others], options.comparison, settings)
    cohort = inputs.cohort
    references, groups = choose_references(options.model, cohort.table, settings)
    document = model_document(
        options.model,
        cohort.table,
        groups,
        settings,
        comparison=options.comparison,
        visits=inputs.time,
    )
    model = parse_model(document)
    templates = read_templates(options.template, cohort)
    analysis = analyze_cohort(
        cohort,
        model,
        groups,
        settings,
        measures=inputs.measures,
        references=references,
        comparison=options.comparison,
        time=inputs.time.column if inputs.time else None,
        icv=inputs.icv,
        templates=templates,
        site_effects=load_effects(options.harmonize_model) if options.harmonize_model else None,
    )
    others = {
        name: (other, analyze_points(other, analysis, settings))
        for name, other in inputs.others.items()
    }
    found = dict(analysis.found)
    for _, other in others.values():
        found |= other.found
    joint = combine_maps([analysis, *(other for _, other in others.values())], settings)
    found |= {key: one.found for key, one in joint.items()}
    tested = tuple(joint.values())
    analysis = replace(analysis, found=found)
    exclusions = [*inputs.exclusions, *_incomplete(analysis)]
    wanted = wanted_measures(options.model, options.measures)
    notes = [*inputs.notes, *_notes(options, inputs, analysis, settings)]
    summary = _summary(options, inputs, analysis, settings, notes)
    tell("average surfaces")
    shapes = average_shapes(inputs.found.records, cohort, analysis, settings)
    # One is enough from here on, and all may take much memory.
    inputs = replace(inputs, found=replace(inputs.found, records=inputs.found.records[:1]))

    def fill(folder: Path) -> dict[str, Any]:
        write_results(
            folder,
            cohort,
            analysis,
            settings,
            exclusions,
            others=others,
            joint=tested,
            region=options.sheets.region,
            ratings=inputs.found.ratings,
        )
        files.write_json(folder / "model.json", document)
        if summary is not None:
            write_summary(folder / SUMMARY, summary)
        write_shapes(folder, shapes)
        if analysis.sides and inputs.found.records and not shapes:
            notes.append("no average surfaces: those of the participant level are missing")
        notes.extend(draw(folder, cohort, analysis, shapes, others=others, joint=tested))
        return _record(analysis, inputs.found.ratings)

    return write_folder(
        options,
        folder_name(model.formula, wanted) + options.comparison.suffix,
        inputs,
        settings,
        notes=notes,
        counts=(analysis.n_participants, len(exclusions)),
        fill=fill,
    )


def write_folder(
    options: GroupOptions,
    name: str,
    inputs: GroupInputs,
    settings: GroupSettings,
    *,
    notes: list[str],
    counts: tuple[int, int],
    fill: Callable[[Path], Mapping[str, Any]],
) -> GroupResult:
    """Write all results or none.

    ``fill`` writes into the folder, adds to the notes, and returns what is recorded; ``counts`` are
    of participants and of what is left out.
    """
    found, region = inputs.found, options.sheets.region
    name = options.model.name or (name if region == "body" else f"{name}_{region}")
    _describe_dataset(options)
    with write.model_folder(options.out_dir, name) as folder:
        tell("tables and maps")
        record = {
            "command": list(options.command),
            "version": __version__,
            "inputs": {
                "datasets": [str(root.resolve()) for root in options.sheets.roots],
                "settings_hash": found.settings_hash,
                "versions": found.versions,
                "seg": found.records[0].place.name.seg if found.records else None,
                "region": region,
                "maps": dict(options.maps),
                "volumes": dict(options.volumes),
                "covariates": [str(path) for path in options.covariates],
                "template": options.template and str(options.template),
                "harmonization": options.harmonize_model and str(options.harmonize_model),
            },
            **fill(folder),
            "notes": [*found.warnings, *notes],
            "settings": resolve(settings),
        }
        files.write_json(folder / "analysis.json", record)
    return GroupResult(
        folder=options.out_dir / write.GROUP_FOLDER / name,
        n_participants=counts[0],
        n_excluded=counts[1],
        notes=tuple(notes),
        warnings=found.warnings,
    )


def _summary(
    options: GroupOptions,
    inputs: GroupInputs,
    analysis: Analysis,
    settings: GroupSettings,
    notes: list[str],
) -> dict[str, Any] | None:
    """Make the summary for other sites, if it is asked for."""
    if options.export_summary is None:
        return None
    found = inputs.found
    summary, more = summarize(
        inputs.cohort,
        analysis,
        settings,
        site=options.export_summary or options.bids_dir.resolve().name,
        inputs={
            "versions": list(found.versions),
            "seg": found.records[0].place.name.seg if found.records else "none",
            "region": options.sheets.region,
            "settings_hash": found.settings_hash,
        },
    )
    notes += more
    return summary


def read_inputs(options: GroupOptions, settings: GroupSettings) -> GroupInputs:
    """Find and read sheets, other maps, volumes and covariates."""
    check_volumes(options.volumes)
    found = collect_sheets(options.sheets, may_lack=bool(options.maps))
    taken = taken_names(with_sheets=bool(found.records))
    requests = map_patterns(options.maps, options.surfaces, taken)
    wanted = wanted_measures(options.model, options.measures)
    measures = choose_measures(wanted, found.records, [one.name for one in requests])
    external = _read_maps(options, found, requests, measures, settings)
    measured, volume_notes = add_volumes(
        external.measured, found.records, options.volumes, options.bids_dir
    )
    check_summaries(measures, measured.sides)
    everybody = Cohort(
        table=with_factors(
            read_covariates(measured.visits, options.bids_dir, options.covariates), settings
        ),
        sides=measured.sides,
        x=measured.x,
        y=measured.y,
        units=measured.units,
    )
    # A visit may have lost both of its hemispheres.
    sides = [side for one in (everybody, *external.others.values()) for side in one.sides.values()]
    there = np.isin(np.arange(len(everybody.table)), np.concatenate([one.rows for one in sides]))
    cohort, reasons = choose_visits(everybody.take(there), options.comparison)
    keep = everybody.table.index.isin(cohort.table.index)
    table, icv = add_icv(cohort.table, measured.sources, settings)
    cohort = replace(cohort, table=table)
    time = None
    if options.comparison.longitudinal:
        time = add_time(cohort.table, settings)
        cohort = replace(cohort, table=time.table)
    own = tuple(name for name in measures.maps if name not in external.others)
    other = "other-session" if options.comparison.pair else "later-session"
    return GroupInputs(
        found=found,
        cohort=cohort,
        others={
            name: replace(other.take(keep), table=cohort.table)
            for name, other in external.others.items()
        },
        measures=replace(measures, maps=own),
        icv=icv,
        time=time,
        exclusions=(
            *found.exclusions,
            *measured.damaged,
            *exclude_visits(
                measured.visits, {visit: (other, message) for visit, message in reasons.items()}
            ),
        ),
        notes=(*found.notes, *external.notes, *volume_notes, *_damaged(measured)),
    )


def _read_maps(
    options: GroupOptions,
    found: Collection,
    requests: Sequence[MapPattern],
    measures: Measures,
    rules: GroupSettings,
) -> ExternalCohorts:
    """Read the maps that are asked for, of the sheets and of other programs."""
    error_window = 0 if rules.glm.weights == "none" else rules.glm.error_window
    asked = [one for one in requests if one.name in measures.maps]
    files_of, visits = find_all(
        asked, options.bids_dir, visits_of(found.records), wanted_by(options.sheets)
    )
    names = {one.name for one in requests}
    own = [name for name in measures.maps if name not in names]
    if error_window and asked:
        names_of = ", ".join(one.name for one in asked)
        raise InputError(
            f"--weights uncertainty: there are no SDs of {names_of}; leave --maps or the"
            " weights out",
            reason="no-uncertainty",
        )
    measured = read_sheets(
        found.records, found.grid, own, visits, rules=rules, error_window=error_window
    )
    return add_external(measured, files_of, visits)


def _damaged(measured: Measured) -> tuple[str, ...]:
    shown = [
        f"{one.participant}{f' {one.session}' if one.session else ''}, hemisphere {one.hemi}, is"
        f" left out: {one.message}; measure it again"
        for one in measured.damaged[:_SHOWN]
    ]
    more = len(measured.damaged) - _SHOWN
    return (*shown, f"{more} more are left out alike, see excluded.tsv") if more > 0 else (*shown,)


def _notes(
    options: GroupOptions, inputs: GroupInputs, analysis: Analysis, settings: GroupSettings
) -> list[str]:
    """List what a reader of the results should know, one line each."""
    found, notes = inputs.found, list(analysis.skipped)
    time = inputs.time.column if inputs.time else None
    notes += [note for name, note in analysis.design.notes.items() if name != time]
    if options.model.formula is None and options.model.file is None:
        notes += [
            f"{name} is n/a for all, and not in the model; fill it in, or do not read much into"
            f" differences that {name} might explain"
            for name in empty_covariates(inputs.cohort.table, settings)
        ]
    if later := sum(one.reason == "later-session" for one in inputs.exclusions):
        notes.append(
            f"{later} later sessions are not in it; --longitudinal takes all, --paired two"
        )
    if flagged := sum(record.flagged for record in found.records):
        notes.append(
            f"{flagged} flagged hemispheres are in it; look at them, or use --exclude-flagged"
        )
    if separated := sum(pair.comparison.separated for _, _, pair in analysis.pairs):
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
    notes += unequal_spread(analysis, settings.glm)
    for hemi, side in analysis.sides.items():
        if not side.registration.converged:
            notes.append(f"hemisphere {hemi}: registration had not settled when it ended")
        if side.registration.extreme.any():
            notes.append(
                f"hemisphere {hemi}: extreme warps: {int(side.registration.extreme.sum())}, see"
                " warps.tsv"
            )
    return notes


def _record(analysis: Analysis, ratings: Mapping[str, int] | None) -> dict[str, Any]:
    """Record what was fitted to what."""
    return {
        "harmonization": None
        if analysis.harmonization is None
        else harmonization_record(analysis.harmonization, analysis.groups),
        "measures": {"maps": analysis.measured.maps, "summaries": analysis.measured.summaries},
        "formula": analysis.model.formula,
        "columns": analysis.design.columns,
        "references": analysis.design.references,
        "contrasts": {c.name: c.weights.tolist() for c in analysis.design.contrasts},
        "comparison": asdict(analysis.comparison),
        "groups": None if analysis.groups is None else asdict(analysis.groups),
        "participants": analysis.n_participants,
        "rows": len(analysis.design.rows),
        "ratings": ratings,
        "hemispheres": {hemi: len(one.used) for hemi, one in analysis.fitted.items()},
    }


def with_page(options: GroupOptions, result: GroupResult) -> GroupResult:
    """Add the page to results that were written."""
    page, problem = make_page(options, result.folder.name)
    return replace(result, page=page, problem=problem)


def make_page(options: GroupOptions, name: str) -> tuple[Path | None, str | None]:
    """Make the page, and say why if it is not there."""
    path = options.out_dir / group_report(name)
    if not options.reports:
        files.remove([path])  # it would be that of an earlier analysis of this name
        return None, None
    tell("page")
    problem = write_group_report(options.out_dir, name)
    return (path if problem is None else None), problem


def _describe_dataset(options: GroupOptions) -> None:
    """Describe the output dataset, if the participant level has not."""
    files.make_folder(options.out_dir)
    if not (options.out_dir / "dataset_description.json").exists():
        roots = [root for root in options.sheets.roots if root != options.out_dir]
        roots += [options.bids_dir] if options.maps else []
        names = dataset.source_names((root.resolve().name, root) for root in roots)
        dataset.write_description(options.out_dir, names)
    dataset.write_notes(options.out_dir)


def read_templates(path: Path | None, cohort: Cohort) -> Mapping[str, Template] | None:
    """Read the templates of an earlier analysis, if one is named."""
    if path is None:
        return None
    content = files.read_json(path)
    content = content.get("template") or content  # in the summary of another site
    templates = templates_from_json(content, str(path))
    if missing := sorted(set(cohort.sides) - set(templates)):
        raise ModelError(
            f"{path}: has no template of hemisphere {', '.join(missing)}", reason="template-file"
        )
    return templates


def _incomplete(analysis: Analysis) -> list[Exclusion]:
    """Visits that lack a variable of the model."""
    table = analysis.compared.table
    return [
        one
        for variable, visits in analysis.design.dropped.items()
        for one in exclude_visits(
            table, dict.fromkeys(visits, ("incomplete", f"{variable} is missing"))
        )
    ]
