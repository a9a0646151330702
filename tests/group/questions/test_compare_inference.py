"""Permutations, sessions and sides of the group level, from files to files."""

import json
import re

import nibabel as nib
import numpy as np
import pandas as pd
import pytest
from pyarrow import parquet
from scipy import stats
from small_cohorts import (
    GROUPS,
    PLAN,
    methods_of,
    place_of,
    table,
    write_dataset,
    write_participants,
    write_sessions,
)

from hipsta_bids.cli.main import main
from hipsta_bids.group.output import write
from hipsta_bids.reports.group import group_page
from hipsta_bids.stats.inference import control_fdr
from validation.group import simulate_cohort

ALIGNED = ["--align", "none"]
PLAIN = [*ALIGNED, "--no-classification"]


@pytest.fixture(autouse=True)
def _no_figures(monkeypatch):
    """Figures take longer than all else."""
    monkeypatch.setattr(write, "draw_figures", lambda *_: iter(()))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("one-session"))


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    """Three yearly sessions; patients' wall thins by 0.1 mm per year, that of others by 0.02."""
    cohort = simulate_cohort(PLAN, 0)
    data, out = write_sessions(
        tmp_path_factory.mktemp("sessions"),
        cohort,
        np.where(cohort.group, 0.1, 0.02),
        noise=0.02,
        column="acq_time",
        times=lambda i, year: f"20{10 + year}-03-0{1 + i % 9}T12:00:00",
    )
    rows = [
        [f"sub-{i + 1:02d}", GROUPS[int(patient)], f"{age:.1f}", "MF"[int(sex)]]
        for i, (patient, age, sex) in enumerate(
            zip(cohort.group, cohort.age, cohort.sex, strict=True)
        )
    ]
    write_participants(data, rows)
    return data, out


def run(dataset, *options):
    data, out = dataset
    words = "".join(c if c.isalnum() else " " for c in " ".join(options[2:])).split()
    name = "-".join(words)
    assert main([str(data), str(out), "group", *options, "--name", name]) == 0
    return out / "group" / name


def test_permutations_are_in_the_tables_of_the_map(dataset, quick):
    corrected = {}
    for method in ("permutation-tfce", "permutation-max"):
        options = [*quick, *PLAIN, "--correction", method, "--permutations", "100"]
        folder = run(dataset, *options)
        found = table(folder / "hemi-L_contrast-CNAD_desc-thickness_statmap.tsv")
        assert found.p_corrected.min() == pytest.approx(1 / 100)
        assert (found.significant == (found.p_corrected <= 0.05)).all()
        peak = table(folder / "peaks.tsv").query("measure == 'thickness' and hemi == 'L'").iloc[0]
        here = found[(found.x == peak.x) & (found.y == peak.y)].iloc[0]
        assert here.p_corrected == peak.p_corrected
        text = methods_of(folder)
        assert "100 permutations" in text
        assert "seed 3" in text
        enhanced = "the largest threshold-free cluster enhancement [" in text
        assert enhanced == (method == "permutation-tfce")
        corrected[method] = found
    maximum = corrected["permutation-max"]
    # The largest t has the smallest p: the correction is monotone.
    order = maximum.statistic.abs().argsort()
    assert (np.diff(maximum.p_corrected.to_numpy()[order]) <= 0).all()
    overview = table(folder / "maps.tsv").set_index(["measure", "hemi"])
    largest = maximum.p[maximum.significant].max()
    assert overview.loc[("thickness", "L"), "p_cutoff"] == pytest.approx(largest)
    again = run(dataset, *options)
    pd.testing.assert_frame_equal(
        maximum, table(again / "hemi-L_contrast-CNAD_desc-thickness_statmap.tsv")
    )


def test_pooled_family_is_no_less_strict(dataset, quick):
    options = [*quick, *PLAIN, "--correction", "permutation-max", "--permutations", "100"]
    single = run(dataset, *options)
    pooled = run(dataset, *options, "--fdr-scope", "hemispheres")
    every = run(dataset, *options, "--fdr-scope", "all")
    overview = table(every / "maps.tsv").query("contrast == 'CN-AD'")
    assert len(set(overview.n_tests)) == 1
    assert overview.n_tests.iloc[0] == len(overview) * 147
    assert "all maps of a contrast" in (every / "methods.md").read_text()
    name = "hemi-{}_contrast-CNAD_desc-thickness_statmap.tsv"
    for hemi in "LR":
        one, both = (table(folder / name.format(hemi)) for folder in (single, pooled))
        # Everybody has both hemispheres, so that both runs shuffle alike.
        assert (both.p_corrected >= one.p_corrected).all()
        assert (both.p_corrected > one.p_corrected).any()


def test_blocks_are_a_column_inside_which_the_contrast_varies(dataset, quick, capsys):
    data, out = dataset
    options = [*quick, *PLAIN, "--correction", "permutation-max", "--permutations", "20"]
    folder = run(dataset, *options, "--blocks", "sex")
    assert "within levels of sex" in (folder / "methods.md").read_text()
    arguments = [str(data), str(out), "group", *options]
    assert main([*arguments, "--blocks", "group"]) == 65
    assert "does not vary inside the blocks" in capsys.readouterr().err
    assert main([*arguments, "--blocks", "sexx"]) == 65
    assert "did you mean sex" in capsys.readouterr().err


def test_two_sessions_give_the_paired_t_test(sessions, quick):
    options = [*quick, *PLAIN, "--paired", "1", "ses-3", "--formula", "1", "--asymmetry"]
    folder = run(sessions, *options)
    found = table(folder / "hemi-R_contrast-Mean_desc-thickness_statmap.tsv")
    _, out = sessions
    maps = {
        hemi: [
            [
                table(place_of(out, f"{i + 1:02d}", hemi, session=session).path("sheet")).thickness
                for i in range(sum(PLAN.sizes))
            ]
            for session in "13"
        ]
        for hemi in "LR"
    }
    expected = stats.ttest_rel(maps["R"][1], maps["R"][0])
    # Changes may be zero: their asymmetry is a difference, not a share.
    change = {hemi: np.subtract(own[1], own[0]) for hemi, own in maps.items()}
    both = table(folder / "contrast-Mean_desc-thicknessAsymmetry_statmap.tsv")
    np.testing.assert_allclose(
        both.statistic, stats.ttest_rel(change["L"], change["R"]).statistic, rtol=1e-6
    )
    assert (
        "left minus right, in the unit of the measure. Points"
        in (folder / "methods.md").read_text()
    )
    # Ten digits are written.
    np.testing.assert_allclose(found.statistic, expected.statistic, rtol=1e-8)
    np.testing.assert_allclose(found.p, expected.pvalue, rtol=1e-8)
    volume = table(folder / "measures.tsv").query("measure == 'volume' and hemi == 'R'").iloc[0]
    # The difference of two uniform numbers, over 30 participants, has an SD of .08.
    assert volume.estimate == pytest.approx(-10, abs=0.3)
    left_out = table(folder / "excluded.tsv")
    assert set(left_out.session_id) == {"ses-2"}
    assert set(left_out.reason) == {"other-session"}


def test_changes_of_groups_are_compared_between_two_sessions(sessions, quick):
    folder = run(sessions, *quick, *PLAIN, "--paired", "1", "2")
    record = json.loads((folder / "analysis.json").read_text())
    assert record["formula"] == "group + age + sex"
    assert set(record["contrasts"]) == {"mean", "CN-AD"}
    change = table(folder / "hemi-L_contrast-CNAD_desc-thickness_statmap.tsv")
    # .08 mm; noise of .02 in 30 participants and four columns leaves .011 at a point.
    assert change.estimate.mean() == pytest.approx(0.08, abs=0.003)
    assert np.abs(change.estimate - 0.08).max() < 0.06
    page = group_page(folder)
    assert "could not be made" not in page
    assert "change from ses-1 to ses-2" in page
    assert "larger in CN" in page
    assert "with a decrease" in page


@pytest.mark.parametrize("random", ["intercept", ""])
def test_longitudinal_model_finds_the_slopes(sessions, quick, random):
    folder = run(sessions, *quick, *ALIGNED, "--longitudinal", *random.split())
    record = json.loads((folder / "analysis.json").read_text())
    assert record["formula"] == "group * time + age + sex"
    assert (record["participants"], record["rows"]) == (30, 90)
    expected = {"TimeInCN": -0.02, "TimeInAD": -0.1, "TimeInCNAD": 0.08}
    for contrast, slope in expected.items():
        found = table(folder / f"hemi-L_contrast-{contrast}_desc-thickness_statmap.tsv")
        # Noise of .02 at three sessions of 14 and 16 participants: SE .005 at a point.
        assert found.estimate.mean() == pytest.approx(slope, abs=0.002)
        assert found.se.mean() == pytest.approx(0.0052 if "AD" in contrast else 0.0035, rel=0.35)
        # Sessions of a participant do not count as participants.
        assert (found.df < 90).all()
    text = methods_of(folder)
    own = "intercepts" if random else "intercepts and slopes"  # three visits of 30
    assert f"It had random {own} of participants, and was estimated by restricted" in text
    assert "30 participants (90 visits)" in text
    # Visits do not count as people.
    measures = table(folder / "measures.tsv")
    assert set(measures.n) == {30}
    assert set(measures.visits) == {90}
    assert table(folder / "means.tsv").n.max() == 16
    assert table(folder / "descriptives.tsv").n.max() == 16
    for _, own in measures.groupby("contrast"):
        expected = control_fdr(own.p.to_numpy(), 0.05).adjusted
        np.testing.assert_allclose(own.p_fdr, expected, rtol=1e-6)
    # Classification wants independent rows.
    assert set(table(folder / "classification.tsv").n) == {30}
    page = group_page(folder)
    assert "could not be made" not in page
    assert "n counts participants" in page
    assert "30 participants with 90 visits" in page
    assert "larger in CN" in page


def test_default_model_with_a_curve_of_age_tests_it(sessions, quick):
    """Also in a mixed model, where the spline's part beyond a line takes an F test."""
    options = ("--longitudinal", "intercept", "--age-model", "spline", "--measures", "thickness")
    folder = run(sessions, *quick, *PLAIN, *options)
    formula = json.loads((folder / "analysis.json").read_text())["formula"]
    assert formula == 'group * time + cr(age, df=3, constraints="center") + sex'
    found = table(folder / "hemi-L_contrast-AgeNonlinear_desc-thickness_statmap.tsv")
    assert found.cohen_d.isna().all()
    # Nothing bends; F of two rows, of 30 participants, is one on average, with 24 or so below.
    assert 0.2 < found.statistic.mean() < 3
    assert (found.df < 90).all()
    assert set(table(folder / "peaks.tsv").query("contrast == 'age nonlinear'").test) == {"F"}
    text = methods_of(folder)
    assert "modeled with a natural cubic spline. The contrast age nonlinear tested" in text
    assert "Fai AHT, Cornelius PL" in text  # of tests by F
    assert not (folder / "classification.tsv").exists()


def test_permutations_of_repeated_visits_flip_signs_of_participants(sessions, quick):
    options = ("--correction", "permutation-max", "--permutations", "20", "--blocks", "sex")
    folder = run(sessions, *quick, *PLAIN, *options, "--longitudinal", "--measures", "thickness")
    found = table(folder / "hemi-L_contrast-TimeInAD_desc-thickness_statmap.tsv")
    # The loss of .1 mm per session is in all: none of the other signs gives as much.
    np.testing.assert_allclose(found.p_corrected * 20, (found.p_corrected * 20).round(), atol=1e-6)
    assert found.significant.mean() > 0.9
    text = methods_of(folder)
    assert "20 permutations within levels of sex (seed 3)" in text
    assert "Residuals of the linear model without the contrast were permuted" in text
    exchanged = "participants with the same number of visits were exchanged"
    assert f"For CN-AD, time in CN-AD, {exchanged}; for time in CN, time in AD, the signs" in text
    share = re.search(r"Slopes differed between participants at (\d+)% of the points", text)
    assert share is not None
    assert int(share[1]) < 50
    assert "Stram DO, Lee JW" in text


def test_first_session_is_the_default_and_says_so(sessions, quick, capsys):
    folder = run(sessions, *quick, *PLAIN, "--formula", "group + age")
    assert "60 later sessions are not in it" in capsys.readouterr().out
    assert json.loads((folder / "analysis.json").read_text())["rows"] == 30


def test_asymmetry_is_left_minus_right_in_the_same_model(dataset, quick):
    folder = run(dataset, *quick, *PLAIN, "--asymmetry")
    _, out = dataset
    wall = {
        hemi: np.array(
            [
                table(place_of(out, f"{i + 1:02d}", hemi).path("sheet")).thickness
                for i in range(sum(PLAN.sizes))
            ]
        )
        for hemi in "LR"
    }
    relative = (wall["L"] - wall["R"]) / ((wall["L"] + wall["R"]) / 2)
    found = table(folder / "contrast-Mean_desc-thicknessAsymmetry_statmap.tsv")
    # The model's mean over all rows is the mean.
    np.testing.assert_allclose(found.estimate, relative.mean(axis=0), rtol=1e-7)
    assert (folder / "contrast-CNAD_desc-curvatureAsymmetry_statmap.tsv").is_file()
    assert (folder / "contrast-CNAD_stat-t_desc-curvatureAsymmetry_statmap.shape.gii").is_file()
    peaks = table(folder / "peaks.tsv")
    assert set(peaks.contrast[peaks.hemi == "LR"]) == {"mean", "CN-AD"}
    assert "(L - R) / ((L + R) / 2)" in (folder / "methods.md").read_text()


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (["--paired", "1", "9"], 65, "there is no session ses-9"),
        (["--paired", "1", "2", "--longitudinal"], 64, "not both"),
        (
            ["--longitudinal", "--session-label", "1"],
            65,
            "longitudinal model: no participant has a second session; remove --longitudinal",
        ),
        (
            [
                *("--longitudinal", "intercept", "--correction", "permutation-tfce"),
                *("--blocks", "session_id", "--measures", "thickness"),
            ],
            65,
            "changes between visits of a participant",
        ),
        (
            [
                *("--longitudinal", "intercept", "--correction", "permutation-max"),
                *("--blocks", "group", "--measures", "thickness"),
                *("--formula", "group*time", "--contrast", "group[T.AD]:time"),
            ],
            65,
            "group[T.AD]:time does not vary inside the blocks",
        ),
        (["--correction", "permutation-max", "--permutations", "1"], 64, "at least 2"),
        (["--correction", "permutation-max", "--permutations", "19"], 64, "at least 20 are"),
        (["--blocks", "sex"], 64, "--blocks: has no effect without permutations"),
        (["--permutations", "99"], 64, "--permutations: has no effect without"),
        (["--longitudinal", "--formula", "age", "--contrast", "age,age"], 65, "rows"),
        (["--formula", "group + age", "--age-model", "spline"], 64, "of the default model"),
        (["--formula", "group + age", "--contrast", "nonlinear(age)"], 65, "poly(age, 2)"),
    ],
)
def test_refusals(sessions, capsys, options, code, message):
    data, out = sessions
    before = sorted((out / "group").glob("*")) if (out / "group").exists() else []
    assert main([str(data), str(out), "group", *ALIGNED, *options]) == code
    assert message in capsys.readouterr().err
    assert (sorted((out / "group").glob("*")) if (out / "group").exists() else []) == before


@pytest.mark.parametrize("options", [["--paired", "a", "b"], ["--endpoint", "mmrm", "a", "b"]])
def test_a_dataset_without_sessions_has_none_to_compare(dataset, capsys, options):
    data, out = dataset
    assert main([str(data), str(out), "group", *options]) == 65
    assert f"{options[0]}: no sessions in this dataset" in capsys.readouterr().err


def test_w_scores_are_those_of_a_model_without_the_participant(dataset, quick):
    folder = run(dataset, *quick, *PLAIN, "--normative", "group=CN")
    _, out = dataset
    people = table(folder / "covariates.tsv")
    wall = np.array(
        [
            table(place_of(out, p.removeprefix("sub-"), "L").path("sheet")).thickness
            for p in people.participant_id
        ]
    )
    matrix = np.column_stack([np.ones(len(people)), people.age, people.sex == "M"]).astype(float)
    healthy = (people.group == "CN").to_numpy()
    scored = parquet.read_table(folder / "wscores.parquet").to_pandas()
    for i in (0, len(people) - 1):  # a member of the reference group, and a patient
        others = healthy & (np.arange(len(people)) != i)
        beta, squares, *_ = np.linalg.lstsq(matrix[others], wall[others], rcond=None)
        sigma = np.sqrt(squares / (others.sum() - 3))
        expected = (wall[i] - matrix[i] @ beta) / sigma
        own = scored[(scored.participant_id == people.participant_id[i]) & (scored.hemi == "L")]
        np.testing.assert_allclose(own.thickness_w, expected, rtol=1e-5)  # single precision
        image = nib.load(folder / "hemi-L_stat-w_desc-thickness_statmap.shape.gii")
        np.testing.assert_allclose(image.darrays[i].data, expected, rtol=1e-5)
        assert image.darrays[i].meta["Name"] == people.participant_id[i]
        row = table(folder / "wscores.tsv").query(
            "participant_id == @people.participant_id[@i] and hemi == 'L' and region == 'all'"
            " and measure == 'thickness'"
        )
        assert row.w.item() == pytest.approx(expected.mean())
    found = table(folder / "wscores.tsv").query("region == 'all' and measure == 'thickness'")
    members = found[found.reference]
    # What counts as low is one in forty of a healthy participant's points.
    assert members.low.mean() == pytest.approx(0.025, abs=0.025)
    assert found[~found.reference].low.mean() > members.low.mean() + 0.02
    text = methods_of(folder)
    assert "against 16 participants with group CN." in text
    assert "including the uncertainty of the model, was below 0.05." in text


def test_w_scores_say_what_is_wrong_with_their_reference(dataset, capsys):
    data, out = dataset
    for option, code, message in (
        ("group=XY", 65, "there are AD, CN"),
        ("grp=CN", 65, "did you mean group"),
        ("CN", 64, "FACTOR=LEVEL"),
    ):
        arguments = [str(data), str(out), "group", *ALIGNED, "--normative", option]
        assert main(arguments) == code
        assert message in capsys.readouterr().err
