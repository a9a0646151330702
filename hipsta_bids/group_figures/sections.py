"""Average cross-sections of the groups: interior wall, middle and exterior wall."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from hipsta_bids.group.analysis import Analysis
from hipsta_bids.group.fitted import FittedMaps
from hipsta_bids.group.shapes import AverageShape
from hipsta_bids.group_data import Cohort, Float
from hipsta_bids.group_figures.panels import (
    LABEL,
    SMALL,
    TITLE,
    panels,
    repeat_colors,
    side_name,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Where along the long axis, as a fraction from posterior to anterior.
_PLACES = (0.1, 0.5, 0.9)
_WIDTHS = (1.2, 0.7, 1.2)  # of the lines of interior, middle and exterior, points
_STYLES = ("-", ":", "-")


def draw_sections(
    cohort: Cohort, analysis: Analysis, shapes: Mapping[str, AverageShape]
) -> "Figure":
    """Draw the groups' mean walls at three places along the long axis, superior up."""
    figure, axes = panels(len(shapes), len(_PLACES), (3.2, 2.8))
    for i, (hemi, shape) in enumerate(shapes.items()):
        for j, place in enumerate(_PLACES):
            axis, node = axes[i, j], round(place * (len(cohort.y) - 1))
            plane = _plane(shape.mean[1], node, left=hemi == "L")
            center = np.nanmean(shape.mean[:, :, node], axis=(0, 1))
            for color, (group, layers) in zip(
                repeat_colors(), shape.by_group.items(), strict=False
            ):
                flat = (layers[:, :, node] - center) @ plane.T
                for line, width, style in zip(flat, _WIDTHS, _STYLES, strict=True):
                    axis.plot(*line.T, color=color, linewidth=width, linestyle=style)
                # One line more for the legend alone.
                label = f"{group} (n = {shape.counts[group]})"
                axis.plot([], [], color=color, label=label)
            if hemi in analysis.fitted:
                middle = (shape.mean[:, :, node] - center) @ plane.T
                _mark_subfields(axis, middle, analysis.fitted[hemi], node)
            axis.set_title(
                f"{side_name(hemi)}, y = {cohort.y[node]:.2g} ({_where(place)})", fontsize=TITLE
            )
            axis.set_xlabel("to lateral [mm]", fontsize=LABEL)
            axis.set_ylabel("to superior [mm]", fontsize=LABEL)
            axis.set_aspect("equal", adjustable="datalim")
            axis.tick_params(labelsize=LABEL)
    axes[0, 0].legend(fontsize=SMALL, title="walls, and dotted the middle", title_fontsize=SMALL)
    return figure


def _where(place: float) -> str:
    return {0.5: "middle"}.get(place, "posterior" if place < 0.5 else "anterior")  # noqa: PLR2004 -- the middle


def _plane(middle: Float, node: int, *, left: bool) -> Float:
    """Two directions across the long axis: to lateral, and to superior.

    Parameters
    ----------
    middle : ndarray, shape (x, y, 3)
        Mean middle surface, RAS mm.
    node : int
        Along y.
    left : bool
        Whether lateral is to the left.

    Returns
    -------
    ndarray, shape (2, 3)
        Orthonormal rows.
    """
    centers = np.nanmean(middle, axis=0)
    along = centers[min(node + 2, len(centers) - 1)] - centers[max(node - 2, 0)]
    along = along / np.linalg.norm(along)
    lateral = np.array([-1.0 if left else 1.0, 0.0, 0.0])
    lateral -= along * (along @ lateral)
    lateral /= np.linalg.norm(lateral)
    superior = np.cross(along, lateral)
    return np.stack([lateral, superior if superior[2] > 0 else -superior])


def _mark_subfields(axis: "Axes", layers: Float, one: FittedMaps, node: int) -> None:
    """Draw borders of subfields across the mean wall, and name them inside it."""
    fields = one.subfield[:, node]
    inner, middle, outer = layers
    for i in np.flatnonzero(fields[1:] != fields[:-1]):
        ends = [(layer[i] + layer[i + 1]) / 2 for layer in (inner, outer)]
        axis.plot(*np.transpose(ends), color="0.3", linewidth=0.6)
    for number, name in enumerate(one.maps.names):
        nodes = np.flatnonzero(fields == number)
        if len(nodes):
            place = nodes[len(nodes) // 2]
            box = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 0.3}
            x, y = middle[place]
            axis.text(x, y, name, fontsize=SMALL, ha="center", va="center", bbox=box)
