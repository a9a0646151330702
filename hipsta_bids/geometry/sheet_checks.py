"""What of a sheet a person should look at, as it does not resemble the neighboring sheet.

Rows that are narrower, edges that recede, and maps that a second choice moves.
"""

import numpy as np
from scipy import ndimage

from hipsta_bids.settings import CheckSettings
from hipsta_bids.types import Finding, Float, Sheet

#: Distance along the axis within which rows are compared, mm.
ROW_DIP_REACH = 8.0
#: Edges are compared with themselves at these distances along the axis on both sides, mm.
EDGE_REACH = (2.5, 3.5, 5.0)
#: The way into the sheet goes from an edge to the columns at this distance from it, mm.
INWARD = 2.5

#: A column is moved by a second choice if its thickness differs by more, mm.
RIVAL_OFF = 0.3


def check_rows(sheet: Sheet, settings: CheckSettings) -> list[Finding]:
    """Flag a sheet whose medial-to-lateral length jumps from row to row, or dips."""
    middle = sheet.points[:, :, sheet.middle]
    lengths = np.linalg.norm(np.diff(middle, axis=0), axis=-1).sum(axis=0)
    jumps = np.abs(np.diff(lengths)) / np.minimum(lengths[1:], lengths[:-1])
    jumps[[0, -1]] /= 2  # a plane may cut the sheet where it flares
    dips = 1 - lengths / _wider(lengths, middle, ROW_DIP_REACH)
    findings = []
    for reason, change, limit, description in (
        ("extent-jump", jumps, settings.flag_row_jump, "changes by {} from one row to the next"),
        ("extent-dip", dips, settings.flag_row_dip, "dips by {}"),
    ):
        row = int(np.nanargmax(change))
        findings.append(
            Finding(
                reason=reason,
                value=float(change[row]),
                limit=limit,
                text=f"the sheet's width {description.format(f'{change[row]:.0%}')}",
                remedy="look for missing or added parts in the labels",
                points=known(middle[:, row]),
            )
        )
    return findings


def check_edges(whole: Sheet, settings: CheckSettings) -> list[Finding]:
    """Flag a sheet whose medial or lateral edge recedes between parts that do not.

    Notches, slits and tips without their label are too small to show in the width of the sheet, but
    move the columns of their rows. ``whole`` reaches from edge to edge.
    """
    middle = whole.points[:, :, whole.middle]
    step, count = node_step(middle, axis=1), middle.shape[1]
    inner = min(max(round(INWARD / node_step(middle, axis=0)), 1), middle.shape[0] - 1)
    findings = []
    for name, edge, inward_row in (("medial", 0, inner), ("lateral", -1, -1 - inner)):
        outline, inward = middle[edge], middle[inward_row] - middle[edge]
        best = (0.0, 0.0, settings.flag_edge[0], 0, 0)
        for reach, limit in zip(EDGE_REACH, settings.flag_edge, strict=True):
            k = max(round(reach / step), 1)
            if 2 * k >= count:
                continue
            towards = ndimage.uniform_filter1d(np.nan_to_num(inward), 2 * k + 1, axis=0)[k:-k]
            towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-9)
            behind, front = (
                outline[k:-k] - outline[part] for part in (slice(-2 * k), slice(2 * k, None))
            )
            depth = np.minimum(*((gap * towards).sum(axis=1) for gap in (behind, front)))
            row = int(np.nan_to_num(depth).argmax())
            size = max(float(np.nan_to_num(depth)[row]), 0.0)
            best = max(best, (size / limit, size, limit, row + k, k))
        _, size, limit, row, k = best
        findings.append(
            Finding(
                reason="edge-notch",
                value=size,
                limit=limit,
                text=f"the {name} edge of the sheet recedes by {size:.1f} mm",
                remedy="look for a notch or a missing tip in the labels",
                points=known(outline[max(row - k // 2, 0) : row + k // 2 + 1]),
            )
        )
    return findings


def known(points: Float) -> Float:
    """Return the rows of (N, 3) points without NaN."""
    return points[np.isfinite(points).all(axis=1)]


def node_step(middle: Float, axis: int) -> float:
    """Median distance of neighboring nodes of the mid-surface (Nx, Ny, 3) along an axis, mm."""
    return float(np.nanmedian(np.linalg.norm(np.diff(middle, axis=axis), axis=-1)))


def _wider(lengths: Float, middle: Float, reach: float) -> Float:
    """Width (Ny,) that rows within ``reach`` mm attain on both sides of each row."""
    rows = np.arange(len(lengths))
    offset = rows[None, :] - rows[:, None]
    near = np.abs(offset) <= max(round(reach / node_step(middle, axis=1)), 1)
    before = np.where(near & (offset <= 0), lengths, -np.inf).max(axis=1)
    after = np.where(near & (offset >= 0), lengths, -np.inf).max(axis=1)
    return np.asarray(np.minimum(before, after))


def check_rival(thickness: Float, choice: str, rival: Float, settings: CheckSettings) -> Finding:
    """Flag a map (Nx, Ny), mm, that a second choice, as likely as the first, moves by much."""
    difference = rival - thickness
    moved = np.abs(difference) > RIVAL_OFF
    rms = rms_difference(rival, thickness)
    return Finding(
        reason="second-choice",
        value=rms,
        limit=settings.flag_rival,
        text=f"another {choice} is as likely and moves {moved.mean():.0%} of the columns by over "
        f"{RIVAL_OFF:g} mm (RMS {rms:.2f} mm)",
        remedy="look at the labels there",
        share=float(moved.mean()),
        change=float(np.nanmean(difference)),
    )


def rms_difference(first: Float, second: Float) -> float:
    """Compute the root mean square of the difference of two maps, where both have values."""
    return float(np.sqrt(np.nanmean((first - second) ** 2)))
