"""Variables of a model: which rows are complete, what is a number and what a factor."""

import difflib
from collections.abc import Iterable, Mapping

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from hipsta_bids.errors import ModelError
from hipsta_bids.group_settings import DesignSettings

#: Texts that mean a missing value, besides what pandas takes for one.
_MISSING = ("n/a", "NA", "N/A", "nan", "NaN", "")
#: Numbers from here on overflow when they are squared and summed.
_LARGEST = 1e100
#: Rows that a message names.
_NAMED = 8


def check_unique(table: pd.DataFrame, keys: list[str]) -> None:
    """Refuse a table in which a participant (or session) stands twice.

    Raises
    ------
    ModelError
        Names those that do.
    """
    twice = table.loc[table.duplicated(keys), keys].astype(str).agg(" ".join, axis=1)
    if len(twice):
        raise ModelError(
            f"table: {listed(sorted(set(twice)))} stand more than once; keep one row each",
            reason="duplicate-rows",
        )


def check_names(names: Iterable[str], columns: pd.Index) -> None:
    """Refuse names that the table does not have."""
    known = [str(column) for column in columns]
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean {near[0]}?" if near else f"the table has {listed(known)}"
            raise ModelError(
                f"model: the table has no column {name!r}; {hint}", reason="unknown-variable"
            )


def typed(values: pd.Series, settings: DesignSettings) -> pd.Series:
    """Return numbers as floats, text as text, and what is missing as missing.

    Raises
    ------
    ModelError
        If a few texts stand among numbers, or numbers are too large; names their rows.
    """
    if pd.api.types.is_bool_dtype(values):
        return values.map({True: "yes", False: "no"}).astype(object)
    if pd.api.types.is_numeric_dtype(values):
        numbers = values.astype(np.float64)
        return numbers.where(np.isfinite(numbers))
    text = values.astype(object).where(values.notna(), None)
    text = text.map(lambda value: None if value is None else str(value).strip())
    text = text.where(~text.isin(_MISSING), None)
    present = text.notna()
    numbers = pd.to_numeric(text, errors="coerce").astype(np.float64)
    if present.any() and numbers[present].notna().all():
        too_large = present & ~(numbers.abs() < _LARGEST)
        if too_large.any():
            raise ModelError(
                f"model: column {values.name!r} holds numbers that are too large for rows"
                f" {listed(values.index[too_large])}; correct them, or mark them n/a",
                reason="not-numeric",
            )
        return numbers
    if numbers[present].notna().mean() > settings.numeric_share:
        bad = present & numbers.isna()
        raise ModelError(
            f"model: column {values.name!r} holds numbers but for rows"
            f" {listed(values.index[bad])}; correct them, or mark them n/a",
            reason="not-numeric",
        )
    return text


def rows_by_lack(used: pd.DataFrame, complete: NDArray[np.bool_]) -> dict[str, tuple[str, ...]]:
    """Group incomplete rows by the first variable that they lack."""
    result: dict[str, list[str]] = {}
    lacking = used.isna().to_numpy()
    for row in np.flatnonzero(~complete).tolist():
        name = str(used.columns[int(np.argmax(lacking[row]))])
        result.setdefault(name, []).append(str(used.index[row]))
    return {name: tuple(rows) for name, rows in result.items()}


def check_left(used: pd.DataFrame, dropped: Mapping[str, tuple[str, ...]]) -> None:
    """Refuse a model that leaves no row; says what the rows lack.

    Raises
    ------
    ModelError
        With the number of rows per variable.
    """
    if not len(used):
        lack = ", ".join(f"{name} ({len(rows)})" for name, rows in dropped.items())
        why = f"; missing are {lack}" if lack else ""
        raise ModelError(f"model: no row has all variables{why}", reason="group-size")


def set_levels(
    used: pd.DataFrame, references: Mapping[str, str], settings: DesignSettings
) -> dict[str, list[str]]:
    """Make factors of text columns in place.

    Returns
    -------
    dict
        Levels of each factor, the reference first.

    Raises
    ------
    ModelError
        If a column does not vary, a level is unknown or has too few rows.
    """
    chosen = {}
    for column in used.columns:
        name = str(column)
        if pd.api.types.is_numeric_dtype(used[name]):
            _check_varies(used[name], name)
        else:
            chosen[name] = _levels(used[name], name, references.get(name), settings)
            used[name] = pd.Categorical(used[name], categories=chosen[name])
    if unknown := sorted(set(references) - set(chosen)):
        raise ModelError(
            f"model: reference level given for {listed(unknown)}, which is no factor of the model",
            reason="unknown-variable",
        )
    return chosen


def _check_varies(values: pd.Series, name: str) -> None:
    numbers = values.to_numpy(dtype=np.float64)
    if numbers.min() == numbers.max():
        raise ModelError(
            f"model: {name!r} is {numbers[0]:g} in all {len(numbers)} complete rows; leave it out",
            reason="constant-column",
        )


def _levels(
    values: pd.Series, name: str, reference: str | None, settings: DesignSettings
) -> list[str]:
    """Levels of a factor, reference first."""
    counts = {str(level): int(count) for level, count in values.value_counts().items()}
    levels = sorted(counts)
    first = levels[0] if reference is None else reference
    if first not in levels:
        raise ModelError(
            f"model: {name!r} has no level {first!r} in the complete rows, only {listed(levels)}",
            reason="unknown-level",
        )
    if len(levels) == 1:
        raise ModelError(
            f"model: all {len(values)} complete rows have {name!r} {first}; leave it out",
            reason="constant-column",
        )
    small = [f"{level} ({counts[level]})" for level in levels if counts[level] < settings.min_level]
    if small:
        raise ModelError(
            f"model: too few complete rows in {name!r}: {listed(small)}; at least"
            f" {settings.min_level} are needed",
            reason="group-size",
        )
    levels.remove(first)
    return [first, *levels]


def listed(items: Iterable[object]) -> str:
    """Join names for a message, not too many."""
    texts = [str(item) for item in items]
    more = f" and {len(texts) - _NAMED} more" if len(texts) > _NAMED else ""
    return ", ".join(texts[:_NAMED]) + more
