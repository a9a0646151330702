"""Finished analyses side by side: one table of effects, one figure, and agreement of maps."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, count
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from hipsta_bids import __version__
from hipsta_bids.derivatives.analyses import GroupResults, records
from hipsta_bids.geometry.agreement import agreement
from hipsta_bids.group.output.citations import Citations, code, escaped, joined
from hipsta_bids.group.output.ground import Ground, read_grounds
from hipsta_bids.group.output.maps import ContrastMap, read_tests
from hipsta_bids.group.output.panels import Row
from hipsta_bids.reports import cells, display
from hipsta_bids.reports.group_maps import EFFECT_NAMES
from hipsta_bids.stats.inference import MapKey
from hipsta_bids.types import PARTICIPANT, SIDES

_FAILED = "failed"
#: Columns that locate a point: nodes of the sheet, or vertices of a surface.
_PLACES = ("x", "y", "surface_x", "surface_y", "surface_z")
_CONFIDENCE = 0.95  # of analyses that do not record it
_NEAR = 1e-3  # of places that are the same, as files round them

Tested = tuple[ContrastMap, pd.DataFrame]
"""The test of a contrast at each point, and the places of the points."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Entry:
    """A finished analysis, under the name that it has in the comparison."""

    name: str
    results: GroupResults
    measure: str | None = None
    """The only map to compare; all without."""
    alias: str | None = None
    """Common name of the maps, where each analysis has one."""

    @cached_property
    def maps(self) -> dict[MapKey, Tested]:
        """Read tests and places of the points of each map."""
        tests, maps = read_tests(self.results), {}
        for row in records(self.results.table("maps")):
            measure, contrast, hemi = (str(row[name]) for name in ("measure", "contrast", "hemi"))
            if self.measure in {None, measure}:
                points = self.results.table(str(row["file"]))
                key = MapKey(self.alias or measure, contrast, hemi)
                maps[key] = tests[hemi][measure][contrast], points.filter(_PLACES)
        return maps

    @property
    def measures(self) -> set[str]:
        """Return the names of the maps."""
        return {key.measure for key in self.maps}

    @property
    def people(self) -> set[str]:
        """Return the labels of the participants in the model."""
        return set(self.results.table("covariates")[PARTICIPANT])

    @property
    def inputs(self) -> Mapping[str, Any]:
        """Return the record of the sheets that were analyzed."""
        return self.results.record.get("inputs") or {}

    @property
    def settings(self) -> Mapping[str, Any]:
        """Return the settings of the analysis."""
        return self.results.record.get("settings") or {}

    @property
    def correction(self) -> str:
        """Return the method that corrects for many points, and its family."""
        rules = self.settings.get("multiplicity") or {}
        return f"{rules.get('method')}, one family per {rules.get('scope')}"


def analyses_table(entries: Sequence[Entry]) -> pd.DataFrame:
    """Count participants, groups, hemispheres and failures of each analysis."""
    rows = []
    for entry in entries:
        record, people = entry.results.record, entry.results.table("covariates")
        groups, excluded = record.get("groups") or {}, entry.results.table("excluded")
        failed = excluded["reason"].astype(str).str.startswith(_FAILED)
        sizes = list[str]()
        if groups:
            member = people.drop_duplicates(PARTICIPANT)[groups["column"]].astype(str)
            sizes = [f"{(member == level).sum()} {level}" for level in entry.results.levels]
        rows.append(
            {
                "analysis": entry.name,
                "seg": entry.inputs.get("seg"),
                "formula": record.get("formula"),
                "n": record.get("participants"),
                "groups": ", ".join(sizes),
                **{f"n_{hemi}": (record.get("hemispheres") or {}).get(hemi, 0) for hemi in "LR"},
                "n_failed": int(failed.sum()),
                "n_excluded": int((~failed).sum()),
                "correction": entry.correction,
            }
        )
    return pd.DataFrame(rows)


def joined_tables(entries: Sequence[Entry], name: str, keys: Sequence[str]) -> pd.DataFrame:
    """Put tables of all analyses under each other, so that equal effects are neighbors."""
    tables = [
        entry.results.table(name).assign(analysis=entry.name)
        for entry in entries
        if not entry.measure and len(entry.results.table(name))
    ]
    if not tables:
        return pd.DataFrame()
    table = pd.concat(tables, ignore_index=True).sort_values([*keys], kind="stable")
    return table[["analysis", *table.columns.drop("analysis")]]


def effects_table(entries: Sequence[Entry]) -> pd.DataFrame:
    """Return the effects on summary measures of all analyses, with limits of the estimates."""
    table = joined_tables(entries, "measures", ("contrast", "measure", "hemi", "model"))
    if len(table):
        rules = {entry.name: entry.settings.get("glm") or {} for entry in entries}
        level = table["analysis"].map(lambda name: rules[name].get("confidence", _CONFIDENCE))
        reach = stats.t.ppf((1 + level) / 2, table["df"]) * table["se"]
        at = list(table).index("se") + 1
        table.insert(at, "estimate_high", table["estimate"] + reach)
        table.insert(at, "estimate_low", table["estimate"] - reach)
    return table


def agreement_table(entries: Sequence[Entry]) -> pd.DataFrame:
    """Compare the effect maps of each two analyses: correlation, and overlap of significance."""
    return pd.DataFrame(
        {
            "measure": key.measure,
            "contrast": key.contrast,
            "hemi": key.hemi,
            "analysis": first.name,
            "other": second.name,
            "n_shared": len(first.people & second.people),
            **_agree(first.maps[key], second.maps[key]),
        }
        for first, second in combinations(entries, 2)
        for key in first.maps
        if key in second.maps
    )


def _agree(first: Tested, second: Tested) -> dict[str, float]:
    """Compare two maps at the points that have an effect in both; NaN if points differ."""
    names = ("n_points", "r", "n_significant", "n_significant_other", "n_both", "dice")
    if not _comparable(first, second):
        return dict.fromkeys(names, np.nan)
    a, b = first[0], second[0]
    finite = np.isfinite(a.effect) & np.isfinite(b.effect)
    x, y = a.effect[finite], b.effect[finite]
    survive, survive_second = a.rejected[finite], b.rejected[finite]
    n_both = int((survive & survive_second & (np.sign(x) == np.sign(y))).sum())
    counts = int(survive.sum()), int(survive_second.sum())
    dice = 2 * n_both / sum(counts) if sum(counts) else np.nan
    values = len(x), agreement(x, y).correlation, *counts, n_both, dice
    return dict(zip(names, values, strict=True))


def _comparable(first: Tested, second: Tested) -> bool:
    """Check whether two maps have tests of one kind, at points that correspond."""
    (a, places), (b, places_of_second) = first, second
    names = list(places), places.shape
    return (a.kind, *names) == (b.kind, list(places_of_second), places_of_second.shape) and (
        np.allclose(places, places_of_second, atol=_NEAR, equal_nan=True)
    )


def effect_rows(
    entries: Sequence[Entry], measure: str
) -> tuple[dict[str, Ground], list[list[Row]]]:
    """Show the effect maps of a measure in one scale: a row per analysis, a block per contrast."""
    drawn = [entry for entry in entries if measure in entry.measures]
    grounds = [read_grounds(entry.results, entry.measure or measure) for entry in drawn]
    flat = [_changed(sides, surface=None) for sides in grounds]
    names = [list(dict.fromkeys(n for one in sides.values() for n in one.names)) for sides in flat]
    uniform = names.count(names[0]) == len(names)
    # One line of names below all rows would be wrong.
    ends = ["" if uniform else f"; {', '.join(of_analysis)}" for of_analysis in names]
    lines, number = list(zip(drawn, flat, ends, strict=True)), count()
    contrasts = dict.fromkeys(key.contrast for key in drawn[0].maps if key.measure == measure)
    blocks = [_contrast_rows(lines, measure, contrast, number) for contrast in contrasts]
    return flat[0] if uniform else _changed(flat[0], names=()), blocks


def _changed(grounds: Mapping[str, Ground], **values: Any) -> dict[str, Ground]:  # noqa: ANN401  (of any field)
    return {hemi: replace(ground, **values) for hemi, ground in grounds.items()}


def _contrast_rows(
    lines: Sequence[tuple[Entry, Mapping[str, Ground], str]],
    measure: str,
    contrast: str,
    number: Iterator[int],
) -> list[Row]:
    """Show the maps of a contrast in one scale; analyses have grounds, and ends of titles."""
    first = lines[0][0].maps
    keys = [key for key in first if (key.measure, key.contrast) == (measure, contrast)]
    tests = [
        {k.hemi: e.maps[k][0] for k in keys if k in e.maps and _comparable(first[k], e.maps[k])}
        for e, *_ in lines
    ]
    every_test = [test for by_side in tests for test in by_side.values()]
    kind = every_test[0].kind
    reach = display.effect_reach(
        [display.Effects(t.kind, t.effect, t.statistic, t.df) for t in every_test]
    )
    low, colors, _ = display.effect_colors(kind)
    return [
        Row(
            kind="effect",
            index=next(number),
            title=f"{contrast}: {entry.name} (n = {entry.results.record['participants']}){end}",
            label=EFFECT_NAMES[kind],
            scale={"cmap": colors, "vmin": low * reach, "vmax": reach},
            values={hemi: test.effect for hemi, test in by_side.items()},
            survive={hemi: test.rejected for hemi, test in by_side.items()},
            grounds=sides,
        )
        for (entry, sides, end), by_side in zip(lines, tests, strict=True)
        if by_side
    ]


def differences(entries: Sequence[Entry]) -> Iterator[str]:
    """List facts other than data in which the analyses differ, one line each."""
    facts: dict[str, list[Any]] = {
        "model": [entry.results.record.get("formula") for entry in entries],
        "correction": [entry.correction for entry in entries],
        "region": [entry.inputs.get("region") for entry in entries],
        "hash of the sheet settings": [entry.inputs.get("settings_hash") for entry in entries],
        "version": [entry.results.record.get("version") for entry in entries],
    }
    for title, values in facts.items():
        if len(set(values)) > 1:
            pairs = zip(entries, values, strict=True)
            yield f"the {title} differs: " + "; ".join(f"{e.name} {value}" for e, value in pairs)
    yield from dict.fromkeys(
        f"{key.measure}, {first.name} and {second.name}: points or tests do not correspond"
        for first, second in combinations(entries, 2)
        for key in first.maps
        if key in second.maps and not _comparable(first.maps[key], second.maps[key])
    )


def agreement_methods(
    entries: Sequence[Entry], table: pd.DataFrame, notes: Sequence[str], region: str
) -> str:
    """Return the methods and the agreement of maps, as a paper prints it."""
    cite = Citations()
    names = [f"{escaped(e.name)} ({e.results.record.get('participants')})" for e in entries]
    formulas = dict.fromkeys(str(entry.results.record.get("formula")) for entry in entries)
    text = (
        f"Measures of the hippocampal body {cite('method')} were compared between"
        f" {len(entries)} analyses. Analyses (participants) were {joined(names)}."
        f" hipsta_bids {__version__} read their results; no model was fitted again. The model was"
        f" {joined([code(formula) for formula in formulas])}. Each analysis was registered and"
        " corrected for multiple tests by itself. Error rates hold within an analysis, not over"
        " all analyses."
    )
    rule = (
        "Agreement of two maps of effect sizes is Pearson's correlation (r) over the points with"
        " a value in both. No p-value is given, because neighboring points are not independent."
        " The Dice coefficient is the overlap of significant points with effects in one"
        " direction."
    )
    points = [
        f"- {escaped(row['measure'])}, {escaped(row['contrast'])}, {SIDES[row['hemi']]},"
        f" {escaped(row['analysis'])} and {escaped(row['other'])}: r"
        f" {cells.number_text(row['r'], 2)}, Dice {cells.number_text(row['dice'], 2)}"
        for row in records(table)
    ]
    lines = [f"- {escaped(note)}" for note in notes]
    lists = [("Agreement of effect maps:", points), ("Notes:", lines)]
    paragraphs = ["\n".join([title, "", *items]) for title, items in lists if items]
    return cite.page([text, rule, *paragraphs], region)
