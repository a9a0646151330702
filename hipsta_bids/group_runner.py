"""The group level from files to files."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids import __version__
from hipsta_bids.bids import derivative, files, gifti, group_outputs
from hipsta_bids.bids.covariates import read_covariates, read_icv
from hipsta_bids.bids.group_inputs import Collection, Exclusion, GroupRequest, collect_sheets
from hipsta_bids.bids.sheets import Measured, read_sheets
from hipsta_bids.errors import ModelError, UsageError
from hipsta_bids.group.analysis import Analysis, analyze_cohort
from hipsta_bids.group.default_model import Groups, default_formula, find_groups
from hipsta_bids.group.model_spec import model_from_shortcut, parse_model
from hipsta_bids.group.report import methods_text
from hipsta_bids.group.tables import COLUMNS, map_name, result_tables
from hipsta_bids.group.template_json import templates_from_json, templates_to_json
from hipsta_bids.group_data import PARTICIPANT, SESSION, Cohort, ResultTable
from hipsta_bids.group_figures import draw_figures
from hipsta_bids.group_settings import GroupSettings
from hipsta_bids.settings_file import resolve

#: Column that takes the intracranial volume estimated by the segmentation's program.
_ICV = "icv"


@dataclass(frozen=True, kw_only=True)
class ModelRequest:
    """Which model; all empty is the default."""

    file: Path | None = None
    """BIDS Stats Model."""
    formula: str | None = None
    contrasts: tuple[str, ...] = ()
    references: tuple[tuple[str, str], ...] = ()
    """Reference level by factor."""
    name: str | None = None
    """Folder of the results; else made from the formula."""


@dataclass(frozen=True, kw_only=True)
class GroupOptions:
    """What the user asked for."""

    bids_dir: Path
    out_dir: Path
    sheets: GroupRequest
    model: ModelRequest
    covariates: tuple[Path, ...] = ()
    template: Path | None = None
    command: tuple[str, ...] = ()
    """The command line, for the record."""


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
    measured = read_sheets(found.records, found.settings)
    cohort, later = _first_visits(_cohort(measured, options))
    cohort, icv = _with_icv(cohort, measured, settings)
    references, groups = _references(options.model, cohort.table, settings)
    document = _document(options.model, cohort.table, groups, settings)
    model = parse_model(document)
    templates = None
    if options.template is not None:
        templates = templates_from_json(files.read_json(options.template), str(options.template))
        _check_templates(templates, cohort, options.template)
    analysis = analyze_cohort(
        cohort, model, groups, settings, references=references, icv=icv, templates=templates
    )
    exclusions = [*found.exclusions, *later, *_incomplete(cohort, analysis)]
    name = options.model.name or folder_name(model.formula)
    notes = _notes(found, analysis)
    files.make_folder(options.out_dir)
    if not (options.out_dir / "dataset_description.json").exists():
        roots = derivative.source_names((root.name, root) for root in options.sheets.roots)
        derivative.write_description(options.out_dir, roots)
    with group_outputs.model_folder(options.out_dir, name) as folder:
        _write(folder, cohort, analysis, settings, exclusions)
        files.write_json(folder / "model.json", document)
        notes += _draw(folder, cohort, analysis)
        record = _record(options, found, settings, analysis, notes)
        files.write_json(folder / "analysis.json", record)
    return GroupResult(
        folder=options.out_dir / group_outputs.GROUP_FOLDER / name,
        n_participants=len(analysis.design.rows),
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


def _first_visits(cohort: Cohort) -> tuple[Cohort, list[Exclusion]]:
    """Keep the first session of each participant: models of the maps want independent rows."""
    later = cohort.table[PARTICIPANT].duplicated().to_numpy()
    left_out = [
        Exclusion(
            participant=row[PARTICIPANT],
            session=row[SESSION],
            hemi=files.MISSING,
            reason="later-session",
            message="the first session of each participant is analyzed",
        )
        for row in cohort.table[later].to_dict("records")
    ]
    return cohort.take(~later), left_out


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


def _references(
    request: ModelRequest, table: pd.DataFrame, settings: GroupSettings
) -> tuple[dict[str, str], Groups | None]:
    """Take reference levels that the user gave; that of the groups reorders them."""
    references = dict(request.references)
    groups = find_groups(table, settings)
    if groups is not None and groups.column in references:
        groups = find_groups(table, settings, references[groups.column])
    return references, groups


def _document(
    request: ModelRequest, table: pd.DataFrame, groups: Groups | None, settings: GroupSettings
) -> Mapping[str, Any]:
    if request.file is not None:
        if request.formula or request.contrasts:
            raise UsageError("give --model or --formula, not both", reason="usage")
        return files.read_json(request.file)
    if request.formula is not None:
        formula = request.formula
        contrasts = list(request.contrasts)
        if not contrasts and groups is not None and groups.column in formula:
            contrasts = groups.contrasts()
        return model_from_shortcut(formula, contrasts, request.name or folder_name(formula))
    if groups is None:
        raise ModelError(
            "participants.tsv has no column that tells groups"
            f" ({', '.join(settings.model.group_columns)}) with two levels; give a model by"
            ' --formula "age + sex" --contrast age',
            reason="no-groups",
        )
    formula = default_formula(table, groups, settings)
    contrasts = list(request.contrasts) or groups.contrasts()
    return model_from_shortcut(formula, contrasts, request.name or folder_name(formula))


def folder_name(formula: str) -> str:
    """Spell a formula as the name of a folder; products must not look like sums."""
    right = formula.rpartition("~")[2].replace("*", " x ").replace(":", " by ")
    right = right.replace(" - ", " without ")
    words = "".join(c if c.isalnum() else " " for c in right).split()
    return "-".join(words) or "model"


def _check_templates(templates: Mapping[str, Any], cohort: Cohort, path: Path) -> None:
    if missing := sorted(set(cohort.sides) - set(templates)):
        raise ModelError(
            f"{path}: has no template of hemisphere {', '.join(missing)}", reason="template-file"
        )


def _incomplete(cohort: Cohort, analysis: Analysis) -> list[Exclusion]:
    """Visits that lack a variable of the model."""
    result = []
    for variable, visits in analysis.design.dropped.items():
        for visit in visits:
            row = cohort.table.loc[[visit], [PARTICIPANT, SESSION]].to_dict("records")[0]
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


def _notes(found: Collection, analysis: Analysis) -> list[str]:
    notes = list(analysis.skipped)
    if flagged := sum(record.flagged for record in found.records):
        notes.append(
            f"{flagged} flagged hemispheres are in it; look at them, or use --exclude-flagged"
        )
    if len(found.versions) > 1:
        notes.append(f"hemispheres were measured by several versions, {', '.join(found.versions)}")
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
                f"hemisphere {hemi}: {int(side.registration.extreme.sum())} warps are extreme, see"
                " warps.tsv"
            )
    return notes


def _write(
    folder: Path,
    cohort: Cohort,
    analysis: Analysis,
    settings: GroupSettings,
    exclusions: Sequence[Exclusion],
) -> None:
    for table in result_tables(cohort, analysis, settings):
        group_outputs.write_result_table(folder, table, COLUMNS)
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
    group_outputs.write_covariates(
        folder / "covariates.tsv", cohort.table.iloc[analysis.design.rows]
    )
    registered = {hemi: side.registered for hemi, side in analysis.sides.items()}
    group_outputs.write_maps(folder / "maps.parquet", cohort, registered)
    templates = {
        hemi: side.registration.template
        for hemi, side in analysis.sides.items()
        if side.registration.template is not None
    }
    if templates:
        files.write_json(folder / "template.json", templates_to_json(templates))
    _write_gifti(folder, cohort, analysis)
    text = methods_text(cohort, analysis, settings, len(exclusions))
    files.write_text(folder / "methods.md", text)


def _draw(folder: Path, cohort: Cohort, analysis: Analysis) -> list[str]:
    """Draw the figures, if the library for it is there; notes otherwise."""
    try:
        for drawing in draw_figures(cohort, analysis):
            files.write_bytes(folder / "figures" / f"{drawing.name}.png", drawing.png)
            files.write_bytes(folder / "figures" / f"{drawing.name}.svg", drawing.svg)
    except ImportError:
        return ["no figures, as matplotlib is missing: pip install 'hipsta_bids[figures]'"]
    return []


def _write_gifti(folder: Path, cohort: Cohort, analysis: Analysis) -> None:
    """Write statistics and effect sizes on the unfolded sheet."""
    for hemi, side in analysis.sides.items():
        surface = folder / f"hemi-{hemi}_space-unfold_midthickness.surf.gii"
        group_outputs.write_sheet_surface(surface, cohort.x, cohort.y, hemi)
        for measure, fit in side.fits.items():
            for test in fit.tests:
                single = test.kind == "t"
                effect = ("d", test.cohen_d) if single else ("eta2", test.eta_squared)
                for stat, values in ((test.kind, test.statistic), effect):
                    stem = map_name(hemi, measure, test).replace("_desc-", f"_stat-{stat}_desc-")
                    content = gifti.shape_bytes(values, hemi=hemi, name=stem, unit="1")
                    files.write_bytes(folder / f"{stem}.shape.gii", content)


def _record(
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
            "seg": found.records[0].place.name.seg,
            "covariates": [str(path) for path in options.covariates],
            "template": None if options.template is None else str(options.template),
        },
        "formula": analysis.model.formula,
        "columns": analysis.design.columns,
        "references": analysis.design.references,
        "contrasts": {c.name: c.weights.tolist() for c in analysis.design.contrasts},
        "groups": None if analysis.groups is None else asdict(analysis.groups),
        "participants": len(analysis.design.rows),
        "hemispheres": {hemi: len(side.used) for hemi, side in analysis.sides.items()},
        "notes": notes,
        "settings": resolve(settings),
    }
