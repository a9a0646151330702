"""Unfolded maps: their layout, drawings by matplotlib without a screen, and tiles."""

import base64
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.derivatives.results import read_sheet
from hipsta_bids.errors import InputError
from hipsta_bids.reports.display import (
    MAP_KINDS,
    X_ENDS,
    MapKind,
    colors_of,
    gradient_of,
    scale_of,
    separate_settings,
)
from hipsta_bids.reports.results import SIDES, Hemisphere, SheetTable
from hipsta_bids.types import Float

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SVG_TAG = re.compile(rb"<svg[^>]*>")
#: Style of drawings in a dark page. Lines on maps stay as they are: colors are behind them.
_DARK = b"""<style>@media (prefers-color-scheme: dark) {
text { fill: #e4e7ea } text[style*="fill: #4c4c4c"] { fill: #a7b0ba !important }
[style*="fill: #ffffff"] { fill: #15191d !important }
:is([id^="matplotlib.axis"], [id^="patch"], [id^="figure"] > [id^="line2d"])
[style*="stroke: #000000"] { stroke: #e4e7ea !important } }</style>"""

SHADES = 128
"""Colors of a map; one more stands for missing values."""

#: Hatching of matplotlib, by reason.
_HATCHES = {"doubtful": "////", "filled": "xxxx"}

# Tiles: many small maps in one picture, of which a browser shows a part each.
_COLUMNS = 20  # side by side
_MISSING = (217, 217, 217)
_FULL_SIZE = 1500  # tiles; of more, each has a quarter of the pixels, so that pages stay small


def new_figure(
    size: tuple[float, float], layout: Literal["constrained", "compressed"] | None
) -> "Figure":
    """Return an empty figure; it needs no screen and no home folder."""
    with separate_settings():
        from matplotlib.figure import Figure  # noqa: PLC0415  (slow to load)

    return Figure(figsize=size, layout=layout)


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


def picture_of_file(path: Path, *, alt: str, caption: str) -> Picture:
    """Embed a drawing that was made before."""
    content = path.read_bytes()
    width = re.search(rb'<svg[^>]*? width="([\d.]+)pt"', content)
    pixels = round(float(width[1]) / 0.75) if width else 800
    return Picture(content=content, alt=alt, caption=caption, width=pixels)


@dataclass(frozen=True, kw_only=True)
class SheetLayout:
    """Where the columns of a sheet lie on its map, with borders and names."""

    sheet: SheetTable
    x: Float
    """(Nx,) places of columns in ``unit``, from medial to lateral."""
    y: Float
    """(Ny,) likewise, from posterior to anterior."""
    unit: str
    """``mm`` or ``nodes``."""
    names: NDArray[np.str_]
    """(Nx, Ny) of subfields, empty where none is named."""

    @classmethod
    def of(cls, sheet: SheetTable, extents: Sequence[float]) -> "SheetLayout":
        """Lay out a sheet by its extents along x and y, mm, or else by nodes."""
        has_extents = bool(np.isfinite(extents).all())
        sizes = extents if has_extents else [float(n) for n in sheet.shape]
        x, y = (np.linspace(0, size, n) for size, n in zip(sizes, sheet.shape, strict=True))
        names = sheet.subfield
        if sheet.ends is not None:
            names = np.where(sheet.valid, names, "")
            y = _row_positions(sheet) if has_extents and sheet.points else y
        unit = "mm" if has_extents else "nodes"
        return cls(sheet=sheet, x=x, y=y, unit=unit, names=names)

    @cached_property
    def edges(self) -> tuple[Float, Float]:
        """Edges of the columns along x and y, halfway between them."""
        steps = [np.diff(nodes) / 2 for nodes in (self.x, self.y)]
        x, y = (
            np.concatenate([nodes - [half[0], *half], [nodes[-1] + half[-1]]])
            for nodes, half in zip((self.x, self.y), steps, strict=True)
        )
        return x, y

    @cached_property
    def rows(self) -> tuple[int, int]:
        """First row that is shown, and the one after the last."""
        valid_rows = np.flatnonzero(self.sheet.valid.any(axis=0) | (self.sheet.ends is None))
        return int(valid_rows[0]), int(valid_rows[-1]) + 1

    @property
    def limits(self) -> tuple[float, float]:
        """Values of y at the edges of the map."""
        low, high = self.edges[1][list(self.rows)].tolist()
        return low, high

    @property
    def hatched(self) -> Iterator[tuple[str, list[tuple[float, float, float, float]]]]:
        """Rectangles of columns (left, right, posterior, anterior) that are hatched, by reason."""
        (x, y), sheet = self.edges, self.sheet
        filled = ~sheet.valid & (sheet.ends is None)
        for reason, nodes in (("doubtful", sheet.doubtful), ("filled", filled)):
            if nodes.any():
                yield reason, [(x[i], x[i + 1], y[j], y[j + 1]) for i, j in np.argwhere(nodes)]

    @property
    def borders(self) -> list[tuple[tuple[float, float], tuple[float, float]]]:
        """Borders between subfields: both ends of lines along edges of columns."""
        (x, y), names, named = self.edges, self.names, self.names != ""
        across = np.argwhere((names[1:] != names[:-1]) & named[1:] & named[:-1])
        along = np.argwhere((names[:, 1:] != names[:, :-1]) & named[:, 1:] & named[:, :-1])
        return [
            *(((x[i + 1], y[j]), (x[i + 1], y[j + 1])) for i, j in across),
            *(((x[i], y[j + 1]), (x[i + 1], y[j + 1])) for i, j in along),
        ]

    @property
    def labels(self) -> Iterator[tuple[float, float, str]]:
        """Places and names of subfields."""
        named = self.names != ""
        some_named = named.any() and not named.all()
        staggered = 0.07 * (self.y[-1] - self.y[0]) if some_named else 0.0
        for name, side in zip(np.unique(self.names[named]), cycle((-1, 1)), strict=False):
            i, j = np.nonzero(self.names == name)
            yield self.x[i].mean(), self.y[j].mean() + side * staggered, str(name)

    @property
    def parts(self) -> Iterator[tuple[float, str]]:
        """Places along y, and names, of tail, body and head, where not all is body."""
        valid_rows = np.flatnonzero(self.sheet.valid.any(axis=0))
        for name, first, last in self.sheet.parts:
            part_rows = valid_rows[(valid_rows >= first) & (valid_rows <= last)]
            if len(part_rows):
                yield (self.y[part_rows[0]] + self.y[part_rows[-1]]) / 2, name


def _row_positions(sheet: SheetTable) -> Float:
    """Mean distance of rows from the first, mm: tail, body and head have separate steps."""
    middle, valid = sheet.points["midthickness"], sheet.valid[:, 1:] & sheet.valid[:, :-1]
    steps = np.linalg.norm(np.diff(middle, axis=1), axis=2)
    measured, rows = valid.any(axis=0), np.arange(valid.shape[1])
    mean = np.where(valid, steps, 0.0).sum(axis=0) / np.maximum(valid.sum(axis=0), 1)
    return np.append(0.0, np.cumsum(np.interp(rows, rows[measured], mean[measured])))


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
    from matplotlib.collections import PathCollection  # noqa: PLC0415  (slow to load)
    from matplotlib.patches import PathPatch  # noqa: PLC0415
    from matplotlib.path import Path as Outline  # noqa: PLC0415

    layout = SheetLayout.of(sheet, extents)
    values = sheet.columns[kind.column].T
    axis.set_facecolor("0.85")
    image = axis.pcolormesh(
        layout.x, layout.y, values, cmap=kind.colors, vmin=scale[0], vmax=scale[1],
        shading="nearest", rasterized=True,
    )  # fmt: skip
    for reason, boxes in layout.hatched:
        cells = [[(a, c), (b, c), (b, d), (a, d), (a, c)] for a, b, c, d in boxes]
        area = Outline.make_compound_path(*(Outline(cell, closed=True) for cell in cells))
        style: dict[str, Any] = {"facecolor": "none", "edgecolor": "black", "linewidth": 0}
        axis.add_patch(PathPatch(area, hatch=_HATCHES[reason], **style))
    # Lines apart from each other are one path, so that files stay small.
    lines = [Outline.make_compound_path(*map(Outline, b))] if (b := layout.borders) else []
    for color, width in (("white", 2.2), ("black", 1.0)):
        lines_of_color = PathCollection(lines, edgecolors=color, facecolors="none")
        lines_of_color.set_linewidth(width)
        axis.add_collection(lines_of_color)
    for x, y, name in layout.labels:
        label = {"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 1.2}
        axis.text(
            x, y, name, ha="center", va="center", rotation=90, bbox=label, fontsize=9,
        )  # fmt: skip
    if sheet.ends is not None:
        axis.set_ylim(*layout.limits)
    for row in sheet.end_rows:
        axis.axhline(layout.y[row], color="black", linewidth=1, dashes=(4, 2))
    for y, name in layout.parts:
        axis.text(
            1.02, y, name, ha="left", va="center", rotation=90, fontsize=8,
            transform=axis.get_yaxis_transform(),
        )  # fmt: skip
    axis.set_aspect("equal")
    axis.set_title(SIDES.get(hemi, hemi))
    axis.set_xlabel(f"  ←  {layout.unit}  →  ".join(X_ENDS))
    return image


def usual_subfields(rows: Sequence[Sequence[str]]) -> list[str]:
    """Find the most frequent name of each row; of several as frequent, the first one.

    A set would give another of these in another process, as its order does.
    """
    return [max(dict.fromkeys(row), key=list(row).count) for row in rows]


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
    width, height = maps[0].shape
    rows = -(-len(maps) // columns)
    picture = np.full((rows * height, columns * width), SHADES, dtype=np.uint8)
    for number, values in enumerate(maps):
        row, column = divmod(number, columns)
        window = np.s_[row * height : (row + 1) * height, column * width : (column + 1) * width]
        picture[window] = shades_of(values, scale)
    colors = colors_of(kind.colors, SHADES)
    gradient, address = gradient_of(colors), palette_png(picture, colors)
    return {"kind": kind, "scale": scale, "gradient": gradient, "address": address}


def shades_of(values: Float, scale: tuple[float, float]) -> NDArray[np.uint8]:
    """Return indices of colors (Ny, Nx) of a map (Nx, Ny), anterior above."""
    share = np.clip((values - scale[0]) / (scale[1] - scale[0]), 0, 1)
    shade = np.where(np.isnan(values), SHADES, np.nan_to_num(share) * (SHADES - 1))
    return np.asarray(shade.round().astype(np.uint8).T[::-1])


def palette_png(picture: NDArray[np.uint8], colors: NDArray[np.str_]) -> str:
    """Write indices of colors as the data address of a PNG."""
    from PIL import Image  # noqa: PLC0415  (slow to load)

    image = Image.fromarray(picture, mode="P")
    image.putpalette([*bytes.fromhex("".join(colors.tolist()).replace("#", "")), *_MISSING])
    buffer = io.BytesIO()
    image.save(buffer, format="png", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()
