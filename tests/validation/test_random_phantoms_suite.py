"""Phantoms that are drawn at random: the draws, and what is judged."""

import numpy as np
import pytest

from hipsta_bids.phantom import KINDS
from validation import cases, random_phantoms
from validation.cases import Measured, Refusal
from validation.random_phantoms import FINE, SLICES, THICKNESS, draw


def measured(bias, decision="use"):
    error = np.array([[bias - 0.01, bias + 0.01]])
    return Measured(
        thickness=2.0 + error,
        true_thickness=np.full(error.shape, 2.0),
        curvature={},
        true_curvature={},
        summary={},
        true_summary={},
        decision=decision,
        flags=(),
    )


def test_draws_are_the_same_each_time_and_differ_from_one_another():
    specs = [draw("fine", number).spec for number in range(20)]
    assert specs == [draw("fine", number).spec for number in range(20)]
    assert len(set(specs)) == 20
    assert {spec.kind for spec in specs} == set(KINDS)
    assert all(THICKNESS[0] <= spec.thickness <= THICKNESS[1] for spec in specs)


def test_voxels_are_isotropic_or_thick_slices():
    fine, thick = (
        [draw(name, number).voxel_size for number in range(9)] for name in ("fine", "thick")
    )
    assert all(FINE[0] <= x == y == z <= FINE[1] for x, y, z in fine)
    assert all(x == y < 0.51 and SLICES[0] <= z <= SLICES[1] for x, y, z in thick)


@pytest.mark.parametrize(("biases", "met"), [((0.03, -0.01), True), ((0.03, 0.03), False)])
def test_the_mean_bias_decides_and_the_largest_is_shown(monkeypatch, biases, met):
    results = [measured(biases[0]), measured(biases[1], "look"), Refusal(reason="x", message="y")]
    monkeypatch.setattr(cases, "run_cases", lambda *_, **__: results * 2)
    suite = random_phantoms.run(full=False)
    summary, each = suite.tables
    fine = summary.rows[0]
    assert (fine["phantoms"], fine["refused"], fine["flagged"], fine["met"]) == (3, 1, 1, met)
    assert fine["bias, largest"] == pytest.approx(0.03)
    assert fine["SD"] == pytest.approx(0.01)
    assert [row["decision"] for row in each.rows] == ["use", "look", "x"] * 2
    assert "- fine: " in summary.notes
