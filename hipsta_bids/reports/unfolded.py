"""Drawings of the pages of participants: unfolded maps, and profiles.

SVG as text, because Matplotlib takes 0.3 s per hemisphere. Lengths are in points.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.reports import display, maps
from hipsta_bids.reports.maps import SHADES, Picture, SheetLayout, usual_subfields
from hipsta_bids.reports.results import Hemisphere
from hipsta_bids.types import Float

_Places = TypeVar("_Places", float, Float)

_LINE = "fill: none; stroke: #000000; stroke-width: "
_PATTERN = (
    '<pattern id="{}" width="4.2" height="4.2" patternUnits="userSpaceOnUse" patternTransform='
    '"rotate(45)"><path d="{}" stroke="#000" stroke-width="1.6"/></pattern>'
)
_HATCHES = _PATTERN.format("doubtful", "M0 0V4.2") + _PATTERN.format("filled", "M0 0V4.2M0 0H4.2")
_STYLE = """text { font: 10px sans-serif }
@media (prefers-color-scheme: dark) { .axes path { stroke: #e4e7ea !important }
text[style*="stroke: #ffffff"] { stroke: #15191d !important } }"""
_HEAD = f"<style>{_STYLE}</style><defs>{_HATCHES}</defs>"
#: Names on maps.
_NAME = "font-size: 9px; paint-order: stroke; stroke: #ffffff; stroke-width: 3px"
_PIXELS = 8  # per column, so that its edges are sharp
_MINUS = "\N{MINUS SIGN}"
_CSS = 4 / 3  # CSS pixels per point


@dataclass(frozen=True, kw_only=True)
class _Axes:
    """A rectangle of a drawing, whose edges have values."""

    left: float
    top: float
    width: float
    height: float
    x: tuple[float, float]
    y: tuple[float, float]

    def across(self, x: _Places) -> _Places:
        """Places of values of x, from the left edge of the drawing."""
        return self.left + (x - self.x[0]) / (self.x[1] - self.x[0]) * self.width

    def down(self, y: _Places) -> _Places:
        """Places of values of y, from the upper edge of the drawing."""
        return self.top + (self.y[1] - y) / (self.y[1] - self.y[0]) * self.height

    def line(self, x: Float, y: Float) -> str:
        """Write a path through points; it is interrupted where they are missing."""
        points = zip(self.across(x).tolist(), self.down(y).tolist(), strict=True)
        text = "".join(" " if np.isnan(a + b) else f"L{a:.2f},{b:.2f}" for a, b in points)
        return "".join("M" + part[1:] for part in text.split())

    def rule(self, y: float, style: str) -> str:
        """Draw a horizontal line from edge to edge."""
        return _path(f"M{self.left:.2f} {self.down(y):.2f}h{self.width:.2f}", style)

    def frame(self, bottom: str, left: str) -> Iterator[str]:
        """Draw the lower and the left edge with ticks and labels, and with their names."""
        low, right = self.top + self.height, self.left + self.width
        ticks, marks = "", []
        for value, text in _ticks(*self.x):
            x = self.across(value)
            ticks += f"M{x:.2f} {low:.2f}v3.5"
            marks.append(_text(x, low + 11, text))
        for value, text in _ticks(*self.y):
            y = self.down(value)
            ticks += f"M{self.left:.2f} {y:.2f}h-3.5"
            marks.append(_text(self.left - 6, y, text, "end"))
        edges = f"M{self.left:.2f} {self.top:.2f}V{low:.2f}H{right:.2f}{ticks}"
        yield f'<g class="axes">{_path(edges, _LINE + "0.8")}</g>' + "".join(marks)
        yield _text((self.left + right) / 2, low + 25, bottom)
        yield _text(8, self.top + self.height / 2, left, turned=True)

    def box(self, left: float, right: float, low: float, high: float) -> str:
        """Write the path of a rectangle."""
        x1, x2, y = self.across(left), self.across(right), self.down(low)
        return f"M{x1:.2f} {y:.2f}H{x2:.2f}V{self.down(high):.2f}H{x1:.2f}z"

    def clipped(self, content: str) -> str:
        """Draw the part of a drawing within the rectangle."""
        box = f"{self.left:.2f} {self.top:.2f} {self.width:.2f} {self.height:.2f}"
        places = 'x="{}" y="{}" width="{}" height="{}"'.format(*box.split())
        return f'<svg {places} viewBox="{box}">{content}</svg>'

    def image(self, address: str) -> str:
        """Draw an image that fills the rectangle."""
        return (
            f'<image x="{self.left:.2f}" y="{self.top:.2f}" width="{self.width:.2f}"'
            f' height="{self.height:.2f}" preserveAspectRatio="none" href="{address}"/>'
        )


def _path(line: str, style: str) -> str:
    return f'<path d="{line}" style="{style}"/>' if line else ""


def _text(
    x: float, y: float, text: str, anchor: str = "middle", *, turned: bool = False, style: str = ""
) -> str:
    """Write a text, centered vertically; turned, it is read from below."""
    turn = f' transform="rotate(-90 {x:.2f} {y:.2f})"' if turned else ""
    look = f"text-anchor: {anchor}; {style}"
    return f'<text x="{x:.2f}" y="{y:.2f}" dy=".35em" style="{look}"{turn}>{escape(text)}</text>'


def _ticks(low: float, high: float, count: int = 6) -> list[tuple[float, str]]:
    """Choose round numbers between two, with their texts."""
    power = 10 ** np.floor(np.log10((high - low) / count))
    step = float(
        next(n * power for n in (1, 2, 2.5, 5, 10) if round((high - low) / n / power, 6) <= count)
    )
    digits = next(n for n in range(12) if round(step * 10**n, 6).is_integer())
    first, last = round(low / step, 6), round(high / step, 6)
    numbers = range(math.ceil(first), math.floor(last) + 1)
    return [(n * step, f"{n * step:.{digits}f}".replace("-", _MINUS)) for n in numbers]


def _drawing(width: float, height: float, content: Iterable[str]) -> bytes:
    size = f'width="{width}pt" height="{height}pt" viewBox="0 0 {width} {height}"'
    svg = f'<svg xmlns="http://www.w3.org/2000/svg" {size}>{_HEAD}{"".join(content)}</svg>'
    return svg.encode()


def draw_map(
    kind: display.MapKind,
    hemispheres: Sequence[Hemisphere],
    *,
    pins: Sequence[tuple[float, float, float]] = (),
    titles: Sequence[str] = (),
) -> Picture:
    """Draw one map of hemispheres, unfolded, side by side on one color scale.

    ``pins`` are points, RAS mm, whose nearest columns in the first map become pins; ``titles``
    replace the names of the sides.
    """
    named_parts = hemispheres[0].sheet.ends is not None
    width, height = 187.2 * len(hemispheres) + 64.8, 331.2 if named_parts else 223.2
    gap, bar = (38.0, 76.0) if named_parts else (24.0, 62.0)
    room = (width - 38 - bar + gap) / len(hemispheres)
    scale = display.scale_of(kind, [h.sheet.columns[kind.column] for h in hemispheres])
    colors = display.colors_of(kind.colors, SHADES)
    names = titles or [h.side for h in hemispheres]
    content: list[str] = []
    panels: list[tuple[_Axes, SheetLayout]] = []
    for n, (name, hemisphere) in enumerate(zip(names, hemispheres, strict=True)):
        extents = [hemisphere.summary.get(f"extent_{a}", np.nan) for a in "xy"]
        layout = SheetLayout.of(hemisphere.sheet, extents)
        axes = _fit(layout, (38 + n * room, 20.0), (room - gap, height - 56))
        panels.append((axes, layout))
        values = hemisphere.sheet.columns[kind.column]
        content += _sheet(axes, layout, maps.palette_png(_pixels(layout, values, scale), colors))
        middle, left = axes.left + axes.width / 2, "" if n else "  ←  mm  →  ".join(display.Y_ENDS)
        content.append(_text(middle, axes.top - 9, name, style="font-size: 11px"))
        content += axes.frame(f"  ←  {layout.unit}  →  ".join(display.X_ENDS), left)
    label = f"{kind.title.lower()} [{kind.unit}]"
    content += _color_bar(label, scale, colors, (width - 52, 20.0, height - 40))
    means = ", ".join(
        f"{name} mean {np.nanmean(h.sheet.columns[kind.column]):.{kind.digits}f}"
        for name, h in zip(names, hemispheres, strict=True)
    )
    axes, layout = panels[0]
    places = []
    for point in pins:  # the columns nearest to them
        gaps = np.linalg.norm(layout.sheet.points["midthickness"] - np.array(point), axis=-1)
        i, j = np.unravel_index(np.nanargmin(gaps), gaps.shape)
        x, y = axes.across(layout.x[i]) / width, axes.down(layout.y[j]) / height
        places.append((round(100 * float(x), 1), round(100 * float(y), 1)))
    low, high = scale
    return Picture(
        content=_drawing(width, height, content),
        alt=f"{kind.title} on the unfolded sheet, {means} {kind.unit}, colors from {low:.3g} to"
        f" {high:.3g} {kind.unit}",
        caption=kind.title,
        width=round(width * _CSS),
        pins=tuple(places),
        maps=tuple(
            (100 * (a.left - 23) / width, 100 * (a.left + a.width + gap - 23) / width)
            for a, _ in panels
        ),
    )


def _fit(layout: SheetLayout, corner: tuple[float, float], room: tuple[float, float]) -> _Axes:
    """Fit the axes of a map, with the same scale along x and y, into the middle of a place."""
    (low, high), x = layout.limits, layout.edges[0]
    sizes = np.array([x[-1] - x[0], high - low])
    width, height = (sizes * (np.array(room) / sizes).min()).tolist()
    left, top = corner[0] + (room[0] - width) / 2, corner[1] + (room[1] - height) / 2
    return _Axes(left=left, top=top, width=width, height=height, x=(x[0], x[-1]), y=(low, high))


def _pixels(layout: SheetLayout, values: Float, scale: tuple[float, float]) -> NDArray[np.uint8]:
    """Repeat columns by their size, so that all pixels have the same size."""
    first, last = layout.rows
    nearest = []
    for edges in (layout.edges[0], layout.edges[1][first : last + 1]):
        corners = np.linspace(edges[0], edges[-1], _PIXELS * (len(edges) - 1) + 1)
        nearest.append(np.searchsorted(edges, (corners[1:] + corners[:-1]) / 2) - 1)
    return maps.shades_of(values[:, first:last][np.ix_(*nearest)], scale)


def _sheet(axes: _Axes, layout: SheetLayout, address: str) -> Iterator[str]:
    """Draw the map of one hemisphere, hatching, borders and names."""
    yield axes.image(address)
    marks = ""
    for reason, boxes in layout.hatched:
        cells = "".join(axes.box(*box) for box in boxes)
        marks += _path(cells, f"fill: url(#{reason})")
    ends = [np.transpose(line) for line in layout.borders]
    lines = "".join(axes.line(x, y) for x, y in ends)
    marks += _path(lines, _LINE.replace("#000000", "#fff") + "2.2") + _path(lines, _LINE + "1")
    for row in layout.sheet.end_rows:
        marks += axes.rule(layout.y[row], _LINE + "1; stroke-dasharray: 4 2")
    yield axes.clipped(marks)
    for x, y, name in layout.labels:
        yield _text(axes.across(x), axes.down(y), name, turned=True, style=_NAME)
    for y, name in layout.parts:
        place = axes.left + axes.width + 7
        yield _text(place, axes.down(y), name, turned=True, style="font-size: 8px")


def _color_bar(
    label: str,
    scale: tuple[float, float],
    colors: NDArray[np.str_],
    place: tuple[float, float, float],
) -> Iterator[str]:
    """Draw the colors of values at a place (left, top, height), with arrows at both ends."""
    left, top, height = place
    axes = _Axes(left=left, top=top, width=8, height=height, x=(0, 1), y=scale)
    bar = np.arange(len(colors), dtype=np.uint8)[::-1, np.newaxis]
    yield axes.image(maps.palette_png(bar, colors))
    for y, tip, color in ((top, -8, colors[-1]), (top + height, 8, colors[0])):
        yield _path(f"M{left} {y:.2f}h8l-4 {tip}z", f"fill: {color}")
    outline = f"M{left} {top}l4 -8l4 8v{height:.2f}l-4 8l-4 -8z"
    for value, text in _ticks(*scale):
        y = axes.down(value)
        outline += f"M{left + 8} {y:.2f}h3.5"
        yield _text(left + 14, y, text, "start")
    yield f'<g class="axes">{_path(outline, _LINE + "0.8")}</g>'
    yield _text(left + 46, top + height / 2, label, turned=True)


def draw_profiles(
    kind: display.MapKind, hemispheres: Sequence[Hemisphere], cohorts: Mapping[str, Float]
) -> Picture:
    """Draw a map along x: its mean over y and the range of nine tenths of the rows."""
    values_of = [h.sheet.columns[kind.column] for h in hemispheres]
    bands = [np.nanpercentile(values, [5, 95], axis=1) for values in values_of]
    # Columns next to the edges of the sheet may be far off; they must not squeeze the rest.
    low, high = np.nanpercentile(np.concatenate(bands), [3, 97]).tolist()
    spread = max(high - low, 1e-6)  # a map may have one value only
    y = low - 0.15 * spread, high + 0.2 * spread
    axes = _Axes(left=48, top=16, width=346, height=152, x=(0, 100), y=y)
    lines = axes.rule(0.0, _LINE.replace("#000000", "#999") + "0.7") if kind.centered else ""
    legend = []
    for n, (hemisphere, values, band) in enumerate(zip(hemispheres, values_of, bands, strict=True)):
        hemi = hemisphere.result.name.hemi
        x, color = np.linspace(0, 100, len(values)), display.HEMISPHERE_COLORS[hemi]
        finite = np.isfinite(band[0])
        around = (
            np.append(x[finite], x[finite][::-1]),
            np.append(band[0, finite], band[1, finite][::-1]),
        )
        line = f"fill: none; stroke: {color}; stroke-width: "
        lines = _path(axes.line(*around), f"fill: {color}; fill-opacity: 0.18") + lines
        lines += _path(axes.line(x, np.nanmean(values, axis=1)), line + "1.5")
        cohort = cohorts.get(hemi)
        if cohort is not None and len(cohort):
            for limit in np.nanpercentile(cohort, [5, 95], axis=0):
                lines += _path(axes.line(x, limit), line + "0.9; stroke-dasharray: 1.8 1.8")
        left = 394 - 62 * (len(hemispheres) - n)
        legend.append(_path(f"M{left} 26h20", line + "1.5"))
        legend.append(_text(left + 26, 26, hemisphere.side, "start", style="font-size: 9px"))
    label = f"{kind.title.lower()} [{kind.unit}]"
    content = [
        *_subfields(axes, hemispheres[0]),
        axes.clipped(lines),
        *axes.frame("  ←  % of the width  →  ".join(display.X_ENDS), label),
        *legend,
    ]
    sides = " and ".join(h.side for h in hemispheres)
    return Picture(
        content=_drawing(403.2, 208.8, content),
        alt=f"{kind.title} from medial to lateral, {sides}: mean over the rows of the sheet",
        caption=f"{kind.title} along x",
        width=round(403.2 * _CSS),
    )


def _subfields(axes: _Axes, hemisphere: Hemisphere) -> Iterator[str]:
    """Name the most frequent subfield of each x above the axes, with lines where it changes."""
    usual = usual_subfields(hemisphere.sheet.subfield.tolist())
    x = axes.across(np.linspace(0, 100, len(usual)))
    changes = [0, *(i for i in range(1, len(usual)) if usual[i] != usual[i - 1]), len(usual)]
    for start, stop in pairwise(changes):
        if start:
            line = f"M{(x[start - 1] + x[start]) / 2:.2f} {axes.top}v{axes.height}"
            yield _path(line, _LINE.replace("#000000", "#ccc") + "0.8")
        middle = float(x[start] + x[stop - 1]) / 2
        style = "font-size: 9px; fill: #4c4c4c"
        yield _text(middle, axes.top - 8, usual[start], style=style)
