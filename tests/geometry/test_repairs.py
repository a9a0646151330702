"""What repairs do to thickness, on plates of which it is known."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from test_columns import BENT, HIGH, LOW, at, flat_sheet, plate_field

from hipsta_bids.geometry.measures import column_area
from hipsta_bids.geometry.repairs import doubtful_columns, repair_metrics
from hipsta_bids.geometry.topology import SolidField, repaired_columns
from hipsta_bids.types import Finding

DENT = 0.4  # mm


def solid_of(before, touched, gaps=None):
    """A plate whose labels were ``before``, repaired at nodes, and had gaps at nodes."""
    return SolidField(
        field=replace(plate_field(at(LOW), at(HIGH)), cavities=gaps),
        before=before,
        repairs=(),
        touched=touched,
        euler_before=1,
        euler_after=1,
        changed_fraction=0.0,
    )


def dented(points):
    """The upper wall lies deeper beyond y = 10 mm."""
    return np.where(points[..., 1] > 10, HIGH - DENT, HIGH)


def test_a_filled_dent_raises_the_mean_by_its_depth_and_share():
    sheet, before = flat_sheet(), plate_field(at(LOW), dented)
    y = sheet.points[:, :, 0, 1]
    far = y > 11  # the dent has a slope
    solid = solid_of(before, np.ones(before.values.shape, dtype=bool))
    share = column_area(sheet)[far].sum() / column_area(sheet).sum()
    body = SimpleNamespace(uncus=())
    metrics = repair_metrics(sheet, solid, far, body)
    # The spline rounds the corner of the dent.
    assert metrics["repaired_change_mm"] == pytest.approx(DENT * share, abs=BENT)
    assert metrics["repaired_fraction"] == far.mean()
    near = repair_metrics(sheet, solid, y < 9, body)
    assert near["repaired_change_mm"] == pytest.approx(0, abs=BENT / 4)
    assert repair_metrics(sheet, solid, np.zeros_like(far), body)["repaired_change_mm"] == 0


def test_a_stump_is_doubtful_and_a_filled_gap_is_not():
    sheet = flat_sheet()
    points, at_column = sheet.points.copy(), (7, 4)
    points[*at_column, -1, 0] += 0.3
    points[2, 2, -1, 0] += 0.04
    sheet = replace(sheet, points=points)
    field = plate_field(at(LOW), at(HIGH))
    near = [
        np.linalg.norm(field.grid.node_points() - points[*column, 4], axis=-1) < 0.3
        for column in (at_column, (2, 2), (12, 6))
    ]
    touched = np.logical_or.reduce(near)
    solid = solid_of(field, touched)
    assert repaired_columns(sheet, solid)[(7, 2, 12), (4, 2, 6)].all()
    (column,) = np.argwhere(doubtful_columns(sheet, solid, []))
    assert tuple(column) == at_column
    gap = solid_of(field, touched, gaps=near[0])
    assert not doubtful_columns(sheet, gap, []).any()
    for value, flagged in ((0.9, False), (1.1, True)):
        flag = Finding(
            reason="noise", value=value, limit=1.0, text="", remedy="", points=points[0, 0]
        )
        marked = doubtful_columns(sheet, gap, [flag])
        assert marked[0, 0] == flagged
        assert not marked[3:].any()
