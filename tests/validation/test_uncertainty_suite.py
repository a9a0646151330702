"""The suite of uncertainty: its ratio and its target, on maps that are made up."""

import numpy as np
import pytest

from hipsta_bids.participant.uncertainty import Uncertainty
from validation.cases import Measured, Refusal
from validation.uncertainty import VOXELS, _posed, _uncertainty_row

SPREAD = np.linspace(0.02, 0.2, 861).reshape(41, 21)


def poses(count=400):
    random = np.random.default_rng(5)
    return [
        Measured(
            thickness=2 + SPREAD * random.normal(size=SPREAD.shape),
            true_thickness=SPREAD,
            curvature={},
            true_curvature={},
            summary={"thickness_mean": 2 + 0.01 * random.normal()},
            true_summary={},
            status="ok",
            flags=(),
        )
        for _ in range(count)
    ]


def predicted(factor):
    maps, summary = {"thickness": factor * SPREAD}, {"thickness_mean": 0.01}
    return [Uncertainty(copies=8, failed=1, maps=maps, summary=summary)] * 2


@pytest.mark.parametrize(("factor", "met"), [(1.0, True), (1.4, True), (1.6, False), (0.6, False)])
def test_ratio_is_told_and_held_to_the_target(factor, met):
    row = _uncertainty_row("spiral", VOXELS[0], "voxels", poses(), predicted(factor))
    assert float(row["ratio"]) == pytest.approx(factor, abs=0.03)  # 400 poses, and two digits
    assert row["met"] is met
    assert float(row["rank correlation"]) > 0.95
    assert float(row["that of halves of the poses"]) > 0.9
    assert row["copies refused"] == 2


def test_copies_that_differ_in_labels_too_have_no_target():
    row = _uncertainty_row("spiral", VOXELS[0], "voxels and labels", poses(9), predicted(3.0))
    assert row["met"] is None
    assert row["target, ratio"] is None


def test_refused_copies_miss_the_target():
    lost = [Refusal(reason="too-thin", message="thin")]
    row = _uncertainty_row("spiral", VOXELS[0], "voxels", poses(9), lost)
    assert row["met"] is False
    assert "ratio" not in row


def test_slices_lie_across_the_phantom_and_poses_differ():
    spec = None
    fine, thick = (_posed(spec, voxel, 3) for voxel in VOXELS)
    assert all(case.grid_rotation is None for case in fine)
    assert all(case.grid_rotation is not None for case in thick)
    assert len({case.pose.tobytes() for case in fine}) == 3
