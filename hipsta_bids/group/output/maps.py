"""Rows of the figures of maps: means, effects and significance, read from the files of an analysis.

No model is fitted for a figure: what a figure shows is in the tables of its folder.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import chain
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from hipsta_bids.derivatives.analyses import GroupResults, records
from hipsta_bids.group.output import panels, style
from hipsta_bids.group.output.ground import read_grounds
from hipsta_bids.group.output.panels import Row
from hipsta_bids.reports import cells, display, group_maps
from hipsta_bids.reports.group_tables import map_unit
from hipsta_bids.stats.arrays import Bool, Float
from hipsta_bids.types import BOTH_SIDES, DIFFERENCE, SIDES, parts_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LEVEL = 0.05
_LEAST_Z = 4.0  # at the end of the colors of joint evidence


@dataclass(frozen=True, eq=False, kw_only=True)
class ContrastMap:
    """The test of a contrast at each point (points,) of one side."""

    kind: str
    """``t``, ``F``, or ``z`` of several measures together."""
    effect: Float
    statistic: Float
    df: Float
    adjusted: Float
    rejected: Bool
    alpha: float


#: Ends of columns of tests, and what they are of.
_STATES = {"": "Registered", "_unregistered": "Not registered"}

Tests = Mapping[str, Mapping[str, Mapping[str, ContrastMap]]]
"""By side, measure and contrast."""


def draw_measure(
    results: GroupResults, measure: str, views: panels.Views, dpi: float = style.DOTS_PER_INCH
) -> "list[Figure]":
    """Draw all maps of a measure: one figure, or several where they do not fit a page."""
    blocks = [[row] for row in mean_rows(results, measure)]
    blocks += contrast_rows(results, measure)
    return panels.draw_pages(read_grounds(results, measure), blocks, views=views, dpi=dpi)


def draw_alignment(results: GroupResults, measure: str) -> "list[Figure]":
    """Draw statistics of a measure with and without registration, unfolded, by contrast."""
    grounds = read_grounds(results, measure)
    flat = {hemi: replace(ground, surface=None) for hemi, ground in grounds.items()}
    return panels.draw_pages(flat, list(alignment_rows(results, measure)))


def alignment_rows(results: GroupResults, measure: str) -> Iterator[list[Row]]:
    """Show the statistic of each contrast with and without registration, on one scale."""
    maps = results.table("maps")
    for index, (name, rows) in enumerate(
        maps[maps["measure"] == measure].groupby("contrast", sort=False)
    ):
        points = {str(row["hemi"]): results.table(str(row["file"])) for row in records(rows)}
        kind = group_maps.kind_of_test(measure, next(iter(points.values())))
        low, colors, _ = display.effect_colors(kind)
        statistics = {
            end: {
                hemi: table[f"statistic{end}"].to_numpy(np.float64)
                for hemi, table in points.items()
            }
            for end in _STATES
        }
        values = display.known(
            [values for sides in statistics.values() for values in sides.values()]
        )
        reach = float(np.abs(values).max(initial=1.0))
        block = []
        for end, state in _STATES.items():
            survive = {
                hemi: (table[f"significant{end}"] == True).to_numpy(bool)  # noqa: E712  (may be missing)
                for hemi, table in points.items()
            }
            block.append(
                Row(
                    kind="statistic",
                    index=index,
                    title=f"{state}: {name}",
                    label=f"{kind} statistic",
                    scale={"cmap": colors, "vmin": low * reach, "vmax": reach},
                    values=statistics[end],
                    survive=survive,
                )
            )
        yield block


def contrast_rows(results: GroupResults, measure: str) -> Iterator[list[Row]]:
    """Show effect sizes and corrected p-values of each contrast of a map that was tested."""
    return contrasts(read_tests(results), measure)


def read_tests(results: GroupResults) -> Tests:
    """Read the tests of all maps."""
    settings = results.record.get("settings") or {}
    alpha = float((settings.get("multiplicity") or {}).get("alpha", _LEVEL))
    tests: dict[str, dict[str, dict[str, ContrastMap]]] = {}
    for row in records(results.table("maps")):
        points, measure = results.table(str(row["file"])), str(row["measure"])
        kind = group_maps.kind_of_test(measure, points)
        names = {"statistic": "statistic", "effect": group_maps.EFFECT_COLUMNS[kind]}
        names |= {"df": "df", "adjusted": "p_corrected"}
        values = {
            field: points[name].to_numpy(np.float64) if name in points else np.full(1, np.nan)
            for field, name in names.items()
        }
        rejected = (points["significant"] == True).to_numpy(bool)  # noqa: E712  (may be missing)
        tests.setdefault(str(row["hemi"]), {}).setdefault(measure, {})[str(row["contrast"])] = (
            ContrastMap(kind=kind, rejected=rejected, alpha=alpha, **values)
        )
    return tests


def mean_rows(results: GroupResults, measure: str) -> Iterator[Row]:
    """Show the mean map of each group, on one scale that the maps span."""
    means = results.everywhere("means")
    means = means[means["measure"] == measure] if len(means) else means
    if not len(means):
        return
    change, unit = results.is_change, map_unit(results, measure)
    is_difference = means["hemi"] == DIFFERENCE
    for part, difference in ((means[~is_difference], False), (means[is_difference], True)):
        scale = _mean_scale(measure, part, change=change or difference)
        title = "mean change" if change else "mean"
        for index, (group, rows) in enumerate(part.groupby("group", sort=False)):
            by_side = {str(hemi): part for hemi, part in rows.groupby("hemi", sort=False)}
            counts = {hemi: int(part["n"].max()) for hemi, part in by_side.items()}
            number = ", ".join(f"{n} {SIDES[hemi]}" for hemi, n in counts.items())
            if len(set(counts.values())) == 1:
                number = f"n = {max(counts.values())}"
            yield Row(
                kind="mean",
                index=index,
                title=f"{title.capitalize()}, {group} ({number})",
                label=cells.with_brackets(f"{title},\n{cells.display_name(measure)}", unit),
                scale=scale,
                values={hemi: part["mean"].to_numpy(np.float64) for hemi, part in by_side.items()},
            )
    yield from _count_rows(results, measure)


def _mean_scale(measure: str, means: pd.DataFrame, *, change: bool) -> dict[str, Any]:
    """Return the colors of means, whose ends are percentiles of all that are shown."""
    kind = display.kind_of(measure, change=change)
    low, high = display.span_of(kind, [means["mean"].to_numpy(np.float64)])
    return {"cmap": kind.colors, "vmin": low, "vmax": high}


def _count_rows(results: GroupResults, measure: str) -> Iterator[Row]:
    """Show how many sheets have a value, where head and tail differ in it."""
    maps = results.table("maps")
    first = records(maps[maps["measure"] == measure].drop_duplicates("hemi"))
    points = {str(row["hemi"]): results.table(str(row["file"])) for row in first}
    if all(
        "y" in table and parts_of(np.unique(table["y"])) is not None for table in points.values()
    ):
        counts = {hemi: table["n"].to_numpy(np.float64) for hemi, table in points.items()}
        yield Row(
            kind="count",
            index=0,
            title="Sheets with a value at each point",
            label="n",
            scale={"cmap": "cividis", "vmin": 0, "vmax": max(n.max() for n in counts.values())},
            values={hemi: np.where(n > 0, n, np.nan) for hemi, n in counts.items()},
        )


def contrasts(
    every_test: Tests, measure: str, like: Mapping[str, str] = MappingProxyType({})
) -> Iterator[list[Row]]:
    """Show effect sizes and corrected p-values of each contrast of a measure.

    Tests of all measures share their colors; ``like`` names contrasts that
    have the colors of others.
    """
    tests = {hemi: maps[measure] for hemi, maps in every_test.items() if measure in maps}
    signed = {
        (hemi, name): group_maps.signed_logarithm(test.adjusted, test.statistic)
        for hemi, by_name in tests.items()
        for name, test in by_name.items()
    }
    top = display.significance_reach(list(signed.values()))
    names = dict.fromkeys(chain.from_iterable(tests.values()))
    for index, name in enumerate(names):
        sides = {hemi: by_name[name] for hemi, by_name in tests.items() if name in by_name}
        first = next(iter(sides.values()))
        reach = _reach(every_test, first.kind, like.get(name, name), sides)
        low, colors, p_colors = display.effect_colors(first.kind)
        survive = {hemi: test.rejected for hemi, test in sides.items()}
        word = "Joint evidence" if first.kind == "z" else "Effect"
        yield [
            Row(
                kind="effect",
                index=index,
                title=f"{word}, {name}",
                label=group_maps.EFFECT_NAMES[first.kind],
                scale={"cmap": colors, "vmin": low * reach, "vmax": reach},
                values={hemi: test.effect for hemi, test in sides.items()},
                survive=survive,
            ),
            Row(
                kind="significance",
                index=index,
                title=f"Significant: {_counts(sides)}",
                label="corrected p" + (", signed" if low else ""),
                scale={"cmap": p_colors, "vmin": low * top, "vmax": top},
                values={hemi: signed[hemi, name] for hemi in sides},
                survive=survive,
                level=first.alpha,
            ),
        ]


def _reach(every_test: Tests, kind: str, name: str, sides: Mapping[str, ContrastMap]) -> float:
    """Return the effect size at the end of the colors of a contrast."""
    if kind == "z":
        return max(_LEAST_Z, *(float(np.nanmax(test.effect)) for test in sides.values()))
    tests = [
        by_name[name]
        for side in every_test.values()
        for by_name in side.values()
        if name in by_name
    ]
    return display.effect_reach(
        [display.Effects(t.kind, t.effect, t.statistic, t.df) for t in tests if t.kind == kind]
    )


def _counts(sides: Mapping[str, ContrastMap]) -> str:
    """Write how many points survive, by side."""
    tested = {hemi: int(np.isfinite(test.adjusted).sum()) for hemi, test in sides.items()}
    uniform = len(set(tested.values())) == 1
    counts = ", ".join(
        " ".join(
            (
                str(int(test.rejected.sum())),
                *(() if uniform else (f"of {tested[hemi]}",)),
                *(() if hemi == BOTH_SIDES else (SIDES[hemi],)),
            )
        )
        for hemi, test in sides.items()
    )
    return counts + (f" of {max(tested.values())} points" if uniform else "")
