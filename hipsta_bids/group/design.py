"""From a table and a formula to a design matrix, with all that is wrong said beforehand."""

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from formulaic import Formula
from formulaic.errors import FormulaicError
from numpy.typing import NDArray

from hipsta_bids.errors import ModelError
from hipsta_bids.group.formula import (
    Contrast,
    ContrastSpec,
    ModelSpec,
    check_left,
    check_names,
    listed,
    rows_by_lack,
    set_levels,
    typed,
)
from hipsta_bids.group.settings import DesignSettings

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Design:
    """A design matrix for complete rows, and its contrasts."""

    matrix: FloatArray
    """(rows, columns)"""
    columns: tuple[str, ...]
    rows: NDArray[np.int64]
    """Positions in the table of the rows that are complete."""
    dropped: Mapping[str, tuple[str, ...]]
    """Labels of rows left out, by the variable that they lack (the first one)."""
    references: Mapping[str, str]
    """Reference level of each factor."""
    contrasts: tuple[Contrast, ...]


def build_design(
    table: pd.DataFrame, model: ModelSpec, settings: DesignSettings, references: Mapping[str, str]
) -> Design:
    """Make the design matrix of a model, or say what keeps it from being fitted."""
    formula = _read_formula(model.formula)
    names = sorted(str(name) for name in formula.required_variables)
    check_names(names, table.columns)
    used = table[names].copy()
    for name in names:
        used[name] = typed(used[name], settings)
    complete = used.notna().all(axis=1).to_numpy()
    dropped = rows_by_lack(used, complete)
    used = used.loc[complete].copy()
    check_left(used, dropped)
    chosen = set_levels(used, references, settings)
    try:
        made = formula.get_model_matrix(used, na_action="raise", context={})
    except (FormulaicError, ValueError, TypeError, KeyError) as error:
        raise ModelError(
            f"formula {model.formula!r}: {str(error).partition(chr(10))[0]}", reason="formula"
        ) from error
    columns = tuple(str(column) for column in made.columns)
    matrix: FloatArray = np.asarray(made, dtype=np.float64)
    _check_matrix(matrix, columns, used.index, settings)
    terms = _Terms(columns, used, made.model_spec, chosen)
    specs = (*model.contrasts, *_dummies(columns, model.dummy))
    return Design(
        matrix=matrix,
        columns=columns,
        rows=np.flatnonzero(complete),
        dropped=dropped,
        references={name: levels[0] for name, levels in chosen.items()},
        contrasts=tuple(terms.contrast(spec) for spec in specs),
    )


@dataclass(frozen=True)
class _Terms:
    """What contrasts can name, as rows of weights of the columns."""

    columns: tuple[str, ...]
    table: pd.DataFrame
    spec: Any
    levels: Mapping[str, list[str]]

    def contrast(self, spec: ContrastSpec) -> Contrast:
        rows = np.array([self._row(name, spec.name) for name in spec.conditions])
        weights: FloatArray = np.array(spec.weights) @ rows
        return Contrast(spec.name, weights)

    def _row(self, name: str, contrast: str) -> FloatArray:
        if name in self.columns:
            unit = np.arange(len(self.columns)) == self.columns.index(name)
            return np.asarray(unit, dtype=np.float64)
        factor, level = self._split(name)
        if factor is None:
            known = [
                *self.columns,
                *(f"{f}[{x}]" for f, levels in self.levels.items() for x in levels),
            ]
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean {near[0]}?" if near else f"known are {listed(known)}"
            raise ModelError(
                f"contrast {contrast!r}: nothing is called {name!r}; {hint}",
                reason="contrast-unknown",
            )
        # The mean of the model over all rows if every one had this level.
        moved = self.table.copy()
        moved[factor] = pd.Categorical([level] * len(moved), categories=self.levels[factor])
        matrix = np.asarray(self.spec.get_model_matrix(moved), dtype=np.float64)
        return np.asarray(matrix.mean(axis=0), dtype=np.float64)

    def _split(self, name: str) -> tuple[str | None, str]:
        """Factor and level of ``factor[level]`` or ``factor.level``."""
        for factor, levels in self.levels.items():
            for level in levels:
                if name in {f"{factor}[{level}]", f"{factor}.{level}"}:
                    return factor, level
        return None, ""


def _dummies(columns: tuple[str, ...], test: str | None) -> list[ContrastSpec]:
    if test is None:
        return []
    return [
        ContrastSpec(column, (column,), ((1.0,),), test)
        for column in columns
        if column != "Intercept"
    ]


def _read_formula(text: str) -> Formula:
    try:
        formula = Formula(text)
        formula.required_variables  # noqa: B018 -- finds names that are none
    except (FormulaicError, ValueError, AttributeError) as error:
        raise ModelError(
            f"formula {text!r} cannot be read; write it as group + age, and names with blanks in"
            " backticks",
            reason="formula",
        ) from error
    if hasattr(formula, "rhs"):
        raise ModelError(
            f"formula {text!r}: give the right-hand side only, as group + age", reason="formula"
        )
    return formula


def _check_matrix(
    matrix: FloatArray, columns: tuple[str, ...], rows: pd.Index, settings: DesignSettings
) -> None:
    bad = np.flatnonzero(~np.isfinite(matrix).all(axis=1))
    if len(bad):
        raise ModelError(
            f"model: the formula has no value for rows {listed(rows.take(bad))}; a logarithm of"
            " zero?",
            reason="design-missing",
        )
    if len(matrix) - len(columns) < settings.min_residual_df:
        raise ModelError(
            f"model: {len(matrix)} complete rows are too few for {len(columns)} columns; at least"
            f" {len(columns) + settings.min_residual_df} are needed",
            reason="group-size",
        )
    lengths = np.linalg.norm(matrix, axis=0)
    if (lengths == 0).any():
        raise ModelError(
            f"model: no row has {columns[int(np.argmin(lengths))]!r}; leave it out of the formula",
            reason="constant-column",
        )
    unit = matrix / lengths
    for last in range(1, len(columns)):
        before = unit[:, :last]
        weights = np.linalg.lstsq(before, unit[:, last], rcond=None)[0]
        rest = float(np.linalg.norm(unit[:, last] - before @ weights))
        if rest < settings.dependence:
            involved = [columns[i] for i in np.flatnonzero(np.abs(weights) > settings.dependence)]
            raise ModelError(
                f"model: column {columns[last]!r} is a combination of {listed(involved)}; leave one"
                " of them out",
                reason="design-rank",
            )
