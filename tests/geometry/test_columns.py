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
