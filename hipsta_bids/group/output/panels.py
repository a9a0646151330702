"""Figures of maps: rows of panels, unfolded and on the surface, with one color bar for each row.

A row of panels is one quantity of all sides. Surfaces are those of ``views``; how values become
colors, and how maps lie, is that of the pages (``reports.display``).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.group.output import style
from hipsta_bids.group.output.color_bar import Scale, draw_bar
from hipsta_bids.group.output.ground import Ground, beyond, middles_of
from hipsta_bids.group.output.style import DOTS_PER_INCH, LETTER, MM, SMALL, TITLE
from hipsta_bids.group.output.views import View, across, draw_mesh, flat_layout, look
from hipsta_bids.reports.display import X_ENDS, Y_ENDS
from hipsta_bids.reports.group_maps import map_id
from hipsta_bids.reports.maps import new_figure
from hipsta_bids.stats.arrays import Bool, Float
from hipsta_bids.types import SIDES, Mesh, parts_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Text

# Lengths in mm.
_LEFT, _RIGHT, _TOP, _BOTTOM = 9.0, 20.5, 9.5, 5.0  # margins, with the words in them
_SPACE = 0.8  # between words
_HEAD = 6.0  # above a row, for its title
_GAP, _BETWEEN = 1.5, 5.0  # between columns, and between sides
_VIEW_WIDTH = 0.62  # of an unfolded map's, for each view of a surface
_LEAST_VIEW = 11.5  # width of a view below which its title does not fit: there are none then
_UPRIGHT, _LONG = 1.15, 1.7  # height of an unfolded map over its width; with head and tail
_LEAST_ENDS = 18.0  # width of an unfolded map that has whole words for its ends
_LEAST_HEIGHT = 27.0  # of a row that has whole words for its ends
_TALLEST = 235.0  # page
_BAR, _BAR_WIDTH = 1.5, 2.6  # distance and width of a color bar
_LARGEST = 0.94  # of the space of a view, for the surface
_RULERS = (10.0, 5.0, 2.0, 1.0)  # of surfaces

_FIELD_LINE = 0.6  # borders of subfields, points
_UNKNOWN = 0.92  # brightness where there is no value
_HALF = 0.5
_HEAD_PIXELS = round(_HEAD * MM)
#: Rows of a figure.
MOST_ROWS = 6

Views = dict[tuple[Any, ...], tuple[View, Bool]]
"""Views with borders of subfields, by direction, size, and what they are of."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Row:
    """One quantity on some sides."""

    kind: str
    """``mean``, ``effect``, ``significance``, or another that has no place in the page's data."""
    index: int
    """Of the group, or of the contrast."""
    title: str
    label: str
    """Of the color bar."""
    scale: Scale
    values: Mapping[str, Float]
    """(points,) by side."""
    survive: Mapping[str, Bool] = field(default_factory=dict)
    """(points,) by side; empty where nothing is tested."""
    level: float | None = None
    """Of significance, on maps of it."""
    ticks: Mapping[float, str] = field(default_factory=dict)
    """Positions and texts on the color bar, where it is not to choose them."""
    grounds: Mapping[str, Ground] = field(default_factory=dict)
    """By side, where unfolded maps lie on others than the maps of other rows."""


def draw_pages(
    sides: Mapping[str, Ground],
    blocks: Sequence[list[Row]],
    *,
    views: Views | None = None,
    width: float | None = None,
    widest: float | None = None,
    dpi: float = DOTS_PER_INCH,
) -> "list[Figure]":
    """Draw rows; the rows of a block are on one figure.

    ``views`` keeps views of surfaces for the next call. ``width`` is the width of figures in mm;
    ``widest`` is an upper limit for figures that are as narrow as their height allows. Pictures of
    surfaces have ``dpi`` dots per inch.
    """
    pages: list[list[Row]] = [[]]
    for block in blocks:
        if len(pages[-1]) + len(block) > MOST_ROWS:
            pages.append([])
        pages[-1] += block
    views = {} if views is None else views
    return [_draw_rows(sides, rows, views, (width, widest), dpi) for rows in pages]


def _axes_of(mesh: Mesh, shape: tuple[int, ...], hemi: str, *, sheet: bool) -> dict[str, Float]:
    """Find the axes (3, 3) of the views of a surface, by name."""
    if sheet:
        grid = mesh.points.reshape(*shape, 3)
        along = grid[:, -1].mean(axis=0) - grid[:, 0].mean(axis=0)
    else:
        along = np.linalg.svd(mesh.points - mesh.points.mean(axis=0), full_matrices=False)[2][0]
        along = along * np.sign(along[1] or 1.0)  # to anterior
    lateral = np.array([1.0 if hemi == "R" else -1.0, 0.0, 0.0])
    views = {"superior": False, "inferior": True}
    return {name: across(along, lateral, below=below) for name, below in views.items()}


def _fitting(mesh: Mesh, views: Mapping[str, Float], size: tuple[int, int]) -> float:
    """Pixels per mm at which all views fit pictures of a height and width."""
    spans = [np.ptp(mesh.points @ axes.T, axis=0) for axes in views.values()]
    return float(min(_LARGEST * size[1 - i] / span[i] for span in spans for i in (0, 1)))


def _borders(view: View, ground: Ground, point: float) -> Bool:
    """Draw lines between subfields in a view, whose pixels per point are given."""
    lines = np.zeros(view.triangle.shape, dtype=bool)
    for number in range(len(ground.names)):
        region = view.region(ground.subfield.ravel(), number)
        lines |= view.border(region, _FIELD_LINE * point)
    return lines


def draw_view(
    view: View,
    borders: Bool,
    values: Float,
    scale: Scale,
    survive: Bool | None,
    *,
    point: float = style.POINT,
) -> NDArray[np.uint8]:
    """Draw a map (points,) in the colors of a scale, with a line round what survives.

    ``point`` is the pixels per point of type.
    """
    from matplotlib import colormaps  # noqa: PLC0415  (slow to load)

    pixels = view.spread(values.ravel())
    share = (pixels - scale["vmin"]) / (scale["vmax"] - scale["vmin"])
    colors = colormaps[scale["cmap"]](np.nan_to_num(share))[:, :3]
    colors[~np.isfinite(pixels)] = _UNKNOWN
    if survive is not None:
        inside = view.region(survive.ravel().astype(np.int64), 1)
        borders = borders | view.border(inside, style.SIGNIFICANT_LINE * point)
    return view.picture(colors, borders)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Column:
    """Where the maps of one side are drawn: unfolded, or on a surface from one direction."""

    hemi: str
    ground: Ground
    box: tuple[int, int]
    """Where it begins from the left, and its width, in pixels."""
    title: str
    ends: tuple[str, ...]
    """What lies to the left and to the right."""
    seen: tuple[View, Bool] | None = None
    """Of a surface, with the borders of subfields."""


@dataclass(frozen=True, kw_only=True)
class _Viewer:
    """Draws surfaces with the borders of subfields, each view once."""

    views: Views
    scale: float
    size: tuple[int, int]
    dpi: float

    def look(self, mesh: Mesh, axes: Float, ground: Ground) -> tuple[View, Bool]:
        """Draw a surface from the direction of ``axes``."""
        options = axes.tobytes(), self.size, self.scale, self.dpi
        key = *options, mesh.points.tobytes(), ground.subfield.tobytes()
        if key not in self.views:
            share = self.dpi / DOTS_PER_INCH
            size = round(self.size[0] * share), round(self.size[1] * share)
            view = look(mesh, axes, self.scale * share, size)
            self.views[key] = view, _borders(view, ground, self.dpi / 72)
        return self.views[key]


# Places on figures are pixels from the upper left corner.


def _size(figure: "Figure") -> tuple[int, int]:
    return round(figure.bbox.width), round(figure.bbox.height)


def _text(figure: "Figure", x: float, y: float, text: str, **options: Any) -> "Text":  # noqa: ANN401  (of matplotlib)
    options = {"ha": "center", "va": "center", "fontsize": SMALL, **options}
    width, height = _size(figure)
    return figure.text(x / width, 1 - y / height, text, **options)


def _axes(figure: "Figure", left: float, top: float, width: float, height: float) -> "Axes":
    whole = _size(figure)
    box = (left / whole[0], 1 - (top + height) / whole[1])
    axes = figure.add_axes((*box, width / whole[0], height / whole[1]))
    axes.set_xticks([])
    axes.set_yticks([])
    return axes


def _surfaces(
    sides: Mapping[str, Ground],
) -> Iterator[tuple[str, tuple[Mesh, Mapping[str, Float]]]]:
    for hemi, ground in sides.items():
        if (mesh := ground.folded) is not None:
            is_sheet = ground.mesh is None
            yield hemi, (mesh, _axes_of(mesh, ground.subfield.shape, hemi[0], sheet=is_sheet))


def _unfolded_column(hemi: str, ground: Ground, left: float, width: float) -> _Column:
    ends = X_ENDS if ground.mesh is None else flat_layout(ground.mesh)[1]
    box = round(left), round(width)
    return _Column(hemi=hemi, ground=ground, box=box, title="unfolded", ends=ends)


def _view_columns(
    hemi: str,
    ground: Ground,
    surface: tuple[Mesh, Mapping[str, Float]],
    left: float,
    viewer: _Viewer,
) -> Iterator[_Column]:
    """Place the views of a surface side by side, from ``left``, pixels."""
    mesh, axes_of = surface
    medial, lateral = (f"{word[:3]}." for word in X_ENDS)
    for title, axes in axes_of.items():
        # The right side's lateral is to the right in the scanner, and the left one's is not.
        turned = (axes[0, 0] > 0) != (hemi == "R")
        ends = (lateral, medial) if turned else (medial, lateral)
        seen = viewer.look(mesh, axes, ground)
        box = round(left), viewer.size[1]
        yield _Column(hemi=hemi, ground=ground, box=box, title=title, ends=ends, seen=seen)
        left += viewer.size[1] + _GAP * MM


def _draw_rows(
    sides: Mapping[str, Ground],
    rows: Sequence[Row],
    views: Views,
    widths: tuple[float | None, float | None],
    dpi: float,
) -> "Figure":
    """Draw rows of panels; all boxes are whole pixels, so that pictures are not resampled."""
    width, limit = widths
    surfaces = dict(_surfaces(sides))
    usual = (style.ONE_COLUMN, style.TWO_COLUMNS)[min(len(sides) - 1, len(surfaces), 1)]
    page_width = width or limit or usual
    space = (page_width - _LEFT - _RIGHT - _BETWEEN * (len(sides) - 1)) / len(sides)
    n_flat = int(any(ground.unfolded for ground in sides.values()))

    def widest(n_views: int) -> float:
        return (space - _GAP * (n_flat + n_views - 1)) / (n_flat + _VIEW_WIDTH * n_views)

    if n_flat and _VIEW_WIDTH * widest(2) < _LEAST_VIEW:
        surfaces = {}
    unit = widest(2 * bool(surfaces))
    upright = _UPRIGHT if all(parts_of(ground.y) is None for ground in sides.values()) else _LONG
    feet = _feet_height(sides, unit)
    tallest = (_TALLEST - _TOP - feet) / len(rows) - _HEAD
    unit = min(unit, max(tallest, _LEAST_VIEW / _VIEW_WIDTH))
    if width is None:  # no space is left next to maps of limited height
        unused = (widest(2 * bool(surfaces)) - unit) * (n_flat + 2 * _VIEW_WIDTH * bool(surfaces))
        space, page_width = space - unused, page_width - unused * len(sides)
    height = round(min(unit * upright, tallest) * MM)
    size = height, round(_VIEW_WIDTH * unit * MM)
    scale = min((_fitting(*surface, size) for surface in surfaces.values()), default=1.0)
    viewer = _Viewer(views=views, scale=scale, size=size, dpi=dpi)
    columns: list[_Column] = []
    for number, (hemi, ground) in enumerate(sides.items()):
        left = (_LEFT + number * (space + _BETWEEN)) * MM
        if ground.unfolded:
            columns.append(_unfolded_column(hemi, ground, left, unit * MM))
            left += (unit + _GAP) * MM
        if hemi in surfaces:
            columns += _view_columns(hemi, ground, surfaces[hemi], left, viewer)
    pixels = (
        round(page_width * MM),
        round((_TOP + feet) * MM) + len(rows) * (height + _HEAD_PIXELS),
    )
    figure = new_figure((pixels[0] / DOTS_PER_INCH, pixels[1] / DOTS_PER_INCH), layout=None)
    figure.set_dpi(DOTS_PER_INCH)
    _write_heads(figure, columns)
    for number, row in enumerate(rows):
        top = round(_TOP * MM) + _HEAD_PIXELS + number * (height + _HEAD_PIXELS)
        _draw_row(
            figure, columns, row, (top, height, style.LETTERS[number % len(style.LETTERS)]), dpi
        )
    _write_feet(figure, columns, top + height, scale)
    return figure


def _write_heads(figure: "Figure", columns: Sequence[_Column]) -> None:
    """Name sides and columns."""
    for hemi in dict.fromkeys(column.hemi for column in columns):
        boxes = [column.box for column in columns if column.hemi == hemi]
        middle = (boxes[0][0] + sum(boxes[-1])) / 2
        _text(figure, middle, 3.4 * MM, SIDES[hemi].capitalize(), fontsize=TITLE, weight="bold")
    for column in columns:
        left, width = column.box
        _text(figure, left + width / 2, 7.6 * MM, column.title)


def _feet_height(sides: Mapping[str, Ground], unit: float) -> float:
    """Return the mm below the last row: names of subfields, ends, and the ruler."""
    lines = [
        _longest(ground) if _upright(ground, unit) else style.LINE
        for ground in sides.values()
        if ground.mesh is None and ground.names
    ]
    return _BOTTOM + max(
        lines, default=0.0 if all(s.unfolded for s in sides.values()) else style.LINE
    )


def _longest(ground: Ground) -> float:
    """Return the mm that the longest name of a subfield takes."""
    return _length(max(ground.names, key=len), 1.2) + _SPACE


def _upright(ground: Ground, width: float) -> bool:
    """Whether names of subfields have to stand, so that they fit a width in mm."""
    places = middles_of(ground)
    sizes = {name: _length(name) for name in places}
    names = list(places)
    gaps = [
        (places[b] - places[a]) * width - (sizes[a] + sizes[b]) / 2 - _SPACE
        for a, b in pairwise(names)
    ]
    return bool(names) and (min(gaps, default=1.0) < 0 or max(sizes.values()) > width / 2)


def _length(text: str, margin: float = 1.15) -> float:
    """Return the mm of a short text, with a margin for wide letters."""
    return len(text) * style.LETTER_WIDTH * margin * SMALL * 25.4 / 72


def _apart(places: Sequence[float], gap: float, width: float) -> list[float]:
    """Move places (ascending) as little as needed to be a gap apart, inside a width."""
    moved = list(places)
    for _ in range(2):
        for i in range(1, len(moved)):
            moved[i] = max(moved[i], moved[i - 1] + gap)
        over = moved[-1] - (width - gap / 2) if moved else 0.0
        if over > 0:
            moved[-1] -= over
        for i in range(len(moved) - 2, -1, -1):
            moved[i] = min(moved[i], moved[i + 1] - gap)
    return moved


def _write_feet(figure: "Figure", columns: Sequence[_Column], bottom: int, scale: float) -> None:
    """Write subfields and what lies to the left and to the right; draw a ruler for surfaces."""
    units = [column.box[1] / MM for column in columns if column.seen is None]
    grounds = {column.hemi: column.ground for column in columns}
    feet = _feet_height(grounds, min(units, default=1.0)) - _BOTTOM
    for column in columns:
        left, width = column.box
        line = bottom + 2.4 * MM
        if column.seen is None and column.ground.mesh is None and column.ground.names:
            _write_subfields(figure, column, bottom)
            line += feet * MM
        ends = column.ends
        if column.seen is None and width < _LEAST_ENDS * MM:
            ends = tuple(word[:3] + "." for word in filter(None, ends))
        for x, end, side in zip((left, left + width), ends, ("left", "right"), strict=False):
            _text(figure, x, line, end, ha=side)
    if views := [column for column in columns if column.seen is not None]:
        _draw_ruler(figure, views[-1].box, bottom + (2.4 + max(feet, style.LINE)) * MM, scale)


def _draw_ruler(figure: "Figure", box: tuple[int, int], y: float, scale: float) -> None:
    """Draw a ruler that ends at the right of a box and takes at most half of it."""
    from matplotlib.lines import Line2D  # noqa: PLC0415  (slow to load)

    left, wide = box
    length = next((n for n in _RULERS if n * scale <= wide * _HALF), _RULERS[-1])
    width, height = _size(figure)
    line_ends = [(left + wide - n * scale) / width for n in (length, 0)]
    figure.add_artist(Line2D(line_ends, [1 - y / height] * 2, color="black", linewidth=1.2))
    _text(figure, line_ends[0] * width - MM, y, f"{length:g} mm", ha="right")


def _write_subfields(figure: "Figure", column: _Column, bottom: int) -> None:
    """Name subfields below a sheet, at their places."""
    left, width = column.box
    places = middles_of(column.ground)
    upright = _upright(column.ground, width / MM)
    middles = [place * width for place in places.values()]
    if upright:
        middles = _apart(middles, 0.9 * style.LINE * MM, width)
    for name, x in zip(places, middles, strict=True):
        y = bottom + (0.5 if upright else 0.9) * MM
        _text(figure, left + x, y, name, va="top", rotation=90 * upright)


def _draw_row(
    figure: "Figure",
    columns: Sequence[_Column],
    row: Row,
    position: tuple[int, int, str],
    dpi: float,
) -> None:
    """Draw a row at a place from the top, of a height, with its letter."""
    top, height, letter = position
    _text(figure, 1.0 * MM, top - 3.2 * MM, letter, fontsize=LETTER, weight="bold", ha="left")
    _write_title(figure, top, row.title)
    ground = columns[0].ground
    if columns[0].seen is not None or ground.mesh is None:
        short = height < _LEAST_HEIGHT * MM
        ends = [f"{word[: 3 if word[0] == 'a' else 4]}." if short else word for word in Y_ENDS]
        words: list[tuple[str, float, str]]
        words = [(ends[0], top + height, "bottom"), (ends[1], top, "top")]
        if (parts := parts_of(ground.y)) is not None:
            middle = {name: np.flatnonzero(parts == name).mean() for name in np.unique(parts)}
            words = [
                (name, top + height * (1 - (float(at) + _HALF) / len(parts)), "center")
                for name, at in middle.items()
            ]
        for word, y, va in words:
            _text(figure, (_LEFT - 2) * MM, y, word, rotation=90, va=va)
    for column in columns:
        if column.hemi not in row.values:
            continue
        values, survive = row.values[column.hemi], row.survive.get(column.hemi)
        ground = row.grounds.get(column.hemi, column.ground)
        if column.seen is not None:
            picture = draw_view(*column.seen, values, row.scale, survive, point=dpi / 72)
            style.place_picture(figure, picture, (column.box[0], top, column.box[1], height))
            continue
        axes = _axes(figure, column.box[0], top, column.box[1], height)
        axes.set_gid(map_id(row.kind, row.index, column.hemi))
        axes.set_facecolor(str(_UNKNOWN))
        if ground.mesh is None:
            _draw_sheet(axes, ground, values, row.scale)
        else:
            draw_mesh(axes, ground.mesh, values, row.scale)
        if survive is not None:
            _enclose(axes, ground, survive)
    edge = sum(columns[-1].box) + _BAR * MM
    draw_bar(
        _axes(figure, edge, top, _BAR_WIDTH * MM, height),
        row.scale,
        row.label,
        kind=row.kind,
        level=row.level,
        ticks=row.ticks,
    )


def _write_title(figure: "Figure", top: int, words: str) -> None:
    """Write the title of a row; what follows a semicolon is a second line if one is too long."""
    room = _size(figure)[0] - (_LEFT + 1) * MM
    title = _text(figure, _LEFT * MM, top - 3.2 * MM, words, fontsize=TITLE, ha="left")
    first, semicolon, second = words.partition("; ")
    if semicolon and style.width_of(title) > room:
        title.remove()
        title = _text(figure, _LEFT * MM, top - 4.5 * MM, first, fontsize=TITLE, ha="left")
        style.fit_text(_text(figure, _LEFT * MM, top - 1.6 * MM, second, ha="left"), room)
    style.fit_text(title, room)


def _draw_sheet(axes: "Axes", ground: Ground, values: Float, scale: Mapping[str, Any]) -> None:
    """Draw a map of the sheet, and borders of the most frequent subfields."""
    x, y = ground.x, ground.y
    fields = ground.subfield
    edges = beyond(x), beyond(y)
    extent = *edges[0][[0, -1]], *edges[1][[0, -1]]
    image = values.reshape(fields.shape).T
    axes.imshow(
        image, **scale, extent=extent, origin="lower", aspect="auto", interpolation="nearest"
    )
    for end in (-1.0, 1.0):  # of the body
        if y[0] < end < y[-1]:
            axes.axhline(end, color="black", linewidth=_FIELD_LINE, linestyle=(0, (4, 2)))
    from matplotlib.collections import LineCollection  # noqa: PLC0415  (slow to load)

    axes.add_collection(LineCollection(ground.borders, colors="black", linewidths=_FIELD_LINE))


def _enclose(axes: "Axes", ground: Ground, survive: Bool) -> None:
    """Draw a line round the points that survive."""
    if not survive.any():
        return
    line: Any = {"levels": [_HALF], "colors": "black", "linewidths": style.SIGNIFICANT_LINE}
    if ground.mesh is not None:
        from matplotlib.tri import Triangulation  # noqa: PLC0415  (slow to load)

        plane = flat_layout(ground.mesh)[0]
        grid = Triangulation(plane[:, 0], plane[:, 1], ground.mesh.triangles)
        axes.tricontour(grid, survive.ravel().astype(np.float64), **line)
        return
    # Closed where it meets the edges of the sheet.
    closed = np.pad(survive.reshape(ground.subfield.shape), 1).astype(np.float64)
    axes.contour(beyond(ground.x), beyond(ground.y), closed.T, **line)
