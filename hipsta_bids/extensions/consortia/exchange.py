"""What a site sends to other sites about an analysis, and how it is read: sums over people only.

A summary is one JSON file. All of its numbers are about the same participants, so that no
difference of two of them is about one person.
"""

import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
from pydantic import Field

from hipsta_bids import __version__
from hipsta_bids.errors import InputError, ModelError
from hipsta_bids.group.cohort.data import Cohort, grows_with_head, summary_values
from hipsta_bids.group.output.results import Analysis, templates_of
from hipsta_bids.group.questions.study import Study
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.io import files
from hipsta_bids.io.files import FileNumbers, Number, Text, read_foreign, rounded
from hipsta_bids.joints import Writer
from hipsta_bids.stats.arrays import Float, Int
from hipsta_bids.stats.design import Design, build_design
from hipsta_bids.stats.disclosure import check_cells, check_people, is_traceable
from hipsta_bids.stats.formula import typed
from hipsta_bids.stats.glm import FittedMaps, PointTest, fit_points, with_mean
from hipsta_bids.stats.grammar import closed_formula
from hipsta_bids.stats.settings import ExchangeSettings
from hipsta_bids.types.tables import TomlTable

#: File of a summary, in the folder of an analysis.
SUMMARY = "summary.json"
#: Changes when readers of earlier versions would misread a summary.
_FORMAT = 2
_AXES = "x from medial to lateral, y from posterior to anterior, on both sides"
#: Summaries larger than this many bytes are not read.
_MOST_BYTES = 50_000_000
#: Smaller counts are not shown.
_FEWEST = 5
#: Functions whose columns depend on who is in the table.
_OF_THE_SAMPLE = re.compile(r"(?<![\w.])(bs|center|cr|poly|scale)\s*\(")
Word = Annotated[str, Field(min_length=1, max_length=60, pattern=r"^[\w][\w .+-]*$")]
Name = Annotated[str, Field(min_length=1, max_length=200, pattern=r"^\w[\w .:+-]*$")]
Count = Annotated[int, Field(ge=0)] | Literal["<5"]
Numbers = list[Number]


class ModelSummary(TomlTable):
    """One model at each point of a map, or for summary measures."""

    kind: Literal["map", "summary"]
    """What the points are: those of the sheet, or summary measures."""
    hemi: Literal["L", "R", "LR"]
    measures: Annotated[list[Name], Field(min_length=1)]
    units: list[Text]
    formula: Text
    columns: Annotated[list[Text], Field(min_length=1, max_length=200)]
    df: Annotated[int, Field(ge=1)]
    """Residual degrees of freedom."""
    contrasts: Annotated[dict[Text, Numbers], Field(min_length=1)]
    """Weights of the columns."""
    sd: FileNumbers
    """(points,) residual standard deviation; null where a participant lacks a value."""
    estimate: dict[Text, FileNumbers]
    """(points,) by contrast."""
    se: dict[Text, FileNumbers]
    """(points,) by contrast."""
    subfield: list[Text | None] | None = None
    """(points,) of a map, most frequent."""

    @property
    def title(self) -> str:
        """Name in messages."""
        subject = self.measures[0] if self.kind == "map" else f"summary measures ({self.formula})"
        return f"{subject}, {self.hemi}"

    def check(self, points: int, participants: int) -> str | None:
        """Raise the first disagreement, if there is one."""
        points = points if self.kind == "map" else len(self.measures)
        rows: list[Sequence[object]] = [self.sd, *self.estimate.values(), *self.se.values()]
        rows += [] if self.subfield is None else [self.subfield]
        count = len(self.columns)
        sizes = [value for row in (self.sd, *self.se.values()) for value in row]
        problems = {
            f"numbers of points that are not {points}": any(len(row) != points for row in rows),
            f"weights of columns that are not {count}": any(
                len(row) != count for row in self.contrasts.values()
            ),
            "measures without units": len(self.units) != len(self.measures),
            "other degrees of freedom than participants": self.df != participants - count,
            "contrasts without estimates": not (
                self.contrasts.keys() == self.estimate.keys() == self.se.keys()
            ),
            "standard deviations or errors that are not positive": any(
                value is not None and value <= 0 for value in sizes
            ),
            "standard deviations or errors too close to zero": any(
                value is not None and value < 1 / files.LARGEST for value in sizes
            ),
        }
        return next((text for text, is_wrong in problems.items() if is_wrong), None)


class SiteSummary(TomlTable):
    """The content of a summary."""

    description: Text
    format: Literal[2]
    site: Word
    version: Text
    """Of hipsta_bids, at the group level."""
    versions: list[Text]
    """Of hipsta_bids, at the participant level."""
    seg: Text
    region: Text
    labels: dict[Text, list[Text]] = Field(default_factory=dict)
    """Values of each field of provenance of the labels."""
    settings_hash: Text
    """Of the settings of the participant level."""
    axes: Text
    x: Annotated[Numbers, Field(min_length=2, max_length=2000)]
    """Coordinates of the nodes of the sheet, medial to lateral."""
    y: Annotated[Numbers, Field(min_length=2, max_length=2000)]
    """Posterior to anterior."""
    asymmetry: list[Text]
    """Measures whose left minus right is relative."""
    change: bool
    """Whether rows are changes between two sessions."""
    align: Text
    template: dict[str, Any] | None
    """Template of registration, as in ``template.json``; ``None`` without registration."""
    participants: Annotated[int, Field(ge=1)]
    groups: dict[Text, Count]
    """Participants by group, the reference first; empty without groups."""
    factors: dict[Text, dict[Text, Count]]
    """Participants by level of each factor of the model, the reference level first."""
    covariates: dict[Text, dict[Literal["mean", "sd"], Number]]
    """Of the numbers of the model."""
    models: Annotated[list[ModelSummary], Field(min_length=1, max_length=500)]

    @property
    def template_hash(self) -> str:
        """Hash of the template, or ``none``."""
        if self.template is None:
            return "none"
        text = json.dumps(self.template, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def shown_counts(counts: Mapping[str, Count]) -> dict[str, int | str]:
    """Hide counts below five; then other counts are hidden too, as their sum is known."""
    levels = {level for level, n in counts.items() if n == "<5" or n < _FEWEST}
    if not levels:
        return dict(counts)
    return {level: "<5" if level in levels else f"{_FEWEST}+" for level in counts}


def prepare_summary(study: Study, analysis: Analysis, site: str) -> tuple[Writer, list[str]]:
    """Make the summary of an analysis for other sites; an empty ``site`` is the dataset's name.

    Returns what writes it into the folder of the analysis, and notes. ModelError as `summarize`.
    """
    options, collection = study.options, study.collection
    summary, notes = summarize(
        study.cohort,
        analysis,
        study.settings,
        site=site or options.bids_dir.resolve().name,
        inputs={
            "versions": list(collection.versions),
            "seg": collection.records[0].result.name.seg if collection.records else "none",
            "region": options.sheets.region,
            "labels": study.labels,
            "settings_hash": collection.settings_hash,
        },
    )
    return lambda folder: write_summary(folder / SUMMARY, summary), notes


def write_summary(path: Path, summary: Mapping[str, Any]) -> None:
    """Write a summary, one entry per line."""
    lines = [f"{json.dumps(key)}: {json.dumps(value)}" for key, value in summary.items()]
    files.write_text(path, "{\n" + ",\n".join(lines) + "\n}\n")


def read_summary(path: Path) -> SiteSummary:
    """Read and check a summary of another site, which may hold anything."""
    if path.is_dir() and not (path := path / SUMMARY).exists():
        raise InputError(f"{path}: no summary; it is written by `group --export-summary`")
    try:
        summary = read_foreign(path, SiteSummary, max_bytes=_MOST_BYTES)
        _ = summary.template_hash
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not a summary: {error}; ask the site for it again") from error
    for model in summary.models:
        points = len(summary.x) * len(summary.y)
        if problem := model.check(points, summary.participants):
            raise InputError(f"{path}: {model.title} has {problem}; ask the site for it again")
    return summary


def summarize(
    cohort: Cohort,
    analysis: Analysis,
    settings: GroupSettings,
    *,
    site: str,
    inputs: Mapping[str, Any],
) -> tuple[dict[str, Any], list[str]]:
    """Make the summary of an analysis of linear models, and note its omissions.

    The cohort has coordinates and units; ``inputs`` are ``seg``, ``region``, ``labels``,
    ``settings_hash`` and ``versions`` of the sheets. ModelError if so few participants are behind a
    number that it could be traced to one of them.
    """
    _check_model(analysis, settings)
    rows: Int = analysis.design.rows
    for side in analysis.compared.sides.values():
        rows = np.intersect1d(rows, side.rows)
    notes = []
    if lacking := len(analysis.design.rows) - len(rows):
        notes.append(f"{SUMMARY}: without {lacking} participants who lack a hemisphere")
    sample = _most_complete(analysis, rows, settings.of(ExchangeSettings).min_cell)
    try:
        summary, omissions = _summarize(
            cohort, analysis, settings, sample, site=site, inputs=inputs
        )
    except ModelError:
        if len(sample) == len(rows):
            raise
        sample = rows
        summary, omissions = _summarize(cohort, analysis, settings, rows, site=site, inputs=inputs)
    if omitted := len(rows) - len(sample):
        notes.append(f"{SUMMARY}: without {omitted} participants who lack values at many points")
    return summary, notes + omissions


def _most_complete(analysis: Analysis, rows: Int, least: int) -> Int:
    """Choose rows, all or without the least complete, that have most values at complete points.

    At least ``least`` rows are omitted, and at most a tenth, if this is more.
    """
    blocks = [
        np.isnan(side.maps.maps[measure][np.searchsorted(side.maps.rows, rows)])
        for side in analysis.fitted.values()
        for measure in side.fits
    ]
    missing = (
        np.hstack([b.reshape(len(rows), -1) for b in blocks])
        if blocks
        else np.zeros((len(rows), 0), dtype=np.bool_)
    )
    missing = missing[:, ~missing.all(axis=0)]
    order, left = np.arange(len(rows)), np.ones(len(rows), dtype=np.bool_)
    options = [(int((~missing.any(axis=0)).sum()) * len(rows), rows)]
    for n_omitted in range(1, min(max(least, len(rows) // 10), len(rows) - 1) + 1):
        is_last = missing[left].sum(axis=0) == 1
        freed = missing[left] @ is_last.astype(np.int64)
        # Participants who alone lack a point are omitted first, then those who lack most.
        first = np.lexsort((missing[left].sum(axis=1), freed))[-1]
        left[order[left][first]] = False
        if n_omitted >= least:
            n_points = int((~missing[left].any(axis=0)).sum())
            options.append((n_points * int(left.sum()), rows[left]))
    return max(options, key=lambda option: option[0])[1]


def _designs(
    table: pd.DataFrame, analysis: Analysis, settings: GroupSettings
) -> tuple[dict[str, Design], list[str]]:
    """Build the design of each formula for some participants, and note what is omitted."""
    designs, notes = {}, []
    for formula in dict.fromkeys((analysis.model.formula, *(f for _, f in analysis.measures))):
        # Anew, since contrasts may hold means over all participants.
        spec = replace(analysis.model, formula=formula)
        rebuilt = build_design(table, spec, settings.design, analysis.design.references)
        if lacking := len(table) - len(rebuilt.rows):
            notes.append(f"{SUMMARY}: without {formula}: {lacking} participants lack a variable")
        else:
            designs[formula] = replace(rebuilt, contrasts=with_mean(rebuilt))
    return designs, notes


def _missing_note(model: Mapping[str, Any]) -> Iterator[str]:
    """Note points or measures of a model that the summary omits."""
    if missing := model["sd"].count(None):
        is_map = model["kind"] == "map"
        yield (
            f"{SUMMARY}: {model['measures'][0] if is_map else 'summaries'}, {model['hemi']}:"
            f" without {missing} {'points' if is_map else 'measures'} that are not known of all"
            " participants, or differ in few"
        )


def _summarize(
    cohort: Cohort,
    analysis: Analysis,
    settings: GroupSettings,
    rows: Int,
    *,
    site: str,
    inputs: Mapping[str, Any],
) -> tuple[dict[str, Any], list[str]]:
    """Make the summary of the participants in ``rows``, and note its omissions."""
    compared = analysis.compared
    table = compared.table.iloc[rows]
    designs, notes = _designs(table, analysis, settings)
    references = analysis.design.references.items()
    factors = {name: _counts(typed(table[name]), first) for name, first in references}
    groups = {}
    if analysis.groups is not None:
        column = table[analysis.groups.column]
        check_cells({analysis.groups.column: column}, settings.of(ExchangeSettings).min_cell)
        groups = _counts(column, analysis.groups.reference)
    names = {name for formula in designs for name in closed_formula(formula).names}
    first = analysis.groups.column if analysis.groups else None
    variables = {name: typed(table[name]) for name in sorted(names, key=lambda n: (n != first, n))}
    cells = check_people([*designs.values()], variables, settings.of(ExchangeSettings))
    models = list(_models(compared, analysis, rows, designs, settings, cells=cells))
    if not models:
        raise ModelError(
            "--export-summary: nothing to export; maps of other programs are not in a summary"
        )
    for model in models:
        model["units"] = [cohort.units.get(name, "1") for name in model["measures"]]
        notes += _missing_note(model)
    is_change = bool(analysis.comparison.sessions.later)
    numbers = {
        name: typed(table[name]).astype(np.float64)
        for name in closed_formula(analysis.model.formula).names
        if name not in factors
    }
    return {
        "description": "results of one site for a meta-analysis with hipsta_bids; no values of"
        " single participants",
        "format": _FORMAT,
        "site": site,
        "version": __version__,
        **inputs,
        "axes": _AXES,
        "x": cohort.x.tolist(),
        "y": cohort.y.tolist(),
        "asymmetry": [] if is_change else list(settings.asymmetry.relative),
        "change": is_change,
        "align": settings.registration.align,
        "template": files.plain(templates_of(analysis.registrations)),
        "participants": len(rows),
        "groups": groups,
        "factors": factors,
        "covariates": {
            name: {"mean": rounded(values.mean()), "sd": rounded(values.std())}
            for name, values in numbers.items()
        },
        "models": models,
    }, notes


def _counts(values: pd.Series, first: str) -> dict[str, int]:
    """Count participants by level, the reference first."""
    counts = values.dropna().astype(str).value_counts()
    return {
        level: int(counts[level]) for level in sorted(counts.index, key=lambda x: (x != first, x))
    }


def _check_model(analysis: Analysis, settings: GroupSettings) -> None:
    """Refuse models whose coefficients other sites could not use."""
    problem = None
    if analysis.comparison.sessions.is_repeated:
        problem = "of --longitudinal cannot be combined; use --paired"
    elif analysis.model.added:
        problem = "with map() cannot be combined; remove the term"
    elif analysis.is_adjusted:
        problem = "of harmonized values cannot be combined; leave --harmonize out"
    elif settings.glm.covariance != "ordinary":
        problem = "with HC3 standard errors cannot be combined; exclude these"
    elif match := _OF_THE_SAMPLE.search(analysis.model.formula):
        problem = (
            f"with {match[1]}() has other columns at each site; write numbers that are the same"
            " everywhere, as I((age - 65) / 10)"
        )
    elif not any(c.n_rows == 1 and not c.side for c in analysis.design.contrasts):
        problem = "has no two-sided contrast of one row; others cannot be combined"
    if problem is not None:
        raise ModelError(f"--export-summary: a model {problem}")


def _models(
    compared: Cohort,
    analysis: Analysis,
    rows: Int,
    designs: Mapping[str, Design],
    settings: GroupSettings,
    *,
    cells: Sequence[Int],
) -> Iterator[dict[str, Any]]:
    """Models of maps, and of summary measures, of the participants in ``rows``."""
    formula = analysis.model.formula
    for hemi, one in analysis.fitted.items():
        places = np.searchsorted(one.maps.rows, rows)
        for measure, fit in one.fits.items():
            values = one.maps.maps[measure][places].reshape(len(rows), -1)
            yield {
                "kind": "map",
                "hemi": hemi,
                "measures": [measure],
                "formula": formula,
                "subfield": _subfields(one),
                **_model(values, designs[formula], fit.tests, settings, cells),
            }
    for (hemi, model_formula), (_, fit, _) in analysis.measures.items():
        if model_formula not in designs:
            continue
        table = summary_values(compared, hemi, analysis.measured.summaries).iloc[rows]
        # Also those that do not vary here, so that all sites have the same measures.
        adjusted = model_formula != formula
        names = [str(c) for c in table if not adjusted or grows_with_head(str(c))]
        values = table[names].to_numpy(dtype=np.float64)
        yield {
            "kind": "summary",
            "hemi": hemi,
            "measures": names,
            "formula": model_formula,
            **_model(values, designs[model_formula], fit.tests, settings, cells),
        }


def _subfields(fitted: FittedMaps) -> list[str | None]:
    names = [*fitted.maps.names, None]
    return [names[number] for number in fitted.subfield.ravel().tolist()]


def _model(
    values: Float,
    design: Design,
    tests: Sequence[PointTest],
    settings: GroupSettings,
    cells: Sequence[Int],
) -> dict[str, Any]:
    """Fit the model where all participants have a value, and spell the results."""
    names = [test.contrast.name for test in tests]
    contrasts = [c for c in design.contrasts if c.n_rows == 1 and not c.side and c.name in names]
    complete = np.isfinite(values).all(axis=0)
    fit = fit_points(np.where(complete, values, 0.0), design.matrix, contrasts, settings.glm)
    traceable = is_traceable(values, cells, settings.of(ExchangeSettings).min_cell)
    usable = complete & np.isfinite(fit.sigma) & ~traceable

    def known(numbers: Float) -> list[Any]:
        return rounded(np.where(usable, numbers, np.nan))  # type: ignore[no-any-return]

    return {
        "columns": list(design.columns),
        "df": len(design.matrix) - len(design.columns),
        "contrasts": {contrast.name: contrast.weights[0].tolist() for contrast in contrasts},
        "sd": known(fit.sigma),
        "estimate": {test.contrast.name: known(test.estimate[0]) for test in fit.tests},
        "se": {test.contrast.name: known(test.se[0]) for test in fit.tests},
    }
