"""Visits of one person: how they are drawn, what noise is, and which targets are met."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from hipsta_bids.protocols.protocol import Tissue
from validation import visits
from validation.visits import Person, Result, draw, noise_of, per_arm, plain, slopes


def result(noise, separate, random):
    maps = 2 + random.normal(0, noise, (3, 12, 8))
    own = 2 + random.normal(0, separate, (3, 12, 8))
    return Result(
        frame=maps,
        smooth=own,
        separate=own,
        true=None,
        smoother=(own, maps),
        volume=np.array([400.0, 360.0, 320.0]),
        separate_volume=np.array([400.0, 364.0, 328.0]),
        labels_volume=np.array([410.0, 369.0, 328.0]),
        ca1=np.tile(np.arange(12)[:, None] > 3, (1, 8)) & (np.arange(12)[:, None] < 11),
        filled=0.0,
        overlap=0.95,
        distance=0.1,
        flagged=0,
        cost=1.2,
        memory=300.0,
    )


def test_a_scan_keeps_the_labels_and_moves_them():
    person = Person(name="", sources=(plain(0),) * 2, voxels=(visits.FINE, visits.THICK))
    (fine, thick), hemi = draw(person)
    assert hemi == "L"
    sizes = [
        np.count_nonzero(volume.tissue == Tissue.CA1) * abs(np.linalg.det(volume.affine[:3, :3]))
        for volume in (fine, thick)
    ]
    assert sizes[1] == pytest.approx(sizes[0], rel=0.05)  # two slices of fifteen end half-way
    edges = [np.linalg.norm(volume.affine[:3, :3], axis=0) for volume in (fine, thick)]
    assert sorted(edges[1]) == pytest.approx([0.4, 0.4, 2.0])
    assert not np.allclose(fine.affine[:3, 3], thick.affine[:3, 3], atol=0.5)


@pytest.mark.long
def test_errors_of_labels_change_labels_beside_borders_only():
    still, noisy = (
        draw(Person(name="", sources=(plain(1),), voxels=(visits.FINE,), noise=noise))[0][0]
        for noise in (0.0, 0.3)
    )
    # The same random numbers place the grid; later ones differ.
    same = (still.tissue == noisy.tissue)[still.tissue > 0].mean()
    assert 0.6 < same < 0.98


def test_slopes_and_noise_are_those_of_simulated_maps():
    random = np.random.default_rng(1)
    maps = 2 + random.normal(0, 0.1, (3, 200, 50))
    assert noise_of(maps) == pytest.approx(0.1, rel=0.03)  # 20,000 degrees of freedom
    changing = maps - 0.05 * np.arange(3)[:, None, None]
    assert slopes(changing).mean() == pytest.approx(-0.05, abs=0.003)
    assert noise_of(maps, mean=True) < 0.01


def test_less_noise_needs_fewer_participants():
    # Twice the SD takes four times as many; two in the formula for large groups.
    none, some = per_arm(0.0), per_arm(np.sqrt(3 * 2) * visits.TRUE_SD)
    assert some == pytest.approx(4 * none, rel=0.02)
    d = visits.SLOWED * visits.LOSS / visits.TRUE_SD
    assert none == pytest.approx(2 * (1.96 + 0.8416) ** 2 / d**2, rel=0.03)


def test_tables_say_which_targets_are_met():
    random = np.random.default_rng(2)
    group = [result(0.05, 0.1, random) for _ in range(4)]
    people = {"set": [Person(name=str(n), sources=()) for n in range(4)]}
    (row,) = visits.noise_table({"set": group}, people).rows
    assert row["ratio"] == pytest.approx(0.5, rel=0.1)
    assert row["lower in"] == "4 of 4"
    assert row["cost met"] is row["memory met"] is True
    (row,) = visits._slopes({"none": [result(0.05, 0.1, random) for _ in range(30)]}).rows
    # 96 independent points: two standard errors.
    assert float(row["false positives"]) == pytest.approx(0.05, abs=0.045)
    for change, planted in (("everywhere", visits.SLOPE), ("CA1", visits.LOCAL)):
        group = []
        for _ in range(4):
            person = result(0.001, 0.1, random)
            where = person.ca1 if change == "CA1" else True
            steps = visits.YEARS[:, None, None] * planted * where
            group.append(replace(person, frame=person.frame + steps))
        (row,) = visits._slopes({change: group}).rows
        assert row["measured, mm per year"] == pytest.approx(planted, rel=0.02)
        assert row["bias met"] is True
    assert row["leakage met"] is True


@pytest.mark.long
def test_a_lost_layer_is_as_thick_as_planted():
    volume, _ = visits.load(plain(0))
    before, after = (visits.lose_layer(volume, layer) for layer in (0.0, visits.LAYER))
    sheets = [np.isin(v.tissue, [*v.protocol.sheet, Tissue.HIPPOCAMPUS]) for v in (before, after)]
    assert not (sheets[1] & ~sheets[0]).any()
    size = visits.FINEST**3
    lost = np.count_nonzero(sheets[0] & ~sheets[1]) * size
    depth = ndimage.distance_transform_edt(sheets[0], sampling=visits.FINEST)
    surface = np.count_nonzero(sheets[0] & (depth <= 3 * visits.FINEST)) * size
    # The layer over a layer of three voxels, whose depths are of centers.
    assert lost / surface == pytest.approx(visits.LAYER / (3 * visits.FINEST), rel=0.15)


def test_the_share_of_a_loss_that_is_measured_is_its_bias():
    random = np.random.default_rng(3)
    loss = np.array([0.0, -2 * visits.LAYER])[:, None, None]
    group = []
    for _ in range(3):
        one = result(0.01, 0.01, random)
        maps, own = one.frame[:2] + 0.99 * loss, one.separate[:2] + 0.8 * loss
        group.append(replace(one, frame=maps, separate=own))
    (row,) = visits._losses({"set": group}, [result(0.05, 0.1, random)]).rows
    assert row["common, mm"] == pytest.approx(-0.198, abs=0.003)
    assert row["separate, mm"] == pytest.approx(-0.16, abs=0.003)
    assert row["bias met"] is True
    assert row["volume, common"] == row["volume of labels"] == "-10.0%"
    (worse,) = visits._losses(
        {"set": [replace(one, frame=one.separate) for one in group]}, group[:1]
    ).rows
    assert worse["bias met"] is False
