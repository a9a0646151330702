"""The suite of damage that leaves a plausible map: kinds, and what counts as wrong and silent."""

import numpy as np
import pytest

from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.protocols.protocol import MEDIAL_END
from validation import cases, silent
from validation.damage import Site, make_defect
from validation.random_phantoms import TARGETS

SPEC = PhantomSpec(kind="arc", thickness=2.0, length=14.0)


@pytest.fixture(scope="module")
def site():
    volume, _, reference = cases.measure_reference(SPEC, 0.5)
    return Site(volume, reference.sheet)


def test_all_kinds_are_drawn_in_both_kinds_of_voxels():
    trials = silent.plan(2 * len(silent.KINDS))
    assert {(t.kind, t.voxels) for t in trials} == {(k, v) for k in silent.KINDS for v in TARGETS}
    for trial in trials:
        case, (_, size, (u, v)) = silent.draw(trial)
        kind = silent.KINDS[trial.kind]
        unit = min(case.voxel_size) if kind.voxels else 1.0
        assert kind.size[0] <= size / unit <= kind.size[1]
        assert kind.u[0] <= u <= kind.u[1]
        assert kind.v[0] <= v <= kind.v[1]


@pytest.mark.long
def test_damage_is_where_it_is_said_to_be(site):
    ball = make_defect(site, "leak-interior", 1.2, (0.5, 0.4))
    wall = site.column((0.5, 0.4))[0]
    assert np.linalg.norm(ball.changed - wall, axis=1).max() <= 1.2 * 1.6 + 0.01
    thin = make_defect(site, "thin-edge", 0.6, (0.0, 0.5))
    lost = np.isin(thin.volume.tissue, site.volume.protocol.sheet)
    assert (
        0.08 < 1 - lost.sum() / np.isin(site.volume.tissue, site.volume.protocol.sheet).sum() < 0.2
    )
    half = make_defect(site, "half-subfield", 0.4, (0.0, 1.0))
    left = site.v[np.isin(half.volume.tissue, MEDIAL_END)]
    assert left[left < 1].max() <= 0.61
    inward, outward = (make_defect(site, "moved-end", step, (0.5, 0.0)) for step in (2.0, -2.0))
    length = cases.measure_body(site.volume, "L").qc["body_length_mm"]
    for defect, change in ((inward, -2.0), (outward, 2.0)):
        moved = cases.measure_body(defect.volume, "L").qc["body_length_mm"]
        assert moved - length == pytest.approx(change, abs=0.4)
    layer = make_defect(site, "fissure", 0.8, (0.5, 0.5))
    assert (np.linalg.norm(layer.changed - site.column((0.5, 0.5))[0], axis=1).min()) < 1.0


def test_a_map_is_wrong_where_ten_points_are():
    error = np.zeros((41, 21))
    error[10, 10] = 0.7  # a single point
    assert silent.worst(error) < silent.WRONG
    error[8:12, 9:12] = 0.3
    assert silent.worst(error) > silent.WRONG
    sound = silent.Outcome(sound=(), decision="use", error=0.2)
    assert not sound.wrong
    assert silent.Outcome(sound=(), decision="use", slide=1.5).silent
    assert not silent.Outcome(sound=(), decision="look", error=1.0).silent
    assert not silent.Outcome(sound=(), decision="failed", error=1.0).wrong


def test_slides_are_along_the_sheet():
    phantom = Phantom(SPEC)
    maps = cases.measure_body(cases.draw(phantom, cases.Case(spec=SPEC)), "L")
    assert silent.worst(silent._slide(maps, maps)) == 0
    sheet = maps.sheet
    shifted = type(sheet)(points=np.roll(sheet.points, 2, axis=0), valid=sheet.valid)
    step = np.linalg.norm(np.diff(sheet.points[:, :, sheet.middle], axis=0), axis=-1).mean()
    moved = silent._slide(type("Maps", (), {"sheet": shifted})(), maps)[5:-5]
    assert np.median(moved) == pytest.approx(-2 * step, rel=0.1)


def test_tables_count_what_was_accepted_though_wrong(monkeypatch):
    outcome = silent.Outcome(sound=("labels-end",), decision="use", error=1.0)
    monkeypatch.setattr(cases, "run_cases", lambda *_, **__: [outcome] * silent.NUMBER_QUICK)
    kinds, sound = silent.run(full=False).tables
    rows = [row for row in kinds.rows if row["damage"] == "all that one brain can show"]
    assert [row["met"] for row in rows] == [False, False]
    assert sum(row["wrong and accepted"] for row in rows) == silent.NUMBER_QUICK
    assert sum(row["flagged"] for row in sound.rows) == silent.NUMBER_QUICK
