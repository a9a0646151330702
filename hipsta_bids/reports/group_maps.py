"""Maps of an analysis as the page draws them: means of groups, effects and significance."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids.artifacts import Float
from hipsta_bids.reports.figures import colors_of
from hipsta_bids.reports.group_results import (
    BOTH,
    MINUS,
    SIDES,
    GroupResults,
    number_text,
    records,
    spelled,
    unit_of,
    with_unit,
)

_SHARED = (2.0, 98.0)  # percentiles that the colors of means span
_EFFECTS = 99.0  # percentile of sizes that the colors of effects span
_SMALLEST_P = 1e-10
_LEAST_REACH = 3.0  # powers of ten of p that colors span at least
_EFFECT_NAMES = {"t": "Cohen's d", "F": "partial eta squared"}


def map_scenes(results: GroupResults) -> Mapping[str, Any] | None:
    """Collect the maps of all measures on regular grids.

    Parameters
    ----------
    results : GroupResults

    Returns
    -------
    mapping or None
        What the template lists and ``group.js`` draws; ``None`` if nothing was mapped.
    """
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
            yield {"name": path.stem, "title": f"{spelled(measure).capitalize()}: {title}"}


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
        "title": spelled(measure).capitalize(),
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
                "alt": f"Mean {spelled(measure)} of {group['group']}, {side['title']}: {span}",
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
                    "alt": f"{what.capitalize()} of {contrast} on {spelled(measure)},"
                    f" {side['title']}: {said}",
                }
