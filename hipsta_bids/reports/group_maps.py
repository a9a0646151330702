"""Maps of an analysis on its page: figures, and the values at each point of the sheet."""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids.derivatives.analyses import GroupResults, records
from hipsta_bids.reports import cells
from hipsta_bids.reports.display import known
from hipsta_bids.reports.group_tables import map_unit
from hipsta_bids.reports.maps import Picture, picture_of_file
from hipsta_bids.types import JOINT, SIDES, Float

#: Kinds of effect sizes, by the test.
EFFECT_NAMES = {"t": "Cohen's d", "F": "partial eta squared", "z": "combined evidence, z"}
EFFECT_COLUMNS = {"t": "cohen_d", "F": "eta_squared", "z": "statistic"}
#: Kinds of maps.
KINDS = ("mean", "effect", "significance")
_SMALLEST_P = 1e-10
#: Measures whose figures are shown at once, and at all; the folder has them all.
_OPEN, MOST_FIGURES = 2, 9
_HALF = 0.5  # of a cell, to its middle


def signed_logarithm(adjusted: Float, statistic: Float) -> Float:
    """Minus log10 of corrected p with the sign of the statistic; NaN without a test."""
    return np.asarray(-np.log10(np.clip(adjusted, _SMALLEST_P, 1)) * np.sign(statistic))


def kind_of_test(measure: str, points: pd.DataFrame) -> str:
    """Return the kind of the test in a table of points: ``t``, ``F``, or ``z`` of joint tests."""
    return "z" if measure == JOINT else "t" if points["cohen_d"].notna().any() else "F"


def map_id(kind: str, index: int | str, hemi: str) -> str:
    """Name an unfolded map inside a drawing: a mean of a group, or a contrast's effect or p."""
    return f"map-{kind}-{index}-{hemi}"


def measures_of(results: GroupResults) -> list[str]:
    """List the maps of an analysis in the order of its page, joint evidence first."""
    maps = results.table("maps")
    names = maps["measure"].unique().tolist() if len(maps) else []
    return sorted(map(str, names), key=lambda name: name != JOINT)


def map_scenes(results: GroupResults) -> Mapping[str, Any] | None:
    """Collect the figures of all measures, and the values to read at each point of the sheet."""
    maps = results.table("maps")
    if not len(maps):
        return None
    blocks, data = [], list[dict[str, Any]]()
    measures = measures_of(results)
    for measure in measures[:MOST_FIGURES]:
        rows = maps[maps["measure"] == measure]
        means = results.table("means")
        means = means[means["measure"] == measure] if len(means) else means
        scene: dict[str, Any] | None = None
        if "node_x" in results.table(str(rows["file"].iloc[0])):
            unit = cells.unit_of(map_unit(results, measure))
            sides = [
                _side(results, str(hemi), means, tests)
                for hemi, tests in rows.groupby("hemi", sort=False)
            ]
            scene = {"unit": unit, "sides": sides}
        title = cells.measure_title(measure)
        plates = [
            {"picture": picture, "spots": _spots(picture, scene, len(data)) if scene else []}
            for number in range(1, MOST_FIGURES)
            for name in [f"{measure}_maps" if number == 1 else f"{measure}_maps_{number}"]
            for picture in embedded(results, name, f"{title}, maps", _alternative(title, rows))
        ]
        blocks.append({"title": title, "plates": plates})
        if scene and plates:
            data.append(_rounded(scene))
    first = _OPEN + (JOINT in measures)
    return {"blocks": blocks[:first], "more": blocks[first:], "data": data}


def embedded(results: GroupResults, name: str, caption: str, alt: str = "") -> list[Picture]:
    """Embed a figure of the analysis; none if it was not made."""
    path = results.folder / "figures" / f"{name}.svg"
    return [picture_of_file(path, alt=alt or caption, caption=caption)] if path.exists() else []


def _alternative(title: str, maps: pd.DataFrame) -> str:
    """Write what the maps of a measure show."""
    counts = "; ".join(
        f"{row['contrast']}, {SIDES[row['hemi']]}: {row['n_significant']} of {row['n_tests']}"
        for row in records(maps)
    )
    content = "evidence" if maps["measure"].iloc[0] == JOINT else "means, effects"
    return f"{title}: {content} and significance. Points that survive: {counts}"


def _spots(picture: Picture, scene: Mapping[str, Any], block: int) -> list[dict[str, Any]]:
    """Find where the unfolded maps lie in a figure, in percent of it, and what they show."""
    number = r"([-\d.]+)"
    content = picture.content.decode()
    size = re.search(rf'viewBox="0 0 {number} {number}"', content)
    spots: list[dict[str, Any]] = []
    if size is None:
        return spots
    width, height = (float(length) / 100 for length in size.groups())
    corner = rf"M {number} {number}\s+L {number} {number}\s+L {number} {number}"
    sides = {side["hemi"]: (n, side) for n, side in enumerate(scene["sides"])}
    for kind in KINDS:
        name = map_id(kind, r"(\d+)", r"(\w+)")
        pattern = rf'<g id="{name}">\s*<g id="\w+">\s*<path d="{corner}'
        for index, hemi, *places in re.findall(pattern, content):
            left, bottom, right, _, _, top = map(float, places)
            at, side = sides[hemi]
            spots.append(
                {
                    "block": block,
                    "side": at,
                    "kind": kind,
                    "index": int(index),
                    "box": [
                        left / width,
                        top / height,
                        (right - left) / width,
                        (bottom - top) / height,
                    ],
                    "alt": _alt(side, kind, int(index)),
                    "numbers": _numbers(side, int(index)) if kind == "effect" else [],
                }
            )
    return spots


def _alt(side: Mapping[str, Any], kind: str, index: int) -> str:
    """Write what an unfolded map shows."""
    if kind == "mean":
        group = side["means"][index]
        return f"Mean of {group['group']}, {side['title']}: {_span(group['values'])}"
    test = side["tests"][index]
    text = f"{test['n_significant']} of {test['n_tests']} points survive"
    if kind == "effect":
        text = f"{EFFECT_NAMES[test['kind']]} {_span(test['effect'])}"
    return f"{kind.capitalize()} of {test['contrast']}, {side['title']}: {text}"


def _numbers(side: Mapping[str, Any], index: int) -> list[tuple[float, float]]:
    """Places of clusters on a map, in percent from its left and upper edge."""
    nx, ny = side["shape"]
    x, y = side["x"][::ny], side["y"][:ny]
    return [
        (
            100 * (int(np.abs(x - at[0]).argmin()) + _HALF) / nx,
            100 - 100 * (int(np.abs(y - at[1]).argmin()) + _HALF) / ny,
        )
        for at in side["tests"][index]["peaks"]
    ]


def _side(
    results: GroupResults, hemi: str, means: pd.DataFrame, maps: pd.DataFrame
) -> dict[str, Any]:
    first = results.table(str(maps["file"].iloc[0]))
    names = [name for name in first["subfield"].dropna().unique().tolist() if name]
    group_means = means[means["hemi"] == hemi] if len(means) else means
    groups = group_means.groupby("group", sort=False) if len(group_means) else ()
    return {
        "hemi": hemi,
        "title": SIDES[hemi],
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
    joint, kind = row["measure"] == JOINT, kind_of_test(row["measure"], rows)
    significant = rows["significant"].to_numpy() == True  # noqa: E712  (may hold missing values)
    numbers = {
        name: rows[name].to_numpy(dtype=np.float64)
        for name in ("estimate", "statistic", "df", "p", "p_corrected", "n")
        if name in rows
    }
    peaks = results.everywhere("peaks")
    selected = (peaks["measure"] == row["measure"]) & (peaks["hemi"] == row["hemi"])
    selected &= (peaks["contrast"] == row["contrast"]) & (peaks["extent"] > 0)
    return {
        "contrast": row["contrast"],
        "kind": kind,
        "n_tests": int(row["n_tests"]),
        "n_significant": int(row["n_significant"]),
        "effect": rows[EFFECT_COLUMNS[kind]].to_numpy(dtype=np.float64),
        "parts": [
            [f"p of {cells.display_name(str(name)[2:])}", rows[name].to_numpy(np.float64)]
            for name in rows
            if joint and str(name).startswith("p_") and name != "p_corrected"
        ],
        "significant": significant.astype(int).tolist(),
        "values": numbers,
        "peaks": peaks.loc[selected, ["x", "y"]].round(6).to_numpy().tolist(),
    }


def _span(values: Float) -> str:
    """Spell the smallest and the largest value."""
    finite = known([values])
    return (
        f"{cells.number_text(finite.min())} to {cells.number_text(finite.max())}"
        if len(finite)
        else "n/a"
    )


def _rounded(value: Any) -> Any:  # noqa: ANN401  (of JSON)
    """Prepare a side for JSON: colors and readers do not resolve more than four digits."""
    if isinstance(value, np.ndarray):
        return [float(f"{v:.4g}") if np.isfinite(v) else None for v in value.tolist()]
    if isinstance(value, Mapping):
        return {key: _rounded(part) for key, part in value.items()}
    return [_rounded(part) for part in value] if isinstance(value, list) else value
