"""The suite on thickness and loss of tissue: its labels and its tables."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hipsta_bids.io.files import read_tsv
from hipsta_bids.phantom import Phantom
from validation import paradox
from validation.cases import Refusal
from validation.paradox import LOSSES, Loss, Sizes, Trial, draw_labels

DOCS = Path(__file__).parents[2] / "docs"
SOUND = LOSSES[0]


def loss(name, strength=None):
    """Find a loss by its name, the strongest if no strength is given."""
    found = [one for one in LOSSES if one.name == name and strength in (None, one.strength)]
    return found[-1]


def sheet(case):
    """Mark the voxels of the sheet; ``case`` is drawn in the first pose."""
    return paradox._sheet_of(draw_labels(Trial(loss=case, pose=0)))


def sizes(**changes):
    known = {"area": 1.8, "nodes": 1.8, "published": 1.7, "volume": 500.0, "surface": 300.0}
    return Sizes(**{**known, "flagged": False, **changes})


@pytest.mark.long
def test_tissue_that_is_lost_has_the_sizes_that_were_asked_for():
    known = Phantom(SOUND.true).truth(0.5, 0.5).summary
    truth = {(one.name, one.strength): Phantom(one.true).truth(0.5, 0.5).summary for one in LOSSES}
    thin = truth["thinner wall", 0.2]
    assert thin["thickness_mean"] == pytest.approx(known["thickness_mean"] - 0.2)
    assert thin["area_mid"] == pytest.approx(known["area_mid"])
    for name in ("narrower sheet", "shorter body"):
        summary = truth[name, 20.0]
        assert summary["thickness_mean"] == pytest.approx(known["thickness_mean"], rel=1e-6)
        assert summary["volume"] == pytest.approx(0.8 * known["volume"], rel=1e-6)
    fold = truth["less folding", 50.0]
    assert [fold[one] for one in ("thickness_mean", "volume", "area_mid")] == pytest.approx(
        [known[one] for one in ("thickness_mean", "volume", "area_mid")]
    )
    small = truth["smaller in all directions", 10.0]
    assert small["thickness_mean"] == pytest.approx(0.9 * known["thickness_mean"])
    assert small["volume"] == pytest.approx(0.9**3 * known["volume"])


def test_a_lost_edge_leaves_the_remaining_wall_as_it_is():
    whole, rest = (Phantom(one.true).body for one in (SOUND, loss("thin edge lost", 2.0)))
    u = np.linspace(0.0, 1.0, 50)
    kept = rest.spec.width / whole.spec.width
    assert rest.spec.width == pytest.approx(paradox.WIDTH - 2.0)
    np.testing.assert_allclose(rest.thickness(u, 0.5), whole.thickness(u * kept, 0.5))
    s = u * rest.spec.width
    np.testing.assert_allclose(rest.curve.curvature(s), whole.curve.curvature(s))


@pytest.mark.long
def test_errors_of_labels_take_and_add_voxels_where_they_should():
    sound = sheet(SOUND)
    cut = sheet(loss("thin edges without label", 1.5))
    assert not (cut & ~sound).any()
    volume = draw_labels(Trial(loss=SOUND, pose=0))
    wall = paradox._wall(
        Phantom(SOUND.true),
        volume,
        paradox.cases.any_pose(np.random.default_rng((paradox.SEED, 0))),
    )
    assert wall[cut].min() >= 1.5
    assert wall[sound & ~cut].max() < 1.5
    filled = sheet(loss("fold filled by labels"))
    assert (filled & ~sound).any()
    assert not (sound & ~filled).any()
    rounded = sheet(loss("rounded labels"))
    # Thin edges lose more than the thick middle gains.
    assert rounded.sum() < 0.95 * sound.sum()
    assert sheet(loss("labels too thick")).sum() > 1.05 * sound.sum()


@pytest.mark.long
def test_missing_edges_make_the_mean_thickness_rise_while_volume_falls():
    """The paradox itself, measured: no wall of the phantom thickens."""
    results = {
        one: [paradox.measure_trial(Trial(loss=one, pose=0))]
        for one in (SOUND, loss("thin edges without label", 1.5))
    }
    (row,) = paradox._changes(results).rows
    assert row["rises as volume falls"] == "area, nodes, published"
    assert row["true thickness"] == "+0.0"
    assert float(row["volume"]) < -10.0
    assert float(row["thickness by area"]) > 3.0


def test_rows_compare_with_the_undamaged_body_and_only_right_labels_have_a_target():
    thin, rounded = loss("thinner wall", 0.2), loss("rounded labels", 0.8)
    results = {
        SOUND: [sizes(), sizes(area=1.82)],
        thin: [sizes(area=1.62, volume=450.0), sizes(area=1.6, volume=450.0)],
        rounded: [
            sizes(nodes=1.9, volume=495.0, flagged=True),
            Refusal(reason="sheet-too-thin", message="too thin"),
        ],
    }
    found = paradox._changes(results)
    first, second = found.rows
    assert first["strength"] == "0.2 mm"
    assert first["thickness by area"] == f"{100 * (1.61 / 1.81 - 1):+.1f}"
    assert first["met"] is True
    assert first["rises as volume falls"] == "no"
    assert second["met"] is None
    assert second["rises as volume falls"] == "nodes"  # by area it falls by 0.6 %
    assert second["flagged"] == "1 of 2"
    assert "rounded labels, 0.8: sheet-too-thin: too thin" in found.notes
    results[thin] = [sizes(area=1.7), sizes(area=1.7)]
    assert paradox._changes(results).rows[0]["met"] is False


def test_a_case_that_is_refused_has_no_numbers():
    refused = [Refusal(reason="sheet-too-thin", message="m")]
    (row,) = paradox._changes({SOUND: [sizes()], loss("larger voxels"): refused}).rows
    assert row["volume"] is None
    assert row["rises as volume falls"] is None


def test_values_have_a_row_per_loss_and_missing_values():
    other = replace(loss("larger voxels"), name="other")
    rows = paradox._values({SOUND: [sizes()], other: [Refusal(reason="r", message="m")]}).rows
    assert rows[0]["thickness_area_mm"] == "1.8"
    assert rows[1]["volume_mm3"] is None
    assert rows[1]["n_refused"] == 1


@pytest.mark.long
def test_the_stored_values_are_of_these_losses():
    rows = read_tsv(DOCS / "validation" / "paradox--values.tsv")
    assert all(re.fullmatch(r"[a-z0-9_]+", name) for name in rows[0])
    assert [(row["loss"], float(row["strength"])) for row in rows] == [
        (one.name, one.strength) for one in LOSSES
    ]
    for one, row in zip(LOSSES, rows, strict=True):
        truth = Phantom(one.true).truth(0.5, 0.5).summary
        assert float(row["true_volume_mm3"]) == pytest.approx(truth["volume"], rel=1e-3)


def test_the_losses_are_distinct():
    assert len({(one.name, one.strength) for one in LOSSES}) == len(LOSSES)
    assert isinstance(SOUND, Loss)
    assert SOUND.kind == paradox.SOUND
