"""A sheet that does not cover what is labeled, or lacks a subfield in some rows."""

import re

import numpy as np
import pytest
from geometry_cases import plain_body, straight_ends
from sheet_cases import grid, plates, sheet_of

from hipsta_bids.geometry.coverage import check_lost_labels, check_subfields, check_thin_edges
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.settings import CheckSettings

CHECKS = CheckSettings()


def subfields(width, rows, edge):
    """Three subfields on 41 x 21 nodes, of which the one at an edge is missing in some rows."""
    labels = np.full((41, 21), Tissue.CA1, dtype=np.uint8)
    own = slice(width) if edge == "medial" else slice(-width, None)
    labels[own] = Tissue.SUBICULUM if edge == "medial" else Tissue.CA3
    labels[own, rows] = Tissue.CA1
    return labels


@pytest.mark.parametrize("edge", ["medial", "lateral"])
@pytest.mark.parametrize(
    ("width", "rows", "value", "limit"),
    [
        (10, slice(8, 14), 2.4, 1.5),  # rows lie .4 mm apart
        (10, slice(2, 19), 6.8, 1.5),
        (10, slice(8, 11), 1.2, 1.5),
        (10, slice(0, 8), 3.2, 3.0),
        (10, slice(11, 21), 4.0, 3.0),
        (10, slice(0, 7), 2.8, 3.0),  # real subfields may end before the body does
        (10, slice(0, 21), 0.0, 1.5),  # missing everywhere: a check of its own
        (2, slice(8, 14), 0.0, 1.5),  # .6 mm wide: no column moves
        (2, slice(0, 14), 0.0, 1.5),
    ],
)
def test_a_subfield_that_rows_lack_is_flagged(edge, width, rows, value, limit):
    sheet = plates()
    (gap,) = check_subfields(sheet, subfields(width, rows, edge), CHECKS)
    assert gap.value == pytest.approx(value)
    assert gap.limit == limit
    assert gap.raised == (value > limit)
    if value:
        name = "SUBICULUM" if edge == "medial" else "CA3"
        assert gap.text.startswith(f"rows lack {name} over {value} mm")
        where = {0: "posterior end", 11: "anterior end"}
        assert gap.text.endswith(where.get(rows.start, "between rows that have it"))
        assert set(gap.points[:, 0]) == {0.0 if edge == "medial" else 12.0}
        assert len(gap.points) == rows.stop - rows.start
        assert gap.share == pytest.approx(len(gap.points) / 21)


def test_subfields_that_protocols_divide_count_together():
    """CA2 may replace CA3 over short parts of real labels; the sheet ends early without both."""
    labels = subfields(10, slice(0), "lateral")
    labels[28:31] = Tissue.CA2
    labels[31:, 14:] = Tissue.CA2  # .4 mm apart: 2.8 mm without CA3
    (divided,) = check_subfields(plates(), labels, CHECKS)
    assert not divided.raised
    labels[28:, 8:] = Tissue.CA1
    (gone,) = check_subfields(plates(), labels, CHECKS)
    assert gone.value == pytest.approx(5.2)
    assert gone.raised


def test_rows_without_ca1_are_flagged():
    labels = subfields(15, slice(0), "medial")
    labels[:, :8] = Tissue.SUBICULUM
    labels[35:, :] = Tissue.CA3
    (gap,) = check_subfields(plates(), labels, CHECKS)
    assert gap.raised
    assert "CA1 over 3.2 mm up to the posterior end" in gap.text


def labeled_plate(start=0.0, stop=12.0, thickness=1.7):
    """A body of voxels of .4 mm that fills the plates, and thin tissue up to ``start``, 12 mm.

    Subiculum, CA1 and CA3 are 4 mm wide each.
    """
    voxel = 0.4
    shape = (round(stop / voxel), 20, round(thickness / voxel))
    tissue = np.zeros(tuple(n + 2 for n in shape), dtype=np.uint8)
    third = np.repeat([Tissue.SUBICULUM, Tissue.CA1, Tissue.CA3], 10)[: shape[0]]
    tissue[1:-1, 1:-1, 1:-1] = third[:, None, None]
    tissue[1 : 1 + round(start / voxel), :, 3:] = 0  # thin: two voxels
    affine = np.diag([voxel, voxel, voxel, 1.0])
    affine[:3, 3] = -voxel / 2
    return plain_body(tissue, affine, straight_ends(8.0))


def stretched(start, stop=12.0, thickness=1.7):
    """Plates from ``start`` to ``stop``, mm, and their subfields (41, 21)."""
    x, y, z = grid()
    points = np.stack([start + (stop - start) * x, 8 * y, thickness * z], axis=-1)
    thirds = np.array([Tissue.SUBICULUM, Tissue.CA1, Tissue.CA3], dtype=np.uint8)
    return sheet_of(points), thirds[np.clip(points[:, :, 0, 0] // 4, 0, 2).astype(int)]


@pytest.mark.parametrize(("start", "short"), [(0.0, 0.0), (1.6, 0.0), (2.0, 1.8), (3.1, 2.9)])
def test_labels_that_the_sheet_does_not_cover_are_flagged(start, short):
    """Voxels of .4 mm from 0 mm on; the sheet begins at ``start``."""
    body, (sheet, subfield) = labeled_plate(), stretched(start)
    medial, lateral = check_lost_labels(sheet, subfield, body, CHECKS)
    assert (medial.reason, lateral.reason, lateral.value) == ("edge-lost", "edge-lost", 0.0)
    assert medial.value == pytest.approx(short / (12 - start + short), abs=0.015)
    assert medial.raised == (short > 0)
    assert f"({medial.value:.0%}) too small" in medial.text
    if medial.raised:
        assert medial.points[:, 0].max() == pytest.approx(start - 1.5, abs=0.4)
        assert medial.share > 0.9
        assert f"labels of SUBICULUM lie up to {short:.1f} mm beyond the medial edge" in medial.text
        (size,) = re.findall(r"extent_x is ([\d.]+) mm", medial.text)
        assert float(size) == pytest.approx(short, abs=0.2)


def test_labels_lost_in_few_rows_are_no_lost_edge():
    """Such as a detached piece, or the tip of the uncus."""
    body, (sheet, subfield) = labeled_plate(), stretched(0.0)
    points = sheet.points.copy()
    points[:, :5, :, 0] = 3 + points[:, :5, :, 0] * 9 / 12
    medial, _ = check_lost_labels(sheet_of(points), subfield, body, CHECKS)
    assert 0 < medial.value < CHECKS.flag_lost_edge


@pytest.mark.parametrize(("across", "raised"), [(1.3, True), (1.7, False)])
def test_an_edge_of_hardly_more_than_a_voxel_is_flagged(across, raised):
    points = stretched(0.0)[0].points.copy()
    points[-3:, ..., 2] *= across * 0.4 / 1.7
    medial, lateral = check_thin_edges(sheet_of(points), labeled_plate(), CHECKS)
    assert not medial.raised
    assert lateral.raised == raised
    assert lateral.text.startswith(f"the lateral edge of the sheet is {across} voxels thick")


@pytest.mark.parametrize(("left", "raised"), [(6, True), (7, False), (10, False)])
def test_a_narrow_subfield_in_place_of_another_is_flagged(left, raised):
    """CA3 is 3 mm wide; CA2 stands for it, 1.8, 2.1 or 3 mm wide: less by a mm or not."""
    labels = subfields(10, slice(0), "lateral")
    labels[-10:, 8:13] = Tissue.CA1
    labels[-left:, 8:13] = Tissue.CA2
    (gap,) = check_subfields(plates(), labels, CHECKS)
    assert gap.raised is raised
    assert gap.text.startswith("rows lack CA3 over 2.0 mm between" if raised else "")


def test_rows_whose_labels_the_sheet_covers_lose_nothing():
    """In half of the rows, labels begin 2.4 mm before the sheet does."""
    body, (sheet, subfield) = labeled_plate(), stretched(2.6)
    tissue = body.tissue.copy()
    tissue[:7, 11:] = 0
    body = plain_body(tissue, body.affine, body.ends)
    medial, lateral = check_lost_labels(sheet, subfield, body, CHECKS)
    assert medial.share == pytest.approx(0.5, abs=0.03)
    assert medial.value == pytest.approx(1.2 / (9.4 + 1.2), abs=0.01)
    assert (lateral.value, lateral.share) == (0, 0)
