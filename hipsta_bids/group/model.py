"""Which model the group level fits: the user's, or the paper's."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from hipsta_bids.errors import ModelError, UsageError
from hipsta_bids.group.comparison import Comparison
from hipsta_bids.group.covariates import VisitTime
from hipsta_bids.group.formula import left_side, model_from_shortcut, parse_model, typed
from hipsta_bids.group.settings import DefaultModelSettings, GroupSettings
from hipsta_bids.io import files

# The model of the paper, for those who give none: group, age and sex.


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
                f"model: nobody has {column!r} {first!r}; there are {', '.join(sorted(counts))}",
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
