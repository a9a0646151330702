"""The suite of damaged labels: verdicts, tables, and what must hold for chosen defects."""

from dataclasses import replace

import pytest

from hipsta_bids.errors import GeometryError
from hipsta_bids.types import Decision
from validation import defects
from validation.cases import Refusal, measure_reference
from validation.defects import Damage, Trial, compare, measure_trial

SPIRAL = defects.SPECS[0]


def trial(kind, size, position=(0.5, 0.5)):
    return Trial(body=SPIRAL, injury=(kind, size, position))


@pytest.mark.long
@pytest.mark.parametrize("position", [(0.5, 0.5), (0.2, 0.35), (0.82, 0.6)])
def test_holes_are_filled_to_the_walls_thickness(position):
    found = measure_trial(trial("hole", 0.8, position))
    assert found.outcome == "repaired"
    assert found.shift < 0.15  # mm, the rule; the grid's nodes are the same, the mesh is not
    # Of about 100 columns near it; a plug of the wall's own thickness leaves few.
    assert found.near_wrong <= 6


def test_a_hole_beside_an_edge_is_not_cut_open():
    found = measure_trial(trial("hole", 1.6, (0.2, 0.35)))
    assert found.outcome == "flagged"
    assert found.reasons[0] == "large-repair"
    assert found.near_wrong + found.far_wrong <= 6  # 42 columns moved when it was cut open
    assert found.shift < 0.15  # mm, as above


def test_a_notch_is_flagged_with_its_position():
    found = measure_trial(trial("notch", 2.0))
    assert "section-notch" in found.reasons


@pytest.mark.parametrize(
    ("kind", "size", "reason"),
    [
        ("gap", 0.8, "body-split"),
        ("tail-inside", 2.0, "body-interrupted"),
        ("missing-slices", 1.0, "body-interrupted"),
        ("wrong-voxels", 4.0, "sheet-too-thin"),
    ],
)
def test_refusals_name_the_defect(kind, size, reason):
    with pytest.raises(GeometryError, match=r"check|correct|fill|use") as caught:
        measure_trial(trial(kind, size))
    assert caught.value.reason == reason
    assert "RAS" in str(caught.value) or reason in defects.PLACELESS


@pytest.mark.parametrize(
    ("kind", "size", "reason"),
    [
        ("at-border", 1.0, "image-border"),
        ("wrong-voxels", 2.0, "slices-along-axis"),
        ("bridge-ca1-ca1", 0.8, "section-intrusion"),
        ("leak", 3.0, "section-bump"),
        ("salt", 0.03, "noisy-labels"),
        ("cut-short", 8.0, "labels-end"),
        ("ends-flush", 1.0, "labels-end"),
    ],
)
def test_what_cannot_be_repaired_is_flagged(kind, size, reason):
    assert reason in measure_trial(trial(kind, size)).reasons


def test_a_gap_that_the_hippocampus_encloses_is_filled():
    found = measure_trial(trial("gap", 0.4))
    assert found.decision == Decision.USE
    assert (found.near_wrong, found.far_wrong) == (0, 0)
    assert abs(found.mean) < 0.01


def test_columns_are_counted_near_and_far():
    _, _, reference = measure_reference(SPIRAL, defects.VOXEL)
    shifted = reference.thickness.copy()
    shifted[0, 0] += 0.5
    shifted[-1, -1] -= 0.2
    damaged = replace(reference, maps={**reference.maps, "thickness": shifted})
    found = compare(damaged, reference, reference.sheet.points[0, 0])
    assert (found.near_wrong, found.far_wrong) == (1, 0)
    assert found.shift == pytest.approx(0.2)
    assert found.mean == pytest.approx(0.3 / shifted.size)
    assert found.missed == ("moved",)
    assert replace(found, shift=0.1).missed == ()
    assert replace(found, decision="look").missed == ()


@pytest.mark.parametrize(
    ("damage", "missed"),
    [
        (Damage(decision="use", reasons=(), near_wrong=2, columns=100), ()),
        (Damage(decision="use", reasons=(), near_wrong=2, far_wrong=1, columns=100), ("wrong",)),
        (Damage(decision="look", reasons=("folded",), near_wrong=9, columns=100), ()),
        (Damage(decision="use", reasons=(), changed=0.06), ("big",)),
        (Damage(decision="failed", reasons=("topology",), message="near RAS 1 2 3 mm"), ()),
        (Damage(decision="failed", reasons=("topology",), message="somewhere"), ("placeless",)),
        (Damage(decision="failed", reasons=("sheet-too-thin",), message="all of it"), ()),
        (Damage(decision="crash", reasons=("timeout",)), ("crash",)),
    ],
)
def test_rules(damage, missed):
    assert damage.missed == missed


def test_the_tables_show_every_case_and_miss_crashes(monkeypatch):
    def some(work, cases, *, timeout):
        assert work is measure_trial
        assert timeout == 60.0
        results = [Damage(decision="use", reasons=(), columns=861) for _ in cases]
        results[1] = Refusal(reason="topology", message="no")
        results[2] = Refusal(reason="crash", message="bug")
        return results

    monkeypatch.setattr(defects.cases, "run_cases", some)
    suite = defects.run(False)
    cases, totals = suite.tables
    assert len(cases.rows) == len(defects.PLAN[::3])
    assert len(defects.run(True).tables[0].rows) == 2 * len(defects.PLAN)
    assert (cases.rows[0]["outcome"], cases.rows[0]["reason"]) == ("unnoticed", "-")
    assert (cases.rows[1]["outcome"], cases.rows[1]["reason"]) == ("refused", "topology")
    assert "the same elsewhere" not in cases.rows[1]
    assert [row["rules broken"] for row in cases.rows[:3]] == ["-", "placeless", "crash"]
    assert cases.missed == 2
    assert {row["outcome"]: row["cases"] for row in totals.rows}["crash"] == 1
    assert sum(row["cases"] for row in totals.rows) == len(cases.rows)
