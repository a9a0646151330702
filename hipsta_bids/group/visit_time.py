"""The time of visits, for longitudinal models."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from hipsta_bids.errors import ModelError
from hipsta_bids.group.variables import typed
from hipsta_bids.group_data import PARTICIPANT
from hipsta_bids.group_settings import GroupSettings

#: Column of BIDS' sessions.tsv with dates, and columns that are made here.
_DATE, TIME, FIRST_AGE = "acq_time", "time", "age_first"
_DAYS_PER_YEAR = 365.25


@dataclass(frozen=True)
class VisitTime:
    """Visits with their time."""

    table: pd.DataFrame
    column: str | None
    """Of the time; None if nothing tells it."""
    covariates: tuple[str, ...]
    """Names of covariates of the default model, age being that of the first visit."""


def add_time(table: pd.DataFrame, settings: GroupSettings) -> VisitTime:
    """Find the time of each visit, or make it from dates or ages.

    A column of ``longitudinal.time_columns`` that varies between the sessions of somebody; else
    ``acq_time``, in years since the participant's first session; else age, likewise. If age
    varies between sessions, the age at the first one is added, since the other would take part of
    the change.

    Parameters
    ----------
    table : DataFrame
        Visits with covariates.
    settings : GroupSettings
        Names of columns.

    Raises
    ------
    ModelError
        If dates cannot be read.
    """
    covariates = tuple(settings.model.covariates)
    by_name = {str(column).casefold(): str(column) for column in table.columns}
    age = by_name.get("age")
    result = table
    ages = None
    if age is not None:
        ages = typed(table[age], settings.design)
        if pd.api.types.is_numeric_dtype(ages) and varies_within(ages, table):
            first = ages.groupby(table[PARTICIPANT]).transform("first")
            result = result.assign(**{FIRST_AGE: first})
            covariates = tuple(
                FIRST_AGE if name.casefold() == "age" else name for name in covariates
            )
        else:
            ages = None
    column = _given(table, settings.longitudinal.time_columns, by_name, settings)
    if column is None and _DATE in table.columns and table[_DATE].notna().any():
        days = _dates(table[_DATE])
        result, column = result.assign(**{TIME: _since_first(days, table) / _DAYS_PER_YEAR}), TIME
    elif column is None and ages is not None:
        result, column = result.assign(**{TIME: _since_first(ages, table)}), TIME
    elif column is not None:
        result = result.assign(**{column: typed(table[column], settings.design)})
    return VisitTime(result, column, covariates)


def varies_within(values: pd.Series, table: pd.DataFrame) -> bool:
    """Whether somebody has different values at different sessions."""
    own = values.groupby(table[PARTICIPANT])
    return bool((own.transform("min") < own.transform("max")).any())


def _given(
    table: pd.DataFrame, names: Sequence[str], by_name: dict[str, str], settings: GroupSettings
) -> str | None:
    for name in names:
        column = by_name.get(name.casefold())
        if column is None:
            continue
        values = typed(table[column], settings.design)
        if pd.api.types.is_numeric_dtype(values) and varies_within(values, table):
            return column
    return None


def _dates(values: pd.Series) -> pd.Series:
    """Days, from ISO dates."""
    try:
        dates = pd.to_datetime(values, format="ISO8601", utc=True)
    except (ValueError, TypeError) as error:
        raise ModelError(
            f"sessions: acq_time is not a date and time as 2001-02-03T04:05:06 ({error})",
            reason="bad-date",
        ) from error
    days = (dates - dates.min()) / pd.Timedelta(days=1)
    return days.astype(np.float64)


def _since_first(values: pd.Series, table: pd.DataFrame) -> pd.Series:
    return values - values.groupby(table[PARTICIPANT]).transform("min")
