"""Figures of an analysis: the list of all, and those that show curves.

Figures of maps are in ``maps`` and ``panels``. Colors are those of the pages (``reports.display``).
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, cycle
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np

from hipsta_bids.derivatives.analyses import GroupResults, records
from hipsta_bids.group.cohort.data import SHEET, Cohort
from hipsta_bids.group.output import panels, style
from hipsta_bids.group.output.maps import draw_alignment, draw_measure
from hipsta_bids.group.output.results import Analysis
from hipsta_bids.group.output.shapes import AverageShape
from hipsta_bids.group.output.steps import blocks
from hipsta_bids.joints import load_all
from hipsta_bids.reports.cells import display_name, with_brackets
from hipsta_bids.reports.display import COLORS, X_ENDS
from hipsta_bids.reports.group_maps import MOST_FIGURES, measures_of
from hipsta_bids.stats.arrays import Float, describe_known
from hipsta_bids.stats.glm import FittedMaps
from hipsta_bids.types import PARTICIPANT, SIDES, parts_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Positions of cross-sections along the long axis, as a fraction from posterior to anterior.
_SECTIONS = {0.1: "posterior", 0.5: "middle", 0.9: "anterior"}
_WIDTHS = (1.2, 0.7, 1.2)  # of the lines of interior, middle and exterior, points
_STYLES = ("-", ":", "-")
_SCREEN = 150  # dots per inch of pictures that the page alone shows
_SIDE_MARK = "\t"  # of entries of legends that have no line
_MOST_LINES = 500  # of single warps on a panel: more hide each other


def mark_medial(axis: "Axes", x: Float) -> None:
    """Mark the medial end on the x axis."""
    axis.set_xticks([x[0], x[-1]], X_ENDS)
    left, right = axis.get_xticklabels()
    left.set_horizontalalignment("left")
    right.set_horizontalalignment("right")


@dataclass(frozen=True, eq=False, kw_only=True)
class Curve:
    """A curve of a classifier, with the text of its legend."""

    hemi: str
    pair: tuple[str, str]
    """Control and case."""
    added: str
    full: bool
    """Whether the measure was added to the base model."""
    points: tuple[Float, Float]
    text: str
    separated: bool


def read_roc(results: GroupResults) -> list[Curve]:
    """Read receiver operating characteristics, with areas and their limits."""
    keys, curves = ["hemi", "control", "case", "added"], list[Curve]()
    table = records(results.table("classification"))
    rows = {tuple(row[key] for key in keys): row for row in table}
    for group, points in results.table("roc").groupby([*keys, "classifier"], sort=False):
        hemi, control, case, added, name = map(str, group)
        row = rows[hemi, control, case, added]
        ends = ("", "_low", "_high", "_cv")
        area, low, high, left_out = (row[f"auc_{name}{end}"] for end in ends)
        curves.append(
            Curve(
                hemi=hemi,
                pair=(control, case),
                added=added,
                full=name == "full",
                points=(points["false_positives"].to_numpy(), points["true_positives"].to_numpy()),
                text=f"{area:.2f} ({low:.2f} to {high:.2f}),\n   cross-validated {left_out:.2f}",
                separated=bool(row["separated"]),
            )
        )
    return curves


def draw_roc(results: GroupResults, width: float | None = None) -> "list[Figure]":
    """Draw the curves of the first added measure."""
    labels = "1 - specificity", "sensitivity"
    title = "area (95 % limits), fitted"
    return _draw_pairs(read_roc(results), labels, title, width=width)


def draw_calibration(analysis: Analysis) -> "list[Figure]":
    """Draw predicted chances, cross-validated, against what happened; of large groups only."""
    curves = [
        Curve(
            hemi=hemi,
            pair=pair,
            added=measure,
            full=full,
            points=(result.calibration.predicted, result.calibration.observed),
            text=f"{result.calibration.slope:.2f}, {result.calibration.brier:.2f}",
            separated=bool(comparison.columns["separated"]),
        )
        for hemi, measure, pair, comparison in analysis.pairs
        if comparison.full.calibration.judged
        for full, result in ((False, comparison.base), (True, comparison.full))
    ]
    labels = "predicted chance, cross-validated", "share of cases"
    return _draw_pairs(curves, labels, "slope, Brier score", marker="o", markersize=3)


def _first_added(curves: Sequence[Curve]) -> dict[tuple[str, str], dict[str, list[Curve]]]:
    """Return the curves of the first added measure, by pair of groups and side."""
    first: dict[tuple[str, str], dict[str, list[Curve]]] = {}
    for curve in curves:
        side_curves = first.setdefault(curve.pair, {}).setdefault(curve.hemi, [])
        if not side_curves or side_curves[0].added == curve.added:
            side_curves.append(curve)
    return first


def _draw_curves(axis: "Axes", curves: Iterable[Curve], options: Mapping[str, Any]) -> None:
    axis.plot([0, 1], [0, 1], color="0.6", linewidth=0.5)
    for curve in curves:
        axis.plot(*curve.points, color=COLORS[curve.full], **options)
    axis.set_xticks([0, 0.5, 1])
    axis.set_yticks([0, 0.5, 1])


def _add_legend(axis: "Axes", lines: Sequence[str]) -> None:
    """Write a heading and entries; entries of curves have the next color."""
    from matplotlib.lines import Line2D  # noqa: PLC0415  (slow to load)

    heading, *entries = lines
    colors = iter(COLORS)
    handles = [
        Line2D([], [], linestyle="none", color="none")
        if entry.startswith(_SIDE_MARK)
        else Line2D([], [], linestyle="-", color=next(colors))
        for entry in entries
    ]
    legend = axis.legend(
        handles, [entry.lstrip(_SIDE_MARK) for entry in entries], title=heading,
        loc="upper left", borderaxespad=0, alignment="left", handlelength=1.2, labelspacing=0.2,
    )  # fmt: skip
    legend.set_in_layout(False)


def _draw_pairs(
    curves: Sequence[Curve],
    labels: tuple[str, str],
    title: str,
    width: float | None = None,
    **options: Any,  # noqa: ANN401  (of matplotlib)
) -> "list[Figure]":
    """Draw a row for each pair of groups, with its legend next to it: the first added measure."""
    first = _first_added(curves)
    n = max(map(len, first.values()))
    width = width or (style.TWO_COLUMNS if n > 1 else style.ONE_COLUMN)
    legend_right = n == 1 or width > style.ONE_COLUMN  # is the legend
    side = (width - 6.0) / (n + legend_right)
    letters = int((side if legend_right else width - 12.0) / (0.22 * style.SMALL))
    legends = {pair: _legend(pair, by_side, title, letters) for pair, by_side in first.items()}
    lines = max("\n".join(legend).count("\n") + 1 for legend in legends.values())
    text = 18.0 + 3.2 * lines
    n_rows, height, ratios = 1, max(side + 13, text), None
    if not legend_right:
        n_rows, height, ratios = 2, side + 13 + text, [side + 13, text] * len(first)
    shape = n_rows * len(first), n + legend_right
    figure, axes = style.new_panels(*shape, (width, len(first) * height), ratios)
    for number, (pair, by_side) in enumerate(first.items()):
        row, *below = axes[n_rows * number : n_rows * (number + 1)]
        for axis, (hemi, side_curves) in zip(row, by_side.items(), strict=False):
            _draw_curves(axis, side_curves, options)
            axis.set_title(_sides_name(hemi), loc="center" if legend_right else "right")
            axis.set(xlabel=labels[0], aspect="equal")
        row[0].set_ylabel(labels[1])
        empty = [*row[len(by_side) :], *chain(*below)]
        for axis in empty:
            axis.set_axis_off()
        _add_legend(row[-1] if legend_right else empty[-n], legends[pair])
    style.letter_panels([axis for axis in axes.flat if axis.axison])
    return [figure]


def _legend(
    pair: tuple[str, str], by_side: Mapping[str, Sequence[Curve]], title: str, letters: int
) -> list[str]:
    """Write the title and the entries of a legend; those of sides, without a color, are marked."""
    curves = [curve for side_curves in by_side.values() for curve in side_curves]
    heading = wrap(" against ".join(pair), letters)
    if any(curve.separated for curve in curves):
        heading.append("(separated: Firth's method)")
    lines = ["\n".join([*heading, title])]
    for full in (False, True):
        name = f"with {display_name(curves[0].added)}" if full else "base model"
        lines.append("\n".join(wrap(name, letters - 4)))
        lines += [
            f"{_SIDE_MARK}{_sides_name(curve.hemi).split()[0]}: {curve.text}"
            for curve in curves
            if curve.full == full
        ]
    return lines


def _sides_name(hemi: str) -> str:
    return {"L": "left", "R": "right"}.get(hemi, "both sides")


def _draw_warps(shifts: "Axes", positions: "Axes", warps: Mapping[str, Float], side: str) -> None:
    """Draw shifts of participants (n, nodes) by group, their means, and registered positions."""
    from matplotlib.collections import LineCollection  # noqa: PLC0415  (slow to load)

    step = -(-sum(map(len, warps.values())) // _MOST_LINES)
    for color, values in zip(cycle(COLORS), warps.values(), strict=False):
        nodes = np.linspace(0, 1, values.shape[1])
        shifted = values[::step]
        for axis, drawn in ((shifts, shifted), (positions, nodes + shifted / (len(nodes) - 1))):
            lines = [np.column_stack([nodes, line]) for line in drawn]
            axis.add_collection(LineCollection(lines, colors=color, alpha=0.25, linewidths=0.4))
    for color, (group, values) in zip(cycle(COLORS), warps.items(), strict=False):
        _, mean, sd = describe_known([values])
        _curve(shifts, mean, sd / np.sqrt(max(len(values), 1)), color, group)
    shifts.axhline(0, color="black", linewidth=0.5)
    shifts.set_title(f"{side}, warps" + (f" (1 of {step} drawn)" if step > 1 else ""))
    shifts.set_ylabel("shift to lateral [nodes]")
    positions.set_title(f"{side}, positions")
    _mark_positions(positions)


def draw_registration(results: GroupResults, width: float | None = None) -> "list[Figure]":
    """Draw curvature from medial to lateral before and after registration, and positions."""
    profiles = results.table("profiles")
    profiles = profiles[profiles["measure"] == "curvature"]
    sides = [str(hemi) for hemi in profiles["hemi"].unique()]
    groups = [str(name) for name in profiles["group"].unique()]
    wide = (width or style.TWO_COLUMNS) > style.ONE_COLUMN
    shape = (len(sides), 4) if wide else (4, len(sides))
    size = (style.TWO_COLUMNS, 44.0 * len(sides)) if wide else (style.ONE_COLUMN, 200.0)
    figure, axes = style.new_panels(*shape, size)
    label = with_brackets("curvature", str(profiles["unit"].iloc[0]))
    for hemi, (before, after, shifts, positions) in zip(
        sides, axes if wide else axes.T, strict=True
    ):
        for axis, registered in ((before, False), (after, True)):
            is_shown = (profiles["hemi"] == hemi) & (profiles["registered"] == registered)
            for color, group in zip(cycle(COLORS), groups, strict=False):
                curve = profiles[is_shown & (profiles["group"] == group)]
                name = f"{group} (n = {curve['n'].max()})"
                _curve(axis, curve["mean"], curve["mean_se"], color, name)
            axis.set_title(f"{SIDES[hemi]}, {'after' if registered else 'before'}")
            axis.set_ylabel(label)
        _draw_warps(shifts, positions, _shifts_of(results, hemi, groups), SIDES[hemi])
        for axis in (before, after, shifts, positions):
            mark_medial(axis, np.array([0.0, 1.0]))
    # Sides can be compared, as can both states.
    grid = axes if wide else axes.T
    for panels_alike in (grid[:, :2].ravel(), grid[:, 2], grid[:, 3]):
        style.share_limits(panels_alike)
    style.explain(figure, grid[0, 0], "mean, 2 standard errors")
    style.letter_panels(axes.flat)
    return [figure]


def _mark_positions(axis: "Axes") -> None:
    """Draw the identity, and name both axes of positions."""
    axis.plot([0, 1], [0, 1], "--", color="black", linewidth=0.5)
    axis.set_xlabel("original position")
    axis.set_ylabel("registered position")
    axis.set_yticks([0, 1], X_ENDS, rotation=90)
    low, high = axis.get_yticklabels()
    low.set_verticalalignment("bottom")
    high.set_verticalalignment("top")


def _shifts_of(results: GroupResults, hemi: str, groups: Sequence[str]) -> dict[str, Float]:
    """Read how far registration moved nodes (sheets, nodes), to lateral, by group."""
    warps, people = results.table("warps"), results.table("covariates")
    warps = warps[warps["hemi"] == hemi]
    nodes = warps.filter(regex=r"^node_\d+$").to_numpy(np.float64)
    moved = (nodes - np.linspace(0, 1, nodes.shape[1])) * (nodes.shape[1] - 1)
    column = (results.record.get("groups") or {}).get("column")
    if column is None:
        return dict.fromkeys(groups, moved)
    group_of = people.drop_duplicates(PARTICIPANT).set_index(PARTICIPANT)[column].astype(str)
    of_sheets = warps[PARTICIPANT].map(group_of).to_numpy()
    return {group: moved[of_sheets == group] for group in groups}


def _curve(axis: "Axes", mean: Any, error: Any, color: str, name: str) -> None:  # noqa: ANN401  (columns)
    """Draw a mean and twice its standard error to both sides."""
    mean, error = np.asarray(mean, np.float64), 2 * np.asarray(error, np.float64)
    x = np.linspace(0, 1, len(mean))
    axis.plot(x, mean, color=color, label=name, linewidth=1.2)
    axis.fill_between(x, mean - error, mean + error, color=color, alpha=0.25, linewidth=0)


def draw_sections(
    cohort: Cohort, analysis: Analysis, shapes: Mapping[str, AverageShape]
) -> "list[Figure]":
    """Draw the groups' mean walls at three places along the long axis, superior up."""
    last = len(cohort.y) - 1
    places = {name: round(share * last) for share, name in _SECTIONS.items()}
    if (parts := parts_of(cohort.y)) is not None:
        named = {name: np.flatnonzero(parts == name) for name in ("tail", "body", "head")}
        places = {name: int(np.median(counts)) for name, counts in named.items() if len(counts)}
    figure, axes = style.new_panels(len(shapes), len(places), (style.TWO_COLUMNS, 55 * len(shapes)))
    for i, (hemi, shape) in enumerate(shapes.items()):
        for j, (name, node) in enumerate(places.items()):
            axis = axes[i, j]
            plane = _plane(shape.mean[1], node, left=hemi == "L")
            center = np.nanmean(shape.mean[:, :, node], axis=(0, 1))
            for color, (group, layers) in zip(cycle(COLORS), shape.by_group.items(), strict=False):
                flat = (layers[:, :, node] - center) @ plane.T
                for line, width, dashes in zip(flat, _WIDTHS, _STYLES, strict=True):
                    axis.plot(*line.T, color=color, linewidth=width, linestyle=dashes)
                # Another line for the legend alone.
                axis.plot([], [], color=color, label=f"{group} (n = {shape.counts[group]})")
            if hemi in analysis.fitted:
                middle = (shape.mean[:, :, node] - center) @ plane.T
                _mark_subfields(axis, middle, analysis.fitted[hemi], node)
            axis.set_title(f"{SIDES[hemi]}, {name} (y = {cohort.y[node]:.2g})")
            axis.set_xlabel("to lateral [mm]")
            axis.set_ylabel("to superior [mm]")
            axis.set_aspect("equal", adjustable="datalim")
    style.explain(figure, axes[0, 0], "walls; dotted: middle")
    style.letter_panels(axes.flat)
    return [figure]


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


def _mark_subfields(axis: "Axes", layers: Float, fitted: FittedMaps, node: int) -> None:
    """Draw borders of subfields across the mean wall, and name them inside it."""
    fields = fitted.subfield[:, node]
    inner, middle, outer = layers
    for i in np.flatnonzero(fields[1:] != fields[:-1]):
        ends = [(layer[i] + layer[i + 1]) / 2 for layer in (inner, outer)]
        axis.plot(*np.transpose(ends), color="0.3", linewidth=0.6)
    for number, name in enumerate(fitted.maps.names):
        nodes = np.flatnonzero(fields == number)
        if len(nodes):
            x, y = middle[nodes[len(nodes) // 2]]
            box = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 0.3}
            axis.text(x, y, name, fontsize=style.SMALL, ha="center", va="center", bbox=box)


def draw_figures(
    saved: GroupResults,
    cohorts: Mapping[str, Cohort],
    analyses: Mapping[str, Analysis],
    shapes: Mapping[str, AverageShape],
    all_measures: bool,
) -> Iterator[tuple[str, style.Drawing]]:
    """List the figures that a page shows by name, or all, for :func:`encode`."""
    views: panels.Views = {}
    dpi = style.DOTS_PER_INCH if all_measures else _SCREEN
    measures = measures_of(saved)[: None if all_measures else MOST_FIGURES]
    for measure in measures:
        yield f"{measure}_maps", partial(draw_measure, saved, measure, views, dpi)
    for surface, analysis in analyses.items():
        yield from blocks("figures", analysis.request, cohorts[surface], analysis)
    analysis = analyses[SHEET]
    templates = [registration.template for registration in analysis.registrations.values()]
    if templates and None not in templates:
        yield "registration", partial(draw_registration, saved)
    unregistered = {key.measure for key in analysis.unregistered}
    for measure in filter(unregistered.__contains__, measures):
        yield f"{measure}_alignment", partial(draw_alignment, saved, measure)
    if shapes:
        yield "sections", partial(draw_sections, cohorts[SHEET], analysis, shapes)
    for list_figures in load_all("figures"):
        yield from list_figures(saved)
    if analysis.pairs:
        yield "roc", partial(draw_roc, saved)
    if any(model.full.calibration.judged for *_, model in analysis.pairs):
        yield "calibration", partial(draw_calibration, analysis)
