"""What a group page says: findings in sentences, and tables of all else that an analysis left."""

import re
from collections.abc import Iterator, Mapping, Sequence
from string import ascii_uppercase
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from hipsta_bids.derivatives.analyses import GroupResults, records, short_contrast, without_effects
from hipsta_bids.joints import find_sessions, load, load_all
from hipsta_bids.reports import cells
from hipsta_bids.types import DIFFERENCE, FAMILY, JOINT, REGION, SIDES, p_text

_ALPHA = 0.05  # of tests of summary measures and of models, for a word only
_LEAST_SHARE = 0.01  # share of a map; what survives in less of it is no finding of the same rank
_VISIBLE_ROWS = 12  # of summary measures in what was found; more are folded
MOST_ROWS = 200  # of lists, so that pages stay small
#: Summary measures of the thickness of the whole sheet.
_THICKNESS = ("thickness_mean", "thickness_nodes")
#: Tests of demographics by their names in tables.
_TESTS = {
    "t": "Welch's t test",
    "F": "one-way analysis of variance",
    "chi2": "Pearson's chi-squared test",
    "fisher": "Fisher's exact test",
}


def direction(results: GroupResults, contrast: str, hemi: str, sign: float) -> str:
    """Describe what a contrast above or below zero means."""
    if contrast == "mean" and hemi == DIFFERENCE:
        return "larger on the left" if sign > 0 else "larger on the right"
    if contrast == "mean" and results.is_change:
        return "with an increase" if sign > 0 else "with a decrease"
    short = short_contrast(contrast)
    for first in results.levels:
        for second in results.levels:
            if re.fullmatch(rf"(?:.* in )?{re.escape(first)}-{re.escape(second)}", short):
                return f"larger in {first if sign > 0 else second}"
    return "positive" if sign > 0 else "negative"


def _cards(results: GroupResults, maps: pd.DataFrame) -> dict[str, Any]:
    """Sort maps by the share of their points that survived."""
    cards = []
    groups = maps.groupby(["measure", "contrast"], sort=False) if len(maps) else ()
    for (measure, contrast), rows in groups:
        sides = [_side(results, row) for row in records(rows)]
        title = f"{cells.measure_title(measure)}, {contrast}"
        share = max(side["share"] for side in sides)
        cards.append({"title": title, "sides": sides, "share": share})
    cards.sort(key=lambda card: -card["share"])
    return {
        "n": len(cards),
        "cards": [card for card in cards if card["share"] >= _LEAST_SHARE],
        "few": [card for card in cards if 0 < card["share"] < _LEAST_SHARE],
        "none": [card for card in cards if not card["share"]],
        "least": _LEAST_SHARE,
    }


def findings(results: GroupResults) -> Mapping[str, Any] | None:
    """Describe what survived, by measure and contrast, the largest part of a map first."""
    maps = results.table("maps")
    if "contrasts" not in results.record:
        return None  # nothing was compared
    settings = results.record.get("settings") or {}
    multiplicity = settings.get("multiplicity") or {}
    scope = multiplicity.get("scope", "map")
    family = list(FAMILY.get(scope, FAMILY["map"]))
    measures = results.table("measures")
    tests, unknown = measures, []
    if len(measures):
        tests, unknown = estimated(measures), records(measures[measures["statistic"].isna()])
    sided = results.record.get("one_sided") or {}
    return _cards(results, maps) | {
        "families": maps[family].drop_duplicates().shape[0] if len(maps) else 0,
        "scope": scope,
        "tested": len(tests),
        "contrasts": tests["contrast"].nunique() if len(tests) else 0,
        "unknown": [f"{name}, {sides}" for name, sides in _names_and_sides(unknown)],
        "estimated": describe_rows(results)[1],
        "sites": "sites" in results.record,
        "signed": set(results.record["contrasts"]) > set(sided) or not sided,
        "margins": [(str(name), side_words(text)) for name, text in sided.items()],
        "limits": 1 - 2 * multiplicity["alpha"] if "limit_low" in measures else None,
        "summaries": _summaries(results),
        "visible": _VISIBLE_ROWS,
        "letters": letters_of(measures),
        "slopes": _slopes(results, measures),
        "opposite": opposite_changes(measures),
        "classification": list(_classification(results)),
        "method": multiplicity.get("method"),
        "alpha": multiplicity.get("alpha"),
        "further": [part for make in load_all("findings") if (part := make(results))],
    }


def estimated(measures: pd.DataFrame) -> pd.DataFrame:
    """Select the tests of summary measures whose models could be estimated."""
    tests: pd.DataFrame = measures[np.isfinite(measures["statistic"])]
    return tests


def describe_rows(results: GroupResults) -> tuple[str, str]:
    """Describe a row of the model, and name the estimate that may be missing."""
    comparison = results.record.get("comparison") or {}
    texts = (load(one.page)(comparison) for one in find_sessions())
    return next(filter(None, texts), ("A row is a participant.", "the model"))


def _names_and_sides(rows: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, str]]:
    """Yield each measure in words, with its sides."""
    sides: dict[str, dict[str, None]] = {}
    for row in rows:
        name = str(row["measure"])
        sides.setdefault(name, {})[cells.summary_side(row["hemi"], name)] = None
    for name, words in sides.items():
        yield cells.display_name(name), " and ".join(words)


def side_words(hypothesis: str) -> str:
    """Write the alternative of a one-sided test: ``> -0.05`` as *above*, with the margin."""
    for sign, word in ((">", "above"), ("<", "below"), ("-", cells.MINUS)):
        hypothesis = hypothesis.replace(sign, word)
    return hypothesis


def _side(results: GroupResults, row: Mapping[str, Any]) -> dict[str, Any]:
    """Describe what survived in a map in one line."""
    peaks = results.everywhere("peaks")
    selected = (peaks["measure"] == row["measure"]) & (peaks["contrast"] == row["contrast"])
    candidates = peaks[selected & (peaks["hemi"] == row["hemi"])]
    n, total = int(row["n_significant"]), int(row["n_tests"])
    title, share = SIDES[row["hemi"]].capitalize(), n / total if total else 0.0
    if not len(candidates):
        return {"title": title, "share": 0.0, "text": "nothing could be tested"}
    sided = (results.record.get("one_sided") or {}).get(row["contrast"])
    if sided:
        unit = slope_unit(results, map_unit(results, row["measure"]), row["contrast"])
        words = side_words(sided)
        words = cells.with_unit(words, unit) if words[-1].isdigit() else words
    if not n:
        ending = f"is shown to be {words}" if sided else "survives"
        return {"title": title, "share": 0.0, "text": f"none of {total} points {ending}"}
    points = results.table(str(row["file"]))
    first = records(candidates)[int(np.argmax(candidates["statistic"].abs()))]
    counts = "" if sided else "".join(_directions(results, row, points))
    text = f"{n} of {total} points survive ({_percent(share)}){counts}"
    if sided:
        text = f"{n} {words}, {total - n} not shown ({_percent(share)} of {total} points)"
    if str(row.get("lenient", "")).lower() == "true":
        text += (
            f", uncorrected p up to {row['p_cutoff']:.2g} since the effect is widespread, or all"
            " values are shifted"
        )
    return {"title": title, "share": share, "text": f"{text}; peak {_peak(results, first, points)}"}


def _percent(share: float) -> str:
    return f"{share:.0%}" if share >= _LEAST_SHARE else "less than 1%"


def _directions(
    results: GroupResults, row: Mapping[str, Any], points: pd.DataFrame
) -> Iterator[str]:
    """Name the directions of the points that survive; with two, count each."""
    significant = points[points["significant"] == True]  # noqa: E712  (may hold missing values)
    if "cohen_d" not in points or not points["cohen_d"].notna().any():
        return
    signs = np.sign(significant["statistic"])
    for sign in (1, -1):
        if count := int((signs == sign).sum()):
            number = f"{count} " if count < len(significant) else ""
            words = direction(results, str(row["contrast"]), str(row["hemi"]), sign)
            yield f", {number}{words}"


def _peak(results: GroupResults, peak: Mapping[str, Any], points: pd.DataFrame) -> str:
    """Describe the position of a peak in words, its size and its significance."""
    corrected = f"corrected p {p_text(peak['p_corrected'])}"
    place = cells.position_text(peak).partition(" (x ")[0]
    if peak["measure"] == JOINT:
        return f"{place}: {peak['measures']}; together {corrected}"
    point = point_of(peak, points)
    effects = [f"{cells.effect_name(peak['effect'])} {cells.number_text(peak['effect_size'])}"]
    if point is not None and np.isfinite(point["estimate"]):
        unit = slope_unit(results, map_unit(results, peak["measure"]), peak["contrast"])
        effects.insert(0, cells.with_unit(cells.number_text(point["estimate"]), unit))
    return f"{place}: {', '.join([*effects, corrected])}"


def map_unit(results: GroupResults, measure: str) -> str:
    """Look up the unit of a map, by the means of groups or in forest plots."""
    means = results.everywhere("means")
    means = means if len(means) else results.table("forest")
    if not len(means):
        return "1"
    units = means.loc[means["measure"] == measure, "unit"]
    return str(units.iloc[0]) if len(units) else "1"


def point_of(peak: Mapping[str, Any], points: pd.DataFrame) -> pd.Series | None:
    """Find the point of a map that a peak is."""
    names = ("vertex",) if "vertex" in points else ("x", "y")
    matches = np.all([points[name] == peak[name] for name in names], axis=0)
    return points[matches].iloc[0] if matches.any() else None


def _summaries(results: GroupResults) -> list[dict[str, Any]]:
    """List summary measures that differ, corrected for their number, the smallest p first."""
    table = results.table("measures")
    if not len(table):
        return []
    model = (results.record.get("settings") or {}).get("model") or {}
    low = table[table["p_fdr"] < _ALPHA].sort_values(["p_fdr", "p"], kind="stable")
    if "estimate_low" not in low:
        df = low["df"].where(np.isfinite(low["df"]), np.inf)
        reach = stats.t.isf((1 - model.get("confidence", 0.95)) / 2, df) * low["se"]
        limits = {"low": low["estimate"] - reach, "high": low["estimate"] + reach}
        limits = {end: low.get(f"limit_{end}", v).fillna(v) for end, v in limits.items()}
        low = low.assign(**{f"estimate_{end}": values for end, values in limits.items()})
    return records(low)


def slope_of(results: GroupResults, contrast: str) -> str:
    """Name the variable that a contrast is a slope over; empty for other contrasts.

    All its columns are products of this variable and levels of factors.
    """
    weights = (results.record.get("contrasts") or {}).get(without_effects(contrast))
    names = results.record.get("columns") or ()
    if weights is None or np.atleast_2d(weights).shape != (1, len(names)):
        return ""
    columns = (name.split(":") for name, w in zip(names, np.ravel(weights), strict=True) if w)
    numbers = {tuple(part for part in column if "[" not in part) for column in columns}
    variable = numbers.pop() if len(numbers) == 1 else ()
    return variable[0] if len(variable) == 1 and variable != ("Intercept",) else ""


def letters_of(measures: pd.DataFrame) -> dict[str, str]:
    """Give letters to the models of summary measures, if there are several."""
    models = measures["model"].unique().tolist() if len(measures) else []
    return dict(zip(models, ascii_uppercase, strict=False)) if len(models) > 1 else {}


def _slopes(results: GroupResults, measures: pd.DataFrame) -> dict[str, str]:
    """List the contrasts of summary measures that are slopes, with their variables."""
    names = measures["contrast"].unique().tolist() if len(measures) else []
    return {name: slope_of(results, name) for name in names if slope_of(results, name)}


def slope_unit(results: GroupResults, unit: str, contrast: str) -> str:
    """Write the unit of the estimate of a contrast: of a slope, by unit of its variable."""
    variable = slope_of(results, contrast)
    return f"{'' if unit == '1' else unit} per unit of {variable}".lstrip() if variable else unit


def opposite_changes(measures: pd.DataFrame) -> list[str]:
    """List contrasts in which volume and mean thickness change in opposite directions.

    Both have corrected p-values below the level, in one hemisphere or in the mean of both.
    """
    if not len(measures):
        return []
    low = measures[(measures["test"] == "t") & (measures["p_fdr"] < _ALPHA)]
    lines = []
    for contrast, rows in low.groupby("contrast", sort=False):
        sides = []
        for row in records(rows[rows["measure"].isin(_THICKNESS)]):
            volumes = rows[(rows["measure"] == "volume") & (rows["hemi"] == row["hemi"])]
            for volume in volumes["effect_size"][volumes["estimate"] * row["estimate"] < 0]:
                name, d = str(row["measure"]), cells.number_text(row["effect_size"])
                side = cells.summary_side(row["hemi"], name)
                sides.append(f"{side}: volume d {cells.number_text(volume)}, {name} d {d}")
        if sides:
            lines.append(
                f"{contrast}: volume and mean thickness change in opposite directions"
                f" ({'; '.join(sides)}). Possible causes: labels that miss thin edges, rounded or"
                " coarse labels, and loss of thin parts of the sheet. Check the labels of both"
                " edges; see Validation, Thickness and loss of tissue."
            )
    return lines


def _classification(results: GroupResults) -> Iterator[str]:
    """List the pairs in which a measure adds to the base model."""
    for row in records(results.table("classification")):
        if row["p"] < _ALPHA:
            side, added = cells.summary_side(row["hemi"], row["added"]), row["added"]
            yield (
                f"{row['control']} against {row['case']}, {side}: {cells.display_name(added)}"
                f" adds to {row['base']} (p {p_text(row['p'])}, not corrected);"
                f" cross-validated area {row['auc_base_cv']:.2f} to {row['auc_full_cv']:.2f}"
            )


def peaks(results: GroupResults) -> Mapping[str, Any] | None:
    """List clusters with their peaks, and the strongest point of maps without."""
    table = results.everywhere("peaks")
    if not len(table):
        return None
    maps = ["measure", "contrast", "hemi"]
    file_of = results.table("maps").set_index(maps)["file"]
    rows = records(table.assign(number=table.groupby(maps).cumcount() + 1).head(MOST_ROWS))
    for row in rows:
        points = results.table(file_of[row["measure"], row["contrast"], row["hemi"]])
        point = None if row["measure"] == JOINT else point_of(row, points)
        row["estimate"] = np.nan if point is None else point["estimate"]
    return {"rows": rows, "more": len(table) - len(rows)}


def participants(results: GroupResults) -> Mapping[str, Any]:
    """Describe who is in the model, by group, and list who is not, with reasons."""
    people, table = results.table("covariates"), results.table("demographics")
    excluded = results.table("excluded")
    reasons = excluded["reason"].value_counts().items() if len(excluded) else ()
    variables = table.groupby("variable", sort=False) if len(table) else ()
    return {
        "n": people[cells.IDS[0]].nunique() if len(people) else 0,
        "visits": len(people),
        "hemispheres": results.record.get("hemispheres") or {},
        "levels": list(table["group"].unique()) if len(table) else [],
        "rows": [
            (name, [_described(part) for _, part in rows.groupby("group", sort=False)], p)
            for name, rows in variables
            for p in [rows["p"].iloc[0]]
        ],
        "tests": ", ".join(demographic_tests(table)),
        "ratings": results.record.get("ratings") or {},
        "reasons": list(reasons),
        "excluded": records(excluded.fillna("").head(MOST_ROWS)),
        "more": max(0, len(excluded) - MOST_ROWS),
    }


def demographic_tests(table: pd.DataFrame) -> list[str]:
    """List the tests of ``demographics.tsv`` in words, each with its variables."""
    tested = table[table["p"].notna()].drop_duplicates("variable") if len(table) else table
    tests = tested.groupby("test", sort=False)["variable"] if len(tested) else ()
    return [f"{_TESTS[str(test)]} ({', '.join(variables)})" for test, variables in tests]


def _described(rows: pd.DataFrame) -> list[str]:
    """List the lines about a variable of a group: mean and SD, or counts; missing values."""
    first, lines = records(rows)[0], [str(rows["n"].iloc[0])]
    if rows["level"].notna().all():
        columns = rows["level"], rows["count"], rows["percent"]
        lines = [
            f"{level} {n:.0f} ({share:.0f}%)" for level, n, share in zip(*columns, strict=True)
        ]
    elif np.isfinite(first["missing"]):
        lines = [f"{cells.number_text(first['mean'])} ({cells.number_text(first['sd'])})"]
    return [*lines, *[f"{first['missing']:.0f} missing"] * bool(first["missing"] > 0)]


def summaries(results: GroupResults) -> Mapping[str, Any] | None:
    """List tests of summary measures with the means of the groups."""
    table = results.table("measures")
    if not len(table):
        return None
    table = estimated(table).sort_values(["p_fdr", "p"], kind="stable")
    if not len(table):
        return None
    low = table["p_fdr"] < _ALPHA
    means = results.table("descriptives")
    return {
        "groups": list(means["group"].unique()) if len(means) else [],
        "means": {(row["measure"], row["hemi"], row["group"]): row for row in records(means)},
        "rows": records(table[low]),
        "more": records(table[~low]),
        "alpha": _ALPHA,
        "regions": bool(table["measure"].str.contains(REGION).any()),
        "families": table["contrast"].nunique(),
        "letters": letters_of(results.table("measures")),
        "slopes": _slopes(results, table),
        "repeated": bool((table["visits"] > table["n"]).any()),
    }
