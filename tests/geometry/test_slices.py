"""Shapes between thick slices."""

import numpy as np
import pytest
from geometry_cases import solve_case
from scipy import ndimage

from hipsta_bids.geometry import slices
from hipsta_bids.geometry.body import extract_body
from hipsta_bids.geometry.measures import measure_thickness
from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.schemes import Tissue, load_scheme
from hipsta_bids.settings import Settings

SETTINGS = Settings().slices
PIXEL = 0.2  # mm, fine pixels of a 0.4 mm segmentation


def disc(center: tuple[float, float], radius: float, size: int = 100) -> np.ndarray:
    """Signed distance from a circle, mm, clipped as outlines are."""
    grid = np.indices((size, size)) * PIXEL
    gap = np.hypot(grid[0] - center[0], grid[1] - center[1])
    return np.clip(radius - gap, -SETTINGS.reach, SETTINGS.reach).astype(np.float32)


def test_a_shape_that_moves_sideways_is_found_halfway():
    """Blending in place would give two half shapes where the disc moves by its own radius."""
    below, above = disc((8, 10), 2.0), disc((10, 10), 2.0)
    planes = slices._between(below, above, 2, PIXEL, SETTINGS)
    middle = planes[0] > 0
    assert len(planes) == 2
    assert np.array_equal(planes[1], above)
    assert ndimage.label(middle)[1] == 1
    center = np.array(ndimage.center_of_mass(middle)) * PIXEL
    np.testing.assert_allclose(center, (9, 10), atol=PIXEL / 2)  # half a fine pixel
    # A clipped distance flattens in the middle of the disc; the area may suffer by some per cent.
    assert middle.sum() * PIXEL**2 == pytest.approx(np.pi * 4, rel=0.08)


def test_a_thin_tail_is_kept():
    tissue = np.zeros((40, 60), dtype=np.uint8)
    tissue[15:22, 5:20] = Tissue.CA1
    tissue[18, 20:50] = Tissue.CA1  # one pixel wide: the Gaussian alone would erase it
    outline = slices._outline(tissue, PIXEL, SETTINGS)
    assert ndimage.label(outline > 0)[1] == 1
    assert (outline > 0)[:, 98].any()  # up to its end, in fine pixels


@pytest.mark.parametrize(
    ("gap", "other", "joined"),
    [(2, Tissue.CA1, True), (2, Tissue.SUBICULUM, False), (6, Tissue.CA1, False)],
)
def test_fragments_are_joined_if_near_and_next_in_order(gap, other, joined):
    """0.8 mm may be a torn ribbon, 2.4 mm is not; CA3 and subiculum face each other."""
    tissue = np.zeros((60, 60), dtype=np.uint8)
    tissue[20:26, 5:30] = Tissue.CA3 if other == Tissue.SUBICULUM else Tissue.CA2
    tissue[20:26, 30 + gap : 50] = other
    outline = slices._outline(tissue, PIXEL, SETTINGS)
    assert (ndimage.label(outline > 0)[1] == 1) == joined


def test_crumbs_are_dropped_and_small_holes_filled():
    tissue = np.zeros((60, 60), dtype=np.uint8)
    tissue[10:24, 5:40] = Tissue.CA1
    tissue[16:18, 20:22] = 0
    tissue[45:47, 45:47] = Tissue.CA1
    outline = slices._outline(tissue, PIXEL, SETTINGS)
    assert ndimage.label(outline > 0)[1] == 1
    assert ndimage.label(outline <= 0)[1] == 1


@pytest.mark.parametrize(("voxel", "thick"), [((0.4, 0.4, 0.4), False), ((0.4, 2.0, 0.4), True)])
def test_thick_slices_are_told_by_the_voxel(voxel, thick):
    assert slices.has_thick_slices(np.diag([*voxel, 1.0]), SETTINGS) == thick


def test_fine_volume_lies_where_the_slices_lie():
    """At slice centers the fine volume repeats the slice: its affine is right along every axis."""
    phantom = Phantom(PhantomSpec(kind="arc", length=10))
    volume = phantom.label_volume(load_scheme("freesurfer"), voxel_size=(0.4, 1.6, 0.4))
    body = extract_body(volume, Settings().body)
    fine = slices.interpolate_slices(body, SETTINGS)
    index, points = body.inside_points()
    inverse = np.linalg.inv(fine.affine)
    where = points @ inverse[:3, :3].T + inverse[:3, 3]
    found = ndimage.map_coordinates(fine.values, where.T, order=1, mode="nearest")
    assert (found > 0.5).mean() > 0.97  # voxels at the outline's corners are smoothed away
    assert len(index) > 1000


@pytest.mark.parametrize("kind", ["arc", "spiral"])
def test_thickness_on_thick_slices_across_the_axis(kind):
    """2 mm slices, drawn like a scanner's across the long axis: the mean holds within 0.04 mm."""
    phantom = Phantom(PhantomSpec(kind=kind, length=12))
    tilt = 0.45  # rad, the phantom's pitch: slices across its long axis
    turn = np.array([[1, 0, 0], [0, np.cos(tilt), np.sin(tilt)], [0, -np.sin(tilt), np.cos(tilt)]])
    case = solve_case(phantom, voxel_size=(0.4, 2.0, 0.4), grid_rotation=turn)
    assert measure_thickness(case.sheet).mean() == pytest.approx(2.0, abs=0.04)
