"""Test-retest and sample sizes from files to files, and what they refuse."""

import json
import re

import nibabel as nib
import numpy as np
import pytest
from extension_marks import needs
from hippunfold_like import flat_surface, names, write_map, write_surface
from small_cohorts import NODES, place_of, table, write_participants, write_sessions
from statsmodels.api import OLS
from statsmodels.stats.power import TTestIndPower

from hipsta_bids.cli.main import main
from hipsta_bids.extensions.trials import trial as trials
from hipsta_bids.extensions.trials.sizes import repeatability
from hipsta_bids.group.output.tables import read_columns
from hipsta_bids.reports.group import group_page
from hipsta_bids.stats.registration import mean_profiles, register
from hipsta_bids.stats.settings import RegistrationSettings
from validation.group import SimulationPlan, simulate_cohort

PEOPLE = 14
ALIGNED = ["--align", "none"]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Three yearly sessions of patients and controls, thinning by .06 and .02 mm per year."""
    cohort = simulate_cohort(SimulationPlan(sizes=(7, 7), nodes=NODES, effect=0.0), 0)
    patient = np.arange(PEOPLE) % 2
    data, out = write_sessions(
        tmp_path_factory.mktemp("trials"),
        cohort,
        np.where(patient, 0.06, 0.02) + 0.01 * np.random.default_rng(1).standard_normal(PEOPLE),
        noise=0.03,
        column="age",
        times=lambda i, year: f"{60 + i + year}",
        lacking={(0, "2")},
    )
    rows = [[f"sub-{i + 1:02d}", ("CN", "AD")[i % 2], "FM"[i // 2 % 2]] for i in range(PEOPLE)]
    write_participants(data, rows, ("participant_id", "group", "sex"))
    return data, out


@pytest.fixture(autouse=True)
def _no_figures(request, monkeypatch):
    """Figures take longer than all else."""
    if "draws" not in request.node.name:
        monkeypatch.setattr(trials, "_figures", lambda *_: iter(()))


def run(dataset, *options):
    data, out = dataset
    assert main([str(data), str(out), "group", *options, "--name", "found"]) == 0
    return out / "group" / "found"


def sheets(out, hemi, column, sessions, skipped=()):
    who = [f"{i + 1:02d}" for i in range(PEOPLE) if f"{i + 1:02d}" not in skipped]
    return np.array(
        [
            [table(place_of(out, name, hemi, session=s).path("sheet"))[column] for s in sessions]
            for name in who
        ]
    )


def test_retest_is_that_of_the_sheets(dataset, capsys):
    folder = run(dataset, *ALIGNED, "--retest")
    assert "2 visits of participants who lack a session" in capsys.readouterr().out
    values = sheets(dataset[1], "R", "thickness", "123", skipped=("01",))
    expected = repeatability(values)
    points = table(folder / "retest_points.tsv").query("measure == 'thickness' and hemi == 'R'")
    np.testing.assert_allclose(points.icc, expected["icc"], rtol=1e-8)
    np.testing.assert_allclose(points.sd_within, expected["sd_within"], rtol=1e-8)
    np.testing.assert_allclose(points.detectable_change, expected["detectable_change"], rtol=1e-8)
    for stat, column in (("icc", "icc"), ("sdwithin", "sd_within"), ("mdc", "detectable_change")):
        path = folder / f"hemi-R_stat-{stat}_desc-thickness_statmap.shape.gii"
        written = nib.load(path).agg_data()
        np.testing.assert_allclose(written, points[column], rtol=1e-6)
    summary = table(folder / "retest.tsv").set_index(["measure", "hemi"])
    assert set(summary.loc["volume"].index) == {"L", "R", "LR"}
    # Thinning is part of the difference between sessions, and told by its p.
    assert (summary.loc["volume"].p_sessions < 1e-6).all()
    assert set(table(folder / "excluded.tsv").reason) == {"incomplete-sessions"}
    for name in ("retest", "retest_points"):
        columns = table(folder / f"{name}.tsv").columns.tolist()
        assert list(json.loads((folder / f"{name}.json").read_text())) == columns
        assert set(columns) <= set(read_columns("hipsta_bids.extensions.trials"))
    page = group_page(folder)
    assert "could not be made" not in page
    assert "Sessions ses-1, ses-2, ses-3 of 13 participants" in page
    assert "What was found" not in page
    text = (folder / "methods.md").read_text()
    assert "ICC(2,1)" in text
    assert "McGraw KO, Wong SP." in text


def test_retest_registers_sheets_as_comparisons_do_and_draws_them(dataset):
    options = ["--session-label", "1", "3", "--measures", "thickness"]
    folder = run(dataset, "--retest", *options)
    bends = sheets(dataset[1], "L", "curvature", "13").reshape(-1, *NODES)
    profiles = mean_profiles(bends, RegistrationSettings())
    warps = register(profiles, RegistrationSettings()).warps
    written = table(folder / "warps.tsv").query("hemi == 'L'")
    nodes = [f"node_{i + 1}" for i in range(NODES[0])]
    np.testing.assert_allclose(written[nodes], warps, atol=1e-9)
    assert (folder / "template.json").is_file()
    assert (folder / "figures" / "thickness_retest.svg").is_file()
    page = group_page(folder)
    assert "Thickness: agreement between sessions at each point" in page
    assert page.count("data:image/svg+xml") == 1


def test_sample_size_of_one_visit(dataset, capsys):
    folder = run(dataset, *ALIGNED, "--power", "thinning=5%", "--dropout", ".1")
    out = capsys.readouterr().out
    assert "curvature: no sample sizes" in out
    values = sheets(dataset[1], "L", "thickness", "1")[:, 0]
    people = table(folder / "covariates.tsv")
    matrix = np.column_stack([np.ones(PEOPLE), people.age, people.sex == "M"]).astype(float)
    sd = np.sqrt([OLS(point, matrix).fit().scale for point in values.T])
    d = 0.05 * values.mean(axis=0) / sd
    points = table(folder / "power_points.tsv")
    assert set(points.measure) == {"thickness"}
    left = points[points.hemi == "L"]
    np.testing.assert_allclose(left.cohen_d, d, rtol=1e-8)
    n = [
        TTestIndPower().solve_power(one, alpha=alpha, power=0.8)
        for one, alpha in zip(d[:5], left.alpha, strict=False)
    ]
    assert left.per_arm[:5].tolist() == np.ceil(n).tolist()
    assert (left.enrolled_per_arm == np.ceil(left.per_arm / 0.9 - 1e-9)).all()
    written = nib.load(folder / "hemi-L_stat-n_desc-thickness_statmap.shape.gii").agg_data()
    np.testing.assert_array_equal(written, left.per_arm.astype(np.float32))
    summary = table(folder / "power.tsv")
    assert (np.diff(summary.per_arm) >= 0).all()
    assert (summary.per_arm_low <= summary.per_arm).all()
    assert (summary.alpha == 0.05).all()
    page = group_page(folder)
    assert "could not be made" not in page
    assert f"needs fewest: {summary.per_arm[0]:.0f} per arm" in page
    assert "One visit; the end point is" in page
    # Of the participants, the first sessions only, by a model of age and sex.
    record = json.loads((folder / "analysis.json").read_text())
    assert (record["formula"], record["rows"]) == ("1 + age + sex", PEOPLE)


PLAIN_POWER = ("--align", "none", "--measures", "thickness_mean", "--power", "thinning=1%")


def test_sample_sizes_of_unequal_arms(dataset):
    equal = table(run(dataset, *PLAIN_POWER) / "power.tsv")
    assert "larger_arm" not in equal
    folder = run(dataset, *PLAIN_POWER, "--allocation", "1:2")
    summary = table(folder / "power.tsv")
    assert (summary["per_arm"] < equal["per_arm"]).all()
    assert (summary["larger_arm"] == 2 * summary["per_arm"]).all()
    first = summary.iloc[0]
    exact = [
        TTestIndPower().power(first["cohen_d"], n, 0.05, 2)
        for n in (first["per_arm"] - 1, first["per_arm"])
    ]
    assert exact[0] < 0.8 <= exact[1]
    assert "two arms allocated 2:1" in (folder / "methods.md").read_text()
    page = group_page(folder)
    assert "arms of sizes 2 to 1, power" in page
    n = int(first["per_arm"])
    assert f"needs fewest: {n:,} and {2 * n:,} participants, {3 * n:,} in all</b>, limits" in page
    heads = [
        '<th scope="col" class="n">Smaller arm</th>',
        '<th scope="col" class="n">Larger arm</th>',
        '<th scope="col" class="n">Total</th>',
    ]
    assert [page.count(head) for head in heads] == [1, 1, 1]
    assert f'<td class="n">{2 * n:,}</td><td class="n">{3 * n:,}</td>' in page


def test_a_plan_of_unequal_arms_draws_the_smaller_arm(dataset):
    options = ["--power", "thinning=5%", "--measures", "thickness", "--allocation", "2:1"]
    page = group_page(run(dataset, *ALIGNED, *options))
    assert "Thickness: participants of the smaller arm at each point" in page
    assert "participants per arm at each point" not in page


def test_sample_size_of_slowing_among_patients_draws_a_map(dataset):
    options = ["--power", "slowing=25%", "--visits", "0,12,24", "--among", "group=AD"]
    options += ["--measures", "thickness", "thickness_mean", "volume"]
    folder = run(dataset, *ALIGNED, *options, "--power-level", ".9")
    summary = table(folder / "power.tsv").set_index(["measure", "hemi"])
    assert (summary.n == PEOPLE // 2).all()
    thin = summary.loc["thickness_mean"]
    # The planted change, with the SD .01 of own changes over seven patients.
    assert thin.change_per_year.to_numpy() == pytest.approx([-0.06] * 3, abs=0.012)
    np.testing.assert_allclose(thin.arm_difference, -0.25 * thin.change_per_year, rtol=1e-8)
    assert summary.loc[("volume", "LR")].change_per_year == pytest.approx(-5, abs=0.6)
    assert (summary.power >= 0.9).all()
    reasons = table(folder / "excluded.tsv").reason
    assert reasons.value_counts().to_dict() == {"not-asked": 20}
    drawn = (folder / "figures" / "thickness_power.svg").read_text(encoding="utf-8")
    ticks = [int(n.replace(",", "")) for n in re.findall(r">([\d,]+)</text>", drawn)]
    per_arm = table(folder / "power_points.tsv").per_arm
    # Numbers of participants, though colors go by their logarithm.
    assert ticks == sorted({*ticks} & {20, 30, 50, 100, 200, 300, 500, 1000, 2000, 3000, 5000})
    assert per_arm.min() <= ticks[0] < ticks[-1] <= per_arm.max()
    text = (folder / "methods.md").read_text()
    assert "a power of 0.9. In this trial, treatment prevents 25 % of the change over time." in text
    assert "`time + age_first + sex`" in text
    page = group_page(folder)
    assert "Visits: months 0, 12, 24" in page
    assert "could not be made" not in page


def test_retest_feeds_sample_sizes(dataset):
    options = ["--retest", "--power", "thinning=5%", "--visits", "0,12"]
    folder = run(dataset, *ALIGNED, *options, "--session-label", "1", "2")
    agreed = table(folder / "retest.tsv").set_index(["measure", "hemi"])
    sizes = table(folder / "power.tsv").set_index(["measure", "hemi"]).loc[agreed.index]
    # The slope of two visits is their difference.
    np.testing.assert_allclose(sizes.sd_endpoint, np.sqrt(2) * agreed.sd_within, rtol=1e-8)
    np.testing.assert_allclose(sizes.arm_difference, 0.05 * agreed["mean"], rtol=1e-8)
    record = json.loads((folder / "analysis.json").read_text())
    assert any("include only the variance of measurement" in note for note in record["notes"])


@needs("maps")
def test_maps_of_other_programs_lie_on_their_surface(tmp_path):
    data, out, random = tmp_path / "bids", tmp_path / "out", np.random.default_rng(0)
    surface = flat_surface(60)
    values = 1.5 + random.normal(0, 0.1, (6, 1, 60)) + random.normal(0, 0.04, (6, 2, 60))
    for i, of_participant in enumerate(values):
        for session, one in zip("12", of_participant, strict=True):
            path, flat = names(data / "hippunfold", f"{i}", "L", version=2, session=session)
            write_map(path, one)
            write_surface(flat, *surface)
    pattern = "hippunfold/sub-{subject}/ses-{session}/metric/*_hemi-{hemi}_*_thickness.shape.gii"
    asked = ["--retest", "--power", "thinning=5%", "--maps", f"hipp={pattern}"]
    folder = run((data, out), *asked)
    expected = repeatability(values)
    found = table(folder / "hipp_retest_points.tsv")
    np.testing.assert_allclose(
        found.icc, expected["icc"], rtol=1e-5
    )  # maps are in single precision
    assert found.surface_x.to_numpy() == pytest.approx(surface[0][:, 0], abs=1e-4)
    sizes = table(folder / "hipp_power_points.tsv")
    total = np.sqrt(expected["sd_within"] ** 2 + expected["sd_between"] ** 2)
    np.testing.assert_allclose(sizes.sd_endpoint, total, rtol=1e-5)
    assert (folder / "hemi-L_space-hipp_midthickness.surf.gii").is_file()
    text = (folder / "methods.md").read_text()
    assert "(hipp) were analyzed without registration" in text
    assert "could not be made" not in group_page(folder)


def test_who_lacks_a_covariate_is_not_in_the_reference(dataset, tmp_path):
    score = tmp_path / "score.tsv"
    score.write_text(
        "participant_id\tscore\n"
        + "".join(f"sub-{i + 1:02d}\t{i or 'n/a'}\n" for i in range(PEOPLE))
    )
    options = ["--power", "thinning=5%", "--measures", "volume", "--formula", "score"]
    folder = run(dataset, *options, "--covariates", str(score))
    assert (table(folder / "power.tsv").n == PEOPLE - 1).all()
    excluded = table(folder / "excluded.tsv").query("reason == 'incomplete'")
    assert excluded[["participant_id", "message"]].to_numpy().tolist() == [
        ["sub-01", "score is missing"]
    ]
    assert f"{PEOPLE - 1} participants" in (folder / "methods.md").read_text()


@needs("sites")
def test_harmonization_of_the_settings_is_refused(dataset, tmp_path, capsys):
    settings = tmp_path / "group.toml"
    settings.write_text('[harmonization]\ncolumn = "site"\n')
    data, out = dataset
    asked = ["--power", "thinning=5%", "--settings", str(settings)]
    assert main([str(data), str(out), "group", *asked]) == 64
    assert "harmonization is not possible" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (["--power", "thinning=5"], 64, "not of the form thinning=5%"),
        (["--power", "thining=5%"], 64, "slowing=25%; did you mean thinning?"),
        (["--power", "thinning=0%"], 64, "not of the form"),
        (["--power", "growth=5%"], 64, "not of the form"),
        (["--power", "slowing=25%"], 64, "--visits 0,12,24"),
        (["--power", "thinning=5%", "--visits", "12,0"], 64, "in their order"),
        (["--power", "thinning=5%", "--visits", "12"], 64, "two or more"),
        (["--power", "thinning=5%", "--dropout", "1"], 64, "dropout"),
        (["--power", "thinning=5%", "--allocation", "2:0"], 64, "2:1"),
        (["--power", "thinning=5%", "--allocation", "40:1"], 64, "allocation"),
        (["--power", "thinning=5%", "--correction", "permutation-max"], 64, "fdr2 or bh"),
        pytest.param(
            ["--power", "thinning=5%", "--paired", "1", "2"],
            64,
            "--paired: has no effect",
            marks=needs("repeated"),
        ),
        pytest.param(
            ["--retest", "--harmonize", "site"],
            64,
            "--harmonize: has no effect with --retest",
            marks=needs("sites"),
        ),
        (["--visits", "0,12"], 64, "without --retest or --power"),
        (["--retest", "--dropout", ".1"], 64, "without --power"),
        (["--retest", "--formula", "age"], 64, "--formula: has no effect with --retest"),
        (["--retest", "--session-label", "1"], 65, "no second session"),
        (["--retest", "--participant-label", "01", "02"], 65, "of 5 needed"),
        (["--retest", "--among", "group=MCI"], 65, "there are AD, CN"),
        (["--retest", "--among", "sexx=F"], 65, "did you mean sex"),
        (
            ["--power", "slowing=9%", "--visits", "0,9", "--session-label", "1", "2"],
            65,
            "has three sessions",
        ),
        (["--retest", "--power", "slowing=9%", "--visits", "0,9"], 65, "was followed"),
    ],
)
def test_refusals(dataset, capsys, options, code, message):
    data, out = dataset
    before = sorted((out / "group").glob("*")) if (out / "group").exists() else []
    assert main([str(data), str(out), "group", *ALIGNED, *options]) == code
    said = capsys.readouterr().err.strip()
    assert message in said
    assert "\n" not in said
    assert (sorted((out / "group").glob("*")) if (out / "group").exists() else []) == before
