"""Synthetic cohorts, in memory and through the command line."""

import numpy as np
import pandas as pd
import pytest

from hipsta_bids.cli import main
from hipsta_bids.cli.commands import phantom_parser
from hipsta_bids.errors import ExitCode, UsageError
from hipsta_bids.inputs.scan import InputRequest
from hipsta_bids.inputs.search import find_hemispheres
from hipsta_bids.io import files
from hipsta_bids.phantom import TRUTH_TABLE, Phantom
from hipsta_bids.phantom.cohort import (
    EFFECT_TABLE,
    MAPS_FOLDER,
    REGIONS,
    CohortPlan,
    make_cohort,
    region_limits,
    typical_shape,
)

COARSE = ("--voxel-size", "0.8", "0.8", "0.8")
QUIET = {"subject_sd": 0.0, "hemisphere_sd": 0.0, "offset_sd": 0.0}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    out = tmp_path_factory.mktemp("cohort") / "with blank"
    options = ("--n-subjects", "3", "--groups", "young", "old", "--seed", "4", "--shift", "0.6")
    assert main.main(["phantom", str(out), *options, *COARSE]) == ExitCode.OK
    return out


def tree(folder):
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def walls(subjects):
    """Mean thickness of every hemisphere."""
    return np.array([[item.spec.thickness for item in s.hemispheres] for s in subjects])


def test_each_subject_has_two_sides_and_covariates(dataset):
    table = pd.read_csv(dataset / "participants.tsv", sep="\t")
    assert list(table) == ["participant_id", "group", "age", "sex", "icv", "site"]
    assert table.group.tolist() == ["young", "old", "young"]
    assert table.age.between(50, 80).all()
    assert table.icv.between(1000, 2000).all()
    sidecar = files.read_json(dataset / "participants.json")
    assert set(sidecar) == set(table)
    assert sidecar["icv"]["Units"] == "mL"
    assert set(table.sex) <= set(sidecar["sex"]["Levels"])
    assert set(table.site) <= set(sidecar["site"]["Levels"])
    items = find_hemispheres(InputRequest(bids_dir=dataset))
    assert [(item.subject, item.hemi) for item in items] == [
        (f"{n:02d}", hemi) for n in (1, 2, 3) for hemi in "LR"
    ]
    assert all(item.problem is None for item in items)


def test_true_maps_are_those_of_the_phantoms(dataset):
    plan = CohortPlan(n_subjects=3, groups=("young", "old"), seed=4, shift=0.6)
    item = make_cohort(plan)[1].hemispheres[1]
    table = pd.read_csv(dataset / MAPS_FOLDER / "sub-02_hemi-R_truth.tsv", sep="\t")
    truth = Phantom(item.spec).truth(table.u, table.v, hemi="R", pose=item.pose)
    # Five decimals are written.
    np.testing.assert_allclose(table.thickness, truth.thickness, atol=1e-5)
    np.testing.assert_allclose(table.curvature, truth.curvature, atol=1e-5)
    np.testing.assert_allclose(table[["r", "a", "s"]], truth.points, atol=1e-4)
    assert table[["x", "y"]].max().tolist() == [41, 21]
    rows = files.read_tsv(dataset / TRUTH_TABLE)
    (row,) = [r for r in rows if (r["subject"], r["hemi"]) == ("sub-02", "R")]
    assert float(row["thickness_mean"]) == pytest.approx(truth.summary["thickness_mean"], abs=1e-4)


def test_cortex_leaves_the_hippocampus_as_it_was():
    plain, beside = (CohortPlan(n_subjects=1, cortex=mm, region="CA1") for mm in (0.0, 10.0))
    first, second = (Phantom(typical_shape(plan, 1)) for plan in (plain, beside))
    s = np.linspace(0.0, 20.0, 9)
    np.testing.assert_allclose(
        second.body.curve.curvature(10.0 + s), first.body.curve.curvature(s), atol=1e-12
    )
    # CA1 begins 7 mm and ends 15 mm from the border with the cortex.
    assert np.multiply(30.0, region_limits(beside)[0]) == pytest.approx([17.0, 25.0])
    assert region_limits(plain) == ((0.35, 0.75), (0.0, 1.0))


def test_effect_table_tells_thinning_from_shift(dataset):
    table = pd.read_csv(dataset / EFFECT_TABLE, sep="\t")
    inside = table.in_region == 1
    # CA1-anterior: nodes 15 to 31 along x, 11 to 21 along y.
    assert inside.sum() == 17 * 11
    assert table.x[inside].agg(["min", "max"]).tolist() == [15, 31]
    assert table.difference[inside].min() == pytest.approx(-0.3, abs=1e-4)
    far = (table.u < 0.2) | (table.v < 0.3)
    assert table.difference[far].abs().max() < 1e-3
    # At equal u, the shifted pattern alone makes differences elsewhere.
    assert table.difference_unregistered[far].abs().max() > 0.02
    assert files.read_json((dataset / EFFECT_TABLE).with_suffix(".json"))["Plan"]["seed"] == 4


def test_the_same_seed_gives_the_same_files(dataset, tmp_path):
    options = ("--n-subjects", "3", "--groups", "young", "old", "--seed", "4", "--shift", "0.6")
    assert main.main(["phantom", str(tmp_path / "again"), *options, *COARSE]) == ExitCode.OK
    assert tree(dataset) == tree(tmp_path / "again")


def test_another_seed_gives_another_cohort():
    first, second = (make_cohort(CohortPlan(seed=seed, n_subjects=4)) for seed in (0, 1))
    assert not np.isclose(walls(first), walls(second)).any()


def test_more_subjects_leave_the_first_ones_alone():
    few, many = (make_cohort(CohortPlan(n_subjects=n)) for n in (3, 9))
    assert [(s.age, s.icv, s.group) for s in few] == [(s.age, s.icv, s.group) for s in many[:3]]
    np.testing.assert_array_equal(walls(few), walls(many)[:3])


def test_effect_is_in_every_group_but_the_first():
    plan = CohortPlan(n_subjects=6, groups=("a", "b", "c"), thinning=0.2, shift=0.4, **QUIET)
    for subject in make_cohort(plan):
        dose = "abc".index(subject.group)
        for item in subject.hemispheres:
            depths = [thinning.depth for thinning in item.spec.thinnings]
            assert depths == ([pytest.approx(0.2 * dose)] if dose else [])
            assert item.spec.offset * item.spec.width == pytest.approx(0.4 * dose)


def test_covariates_act_as_stated():
    plan = CohortPlan(n_subjects=400, **QUIET)
    subjects = make_cohort(plan)
    age = np.array([s.age for s in subjects])
    site = np.array([plan.sites[int(s.site[-1]) - 1] for s in subjects])
    expected = plan.thickness + plan.age_slope * (age - 65) + site
    np.testing.assert_allclose(walls(subjects), np.tile(expected, (2, 1)).T, atol=1e-12)  # rounding
    icv = np.array([s.icv for s in subjects])
    width = np.array([s.hemispheres[0].spec.width for s in subjects])
    np.testing.assert_allclose(width, 20 * np.cbrt(icv / 1480), atol=1e-12)  # rounding
    men = np.array([s.sex == "M" for s in subjects])
    # 160 mL apart; the standard error is 110 * sqrt(4 / 400) = 11.
    assert icv[men].mean() - icv[~men].mean() == pytest.approx(160, abs=45)


def test_subjects_differ_as_much_as_planned():
    plan = CohortPlan(n_subjects=400, age_slope=0.0, sites=(0.0,))
    wall = walls(make_cohort(plan))
    # Relative standard error of an SD: 1 / sqrt(2 * 400) = 0.035; four of them.
    assert wall.mean(axis=1).std() == pytest.approx(np.hypot(0.08, 0.03 / 2**0.5), rel=0.14)
    assert (wall[:, 0] - wall[:, 1]).std() == pytest.approx(0.03 * 2**0.5, rel=0.14)


@pytest.mark.parametrize("region", REGIONS)
def test_every_region_can_be_thinned(region):
    (_, patient) = make_cohort(CohortPlan(n_subjects=2, region=region))
    u, v = REGIONS[region]
    body = Phantom(patient.hemispheres[0].spec).body
    middle = body.thickness(np.array(np.mean(u) + body.spec.offset), np.array(np.mean(v)))
    without = patient.hemispheres[0].spec.thickness * (1 + 0.12)
    assert middle < without


def test_help_names_the_regions():
    words = phantom_parser().epilog.split("\n", maxsplit=1)[0]
    assert all(name.removesuffix("-anterior").removesuffix("-posterior") in words
               for name in REGIONS)  # fmt: skip


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--region", "CA9"), "region 'CA9' is unknown; choose from presubiculum"),
        (("--kind", "helix"), "kind 'helix' is unknown"),
        (("--groups", "a", "a"), "groups with different names"),
        (("--n-subjects", "0"), "0 subjects; give 1 to 10,000"),
        (("--n-subjects", "1000000000"), "1000000000 subjects"),
        (("--seed", "-1"), "a seed of 0 or more, not -1"),
        (("--layout", "hipsta"), "layout 'hipsta' is unknown"),
        (("--thinning", "5"), "leaves no wall"),
        (("--thinning", "nan"), "thinning depth nan is outside"),
        (("--n-subjects", "x"), "invalid int value"),
    ],
)
def test_wrong_options_are_one_line(tmp_path, capsys, options, message):
    code = main.main(["phantom", str(tmp_path / "out"), *options])
    assert code == ExitCode.USAGE
    text = capsys.readouterr().err
    assert message in text
    assert text.count("\n") == 1


def test_a_folder_with_something_else_is_left_alone(tmp_path, capsys):
    (tmp_path / "thesis.txt").write_text("years of work")
    assert main.main(["phantom", str(tmp_path)]) == ExitCode.USAGE
    assert "holds something other than phantoms" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]


def test_plans_are_checked_at_once():
    with pytest.raises(UsageError, match="region 'x' is unknown"):
        CohortPlan(region="x")


def test_subjects_of_one_site_are_named_after_it():
    plain = make_cohort(CohortPlan(n_subjects=2, thickness=1.9, sites=(0.0,)))
    own = make_cohort(CohortPlan(n_subjects=2, thickness=1.9, site="Oslo"))
    assert [subject.label for subject in own] == ["Oslo01", "Oslo02"]
    assert {subject.site for subject in own} == {"Oslo"}
    walls = [[item.spec.thickness for s in some for item in s.hemispheres] for some in (plain, own)]
    assert walls[0] == walls[1]
    with pytest.raises(UsageError, match="letters and digits"):
        CohortPlan(site="New York")
