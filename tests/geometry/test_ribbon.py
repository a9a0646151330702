"""Nodes of the ribbon in single slices, their alignment, cut rings and parted turns."""

from itertools import pairwise

import numpy as np
import pytest
from geometry_cases import plain_body, straight_ends
from scipy import ndimage

from hipsta_bids.geometry import ribbon, slices
from hipsta_bids.geometry.outlines import DISTANCE_REACH, SLIT_HALF_WIDTH, cut_rings, outline_slice
from hipsta_bids.geometry.ribbon import (
    LEAST_HALF_THICKNESS,
    MATCH_STRETCH,
    RIBBON_NODES,
    align_nodes,
    keep_whole,
    match_lines,
    moves_between,
    part_turns,
    ribbon_nodes,
)
from hipsta_bids.geometry.slices import sample_slices
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.settings import Settings

SETTINGS = Settings().slices
FINE = 0.2  # mm
RADIUS, WALL = 5.0, 1.6  # mm
SIZE = 90  # fine pixels
CENTER = 0.5 * SIZE * FINE


def arc(*, turn=0.0, opening=2.0, wall=WALL, radius=RADIUS, fine=FINE):
    """Signed distance from an arc, mm, and the angle along it, rad; round ends, gap at ``turn``."""
    count = round(SIZE * FINE / fine)
    x, y = (np.indices((count, count)) + 0.5) * fine - CENTER
    angle = (np.arctan2(y, x) - turn) % (2 * np.pi)
    held = np.clip(angle, 0.5 * opening, 2 * np.pi - 0.5 * opening) + turn
    gap = np.hypot(x - radius * np.cos(held), y - radius * np.sin(held))
    return np.clip(0.5 * wall - gap, -DISTANCE_REACH, DISTANCE_REACH), angle


def arc_nodes(**how):
    outline, angle = arc(**how)
    return ribbon_nodes(outline, np.where(outline > 0, angle, np.nan), FINE)


def polar(nodes):
    """Radius, mm, and angle of nodes."""
    x, y = np.moveaxis((nodes + 0.5) * FINE - CENTER, -1, 0)
    return np.hypot(x, y), np.arctan2(y, x) % (2 * np.pi)


def test_nodes_of_an_arc_lie_on_its_radii():
    nodes = arc_nodes()
    assert nodes.shape == (RIBBON_NODES, 5, 2)
    radius, angle = polar(nodes)
    inner = slice(10, -10)  # the round ends are no part of the annulus
    # Vertices are a pixel apart; half of it on a chord of 5 mm is 1 um, on the contour 5 um.
    thickness = np.abs(radius[inner, -1] - radius[inner, 0])
    np.testing.assert_allclose(thickness, WALL, atol=0.02)
    assert np.ptp(angle[inner], axis=1).max() * RADIUS < 0.05
    assert (np.diff(angle[:, 2]) > 0).all()  # from medial to lateral
    assert nodes[0, 0] != pytest.approx(nodes[-1, 0])


def test_walls_keep_their_sides_from_slice_to_slice():
    first, second = (polar(arc_nodes(turn=turn))[0][40] for turn in (0.0, 2.0))
    np.testing.assert_allclose(first, second, atol=0.03)
    assert abs(first[0] - first[-1]) > 1.5


def test_what_is_no_ribbon_has_no_nodes():
    empty = np.full((30, 30), -DISTANCE_REACH)
    assert ribbon_nodes(empty, np.full((30, 30), np.nan), FINE) is None
    empty[15, 15] = 0.05  # less than a pixel
    assert ribbon_nodes(empty, np.full((30, 30), np.nan), FINE) is None


def test_a_line_matches_itself_evenly():
    line = np.column_stack([np.linspace(0, 20, 81), np.sin(np.linspace(0, 6, 81))])
    share = np.linalg.norm(np.diff(line, axis=0), axis=1).cumsum() / 20
    where = match_lines(line, line, MATCH_STRETCH)
    # Places on the second line are a fourth of a node apart.
    np.testing.assert_allclose(where[1:], share / share[-1], atol=0.5 / 80)


def test_corners_are_matched_with_corners():
    """An L whose corner is at half of one line and at a third of the other."""
    first = np.column_stack([np.linspace(0, 20, 81).clip(max=10), np.linspace(0, 20, 81) - 10])
    first[:, 1] = first[:, 1].clip(min=0)
    second = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 20.0]])
    where = match_lines(first, second, MATCH_STRETCH)
    assert (np.diff(where) >= 0).all()
    assert where[0] == 0
    assert where[-1] == 1
    assert where[40] == pytest.approx(1 / 3, abs=0.05)


def test_nodes_of_a_turned_arc_belong_to_the_nearest():
    """Its middle turns by 0.8 mm; ends belong to ends."""
    aligned = align_nodes([arc_nodes(), None, arc_nodes(), arc_nodes(turn=0.16)], FINE)
    assert aligned[1] is None
    (_, before), (_, after) = (polar(nodes[:, 2]) for nodes in aligned[2:])
    shift = after - before
    assert shift[0] == pytest.approx(0.16, abs=0.02)
    assert shift[40] < 0.08  # less than half: the nearest points of the same circle do not move


def test_pixels_move_with_the_ribbon():
    first = arc_nodes()
    move = np.array([3.0, -2.0])
    moved = moves_between(first, first + move, (first + 0.5 * move).reshape(-1, 2))
    np.testing.assert_allclose(moved, np.tile(move, (len(moved), 1)), atol=1e-9)


def holes(outline):
    return ndimage.label(outline <= 0)[1] - 1


@pytest.mark.parametrize("turn", [0.0, 1.0, 4.0])
def test_a_ring_is_cut_where_the_slices_beside_are_open(turn):
    ring, angle = arc(turn=turn, opening=0.0)
    ribbon, _ = arc(turn=turn, opening=0.8)
    stack = np.stack([ribbon, ring, ribbon]).astype(np.float32)
    found = cut_rings(stack, FINE)
    assert holes(stack[1]) == 1
    assert holes(found[1]) == 0
    assert (found[[0, 2]] == stack[[0, 2]]).all()
    for image in (cut_rings(stack[1:], FINE)[0], found[1]):  # without the first slice, and with it
        lost = (image <= 0) & (ring > 0)
        assert np.abs((angle[lost] + np.pi) % (2 * np.pi) - np.pi).max() < 0.4
    # A gap of twice the half width, across the wall; whole pixels add up to one on each side.
    width = lost.sum() * FINE**2 / WALL
    assert 2 * SLIT_HALF_WIDTH - FINE < width < 2 * SLIT_HALF_WIDTH + 2 * FINE


def test_a_ring_alone_is_cut_where_it_is_thin():
    ring, angle = arc(opening=0.0)
    thin = np.minimum(ring, np.where(np.cos(angle - 2.0) > 0.95, 0.1, 9.0)).astype(np.float32)
    lost = (cut_rings(thin[None], FINE)[0] <= 0) & (thin > 0)
    assert np.cos(angle[lost] - 2.0).min() > 0.85


def test_a_thin_part_of_a_ribbon_is_thickened_and_the_rest_stays():
    outline, angle = arc()
    thin = np.cos(angle - np.pi) > 0.9
    x, y = (np.indices(outline.shape) + 0.5) * FINE - CENTER
    line = 0.17 - np.abs(np.hypot(x, y) - RADIUS)
    narrow = np.where(thin, np.minimum(outline, line), outline)
    nodes = ribbon_nodes(narrow, np.where(narrow > 0, angle, np.nan), FINE)
    found = narrow.copy()
    keep_whole(found, nodes, FINE)
    core = np.cos(angle - np.pi) > 0.95
    expected = LEAST_HALF_THICKNESS - np.abs(np.hypot(x, y) - RADIUS)
    near = core & (expected > 0.05)
    assert near.sum() > 20
    # The mid-line of the nodes lies within a fourth of a pixel of the circle.
    np.testing.assert_allclose(found[near], expected[near], atol=0.05)
    assert (found >= narrow).all()
    assert (
        found[~thin & (narrow > LEAST_HALF_THICKNESS)]
        == narrow[~thin & (narrow > LEAST_HALF_THICKNESS)]
    ).all()
    whole = outline.copy()
    keep_whole(whole, arc_nodes(), FINE)
    np.testing.assert_array_equal(whole, outline)


def radius_at(z, radii):
    """Mean radius, mm, of the outer wall of an arc, between slices 2 mm apart with such radii."""
    pixel, step = 0.4, 2.0
    size = round(SIZE * FINE / pixel)
    tissue = np.zeros((size, size, len(radii)), dtype=np.uint8)
    for number, radius in enumerate(radii):
        outline, angle = arc(fine=pixel, radius=radius)
        labels = np.select([angle < 2.4, angle < 4], [Tissue.SUBICULUM, Tissue.CA1], Tissue.CA3)
        tissue[..., number] = np.where(outline > 0, labels, 0)
    affine = np.diag([pixel, pixel, step, 1.0])
    affine[:2, 3] = 0.5 * pixel
    body = plain_body(tissue, affine, straight_ends((len(radii) - 1) * step))
    angles = np.linspace(1.6, 2 * np.pi - 1.6, 60)
    out = np.arange(2.0, 8.0, 0.02)
    x, y = (CENTER + way(angles)[:, None] * out for way in (np.cos, np.sin))
    points = np.stack([x, y, np.full(x.shape, z)], axis=-1).reshape(-1, 3)
    inside = (sample_slices(body, points, SETTINGS) > 0.5).reshape(x.shape)
    return float((out[0] + 0.02 * inside.shape[1] - 0.02 * inside[:, ::-1].argmax(axis=1)).mean())


@pytest.mark.slow
@pytest.mark.parametrize("smoothing", [0.0, 1.0])
def test_the_ribbon_follows_a_smooth_path_through_the_slices(smoothing, monkeypatch):
    """Cubic paths through, or B-splines over, radii that are 0.8 mm more in one slice."""
    radii = [4.6, 4.6, 5.4, 4.6, 4.6]
    monkeypatch.setattr(slices, "PATH_SMOOTHING", smoothing)
    found = np.array([radius_at(z, radii) for z in (4.0, 3.0, 2.0)]) - 0.5 * WALL
    # Catmull-Rom halfway: (-1, 9, 9, -1) / 16; B-spline: (1, 4, 1) / 6 and (1, 23, 23, 1) / 48.
    shares = np.array([1, 9 / 16, 0]) if smoothing == 0 else np.array([4 / 6, 23 / 48, 1 / 6])
    # Voxels of 0.4 mm, smoothed in the slice, and moves that are averaged over near nodes.
    np.testing.assert_allclose(found, 4.6 + 0.8 * shares, atol=0.05)


def test_turns_are_parted_and_a_single_ribbon_stays():
    """Ends of the arc 0.2 mm apart: later smoothing would close the gap."""
    opening = (WALL + 0.2) / RADIUS
    outline, angle = arc(opening=opening)
    kept, far = outline.copy(), np.cos(angle) < 0
    part_turns(outline, arc_nodes(opening=opening), FINE)
    assert (outline[far] == kept[far]).all()
    across = np.flatnonzero(np.abs(np.arange(SIZE) + 0.5 - (CENTER + RADIUS) / FINE) < 1)
    gap = (outline[across][:, 30:60] <= 0).sum(axis=1).mean() * FINE
    assert gap == pytest.approx(2 * SLIT_HALF_WIDTH, abs=FINE)
    single, _ = arc()
    alone = single.copy()
    part_turns(alone, arc_nodes(), FINE)
    assert (alone == single).all()


def test_pieces_that_repeat_the_ribbon_are_dropped_and_others_stay():
    def pieces(other):
        tissue = np.zeros((76, 60, 4), dtype=np.uint8)
        tissue[8:12, 5:25], tissue[8:12, 25:50] = Tissue.SUBICULUM, Tissue.CA1
        tissue[25:30, 20:40] = other
        affine = np.diag([0.4, 0.4, 2.0, 1.0])
        affine[2, 3] = 1.0
        body = plain_body(tissue, affine, straight_ends(8.0))
        return sample_slices(body, np.array([[11.0, 12.0, 4.0], [4.0, 12.0, 4.0]]), SETTINGS) > 0.5

    assert pieces(Tissue.CA1).tolist() == [False, True]
    assert pieces(Tissue.CA3).tolist() == [True, True]


@pytest.mark.parametrize("z", [2.0, 3.0, 3.5])
def test_an_arc_that_moves_by_its_wall_keeps_its_thickness_between_slices(z):
    """1.6 mm a slice: blending in place would leave little of it halfway."""
    pixel, step = 0.4, 2.0
    tissue = np.zeros((76, 60, 4), dtype=np.uint8)
    for number in range(4):
        outline, angle = arc(fine=pixel)
        labels = np.select([angle < 2.4, angle < 4], [Tissue.SUBICULUM, Tissue.CA1], Tissue.CA3)
        first = 4 + 4 * number  # 1.6 mm
        tissue[first : first + len(outline), 5 : 5 + len(outline), number] = np.where(
            outline > 0, labels, 0
        )
    body = plain_body(tissue, np.diag([pixel, pixel, step, 1.0]), straight_ends(6.0))
    middle = np.array([(3.5 + 4 * z / step) * pixel, 4.5 * pixel]) + CENTER
    angles = np.linspace(1.5, 2 * np.pi - 1.5, 40)
    out = np.arange(RADIUS - 2.5, RADIUS + 2.5, 0.05)
    x = middle[0] + np.cos(angles)[:, None] * out
    y = middle[1] + np.sin(angles)[:, None] * out
    points = np.stack([x, y, np.full(x.shape, z)], axis=-1).reshape(-1, 3)
    inside = (sample_slices(body, points, SETTINGS) > 0.5).reshape(x.shape)
    thickness = inside.sum(axis=1) * 0.05
    # Along the way of the arc, mid-lines are matched at the nearest points, which cuts its corners.
    assert thickness.mean() == pytest.approx(WALL, abs=0.05)
    assert thickness.std() < 0.15


def meander(points):
    """Whether points (N, 2), mm, lie on a ribbon of three strands, 3.2 mm apart."""
    corners = np.array([[0, 0], [10, 0], [10, 3.2], [0, 3.2], [0, 6.4], [10, 6.4]])
    gap = np.full(len(points), np.inf)
    for start, stop in pairwise(corners):
        along = stop - start
        share = np.clip((points - start) @ along / (along @ along), 0, 1)
        gap = np.minimum(gap, np.linalg.norm(points - start - share[:, None] * along, axis=1))
    return gap < 0.5 * WALL


@pytest.mark.slow
def test_strands_are_not_taken_for_their_neighbors():
    """A meander moves by 2 mm a slice; its next strand is 1.2 mm away on the other side."""
    pixel, step, moved = 0.4, 2.0, 2.0
    grid = (np.indices((50, 60)).reshape(2, -1).T + 0.5) * pixel
    tissue = np.zeros((50, 60, 4), dtype=np.uint8)
    for number in range(4):
        local = grid - [4.0, 4.0 + moved * number]
        labels = np.where(local[:, 1] < 2, Tissue.SUBICULUM, Tissue.CA1)
        labels = np.where(local[:, 1] > 4.4, Tissue.CA3, labels)
        tissue[..., number] = (labels * meander(local)).reshape(50, 60)
    affine = np.diag([pixel, pixel, step, 1.0])
    affine[:2, 3] = 0.5 * pixel
    body = plain_body(tissue, affine, straight_ends(6.0))
    grid = (np.indices((200, 240)).reshape(2, -1).T + 0.5) * 0.1
    points = np.column_stack([grid, np.full(len(grid), 1.5 * step)])
    found = sample_slices(body, points, SETTINGS) > 0.5
    truth = meander(grid - [4.0, 4.0 + moved * 1.5])
    both = np.count_nonzero(found & truth)
    # Corners are rounded off; registration of the outlines alone finds half.
    assert 2 * both / (found.sum() + truth.sum()) > 0.93


@pytest.mark.slow
def test_the_order_of_voxels_in_the_image_decides_nothing():
    """An even number of slices, so that the middle of the stack is a matter of its direction."""
    size, pixel, step = 60, 0.4, 2.0
    tissue = np.zeros((size, size, 6), dtype=np.uint8)
    for number in range(6):
        outline, angle = arc(fine=pixel, turn=0.3 + 0.2 * number, radius=4.6 + 0.2 * number)
        labels = np.select([angle < 2.4, angle < 4], [Tissue.SUBICULUM, Tissue.CA1], Tissue.CA3)
        first = slice(3 + number, 3 + number + len(outline))
        tissue[first, 5 : 5 + len(outline), number] = np.where(outline > 0, labels, 0)
    affine = np.diag([pixel, pixel, step, 1.0])
    points = np.argwhere(tissue)[::3] @ affine[:3, :3] + [0.1, 0.15, 0.7]
    found = sample_slices(plain_body(tissue, affine, straight_ends(10.0)), points, SETTINGS)
    for way in ((0,), (1,), (2,), (0, 1, 2)):
        turned = affine.copy()
        for n in way:
            turned[:3, 3] += turned[:3, n] * (tissue.shape[n] - 1)
            turned[:3, n] *= -1
        body = plain_body(np.flip(tissue, way).copy(), turned, straight_ends(10.0))
        again = sample_slices(body, points, SETTINGS)
        np.testing.assert_allclose(again, found, atol=1e-5, err_msg=str(way))
    order = plain_body(
        tissue.transpose(2, 0, 1).copy(), affine[:, [2, 0, 1, 3]], straight_ends(10.0)
    )
    np.testing.assert_allclose(sample_slices(order, points, SETTINGS), found, atol=1e-5)


def test_outlines_of_labels_give_nodes_too():
    outline, angle = arc(fine=0.4)
    labels = np.where(angle < np.pi, Tissue.SUBICULUM, Tissue.CA3) * (outline > 0)
    drawn = outline_slice(labels.astype(np.uint8), 0.4, SETTINGS)
    _, fine = arc()
    nodes = ribbon_nodes(drawn, np.where(drawn > 0, fine, np.nan), FINE)
    radius, _ = polar(nodes)
    assert np.abs(radius[10:-10, -1] - radius[10:-10, 0]).mean() == pytest.approx(WALL, abs=0.05)


def test_near_nodes_weigh_more_in_the_move_of_a_pixel():
    """One over the squared distance and a quarter, of the six nearest."""
    places = np.array([[0.0, 0], [1, 0], [2, 0], [3, 0], [4, 0], [5, 0], [9, 0]])[:, None]
    moves = np.zeros((7, 1, 2))
    moves[2], moves[6] = [0, 6.0], [0, 1e6]
    found = moves_between(places - 0.5 * moves, places + 0.5 * moves, np.array([[0.0, 0.0]]))
    weight = 1 / (np.arange(6) ** 2 + 0.25)
    np.testing.assert_allclose(found, [[0, 6 * weight[2] / weight.sum()]])


def test_what_rises_laterally_has_a_covariance_with_the_ranks():
    ranks = np.full((4, 5), np.nan)
    points = np.array([[1.2, 0.9], [1, 2], [0.6, 3.4], [3, 9]])
    assert ribbon._rises(np.ones(4), points, ranks) == 0
    ranks[1, 1:4] = [1, 2, 6]
    assert ribbon._rises(np.array([1.0, 0, 2, 100]), points, ranks) == pytest.approx(-2 + 6)
