"""Agreement of repeated sessions and sample sizes of trials, from files to files."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from hipsta_bids import __version__
from hipsta_bids.derivatives import dataset
from hipsta_bids.errors import ModelError
from hipsta_bids.extensions.trials import EXTENSION
from hipsta_bids.extensions.trials import sizes as trials
from hipsta_bids.extensions.trials.figures import agreement_rows, size_rows
from hipsta_bids.extensions.trials.methods import power_text, retest_text
from hipsta_bids.extensions.trials.page import TABLES
from hipsta_bids.extensions.trials.settings import PowerSettings, RetestSettings
from hipsta_bids.group import model as modeling
from hipsta_bids.group.cohort.covariates import order_sessions
from hipsta_bids.group.cohort.data import SHEET, SUMMARY, Cohort, Layer, layers, participants_with
from hipsta_bids.group.output import write
from hipsta_bids.group.output.citations import Citations, code, escaped
from hipsta_bids.group.output.columns import frame_of
from hipsta_bids.group.output.ground import grounds_of
from hipsta_bids.group.output.methods import COMMON_SHEETS
from hipsta_bids.group.output.panels import draw_pages
from hipsta_bids.group.output.style import Drawing
from hipsta_bids.group.output.tables import entity_label, read_columns
from hipsta_bids.group.questions import study as studies
from hipsta_bids.group.questions.mixing import with_mixes
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.io import files, gifti
from hipsta_bids.progress import tell
from hipsta_bids.stats import glm
from hipsta_bids.stats.arrays import Bool, Float, Int, SideMaps, describe_known, mean_of_known
from hipsta_bids.stats.design import build_design
from hipsta_bids.stats.formula import listed, model_from_shortcut, parse_model
from hipsta_bids.stats.glm import FittedMaps, PointwiseFit, RowModel, fit_maps, points_of
from hipsta_bids.stats.mixed import longitudinal_model
from hipsta_bids.stats.settings import GlmSettings
from hipsta_bids.types import PARTICIPANT, SESSION

#: Maps, by the value of ``stat-``: the tables that have them, the column, and the unit; none
#: is that of the map.
MAPS: dict[str, tuple[str, str, str]] = {
    "icc": ("retest", "icc", "1"),
    "sdwithin": ("retest", "sd_within", ""),
    "mdc": ("retest", "detectable_change", ""),
    "n": ("power", "per_arm", "1"),
}
#: Months per unit of columns of time with these names.
_MONTHS = {"years": 12.0, "months": 1.0, "days": 12 / 365.25}
#: Sessions that distinguish a participant's change from noise.
_SLOPE_SESSIONS = 3


Tables = dict[str, Mapping[str, Any]]
"""Columns of the tables of each question, ``retest`` and ``power``."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Described:
    """Facts about a layer."""

    layer: Layer
    tables: Tables
    reference: trials.Reference
    data: Float
    """(rows, points) that it rests on."""
    points: FittedMaps | None
    """Where the points are; ``None`` for a summary measure."""


class Retested:
    """Means and variances of repeated sessions, of the participants who have all of them."""

    time: str | None = None

    rows: Int | None = None
    """Rows of the table of which summary measures are taken; all."""

    def __init__(
        self, cohort: Cohort, settings: GroupSettings, *, has_visits: bool = False
    ) -> None:
        """Take variances of one visit of a trial, or of several."""
        self._has_visits, self._settings = has_visits, settings.of(RetestSettings)
        table = cohort.table
        counts = table[SESSION].fillna("").value_counts()
        self.sessions = tuple(order_sessions(table, settings))
        session_counts = table[PARTICIPANT].map(table.groupby(PARTICIPANT)[SESSION].nunique())
        self.complete: Bool = (session_counts == len(self.sessions)).to_numpy()
        self._table = table[self.complete]
        self.participants = sorted(self._table[PARTICIPANT].unique())
        names = [*[""] * ("" in counts.index), *self.sessions]
        sessions_text = listed([f"{name or 'without a name'} ({counts[name]})" for name in names])
        if len(self.sessions) < 2:  # noqa: PLR2004 -- two sessions
            raise ModelError(
                f"--retest: there is no second session, only {sessions_text}; measure repeated"
                " sessions first"
            )
        if len(self.participants) < self._settings.min_participants:
            raise ModelError(
                f"--retest: {len(self.participants)} participants have all sessions "
                f"{sessions_text}, of {self._settings.min_participants} needed; name other "
                "sessions by --session-label"
            )

    def arrange(self, values: Float, rows: Int) -> Float:
        """Arrange values of visits as (participants, sessions, points); NaN where missing.

        ``rows`` are rows of the table of all complete visits.
        """
        visits = self._table.iloc[rows]
        filled = np.full((len(self.participants), len(self.sessions), values.shape[1]), np.nan)
        participant = np.searchsorted(self.participants, visits[PARTICIPANT].astype(str))
        session = pd.Index(self.sessions).get_indexer(pd.Index(visits[SESSION]))
        filled[participant, session] = values
        return filled

    def describe(self, layer: Layer) -> Described:
        """Describe the agreement of sessions at each point, and mean and variance."""
        data = layer.data
        values = self.arrange(data, layer.rows)
        agreed = trials.repeatability(
            values, confidence=self._settings.confidence, least=self._settings.min_participants
        )
        # Of one visit, the variance between and within; of several, that within.
        n = agreed["n"]
        freedom = n * (len(self.sessions) - 1) if self._has_visits else n - 1
        between = 0.0 if self._has_visits else agreed["sd_between"] ** 2
        reference = trials.Reference(
            n=n,
            mean=agreed["mean"],
            variance=agreed["sd_within"] ** 2 + between,
            freedom=np.maximum(freedom, 1.0),
            mean_limits=agreed["mean"] + _reach(mean_of_known(values, 1), self._settings),
        )
        return Described(
            layer=layer,
            tables={"retest": agreed},
            reference=reference,
            data=data,
            points=points_of(layer.source) if isinstance(layer.source, SideMaps) else None,
        )

    def words(self, cite: Callable[[str], str]) -> str:
        """Name what means and variances rest on."""
        text = f"these repeated sessions {cite('bland')}"
        if self._has_visits:
            text += (
                ". True changes were assumed equal in all participants, so that sample sizes are"
                " lower limits"
            )
        return text


class Modeled:
    """Means, changes and variances of a cohort, by a model of its visits."""

    def __init__(
        self,
        cohort: Cohort,
        request: modeling.ModelRequest,
        settings: GroupSettings,
        visits: modeling.VisitTime | None = None,
    ) -> None:
        table, covariates = cohort.table, None
        self.time: str | None = None
        if visits is not None:
            self.time, covariates = visits.column, visits.covariates
            _check_times(table, self.time, settings)
        formula = request.formula or modeling.default_formula(
            table, None, settings, covariates=covariates, time=self.time
        )
        contrasts = [self.time] if self.time else []
        self.spec = parse_model(model_from_shortcut(formula, contrasts, "reference"))
        design = build_design(table, self.spec, settings.design, dict(request.references))
        self._table, self._settings = table, settings
        self.model = RowModel(replace(design, contrasts=()), settings.glm)
        if self.time is not None:
            slopes = settings.longitudinal.changed(random="slope")
            self.model = longitudinal_model(design, table, self.time, settings.glm, slopes)

    @property
    def months(self) -> float:
        """Months per unit of time."""
        return _MONTHS.get(
            str(self.time).casefold(), self._settings.of(PowerSettings).months_per_time
        )

    @property
    def follow_up(self) -> float:
        """Months from the earliest to the latest visit."""
        if self.time is None:
            return 0.0
        times = self._table[self.time].to_numpy(dtype=np.float64)
        return float(np.ptp(times[np.isfinite(times)])) * self.months

    @property
    def rows(self) -> Int:
        """Rows of the table of which summary measures are taken: the model's."""
        return self.model.design.rows

    def describe(self, layer: Layer) -> Described:
        """Fit the model, and describe mean, change and variances at each point."""
        points = None
        if isinstance(layer.source, SideMaps):
            points = fit_maps(layer.hemi, layer.source, self.model)
            data, fit = points.values(layer.measure), points.fits[layer.measure]
            rows = layer.rows[points.used]
        else:
            rows, data = layer.rows, layer.data
            rows_known = np.flatnonzero(np.isfinite(data[:, 0]))
            contrasts = self.model.design.contrasts
            fit = self.model.fit_measures(data[rows_known], rows_known, contrasts)
        return Described(
            layer=layer,
            tables={},
            reference=self._reference(rows, data, fit),
            data=data,
            points=points,
        )

    def _reference(self, rows: Int, values: Float, fit: PointwiseFit) -> trials.Reference:
        """At one visit with the residual variance; over time with changes and both variances."""
        participants = self._table[PARTICIPANT].iloc[rows].to_numpy()
        n = participants_with(np.isfinite(values), participants)
        mean = mean_of_known(values, 0)
        people = np.unique(participants.astype(str), return_inverse=True)[1]
        counts = glm.sum_by(people, np.isfinite(values).astype(np.float64))
        person_means = glm.sum_by(people, np.nan_to_num(values)) / np.where(
            counts > 0, counts, np.nan
        )
        plain = trials.Reference(
            n=n,
            mean=mean,
            variance=fit.sigma**2,
            freedom=np.maximum(n - float(len(self.model.design.columns)), 1.0),
            mean_limits=mean + _reach(person_means, self._settings.glm),
        )
        if self.time is None:
            return plain
        months = self._table[self.time].iloc[rows].to_numpy(dtype=np.float64) * self.months
        visits = glm.sum_by(people, np.stack([np.ones_like(months), months, months**2], axis=1))
        spreads = visits[:, 2] - visits[:, 1] ** 2 / visits[:, 0]
        (test,) = (test for test in fit.tests if test.contrast.name == self.time)
        slope, se = test.estimate[0] / self.months, test.se[0] / self.months
        reach = stats.t.ppf((1 + self._settings.glm.confidence) / 2, test.df) * se
        return replace(
            plain,
            variance=fit.variances["residual"],
            slope=slope,
            slope_limits=np.stack([slope - reach, slope + reach]),
            slope_variance=fit.variances["slope"] / self.months**2,
            slope_freedom=test.df,
            spread=float(1 / np.mean(1 / spreads[spreads > 0])),
            freedom=np.maximum(np.isfinite(values).sum(axis=0) - 2.0 * n, 1.0),
        )

    def words(self, cite: Callable[[str], str]) -> str:
        """Name what means, changes and variances rest on."""
        model = code(self.spec.formula)
        if self.time is None:
            return f"these participants, with a linear model {model}"
        unit = "a month" if self.months == 1 else f"{self.months:.3g} months"
        return (
            f"these participants, with a linear mixed model {model} with random intercepts and"
            f" slopes of participants {cite('mixed')}. One unit of {escaped(self.time)} was {unit}"
        )


Source = Retested | Modeled


def _reach(means: Float, settings: GlmSettings | RetestSettings) -> Float:
    """Limits (2, points) around the mean of participants' means (participants, points)."""
    finite, _, sd = describe_known([means])
    count = np.maximum(finite.sum(axis=0), 2)
    reach = stats.t.ppf((1 + settings.confidence) / 2, count - 1) * sd / np.sqrt(count)
    return np.stack([-reach, reach])


def _check_times(table: pd.DataFrame, time: str | None, settings: GroupSettings) -> None:
    """Refuse a reference in which change cannot be distinguished from noise."""
    if time is None:
        raise ModelError(
            "--power with --visits needs the time of each session of the reference: a column"
            f" {', '.join(settings.longitudinal.time_columns)}, acq_time or age in sessions.tsv"
        )
    if table[PARTICIPANT].value_counts().max() < _SLOPE_SESSIONS:
        raise ModelError(
            "--power with --visits: no reference participant has three sessions to estimate "
            "changes; remove --visits, or give --retest"
        )


def run_trial(
    options: studies.GroupOptions,
    settings: GroupSettings,
    *,
    retest: bool = False,
    effect: trials.TrialEffect | None = None,
    among: tuple[str, str] | None = None,
) -> studies.GroupResult:
    """Measure the agreement of sessions, or sample sizes, and write all results or none.

    ``effect`` is of a trial whose size is asked for, by the ``retest`` if there is one, and
    ``among`` are column and level of the participants.
    """
    dataset.check_own_dataset(options.out_dir)
    if effect is not None:
        # Refuses before anything is read.
        trials.point_level(settings.multiplicity, settings.of(PowerSettings))
    visits = bool(effect and effect.visits)
    sessions = modeling.AllSessions() if retest or visits else modeling.Sessions()
    options = replace(options, comparison=modeling.Comparison(sessions=sessions))
    study = studies.read_study(options, settings, among)
    source: Source
    if retest:
        source = Retested(study.cohort, settings, has_visits=visits)
        message = "the participant lacks one of the sessions " + " ".join(source.sessions)
        study = study.take(source.complete, ("incomplete-sessions", message))
    study = study.with_alignment()
    cohort = study.cohort
    templates, cohorts, tables = study.register(studies.read_templates(options.template, cohort))
    tell("points and measures")
    if not retest:
        source = Modeled(cohort, options.model, settings, study.time)
        lacking = source.model.design.dropped
        study.left_out.update(study.incomplete(lacking, cohort.table[PARTICIPANT]))
    modeled = cohort.table if source.rows is None else cohort.table.iloc[source.rows]
    study = with_mixes(study, modeled, ())
    maps, summaries = study.measures.maps, study.measures.summaries
    results = [
        source.describe(layer)
        for layer in layers(cohorts, maps, summaries, source.rows)
        if layer.surface != SUMMARY or np.unique(layer.data[np.isfinite(layer.data)]).size > 1
    ]
    if effect is not None:
        for result in results:
            result.tables.update(_sample_sizes(effect, result, settings))

    def fill(folder: Path) -> list[str]:
        _write_tables(folder, cohorts, results)
        _write_maps(folder, cohorts, results)
        if templates:
            files.write_json(folder / "template.json", templates)
        files.write_text(folder / "methods.md", _methods(study, source, modeled, results, effect))
        return write.write_figures(folder, _figures(cohorts, results), prints=options.figures)

    return study.write(
        _folder(effect, among, retest=retest),
        _notes(source, results, study, effect),
        visits=modeled,
        tables=tables,
        meaning=read_columns(EXTENSION.package),
        record=_record(study, source, modeled, effect) | {"among": among},
        fill=fill,
    )


def _folder(
    effect: trials.TrialEffect | None, among: tuple[str, str] | None, *, retest: bool
) -> str:
    words = ["retest"] if retest else []
    if effect is not None:
        words.append(f"power-{effect.kind}-{100 * effect.share:g}".replace(".", "p"))
    return studies.folder_of(words, among)


def _sample_sizes(effect: trials.TrialEffect, result: Described, settings: GroupSettings) -> Tables:
    """Return columns of sample sizes; the mean of values of both signs has no share.

    Such a map has none, a summary measure keeps its row.
    """
    moments, single = result.reference, result.layer.surface == SUMMARY
    finite = result.data[np.isfinite(result.data)]
    if effect.kind == trials.THINNING and finite.min(initial=1.0) <= 0:
        if not single:
            return {}
        moments = replace(moments, mean=np.full_like(moments.mean, np.nan))
    plan = settings.of(PowerSettings)
    alpha = plan.alpha if single else trials.point_level(settings.multiplicity, plan)
    confidence = settings.glm.confidence if single else None
    size = trials.sample_size(effect, moments, plan, alpha=alpha, confidence=confidence)
    return {"power": size}


def _record(
    study: studies.Study, source: Source, visits: pd.DataFrame, effect: trials.TrialEffect | None
) -> dict[str, Any]:
    """Return the record of the model or the sessions, and of the trial."""
    settings, people = study.settings, int(visits[PARTICIPANT].nunique())
    power = {
        "alpha_point": trials.point_level(settings.multiplicity, settings.of(PowerSettings)),
        "most": trials.MOST_PARTICIPANTS,
    }
    return {
        "formula": source.spec.formula if isinstance(source, Modeled) else None,
        "hemispheres": {hemi: len(side.rows) for hemi, side in study.cohort.sides.items()},
        "retest": {"participants": people, "sessions": source.sessions}
        if isinstance(source, Retested)
        else None,
        "power": effect and asdict(effect) | power,
    }


def _notes(
    source: Source,
    results: Sequence[Described],
    study: studies.Study,
    effect: trials.TrialEffect | None,
) -> Iterator[str]:
    if isinstance(source, Retested) and (n := int((~source.complete).sum())):
        yield f"{n} visits of participants who lack a session are excluded, see excluded.tsv"
    if effect is None:
        return
    if signed := dict.fromkeys(r.layer.measure for r in results if "power" not in r.tables):
        yield (
            f"{', '.join(signed)}: no sample sizes, since it has values of both signs, whose share"
            " means nothing"
        )
    if isinstance(source, Modeled) and effect.duration > source.follow_up:
        yield (
            f"the trial lasts {effect.duration:g} months, the reference "
            f"{source.follow_up:.3g}; the estimate assumes that change continues linearly"
        )
    if isinstance(source, Retested) and effect.visits:
        yield (
            "sample sizes include only the variance of measurement; participants also "
            "differ in change, so trials need more"
        )
    if n_later := sum(exclusion.reason == "later-session" for exclusion in study.exclusions):
        yield f"{n_later} later sessions are not in it; --visits takes all"


def _methods(
    study: studies.Study,
    source: Source,
    visits: pd.DataFrame,
    results: Sequence[Described],
    effect: trials.TrialEffect | None,
) -> str:
    """Describe what was done, with the works it rests on."""
    settings, cite = study.settings, Citations()
    among = f" ({escaped(' '.join(study.among))})" if study.among else ""
    surfaces = dict.fromkeys(result.layer.surface for result in results)
    external = [name for name in surfaces if name not in {SHEET, SUMMARY}]
    subject = f"Maps of {', '.join(external)}"
    if len(external) < len(surfaces):
        subject = f"Measures of the hippocampal body {cite('method')}"
    first = (
        f"{subject} of {visits[PARTICIPANT].nunique()} participants{among} with"
        f" {len(visits)} visits were analyzed with hipsta_bids {__version__}."
    )
    shared = study.cohort.shared and SHEET in surfaces
    first += COMMON_SHEETS * shared
    if SHEET in surfaces and settings.registration.align != "none":
        owner = "participant" if shared else "session"
        first += (
            f" Sheets of each {owner} were registered by their curvature profiles"
            f" {cite('registr')}."
        )
    elif SHEET in surfaces:
        first += " Sheets were not registered to each other."
    if external:
        first += (
            f" Maps of other programs ({', '.join(external)}) were analyzed without registration."
        )
    paragraphs = [first]
    if isinstance(source, Retested):
        paragraphs.append(
            retest_text(
                len(source.sessions), len(source.participants), settings.of(RetestSettings), cite
            )
        )
    if effect is not None:
        paragraphs.append(power_text(effect, settings, source.words, cite))
    return cite.page(paragraphs, study.options.sheets.region)


def _write_tables(
    folder: Path, cohorts: Mapping[str, Cohort], results: Sequence[Described]
) -> None:
    """Write a table per question and surface; of summary measures the smallest trial first."""
    for question, (summary_title, points_title) in TABLES.items():
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
            write.write_table(folder, title, table, meaning=read_columns(EXTENSION.package))


def _write_maps(folder: Path, cohorts: Mapping[str, Cohort], results: Sequence[Described]) -> None:
    """Write surfaces and maps as GIFTI."""
    for result in results:
        layer = result.layer
        if result.points is None:
            continue
        write.write_surface(folder, cohorts[layer.surface], result.points, layer.hemi)
        units = {"1": "1", "": layer.unit}
        for stat, (question, column, unit) in MAPS.items():
            if question in result.tables:
                stem = f"hemi-{layer.hemi}_stat-{stat}_desc-{entity_label(layer.measure)}_statmap"
                values = np.asarray(result.tables[question][column], dtype=np.float64)
                content = gifti.shape_bytes(values, hemi=layer.hemi, name=stem, unit=units[unit])
                files.write_bytes(folder / f"{stem}.shape.gii", content)


def _figures(
    cohorts: Mapping[str, Cohort], results: Sequence[Described]
) -> Iterator[tuple[str, Drawing]]:
    """List the figures of each map by name."""
    maps = [result for result in results if result.points is not None]
    for surface, measure in dict.fromkeys((r.layer.surface, r.layer.measure) for r in maps):
        for question, make in (("retest", agreement_rows), ("power", size_rows)):
            sides = {
                r.layer.hemi: r
                for r in maps
                if (r.layer.surface, r.layer.measure) == (surface, measure) and question in r.tables
            }
            unit = cohorts[surface].units.get(measure, "1")
            tables = {hemi: result.tables[question] for hemi, result in sides.items()}
            if rows := list(make(tables, measure, unit)):
                points = {hemi: r.points for hemi, r in sides.items() if r.points is not None}
                grounds = grounds_of(cohorts[surface], points)
                yield f"{measure}_{question}", partial(draw_pages, grounds, [rows])
