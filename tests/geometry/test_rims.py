"""Rim paths by distances inside the volume, and the middle lines that they guide."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from hipsta_bids.geometry.boundaries import center_curves, guided_curves, rim_paths
from hipsta_bids.geometry.mesh import mean_wall_thickness
from hipsta_bids.geometry.wall import Wall
from hipsta_bids.settings import BoundarySettings

SETTINGS = BoundarySettings()


@pytest.fixture(scope="module", params=["arc", "slab", "spiral"])
def found(request):
    """A case, its wall, and its rim paths."""
    case = request.getfixturevalue(request.param)
    wall = Wall(case.surface, case.body, SETTINGS)
    paths, depths = rim_paths(wall, case.laplace, case.body)
    return case, wall, paths, depths


def gap_to_rim(case, points, u):
    """Distances from a flat rim, mm."""
    hemi = "R" if case.volume.affine[0, 3] > 0 else "L"
    v, n = np.linspace(-0.05, 1.05, 81)[:, None], np.linspace(-1, 1, 21)[None]
    rim = case.phantom.body.place(u, v, n, hemi=hemi).reshape(-1, 3)
    return cKDTree(rim).query(points)[0]


def test_paths_run_from_end_to_end_along_edges(found):
    _, wall, paths, _ = found
    edges = set(map(tuple, wall.edges.tolist()))
    for path in paths:
        ends = {bool(wall.posterior[path[k]]) for k in (0, -1)}
        assert ends == {True, False}
        assert wall.anterior[path[[0, -1]]].any()
        steps = np.sort(np.column_stack([path[:-1], path[1:]]), axis=1)
        assert all(tuple(step) in edges for step in steps.tolist())


def test_the_first_path_is_medial_and_the_second_lateral(found):
    case, wall, paths, _ = found
    for u, path in zip((0, 1), paths, strict=True):
        gap = gap_to_rim(case, wall.vertices[path], u)
        # Farthest from the other rim is an edge of the flat rim, rounded by a voxel of 0.4 mm.
        assert gap.mean() < 0.6
        assert gap.max() < 1.5


def test_depth_grows_from_the_rim_inward(found):
    case, wall, _, depths = found
    for u, depth in zip((0, 1), depths, strict=True):
        gap = gap_to_rim(case, wall.vertices, u)
        near, far = depth[gap < 0.5], depth[gap > 5.0]
        assert np.median(near) < 1.0
        assert far.min() > 2.0  # 5 mm along the wall; a bend's inner side is shorter


def test_guided_and_centered_curves_run_along_the_rims(found):
    case, wall, paths, depths = found
    thickness = mean_wall_thickness(case.surface)
    guided = guided_curves(wall, paths, depths, thickness)
    assert guided is not None
    centered = center_curves(wall, guided, thickness)
    for u, curve in zip((0, 1), centered, strict=True):
        other = gap_to_rim(case, curve, 1 - u).mean()
        here = gap_to_rim(case, curve, u).mean()
        assert min(here, other) < 0.5  # in either order; a voxel of 0.4 mm is rounded off


def test_zones_without_two_sides_give_no_curves(found):
    case, wall, paths, depths = found
    thickness = 5 * mean_wall_thickness(case.surface)
    assert guided_curves(wall, paths, depths, thickness) is None
