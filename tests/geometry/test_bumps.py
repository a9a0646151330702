"""Bumps on walls of sheets from formulas: which are flagged, and where."""

from dataclasses import replace

import numpy as np
import pytest
from sheet_cases import grid, plates, sheet_of

from hipsta_bids.geometry import bumps
from hipsta_bids.geometry.bumps import GAP, REACH, check_bumps, check_swollen_ends, predictor
from hipsta_bids.settings import CheckSettings
from hipsta_bids.types import MAD_TO_SD

CHECKS = CheckSettings()
LENGTH, WIDTH, THICKNESS = 20.0, 20.0, 1.8


def pipe(exterior=0.0, interior=0.0):
    """Half a pipe, 20 x 20 mm, whose walls stand out by (41, 21) mm; x, y and points."""
    x, y, z = grid()
    inner, outer = (np.broadcast_to(np.asarray(out, dtype=float), (41, 21))[..., None]
                    for out in (interior, exterior))  # fmt: skip
    r = WIDTH / np.pi + THICKNESS * (z - 0.5) - inner * (1 - z) + outer * z
    return sheet_of(np.stack([r * np.cos(np.pi * x), r * np.sin(np.pi * x), LENGTH * y], axis=-1))


def ball(size, x, y, radius=0.8):
    """Height (41, 21), mm, of a round bump at a position in mm along both axes."""
    across, along = np.meshgrid(
        np.linspace(0, WIDTH, 41), np.linspace(0, LENGTH, 21), indexing="ij"
    )
    far = ((across - x) ** 2 + (along - y) ** 2) / radius**2
    return size * np.maximum(1 - far, 0) ** 0.5


def raised(sheet):
    return [finding for finding in check_bumps(sheet, CHECKS) if finding.raised]


@pytest.mark.parametrize("wall", ["interior", "exterior"])
@pytest.mark.parametrize("y", [0.0, 1.0, 9.0, 20.0])
@pytest.mark.parametrize("x", [1.0, 10.0])
def test_a_bump_is_flagged_where_it_is(wall, x, y):
    """Also in the first and last rows, which have neighbors on one side only."""
    sheet = pipe(**{wall: ball(1.0, x, y)})
    (flag,) = raised(sheet)
    assert flag.reason == "wall-bump"
    assert flag.text.startswith(f"the {wall} wall stands out")
    assert "1.0 mm thicker" in flag.text
    middle = sheet.points[round(2 * x), round(y), 0 if wall == "interior" else -1]
    assert np.linalg.norm(flag.points - middle, axis=1).max() < 2.0  # mm
    assert np.linalg.norm(flag.points.mean(axis=0) - middle) < 0.6


@pytest.mark.parametrize("wall", ["interior", "exterior"])
@pytest.mark.parametrize("y", [1.0, 9.0, 19.0])
def test_a_dent_is_flagged_where_it_is(wall, y):
    sheet = pipe(**{wall: -ball(1.0, 10, y)})
    (flag,) = raised(sheet)
    assert flag.reason == "wall-dent"
    assert flag.text.startswith(f"the {wall} wall recedes: the sheet is 1.0 mm thinner")
    middle = sheet.points[20, round(y), 0 if wall == "interior" else -1]
    assert np.linalg.norm(flag.points.mean(axis=0) - middle) < 0.6  # mm


@pytest.mark.parametrize(("end", "y"), [("posterior", 0.0), ("anterior", 20.0)])
def test_an_end_swollen_over_more_than_bumps_cover_is_flagged(end, y):
    sheet = pipe(exterior=ball(3.0, 10, y, radius=5.0))
    flags = [finding for finding in check_swollen_ends(sheet, CHECKS) if finding.raised]
    assert [flag.reason for flag in flags] == ["end-swollen"]
    assert end in flags[0].text
    middle = sheet.points[20, round(y), sheet.middle]
    assert np.linalg.norm(flags[0].points.mean(axis=0) - middle) < 1.5  # mm
    # As thick as that everywhere, or thicker steadily: no swelling.
    for wall in (2.5, np.linspace(0, 2.5, 21), ball(3.0, 10, 10, radius=5.0)):
        found = check_swollen_ends(pipe(exterior=wall), CHECKS)
        assert not any(finding.raised for finding in found)


def test_a_band_over_part_of_the_width_is_a_bump():
    sheet = pipe(exterior=2.5 * np.outer(np.abs(np.arange(41) - 20) < 6, np.arange(21) == 9))
    (flag,) = [flag for flag in raised(sheet) if flag.reason == "wall-bump"]
    assert "2.5 mm thicker" in flag.text


def test_two_bumps_are_two_findings():
    flags = raised(pipe(exterior=ball(1.0, 5, 9) + ball(1.2, 14, 10)))
    assert len(flags) == 2


@pytest.mark.parametrize(
    "sheet",
    [
        pipe(),
        pipe(exterior=ball(0.3, 10, 9)),  # as little as voxels do
        pipe(exterior=np.linspace(-0.4, 0.9, 21)),
        pipe(exterior=np.where(np.arange(41) > 20, 0.8, 0.0)[:, None]),  # a subfield's border
        pipe(exterior=0.9 * (np.abs(np.arange(41) - 20) < 3)[:, None]),  # a fold along the axis
        pipe(exterior=np.where(np.arange(21) > 9, 0.8, 0.0)),  # a step
        pipe(exterior=0.9 * (np.arange(21) == 9)),  # a band across the axis
        pipe(exterior=ball(1.0, 10, 9), interior=-ball(1.0, 10, 9)),  # a fold of both walls
        pipe(exterior=2.5 * ball(1.0, 10, 10, radius=12.0) ** 2),  # wide
    ],
)
def test_what_is_no_bump_passes(sheet):
    assert raised(sheet) == []


def test_a_bump_on_a_rough_sheet_is_none():
    noise = np.random.default_rng(3).normal(scale=0.3, size=(2, 41, 21))
    bump = ball(1.0, 10, 9)
    flags = raised(pipe(exterior=noise[0] + bump, interior=noise[1]))
    assert "wall-bump" not in [flag.reason for flag in flags]
    assert raised(pipe(exterior=bump + 0.1 * noise[0], interior=0.1 * noise[1])) != []


def test_undefined_columns_are_no_bumps():
    points = pipe(exterior=ball(1.0, 10, 9)).points.copy()
    points[30:33, 5:8] = np.nan
    (flag,) = raised(replace(pipe(), points=points))
    assert np.isfinite(flag.points).all()
    assert np.linalg.norm(flag.points - points[20, 9, -1], axis=1).max() < 2.0


def test_a_sheet_too_short_for_neighbors_is_passed_over():
    points = pipe(exterior=ball(1.0, 10, 9)).points * [1, 1, 0.3]
    assert check_bumps(sheet_of(points), CHECKS) == []
    assert check_swollen_ends(sheet_of(points * [1, 1, 0.4]), CHECKS) == []


def test_lines_are_predicted_exactly_without_what_is_near():
    step = 0.9
    at = step * np.arange(21)
    matrix = predictor(21, step)
    np.testing.assert_allclose(matrix @ (2 - 0.3 * at), 2 - 0.3 * at, atol=1e-10)
    near = np.abs(at - at[:, None]) <= GAP
    assert not matrix[near].any()
    # The closed form is the weighted regression of each row.
    for row in (0, 4, 20):
        weight = np.exp(-((at - at[row]) ** 2) / (4 * REACH**2)) * ~near[row]  # square roots
        values = np.random.default_rng(row).normal(size=21)
        slope = np.polyfit(at, values, 1, w=weight)
        assert matrix[row] @ values == pytest.approx(np.polyval(slope, at[row]))


def test_a_bump_on_plates_has_a_known_score():
    """Its height in SDs of departures from lines along either axis, over the least roughness."""
    points = plates().points.copy()
    points[20, 9, :, 2] *= np.linspace(1, 1.5, 9)  # the exterior wall stands out by 0.85 mm
    points[20, 9, :, 2] = np.linspace(0, 1.7 + 0.85, 9)
    (found,) = check_bumps(sheet_of(points), CHECKS)
    sizes = [np.linalg.norm(np.append(predictor(n, step)[row], 1.0))
             for n, step, row in ((41, 0.3, 20), (21, 0.4, 9))]  # fmt: skip
    assert found.value == pytest.approx(0.85 / np.sqrt(np.prod(sizes)) / CHECKS.smooth_wall)
    np.testing.assert_allclose(found.points, [points[20, 9, -1]])
    outward = bumps._stand_out(points[:, :, [0, -1]], predictor(21, 0.4))[20, 9]
    np.testing.assert_allclose(outward, [0, 0.85 / sizes[1]], atol=1e-12)
    for share, count in ((6.5 / 8, 0), (6.7 / 8, 1)):  # three times the gap are 6.6 mm
        assert len(check_bumps(sheet_of(points * [1, share, 1]), CHECKS)) == count


def test_roughness_is_half_of_the_wall_and_half_of_the_band():
    departure = np.arange(15.0)[:, None, None] * [[1, -2], [-1, 2], [1, 2]]
    wall, band = 7.0, np.r_[2, 2.5, 3, 3.5, 4:11, 10.5, 11, 11.5, 12]
    expected = MAD_TO_SD * np.sqrt((band**2 + wall**2) / 2)
    np.testing.assert_allclose(bumps._roughness(departure)[:, 0, 0], expected)


def test_an_end_is_compared_with_rows_three_to_eight_millimeters_farther_in():
    """Over 4.5 mm along x, which are nine columns, of which five are thicker by 1 mm."""
    rows = np.where(np.arange(21) < 2, 1.0, 0.0) + np.where(np.arange(21) >= 8, 5.0, 0.0)
    rows[2], rows[3] = 9.0, -9.0  # one of five: the median does not mind
    sheet = pipe(exterior=np.outer(np.abs(np.arange(41) - 20) < 3, rows))
    posterior, _ = check_swollen_ends(sheet, CHECKS)
    assert posterior.value == pytest.approx(5 / 9, abs=1e-3)
    assert len(posterior.points) == 2 * 9
    assert np.ptp(posterior.points[:, 2]) == pytest.approx(1.0)
