"""Every map and every measure of cross-sections: its name, its meaning and its function.

A row here is a column of the output tables with its entry in the sidecar; a row of ``MAPS`` is
also a GIFTI file and a column of the profiles. The numbers per hemisphere are in ``summary.py``.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.geometry.body import Body
from hipsta_bids.geometry.measures import (
    CrossSections,
    at_columns,
    away_from_edges,
    column_area,
    cut_sections,
    extent_x,
    extent_y,
    gaussian_curvature,
    mean_curvature,
    measure_thickness,
    subfield_areas,
    subfield_volumes,
    wall_area,
)
from hipsta_bids.geometry.surface import signed_volume
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.settings import Settings
from hipsta_bids.types import Bool, Float, Sheet, Surface, TetMesh

# One hemisphere's sheet with what several measures share.


@dataclass(frozen=True, eq=False, kw_only=True)
class Measured:
    """One hemisphere's body and sheet, and what several measures share."""

    body: Body
    surface: Surface
    mesh: TetMesh
    sheet: Sheet
    """Where maps are measured."""
    subfield: NDArray[np.uint8]
    """(Nx, Ny) values of Tissue."""
    whole: Sheet
    """The same body from its medial to its lateral edge, end to end and wall to wall."""
    settings: Settings

    @cached_property
    def areas(self) -> dict[Tissue, float]:
        """Area of the whole mid-surface in each subfield, mm2."""
        return subfield_areas(self.whole, self.body)

    @cached_property
    def volumes(self) -> dict[Tissue, float]:
        """Volume of the mesh in each subfield, mm3."""
        return subfield_volumes(self.mesh, self.body)

    @cached_property
    def volume(self) -> float:
        """Volume of the mesh, mm3."""
        return signed_volume(self.surface.vertices, self.surface.triangles)

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

    Returns ````x````: (Nx,) values by name, averaged over y; ````y````: (Ny,) values, averaged over
    x. NaN where a line has no such column.
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


DIERS = "Diers et al. 2023, NeuroImage 276:120182, section 2.2"
DO_CARMO = "do Carmo 1976, Differential Geometry of Curves and Surfaces, section 3.3"
OURS = "this software"


@dataclass(frozen=True, kw_only=True)
class Column:
    """What a column of a table is."""

    name: str
    unit: str
    definition: str
    source: str
    digits: int = 4


@dataclass(frozen=True, kw_only=True)
class MapMeasure(Column):
    """One number per column of the sheet."""

    compute: Callable[[Measured], Float]
    """Gives (Nx, Ny)."""
    suffix: str = "morph"
    """Of the GIFTI file."""
    desc: str | None = None
    """The same."""


@dataclass(frozen=True, kw_only=True)
class SectionMeasure(Column):
    """One number per cross-section."""

    compute: Callable[[CrossSections], Float]
    """Gives (Ny,)."""


def _curvature(surface: str, ending: str, level: int | None) -> MapMeasure:
    """Mean curvature of one surface; no level is the middle."""
    return MapMeasure(
        name=f"curvature{ending}",
        unit="1/mm",
        definition=f"mean curvature of the {surface}, positive round the interior",
        source=DO_CARMO,
        digits=5,
        compute=lambda m: m.mean_curvature(m.sheet.middle if level is None else level),
        suffix="curv",
        desc=ending.removeprefix("_") or None,
    )


def _gaussian_curvature(surface: str, ending: str, level: int | None) -> MapMeasure:
    """Gaussian curvature, likewise."""
    return MapMeasure(
        name=f"gaussian_curvature{ending}",
        unit="1/mm^2",
        definition=f"Gaussian curvature of the {surface}: positive in bowls and domes, negative in"
        " saddles, zero where it could be laid flat",
        source=DO_CARMO,
        digits=6,
        compute=lambda m: m.gaussian_curvature(m.sheet.middle if level is None else level),
        suffix="curv",
        desc="gaussian" + ending.removeprefix("_").capitalize(),
    )


_SURFACES = (
    ("mid-surface", "", None),
    ("interior surface", "_interior", 0),
    ("exterior surface", "_exterior", -1),
)

MAPS: tuple[MapMeasure, ...] = (
    MapMeasure(
        name="thickness",
        unit="mm",
        definition="length of the line from the interior to the exterior wall",
        source=DIERS,
        compute=lambda m: m.thickness,
        suffix="thickness",
    ),
    *(_curvature(*surface) for surface in _SURFACES),
    *(_gaussian_curvature(*surface) for surface in _SURFACES),
    MapMeasure(
        name="extent_x",
        unit="mm",
        definition="length of the mid-surface line from medial to lateral rim through this point",
        source=DIERS,
        compute=lambda m: m.lines(0),
        desc="extentX",
    ),
    MapMeasure(
        name="extent_y",
        unit="mm",
        definition="length of the mid-surface line from the posterior to the anterior end through"
        " this point",
        source=DIERS,
        compute=lambda m: m.lines(1),
        desc="extentY",
    ),
)

SECTIONS: tuple[SectionMeasure, ...] = (
    SectionMeasure(
        name="position",
        unit="mm",
        definition="distance from the posterior end plane along the mid-surface, mean over x",
        source=OURS,
        compute=lambda s: s.position,
    ),
    SectionMeasure(
        name="thickness",
        unit="mm",
        definition="mean thickness over the columns of the section",
        source=DIERS,
        compute=lambda s: s.thickness,
    ),
    SectionMeasure(
        name="length_interior",
        unit="mm",
        definition="length of the interior wall from medial to lateral rim",
        source=DIERS,
        compute=lambda s: s.interior,
    ),
    SectionMeasure(
        name="length_mid",
        unit="mm",
        definition="length of the mid-line from medial to lateral rim",
        source=DIERS,
        compute=lambda s: s.middle,
    ),
    SectionMeasure(
        name="length_exterior",
        unit="mm",
        definition="length of the exterior wall from medial to lateral rim",
        source=DIERS,
        compute=lambda s: s.exterior,
    ),
    SectionMeasure(
        name="circumference",
        unit="mm",
        definition="sum of the interior and the exterior length",
        source=DIERS,
        compute=lambda s: s.circumference,
    ),
    SectionMeasure(
        name="interior_exterior_ratio",
        unit="1",
        definition="interior over exterior length",
        source=DIERS,
        digits=5,
        compute=lambda s: s.ratio,
    ),
    SectionMeasure(
        name="section_area",
        unit="mm^2",
        definition="area of the cross-section",
        source=DIERS,
        compute=lambda s: s.area,
    ),
    SectionMeasure(
        name="shape_index",
        unit="1/mm",
        definition="circumference over area of the cross-section",
        source=DIERS,
        digits=5,
        compute=lambda s: s.shape_index,
    ),
)


def measure_maps(measured: Measured) -> dict[str, Float]:
    """Compute every map, (Nx, Ny) each, by name."""
    return {row.name: row.compute(measured) for row in MAPS}


def measure_sections(measured: Measured) -> dict[str, Float]:
    """Compute what is measured per cross-section, (Ny,) each, by name."""
    return {row.name: row.compute(measured.sections) for row in SECTIONS}


# Every number per hemisphere and per subfield: its name, its meaning and its function.


@dataclass(frozen=True, kw_only=True)
class SummaryMeasure(Column):
    """One number per hemisphere."""

    compute: Callable[[Measured], float]


@dataclass(frozen=True, kw_only=True)
class SubfieldMeasure(Column):
    """One number per subfield; the name of the column goes on with the subfield's."""

    compute: Callable[[Measured, Tissue], float]
    """Gives NaN for a subfield that is absent."""


def _over_body(name: str) -> SummaryMeasure:
    """Average a section's measure over the body's length."""
    row = next(row for row in SECTIONS if row.name == name)
    return SummaryMeasure(
        name=f"{name}_mean",
        unit=row.unit,
        definition=f"{row.definition}, mean over the length of the body",
        source=row.source,
        digits=row.digits,
        compute=lambda m: m.sections.mean(row.compute(m.sections)),
    )


def _over_sheet(name: str) -> SummaryMeasure:
    """Average a map over the part of the sheet where it is sure: away from rims and ends."""
    row = next(row for row in MAPS if row.name == name)
    return SummaryMeasure(
        name=f"{name}_mean",
        unit=row.unit,
        definition=f"{row.definition}; mean over the mid-surface away from rims and ends, by half"
        " of measures.curvature_window",
        source=row.source,
        digits=row.digits,
        compute=lambda m: m.mean(row.compute(m), m.away),
    )


SUMMARY: tuple[SummaryMeasure, ...] = (
    SummaryMeasure(
        name="thickness_mean",
        unit="mm",
        definition="mean thickness over the area of the sheet's mid-surface",
        source=DIERS,
        compute=lambda m: m.mean(m.thickness, m.sheet.valid),
    ),
    SummaryMeasure(
        name="extent_x",
        unit="mm",
        definition="mean length of the mid-surface's lines from medial to lateral rim",
        source=DIERS,
        compute=lambda m: float(extent_x(m.whole).mean()),
    ),
    SummaryMeasure(
        name="extent_y",
        unit="mm",
        definition="mean length of the mid-surface's lines from the posterior to the anterior end",
        source=DIERS,
        compute=lambda m: float(extent_y(m.whole).mean()),
    ),
    SummaryMeasure(
        name="extent_z",
        unit="mm",
        definition="mean length of the lines from the interior to the exterior wall, evenly over"
        " the mid-surface",
        source=DIERS,
        compute=lambda m: float(np.average(m.thickness, weights=m.area)),
    ),
    SummaryMeasure(
        name="volume",
        unit="mm^3",
        definition="volume of the sheet, enclosed by its triangle mesh",
        source=DIERS,
        compute=lambda m: m.volume,
    ),
    SummaryMeasure(
        name="area_interior",
        unit="mm^2",
        definition="area of the interior wall; next to the rims continued along the mid-surface",
        source=DIERS,
        compute=lambda m: m.wall_area(0),
    ),
    SummaryMeasure(
        name="area_mid",
        unit="mm^2",
        definition="area of the mid-surface",
        source=DIERS,
        compute=lambda m: sum(m.areas.values()),
    ),
    SummaryMeasure(
        name="area_exterior",
        unit="mm^2",
        definition="area of the exterior wall; next to the rims continued along the mid-surface",
        source=DIERS,
        compute=lambda m: m.wall_area(-1),
    ),
    SummaryMeasure(
        name="area_ratio",
        unit="1",
        definition="area of the interior over that of the exterior wall",
        source=DIERS,
        digits=5,
        compute=lambda m: m.wall_area(0) / m.wall_area(-1),
    ),
    SummaryMeasure(
        name="surface_volume_ratio",
        unit="1/mm",
        definition="area of both walls over the volume; rims and end planes do not count",
        source=DIERS,
        digits=5,
        compute=lambda m: (m.wall_area(0) + m.wall_area(-1)) / m.volume,
    ),
    *map(
        _over_body,
        ("circumference", "interior_exterior_ratio", "section_area", "shape_index"),
    ),
    *map(_over_sheet, (row.name for row in MAPS if "curvature" in row.name)),
)

PER_SUBFIELD: tuple[SubfieldMeasure, ...] = (
    SubfieldMeasure(
        name="thickness_mean",
        unit="mm",
        definition="mean thickness over the area of the sheet's mid-surface in {}",
        source=DIERS,
        compute=lambda m, tissue: m.mean(m.thickness, m.subfield == tissue),
    ),
    SubfieldMeasure(
        name="area",
        unit="mm^2",
        definition="area of the mid-surface in {}",
        source=DIERS,
        compute=lambda m, tissue: m.areas.get(tissue, float("nan")),
    ),
    SubfieldMeasure(
        name="volume",
        unit="mm^3",
        definition="volume of the sheet in {}",
        source=DIERS,
        compute=lambda m, tissue: m.volumes.get(tissue, float("nan")),
    ),
)


def summarize(measured: Measured, tissues: tuple[Tissue, ...]) -> dict[str, float]:
    """Compute one number per measure for the whole body, and per subfield.

    ``tissues`` absent ones are NaN.
    """
    return {row.name: row.compute(measured) for row in SUMMARY} | {
        f"{row.name}_{tissue.name}": row.compute(measured, tissue)
        for row in PER_SUBFIELD
        for tissue in tissues
    }
