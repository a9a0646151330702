"""Curves along x by group: profiles before and after registration, and warps."""

from typing import TYPE_CHECKING

import numpy as np

from hipsta_bids.group.analysis import Analysis
from hipsta_bids.group.members import mean_of_known, members_of, spread_of_known
from hipsta_bids.group_data import Cohort, Float
from hipsta_bids.group_figures.panels import (
    LABEL,
    TITLE,
    mark_medial,
    panels,
    repeat_colors,
    side_name,
    spelled,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw_profiles(cohort: Cohort, analysis: Analysis) -> "Figure":
    """Draw means over y by group, before and after registration."""
    measures = list(next(iter(cohort.sides.values())).maps)
    figure, axes = panels(len(analysis.sides), 2 * len(measures), (3.0, 2.4))
    for i, (hemi, side) in enumerate(analysis.sides.items()):
        sources = {"before": cohort.sides[hemi], "after": side.registered}
        for j, measure in enumerate(measures):
            pair = axes[i, 2 * j : 2 * j + 2]
            for axis, (when, source) in zip(pair, sources.items(), strict=True):
                values = mean_of_known(source.maps[measure], 2)
                members = members_of(analysis, cohort.table.iloc[source.rows])
                for color, (group, own) in zip(repeat_colors(), members.items(), strict=False):
                    _band(axis, cohort.x, values[own], group, color)
                axis.set_title(
                    f"{spelled(measure)}, {side_name(hemi)},\n{when} registration", fontsize=TITLE
                )
                _finish(axis, cohort, f"{spelled(measure)} [{cohort.units.get(measure, '1')}]")
            pair[1].sharey(pair[0])
    axes[0, 0].legend(fontsize=LABEL, title="mean, 2 SE", title_fontsize=LABEL)
    return figure


def draw_warps(cohort: Cohort, analysis: Analysis) -> "Figure":
    """Draw displacements by group."""
    figure, axes = panels(len(analysis.sides), 2, (3.6, 2.6))
    for i, (hemi, side) in enumerate(analysis.sides.items()):
        nodes = side.registration.warps.shape[1]
        moved = (side.registration.warps - np.linspace(0, 1, nodes)) * (nodes - 1)
        members = members_of(analysis, cohort.table.iloc[side.registered.rows])
        for color, (group, own) in zip(repeat_colors(), members.items(), strict=False):
            axes[i, 0].plot(cohort.x, moved[own].T, color=color, alpha=0.4, linewidth=0.6)
            _band(axes[i, 1], cohort.x, moved[own], group, color)
        for axis, what in zip(axes[i], ("each participant", "means, 2 SE"), strict=True):
            axis.axhline(0, color="black", linewidth=0.5)
            axis.set_title(f"warps, {side_name(hemi)}, {what}", fontsize=TITLE)
            _finish(axis, cohort, "shift to lateral [nodes]")
    axes[0, 1].legend(fontsize=LABEL)
    return figure


def _finish(axis: "Axes", cohort: Cohort, label: str) -> None:
    axis.set_ylabel(label, fontsize=LABEL)
    mark_medial(axis, cohort)
    axis.tick_params(labelsize=LABEL)


def _band(axis: "Axes", x: Float, values: Float, name: str, color: str) -> None:
    """Draw a mean and twice its standard error to both sides."""
    count = np.isfinite(values).sum(axis=0)
    mean = mean_of_known(values, 0)
    error = spread_of_known(values) / np.sqrt(np.maximum(count, 1))
    axis.plot(x, mean, color=color, label=f"{name} (n = {len(values)})", linewidth=1.2)
    axis.fill_between(x, mean - 2 * error, mean + 2 * error, color=color, alpha=0.25, linewidth=0)
