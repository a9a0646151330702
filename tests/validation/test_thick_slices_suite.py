"""The suite of thick slices: how labels are resliced, and what its table says."""

from types import SimpleNamespace

import numpy as np
import pytest

from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.types import LabelVolume
from validation import thick_slices
from validation.cases import Refusal
from validation.thick_slices import Outcome, Trial, reslice

AXIS = np.array([0.0, 1.0, 0.0])


def numbered(shape=(20, 30, 16), voxel=0.3):
    """A volume whose tissue says how far it lies along each axis, in steps of three voxels."""
    i, j, k = np.indices(shape) // 3
    affine = np.diag([voxel, voxel, voxel, 1.0])
    affine[:3, 3] = [5.0, -3.0, 2.0]
    return LabelVolume(
        tissue=(1 + i + j + k).astype(np.uint8),
        part=(j % 4).astype(np.uint8),
        affine=affine,
        protocol=load_protocol("freesurfer"),
    )


@pytest.mark.parametrize(("offset", "tilt"), [(0.0, 0.0), (0.3, 0.0), (0.7, 10.0)])
def test_each_voxel_has_the_label_at_its_center(offset, tilt):
    volume = numbered()
    found = reslice(volume, AXIS, (0.4, 0.4, 1.5), offset=offset, tilt=tilt)
    index = np.argwhere(np.ones(found.tissue.shape, dtype=bool))
    points = index @ found.affine[:3, :3].T + found.affine[:3, 3]
    nearest = np.rint((points - volume.affine[:3, 3]) / 0.3).astype(int)
    inside = ((nearest >= 0) & (nearest < volume.tissue.shape)).all(axis=1)
    assert inside.sum() > 500
    assert (found.tissue.ravel()[inside] == volume.tissue[tuple(nearest[inside].T)]).all()
    assert (found.part.ravel()[inside] == volume.part[tuple(nearest[inside].T)]).all()
    assert not found.tissue.ravel()[~inside].any()


@pytest.mark.parametrize("tilt", [0.0, 10.0])
def test_slices_lie_across_the_axis_but_for_the_tilt(tilt):
    found = reslice(numbered(), AXIS, (0.4, 0.4, 2.0), tilt=tilt)
    edges = np.linalg.norm(found.affine[:3, :3], axis=0)
    np.testing.assert_allclose(edges, [0.4, 0.4, 2.0])
    assert np.degrees(np.arccos(found.affine[:3, 2] @ AXIS / 2.0)) == pytest.approx(tilt, abs=1e-5)


def test_an_offset_moves_slices_by_its_share_of_their_distance():
    plain, moved = (reslice(numbered(), AXIS, (0.4, 0.4, 2.0), offset=o) for o in (0.0, 0.25))
    np.testing.assert_allclose((moved.affine - plain.affine)[:3, 3], 0.25 * 2.0 * AXIS, atol=1e-12)


def test_several_points_per_voxel_give_shares_and_the_label_of_most():
    volume = numbered()
    found = reslice(
        volume, AXIS, (0.6, 0.6, 1.8), offset=0.3, tilt=10.0, aside=(0.2, 0.7), points=(2, 2, 6)
    )
    total = sum(found.shares.values())
    np.testing.assert_allclose(total, 1, atol=1e-6)
    kinds = np.array(list(found.shares))
    largest = kinds[np.stack(list(found.shares.values())).argmax(axis=0)]
    clear = np.stack(list(found.shares.values())).max(axis=0) > 0.5
    np.testing.assert_array_equal(found.tissue[clear], largest[clear])
    # Voxels inside, of a label that rises evenly: the mean over the points is that of the place.
    index = np.argwhere(found.shares[0] == 0)
    mean = sum(kind * share for kind, share in found.shares.items())[tuple(index.T)]
    points = index @ found.affine[:3, :3].T + found.affine[:3, 3]
    place = (points - volume.affine[:3, 3]) / 0.3
    assert len(index) > 20
    assert np.abs(mean - (1 + (place - 1).sum(axis=1) / 3)).mean() < 0.25


def test_pixels_move_aside_by_their_share():
    plain, moved = (reslice(numbered(), AXIS, (0.4, 0.4, 2.0), aside=a) for a in ((0, 0), (0.5, 1)))
    step = np.linalg.inv(plain.affine[:3, :3]) @ (moved.affine - plain.affine)[:3, 3]
    np.testing.assert_allclose(step, [0.5, 1.0, 0.0], atol=1e-12)


def maps(thickness, length=20.0):
    return SimpleNamespace(thickness=thickness, qc={"body_length_mm": length}, decision="use")


def test_maps_are_compared_node_by_node():
    reference = np.random.default_rng(1).uniform(1, 2, (41, 21))
    found = thick_slices.compare(maps(2 * reference - 1.2), maps(reference), 2.0)
    assert found.correlation == pytest.approx(1.0)
    assert found.change == pytest.approx(reference.mean() - 1.2)


def test_sampling_loses_nothing_of_a_map_without_change_along_the_axis():
    thickness = np.repeat(np.linspace(1, 2, 41)[:, None], 21, axis=1)
    for change, correlation in thick_slices.compare(maps(thickness), maps(thickness), 2.0).sampled:
        assert change == pytest.approx(0.0, abs=1e-12)
        assert correlation == pytest.approx(1.0)


def test_sampling_a_spike_between_slices_loses_all_of_it():
    thickness = np.repeat(np.linspace(1, 2, 41)[:, None], 21, axis=1)
    thickness[:, 10] += 1.0  # at 10 mm; rows are 1 mm apart
    lost = [
        change for change, _ in thick_slices.compare(maps(thickness), maps(thickness), 4.0).sampled
    ]
    # Slices at 4 (n + 1/6), 4 (n + 1/2) and 4 (n + 5/6) mm. That at 10 mm makes a tent 8 mm wide,
    # 4 rows in sum; those at 8.67 and 12.67, and at 7.33 and 11.33 mm miss the spike.
    np.testing.assert_allclose(lost, np.array([-1, 3, -1]) / 21, atol=1e-12)


def outcome(change, correlation=0.9, decision="use"):
    sampled = ((0.01, 0.95), (-0.03, 0.93), (0.02, 0.97))
    return Outcome(
        decision=decision,
        change=change,
        correlation=correlation,
        sampled=sampled,
        thickness=np.full((3, 2), 1.0 + change),
        half_sampled=0.1,
    )


def row_of(results, step=2.0):
    trials = [
        Trial(body=thick_slices.PHANTOMS[0], step=step, offset=0.0, tilt=0.0)
        for _ in range(len(results))
    ]
    table = thick_slices._table(trials, results)
    assert len(table.rows) == 1
    return table.rows[0], table.rows[0]["met"], table


@pytest.mark.parametrize(
    ("results", "met"),
    [
        ([outcome(0.02), outcome(-0.03)], True),
        ([*3 * [outcome(0.01)], outcome(-0.11)], False),  # worst
        ([outcome(0.04), outcome(-0.04)], False),  # mean
        ([outcome(0.02, 0.54), outcome(0.02)], False),  # one correlation
        ([outcome(0.02, 0.82), outcome(0.02, 0.85)], False),  # their median
        ([*6 * [outcome(0.02)], outcome(0.02, decision="look")], True),
        ([*5 * [outcome(0.02)], outcome(0.02, decision="look")], False),  # accepted
    ],
)
def test_targets_are_judged(results, met):
    assert row_of(results)[1] is met


def test_no_accepted_map_may_be_far_off_whatever_the_distance():
    assert row_of([outcome(0.16)], step=thick_slices.PIXEL)[1] is False
    assert row_of([outcome(0.16, decision="look")], step=thick_slices.PIXEL)[1] is True


def test_refusals_are_counted_and_explained():
    refused = Refusal(reason="topology", message="a knot")
    row, met, table = row_of([*6 * [outcome(0.01)], refused])
    assert (row["number"], row["refused"], row["flagged"]) == (7, 1, 0)
    assert met is True
    assert row_of([*5 * [outcome(0.01)], refused])[1] is False
    assert "phantoms, 2 mm, straight: topology: a knot" in table.notes
    assert row_of([Refusal(reason="topology", message="a knot")])[1] is False


def half_row(*offsets_and_results):
    trials = [
        Trial(body=thick_slices.PHANTOMS[0], step=2.0, offset=offset, tilt=0.0)
        for offset, _ in offsets_and_results
    ]
    table = thick_slices._half_table(trials, [result for _, result in offsets_and_results])
    return table.rows


def test_maps_half_a_slice_apart_are_compared():
    (row,) = half_row(
        (0.0, outcome(0.0)), (0.25, outcome(0.0)), (0.5, outcome(0.2)), (0.75, outcome(-0.1))
    )
    assert (row["pairs"], row["one accepted only"]) == (2, 0)
    assert row["RMS change, mean"] == pytest.approx(0.15)
    assert row["RMS change, worst"] == pytest.approx(0.2)
    assert row["met"] is True


@pytest.mark.parametrize(
    ("second", "flips"),
    [
        (outcome(0.25), 0),
        (outcome(0.0, decision="look"), 1),
        (Refusal(reason="topology", message="a knot"), 1),
    ],
)
def test_changes_of_half_a_slice_are_judged(second, flips):
    (row,) = half_row((0.0, outcome(0.0)), (0.5, second))
    assert row["one accepted only"] == flips
    assert row["met"] is False


def test_no_pair_makes_no_row():
    assert not half_row((0.0, outcome(0.0)), (0.25, outcome(0.0)))


@pytest.mark.long
def test_a_phantom_in_thick_slices_meets_the_targets():
    trial = Trial(body=thick_slices.PHANTOMS[0], step=2.0, offset=1 / 3, tilt=10.0)
    found = thick_slices.measure_trial(trial)
    assert abs(found.change) <= thick_slices.TARGETS[2.0][1]
    assert found.correlation >= thick_slices.TARGETS[2.0][3]
