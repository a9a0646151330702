"""One hemisphere's sheet with what several measures share."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.artifacts import Bool, Float, Sheet
from hipsta_bids.geometry.cross_sections import CrossSections, cut_sections
from hipsta_bids.geometry.measures import (
    away_from_edges,
    column_area,
    gaussian_curvature,
    mean_curvature,
    measure_thickness,
)
from hipsta_bids.geometry.shape_lengths import at_columns, extent_x, extent_y, wall_area
from hipsta_bids.schemes import Tissue
from hipsta_bids.settings import Settings


@dataclass(frozen=True, eq=False, kw_only=True)
class Measured:
    """One hemisphere's sheet, and what several measures share."""

    sheet: Sheet
    """Where maps are measured."""
    subfield: NDArray[np.uint8]
    """(Nx, Ny) values of Tissue."""
    whole: Sheet
    """The same body from rim to rim, end to end and wall to wall."""
    areas: Mapping[Tissue, float]
    """Of the mid-surface from rim to rim in each subfield, mm2."""
    volumes: Mapping[Tissue, float]
    """Of the mesh in each subfield, mm3."""
    volume: float
    """Of the mesh, mm3."""
    settings: Settings

    @cached_property
    def thickness(self) -> Float:
        """(Nx, Ny) mm."""
        return measure_thickness(self.sheet)

    @cached_property
    def sections(self) -> CrossSections:
        """The cross-sections."""
        extent = self.settings.sheet.y_extent
        count = self.whole.points.shape[1]
        means = np.average(self.thickness, axis=0, weights=self.area)
        thickness = at_columns(means, 1 / extent, count)
        return cut_sections(self.whole, thickness, self.settings.measures)

    @cached_property
    def area(self) -> Float:
        """(Nx, Ny) area of the mid-surface round each node, mm2."""
        return column_area(self.sheet)

    @cached_property
    def away(self) -> Bool:
        """(Nx, Ny) nodes so far from rims and ends that polynomials are fitted on both sides."""
        return away_from_edges(self.thickness.shape, self.settings.measures)

    def mean(self, values: Float, where: Bool) -> float:
        """Mean of a map (Nx, Ny) over part of the sheet, for columns that were measured directly.

        Every square millimeter counts the same: where the wall is thin, the lines of the grid lie
        closer together, and a mean over nodes would be that of the thin parts. NaN if there are no
        such columns.
        """
        here = where & self.sheet.valid
        return float(np.average(values[here], weights=self.area[here])) if here.any() else np.nan

    def wall_area(self, level: int) -> float:
        """Area of the interior (0) or exterior (-1) wall, mm2."""
        return wall_area(self.whole, level, self.settings.measures)

    def mean_curvature(self, level: int) -> Float:
        """(Nx, Ny) 1/mm."""
        return mean_curvature(self.sheet, level, self.settings.measures)

    def gaussian_curvature(self, level: int) -> Float:
        """(Nx, Ny) 1/mm2."""
        return gaussian_curvature(self.sheet, level, self.settings.measures)

    def lines(self, axis: int) -> Float:
        """(Nx, Ny) length of the whole mid-surface line along an axis through each node, mm."""
        nx, ny = self.thickness.shape
        grid = self.settings.sheet
        if axis:
            return np.tile(at_columns(extent_y(self.whole), grid.x_extent, nx)[:, None], (1, ny))
        return np.tile(at_columns(extent_x(self.whole), grid.y_extent, ny), (nx, 1))


def average_profiles(maps: Mapping[str, Float], sheet: Sheet) -> dict[str, dict[str, Float]]:
    """Average maps along one axis of the sheet, over the area of columns measured directly.

    Returns
    -------
    dict
        ``x``: (Nx,) values by name, averaged over y; ``y``: (Ny,) values, averaged over x. NaN
        where a line has no such column.
    """
    weights = column_area(sheet) * sheet.valid
    profiles = {}
    for axis, other in (("x", 1), ("y", 0)):
        total = weights.sum(axis=other)
        profiles[axis] = {
            name: np.divide(
                np.where(sheet.valid, values * weights, 0).sum(axis=other),
                total,
                out=np.full(len(total), np.nan),
                where=total > 0,
            )
            for name, values in maps.items()
        }
    return profiles
