"""Every number per hemisphere and per subfield: its name, its meaning and its function."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hipsta_bids.geometry.catalog import DIERS, MAPS, SECTIONS, Column
from hipsta_bids.geometry.measured import Measured
from hipsta_bids.geometry.shape_lengths import extent_x, extent_y
from hipsta_bids.schemes import Tissue


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

    Parameters
    ----------
    measured : Measured
    tissues : tuple of Tissue
        The subfields of the protocol; absent ones are NaN.

    Returns
    -------
    dict
        By the names in ``SUMMARY`` and ``PER_SUBFIELD``.
    """
    return {row.name: row.compute(measured) for row in SUMMARY} | {
        f"{row.name}_{tissue.name}": row.compute(measured, tissue)
        for row in PER_SUBFIELD
        for tissue in tissues
    }
