"""Columns of a common sheet, carried to the edges and walls of a visit."""

import numpy as np
import pytest
from plates import BENT, NX, NY, bounded_field, flat_sheet

from hipsta_bids.extensions.visits import carry
from hipsta_bids.geometry.mesh import tetra_volumes
from hipsta_bids.types import Sheet


@pytest.fixture
def sheet():
    return flat_sheet()


def test_edges_of_a_visit_are_found(sheet):
    edges = carry.find_edges(sheet, np.eye(4), bounded_field((4.3, 15.6)))
    # Steps along a row are 0.3 mm.
    assert edges[:, 0] == pytest.approx(0.3, abs=2 * BENT)
    assert edges[:, 1] == pytest.approx(-0.4, abs=2 * BENT)


def test_edges_are_smoothed_past_places_without_one(sheet):
    edges = np.tile([0.3, -0.2], (NY, 1))
    edges[2] = np.nan
    edges[5, 0] = 3.0  # of another turn
    smooth = carry.smooth_edges(edges, sheet)
    assert smooth == pytest.approx(np.tile([0.3, -0.2], (NY, 1)))
    assert not carry.smooth_edges(np.full((NY, 2), np.nan), sheet).any()


@pytest.mark.parametrize("far", [0.3, 1.4])
def test_columns_follow_the_edges_less_the_farther_away(sheet, far):
    edges = np.tile([far, -0.2], (5, 1))
    moved = carry.move_edges(sheet, edges, 1.0, 1.0)
    distance = moved.points - sheet.points
    assert distance[..., [0, 2]] == pytest.approx(0.0, abs=1e-12)
    assert distance[0, ..., 1] == pytest.approx(far, abs=1e-4)
    assert distance[-1, ..., 1] == pytest.approx(-0.2, abs=0.03)
    reach = np.hypot(carry.EDGE_REACH, 2 * far)
    assert distance[1, ..., 1] == pytest.approx(far * np.exp(-12 / (NX - 1) / reach), abs=1e-4)
    # Columns do not change places.
    assert np.diff(moved.points[:, 0, 0, 1]).min() > 0.4 * 12 / (NX - 1)
    # A sheet that ends before the edges moves as that part of the whole one.
    short = Sheet(points=sheet.points[1:-1], valid=sheet.valid[1:-1])
    part = carry.move_edges(short, edges, (NX - 3) / (NX - 1), 1.0)
    assert part.points == pytest.approx(moved.points[1:-1])


def test_walls_follow_their_moves(sheet):
    carried = carry.move_walls(sheet, np.tile([0.3, 0.2], (NX, NY, 1)), np.eye(4))
    assert carried.points[..., 0, 0] == pytest.approx(8.3)
    assert carried.points[..., -1, 0] == pytest.approx(10.2)


def test_the_motion_carries_the_sheet(sheet):
    motion = np.eye(4)
    motion[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    motion[:3, 3] = [20.0, 3.0, 1.0]
    carried = carry.move_walls(sheet, np.zeros((NX, NY, 2)), motion)
    assert carried.points == pytest.approx(sheet.points @ motion[:3, :3].T + motion[:3, 3])


def test_moves_shrink_towards_edges_where_columns_do(sheet):
    points = sheet.points.copy()
    middle = points[:, :, 4:5]
    shrink = np.clip(1.5 - np.abs(np.linspace(-1.5, 1.5, NX)), 0, 1)
    whole = Sheet(
        points=middle + (points - middle) * shrink[:, None, None, None], valid=sheet.valid
    )
    moves = np.tile([-0.1, 0.1], (NX, NY, 1))
    carried = carry.moves_at(moves, sheet, whole, 0.9, 1.0)
    assert carried[[0, -1]] == pytest.approx(0.0, abs=1e-6)
    assert carried[NX // 2, :, 1] == pytest.approx(0.1)


def test_cells_fill_the_sheet_with_positive_tetrahedra(sheet):
    for points in (sheet.points, sheet.points[:, :, ::-1]):
        mesh, coordinates = carry.grid_mesh(Sheet(points=points, valid=sheet.valid))
        volumes = tetra_volumes(mesh.vertices, mesh.tetrahedra)
        assert (volumes > 0).all()
        assert volumes.sum() == pytest.approx(2.0 * 12 * 8)
        assert coordinates.values.min() == -1
        assert coordinates.values.max() == 1
