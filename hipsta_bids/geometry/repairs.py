"""What repairs of the labels do to a map: their size, effect and place."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from hipsta_bids.geometry import checks
from hipsta_bids.geometry.body import Body
from hipsta_bids.geometry.columns import lengths_inside
from hipsta_bids.geometry.grid import before_mending
from hipsta_bids.geometry.measures import column_area, measure_thickness
from hipsta_bids.geometry.topology import Repair, SolidField, repaired_columns
from hipsta_bids.settings import CheckSettings
from hipsta_bids.types import REPAIR_EFFECT, Bool, Finding, Float, Sheet


def describe_repair(repair: Repair) -> Finding:
    """Return the finding of a repair: its size over the limit."""
    return Finding(
        reason="large-repair",
        value=repair.excess,
        limit=1.0,
        text=str(repair),
        remedy="a large repair, look at the labels there",
        points=repair.points,
        placed=True,
    )


def measure_effect(sheet: Sheet, solid: SolidField, repaired: Bool) -> Float:
    """Measure by how much repairs raise the thickness (Nx, Ny) of ``repaired`` columns, mm.

    These are cut at the walls of the labels before and after repairs; 0 where a wall is missing.
    """
    if not repaired.any():
        return np.zeros(repaired.shape)
    fields = solid.field, before_mending(solid.before)
    after, before = (lengths_inside(sheet, field) for field in fields)
    return np.where(repaired, np.nan_to_num(after - before), 0.0)


def list_repairs(
    solid: SolidField, body: Body, sheet: Sheet, effect: Float, settings: CheckSettings
) -> tuple[str, ...]:
    """List repairs with place and consequence, a line each."""
    lines = []
    for repair in solid.repairs:
        finding = checks.add_consequence(describe_repair(repair), sheet)
        text = checks.consequence_text(finding)
        if repair.kind == "cavity" and finding.share > 0:
            near = checks.columns_near(sheet, repair.points, checks.FLAG_REACH)
            change = mean_effect(sheet, np.where(near, effect, 0.0))
            text = f"; it concerns {finding.share:.1%} of the columns and raises the mean thickness"
            text += f" by {change:.3f} mm"
        lines.append(f"{finding.text}{text}")
    return (*lines, *checks.describe_uncus(body, settings))


def mean_effect(sheet: Sheet, effect: Float) -> float:
    """Average an effect (Nx, Ny) over the area of the sheet."""
    area = np.nan_to_num(column_area(sheet))
    return float((effect * area).sum() / area.sum())


def doubtful_columns(sheet: Sheet, solid: SolidField, findings: Sequence[Finding]) -> Bool:
    """Mark columns (Nx, Ny) near a flag, or odd ones at a repair.

    A column is odd if its thickness differs from the continuation of its neighbors, as at the
    stump of a bridge. Filled gaps do not count: the protocol leaves them, and they have a rule.
    """
    thickness = measure_thickness(sheet)
    doubtful = repaired_columns(sheet, replace(solid, touched=solid.touched & ~solid.gaps))
    usual = checks.spread_over(thickness, doubtful | ~np.isfinite(thickness))
    doubtful &= np.abs(thickness - usual) > REPAIR_EFFECT
    for finding in findings:
        if finding.raised and len(finding.points):
            doubtful |= checks.columns_near(sheet, finding.points, checks.FLAG_REACH)
    return doubtful


def repair_metrics(solid: SolidField, body: Body, sheet: Sheet, effect: Float) -> dict[str, Any]:
    """Count repairs by kind, and measure their effect on the mean."""
    kinds = Counter(repair.kind for repair in solid.repairs)
    if len(body.uncus):
        kinds["uncus"] += 1
    return {"repair_kinds": dict(kinds), "repaired_change_mm": mean_effect(sheet, effect)}
