"""Figures of the group level, in the layout of the paper."""

import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from hipsta_bids.drawing import new_figure
from hipsta_bids.group.analysis import Analysis
from hipsta_bids.group.fitted import FittedMaps
from hipsta_bids.group.glm import PointTest
from hipsta_bids.group.multiplicity import MapKey
from hipsta_bids.group_data import Cohort, Float

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Colors of groups that people who cannot tell red from green can tell (Okabe and Ito 2008).
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_DOTS_PER_INCH = 150
_SMALLEST_P = 1e-10
_SHARED = (2.0, 98.0)  # percentiles that the colors of means span


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """One figure, encoded."""

    name: str
    """File name without its extension."""
    png: bytes
    svg: bytes


def draw_figures(cohort: Cohort, analysis: Analysis) -> Iterator[Drawing]:
    """Draw all figures of one model.

    Parameters
    ----------
    cohort : Cohort
        What was analyzed.
    analysis : Analysis
        Results.

    Yields
    ------
    Drawing

    Raises
    ------
    ImportError
        Without matplotlib.
    """
    for measure in dict.fromkeys(m for one in analysis.fitted.values() for m in one.fits):
        yield _encode(f"{measure}_means", _means(cohort, analysis, measure))
        yield _encode(f"{measure}_contrasts", _contrasts(cohort, analysis, measure))
    if analysis.sides:
        yield _encode("profiles", _profiles(cohort, analysis))
    if (
        analysis.groups is not None
        and analysis.sides
        and all(side.registration.template is not None for side in analysis.sides.values())
    ):
        yield _encode("warps", _warps(cohort, analysis))
    if analysis.pairs:
        yield _encode("roc", _curves(analysis))


def _encode(name: str, figure: "Figure") -> Drawing:
    from matplotlib import rc_context  # noqa: PLC0415  (optional, slow to load)

    encoded = {}
    # The same results give the same bytes.
    with rc_context({"svg.hashsalt": "hipsta_bids", "svg.fonttype": "none"}):
        for kind, metadata in (("png", {"Software": None}), ("svg", {"Date": None})):
            buffer = io.BytesIO()
            figure.savefig(buffer, format=kind, dpi=_DOTS_PER_INCH, metadata=metadata)
            encoded[kind] = buffer.getvalue()
    return Drawing(name=name, png=encoded["png"], svg=encoded["svg"])


def _panels(rows: Sequence[str], n_columns: int, size: tuple[float, float]) -> tuple["Figure", Any]:
    """Return an empty figure with a row per hemisphere."""
    shape = (size[0] * n_columns + 0.8, size[1] * len(rows) + 0.6)
    figure = new_figure(shape, layout="constrained")
    return figure, figure.subplots(len(rows), n_columns, squeeze=False)


def _shown(analysis: Analysis, measure: str) -> Mapping[str, FittedMaps]:
    """Give hemispheres, or their difference, that have maps of a measure."""
    return {hemi: one for hemi, one in analysis.fitted.items() if measure in one.fits}


def _rows(analysis: Analysis, one: FittedMaps) -> pd.DataFrame:
    """Rows of the model's table that the sheets used belong to."""
    return analysis.compared.table.iloc[one.maps.rows[one.used]]


def _members(analysis: Analysis, table: pd.DataFrame) -> Mapping[str, Any]:
    """Tell which rows belong to each group."""
    if analysis.groups is None:
        return {"all": np.ones(len(table), dtype=bool)}
    names = table[analysis.groups.column]
    return {level: (names == level).to_numpy() for level in analysis.groups.levels}


def _means(cohort: Cohort, analysis: Analysis, measure: str) -> "Figure":
    """Draw the mean map of each group."""
    groups = analysis.groups.levels if analysis.groups else ("all",)
    shown = _shown(analysis, measure)
    figure, axes = _panels(list(shown), len(groups), (2.6, 3.6))
    means = {
        (hemi, group): mean_of_known(one.values(measure)[own], 0).reshape(one.maps.shape)
        for hemi, one in shown.items()
        for group, own in _members(analysis, _rows(analysis, one)).items()
    }
    low, high = np.nanpercentile(np.stack(list(means.values())), _SHARED)
    images: list[Any] = []
    for i, (hemi, one) in enumerate(shown.items()):
        for j, group in enumerate(groups):
            axis = axes[i, j]
            images.append(_sheet(axis, cohort, means[hemi, group], "viridis", (low, high)))
            _borders(axis, cohort, one)
            axis.set_title(f"{group}, {_side(hemi)}", fontsize=9)
    unit = cohort.units.get(measure, "1")
    figure.colorbar(images[0], ax=axes, label=f"mean {measure} [{unit}]", shrink=0.6)
    return figure


def _contrasts(cohort: Cohort, analysis: Analysis, measure: str) -> "Figure":
    """Draw effect sizes and adjusted p-values of each contrast."""
    shown = _shown(analysis, measure)
    tests = next(iter(shown.values())).fits[measure].tests
    figure, axes = _panels(list(shown), 2 * len(tests), (2.6, 3.6))
    effects = [_effect(t) for one in shown.values() for t in one.fits[measure].tests]
    reach = max(float(np.nanmax(np.abs(np.stack(effects)))), 1e-6)
    top = -np.log10(_SMALLEST_P)
    images: list[Any] = []
    for i, (hemi, one) in enumerate(shown.items()):
        for j, test in enumerate(one.fits[measure].tests):
            found = analysis.found[MapKey(measure, test.contrast.name, hemi)]
            left, right = axes[i, j], axes[i, len(tests) + j]
            shape = one.maps.shape
            images.append(
                _sheet(left, cohort, _effect(test).reshape(shape), "RdBu_r", (-reach, reach))
            )
            sign = np.sign(test.statistic)
            log = -np.log10(np.clip(found.adjusted, _SMALLEST_P, 1)) * sign
            surviving = np.where(found.rejected, log, np.nan).reshape(shape)
            images.append(_sheet(right, cohort, surviving, "PuOr_r", (-top, top)))
            for axis, what in ((left, "effect size"), (right, "significance")):
                _borders(axis, cohort, one)
                axis.set_title(f"{test.contrast.name}, {_side(hemi)}\n{what}", fontsize=9)
    figure.colorbar(
        images[0], ax=axes[:, : len(tests)], label="Cohen's d (F: partial eta squared)", shrink=0.6
    )
    figure.colorbar(
        images[1],
        ax=axes[:, len(tests) :],
        label="sign x -log10 of the adjusted p, where significant",
        shrink=0.6,
    )
    return figure


def _effect(test: PointTest) -> Float:
    return test.cohen_d if test.kind == "t" else test.eta_squared


def _side(hemi: str) -> str:
    return {"L": "left", "R": "right"}.get(hemi, "left minus right")


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
    _mark_medial(axis, cohort)
    axis.set_yticks([cohort.y[0], cohort.y[-1]], ["posterior", "anterior"], fontsize=7, rotation=90)
    lower, upper = axis.get_yticklabels()
    lower.set_verticalalignment("bottom")
    upper.set_verticalalignment("top")
    return image


def _mark_medial(axis: "Axes", cohort: Cohort) -> None:
    axis.set_xticks([cohort.x[0], cohort.x[-1]], ["medial", "lateral"], fontsize=7)
    left, right = axis.get_xticklabels()
    left.set_horizontalalignment("left")
    right.set_horizontalalignment("right")


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
                fontsize=6,
                ha="center",
                bbox={"facecolor": "white", "alpha": 0.6, "edgecolor": "none", "pad": 0.5},
            )


def _profiles(cohort: Cohort, analysis: Analysis) -> "Figure":
    """Draw means over y by group, before and after registration."""
    measures = list(next(iter(cohort.sides.values())).maps)
    figure, axes = _panels(list(analysis.sides), 2 * len(measures), (3.0, 2.4))
    for i, (hemi, side) in enumerate(analysis.sides.items()):
        original = cohort.sides[hemi]
        for j, measure in enumerate(measures):
            for k, (source, when) in enumerate(((original, "before"), (side.registered, "after"))):
                axis = axes[i, 2 * j + k]
                values = mean_of_known(source.maps[measure], 2)
                for color, (group, own) in zip(
                    _repeat_colors(),
                    _members(analysis, cohort.table.iloc[source.rows]).items(),
                    strict=False,
                ):
                    _band(axis, cohort.x, values[own], group, color)
                axis.set_title(f"{measure}, {_side(hemi)}, {when}", fontsize=9)
                axis.set_ylabel(f"[{cohort.units.get(measure, '1')}]", fontsize=7)
                _mark_medial(axis, cohort)
                axis.tick_params(labelsize=7)
    axes[0, 0].legend(fontsize=7)
    return figure


def mean_of_known(values: Float, axis: int) -> Float:
    """Mean of what is not missing; NaN where all is."""
    known = np.isfinite(values)
    total = np.where(known, values, 0.0).sum(axis=axis)
    count = known.sum(axis=axis)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _band(axis: "Axes", x: Float, values: Float, name: str, color: str) -> None:
    """Draw a mean and twice its standard error to both sides."""
    count = np.isfinite(values).sum(axis=0)
    mean = mean_of_known(values, 0)
    error = np.sqrt(mean_of_known((values - mean) ** 2, 0) / np.maximum(count, 1))
    axis.plot(x, mean, color=color, label=f"{name} (n = {len(values)})", linewidth=1.2)
    axis.fill_between(x, mean - 2 * error, mean + 2 * error, color=color, alpha=0.25, linewidth=0)


def _repeat_colors() -> Iterator[str]:
    while True:
        yield from _COLORS


def _warps(cohort: Cohort, analysis: Analysis) -> "Figure":
    """Draw displacements by group."""
    figure, axes = _panels(list(analysis.sides), 2, (3.4, 2.6))
    for i, (hemi, side) in enumerate(analysis.sides.items()):
        nodes = side.registration.warps.shape[1]
        moved = (side.registration.warps - np.linspace(0, 1, nodes)) * (nodes - 1)
        members = _members(analysis, cohort.table.iloc[side.registered.rows])
        for color, (group, own) in zip(_repeat_colors(), members.items(), strict=False):
            lines = moved[own]
            axes[i, 0].plot(cohort.x, lines.T, color=color, alpha=0.25, linewidth=0.4)
            _band(axes[i, 1], cohort.x, lines, group, color)
        for axis, what in zip(axes[i], ("each participant", "mean, 2 SE"), strict=True):
            axis.axhline(0, color="black", linewidth=0.5)
            axis.set_title(f"{_side(hemi)}, {what}", fontsize=9)
            axis.set_ylabel("shift to lateral [nodes]", fontsize=7)
            _mark_medial(axis, cohort)
            axis.tick_params(labelsize=7)
    axes[0, 1].legend(fontsize=7)
    return figure


def _curves(analysis: Analysis) -> "Figure":
    """Draw receiver operating characteristics of the first added measure."""
    first = analysis.pairs[0][1]
    shown = [(hemi, pair) for hemi, measure, pair in analysis.pairs if measure == first]
    hemis = list(dict.fromkeys(hemi for hemi, _ in shown))
    figure, axes = _panels(hemis, len(shown) // len(hemis), (3.0, 3.0))
    for axis, (hemi, pair) in zip(axes.ravel(), shown, strict=True):
        for color, (name, result) in zip(
            _COLORS,
            (("base", pair.comparison.base), (f"with {first}", pair.comparison.full)),
            strict=False,
        ):
            area = result.auc
            axis.plot(
                *_roc(result.score, pair.is_case),
                color=color,
                label=f"{name}: {area.area:.2f} ({area.low:.2f}-{area.high:.2f})",
            )
        axis.plot([0, 1], [0, 1], color="0.6", linewidth=0.5)
        where = {"L": "left", "R": "right"}.get(hemi, "both")
        axis.set_title(f"{pair.control} against {pair.case}, {where}", fontsize=9)
        axis.set_xlabel("1 - specificity", fontsize=7)
        axis.set_ylabel("sensitivity", fontsize=7)
        axis.set_aspect("equal")
        axis.tick_params(labelsize=7)
        axis.legend(fontsize=6, loc="lower right", title="area, fitted", title_fontsize=6)
    return figure


def _roc(score: Float, case: np.ndarray[Any, np.dtype[np.bool_]]) -> tuple[Float, Float]:
    """Shares of controls and of cases at or above each score."""
    cuts = np.concatenate([[np.inf], np.unique(score)[::-1]])
    controls, cases = np.sort(score[~case]), np.sort(score[case])
    above = [1 - np.searchsorted(part, cuts) / len(part) for part in (controls, cases)]
    return above[0], above[1]
