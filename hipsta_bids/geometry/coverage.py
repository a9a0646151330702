"""Whether the sheet covers what is labeled, and whether labels cover the whole sheet.

The sheet ends early where a subfield of an edge is missing, and where an edge is too thin for the
voxels: extents and areas are too small then, and columns slide along x, at a plausible thickness.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from hipsta_bids.geometry.body import Body
from hipsta_bids.geometry.checks import voxel_across
from hipsta_bids.geometry.measures import extent_x, measure_thickness
from hipsta_bids.geometry.sheet_checks import known, node_step
from hipsta_bids.protocols.protocol import LATERAL_END, MEDIAL_END, Tissue
from hipsta_bids.settings import CheckSettings
from hipsta_bids.types import Finding, Float, Sheet

#: Rows may lack so much of a subfield, mm: less does not move the other columns.
LEAST_WIDTH = 1.0
#: Labels farther from the sheet than this are lost, mm: no sound phantom has any.
LOST_BEYOND = 1.5
#: Labels of an edge are compared with its columns up to this x, whatever their subfield is.
EDGE_SHARE = 0.2
#: An edge is as thick as its columns up to this x.
THIN_SHARE = 0.1

Edge = tuple[str, tuple[Tissue, ...], slice]
"""Name, subfields, and order of the columns from it."""
EDGES: tuple[Edge, ...] = (
    ("medial", MEDIAL_END, slice(None)),
    ("lateral", LATERAL_END, slice(None, None, -1)),
)


def check_coverage(
    sheet: Sheet,
    whole: Sheet,
    subfield: NDArray[np.uint8],
    body: Body,
    settings: CheckSettings,
) -> list[Finding]:
    """Compare the sheet and its labels in all ways of this module.

    ``whole`` reaches from edge to edge; ``subfield`` (Nx, Ny) are values of Tissue.
    """
    return [
        *check_subfields(sheet, subfield, settings),
        *check_lost_labels(whole, subfield, body, settings),
        *check_thin_edges(sheet, body, settings),
    ]


def check_subfields(
    sheet: Sheet, subfield: NDArray[np.uint8], settings: CheckSettings
) -> list[Finding]:
    """Flag the subfield that most rows lack, between rows that have it or up to an end.

    ``subfield`` (Nx, Ny) are values of Tissue. Protocols label CA1 and the subfields of both edges
    all along the body. Where CA2 stands for CA3, or the presubiculum for the subiculum, the sheet
    is as wide, and no row lacks a subfield.
    """
    whole = _gap("", 0.0, settings.flag_subfield_gap, np.zeros((0, 3)), 0.0)
    gaps = _gaps(sheet.points[:, :, sheet.middle], subfield, settings)
    return [max([whole, *gaps], key=lambda finding: finding.margin)]


def _gaps(middle: Float, subfield: NDArray[np.uint8], settings: CheckSettings) -> Iterator[Finding]:
    step, lengths = node_step(middle, axis=1), np.linalg.norm(np.gradient(middle, axis=0), axis=-1)
    lengths = np.nan_to_num(lengths)
    present = np.unique(subfield).tolist()
    for edge, group in ((0, MEDIAL_END), (len(middle) // 2, (Tissue.CA1,)), (-1, LATERAL_END)):
        group_width = np.where(np.isin(subfield, group), lengths, 0.0).sum(axis=0)
        parts = [(tissue,) for tissue in group if tissue in present]
        for tissues in dict.fromkeys((group, *parts)):
            widths = np.where(np.isin(subfield, tissues), lengths, 0.0).sum(axis=0)
            usual = np.median(group_width[widths > 0]) if widths.any() else 0.0
            absent = (widths == 0) & (group_width < usual - LEAST_WIDTH)
            name = " and ".join(Tissue(tissue).name for tissue in tissues if tissue in present)
            for (rows,) in ndimage.find_objects(ndimage.label(absent)[0]):
                size, points = (rows.stop - rows.start) * step, known(middle[edge, rows])
                place, limit = "between rows that have it", settings.flag_subfield_gap
                if rows.start == 0 or rows.stop == len(widths):
                    end = "anterior" if rows.start else "posterior"
                    place, limit = f"up to the {end} end", settings.flag_subfield_end
                text = f"rows lack {name} over {size:.1f} mm {place}"
                yield _gap(text, size, limit, points, len(points) / len(widths))


def _gap(text: str, size: float, limit: float, points: Float, share: float) -> Finding:
    return Finding(
        reason="subfield-gap",
        value=size,
        limit=limit,
        text=text,
        remedy="complete the labels; extent_x and areas are too small",
        points=points,
        share=share,
    )


def check_lost_labels(
    whole: Sheet, subfield: NDArray[np.uint8], body: Body, settings: CheckSettings
) -> list[Finding]:
    """Flag an edge of the sheet beyond which its subfield is labeled: that tissue dropped out.

    ``whole`` reaches from edge to edge; ``subfield`` (Nx, Ny) are values of Tissue. The statistic
    is the share of ``extent_x`` that is lost at least, mean of the rows with labels.
    """
    points, tissue = body.inside_points()[1], body.tissue[body.inside]
    defined, length = np.isfinite(whole.points).all(axis=(2, 3)), np.nanmean(extent_x(whole))
    count, levels = whole.points.shape[1:3]
    findings = []
    for edge, group, order in EDGES:
        labeled, columns = np.isin(tissue, group), np.isin(subfield, group)
        columns[order][: round(EDGE_SHARE * len(columns))] = True
        columns &= defined
        if not labeled.any() or not columns.any():
            continue
        rows = np.repeat(np.nonzero(columns)[1], levels)
        nearest = cKDTree(whole.points[columns].reshape(-1, 3)).query(points[labeled])
        gap, node = map(np.asarray, nearest)
        row, off = rows[node], gap > LOST_BEYOND
        reach = np.zeros(count)
        np.maximum.at(reach, row[off], gap[off])
        excess = reach[np.unique(row)]  # in thick slices, there are rows without labels
        short = float(excess.mean())
        name = " and ".join(Tissue(t).name for t in np.unique(tissue[labeled]))
        findings.append(
            Finding(
                reason="edge-lost",
                value=float(short / (length + short)),
                limit=settings.flag_lost_edge,
                text=f"labels of {name} lie up to {excess.max():.1f} mm beyond the {edge} edge; "
                f"extent_x is {short:.1f} mm ({short / (length + short):.0%}) too small",
                remedy="look for thin labels; columns slide along x",
                points=points[labeled][off],
                share=float((excess > 0).mean()),
            )
        )
    return findings


def check_thin_edges(sheet: Sheet, body: Body, settings: CheckSettings) -> list[Finding]:
    """Flag an edge of the sheet that is hardly thicker than a voxel: labels smooth it away."""
    voxels = np.nan_to_num(measure_thickness(sheet), nan=np.inf) / voxel_across(body)
    findings = []
    for edge, _, order in EDGES:
        columns = voxels[order][: round(THIN_SHARE * len(voxels))]
        across = float(np.median(columns, axis=1).min())
        findings.append(
            Finding(
                reason="edge-thin",
                value=1 / across,
                limit=1 / settings.min_edge_voxels,
                text=f"the {edge} edge of the sheet is {across:.1f} voxels thick; part of this "
                "thin tissue is lost",
                remedy="look for thin labels; extent_x and areas may be too small",
                points=known(sheet.points[order][0, :, sheet.middle]),
                share=1.0,
            )
        )
    return findings
