"""Sections of the page of an analysis: sample sizes, and agreement between sessions."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids.derivatives.analyses import GroupResults, records
from hipsta_bids.reports import cells
from hipsta_bids.reports.group_maps import embedded
from hipsta_bids.reports.maps import Picture
from hipsta_bids.reports.page import Section

#: Tables of the group level about repeated sessions and sample sizes: of summary measures, and of
#: the points of maps.
TABLES: dict[str, tuple[str, str]] = {
    "retest": ("retest", "retest_points"),
    "power": ("power", "power_points"),
}
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
    unequal = settings["power"].get("allocation", 1) > 1
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
        "unequal": unequal,
        "arm": "Smaller arm" if unequal else "Per arm",
        "rows": rows,
        "usual": _USUAL,
        "maps": [{**map_, **_spread(map_["points"])} for map_ in _maps(points)],
        "pictures": _pictures(results, points, "power"),
    }


def _tables(results: GroupResults, question: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    summary, points = TABLES[question]
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
    arm = "of the smaller arm" if "larger_arm" in points else "per arm"
    caption = {
        "retest": "agreement between sessions at each point",
        "power": f"participants {arm} at each point",
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


SECTIONS: tuple[Section[GroupResults], ...] = (
    Section("power", "Sample size", "group/power.html", power),
    Section("retest", "Test-retest", "group/retest.html", retest),
)
