"""Ways to align sheets find known displacements; labels and sheets are compared as they should."""

import numpy as np
import pytest

from validation import alignment, cases, displacements
from validation.alignment import Plan, Sheet, compare_left_out, compare_sheets, judge, simulate
from validation.displacements import (
    LEAST_AREA,
    NONE,
    REGISTR,
    WAYS,
    align,
    least_area,
    make_fields,
    sample,
)

NODES = alignment.NODES
MAPS = [way for way in WAYS if way not in {NONE, REGISTR}]


@pytest.fixture
def soft(monkeypatch):
    """Noiseless maps need no stiffness."""
    monkeypatch.setattr(displacements, "STIFFNESS", 0.3)


def sheet(brain, curvature, moved, hemi="L"):
    """A sheet whose thickness is its curvature, and whose subiculum ends at node 12."""
    fields = np.repeat((np.arange(NODES[0]) > 12).astype(float), NODES[1]).reshape(1, *NODES)
    shown = sample(np.stack([curvature]), moved[None])[0]
    labels = sample(fields, moved[None], order=0)[0]
    return Sheet(brain=brain, hemi=hemi, curvature=shown, thickness=shown, subfield=labels)


def bumps():
    """Curvature that varies along both axes, without noise."""
    x, y = np.meshgrid(*(np.linspace(0, 1, n) for n in NODES), indexing="ij")
    return np.sin(7 * x + 2 * y) + 0.5 * np.cos(5 * y - 3 * x)


def displaced(n=12, amount=1.0, kind="one", seed=3):
    """Noiseless sheets, displaced."""
    random = np.random.default_rng(seed)
    moved = alignment.displace(Plan(kind=kind, amount=amount), np.zeros(n, dtype=bool), random)
    return sample(np.broadcast_to(bumps(), (n, *NODES)), moved), moved


def position_error(found, moved):
    error = found + np.stack([sample(moved[:, k], found) for k in (0, 1)], axis=1)
    error -= error.mean(axis=0)
    return cases.rms(error[:, 0]), cases.rms(error[:, 1])


def test_sampling_follows_the_displacement():
    ramp = np.broadcast_to(np.arange(NODES[0], dtype=float)[:, None], (2, *NODES))
    moved = np.zeros((2, 2, *NODES))
    moved[1, 0] = 1.5
    shown = sample(ramp, moved)
    np.testing.assert_array_equal(shown[0], ramp[0])
    np.testing.assert_allclose(shown[1, :-2], ramp[1, :-2] + 1.5)
    assert (shown[1, -1] == NODES[0] - 1).all()


@pytest.mark.parametrize("way", MAPS)
def test_displacements_keep_the_edges_and_do_not_fold(way):
    fields = make_fields(WAYS[way], NODES)
    assert not fields[:, 0, [0, -1]].any()
    assert not fields[:, 1, :, [0, -1]].any()
    curvature, _ = displaced(amount=3.0, kind="both")
    found, _ = align(curvature, way)
    assert least_area(found).min() > LEAST_AREA - 0.05  # the mean is subtracted last
    np.testing.assert_allclose(found.mean(axis=0), 0, atol=1e-9)


@pytest.mark.parametrize(
    ("way", "kind", "share"),
    [
        (REGISTR, "one", 0.4),
        ("map, along x", "one", 0.4),
        ("map, along x by row", "rows", 0.4),
        ("map, two dimensions", "rows", 0.4),
    ],
)
@pytest.mark.usefixtures("soft")
def test_known_displacements_are_found(way, kind, share):
    """Of displacements of one node, less than a share is left; the rest is along level lines."""
    curvature, moved = displaced(kind=kind)
    found, _ = align(curvature, way)
    assert position_error(found, moved)[0] < share
    left, placed = align(curvature[:10], way, curvature[10:])
    assert position_error(np.concatenate([left, placed]), moved)[0] < share + 0.1


@pytest.mark.usefixtures("soft")
def test_one_warp_for_all_rows_does_not_see_rows():
    curvature, moved = displaced(kind="rows")
    errors = {way: position_error(align(curvature, way)[0], moved)[0] for way in WAYS}
    assert errors["map, along x by row"] < errors["map, along x"] - 0.1
    assert errors[NONE] == pytest.approx(1.0, abs=0.05)  # the mean of twelve is removed


def test_stiff_sheets_do_not_move(monkeypatch):
    monkeypatch.setattr(displacements, "STIFFNESS", 1e6)
    found, _ = align(displaced()[0], "map, two dimensions")
    assert np.abs(found).max() < 1e-3


def test_simulated_cohorts_have_the_planned_displacement_and_effect():
    cohort = simulate(Plan(kind="both", amount=1.0), 1)
    # Means of 80 are removed after scaling.
    assert cases.rms(cohort.moved[:, 0]) == pytest.approx(1.0, abs=0.03)
    assert cases.rms(cohort.moved[:, 1]) == pytest.approx(alignment.ALONG_Y, abs=0.03)
    assert not cohort.thinning[~cohort.group].any()
    still = simulate(Plan(), 1)
    assert still.thinning.max() == pytest.approx(alignment.EFFECT * alignment.THICKNESS_SD)
    sd = still.thickness.std(axis=0)
    assert np.median(sd) == pytest.approx(alignment.THICKNESS_SD, rel=0.1)  # 80 participants
    assert not still.moved.any()
    shifted = simulate(Plan(shift=2.0), 1)
    apart = shifted.moved[shifted.group, 0].mean(axis=0) - shifted.moved[0, 0]
    assert apart[20, 10] == pytest.approx(2.0)


def test_outcomes_are_those_of_a_cohort_with_a_strong_effect(monkeypatch):
    monkeypatch.setattr(alignment, "EFFECT", 4.0)
    outcome = judge(simulate(Plan(), 2), NONE)
    assert outcome.error == (0.0, 0.0)
    assert outcome.created == 0.0
    assert outcome.power == 1.0
    assert outcome.missed_by < 0.5
    shifted = judge(simulate(Plan(shift=4.0), 2), NONE, effect=False)
    assert shifted.null  # a shift alone is taken for a difference of thickness
    assert shifted.created == pytest.approx(4.0, abs=0.2)
    assert np.isnan(shifted.power)


def test_likeness_of_sheets_at_registered_nodes():
    still, moved = np.zeros((2, *NODES)), np.zeros((2, *NODES))
    moved[0] = -3.0
    one, two = sheet("1", bumps(), still), sheet("2", bumps(), moved)
    apart = compare_sheets(one, two, np.stack([still, still]))
    assert apart.border == 3.0
    assert apart.same_label == pytest.approx(1 - 3 / NODES[0])
    assert apart.thickness < 0.95
    aligned = compare_sheets(one, two, np.stack([still, -moved]))
    assert aligned.border == 0.0
    assert aligned.same_label == 1.0
    # The medial edge is lost where nodes beyond it would be.
    assert aligned.thickness > 0.97


def test_brains_that_are_left_out_are_aligned_to_the_others():
    _, moved = displaced(n=6, amount=1.5)
    brains = [sheet("123"[n // 2], bumps(), moved[n], "LR"[n % 2]) for n in range(6)]
    plain = compare_left_out(brains, NONE)
    found = compare_left_out(brains, "map, along x")
    assert list(found) == ["1", "2", "3"]
    for brain, (likenesses, placed) in found.items():
        assert len(likenesses) == 8  # two sheets, four of the other brains
        assert placed.shape == (2, 2, *NODES)
        before = np.mean([one.curvature for one in plain[brain][0]])
        assert np.mean([one.curvature for one in likenesses]) > before
    retests = alignment.compare_retests(brains, [(brains[0], brains[0])], "map, along x")
    assert retests[0][1] == 0.0
    assert retests[0][0].same_label == 1.0


@pytest.mark.long
def test_tables_have_a_target_of_the_default_only(monkeypatch):
    monkeypatch.setattr(alignment, "_KINDS", {"one": "along x"})
    monkeypatch.setattr(alignment, "DIFFERENCES", {"none": ((1.0,) * 4, 0.0)})
    suite = alignment.run(full=False)
    assert suite.targets == 4  # no displacement, two, and no difference of groups
    for table in suite.tables:
        assert {row["aligned"] for row in table.rows if row["met"] is not None} == {REGISTR}
    assert "Real labels were left out" in suite.text
