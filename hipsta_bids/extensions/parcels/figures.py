"""Tests of regions on the sheet: figures, and the section of the page of an analysis."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from hipsta_bids.derivatives.analyses import GroupResults
from hipsta_bids.group.output import maps, panels, style
from hipsta_bids.group.output.ground import Ground, read_grounds
from hipsta_bids.reports import cells
from hipsta_bids.reports.group_maps import embedded
from hipsta_bids.reports.page import Section
from hipsta_bids.types import REGION, SIDES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_COLUMNS = ("effect_size", "statistic", "df", "p_fdr")


def list_figures(results: GroupResults) -> Iterator[tuple[str, style.Drawing]]:
    """List a figure for each map whose means over regions were tested."""
    for measure in _tests(results)["map"].unique() if len(results.table("region_nodes")) else ():
        yield f"{measure}_regions", partial(draw_regions, results, measure)


def _tests(results: GroupResults) -> pd.DataFrame:
    """Read tests of means over regions of a hemisphere, with ``map`` and ``region``."""
    table = results.table("measures")
    parts = table["measure"].str.partition(REGION)
    table = table.assign(map=parts[0], region=parts[2])
    return table[(parts[1] == REGION) & table["hemi"].isin(["L", "R"])]


def draw_regions(results: GroupResults, measure: str) -> "list[Figure]":
    """Draw effects and corrected p-values of regions, with borders and names."""
    tests, read = _tests(results), read_grounds(results, measure)
    tests = tests[(tests["map"] == measure) & (tests["model"] == tests["model"].iloc[0])]
    nodes = dict(list(results.table("region_nodes").groupby("hemi")))
    alpha = float(results.record["settings"]["multiplicity"]["alpha"])
    found: dict[str, dict[str, dict[str, maps.ContrastMap]]] = {}
    titles: dict[str, list[str]] = {}
    for (contrast, hemi), rows in tests.groupby(["contrast", "hemi"], sort=False):
        points = nodes[hemi].merge(rows, on="region", how="left")
        effect, statistic, df, adjusted = points[list(_COLUMNS)].to_numpy(np.float64).T
        found.setdefault(hemi, {measure: {}})[measure][contrast] = maps.ContrastMap(
            kind=rows["test"].iloc[0],
            effect=effect,
            statistic=statistic,
            df=df,
            adjusted=adjusted,
            rejected=adjusted <= alpha,
            alpha=alpha,
        )
        count = f"{(rows['p_fdr'] <= alpha).sum()} of {len(rows)} {SIDES[hemi]}"
        titles.setdefault(contrast, []).append(count)
    blocks = [
        [effect, replace(p, title=f"Significant regions: {', '.join(titles[contrast])}")]
        for contrast, (effect, p) in zip(titles, maps.contrasts(found, measure), strict=True)
    ]
    grounds = {hemi: _ground(read[hemi], table) for hemi, table in nodes.items()}
    figures = panels.draw_pages(grounds, blocks, width=style.TWO_COLUMNS)
    for axes in (axes for figure in figures for axes in figure.axes if axes.get_gid()):
        hemi = axes.get_gid().rpartition("-")[2]
        _name_regions(axes, read[hemi], nodes[hemi])
    return figures


def _name_regions(axes: "Axes", ground: Ground, nodes: pd.DataFrame) -> None:
    """Write names at the middles of regions."""
    box = {"facecolor": "white", "alpha": 0.7, "edgecolor": "none", "pad": 0.5}
    for name, points in nodes.dropna(subset="region").groupby("region"):
        x, y = ground.x[points["node_x"] - 1].mean(), ground.y[points["node_y"] - 1].mean()
        text = str(name).replace("_", "\n")
        axes.text(x, y, text, fontsize=style.SMALL, ha="center", va="center", bbox=box)


def _ground(ground: Ground, nodes: pd.DataFrame) -> Ground:
    """Put regions in place of subfields; their names stand inside."""
    codes, names = pd.factorize(nodes["region"])
    regions = codes.reshape(len(ground.x), len(ground.y))
    return replace(ground, subfield=regions, names=("",) * len(names), surface=None)


def _regions(results: GroupResults) -> Mapping[str, Any] | None:
    """Show tests of regions on the sheet."""
    pictures = [
        picture
        for name, _ in list_figures(results)
        for picture in embedded(results, name, cells.measure_title(name.replace("_", ", ")))
    ]
    text = (
        "Means over regions of each sheet, before registration. The false discovery rate is held"
        " over regions, sides and the mean of both sides. Bold lines enclose significant regions."
        " `measures.tsv` has the tests."
    )
    about = {"title": "Regions", "text": text, "file": "regions.tsv", "columns": [], "rows": []}
    return {**about, "pictures": pictures} if pictures else None


SECTIONS: tuple[Section[GroupResults], ...] = (
    Section("regions", "Regions", "group/table.html", _regions, after="maps"),
)
