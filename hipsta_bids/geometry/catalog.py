"""Every map and every number of the output tables: its name, its meaning and its function.

A row of ``MAPS`` is a GIFTI file and a column of the sheet's tables; a row of ``SECTIONS``,
``SUMMARY`` or ``PER_SUBFIELD`` is a column of the table of cross-sections or of the summary. Each
column has its entry in the sidecar.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.geometry import measures
from hipsta_bids.geometry.body import Body
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.settings import Settings
from hipsta_bids.types import Bool, Float, Sheet, TetMesh

DIERS = "Diers et al. 2023, NeuroImage 276:120182, section 2.2"
DO_CARMO = "do Carmo 1976, Differential Geometry of Curves and Surfaces, section 3.3"
SOFTWARE = "this software"


@dataclass(frozen=True, eq=False, kw_only=True)
class Measured:
    """One hemisphere's body and sheet, and what several measures share."""

    body: Body
    mesh: TetMesh
    sheet: Sheet
    """Sheet on which maps are measured."""
    subfield: NDArray[np.uint8]
    """(Nx, Ny) values of Tissue."""
    whole: Sheet
    """Sheet of the same body from its medial to its lateral edge, end to end and wall to wall."""
    settings: Settings
    """Settings of the participant level."""

    @cached_property
    def areas(self) -> dict[Tissue, float]:
        """Area of the whole mid-surface in each subfield, mm2."""
        return measures.subfield_areas(self.whole, self.body)

    @cached_property
    def volumes(self) -> dict[Tissue, float]:
        """Volume of each subfield between the end planes, mm3."""
        return measures.subfield_volumes(self.mesh, self.body)

    @cached_property
    def volume(self) -> float:
        """Volume between the end planes, mm3."""
        return sum(self.volumes.values())

    @cached_property
    def thickness(self) -> Float:
        """(Nx, Ny) length of the line from wall to wall, mm."""
        return measures.measure_thickness(self.sheet)

    @cached_property
    def sections(self) -> measures.CrossSections:
        """Cross-sections of the whole sheet."""
        means = np.average(self.thickness, axis=0, weights=self.area)
        extent = self.settings.sheet.y_extent
        thickness = measures.at_columns(means, 1 / extent, self.whole.points.shape[1])
        return measures.cut_sections(self.whole, thickness)

    @cached_property
    def area(self) -> Float:
        """(Nx, Ny) area of the mid-surface round each node, mm2."""
        return measures.column_area(self.sheet)

    @cached_property
    def away(self) -> Bool:
        """(Nx, Ny) nodes so far from the edges that polynomials are fitted on both sides."""
        return measures.away_from_edges(self.thickness.shape, self.settings.measures)

    def mean(self, values: Float, mask: Bool) -> float:
        """Mean of a map (Nx, Ny) over columns of a part that were measured directly, or NaN.

        Every square millimeter counts the same: where the wall is thin, the lines of the grid lie
        closer together, and a mean over nodes would be biased to the thin parts.
        """
        selected = mask & self.sheet.valid
        return (
            float(np.average(values[selected], weights=self.area[selected]))
            if selected.any()
            else np.nan
        )

    def wall_area(self, level: int) -> float:
        """Area of the interior (0) or exterior (-1) wall, mm2."""
        return measures.wall_area(self.whole, level)

    def mean_curvature(self, level: int) -> Float:
        """(Nx, Ny) mean curvature of a level of the sheet, 1/mm."""
        return measures.mean_curvature(self.sheet, level, self.settings.measures)

    def gaussian_curvature(self, level: int) -> Float:
        """(Nx, Ny) Gaussian curvature of a level of the sheet, 1/mm2."""
        return measures.gaussian_curvature(self.sheet, level, self.settings.measures)

    def lines(self, axis: int) -> Float:
        """(Nx, Ny) length of the whole mid-surface line along an axis through each node, mm."""
        nx, ny = self.thickness.shape
        grid = self.settings.sheet
        if axis:
            return np.tile(
                measures.at_columns(measures.extent_y(self.whole), grid.x_extent, nx)[:, None],
                (1, ny),
            )
        return np.tile(
            measures.at_columns(measures.extent_x(self.whole), grid.y_extent, ny), (nx, 1)
        )


@dataclass(frozen=True)
class Column:
    """Description of a column of a table."""

    name: str
    """Name of the column."""
    unit: str
    """Unit in the sidecar."""
    definition: str
    """Meaning in the sidecar."""
    source: str = field(default=DIERS, kw_only=True)
    """Publication that defines it."""
    digits: int = field(default=4, kw_only=True)
    """Number of decimals in tables."""
    possible: tuple[float, float] = field(default=(0.0, np.inf), kw_only=True)
    """Values of any hippocampus lie between these, both excluded."""


@dataclass(frozen=True)
class MapMeasure(Column):
    """One number per column of the sheet."""

    compute: Callable[[Measured], Float]
    """Function that returns the map, (Nx, Ny)."""
    suffix: str = field(default="morph", kw_only=True)
    """Suffix of the GIFTI file's name."""
    desc: str | None = field(default=None, kw_only=True)
    """Description in the GIFTI file's name."""


@dataclass(frozen=True)
class SectionMeasure(Column):
    """One number per cross-section."""

    compute: Callable[[measures.CrossSections], Float]
    """Function that returns the numbers, (Ny,)."""


@dataclass(frozen=True)
class SummaryMeasure(Column):
    """One number per hemisphere."""

    compute: Callable[[Measured], float]
    """Function that returns the number."""


@dataclass(frozen=True)
class SubfieldMeasure(Column):
    """One number per subfield, whose name is appended to the column's."""

    compute: Callable[[Measured, Tissue], float]
    """Function that returns the number; NaN for a subfield that is absent."""


#: Curvature that no sheet reaches, 1/mm: its radius would be a hundredth of a millimeter.
_SHARPEST = 100.0
#: Thickness of a sheet, mm, and sizes of subfields, which may be too small to measure.
_THICKNESS, _OR_NONE = (0.0, 10.0), (-1e-9, np.inf)
#: Lengths, areas and volumes that no hippocampus reaches, by unit.
_LARGEST = {"mm": 1e3, "mm^2": 1e5, "mm^3": 1e6}


def _curvature(surface: str, ending: str, level: int | None) -> MapMeasure:
    """Describe the mean curvature of a level of the sheet; None is the mid-surface."""
    return MapMeasure(
        f"curvature{ending}",
        "1/mm",
        f"mean curvature of the {surface}, positive round the interior",
        lambda m: m.mean_curvature(m.sheet.middle if level is None else level),
        source=DO_CARMO,
        digits=5,
        suffix="curv",
        desc=ending.removeprefix("_") or None,
        possible=(-_SHARPEST, _SHARPEST),
    )


def _gaussian_curvature(surface: str, ending: str, level: int | None) -> MapMeasure:
    """Describe the Gaussian curvature of a level of the sheet; None is the mid-surface."""
    return MapMeasure(
        f"gaussian_curvature{ending}",
        "1/mm^2",
        f"Gaussian curvature of the {surface}, positive in bowls and domes, negative in saddles",
        lambda m: m.gaussian_curvature(m.sheet.middle if level is None else level),
        source=DO_CARMO,
        digits=6,
        suffix="curv",
        desc="gaussian" + ending.removeprefix("_").capitalize(),
        possible=(-(_SHARPEST**2), _SHARPEST**2),
    )


_SURFACES = (
    ("mid-surface", "", None),
    ("interior surface", "_interior", 0),
    ("exterior surface", "_exterior", -1),
)

MAPS: tuple[MapMeasure, ...] = (
    MapMeasure(
        "thickness",
        "mm",
        "length of the line from the interior to the exterior wall",
        lambda m: m.thickness,
        suffix="thickness",
        possible=_THICKNESS,
    ),
    *(_curvature(*surface) for surface in _SURFACES),
    *(_gaussian_curvature(*surface) for surface in _SURFACES),
    MapMeasure(
        "extent_x",
        "mm",
        "length of the mid-surface line from medial to lateral rim through this point",
        lambda m: m.lines(0),
        desc="extentX",
    ),
    MapMeasure(
        "extent_y",
        "mm",
        "length of the mid-surface line from the posterior to the anterior end through this point",
        lambda m: m.lines(1),
        desc="extentY",
    ),
)


SECTIONS: tuple[SectionMeasure, ...] = (
    SectionMeasure(
        "position",
        "mm",
        "distance from the posterior end plane along the mid-surface, mean over x",
        lambda s: s.position,
        source=SOFTWARE,
    ),
    SectionMeasure(
        "thickness", "mm", "mean thickness over the columns of the section", lambda s: s.thickness
    ),
    SectionMeasure(
        "length_interior",
        "mm",
        "length of the interior wall from medial to lateral rim",
        lambda s: s.interior,
    ),
    SectionMeasure(
        "length_mid", "mm", "length of the mid-line from medial to lateral rim", lambda s: s.middle
    ),
    SectionMeasure(
        "length_exterior",
        "mm",
        "length of the exterior wall from medial to lateral rim",
        lambda s: s.exterior,
    ),
    SectionMeasure(
        "circumference",
        "mm",
        "sum of the interior and the exterior length",
        lambda s: s.circumference,
    ),
    SectionMeasure(
        "interior_exterior_ratio", "1", "interior over exterior length", lambda s: s.ratio, digits=5
    ),
    SectionMeasure("section_area", "mm^2", "area of the cross-section", lambda s: s.area),
    SectionMeasure(
        "shape_index",
        "1/mm",
        "circumference over area of the cross-section",
        lambda s: s.shape_index,
        digits=5,
    ),
)


def _mean(row: Column, qualifier: str, compute: Callable[[Measured], float]) -> SummaryMeasure:
    """Describe the mean of a map or of a section's measure."""
    return SummaryMeasure(
        f"{row.name}_mean",
        row.unit,
        f"{row.definition}{qualifier}",
        compute,
        source=row.source,
        digits=row.digits,
        possible=row.possible,
    )


def _over_body(row: SectionMeasure) -> SummaryMeasure:
    """Average a section's measure over the body's length."""
    qualifier = ", mean over the length of the body"
    return _mean(row, qualifier, lambda m: m.sections.mean(row.compute(m.sections)))


def _over_sheet(row: MapMeasure) -> SummaryMeasure:
    """Average a map over the part of the sheet where it is reliable: away from the edges."""
    qualifier = "; mean over the mid-surface without margins of half of measures.curvature_window"
    return _mean(row, qualifier, lambda m: m.mean(row.compute(m), m.away))


SUMMARY: tuple[SummaryMeasure, ...] = (
    SummaryMeasure(
        "thickness_mean",
        "mm",
        "mean thickness over the area of the sheet's mid-surface",
        lambda m: m.mean(m.thickness, m.sheet.valid),
        possible=_THICKNESS,
    ),
    SummaryMeasure(
        "thickness_nodes",
        "mm",
        "mean thickness over the nodes of the sheet",
        lambda m: float(m.thickness[m.sheet.valid].mean()),
        possible=_THICKNESS,
    ),
    SummaryMeasure(
        "extent_x",
        "mm",
        "mean length of the mid-surface's lines from medial to lateral rim",
        lambda m: float(measures.extent_x(m.whole).mean()),
    ),
    SummaryMeasure(
        "extent_y",
        "mm",
        "mean length of the mid-surface's lines from the posterior to the anterior end",
        lambda m: float(measures.extent_y(m.whole).mean()),
    ),
    SummaryMeasure(
        "extent_z",
        "mm",
        "mean length of the lines from the interior to the exterior wall, evenly over"
        " the mid-surface",
        lambda m: float(np.average(m.thickness, weights=m.area)),
        possible=_THICKNESS,
    ),
    SummaryMeasure(
        "volume", "mm^3", "volume of the sheet between the end planes", lambda m: m.volume
    ),
    SummaryMeasure(
        "area_interior",
        "mm^2",
        "area of the interior wall; next to the rims continued along the mid-surface",
        lambda m: m.wall_area(0),
    ),
    SummaryMeasure("area_mid", "mm^2", "area of the mid-surface", lambda m: sum(m.areas.values())),
    SummaryMeasure(
        "area_exterior",
        "mm^2",
        "area of the exterior wall; next to the rims continued along the mid-surface",
        lambda m: m.wall_area(-1),
    ),
    SummaryMeasure(
        "area_ratio",
        "1",
        "area of the interior wall over area of the exterior wall",
        lambda m: m.wall_area(0) / m.wall_area(-1),
        digits=5,
    ),
    SummaryMeasure(
        "surface_volume_ratio",
        "1/mm",
        "area of both walls over the volume; rims and end planes do not count",
        lambda m: (m.wall_area(0) + m.wall_area(-1)) / m.volume,
        digits=5,
    ),
    *map(_over_body, SECTIONS[-4:]),  # what describes the shape of a section
    *(_over_sheet(row) for row in MAPS if "curvature" in row.name),
)

PER_SUBFIELD: tuple[SubfieldMeasure, ...] = (
    SubfieldMeasure(
        "thickness_mean",
        "mm",
        "mean thickness over the area of the sheet's mid-surface in {}",
        lambda m, tissue: m.mean(m.thickness, m.subfield == tissue),
    ),
    SubfieldMeasure(
        "area",
        "mm^2",
        "area of the mid-surface in {}",
        lambda m, tissue: m.areas.get(tissue, float("nan")),
    ),
    SubfieldMeasure(
        "volume",
        "mm^3",
        "volume of the sheet in {}",
        lambda m, tissue: m.volumes.get(tissue, float("nan")),
    ),
)


def measure_maps(measured: Measured) -> dict[str, Float]:
    """Compute every map (Nx, Ny) by name."""
    return {row.name: row.compute(measured) for row in MAPS}


def measure_sections(measured: Measured) -> dict[str, Float]:
    """Compute every measure (Ny,) of cross-sections by name."""
    return {row.name: row.compute(measured.sections) for row in SECTIONS}


def summarize(measured: Measured, tissues: tuple[Tissue, ...]) -> dict[str, float]:
    """Compute one number per measure for the whole body and per subfield; NaN for absent ones."""
    return {row.name: row.compute(measured) for row in SUMMARY} | {
        f"{row.name}_{tissue.name}": row.compute(measured, tissue)
        for row in PER_SUBFIELD
        for tissue in tissues
    }


def average_profiles(maps: Mapping[str, Float], sheet: Sheet) -> dict[str, dict[str, Float]]:
    """Average maps, by area, over each line of columns that were measured directly; else NaN.

    ``x`` holds values (Nx,) averaged over y, and ``y`` values (Ny,) averaged over x, by name.
    """
    weights = measures.column_area(sheet) * sheet.valid
    profiles = {}
    for axis, summed_axis in (("x", 1), ("y", 0)):
        total = weights.sum(axis=summed_axis)
        profiles[axis] = {
            name: np.divide(
                np.where(sheet.valid, values * weights, 0).sum(axis=summed_axis),
                total,
                out=np.full(len(total), np.nan),
                where=total > 0,
            )
            for name, values in maps.items()
        }
    return profiles


def why_impossible(name: str, values: Float) -> str | None:
    """Return why a map of some measure, any shape, or a summary measure is impossible, or None.

    Measures of other programs may have any value. A map has the same value at every point only if
    it was not measured.
    """
    measure = next((row for row in (*MAPS, *SUMMARY) if row.name == name), None)
    measure = measure or next((r for r in PER_SUBFIELD if name.startswith(f"{r.name}_")), None)
    finite = values[~np.isnan(values)]
    if measure is None or not finite.size:
        return None
    smallest, largest = float(finite.min()), float(finite.max())
    limit = min(measure.possible[1], _LARGEST.get(measure.unit, np.inf))
    worst = smallest if smallest <= measure.possible[0] else largest
    if smallest <= measure.possible[0] or largest >= limit:
        return f"{name} reaches {worst:.3g} {measure.unit}, which no sheet does"
    if smallest == largest and finite.size > 1:
        return f"{name} is {smallest:.3g} {measure.unit} at all points"
    return None
