"""Subfields at places: labels, and shares of the mid-surface and of the volume."""

import numpy as np
import pytest
from geometry_cases import box_mesh, plain_body, straight_ends
from sheet_cases import plates

from hipsta_bids.geometry.measures import labels_at, subfield_areas, subfield_volumes
from hipsta_bids.protocols.protocol import Tissue

VOXEL = 0.5


def halves(border, *, size=(24, 16, 4)):
    """A box of 12 x 8 x 2 mm: subiculum up to a voxel number along x, CA1 beyond."""
    tissue = np.full(size, Tissue.CA1, dtype=np.uint8)
    tissue[:border] = Tissue.SUBICULUM
    affine = np.diag([VOXEL, VOXEL, VOXEL, 1.0])
    affine[:3, 3] = VOXEL / 2
    return plain_body(tissue, affine, straight_ends(8.0))


def test_labels_are_those_of_the_voxel_or_of_the_nearest():
    body = halves(10)
    body.tissue[:, :, 3], body.inside[:, :, 3] = Tissue.CA3, False  # beyond an end plane
    points = np.array([[4.99, 1, 1], [5.01, 1, 1], [-3, 4, 1], [20, 4, 1], [5.3, 4, 9]])
    points = np.vstack([points, [[4.9, 4, 1.9], [5.1, 4, 1.9]]])
    wanted = [Tissue.SUBICULUM, Tissue.CA1, Tissue.SUBICULUM, Tissue.CA1, Tissue.CA1]
    wanted += [Tissue.SUBICULUM, Tissue.CA1]
    assert labels_at(points, body).tolist() == wanted


def test_labels_beyond_an_image_with_sheared_axes_are_those_of_the_nearest_voxel():
    """The header of an image may hold any affine."""
    straight = halves(10)
    affine = straight.affine.copy()
    affine[0, 1] = 0.3  # rows lean by 31 degrees
    body = plain_body(straight.tissue, affine, straight.ends)
    index, centers = body.inside_points()
    points = np.random.default_rng(3).uniform([0, 9, 0], [17, 14, 2], (200, 3))
    distance = np.linalg.norm(points[:, None] - centers, axis=2)
    nearest = body.tissue[tuple(index[distance.argmin(axis=1)].T)]
    np.testing.assert_array_equal(labels_at(points, body), nearest)


@pytest.mark.parametrize("border", [3, 10, 17])
def test_areas_are_finer_than_the_grid(border):
    """The grid's lines are 0.3 mm apart."""
    found = subfield_areas(plates(thickness=2.0), halves(border))
    assert sum(found.values()) == pytest.approx(96.0)
    # Half the distance of two places along x, 0.3 mm / 4, over 8 mm of border.
    assert found[Tissue.SUBICULUM] == pytest.approx(border * VOXEL * 8.0, abs=0.0375 * 8 + 1e-9)


def test_columns_across_a_border_count_for_both_sides():
    tissue = np.full((24, 16, 4), Tissue.CA1, dtype=np.uint8)
    tissue[:10, :, 1:] = Tissue.SUBICULUM
    body = plain_body(tissue, halves(10).affine, straight_ends(8.0))
    found = subfield_areas(plates(thickness=1.9), body)
    # Two of seven inner levels, 0.24 mm apart, lie in the lowest voxel.
    assert found[Tissue.SUBICULUM] == pytest.approx(5 / 7 * 5.0 * 8.0, abs=0.0375 * 8)


def test_volumes_add_up_to_the_mesh():
    mesh = box_mesh((24, 16, 4), (12.0, 8.0, 2.0))
    found = subfield_volumes(mesh, halves(6))
    # Borders of voxels are those of the mesh's cubes.
    assert found == pytest.approx({Tissue.SUBICULUM: 48.0, Tissue.CA1: 144.0})
