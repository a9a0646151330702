"""What a group page says about repeated sessions, the size of trials, and norms."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids.derivatives.names import TRIAL_TABLES
from hipsta_bids.io import files
from hipsta_bids.reports.group_maps import embedded
from hipsta_bids.reports.group_tables import (
    SIDES,
    GroupResults,
    display_name,
    far_scores,
    measure_title,
    number_text,
    p_text,
    position_text,
    records,
    score_rows,
    summary_side,
    with_brackets,
)
from hipsta_bids.reports.maps import Picture

#: Participants per arm that the map's share is given for.
_USUAL = 200


def retest(results: GroupResults) -> Mapping[str, Any] | None:
    """List agreement between sessions, of summary measures and over maps."""
    asked = results.record.get("retest")
    if not asked:
        return None
    summary, points = _tables(results, "retest")
    return {
        "sessions": asked["sessions"],
        "n": asked["participants"],
        "rows": [
            {
                "measure": _title(row),
                "side": summary_side(row["hemi"], row["measure"]),
                "n": int(row["n"]),
                "mean": number_text(row["mean"]),
                "between": number_text(row["sd_between"]),
                "within": _limited(row, "sd_within"),
                "icc": _limited(row, "icc", digits=2),
                "detectable": number_text(row["detectable_change"]),
                "p": p_text(row["p_sessions"]),
            }
            for row in records(summary)
        ],
        "maps": [
            {
                "measure": title,
                "side": side,
                "points": len(own),
                "icc": _quartiles(own["icc"]),
                "within": _quartiles(own["sd_within"]),
                "detectable": _quartiles(own["detectable_change"]),
            }
            for title, side, own in _maps(points)
        ],
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
    rows = [
        {
            "measure": _title(row),
            "side": summary_side(row["hemi"], row["measure"]),
            "n": int(row["n"]),
            "mean": number_text(row["mean"]),
            "change": number_text(row["change_per_year"]),
            "difference": number_text(row["arm_difference"]),
            "sd": number_text(row["sd_endpoint"]),
            "d": number_text(row["cohen_d"]),
            "per_arm": _count(row["per_arm"]),
            "limits": f"{_count(row['per_arm_low'])} to {_count(row['per_arm_high'])}",
            "enrolled": _count(row["enrolled_per_arm"]),
        }
        for row in records(summary)
    ]
    return {
        "kind": effect["kind"],
        "share": f"{100 * effect['share']:g}",
        "visits": [f"{month:g}" for month in effect["visits"]],
        "settings": settings["power"],
        "dropout": f"{100 * settings['power']['dropout']:g}",
        "affected": f"{100 * settings['power']['affected']:g}",
        "most": f"{effect['most']:,}",
        "alpha_point": f"{effect['alpha_point']:.2g}",
        "correction": settings["multiplicity"],
        "followed": effect["kind"] == "slowing"
        or (bool(len(summary)) and bool(summary["change_per_year"].notna().any())),
        "best": rows[0] if len(possible) else None,
        "rows": rows,
        "usual": _USUAL,
        "maps": [_spread(title, side, own) for title, side, own in _maps(points)],
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
    for kind, what in (("norms", "centiles by age"), ("normmaps", "maps")):
        for path in sorted((results.folder / "figures").glob(f"*_{kind}.svg")):
            measure = display_name(path.stem.removesuffix(f"_{kind}"))
            pictures += embedded(results, path.stem, f"{measure.capitalize()}: {what}")
    far: list[dict[str, str]] = []
    rows: list[dict[str, Any]] = []
    if len(scores):
        whole = scores[scores["region"].isna() | (scores["region"] == "all")]
        whole = whole.rename(columns={"z": "w", "adapted": "reference"})
        rows = list(score_rows(whole))
        far = list(far_scores(whole[~whole["reference"].astype(bool)]))
    return {
        **about,
        "levels": [name.removeprefix("below_") for name in shares],
        "calibration": [
            {
                "measure": display_name(row["measure"]),
                "side": summary_side(row["hemi"], row["measure"]),
                "n": row["n"],
                "points": row["n_points"],
                "transformed": f"{row['transformed']:.0%}",
                "shares": [f"{100 * row[name]:.1f}" for name in shares],
            }
            for row in records(table)
        ],
        "rows": rows,
        "adapted": any(site["new"] for site in about["sites"]),
        "far": far,
        "pictures": pictures,
    }


def _tables(results: GroupResults, question: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    summary, points = TRIAL_TABLES[question]
    return results.table(summary), results.everywhere(points)


def _maps(points: pd.DataFrame) -> Iterator[tuple[str, str, pd.DataFrame]]:
    """Points with values of each map of each side, with the titles of both."""
    if len(points):
        known = points[points["n"] > 0]
        for (measure, hemi), own in known.groupby(["measure", "hemi"], sort=False):
            title = with_brackets(display_name(str(measure)), str(own["unit"].iloc[0]))
            yield title, SIDES[str(hemi)], own


def _spread(title: str, side: str, own: pd.DataFrame) -> dict[str, Any]:
    """Describe a map of participants per arm, and its point that needs fewest."""
    known = own[own["per_arm"].notna()]
    fewest = ""
    if len(known):
        (best,) = records(known.nsmallest(1, "per_arm"))
        fewest = f"{_count(best['per_arm'])}: {position_text(best)}"
    # Points beyond the limit of the search need more than any that is known.
    low, middle, high = np.percentile(own["per_arm"].fillna(np.inf), [25, 50, 75], method="lower")
    return {
        "measure": title,
        "side": side,
        "points": len(own),
        "middle": f"{_count(middle)} ({_count(low)} to {_count(high)})",
        "usual": f"{(own['per_arm'] <= _USUAL).mean():.0%}",
        "fewest": fewest,
    }


def _title(row: Mapping[str, Any]) -> str:
    return with_brackets(display_name(row["measure"]), row["unit"])


def _limited(row: Mapping[str, Any], name: str, digits: int | None = None) -> str:
    """Write a number with its limits."""
    values = [row[name], row[f"{name}_low"], row[f"{name}_high"]]
    if digits is None:
        value, low, high = (number_text(one) for one in values)
    else:
        value, low, high = (f"{one:.{digits}f}".replace("-", "\N{MINUS SIGN}") for one in values)
    return f"{value} ({low} to {high})"


def _quartiles(values: pd.Series) -> str:
    """Write the median with the quartiles."""
    if not values.notna().any():
        return files.MISSING
    low, middle, high = (number_text(one) for one in values.quantile([0.25, 0.5, 0.75]))
    return f"{middle} ({low} to {high})"


def _count(value: float) -> str:
    return f"{value:,.0f}" if np.isfinite(value) else "more"


def _pictures(results: GroupResults, points: pd.DataFrame, question: str) -> list[Picture]:
    what = {
        "retest": "agreement between sessions at each point",
        "power": "participants per arm at each point",
    }[question]
    return [
        picture
        for measure in (points["measure"].unique() if len(points) else ())
        for picture in embedded(
            results,
            f"{measure}_{question}",
            f"{measure_title(measure)}: {what}",
        )
    ]
