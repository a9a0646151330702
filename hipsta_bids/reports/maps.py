"""Static figures by matplotlib, without a screen: unfolded maps, profiles, and tiles of maps."""

import atexit
import base64
import contextlib
import io
import os
import re
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import cycle, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.derivatives.results import read_sheet
from hipsta_bids.errors import InputError
from hipsta_bids.io.files import scratch_folder
from hipsta_bids.reports.display import (
    HEMISPHERE_COLORS,
    MAP_KINDS,
    X_ENDS,
    Y_ENDS,
    MapKind,
    colors_of,
    gradient_of,
    scale_of,
)
from hipsta_bids.reports.results import SIDES, Hemisphere, SheetTable
from hipsta_bids.types import Float

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: What a user may have in the environment that would change figures.
_PREFERENCES = ("MPLBACKEND", "MATPLOTLIBRC")

_STYLE: Any = {
    "font.family": "sans-serif",
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "hatch.linewidth": 0.7,
    "svg.fonttype": "none",
    "svg.hashsalt": "hipsta_bids",
}

_SVG_TAG = re.compile(rb"<svg[^>]*>")
#: Style of drawings in a dark page. Lines on maps stay as they are: colors are behind them.
_DARK = b"""<style>@media (prefers-color-scheme: dark) {
text { fill: #e4e7ea } text[style*="fill: #4c4c4c"] { fill: #a7b0ba !important }
[style*="fill: #ffffff"] { fill: #15191d !important }
:is([id^="matplotlib.axis"], [id^="patch"], [id^="figure"] > [id^="line2d"])
[style*="stroke: #000000"] { stroke: #e4e7ea !important } }</style>"""

# Tiles: many small maps in one picture, of which a browser shows a part each.
_COLUMNS = 20  # side by side
_COLORS = 128  # shades; one more stands for missing values
_MISSING = (217, 217, 217)
_FULL_SIZE = 1500  # tiles; of more, each has a quarter of the pixels, so that pages stay small


def new_figure(
    size: tuple[float, float], layout: Literal["constrained", "compressed"] | None
) -> "Figure":
    """Return an empty figure; it needs no screen and no home folder."""
    with contextlib.nullcontext() if "matplotlib" in sys.modules else _empty_settings():
        from matplotlib.figure import Figure  # noqa: PLC0415  (slow to load)

    return Figure(figsize=size, layout=layout)


@contextlib.contextmanager
def _empty_settings() -> Iterator[None]:
    """Let matplotlib load with a temporary folder, which is removed when this process ends.

    It keeps a list of fonts in the user's home, which may be missing or read-only in containers
    and on clusters, and would read that user's preferences there.
    """
    folder = str(scratch_folder("fonts"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    before = {name: os.environ.pop(name, None) for name in (*_PREFERENCES, "MPLCONFIGDIR")}
    os.environ["MPLCONFIGDIR"] = folder
    try:
        yield
    finally:
        del os.environ["MPLCONFIGDIR"]
        os.environ.update({name: value for name, value in before.items() if value is not None})


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A figure in a page."""

    content: bytes
    """The drawing, SVG."""
    alt: str
    caption: str
    width: int
    """CSS pixels at which its letters have their size."""
    pins: tuple[tuple[float, float], ...] = ()
    """Places in it, percent from its left and upper edge."""
    maps: tuple[tuple[float, float], ...] = ()
    """Left and right end of each map with the numbers next to it, percent from its left edge."""

    @property
    def address(self) -> str:
        """Data address; in a dark page, white is dark and black is light."""
        content = _SVG_TAG.sub(rb"\g<0>" + _DARK, self.content, count=1)
        return "data:image/svg+xml;base64," + base64.b64encode(content).decode()


def draw_map(
    kind: MapKind,
    hemispheres: Sequence[Hemisphere],
    *,
    pins: Sequence[tuple[float, float, float]] = (),
    titles: Sequence[str] = (),
) -> Picture:
    """Draw one map of hemispheres, unfolded, side by side on one color scale.

    ``pins`` are points, RAS mm, whose nearest columns in the first map become pins; ``titles``
    replace the names of the sides.
    """
    height = 3.1 if hemispheres[0].sheet.ends is None else 4.6
    figure, axes = _new_figure(1, len(hemispheres), (2.6 * len(hemispheres) + 0.9, height))
    low, high = scale_of(kind, [h.sheet.columns[kind.column] for h in hemispheres])
    image: Any = None
    for axis, hemisphere in zip(axes[0], hemispheres, strict=True):
        extents = [hemisphere.summary.get(f"extent_{a}", np.nan) for a in "xy"]
        hemi = hemisphere.result.name.hemi
        image = draw_sheet(axis, hemisphere.sheet, kind, (low, high), extents=extents, hemi=hemi)
    for axis, title in zip(axes[0], titles, strict=False):
        axis.set_title(title)
    axes[0, 0].set_ylabel("  ←  mm  →  ".join(Y_ENDS))
    figure.colorbar(
        image, ax=list(axes[0]), label=f"{kind.title.lower()} [{kind.unit}]", extend="both"
    )
    names = titles or [h.side for h in hemispheres]
    means = ", ".join(
        f"{name} mean {np.nanmean(h.sheet.columns[kind.column]):.{kind.digits}f}"
        for name, h in zip(names, hemispheres, strict=True)
    )
    picture = _encode(
        figure,
        alt=f"{kind.title} on the unfolded sheet, {means} {kind.unit}, colors from {low:.3g} to"
        f" {high:.3g} {kind.unit}",
        caption=kind.title,
    )
    places = [axis.get_position() for axis in axes[0]]
    gap = min((b.x0 - a.x1 for a, b in pairwise(places)), default=0.0) - 0.015
    shares = tuple((100 * (box.x0 - gap), 100 * (box.x1 + 0.01)) for box in places)
    picture = replace(picture, maps=shares)
    if not pins:
        return picture
    return replace(picture, pins=tuple(_pins(axes[0, 0], hemispheres[0].sheet, pins)))


def _pins(
    axis: "Axes", sheet: SheetTable, points: Sequence[tuple[float, float, float]]
) -> Iterator[tuple[float, float]]:
    """Find the columns nearest to points in a map that was drawn, percent of its figure."""
    corners = axis.collections[0].get_coordinates()  # type: ignore[attr-defined]  # of a mesh
    to_shares = axis.transData - axis.figure.transFigure
    for point in points:
        gaps = np.linalg.norm(sheet.points["midthickness"] - np.array(point), axis=-1)
        i, j = np.unravel_index(np.nanargmin(gaps), gaps.shape)
        x, y = to_shares.transform(corners[j : j + 2, i : i + 2].mean(axis=(0, 1)))
        yield round(100 * float(x), 1), round(100 * (1 - float(y)), 1)


def draw_profiles(
    kind: MapKind, hemispheres: Sequence[Hemisphere], cohorts: Mapping[str, Float]
) -> Picture:
    """Draw a map along x: its mean over y and the range of nine tenths of the rows."""
    figure, axes = _new_figure(1, 1, (5.6, 2.9))
    axis = axes[0, 0]
    bands = []
    for hemisphere in hemispheres:
        hemi = hemisphere.result.name.hemi
        values = hemisphere.sheet.columns[kind.column]
        x = np.linspace(0, 100, values.shape[0])
        color = HEMISPHERE_COLORS[hemi]
        low, high = np.nanpercentile(values, [5, 95], axis=1)
        bands += [low, high]
        axis.fill_between(x, low, high, color=color, alpha=0.18, linewidth=0)
        axis.plot(x, np.nanmean(values, axis=1), color=color, label=hemisphere.side)
        cohort = cohorts.get(hemi)
        if cohort is not None and len(cohort):
            style = {"color": color, "linewidth": 0.9, "linestyle": (0, (2, 2))}
            for line in np.nanpercentile(cohort, [5, 95], axis=0):
                axis.plot(x, line, **style)
    _mark_subfields(axis, hemispheres[0])
    axis.set_xlim(0, 100)
    # Columns next to the edges of the sheet may be far off; they must not squeeze the rest.
    bottom, top = np.nanpercentile(np.concatenate(bands), [3, 97])
    axis.set_ylim(bottom - 0.15 * (top - bottom), top + 0.2 * (top - bottom))
    axis.set_xlabel("  ←  % of the width  →  ".join(X_ENDS))
    axis.set_ylabel(f"{kind.title.lower()} [{kind.unit}]")
    if kind.centered:
        axis.axhline(0, color="0.6", linewidth=0.7, zorder=0)
    axis.legend(frameon=False, loc="upper right", ncols=2, fontsize=9)
    sides = " and ".join(h.side for h in hemispheres)
    return _encode(
        figure,
        alt=f"{kind.title} from medial to lateral, {sides}: mean over the rows of the sheet",
        caption=f"{kind.title} along x",
    )


def picture_of_file(path: Path, *, alt: str, caption: str) -> Picture:
    """Embed a drawing that was made before."""
    content = path.read_bytes()
    width = re.search(rb'<svg[^>]*? width="([\d.]+)pt"', content)
    pixels = round(float(width[1]) / 0.75) if width else 800
    return Picture(content=content, alt=alt, caption=caption, width=pixels)


def _new_figure(rows: int, columns: int, size: tuple[float, float]) -> tuple["Figure", Any]:
    new_figure((1.0, 1.0), "constrained")  # loads the library with separate settings
    from matplotlib import rc_context  # noqa: PLC0415  (slow to load)

    with rc_context(_STYLE):
        figure = new_figure(size, "constrained")
        return figure, figure.subplots(rows, columns, squeeze=False)


def _encode(figure: "Figure", *, alt: str, caption: str) -> Picture:
    from matplotlib import rc_context  # noqa: PLC0415  (slow to load)

    buffer = io.BytesIO()
    # The same results give the same bytes.
    with rc_context(_STYLE):
        figure.savefig(buffer, format="svg", metadata={"Date": None}, dpi=150)
    width = round(figure.get_figwidth() * 96)
    return Picture(content=buffer.getvalue(), alt=alt, caption=caption, width=width)


def draw_sheet(
    axis: "Axes",
    sheet: SheetTable,
    kind: MapKind,
    scale: tuple[float, float],
    *,
    extents: Sequence[float],
    hemi: str,
) -> Any:  # noqa: ANN401  (matplotlib's mappables have no common public type)
    """Draw one map of a sheet, its extents along x and y in mm or else in nodes."""
    has_extents = bool(np.isfinite(extents).all())
    sizes = extents if has_extents else [float(n) for n in sheet.shape]
    x, y = (np.linspace(0, size, n) for size, n in zip(sizes, sheet.shape, strict=True))
    names, hatched = sheet.subfield, ~sheet.valid
    if sheet.ends is not None:
        names, hatched = np.where(sheet.valid, names, ""), np.zeros_like(hatched)
        y = _row_positions(sheet) if has_extents and sheet.points else y
    values = sheet.columns[kind.column].T
    axis.set_facecolor("0.85")
    image = axis.pcolormesh(
        x, y, values, cmap=kind.colors, vmin=scale[0], vmax=scale[1], shading="nearest",
        rasterized=True,
    )  # fmt: skip
    for nodes, hatch in ((sheet.doubtful, "////"), (hatched, "xxxx")):
        if nodes.any():
            _hatch(axis, nodes, x, y, hatch)
    _draw_borders(axis, names, x, y)
    if sheet.ends is not None:
        _draw_ends(axis, sheet, y)
    axis.set_aspect("equal")
    axis.set_title(SIDES.get(hemi, hemi))
    axis.set_xlabel(f"  ←  {'mm' if has_extents else 'nodes'}  →  ".join(X_ENDS))
    return image


def _row_positions(sheet: SheetTable) -> Float:
    """Mean distance of rows from the first, mm: tail, body and head have separate steps."""
    middle, valid = sheet.points["midthickness"], sheet.valid[:, 1:] & sheet.valid[:, :-1]
    steps = np.linalg.norm(np.diff(middle, axis=1), axis=2)
    measured, rows = valid.any(axis=0), np.arange(valid.shape[1])
    mean = np.where(valid, steps, 0.0).sum(axis=0) / np.maximum(valid.sum(axis=0), 1)
    return np.append(0.0, np.cumsum(np.interp(rows, rows[measured], mean[measured])))


def _draw_ends(axis: "Axes", sheet: SheetTable, y: Float) -> None:
    """Mark the ends of the body, and name the parts of the sheet at the right."""
    valid_rows = np.flatnonzero(sheet.valid.any(axis=0))
    axis.set_ylim(*_edges(y)[[valid_rows[0], valid_rows[-1] + 1]])
    for row in sheet.end_rows:
        axis.axhline(y[row], color="black", linewidth=1, dashes=(4, 2))
    for name, first, last in sheet.parts:
        part_rows = valid_rows[(valid_rows >= first) & (valid_rows <= last)]
        if not len(part_rows):
            continue
        axis.text(
            1.02, (y[part_rows[0]] + y[part_rows[-1]]) / 2, name,
            ha="left", va="center", rotation=90, fontsize=8, transform=axis.get_yaxis_transform(),
        )  # fmt: skip


def _hatch(axis: "Axes", nodes: NDArray[np.bool_], x: Float, y: Float, hatch: str) -> None:
    from matplotlib.patches import PathPatch  # noqa: PLC0415  (slow to load)
    from matplotlib.path import Path as Outline  # noqa: PLC0415

    x_edges, y_edges = _edges(x), _edges(y)
    cells = [
        [(x_edges[i], y_edges[j]), (x_edges[i + 1], y_edges[j]),
         (x_edges[i + 1], y_edges[j + 1]), (x_edges[i], y_edges[j + 1]), (x_edges[i], y_edges[j])]
        for i, j in np.argwhere(nodes)
    ]  # fmt: skip
    area = Outline.make_compound_path(*(Outline(cell, closed=True) for cell in cells))
    axis.add_patch(PathPatch(area, facecolor="none", edgecolor="black", linewidth=0, hatch=hatch))


def _edges(nodes: Float) -> Float:
    """Compute cell edges halfway between nodes."""
    steps = np.diff(nodes) / 2
    return np.concatenate([nodes - [steps[0], *steps], [nodes[-1] + steps[-1]]])


def _draw_borders(axis: "Axes", names: NDArray[np.str_], x: Float, y: Float) -> None:
    """Draw the borders between subfields along cell edges, and their names."""
    from matplotlib.collections import PathCollection  # noqa: PLC0415  (slow to load)
    from matplotlib.path import Path as Outline  # noqa: PLC0415

    x_edges, y_edges = _edges(x), _edges(y)
    named = names != ""
    across = np.argwhere((names[1:] != names[:-1]) & named[1:] & named[:-1])
    along = np.argwhere((names[:, 1:] != names[:, :-1]) & named[:, 1:] & named[:, :-1])
    lines = [
        *(((x_edges[i + 1], y_edges[j]), (x_edges[i + 1], y_edges[j + 1])) for i, j in across),
        *(((x_edges[i], y_edges[j + 1]), (x_edges[i + 1], y_edges[j + 1])) for i, j in along),
    ]
    # Lines apart from each other are one path, so that pages stay small.
    borders = [Outline.make_compound_path(*map(Outline, lines))] if lines else []
    for color, width in (("white", 2.2), ("black", 1.0)):
        lines_of_color = PathCollection(borders, edgecolors=color, facecolors="none")
        lines_of_color.set_linewidth(width)
        axis.add_collection(lines_of_color)
    fields = np.unique(names[named])
    staggered = 0.07 * (y[-1] - y[0]) if named.any() and not named.all() else 0.0
    for name, side in zip(fields, cycle((-1, 1)), strict=False):
        i, j = np.nonzero(names == name)
        label = {"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 1.2}
        axis.text(
            x[i].mean(), y[j].mean() + side * staggered, name,
            ha="center", va="center", rotation=90, bbox=label, fontsize=9,
        )  # fmt: skip


def usual_subfields(rows: Sequence[Sequence[str]]) -> list[str]:
    """Find the most frequent name of each row; of several as frequent, the first one.

    A set would give another of these in another process, as its order does.
    """
    return [max(dict.fromkeys(row), key=list(row).count) for row in rows]


def _mark_subfields(axis: "Axes", hemisphere: Hemisphere) -> None:
    """Name the most frequent subfield of each x above the axes, with ticks where it changes."""
    usual = usual_subfields(hemisphere.sheet.subfield.tolist())
    x = np.linspace(0, 100, len(usual))
    changes = [0, *(i for i in range(1, len(usual)) if usual[i] != usual[i - 1]), len(usual)]
    for start, stop in pairwise(changes):
        if start:
            axis.axvline((x[start - 1] + x[start]) / 2, color="0.8", linewidth=0.8, zorder=0)
        middle = (x[start] + x[stop - 1]) / 2
        axis.text(
            middle, 1.01, usual[start], ha="center", va="bottom", fontsize=9, color="0.3",
            transform=axis.get_xaxis_transform(),
        )  # fmt: skip


def read_maps(hemisphere: Hemisphere) -> dict[str, Float]:
    """Read the maps that are shown, faster than the whole sheet."""
    try:
        return read_sheet(hemisphere.result.path("sheet"), [kind.column for kind in MAP_KINDS])
    except InputError:
        return {}


def make_sprites(
    maps: Sequence[Mapping[str, Float]],
) -> tuple[list[dict[str, Any]], int, dict[int, int]]:
    """Draw the maps of all hemispheres, on tiles for the longest; without one, a tile is empty.

    Returns the pictures, how many tiles lie side by side, and the tile of each row that has one.
    """
    shapes = [maps_of_side[MAP_KINDS[0].column].shape for maps_of_side in maps if maps_of_side]
    usual = max(set(shapes), key=shapes.count) if shapes else (0, 0)
    drawn = [row for row, c in enumerate(maps) if c and next(iter(c.values())).shape[0] == usual[0]]
    longest = max((shape[1] for shape in shapes if shape[0] == usual[0]), default=0)
    columns = min(_COLUMNS, max(1, len(drawn)))
    step = 1 if len(drawn) <= _FULL_SIZE else 2
    sprites = []
    for kind in MAP_KINDS if drawn else ():
        scale = scale_of(kind, [maps[row][kind.column] for row in drawn])
        tiles = [_longer(maps[row][kind.column], longest)[::step, ::step] for row in drawn]
        sprites.append(_sprites(kind, tiles, columns, scale))
    return sprites, columns, {row: tile for tile, row in enumerate(drawn)}


def _longer(values: Float, rows: int) -> Float:
    """Add rows without values at the anterior end, as regions differ in length."""
    return np.pad(values, ((0, 0), (0, rows - values.shape[1])), constant_values=np.nan)


def _sprites(
    kind: MapKind, maps: Sequence[Float], columns: int, scale: tuple[float, float]
) -> dict[str, Any]:
    low, high = scale
    width, height = maps[0].shape
    rows = -(-len(maps) // columns)
    picture = np.full((rows * height, columns * width), _COLORS, dtype=np.uint8)
    for number, values in enumerate(maps):
        share = np.clip((values - low) / (high - low), 0, 1)
        shade = np.where(np.isnan(values), _COLORS, np.nan_to_num(share) * (_COLORS - 1))
        row, column = divmod(number, columns)
        window = np.s_[row * height : (row + 1) * height, column * width : (column + 1) * width]
        picture[window] = shade.round().astype(np.uint8).T[::-1]
    colors = colors_of(kind.colors, _COLORS)
    gradient, address = gradient_of(colors), _palette_png(picture, colors)
    return {"kind": kind, "scale": scale, "gradient": gradient, "address": address}


def _palette_png(picture: NDArray[np.uint8], colors: NDArray[np.str_]) -> str:
    from PIL import Image  # noqa: PLC0415  (slow to load)

    image = Image.fromarray(picture, mode="P")
    image.putpalette([*bytes.fromhex("".join(colors.tolist()).replace("#", "")), *_MISSING])
    buffer = io.BytesIO()
    image.save(buffer, format="png", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()
