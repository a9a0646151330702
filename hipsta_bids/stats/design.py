"""Design matrix of a model, and its contrasts."""

import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
from formulaic import Formula, ModelMatrix
from numpy.typing import NDArray

from hipsta_bids.errors import ModelError
from hipsta_bids.stats import formula as formulas
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.formula import declared_levels
from hipsta_bids.stats.grammar import CONTEXT, closed_formula, term_text
from hipsta_bids.stats.marginal import Terms
from hipsta_bids.stats.references import references_note
from hipsta_bids.stats.settings import DefaultModelSettings, DesignSettings
from hipsta_bids.types import PARTICIPANT, Float, Int64

#: A column is a combination of other columns if a smaller share is orthogonal to these.
DEPENDENCE = 1e-9
#: Age at the first visit, where that of each visit is known.
FIRST_AGE = "age_first"
#: Visits as categories, by the labels of sessions.
VISIT = "visit"
#: Columns of ages, which the default model may bend.
AGES = ("age", FIRST_AGE)
_HEADS = DefaultModelSettings.model_fields["icv_columns"].default
_OLDEST = 130.0  # years
#: Head volumes differ by less, in one unit.
_UNITS = 50.0
#: A note names covariates that correlate by more, and columns for which there are fewer people.
_NEARLY_SAME, _PEOPLE_PER_COLUMN = 0.99, 10


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


def _parsed(text: str) -> Formula:
    try:
        return Formula(text)
    except Exception as error:  # formulaic raises all kinds where a formula makes no sense
        raise ModelError(
            f"formula {text!r} cannot be read; write it as group + age, and names with"
            " blanks in backticks"
        ) from error


def _typed(table: pd.DataFrame, factors: Collection[str]) -> pd.DataFrame:
    variables = table.copy()
    for name in map(str, table.columns):
        column = formulas.as_factor(table[name]) if name in factors else table[name]
        variables[name] = formulas.typed(column)
    return variables


def _model_matrix(formula: Formula, variables: pd.DataFrame, text: str) -> ModelMatrix:
    try:
        with np.errstate(invalid="ignore", divide="ignore"):  # _check_matrix names missing values
            return formula.get_model_matrix(variables, na_action="ignore", context=dict(CONTEXT))
    except Exception as error:  # as above
        raise ModelError(f"formula {text!r}: {str(error).partition(chr(10))[0]}") from error


def _least_columns(formula: Formula, levels: Mapping[str, Sequence[str]]) -> int:
    """Return the number of columns, if functions of numbers give one each."""
    products = [closed_formula(term_text(term)).names for term in formula]
    sizes = {name: len(names) - 1 for name, names in levels.items()}
    return sum(math.prod(sizes.get(name, 1) for name in names) for names in products)


def build_design(
    table: pd.DataFrame,
    model: formulas.ModelSpec,
    settings: DesignSettings,
    references: Mapping[str, str],
) -> Design:
    """Make the design matrix of a model, or raise the reason why it cannot be fitted."""
    closed = closed_formula(model.formula)
    formula = _parsed(closed.text)
    names = sorted(closed.names)
    formulas.check_names(names, table.columns)
    variables = _typed(table[names], closed.factors)
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
    _refuse_more_columns(_least_columns(formula, levels_used), len(variables), settings)
    model_matrix = _model_matrix(formula, variables, model.formula)
    terms = Terms(model_matrix, variables, levels_used, model.added_terms)
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
    if name not in {*AGES, *_HEADS}:
        return
    numbers = values.to_numpy(dtype=np.float64)
    first, middle = np.quantile(numbers, [0.25, 0.5])
    bad = numbers <= 0 if name in _HEADS else numbers < 0
    bad &= first > 0  # else they are differences from a mean
    if name in AGES:  # in months, say, most are larger
        bad |= (numbers > _OLDEST) & (middle <= _OLDEST)
    if bad.any():
        rows_text = formulas.listed(f"{row} ({value:g})" for row, value in values[bad].items())
        raise ModelError(
            f"model: column {values.name!r} has {rows_text}, which is impossible; correct "
            "them, or mark them n/a"
        )
    if name in AGES or first <= 0:
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
    # The part of each unit column that is orthogonal to the columns before it.
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
    """Refuse more columns than the rows can distinguish."""
    if n_rows - n_columns < settings.min_residual_df:
        raise ModelError(
            f"model: {n_rows} complete rows are too few for {n_columns} columns; at least"
            f" {n_columns + settings.min_residual_df} are needed"
        )
