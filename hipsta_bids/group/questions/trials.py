"""Agreement of repeated sessions and sample sizes of trials, from files to files."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids import __version__
from hipsta_bids.derivatives import dataset
from hipsta_bids.derivatives.names import TRIAL_MAPS, TRIAL_TABLES
from hipsta_bids.group.cohort.data import SHEET, SUMMARY, Cohort, layers
from hipsta_bids.group.design.model import Comparison
from hipsta_bids.group.design.settings import GroupSettings
from hipsta_bids.group.output import write
from hipsta_bids.group.output.columns import frame_of
from hipsta_bids.group.output.figures import Drawing
from hipsta_bids.group.output.methods import Citations, power_text, retest_text
from hipsta_bids.group.output.panels import Row, draw_maps, spanned
from hipsta_bids.group.output.tables import entity_label
from hipsta_bids.group.questions import reference
from hipsta_bids.group.questions import study as studies
from hipsta_bids.group.stats import trials
from hipsta_bids.group.stats.arrays import Float
from hipsta_bids.io import files, gifti
from hipsta_bids.progress import tell
from hipsta_bids.reports.cells import display_name, with_brackets
from hipsta_bids.types import PARTICIPANT

#: Ticks of numbers of participants.
_COUNTS = tuple(n * 10**power for power in range(5) for n in (1, 2, 3, 5))


def run_trial(
    options: studies.GroupOptions,
    settings: GroupSettings,
    *,
    retest: bool = False,
    effect: trials.TrialEffect | None = None,
    among: tuple[str, str] | None = None,
) -> studies.GroupResult:
    """Measure the agreement of sessions, or sample sizes, and write all results or none.

    Parameters
    ----------
    options : GroupOptions
        Files, model of the reference cohort.
    settings : GroupSettings
        What changes results.
    retest : bool
        Whether the agreement of sessions is measured; means and variances are theirs then.
    effect : TrialEffect, optional
        Of a trial whose size is asked for.
    among : (str, str), optional
        Column and level of the participants; all without.
    """
    dataset.check_own_dataset(options.out_dir)
    if effect is not None:
        trials.point_level(settings.multiplicity, settings.power)  # refuses before anything is read
    visits = bool(effect and effect.visits)
    options = replace(options, comparison=Comparison(longitudinal=retest or visits))
    study, repeated = studies.Study.read(options, among, settings), None
    if retest:
        repeated = reference.retest_cohort(study.cohort, settings.retest.min_participants)
        reasons = {v: ("incomplete-sessions", text) for v, text in repeated.left_out.items()}
        keep = study.inputs.cohort.table.index.isin(repeated.cohort.table.index)
        left_out = study.left_out | reasons
        study = replace(study, keep=keep, cohort=repeated.cohort, left_out=left_out)
    cohort, inputs = study.cohort, study.inputs
    templates, cohorts, tables = study.register(studies.read_templates(options.template, cohort))
    tell("points and measures")
    source: reference.Source
    if repeated is not None:
        source = reference.Retested(repeated, settings, has_visits=visits)
    else:
        source = reference.Modeled(cohort, options.model, settings, inputs.time)
        for variable, lacking in source.model.design.dropped.items():
            reason = "incomplete", f"{variable} is missing"
            study.left_out.update(dict.fromkeys(lacking, reason))
    maps, summaries = inputs.measures.maps, inputs.measures.summaries
    results = [
        source.describe(layer)
        for layer in layers(cohorts, maps, summaries, source.rows)
        if layer.surface != SUMMARY or np.unique(layer.data[np.isfinite(layer.data)]).size > 1
    ]
    if effect is not None:
        for result in results:
            result.tables.update(_sample_sizes(effect, result, settings))
    modeled = cohort.table if source.rows is None else cohort.table.iloc[source.rows]
    people = int(modeled[PARTICIPANT].nunique())

    def fill(folder: Path) -> list[str]:
        _write_tables(folder, cohorts, results)
        _write_maps(folder, cohorts, results)
        if templates:
            files.write_json(folder / "template.json", templates)
        files.write_text(folder / "methods.md", _methods(study, source, modeled, results, effect))
        return write.write_figures(folder, _figures(cohorts, results))

    record = {
        "formula": source.spec.formula if isinstance(source, reference.Modeled) else None,
        "hemispheres": {hemi: len(side.rows) for hemi, side in cohort.sides.items()},
        "retest": repeated and {"participants": people, "sessions": repeated.sessions},
        "power": effect
        and asdict(effect)
        | {
            "alpha_point": trials.point_level(settings.multiplicity, settings.power),
            "most": trials.MOST_PARTICIPANTS,
        },
        "among": among,
    }
    name = ["retest"] if retest else []
    if effect is not None:
        name.append(f"power-{effect.kind}-{100 * effect.share:g}".replace(".", "p"))
    return study.write(
        studies.folder_of(name, among),
        _notes(source, results, inputs, effect),
        visits=modeled,
        tables=tables,
        record=record,
        fill=fill,
    )


def _sample_sizes(
    effect: trials.TrialEffect, result: reference.Described, settings: GroupSettings
) -> reference.Tables:
    """Return columns of sample sizes; the mean of values of both signs has no share.

    Such a map has none, a summary measure keeps its row.
    """
    moments, single = result.reference, result.layer.surface == SUMMARY
    finite = result.data[np.isfinite(result.data)]
    if effect.kind == trials.THINNING and finite.min(initial=1.0) <= 0:
        if not single:
            return {}
        moments = replace(moments, mean=np.full_like(moments.mean, np.nan))
    plan = settings.power
    alpha = plan.alpha if single else trials.point_level(settings.multiplicity, plan)
    confidence = settings.glm.confidence if single else None
    size = trials.sample_size(effect, moments, plan, alpha=alpha, confidence=confidence)
    return {"power": size}


def _notes(
    source: reference.Source,
    results: Sequence[reference.Described],
    inputs: studies.GroupInputs,
    effect: trials.TrialEffect | None,
) -> Iterator[str]:
    if isinstance(source, reference.Retested) and (n := len(source.retest.left_out)):
        yield f"{n} visits of participants who lack a session are left out, see excluded.tsv"
    if effect is None:
        return
    if signed := dict.fromkeys(r.layer.measure for r in results if "power" not in r.tables):
        yield (
            f"{', '.join(signed)}: no sample sizes, since it has values of both signs, whose share"
            " means nothing"
        )
    if isinstance(source, reference.Modeled) and effect.duration > source.follow_up:
        yield (
            f"the trial lasts {effect.duration:g} months, the reference {source.follow_up:.3g};"
            " that change goes on alike is an assumption"
        )
    if isinstance(source, reference.Retested) and effect.visits:
        yield (
            "sample sizes rest on the variance of measurement alone; trials need more, as people"
            " differ in how they change"
        )
    if n_later := sum(exclusion.reason == "later-session" for exclusion in inputs.exclusions):
        yield f"{n_later} later sessions are not in it; --visits takes all"


def _methods(
    study: studies.Study,
    source: reference.Source,
    visits: pd.DataFrame,
    results: Sequence[reference.Described],
    effect: trials.TrialEffect | None,
) -> str:
    """Describe what was done, with the works it rests on."""
    settings, cite = study.settings, Citations()
    among = f" ({' '.join(study.among)})" if study.among else ""
    first = (
        f"Measures of the hippocampus {cite('method')} of {visits[PARTICIPANT].nunique()}"
        f" participants{among} with {len(visits)} visits were analyzed with hipsta_bids"
        f" {__version__}."
    )
    surfaces = dict.fromkeys(result.layer.surface for result in results)
    if SHEET in surfaces and settings.registration.align != "none":
        first += (
            f" Sheets were registered by their curvature profiles {cite('registr')}, each session"
            " by itself, as for comparisons of groups."
        )
    elif SHEET in surfaces:
        first += " Sheets were not registered to each other."
    if external := [name for name in surfaces if name not in {SHEET, SUMMARY}]:
        first += (
            f" Maps of other programs ({', '.join(external)}) were taken as they are, without"
            " registration."
        )
    paragraphs = [first]
    if isinstance(source, reference.Retested):
        paragraphs.append(retest_text(source.retest, settings.retest, cite))
    if effect is not None:
        paragraphs.append(power_text(effect, settings, source.words, cite))
    return cite.page(paragraphs, study.options.sheets.region)


def _write_tables(
    folder: Path, cohorts: Mapping[str, Cohort], results: Sequence[reference.Described]
) -> None:
    """Write a table per question and surface; of summary measures the smallest trial first."""
    for question, (summary_title, points_title) in TRIAL_TABLES.items():
        blocks: dict[str, list[pd.DataFrame]] = {}
        for result in results:
            layer = result.layer
            if question in result.tables:
                columns: dict[str, Any] = {
                    "hemi": layer.hemi,
                    "measure": layer.measure,
                    "unit": layer.unit,
                }
                if result.points is not None:
                    columns |= frame_of(cohorts[layer.surface], result.points).columns
                block = pd.DataFrame({**columns, **result.tables[question]})
                blocks.setdefault(layer.surface, []).append(block)
        for surface, parts in blocks.items():
            table = pd.concat(parts, ignore_index=True)
            title = "_".join(filter(None, (surface, points_title)))
            if surface == SUMMARY:
                title = summary_title
                if "per_arm" in table:
                    table = table.sort_values(
                        ["per_arm", "cohen_d"], ascending=[True, False], ignore_index=True
                    )
            write.write_table(folder, title, table)


def _write_maps(
    folder: Path, cohorts: Mapping[str, Cohort], results: Sequence[reference.Described]
) -> None:
    """Write surfaces and maps as GIFTI."""
    for result in results:
        layer = result.layer
        if result.points is None:
            continue
        write.write_surface(folder, cohorts[layer.surface], result.points, layer.hemi)
        units = {"1": "1", "": layer.unit}
        for stat, (question, column, unit) in TRIAL_MAPS.items():
            if question in result.tables:
                stem = f"hemi-{layer.hemi}_stat-{stat}_desc-{entity_label(layer.measure)}_statmap"
                values = np.asarray(result.tables[question][column], dtype=np.float64)
                content = gifti.shape_bytes(values, hemi=layer.hemi, name=stem, unit=units[unit])
                files.write_bytes(folder / f"{stem}.shape.gii", content)


def _figures(
    cohorts: Mapping[str, Cohort], results: Sequence[reference.Described]
) -> Iterator[tuple[str, Drawing]]:
    """List the figures of each map by name."""
    maps = [result for result in results if result.points is not None]
    for surface, measure in dict.fromkeys((r.layer.surface, r.layer.measure) for r in maps):
        for question, make in (("retest", _agreement), ("power", _sizes)):
            sides = {
                r.layer.hemi: r
                for r in maps
                if (r.layer.surface, r.layer.measure) == (surface, measure) and question in r.tables
            }
            unit = cohorts[surface].units.get(measure, "1")
            if rows := list(make(sides, display_name(measure), unit)):
                points = {hemi: r.points for hemi, r in sides.items() if r.points is not None}
                yield f"{measure}_{question}", partial(draw_maps, cohorts[surface], points, rows)


def _agreement(sides: Mapping[str, reference.Described], measure: str, unit: str) -> Iterator[Row]:
    """Show agreement between sessions."""
    if sides:
        within, icc = (_values(sides, "retest", name) for name in ("sd_within", "icc"))
        title = "Within-subject SD"
        label = with_brackets(f"within-subject SD,\n{measure}", unit)
        scale = spanned("magma", within)
        yield Row(kind="error", index=0, title=title, label=label, scale=scale, values=within)
        title = "ICC(2,1)"
        scale = {"cmap": "viridis", "vmin": 0.0, "vmax": 1.0}
        yield Row(kind="agreement", index=0, title=title, label=title, scale=scale, values=icc)


def _sizes(sides: Mapping[str, reference.Described], measure: str, _: str) -> Iterator[Row]:
    """Show participants per arm, by their logarithm."""
    values = {hemi: np.log10(n) for hemi, n in _values(sides, "power", "per_arm").items()}
    if any(np.isfinite(n).any() for n in values.values()):
        scale = spanned("viridis_r", values)
        ticks = [n for n in _COUNTS if scale["vmin"] <= np.log10(n) <= scale["vmax"]]
        yield Row(
            kind="size",
            index=0,
            title="Participants per arm",
            label=f"participants per arm,\n{measure}",
            scale=scale,
            values=values,
            ticks={float(np.log10(n)): f"{n:,}" for n in ticks},
        )


def _values(
    sides: Mapping[str, reference.Described], question: str, column: str
) -> dict[str, Float]:
    return {
        hemi: np.asarray(result.tables[question][column], dtype=np.float64)
        for hemi, result in sides.items()
    }
