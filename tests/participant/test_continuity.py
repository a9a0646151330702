"""A small change of the labels makes a small change of the map; the suite `continuity` has more."""

from pathlib import Path

import pytest

from hipsta_bids.phantom import PhantomSpec
from validation import cases, continuity

SHARED = (Path(__file__).parents[2] / ".." / "shared" / "data").resolve()
SPIRAL = continuity.Subject(labels=PhantomSpec(kind="spiral", thickness=2.0, length=8.0))


def move(subject, perturbation, draw=0):
    return continuity.move(continuity.Trial(subject=subject, perturbation=perturbation, draw=draw))


@pytest.mark.parametrize("perturbation", continuity.TARGETS)
def test_a_small_change_moves_the_map_of_a_phantom_by_little(perturbation):
    moved = move(SPIRAL, perturbation)
    assert moved.same_xy <= continuity.TARGETS[perturbation][1]
    assert moved.accepted


@pytest.mark.parametrize("draw", [0, 1])
def test_a_notch_moves_no_column_far_from_it(draw):
    moved = move(SPIRAL, "edge notch of 1.4 mm", draw)
    assert moved.far_off <= continuity.MAX_OFF


@pytest.mark.skipif(not SHARED.is_dir(), reason="shared test data not found")
@pytest.mark.parametrize(("dataset", "subject", "hemi"), [("hippunfold", "001", "R")])
def test_an_affine_of_real_labels_moves_the_map_by_no_more_than_tetgen_does(dataset, subject, hemi):
    """Two operators lead to boundaries 0.6 mm apart here, beyond the anterior end plane."""
    (item,) = (
        item
        for item in cases.fine_segmentations(SHARED / dataset, 0.6)
        if (item.subject, item.hemi) == (subject, hemi)
    )
    moved = move(continuity.Subject(labels=item), "affine, 1e-5 mm")
    assert moved.same_xy <= continuity.TARGETS["affine, 1e-5 mm"][1]
    assert moved.choices == ()
