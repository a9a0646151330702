"""Two labelings of the same brains: pairs, differences, where they are, and their targets."""

import numpy as np
import pytest

from hipsta_bids.phantom import Hemisphere, PhantomSpec, write_dataset
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.settings import Settings
from hipsta_bids.types import BodyMask, Decision
from validation import cases, labelings
from validation.labelings import Agreement, Comparison


def mask(inside, start=(0, 0, 0), voxel=0.3):
    affine = np.diag([-voxel, voxel, voxel, 1.0])
    return BodyMask(inside=inside, start=start, shape=(20, 20, 20), affine=affine)


def agreement(difference=-0.01, r=0.99, off=0.01):
    return Agreement(difference=difference, same_columns=difference, r=r, off=off)


def comparison(whole, decisions=(Decision.USE, Decision.USE)):
    return Comparison(
        decisions=decisions,
        parts={None: whole, Tissue.CA1: agreement(difference=0.1)},
        elsewhere=agreement(difference=-0.002, r=0.999),
        volume=-0.04,
    )


def test_columns_without_a_value_are_left_aside():
    first = np.array([[1.0, 2.0], [3.0, np.nan]])
    second = np.array([[1.0, 2.1], [3.5, 9.0]])
    every = np.ones((2, 2), dtype=bool)
    result = labelings.compare_columns(first, second, every, 0.07)
    assert result.difference == 0.07
    assert result.same_columns == pytest.approx(0.2)
    assert result.off == pytest.approx(1 / 3)  # of the three that both have, 0.5 mm is off
    assert result.r == pytest.approx(np.corrcoef([1, 2, 3], [1, 2.1, 3.5])[0, 1])


def test_bodies_in_differently_cropped_files_are_compared_where_they_are():
    inside = np.zeros((6, 6, 6), dtype=bool)
    inside[1:5, 1:5, 1:5] = True
    moved = inside[1:].copy()
    moved[3, 4, 4] = False  # voxel 4, 4, 4 of the lattice
    changed = labelings.changed_points(mask(inside), mask(moved, start=(1, 0, 0)))
    assert changed == pytest.approx(np.array([[-1.2, 1.2, 1.2]]))


def test_the_same_body_has_no_changed_voxel():
    inside = np.ones((3, 3, 3), dtype=bool)
    assert labelings.changed_points(mask(inside), mask(inside)).shape == (0, 3)


@pytest.mark.long
def test_brains_are_paired_and_a_thinner_second_labeling_is_thinner(tmp_path):
    labels = tmp_path / "labels"
    labels.mkdir()
    spec = {name: PhantomSpec(thickness=t) for name, t in (("1A", 2.0), ("1B", 1.8), ("2A", 2.0))}
    write_dataset(
        tmp_path / "labels-revised",
        [Hemisphere(subject=name, hemi="L", spec=shape) for name, shape in spec.items()],
    )
    pairs = labelings.revisions(labels, Settings())
    assert [pair.name for pair in pairs] == ["1 L"]  # the second brain has one set only
    result = labelings.compare_revision(pairs[0])
    whole = result.parts[None]
    # 0.2 mm by construction; voxels of 0.4 mm move a mean by some hundredths.
    assert whole.difference == pytest.approx(-0.2, abs=0.03)
    assert whole.same_columns == pytest.approx(-0.2, abs=0.03)
    assert result.volume == pytest.approx(-0.1, abs=0.02)
    assert set(result.parts) == {
        None,
        Tissue.PRESUBICULUM,
        Tissue.SUBICULUM,
        Tissue.CA1,
        Tissue.CA2_3,
    }
    assert not result.flipped


@pytest.mark.long
def test_a_labeling_without_a_map_is_failed(monkeypatch, tmp_path):
    labels = tmp_path / "labels"
    labels.mkdir()
    write_dataset(
        tmp_path / "labels-revised",
        [Hemisphere(subject=name, hemi="L", spec=PhantomSpec()) for name in ("1A", "1B")],
    )
    (pair,) = labelings.revisions(labels, Settings())
    measure = labelings.measure

    def refuse_second(item, settings):
        if item.subject == "1B":
            raise labelings.cases.HipstaError("no body", reason="no-body")
        return measure(item, settings)

    monkeypatch.setattr(labelings, "measure", refuse_second)
    result = labelings.compare_revision(pair)
    assert result.decisions == (Decision.USE, Decision.FAILED)
    assert result.flipped
    (row,) = labelings._hemispheres({pair.name: result}).rows
    assert row["difference met"] is row["r met"] is row["decision met"] is False


def test_targets_are_those_of_each_hemisphere():
    results = {
        "1 L": comparison(agreement(difference=-0.02, r=0.98)),
        "1 R": comparison(agreement(difference=0.021), (Decision.USE, Decision.LOOK)),
        "2 L": comparison(agreement(r=0.979)),
        "2 R": cases.Refusal(reason="timeout", message="no result after 60 s"),
    }
    table = labelings._hemispheres(results)
    judged = [
        tuple(row[name] for name in ("difference met", "r met", "decision met"))
        for row in table.rows[:3]
    ]
    assert judged == [(True, True, True), (False, True, False), (True, False, True)]
    assert table.rows[3]["hemisphere"] == labelings.MEAN
    assert table.rows[3]["difference of the mean, mm"] == pytest.approx(0.051 / 3)  # absolute
    assert table.rows[3]["volume, %"] == pytest.approx(4.0)
    assert "2 R: timeout: no result after 60 s" in table.notes


def test_subfields_are_listed_with_the_mean_of_their_sizes():
    results = {
        "1 L": comparison(agreement()),
        "1 R": comparison(agreement()),
    }
    rows = labelings._subfields(results).rows
    assert [(row["subfield"], row["hemisphere"]) for row in rows] == [
        ("CA1", "1 L"),
        ("CA1", "1 R"),
        ("CA1", labelings.MEAN),
    ]
    assert rows[2]["difference of the mean, mm"] == pytest.approx(0.1)


def test_without_labels_the_suite_says_so():
    result = labelings.run(full=False)
    assert result.tables == ()
    assert "need `--labels`" in result.text
