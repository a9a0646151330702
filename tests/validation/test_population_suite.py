"""The suite of flags on a population: how hemispheres are varied, and how limits are judged."""

from dataclasses import replace

import numpy as np
import pytest

from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.settings import Settings
from hipsta_bids.types import Decision
from validation import population
from validation.cases import Refusal
from validation.defects import PLAN, Damage
from validation.population import (
    CALIBRATED,
    Member,
    Specimen,
    is_flagged,
    is_silent,
    make_labels,
    measure_specimen,
    redraw,
    set_limits,
    smooth_warp,
)

SPEC = PhantomSpec(kind="arc", thickness=2.0, length=10.0)
FINE = (0.5, 0.5, 0.5)


def centers(shape, affine):
    return np.moveaxis(np.indices(shape), 0, -1) @ affine[:3, :3].T + affine[:3, 3]


def labeled_volume(voxel=0.4):
    return Phantom(SPEC).label_volume(load_protocol("freesurfer"), voxel_size=(voxel,) * 3)


def test_warps_have_their_size_and_scale():
    box = np.array([[0.0, 0.0, 0.0], [60.0, 60.0, 60.0]])
    points = np.stack(np.meshgrid(*[np.arange(0.0, 60.0, 2.0)] * 3, indexing="ij"), axis=-1)
    warp = smooth_warp(box, 1.0, 10.0, np.random.default_rng(1))(points)
    # Some 200 independent places: standard errors of 5 %.
    assert warp.std(axis=(0, 1, 2)) == pytest.approx([1, 1, 1], rel=0.15)
    assert np.abs(warp.mean(axis=(0, 1, 2))).max() < 0.25
    # The correlation of smoothed white noise at distance d is exp(-d^2 / (4 sigma^2)).
    sigma = 10.0 / np.sqrt(8 * np.log(2))
    found = np.corrcoef(warp[:-2].ravel(), warp[2:].ravel())[0, 1]
    assert found == pytest.approx(np.exp(-(4.0**2) / (4 * sigma**2)), abs=0.05)


def test_grids_of_any_voxels_share_a_warp():
    box = np.array([[0.0, 0.0, 0.0], [10.0, 12.0, 14.0]])
    one, two = (smooth_warp(box, 1.0, 10.0, np.random.default_rng(4)) for _ in range(2))
    points = np.random.default_rng(0).uniform(0, 10, (50, 3))
    np.testing.assert_array_equal(one(points), two(points[::-1])[::-1])


def test_labels_drawn_anew_where_they_are_stay():
    volume = labeled_volume()
    shape = volume.tissue.shape
    index = np.moveaxis(np.indices(shape), 0, -1).astype(float)
    again = redraw(volume, index, volume.affine)
    same = (again.tissue == volume.tissue) & (again.part == volume.part)
    # Smoothing rounds corners off: a part of the voxels at a border.
    assert same[volume.tissue > 0].mean() > 0.97
    assert set(np.unique(again.tissue)) <= set(np.unique(volume.tissue))


def test_labels_move_with_the_points_they_are_read_at():
    volume = labeled_volume()
    index = np.moveaxis(np.indices(volume.tissue.shape), 0, -1).astype(float)
    moved = redraw(volume, index + np.array([3.0, 0.0, 0.0]), volume.affine)
    still = redraw(volume, index, volume.affine)
    np.testing.assert_array_equal(moved.tissue[:-3], still.tissue[3:])


@pytest.mark.long
@pytest.mark.parametrize("voxel", [FINE, (0.4, 0.4, 2.0)])
def test_a_specimen_has_its_voxels_and_all_of_the_labels(voxel):
    specimen = Specimen(body=SPEC, number=1, voxel=voxel)
    volume, hemi = make_labels(specimen)
    np.testing.assert_allclose(np.linalg.norm(volume.affine[:3, :3], axis=0), voxel)
    assert hemi == ("L" if np.linalg.det(volume.affine[:3, :3]) > 0 else "R")
    size = np.count_nonzero(volume.tissue) * abs(np.linalg.det(volume.affine[:3, :3]))
    before = labeled_volume(population.FULL_VOXEL)
    wanted = np.count_nonzero(before.tissue) * population.FULL_VOXEL**3
    assert size == pytest.approx(wanted, rel=0.1)  # warps change sizes
    again, _ = make_labels(specimen)
    np.testing.assert_array_equal(again.tissue, volume.tissue)


def test_the_first_specimen_of_a_body_is_as_it_is():
    volume, _ = make_labels(Specimen(body=SPEC, number=0, voxel=None))
    np.testing.assert_array_equal(volume.tissue, labeled_volume(population.FULL_VOXEL).tissue)


@pytest.mark.long
def test_the_plan_takes_all_damages_in_turn():
    bodies = population.find_bodies(None)
    specimens = population.plan(bodies, full=True)
    assert len(specimens) == len(bodies) * (1 + population.WARPS_FULL * len(population.SIZES))
    done = [injury for s in specimens for injury in s.injuries]
    counts = [done.count(injury) for injury in PLAN]
    assert max(counts) - min(counts) <= 1
    assert sum(counts) == len(specimens)


def member(brain="a", spacing=0.33, damages=(), origin="a 1", mean=1.6, **margins):
    return Member(
        brain=brain,
        origin=origin,
        mean=mean,
        spacing=spacing,
        margins={name.replace("_", "-"): value for name, value in margins.items()},
        damages=damages,
    )


def damage(far_wrong=0, **margins):
    named = {name.replace("_", "-"): value for name, value in margins.items()}
    return Damage(decision=Decision.USE, reasons=(), far_wrong=far_wrong, far=100, margins=named)


def test_limits_are_quantiles_with_room_but_no_less_than_what_matters():
    values = np.linspace(0, 2, 101)
    limits = set_limits([member(extent_dip=v, extent_jump=0.1) for v in values])
    assert limits["extent-dip"] == pytest.approx(1.1 * 1.96)  # the quantile .98
    assert limits["extent-jump"] == pytest.approx(0.15 / Settings().checks.flag_row_jump)
    assert set(limits) == set(CALIBRATED)


def test_flags_follow_the_limits():
    assert is_flagged({"folded": 1.1}, {})
    assert not is_flagged({"extent-dip": 1.1}, {"extent-dip": 1.2})
    assert is_flagged({"extent-dip": 0.9}, {"extent-dip": 0.8})


def test_a_damage_is_silent_if_it_is_accepted_and_far_columns_are_off():
    assert is_silent(damage(far_wrong=6, folded=0.2), {}) is True
    assert is_silent(damage(far_wrong=5, folded=0.2), {}) is False
    assert is_silent(damage(far_wrong=6, folded=1.2), {}) is None
    refused = Damage(decision=Decision.FAILED, reasons=("topology",))
    assert is_silent(refused, {}) is None


def test_tables_count_by_voxels_and_leave_brains_out():
    specimens = [Specimen(body=SPEC, number=n, voxel=None) for n in range(5)]
    wrong, right = damage(far_wrong=50, extent_dip=1.3), damage(extent_dip=0.1)
    results = [
        member("a", extent_dip=0.5, damages=(right,)),
        member("a", extent_dip=1.2, damages=(wrong,), origin="a 2"),
        member("b", extent_dip=0.5, damages=(wrong,), origin="b 1"),
        member("b", spacing=2.0, extent_dip=0.5, damages=(), origin="b 1", mean=1.8),
        Refusal(reason="topology", message="no way"),
    ]
    suite = population.describe(specimens, results)
    present, curves, quantiles, left_out = suite.tables
    fine, thick = present.rows
    assert fine["undamaged, flagged"] == "33.3% of 3"
    assert fine["accepted, wrong far away"] == "0.0% of 1"
    assert thick["accepted, off by > 0.1 mm"] == 1
    (row,) = [row for row in curves.rows if row["voxels"] == "fine"]
    assert row["x 1"] == "33.3% / 67%"
    assert row["x 1.2"] == "0.0% / 67%"
    (asked,) = [row for row in quantiles.rows if row["flag"] == "extent-dip"]
    assert asked["asked for"] == f"{1.1 * 1.2 * Settings().checks.flag_row_dip:.3g}"
    judged = {(row["brain"], row["voxels"]): row for row in left_out.rows}
    # Brain b's limits are those that a asks for, 1.32: its own damage of 1.3 is not noticed.
    assert judged["b", "fine"]["quantile: accepted and wrong"] == "100.0% of 1"
    assert judged["b", "fine"]["present limits: accepted and wrong"] is None
    assert judged["a", "fine"]["quantile: false flags"] == "50.0% of 2"
    assert judged["all", "fine"]["present met"] is False
    assert "no way" in left_out.notes


@pytest.mark.long
def test_a_specimen_is_measured_with_its_damage():
    injuries = (("hole", 0.8, (0.5, 0.5)), ("notch", 2.0, (0.5, 0.5)))
    found = measure_specimen(Specimen(body=SPEC, number=1, voxel=FINE, injuries=injuries))
    assert found.spacing == 0.5
    assert [d.outcome for d in found.damages] == ["repaired", "flagged"]
    assert found.damages[0].far > 500
    assert found.damages[1].margins["section-notch"] > 1 > found.margins["section-notch"]


def test_a_damage_that_is_refused_is_a_result():
    injuries = (("cut-short", 3.0, (0.5, 0.5)), ("hole", 0.01, (0.5, 0.5)))
    found = measure_specimen(Specimen(body=SPEC, number=0, voxel=None, injuries=injuries))
    (refused,) = found.damages  # the hole changes no voxel
    assert (refused.decision, refused.margins) == ("failed", {})


@pytest.mark.long
def test_mirrored_specimens_change_sides():
    sides = {make_labels(Specimen(body=SPEC, number=n, voxel=FINE))[1] for n in (1, 3)}
    assert sides == {"L", "R"}


def test_labels_with_thick_slices_keep_them():
    spec = replace(SPEC, length=8.0)
    assert population.is_fine(labeled_volume())
    volume = Phantom(spec).label_volume(load_protocol("freesurfer"), voxel_size=(0.4, 0.4, 2.0))
    assert not population.is_fine(volume)
