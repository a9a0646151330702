"""The group level from files to files."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from hipsta_bids import __version__
from hipsta_bids.derivatives import dataset
from hipsta_bids.derivatives.names import group_report
from hipsta_bids.errors import ModelError
from hipsta_bids.group import write
from hipsta_bids.group.analysis import Analysis, analyze_cohort, analyze_points
from hipsta_bids.group.collect import Collection, Exclusion
from hipsta_bids.group.data import PARTICIPANT, SESSION, Cohort
from hipsta_bids.group.formula import parse_model
from hipsta_bids.group.model import choose_references, folder_name, model_document
from hipsta_bids.group.read import GroupOptions, read_inputs
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.group.shapes import average_shapes, write_shapes
from hipsta_bids.group.template import templates_from_json
from hipsta_bids.group.write import draw, write_results
from hipsta_bids.io import files
from hipsta_bids.reports.group import write_group_report
from hipsta_bids.settings import resolve

# What the group level is asked for, what comes of it, and the record of both.


def notes_of(found: Collection, analysis: Analysis, *, n_other_visits: int) -> list[str]:
    """Say what a reader of the results should know, one line each."""
    notes = list(analysis.skipped)
    if n_other_visits and analysis.comparison.pair is None:
        notes.append(
            f"{n_other_visits} later sessions are not in it; --longitudinal takes all, --paired two"
        )
    if flagged := sum(record.flagged for record in found.records):
        notes.append(
            f"{flagged} flagged hemispheres are in it; look at them, or use --exclude-flagged"
        )
    if len(found.versions) > 1:
        notes.append(f"hemispheres were measured by several versions, {', '.join(found.versions)}")
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
    for hemi, side in analysis.sides.items():
        if not side.registration.converged:
            notes.append(f"hemisphere {hemi}: registration had not settled when it ended")
        if side.registration.extreme.any():
            notes.append(
                f"hemisphere {hemi}: extreme warps: {int(side.registration.extreme.sum())}, see"
                " warps.tsv"
            )
    return notes


def record_of(
    options: GroupOptions,
    found: Collection,
    settings: GroupSettings,
    analysis: Analysis,
    notes: Sequence[str],
) -> dict[str, Any]:
    """Record what was run, with which settings and seeds, on what."""
    return {
        "command": list(options.command),
        "version": __version__,
        "inputs": {
            "datasets": [str(root.resolve()) for root in options.sheets.roots],
            "settings_hash": found.settings_hash,
            "versions": found.versions,
            "seg": found.records[0].place.name.seg if found.records else None,
            "region": options.sheets.region,
            "maps": dict(options.maps),
            "volumes": dict(options.volumes),
            "covariates": [str(path) for path in options.covariates],
            "template": None if options.template is None else str(options.template),
        },
        "measures": {"maps": analysis.measured.maps, "summaries": analysis.measured.summaries},
        "formula": analysis.model.formula,
        "columns": analysis.design.columns,
        "references": analysis.design.references,
        "contrasts": {c.name: c.weights.tolist() for c in analysis.design.contrasts},
        "comparison": asdict(analysis.comparison),
        "groups": None if analysis.groups is None else asdict(analysis.groups),
        "participants": analysis.n_participants,
        "rows": len(analysis.design.rows),
        "hemispheres": {hemi: len(one.used) for hemi, one in analysis.fitted.items()},
        "notes": notes,
        "settings": resolve(settings),
    }


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
    dataset.check_own_dataset(options.out_dir)
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
    region = options.sheets.region
    if region != "body" and not options.model.name:
        name += f"_{region}"
    notes = [*read.notes, *notes_of(read.found, analysis, n_other_visits=read.n_other_visits)]
    shapes = average_shapes(read.found.records, cohort, analysis, settings)
    _describe(options)
    with write.model_folder(options.out_dir, name) as folder:
        write_results(folder, cohort, analysis, settings, exclusions, others=others, region=region)
        files.write_json(folder / "model.json", document)
        write_shapes(folder, shapes)
        if analysis.sides and read.found.records and not shapes:
            notes.append("no average surfaces: those of the participant level are missing")
        draw(folder, cohort, analysis, shapes, others=others)
        record = record_of(options, read.found, settings, analysis, notes)
        files.write_json(folder / "analysis.json", record)
    page, problem = _report(options, name)
    return GroupResult(
        folder=options.out_dir / write.GROUP_FOLDER / name,
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
        names = dataset.source_names((root.resolve().name, root) for root in roots)
        dataset.write_description(options.out_dir, names)


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
