"""Maps of an analysis as the page draws them: means of groups, effects and significance."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from hipsta_bids.reports.display import (
    EFFECT_COLORS,
    P_COLORS,
    Effects,
    colors_of,
    effect_reach,
    kind_of,
    known,
    scale_of,
    significance_reach,
)
from hipsta_bids.reports.group_tables import (
    BOTH,
    MINUS,
    SIDES,
    GroupResults,
    display_name,
    map_unit,
    number_text,
    records,
    unit_of,
    with_brackets,
    with_unit,
)
from hipsta_bids.reports.maps import Picture, picture_of_file
from hipsta_bids.types import Float

#: Kinds of effect sizes, by the test.
EFFECT_NAMES = {"t": "Cohen's d", "F": "partial eta squared"}
_SMALLEST_P = 1e-10


def signed_logarithm(adjusted: Float, significant: NDArray[np.bool_], statistic: Float) -> Float:
    """Minus log10 of corrected p with the sign of the statistic; NaN where it does not survive."""
    size = -np.log10(np.clip(adjusted, _SMALLEST_P, 1))
    return np.where(significant, size * np.sign(statistic), np.nan)


def map_scenes(results: GroupResults) -> Mapping[str, Any] | None:
    """Collect the maps of all measures: scenes on regular grids, and figures of other surfaces."""
    maps = results.table("maps")
    if not len(maps):
        return None
    sides, pictures = {}, []
    for measure in maps["measure"].unique().tolist():
        own = maps[maps["measure"] == measure]
        if "node_x" in results.table(str(own["file"].iloc[0])):
            sides[measure] = [
                _side(results, str(hemi), _means(results, measure), rows)
                for hemi, rows in own.groupby("hemi", sort=False)
            ]
        else:
            title = display_name(measure).capitalize()
            pictures += embedded(results, f"{measure}_means", f"{title}: means")
            pictures += embedded(
                results, f"{measure}_contrasts", f"{title}: effects and significance"
            )
    every = [test for own in sides.values() for side in own for test in side["tests"]]
    blocks = [_block(results, measure, own, every) for measure, own in sides.items()]
    return {
        "blocks": [block for block, _ in blocks],
        "data": [scene for _, scene in blocks],
        "pictures": pictures,
    }


def embedded(results: GroupResults, name: str, caption: str, alt: str = "") -> list[Picture]:
    """Embed a figure of the analysis; none if figures were not made."""
    path = results.folder / "figures" / f"{name}.svg"
    return [picture_of_file(path, alt=alt or caption, caption=caption)] if path.exists() else []


def _means(results: GroupResults, measure: str) -> pd.DataFrame:
    means = results.table("means")
    return means[means["measure"] == measure] if len(means) else means


def _block(
    results: GroupResults,
    measure: str,
    sides: Sequence[Mapping[str, Any]],
    every: Sequence[Mapping[str, Any]],
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Everything about one measure, beside the tests of all: for the template and the script."""
    unit = map_unit(results, measure)
    scene = {
        "unit": unit_of(unit),
        "scales": _scales(results, measure, sides, every, unit),
        "sides": [_rounded(side) for side in sides],
    }
    block = {
        "title": display_name(measure).capitalize(),
        "means": list(_mean_panels(measure, unit, sides)),
        "contrasts": [
            {"name": name, "panels": list(_contrast_panels(measure, name, sides))}
            for name in dict.fromkeys(t["contrast"] for side in sides for t in side["tests"])
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


def _scales(
    results: GroupResults,
    measure: str,
    sides: Sequence[Mapping[str, Any]],
    every: Sequence[Mapping[str, Any]],
    unit: str,
) -> dict[str, Any]:
    """Choose ends, colors and words of the color bars; sides share them."""
    pair = (results.record.get("comparison") or {}).get("pair")
    change = bool(pair) or {side["hemi"] for side in sides} == {BOTH}
    kind = kind_of(measure, change=change)
    means = scale_of(kind, [g["values"] for side in sides for g in side["means"]])
    tests = [test for side in sides for test in side["tests"]]
    top = significance_reach([test["significance"] for test in tests])
    mean_label = "mean change" if pair else "mean"
    effects = {}
    # Each contrast has its own ends, the same for all measures: effects per year and of groups
    # differ by far.
    for test in tests:
        same = [one for one in every if one["contrast"] == test["contrast"]]
        reach = effect_reach([_effects(one) for one in same])
        label = f"effect size, {EFFECT_NAMES[test['kind']]}"
        effects[test["contrast"]] = _scale(EFFECT_COLORS, (-reach, reach), label)
    return {
        "mean": _scale(
            kind.colors,
            means,
            with_brackets(mean_label, unit),
        ),
        "effect": effects,
        "significance": _scale(
            P_COLORS,
            (-top, top),
            f"{MINUS}log₁₀ of corrected p, with the sign of the effect",
            _level_marks(results, top),
        ),
    }


def _effects(test: Mapping[str, Any]) -> Effects:
    values = test["values"]
    return Effects(test["kind"], test["effect"], values["statistic"], values["df"])


def _level_marks(results: GroupResults, top: float) -> list[tuple[float, str]]:
    """Positions on the bar of significance, in percent, of the level on both sides of zero."""
    alpha = ((results.record.get("settings") or {}).get("multiplicity") or {}).get("alpha", 0.05)
    share = -50 * np.log10(alpha) / top
    return [(round(50 + sign * share, 2), f"p {number_text(alpha)}") for sign in (-1, 1)]


def _scale(
    colors: str, ends: tuple[float, float], label: str, marks: Sequence[tuple[float, str]] = ()
) -> dict[str, Any]:
    return {
        "marks": marks,
        "low": ends[0],
        "high": ends[1],
        "words": [number_text(value) for value in (ends[0], sum(ends) / 2, ends[1])],
        "label": label,
        "colors": colors_of(colors).tolist(),
    }


def _span(values: Float) -> str:
    """Spell the smallest and the largest value."""
    some = known([values])
    return f"{number_text(some.min())} to {number_text(some.max())}" if len(some) else "n/a"


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
