"""Three harmonic coordinates: exact on a box, true on phantoms, convergent."""

import numpy as np
import pytest
from geometry_cases import box_mesh

from hipsta_bids.geometry.boundaries import Boundaries
from hipsta_bids.geometry.fem import volume_laplace
from hipsta_bids.geometry.sheet import solve_coordinates

SIZE = (6.0, 4.0, 2.0)


def box_boundaries(mesh):
    """The six faces of a box as the six boundaries."""
    sets = {}
    names = (("medial", "lateral"), ("posterior", "anterior"), ("interior", "exterior"))
    for axis, pair in enumerate(names):
        for name, value in zip(pair, (0.0, SIZE[axis]), strict=True):
            sets[name] = np.flatnonzero(mesh.vertices[:, axis] == value).astype(np.int32)
    return Boundaries(
        **sets,
        medial_curve=np.zeros((1, 3)),
        lateral_curve=np.zeros((1, 3)),
        doubt=0.0,
        side_rule="labels",
        side_margin=1.0,
        strip_width=0.0,
        sheet_thickness=2.0,
    )


def test_coordinates_of_a_box_are_linear():
    mesh = box_mesh((5, 4, 3), SIZE)
    values = solve_coordinates(volume_laplace(mesh), box_boundaries(mesh)).values
    # Linear functions are harmonic and without flux through the other faces: exact but rounding.
    np.testing.assert_allclose(values, 2 * mesh.vertices / SIZE - 1, atol=1e-12)


def test_coordinates_keep_within_their_range(case):
    values = case.coordinates.values
    assert values.shape == (len(case.mesh.vertices), 3)
    assert values.min() >= -1.01  # obtuse tetrahedra may overshoot by less than a per cent
    assert values.max() <= 1.01


def test_coordinates_follow_the_phantoms_own(case):
    hemi = "R" if case.volume.affine[0, 3] > 0 else "L"
    u, v, n = case.phantom.body.locate(case.mesh.vertices, hemi=hemi).T
    inner = np.abs(u - 0.5) < 0.35  # away from the strips
    x, y, z = case.coordinates.values[inner].T
    # x and u are not proportional where the section bends or thickens, but nearly.
    assert np.corrcoef(x, u[inner])[0, 1] > 0.998
    # Planes are found to 0.2 of 8 mm, half that at most in units of y, and tilt.
    assert np.abs(y - (2 * v[inner] - 1)).max() < 0.06
    # The wall is found to a part of a voxel of 0.4 mm; z is n / (1 mm).
    assert np.sqrt(np.mean((z - n[inner]) ** 2)) < 0.1
    assert np.corrcoef(z, n[inner])[0, 1] > 0.99


@pytest.mark.parametrize("name", ["arc", "spiral"])
def test_x_runs_from_medial_to_lateral_in_both_hemispheres(name, request):
    case = request.getfixturevalue(name)
    hemi = "R" if case.volume.affine[0, 3] > 0 else "L"
    u, v, n = case.phantom.body.locate(case.mesh.vertices, hemi=hemi).T
    known = np.isfinite(u)
    for value, truth in zip(case.coordinates.values[known].T, (u, v, n), strict=True):
        assert np.corrcoef(value, truth[known])[0, 1] > 0.9
