"""The working grid between two planes, and the smoothed mask on it."""

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from geometry_cases import field_of, plain_body, resampled, rigid, rotation, straight_ends
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry import digital
from hipsta_bids.geometry import grid as grids
from hipsta_bids.geometry.ends import EndPlanes
from hipsta_bids.geometry.grid import WedgeGrid, continued_nodes, in_plane_voxel, smooth_body
from hipsta_bids.geometry.outlines import SLIT_HALF_WIDTH, TOUCH_DISTANCE
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.settings import CheckSettings

EXACT = 1e-9  # rounding of coordinates of some ten mm


@settings(max_examples=25, deadline=None)
@given(st.floats(-25, 25), st.floats(0, 5))
def test_ras_to_nodes_and_back_with_tilted_planes(tilt, phase):
    grid = resampled(box_body(tilt=tilt)).grid
    points = np.random.default_rng(int(10 * phase)).uniform(-3, 12, size=(50, 3))
    np.testing.assert_allclose(grid.to_ras(grid.to_nodes(points)), points, atol=EXACT)


def test_end_planes_are_grid_planes(case):
    grid, ends = case.field.grid, case.body.ends
    nodes = np.random.default_rng(2).uniform(0, 40, size=(100, 3))
    for end, plane in (("posterior", 0), ("anterior", grid.shape[2] - 1)):
        nodes[:, 2] = plane
        np.testing.assert_allclose(ends.height(grid.to_ras(nodes), end), 0, atol=EXACT)


def test_node_points_are_the_nodes_places(arc):
    grid = arc.field.grid
    index = np.argwhere(np.ones(grid.shape, dtype=bool)).astype(float)
    places = grid.node_points().reshape(-1, 3)
    np.testing.assert_allclose(places, grid.to_ras(index), atol=EXACT)


def test_labels_are_read_inside_of_the_end_planes():
    ends, body = straight_ends(8.0), box_body()
    grid = resampled(body).grid
    places = continued_nodes(grid, body, 0.6)
    assert places[..., 2].min() == pytest.approx(0.6)
    assert places[..., 2].max() == pytest.approx(ends.anterior.point[2] - 0.6)
    free = grid.node_points()
    inner = (free[..., 2] > 0.6) & (free[..., 2] < 7.4)
    np.testing.assert_allclose(places[inner], free[inner], atol=EXACT)


def test_spacing_is_the_settings_across_and_close_to_it_along(case):
    grid = case.field.grid
    steps = np.diff(grid.to_ras(np.array([[5.0, 5, 5], [6, 5, 5], [5, 6, 5], [5, 5, 6]])), axis=0)
    assert np.linalg.norm(steps[0]) == pytest.approx(0.35, rel=0.01)  # sheared by the planes' tilt
    along = np.diff(grid.to_ras(np.array([[20.0, 10, 5], [20, 10, 6]])), axis=0)
    assert np.linalg.norm(along) == pytest.approx(0.35, rel=0.1)  # whole steps, planes not parallel


def box_body(*, tilt=0.0, voxel=0.4, length=8.0):
    """A box of 6 x 2.4 mm through planes at z = 0 and ``length``; it goes on beyond them."""
    count = np.ceil(np.array([8.0, 4.4, length + 6.0]) / voxel).astype(int)
    affine = np.diag([voxel, voxel, voxel, 1.0])
    affine[:3, 3] = [-1.0, -1.0, -3.0]
    index = np.indices(tuple(count)).reshape(3, -1).T
    points = index @ affine[:3, :3].T + affine[:3, 3]
    inside = ((points[:, :2] >= 0) & (points[:, :2] <= [6.0, 2.4])).all(axis=1)
    ends = straight_ends(length, tilt=tilt)
    body = plain_body(inside.reshape(count).astype(int), affine, ends)
    between = (ends.height(points, "posterior") > 0) & (ends.height(points, "anterior") < 0)
    body.inside[...] &= between.reshape(count)
    return body


def test_damage_moves_no_node_elsewhere():
    """A hole and an island: the field a few voxels away stays what it was, bit by bit."""
    sound, damaged = box_body(), box_body()
    for array in (damaged.tissue, damaged.inside):
        array[8:12, :8, 16:20] = 0
        array[19, 9, 20] = 1
    damaged = replace(damaged)  # forget the points that were found before
    assert (damaged.inside != sound.inside).any()
    before, after = resampled(sound), resampled(damaged)
    offset = np.rint(after.grid.to_nodes(before.grid.to_ras(np.zeros((1, 3)))))[0].astype(int)
    count = np.minimum(before.values.shape, np.array(after.values.shape) - offset)
    a, b, w = (np.arange(max(0, -o), n) for o, n in zip(offset, count, strict=True))
    index = np.stack(np.meshgrid(a, b, w, indexing="ij"), axis=-1)
    np.testing.assert_allclose(
        after.grid.to_ras((index + offset).reshape(-1, 3).astype(float)),
        before.grid.to_ras(index.reshape(-1, 3).astype(float)),
        atol=EXACT,
    )
    mine = before.values[tuple(np.moveaxis(index, -1, 0))]
    other = after.values[tuple(np.moveaxis(index + offset, -1, 0))]
    ends = w[(w < 2) | (w > w.max() - 2)] - w[0]  # two passes of smoothing reach 2.5 mm
    np.testing.assert_array_equal(mine[..., ends] > 0, other[..., ends] > 0)
    np.testing.assert_allclose(mine[..., ends], other[..., ends], atol=1e-6)  # single precision
    assert np.abs(mine - other).max() > 0.3


def test_field_is_positive_inside_and_negative_outside(case):
    field = case.field
    places = field.grid.node_points().reshape(-1, 3)
    hemi = "R" if case.phantom.spec.kind == "spiral" else "L"
    u, _, n = case.phantom.body.locate(places, hemi=hemi, reach=3.0).T
    values = field.values.ravel()
    deep = (np.abs(n) < 0.6) & (u > 0.06) & (u < 0.94)  # 0.4 mm inside the wall of 2 mm
    far = ~(np.abs(n) < 1.5) & ~np.isnan(n)  # 0.5 mm outside
    assert deep.sum() > 1000
    assert far.sum() > 1000
    assert (values[deep] > 0).all()
    assert (values[far] < 0).all()
    # Across a plane wall, 2 G - G * G goes beyond its ends by 0.037; the two walls add up.
    assert -0.58 < values.min() <= -0.5
    assert 0.5 <= values.max() < 0.58


def test_field_reaches_both_ends_at_full_strength():
    field = resampled(box_body())
    middle = field.values[..., field.grid.shape[2] // 2]
    for plane in (0, -1):
        # No fading towards the end planes: the box goes on, and beyond them nothing is read.
        np.testing.assert_allclose(field.values[..., plane], middle, atol=1e-6)


def test_labels_beyond_the_end_planes_do_not_count():
    whole = box_body()
    cut = box_body()
    cut.tissue[:, :, : int(2.5 / 0.4)] = 0  # the tail, half a millimeter off the plane
    np.testing.assert_array_equal(resampled(cut).values, resampled(whole).values)


def test_field_is_free_at_the_sides(case):
    values = case.field.values
    edge = np.concatenate([values[[0, -1]].ravel(), values[:, [0, -1]].ravel()])
    assert (edge < -0.49).all()  # nothing but background within the margin


@pytest.mark.parametrize("shares", [False, True])
@pytest.mark.parametrize("thickness", [1.0, 1.2, 1.6, 2.4])
def test_smoothing_does_not_move_close_walls_apart(thickness, shares):
    """Without its last step, a sheet of 1.2 mm in voxels of .4 mm becomes .018 mm thicker."""
    voxel, spacing, sigma = (0.6, 0.35, 0.54) if shares else (0.4, 0.35, 0.36)
    fine = 0.001 * np.arange(-8000, 8001)
    slab = (np.abs(fine) < thickness / 2).astype(float)
    box = np.ones(round(voxel / 0.001)) / round(voxel / 0.001)
    for _ in range(3 if shares else 2):  # voxels anywhere, interpolated, with labels or shares
        slab = np.convolve(slab, box, mode="same")
    widths = []
    for offset in np.linspace(0, spacing, 7, endpoint=False):
        z = (np.arange(40) - 20) * spacing + offset
        values = np.broadcast_to(np.interp(z, fine, slab).astype(np.float32), (24, 24, 40))
        weight = np.ones_like(values) if shares else None
        smooth = smooth_body(values, sigma, voxel, spacing, weight)[12, 12]
        widths.append(np.ptp(CubicSpline(z, smooth - 0.5).roots(extrapolate=False)))
    assert np.mean(widths) == pytest.approx(thickness, abs=0.006)


@pytest.mark.parametrize(
    ("edges", "wanted"), [((0.4, 0.4, 2.0), 0.4), ((1.5, 0.3, 0.5), np.sqrt(0.15))]
)
def test_in_plane_voxel(edges, wanted):
    affine = rigid() @ np.diag([*edges, 1.0])
    assert in_plane_voxel(affine) == pytest.approx(wanted)


def test_planes_that_meet_beside_the_body_are_refused():
    body = box_body(tilt=0.0)
    ends = body.ends
    normal = rotation(1, 60) @ ends.anterior.normal
    middle = normal + ends.posterior.normal
    crossed = plain_body(
        body.tissue,
        body.affine,
        EndPlanes(
            posterior=ends.posterior,
            anterior=ends.anterior._replace(normal=normal),
            axis=middle / np.linalg.norm(middle),
            half_slice=0.2,
        ),
    )
    with pytest.raises(GeometryError, match="the end planes meet beside the body") as caught:
        resampled(crossed)
    assert caught.value.reason == "ends-crossed"


def test_turns_that_touch_are_separated():
    """Subiculum and CA3 side by side, in a block without a gap: the field is negative between."""
    body = box_body()
    half = body.tissue.shape[1] // 2
    inside = body.tissue > 0
    tissue = np.zeros_like(body.tissue)
    tissue[:, :half] = Tissue.SUBICULUM
    tissue[:, half:] = Tissue.CA3
    field = resampled(replace(body, tissue=np.where(inside, tissue, 0).astype(np.uint8)))
    values = field.values.ravel()
    nodes = np.argwhere(np.ones(field.grid.shape, dtype=bool)).astype(float)
    border = (half - 0.5) * 0.4 - 1.0  # mm along y, between two voxels
    offset = np.abs(field.grid.to_ras(nodes) - [3.0, border, 4.0])
    block = (offset[:, [0, 2]] < [2.0, 3.0]).all(axis=1)  # away from the block's faces
    assert (values[block & (offset[:, 1] < 0.1)] < 0).all()
    # The slit's half width of 0.3 mm and what smoothing adds.
    assert (values[block & (offset[:, 1] > 0.7) & (offset[:, 1] < 0.8)] > 0).all()
    assert (block & (offset[:, 1] > 0.7) & (offset[:, 1] < 0.8)).any()


def test_a_body_of_one_slice_at_an_end_goes_on_along_the_axis():
    """Voxel centers all as deep as each other tell no direction."""
    body = box_body()
    index, points = body.inside_points()
    depth = body.ends.height(points, "posterior")
    level = depth[np.argmin(np.abs(depth - 2.0))]
    kept = np.isclose(depth, level) | (depth > 4.5)
    inside = np.zeros_like(body.inside)
    inside[tuple(index[kept].T)] = True
    found = replace(body, inside=inside).outward
    np.testing.assert_allclose(found["posterior"], -body.ends.axis, atol=EXACT)
    np.testing.assert_allclose(found["anterior"], body.ends.axis, atol=0.02)


@pytest.mark.parametrize("growth", [0.0, 0.15])
def test_cross_sections_go_on_changing_beyond_an_end_as_they_do_behind_it(growth):
    """Two walls lean apart: each mm along the axis, the body is wider by a share of its width."""
    body = box_body(voxel=0.3, length=9.0)
    points = digital.voxel_points(np.ones(body.inside.shape, dtype=bool), body.affine)
    half = 3.0 * (1 + growth * (points[:, 2] - 9.0))
    inside = (np.abs(points[:, 0] - 3.0) <= half) & (points[:, 1] >= 0) & (points[:, 1] <= 2.4)
    between = (points[:, 2] > 0) & (points[:, 2] < 9.0)
    mask = (inside & between).reshape(body.inside.shape)
    wedge = replace(body, tissue=mask.astype(np.uint8), inside=mask)
    nodes = np.array([[x, 1.2, 10.5] for x in np.arange(-1.0, 3.0, 0.05)])
    grid = SimpleNamespace(node_points=nodes.copy, across=np.eye(3)[:2])
    read = continued_nodes(grid, wedge, 0.0)
    np.testing.assert_allclose(read[:, 2], 9.0, atol=1e-9)
    expected = 3.0 + (nodes[:, 0] - 3.0) / (1 + 1.5 * growth)
    # 0.45 mm at the wall without the change; walls are known to a quarter of a voxel.
    np.testing.assert_allclose(read[:, 0], expected, atol=0.08)


@pytest.mark.parametrize("offset", [0.0, 0.5, 1.0, 1.5])
def test_cross_sections_of_thick_slices_go_on_wherever_the_plane_lies(offset):
    """Slices of 2 mm: between half a slice and 3 mm behind a plane there may be no center."""
    body = box_body(voxel=0.4, length=12.0)
    affine = np.diag([0.4, 0.4, 2.0, 1.0])
    affine[:3, 3] = [-1.0, -1.0, -3.0 + offset]
    tissue = np.repeat(body.tissue[:, :, :1], 10, axis=2)
    ends = replace(body.ends, half_slice=1.0)
    thick = replace(body, tissue=tissue, inside=tissue > 0, affine=affine, ends=ends)
    nodes = np.array([[x, 1.2, z] for x in (0.5, 5.5) for z in (-1.0, 13.0)])
    grid = SimpleNamespace(node_points=nodes.copy, across=np.eye(3)[:2])
    read = continued_nodes(grid, thick, 0.0)
    np.testing.assert_allclose(read[:, :2], nodes[:, :2], atol=0.02)  # the box does not change


def test_nodes_between_tilted_planes_lie_where_they_are_said_to():
    grid = WedgeGrid(
        shape=(5, 7, 21),
        spacing=0.5,
        origin=np.array([1.0, 2.0, 3.0]),
        across=np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        axis=np.array([1.0, 0.0, 0.0]),
        posterior=np.array([1.0, 0.1, 0.2]),
        anterior=np.array([11.0, -0.1, 0.3]),
    )
    # The planes lie 1.8 and 11.7 mm above the middle.
    assert grid.step == pytest.approx(9.9 / 20)
    middle = grid.to_ras(np.array([[2.0, 3.0, 0.0], [2.0, 3.0, 5.0], [4.0, 1.0, 20.0]]))
    expected = [[2.8, 3.0, 4.5], [2.8 + 9.9 / 4, 3.0, 4.5], [12.9 - 1.0, 4.0, 3.5]]
    np.testing.assert_allclose(middle, expected, atol=EXACT)


def test_the_grid_ends_at_its_margins():
    """On multiples of 0.35 mm from a voxel, 1.9 mm and less than a step more round the body."""
    body = box_body(tilt=20.0)
    grid = resampled(body).grid
    points = body.inside_points()[1]
    nodes = grid.to_nodes(points)
    room = np.array([nodes.min(axis=0), np.array(grid.shape) - 1 - nodes.max(axis=0)])[:, :2]
    assert (room * 0.35 >= 1.9 - EXACT).all()
    assert (room * 0.35 < 1.9 + 0.35).all()
    nearest = np.rint(body.to_voxels(body.ends.posterior.point))
    voxel = body.affine[:3, :3] @ nearest + body.affine[:3, 3]
    shift = (voxel - grid.origin) @ grid.across.T / 0.35
    np.testing.assert_allclose(shift, np.rint(shift), atol=1e-6)
    hands = [np.linalg.det(resampled(body, hemi=hemi).grid.frame) for hemi in "LR"]
    assert hands == pytest.approx([1, -1])


@pytest.mark.parametrize(("degrees", "across"), [(59, True), (61, False)])
def test_slices_lie_across_the_body_up_to_sixty_degrees(degrees, across):
    turn = np.eye(4)
    turn[:3, :3] = rotation(0, degrees)
    body = plain_body(np.ones((3, 3, 3)), turn @ np.diag([0.4, 0.5, 2.0, 1.0]), straight_ends(9.0))
    assert grids.cut_across(body) is across


@pytest.mark.parametrize("skew", [0.0, 0.3])
def test_motion_of_cross_sections_behind_a_plane(skew):
    """A rectangle that moves and changes linearly with the depth, in both directions."""
    change = np.array([[0.05, 0.04], [-0.02, -0.06]])
    grid = np.indices((60, 44, 36)).reshape(3, -1).T * 0.25
    affine = np.diag([0.25, 0.25, 0.25, 1.0])
    affine[:3, 3] = [-7.5, -5.5, 0.1]
    points = grid + affine[:3, 3]
    depth = points[:, 2:]
    flat = points[:, :2] - depth * [skew, -0.5 * skew]
    local = np.einsum("nij,nj->ni", np.linalg.inv(np.eye(2) + depth[..., None] * change), flat)
    tissue = (np.abs(local) < [4.0, 2.2]).all(axis=1).reshape(60, 44, 36)
    body = plain_body(tissue, affine, replace(straight_ends(20.0), half_slice=0.125))
    inward = np.array([skew, -0.5 * skew, 1.0])
    turn = rotation(2, 30)
    center, across, found = grids._motion(body, "posterior", inward, turn[:2])
    np.testing.assert_allclose(center, 0.0, atol=0.1)
    np.testing.assert_allclose(across, turn[:2], atol=EXACT)
    np.testing.assert_allclose(found, turn[:2, :2] @ change @ turn[:2, :2].T, atol=0.025)
    if not skew:  # what lies a millimeter beyond the plane is read from this place in it
        body = replace(body, ends=replace(straight_ends(9.0), half_slice=0.125))
        nodes = np.array([[2.0, 1.0, -1.0], [3.0, -1.5, -2.0]])
        read = continued_nodes(SimpleNamespace(node_points=nodes.copy, across=turn[:2]), body, 0.0)
        places = [np.linalg.inv(np.eye(2) + node[2] * change) @ node[:2] for node in nodes]
        np.testing.assert_allclose(read, np.column_stack([places, [0, 0]]), atol=0.08)


def test_filling_and_parting_of_labels_is_undone():
    kind = np.random.default_rng(4).choice(5, size=(12, 11, 10), p=[0.4, 0.3, 0.1, 0.1, 0.1])
    parts = {"slits": kind == 2, "cavities": kind == 3, "separated": kind == 4}
    after, before = (
        grids._smooth(np.isin(kind, kinds).astype(np.float32), 1.1) for kinds in ((1, 2, 3), (1, 4))
    )
    field = replace(field_of(kind > 0), values=after, smoothing=1.1, **parts)
    np.testing.assert_allclose(grids.before_mending(field).values, before, atol=1e-5)


def test_smoothing_keeps_quadratic_functions():
    """What a Gaussian adds, its second pass adds again."""
    a, b, _ = np.indices((41, 41, 3)) - 20.0
    values = (0.01 * (a**2 - 2 * b**2 + a * b) + 0.1 * a).astype(np.float32)
    smooth = grids._smooth(values, 1.5)[12:-12, 12:-12]
    np.testing.assert_allclose(smooth, values[12:-12, 12:-12], atol=1e-4)
    np.testing.assert_allclose(grids._slope(3 * a + 2 * b)[1:-1], np.sqrt(13), atol=1e-6)


@pytest.mark.parametrize(("edge", "touch"), [(0.43, False), (0.38, True)])
def test_slits_lie_between_ends_that_touch(edge, touch):
    """Planes of subiculum and CA3 two voxels apart, and another one farther away."""
    tissue = np.zeros((9, 30, 9), dtype=np.uint8)
    tissue[:, 5], tissue[:, 7], tissue[:, 14] = Tissue.SUBICULUM, Tissue.CA3, Tissue.SUBICULUM
    body = plain_body(tissue, np.diag([edge, edge, edge, 1.0]), straight_ends(20.0))
    places = edge * np.arange(3.0, 16.0, 0.08)
    points = np.column_stack([4 * edge + 0 * places, places, 4 * edge + 0 * places])
    gaps = np.abs(places - 5 * edge), np.abs(places - 7 * edge)
    expected = np.maximum(*gaps) < TOUCH_DISTANCE + 0.5 * edge
    expected &= np.abs(gaps[0] - gaps[1]) < 2 * SLIT_HALF_WIDTH
    np.testing.assert_array_equal(grids._between_turns(body, points), expected & touch)
    assert expected.sum() > 10


@pytest.mark.parametrize(
    ("times", "edge", "refused"),
    [
        ((1, 1, 1), 0.89, None),
        ((1, 1, 1), 0.91, "voxels of 0.91 mm are too coarse"),
        ((2, 2, 1), 0.5, "voxels of 0.50 mm were resampled from about 1.00 mm"),
        ((1, 3, 1), 0.4, None),  # along one axis: thick slices
        ((3, 1, 4), 0.2, "from about 0.80 mm"),
        ((5, 5, 5), 0.2, None),
    ],
)
def test_labels_that_were_resampled_are_refused(times, edge, refused):
    tissue = np.random.default_rng(0).integers(2, 4, (8, 9, 7)).astype(np.uint8)
    for axis, count in enumerate(times):
        tissue = np.repeat(tissue, count, axis=axis)
    volume = SimpleNamespace(tissue=tissue, affine=rigid() @ np.diag([edge, edge, edge, 1.0]))
    with pytest.raises(GeometryError, match=refused) if refused else nullcontext():
        grids.check_voxel(volume, CheckSettings())


def test_filled_nodes_are_known_to_the_field(arc):
    index = np.argwhere(arc.body.inside)
    height = arc.body.ends.height(arc.body.inside_points()[1], "posterior")
    index = index[np.abs(height - np.median(height)) < 3][::200]  # mm; nodes at ends lie closer
    field = resampled(replace(arc.body, filled=index))
    points = index @ arc.body.affine[:3, :3].T + arc.body.affine[:3, 3]
    nodes = np.argwhere(field.slits).astype(float)
    distance = np.linalg.norm(field.grid.to_ras(nodes)[:, None] - points, axis=-1).min(axis=1)
    assert distance.max() <= 0.5 * np.sqrt(3) * 0.4 + 1e-6  # half the diagonal of a voxel


@pytest.mark.parametrize("hemi", ["L", "R"])
@pytest.mark.parametrize("sign", [1, -1])
def test_grids_lie_along_the_most_lateral_edge_of_the_voxels(sign, hemi):
    """A plate that gets more lateral along the second edge, and a little along the first."""
    shape, turn = (7, 11, 5), rotation(0, 30) @ rotation(2, 25)
    affine = np.eye(4)
    affine[:3, :3] = turn * [0.5, 0.4, 0.6]
    affine[:3, 3] = [40.0, -20.0, 7.0]
    axis = turn @ [0.1, 0.0, np.sqrt(0.99)]
    place = sign * (np.indices(shape)[1] + 0.3 * np.indices(shape)[0] - 5.9)
    tissue = np.select([place < -2, place < 2], [Tissue.SUBICULUM, Tissue.CA1], Tissue.CA3)
    body = plain_body(tissue, affine, replace(straight_ends(9.0), axis=axis))
    points = body.inside_points()[1]
    flat = points - np.outer(points @ axis, axis)
    first, second = grids._directions_across(body, hemi, flat)
    np.testing.assert_allclose(first, sign * turn[:, 1], atol=EXACT)
    np.testing.assert_allclose({"L": 1, "R": -1}[hemi] * second, np.cross(axis, first), atol=EXACT)


@pytest.mark.parametrize("pose", [np.eye(4), rigid()])
def test_a_slanting_prism_goes_on_along_itself(pose):
    """Its sections move by 0.4 and -0.2 mm per mm, and the planes lie across the first axis."""
    index = np.indices((52, 40, 40)).reshape(3, -1).T
    affine = np.diag([0.3, 0.3, 0.3, 1.0])
    affine[:3, 3] = [-6.0, -6.0, -1.0]
    points = index @ affine[:3, :3].T + affine[:3, 3]
    slope = np.array([0.4, -0.2])
    local = np.abs(points[:, :2] - points[:, 2:] * slope)
    tissue = (local < [3.0, 2.0]).all(axis=1).reshape(52, 40, 40)
    ends, spin, shift = straight_ends(9.0), pose[:3, :3], pose[:3, 3]
    planes = [
        plane._replace(point=spin @ plane.point + shift, normal=spin @ plane.normal)
        for plane in (ends.posterior, ends.anterior)
    ]
    ends = replace(ends, posterior=planes[0], anterior=planes[1], axis=spin @ ends.axis)
    body = plain_body(tissue, pose @ affine, ends)
    body.inside[...] &= ((points[:, 2] > 0) & (points[:, 2] < 9)).reshape(tissue.shape)
    nodes = np.array([[0.5, 1.0, -1.5], [-0.9, 0.3, 0.2], [1.0, -0.7, 8.9], [4.0, -1.0, 11.0]])
    # As many mm along z, to half a mm inside of the planes.
    expected = nodes - np.array([[-2.0], [-0.3], [0.4], [2.5]]) * [*slope, 1.0]
    places = nodes @ spin.T + shift
    across = np.array([[0.8, 0.6, 0.2], [-0.6, 0.8, -0.4]]) @ spin.T  # turned into the planes
    read = continued_nodes(SimpleNamespace(node_points=places.copy, across=across), body, 0.5)
    np.testing.assert_allclose((read - shift) @ spin, expected, atol=0.08)
