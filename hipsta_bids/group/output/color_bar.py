"""Color scales of maps, and the color bars that show them."""

from collections.abc import Mapping
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np

from hipsta_bids.group.output import style
from hipsta_bids.group.output.style import LINE, MM, SMALL
from hipsta_bids.reports import display
from hipsta_bids.reports.cells import MINUS
from hipsta_bids.stats.arrays import Float

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_LABEL_LINES = 2
_PLAIN = 4  # powers of ten of numbers that are written out
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_EXTEND = dict.fromkeys(("significance", "heterogeneity", "count"), "neither")  # by kind of map
_EXTEND["agreement"] = "min"

Scale = Mapping[str, Any]
"""Color map and the values at its ends, as matplotlib's arguments."""


def spanned(colors: str, values: Mapping[str, Float]) -> Scale:
    """Colors from the 1st to the 99th percentile."""
    finite = display.known(list(values.values()))
    low, high = np.percentile(finite, (1, 99)) if len(finite) else (0.0, 1.0)
    return {"cmap": colors, "vmin": float(low), "vmax": float(high if high > low else low + 1)}


def draw_bar(
    axes: "Axes",
    scale: Scale,
    label: str,
    *,
    kind: str,
    level: float | None,
    ticks: Mapping[float, str],
) -> None:
    """Draw the color bar of maps of one kind; lines mark the level of significance."""
    from matplotlib.cm import ScalarMappable  # noqa: PLC0415  (slow to load)
    from matplotlib.colors import Normalize  # noqa: PLC0415
    from matplotlib.ticker import MaxNLocator  # noqa: PLC0415

    low, high = scale["vmin"], scale["vmax"]
    signs = (-1, 1) if low else (1,)
    colors = ScalarMappable(Normalize(low, high), scale["cmap"])
    extend = _EXTEND.get(kind, "both" if low else "max")
    bar = axes.figure.colorbar(colors, cax=axes, extend=extend, extendfrac=0.06)
    if bar.solids is not None:  # an image instead, which has no seams and takes no page in memory
        bar.solids.remove()
        steps = np.linspace(low, high, 256)[:, None]
        box: Any = (0.0, 1.0, low, high)
        axes.imshow(steps, **scale, extent=box, origin="lower", aspect="auto")
    axes.tick_params(labelsize=SMALL, length=2, pad=1.5)
    texts, power = dict(ticks), 0
    if level is not None:
        texts = {sign * at: text for at, text in display.p_ticks(level, high) for sign in signs}
        for sign in signs:
            axes.axhline(-sign * np.log10(level), color="black", linewidth=style.SIGNIFICANT_LINE)
    elif not texts:
        n = max(2, int(axes.bbox.height / (2 * LINE * MM)))
        places = MaxNLocator(min(n, 5), steps=[1, 2, 2.5, 5, 10]).tick_values(low, high)
        power = 3 * int(np.floor(np.log10(max(abs(low), abs(high), 1e-300)) / 3))
        power = 0 if -_PLAIN <= power < _PLAIN else power
        digits = max(len(f"{at / 10.0**power:.6g}".partition(".")[2]) for at in places)
        texts = {at: f"{at / 10.0**power:.{digits}f}" for at in places}
    inside = {at: text for at, text in texts.items() if low <= at <= high}
    texts = _spaced(inside, (high - low) * 0.9 * LINE * MM / axes.bbox.height, level)
    bar.set_ticks(list(texts), labels=[_tick_text(text) for text in texts.values()])
    _label_bar(axes, _with_power(label, power))


def _spaced(ticks: Mapping[float, str], gap: float, level: float | None) -> dict[float, str]:
    """Leave out ticks nearer than a gap to others, last those of the level."""
    first = f"{level:g}" if level is not None else None
    places = list[float]()
    for at in sorted(ticks, key=lambda at: (ticks[at] != first, abs(at))):
        if all(abs(at - place) >= gap for place in places):
            places.append(at)
    return {at: ticks[at] for at in sorted(places)}


def _tick_text(text: str) -> str:
    """Write a number on a color bar; powers of ten are short, so that labels have room."""
    digits, power, exponent = ("1e-04" if text == "0.0001" else text).partition("e")
    if not power or digits != "1":
        return text.replace("-", MINUS)
    return f"10{str(int(exponent)).translate(_SUPERSCRIPTS)}"


def _with_power(label: str, power: int) -> str:
    """Write the power of ten that ticks are in into the unit of a label."""
    if not power:
        return label
    number = "10" + str(power).translate(_SUPERSCRIPTS)
    start, bracket, unit = label.rpartition("[")
    return f"{start}[{number} {unit}" if bracket else f"{label} [{number}]"


def _label_bar(axes: "Axes", label: str) -> None:
    """Write the label of a color bar at the right margin, in lines that fit its height."""
    figure, place = axes.figure, axes.bbox
    letters = int(place.height / (style.LETTER_WIDTH * SMALL * style.POINT))
    lines = [part for line in label.split("\n") for part in wrap(line, max(letters, 4))]
    if len(lines) > _LABEL_LINES:
        lines = wrap(" ".join(lines), max(letters, 4))
    if len(lines) > _LABEL_LINES:
        lines = [
            *lines[: _LABEL_LINES - 1],
            lines[_LABEL_LINES - 1][: letters - 1] + style.ELLIPSIS,
        ]
    width, height = figure.bbox.width, figure.bbox.height
    figure.text(
        1 - 0.8 * MM / width, (place.y0 + place.height / 2) / height, "\n".join(lines),
        fontsize=SMALL, rotation=90, ha="right", va="center", multialignment="center",
    )  # fmt: skip
