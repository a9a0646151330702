"""The figure of a measure: means, effects and significance, unfolded and on the surface.

A row of panels is one quantity of all sides. Surfaces are those of ``views``; how values become
colors, and how maps lie, is that of the pages (``reports.display``).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.group.cohort.data import Cohort
from hipsta_bids.group.output.results import Analysis, members_of, rows_of
from hipsta_bids.group.output.shapes import AverageShape
from hipsta_bids.group.output.views import View, across, draw_mesh, laid_out, look
from hipsta_bids.group.stats.arrays import Bool, Float, describe_known
from hipsta_bids.group.stats.glm import FittedMaps, PointTest
from hipsta_bids.group.stats.inference import Discoveries, MapKey
from hipsta_bids.reports import display
from hipsta_bids.reports.cells import DIFFERENCE, SIDES, display_name, with_brackets
from hipsta_bids.reports.display import X_ENDS, Y_ENDS, parts_of
from hipsta_bids.reports.group_maps import EFFECT_NAMES, map_id, signed_logarithm
from hipsta_bids.reports.maps import new_figure
from hipsta_bids.types import Mesh

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Widths of figures in mm, of one column of a journal's page and of two.
ONE_COLUMN, TWO_COLUMNS = 85.0, 180.0
DOTS_PER_INCH = 300
MM = DOTS_PER_INCH / 25.4  # pixels
#: Sizes of type in points: of letters of panels, of titles, and of all else.
LETTER, TITLE, SMALL = 9.0, 8.0, 7.0

# Lengths in mm.
_LEFT, _RIGHT, _TOP, _BOTTOM = 9.0, 19.0, 9.5, 5.0  # margins, with the words in them
_HEAD = 6.0  # above a row, for its title
_GAP, _BETWEEN = 1.5, 5.0  # between columns, and between sides
_VIEW_WIDTH = 0.62  # of an unfolded map's, for each view of a surface
_UPRIGHT, _LONG = 1.15, 1.7  # height of an unfolded map over its width; with head and tail
_TALLEST = 235.0  # page
_MOST_ROWS = 6
_BAR, _BAR_WIDTH = 1.5, 2.6  # distance and width of a color bar
_LARGEST = 0.94  # of the space of a view, for the surface
_RULERS, _RULER_SPACE = (10.0, 5.0, 2.0, 1.0), 15.0  # of surfaces, and on paper

_FIELD_LINE, _FOUND_LINE = 0.6, 1.3  # borders of subfields and of what survives, points
_POINT = DOTS_PER_INCH / 72  # pixels
_LETTER_WIDTH = 0.57  # of type, over its size
_UNKNOWN = 0.92  # brightness where there is no value
_HALF = 0.5
_HEAD_PIXELS = round(_HEAD * MM)
_EXTEND = dict.fromkeys(("significance", "heterogeneity", "count"), "neither")  # color bars
_EXTEND["agreement"] = "min"


Scale = Mapping[str, Any]
"""Color map and the values at its ends, as matplotlib's arguments."""
Views = dict[tuple[Any, ...], tuple[View, Bool]]
"""Views with borders of subfields, by side, direction, size, and what they are of."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Row:
    """One quantity on all sides."""

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


def spanned(colors: str, values: Mapping[str, Float]) -> Scale:
    """Colors from the 1st to the 99th percentile."""
    finite = display.known(list(values.values()))
    low, high = np.percentile(finite, (1, 99)) if len(finite) else (0.0, 1.0)
    return {"cmap": colors, "vmin": float(low), "vmax": float(high if high > low else low + 1)}


def draw_measure(
    cohort: Cohort,
    analysis: Analysis,
    shapes: Mapping[str, AverageShape],
    views: Views,
    measure: str,
) -> "list[Figure]":
    """Draw all maps of a measure: one figure, or several where they do not fit a page.

    ``views`` keeps views of the surfaces, which all measures have in common.
    """
    sides = {hemi: one for hemi, one in analysis.fitted.items() if measure in one.fits}
    blocks = [[row] for row in _means(cohort, analysis, sides, measure)]
    tests = {h: {m: fit.tests for m, fit in a.fits.items()} for h, a in analysis.fitted.items()}
    blocks += contrasts(tests, analysis.found, measure)
    return draw_pages(cohort, sides, blocks, shapes, views)


def draw_pages(
    cohort: Cohort,
    sides: Mapping[str, FittedMaps],
    blocks: Sequence[list[Row]],
    shapes: Mapping[str, AverageShape] | None = None,
    views: Views | None = None,
) -> "list[Figure]":
    """Draw rows, of which those of a block are on the same figure."""
    pages: list[list[Row]] = [[]]
    for block in blocks:
        if len(pages[-1]) + len(block) > _MOST_ROWS:
            pages.append([])
        pages[-1] += block
    shapes, views = shapes or {}, {} if views is None else views
    return [_draw_rows(cohort, sides, rows, shapes, views) for rows in pages]


def _means(
    cohort: Cohort, analysis: Analysis, sides: Mapping[str, FittedMaps], measure: str
) -> Iterator[Row]:
    """Mean maps of the groups, on one scale."""
    means: dict[str, dict[str, Float]] = {}
    counts: dict[str, dict[str, int]] = {}
    for hemi, fitted in sides.items():
        for group, member in members_of(analysis, rows_of(analysis, fitted)).items():
            _, means.setdefault(group, {})[hemi], _ = describe_known(fitted.parts(measure, member))
            counts.setdefault(group, {})[hemi] = int(member.sum())
    pair = bool(analysis.comparison.pair)
    kind = display.kind_of(measure, change=pair or set(sides) == {DIFFERENCE})
    low, high = display.scale_of(
        kind, [values for maps in means.values() for values in maps.values()]
    )
    title = "mean change" if pair else "mean"
    for index, (group, values) in enumerate(means.items()):
        n = counts[group]
        by_side = ", ".join(f"{count} {SIDES[hemi]}" for hemi, count in n.items())
        number = by_side if len(set(n.values())) > 1 else str(max(n.values()))
        visits = analysis.comparison.longitudinal
        how_many = f"{number} visits" if visits else f"n = {number}"
        yield Row(
            kind="mean",
            index=index,
            title=f"{title.capitalize()}, {group} ({how_many})",
            label=with_brackets(
                f"{title},\n{display_name(measure)}", cohort.units.get(measure, "1")
            ),
            scale={"cmap": kind.colors, "vmin": low, "vmax": high},
            values=values,
        )
    if parts_of(cohort.y) is not None:  # rims and holes, which differ, have no values
        known = {hemi: fitted.fits[measure].n for hemi, fitted in sides.items()}
        yield Row(
            kind="count",
            index=0,
            title="Sheets with a value at each point",
            label="n",
            scale={"cmap": "cividis", "vmin": 0, "vmax": max(n.max() for n in known.values())},
            values={hemi: np.where(n > 0, n, np.nan) for hemi, n in known.items()},
        )


def contrasts(
    every_test: Mapping[str, Mapping[str, Sequence[PointTest]]],
    discoveries: Mapping[MapKey, Discoveries],
    measure: str,
    like: Mapping[str, str] | None = None,
) -> Iterator[list[Row]]:
    """Effect sizes and corrected p-values of each contrast.

    Tests are those of all measures, by side and measure, which share their colors; ``like`` names
    contrasts of which other functions take these.
    """
    tests = {hemi: own[measure] for hemi, own in every_test.items() if measure in own}
    signed = {
        key: signed_logarithm(discoveries[key].adjusted, test.statistic)
        for hemi, own in tests.items()
        for test in own
        for key in [MapKey(measure, test.contrast.name, hemi)]
    }
    top = display.significance_reach(list(signed.values()))
    for index, test in enumerate(next(iter(tests.values()))):
        name = test.contrast.name
        scales = [
            display.Effects(other.kind, other.effect, other.statistic, other.df)
            for own in every_test.values()
            for some in own.values()
            for other in some
            if other.contrast.name == (like or {}).get(name, name)
        ]
        reach = display.effect_reach(scales)
        low, colors, p_colors = display.effect_colors(test.kind)
        found = {hemi: discoveries[MapKey(measure, name, hemi)] for hemi in tests}
        survive = {hemi: one.rejected for hemi, one in found.items()}
        tested = {hemi: int(np.isfinite(one.adjusted).sum()) for hemi, one in found.items()}
        uniform = len(set(tested.values())) == 1
        counts = ", ".join(
            f"{int(own.sum())} {'' if uniform else f'of {tested[hemi]} '}{SIDES[hemi]}"
            for hemi, own in survive.items()
        )
        counts += f" of {max(tested.values())} points" if uniform else ""
        yield [
            Row(
                kind="effect",
                index=index,
                title=f"Effect, {name}",
                label=EFFECT_NAMES[test.kind],
                scale={"cmap": colors, "vmin": low * reach, "vmax": reach},
                values={hemi: own[index].effect for hemi, own in tests.items()},
                survive=survive,
            ),
            Row(
                kind="significance",
                index=index,
                title=f"Significant: {counts}",
                label="corrected p" + (", signed" if low else ""),
                scale={"cmap": p_colors, "vmin": low * top, "vmax": top},
                values={hemi: signed[MapKey(measure, name, hemi)] for hemi in tests},
                survive=survive,
                level=next(iter(found.values())).alpha,
            ),
        ]


def _surface_of(
    fitted: FittedMaps, shape: AverageShape | None, hemi: str
) -> tuple[Mesh, dict[str, Float]] | None:
    """Find a surface in three dimensions, and the axes (3, 3) of its views, by name."""
    mesh = fitted.maps.mesh
    if mesh is not None and mesh.flat:
        return None
    if mesh is not None:
        along = np.linalg.svd(mesh.points - mesh.points.mean(axis=0), full_matrices=False)[2][0]
        along = along * np.sign(along[1] or 1.0)  # to anterior
    elif shape is not None:
        mesh = shape.middle
        grid = mesh.points.reshape(*fitted.maps.shape, 3)
        along = grid[:, -1].mean(axis=0) - grid[:, 0].mean(axis=0)
    else:
        return None
    lateral = np.array([1.0 if hemi == "R" else -1.0, 0.0, 0.0])
    views = {"superior": False, "inferior": True}
    return mesh, {name: across(along, lateral, below=below) for name, below in views.items()}


def _fitting(mesh: Mesh, views: Mapping[str, Float], size: tuple[int, int]) -> float:
    """Pixels per mm at which all views fit pictures of a height and width."""
    spans = [np.ptp(mesh.points @ axes.T, axis=0) for axes in views.values()]
    return float(min(_LARGEST * size[1 - i] / span[i] for span in spans for i in (0, 1)))


def _unfolded(fitted: FittedMaps) -> bool:
    """Whether maps lie on a plane: the sheet's, or that of other programs."""
    return fitted.maps.mesh is None or fitted.maps.mesh.flat


def _borders(view: View, fitted: FittedMaps) -> Bool:
    """Draw lines between subfields in a view."""
    lines = np.zeros(view.triangle.shape, dtype=bool)
    for number in range(len(fitted.maps.names)):
        region = view.region(fitted.subfield.ravel(), number)
        lines |= view.border(region, _FIELD_LINE * _POINT)
    return lines


def draw_view(
    view: View, borders: Bool, values: Float, scale: Scale, survive: Bool | None
) -> NDArray[np.uint8]:
    """Draw a map (points,) in the colors of a scale, with a line round what survives."""
    from matplotlib import colormaps  # noqa: PLC0415  (slow to load)

    pixels = view.spread(values.ravel())
    share = (pixels - scale["vmin"]) / (scale["vmax"] - scale["vmin"])
    colors = colormaps[scale["cmap"]](np.nan_to_num(share))[:, :3]
    colors[~np.isfinite(pixels)] = _UNKNOWN
    if survive is not None:
        inside = view.region(survive.ravel().astype(np.int64), 1)
        borders = borders | view.border(inside, _FOUND_LINE * _POINT)
    return view.picture(colors, borders)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Column:
    """Where the maps of one side are drawn: unfolded, or on a surface from one direction."""

    hemi: str
    fitted: FittedMaps
    box: tuple[int, int]
    """Where it begins from the left, and its width, in pixels."""
    title: str
    ends: tuple[str, ...]
    """What lies to the left and to the right."""
    seen: tuple[View, Bool] | None = None
    """Of a surface, with the borders of subfields."""


# Places on figures are pixels from the upper left corner.


def _size(figure: "Figure") -> tuple[int, int]:
    return round(figure.bbox.width), round(figure.bbox.height)


def _text(figure: "Figure", x: float, y: float, text: str, **options: Any) -> None:  # noqa: ANN401  (of matplotlib)
    options = {"ha": "center", "va": "center", "fontsize": SMALL, **options}
    width, height = _size(figure)
    figure.text(x / width, 1 - y / height, text, **options)


def _axes(figure: "Figure", left: float, top: float, width: float, height: float) -> "Axes":
    whole = _size(figure)
    box = (left / whole[0], 1 - (top + height) / whole[1])
    axes = figure.add_axes((*box, width / whole[0], height / whole[1]))
    axes.set_xticks([])
    axes.set_yticks([])
    return axes


def _draw_rows(
    cohort: Cohort,
    sides: Mapping[str, FittedMaps],
    rows: Sequence[Row],
    shapes: Mapping[str, AverageShape],
    views: Views,
) -> "Figure":
    """Draw rows of panels; all boxes are whole pixels, so that pictures are not resampled."""
    surfaces = {
        hemi: surface
        for hemi, fitted in sides.items()
        if (surface := _surface_of(fitted, shapes.get(hemi[0]), hemi[0])) is not None
    }
    page_width = TWO_COLUMNS if len(sides) > 1 and surfaces else ONE_COLUMN
    space = (page_width - _LEFT - _RIGHT - _BETWEEN * (len(sides) - 1)) / len(sides)
    n_flat, n_views = int(any(map(_unfolded, sides.values()))), 2 * bool(surfaces)
    unit = (space - _GAP * (n_flat + n_views - 1)) / (n_flat + _VIEW_WIDTH * n_views)
    tallest = (_TALLEST - _TOP - _BOTTOM) / len(rows) - _HEAD
    unit = min(unit, tallest)
    upright = _UPRIGHT if parts_of(cohort.y) is None else _LONG
    height = round(min(unit * upright, tallest) * MM)
    size = height, round(_VIEW_WIDTH * unit * MM)
    scale = min((_fitting(*surface, size) for surface in surfaces.values()), default=1.0)
    columns: list[_Column] = []
    for number, (hemi, fitted) in enumerate(sides.items()):
        left = (_LEFT + number * (space + _BETWEEN)) * MM
        if _unfolded(fitted):
            mesh = fitted.maps.mesh
            ends = X_ENDS if mesh is None else (laid_out(mesh)[2][0], "")
            box = round(left), round(unit * MM)
            columns.append(_Column(hemi=hemi, fitted=fitted, box=box, title="unfolded", ends=ends))
            left += (unit + _GAP) * MM
        for title, axes in surfaces[hemi][1].items() if hemi in surfaces else ():
            key = hemi, title, size, id(fitted)
            if key not in views:
                view = look(surfaces[hemi][0], axes, scale, size)
                views[key] = view, _borders(view, fitted)
            # The right side's lateral is to the right in the scanner, and the left one's is not.
            turned = (axes[0, 0] > 0) != (hemi == "R")
            medial, lateral = (f"{word[:3]}." for word in X_ENDS)
            ends = (lateral, medial) if turned else (medial, lateral)
            box = round(left), size[1]
            columns.append(
                _Column(hemi=hemi, fitted=fitted, box=box, title=title, ends=ends, seen=views[key])
            )
            left += size[1] + _GAP * MM
    pixels = (
        round(page_width * MM),
        round((_TOP + _BOTTOM) * MM) + len(rows) * (height + _HEAD_PIXELS),
    )
    figure = new_figure((pixels[0] / DOTS_PER_INCH, pixels[1] / DOTS_PER_INCH), layout=None)
    figure.set_dpi(DOTS_PER_INCH)
    _write_heads(figure, columns)
    for number, row in enumerate(rows):
        top = round(_TOP * MM) + _HEAD_PIXELS + number * (height + _HEAD_PIXELS)
        _draw_row(figure, cohort, columns, row, (top, height, "abcdef"[number]))
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


def _write_feet(figure: "Figure", columns: Sequence[_Column], bottom: int, scale: float) -> None:
    """Write what lies to the left and to the right, and draw a ruler for the surfaces."""
    for column in columns:
        left, width = column.box
        _text(figure, left, bottom + 2.4 * MM, column.ends[0], ha="left")
        _text(figure, left + width, bottom + 2.4 * MM, column.ends[1], ha="right")
    if any(column.seen is not None for column in columns):
        from matplotlib.lines import Line2D  # noqa: PLC0415  (slow to load)

        length = max(n for n in _RULERS if n * scale <= _RULER_SPACE * MM or n == _RULERS[-1])
        width, height = _size(figure)
        middle = width - _RIGHT * MM / 2
        x = [(middle + sign * length * scale / 2) / width for sign in (-1, 1)]
        y = 1 - (bottom + 1.4 * MM) / height
        figure.add_artist(Line2D(x, [y, y], color="black", linewidth=1.2))
        _text(figure, middle, bottom + 3.4 * MM, f"{length:g} mm")


def _draw_row(
    figure: "Figure",
    cohort: Cohort,
    columns: Sequence[_Column],
    row: Row,
    position: tuple[int, int, str],
) -> None:
    """Draw a row at a place from the top, of a height, with its letter."""
    top, height, letter = position
    _text(figure, 1.0 * MM, top - 3.2 * MM, letter, fontsize=LETTER, weight="bold", ha="left")
    room = int((_size(figure)[0] / MM - _LEFT) / (_LETTER_WIDTH * TITLE * 25.4 / 72))
    long = len(row.title) > room
    title = row.title[: room - 1] + "\N{HORIZONTAL ELLIPSIS}" if long else row.title
    _text(figure, _LEFT * MM, top - 3.2 * MM, title, fontsize=TITLE, ha="left")
    if columns[0].seen is not None or columns[0].fitted.maps.mesh is None:
        words: list[tuple[str, float, str]]
        words = [(Y_ENDS[0], top + height, "bottom"), (Y_ENDS[1], top, "top")]
        if (parts := parts_of(cohort.y)) is not None:
            middle = {name: np.flatnonzero(parts == name).mean() for name in np.unique(parts)}
            words = [
                (name, top + height * (1 - (float(at) + _HALF) / len(parts)), "center")
                for name, at in middle.items()
            ]
        for word, y, va in words:
            _text(figure, (_LEFT - 2) * MM, y, word, rotation=90, va=va)
    for column in columns:
        values, survive = row.values[column.hemi], row.survive.get(column.hemi)
        if column.seen is not None:
            picture = draw_view(*column.seen, values, row.scale, survive)
            figure.figimage(picture, column.box[0], _size(figure)[1] - top - height)
            continue
        axes = _axes(figure, column.box[0], top, column.box[1], height)
        axes.set_gid(map_id(row.kind, row.index, column.hemi))
        axes.set_facecolor(str(_UNKNOWN))
        if column.fitted.maps.mesh is None:
            _draw_sheet(axes, cohort, column.fitted, values, row.scale)
        else:
            draw_mesh(axes, column.fitted.maps.mesh, values, row.scale)
        if survive is not None:
            _enclose(axes, cohort, column.fitted, survive)
    edge = sum(columns[-1].box) + _BAR * MM
    _draw_bar(_axes(figure, edge, top, _BAR_WIDTH * MM, height), row)


def _draw_sheet(
    axes: "Axes", cohort: Cohort, fitted: FittedMaps, values: Float, scale: Mapping[str, Any]
) -> None:
    """Draw a map of the sheet, and borders and names of the most frequent subfields."""
    x, y = cohort.x, cohort.y
    fields = fitted.subfield
    edges = _beyond(x), _beyond(y)
    extent = *edges[0][[0, -1]], *edges[1][[0, -1]]
    image = values.reshape(fields.shape).T
    axes.imshow(
        image, **scale, extent=extent, origin="lower", aspect="auto", interpolation="nearest"
    )
    line: Any = {"levels": [_HALF], "colors": "black", "linewidths": _FIELD_LINE}
    for end in (-1.0, 1.0):  # of the body
        if y[0] < end < y[-1]:
            axes.axhline(end, color="black", linewidth=_FIELD_LINE, linestyle=(0, (4, 2)))
    width = axes.bbox.width * 72 / axes.figure.dpi  # points
    for number, name in enumerate(fitted.maps.names):
        field = fields == number
        if not field.any():
            continue
        if not field.all():
            axes.contour(*edges, np.pad(field, 1, mode="edge").T.astype(np.float64), **line)
        at = x[np.nonzero(field)[0]].mean()
        room = field[:, : len(y) // 3].sum() / (len(y) // 3) / len(x) * width
        upright = len(name) * _LETTER_WIDTH * SMALL > room
        axes.text(
            at, y[0], name, fontsize=SMALL, ha="center", va="bottom", rotation=90 * upright,
            bbox={"facecolor": "white", "alpha": 0.6, "edgecolor": "none", "pad": 0.6},
        )  # fmt: skip


def _enclose(axes: "Axes", cohort: Cohort, fitted: FittedMaps, survive: Bool) -> None:
    """Draw a line round the points that survive."""
    if not survive.any():
        return
    line: Any = {"levels": [_HALF], "colors": "black", "linewidths": _FOUND_LINE}
    if fitted.maps.mesh is not None:
        from matplotlib.tri import Triangulation  # noqa: PLC0415  (slow to load)

        plane, triangles, _ = laid_out(fitted.maps.mesh)
        grid = Triangulation(plane[:, 0], plane[:, 1], triangles)
        axes.tricontour(grid, survive.ravel().astype(np.float64), **line)
        return
    # Closed where it meets the edges of the sheet.
    closed = np.pad(survive.reshape(fitted.maps.shape), 1).astype(np.float64)
    axes.contour(_beyond(cohort.x), _beyond(cohort.y), closed.T, **line)


def _beyond(nodes: Float) -> Float:
    """Add the outer edges of the first and of the last cell to the nodes."""
    half = (nodes[1] - nodes[0]) / 2
    return np.concatenate([[nodes[0] - half], nodes, [nodes[-1] + half]])


def _draw_bar(axes: "Axes", row: Row) -> None:
    """Draw the color bar of a row; that of significance is marked where points survive."""
    from matplotlib.cm import ScalarMappable  # noqa: PLC0415  (slow to load)
    from matplotlib.colors import Normalize  # noqa: PLC0415

    low, high = row.scale["vmin"], row.scale["vmax"]
    signs = (-1, 1) if low else (1,)
    colors = ScalarMappable(Normalize(low, high), row.scale["cmap"])
    extend = _EXTEND.get(row.kind, "both" if low else "max")
    bar = axes.figure.colorbar(colors, cax=axes, extend=extend, extendfrac=0.06)
    if bar.solids is not None:  # an image instead, which has no seams and takes no page in memory
        bar.solids.remove()
        steps = np.linspace(low, high, 256)[:, None]
        box: Any = (0.0, 1.0, low, high)
        axes.imshow(steps, **row.scale, extent=box, origin="lower", aspect="auto")
    bar.set_label(row.label, fontsize=SMALL, labelpad=2)
    axes.tick_params(labelsize=SMALL, length=2, pad=1.5)
    if row.ticks:
        bar.set_ticks(list(row.ticks), labels=list(row.ticks.values()))
    if row.level is not None:
        ticks = {sign * at: text for at, text in display.p_ticks(row.level, high) for sign in signs}
        bar.set_ticks(list(ticks), labels=list(ticks.values()))
        for sign in signs:
            axes.axhline(-sign * np.log10(row.level), color="black", linewidth=_FOUND_LINE)
