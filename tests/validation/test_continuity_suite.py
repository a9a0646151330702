"""Small changes of labels, and what is reported of them."""

import numpy as np
import pytest

from hipsta_bids.phantom import PhantomSpec
from hipsta_bids.protocols.protocol import Part
from validation import cases, continuity

SUBJECT = continuity.Subject(labels=PhantomSpec(kind="spiral", thickness=2.0, length=8.0))


@pytest.fixture(scope="module")
def labels():
    return continuity.load(SUBJECT)


def perturbed(labels, name):
    volume, hemi = labels
    maps = cases.measure_body(volume, hemi)
    return volume, continuity.PERTURBATIONS[name](volume, maps, np.random.default_rng(0))


@pytest.mark.parametrize("size", [1e-6, 1e-5])
def test_an_affine_moves_points_by_no_more_than_its_size(labels, size):
    volume, _ = labels
    moved = continuity.near_affine(volume, None, np.random.default_rng(0), size=size)
    corner = np.append(np.array(volume.tissue.shape) - 1, 1.0)
    step = np.abs((moved.affine - volume.affine) @ corner)[:3]
    assert 0 < step.max() < 4 * size
    np.testing.assert_array_equal(moved.tissue, volume.tissue)


def test_displaced_labels_differ_at_boundaries_only(labels):
    volume, moved = perturbed(labels, "labels displaced by 0.3 mm")
    changed = moved.tissue != volume.tissue
    assert 0.01 < changed.mean() / (volume.tissue > 0).mean() < 0.5
    assert set(np.unique(moved.tissue)) == set(np.unique(volume.tissue))
    assert set(np.unique(moved.part)) <= {int(part) for part in Part}


def test_a_shifted_grid_has_the_same_labels_at_the_same_place(labels):
    volume, moved = perturbed(labels, "grid shifted by 0.1 voxel")
    assert np.abs((moved.affine - volume.affine)[:3, 3]).max() == pytest.approx(0.04)
    assert (moved.tissue == volume.tissue).mean() > 0.999


@pytest.mark.parametrize("name", ["end plane moved by 0.4 mm", "end plane moved by a slice"])
def test_one_end_moves(labels, name):
    _, moved = perturbed(labels, name)
    (end,) = moved.given_ends
    assert end.end in ("posterior", "anterior")


def test_few_voxels_of_the_surface_flip(labels):
    volume, moved = perturbed(labels, "1 of 1000 surface voxels flipped")
    changed = moved.tissue != volume.tissue
    assert 0 < changed.sum() < 30


def test_the_table_says_which_targets_are_met():
    same = continuity.Movement(
        same_xy=0.01,
        same_place=0.01,
        correlation=1.0,
        mean=0.0,
        far_off=0.0,
        accepted=True,
        reasons=(),
        choices=(),
    )
    refusal = cases.Refusal(reason="topology", message="m")
    found = continuity._movements({"affine, 1e-5 mm": [same, refusal]})
    (row,) = found.rows
    assert row["met"] is True
    assert row["refused"] == 1
    assert "topology" in found.notes
