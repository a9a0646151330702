"""What of a sheet a person should look at, as it does not resemble the sheet beside it.

Rows that are narrower, edges that recede, subfields that are missing, and bands of odd thickness.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from hipsta_bids.geometry.body import Body
from hipsta_bids.geometry.checks import voxel_across
from hipsta_bids.geometry.measures import extent_x, measure_thickness
from hipsta_bids.protocols.protocol import LATERAL_END, MEDIAL_END, Tissue
from hipsta_bids.settings import CheckSettings
from hipsta_bids.types import Finding, Float, Sheet

#: Distance along the axis within which rows are compared, mm.
ROW_DIP_REACH = 8.0
#: Edges are compared with themselves at these distances along the axis on both sides, mm.
EDGE_REACH = (2.5, 3.5, 5.0)
#: Thickness is compared with that at these distances along the axis on both sides, mm.
GROOVE_REACH = (1.0, 2.0, 3.0)
#: Width over which thickness is averaged before grooves are sought, mm.
GROOVE_WIDTH = 4.0
#: The way into the sheet goes from an edge to the columns at this distance from it, mm.
INWARD = 2.5

#: A column is moved by a second choice if its thickness differs by more, mm.
RIVAL_OFF = 0.3

#: Labels farther from the sheet than this are lost, mm: no sound phantom has any.
LOST_BEYOND = 1.2
#: The columns of an edge, of which labels are the nearest in any case, and its last columns.
EDGE_SHARE, LAST_SHARE = 0.2, 0.1

_LEAST_WIDTH = 1.0
"""mm of a subfield that rows may lack: less does not move the other columns."""


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
                points=_known(middle[:, row]),
            )
        )
    return findings


def check_edges(whole: Sheet, settings: CheckSettings) -> list[Finding]:
    """Flag a sheet whose medial or lateral edge recedes between parts that do not.

    Notches, slits and tips without their label are too small to show in the width of the sheet, but
    move the columns of their rows. ``whole`` reaches from edge to edge.
    """
    middle = whole.points[:, :, whole.middle]
    step, count = nodenode_step(middle, axis=1), middle.shape[1]
    inner = min(max(round(INWARD / nodenode_step(middle, axis=0)), 1), middle.shape[0] - 1)
    findings = []
    for name, edge, beside in (("medial", 0, inner), ("lateral", -1, -1 - inner)):
        outline, inward = middle[edge], middle[beside] - middle[edge]
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
                points=_known(outline[max(row - k // 2, 0) : row + k // 2 + 1]),
            )
        )
    return findings


def check_subfields(
    sheet: Sheet, subfield: NDArray[np.uint8], settings: CheckSettings
) -> list[Finding]:
    """Flag rows that lack a subfield of an edge: the edge recedes, or the sheet ends early there.

    They lie between rows that have it, or at an end. ``subfield`` (Nx, Ny) are values of Tissue.
    Presubiculum and subiculum count together, too, and so do CA2 and CA3: with CA1, protocols
    label these all along. Less than a millimeter of a subfield hardly moves the other columns.
    """
    middle = sheet.points[:, :, sheet.middle]
    step, lengths = node_step(middle, axis=1), np.linalg.norm(np.gradient(middle, axis=0), axis=-1)
    edges = {(tissue,): edge for edge in (-1, 0) for tissue in np.unique(subfield[edge]).tolist()}
    edges |= {MEDIAL_END: 0, (Tissue.CA1,): len(middle) // 2, LATERAL_END: -1}
    findings = [_subfield_gap("", 0.0, settings.flag_subfield_gap)]
    for tissues, edge in edges.items():
        widths = np.where(np.isin(subfield, tissues), np.nan_to_num(lengths), 0.0).sum(axis=0)
        name = " and ".join(Tissue(t).name for t in tissues if (subfield == t).any())
        for (rows,) in ndimage.find_objects(ndimage.label(widths == 0)[0]):
            sides = [
                side.max() for side in (widths[: rows.start], widths[rows.stop :]) if side.size
            ]
            if min(sides, default=0.0) < _LEAST_WIDTH:
                continue
            size, points = (rows.stop - rows.start) * step, _known(middle[edge, rows])
            if len(sides) > 1:
                text = f"rows lack {name} over {size:.1f} mm between rows that have it"
                gap = _subfield_gap(text, size, settings.flag_subfield_gap)
            else:
                end = "anterior" if rows.start else "posterior"
                text = f"rows lack {name} over {size:.1f} mm up to the {end} end"
                gap = _subfield_gap(text, size, settings.flag_subfield_end)
            findings.append(replace(gap, points=points, share=len(points) / len(widths)))
    return [max(findings, key=lambda finding: finding.margin)]


def _subfield_gap(text: str, size: float, limit: float) -> Finding:
    return Finding(
        reason="subfield-gap",
        value=size,
        limit=limit,
        text=text,
        remedy="complete the labels; until then, extent_x, areas and positions along x are wrong",
    )


def check_lost_edges(
    sheet: Sheet, whole: Sheet, subfield: NDArray[np.uint8], body: Body, settings: CheckSettings
) -> list[Finding]:
    """Flag a subfield of an edge that is labeled where the sheet is not, and an edge that is thin.

    Tissue of about a voxel drops out when labels are smoothed: the sheet ends early, and columns
    slide. ``whole`` reaches from edge to edge; ``subfield`` (Nx, Ny) are values of Tissue.
    """
    points, tissue = body.inside_points()[1], body.tissue[body.inside]
    thickness = np.nan_to_num(measure_thickness(sheet), nan=np.inf) / voxel_across(body)
    outer, last = round(EDGE_SHARE * len(subfield)), round(LAST_SHARE * len(subfield))
    defined, length = np.isfinite(whole.points).all(axis=(2, 3)), np.nanmean(extent_x(whole))
    findings = []
    for edge, group, way in (("medial", MEDIAL_END, 1), ("lateral", LATERAL_END, -1)):
        among = np.isin(tissue, group)
        near = np.isin(subfield, group)
        near[::way][:outer] = True
        near &= defined
        if not among.any() or not near.any():
            continue
        rows = np.repeat(np.nonzero(near)[1], whole.points.shape[2])
        gap, node = cKDTree(whole.points[near].reshape(-1, 3)).query(points[among])
        row, outside = rows[node], gap > LOST_BEYOND
        reach, count = np.zeros(subfield.shape[1]), np.bincount(row, minlength=subfield.shape[1])
        np.maximum.at(reach, row[outside], gap[outside])
        labeled = count > 0  # there are rows between thick slices
        share = float((np.bincount(row, outside, len(count))[labeled] / count[labeled]).mean())
        name = " and ".join(Tissue(t).name for t in np.unique(tissue[among]))
        short = float(reach[labeled].mean())
        findings.append(
            Finding(
                reason="edge-lost",
                value=share,
                limit=settings.flag_lost_edge,
                text=f"{share:.0%} of {name} lies beyond the {edge} edge of the sheet: extent_x is "
                f"at least {short:.1f} mm ({short / (length + short):.0%}) short",
                remedy="look for thin labels; areas and positions along x are wrong",
                points=points[among][outside],
                share=float((reach > 0)[labeled].mean()),
            )
        )
        across = float(np.median(thickness[::way][:last], axis=1).min())
        findings.append(
            Finding(
                reason="edge-thin",
                value=1 / across,
                limit=1 / settings.min_edge_voxels,
                text=f"the {edge} edge of the sheet is {across:.1f} voxels thick: tissue this thin "
                "is lost in part",
                remedy="look for thin labels; extent_x, areas and positions along x may be wrong",
                points=_known(sheet.points[[0, -1][way < 0], :, sheet.middle]),
                share=1.0,
            )
        )
    return findings


def _known(points: Float) -> Float:
    """Rows of (N, 3) points without NaN."""
    return points[np.isfinite(points).all(axis=1)]


def check_grooves(sheet: Sheet, thickness: Float, settings: CheckSettings) -> Finding:
    """Flag a band across the axis where thickness (Nx, Ny), mm, is less than on both sides.

    A dent, or a bar that was cut, shows in few cross-sections; thickness of a whole sheet changes
    more slowly along the axis.
    """
    middle, limits = sheet.points[:, :, sheet.middle], settings.flag_groove
    columns = max(round(GROOVE_WIDTH / nodenode_step(middle, axis=0)), 1)
    bands = _bands(-thickness, limits, nodenode_step(middle, axis=1), columns)
    excess, size, (column, row) = max(bands, default=(0.0, 0.0, (0, 0)))
    half = columns // 2
    return Finding(
        reason="thickness-groove",
        value=size,
        limit=size / excess if excess else limits[0],
        text=f"a band of the sheet is {size:.1f} mm thinner than the sheet before and behind it",
        remedy="look at the labels there",
        points=_known(middle[max(column - half, 0) : column + half + 1, row]),
    )


def _bands(
    thickness: Float, limits: tuple[float, ...], step: float, columns: int
) -> Iterator[tuple[float, float, tuple[int, int]]]:
    """Thickest band at each distance: times the limit, mm above both sides, and column."""
    for reach, limit in zip(GROOVE_REACH, limits, strict=True):
        k = max(round(reach / step), 1)
        if 2 * k >= thickness.shape[1]:
            continue
        sides = np.maximum(thickness[:, : -2 * k], thickness[:, 2 * k :])
        above = np.nan_to_num(thickness[:, k:-k] - sides)
        band = ndimage.uniform_filter1d(above, columns, axis=0)
        at = np.unravel_index(band.argmax(), band.shape)
        size = max(float(band[at]), 0.0)
        yield size / limit, size, (int(at[0]), int(at[1]) + k)


def nodenode_step(middle: Float, axis: int) -> float:
    """Median distance of neighboring nodes of the mid-surface (Nx, Ny, 3) along an axis, mm."""
    return float(np.nanmedian(np.linalg.norm(np.diff(middle, axis=axis), axis=-1)))


def _wider(lengths: Float, middle: Float, reach: float) -> Float:
    """Width (Ny,) that rows within ``reach`` mm attain on both sides of each row."""
    rows = np.arange(len(lengths))
    offset = rows[None, :] - rows[:, None]
    near = np.abs(offset) <= max(round(reach / nodenode_step(middle, axis=1)), 1)
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
