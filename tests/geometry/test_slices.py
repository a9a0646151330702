"""Outlines of slices, their registration, and shapes between thick slices."""

from dataclasses import replace

import numpy as np
import pytest
from geometry_cases import plain_body, solve_case, straight_ends
from scipy import ndimage

from hipsta_bids.geometry import outlines
from hipsta_bids.geometry import slices as shapes
from hipsta_bids.geometry.measures import measure_thickness
from hipsta_bids.geometry.outlines import DISTANCE_REACH, SLIT_HALF_WIDTH, outline_slice
from hipsta_bids.geometry.shares import SheetShare
from hipsta_bids.geometry.slices import (
    has_thick_slices,
    register_slices,
    sample_slices,
)
from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.settings import Settings

SETTINGS = Settings().slices
PIXEL = 0.4  # mm
FINE = PIXEL / SETTINGS.upsampling
STEP = 2.0  # mm
MOVING = [8.0, 8.8, 9.6, 10.4, 11.2]  # mm, whole pixels apart


def outline(tissue):
    return outline_slice(tissue, PIXEL, SETTINGS)


def fine_positions(count):
    """Centers of fine pixels, in pixels of the segmentation."""
    return (np.arange(count * SETTINGS.upsampling) + 0.5) / SETTINGS.upsampling - 0.5


def test_a_straight_edge_lies_where_the_pixels_end():
    tissue = np.zeros((30, 30), dtype=np.uint8)
    tissue[:, 10:] = Tissue.CA1
    expected = (fine_positions(30) - 9.5) * PIXEL
    near = np.abs(expected) < 1.5
    # Fine pixels sample the Gaussian at a fourth of its sigma; beyond it whole fine pixels count.
    np.testing.assert_allclose(outline(tissue)[30][near], expected[near], atol=0.03)


def test_a_slanting_edge_lies_between_the_pixels():
    """Whole pixels would shift it by up to half of one, 0.2 mm."""
    grid = np.indices((40, 40))
    slope = 1 / np.pi  # no row ends exactly at a pixel center
    tissue = np.where(grid[1] > slope * grid[0] + 8, Tissue.CA1, 0).astype(np.uint8)
    rows, columns = np.meshgrid(fine_positions(40), fine_positions(40), indexing="ij")
    expected = (columns - slope * rows - 8) / np.hypot(1, slope) * PIXEL
    # Away from the borders of the image, near the edge.
    inner = (np.abs(rows - 20) < 12) & (np.abs(expected) < 0.2)
    error = (outline(tissue) - expected)[inner]
    assert inner.sum() > 50
    # A tenth of a pixel's half: what the Gaussian leaves of steps that are three pixels long.
    assert error.std() < 0.06
    assert abs(error.mean()) < 0.02


def test_an_empty_slice_is_outside_everywhere():
    empty = outline(np.zeros((8, 9), dtype=np.uint8))
    assert empty.shape == (16, 18)
    assert (empty == -DISTANCE_REACH).all()


@pytest.mark.parametrize(
    ("gap", "other", "joined"),
    [(2, Tissue.CA1, True), (2, Tissue.SUBICULUM, False), (6, Tissue.CA1, False)],
)
def test_fragments_are_joined_if_near_and_next_in_order(gap, other, joined):
    """0.8 mm may be a broken ribbon, 2.4 mm is not; CA3 and subiculum face each other."""
    tissue = np.zeros((60, 60), dtype=np.uint8)
    tissue[20:26, 5:30] = Tissue.CA3 if other == Tissue.SUBICULUM else Tissue.CA2
    tissue[20:26, 30 + gap : 50] = other
    assert (ndimage.label(outline(tissue) > 0)[1] == 1) == joined


@pytest.mark.parametrize(
    ("medial", "lateral", "beside", "joined"),
    [
        (Tissue.CA1, Tissue.CA2, True, True),
        (Tissue.CA1, Tissue.CA2, False, False),
        (Tissue.CA1, Tissue.CA1, True, False),
        (Tissue.SUBICULUM, Tissue.CA3, True, False),
    ],
    ids=["broken", "nothing beside", "no other subfield", "not next in order"],
)
def test_a_broken_ribbon_is_joined_where_a_slice_beside_shows_it(medial, lateral, beside, joined):
    """2.4 mm wide; the uncus has no subfield that the ribbon lacks."""
    tissue = np.zeros((60, 60), dtype=np.uint8)
    tissue[20:26, 5:28] = medial
    tissue[20:26, 34:50] = lateral
    whole = tissue.copy()
    whole[20:26, 28:34] = medial
    found = outline_slice(tissue, PIXEL, SETTINGS, [whole if beside else tissue])
    assert (ndimage.label(found > 0)[1] == 1) == joined


def test_fragments_are_dropped_and_small_holes_filled():
    tissue = np.zeros((60, 60), dtype=np.uint8)
    tissue[10:24, 5:40] = Tissue.CA1
    tissue[16:18, 20:22] = 0
    tissue[45:47, 45:47] = Tissue.CA1
    found = outline(tissue)
    assert ndimage.label(found > 0)[1] == 1
    assert ndimage.label(found <= 0)[1] == 1


def disc(center, radius, size=100):
    """Signed distance from a circle, mm, clipped as outlines are."""
    grid = np.indices((size, size)) * FINE
    gap = np.hypot(grid[0] - center[0], grid[1] - center[1])
    return np.clip(radius - gap, -DISTANCE_REACH, DISTANCE_REACH).astype(np.float32)


def test_equal_slices_do_not_move():
    flow = register_slices(np.stack([disc((8, 10), 2.0)] * 3), PIXEL, SETTINGS)
    assert flow.shape == (2, 2, 50, 50)
    assert (flow == 0).all()


def test_a_shift_is_found():
    """Twice the distance over which blending in place would still overlap half."""
    flow = register_slices(np.stack([disc((8, 10), 2.0), disc((10, 9), 2.0)]), PIXEL, SETTINGS)
    middle = flow[:, 0, 22, 23] * FINE  # at the middle of both, mm
    # The ridge, 0.02 of a mean squared slope of up to 1, holds back some per cent.
    np.testing.assert_allclose(middle, [2, -1], atol=0.15)


def test_the_way_back_is_the_way_there():
    pair = np.stack([disc((8, 10), 2.0), disc((10, 9), 2.5)])
    there, back = (register_slices(stack, PIXEL, SETTINGS) for stack in (pair, pair[::-1]))
    np.testing.assert_allclose(there, -back, atol=1e-4)  # pixels; float32


def test_slices_are_registered_independently():
    shapes = [disc((8, 10), 2.0), disc((9, 10), 2.0), disc((9, 11), 2.5)]
    together = register_slices(np.stack(shapes), PIXEL, SETTINGS)
    alone = register_slices(np.stack(shapes[1:]), PIXEL, SETTINGS)
    np.testing.assert_allclose(together[:, 1:], alone, atol=1e-6)  # float32


def test_odd_sizes_are_covered():
    flow = register_slices(np.stack([disc((4, 5), 2.0, 54)] * 2), PIXEL, SETTINGS)
    assert flow.shape == (2, 1, 27, 27)


def block(centers, *, width=4.0, height=8.0, size=(60, 60)):
    """Labels of a rectangle in each slice; only its middle along the first axis moves."""
    grid = (np.indices(size) + 0.5) * PIXEL
    stack = [
        (np.abs(grid[0] - center) < width / 2) & (np.abs(grid[1] - 12.0) < height / 2)
        for center in centers
    ]
    return np.stack(stack, axis=-1).astype(np.uint8) * np.uint8(Tissue.CA1)


def slice_body(tissue, *, first, length):
    """A body along +z whose first slice lies at ``first`` mm, between planes at 0 and length."""
    affine = np.diag([PIXEL, PIXEL, STEP, 1.0])
    affine[:3, 3] = [0.5 * PIXEL, 0.5 * PIXEL, first]
    body = plain_body(tissue, affine, straight_ends(length))
    levels = first + STEP * np.arange(tissue.shape[2])
    body.inside[...] &= (levels > 0) & (levels < length)
    return body


def section(body, z):
    """Center and width along the first axis of the shape at a level, mm, and its area, mm2."""
    fine = 0.1
    at = np.arange(0.5 * fine, 24, fine)  # edges of pixels lie between these places
    grid = np.stack(np.meshgrid(at, at, [z], indexing="ij"))
    found = sample_slices(body, grid.reshape(3, -1).T, SETTINGS).reshape(240, 240) > 0.5
    across = found[:, 120].sum() * fine
    return (ndimage.center_of_mass(found)[0] + 0.5) * fine, across, found.sum() * fine**2


@pytest.mark.parametrize("z", [3.0, 3.5, 4.0, 4.6])
def test_a_shape_that_moves_sideways_is_found_on_its_way(z):
    """It moves by 0.8 mm a slice; blending in place would make it narrower than it is."""
    body = slice_body(block(MOVING), first=0.0, length=9.0)
    center, width, _ = section(body, z)
    # 0.1 mm is the section's resolution; the registration's ridge costs some per cent of the way.
    assert center == pytest.approx(8 + 0.8 * z / STEP, abs=0.1)
    assert width == pytest.approx(4.0, abs=0.1)


def test_beyond_the_last_slice_shapes_go_on_more_slowly():
    body = slice_body(block(MOVING), first=1.0, length=10.0)
    # Slices at 1 and 3 mm, 0.8 mm apart; half their pace over the millimeter to the plane.
    center, _, _ = section(body, 0.0)
    assert center == pytest.approx(8 - 0.5 * 0.4, abs=0.1)  # as above


def test_labels_beyond_an_end_plane_tell_how_the_sheet_goes_on():
    """A corner in the way of the shape, at the first slice inside: extrapolation would miss it."""
    body = slice_body(block([10.8, 10, 10, 10, 10]), first=-1.0, length=8.0)
    center, _, _ = section(body, 0.0)
    assert center == pytest.approx(10.4, abs=0.1)  # halfway between slices at -1 and 1 mm


def test_the_ends_of_the_ribbon_are_kept_apart():
    """Subiculum and CA3 touch only where labels are wrong or the sulcus is closed."""
    tissue = block([8, 8, 8, 8, 8])
    body = slice_body(tissue, first=0.0, length=7.0)
    tissue = body.tissue.copy()
    tissue[:, :30][tissue[:, :30] > 0] = Tissue.SUBICULUM
    tissue[:, 30:][tissue[:, 30:] > 0] = Tissue.CA3
    kissing = plain_body(tissue, body.affine, body.ends)
    kissing.inside[...] = body.inside
    for z in (2.0, 3.0):  # in a slice and between slices
        y = np.arange(9, 15, 0.05)
        points = np.column_stack([np.full(len(y), 8.0), y, np.full(len(y), z)])
        inside = sample_slices(kissing, points, SETTINGS) > 0.5
        gap = y[~inside]
        # Of twice the slit's half width, at the border of the labels; the ramp of 0.2 mm and the
        # fine pixels of 0.2 mm blunt its bottom.
        assert gap.mean() == pytest.approx(12.0, abs=0.1)
        assert len(gap) * 0.05 == pytest.approx(2 * SLIT_HALF_WIDTH, abs=0.2)
        assert inside.sum() + len(gap) == len(y)


def test_what_an_oblique_end_label_hides_is_continued():
    """The plane cuts through the first slices; without labels beyond, half of them is empty."""
    straight = slice_body(block([10] * 7), first=-3.0, length=8.0)
    ends = straight_ends(8.0)
    normal = np.array([0.0, np.sin(0.3), np.cos(0.3)])
    posterior = ends.posterior._replace(point=np.array([0.0, 12.0, 1.0]), normal=normal)
    tilted = replace(ends, posterior=posterior)
    index = np.argwhere(straight.tissue > 0)
    points = index @ straight.affine[:3, :3].T + straight.affine[:3, 3]
    keep = (points - tilted.posterior.point) @ normal > 0
    tissue = np.zeros_like(straight.tissue)
    tissue[tuple(index[keep].T)] = Tissue.CA1
    body = plain_body(tissue, straight.affine, tilted)
    body.inside[...] &= straight.inside
    rng = np.random.default_rng(1)
    depth = rng.uniform(0.05, 1.0, 300)  # mm inside the plane, in the middle of the block
    y = rng.uniform(9.0, 15.0, 300)
    z = 1.0 + (depth - (y - 12.0) * np.sin(0.3)) / np.cos(0.3)
    there = sample_slices(body, np.column_stack([np.full(300, 10.0), y, z]), SETTINGS)
    assert (there > 0.5).mean() > 0.99


@pytest.mark.slow
def test_shares_place_the_walls_of_a_slab_that_bends_between_slices():
    """Means through slices, over offsets in a pixel: at one half alone, it is 0.17 mm too thin."""
    errors = np.concatenate([_errors_of_bent_slab(offset) for offset in np.arange(5) * PIXEL / 5])
    assert abs(np.mean(errors, axis=0)).max() < 0.04
    # The slab moves by 1.2 mm a slice, three fourths of its width: half of the errors at one half.
    assert np.std(errors, axis=0)[0] < 0.09


def _errors_of_bent_slab(offset):
    """Errors of center and width, mm, (N, 2), at levels along a slab that waves."""
    width = 1.6

    def center(z):
        return 11 + offset + 1.2 * np.sin(2 * np.pi * z / 12)

    levels = STEP * np.arange(9)[:, None] + STEP * ((np.arange(40) + 0.5) / 40 - 0.5)
    edges = np.arange(60) * PIXEL
    high, low = (
        np.clip((center(levels)[..., None] + side * width / 2 - edges) / PIXEL, 0, 1)
        for side in (1, -1)
    )
    along = np.abs(edges + PIXEL / 2 - 12) < 6
    share = np.einsum("nx,y->xyn", (high - low).mean(axis=1), along).astype(np.float32)
    body = slice_body(np.where(share > 0.5, Tissue.CA1, 0), first=0.0, length=16.0)
    body = replace(body, soft=SheetShare(share, np.zeros((0, 3), dtype=int)))
    x, z = np.meshgrid(np.arange(8, 14, 0.01), np.arange(3, 13.5, 0.5))
    points = np.column_stack([x.ravel(), np.full(x.size, 12.0), z.ravel()])
    inside = (sample_slices(body, points, SETTINGS) > 0.5).reshape(x.shape)
    return [
        [row[there].mean() - center(level), np.ptp(row[there]) - width]
        for row, there, level in zip(x, inside, z[:, 0], strict=True)
    ]


def test_a_single_slice_is_a_prism():
    body = slice_body(block([8]), first=1.0, length=2.0)
    areas = [section(body, z)[2] for z in (0.0, 1.0, 2.0)]
    assert areas[0] == areas[1] == areas[2]
    assert areas[1] == pytest.approx(4.0 * 8.0, rel=0.03)  # the Gaussian rounds the corners


@pytest.mark.parametrize("through", [0, 1, 2])
def test_slices_may_lie_along_any_axis_of_the_image(through):
    body = slice_body(block(MOVING), first=0.0, length=9.0)
    turned = plain_body(
        np.moveaxis(body.tissue, 2, through),
        body.affine[:, [*np.insert(np.array([0, 1]), through, 2), 3]],
        body.ends,
    )
    turned.inside[...] = np.moveaxis(body.inside, 2, through)
    points = np.random.default_rng(2).uniform([4, 6, 0], [16, 18, 9], (500, 3))
    first, second = (sample_slices(b, points, SETTINGS) for b in (body, turned))
    np.testing.assert_allclose(first, second, atol=1e-5)  # float32


@pytest.mark.parametrize(("voxel", "thick"), [((0.4, 0.4, 0.4), False), ((0.4, 2.0, 0.4), True)])
def test_thick_slices_are_recognized_by_the_voxel(voxel, thick):
    assert has_thick_slices(np.diag([*voxel, 1.0]), SETTINGS) == thick


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["arc", "spiral"])
def test_thickness_on_thick_slices_across_the_axis(kind):
    """2 mm slices, drawn like a scanner's across the long axis: the mean holds within 0.04 mm."""
    phantom = Phantom(PhantomSpec(kind=kind, length=12))
    tilt = 0.45  # rad, the phantom's pitch: slices across its long axis
    turn = np.array([[1, 0, 0], [0, np.cos(tilt), np.sin(tilt)], [0, -np.sin(tilt), np.cos(tilt)]])
    case = solve_case(phantom, voxel_size=(0.4, 2.0, 0.4), grid_rotation=turn)
    assert measure_thickness(case.sheet).mean() == pytest.approx(2.0, abs=0.04)


def test_a_step_of_the_registration_of_ramps_is_their_shift():
    """The ridge holds back two per cent; across the slope nothing moves."""
    at = np.indices((40, 44)) * PIXEL
    ramps = [0.6 * (at[0] - shift) + 0.8 * at[1] for shift in (0.0, 1.0, 3.0)]
    images = np.stack(ramps).astype(np.float32)
    flow = shapes._improved(images, np.zeros((2, 2, 40, 44), dtype=np.float32), PIXEL)
    shift = 0.6 * np.array([1.0, 2.0]) / PIXEL / (1 + shapes.FLOW_RIDGE)
    middle = flow[:, :, 16:-16, 16:-16] - np.multiply.outer([0.6, 0.8], shift)[..., None, None]
    np.testing.assert_allclose(middle, 0, atol=1e-4)


def test_linear_functions_survive_other_pixels():
    number, row, column = np.indices((3, 9, 8)).astype(np.float32)
    images = 10 * number + 2 * row - 3 * column
    shrunk = shapes._shrunk(images, 4)
    np.testing.assert_allclose(shrunk[:, :2], images[:, 1:8:4, 1:8:4] - 0.5)
    np.testing.assert_allclose(shrunk[:, 2], images[:, 8, 1::4] - 1.5)  # the border is repeated
    number, row, column = np.indices((3, 18, 16)).astype(np.float32)
    doubled = shapes._doubled(np.stack([images, -images]), (18, 16))[..., 1:-1, 1:-1]
    expected = (20 * number + 2 * row - 3 * column + 0.5)[:, 1:-1, 1:-1]
    np.testing.assert_allclose(doubled, [expected, -expected])
    moved = shapes._moved(images, np.stack([0.25 + 0 * images, 0.5 + 0 * images]))
    np.testing.assert_allclose(moved[:, :-1, :-1], images[:, :-1, :-1] + 0.5 - 1.5)


@pytest.mark.parametrize("smoothing", [0.0, 0.4, 1.0])
def test_shapes_between_slices_follow_paths_and_shares(smoothing, monkeypatch):
    """Edges across the first axis, in places whose path through the slices is known."""
    monkeypatch.setattr(shapes, "PATH_SMOOTHING", smoothing)
    places = np.array([10.0, 13.0, 12.0, 15.0])
    flows = np.zeros((2, 3, 20, 16), dtype=np.float32)
    flows[0] = np.diff(places)[:, None, None]
    bends = np.zeros((2, 4, 20, 16), dtype=np.float32)
    bends[0, 1:3] = np.diff(places, 2)[:, None, None]
    edges = np.indices((4, 40, 32))[1] - places[:, None, None]
    stack = shapes._SliceStack(
        outlines=edges.astype(np.float32),
        ends=np.full((2, 4, 40, 32), -9.0, dtype=np.float32),
        flows=flows,
        bends=bends,
        settings=SETTINGS,
    )
    levels = np.array([0.25, 1.0, 1.5, 2.75, 3.5, -0.5])
    straight = np.array([10.75, 13.0, 12.5, 14.25, 15.75, 9.25])
    before, after = np.diff(places, 2)
    cubic = np.array([-before * 3 / 128, 0, -(before + after) / 16, -after * 3 / 128, 0, 0])
    spline = np.array([before / 384, before / 6, (before + after) / 48, after / 384, 0, 0])
    bent = smoothing * spline + (1 - smoothing) * cubic
    pixels = np.tile(np.array([[14.0], [11.0]]), len(levels)).astype(np.float32)
    found = stack.blend(levels.astype(np.float32), pixels)
    np.testing.assert_allclose(found, 14.0 - straight - bent, atol=1e-4)


def test_places_of_ribbons_give_flows_and_bends():
    line = np.stack(np.broadcast_arrays(np.linspace(4, 30, 9)[:, None], [11, 12, 13]), axis=-1)
    ribbons = [line, line + np.array([2.0, 1.0]), line + np.array([3.0, 5.0]), None, line]
    flows = np.full((2, 4, 16, 16), 7.0, dtype=np.float32)
    bends = np.zeros((2, 5, 16, 16), dtype=np.float32)
    shapes._align(flows, bends, ribbons, SETTINGS)
    steps = np.array([[2.0, 1.0, 7.0, 7.0], [1.0, 4.0, 7.0, 7.0]])
    np.testing.assert_allclose(flows, steps[..., None, None] + 0 * flows, rtol=1e-5)
    expected = np.array([[0.0, -1.0, 0, 0, 0], [0.0, 3.0, 0, 0, 0]])
    np.testing.assert_allclose(bends, expected[..., None, None] + 0 * bends, atol=1e-5)


def test_pixels_have_their_distance_from_a_segment():
    found = outlines._segment_distance((4, 9), np.array([2, 3]), np.array([2, 6]))
    row, column = np.indices((4, 9))
    beyond = np.maximum(np.maximum(3 - column, column - 6), 0)
    np.testing.assert_allclose(found, np.hypot(row - 2, beyond))


@pytest.mark.parametrize("order", [1, -1])
def test_slices_on_either_side_show_that_a_ribbon_is_broken(order):
    tissue = np.zeros((3, 60, 60), dtype=np.uint8)
    tissue[:, 20:26, 5:28], tissue[:, 20:26, 34:50] = Tissue.CA1, Tissue.CA2
    tissue[0, 20:26, 28:34] = Tissue.CA1
    found = shapes._stacked(tissue[::order], PIXEL, SETTINGS).outlines[::order] > 0
    assert [ndimage.label(image)[1] for image in found] == [1, 1, 2]


def test_displacements_are_smoothed_by_half_a_millimeter():
    """Without slopes there is no other change: the variance is that of the Gaussian."""
    flow = np.zeros((2, 1, 41, 41), dtype=np.float32)
    flow[:, 0, 20, 20] = 3.0, -2.0
    found = shapes._improved(np.zeros((2, 41, 41), dtype=np.float32), flow, 0.25)
    row, column = np.indices((41, 41)) - 20
    for part in found[:, 0] / [[[3.0]], [[-2.0]]]:
        sums = [(weight * part).sum() for weight in (1, row**2, column**2)]
        assert sums == pytest.approx([1, 4, 4], rel=0.01)  # (0.5 mm / 0.25 mm)^2


@pytest.mark.parametrize("uncus", [0, 1, 2])
def test_a_ribbon_has_each_subfield_once(uncus):
    """Pieces without a further subfield are dropped, however many."""
    rank = np.full((12, 20), np.nan)
    rank[1:7, 2:9], rank[8:10, 2:9] = 5, 6
    kept = np.isfinite(rank)
    rank[1:7:3, 12:15][:uncus] = 5
    outline = np.where(np.isfinite(rank), 1, -1).astype(np.float32)
    outlines.drop_doubles(outline, rank)
    np.testing.assert_array_equal(outline > 0, kept)


def test_ends_are_kept_apart_by_a_slit_where_both_are_near():
    """0.3 mm to each side of the middle, or what both are nearer than 0.6 mm."""
    medial, lateral = np.array([[-0.2, 1.0, -3.0], [-0.5, -0.3, -0.1]])
    np.testing.assert_allclose(outlines.keep_apart(medial, lateral), [-0.1, 0.35, 2.4])
