"""Maps on the sheet: means of groups, effect sizes and significance."""

from typing import TYPE_CHECKING, Any

import numpy as np

from hipsta_bids.group.analysis import Analysis
from hipsta_bids.group.comparison import BOTH
from hipsta_bids.group.fitted import FittedMaps
from hipsta_bids.group.glm import PointTest
from hipsta_bids.group.members import mean_of_known, members_of, rows_of
from hipsta_bids.group.multiplicity import MapKey
from hipsta_bids.group_data import Cohort, Float
from hipsta_bids.group_figures.meshes import draw_mesh
from hipsta_bids.group_figures.panels import (
    LABEL,
    SMALL,
    TITLE,
    mark_medial,
    panels,
    shown,
    side_name,
    spelled,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PANEL = (2.6, 3.4)  # inches
_SHARED = (2.0, 98.0)  # percentiles that the colors of means span
_EFFECTS = 99.0  # percentile of sizes that the colors of effects span
_SMALLEST_P = 1e-10
_LEAST_REACH = 3.0  # powers of ten of p that colors span at least


def draw_means(cohort: Cohort, analysis: Analysis, measure: str) -> "Figure":
    """Draw the mean map of each group."""
    groups = analysis.groups.levels if analysis.groups else ("all",)
    sides = shown(analysis, measure)
    figure, axes = panels(len(sides), len(groups), _PANEL)
    means, counts = {}, {}
    for hemi, one in sides.items():
        for group, own in members_of(analysis, rows_of(analysis, one)).items():
            values = mean_of_known(one.values(measure)[own], 0)
            means[hemi, group] = values.reshape(one.maps.shape)
            counts[hemi, group] = int(own.sum())
    low, high = np.nanpercentile(np.concatenate([m.ravel() for m in means.values()]), _SHARED)
    colors = "viridis"
    if analysis.comparison.pair or set(sides) == {BOTH}:  # differences, to either side of zero
        high = max(abs(low), abs(high))
        low, colors = -high, "PRGn"
    images: list[Any] = []
    for i, (hemi, one) in enumerate(sides.items()):
        for j, group in enumerate(groups):
            axis = axes[i, j]
            images.append(_draw(axis, (cohort, one), means[hemi, group], colors, (low, high)))
            axis.set_title(
                f"{group}, {side_name(hemi)} (n = {counts[hemi, group]})", fontsize=TITLE
            )
    change = " change of" if analysis.comparison.pair else ""
    unit = cohort.units.get(measure, "1")
    _bar(figure, images[0], axes, f"mean{change} {spelled(measure)} [{unit}]")
    return figure


def draw_contrasts(cohort: Cohort, analysis: Analysis, measure: str) -> "Figure":
    """Draw effect sizes and corrected p-values, one row per contrast."""
    sides = shown(analysis, measure)
    tests = next(iter(sides.values())).fits[measure].tests
    figure, axes = panels(len(tests), 2 * len(sides), _PANEL)
    sizes = np.concatenate([_effect(t) for one in sides.values() for t in one.fits[measure].tests])
    reach = max(float(np.nanpercentile(np.abs(sizes), _EFFECTS)), 1e-6)
    signed = {
        (hemi, i): _signed_logarithm(analysis, MapKey(measure, test.contrast.name, hemi), test)
        for hemi, one in sides.items()
        for i, test in enumerate(one.fits[measure].tests)
    }
    top = max(_LEAST_REACH, *(float(np.nanmax(np.abs(v), initial=0)) for v in signed.values()))
    images: list[Any] = []
    for j, (hemi, one) in enumerate(sides.items()):
        for i, test in enumerate(one.fits[measure].tests):
            left, right = axes[i, 2 * j], axes[i, 2 * j + 1]
            effect = _effect(test).reshape(one.maps.shape)
            p = signed[hemi, i].reshape(one.maps.shape)
            images.append(_draw(left, (cohort, one), effect, "RdBu_r", (-reach, reach)))
            images.append(_draw(right, (cohort, one), p, "PuOr_r", (-top, top)))
            for axis, what in ((left, "effect size"), (right, "significance")):
                axis.set_title(f"{test.contrast.name}\n{side_name(hemi)}, {what}", fontsize=TITLE)
    kinds = {"t": "Cohen's d", "F": "partial eta squared"}
    label = ", ".join(kinds[kind] for kind in sorted({t.kind for t in tests}, reverse=True))
    _bar(figure, images[1], axes, "-log10 of corrected p,\nwith the sign of the effect")
    _bar(figure, images[0], axes, label, extend="both")
    return figure


def _effect(test: PointTest) -> Float:
    return test.cohen_d if test.kind == "t" else test.eta_squared


def _signed_logarithm(analysis: Analysis, key: MapKey, test: PointTest) -> Float:
    """Minus the logarithm of corrected p where it survives, with the sign of the statistic."""
    found = analysis.found[key]
    size = -np.log10(np.clip(found.adjusted, _SMALLEST_P, 1))
    return np.where(found.rejected, size * np.sign(test.statistic), np.nan)


def _bar(figure: "Figure", image: Any, axes: Any, label: str, extend: str = "neither") -> None:  # noqa: ANN401  (of matplotlib)
    bar = figure.colorbar(image, ax=axes, shrink=min(1.0, 2 / len(axes)), extend=extend)
    bar.set_label(label, fontsize=TITLE)
    bar.ax.tick_params(labelsize=LABEL)


def _draw(
    axis: "Axes",
    place: tuple[Cohort, FittedMaps],
    values: Float,
    colors: str,
    limits: tuple[float, float],
) -> Any:  # noqa: ANN401  (what colorbars take)
    """Draw one map on the sheet with its subfields, or on the surface that it lies on."""
    cohort, one = place
    if one.maps.mesh is not None:
        return draw_mesh(axis, one.maps.mesh, values, colors, limits)
    image = _sheet(axis, cohort, values, colors, limits)
    _borders(axis, cohort, one)
    return image


def _sheet(
    axis: "Axes", cohort: Cohort, values: Float, colors: str, limits: tuple[float, float]
) -> Any:  # noqa: ANN401  (what colorbars take)
    """Draw one map: medial left, posterior below."""
    image = axis.pcolormesh(
        cohort.x,
        cohort.y,
        values.T,
        cmap=colors,
        vmin=limits[0],
        vmax=limits[1],
        shading="nearest",
        rasterized=True,
    )
    axis.set_facecolor("0.92")
    mark_medial(axis, cohort)
    ends = ["posterior", "anterior"]
    axis.set_yticks([cohort.y[0], cohort.y[-1]], ends, fontsize=LABEL, rotation=90)
    lower, upper = axis.get_yticklabels()
    lower.set_verticalalignment("bottom")
    upper.set_verticalalignment("top")
    return image


def _borders(axis: "Axes", cohort: Cohort, one: FittedMaps) -> None:
    """Draw where the most frequent subfield changes, and name the subfields."""
    fields = one.subfield
    x, y = cohort.x, cohort.y
    dx, dy = (x[1] - x[0]) / 2, (y[1] - y[0]) / 2
    i, j = np.nonzero(fields[1:] != fields[:-1])
    axis.vlines(x[i] + dx, y[j] - dy, y[j] + dy, colors="black", linewidth=0.8)
    i, j = np.nonzero(fields[:, 1:] != fields[:, :-1])
    axis.hlines(y[j] + dy, x[i] - dx, x[i] + dx, colors="black", linewidth=0.8)
    for number, name in enumerate(one.maps.names):
        places = np.nonzero(fields == number)
        if len(places[0]):
            axis.text(
                float(x[places[0]].mean()),
                float(y[0]) + 2 * dy,
                name,
                fontsize=SMALL,
                ha="center",
                bbox={"facecolor": "white", "alpha": 0.6, "edgecolor": "none", "pad": 0.5},
            )
