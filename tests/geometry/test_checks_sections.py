"""Cross-sections and rows that differ from their neighbors, located."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from geometry_cases import resampled, short_phantom
from grids import straight_grid

from hipsta_bids.geometry import sheet_checks
from hipsta_bids.geometry.body import Body, extract_body
from hipsta_bids.geometry.checks import check_cross_sections
from hipsta_bids.geometry.grid import Field
from hipsta_bids.geometry.sheet_checks import (
    check_edges,
    check_rows,
)
from hipsta_bids.phantom import Phantom
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.settings import BodySettings, CheckSettings
from hipsta_bids.types import Sheet

CHECKS = CheckSettings()


@dataclass(frozen=True, kw_only=True)
class Ribbon:
    """A phantom with its body and field."""

    phantom: Phantom
    body: Body
    field: Field


@pytest.fixture(scope="module")
def ribbon():
    """An arc, 16 mm long: a defect of some millimeters is an exception on it."""
    phantom = short_phantom(length=16.0)
    body = extract_body(phantom.label_volume(load_protocol("freesurfer")), BodySettings())
    return Ribbon(phantom=phantom, body=body, field=resampled(body))


def place_of(finding):
    return finding.points.mean(axis=0)


def raised(findings):
    """What is beyond its limit."""
    return [finding for finding in findings if finding.raised]


def ball(field, middle, radius):
    """Nodes within a radius (mm) of a point."""
    points = field.grid.node_points()
    return np.linalg.norm(points - middle, axis=-1) < radius


def changed(field, where, value):
    return replace(field, values=np.where(where, np.float32(value), field.values))


def wall(case, u, n):
    """Point at the middle of the body, ``n`` mm from the mid-surface."""
    return case.phantom.body.place(np.array([u]), 0.5, n)[0]


def test_sound_bodies_have_no_flags(ribbon):
    assert raised(check_cross_sections(ribbon.field, 0.4, CHECKS)) == []


def test_a_leak_is_flagged_where_it_is(ribbon):
    middle = wall(ribbon, 0.5, 1.5)
    leak = changed(ribbon.field, ball(ribbon.field, middle, 1.6), 0.5)
    (flag,) = raised(check_cross_sections(leak, 0.4, CHECKS))
    assert flag.reason == "section-bump"
    assert np.linalg.norm(place_of(flag) - middle) < 1.0  # mm, the ball's part outside the wall


def test_a_notch_is_flagged_where_it_is(ribbon):
    middle = wall(ribbon, 0.85, 0.0)
    notch = changed(ribbon.field, ball(ribbon.field, middle, 2.0), -0.5)
    (flag,) = raised(check_cross_sections(notch, 0.4, CHECKS))
    assert flag.reason == "section-notch"
    assert np.linalg.norm(place_of(flag) - middle) < 1.0  # mm, the ball's part inside the wall


def test_a_bar_through_the_interior_is_flagged_where_it_is(ribbon):
    """Behind the interior wall lies the dentate gyrus, before and after the bar."""
    middle = wall(ribbon, 0.75, -1.6)
    bar = changed(ribbon.field, ball(ribbon.field, middle, 1.1), 0.5)
    flags = {f.reason: f for f in raised(check_cross_sections(bar, 0.4, CHECKS))}
    assert np.linalg.norm(place_of(flags["section-intrusion"]) - middle) < 1.0  # mm, its radius
    found = raised(check_cross_sections(replace(bar, interior=None), 0.4, CHECKS))
    assert "section-intrusion" not in {f.reason for f in found}


def test_stubs_of_a_cut_bridge_are_known(ribbon):
    middle = wall(ribbon, 0.75, -1.6)
    where = ball(ribbon.field, middle, 1.1)
    cuts = ball(ribbon.field, middle, 0.4)
    stubs = changed(changed(ribbon.field, where, 0.5), cuts, -0.1)
    assert raised(check_cross_sections(stubs, 0.4, CHECKS, cuts)) == []
    assert raised(check_cross_sections(stubs, 0.4, CHECKS)) != []


def test_what_is_odd_depends_on_the_body_s_other_cross_sections(ribbon):
    """A leak that is flagged on a smooth body is none on one that is rough everywhere."""
    leak = changed(ribbon.field, ball(ribbon.field, wall(ribbon, 0.5, 1.5), 1.2), 0.5)
    rough = np.random.default_rng(2).random(leak.values.shape) < 0.1
    shell = np.abs(ribbon.field.values) < 0.45  # noise near the surface only
    noisy = replace(leak, values=np.where(rough & shell, -leak.values, leak.values))
    found = raised(check_cross_sections(leak, 0.4, CHECKS))
    assert [f.reason for f in found] == ["section-bump"]
    assert raised(check_cross_sections(leak, 2.0, CHECKS)) == []  # slices of 2 mm vary as much
    assert raised(check_cross_sections(noisy, 0.4, CHECKS)) == []


def rows_of(widths, spacing=0.8):
    """A flat sheet whose rows have these widths, mm."""
    x = np.linspace(-0.5, 0.5, 11)
    y = spacing * np.arange(len(widths))
    z = np.linspace(0, 2, 3)
    points = np.zeros((len(x), len(y), len(z), 3))
    points[..., 0] = x[:, None, None] * np.asarray(widths)[None, :, None]
    points[..., 1] = y[None, :, None]
    points[..., 2] = z
    return Sheet(points=points, valid=np.ones(points.shape[:2], dtype=bool))


@pytest.mark.parametrize(
    ("widths", "wanted"),
    [
        ([20.0] * 21, []),
        (np.linspace(24, 16, 21), []),  # tapers
        ([20.0] * 10 + [16.0] * 11, ["extent-jump"]),
        (20 - 6 * np.exp(-(((np.arange(21) - 10) / 3.0) ** 2)), ["extent-dip"]),
        (20 - 2 * np.exp(-(((np.arange(21) - 10) / 3.0) ** 2)), []),
        (20 - 4 * np.cos(np.linspace(-1, 1, 21) * np.pi / 4), []),  # narrow all along
    ],
)
def test_rows_that_jump_or_dip(widths, wanted):
    flags = raised(check_rows(rows_of(widths), CHECKS))
    assert [flag.reason for flag in flags] == wanted
    for flag in flags:
        assert place_of(flag)[1] == pytest.approx(0.8 * 10, abs=0.8)  # mm, one row


def test_dips_are_sought_within_a_reach(monkeypatch):
    widths = 20 - 6 * np.exp(-(((np.arange(21) - 10) / 3.0) ** 2))
    assert raised(check_rows(rows_of(widths), CHECKS)) != []
    monkeypatch.setattr(sheet_checks, "ROW_DIP_REACH", 2.0)
    assert raised(check_rows(rows_of(widths), CHECKS)) == []


def notched(depth, rows, edge):
    """A flat sheet of 20 x 16 mm with an edge that recedes in some rows, 0.8 mm apart."""
    sheet = rows_of(np.full(21, 20.0))
    points = sheet.points.copy()
    x = np.linspace(0, 1, points.shape[0])
    share = (1 - x) if edge == "medial" else -x
    points[:, rows, :, 0] += depth * share[:, None, None]
    return Sheet(points=points, valid=sheet.valid)


@pytest.mark.parametrize("edge", ["medial", "lateral"])
@pytest.mark.parametrize(
    ("depth", "rows", "flagged"),
    [
        (2.5, slice(9, 12), True),
        (0.5, slice(9, 12), False),  # as rough as real edges
        (-2.5, slice(9, 12), False),  # a tongue
        (3.0, slice(12, 21), False),  # the sheet narrows at its end
    ],
)
def test_an_edge_that_recedes_is_flagged_where_it_does(edge, depth, rows, flagged):
    sheet = notched(depth, rows, edge)
    found = check_edges(sheet, CHECKS)
    assert [finding.raised for finding in found] == [
        flagged and edge == name for name in ("medial", "lateral")
    ]
    if flagged:
        (flag,) = raised(found)
        assert flag.value == pytest.approx(depth)
        end = sheet.points[0 if edge == "medial" else -1, 10, 1]
        assert np.linalg.norm(place_of(flag) - end) < 1.3  # mm, a row and a part of the notch


@pytest.mark.parametrize("beyond", [0, 3])
def test_shares_of_a_notch_a_bump_and_an_intrusion(beyond):
    """10 x 8 nodes in each section, half a mm apart; levels beyond the planes do not count."""
    values = np.full((24, 12, 24 + 2 * beyond), -0.5, dtype=np.float32)
    values[2:12, 2:10] = 0.5
    interior, at = np.zeros(values.shape, dtype=bool), beyond + 11
    interior[12:22, 2:10] = True
    field = Field(grid=straight_grid(values.shape), values=values.copy(), interior=interior)
    plain = Field(grid=straight_grid((24, 12, 3)), values=values[:, :, 8:11])
    assert [f.value for f in check_cross_sections(plain, 0.4, CHECKS)] == [0, 0, 0]
    field.values[10:12, 2:10, at - 2 : at + 3] = -0.5
    field.values[2:7, 10, at], field.values[12:14, 2:6, at - 1] = 0.5, 0.5
    field.values[2:, 2:, :beyond] = 0.5
    for step, noise in ((0.4, 0.02), (2.5, 0.05)):
        notch, bump, intrusion = check_cross_sections(replace(field, beyond=beyond), step, CHECKS)
        assert (notch.value, notch.limit) == (pytest.approx(16 / 64), 0.3)
        assert bump.value == intrusion.value == pytest.approx(8 / 80)
        assert intrusion.limit == pytest.approx(CHECKS.intrusion_contrast * noise)
        assert bump.limit == pytest.approx(CHECKS.bump_contrast * noise)
        place = [[x / 2, y / 2, at / 2 - 0.5] for x in (12, 13) for y in (2, 3, 4, 5)]
        assert bump.points.tolist() == intrusion.points.tolist() == place


def test_rows_are_compared_with_the_widest_within_a_reach_on_both_sides():
    middle = rows_of(np.ones(6), spacing=0.4).points[:, :, 1]
    wider = sheet_checks._wider(np.array([1.0, 5, 2, 1, 3, 0]), middle, 0.8)
    assert wider.tolist() == [1, 5, 3, 3, 3, 0]
