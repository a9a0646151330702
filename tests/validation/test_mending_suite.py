"""The suite of mended labels: what is planted, and targets that are missed without the cure."""

from dataclasses import replace

import numpy as np
import pytest

from hipsta_bids.geometry import completion
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.types import Decision
from validation import mending
from validation.cases import Refusal, measure_reference
from validation.damage import make_defect
from validation.defects import VOXEL, site_of
from validation.mending import CAVITIES, RAGGED, UNCUS, Trial, measure_trial

ARC, SPIRAL = mending.LAYERED


def trials(*planted, body=ARC):
    return [Trial(body=body, injury=one) for one in planted]


@pytest.mark.long
def test_a_missing_stratum_is_mended_and_thins_the_wall_if_it_is_not():
    planted = dict.fromkeys(CAVITIES)
    (stratum,) = (one for one in planted if one[0] == "stratum")
    pair = [Trial(body=ARC, injury=stratum, mended=mended) for mended in (True, False)]
    mended, hollow = map(measure_trial, pair)
    assert mended.found == pytest.approx(mended.planted)
    assert hollow.found == 0
    assert hollow.off > 0.1
    assert mending._cavities(pair, [mended, hollow]).rows[0]["met"] is True
    assert mending._cavities(pair, [hollow, hollow]).rows[0]["met"] is False


@pytest.mark.parametrize(("kind", "size", "position"), CAVITIES)
def test_cavities_lie_between_the_sheet_and_its_interior(kind, size, position):
    volume, _, reference = measure_reference(ARC, VOXEL)
    defect = make_defect(site_of(ARC), kind, size, position)
    lost = volume.tissue[defect.volume.tissue != volume.tissue]
    assert (lost > 0).all()
    assert not defect.volume.tissue[defect.volume.tissue != volume.tissue].any()
    inner = reference.sheet.points[:, :, 0].reshape(-1, 3)
    gap = np.linalg.norm(defect.changed[:, None] - inner[None], axis=-1).min(axis=1)
    assert gap.max() < size + 0.7  # a layer of 0.6 mm; nodes lie 0.3 mm apart at most
    if kind != "stratum":
        assert (lost == Tissue.DENTATE_GYRUS).any() or (lost == Tissue.CA4).any()


def without_handing_over(volume, tissue, _ends, _reach):
    return volume, tissue, 0


@pytest.mark.long
def test_tail_labels_in_the_body_are_noticed_if_they_are_not_handed_over(monkeypatch):
    (trial,) = trials(RAGGED[-1])
    right = measure_trial(trial)
    assert 0 < right.found <= right.planted
    assert right.same_plane <= right.off + 0.01
    monkeypatch.setattr(completion, "hand_over", without_handing_over)
    wrong = measure_trial(trial)
    assert wrong.found == 0
    assert wrong.damage.decision == Decision.LOOK
    rows = mending._ragged([trial, trial], [right, wrong]).rows
    assert [row["met"] for row in rows] == [True, False]


@pytest.mark.long
def test_an_uncus_is_left_out_with_a_warning_and_noticed_if_it_is_not(monkeypatch):
    detached, attached = trials(UNCUS[1], UNCUS[2], body=SPIRAL)
    assert (detached.injury[0], attached.injury[0]) == ("uncus", "attached-uncus")
    right = [measure_trial(detached), measure_trial(attached)]
    assert [outcome.warned for outcome in right] == [True, False]
    monkeypatch.setattr(completion, "find_uncus", lambda *_: np.zeros((0, 3), np.intp))
    wrong = measure_trial(attached)
    assert wrong.found == 0
    table = mending._uncus([detached, attached, attached], [*right, wrong])
    assert [row["met"] for row in table.rows] == [True, True, False]
    # What is warned of, or not, against the plan is a miss, too.
    odd = replace(right[0], warned=False)
    assert mending._uncus([detached], [odd]).rows[0]["met"] is False


def test_what_cannot_be_planted_is_left_out_and_refusals_are_told():
    empty = Refusal(reason="defect-empty", message="no layer")
    refused = Refusal(reason="topology", message="a knot")
    pair = [Trial(body=ARC, injury=CAVITIES[0], mended=mended) for mended in (True, False)]
    table = mending._cavities([*pair, *pair], [empty, empty, refused, refused])
    assert [row["met"] for row in table.rows] == [False]
    assert "topology: a knot" in table.notes
    assert "no layer" not in table.notes


def test_a_short_run_plants_one_of_each_in_a_phantom(monkeypatch):
    def none(work, groups):
        assert work is measure_trial
        lost = Refusal(reason="crash", message="bug")
        return {name: [lost for _ in cases] for name, cases in groups.items()}

    monkeypatch.setattr(mending.cases, "run_groups", none)
    suite = mending.run(False)
    assert "Real labels were left out" in suite.text
    assert [(table.targets, table.missed) for table in suite.tables] == [(1, 1)] * 3
