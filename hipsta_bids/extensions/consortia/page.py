"""The page of a meta-analysis: what sites have in common, where they differ, and how."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from string import ascii_uppercase
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from hipsta_bids.derivatives.analyses import GroupResults, records
from hipsta_bids.io import files
from hipsta_bids.reports import cells, group_tables
from hipsta_bids.reports.group import heading, methods, origin
from hipsta_bids.reports.group_maps import map_scenes
from hipsta_bids.reports.group_tables import map_unit
from hipsta_bids.reports.page import Section, build_sections, render
from hipsta_bids.types import SIDES, p_text

#: Folder and page, in a separate output folder.
FOLDER, REPORT = "meta", "meta.html"
_PREFIX = "meta"
#: Forest plots of summary measures on the page; all are in the table.
_MOST_FORESTS = 60
_SITE, _PREDICTION = "site", "prediction"
_FIXED, _RANDOM = "fixed effect", "random effects"
#: Layout of a forest plot, pixels.
_NAMES, _PLOT, _TEXTS, _ROW, _TOP = 156, 236, 222, 21, 10
_LARGEST = 12.0  # side of the square of a site with all of the weight
_TICKS = 4


def _forests(results: GroupResults, *, maps: bool) -> Iterator[dict[str, Any]]:
    """Lay out the forest plots of peaks, or of summary measures."""
    table = results.table("forest")
    if not len(table):
        return
    at = table["x"].notna() if "x" in table else pd.Series(data=False, index=table.index)
    for number, rows in table[at == maps].groupby("plot", sort=False):
        first = records(rows.head(1))[0]
        side = SIDES[first["hemi"]] if maps else cells.summary_side(first["hemi"], first["measure"])
        position = f" at {cells.position_text(first)}" if maps else ""
        title = f"{cells.measure_title(first['measure'])}, {side}, {first['contrast']}"
        drawing = _drawing(records(rows), str(first["unit"]))
        yield {
            "number": int(str(number)),
            "title": title + position,
            "model": first["model"],
            "measure": first["measure"],
            **drawing,
        }


def _mark(row: Mapping[str, Any], number: int, across: Callable[[float], float]) -> dict[str, Any]:
    """Place the mark of a row, with positions ``across`` the plot."""
    is_site, estimate = row["kind"] == _SITE, row["estimate"]
    low_text, high_text = (cells.number_text(row[f"estimate_{end}"]) for end in ("low", "high"))
    text = f"[{low_text} to {high_text}]"
    if row["kind"] != _PREDICTION:
        text = f"{cells.number_text(estimate)} {text}"
    size = _LARGEST * math.sqrt(row["weight"]) if is_site else 0.0
    return {
        "kind": "diamond" if not is_site and row["kind"] != _PREDICTION else row["kind"],
        "name": row["site"],
        "n": f"n {row['n']:.0f}" if math.isfinite(row["n"]) else "",
        "y": _TOP + _ROW * number + _ROW / 2 + (6 if not is_site else 0),
        "low": across(row["estimate_low"]),
        "high": across(row["estimate_high"]),
        "at": across(estimate) if math.isfinite(estimate) else 0.0,
        "size": round(max(3.0, size), 1),
        "text": text,
    }


def _drawing(rows: Sequence[Mapping[str, Any]], unit: str) -> dict[str, Any]:
    """Place the marks of a forest plot; rows from top to bottom."""
    estimated = [row for row in rows if math.isfinite(row["estimate_low"])]
    drawn = [row for row in estimated if row["kind"] != _PREDICTION]
    ends = [row[name] for row in drawn for name in ("estimate_low", "estimate_high")]
    low, high = min(0.0, *ends), max(0.0, *ends)
    low, high = low - 0.04 * (high - low), high + 0.04 * (high - low)
    scale = _PLOT / max(high - low, 1e-300)

    def across(value: float) -> float:
        return float(round(_NAMES + (min(max(value, low), high) - low) * scale, 1))

    marks = [_mark(row, number, across) for number, row in enumerate(estimated)]
    random = next(row for row in rows if row["kind"] == _RANDOM)
    tau = cells.number_text(random["tau2"] ** 0.5)
    height = _TOP + _ROW * len(estimated) + 10
    values = "; ".join(f"{mark['name']} {mark['text']}" for mark in marks)
    return {
        "marks": marks,
        "names": _NAMES,
        "plot": _PLOT,
        "width": _NAMES + _PLOT + _TEXTS,
        "height": height + 34,
        "bottom": height,
        "zero": across(0.0),
        "rule": _TOP + _ROW * sum(mark["kind"] == _SITE for mark in marks) + 3,
        "ticks": [(across(value), cells.number_text(value)) for value in _ticks(low, high)],
        "unit": cells.unit_of(unit),
        "text_at": _NAMES + _PLOT + _TEXTS,
        "middle": _NAMES + _PLOT / 2,
        "alt": f"estimates with limits [{cells.unit_of(unit)}]: {values}",
        "between": f"I² {cells.percent_text(random['i2'])}, τ {cells.with_unit(tau, unit)},"
        f" Q p {p_text(random['q_p'])}",
        "p": random["p"],
        "p_text": p_text(random["p"]),
    }


def _ticks(low: float, high: float) -> list[float]:
    """Choose a few round numbers between two values."""
    rough = (high - low) / _TICKS
    power = 10.0 ** math.floor(math.log10(rough))
    step = power * min((1, 2, 5, 10), key=lambda times: abs(times * power - rough))
    return [step * i for i in range(math.ceil(low / step), math.floor(high / step) + 1)]


def _explained(results: GroupResults) -> Mapping[str, Any]:
    settings = (results.record.get("settings") or {}).get("meta") or {}
    sites = len(results.record.get("sites") or ())
    return {
        "random": settings.get("random"),
        "sites": sites,
        "needed": cells.number_text(float(stats.t.isf(0.0005, max(1, sites - 1)))),
        "confidence": f"{settings.get('confidence', 0.95):.0%}",
    }


def _maps(results: GroupResults) -> Mapping[str, Any] | None:
    scenes = map_scenes(results)
    return None if scenes is None else {**scenes, "flat": True}


def _peak_forests(results: GroupResults) -> Mapping[str, Any] | None:
    plots = sorted(_forests(results, maps=True), key=lambda plot: plot["measure"] != "thickness")
    return {"plots": plots, "more": 0, "what": "peak"} if plots else None


def _summary_forests(results: GroupResults) -> Mapping[str, Any] | None:
    plots = list(_forests(results, maps=False))
    if not plots:
        return None
    plots.sort(key=lambda plot: (not math.isfinite(plot["p"]), plot["p"]))
    return {
        "plots": plots[:_MOST_FORESTS],
        "more": max(0, len(plots) - _MOST_FORESTS),
        "what": "summary measure",
    }


def _pairs(table: pd.DataFrame, keys: Sequence[str]) -> pd.DataFrame:
    """Put fixed and random effects of a contrast in one row, as columns with these endings."""
    halves = []
    for kind in (_FIXED, _RANDOM):
        suffix = f" ({kind})"
        half = table[table["contrast"].str.endswith(suffix)]
        halves.append(half.assign(contrast=half["contrast"].str.removesuffix(suffix)))
    return halves[0].merge(halves[1], on=[*keys, "contrast"], suffixes=("_fixed", "_random"))


def _heterogeneity(results: GroupResults) -> Mapping[str, Any] | None:
    """Summarize maps: points that survive, and how much sites differ."""
    table = results.table("maps")
    if not len(table):
        return None
    rows = records(_pairs(table, ["measure", "hemi"]))
    for row in rows:
        points = results.table(str(row["file_random"])).dropna(subset="i2")
        row["median"], row["most"] = points["i2"].quantile([0.5, 0.95])
        row["tau"] = math.sqrt(points["tau2"].median())
        row["unit"] = map_unit(results, row["measure"])
        row["share"] = (points["q_p"] < 0.05).mean()  # noqa: PLR2004  (in words)
    return {"rows": rows}


def _measures(results: GroupResults) -> Mapping[str, Any] | None:
    """List summary measures: fixed effect, heterogeneity and random effects in one row."""
    table = results.table("measures")
    if not len(table):
        return None
    pairs = _pairs(table, ["measure", "hemi", "unit", "model"])
    # As the filter of limits wants them.
    pairs.columns = pairs.columns.str.replace(r"_(low|high)_(fixed|random)$", r"_\2_\1", regex=True)
    pairs["tau"] = np.sqrt(pairs["tau2_random"])
    pairs = pairs.sort_values(["p_fdr_fixed", "p_fixed"], kind="stable")
    models = pairs["model"].unique()
    return {
        "rows": records(pairs),
        "families": table["contrast"].nunique(),
        "letters": dict(zip(models, ascii_uppercase, strict=False)) if len(models) > 1 else {},
    }


def _without(results: GroupResults) -> Mapping[str, Any] | None:
    rows = records(results.table("leave_one_out"))
    return {"rows": rows} if rows else None


def _sites(results: GroupResults) -> Mapping[str, Any]:
    table = results.table("sites")
    columns = [name for name in table if name not in {"template", "version"}]
    return {
        "columns": [cells.with_brackets(str(name).replace("_", " "), "1") for name in columns],
        "rows": [
            [value if isinstance(value, str) else cells.number_text(float(value)) for value in row]
            for row in table[columns].to_numpy(object).tolist()
        ],
        "template": table["template"].iloc[0],
        "versions": sorted(set(table["version"].astype(str))),
    }


#: Sections of the page, from top to bottom.
SECTIONS: tuple[Section[GroupResults], ...] = (
    Section("found", "What was found", "group/found.html", group_tables.findings),
    Section("effects", "Fixed and random effects", "meta/effects.html", _explained),
    Section("summaries", "Summary measures", "meta/summaries.html", _measures),
    Section("between", "Maps: points and heterogeneity", "meta/heterogeneity.html", _heterogeneity),
    Section("sites", "Sites", "meta/sites.html", _sites),
    Section("forests", "Peaks by site", "meta/forests.html", _peak_forests),
    Section("measures", "Summary measures by site", "meta/forests.html", _summary_forests),
    Section("maps", "Maps", "group/maps.html", _maps),
    Section("without", "Without a site", "meta/without.html", _without),
    Section("peaks", "Clusters and peaks", "group/peaks.html", group_tables.peaks),
    Section("methods", "Methods paragraph", "group/methods.html", methods),
    Section("origin", "Origin", "group/origin.html", origin),
)


def meta_page(folder: Path) -> str:
    """Make the page about a meta-analysis from its files."""
    results = GroupResults(folder=folder, record=files.read_json(folder / "meta.json"))
    record = results.record
    return render(
        "group.html",
        title=f"Meta-analysis of {len(record.get('sites') or ())} sites",
        folder=folder.name,
        **heading(record),
        cohort=False,
        sections=build_sections(SECTIONS, results, _PREFIX),
    )


def write_meta_page(out_dir: Path) -> Path:
    """Write the page of a meta-analysis next to its folder, and return its path."""
    path = out_dir / REPORT
    files.remove([path])  # it may be that of an earlier one
    files.write_text(path, meta_page(out_dir / FOLDER))
    return path
