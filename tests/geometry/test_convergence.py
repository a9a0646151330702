"""Errors fall as voxels become finer."""

import numpy as np
import pytest
from geometry_cases import short_phantom, solve_case

from hipsta_bids.geometry.measures import measure_thickness


def thickness_error(voxel):
    """Root mean square over the sheet without its rims, mm."""
    sheet = solve_case(short_phantom(), voxel_size=(voxel,) * 3).sheet
    return float(np.sqrt(np.mean((measure_thickness(sheet)[4:-4] - 2.0) ** 2)))


@pytest.mark.slow
def test_thickness_error_falls_with_the_voxel_size():
    coarse, middle, fine = (thickness_error(voxel) for voxel in (0.8, 0.5, 0.3))
    assert coarse > middle > fine
    # Nearly first order: voxels shrink by 2.7, the working grid stays at 0.35 mm.
    assert coarse / fine > 1.5
    assert fine < 0.08  # a quarter of a voxel
