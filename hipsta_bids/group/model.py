"""Which model is fitted: the user's, or the paper's default."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from hipsta_bids.errors import ModelError, UsageError
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.io import files
from hipsta_bids.stats import formula as formulas
from hipsta_bids.stats.design import AGES
from hipsta_bids.stats.formula import declared_levels, folder_name
from hipsta_bids.stats.grammar import closed_formula
from hipsta_bids.stats.marginal import NONLINEAR
from hipsta_bids.stats.references import choose_reference
from hipsta_bids.stats.visits import VISIT, check_endpoint, visit_contrasts
from hipsta_bids.types import PARTICIPANT, SESSION

#: Both sides of a participant, in names of hemispheres.
BOTH = "LR"


@dataclass(frozen=True)
class Groups:
    """The column of the groups, and their order."""

    column: str
    levels: tuple[str, ...]
    """The reference first, the other levels in the order of the alphabet."""

    @property
    def reference(self) -> str:
        """The level that the other levels are compared with."""
        return self.levels[0]

    def contrasts(self) -> list[str]:
        """Each other level against the reference: positive where the reference has more."""
        first = f"{self.column}[{self.reference}]"
        return [
            f"{self.reference}-{level} = {first} - {self.column}[{level}]"
            for level in self.levels[1:]
        ]


def find_groups(
    table: pd.DataFrame, settings: GroupSettings, reference: str | None = None
) -> Groups | None:
    """Find the column of groups and their reference level."""
    by_name = {str(column).casefold(): str(column) for column in table.columns}
    for name in settings.model.group_columns:
        column = by_name.get(name.casefold())
        values = formulas.typed(table[column]).dropna() if column else None
        if column is None or values is None or values.nunique() < 2:  # noqa: PLR2004 -- two groups
            continue
        counts = Counter(formulas.level_name(value) for value in values)
        formulas.check_spelling(counts, column)
        ordered = sorted(counts, key=formulas.in_order)
        words, declared = settings.design.reference_levels, declared_levels(table[column])
        first = choose_reference(ordered, words, requested=reference, declared=declared).level
        if first not in counts:
            available = ", ".join(sorted(counts))
            raise ModelError(
                f"model: no participant has {column!r} {first!r}; there are {available}"
            )
        return Groups(column, (first, *(level for level in ordered if level != first)))
    return None


def default_formula(
    table: pd.DataFrame,
    groups: Groups | None,
    settings: GroupSettings,
    *,
    covariates: Sequence[str] | None = None,
    time: str | None = None,
) -> str:
    """Spell the right-hand side: the groups, and each covariate that varies."""
    first = " * ".join(name for name in (groups.column if groups else None, time) if name)
    names = settings.model.covariates if covariates is None else covariates
    by_name = {str(column).casefold(): str(column) for column in table.columns}
    terms = [first or "1"]
    for name in (by_name[name.casefold()] for name in names if name.casefold() in by_name):
        if len(formulas.typed(table[name]).dropna().unique()) > 1:
            shape = settings.model.age if name.casefold() in AGES else "linear"
            bent = {"quadratic": f"poly({name}, 2)"}
            bent["spline"] = f'cr({name}, df=3, constraints="center")'
            terms.append(bent.get(shape, name))
    return " + ".join(terms)


def default_contrasts(
    groups: Groups | None, time: str | None, nonlinear: Sequence[str] = ()
) -> list[str]:
    """Contrasts of the default model.

    Groups, changes over time in each, their differences, and whether covariates bend.
    """
    bends = [f"{name} nonlinear = {NONLINEAR}({name})" for name in nonlinear]
    if groups is None:
        return [*([time] if time else []), *bends]
    contrasts = [*groups.contrasts(), *bends]
    if time is None:
        return contrasts
    slopes = {level: f"{groups.column}[T.{level}]:{time}" for level in groups.levels[1:]}
    contrasts.append(f"{time} in {groups.reference} = {time}")
    for level, slope in slopes.items():
        contrasts.append(f"{time} in {level} = {time} + {slope}")
        contrasts.append(f"{time} in {groups.reference}-{level} = -1*{slope}")
    return contrasts


def empty_covariates(table: pd.DataFrame, settings: GroupSettings) -> list[str]:
    """Name covariates of the default model whose column holds nothing."""
    names = {name.casefold() for name in settings.model.covariates}
    named = [str(name) for name in table.columns if str(name).casefold() in names]
    return [name for name in named if formulas.typed(table[name]).isna().all()]


@dataclass(frozen=True)
class VisitTime:
    """Visits with their time, for longitudinal models."""

    table: pd.DataFrame
    column: str | None
    """Column of the time; None if it is not known."""
    covariates: tuple[str, ...]
    """Names of covariates of the default model, with age at the first visit."""
    labels: tuple[str, ...] = ()
    """Visits in their order, if they are categories."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Which sessions and sides of a participant are compared; by default the first session."""

    longitudinal: bool = False
    """All sessions, or those of ``endpoint``, by a model of repeated visits."""
    endpoint: tuple[str, ...] = ()
    """``ancova``, ``mmrm`` or ``clda``, the baseline's session, and later ones, with ``ses-``."""
    pair: tuple[str, str] | None = None
    """Two sessions, with ``ses-``: the second minus the first is analyzed."""
    asymmetry: bool = False
    """Also left minus right."""

    @property
    def suffix(self) -> str:
        """The part of names that distinguishes folders of results of one formula."""
        if self.pair:
            return f"_change-{'-'.join(label.removeprefix('ses-') for label in self.pair)}"
        if self.endpoint:
            return f"_{'-'.join(label.removeprefix('ses-') for label in self.endpoint)}"
        return "_longitudinal" if self.longitudinal else ""

    @property
    def adjusted(self) -> str | None:
        """Session of the baseline, if it is a covariate."""
        return self.endpoint[1] if self.endpoint and self.endpoint[0] != "clda" else None

    def __post_init__(self) -> None:
        if self.longitudinal and self.pair:
            raise UsageError("give --longitudinal (all sessions) or --paired (two), not both")
        if self.endpoint:
            check_endpoint(self.endpoint)
            if self.asymmetry:
                raise UsageError("--endpoint: remove --asymmetry")


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


def wanted_measures(request: ModelRequest, options: tuple[str, ...]) -> tuple[str, ...]:
    """Names of the measures that are asked for, by option or on the left of a formula."""
    if request.file is not None:
        left = formulas.parse_model(files.read_json(request.file)).measures
    else:
        left = formulas.left_side(request.formula or "")
    if options and left and set(options) != set(left):
        raise UsageError(
            f"--measures {' '.join(options)} and {' + '.join(left)} ~ in the formula differ; give"
            " one"
        )
    return options or left


def covariate_maps(request: ModelRequest) -> tuple[str, ...]:
    """Names of maps that are covariates at each point."""
    if request.file is not None:
        return formulas.parse_model(files.read_json(request.file)).maps
    return formulas.split_maps(request.formula or "")[1]


def choose_model(
    request: ModelRequest,
    table: pd.DataFrame,
    settings: GroupSettings,
    *,
    comparison: Comparison | None = None,
    visits: VisitTime | None = None,
) -> tuple[Mapping[str, Any], formulas.ModelSpec, Groups | None, dict[str, str]]:
    """Return the model as a BIDS Stats Model and read, the groups, and reference levels.

    The request names reference levels; the design chooses the others by the rule of
    ``find_groups``.
    """
    references = _requested_references(request)
    groups = find_groups(table, settings)
    if groups is not None and groups.column in references:
        groups = find_groups(table, settings, references[groups.column])
    document = model_document(
        request, table, groups, settings, comparison=comparison, visits=visits
    )
    model = formulas.parse_model(document)
    if visits is not None and visits.labels and VISIT in closed_formula(model.formula).names:
        references[VISIT] = visits.labels[0]
    return document, model, groups, references


def _requested_references(request: ModelRequest) -> dict[str, str]:
    """Return reference levels of options and of codings in the formula; they must not differ."""
    references = dict(request.references)
    formula = formulas.split_maps(request.formula or "1")[0]
    if request.file is not None:
        formula = formulas.parse_model(files.read_json(request.file)).formula
    for factor, level in closed_formula(formula).references:
        if references.setdefault(factor, level) != level:
            problem = f"--reference {factor}={references[factor]}, but the formula has"
            raise UsageError(f"{problem} contr.treatment({level!r}); give one")
    return references


def model_document(
    request: ModelRequest,
    table: pd.DataFrame,
    groups: Groups | None,
    settings: GroupSettings,
    *,
    comparison: Comparison | None = None,
    visits: VisitTime | None = None,
) -> Mapping[str, Any]:
    """Give the model as a BIDS Stats Model."""
    if request.file is not None:
        if request.formula or request.contrasts:
            raise UsageError("give --model or --formula, not both")
        return files.read_json(request.file)
    if request.formula is not None:
        if not request.formula.rpartition("~")[2].strip():
            raise UsageError("--formula is empty; write it as group + age")
        formula = request.formula
        contrasts = list(request.contrasts) or _formula_contrasts(
            formula, groups, comparison, visits
        )
        return formulas.model_from_shortcut(
            formula, contrasts, request.name or folder_name(formula)
        )
    comparison = comparison or Comparison()
    _check_default(table, groups, settings, comparison, visits)
    covariates = visits.covariates if visits else settings.model.covariates
    time = visits.column if visits else None
    formula = default_formula(table, groups, settings, covariates=covariates, time=time)
    contrasts = list(request.contrasts) or _default_contrasts(
        formula, groups, settings, comparison, visits
    )
    return formulas.model_from_shortcut(formula, contrasts, request.name or folder_name(formula))


def _check_default(
    table: pd.DataFrame,
    groups: Groups | None,
    settings: GroupSettings,
    comparison: Comparison,
    visits: VisitTime | None,
) -> None:
    """Refuse data without the groups or the times that the default model needs."""
    has_changes = comparison.longitudinal and not comparison.endpoint
    within = has_changes or comparison.pair or comparison.asymmetry
    if groups is None and not within:
        columns = [str(name) for name in table.columns if name not in {PARTICIPANT, SESSION}]
        available = (
            f"there are {formulas.listed(columns)}"
            if columns
            else "no participants.tsv of BIDS_DIR has further columns"
        )
        raise ModelError(
            f"no column has two groups ({', '.join(settings.model.group_columns)}); "
            f'{available}; or give --formula "age + sex" --contrast age'
        )
    if has_changes and not table[PARTICIPANT].duplicated().any():
        raise ModelError(
            "longitudinal model: no participant has a second session; remove --longitudinal"
        )
    if has_changes and (visits is None or visits.column is None):
        raise ModelError(
            "the default longitudinal model needs the time of each session: a column"
            f" {', '.join(settings.longitudinal.time_columns)}, acq_time or age in sessions.tsv"
        )


def _default_contrasts(
    formula: str,
    groups: Groups | None,
    settings: GroupSettings,
    comparison: Comparison,
    visits: VisitTime | None,
) -> list[str]:
    """Return the contrasts of the default model."""
    time = visits.column if visits else None
    bent = [name for name in closed_formula(formula).names if name.casefold() in AGES]
    bent = [] if settings.model.age == "linear" else bent
    contrasts = list[str]()
    if visits is not None and time == VISIT:
        pairs = groups.contrasts() if groups else []
        contrasts = visit_contrasts(pairs, visits.labels, comparison.endpoint)
        time, groups = None, None if contrasts else groups
    return contrasts + default_contrasts(groups, time, bent)


def _formula_contrasts(
    formula: str, groups: Groups | None, comparison: Comparison | None, visits: VisitTime | None
) -> list[str]:
    """Contrasts of a formula that a user wrote without any."""
    plain, maps = formulas.split_maps(formula)
    endpoint = comparison.endpoint if comparison else ()
    if groups is not None and groups.column not in plain:
        groups = None
    if visits is not None and visits.labels and VISIT in closed_formula(plain).names:
        return visit_contrasts(groups.contrasts() if groups else [], visits.labels, endpoint)
    if groups is None:
        return []
    terms = (f"map({name})" for name in maps)
    return [*groups.contrasts(), *formulas.interactions(plain), *terms]


def asymmetry_name(measure: str) -> str:
    """Name of the map of left minus right."""
    return f"{measure}_asymmetry"
