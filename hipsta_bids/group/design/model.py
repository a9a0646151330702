"""Which model is fitted, the user's or the paper's default, and its design matrix."""

import itertools
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from formulaic import Formula
from numpy.typing import NDArray

from hipsta_bids.errors import ModelError, UsageError
from hipsta_bids.group.design import formula as formulas
from hipsta_bids.group.design.contrasts import Contrast
from hipsta_bids.group.design.formula import declared_levels, folder_name
from hipsta_bids.group.design.grammar import CONTEXT, closed_formula, term_text
from hipsta_bids.group.design.marginal import NONLINEAR, Terms
from hipsta_bids.group.design.references import choose_reference, references_note
from hipsta_bids.group.design.settings import DefaultModelSettings, DesignSettings, GroupSettings
from hipsta_bids.group.design.visits import VISIT, check_endpoint, visit_contrasts
from hipsta_bids.io import files
from hipsta_bids.types import PARTICIPANT, SESSION, Float, Int64

#: A column is a combination of other columns if less than this fraction of its length is its own.
DEPENDENCE = 1e-9
#: Age at the first visit, where that of each visit is known.
FIRST_AGE = "age_first"
#: Columns of ages, which the default model may bend.
_AGES = ("age", FIRST_AGE)
_HEADS = DefaultModelSettings.model_fields["icv_columns"].default
_OLDEST = 130.0  # years
#: Head volumes differ by less, in one unit.
_UNITS = 50.0
#: A note names covariates that correlate by more, and columns for which there are fewer people.
_NEARLY_SAME, _PEOPLE_PER_COLUMN = 0.99, 10
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
            shape = settings.model.age if name.casefold() in _AGES else "linear"
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
    normative: tuple[str, str] | None = None
    """Factor and level of the group against which each participant is scored."""

    @property
    def suffix(self) -> str:
        """The part of names that distinguishes folders of results of one formula."""
        if self.pair:
            return f"_change-{'-'.join(one.removeprefix('ses-') for one in self.pair)}"
        if self.endpoint:
            return f"_{'-'.join(one.removeprefix('ses-') for one in self.endpoint)}"
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
            if self.asymmetry or self.normative:
                raise UsageError("--endpoint: remove --asymmetry and --normative")


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
    time = visits.column if visits else None
    if has_changes and not table[PARTICIPANT].duplicated().any():
        raise ModelError(
            "longitudinal model: no participant has a second session; remove --longitudinal"
        )
    if has_changes and time is None:
        raise ModelError(
            "the default longitudinal model needs the time of each session: a column"
            f" {', '.join(settings.longitudinal.time_columns)}, acq_time or age in sessions.tsv"
        )
    covariates = visits.covariates if visits else settings.model.covariates
    formula = default_formula(table, groups, settings, covariates=covariates, time=time)
    bent = [name for name in closed_formula(formula).names if name.casefold() in _AGES]
    bent = [] if settings.model.age == "linear" else bent
    contrasts, endpoint = list(request.contrasts), comparison.endpoint
    if not contrasts and visits is not None and time == VISIT:
        contrasts = visit_contrasts(groups.contrasts() if groups else [], visits.labels, endpoint)
        time, groups = None, None if contrasts else groups
    contrasts += [] if request.contrasts else default_contrasts(groups, time, bent)
    return formulas.model_from_shortcut(formula, contrasts, request.name or folder_name(formula))


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
    return [*groups.contrasts(), *interactions(plain), *terms]


def interactions(formula: str) -> list[str]:
    """List the interactions of a formula by their variables, as contrasts."""
    closed = closed_formula(formula.rpartition("~")[2])
    try:
        terms = list(Formula(closed.text))
    except Exception:  # noqa: BLE001  (formulaic raises all kinds; the design refuses it, with words)
        return []
    variables = (closed_formula(term_text(term)).names for term in terms)
    sets = {frozenset(names): names for names in variables if len(names) > 1}
    plain = (":".join(names) for names in sets.values())
    quoted = (":".join(f"`{name}`" for name in names) for names in sets.values())
    return [
        name if all(map(str.isidentifier, name.split(":"))) else f"{name} = {text}"
        for name, text in zip(plain, quoted, strict=True)
    ]


@dataclass(frozen=True)
class Design:
    """A design matrix for complete rows, and its contrasts."""

    matrix: Float
    """(rows, columns)"""
    columns: tuple[str, ...]
    rows: Int64
    """Positions in the table of the rows that are complete."""
    dropped: Mapping[str, tuple[str, ...]]
    """Labels of rows left out, by the variable that they lack (the first one)."""
    references: Mapping[str, str]
    """Reference level of each factor."""
    contrasts: tuple[Contrast, ...]
    notes: Mapping[str, str] = field(default_factory=dict)
    """What to know about the coding of variables, by their names."""
    levels: Mapping[str, Sequence[str]] = field(default_factory=dict)
    """Levels of each factor, the reference first."""
    members: NDArray[np.bool_] | None = None
    """(rows, levels) of all factors; a point needs ``min_level`` participants in each level."""
    min_level: int = 0


def build_design(
    table: pd.DataFrame,
    model: formulas.ModelSpec,
    settings: DesignSettings,
    references: Mapping[str, str],
) -> Design:
    """Make the design matrix of a model, or raise the reason why it cannot be fitted."""
    closed = closed_formula(model.formula)
    try:
        formula = Formula(closed.text)
    except Exception as error:  # formulaic raises all kinds where a formula makes no sense
        raise ModelError(
            f"formula {closed.text!r} cannot be read; write it as group + age, and names with"
            " blanks in backticks"
        ) from error
    names = sorted(closed.names)
    formulas.check_names(names, table.columns)
    variables = table[names].copy()
    for name in names:
        column = formulas.as_factor(variables[name]) if name in closed.factors else variables[name]
        variables[name] = formulas.typed(column)
    complete = variables.notna().all(axis=1).to_numpy()
    dropped = formulas.rows_by_lack(variables, complete)
    variables = variables.loc[complete].copy()
    formulas.check_left(variables, dropped)
    numeric = variables.select_dtypes("number")
    notes = {name: formulas.coding_note(numeric[name]) for name in map(str, numeric.columns)}
    declared = {name: levels for name in names if (levels := declared_levels(table[name]))}
    levels_used, choices = formulas.set_levels(
        variables, dict(closed.references) | dict(references), settings, declared
    )
    notes |= {"references": references_note(choices)} if choices else {}
    for name in map(str, numeric.columns):
        _check_possible(numeric[name], name.casefold())
    if words := sorted(closed.numbers & set(levels_used)):
        raise ModelError(
            f"formula {model.formula!r}: functions take numbers, but {formulas.listed(words)} holds"
            " names; write it without a function"
        )
    products = [closed_formula(term_text(term)).names for term in formula]
    sizes = {name: len(levels) - 1 for name, levels in levels_used.items()}
    least = sum(math.prod(sizes.get(name, 1) for name in names) for names in products)
    _refuse_more_columns(least, len(variables), settings)
    try:
        with np.errstate(invalid="ignore", divide="ignore"):  # rows without a value are told below
            model_matrix = formula.get_model_matrix(
                variables, na_action="ignore", context=dict(CONTEXT)
            )
    except Exception as error:  # formulaic raises all kinds where a formula makes no sense
        raise ModelError(
            f"formula {model.formula!r}: {str(error).partition(chr(10))[0]}"
        ) from error
    terms = Terms(model_matrix, variables, levels_used, model.maps)
    matrix, columns = terms.matrix, terms.columns
    _check_matrix(matrix, columns, variables.index, settings)
    people = table.loc[complete, PARTICIPANT].nunique() if PARTICIPANT in table else len(matrix)
    doubts = _doubts(numeric, len(set(columns) - {formulas.INTERCEPT}), people)
    specs = model.contrasts
    if model.dummy is not None:
        specs += terms.dummies(model.dummy)
    return Design(
        matrix=matrix,
        columns=columns,
        rows=np.flatnonzero(complete),
        dropped=dropped,
        references={name: levels[0] for name, levels in levels_used.items()},
        contrasts=tuple(terms.contrast(spec) for spec in specs),
        notes={name: note for name, note in notes.items() if note} | doubts,
        levels=levels_used,
        members=np.array(
            [variables[name] == level for name in levels_used for level in levels_used[name]]
        ).T,
        min_level=settings.min_level,
    )


def _doubts(numeric: pd.DataFrame, n_columns: int, n_people: int) -> dict[str, str]:
    """Note covariates that are nearly the same, and more columns than participants can bear."""
    notes = {}
    for a, b in itertools.combinations(map(str, numeric.columns), 2):
        r = numeric[a].corr(numeric[b])
        if abs(r) > _NEARLY_SAME:
            notes[f"{a}, {b}"] = (
                f"{a} and {b} are nearly the same (r = {r:.4f}), and their effects "
                "inseparable; keep one of them"
            )
    if n_columns * _PEOPLE_PER_COLUMN > n_people:
        notes["columns"] = (
            f"the model has {n_columns} columns for {n_people} participants; use one per"
            f" {_PEOPLE_PER_COLUMN} at most, as estimates are uncertain"
        )
    return notes


def _check_possible(values: pd.Series, name: str) -> None:
    """Refuse ages, and volumes of heads, that nobody has."""
    if name not in {*_AGES, *_HEADS}:
        return
    numbers = values.to_numpy(dtype=np.float64)
    first, middle = np.quantile(numbers, [0.25, 0.5])
    bad = numbers <= 0 if name in _HEADS else numbers < 0
    bad &= first > 0  # else they are differences from a mean
    if name in _AGES:  # in months, say, most are larger
        bad |= (numbers > _OLDEST) & (middle <= _OLDEST)
    if bad.any():
        rows_text = formulas.listed(f"{row} ({value:g})" for row, value in values[bad].items())
        raise ModelError(
            f"model: column {values.name!r} has {rows_text}, which is impossible; correct "
            "them, or mark them n/a"
        )
    if name in _AGES or first <= 0:
        return
    ordered = values.sort_values()
    ratios = ordered.to_numpy()[1:] / ordered.to_numpy()[:-1]
    split = int(np.argmax(ratios)) + 1
    if ratios[split - 1] > _UNITS:
        parts = ordered.iloc[:split], ordered.iloc[split:]
        raise ModelError(
            f"model: {values.name!r} has {len(parts[0])} values to {parts[0].iloc[-1]:g}, "
            f"{len(parts[1])} from {parts[1].iloc[0]:g} (cm^3 and mm^3?); use one unit: "
            f"{formulas.cells(min(parts, key=len))}"
        )


def _check_matrix(
    matrix: Float, columns: tuple[str, ...], rows: pd.Index, settings: DesignSettings
) -> None:
    bad = np.flatnonzero(~np.isfinite(matrix).all(axis=1))
    if len(bad):
        raise ModelError(
            f"model: the formula has no value for rows {formulas.listed(rows.take(bad))}; a"
            " logarithm of zero or less?"
        )
    _refuse_more_columns(len(columns), len(matrix), settings)
    lengths = np.linalg.norm(matrix, axis=0)
    if (lengths == 0).any():
        raise ModelError(
            f"model: no row has {columns[int(np.argmin(lengths))]!r}; remove it from the formula"
        )
    unit = matrix / lengths
    # What is left of each unit column beside those before it.
    remainders = np.abs(np.diag(np.linalg.qr(unit, mode="r")))
    if (remainders < DEPENDENCE).any():
        last = int(np.argmax(remainders < DEPENDENCE))
        weights = np.linalg.lstsq(unit[:, :last], unit[:, last], rcond=None)[0]
        involved = [columns[i] for i in np.flatnonzero(np.abs(weights) > DEPENDENCE)]
        raise ModelError(
            f"model: column {columns[last]!r} is a combination of "
            f"{formulas.listed(involved)}; remove one of them"
        )


def _refuse_more_columns(n_columns: int, n_rows: int, settings: DesignSettings) -> None:
    """Refuse more columns than the rows can tell apart."""
    if n_rows - n_columns < settings.min_residual_df:
        raise ModelError(
            f"model: {n_rows} complete rows are too few for {n_columns} columns; at least"
            f" {n_columns + settings.min_residual_df} are needed"
        )


def asymmetry_name(measure: str) -> str:
    """Name of the map of left minus right."""
    return f"{measure}_asymmetry"
