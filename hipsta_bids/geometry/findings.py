"""From what checks found to flags: where it is, and what it means for the map."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from hipsta_bids.geometry.measures import column_area, measure_thickness
from hipsta_bids.types import Bool, Finding, Flag, Float, Sheet

#: A flag concerns the columns within this distance of what was found, mm.
FLAG_REACH = 1.0

_NEGLIGIBLE = 0.005
"""mm; means that differ by less read the same."""


def flag_margins(findings: Sequence[Finding]) -> dict[str, float]:
    """Largest value over limit by reason; above 1 is flagged."""
    margins: dict[str, float] = {}
    for finding in findings:
        margins[finding.reason] = max(finding.margin, margins.get(finding.reason, 0.0))
    return margins


def raise_flags(
    findings: Sequence[Finding],
    sheet: Sheet,
    position: Callable[[Float], str],
) -> list[Flag]:
    """Turn what is beyond its limit into flags that say where, and what it means for the map.

    ``position`` writes the place of (N, 3) points, RAS mm.
    """
    flags = []
    for finding in findings:
        if finding.raised:
            consequence = add_consequence(finding, sheet)
            location = (
                f", near {position(finding.points)}"
                if len(finding.points) and not finding.placed
                else ""
            )
            flags.append(
                Flag(
                    reason=finding.reason,
                    message=f"{finding.text}{location}: {finding.remedy}"
                    + consequence_text(consequence),
                    value=float(finding.value),
                    limit=float(finding.limit),
                    points=finding.points,
                    share=consequence.share,
                    change=consequence.change,
                )
            )
    return flags


def add_consequence(finding: Finding, sheet: Sheet) -> Finding:
    """Add which share of the columns the points of a finding concern, and what that does.

    The mean thickness, weighted by area, is compared with that of a map in which the columns near
    these points are as those around them. A share that is known already is left as it is.
    """
    if not len(finding.points) or not np.isnan(finding.share):
        return finding
    near = columns_near(sheet, finding.points, FLAG_REACH)
    thickness, area = measure_thickness(sheet), column_area(sheet)
    valid = np.isfinite(thickness) & np.isfinite(area)
    change = float("nan")
    if (valid & ~near).any():
        step = np.where(near, thickness - spread_over(thickness, near | ~valid), 0.0)[valid]
        change = float((step * area[valid]).sum() / area[valid].sum())
    return replace(finding, share=float(near.mean()), change=change)


def columns_near(sheet: Sheet, points: Float, reach: float) -> Bool:
    """Columns (Nx, Ny) of which any point lies within ``reach`` mm of points (N, 3)."""
    valid = np.isfinite(sheet.points).all(axis=-1)
    near = np.zeros(valid.shape, dtype=bool)
    gap = cKDTree(points).query(sheet.points[valid], distance_upper_bound=reach)[0]
    near[valid] = np.isfinite(gap)
    return np.asarray(near.any(axis=2))


def spread_over(values: Float, mask: Bool) -> Float:
    """Replace values (Nx, Ny) by the smoothest continuation of the others, a harmonic function."""
    inner, outer = np.flatnonzero(mask), np.flatnonzero(~mask)
    result = values.ravel().copy()
    if len(inner) and len(outer):
        rows = _grid_laplace(values.shape)[inner]
        result[inner] = spsolve(rows[:, inner].tocsc(), -rows[:, outer] @ result[outer])
    return np.asarray(result.reshape(values.shape))


@lru_cache(maxsize=1)
def _grid_laplace(shape: tuple[int, int]) -> sparse.csr_array:
    """Laplace operator of the graph of columns."""
    number = np.arange(shape[0] * shape[1]).reshape(shape)
    first = np.concatenate([number[1:].ravel(), number[:, 1:].ravel()])
    second = np.concatenate([number[:-1].ravel(), number[:, :-1].ravel()])
    edges = sparse.coo_array((np.ones(first.size), (first, second)), shape=(number.size,) * 2)
    weights = (edges + edges.T).tocsr()
    return sparse.csr_array(sparse.diags_array(weights.sum(axis=1)) - weights)


def consequence_text(finding: Finding) -> str:
    """Write what a finding means for the map, to follow its message; empty if that is unknown."""
    if np.isnan(finding.share):
        return ""
    if finding.share == 0:
        return "; no measured column lies near"
    extent = "all columns" if finding.share == 1 else f"{finding.share:.1%} of the columns"
    if np.isnan(finding.change):
        return f"; it concerns {extent}"
    change = "the same" if abs(finding.change) < _NEGLIGIBLE else f"{abs(finding.change):.2f} mm "
    if abs(finding.change) >= _NEGLIGIBLE:
        change += "less" if finding.change > 0 else "more"
    if finding.share == 1:
        return f"; it concerns all columns, the mean thickness may be {change}"
    return f"; it concerns {extent}: were they as those around them, the mean would be {change}"
