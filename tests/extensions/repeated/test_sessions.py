"""Two sessions, and mixed models of all, from files to files."""

import json
import re

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from small_cohorts import PLAN, methods_of, place_of, run_named, table, write_dataset

from hipsta_bids.cli import group
from hipsta_bids.cli.main import main
from hipsta_bids.extensions.repeated.sessions import Trial
from hipsta_bids.group.model import Comparison, ModelRequest, choose_model
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.reports.group import group_page
from hipsta_bids.stats.inference import control_fdr

ALIGNED = ["--align", "none"]
PLAIN = [*ALIGNED, "--no-classification"]
pytestmark = pytest.mark.usefixtures("without_figures")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("one-session"))


def test_two_sessions_give_the_paired_t_test(sessions, quick):
    options = [*quick, *PLAIN, "--paired", "1", "ses-3", "--formula", "1", "--asymmetry"]
    folder = run_named(sessions, *options)
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
    folder = run_named(sessions, *quick, *PLAIN, "--paired", "1", "2")
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
    folder = run_named(sessions, *quick, *ALIGNED, "--longitudinal", *random.split())
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
        np.testing.assert_allclose(own.p_fdr, np.maximum(expected, own.p), rtol=1e-6)
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
    folder = run_named(sessions, *quick, *PLAIN, *options)
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
    folder = run_named(
        sessions, *quick, *PLAIN, *options, "--longitudinal", "--measures", "thickness"
    )
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
        (["--longitudinal", "--formula", "age", "--contrast", "age,age"], 65, "rows"),
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


@pytest.mark.parametrize(("words", "random"), [((), "slope"), (("visits",), "visits")])
def test_settings_choose_random_effects_unless_the_option_does(tmp_path, words, random):
    (tmp_path / "own.toml").write_text('[longitudinal]\nrandom = "slope"\n')
    command = ["x", str(tmp_path), "group", "--settings", str(tmp_path / "own.toml")]
    options = group.group_parser().parse_args([*command, "--longitudinal", *words])
    assert group._settings(options).longitudinal.random == random


def test_trials_compare_arms_before_diagnoses():
    people = pd.DataFrame(
        {
            "participant_id": [f"{n:02d}" for n in range(8)],
            "group": ["CN", "AD"] * 4,
            "Arm": ["active"] * 4 + ["placebo"] * 4,
        }
    )
    request, trial = ModelRequest(formula="1"), Trial(("ancova", "ses-1", "ses-2"))
    columns = [
        choose_model(request, people, GroupSettings(), comparison=comparison)[2].column
        for comparison in (Comparison(sessions=trial), Comparison())
    ]
    assert columns == ["Arm", "group"]
