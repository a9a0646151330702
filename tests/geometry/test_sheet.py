"""Sampling on the regular grid: exact on a box, folds and gaps counted and filled."""

import numpy as np
import pytest
from geometry_cases import box_mesh, plain_body, rigid, straight_ends
from hypothesis import given, settings
from hypothesis import strategies as st

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.sheet import (
    check_flipped,
    folded_fraction,
    is_flipped,
    label_sheet,
    sample_sheet,
    sheet_levels,
    whole_body,
)
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.settings import SheetSettings
from hipsta_bids.types import Coordinates, Sheet, TetMesh

SIZE = np.array([6.0, 4.0, 2.0])
GRID = SheetSettings()
EXACT = 1e-10  # rounding


def box(cells=(6, 5, 4), seed=None):
    """A box and its linear coordinates; with a seed, inner vertices are moved."""
    mesh = box_mesh(cells, SIZE)
    if seed is not None:
        inner = ((mesh.vertices > 0) & (mesh.vertices < SIZE)).all(axis=1)
        shift = np.random.default_rng(seed).uniform(-0.1, 0.1, mesh.vertices.shape)
        mesh = TetMesh(vertices=mesh.vertices + shift * inner[:, None], tetrahedra=mesh.tetrahedra)
    return mesh, Coordinates(values=2 * mesh.vertices / SIZE - 1)


def regular(grid):
    """The grid's nodes in the box."""
    levels = np.meshgrid(*sheet_levels(grid), indexing="ij")
    return (np.stack(levels, axis=-1) + 1) / 2 * SIZE


@pytest.mark.parametrize("seed", [None, 1, 2])
def test_a_box_with_linear_coordinates_gives_the_regular_grid(seed):
    sheet = sample_sheet(*box(seed=seed), GRID)
    assert sheet.valid.all()
    np.testing.assert_allclose(sheet.points, regular(GRID), atol=EXACT)


def test_the_grid_has_the_settings_nodes_and_extents():
    grid = SheetSettings(
        x_nodes=11, y_nodes=7, z_nodes=5, x_extent=0.9, y_extent=0.975, z_extent=0.9
    )
    sheet = sample_sheet(*box(), grid)
    assert sheet.points.shape == (11, 7, 5, 3)
    assert sheet.middle == 2
    np.testing.assert_allclose(sheet.points, regular(grid), atol=EXACT)
    low, high = sheet.points[0, 0, 0], sheet.points[-1, -1, -1]
    np.testing.assert_allclose(low, SIZE / 2 * (1 - np.array([0.9, 0.975, 0.9])), atol=EXACT)
    np.testing.assert_allclose(low + high, SIZE, atol=EXACT)


def test_the_whole_body_reaches_from_wall_to_wall():
    sheet = sample_sheet(*box(), whole_body(GRID))
    short = [0.5e-4 * SIZE[0], 0, 0]  # just inside of the edges
    np.testing.assert_allclose(sheet.points[0, 0, 0], short, atol=EXACT)
    np.testing.assert_allclose(sheet.points[-1, -1, -1], np.subtract(SIZE, short), atol=EXACT)


@given(st.integers(0, 100))
@settings(max_examples=10, deadline=None)
def test_renumbering_changes_nothing(seed):
    mesh, coordinates = box(seed=3)
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(mesh.vertices))
    place = np.argsort(order)
    again = TetMesh(
        vertices=mesh.vertices[order],
        tetrahedra=place[mesh.tetrahedra][rng.permutation(len(mesh.tetrahedra))],
    )
    sheet = sample_sheet(again, Coordinates(values=coordinates.values[order]), GRID)
    np.testing.assert_allclose(sheet.points, regular(GRID), atol=EXACT)


def test_rigid_motion_moves_the_sheet_along():
    mesh, coordinates = box(seed=4)
    pose = rigid()
    moved = TetMesh(
        vertices=mesh.vertices @ pose[:3, :3].T + pose[:3, 3], tetrahedra=mesh.tetrahedra
    )
    wanted = regular(GRID) @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose(sample_sheet(moved, coordinates, GRID).points, wanted, atol=EXACT)


def with_gap(where):
    """The box without the tetrahedra whose centers lie in a region."""
    mesh, coordinates = box((12, 8, 4))
    centers = mesh.vertices[mesh.tetrahedra].mean(axis=1)
    return TetMesh(vertices=mesh.vertices, tetrahedra=mesh.tetrahedra[~where(centers)]), coordinates


def test_missing_columns_are_filled_and_marked():
    # 0.5 x 0.5 mm of 6 x 4, at mid-depth only.
    mesh, coordinates = with_gap(
        lambda p: (np.abs(p - SIZE / 2 - [0.25, 0.25, 0.25]) < 0.25).all(axis=1)
    )
    sheet = sample_sheet(mesh, coordinates, GRID)
    missing = ~sheet.valid
    wanted = regular(GRID)
    in_gap = (np.abs(wanted[:, :, 4, :2] - SIZE[:2] / 2 - 0.25) < 0.25).all(axis=-1)
    assert missing.any()
    assert (missing <= in_gap).all()
    assert np.isfinite(sheet.points).all()
    np.testing.assert_allclose(sheet.points[sheet.valid], wanted[sheet.valid], atol=EXACT)
    # From neighbors on all sides, some nodes of 0.15 x 0.2 mm away.
    assert np.linalg.norm(sheet.points - wanted, axis=-1).max() < 0.2


def test_gaps_at_a_corner_are_filled_too():
    mesh, coordinates = with_gap(lambda p: (p[:, 0] < 1.0) & (p[:, 1] < 1.0))
    sheet = sample_sheet(mesh, coordinates, GRID)
    assert not sheet.valid[0, 0]
    assert np.isfinite(sheet.points).all()


@pytest.mark.parametrize(("share", "refused"), [(0.1, False), (0.4, True)])
def test_a_sheet_with_too_many_gaps_is_refused(share, refused):
    mesh, coordinates = with_gap(lambda p: p[:, 0] < share * SIZE[0])
    if not refused:
        sheet = sample_sheet(mesh, coordinates, GRID)
        assert 0 < 1 - sheet.valid.mean() <= GRID.max_filled
        return
    with pytest.raises(GeometryError, match=r"% of the sheet's columns lie in no") as caught:
        sample_sheet(mesh, coordinates, GRID)
    assert caught.value.reason == "sheet-incomplete"


def test_folded_fraction_of_mirrored_elements():
    corner = np.vstack([np.zeros(3), np.eye(3)])
    mesh = TetMesh(
        vertices=np.vstack([corner, 2 * corner + 5.0]), tetrahedra=[[0, 1, 2, 3], [4, 5, 6, 7]]
    )
    sound = mesh.vertices.copy()
    assert folded_fraction(mesh, Coordinates(values=sound)) == 0
    folded = sound.copy()
    folded[:4, 0] *= -1
    # Volumes are 1 and 8: the small one is turned inside out.
    assert folded_fraction(mesh, Coordinates(values=folded)) == pytest.approx(1 / 9)


def test_a_mirrored_coordinate_system_is_not_folded(case):
    fraction = folded_fraction(case.mesh, case.coordinates)
    assert fraction < 0.01
    turned = Coordinates(values=case.coordinates.values * [1.0, 1.0, -1.0])
    assert folded_fraction(case.mesh, turned) == pytest.approx(fraction)


def test_labels_of_columns_are_the_majority():
    voxel = 0.5
    tissue = np.zeros((12, 8, 4), dtype=np.uint8)
    tissue[:6] = Tissue.SUBICULUM
    tissue[6:] = Tissue.CA1
    tissue[:6, :, 0] = Tissue.CA3  # a thin layer loses
    affine = np.diag([voxel, voxel, voxel, 1.0])
    affine[:3, 3] = voxel / 2
    sheet = sample_sheet(*box(), GRID)
    labels = label_sheet(sheet, plain_body(tissue, affine, straight_ends(2.0)))
    x = sheet.points[:, :, sheet.middle, 0]
    assert (labels[x < 2.9] == Tissue.SUBICULUM).all()
    assert (labels[x > 3.1] == Tissue.CA1).all()


def test_subfields_of_phantoms_follow_the_truth(case):
    labels = label_sheet(case.sheet, case.body)
    hemi = "R" if case.volume.affine[0, 3] > 0 else "L"
    middle = case.sheet.points[:, :, case.sheet.middle]
    u, *_ = case.phantom.body.locate(middle.reshape(-1, 3), hemi=hemi).T
    # FreeSurfer has one label for CA2 and CA3, from u = 0.75 on.
    starts = np.array([0.15, 0.35, 0.75])
    kinds = np.array([Tissue.PRESUBICULUM, Tissue.SUBICULUM, Tissue.CA1, Tissue.CA2_3])
    wanted = kinds[np.searchsorted(starts, u, side="right")]
    border = np.abs(u[:, None] - starts).min(axis=1) < 0.4 / case.phantom.spec.width  # a voxel
    assert (labels.ravel() == wanted)[~border].mean() > 0.99


def test_phantom_sheets_lie_on_the_phantoms_mid_surface(case):
    hemi = "R" if case.volume.affine[0, 3] > 0 else "L"
    middle = case.sheet.points[:, :, case.sheet.middle].reshape(-1, 3)
    _, v, n = case.phantom.body.locate(middle, hemi=hemi).T
    assert np.sqrt(np.nanmean(n**2)) < 0.12  # a third of a voxel
    wanted = np.tile((sheet_levels(GRID)[1] + 1) / 2, GRID.x_nodes)
    assert np.nanmax(np.abs(v - wanted)) < 0.04  # 0.3 of 8 mm


def test_sheets_refuse_wrong_shapes():
    points = np.zeros((4, 3, 5, 3))
    assert not Sheet(points=points, valid=np.ones((4, 3), dtype=bool)).points.flags.writeable
    with pytest.raises(ValueError, match=r"Sheet\.valid: shape"):
        Sheet(points=points, valid=np.ones((3, 4), dtype=bool))


def test_rows_of_the_head_and_the_tail_are_as_far_apart_as_those_of_the_body():
    grid = SheetSettings(y_nodes=5, y_extent=0.8)
    np.testing.assert_allclose(sheet_levels(grid)[1], [-0.8, -0.4, 0, 0.4, 0.8], atol=EXACT)
    rows = sheet_levels(grid, "whole")[1]
    np.testing.assert_allclose(rows, 0.4 * np.arange(-4, 7), atol=EXACT)


def curled_sheet(curl):
    """A left sheet (x to the left, y forward, interior up) of constant curvature, 1/mm, moved."""
    s, y, z = np.meshgrid(
        np.linspace(0.0, 10.0, 21), np.linspace(0.0, 8.0, 9), np.linspace(0, 1, 3), indexing="ij"
    )
    radius = 1 / curl + z - 0.5
    angle = s * curl
    points = np.stack([-radius * np.sin(angle), y, -radius * np.cos(angle)], axis=-1)
    return Sheet(points=points @ rigid()[:3, :3].T + 9.0, valid=np.ones((21, 9), dtype=bool))


@pytest.mark.parametrize("curl", [0.2, -0.2, 0.01])
def test_sides_follow_from_the_hemisphere_whatever_the_bend(curl):
    sheet = curled_sheet(curl)
    mirrored = Sheet(points=sheet.points * [-1, 1, 1], valid=sheet.valid)
    turned = Sheet(points=sheet.points[:, :, ::-1], valid=sheet.valid)
    assert not is_flipped(sheet, "L")
    assert not is_flipped(mirrored, "R")
    assert is_flipped(sheet, "R")
    assert is_flipped(turned, "L")
    assert not check_flipped(sheet, "L").raised
    assert check_flipped(turned, "L").raised
