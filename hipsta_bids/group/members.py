"""Which rows belong to which group, and what they have in common."""

from collections.abc import Mapping

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from hipsta_bids.group.analysis import Analysis
from hipsta_bids.group.fitted import FittedMaps
from hipsta_bids.group_data import Float

#: Group of all, where there are no groups.
ALL = "all"


def rows_of(analysis: Analysis, one: FittedMaps) -> pd.DataFrame:
    """Rows of the model's table that the sheets used belong to."""
    return analysis.compared.table.iloc[one.maps.rows[one.used]]


def members_of(analysis: Analysis, table: pd.DataFrame) -> Mapping[str, NDArray[np.bool_]]:
    """Tell which rows belong to each group."""
    if analysis.groups is None:
        return {ALL: np.ones(len(table), dtype=bool)}
    names = table[analysis.groups.column]
    return {level: (names == level).to_numpy() for level in analysis.groups.levels}


def mean_of_known(values: Float, axis: int) -> Float:
    """Mean without what is missing; NaN where nothing is known."""
    known = np.isfinite(values)
    count = known.sum(axis=axis)
    total = np.where(known, values, 0.0).sum(axis=axis)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def spread_of_known(values: Float) -> Float:
    """Take the standard deviation over the first axis of what is known; NaN below two values."""
    count = np.isfinite(values).sum(axis=0)
    variance = mean_of_known((values - mean_of_known(values, 0)) ** 2, 0)
    return np.where(count > 1, np.sqrt(variance * count / np.maximum(count - 1, 1)), np.nan)
