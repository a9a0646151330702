"""Decisions, ratings and outliers by group, with a test: exclusions may bias a comparison."""

from collections.abc import Iterator

import numpy as np
import pandas as pd
from scipy import stats

from hipsta_bids.stats.formula import level_labels
from hipsta_bids.types import PARTICIPANT, RATINGS, Decision

#: Whether a hemisphere is an outlier of the cohort.
OUTLIER = ("no", "yes")
#: Values from best to worst; a participant has that of the worst hemisphere.
ORDERS = {
    "decision": [str(decision) for decision in Decision],
    "rating": ["unrated", *RATINGS],
    "outlier status": OUTLIER,
}
#: Level of the test, for a note only.
_LEVEL = 0.05


def exact_p(table: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> float:
    """Test a table of counts by Fisher's exact test, larger ones than 2 x 2 by simulation."""
    method = None if table.shape == (2, 2) else stats.MonteCarloMethod(rng=np.random.default_rng(0))
    return float(stats.fisher_exact(table, method=method).pvalue)


def quality_table(quality: pd.DataFrame, column: str) -> pd.DataFrame:
    """Count participants and hemispheres by decision, rating, outlier and group, with tests.

    ``quality`` has a row per hemisphere with participant, these three and the groups' ``column``.
    The unit of the test is the participant, with the worst value of all hemispheres.
    """
    if column not in quality:  # there are maps of other programs only
        return pd.DataFrame()
    labels = level_labels(quality[column])
    return pd.DataFrame(_rows(quality[labels.notna()], labels.dropna()))


def _rows(quality: pd.DataFrame, labels: pd.Series) -> Iterator[dict[str, object]]:
    """Return a row per value and group, of fields that vary."""
    for field, order in ORDERS.items():
        # A damaged record may have any word.
        ranks = quality[field].map({word: rank for rank, word in enumerate(order)}).dropna()
        ranks = ranks.astype(np.int64)
        if ranks.nunique() < 2:  # noqa: PLR2004 -- all have the same value
            continue
        worst = ranks.groupby(quality[PARTICIPANT]).max()
        group_of = labels.groupby(quality[PARTICIPANT]).first()[worst.index]
        people, sheets = pd.crosstab(worst, group_of), pd.crosstab(ranks, labels[ranks.index])
        p = exact_p(people.to_numpy()) if min(people.shape) > 1 else np.nan
        for rank in sheets.index:
            for group in sheets.columns:
                known = rank in people.index and group in people.columns
                yield {
                    "field": field,
                    "value": order[rank],
                    "group": group,
                    "participants": int(people.loc[rank, group]) if known else 0,
                    "hemispheres": int(sheets.loc[rank, group]),
                    "p": p,
                }


def quality_notes(table: pd.DataFrame) -> Iterator[str]:
    """Report fields whose values differ between groups."""
    for field, rows in table.groupby("field", sort=False) if len(table) else ():
        p = rows["p"].iloc[0]
        if p < _LEVEL:
            counts = "; ".join(
                f"{value} " + ", ".join(f"{g} {n}" for g, n in zip(*cells, strict=True))
                for value, cells in _cells(rows)
            )
            yield (
                f"the {field} differs between groups (Fisher's exact test, p {p:.2g}; participants:"
                f" {counts}); exclusions may bias the comparison, see quality.tsv"
            )


def _cells(rows: pd.DataFrame) -> Iterator[tuple[str, tuple[list[str], list[int]]]]:
    """Return groups and their numbers of participants by value."""
    for value, part in rows.groupby("value", sort=False):
        yield str(value), (part["group"].tolist(), part["participants"].tolist())
