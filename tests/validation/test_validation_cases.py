"""Drawing, measuring and comparing: phantoms of which everything is known."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.phantom.shape import PITCH
from hipsta_bids.protocols.load import load_protocol
from validation.accuracy import ROWS, Row, _poses, _thickness_table, rate
from validation.accuracy import _limits_table as limit_table
from validation.cases import (
    CURVATURES,
    GAUSSIAN_CURVATURES,
    Case,
    Measured,
    Refusal,
    along_slices,
    any_pose,
    compare,
    draw,
    measure_case,
    random_motion,
)
from validation.invariance import _motion_table, _pair_table

SMALL = PhantomSpec(length=8.0, end_length=2.0, variation=0.2)


def random(seed=3):
    return np.random.default_rng(seed)


def perfect(case, *, error=0.0):
    """Make maps as a perfect method would, with an error (mm) on top."""
    phantom = Phantom(case.spec)
    u, v, n = np.meshgrid(
        np.linspace(0.05, 0.95, 9), np.linspace(0, 1, 5), [-0.5, 0.0, 0.5], indexing="ij"
    )
    points = phantom.body.place(u, v, n, hemi=case.hemi, pose=case.pose)
    truth = phantom.truth(u[:, :, 1], v[:, :, 1])
    return phantom, SimpleNamespace(
        sheet=SimpleNamespace(points=points * ([-1, 1, 1] if case.mirrored else 1), middle=1),
        thickness=truth.thickness + error,
        summary=dict(truth.summary),
        decision="use",
        flags=(SimpleNamespace(reason="thin"),),
        maps={name: getattr(truth, name) for name in (*CURVATURES, *GAUSSIAN_CURVATURES)},
    )


@pytest.mark.parametrize("hemi", ["L", "R"])
@pytest.mark.parametrize("mirrored", [False, True])
def test_truth_is_looked_up_at_the_points_of_the_sheet(hemi, mirrored):
    case = Case(spec=SMALL, pose=any_pose(random()), hemi=hemi, mirrored=mirrored)
    phantom, maps = perfect(case, error=0.1)
    measured = compare(phantom, case, maps)
    np.testing.assert_allclose(measured.error, 0.1, atol=1e-9)  # projection is exact
    for name in (*CURVATURES, *GAUSSIAN_CURVATURES):
        np.testing.assert_allclose(
            measured.curvature[name], measured.true_curvature[name], atol=1e-9
        )
    assert measured.flags == ("thin",)


def test_points_beyond_the_edges_have_no_error():
    case = Case(spec=SMALL)
    phantom, maps = perfect(case)
    maps.sheet.points[0] += 5.0 * (maps.sheet.points[0] - maps.sheet.points[1])
    error = compare(phantom, case, maps).error
    assert np.isnan(error[0]).all()
    assert np.isfinite(error[1:]).all()


def test_mirrored_labels_are_the_same_voxels_on_the_other_side():
    case = Case(spec=SMALL, voxel_size=(0.8, 0.8, 0.8))
    phantom = Phantom(SMALL)
    plain, mirrored = draw(phantom, case), draw(phantom, replace(case, mirrored=True))
    np.testing.assert_array_equal(plain.tissue, mirrored.tissue)
    np.testing.assert_array_equal(mirrored.affine[0], -plain.affine[0])
    np.testing.assert_array_equal(mirrored.affine[1:], plain.affine[1:])


@pytest.mark.parametrize("tilt", [0.0, 10.0])
def test_slices_stand_across_the_long_axis_but_for_the_tilt(tilt):
    long_axis = np.array([0.0, np.cos(PITCH), -np.sin(PITCH)])
    generator = random()
    for _ in range(5):
        pose, turn = along_slices(generator, tilt=tilt)
        volume = Phantom(SMALL).label_volume(
            load_protocol("freesurfer"),
            voxel_size=(0.9, 0.9, 2.0),
            pose=pose,
            axes="LIA",
            grid_rotation=turn,
        )
        normal = volume.affine[:3, 2] / 2.0
        angle = np.rad2deg(np.arccos(np.clip(normal @ long_axis, -1, 1)))
        assert angle == pytest.approx(tilt, abs=1e-5)  # arccos near 1 amplifies rounding
        np.testing.assert_array_equal(pose[:3, :3], np.eye(3))


def test_poses_are_rigid_and_bounded():
    generator = random()
    for make, shift in ((any_pose, 2.0), (random_motion, 20.0)):
        motions = np.array([make(generator) for _ in range(50)])
        turns = motions[:, :3, :3]
        products = turns @ turns.transpose(0, 2, 1)
        # rounding
        np.testing.assert_allclose(products - np.eye(3), 0.0, atol=1e-12)
        np.testing.assert_allclose(np.linalg.det(turns), 1.0, atol=1e-12)
        assert np.abs(motions[:, :3, 3]).max() <= shift
        assert np.abs(motions[:, :3, 3]).max() > shift / 2


def test_random_rotations_have_no_favorite_direction():
    generator = random()
    images = np.array([random_motion(generator)[:3, 0] for _ in range(2000)])
    # Components have mean 0 and variance 1 / 3; four standard errors of 2000 draws.
    np.testing.assert_allclose(images.mean(axis=0), 0.0, atol=4 * np.sqrt(1 / 3 / 2000))
    np.testing.assert_allclose((images**2).mean(axis=0), 1 / 3, atol=0.03)


def test_fewer_poses_are_the_first_of_more():
    row = ROWS[5]
    few, many = _poses(5, row, 2), _poses(5, row, 4)
    for a, b in zip(few, many, strict=False):
        np.testing.assert_array_equal(a.pose, b.pose)
        np.testing.assert_array_equal(a.grid_rotation, b.grid_rotation)
    assert not np.array_equal(many[0].pose, many[1].pose)


def test_rows_are_those_that_were_promised():
    named = {(row.name, row.voxels): (row.bias, row.sd) for row in ROWS}
    assert named["tight 2.0 mm", "0.4 iso"] == (0.015, 0.04)
    assert named["spiral 2.0 mm, ±30%", "0.4 x 0.4 x 2"] == (0.015, 0.065)
    assert named["spiral 1.2 mm, tilted by 10°", "0.4 x 0.4 x 2"] == (0.02, 0.05)
    assert named["tight 1.6 mm", "0.5 x 0.5 x 1.5"] == (0.03, 0.09)
    assert len(named) == len(ROWS) == 10


def constant(error, *, thickness=2.0, flags=()):
    """Maps with the same error, mm, at every point but for a pattern without mean."""
    true = np.full((10, 8), thickness)
    pattern = np.where(np.indices(true.shape).sum(axis=0) % 2, 0.01, -0.01)
    return Measured(
        thickness=true + error + pattern,
        true_thickness=true,
        curvature={},
        true_curvature={},
        summary={},
        true_summary={},
        decision="use",
        flags=flags,
    )


def test_thickness_table_averages_poses_and_judges():
    rows = (
        Row(spec=SMALL, voxel_size=(0.4, 0.4, 0.4), bias=0.015, sd=0.04),
        Row(spec=SMALL, voxel_size=(0.4, 0.4, 2.0), bias=0.015, sd=0.04, tilt=0.0),
        Row(spec=SMALL, voxel_size=(0.4, 0.4, 2.0), bias=0.015, sd=0.04, tilt=10.0),
    )
    lost = Refusal(reason="sheet-too-thin", message="")
    groups = [[constant(0.02), constant(-0.01)], [constant(0.03), lost], [lost, lost]]
    good, refused, none = _thickness_table(dict(zip(rows, groups, strict=True))).rows
    assert (good["bias"], good["met"]) == ("+0.005", True)
    assert good["SD"] == pytest.approx(0.01)
    assert good["SD without edges"] == pytest.approx(0.01)
    assert good["bias, pose by pose"] == "-0.010 to +0.020"
    assert (refused["bias"], refused["refused"], refused["met"]) == ("+0.030", 1, False)
    assert (none.get("bias"), none["refused"], none["met"]) == (None, 2, False)


def test_limit_table_wants_refusals_or_truth():
    cases = [Case(spec=SMALL)] * 5
    results = [
        Refusal(reason="sheet-too-thin", message=""),
        Refusal(reason="timeout", message=""),
        constant(0.1),
        constant(0.3),
        constant(0.3, flags=("thickness-doubtful",)),
    ]
    rows = limit_table(cases, results).rows
    assert [row["met"] for row in rows] == [True, False, True, False, True]


def test_motions_are_judged_by_mean_and_points():
    maps = [constant(error) for error in (-0.005, 0.0, 0.005)]
    (row,) = _motion_table({"any": maps}).rows
    for heading in ("SD of the mean", "SD of a point (RMS)", "median", "95th percentile"):
        assert row[heading] == pytest.approx(0.005)
    assert row["met"] is True
    lost = Refusal(reason="x", message="")
    (row,) = _motion_table({"any": [*maps, lost]}).rows
    assert row["met"] is False
    (row,) = _motion_table({"any": [lost, lost]}).rows
    assert (row["refused"], row["met"]) == (2, False)


def test_pairs_are_judged_by_their_mean_absolute_change():
    pair = [constant(0.0), constant(0.01), constant(0.0), constant(0.03), constant(0.0)]
    rows = _pair_table([pair]).rows
    assert [row["met"] for row in rows] == [True, True, False, True]
    assert [rows[0][name] for name in ("mean", "mean absolute", "largest")] == [
        "+0.01000",
        "0.01000",
        "0.01000",
    ]


def test_rate_of_a_power_law():
    sizes = (0.6, 0.5, 0.4, 0.3)
    slope, doubt = rate(sizes, [0.3 * size**1.5 for size in sizes])
    assert slope == pytest.approx(1.5)
    assert doubt == pytest.approx(0.0, abs=1e-9)
    noisy = [0.3 * s * f for s, f in zip(sizes, (1.1, 0.9, 1.1, 0.9), strict=True)]
    assert rate(sizes, noisy)[1] > 0.1


def test_a_case_is_measured_near_its_truth():
    measured = measure_case(Case(spec=replace(SMALL, variation=0.0), pose=any_pose(random())))
    assert measured.decision == "use"
    # One pose of a short phantom: a tenth and a quarter of a voxel.
    assert abs(np.nanmean(measured.error)) < 0.04
    assert np.nanstd(measured.error) < 0.1
    assert measured.summary["volume"] == pytest.approx(measured.true_summary["volume"], rel=0.05)
