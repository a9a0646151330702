"""Many small maps in one picture, of which a browser shows a part each: hundreds at once, fast."""

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import csv

from hipsta_bids.artifacts import Float, Status
from hipsta_bids.bids import files
from hipsta_bids.reports.figures import MAP_KINDS, MapKind, color_table, gradient_of, scale_of
from hipsta_bids.reports.results import Hemisphere

_COLUMNS = 20  # tiles side by side
_COLORS = 128  # shades; one more stands for missing values
_MISSING = (217, 217, 217)
_FULL_SIZE = 1500  # beyond so many, tiles have a quarter of the pixels, so that pages stay small


@dataclass(frozen=True, kw_only=True)
class Sprites:
    """All maps of one kind."""

    name: str
    title: str
    unit: str
    low: str
    high: str
    """Values at the ends of the colors."""
    gradient: str
    """Of the color bar, as CSS spells it."""
    address: str
    """Data address of the picture."""


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Where tiles lie in the pictures."""

    columns: int
    rows: int
    places: Mapping[int, int]
    """Number of the tile, by row in the list of hemispheres."""


def read_maps(hemisphere: Hemisphere) -> dict[str, Float]:
    """Read the maps that are shown, faster than the whole sheet.

    Parameters
    ----------
    hemisphere : Hemisphere
        A measured one.

    Returns
    -------
    dict of str to (Nx, Ny) float64
        Empty if the table cannot be read.
    """
    names = [kind.column for kind in MAP_KINDS]
    try:
        table = csv.read_csv(
            hemisphere.place.path("sheet"),
            read_options=csv.ReadOptions(use_threads=False),
            parse_options=csv.ParseOptions(delimiter="\t"),
            convert_options=csv.ConvertOptions(
                include_columns=["x", "y", *names],
                column_types=dict.fromkeys(names, pa.float64()),
                null_values=[files.MISSING],
            ),
        )
        shape = (int(table.column("x")[-1].as_py()), int(table.column("y")[-1].as_py()))
        return {name: table.column(name).to_numpy().reshape(shape) for name in names}
    except (OSError, ValueError, IndexError, KeyError, pa.ArrowException):
        return {}


def make_sprites(
    hemispheres: Sequence[Hemisphere], maps: Sequence[Mapping[str, Float]]
) -> tuple[list[Sprites], Grid]:
    """Draw the maps of all hemispheres.

    Parameters
    ----------
    hemispheres : sequence of Hemisphere
    maps : sequence of mapping
        Of each, from :func:`read_maps`.

    Returns
    -------
    list of Sprites, Grid
        Anterior is up; the medial side of left hemispheres is on the right, as on their own page.
    """
    shapes = [found[MAP_KINDS[0].column].shape for found in maps if found]
    usual = max(set(shapes), key=shapes.count) if shapes else (0, 0)
    shown = [
        row for row, found in enumerate(maps) if found and next(iter(found.values())).shape == usual
    ]
    grid = Grid(
        columns=min(_COLUMNS, max(1, len(shown))),
        rows=max(1, -(-len(shown) // _COLUMNS)),
        places={row: place for place, row in enumerate(shown)},
    )
    step = 1 if len(shown) <= _FULL_SIZE else 2
    mirrored = [hemispheres[row].place.name.hemi == "L" for row in shown]
    trusted = [row for row in shown if hemispheres[row].status != Status.FLAGGED] or shown
    sprites = []
    for kind in MAP_KINDS if shown else ():
        # What is flagged may be far off; it need not stretch the colors of all others.
        scale = scale_of(kind, [maps[row][kind.column] for row in trusted])
        tiles = [maps[row][kind.column][::step, ::step] for row in shown]
        sprites.append(_sprites(kind, tiles, mirrored, grid, scale))
    return sprites, grid


def _sprites(
    kind: MapKind,
    maps: Sequence[Float],
    mirrored: Sequence[bool],
    grid: Grid,
    scale: tuple[float, float],
) -> Sprites:
    low, high = scale
    width, height = maps[0].shape
    picture = np.full((grid.rows * height, grid.columns * width), _COLORS, dtype=np.uint8)
    for place, (values, mirror) in enumerate(zip(maps, mirrored, strict=True)):
        share = np.clip((values - low) / (high - low), 0, 1)
        shade = np.where(np.isnan(values), _COLORS, np.nan_to_num(share) * (_COLORS - 1))
        tile = shade.round().astype(np.uint8).T[::-1]
        row, column = divmod(place, _COLUMNS)
        place_in = np.s_[row * height : (row + 1) * height, column * width : (column + 1) * width]
        picture[place_in] = tile[:, ::-1] if mirror else tile
    colors = color_table(kind, _COLORS)
    return Sprites(
        name=kind.column,
        title=kind.title,
        unit=kind.unit,
        low=f"{low:.{kind.digits}f}",
        high=f"{high:.{kind.digits}f}",
        gradient=gradient_of(colors),
        address=_palette_png(picture, colors),
    )


def _palette_png(picture: NDArray[np.uint8], colors: NDArray[np.str_]) -> str:
    from PIL import Image  # noqa: PLC0415  (slow to load)

    image = Image.fromarray(picture, mode="P")
    palette = [int(color[i : i + 2], 16) for color in colors.tolist() for i in (1, 3, 5)]
    image.putpalette([*palette, *_MISSING])
    buffer = io.BytesIO()
    image.save(buffer, format="png", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()
