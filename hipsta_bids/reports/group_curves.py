"""Charts of a group page: registration and classification."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids.artifacts import Float
from hipsta_bids.reports.charts import COLORS, Axis, Line, chart
from hipsta_bids.reports.group_findings import summary_side
from hipsta_bids.reports.group_results import MINUS, SIDES, GroupResults, records, spelled, unit_of
from hipsta_bids.reports.group_tables import classification

_ENDS = ("medial", "lateral")
_ERRORS = 2.0  # standard errors to either side
_MOST_WARPS = 300  # that are drawn, so that pages of large studies stay small


def registration(results: GroupResults) -> Mapping[str, Any] | None:
    """Show what registration has done: profiles before and after, and warps.

    Parameters
    ----------
    results : GroupResults

    Returns
    -------
    mapping or None
        For the template; ``None`` without sheets.
    """
    table = results.table("registration")
    if not len(table):
        return None
    warps = results.table("warps")
    extreme = warps[warps["extreme"] == True] if len(warps) else warps  # noqa: E712  (may be text)
    settings = (results.record.get("settings") or {}).get("registration") or {}
    return {
        "align": settings.get("align"),
        "rows": [
            {
                "side": SIDES.get(row["hemi"], row["hemi"]),
                "n": row["n"],
                "before": f"{row['explained_before']:.0%}",
                "after": f"{row['explained_after']:.0%}",
                "converged": bool(row["converged"]),
            }
            for row in records(table)
        ],
        "extreme": [
            {
                "who": " ".join(
                    str(row[name])
                    for name in ("participant_id", "session_id")
                    if isinstance(row[name], str)
                ),
                "side": SIDES.get(row["hemi"], row["hemi"]),
                "displacement": f"{row['displacement']:.1f}",
            }
            for row in records(extreme.sort_values("displacement", ascending=False))
        ],
        "profiles": list(_profiles(results)),
        "warps": list(_warps(results, warps)),
        "legend": _legend(results),
    }


def _groups(results: GroupResults) -> Sequence[str]:
    return results.levels or ("all",)


def _legend(results: GroupResults) -> list[dict[str, Any]]:
    return [
        {"name": group, "color": COLORS[i % len(COLORS)], "dashed": False}
        for i, group in enumerate(_groups(results))
    ]


def _profiles(results: GroupResults) -> Iterator[dict[str, Any]]:
    table = results.table("profiles")
    if not len(table):
        return
    for (measure, hemi), rows in table.groupby(["measure", "hemi"], sort=False):
        reach = _ERRORS * rows["mean_se"].fillna(0)
        low, high = (rows["mean"] - reach).min(), (rows["mean"] + reach).max()
        spare = 0.05 * (high - low)
        unit = unit_of(str(rows["unit"].iloc[0]))
        label = spelled(str(measure)) + (f" [{unit}]" if unit else "")
        for registered, own in rows.groupby("registered"):
            when = "after" if registered else "before"
            title = f"{spelled(str(measure)).capitalize()}, {SIDES.get(str(hemi), hemi)}, {when}"
            yield chart(
                title,
                f"{title} registration: means of groups from medial to lateral",
                list(_group_lines(results, own, "mean", "mean_se")),
                Axis(label="", ends=_ENDS),
                Axis(label=label, limits=(low - spare, high + spare)),
            )


def _group_lines(
    results: GroupResults, rows: pd.DataFrame, middle: str, error: str
) -> Iterator[Line]:
    for i, group in enumerate(_groups(results)):
        own = rows[rows["group"] == group]
        if len(own):
            yield Line(
                x=own["node_x"].to_numpy(dtype=np.float64),
                y=own[middle].to_numpy(dtype=np.float64),
                color=COLORS[i % len(COLORS)],
                reach=_ERRORS * own[error].to_numpy(dtype=np.float64),
            )


def _warps(results: GroupResults, warps: pd.DataFrame) -> Iterator[dict[str, Any]]:
    """Draw how far each sheet was moved, and the means of the groups over it."""
    shifts = results.table("shifts")
    nodes = [name for name in warps.columns if str(name).startswith("node_")]
    if not nodes:
        return
    place = np.arange(1.0, len(nodes) + 1)
    for hemi, rows in warps.groupby("hemi", sort=False):
        moved = rows[nodes].to_numpy(dtype=np.float64) * (len(nodes) - 1) - (place - 1)
        lines = [Line(x=place, y=one, color="#57606a", faint=True) for one in _some(moved)]
        if len(shifts):
            lines += _group_lines(results, shifts[shifts["hemi"] == hemi], "shift", "shift_se")
        title = f"Warps, {SIDES.get(str(hemi), hemi)}"
        yield chart(
            title,
            f"{title}: how far each sheet was moved, {moved.min():.1f} to {moved.max():.1f} nodes",
            lines,
            Axis(label="", ends=_ENDS),
            Axis(label="shift to lateral [nodes]"),
        )


def _some(rows: Float) -> Float:
    """Take rows at even distances, if there are too many to draw."""
    step = -(-len(rows) // _MOST_WARPS)
    return rows[:: max(step, 1)]


def classifiers(results: GroupResults) -> Mapping[str, Any] | None:
    """Show how well groups are told apart: table, ROC curves and calibration.

    Parameters
    ----------
    results : GroupResults

    Returns
    -------
    mapping or None
        For the template; ``None`` if no pair was compared.
    """
    rows = classification(results)
    if not rows:
        return None
    return {
        "rows": rows,
        "roc": list(
            _pairs(
                results.table("roc"),
                ("ROC", f"sensitivity against 1 {MINUS} specificity"),
                ("false_positives", "true_positives"),
                (f"1 {MINUS} specificity", "sensitivity"),
            )
        ),
        "calibration": list(
            _pairs(
                results.table("calibration"),
                ("Calibration", "share of cases against predicted chance"),
                ("predicted", "observed"),
                ("predicted chance, cross-validated", "share of cases"),
            )
        ),
        "legend": [
            {"name": "base", "color": COLORS[0], "dashed": True},
            {"name": "with the measure added", "color": COLORS[1], "dashed": False},
        ],
    }


def _pairs(
    table: pd.DataFrame,
    title: tuple[str, str],
    columns: tuple[str, str],
    labels: tuple[str, str],
) -> Iterator[dict[str, Any]]:
    """Draw both models of each comparison."""
    if not len(table):
        return
    for (control, case, hemi, added), rows in table.groupby(
        ["control", "case", "hemi", "added"], sort=False
    ):
        side = summary_side(str(hemi), str(added))
        what = f"{control} against {case}, {side}, {spelled(str(added))}"
        lines = []
        for i, name in enumerate(("base", "full")):
            own = rows[rows["classifier"] == name]
            x, y = (own[column].to_numpy(dtype=np.float64) for column in columns)
            dots = title[0] == "Calibration"
            lines.append(Line(x=x, y=y, color=COLORS[i], dots=dots, dashed=name == "base"))
        yield chart(
            what,
            f"{title[0]} of {what}: {title[1]}",
            lines,
            Axis(label=labels[0], limits=(0.0, 1.0)),
            Axis(label=labels[1], limits=(0.0, 1.0)),
            diagonal=True,
        )
