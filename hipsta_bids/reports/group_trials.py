"""What a group page says about repeated sessions, the size of trials, and norms."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids.derivatives.names import TRIAL_TABLES
from hipsta_bids.reports import cells
from hipsta_bids.reports.group_maps import embedded
from hipsta_bids.reports.group_tables import GroupResults, far_scores, records, score_rows
from hipsta_bids.reports.maps import Picture

#: Participants per arm that the map's share is given for.
_USUAL = 200


def retest(results: GroupResults) -> Mapping[str, Any] | None:
    """List agreement between sessions, of summary measures and over maps."""
    record = results.record.get("retest")
    if not record:
        return None
    summary, points = _tables(results, "retest")
    return {
        "sessions": record["sessions"],
        "n": record["participants"],
        "rows": records(summary),
        "maps": list(_maps(points)),
        "pictures": _pictures(results, points, "retest"),
    }


def power(results: GroupResults) -> Mapping[str, Any] | None:
    """List participants per arm by summary measure and over maps, and what needs fewest."""
    effect = results.record.get("power")
    if not effect:
        return None
    summary, points = _tables(results, "power")
    settings = results.record["settings"]
    possible = summary[summary["per_arm"].notna()] if len(summary) else summary
    rows = records(summary)
    return {
        "kind": effect["kind"],
        "share": f"{100 * effect['share']:g}",
        "visits": [f"{month:g}" for month in effect["visits"]],
        "settings": settings["power"],
        "most": f"{effect['most']:,}",
        "alpha_point": f"{effect['alpha_point']:.2g}",
        "correction": settings["multiplicity"],
        "followed": effect["kind"] == "slowing"
        or (bool(len(summary)) and bool(summary["change_per_year"].notna().any())),
        "best": rows[0] if len(possible) else None,
        "rows": rows,
        "usual": _USUAL,
        "maps": [{**map_, **_spread(map_["points"])} for map_ in _maps(points)],
        "pictures": _pictures(results, points, "power"),
    }


def norms(results: GroupResults) -> Mapping[str, Any] | None:
    """Describe norms and how well they hold, or people against them."""
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


def _tables(results: GroupResults, question: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    summary, points = TRIAL_TABLES[question]
    return results.table(summary), results.everywhere(points)


def _maps(points: pd.DataFrame) -> Iterator[dict[str, Any]]:
    """Points with values of each map of each side."""
    if len(points):
        valid = points[points["n"] > 0]
        for (measure, hemi), rows in valid.groupby(["measure", "hemi"], sort=False):
            unit = str(rows["unit"].iloc[0])
            yield {"measure": measure, "hemi": hemi, "unit": unit, "points": rows}


def _spread(points: pd.DataFrame) -> dict[str, Any]:
    """Describe a map of participants per arm, and its point that needs fewest."""
    per_arm = points["per_arm"]
    return {
        # Points beyond the limit of the search need more than any that is known.
        "quartiles": np.percentile(per_arm.fillna(np.inf), [25, 50, 75], method="lower").tolist(),
        "usual": (per_arm <= _USUAL).mean(),
        "fewest": records(points[per_arm.notna()].nsmallest(1, "per_arm")),
    }


def _pictures(results: GroupResults, points: pd.DataFrame, question: str) -> list[Picture]:
    caption = {
        "retest": "agreement between sessions at each point",
        "power": "participants per arm at each point",
    }[question]
    return [
        picture
        for measure in (points["measure"].unique() if len(points) else ())
        for picture in embedded(
            results,
            f"{measure}_{question}",
            f"{cells.measure_title(measure)}: {caption}",
        )
    ]
