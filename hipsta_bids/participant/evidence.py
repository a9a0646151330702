"""The evidence of one hemisphere's stages, and what their checks found."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hipsta_bids.geometry import coverage, sheet_checks
from hipsta_bids.geometry.boundaries import Boundaries
from hipsta_bids.geometry.bumps import check_bumps, check_swollen_ends
from hipsta_bids.geometry.catalog import Measured
from hipsta_bids.geometry.checks import (
    check_cavities,
    check_cross_sections,
    check_image,
    check_labels,
)
from hipsta_bids.geometry.topology import Repair, SolidField, repaired_columns
from hipsta_bids.protocols.protocol import LATERAL_END, MEDIAL_END, Tissue
from hipsta_bids.types import Bool, Coordinates, Finding, Float, Surface

#: What every protocol labels along the sheet, from medial to lateral.
_PARTS = {
    "subiculum": MEDIAL_END,
    "CA1": (Tissue.CA1,),
    "CA2 or CA3": LATERAL_END,
}


@dataclass(frozen=True, eq=False, kw_only=True)
class Evidence(Measured):
    """One hemisphere's sheet, and the evidence of the stages before it."""

    surface: Surface
    coordinates: Coordinates
    image: tuple[Finding, ...]
    """What the checks of the label image found."""
    side: float
    """How far the medial subfields lie medially of CA1, mm."""
    solid: SolidField
    voxels_across: float
    smoothed: int
    """How often the surface was smoothed more because TetGen could not fill it."""
    boundaries: Boundaries
    label_order: float
    """Rank correlation of x with the labels' order."""
    bending: float
    """Angle by which the sheet bends round its interior side, rad."""
    folded: float
    """Fraction of the volume in which the coordinates have the opposite orientation."""
    rivals: Mapping[str, Float]
    """Thickness (Nx, Ny), mm, after a second choice that is as likely, by what was chosen."""

    @cached_property
    def repaired(self) -> Bool:
        """Columns (Nx, Ny) that a repair touched."""
        return repaired_columns(self.sheet, self.solid)


def find_all(evidence: Evidence) -> list[Finding]:
    """List what the checks of one hemisphere found, within their limits or not."""
    body, sheet, checks = evidence.body, evidence.sheet, evidence.settings.checks
    solid = evidence.solid
    touched = solid.touched & (solid.field.values < 0)
    return [
        *map(describe_repair, solid.repairs),
        *map(_whole, _rows_of_body(evidence)),
        *map(_whole, _rows_of_sheet(evidence)),
        *[
            sheet_checks.check_rival(evidence.thickness, *rival, checks)
            for rival in evidence.rivals.items()
        ],
        *check_image(body),
        *check_cavities(body, checks),
        *check_labels(body, checks),
        *check_cross_sections(solid.field, 2 * body.ends.half_slice, checks, touched),
        *sheet_checks.check_rows(sheet, checks),
        *sheet_checks.check_edges(evidence.whole, checks),
        *coverage.check_coverage(sheet, evidence.whole, evidence.subfield, body, checks),
        *check_bumps(sheet, checks),
        *check_swollen_ends(sheet, checks),
    ]


#: Reason, value, limit, text, remedy, and positions (N, 3) of the columns concerned, RAS mm, or
#: their share.
_Row = tuple[str, float, float, str, str, Float | float]


def _rows_of_body(evidence: Evidence) -> list[_Row]:
    """Check the ends of a body, and which subfields it has."""
    body, sheet = evidence.body, evidence.sheet
    middle, ends = sheet.points[:, :, sheet.middle], body.ends
    present = set(np.unique(body.tissue[body.inside]).tolist())
    rows: list[_Row] = [
        (
            "ends-uncertain",
            uncertainty,
            evidence.settings.checks.flag_end,
            f"the {end} end has no label and is uncertain by {uncertainty:.1f} mm",
            "check the end plane, or place it by hand (--ends)",
            middle[:, row],
        )
        for end, uncertainty, row in (
            ("posterior", ends.posterior.uncertainty, 0),
            ("anterior", ends.anterior.uncertainty, -1),
        )
    ]
    rows += [
        (
            "subfield-missing",
            float(not present & set(tissues)),
            0,
            f"the body has no {name}: the sheet ends there",
            "look at the labels",
            1.0,
        )
        for name, tissues in _PARTS.items()
        if body.region != "entorhinal"
    ]
    return rows


def _rows_of_sheet(evidence: Evidence) -> list[_Row]:
    """Check repairs, boundaries, side, folds and filled columns of a sheet as a whole."""
    solid, boundaries, settings = evidence.solid, evidence.boundaries, evidence.settings
    sheet, checks = evidence.sheet, settings.checks
    middle = sheet.points[:, :, sheet.middle]
    follows_labels = evidence.body.region == "body" and boundaries.side_rule == "labels"
    return [
        (
            "much-repaired",
            solid.changed_fraction,
            settings.topology.flag_fraction,
            f"{solid.changed_fraction:.1%} of the body was changed by repairs",
            "look at the labels",
            middle[evidence.repaired],
        ),
        (
            "boundary-doubtful",
            float(boundaries.tilt),
            0,
            "no medial and lateral boundary runs from end to end with the operator of the settings",
            "look at the edges of the sheet",
            1.0,
        ),
        (
            # The cortex beside the body bends the other way.
            "side-doubtful",
            -evidence.bending if follows_labels else 0.0,
            checks.flag_bending,
            f"dentate gyrus labels lie on the outer side of the bend ({evidence.bending:.1f} rad)",
            "check which wall is interior; thickness does not depend on it",
            1.0,
        ),
        (
            "folded",
            evidence.folded,
            checks.flag_folded,
            f"the coordinates fold in {evidence.folded:.1%} of the volume",
            "look at the map",
            evidence.folded,
        ),
        (
            "columns-filled",
            1 - float(sheet.valid.mean()),
            checks.flag_filled,
            f"{1 - sheet.valid.mean():.1%} of the columns were filled from their neighbors",
            "look at the map",
            middle[~sheet.valid],
        ),
    ]


def describe_repair(repair: Repair) -> Finding:
    """Return the finding of a repair: its size over the limit."""
    return Finding(
        reason="large-repair",
        value=repair.excess,
        limit=1.0,
        text=str(repair),
        remedy="the repair is large, check the labels there",
        points=repair.points,
        placed=True,
    )


def _whole(row: _Row) -> Finding:
    """Make a finding about the sheet as a whole, from the columns concerned or their share."""
    reason, value, limit, text, remedy, location = row
    finding = Finding(
        reason=reason, value=value, limit=limit, text=text, remedy=remedy, placed=True
    )
    if isinstance(location, float):
        return replace(finding, share=location)
    return replace(finding, points=location[np.isfinite(location).all(axis=-1)])
