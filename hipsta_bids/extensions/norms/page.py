"""Section of the page of an analysis: norms, and participants against them."""

from collections.abc import Mapping
from typing import Any

import pandas as pd

from hipsta_bids.derivatives.analyses import GroupResults, records
from hipsta_bids.reports import cells, group_tables
from hipsta_bids.reports.group_maps import embedded
from hipsta_bids.reports.page import Section


def norms(results: GroupResults) -> Mapping[str, Any] | None:
    """Describe norms and how well they hold, or participants against them."""
    about = results.record.get("norms")
    if not about:
        return None
    table, scores = results.table("coverage"), results.table("zscores")
    shares = [name for name in table.columns if name.startswith("below_")]
    pictures = []
    for kind, suffix in (("norms", "centiles by age"), ("normmaps", "maps")):
        for path in sorted((results.folder / "figures").glob(f"*_{kind}.svg")):
            measure = cells.display_name(path.stem.removesuffix(f"_{kind}"))
            pictures += embedded(results, path.stem, f"{measure.capitalize()}: {suffix}")
    far, rows = list[dict[str, Any]](), list[tuple[str, str, list[pd.Series]]]()
    if len(scores):
        whole = scores[scores["region"].isna() | (scores["region"] == "all")]
        whole = whole.rename(columns={"z": "w", "adapted": "reference"})
        rows = score_rows(whole)
        far = far_scores(whole[~whole["reference"].astype(bool)])
    return {
        **about,
        "shares": shares,
        "calibration": records(table),
        "rows": rows,
        "adapted": any(site["new"] for site in about["sites"]),
        "far": far,
        "pictures": pictures,
    }


def scores(results: GroupResults) -> Mapping[str, Any] | None:
    """Compare the groups with the reference, and list participants far from it."""
    table = results.everywhere("wscores")
    if not len(table):
        return None
    level = (results.record.get("comparison") or {}).get("normative") or []
    whole = table[table["region"].isna() | (table["region"] == "all")]
    return {
        "reference": "=".join(str(part) for part in level),
        "rows": score_rows(whole),
        "far": far_scores(whole),
        "limit": cells.FAR,
    }


def score_rows(table: pd.DataFrame) -> list[tuple[str, str, list[pd.Series]]]:
    """List scores ``w`` by measure and side, of the ``reference`` and of the others."""
    return [
        (str(measure), str(hemi), [rows.loc[members, "w"].dropna() for members in (known, ~known)])
        for (measure, hemi), rows in table.groupby(["measure", "hemi"], sort=False)
        for known in [rows["reference"].astype(bool)]
    ]


def far_scores(table: pd.DataFrame) -> list[dict[str, Any]]:
    """List scores ``w`` far from zero, the farthest first."""
    far = table[table["w"].abs() > cells.FAR]
    far = far.reindex(far["w"].abs().sort_values(ascending=False, kind="stable").index)
    return records(far.head(group_tables.MOST_ROWS))


SECTIONS: tuple[Section[GroupResults], ...] = (
    Section("norms", "Norms", "group/norms.html", norms),
    Section("scores", "w-scores", "group/scores.html", scores, after="classification"),
)
