"""Tests of regions on the sheet: figures, and the section of the page of an analysis."""

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from hipsta_bids.derivatives.analyses import GroupResults
from hipsta_bids.group.output import maps, panels, style
from hipsta_bids.group.output.ground import read_grounds
from hipsta_bids.reports.cells import measure_title
from hipsta_bids.reports.group_maps import embedded
from hipsta_bids.reports.page import Section
from hipsta_bids.types import REGION, SIDES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FIELDS = {"effect": "effect_size", "statistic": "statistic", "df": "df", "adjusted": "p_fdr"}
_BOX = {"facecolor": "white", "alpha": 0.7, "edgecolor": "none", "pad": 0.5}


def list_figures(results: GroupResults) -> Iterator[tuple[str, style.Drawing]]:
    """List a figure for each map whose means over regions were tested."""
    nodes, tests = results.table("region_nodes"), results.table("measures")
    if len(nodes) and len(tests):
        parts = tests["measure"].str.partition(REGION)
        tests = tests.assign(map=parts[0], region=parts[2])[parts[1] == REGION]
        for name, rows in tests.groupby("map", sort=False):
            yield f"{name}_regions", partial(_draw, results, str(name), rows, nodes)


def _draw(
    results: GroupResults, name: str, tests: pd.DataFrame, nodes: pd.DataFrame
) -> "list[Figure]":
    """Draw effects and corrected p-values of regions, with borders and names."""
    alpha = float(results.record["settings"]["multiplicity"]["alpha"])
    grounds, titles = {}, defaultdict[str, list[str]](list)
    tested: dict[str, dict[str, dict[str, maps.ContrastMap]]] = {}
    tests = tests[tests["model"] == tests["model"].iloc[0]]
    regions = {hemi: rows["region"].to_numpy() for hemi, rows in nodes.groupby("hemi")}
    for hemi, ground in read_grounds(results, name).items():
        # What is made of both sides lies on the left, as its map does.
        codes, names = pd.factorize(regions[hemi[0]])
        shaped = codes.reshape(ground.subfield.shape)
        grounds[hemi] = replace(ground, subfield=shaped, names=tuple(names), surface=None)
        tested[hemi] = {name: {}}
        for contrast, rows in tests[tests["hemi"] == hemi].groupby("contrast", sort=False):
            points = rows.set_index("region").reindex(regions[hemi[0]])
            values = {key: points[column].to_numpy(float) for key, column in _FIELDS.items()}
            rejected, kind = values["adjusted"] <= alpha, str(rows["test"].iloc[0])
            test = maps.ContrastMap(kind=kind, rejected=rejected, alpha=alpha, **values)
            tested[hemi][name][str(contrast)] = test
            count = f"{(rows['p_fdr'] <= alpha).sum()} of {len(rows)} {SIDES[hemi]}"
            titles[str(contrast)].append(count)
    blocks = [
        [effect, replace(p, title=f"Significant regions: {', '.join(counts)}")]
        for counts, (effect, p) in zip(titles.values(), maps.contrasts(tested, name), strict=True)
    ]
    flat = {hemi: replace(g, names=("",) * len(g.names)) for hemi, g in grounds.items()}
    width = style.TWO_COLUMNS if len(flat) > 1 else style.ONE_COLUMN
    figures = panels.draw_pages(flat, blocks, widest=width)
    for axes in (axes for figure in figures for axes in figure.axes if axes.get_gid() is not None):
        ground = grounds[str(axes.get_gid()).rpartition("-")[2]]
        letters = axes.bbox.width / (style.LETTER_WIDTH * style.SMALL * style.POINT)
        for number, region in enumerate(ground.names):
            x, y = np.nonzero(ground.subfield == number)
            text = re.sub("_(?=[a-z]+$)", "\n", region)
            place = ground.x[x].mean(), ground.y[y].mean()
            turn = 90 if max(map(len, text.split())) > letters * np.ptp(ground.x[x]) else 0
            axes.text(
                *place, text, fontsize=style.SMALL, ha="center", va="center", bbox=_BOX,
                rotation=turn,
            )  # fmt: skip
    return figures


def _regions(results: GroupResults) -> Mapping[str, Any] | None:
    """Show tests of regions on the sheet."""
    pictures = [
        picture
        for name, _ in list_figures(results)
        for path in sorted((results.folder / "figures").glob(f"{name}*.svg"))
        for picture in embedded(results, path.stem, measure_title(name))
    ]
    text = (
        "Means over regions of each sheet, before registration. Bold lines enclose regions with a"
        " corrected p-value below the level. `measures.tsv` has the tests."
    )
    about = {"title": "Regions", "text": text, "file": "regions.tsv", "columns": [], "rows": []}
    return {**about, "pictures": pictures} if pictures else None


SECTIONS: tuple[Section[GroupResults], ...] = (
    Section("regions", "Regions", "group/table.html", _regions, after="maps"),
)
