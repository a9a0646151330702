"""Figures of norms: charts of centiles, and maps of norms and of deviations."""

import re
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from hipsta_bids.extensions.norms.wscores import ScoredMaps
from hipsta_bids.group.output import panels, style
from hipsta_bids.group.output.color_bar import spanned
from hipsta_bids.io.files import MISSING
from hipsta_bids.reports import display
from hipsta_bids.reports.cells import display_name, with_brackets
from hipsta_bids.reports.display import HEMISPHERE_COLORS, kind_of
from hipsta_bids.stats.arrays import Float, mean_of_known
from hipsta_bids.types import SIDES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: The 5th centile of the normal distribution.
_LOW = -1.645


def draw_norms(lines: pd.DataFrame, dots: pd.DataFrame) -> "list[Figure]":
    """Draw centiles over age, a row for each sex, a column for each side, and participants.

    Controls that a site was adapted to are open circles.
    """
    sexes, sides = lines["sex"].unique(), lines["hemi"].unique()
    width = style.TWO_COLUMNS if len(sides) > 1 else style.ONE_COLUMN
    figure, axes = style.new_panels(len(sexes), len(sides), (width, 60.0 * len(sexes)))
    measure, unit = lines[["measure", "unit"]].iloc[0]
    names = [name for name in lines.columns if re.fullmatch(r"p\d+", name)]
    limits = np.concatenate([lines[names].to_numpy().ravel(), dots["value"]])
    low, high = np.nanmin(limits), np.nanmax(limits)
    margin = 0.03 * (high - low)
    for row, sex in zip(axes, sexes, strict=True):
        for axis, hemi in zip(row, sides, strict=True):
            lines_here = lines[(lines["hemi"] == hemi) & (lines["sex"] == sex)]
            age, color = lines_here["age"], HEMISPHERE_COLORS[hemi]
            for first, last in ((0, -1), (1, -2)):
                edges = lines_here[names[first]], lines_here[names[last]]
                axis.fill_between(age, *edges, color=color, alpha=0.15, linewidth=0)
            for name in names:
                middle = name == names[len(names) // 2]
                axis.plot(age, lines_here[name], color=color, linewidth=1.4 if middle else 0.6)
                end = (1.01, lines_here[name].iloc[-1])
                axis.annotate(name[1:], end, xycoords=("axes fraction", "data"), va="center")
            dots_here = dots[(dots["hemi"] == hemi) & (dots["sex"] == sex)]
            for control, face in ((False, "black"), (True, "none")):
                dots_of_control = dots_here[dots_here["adapted"] == control]
                axis.plot(
                    dots_of_control["age"],
                    dots_of_control["value"],
                    "o",
                    color="black",
                    mfc=face,
                    ms=2.5,
                    mew=0.5,
                )
            axis.set_title(SIDES[hemi] if sex == MISSING else f"{SIDES[hemi]}, {sex}")
            axis.set_xlabel("age [years]")
            axis.set_xlim(age.min(), age.max())
            axis.set_ylim(low - margin, high + margin)
        row[0].set_ylabel(with_brackets(display_name(measure), unit))
    style.letter_panels(axes.flat)
    return [figure]


def norm_rows(
    centers: Mapping[str, tuple[Float, Float]], age: float, measure: str, unit: str
) -> Iterator[panels.Row]:
    """Show mean and SD of norms by side, at an age."""
    kind = kind_of(measure)
    for i, (quantity, colors) in enumerate({"mean": kind.colors, "SD": "magma"}.items()):
        values = {hemi: pair[i].ravel() for hemi, pair in centers.items()}
        scale = spanned(colors, values)
        if kind.centered and quantity == "mean":
            low, high = display.span_of(kind, list(values.values()))
            scale = {"cmap": colors, "vmin": low, "vmax": high}
        title = f"{quantity[0].upper()}{quantity[1:]} at {age:g} years"
        label = with_brackets(f"{quantity},\n{display_name(measure)}", unit)
        yield panels.Row(
            kind="expected", index=i, title=title, label=label, scale=scale, values=values
        )


def deviation_rows(scored: Mapping[str, ScoredMaps], measure: str) -> Iterator[panels.Row]:
    """Show mean deviations, and shares of low ones, of participants whom no site was adapted to."""
    z = {
        hemi: side.scores[measure].w[~side.reference]
        for hemi, side in scored.items()
        if measure in side.scores
    }
    means = {hemi: mean_of_known(own, 0) for hemi, own in z.items()}
    low = {
        hemi: 100 * mean_of_known(np.where(np.isfinite(own), own < _LOW, np.nan), 0)
        for hemi, own in z.items()
    }
    reach = max(1.0, *(np.nanmax(np.abs(one), initial=0.0) for one in means.values()))
    highest = max(20.0, *(np.nanmax(one, initial=0.0) for one in low.values()))
    for kind, title, label, colors, ends, values in (
        ("effect", "Mean deviation", "mean z", "RdBu_r", (-reach, reach), means),
        ("error", "Below the 5th centile", "participants [%]", "magma", (0.0, highest), low),
    ):
        scale: dict[str, Any] = {"cmap": colors, "vmin": ends[0], "vmax": ends[1]}
        yield panels.Row(kind=kind, index=0, title=title, label=label, scale=scale, values=values)
