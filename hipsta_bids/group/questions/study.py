"""A study: what was read for a question of the group level, and how its results are written."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids import __version__
from hipsta_bids.derivatives import dataset
from hipsta_bids.errors import InputError, ModelError
from hipsta_bids.group import model as modeling
from hipsta_bids.group.cohort import collect, read
from hipsta_bids.group.cohort.covariates import add_icv, add_time, read_covariates, spelled_note
from hipsta_bids.group.cohort.data import SHEET, Cohort, Measures
from hipsta_bids.group.cohort.order import read_in_order
from hipsta_bids.group.cohort.sources import Reading, Remark, Search, Source
from hipsta_bids.group.output import write
from hipsta_bids.group.output.citations import REFERENCES
from hipsta_bids.group.output.demographics import demographics_table
from hipsta_bids.group.output.pages import write_page
from hipsta_bids.group.output.results import templates_of
from hipsta_bids.group.output.saved import templates_from_json
from hipsta_bids.group.output.tables import DEMOGRAPHIC_COLUMNS, registration_tables
from hipsta_bids.group.output.template import template_file
from hipsta_bids.group.questions.aligning import register_side
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.io import files
from hipsta_bids.joints import Part, find_steps
from hipsta_bids.progress import each, tell
from hipsta_bids.protocols.toml import resolve
from hipsta_bids.stats.arrays import Bool
from hipsta_bids.stats.formula import ascii_letters, check_names, listed, with_factors
from hipsta_bids.stats.warps import Template
from hipsta_bids.types import PARTICIPANT, SESSION, VisitKey

#: Share of participants that may be without a row in participants.tsv.
_MOST_ABSENT = 0.1
#: Hemispheres that notes name.
_MOST_NOTES = 4

#: Keys of a record that have the question.
_QUESTION = ("formula", "contrasts", "one_sided", "comparison", "measures", "settings")


@dataclass(frozen=True, kw_only=True)
class GroupOptions:
    """What the user asked for."""

    bids_dir: Path
    out_dir: Path
    sheets: collect.GroupRequest
    model: modeling.ModelRequest
    covariates: tuple[Path, ...] = ()
    sources: tuple[Source, ...] = ()
    """Of maps and measures beside the sheets, in the order of reading."""
    measures: tuple[str, ...] = ()
    """What to fit the model to; empty for the default or the formula's left-hand side."""
    template: Path | None = None
    comparison: modeling.Comparison = field(default_factory=modeling.Comparison)
    parts: tuple[tuple[Part, str], ...] = ()
    """Parts of the results that extensions add, and the values of their options."""
    further: Mapping[str, Any] = field(default_factory=dict)
    """Values of the options of steps of extensions, by their names in Python."""
    allow_missing: bool = False
    """Whether many participants may be without a row in participants.tsv."""
    part: str = ""
    """End of the folder's name: of one analysis of several."""
    reports: bool = True
    """Whether a page is made."""
    figures: bool = False
    """Whether figures are written for print, too, as PDF and PNG."""
    command: tuple[str, ...] = ()
    """The command line, for the record."""

    @property
    def record_of_sources(self) -> dict[str, Any]:
        """Return names and patterns of the files of sources, for the record."""
        return {name: value for source in self.sources for name, value in source.record.items()}


@dataclass(frozen=True, kw_only=True)
class GroupResult:
    """Result of a question."""

    folder: Path
    n_participants: int
    """In the model."""
    n_excluded: int
    """Rows of excluded.tsv: participants, visits and hemispheres."""
    notes: tuple[str, ...]
    """What to know, one line each."""
    warnings: tuple[str, ...]
    """What may make results wrong, one line each."""
    page: Path | None = None
    """To look at; ``None`` if there is none."""
    problem: str | None = None
    """Why the page could not be made."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Study:
    """The data read for a question, and their participants."""

    options: GroupOptions
    settings: GroupSettings
    collection: collect.Collection
    """Hemispheres that were measured."""
    visits: pd.DataFrame
    """All visits with covariates."""
    cohorts: Mapping[str, Cohort]
    """Visits that the question is about, with maps, by surface."""
    measures: Measures
    """Measures of the sheets."""
    icv: str | None
    """Column of intracranial volume."""
    time: modeling.VisitTime | None
    exclusions: tuple[collect.Exclusion, ...]
    """Of hemispheres, and of sessions that are not compared."""
    notes: tuple[str, ...]
    """What to know, one line each."""
    absent: frozenset[str] = frozenset()
    """Participants who are not in participants.tsv."""
    among: tuple[str, str] | None = None
    """Column and level of the participants; all without."""
    left_out: dict[str, tuple[str, str]] = field(default_factory=dict)
    """Reason and message by further visits that are left out."""
    quality: pd.DataFrame = field(default_factory=pd.DataFrame)
    """Decision and rating of each hemisphere, also of failed ones, with covariates."""
    remarks: tuple[Remark, ...] = ()
    """Notes of sources that need the groups."""
    mixes: tuple[str, ...] = ()
    """In what hemispheres differ, as far as the settings allow it, one line each."""
    labels: Mapping[str, list[str]] = field(default_factory=dict)
    """Values of each field of provenance of their labels."""

    @property
    def cohort(self) -> Cohort:
        """Return the visits with their sheets."""
        return self.cohorts[SHEET]

    @property
    def maps(self) -> list[str]:
        """Return the maps of all surfaces."""
        return [*self.measures.maps, *(name for name in self.cohorts if name != SHEET)]

    def sentences(self) -> list[str]:
        """Return sentences of the methods by the sources."""
        surfaces = [name for name in self.cohorts if name != SHEET]
        texts = (source.sentences(self.maps, surfaces) for source in self.options.sources)
        return [sentence for of_source in texts for sentence in of_source]

    def incomplete(
        self, lacking: Mapping[str, Iterable[str]], people: pd.Series
    ) -> dict[str, tuple[str, str]]:
        """Give reason and message by visit, from visits by the variable that they lack."""
        return {
            visit: (
                "incomplete",
                "not in participants.tsv" if people[visit] in self.absent else f"{name} is missing",
            )
            for name, visits in lacking.items()
            for visit in visits
        }

    def take(self, keep: Bool, reason: tuple[str, str]) -> "Study":
        """Keep some visits; the others are excluded, with a reason and a message."""
        left_out = dict.fromkeys(map(str, self.cohort.table.index[~keep]), reason)
        cohorts = {surface: one.take(keep) for surface, one in self.cohorts.items()}
        return replace(self, cohorts=cohorts, left_out=self.left_out | left_out)

    def with_alignment(self) -> "Study":
        """Choose registration, or none where sheets are too few for a template, with a note."""
        rules = self.settings.registration
        if rules.align != "auto":
            return self
        counts = {hemi: len(side.rows) for hemi, side in self.cohort.sides.items()}
        hemi = min(counts, key=lambda name: counts[name], default="")
        is_small = bool(self.measures.maps and hemi) and counts[hemi] < rules.min_subjects
        align = "none" if is_small and self.options.template is None else "registr"
        note = (
            f"maps are not registered: hemisphere {hemi} has {counts.get(hemi)} sheets, a template"
            f" needs {rules.min_subjects}; --template FILE takes another cohort's"
        )
        return replace(
            self,
            settings=self.settings.changed(registration={"align": align}),
            notes=(*self.notes, *[note] * (align == "none")),
        )

    def register(
        self, templates: Mapping[str, Template] | None
    ) -> tuple[dict[str, Any] | None, dict[str, Cohort], dict[str, pd.DataFrame]]:
        """Register sheets: templates for a file, cohorts (other maps by name), and tables."""
        cohort = self.cohort
        with_maps = list(cohort.sides) if self.measures.maps else []
        sides = {
            hemi: register_side(
                cohort, hemi, groups=None, settings=self.settings, templates=templates
            )
            for hemi in each("registration", with_maps)
        }
        registrations = {hemi: result for hemi, (result, _) in sides.items()}
        registered = {hemi: maps for hemi, (_, maps) in sides.items()} or cohort.sides
        cohorts = {**self.cohorts, SHEET: replace(cohort, sides=registered)}
        tables = dict(registration_tables(cohort, registrations)) if sides else {}
        return templates_of(registrations), cohorts, tables

    def write(
        self,
        name: str,
        notes: Iterable[str],
        *,
        visits: pd.DataFrame,
        tables: Mapping[str, pd.DataFrame],
        meaning: Mapping[str, str],
        record: Mapping[str, Any],
        fill: Callable[[Path], list[str]],
    ) -> GroupResult:
        """Write results of questions other than comparisons, and a page.

        ``meaning`` is of the columns of the tables. ``fill`` writes the files of this question
        only, and returns notes.
        """
        excluded = [*self.exclusions, *collect.exclude_visits(self.visits, self.left_out)]
        all_notes, people = [*self.notes, *notes], int(visits[PARTICIPANT].nunique())

        def everything(folder: Path) -> dict[str, Any]:
            for title, table in tables.items():
                write.write_table(folder, title, table, meaning=meaning)
            write.write_exclusions(folder, excluded)
            write.write_table(folder, "covariates", visits, described=False)
            formulas = [record.get("formula") or "1"]
            table = demographics_table(visits, self.settings, formulas)
            write.write_table(folder, "demographics", table, meaning=DEMOGRAPHIC_COLUMNS)
            all_notes.extend(fill(folder))
            return {"participants": people, "rows": len(visits), **record}

        counts = people, len(excluded)
        result = self.write_folder(name, notes=all_notes, counts=counts, fill=everything)
        return with_page(self.options, result)

    def write_folder(
        self,
        name: str,
        *,
        notes: list[str],
        counts: tuple[int, int],
        fill: Callable[[Path], Mapping[str, Any]],
    ) -> GroupResult:
        """Write all results or none.

        ``fill`` writes into the folder, adds to the notes, and returns the record; ``counts`` are
        of participants and of exclusions.
        """
        options, collection = self.options, self.collection
        warnings = (*collection.warnings, *self.mixes)
        region = options.sheets.region
        name = options.model.name or (name if region == "body" else f"{name}_{region}")
        name += options.part
        _describe_dataset(options)
        final = options.out_dir / write.GROUP_FOLDER / name
        earlier = _question_in(final)
        with write.whole_folder(final) as folder:
            tell("tables and maps")
            record = {
                "command": list(options.command),
                "version": __version__,
                "inputs": {
                    "datasets": [str(root.resolve()) for root in options.sheets.roots],
                    "settings_hash": collection.settings_hash,
                    "versions": collection.versions,
                    "seg": collection.records[0].result.name.seg if collection.records else None,
                    "region": region,
                    **options.record_of_sources,
                    "covariates": [str(path) for path in options.covariates],
                    "template": options.template and str(options.template),
                    **_further_inputs(options),
                },
                "mixes": self.mixes,
                **fill(folder),
                "notes": [*warnings, *notes],
                "settings": resolve(self.settings),
            }
            files.write_json(folder / "analysis.json", record)
            if self.mixes:
                lines = " ".join(f"Note that {line}." for line in self.mixes) + f"\n\n{REFERENCES}"
                text = (folder / "methods.md").read_text(encoding="utf-8")
                text = text.replace(REFERENCES, lines)
                files.write_text(folder / "methods.md", text)
        return GroupResult(
            folder=final,
            n_participants=counts[0],
            n_excluded=counts[1],
            notes=(*notes, *_replaced(earlier, final)),
            warnings=warnings,
        )


def _question_in(folder: Path) -> dict[str, Any]:
    """Return what an analysis asked; empty without a record."""
    with suppress(InputError):
        record = files.read_json(folder / "analysis.json")
        return {key: record.get(key) for key in _QUESTION}
    return {}


def _replaced(earlier: Mapping[str, Any], folder: Path) -> Iterator[str]:
    """Return a note if the results of another question were replaced."""
    written = _question_in(folder)
    if changes := [key for key in earlier if earlier[key] != written[key]]:
        yield f"{folder.name} had another question ({listed(changes)}); keep both with --name"


def read_study(
    options: GroupOptions, settings: GroupSettings, among: tuple[str, str] | None = None
) -> Study:
    """Find and read sheets, covariates and sources, of all or of some participants."""
    tell("reading")
    may_lack = any(source.has_maps for source in options.sources)
    collection = collect.collect_sheets(options.sheets, may_lack=may_lack)
    with_sheets = bool(collection.records)
    names = [n for source in options.sources for n in source.names(with_sheets=with_sheets)]
    measures, covariate_maps = _choose_maps(options, collection, names)
    maps = dict.fromkeys((*measures.maps, *covariate_maps))
    search = Search(
        bids_dir=options.bids_dir,
        maps=frozenset(maps),
        visits=read.visits_of(collection.records),
        choice=partial(collect.wanted_by, options.sheets),
    )
    sources = [source.find(search) for source in options.sources]
    visits: set[VisitKey] = set(search.visits).union(*(visits for _, visits in sources))
    collection, ordered, (covariates, absent, spelled) = read_in_order(
        collection,
        sorted(visits, key=lambda visit: (visit[0], visit[1] or "")),
        options.bids_dir,
        options.covariates,
        settings,
    )
    sheets = read.read_sheets(
        collection.records,
        collection.grid,
        [name for name in maps if name not in names],
        ordered,
        max_gap=settings.registration.max_gap,
    )
    reading = Reading(
        bids_dir=options.bids_dir, collection=collection, visits=ordered, measured=sheets
    )
    for source, _ in sources:
        reading = source.add(reading)
    if covariate_maps and reading.surfaces:
        raise ModelError(
            f"maps {listed(reading.surfaces)} are not on the grid of the sheet, but map() in the"
            " formula is; remove one"
        )
    measures = read.check_summaries(measures, reading.measured.sides)
    notes = [*spelled.notes, *_absence(absent, covariates, options)]
    if spelled:
        file = options.model.file and files.read_json(options.model.file)
        notes.append(spelled_note(spelled, options.model.formula or str(file), settings))
    study = _study(reading, covariates, measures, options, settings)
    study = replace(study, absent=absent, among=among, notes=(*study.notes, *notes))
    return study.take(
        members(study.cohort.table, among), ("not-asked", "another level than --among")
    )


def _choose_maps(
    options: GroupOptions, collection: collect.Collection, names: Sequence[str]
) -> tuple[Measures, Sequence[str]]:
    """Choose measures and the maps of covariates; ``names`` are the maps of sources."""
    requested = modeling.wanted_measures(options.model, options.measures)
    measures = read.choose_measures(requested, collection.records, names)
    covariate_maps = modeling.covariate_maps(options.model)
    if covariate_maps:
        of_covariates = read.choose_measures(covariate_maps, collection.records, names)
        if of_covariates.summaries:
            raise ModelError(f"map({of_covariates.summaries[0]}) in the formula: it is no map")
    return measures, covariate_maps


def _study(
    reading: Reading,
    covariates: pd.DataFrame,
    measures: Measures,
    options: GroupOptions,
    settings: GroupSettings,
) -> Study:
    """Choose the visits that are compared, and add ICV and time."""
    collection, measured, surfaces = reading.collection, reading.measured, reading.surfaces
    quality = _with_covariates(collection.quality, covariates, options, settings)
    all_visits = Cohort(
        table=with_factors(covariates, settings.design, settings.model),
        sides=measured.sides,
        x=measured.x,
        y=measured.y,
        units=measured.units,
        shared=measured.shared,
    )
    # A visit may have lost both of its hemispheres.
    cohorts = {SHEET: all_visits, **surfaces}
    rows = np.concatenate([side.rows for one in cohorts.values() for side in one.sides.values()])
    has_maps = np.isin(np.arange(len(all_visits.table)), rows)
    sessions = options.comparison.sessions
    cohort = all_visits.take(has_maps)
    is_compared, messages = sessions.choose(cohort.table)
    cohort = cohort.take(is_compared)
    keep = all_visits.table.index.isin(cohort.table.index)
    table, icv = add_icv(cohort.table, measured.sources, settings)
    time = None
    if sessions.is_repeated:
        time = sessions.with_visits(add_time(table, settings), settings)
    cohort = replace(cohort, table=table if time is None else time.table)
    reasons = messages[~is_compared].items()
    reasons_of = {str(visit): (sessions.reason, message) for visit, message in reasons}
    return Study(
        options=options,
        settings=settings,
        collection=collection,
        visits=cohort.table,
        cohorts={SHEET: cohort}
        | {name: replace(one.take(keep), table=cohort.table) for name, one in surfaces.items()},
        measures=replace(measures, maps=tuple(m for m in measures.maps if m not in surfaces)),
        icv=icv,
        time=time,
        exclusions=(
            *collection.exclusions,
            *measured.damaged,
            *collect.exclude_visits(measured.table, reasons_of),
        ),
        notes=(*collection.notes, *reading.notes, *_damaged(measured)),
        remarks=reading.remarks,
        quality=quality,
    )


def _absence(absent: frozenset[str], covariates: pd.DataFrame, options: GroupOptions) -> list[str]:
    """Note participants without a row in participants.tsv, or refuse to go on without many."""
    count, names = covariates[PARTICIPANT].nunique(), listed(sorted(absent))
    if len(absent) > _MOST_ABSENT * count and not options.allow_missing:
        raise InputError(
            f"participants.tsv: has no row of {len(absent)} of {count} participants: {names};"
            " correct the labels, or give --allow-missing",
            reason="bad-table",
        )
    note = f"participants.tsv: has no row of {names}; add it, or check its label"
    return [note] * bool(absent)


def _with_covariates(
    quality: pd.DataFrame,
    covariates: pd.DataFrame,
    options: GroupOptions,
    settings: GroupSettings,
) -> pd.DataFrame:
    """Add covariates to decisions; those of participants without any sheet are read."""
    if not len(quality):
        return quality
    keys = [PARTICIPANT, SESSION]
    visits = quality[keys].drop_duplicates()
    if not visits[PARTICIPANT].isin(covariates[PARTICIPANT]).all():
        visits = visits.set_axis(
            visits[PARTICIPANT].str.cat(visits[SESSION], "_", na_rep="").tolist()
        )
        covariates = read_covariates(visits, options.bids_dir, options.covariates, settings)[0]
    return quality.merge(covariates.drop_duplicates(keys), on=keys, how="left")


def _damaged(measured: read.Measured) -> tuple[str, ...]:
    lines = [
        f"{one.participant}{f' {one.session}' if one.session else ''}, hemisphere "
        f"{one.hemi}, is excluded: {one.message}; measure it again"
        for one in measured.damaged[:_MOST_NOTES]
    ]
    n_left = len(measured.damaged) - _MOST_NOTES
    return (
        (*lines, f"{n_left} more are excluded likewise, see excluded.tsv")
        if n_left > 0
        else (*lines,)
    )


def with_page(options: GroupOptions, result: GroupResult) -> GroupResult:
    """Add the page to results that were written, or why it could not be made."""
    page, problem = write_page(options.out_dir, result.folder.name, reports=options.reports)
    return replace(result, page=page, problem=problem)


def _describe_dataset(options: GroupOptions) -> None:
    """Describe the output dataset, if the participant level has not."""
    files.make_folder(options.out_dir)
    if not (options.out_dir / "dataset_description.json").exists():
        roots = [root for root in options.sheets.roots if root != options.out_dir]
        has_maps = any(source.has_maps for source in options.sources)
        roots += [options.bids_dir] if has_maps else []
        names = dataset.source_names((root.resolve().name, root) for root in roots)
        dataset.write_description(options.out_dir, names)
    dataset.write_notes(options.out_dir)


def _further_inputs(options: GroupOptions) -> dict[str, str | None]:
    """Record the files that options of extensions name."""
    names = {key: name for step in find_steps() for name, key in step.inputs.items()}
    paths = {key: options.further.get(name) for key, name in names.items()}
    return {key: path and str(path) for key, path in paths.items()}


def read_templates(path: Path | None, cohort: Cohort) -> Mapping[str, Template] | None:
    """Read the templates of an earlier analysis, if one is named."""
    if path is None:
        return None
    path = template_file(path)
    content = files.read_json(path)
    content = content.get("template") or content  # in the summary of another site
    templates = templates_from_json(content, str(path))
    if missing := sorted(set(cohort.sides) - set(templates)):
        raise ModelError(f"{path}: has no template of hemisphere {', '.join(missing)}")
    return templates


def folder_of(parts: Sequence[str], among: tuple[str, str] | None) -> str:
    """Name a folder of results by its question and its participants."""
    words = (*parts, *(among or ())[1:])
    return "_".join(ascii_letters(word, "-") for word in words)


def members(table: pd.DataFrame, among: tuple[str, str] | None, option: str = "--among") -> Bool:
    """Select the participants that are asked for."""
    if among is None:
        return np.ones(len(table), dtype=bool)
    column, level = among
    check_names([column], table.columns)
    values = table[column].map(lambda value: None if value is None else str(value))
    is_member = (values == level).to_numpy()
    if not is_member.any():
        raise ModelError(
            f"{option} {column}={level}: no participant has it; there are"
            f" {listed(sorted(values.dropna().unique()))}"
        )
    return np.asarray(is_member, dtype=bool)
