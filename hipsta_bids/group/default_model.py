"""The model of the paper, for those who give none: group, age and sex."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd

from hipsta_bids.errors import ModelError
from hipsta_bids.group.variables import typed
from hipsta_bids.group_settings import DefaultModelSettings, GroupSettings


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
    """Find the column of groups and their reference level.

    Parameters
    ----------
    table : DataFrame
        Covariates.
    settings : GroupSettings
        Names of such columns and of reference levels.
    reference : str, optional
        The user's choice of level.

    Returns
    -------
    Groups or None
        ``None`` if no column of these names holds at least two levels.

    Raises
    ------
    ModelError
        If nobody has the reference level.
    """
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
    """Spell the right-hand side: the groups, and each covariate that varies.

    Parameters
    ----------
    table : DataFrame
        Covariates.
    groups : Groups or None
        From :func:`find_groups`.
    settings : GroupSettings
        What is a number.
    covariates : sequence of str, optional
        Their names; else those of the settings.
    time : str, optional
        Column of the time of visits, which may go by differently in groups.
    """
    first = " * ".join(name for name in (groups.column if groups else None, time) if name)
    names = settings.model.covariates if covariates is None else covariates
    return " + ".join([first or "1", *_varying(table, names, settings)])


def default_contrasts(groups: Groups | None, time: str | None) -> list[str]:
    """Contrasts of the default model: groups, changes over time in each, and their differences.

    Parameters
    ----------
    groups : Groups or None
        From :func:`find_groups`.
    time : str or None
        Column of the time of visits.
    """
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
