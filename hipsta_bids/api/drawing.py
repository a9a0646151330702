"""Draws a map of one hemisphere on the unfolded sheet, with the colors of the pages."""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from hipsta_bids.geometry.catalog import MAPS
from hipsta_bids.reports import display
from hipsta_bids.reports.cells import display_name, unit_of
from hipsta_bids.reports.maps import draw_sheet
from hipsta_bids.reports.results import SheetTable

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_UNITS = {row.name: unit_of(row.unit) for row in MAPS}


def draw_map(
    ax: "Axes",
    sheet: SheetTable,
    measure: str,
    side: str,
    *,
    limits: tuple[float, float] | None = None,
    colorbar: bool = True,
) -> None:
    """Draw a column of a sheet in mm, if the sheet has its extents."""
    columns, kind = sheet.columns, map_kind(measure)
    names = "extent_x", "extent_y"
    extents = [float(np.nanmean(columns[n])) if n in columns else np.nan for n in names]
    scale = limits or display.scale_of(kind, [columns[measure]])
    image = draw_sheet(ax, sheet, kind, scale, extents=extents, hemi=side)
    ax.set_ylabel("  ←  →  ".join(display.Y_ENDS))
    if colorbar:
        add_color_bar(ax, image, kind)


def map_kind(measure: str) -> display.MapKind:
    """Return how a map is shown: as on the pages, or after its unit."""
    kinds = {kind.column: kind for kind in display.MAP_KINDS}
    if measure in kinds:
        return kinds[measure]
    title, unit = display_name(measure).capitalize(), _UNITS.get(measure, "")
    return replace(display.kind_of(measure), column=measure, title=title, unit=unit, digits=3)


def add_color_bar(ax: Any, image: Any, kind: display.MapKind) -> None:  # noqa: ANN401  (of matplotlib)
    """Add the colors of a map to its axes."""
    label = kind.title.lower() if kind.unit else kind.title
    unit = f" [{kind.unit}]" if kind.unit else ""
    ax.figure.colorbar(image, ax=ax, label=f"{label}{unit}", extend="both", shrink=0.8)
