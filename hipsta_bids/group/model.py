"""Which model is fitted, the user's or the paper's default, and its design matrix."""

import difflib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from formulaic import Formula

from hipsta_bids.errors import ModelError, UsageError
from hipsta_bids.group.comparison import Comparison
from hipsta_bids.group.covariates import VisitTime
from hipsta_bids.group.data import Float, Int
from hipsta_bids.group.formula import (
    Contrast,
    ContrastSpec,
    ModelSpec,
    check_left,
    check_names,
    left_side,
    listed,
    model_from_shortcut,
    parse_model,
    rows_by_lack,
    set_levels,
    typed,
)
from hipsta_bids.group.grammar import CONTEXT, closed_formula
from hipsta_bids.group.settings import DefaultModelSettings, DesignSettings, GroupSettings
from hipsta_bids.io import files


@dataclass(frozen=True)
class Groups:
    """The column that tells groups, and their order."""

    column: str
    levels: tuple[str, ...]
    """The reference first, the others in the order of the alphabet."""

    @property
    def reference(self) -> str:
        """The level that the others are compared with."""
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
    for wanted in settings.model.group_columns:
        column = by_name.get(wanted.casefold())
        values = typed(table[column], settings.design).dropna() if column else None
        if column is None or values is None or values.nunique() < 2:  # noqa: PLR2004 -- two groups
            continue
        if pd.api.types.is_numeric_dtype(values):
            raise ModelError(
                f"model: column {column!r} holds numbers, which do not name groups; give names, or"
                " a model by --formula",
                reason="group-numeric",
            )
        counts = Counter(str(value) for value in values)
        first = reference or _reference(counts, settings.model)
        if first not in counts:
            raise ModelError(
                f"model: no participant has {column!r} {first!r}; there are"
                f" {', '.join(sorted(counts))}",
                reason="unknown-level",
            )
        return Groups(column, (first, *sorted(level for level in counts if level != first)))
    return None


def _reference(counts: Counter[str], settings: DefaultModelSettings) -> str:
    by_name = {level.casefold().rstrip("s"): level for level in sorted(counts)}
    for name in settings.reference_levels:
        if name.casefold().rstrip("s") in by_name:
            return by_name[name.casefold().rstrip("s")]
    return min(counts, key=lambda level: (-counts[level], level))


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
    return " + ".join([first or "1", *_varying(table, names, settings)])


def default_contrasts(groups: Groups | None, time: str | None) -> list[str]:
    """Contrasts of the default model: groups, changes over time in each, and their differences."""
    if groups is None:
        return [time] if time else []
    found = groups.contrasts()
    if time is None:
        return found
    slopes = {level: f"{groups.column}[T.{level}]:{time}" for level in groups.levels[1:]}
    found.append(f"{time} in {groups.reference} = {time}")
    for level, slope in slopes.items():
        found.append(f"{time} in {level} = {time} + {slope}")
        found.append(f"{time} in {groups.reference}-{level} = -1*{slope}")
    return found


def _varying(table: pd.DataFrame, names: Sequence[str], settings: GroupSettings) -> list[str]:
    by_name = {str(column).casefold(): str(column) for column in table.columns}
    found = [by_name[name.casefold()] for name in names if name.casefold() in by_name]
    levels = {name: typed(table[name], settings.design).dropna().unique() for name in found}
    return [name for name in found if len(levels[name]) > 1]


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


def wanted_measures(request: ModelRequest, listed: tuple[str, ...]) -> tuple[str, ...]:
    """Names of the measures that are asked for, by option or on the left of a formula."""
    if request.file is not None:
        left = parse_model(files.read_json(request.file)).measures
    else:
        left = left_side(request.formula or "")
    if listed and left and set(listed) != set(left):
        raise UsageError(
            f"--measures {' '.join(listed)} and {' + '.join(left)} ~ in the formula differ; give"
            " one",
            reason="usage",
        )
    return listed or left


def choose_references(
    request: ModelRequest, table: pd.DataFrame, settings: GroupSettings
) -> tuple[dict[str, str], Groups | None]:
    """Take reference levels that the user gave; that of the groups reorders them."""
    references = dict(request.references)
    groups = find_groups(table, settings)
    if groups is not None and groups.column in references:
        groups = find_groups(table, settings, references[groups.column])
    return references, groups


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
            raise UsageError("give --model or --formula, not both", reason="usage")
        return files.read_json(request.file)
    if request.formula is not None:
        if not request.formula.rpartition("~")[2].strip():
            raise UsageError("--formula is empty; write it as group + age", reason="usage")
        formula = request.formula
        contrasts = list(request.contrasts)
        if not contrasts and groups is not None and groups.column in formula:
            contrasts = groups.contrasts()
        return model_from_shortcut(formula, contrasts, request.name or folder_name(formula))
    comparison = comparison or Comparison()
    within = comparison.longitudinal or comparison.pair or comparison.asymmetry
    if groups is None and not within:
        raise ModelError(
            "participants.tsv has no column that tells groups"
            f" ({', '.join(settings.model.group_columns)}) with two levels; give a model by"
            ' --formula "age + sex" --contrast age',
            reason="no-groups",
        )
    time = visits.column if visits else None
    if comparison.longitudinal and time is None:
        raise ModelError(
            "the default longitudinal model needs the time of each session: a column"
            f" {', '.join(settings.longitudinal.time_columns)}, acq_time or age in sessions.tsv",
            reason="no-time",
        )
    covariates = visits.covariates if visits else settings.model.covariates
    formula = default_formula(table, groups, settings, covariates=covariates, time=time)
    contrasts = list(request.contrasts) or default_contrasts(groups, time)
    return model_from_shortcut(formula, contrasts, request.name or folder_name(formula))


def folder_name(formula: str, measures: tuple[str, ...] = ()) -> str:
    """Spell measures and a formula as the name of a folder; products must not look like sums."""
    right = formula.rpartition("~")[2].replace("*", " x ").replace(":", " by ")
    right = right.replace(" - ", " without ")
    words = "".join(c if c.isalnum() else " " for c in right).split()
    return "_".join(part for part in ("-".join(measures), "-".join(words) or "model") if part)


@dataclass(frozen=True)
class Design:
    """A design matrix for complete rows, and its contrasts."""

    matrix: Float
    """(rows, columns)"""
    columns: tuple[str, ...]
    rows: Int
    """Positions in the table of the rows that are complete."""
    dropped: Mapping[str, tuple[str, ...]]
    """Labels of rows left out, by the variable that they lack (the first one)."""
    references: Mapping[str, str]
    """Reference level of each factor."""
    contrasts: tuple[Contrast, ...]
    levels: Mapping[str, Sequence[str]] = field(default_factory=dict)
    """Levels of each factor, the reference first."""


def build_design(
    table: pd.DataFrame, model: ModelSpec, settings: DesignSettings, references: Mapping[str, str]
) -> Design:
    """Make the design matrix of a model, or say what keeps it from being fitted."""
    closed = closed_formula(model.formula)
    formula = _read_formula(closed.text)
    names = sorted(closed.names)
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
        made = formula.get_model_matrix(used, na_action="raise", context=dict(CONTEXT))
    except Exception as error:  # formulaic raises all kinds where a formula makes no sense
        raise ModelError(
            f"formula {model.formula!r}: {str(error).partition(chr(10))[0]}", reason="formula"
        ) from error
    columns = tuple(str(column) for column in made.columns)
    matrix: Float = np.asarray(made, dtype=np.float64)
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
        levels=chosen,
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
        weights: Float = np.array(spec.weights) @ rows
        return Contrast(spec.name, weights)

    def _row(self, name: str, contrast: str) -> Float:
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
        matrix = np.asarray(
            self.spec.get_model_matrix(moved, context=dict(CONTEXT)), dtype=np.float64
        )
        return np.asarray(np.asarray(matrix, dtype=np.float64).mean(axis=0), dtype=np.float64)

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
        return Formula(text)
    except Exception as error:  # formulaic raises all kinds where a formula makes no sense
        raise ModelError(
            f"formula {text!r} cannot be read; write it as group + age, and names with blanks in"
            " backticks",
            reason="formula",
        ) from error


def _check_matrix(
    matrix: Float, columns: tuple[str, ...], rows: pd.Index, settings: DesignSettings
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
