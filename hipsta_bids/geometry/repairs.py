"""What repairs of the labels do to a map: their effect on the mean, and doubtful columns."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from hipsta_bids.geometry import checks
from hipsta_bids.geometry.body import Body
from hipsta_bids.geometry.columns import ends_inside
from hipsta_bids.geometry.grid import before_mending
from hipsta_bids.geometry.measures import column_area, measure_thickness
from hipsta_bids.geometry.topology import SolidField, repaired_columns
from hipsta_bids.types import HATCHED_FROM, Bool, Finding, Sheet


def doubtful_columns(sheet: Sheet, solid: SolidField, findings: Sequence[Finding]) -> Bool:
    """Mark columns (Nx, Ny) near a flag, or odd ones at a repair.

    A column is odd if its thickness differs from the continuation of its neighbors, as at the
    stump of a bridge. Filled gaps do not count: the protocol leaves them, and they have a rule.
    """
    thickness, touched = measure_thickness(sheet), solid.touched
    if solid.field.cavities is not None:
        touched = touched & ~solid.field.cavities
    doubtful = repaired_columns(sheet, replace(solid, touched=touched))
    usual = checks.spread_over(thickness, doubtful | ~np.isfinite(thickness))
    doubtful &= np.abs(thickness - usual) > HATCHED_FROM
    for finding in findings:
        if finding.raised and len(finding.points):
            doubtful |= checks.columns_near(sheet, finding.points, checks.FLAG_REACH)
    return doubtful


def repair_metrics(sheet: Sheet, solid: SolidField, repaired: Bool, body: Body) -> dict[str, Any]:
    """Count repairs by kind; measure by how much they raise the mean thickness, mm, by area.

    ``repaired`` columns are cut at the walls before repairs, and unchanged if these are missing.
    """
    kinds = [repair.kind for repair in solid.repairs] + ["uncus"] * bool(len(body.uncus))
    area, change = column_area(sheet), 0.0
    if repaired.any():
        columns = Sheet(points=sheet.points[repaired][None], valid=sheet.valid[repaired][None])
        walls = ends_inside(columns, np.eye(4), before_mending(solid.before))[0]
        change = np.nansum(area[repaired] * (walls[:, 0] - walls[:, 1])) / np.nansum(area)
    return {
        "repair_kinds": dict(Counter(kinds)),
        "repaired_fraction": float(repaired.mean()),
        "repaired_change_mm": float(change),
    }
