"""Figures: maps, profiles, warps, cross-sections, receiver operating characteristics, calibration.

How values become colors, and how maps lie, is that of the pages (``reports.display``).
"""

import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from hipsta_bids.group.analysis import Analysis, mean_of_known, members_of, rows_of, spread_of_known
from hipsta_bids.group.classify import ClassifierResult, PairComparison, roc_curve
from hipsta_bids.group.data import Cohort, Float, Int
from hipsta_bids.group.glm import FittedMaps
from hipsta_bids.group.inference import MapKey
from hipsta_bids.group.shapes import AverageShape
from hipsta_bids.reports import display
from hipsta_bids.reports.display import COLORS, X_ENDS, Y_ENDS
from hipsta_bids.reports.group_maps import EFFECT_NAMES, signed_logarithm
from hipsta_bids.reports.group_tables import BOTH, SIDES, display_name
from hipsta_bids.reports.maps import new_figure
from hipsta_bids.types import Mesh

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Font sizes in points: of titles, of axes, and inside.
TITLE, LABEL, SMALL = 9, 7.5, 6.5
_DOTS_PER_INCH = 150
_MAP_PANEL, _SQUARE_PANEL = (2.6, 3.4), (3.1, 4.0)  # inches
#: A surface is flat if it is thinner than this share of its length.
_FLAT = 1e-3
#: Positions of cross-sections along the long axis, as a fraction from posterior to anterior.
_SECTIONS = {0.1: "posterior", 0.5: "middle", 0.9: "anterior"}
_WIDTHS = (1.2, 0.7, 1.2)  # of the lines of interior, middle and exterior, points
_STYLES = ("-", ":", "-")


#: Ticks of numbers of participants.
_COUNTS = tuple(n * 10**power for power in range(5) for n in (1, 2, 3, 5))

Scale = Mapping[str, Any]
"""Color map and the values at its ends, as matplotlib's arguments."""


def scale_of(colors: str, low: float, high: float) -> Scale:
    """Name the arguments of a color scale."""
    return {"cmap": colors, "vmin": low, "vmax": high}


def encode(name: str, figure: "Figure") -> Iterator[tuple[str, bytes]]:
    """Encode a figure as PNG and SVG files; the same results give the same bytes."""
    from matplotlib import rc_context  # noqa: PLC0415  (optional, slow to load)

    with rc_context({"svg.hashsalt": "hipsta_bids", "svg.fonttype": "none"}):
        for kind, metadata in (("png", {"Software": None}), ("svg", {"Date": None})):
            buffer = io.BytesIO()
            figure.savefig(buffer, format=kind, dpi=_DOTS_PER_INCH, metadata=metadata)
            yield f"{name}.{kind}", buffer.getvalue()


def panels(n_rows: int, n_columns: int, size: tuple[float, float]) -> tuple["Figure", Any]:
    """Return an empty figure and its panels, of a size in inches."""
    figure = new_figure((size[0] * n_columns + 0.8, size[1] * n_rows + 0.4), layout="constrained")
    return figure, figure.subplots(n_rows, n_columns, squeeze=False)


def shown(analysis: Analysis, measure: str) -> Mapping[str, FittedMaps]:
    """Fitted maps of the hemispheres, or of their difference, that have a measure."""
    return {hemi: one for hemi, one in analysis.fitted.items() if measure in one.fits}


def mark_medial(axis: "Axes", cohort: Cohort) -> None:
    """Say on the x axis which end is medial."""
    axis.set_xticks([cohort.x[0], cohort.x[-1]], X_ENDS, fontsize=LABEL)
    left, right = axis.get_xticklabels()
    left.set_horizontalalignment("left")
    right.set_horizontalalignment("right")


def draw_roc(analysis: Analysis) -> "Figure":
    """Draw the curves of the first added measure."""
    figure, panels_of_pairs = _pair_panels(analysis)
    for axis, measure, pair in panels_of_pairs:
        for color, name, result in _models(measure, pair):
            area, validation = result.auc, result.cross_validation
            text = f"{name}: {area.area:.2f} ({area.low:.2f}-{area.high:.2f})"
            text += f"\nleft out: {validation.auc:.2f}"
            curve = roc_curve(result.score, pair.is_case)
            axis.plot(*curve, color=color, label=text, linewidth=1.2)
        title = "area, participants fitted and left out"
        _finish(axis, ("1 - specificity", "sensitivity"), title)
    return figure


def draw_calibration(analysis: Analysis) -> "Figure":
    """Draw predicted chances, cross-validated, against what happened."""
    figure, panels_of_pairs = _pair_panels(analysis)
    for axis, measure, pair in panels_of_pairs:
        if not pair.comparison.full.calibration.judged:
            axis.set_axis_off()  # too few participants
            continue
        for color, name, result in _models(measure, pair):
            found = result.calibration
            text = f"{name}: {found.slope:.2f}, {found.brier:.2f}"
            axis.plot(found.predicted, found.observed, "o-", color=color, label=text, markersize=3)
        labels = ("predicted chance, cross-validated", "share of cases")
        _finish(axis, labels, "slope, Brier score")
    return figure


def _pair_panels(
    analysis: Analysis,
) -> tuple["Figure", list[tuple["Axes", str, PairComparison]]]:
    """Title a panel for each pair and hemisphere, with the measure that was added first."""
    hemis = list(dict.fromkeys(hemi for hemi, _, _ in analysis.pairs))
    groups = list(dict.fromkeys((pair.control, pair.case) for _, _, pair in analysis.pairs))
    figure, axes = panels(len(groups), len(hemis), _SQUARE_PANEL)
    first: dict[tuple[str, str, str], tuple[str, PairComparison]] = {}
    for hemi, measure, pair in analysis.pairs:
        first.setdefault((pair.control, pair.case, hemi), (measure, pair))
    titled = []
    for i, (control, case) in enumerate(groups):
        for j, hemi in enumerate(hemis):
            axis = axes[i, j]
            if (control, case, hemi) not in first:
                axis.set_axis_off()
                continue
            measure, pair = first[control, case, hemi]
            how = "\n(separated: Firth's method)" if pair.comparison.separated else ""
            side = {"L": "left", "R": "right"}.get(hemi, "both sides")
            axis.set_title(f"{control} against {case}, {side}{how}", fontsize=TITLE)
            axis.plot([0, 1], [0, 1], color="0.6", linewidth=0.5)
            titled.append((axis, measure, pair))
    return figure, titled


def _models(measure: str, pair: PairComparison) -> Iterator[tuple[str, str, ClassifierResult]]:
    yield COLORS[0], "base", pair.comparison.base
    yield COLORS[1], f"with {display_name(measure)}", pair.comparison.full


def _finish(axis: "Axes", labels: tuple[str, str], title: str) -> None:
    """Label the axes of a panel, about square, and put its legend below them, off the curves."""
    axis.set_xlabel(labels[0], fontsize=LABEL)
    axis.set_ylabel(labels[1], fontsize=LABEL)
    axis.tick_params(labelsize=LABEL)
    axis.legend(
        fontsize=SMALL,
        title=title,
        title_fontsize=SMALL,
        loc="upper center",
        bbox_to_anchor=(0.5, -0.15),
        frameon=False,
    )


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
                for color, (group, own) in zip(cycle(COLORS), members.items(), strict=False):
                    _band(axis, cohort.x, values[own], group, color)
                axis.set_title(
                    f"{display_name(measure)}, {SIDES[hemi]},\n{when} registration",
                    fontsize=TITLE,
                )
                _finish_curve(
                    axis, cohort, f"{display_name(measure)} [{cohort.units.get(measure, '1')}]"
                )
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
        for color, (group, own) in zip(cycle(COLORS), members.items(), strict=False):
            axes[i, 0].plot(cohort.x, moved[own].T, color=color, alpha=0.4, linewidth=0.6)
            _band(axes[i, 1], cohort.x, moved[own], group, color)
        for axis, what in zip(axes[i], ("each participant", "means, 2 SE"), strict=True):
            axis.axhline(0, color="black", linewidth=0.5)
            axis.set_title(f"warps, {SIDES[hemi]}, {what}", fontsize=TITLE)
            _finish_curve(axis, cohort, "shift to lateral [nodes]")
    axes[0, 1].legend(fontsize=LABEL)
    return figure


def _finish_curve(axis: "Axes", cohort: Cohort, label: str) -> None:
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


def draw_mesh(axis: "Axes", mesh: Mesh, values: Float, scale: Scale) -> Any:  # noqa: ANN401  (what colorbars take)
    """Draw one map, upright as sheets are.

    A flat surface is drawn in its own coordinates. HippUnfold's runs from anterior to posterior
    along x and from the subiculum to the dentate gyrus along y, so that x goes down and y to the
    right, as on a sheet. A folded surface is seen along its thinnest direction.
    """
    plane, triangles, words = _laid_out(mesh)
    flat = values.reshape(-1)
    known = np.isfinite(flat[triangles]).all(axis=1)
    axis.set_facecolor("0.92")
    axis.set_aspect("equal")
    axis.set_xlabel(words[0], fontsize=LABEL)
    axis.set_ylabel(words[1], fontsize=LABEL)
    axis.tick_params(labelsize=SMALL)
    (left, bottom), (right, top) = plane.min(axis=0), plane.max(axis=0)
    axis.set_xlim(left, right)
    axis.set_ylim(*((top, bottom) if words[1].startswith("x") else (bottom, top)))
    # One invisible triangle carries the colors if nothing is known.
    some = triangles[known] if known.any() else triangles[:1]
    return axis.tripcolor(
        plane[:, 0],
        plane[:, 1],
        some,
        facecolors=np.nan_to_num(flat[some].mean(axis=1)),
        **scale,
        edgecolors="none",
        rasterized=True,
        visible=bool(known.any()),
    )


def _laid_out(mesh: Mesh) -> tuple[Float, Int, tuple[str, str]]:
    """Positions in the plane, triangles from back to front, and what the axes are."""
    centered = mesh.points - mesh.points.mean(axis=0)
    reach = np.ptp(mesh.points, axis=0)
    if reach[2] <= _FLAT * reach.max():
        names = ("x of the surface", "y of the surface")
        if reach[0] > reach[1]:
            return mesh.points[:, [1, 0]], mesh.triangles, (names[1], names[0])
        return mesh.points[:, :2], mesh.triangles, names
    axes = np.linalg.svd(centered, full_matrices=False)[2]
    rotated = centered @ axes.T
    order = np.argsort(rotated[mesh.triangles, 2].mean(axis=1))
    return rotated[:, [1, 0]], mesh.triangles[order], ("second axis", "longest axis")


def draw_sections(
    cohort: Cohort, analysis: Analysis, shapes: Mapping[str, AverageShape]
) -> "Figure":
    """Draw the groups' mean walls at three places along the long axis, superior up."""
    figure, axes = panels(len(shapes), len(_SECTIONS), (3.2, 2.8))
    for i, (hemi, shape) in enumerate(shapes.items()):
        for j, (share, name) in enumerate(_SECTIONS.items()):
            axis, node = axes[i, j], round(share * (len(cohort.y) - 1))
            plane = _plane(shape.mean[1], node, left=hemi == "L")
            center = np.nanmean(shape.mean[:, :, node], axis=(0, 1))
            for color, (group, layers) in zip(cycle(COLORS), shape.by_group.items(), strict=False):
                flat = (layers[:, :, node] - center) @ plane.T
                for line, width, style in zip(flat, _WIDTHS, _STYLES, strict=True):
                    axis.plot(*line.T, color=color, linewidth=width, linestyle=style)
                # Another line for the legend alone.
                axis.plot([], [], color=color, label=f"{group} (n = {shape.counts[group]})")
            if hemi in analysis.fitted:
                middle = (shape.mean[:, :, node] - center) @ plane.T
                _mark_subfields(axis, middle, analysis.fitted[hemi], node)
            axis.set_title(f"{SIDES[hemi]}, y = {cohort.y[node]:.2g} ({name})", fontsize=TITLE)
            axis.set_xlabel("to lateral [mm]", fontsize=LABEL)
            axis.set_ylabel("to superior [mm]", fontsize=LABEL)
            axis.set_aspect("equal", adjustable="datalim")
            axis.tick_params(labelsize=LABEL)
    axes[0, 0].legend(fontsize=SMALL, title="walls, and dotted the middle", title_fontsize=SMALL)
    return figure


def _plane(middle: Float, node: int, *, left: bool) -> Float:
    """Two directions across the long axis of a surface (RAS): to lateral, and to superior."""
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
            x, y = middle[nodes[len(nodes) // 2]]
            box = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 0.3}
            axis.text(x, y, name, fontsize=SMALL, ha="center", va="center", bbox=box)


def draw_means(cohort: Cohort, analysis: Analysis, measure: str) -> "Figure":
    """Draw the mean map of each group."""
    groups = analysis.groups.levels if analysis.groups else ("all",)
    sides = shown(analysis, measure)
    figure, axes = panels(len(sides), len(groups), _MAP_PANEL)
    means, counts = {}, {}
    for hemi, one in sides.items():
        for group, own in members_of(analysis, rows_of(analysis, one)).items():
            values = mean_of_known(one.values(measure)[own], 0)
            means[hemi, group] = values.reshape(one.maps.shape)
            counts[hemi, group] = int(own.sum())
    kind = display.kind_of(measure, change=bool(analysis.comparison.pair) or set(sides) == {BOTH})
    scale = scale_of(kind.colors, *display.scale_of(kind, list(means.values())))
    images: list[Any] = []
    for i, (hemi, one) in enumerate(sides.items()):
        for j, group in enumerate(groups):
            axis = axes[i, j]
            images.append(_draw(axis, cohort, one, means[hemi, group], scale))
            axis.set_title(f"{group}, {SIDES[hemi]} (n = {counts[hemi, group]})", fontsize=TITLE)
    change = " change of" if analysis.comparison.pair else ""
    unit = cohort.units.get(measure, "1")
    _bar(figure, images[0], axes, f"mean{change} {display_name(measure)} [{unit}]")
    return figure


def draw_contrasts(cohort: Cohort, analysis: Analysis, measure: str) -> "Figure":
    """Draw effect sizes and corrected p-values, one row per contrast."""
    sides = shown(analysis, measure)
    tests = next(iter(sides.values())).fits[measure].tests
    figure, axes = panels(len(tests), 2 * len(sides), _MAP_PANEL)
    reaches = _reaches(analysis)
    signed = {}
    for hemi, one in sides.items():
        for i, test in enumerate(one.fits[measure].tests):
            found = analysis.found[MapKey(measure, test.contrast.name, hemi)]
            signed[hemi, i] = signed_logarithm(found.adjusted, found.rejected, test.statistic)
    top = display.significance_reach(list(signed.values()))
    p_scale = scale_of(display.P_COLORS, -top, top)
    effects, significances = {}, []
    for j, (hemi, one) in enumerate(sides.items()):
        for i, test in enumerate(one.fits[measure].tests):
            left, right = axes[i, 2 * j], axes[i, 2 * j + 1]
            effect = test.effect.reshape(one.maps.shape)
            p = signed[hemi, i].reshape(one.maps.shape)
            reach = reaches[test.contrast.name]
            scale = scale_of(display.EFFECT_COLORS, -reach, reach)
            effects[i] = _draw(left, cohort, one, effect, scale)
            significances.append(_draw(right, cohort, one, p, p_scale))
            for axis, what in ((left, "effect size"), (right, "significance")):
                axis.set_title(f"{test.contrast.name}\n{SIDES[hemi]}, {what}", fontsize=TITLE)
    bar = _bar(figure, significances[0], axes, "-log10 of corrected p, with the sign of the effect")
    alpha = next(iter(analysis.found.values())).alpha
    for sign in (-1, 1):
        bar.ax.axhline(-sign * np.log10(alpha), color="black", linewidth=1)
        place = (-0.15, -sign * np.log10(alpha))
        bar.ax.text(*place, f"p {alpha:g}", fontsize=SMALL, ha="right", va="center")
    for i, test in enumerate(tests):
        _bar(figure, effects[i], axes[i], EFFECT_NAMES[test.kind], extend="both")
    return figure


def _reaches(analysis: Analysis) -> dict[str, float]:
    """Effect sizes at the ends of the colors by contrast, the same for all measures."""
    maps: dict[str, list[display.Effects]] = {}
    for one in analysis.fitted.values():
        for test in (test for fit in one.fits.values() for test in fit.tests):
            effects = display.Effects(test.kind, test.effect, test.statistic, test.df)
            maps.setdefault(test.contrast.name, []).append(effects)
    return {name: display.effect_reach(own) for name, own in maps.items()}


def _bar(figure: "Figure", image: Any, axes: Any, label: str, extend: str = "neither") -> Any:  # noqa: ANN401  (of matplotlib)
    bar = figure.colorbar(
        image, ax=axes, shrink=min(1.0, 2 / len(axes)) if np.ndim(axes) > 1 else 1.0, extend=extend
    )
    bar.set_label(label, fontsize=TITLE)
    bar.ax.tick_params(labelsize=LABEL)
    return bar


def _draw(
    axis: "Axes",
    cohort: Cohort,
    one: FittedMaps,
    values: Float,
    scale: Scale,
) -> Any:  # noqa: ANN401  (what colorbars take)
    """Draw one map on the sheet with its subfields, or on the surface that it lies on."""
    if one.maps.mesh is not None:
        return draw_mesh(axis, one.maps.mesh, values, scale)
    x, y = cohort.x, cohort.y
    image = axis.pcolormesh(x, y, values.T, **scale, shading="nearest", rasterized=True)
    axis.set_facecolor("0.92")
    mark_medial(axis, cohort)
    axis.set_yticks([y[0], y[-1]], Y_ENDS, fontsize=LABEL, rotation=90)
    lower, upper = axis.get_yticklabels()
    lower.set_verticalalignment("bottom")
    upper.set_verticalalignment("top")
    _borders(axis, cohort, one)
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
        nodes = np.nonzero(fields == number)[0]
        if len(nodes):
            axis.text(
                float(x[nodes].mean()),
                float(y[0]) + 2 * dy,
                name,
                fontsize=SMALL,
                ha="center",
                bbox={"facecolor": "white", "alpha": 0.6, "edgecolor": "none", "pad": 0.5},
            )


TrialMaps = Mapping[str, tuple[FittedMaps, Float]]
"""By hemisphere, where the points of a map are, and their values."""


@dataclass(frozen=True)
class TrialRow:
    """One statistic of a map, for a row of panels with one per side."""

    title: str
    unit: str
    """In brackets, or empty."""
    maps: TrialMaps
    colors: str
    limits: tuple[float, float] | None = None
    """At the ends of the colors; else the 1st and 99th percentiles."""
    log: bool = False
    """Whether colors go by the logarithm."""

    @property
    def scale(self) -> Scale:
        """Colors and the values at their ends."""
        from matplotlib.colors import LogNorm  # noqa: PLC0415  (optional, slow to load)

        every = display.known([values for _, values in self.maps.values()])
        low, high = self.limits or (np.percentile(every, (1, 99)) if len(every) else (1.0, 2.0))
        if self.log:
            return {"cmap": self.colors, "norm": LogNorm(low, max(high, 1.1 * low))}
        return scale_of(self.colors, low, high)


def draw_trial(cohort: Cohort, rows: Sequence[TrialRow]) -> "Figure":
    """Draw statistics of one map, a row each, both sides beside each other."""
    figure, axes = panels(len(rows), max(len(row.maps) for row in rows), _MAP_PANEL)
    for i, row in enumerate(rows):
        scale, image = row.scale, None
        for axis, (hemi, (one, values)) in zip(axes[i], row.maps.items(), strict=False):
            image = _draw(axis, cohort, one, values.reshape(one.maps.shape), scale)
            axis.set_title(f"{row.title}, {SIDES[hemi]}", fontsize=TITLE)
        bar = _bar(figure, image, axes[i], f"{row.title} {row.unit}".strip(), extend="both")
        if row.log:
            low, high = bar.norm.vmin, bar.norm.vmax
            bar.minorticks_off()
            ticks = [tick for tick in _COUNTS if low <= tick <= high]
            bar.set_ticks(ticks, labels=[f"{tick:,}" for tick in ticks])
    return figure


def draw_figures(
    cohort: Cohort, analysis: Analysis, shapes: Mapping[str, AverageShape]
) -> Iterator[tuple[str, bytes]]:
    """Draw all figures of one model, as files."""
    for measure in dict.fromkeys(m for one in analysis.fitted.values() for m in one.fits):
        yield from encode(f"{measure}_means", draw_means(cohort, analysis, measure))
        if any(one.fits[measure].tests for one in analysis.fitted.values() if measure in one.fits):
            yield from encode(f"{measure}_contrasts", draw_contrasts(cohort, analysis, measure))
    if analysis.sides:
        yield from encode("profiles", draw_profiles(cohort, analysis))
    if (
        analysis.groups is not None
        and analysis.sides
        and all(side.registration.template is not None for side in analysis.sides.values())
    ):
        yield from encode("warps", draw_warps(cohort, analysis))
    if shapes:
        yield from encode("sections", draw_sections(cohort, analysis, shapes))
    if analysis.pairs:
        yield from encode("roc", draw_roc(analysis))
        if any(pair.comparison.full.calibration.judged for *_, pair in analysis.pairs):
            yield from encode("calibration", draw_calibration(analysis))
