"""Columns of a common sheet, cut at the walls of a visit."""

import numpy as np
import pytest
from geometry_cases import straight_grid

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry import columns
from hipsta_bids.geometry.grid import Field
from hipsta_bids.geometry.mesh import tetra_volumes
from hipsta_bids.types import Sheet

NX, NY, NZ = 15, 9, 9
LOW, HIGH = 8.0, 10.0  # mm, walls of the sheet along a
#: mm; the spline rounds the bend of the field in the middle of the plate.
BENT = 0.015


def flat_sheet():
    """A plate whose columns run along x of RAS, from 8 to 10 mm."""
    x = np.linspace(LOW, HIGH, NZ)
    along, across = np.linspace(4, 16, NX), np.linspace(4, 12, NY)
    points = np.stack(np.broadcast_arrays(x, along[:, None, None], across[:, None]), axis=-1)
    return Sheet(points=points, valid=np.ones((NX, NY), dtype=bool))


def plate_field(low, high, further=()):
    """A field that is positive between walls, functions of the other coordinates, mm."""
    grid = straight_grid((40, 40, 40))
    points = grid.node_points()
    depth = np.minimum(points[..., 0] - low(points), high(points) - points[..., 0])
    for start, end in further:
        depth = np.maximum(depth, np.minimum(points[..., 0] - start, end - points[..., 0]))
    return Field(grid=grid, values=depth.astype(np.float32))


def bounded_field(edges):
    """A field of the plate, with its own edges along the rows (along y of RAS), mm."""
    field = plate_field(at(LOW), at(HIGH))
    along = field.grid.node_points()[..., 1]
    depth = np.minimum(field.values, np.minimum(along - edges[0], edges[1] - along))
    return Field(grid=field.grid, values=depth.astype(np.float32))


def at(value):
    return lambda points: np.full(points.shape[:-1], value)


@pytest.fixture
def sheet():
    return flat_sheet()


def test_moved_walls_are_found(sheet):
    walls = columns.find_walls(sheet, np.eye(4), plate_field(at(8.3), at(10.2)))
    assert walls.raw[..., 0] == pytest.approx(0.3, abs=BENT)
    assert walls.raw[..., 1] == pytest.approx(0.2, abs=BENT)
    assert walls.moves == pytest.approx(walls.raw, abs=1e-3)
    assert walls.distance == pytest.approx(np.sqrt((0.09 + 0.04) / 2), abs=BENT)
    carried = columns.move_walls(sheet, walls.moves, np.eye(4))
    assert carried.points[..., 0, 0] == pytest.approx(8.3, abs=BENT)
    assert carried.points[..., -1, 0] == pytest.approx(10.2, abs=BENT)


def test_a_fold_beside_the_sheet_is_not_its_wall(sheet):
    walls = columns.find_walls(sheet, np.eye(4), plate_field(at(8.0), at(10.0), [(10.8, 12.0)]))
    assert walls.known.all()
    assert walls.raw == pytest.approx(0.0, abs=BENT)


def test_columns_that_run_into_a_fold_follow_their_neighbors(sheet):
    def joined(points):
        touching = np.abs(points[..., 1] - 10) < 0.8
        return np.where(touching, 13.0, 10.1)

    walls = columns.find_walls(sheet, np.eye(4), plate_field(at(8.0), joined))
    assert 0 < (~walls.known).sum() < NX * NY / 4
    # Where the field turns from one wall to the other, it is not exact.
    assert walls.moves[~walls.known][:, 1] == pytest.approx(0.1, abs=0.15)


def test_a_wall_that_moves_away_loses_its_weight_gradually(sheet):
    def moves(distance):
        field = plate_field(
            at(LOW), lambda p: HIGH + distance * np.exp(-((p[..., 1] - 10) ** 2) / 0.72)
        )
        return columns.find_walls(sheet, np.eye(4), field).moves[..., 1]

    distances, spacing = np.arange(0.0, 1.45, 0.02), 12 / (NX - 1)
    maps = np.stack([moves(distance) for distance in distances])
    largest = np.abs(np.diff(maps, axis=0)).max(axis=(1, 2))
    assert largest.max() < 2 * 0.02
    assert maps[distances.searchsorted(0.4)].max() == pytest.approx(0.4, abs=0.12)
    # There, the neighbors decide.
    assert maps[-1].max() == pytest.approx(distances[-1] * np.exp(-(spacing**2) / 0.72), abs=0.05)


def test_edges_of_a_visit_are_found(sheet):
    edges = columns.find_edges(sheet, np.eye(4), bounded_field((4.3, 15.6)))
    # Steps along a row are 0.3 mm.
    assert edges[:, 0] == pytest.approx(0.3, abs=2 * BENT)
    assert edges[:, 1] == pytest.approx(-0.4, abs=2 * BENT)


def test_edges_are_smoothed_past_places_without_one(sheet):
    edges = np.tile([0.3, -0.2], (NY, 1))
    edges[2] = np.nan
    edges[5, 0] = 3.0  # of another turn
    smooth = columns.smooth_edges(edges, sheet)
    assert smooth == pytest.approx(np.tile([0.3, -0.2], (NY, 1)))
    assert not columns.smooth_edges(np.full((NY, 2), np.nan), sheet).any()


@pytest.mark.parametrize("far", [0.3, 1.4])
def test_columns_follow_the_edges_less_the_farther_away(sheet, far):
    edges = np.tile([far, -0.2], (5, 1))
    moved = columns.move_edges(sheet, edges, 1.0, 1.0)
    distance = moved.points - sheet.points
    assert distance[..., [0, 2]] == pytest.approx(0.0, abs=1e-12)
    assert distance[0, ..., 1] == pytest.approx(far, abs=1e-4)
    assert distance[-1, ..., 1] == pytest.approx(-0.2, abs=0.03)
    reach = np.hypot(columns.EDGE_REACH, 2 * far)
    assert distance[1, ..., 1] == pytest.approx(far * np.exp(-12 / (NX - 1) / reach), abs=1e-4)
    # Columns do not change places.
    assert np.diff(moved.points[:, 0, 0, 1]).min() > 0.4 * 12 / (NX - 1)
    # A sheet that ends before the edges moves as that part of the whole one.
    short = Sheet(points=sheet.points[1:-1], valid=sheet.valid[1:-1])
    part = columns.move_edges(short, edges, (NX - 3) / (NX - 1), 1.0)
    assert part.points == pytest.approx(moved.points[1:-1])


def test_a_visit_far_from_the_sheet_is_refused(sheet):
    with pytest.raises(GeometryError, match="no column"):
        columns.find_walls(sheet, np.eye(4), plate_field(at(13.0), at(15.0)))


def test_smoothing_keeps_a_slope_of_walls_and_lowers_noise(sheet):
    slope = plate_field(at(8.0), lambda p: 10 + 0.03 * (p[..., 1] - 10))
    moves = columns.find_walls(sheet, np.eye(4), slope).moves[2:-2, :, 1]
    expected = 0.03 * (sheet.points[2:-2, :, 0, 1] - 10)
    assert moves == pytest.approx(expected, abs=BENT)


def test_the_motion_carries_the_sheet(sheet):
    motion = np.eye(4)
    motion[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    motion[:3, 3] = [20.0, 3.0, 1.0]
    carried = columns.move_walls(sheet, np.zeros((NX, NY, 2)), motion)
    assert carried.points == pytest.approx(sheet.points @ motion[:3, :3].T + motion[:3, 3])


def test_moves_shrink_towards_edges_where_columns_do(sheet):
    points = sheet.points.copy()
    middle = points[:, :, 4:5]
    shrink = np.clip(1.5 - np.abs(np.linspace(-1.5, 1.5, NX)), 0, 1)
    whole = Sheet(
        points=middle + (points - middle) * shrink[:, None, None, None], valid=sheet.valid
    )
    moves = np.tile([-0.1, 0.1], (NX, NY, 1))
    carried = columns.moves_at(moves, sheet, whole, 0.9, 1.0)
    assert carried[[0, -1]] == pytest.approx(0.0, abs=1e-6)
    assert carried[NX // 2, :, 1] == pytest.approx(0.1)


def test_cells_fill_the_sheet_with_positive_tetrahedra(sheet):
    for points in (sheet.points, sheet.points[:, :, ::-1]):
        mesh, coordinates = columns.grid_mesh(Sheet(points=points, valid=sheet.valid))
        volumes = tetra_volumes(mesh.vertices, mesh.tetrahedra)
        assert (volumes > 0).all()
        assert volumes.sum() == pytest.approx(2.0 * 12 * 8)
        assert coordinates.values.min() == -1
        assert coordinates.values.max() == 1


def test_columns_are_continued_in_equal_steps(sheet):
    points, depth = columns._continued(sheet)
    steps = np.r_[
        np.arange(-1.5, -0.01, 0.05), np.arange(0, 2.01, 0.05), np.arange(2.05, 3.51, 0.05)
    ]
    np.testing.assert_allclose(depth[3, 4], steps, atol=1e-12)
    np.testing.assert_allclose(points[3, 4, :, 0], LOW + steps)


def test_lines_lie_among_nodes_within_an_extent():
    found = columns._positions(0.8, 5, 9), columns._positions(1.0, 3, 9, 0.5)
    np.testing.assert_allclose(found[0], [0, 1.5, 4, 6.5, 8])
    np.testing.assert_allclose(found[1], [2, 4, 6])
