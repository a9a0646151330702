"""Every map and every measure of cross-sections: its name, its meaning and its function.

A row here is a column of the output tables with its entry in the sidecar; a row of ``MAPS`` is
also a GIFTI file and a column of the profiles. The numbers per hemisphere are in ``summary.py``.
"""

from collections.abc import Callable
from dataclasses import dataclass

from hipsta_bids.artifacts import Float
from hipsta_bids.geometry.cross_sections import CrossSections
from hipsta_bids.geometry.measured import Measured

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
