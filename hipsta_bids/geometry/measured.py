"""One hemisphere's sheet with what several measures share."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.artifacts import Float, Sheet
from hipsta_bids.geometry.cross_sections import CrossSections, cut_sections
from hipsta_bids.geometry.measures import (
    column_volume,
    gaussian_curvature,
    layer_area,
    mean_curvature,
    measure_thickness,
    node_shares,
)
from hipsta_bids.geometry.shape_lengths import at_columns, extent_x, extent_y, wall_area
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
    whole_subfield: NDArray[np.uint8]
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
        thickness = at_columns(self.thickness.mean(axis=0), 1 / extent, count)
        return cut_sections(self.whole, thickness, self.settings.measures)

    @cached_property
    def mid_area(self) -> Float:
        """(Nx, Ny) area of the mid-surface round each node of the whole sheet, mm2."""
        return node_shares(layer_area(self.whole.points[:, :, self.whole.middle]))

    @cached_property
    def column_volume(self) -> Float:
        """(Nx, Ny) volume round each column of the whole sheet, mm3."""
        return column_volume(self.whole)

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
    """Average maps along one axis of the sheet, over columns that were measured directly.

    Returns
    -------
    dict
        ``x``: (Nx,) values by name, averaged over y; ``y``: (Ny,) values, averaged over x. NaN
        where a line has no such column.
    """
    known = sheet.valid.astype(float)
    profiles = {}
    for axis, other in (("x", 1), ("y", 0)):
        count = known.sum(axis=other)
        profiles[axis] = {
            name: np.divide(
                np.where(sheet.valid, values, 0).sum(axis=other),
                count,
                out=np.full(len(count), np.nan),
                where=count > 0,
            )
            for name, values in maps.items()
        }
    return profiles
