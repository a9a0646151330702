"""Maps of an analysis as the page draws them: means of groups, effects and significance.

How values become colors is shared with the figures.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from hipsta_bids.reports.group_tables import (
    BOTH,
    MINUS,
    SIDES,
    GroupResults,
    display_name,
    number_text,
    records,
    unit_of,
    with_unit,
)
from hipsta_bids.reports.maps import Picture, colors_of, picture_of_file
from hipsta_bids.types import Float

#: Kinds of effect sizes, by the test.
EFFECT_NAMES = {"t": "Cohen's d", "F": "partial eta squared"}
#: Color maps of means, of differences, of effect sizes and of significance.
MEAN_COLORS, CHANGE_COLORS, EFFECT_COLORS, P_COLORS = "viridis", "PRGn", "RdBu_r", "PuOr_r"

_SHARED = (2.0, 98.0)  # percentiles that the colors of means span
_EFFECTS = 99.0  # percentile of sizes that the colors of effects span
_SMALLEST = 1e-6  # reach of colors where all values are zero
_SMALLEST_P = 1e-10
_LEAST_REACH = 3.0  # powers of ten of p that colors span at least


def mean_limits(values: Sequence[Float], *, centered: bool) -> tuple[float, float]:
    """Choose the ends of the colors of means; those of differences are symmetric about zero."""
    known = _known(values)
    low, high = np.percentile(known, _SHARED).tolist() if len(known) else (0.0, 1.0)
    if not centered:
        return low, max(high, low + _SMALLEST)
    high = max(abs(low), abs(high), _SMALLEST)
    return -high, high


def effect_reach(values: Sequence[Float]) -> float:
    """Return the effect size at the end of the colors."""
    sizes = np.abs(_known(values))
    return max(float(np.percentile(sizes, _EFFECTS)) if len(sizes) else 0.0, _SMALLEST)


def signed_logarithm(adjusted: Float, significant: NDArray[np.bool_], statistic: Float) -> Float:
    """Minus log10 of corrected p with the sign of the statistic; NaN where it does not survive."""
    size = -np.log10(np.clip(adjusted, _SMALLEST_P, 1))
    return np.where(significant, size * np.sign(statistic), np.nan)


def significance_reach(values: Sequence[Float]) -> float:
    """Return the power of ten of p at the end of the colors."""
    return max(_LEAST_REACH, float(np.abs(_known(values)).max(initial=0)))


def map_scenes(results: GroupResults) -> Mapping[str, Any] | None:
    """Collect the maps of all measures: scenes on regular grids, and figures of other surfaces."""
    maps = results.table("maps")
    if not len(maps):
        return None
    blocks, pictures = [], []
    for measure in maps["measure"].unique().tolist():
        own = maps[maps["measure"] == measure]
        if "node_x" in results.table(str(own["file"].iloc[0])):
            blocks.append(_block(results, measure, own))
        else:
            title = display_name(measure).capitalize()
            pictures += embedded(results, f"{measure}_means", f"{title}: means")
            pictures += embedded(
                results, f"{measure}_contrasts", f"{title}: effects and significance"
            )
    return {
        "blocks": [block for block, _ in blocks],
        "data": [scene for _, scene in blocks],
        "pictures": pictures,
    }


def embedded(results: GroupResults, name: str, caption: str, alt: str = "") -> list[Picture]:
    """Embed a figure of the analysis; none if figures were not made."""
    path = results.folder / "figures" / f"{name}.svg"
    return [picture_of_file(path, alt=alt or caption, caption=caption)] if path.exists() else []


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
    kind = "t" if rows["cohen_d"].notna().any() else "F"
    significant = rows["significant"].to_numpy() == True  # noqa: E712  (may hold missing values)
    numbers = {
        name: rows[name].to_numpy(dtype=np.float64)
        for name in ("estimate", "statistic", "df", "p", "p_corrected", "n")
    }
    peaks = results.table("peaks")
    same = (peaks["measure"] == row["measure"]) & (peaks["hemi"] == row["hemi"])
    same &= (peaks["contrast"] == row["contrast"]) & (peaks["extent"] > 0)
    return {
        "contrast": row["contrast"],
        "kind": kind,
        "n_tests": int(row["n_tests"]),
        "n_significant": int(row["n_significant"]),
        "effect": rows["cohen_d" if kind == "t" else "eta_squared"].to_numpy(dtype=np.float64),
        "significance": signed_logarithm(numbers["p_corrected"], significant, numbers["statistic"]),
        "significant": significant.astype(int).tolist(),
        "values": numbers,
        "peaks": peaks.loc[same, ["x", "y"]].round(6).to_numpy().tolist(),
    }


def _scales(results: GroupResults, sides: Sequence[Mapping[str, Any]], unit: str) -> dict[str, Any]:
    """Choose ends, colors and words of the color bars; sides share them."""
    pair = (results.record.get("comparison") or {}).get("pair")
    centered = bool(pair) or {side["hemi"] for side in sides} == {BOTH}
    means = mean_limits([g["values"] for side in sides for g in side["means"]], centered=centered)
    tests = [test for side in sides for test in side["tests"]]
    top = significance_reach([test["significance"] for test in tests])
    mean_label = "mean change" if pair else "mean"
    effects = {}
    # Each contrast has its own ends: effects per year and of groups differ by far.
    for test in tests:
        same = [one["effect"] for one in tests if one["contrast"] == test["contrast"]]
        reach = effect_reach(same)
        label = f"effect size, {EFFECT_NAMES[test['kind']]}"
        effects[test["contrast"]] = _scale(EFFECT_COLORS, (-reach, reach), label)
    return {
        "mean": _scale(
            CHANGE_COLORS if centered else MEAN_COLORS,
            means,
            f"{mean_label} [{unit_of(unit)}]" if unit_of(unit) else mean_label,
        ),
        "effect": effects,
        "significance": _scale(
            P_COLORS, (-top, top), f"{MINUS}log₁₀ of corrected p, with the sign of the effect"
        ),
    }


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


def _span(values: Float) -> str:
    """Spell the smallest and the largest value."""
    known = _known([values])
    return f"{number_text(known.min())} to {number_text(known.max())}" if len(known) else "n/a"


def _rounded(side: Mapping[str, Any]) -> dict[str, Any]:
    """Prepare a side for JSON: colors and readers do not resolve more than four digits."""

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
            span = with_unit(_span(group["values"]), unit)
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
            count = f"{test['n_significant']} of {test['n_tests']} points survive"
            words = {
                "effect": ("effect size", f"{EFFECT_NAMES[test['kind']]} {_span(test['effect'])}"),
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
