"""Figures of an analysis, as a paper prints them: sizes, type, files, and all that show curves.

Those of maps are in ``panels``. Colors are those of the pages (``reports.display``).
"""

import io
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from hipsta_bids.group.cohort.data import Cohort
from hipsta_bids.group.output import panels
from hipsta_bids.group.output.results import Analysis, ScoredMaps, members_of, profiles_of
from hipsta_bids.group.output.shapes import AverageShape
from hipsta_bids.group.stats.arrays import Float, describe_known, mean_of_known
from hipsta_bids.group.stats.classify import ClassifierResult, ModelComparison
from hipsta_bids.group.stats.glm import FittedMaps
from hipsta_bids.io.files import MISSING
from hipsta_bids.reports.cells import SIDES, display_name, with_brackets
from hipsta_bids.reports.display import COLORS, HEMISPHERE_COLORS, X_ENDS, kind_of, parts_of
from hipsta_bids.reports.maps import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_STYLE: Any = {
    "font.family": "sans-serif",
    # The first is everywhere; the other fonts are for readers of drawings who lack them.
    # Chinese, Japanese and Korean characters come from the first of these that is installed.
    "font.sans-serif": [
        "DejaVu Sans",
        "Verdana",
        "Arial",
        "Helvetica",
        "Noto Sans CJK SC",
        "Source Han Sans SC",
        "Microsoft YaHei",
        "PingFang SC",
        "Malgun Gothic",
    ],
    "font.size": panels.SMALL,
    "axes.titlesize": panels.TITLE,
    "axes.titley": 1.0,  # no search for a place: nothing is above the panels
    "axes.labelsize": panels.SMALL,
    "xtick.labelsize": panels.SMALL,
    "ytick.labelsize": panels.SMALL,
    "legend.fontsize": panels.SMALL,
    "legend.title_fontsize": panels.SMALL,
    "legend.frameon": False,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "image.composite_image": False,  # views in one picture with what lies between take longer
    "text.parse_math": False,  # names of groups are no formulas
    "pdf.fonttype": 42,
    "svg.fonttype": "none",
    "svg.hashsalt": "hipsta_bids",
}
#: What of a file would change from day to day, or with the version of a library.
_METADATA: Mapping[str, Any] = {
    "png": {"Software": None},
    "svg": {"Date": None, "Creator": None},
    "pdf": {"CreationDate": None, "Producer": None, "Creator": None},
}
_INCH = 25.4  # mm
#: Positions of cross-sections along the long axis, as a fraction from posterior to anterior.
_SECTIONS = {0.1: "posterior", 0.5: "middle", 0.9: "anterior"}
_WIDTHS = (1.2, 0.7, 1.2)  # of the lines of interior, middle and exterior, points
_STYLES = ("-", ":", "-")
_MOST_LINES = 500  # of single warps on a panel: more hide each other
_LETTERS = "abcdefghijklmnopqrstuvwxyz"

#: Deviation of the 5th centile.
_LOW = -1.645

Drawing = Callable[[], "list[Figure]"]


def encode(name: str, draw: Drawing) -> list[tuple[str, bytes]]:
    """Draw figures and encode each as PDF, PNG and SVG; the same results give the same bytes."""
    new_figure((1.0, 1.0), None)  # loads the library with settings of its own
    from matplotlib import rc_context  # noqa: PLC0415

    encoded = []
    with rc_context(_STYLE):
        for number, figure in enumerate(draw(), start=1):
            title = name if number == 1 else f"{name}_{number}"
            for kind, metadata in _METADATA.items():
                buffer = io.BytesIO()
                options: Any = {"pil_kwargs": {"compress_level": 4}} if kind == "png" else {}
                figure.savefig(
                    buffer, format=kind, dpi=panels.DOTS_PER_INCH, metadata=metadata, **options
                )
                encoded.append((f"{title}.{kind}", buffer.getvalue()))
                figure.set_layout_engine(None)  # that of the first is for all: it takes long
    return encoded


def _panels(n_rows: int, n_columns: int, size: tuple[float, float]) -> tuple["Figure", Any]:
    """Return an empty figure of a size in mm, and its panels."""
    figure = new_figure((size[0] / _INCH, size[1] / _INCH), "constrained")
    return figure, figure.subplots(n_rows, n_columns, squeeze=False)


def _explain(figure: "Figure", axis: "Axes", title: str | None = None) -> None:
    """Put the legend of a panel below all, where it covers no curve."""
    handles = dict(zip(*axis.get_legend_handles_labels()[::-1], strict=True))
    legend = figure.legend(
        handles.values(), handles, loc="outside lower center", ncols=len(handles)
    )
    legend.set_title(title or "")


def _name(axes: "Sequence[Axes]") -> None:
    """Put letters on panels, beside their titles."""
    for axis, letter in zip(axes, cycle(_LETTERS), strict=False):
        axis.set_title(letter, loc="left", fontsize=panels.LETTER, weight="bold")


def mark_medial(axis: "Axes", cohort: Cohort) -> None:
    """Say on the x axis which end is medial."""
    axis.set_xticks([cohort.x[0], cohort.x[-1]], X_ENDS)
    left, right = axis.get_xticklabels()
    left.set_horizontalalignment("left")
    right.set_horizontalalignment("right")


def draw_roc(analysis: Analysis) -> "list[Figure]":
    """Draw the curves of the first added measure."""

    def line(axis: "Axes", result: ClassifierResult, color: str) -> str:
        axis.plot(*result.curve, color=color)
        area, left_out = result.auc, result.validated[0]
        return f"{area.area:.2f} ({area.low:.2f} to {area.high:.2f}),\n   left out {left_out:.2f}"

    labels = "1 - specificity", "sensitivity"
    return _draw_pairs(analysis, labels, "area (95 % limits), participants fitted", line)


def draw_calibration(analysis: Analysis) -> "list[Figure]":
    """Draw predicted chances, cross-validated, against what happened; of large groups only."""

    def line(axis: "Axes", result: ClassifierResult, color: str) -> str:
        calibration = result.calibration
        axis.plot(calibration.predicted, calibration.observed, "o-", color=color, markersize=3)
        return f"{calibration.slope:.2f}, {calibration.brier:.2f}"

    judged = [one for one in analysis.pairs if one[-1].full.calibration.judged]
    labels = "predicted chance, cross-validated", "share of cases"
    return _draw_pairs(replace(analysis, pairs=judged), labels, "slope, Brier score", line)


def _draw_pairs(
    analysis: Analysis,
    labels: tuple[str, str],
    title: str,
    line: "Callable[[Axes, ClassifierResult, str], str]",
) -> "list[Figure]":
    """Draw a row for each pair of groups, with its legend beside it: the first added measure."""
    first: dict[tuple[str, str], dict[str, tuple[str, ModelComparison]]] = {}
    for hemi, measure, pair, comparison in analysis.pairs:
        first.setdefault(pair, {}).setdefault(hemi, (measure, comparison))
    n = max(map(len, first.values()))
    width = panels.TWO_COLUMNS if n > 1 else panels.ONE_COLUMN
    side = (width - 6.0) / (n + 1)
    figure, axes = _panels(len(first), n + 1, (width, len(first) * max(side + 13, 18 + 14 * n)))
    for row, ((control, case), by_side) in zip(axes, first.items(), strict=True):
        texts: dict[str, list[str]] = {}
        for axis, (hemi, (measure, comparison)) in zip(row, by_side.items(), strict=False):
            where = {"L": "left", "R": "right"}.get(hemi, "both sides")
            axis.plot([0, 1], [0, 1], color="0.6", linewidth=0.5)
            for color, name, result in (
                (COLORS[0], "base model", comparison.base),
                (COLORS[1], f"with {display_name(measure)}", comparison.full),
            ):
                text = line(axis, result, color)
                texts.setdefault(name, []).append(f"{where}: {text}")
            axis.set_title(where)
            axis.set(xlabel=labels[0], aspect="equal")
            axis.set_xticks([0, 0.5, 1])
            axis.set_yticks([0, 0.5, 1])
        row[0].set_ylabel(labels[1])
        for axis in row[len(by_side) :]:
            axis.set_axis_off()
        method = "\n(separated: Firth's method)" if comparison.columns["separated"] else ""
        from matplotlib.lines import Line2D  # noqa: PLC0415  (slow to load)

        blank = Line2D([], [], linestyle="none")
        row[-1].legend(
            [
                handle
                for color, lines in zip(COLORS, texts.values(), strict=False)
                for handle in (Line2D([], [], color=color), *[blank] * len(lines))
            ],
            [text for name, lines in texts.items() for text in (name, *lines)],
            title=f"{control} against {case}{method}\n{title}",
            loc="upper left", borderaxespad=0, alignment="left", handlelength=1.2, labelspacing=0.2,
        )  # fmt: skip
    _name([axis for axis in axes.flat if axis.axison])
    return [figure]


def draw_registration(cohort: Cohort, analysis: Analysis) -> "list[Figure]":
    """Draw curvature from medial to lateral before and after registration, and the warps."""
    sides = analysis.registered
    figure, axes = _panels(len(sides), 3, (panels.TWO_COLUMNS, 48 * len(sides)))
    label = with_brackets("curvature", cohort.units.get("curvature", "1"))
    for (before, after, shifts), (hemi, side) in zip(axes, sides.items(), strict=True):
        members = members_of(analysis, cohort.table.iloc[side.rows])
        for axis, source, state in (
            (before, cohort.sides[hemi], "before"),
            (after, side, "after"),
        ):
            curves = (profiles_of(source.maps, "curvature", member) for member in members.values())
            _curves(axis, cohort.x, members, curves)
            axis.set_title(f"{SIDES[hemi]}, {state} registration")
            axis.set_ylabel(label)
        after.sharey(before)
        moved = analysis.registrations[hemi].shifts
        step = -(-len(moved) // _MOST_LINES)
        for color, member in zip(cycle(COLORS), members.values(), strict=False):
            shifts.plot(cohort.x, moved[member][::step].T, color=color, alpha=0.25, linewidth=0.4)
        _curves(shifts, cohort.x, members, (moved[member] for member in members.values()))
        shifts.axhline(0, color="black", linewidth=0.5)
        shifts.set_title(f"{SIDES[hemi]}, warps" + (f" (1 of {step} drawn)" if step > 1 else ""))
        shifts.set_ylabel("shift to lateral [nodes]")
        for axis in (before, after, shifts):
            mark_medial(axis, cohort)
    _explain(figure, axes[0, 0], "mean, 2 standard errors")
    _name(axes.flat)
    return [figure]


def _curves(axis: "Axes", x: Float, names: Iterable[str], groups: Iterable[Float]) -> None:
    """Draw the mean of each group and twice its standard error to both sides."""
    for color, name, values in zip(cycle(COLORS), names, groups, strict=False):
        finite, mean, sd = describe_known([values])
        error = 2 * sd / np.sqrt(np.maximum(finite.sum(axis=0), 1))
        axis.plot(x, mean, color=color, label=f"{name} (n = {len(values)})", linewidth=1.2)
        axis.fill_between(x, mean - error, mean + error, color=color, alpha=0.25, linewidth=0)


def draw_sections(
    cohort: Cohort, analysis: Analysis, shapes: Mapping[str, AverageShape]
) -> "list[Figure]":
    """Draw the groups' mean walls at three places along the long axis, superior up."""
    last = len(cohort.y) - 1
    places = {name: round(share * last) for share, name in _SECTIONS.items()}
    if (parts := parts_of(cohort.y)) is not None:
        named = {name: np.flatnonzero(parts == name) for name in ("tail", "body", "head")}
        places = {name: int(np.median(own)) for name, own in named.items() if len(own)}
    figure, axes = _panels(len(shapes), len(places), (panels.TWO_COLUMNS, 55 * len(shapes)))
    for i, (hemi, shape) in enumerate(shapes.items()):
        for j, (name, node) in enumerate(places.items()):
            axis = axes[i, j]
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
            axis.set_title(f"{SIDES[hemi]}, {name} (y = {cohort.y[node]:.2g})")
            axis.set_xlabel("to lateral [mm]")
            axis.set_ylabel("to superior [mm]")
            axis.set_aspect("equal", adjustable="datalim")
    _explain(figure, axes[0, 0], "walls; dotted: middle")
    _name(axes.flat)
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
            axis.text(x, y, name, fontsize=panels.SMALL, ha="center", va="center", bbox=box)


def draw_sites(cohort: Cohort, analysis: Analysis) -> "list[Figure]":
    """Draw means and SDs of the residuals of sites over points, before and after harmonization."""
    harmonization = analysis.harmonization
    if harmonization is None:
        raise ValueError("nothing was harmonized")
    shown_sites = [site for site in harmonization.plan.sites if site in harmonization.plan.counts]
    height = 2 * (20 + 5 * len(shown_sites))
    maps = {key: pair for key, pair in harmonization.effects.items() if key[0] == "map"}
    figure, axes = _panels(2, len(maps), (panels.TWO_COLUMNS, height))
    for j, ((_, hemi, measure), (effects, moments)) in enumerate(maps.items()):
        states = {"before": moments, "after": moments.after(effects)}
        unit = cohort.units.get(measure, "1")
        for number, (name, state) in enumerate(states.items()):
            for axis, values in ((axes[0, j], state.mean * effects.sd), (axes[1, j], state.sd)):
                for row, site in enumerate(shown_sites):
                    _spread(axis, values[harmonization.plan.sites.index(site)], row, number, name)
        for axis, label, ideal in (
            (axes[0, j], f"mean, {display_name(measure)} [{unit}]", 0.0),
            (axes[1, j], "SD, over that of all", 1.0),
        ):
            axis.axvline(ideal, color="black", linewidth=0.5)
            axis.set_yticks(
                range(len(shown_sites)), shown_sites if j == 0 else [""] * len(shown_sites)
            )
            axis.set_ylim(len(shown_sites) - 0.5, -0.5)
            axis.locator_params(axis="x", nbins=4)
            axis.set_xlabel(label)
        axes[0, j].set_title(f"{display_name(measure)}, {SIDES[hemi]}")
    _explain(figure, axes[0, 0])
    return [figure]


def _spread(axis: "Axes", values: Float, row: int, number: int, name: str) -> None:
    """Draw the 5th to the 95th percentile, the quartiles and the median of points as lines."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return
    low, first, middle, third, high = np.percentile(finite, [5, 25, 50, 75, 95])
    y, color = row - 0.16 + 0.32 * number, ("0.6", COLORS[0])[number]
    axis.plot([low, high], [y, y], color=color, linewidth=1.0)
    axis.plot([first, third], [y, y], color=color, linewidth=4.5, label=name, solid_capstyle="butt")
    axis.plot([middle], [y], "|", color="white", markersize=4.5)


def draw_norms(lines: pd.DataFrame, dots: pd.DataFrame) -> "list[Figure]":
    """Draw centiles over age, a row for each sex and a column for each side; and people on it.

    Controls that a site was adapted to are open circles.
    """
    sexes, sides = lines["sex"].unique(), lines["hemi"].unique()
    width = panels.TWO_COLUMNS if len(sides) > 1 else panels.ONE_COLUMN
    figure, axes = _panels(len(sexes), len(sides), (width, 60.0 * len(sexes)))
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
    _name(axes.flat)
    return [figure]


def norm_rows(
    centers: Mapping[str, tuple[Float, Float]], age: float, measure: str, unit: str
) -> Iterator[panels.Row]:
    """Show mean and SD of norms by side, at an age."""
    kind = kind_of(measure)
    for i, (quantity, colors) in enumerate({"mean": kind.colors, "SD": "magma"}.items()):
        values = {hemi: pair[i].ravel() for hemi, pair in centers.items()}
        scale = panels.spanned(colors, values)
        if kind.limits and quantity == "mean":
            scale = {"cmap": colors, "vmin": kind.limits[0], "vmax": kind.limits[1]}
        title = f"{quantity[0].upper()}{quantity[1:]} at {age:g} years"
        label = with_brackets(f"{quantity},\n{display_name(measure)}", unit)
        yield panels.Row(
            kind="expected", index=i, title=title, label=label, scale=scale, values=values
        )


def deviation_rows(scored: Mapping[str, ScoredMaps], measure: str) -> Iterator[panels.Row]:
    """Show mean deviations, and shares of low ones, of those whom no site was adapted to."""
    z = {
        hemi: side.scores[measure].w[~side.reference]
        for hemi, side in scored.items()
        if measure in side.scores
    }
    means = {hemi: mean_of_known(own, 0) for hemi, own in z.items()}
    below = _LOW
    low = {
        hemi: 100 * mean_of_known(np.where(np.isfinite(own), own < below, np.nan), 0)
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


def draw_figures(
    cohort: Cohort, analysis: Analysis, shapes: Mapping[str, AverageShape]
) -> Iterator[tuple[str, Drawing]]:
    """List all figures of one model by name, for :func:`encode`."""
    views: panels.Views = {}
    for measure in dict.fromkeys(m for one in analysis.fitted.values() for m in one.fits):
        yield (
            f"{measure}_maps",
            partial(panels.draw_measure, cohort, analysis, shapes, views, measure),
        )
    if analysis.harmonization is not None and analysis.fitted:
        name = "sites" if analysis.registered else f"{next(iter(analysis.measured.maps))}_sites"
        yield name, partial(draw_sites, cohort, analysis)
    templates = [one.template for one in analysis.registrations.values()]
    if templates and None not in templates:
        yield "registration", partial(draw_registration, cohort, analysis)
    if shapes:
        yield "sections", partial(draw_sections, cohort, analysis, shapes)
    if analysis.pairs:
        yield "roc", partial(draw_roc, analysis)
        if any(one.full.calibration.judged for *_, one in analysis.pairs):
            yield "calibration", partial(draw_calibration, analysis)
