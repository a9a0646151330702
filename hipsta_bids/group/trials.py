"""Agreement of repeated sessions and sample sizes of trials, from files to files."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from hipsta_bids import __version__
from hipsta_bids.derivatives import dataset
from hipsta_bids.derivatives.names import TRIAL_MAPS, TRIAL_TABLES
from hipsta_bids.errors import ModelError
from hipsta_bids.group import write
from hipsta_bids.group.analysis import register_side, templates_of
from hipsta_bids.group.clusters import frame_of
from hipsta_bids.group.collect import exclude_visits
from hipsta_bids.group.comparison import Comparison
from hipsta_bids.group.data import PARTICIPANT, Bool, Cohort, Float
from hipsta_bids.group.figures import Drawing
from hipsta_bids.group.formula import check_names, listed
from hipsta_bids.group.glm import FittedMaps
from hipsta_bids.group.methods import Citations
from hipsta_bids.group.panels import Row, draw_rows, spanned
from hipsta_bids.group.power import (
    THINNING,
    TrialEffect,
    point_level,
    power_columns,
    power_text,
    sample_size,
)
from hipsta_bids.group.reference import (
    Modeled,
    Reference,
    Retested,
    Source,
    Tables,
    retest_cohort,
    retest_text,
)
from hipsta_bids.group.run import (
    GroupInputs,
    GroupOptions,
    GroupResult,
    read_inputs,
    read_templates,
    with_page,
    write_folder,
)
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.group.tables import entity_label, registration_tables
from hipsta_bids.group.warps import Template
from hipsta_bids.io import files, gifti
from hipsta_bids.progress import each, tell
from hipsta_bids.reports.group_tables import display_name, with_brackets

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Ticks of numbers of participants.
_COUNTS = tuple(n * 10**power for power in range(5) for n in (1, 2, 3, 5))


def folder_of(parts: Sequence[str], among: tuple[str, str] | None) -> str:
    """Name a folder of results by what was asked, and of whom."""
    words = (*parts, *(among or ())[1:])
    return "_".join("".join(c if c.isalnum() else "-" for c in word) for word in words)


@dataclass(frozen=True, kw_only=True)
class TrialRequest:
    """What is asked of repeated sessions, or of a reference cohort."""

    retest: bool = False
    effect: TrialEffect | None = None
    """Of a trial whose size is asked for."""
    among: tuple[str, str] | None = None
    """Column and level of the participants; all without."""

    @property
    def name(self) -> str:
        """Folder of the results."""
        parts = ["retest"] if self.retest else []
        if self.effect is not None:
            share = f"{100 * self.effect.share:g}".replace(".", "p")
            parts.append(f"power-{self.effect.kind}-{share}")
        return folder_of(parts, self.among)


@dataclass(frozen=True, eq=False)
class _Question:
    """What is asked, of whom, and how."""

    source: Source
    request: TrialRequest
    settings: GroupSettings

    def size(self, reference: Reference, *, alpha: float, limits: bool = False) -> dict[str, Any]:
        """Find sample sizes, as columns of their table; none where they are not asked for."""
        effect = self.request.effect
        if effect is None:
            return {}
        size = sample_size(effect, reference, self.settings, alpha=alpha, limits=limits)
        return {"power": power_columns(effect, size, reference)}

    @property
    def shares_mean(self) -> bool:
        """Whether the effect is a share of the mean, without meaning where it has both signs."""
        return self.request.effect is not None and self.request.effect.kind == THINNING


@dataclass(frozen=True, eq=False, kw_only=True)
class Found:
    """What was found for some summary measures, or at the points of one map."""

    hemi: str
    measures: tuple[str, ...]
    tables: Tables


@dataclass(frozen=True, eq=False, kw_only=True)
class MapFound(Found):
    """With the places of the points."""

    place: FittedMaps


@dataclass(frozen=True, eq=False, kw_only=True)
class Asked:
    """What was read, and the visits that a question other than a comparison is about."""

    options: GroupOptions
    settings: GroupSettings
    inputs: GroupInputs
    keep: Bool
    """Of the visits that were read."""
    cohort: Cohort
    """Of those that are kept."""
    left_out: dict[str, tuple[str, str]]
    """Reason and message by visit."""

    @classmethod
    def read(
        cls, options: GroupOptions, among: tuple[str, str] | None, settings: GroupSettings
    ) -> "Asked":
        """Read all visits, and keep those that are asked for."""
        tell("reading")
        inputs = read_inputs(options, settings)
        keep = members(inputs.cohort.table, among)
        why = "not-asked", "another level than --among"
        return cls(
            options=options,
            settings=settings,
            inputs=inputs,
            keep=keep,
            cohort=inputs.cohort.take(keep),
            left_out=dict.fromkeys(map(str, inputs.cohort.table.index[~keep]), why),
        )

    def register(
        self, templates: Mapping[str, Template] | None
    ) -> tuple[dict[str, Any] | None, dict[str, Cohort], dict[str, pd.DataFrame]]:
        """Register sheets: templates for a file, cohorts (other maps by name), and tables."""
        cohort = self.cohort
        with_maps = list(cohort.sides) if self.inputs.measures.maps else []
        sides = {
            hemi: register_side(
                cohort, hemi, groups=None, settings=self.settings, templates=templates
            )
            for hemi in each("registration", with_maps)
        }
        registered = {hemi: side.registered for hemi, side in sides.items()} or cohort.sides
        others = {name: other.take(self.keep) for name, other in self.inputs.others.items()}
        cohorts = {"": replace(cohort, sides=registered), **others}
        tables = dict(registration_tables(cohort, sides)) if sides else {}
        return templates_of(sides), cohorts, tables

    def write(
        self,
        name: str,
        notes: Iterable[str],
        *,
        visits: pd.DataFrame,
        tables: Mapping[str, pd.DataFrame],
        record: Mapping[str, Any],
        fill: Callable[[Path], list[str]],
    ) -> GroupResult:
        """Write what these questions share, and a page; ``fill`` writes all else, and notes."""
        excluded = exclude_visits(self.inputs.cohort.table, self.left_out)
        excluded = [*self.inputs.exclusions, *excluded]
        told, people = [*self.inputs.notes, *notes], int(visits[PARTICIPANT].nunique())

        def everything(folder: Path) -> dict[str, Any]:
            for title, table in tables.items():
                write.write_table(folder, title, table)
            write.write_exclusions(folder, excluded)
            write.write_table(folder, "covariates", visits, described=False)
            told.extend(fill(folder))
            return {"participants": people, "rows": len(visits), **record}

        result = write_folder(
            self.options,
            name,
            self.inputs,
            self.settings,
            notes=told,
            counts=(people, len(excluded)),
            fill=everything,
        )
        return with_page(self.options, result)


def run_trial(options: GroupOptions, request: TrialRequest, settings: GroupSettings) -> GroupResult:
    """Measure the agreement of sessions, or sample sizes, and write all results or none."""
    dataset.check_own_dataset(options.out_dir)
    effect = request.effect
    if effect is not None:
        point_level(settings)  # refuses before anything is read
    repeated = request.retest or bool(effect and effect.visits)
    options = replace(options, comparison=Comparison(longitudinal=repeated))
    asked, retest = Asked.read(options, request.among, settings), None
    if request.retest:
        retest = retest_cohort(asked.cohort, settings.retest.min_participants)
        why = {v: ("incomplete-sessions", text) for v, text in retest.left_out.items()}
        keep = asked.inputs.cohort.table.index.isin(retest.cohort.table.index)
        left_out = asked.left_out | why
        asked = replace(asked, keep=keep, cohort=retest.cohort, left_out=left_out)
    cohort, inputs = asked.cohort, asked.inputs
    templates, cohorts, tables = asked.register(read_templates(options.template, cohort))
    tell("points and measures")
    source: Source
    if retest is not None:
        source = Retested(retest, settings, repeated=bool(effect and effect.visits))
    else:
        source = Modeled(cohort, options.model, settings, inputs.time)
        for variable, visits in source.model.design.dropped.items():
            asked.left_out.update(dict.fromkeys(visits, ("incomplete", f"{variable} is missing")))
    question = _Question(source, request, settings)
    maps = {
        name: list(_of_maps(question, one, (name,) if name else inputs.measures.maps))
        for name, one in cohorts.items()
    }
    measures = list(_of_measures(question, cohorts[""], inputs.measures.summaries))
    modeled = cohort.table
    if isinstance(source, Modeled):
        modeled = modeled.iloc[source.model.design.rows]
    people = int(modeled[PARTICIPANT].nunique())

    def fill(folder: Path) -> list[str]:
        _write_measures(folder, cohort, measures)
        for surface, found in maps.items():
            _write_maps(folder, surface, cohorts[surface], found)
        if templates:
            files.write_json(folder / "template.json", templates)
        text = _methods(question, modeled, maps, options.sheets.region)
        files.write_text(folder / "methods.md", text)
        figures = (figure for key, own in maps.items() for figure in _figures(cohorts[key], own))
        return write.write_figures(folder, figures)

    record = {
        "formula": source.spec.formula if isinstance(source, Modeled) else None,
        "hemispheres": {hemi: len(side.rows) for hemi, side in cohort.sides.items()},
        "retest": retest and {"participants": people, "sessions": retest.sessions},
        "power": effect and asdict(effect) | {"alpha_point": point_level(settings)},
        "among": request.among,
    }
    notes = _notes(question, maps, inputs)
    return asked.write(request.name, notes, visits=modeled, tables=tables, record=record, fill=fill)


def members(table: pd.DataFrame, among: tuple[str, str] | None, option: str = "--among") -> Bool:
    """Tell whose visits are asked for."""
    if among is None:
        return np.ones(len(table), dtype=bool)
    column, level = among
    check_names([column], table.columns)
    values = table[column].map(lambda value: None if value is None else str(value))
    keep = (values == level).to_numpy()
    if not keep.any():
        raise ModelError(
            f"{option} {column}={level}: no participant has it; there are"
            f" {listed(sorted(values.dropna().unique()))}",
            reason="unknown-level",
        )
    return np.asarray(keep, dtype=bool)


def _of_maps(asked: _Question, cohort: Cohort, names: Sequence[str]) -> Iterator[MapFound]:
    """Results at each point of the maps of a cohort."""
    alpha = point_level(asked.settings) if asked.request.effect else np.nan
    for hemi, side in cohort.sides.items() if names else ():
        place = asked.source.place(hemi, side.only([name for name in names if name in side.maps]))
        for measure in place.maps.maps:
            tables, reference = asked.source.of_map(place, measure)
            if not (asked.shares_mean and np.nanmin(place.values(measure)) <= 0):
                tables = {**tables, **asked.size(reference, alpha=alpha)}
            yield MapFound(hemi=hemi, measures=(measure,), tables=tables, place=place)


def _of_measures(asked: _Question, cohort: Cohort, only: Sequence[str] | None) -> Iterator[Found]:
    """Results of the summary measures of each hemisphere and of the mean of both."""
    alpha = asked.settings.power.alpha
    for hemi, names, values, tables, reference in asked.source.of_summaries(cohort, only):
        known = reference
        if asked.shares_mean:
            signed = np.where(np.isfinite(values), values, 1.0).min(axis=0) <= 0
            known = replace(reference, mean=np.where(signed, np.nan, reference.mean))
        own = {**tables, **asked.size(known, alpha=alpha, limits=True)}
        yield Found(hemi=hemi, measures=names, tables=own)


def _notes(
    asked: _Question, maps: Mapping[str, Sequence[MapFound]], inputs: GroupInputs
) -> Iterator[str]:
    source, effect = asked.source, asked.request.effect
    if isinstance(source, Retested) and (n := len(source.retest.left_out)):
        yield f"{n} visits of participants who lack a session are left out, see excluded.tsv"
    if effect is None:
        return
    every = [one for own in maps.values() for one in own]
    if lost := dict.fromkeys(one.measures[0] for one in every if "power" not in one.tables):
        yield (
            f"{', '.join(lost)}: no sample sizes, since it has values of both signs, whose share"
            " means nothing"
        )
    if isinstance(source, Modeled) and effect.duration > source.follow_up:
        yield (
            f"the trial lasts {effect.duration:g} months, the reference {source.follow_up:.3g};"
            " that change goes on alike is an assumption"
        )
    if isinstance(source, Retested) and effect.visits:
        yield (
            "sample sizes rest on the variance of measurement alone; trials need more, as people"
            " differ in how they change"
        )
    if later := sum(one.reason == "later-session" for one in inputs.exclusions):
        yield f"{later} later sessions are not in it; --visits takes all"


def _methods(
    asked: _Question, visits: pd.DataFrame, maps: Mapping[str, Sequence[MapFound]], region: str
) -> str:
    """Word what was done, with the works it rests on."""
    source, request, settings = asked.source, asked.request, asked.settings
    cite = Citations()
    people = int(visits[PARTICIPANT].nunique())
    among = f" ({' '.join(request.among)})" if request.among else ""
    first = (
        f"Measures of the hippocampus {cite('method')} of {people} participants{among} with"
        f" {len(visits)} visits were analyzed with hipsta_bids {__version__}."
    )
    others = [name for name in maps if name]
    if maps[""] and settings.registration.align != "none":
        first += (
            f" Sheets were registered by their curvature profiles {cite('registr')}, each session"
            " by itself, as for comparisons of groups."
        )
    elif maps[""]:
        first += " Sheets were not registered to each other."
    if others:
        first += (
            f" Maps of other programs ({', '.join(others)}) were taken as they are, without"
            " registration."
        )
    paragraphs = [first]
    if isinstance(source, Retested):
        paragraphs.append(retest_text(source.retest, settings.retest, cite))
    if request.effect is not None:
        paragraphs.append(power_text(request.effect, settings, source.words, cite))
    return cite.page(paragraphs, region)


def _write_measures(folder: Path, cohort: Cohort, found: Sequence[Found]) -> None:
    """Write what was found for summary measures, those first that need fewest participants."""
    for question, (title, _) in TRIAL_TABLES.items():
        blocks = [
            pd.DataFrame(
                {
                    "hemi": one.hemi,
                    "measure": one.measures,
                    "unit": [cohort.units.get(name, "1") for name in one.measures],
                    **one.tables[question],
                }
            )
            for one in found
            if question in one.tables
        ]
        if blocks:
            table = pd.concat(blocks, ignore_index=True)
            if "per_arm" in table:
                table = table.sort_values(
                    ["per_arm", "cohen_d"], ascending=[True, False], ignore_index=True
                )
            write.write_table(folder, title, table)


def _write_maps(folder: Path, surface: str, cohort: Cohort, found: Sequence[MapFound]) -> None:
    """Write the points of maps as a table and as GIFTI."""
    for question, (_, title) in TRIAL_TABLES.items():
        blocks = []
        for one in found:
            if question in one.tables:
                columns = {
                    "hemi": one.hemi,
                    "measure": one.measures[0],
                    "unit": cohort.units.get(one.measures[0], "1"),
                    **frame_of(cohort, one.place).columns,
                    **one.tables[question],
                }
                blocks.append(pd.DataFrame(columns))
        if blocks:
            table = pd.concat(blocks, ignore_index=True)
            write.write_table(folder, "_".join(filter(None, (surface, title))), table)
    for one in found:
        write.write_surface(folder, cohort, one.place, one.hemi)
        units = {"1": "1", "": cohort.units.get(one.measures[0], "1")}
        for stat, (question, column, unit) in TRIAL_MAPS.items():
            if question in one.tables:
                stem = f"hemi-{one.hemi}_stat-{stat}_desc-{entity_label(one.measures[0])}_statmap"
                values = np.asarray(one.tables[question][column], dtype=np.float64)
                content = gifti.shape_bytes(values, hemi=one.hemi, name=stem, unit=units[unit])
                files.write_bytes(folder / f"{stem}.shape.gii", content)


def _figures(cohort: Cohort, found: Sequence[MapFound]) -> Iterator[tuple[str, Drawing]]:
    """List the figures of each map by name."""
    for measure in dict.fromkeys(one.measures[0] for one in found):
        for question, make in (("retest", _agreement), ("power", _sizes)):
            own = {
                one.hemi: one
                for one in found
                if one.measures[0] == measure and question in one.tables
            }
            unit = cohort.units.get(measure, "1")
            if rows := list(make(own, display_name(measure), unit)):
                places = {hemi: one.place for hemi, one in own.items()}
                yield f"{measure}_{question}", partial(draw_maps, cohort, places, rows)


def draw_maps(
    cohort: Cohort, places: Mapping[str, FittedMaps], rows: Sequence[Row]
) -> "list[Figure]":
    """Draw rows of maps that no test was made of."""
    return [draw_rows(cohort, places, {}, rows, {})]


def _agreement(found: Mapping[str, MapFound], measure: str, unit: str) -> Iterator[Row]:
    """Show agreement between sessions."""
    if found:
        within, icc = (_values(found, "retest", name) for name in ("sd_within", "icc"))
        title = "Within-subject SD"
        label = with_brackets(f"within-subject SD,\n{measure}", unit)
        scale = spanned("magma", within)
        yield Row(kind="error", index=0, title=title, label=label, scale=scale, values=within)
        title = "ICC(2,1)"
        scale = {"cmap": "viridis", "vmin": 0.0, "vmax": 1.0}
        yield Row(kind="agreement", index=0, title=title, label=title, scale=scale, values=icc)


def _sizes(found: Mapping[str, MapFound], measure: str, _: str) -> Iterator[Row]:
    """Show participants per arm, by their logarithm."""
    values = {hemi: np.log10(own) for hemi, own in _values(found, "power", "per_arm").items()}
    if any(np.isfinite(own).any() for own in values.values()):
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


def _values(found: Mapping[str, MapFound], question: str, column: str) -> dict[str, Float]:
    return {
        hemi: np.asarray(one.tables[question][column], dtype=np.float64)
        for hemi, one in found.items()
    }
