"""The suite of uncertainty: its ratio and its target, on maps that are made up."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hipsta_bids.extensions.uncertainty.copies import Uncertainty
from hipsta_bids.phantom import PhantomSpec
from validation import uncertainty
from validation.cases import Measured, Refusal
from validation.uncertainty import (
    DISPLACED,
    REVISED,
    SLICES,
    VOXELS,
    Coverage,
    Relabeling,
    _posed,
    _uncertainty_row,
    cover,
    coverage_row,
    relabelings,
)

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
            decision="use",
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


def covered(share, rank=0.5):
    numbers = dict.fromkeys(("chance", "error", "sd", "mean_error", "mean_sd"), 0.3)
    return Coverage(covered=share, rank=rank, **numbers)


@pytest.mark.parametrize(
    ("shares", "rank", "met"),
    [((0.91, 0.97), 0.41, True), ((0.8, 0.9), 0.5, False), ((0.99, 0.98), 0.5, False)],
)
def test_coverage_is_held_to_the_target(shares, rank, met):
    group = [covered(share, rank) for share in shares]
    row = coverage_row(DISPLACED, "labels", [*group, Refusal(reason="thin", message="thin")])
    assert row["met"] is met
    assert row["number"] == 3
    assert row["least, most"] == f"{min(shares):.0%}, {max(shares):.0%}"
    assert coverage_row(DISPLACED, "labels", [covered(0.95, 0.3)])["met"] is False


@pytest.mark.parametrize(("factor", "share"), [(1.0, 0.954), (2.0, 0.683)])
def test_errors_are_set_beside_the_sds_of_copies(monkeypatch, factor, share):
    """Errors of a known size: ``factor`` times the SD that copies predict."""
    random = np.random.default_rng(6)
    right = replace(poses(1)[0], thickness=np.full(SPREAD.shape, 2.0))
    maps = [
        replace(
            right,
            thickness=2 + factor * SPREAD * random.normal(size=SPREAD.shape),
            summary={"thickness_mean": right.summary["thickness_mean"] + 0.1 * number},
        )
        for number in (1, 2, 3)
    ]
    queue = iter(maps)
    monkeypatch.setattr(uncertainty, "measure_reference", lambda *_: (None, "L", right))
    monkeypatch.setattr(uncertainty, "measure_body", lambda *_: next(queue))
    monkeypatch.setattr(uncertainty, "warped", lambda *_: None)
    monkeypatch.setattr(uncertainty, "estimate_uncertainty", lambda *_: predicted(1.0)[0])
    spec = PhantomSpec(kind="arc", thickness=2.0)
    found = cover(Relabeling(body=spec, change=DISPLACED, copies=8, draws=3))
    assert found.covered == pytest.approx(share, abs=0.02)  # 2583 errors: .9 % at most
    # Three errors at a point tell its SD to 40 %, and SDs differ by a factor of ten.
    assert found.rank > 0.6
    assert found.chance == pytest.approx(found.rank, abs=0.05)
    assert found.error == pytest.approx(factor * found.sd, rel=0.05)
    assert found.mean_error == pytest.approx(np.sqrt(np.mean([0.01, 0.04, 0.09])))
    assert found.mean_sd == 0.01


def test_both_sets_of_labels_predict_the_other(tmp_path, monkeypatch):
    item = SimpleNamespace
    found = {
        "labels": [item(subject="01", hemi="L")],
        "labels-revised": [item(subject=f"{n}{s}", hemi="L") for n in (1, 2) for s in "AB"],
    }
    for name in found:
        (tmp_path / name).mkdir()
    monkeypatch.setattr(
        uncertainty, "fine_segmentations", lambda folder, _: found[folder.name] if folder else []
    )
    cases = relabelings(tmp_path / "labels", full=True)
    pairs = {(c.body.subject, c.other.subject) for c in cases if c.change == REVISED}
    assert pairs == {("1A", "1B"), ("1B", "1A"), ("2A", "2B"), ("2B", "2A")}
    assert sum(c.change == SLICES for c in cases) == sum(c.change == DISPLACED for c in cases) == 4
    assert [c.change for c in relabelings(tmp_path / "labels", full=False)] == [DISPLACED]
