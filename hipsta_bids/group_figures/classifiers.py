"""How well groups are told apart: receiver operating characteristics and calibration."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Literal

from hipsta_bids.group.analysis import Analysis
from hipsta_bids.group.classification import ClassifierResult
from hipsta_bids.group.pairs import PairComparison
from hipsta_bids.group.roc import roc_curve
from hipsta_bids.group_figures.panels import COLORS, LABEL, SMALL, TITLE, panels, spelled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_Place = Literal["lower right", "upper left"]
_PANEL = (3.1, 3.2)  # inches
_SIDES = {"L": "left", "R": "right"}


def draw_roc(analysis: Analysis) -> "Figure":
    """Draw the curves of the first added measure."""
    figure, axes = panels(*_shape(analysis), _PANEL)
    for axis, pair in _pairs(analysis, axes):
        for color, name, result in _models(analysis, pair):
            area, validation = result.auc, result.cross_validation
            text = f"{name}: {area.area:.2f} ({area.low:.2f}-{area.high:.2f})"
            text += f"\nleft out: {validation.auc:.2f}"
            curve = roc_curve(result.score, pair.is_case)
            axis.plot(*curve, color=color, label=text, linewidth=1.2)
        title = "area, participants fitted and left out"
        _finish(axis, ("1 - specificity", "sensitivity"), title, "lower right")
    return figure


def draw_calibration(analysis: Analysis) -> "Figure":
    """Draw predicted chances, cross-validated, against what happened."""
    figure, axes = panels(*_shape(analysis), _PANEL)
    for axis, pair in _pairs(analysis, axes):
        for color, name, result in _models(analysis, pair):
            found = result.calibration
            text = f"{name}: {found.slope:.2f}, {found.brier:.2f}"
            axis.plot(found.predicted, found.observed, "o-", color=color, label=text, markersize=3)
        labels = ("predicted chance, cross-validated", "share of cases")
        _finish(axis, labels, "slope, Brier score", "upper left")
    return figure


def _shape(analysis: Analysis) -> tuple[int, int]:
    hemis, pairs = _names(analysis)
    return len(pairs), len(hemis)


def _names(analysis: Analysis) -> tuple[list[str], list[tuple[str, str]]]:
    hemis = list(dict.fromkeys(hemi for hemi, _, _ in analysis.pairs))
    pairs = list(dict.fromkeys((pair.control, pair.case) for _, _, pair in analysis.pairs))
    return hemis, pairs


def _pairs(analysis: Analysis, axes: Any) -> Iterator[tuple["Axes", PairComparison]]:  # noqa: ANN401  (of matplotlib)
    """Give the first added measure of each pair and hemisphere, with its panel."""
    hemis, pairs = _names(analysis)
    first: dict[tuple[str, str, str], PairComparison] = {}
    for hemi, _, pair in analysis.pairs:
        first.setdefault((hemi, pair.control, pair.case), pair)
    for i, (control, case) in enumerate(pairs):
        for j, hemi in enumerate(hemis):
            axis = axes[i, j]
            if (hemi, control, case) not in first:
                axis.set_axis_off()
                continue
            pair = first[hemi, control, case]
            how = "\n(separated: Firth's method)" if pair.comparison.separated else ""
            side = _SIDES.get(hemi, "both sides")
            axis.set_title(f"{control} against {case}, {side}{how}", fontsize=TITLE)
            axis.plot([0, 1], [0, 1], color="0.6", linewidth=0.5)
            yield axis, pair


def _models(
    analysis: Analysis, pair: PairComparison
) -> Iterator[tuple[str, str, ClassifierResult]]:
    added = next(measure for _, measure, other in analysis.pairs if other is pair)
    yield COLORS[0], "base", pair.comparison.base
    yield COLORS[1], f"with {spelled(added)}", pair.comparison.full


def _finish(axis: "Axes", labels: tuple[str, str], title: str, place: _Place) -> None:
    axis.set_xlabel(labels[0], fontsize=LABEL)
    axis.set_ylabel(labels[1], fontsize=LABEL)
    axis.set_aspect("equal")
    axis.tick_params(labelsize=LABEL)
    axis.legend(fontsize=SMALL, loc=place, title=title, title_fontsize=SMALL)
