"""Demographics by group: table 1 of a paper, with a test of each variable."""

import warnings
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from hipsta_bids.errors import ModelError
from hipsta_bids.group.cohort.data import Cohort
from hipsta_bids.group.cohort.quality import exact_p
from hipsta_bids.group.model import Groups
from hipsta_bids.group.output.results import ALL, Analysis
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.stats.design import FIRST_AGE, VISIT
from hipsta_bids.stats.formula import in_order, level_labels, typed
from hipsta_bids.stats.grammar import closed_formula
from hipsta_bids.types import PARTICIPANT

#: Variables that are described even if they do not vary.
_ALWAYS = ("age", "sex")
#: Fisher's exact test replaces chi squared if an expected count is smaller.
_LEAST_EXPECTED = 5
_TEST = ("test", "statistic", "df", "p")
_COLUMNS = ("variable", "level", "group", "n", "missing", "mean", "sd", "count", "percent", *_TEST)


def demographics_of(cohort: Cohort, analysis: Analysis, settings: GroupSettings) -> pd.DataFrame:
    """Describe the participants of an analysis, by its groups."""
    rows = analysis.compared.table.iloc[analysis.design.rows]
    visits = analysis.comparison.sessions.described(rows, cohort.table)
    formulas = [analysis.model.formula, *(formula for _, formula in analysis.measures)]
    return demographics_table(visits, settings, formulas, analysis.groups)


def _variables(formulas: Iterable[str]) -> tuple[set[str], set[str]]:
    """Return the variables of some formulas, and which of them are factors."""
    closed = [closed_formula(formula) for formula in formulas]
    return {n for part in closed for n in part.names}, {n for part in closed for n in part.factors}


def demographics_table(
    visits: pd.DataFrame,
    settings: GroupSettings,
    formulas: Iterable[str],
    groups: Groups | None = None,
) -> pd.DataFrame:
    """Describe each participant once: one row per variable, level of a factor, and group.

    Variables are age and sex, and covariates of the default model and of ``formulas`` if they vary.
    Values are of the first of their ``visits``. Without groups, all participants are one group, and
    there is no test.
    """
    people = visits.drop_duplicates(PARTICIPANT)
    parts = {ALL: people}
    if groups is not None:
        parts = {level: people[people[groups.column] == level] for level in groups.levels}
    rows = [{"variable": "participants", "group": g, "n": len(part)} for g, part in parts.items()]
    modeled, factors = _variables(formulas)
    defaults = {name.casefold() for name in (*_ALWAYS, *settings.model.covariates)}
    skipped = {VISIT, FIRST_AGE, groups and groups.column}
    for name in (str(column) for column in people.columns if column not in skipped):
        if name in modeled or name.casefold() in defaults:
            values = _read(people[name], is_factor=name in factors)
            if name.casefold() in _ALWAYS or len(values.dropna().unique()) > 1:
                rows += _describe(name, {g: values[part.index] for g, part in parts.items()})
    return pd.DataFrame(rows, columns=list(_COLUMNS))


def _read(values: pd.Series, *, is_factor: bool) -> pd.Series:
    """Return numbers, or levels as text; what the model would refuse is missing."""
    try:
        return level_labels(values) if is_factor else typed(values)
    except ModelError:
        return pd.to_numeric(values, errors="coerce").astype(np.float64)


def _describe(name: str, parts: Mapping[str, pd.Series]) -> Iterator[dict[str, Any]]:
    """Return the rows of a variable from its values by group."""
    values_of = {group: part.dropna() for group, part in parts.items()}
    values = pd.concat(values_of)
    is_number = pd.api.types.is_numeric_dtype(values)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # constant values, groups of one
        columns = _test(values_of, is_number=is_number)
    for level in [None] if is_number else sorted(map(str, values.unique()), key=in_order):
        for group, part in values_of.items():
            is_level = part == level
            described = (
                {"mean": part.mean(), "sd": part.std()}
                if is_number
                else {"count": is_level.sum(), "percent": 100 * is_level.mean()}
            )
            labels = {"variable": name, "level": level, "group": group}
            counts = {"n": len(part), "missing": len(parts[group]) - len(part)}
            yield {**labels, **counts, **described, **columns}


def _test(values_of: Mapping[str, pd.Series], *, is_number: bool) -> dict[str, Any]:
    """Return the columns of the test of values by group; empty if there is nothing to compare."""
    samples = [part for part in values_of.values() if len(part)]
    table = pd.DataFrame({i: part.value_counts() for i, part in enumerate(samples)})
    counts = table.fillna(0).to_numpy(dtype=np.int64)
    if min(counts.shape) < 2:  # noqa: PLR2004 -- groups, or values
        return {}
    test: tuple[str, float, float, float]
    if is_number and len(samples) == 2:  # noqa: PLR2004 -- two groups
        t = stats.ttest_ind(*samples, equal_var=False)
        test = "t", t.statistic, t.df, t.pvalue
    elif is_number:
        f = stats.f_oneway(*samples)
        test = "F", f.statistic, counts.sum() - len(samples), f.pvalue
    else:
        chi2 = stats.chi2_contingency(counts, correction=False)
        test = "chi2", chi2.statistic, chi2.dof, chi2.pvalue
        if chi2.expected_freq.min() < _LEAST_EXPECTED:
            test = "fisher", np.nan, np.nan, exact_p(counts)
    is_known = np.isfinite(test[-1]) and not np.isinf(test[1])
    return dict(zip(_TEST, test, strict=True)) if is_known else {}
