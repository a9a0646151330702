"""Maps of an analysis as the page draws them: means of groups, effects and significance."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids.reports.group_tables import (
    BOTH,
    MINUS,
    SIDES,
    GroupResults,
    classification,
    display_name,
    number_text,
    records,
    summary_side,
    unit_of,
    with_unit,
)
from hipsta_bids.reports.maps import colors_of
from hipsta_bids.types import Float

_SHARED = (2.0, 98.0)  # percentiles that the colors of means span
_EFFECTS = 99.0  # percentile of sizes that the colors of effects span
_SMALLEST_P = 1e-10
_LEAST_REACH = 3.0  # powers of ten of p that colors span at least
_EFFECT_NAMES = {"t": "Cohen's d", "F": "partial eta squared"}


def map_scenes(results: GroupResults) -> Mapping[str, Any] | None:
    """Collect the maps of all measures on regular grids."""
    maps = results.table("maps")
    if not len(maps):
        return None
    blocks, pictures = [], []
    for measure in maps["measure"].unique().tolist():
        own = maps[maps["measure"] == measure]
        if "node_x" in results.table(str(own["file"].iloc[0])):
            blocks.append(_block(results, measure, own))
        else:
            pictures += list(_pictures(results, measure))
    return {
        "blocks": [block for block, _ in blocks],
        "data": [scene for _, scene in blocks],
        "pictures": pictures,
    }


def _pictures(results: GroupResults, measure: str) -> Iterator[dict[str, str]]:
    """Name the figures of maps that lie on a surface of their own."""
    titles = {"means": "means", "contrasts": "effects and significance"}
    for kind, title in titles.items():
        path = results.folder / "figures" / f"{measure}_{kind}.svg"
        if path.exists():
            yield {"name": path.stem, "title": f"{display_name(measure).capitalize()}: {title}"}


def _block(
    results: GroupResults, measure: str, maps: pd.DataFrame
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Everything about one measure: for the template, and for the script."""
    means = results.table("means")
    means = means[means["measure"] == measure] if len(means) else means
    unit = str(means["unit"].iloc[0]) if len(means) else "1"
    sides = [
        _side(results, str(hemi), means, rows) for hemi, rows in maps.groupby("hemi", sort=False)
    ]
    contrasts = maps["contrast"].unique().tolist()
    scene = {
        "unit": unit_of(unit),
        "scales": _scales(results, sides, unit),
        "sides": [_rounded(side) for side in sides],
    }
    block = {
        "title": display_name(measure).capitalize(),
        "means": list(_mean_panels(measure, unit, sides)),
        "contrasts": [
            {"name": name, "panels": list(_contrast_panels(measure, name, sides))}
            for name in contrasts
        ],
        "scales": scene["scales"],
    }
    return block, scene


def _side(
    results: GroupResults, hemi: str, means: pd.DataFrame, maps: pd.DataFrame
) -> dict[str, Any]:
    first = results.table(str(maps["file"].iloc[0]))
    names = [name for name in first["subfield"].dropna().unique().tolist() if name]
    own = means[means["hemi"] == hemi] if len(means) else means
    groups = own.groupby("group", sort=False) if len(own) else ()
    return {
        "hemi": hemi,
        "title": SIDES.get(hemi, hemi),
        "shape": [int(first["node_x"].max()), int(first["node_y"].max())],
        "x": first["x"].to_numpy(),
        "y": first["y"].to_numpy(),
        "names": names,
        "subfield": [names.index(name) if name in names else -1 for name in first["subfield"]],
        "means": [
            {"group": group, "n": int(rows["n"].max()), "values": rows["mean"].to_numpy()}
            for group, rows in groups
        ],
        "tests": [_test(results, row) for row in records(maps)],
    }


def _test(results: GroupResults, row: Mapping[str, Any]) -> dict[str, Any]:
    rows = results.table(str(row["file"]))
    kind = "t" if rows["cohen_d"].notna().any() else "F"
    adjusted = rows["p_corrected"].to_numpy(dtype=np.float64)
    significant = rows["significant"].to_numpy() == True  # noqa: E712  (may hold missing values)
    sign = np.sign(rows["statistic"].to_numpy(dtype=np.float64))
    size = -np.log10(np.clip(adjusted, _SMALLEST_P, 1))
    peaks = results.table("peaks")
    same = (peaks["measure"] == row["measure"]) & (peaks["hemi"] == row["hemi"])
    same &= (peaks["contrast"] == row["contrast"]) & (peaks["extent"] > 0)
    return {
        "contrast": row["contrast"],
        "kind": kind,
        "n_tests": int(row["n_tests"]),
        "n_significant": int(row["n_significant"]),
        "effect": rows["cohen_d" if kind == "t" else "eta_squared"].to_numpy(dtype=np.float64),
        "significance": np.where(significant, size * sign, np.nan),
        "significant": significant.astype(int).tolist(),
        "values": {
            name: rows[name].to_numpy(dtype=np.float64)
            for name in ("estimate", "statistic", "df", "p", "p_corrected", "n")
        },
        "peaks": peaks.loc[same, ["x", "y"]].round(6).to_numpy().tolist(),
    }


def _scales(results: GroupResults, sides: Sequence[Mapping[str, Any]], unit: str) -> dict[str, Any]:
    """Choose ends, colors and words of the color bars; sides share them."""
    pair = (results.record.get("comparison") or {}).get("pair")
    means = _known([group["values"] for side in sides for group in side["means"]])
    low, high = np.percentile(means, _SHARED) if len(means) else (0.0, 1.0)
    centered = bool(pair) or {side["hemi"] for side in sides} == {BOTH}
    if centered:  # differences, to either side of zero
        high = max(abs(low), abs(high), 1e-6)
        low = -high
    powers = np.abs(_known([test["significance"] for side in sides for test in side["tests"]]))
    top = max(_LEAST_REACH, float(powers.max(initial=0)))
    mean_label = "mean change" if pair else "mean"
    return {
        "mean": _scale(
            "PRGn" if centered else "viridis",
            (float(low), max(float(high), float(low) + 1e-6)),
            f"{mean_label} [{unit_of(unit)}]" if unit_of(unit) else mean_label,
        ),
        "effect": {
            test["contrast"]: _effect_scale(sides, test["contrast"], test["kind"])
            for side in sides
            for test in side["tests"]
        },
        "significance": _scale(
            "PuOr_r", (-top, top), f"{MINUS}log₁₀ of corrected p, with the sign of the effect"
        ),
    }


def _effect_scale(sides: Sequence[Mapping[str, Any]], contrast: str, kind: str) -> dict[str, Any]:
    """Give each contrast its own ends: effects per year and of groups differ by far."""
    tests = [test for side in sides for test in side["tests"] if test["contrast"] == contrast]
    sizes = np.abs(_known([test["effect"] for test in tests]))
    reach = max(float(np.percentile(sizes, _EFFECTS)) if len(sizes) else 0.0, 1e-6)
    return _scale("RdBu_r", (-reach, reach), f"effect size, {_EFFECT_NAMES[kind]}")


def _scale(colors: str, ends: tuple[float, float], label: str) -> dict[str, Any]:
    return {
        "low": ends[0],
        "high": ends[1],
        "words": [number_text(value) for value in (ends[0], sum(ends) / 2, ends[1])],
        "label": label,
        "colors": colors_of(colors).tolist(),
    }


def _known(arrays: Sequence[Float]) -> Float:
    every = np.concatenate([np.ravel(a) for a in arrays]) if arrays else np.empty(0)
    return np.asarray(every[np.isfinite(every)], dtype=np.float64)


def _rounded(side: Mapping[str, Any]) -> dict[str, Any]:
    """Make JSON of a side: four digits are more than colors and readers can tell."""

    def plain(value: Any) -> Any:  # noqa: ANN401  (of JSON)
        if isinstance(value, np.ndarray):
            return [float(f"{v:.4g}") if np.isfinite(v) else None for v in value.tolist()]
        if isinstance(value, Mapping):
            return {key: plain(part) for key, part in value.items()}
        return [plain(part) for part in value] if isinstance(value, list) else value

    return {key: plain(value) for key, value in side.items()}


def _mean_panels(
    measure: str, unit: str, sides: Sequence[Mapping[str, Any]]
) -> Iterator[dict[str, Any]]:
    for i, side in enumerate(sides):
        for j, group in enumerate(side["means"]):
            known = _known([group["values"]])
            ends = [number_text(v) for v in (known.min(), known.max())] if len(known) else ["n/a"]
            span = with_unit(" to ".join(ends), unit)
            yield {
                "side": i,
                "kind": "mean",
                "index": j,
                "title": f"{group['group']}, {side['title']}",
                "note": f"n = {group['n']}",
                "alt": f"Mean {display_name(measure)} of {group['group']}, {side['title']}: {span}",
            }


def _contrast_panels(
    measure: str, contrast: str, sides: Sequence[Mapping[str, Any]]
) -> Iterator[dict[str, Any]]:
    for i, side in enumerate(sides):
        for j, test in enumerate(side["tests"]):
            if test["contrast"] != contrast:
                continue
            sizes = _known([test["effect"]])
            ends = [number_text(v) for v in (sizes.min(), sizes.max())] if len(sizes) else ["n/a"]
            count = f"{test['n_significant']} of {test['n_tests']} points survive"
            words = {
                "effect": ("effect size", f"{_EFFECT_NAMES[test['kind']]} {' to '.join(ends)}"),
                "significance": ("significance", count),
            }
            for kind, (what, said) in words.items():
                yield {
                    "side": i,
                    "kind": kind,
                    "index": j,
                    "title": f"{side['title'].capitalize()}, {what}",
                    "note": count if kind == "significance" else "",
                    "alt": f"{what.capitalize()} of {contrast} on {display_name(measure)},"
                    f" {side['title']}: {said}",
                }


# Small line charts as drawings in the page, which wrap on narrow screens.


#: Colors of groups that people who cannot tell red from green can tell (Okabe and Ito 2008).
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#B07A00", "#56B4E9", "#000000")

_WIDTH, _HEIGHT = 320.0, 220.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 46.0, 8.0, 8.0, 34.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Line:
    """One curve."""

    x: Float
    y: Float
    color: str
    reach: Float | None = None
    """Half of the band round it, in units of y."""
    faint: bool = False
    """One of many."""
    dots: bool = False
    dashed: bool = False


@dataclass(frozen=True, kw_only=True)
class Axis:
    """One axis of a chart."""

    label: str
    limits: tuple[float, float] | None = None
    """``None`` for those of the data."""
    ends: tuple[str, str] | None = None
    """Words at both ends instead of numbers."""


def chart(
    title: str, alt: str, lines: Sequence[Line], x: Axis, y: Axis, *, diagonal: bool = False
) -> dict[str, Any]:
    """Lay out a chart for the template."""
    limits_x = x.limits or _limits([line.x for line in lines])
    reached = [line.y + side * (0 if line.reach is None else line.reach)
               for line in lines for side in (-1, 1)]  # fmt: skip
    limits_y = y.limits or _limits(reached, margin=0.06)

    def place_x(values: Float) -> Float:
        return _LEFT + _share(values, limits_x) * (_WIDTH - _LEFT - _RIGHT)

    def place_y(values: Float) -> Float:
        return _HEIGHT - _BOTTOM - _share(values, limits_y) * (_HEIGHT - _TOP - _BOTTOM)

    drawn = []
    for line in lines:
        px = place_x(line.x)
        drawn.append(
            {
                "color": line.color,
                "d": _path(px, place_y(line.y)),
                "faint": line.faint,
                "dashed": line.dashed,
                "band": None
                if line.reach is None
                else _band(px, place_y(line.y - line.reach), place_y(line.y + line.reach)),
                "dots": [
                    (round(float(a), 1), round(float(b), 1))
                    for a, b in zip(px, place_y(line.y), strict=True)
                ]
                if line.dots
                else [],
            }
        )
    corners = np.array([max(limits_x[0], limits_y[0]), min(limits_x[1], limits_y[1])])
    return {
        "title": title,
        "alt": alt,
        "size": (_WIDTH, _HEIGHT),
        "box": (_LEFT, _TOP, _WIDTH - _RIGHT, _HEIGHT - _BOTTOM),
        "lines": drawn,
        "x": {"label": x.label, "ends": x.ends, "ticks": _ticks(limits_x, place_x)},
        "y": {"label": y.label, "ticks": _ticks(limits_y, place_y)},
        "diagonal": _path(place_x(corners), place_y(corners)) if diagonal else None,
    }


def _limits(values: Sequence[Float], margin: float = 0.0) -> tuple[float, float]:
    every = np.concatenate([np.ravel(part) for part in values])
    every = every[np.isfinite(every)]
    if not len(every):
        return 0.0, 1.0
    low, high = float(every.min()), float(every.max())
    spare = margin * (high - low) or (0.0 if high > low else 0.5 * abs(high) or 1.0)
    return low - spare, high + spare


def _share(values: Float, limits: tuple[float, float]) -> Float:
    return (np.asarray(values, dtype=np.float64) - limits[0]) / (limits[1] - limits[0])


def _ticks(limits: tuple[float, float], place: Any) -> list[tuple[float, str]]:  # noqa: ANN401  (a local function)
    """Choose round numbers: their places and words."""
    raw = (limits[1] - limits[0]) / 4
    power = 10.0 ** np.floor(np.log10(raw))
    step = power * next(factor for factor in (1, 2, 2.5, 5, 10) if factor * power >= raw * 0.999)
    values = np.arange(np.ceil(limits[0] / step - 1e-9), np.floor(limits[1] / step + 1e-9) + 1)
    places = place(values * step)
    return [
        (round(float(at), 1), f"{value * step + 0.0:.6g}".replace("-", "\N{MINUS SIGN}"))
        for at, value in zip(places, values, strict=True)
    ]


def _path(x: Float, y: Float) -> str:
    """Draw through known points; a gap parts the line."""
    parts, pen = [], "M"
    for a, b in zip(x.tolist(), y.tolist(), strict=True):
        if np.isfinite(a) and np.isfinite(b):
            parts.append(f"{pen}{a:.1f} {b:.1f}")
            pen = "L"
        else:
            pen = "M"
    return "".join(parts)


def _band(x: Float, low: Float, high: Float) -> str:
    known = np.isfinite(x) & np.isfinite(low) & np.isfinite(high)
    if not known.any():
        return ""
    round_x = np.concatenate([x[known], x[known][::-1]])
    return _path(round_x, np.concatenate([low[known], high[known][::-1]])) + "Z"


# Charts of a group page: registration and classification.


_ENDS = ("medial", "lateral")
_ERRORS = 2.0  # standard errors to either side
_MOST_WARPS = 300  # that are drawn, so that pages of large studies stay small


def registration(results: GroupResults) -> Mapping[str, Any] | None:
    """Show what registration has done: profiles before and after, and warps."""
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
        label = display_name(str(measure)) + (f" [{unit}]" if unit else "")
        for registered, own in rows.groupby("registered"):
            when = "after" if registered else "before"
            title = (
                f"{display_name(str(measure)).capitalize()}, {SIDES.get(str(hemi), hemi)}, {when}"
            )
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
    """Show how well groups are told apart: table, ROC curves and calibration."""
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
        what = f"{control} against {case}, {side}, {display_name(str(added))}"
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
