"""Demographics by group: values of participants.tsv, tests of libraries, and the page."""

import numpy as np
import pandas as pd
import pytest
from extension_marks import needs
from scipy import stats
from small_cohorts import (
    FAST,
    begin_dataset,
    methods_of,
    place_of,
    read_participants,
    table,
    write_dataset,
    write_hemisphere,
    write_participants,
    write_sessions,
)
from statsmodels.stats.oneway import anova_oneway
from statsmodels.stats.weightstats import ttest_ind

from hipsta_bids.cli.main import main
from hipsta_bids.group.model import Groups
from hipsta_bids.group.output.demographics import demographics_table
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.io import files
from hipsta_bids.reports.group import group_page
from validation.group import SimulationPlan, simulate_cohort

NODES = (21, 7)


def run(study, *options):
    data, out = study
    assert main([str(data), str(out), "group", *FAST, "--name", "q", *options]) == 0
    return out / "group" / "q"


def rows_of(result, *labels):
    """Rows of a variable, and of a level and a group if these are given."""
    for name, label in zip(("variable", "level", "group"), labels, strict=False):
        result = result[result[name] == label] if label else result
    return result


def made(values, groups, name="score", **kinds):
    """Demographics of a table of one variable."""
    n = len(groups)
    visits = pd.DataFrame(
        {"participant_id": [f"sub-{i}" for i in range(n)], "session_id": None, "group": groups}
    ).assign(**{name: values})
    levels = tuple(dict.fromkeys(groups))
    return demographics_table(visits, GroupSettings(), [name], Groups("group", levels), **kinds)


@pytest.fixture
def cohort(tmp_path):
    """Two groups; one control has no age, and few women are in the first group."""
    data, out = write_dataset(tmp_path)
    rows = read_participants(data)
    rows[2][2] = "n/a"
    for i, row in enumerate(rows):
        row[3] = "F" if i % 16 < 2 + 6 * (row[1] == "AD") else "M"
        row.append(f"{10 + i % 5}")
    write_participants(data, rows, ("participant_id", "group", "age", "sex", "education"))
    return data, out


def test_numbers_and_counts_are_of_participants_in_the_model(cohort):
    folder = run(cohort, "--formula", "group + education")
    result, people = table(folder / "demographics.tsv"), table(cohort[0] / "participants.tsv")
    assert list(result["variable"].unique()) == ["participants", "age", "sex", "education"]
    for group, part in people.groupby("group"):
        (n,) = rows_of(result, "participants", None, group)["n"]
        assert n == len(part)
        for name in ("age", "education"):
            (row,) = rows_of(result, name, None, group).to_dict("records")
            assert (row["n"], row["missing"]) == (part[name].count(), part[name].isna().sum())
            np.testing.assert_allclose(
                [row["mean"], row["sd"]], [part[name].mean(), part[name].std()]
            )
        for sex, count in part["sex"].value_counts().items():
            (row,) = rows_of(result, "sex", sex, group).to_dict("records")
            assert row["count"] == count
            assert row["percent"] == pytest.approx(100 * count / len(part))
    assert rows_of(result, "age", None, "CN")["missing"].item() == 1
    assert set(files.read_json(folder / "demographics.json")) == set(result)


def test_tests_are_those_of_libraries(cohort):
    folder = run(cohort, "--formula", "group + education")
    result, people = table(folder / "demographics.tsv"), table(cohort[0] / "participants.tsv")
    for name in ("age", "education"):
        parts = [people[name][people["group"] == group].dropna() for group in ("CN", "AD")]
        t, p, df = ttest_ind(*parts, usevar="unequal")
        rows = rows_of(result, name)
        assert set(rows["test"]) == {"t"}
        for column, value in (("statistic", t), ("df", df), ("p", p)):
            np.testing.assert_allclose(rows[column], value)
    counts = pd.crosstab(people["sex"], people["group"])
    assert stats.contingency.expected_freq(counts).min() < 5
    rows = rows_of(result, "sex")
    assert set(rows["test"]) == {"fisher"}
    assert rows["statistic"].isna().all()
    np.testing.assert_allclose(rows["p"], stats.fisher_exact(counts).pvalue)
    text = methods_of(folder)
    tests = "Welch's t test (age, education) and Fisher's exact test (sex)"
    assert f"Demographics of the groups were compared by {tests}." in text
    page = group_page(folder)
    assert 'aria-label="Participants by group"' in page
    assert "1 missing" in page


def test_a_variable_outside_of_the_model_stops_nothing(cohort):
    data, _ = cohort
    rows = [[*row[:2], row[2].replace(".", ","), *row[3:]] for row in read_participants(data)]
    write_participants(data, rows, ("participant_id", "group", "age", "sex", "education"))
    result = table(run(cohort, "--formula", "group") / "demographics.tsv")
    rows = rows_of(result, "age")
    assert (rows["n"].sum(), rows["missing"].sum()) == (0, 30)
    assert rows["p"].isna().all()


def test_without_groups_all_are_described_and_nothing_is_tested(cohort):
    data, _ = cohort
    rows = [[row[0], *row[2:4]] for row in read_participants(data)]
    write_participants(data, rows, ("participant_id", "age", "sex"))
    folder = run(cohort, "--formula", "age")
    result = table(folder / "demographics.tsv")
    assert set(result["group"]) == {"all"}
    assert result[["test", "statistic", "df", "p"]].isna().all(axis=None)
    ages = table(data / "participants.tsv")["age"]
    row = rows_of(result, "age")
    np.testing.assert_allclose([row["n"], row["mean"]], [[29], [ages.mean()]])
    assert rows_of(result, "participants")["n"].item() == 29, "the model needs the age"
    assert "Demographics" not in methods_of(folder)


def test_three_groups_are_tested_by_analysis_of_variance():
    random = np.random.default_rng(0)
    groups = np.repeat(["a", "b", "c"], [8, 12, 10])
    values = random.normal(0, 1, 30) + (groups == "c")
    values[3] = np.nan
    result = rows_of(made(values, groups), "score")
    known = np.isfinite(values)
    expected = anova_oneway(values[known], groups[known], use_var="equal")
    assert set(result["test"]) == {"F"}
    np.testing.assert_allclose(result["statistic"], expected.statistic)
    np.testing.assert_allclose(result["df"], expected.df_denom)
    np.testing.assert_allclose(result["p"], expected.pvalue)


def test_chi_squared_needs_five_expected_in_each_cell():
    groups = np.repeat(["a", "b", "c"], 20)
    values = np.array(["x", "y"] * 20 + ["x"] * 14 + ["y"] * 6)
    for rows in (slice(None), slice(20, None)):  # three groups, and two
        result = rows_of(made(values[rows], groups[rows]), "score")
        counts = pd.crosstab(values[rows], groups[rows])
        expected = stats.chi2_contingency(counts, correction=False)
        assert set(result["test"]) == {"chi2"}
        for column, value in zip(("statistic", "p", "df"), expected, strict=False):
            np.testing.assert_allclose(result[column], value)
    values[[0, 20, 21, 40]] = "z"
    result = rows_of(made(values, groups), "score")
    assert set(result["test"]) == {"fisher"}
    exact = stats.fisher_exact(
        pd.crosstab(values, groups), method=stats.MonteCarloMethod(rng=np.random.default_rng(1))
    )
    np.testing.assert_allclose(result["p"], exact.pvalue, atol=0.02)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("age", [70.0] * 6),
        ("age", [70.0] * 3 + [80.0] * 3),
        ("age", [70.0, 71.0, 72.0, np.nan, np.nan, np.nan]),
        ("age", [70.0, np.nan, np.nan, 71.0, 72.0, 75.0]),
        ("sex", ["F"] * 6),
        ("sex", ["F", "M", "F", None, None, None]),
    ],
)
def test_there_is_no_test_without_two_groups_that_vary(name, values):
    result = made(values, ["a"] * 3 + ["b"] * 3, name)
    assert len(rows_of(result, name))
    assert result["p"].isna().all()


def test_numbers_in_c_are_levels():
    visits = pd.DataFrame(
        {"participant_id": ["sub-1", "sub-2", "sub-3"], "session_id": None, "scale": [1, 2, 2]}
    )
    result = demographics_table(visits, GroupSettings(), ["C(scale)"])
    assert rows_of(result, "scale")["level"].tolist() == ["1", "2"]
    assert rows_of(result, "scale")["count"].tolist() == [1, 2]


@pytest.fixture(scope="module")
def visits(tmp_path_factory):
    """Three yearly sessions of fourteen participants; the first lacks a session."""
    cohort = simulate_cohort(SimulationPlan(sizes=(7, 7), nodes=NODES, effect=0.0), 0)
    data, out = write_sessions(
        tmp_path_factory.mktemp("visits"),
        cohort,
        np.full(14, 0.05),
        noise=0.03,
        column="age",
        times=lambda i, year: f"{60 + i + year}",
        lacking={(0, "2")},
    )
    rows = [[f"sub-{i + 1:02d}", ("CN", "AD")[i % 2], "FM"[i // 2 % 2]] for i in range(14)]
    write_participants(data, rows, ("participant_id", "group", "sex"))
    return data, out


@pytest.mark.parametrize(
    ("options", "groups"),
    [
        *(
            pytest.param(options.split(), 2, marks=needs("repeated"))
            for options in (
                "--longitudinal",
                "--paired 1 3",
                "--endpoint ancova 1 3",
                "--endpoint clda 1 2 3",
            )
        ),
        pytest.param(["--retest"], 1, marks=needs("trials")),
    ],
)
def test_each_participant_counts_once_at_the_baseline(visits, options, groups, monkeypatch):
    data, out = visits
    if options == ["--retest"]:
        monkeypatch.setattr("hipsta_bids.extensions.trials.trial._figures", lambda *_: iter(()))
    fast = [one for one in FAST if "--retest" not in options or one != "--no-classification"]
    assert main([str(data), str(out), "group", *fast, *options, "--name", "q"]) == 0
    result = table(out / "group" / "q" / "demographics.tsv")
    assert set(result["variable"]) == {"participants", "age", "sex"}, "no time, no visit"
    age = rows_of(result, "age")
    ages = 60 + np.arange(14.0)
    ages = ages[1:] if options == ["--retest"] else ages
    expected = [ages[0::2].mean(), ages[1::2].mean()] if groups == 2 else [ages.mean()]
    np.testing.assert_allclose(sorted(age["mean"]), sorted(expected))
    assert age["n"].sum() == len(ages)


@needs("repeated")
def test_the_baseline_of_an_end_point_is_the_one_named(tmp_path):
    """By their names, sessions without times have the baseline last."""
    data, out = begin_dataset(tmp_path)
    random = np.random.default_rng(0)
    cohort = simulate_cohort(SimulationPlan(sizes=(8, 8), nodes=NODES, effect=0.0), 0)
    for i in range(16):
        sessions = ("a12", "base")
        for session in sessions:
            wall = cohort.thickness[i] + 0.1 * random.standard_normal(NODES)
            write_hemisphere(
                place_of(out, f"{i + 1:02d}", "L", session=session),
                np.maximum(wall, 0.1),
                cohort.curvature[i],
            )
        scores = [[f"ses-{one}", f"{i + 50 * (one == 'a12')}"] for one in sessions]
        path = data / f"sub-{i + 1:02d}" / f"sub-{i + 1:02d}_sessions.tsv"
        files.write_tsv(path, ["session_id", "mmse"], scores)
    rows = [[f"sub-{i + 1:02d}", ("active", "placebo")[i % 2]] for i in range(16)]
    write_participants(data, rows, ("participant_id", "arm"))
    folder = run(
        (data, out), "--endpoint", "clda", "base", "a12", "--formula", "arm * visit + mmse"
    )
    result = table(folder / "demographics.tsv")
    assert rows_of(result, "mmse")["mean"].tolist() == [8.0, 7.0]
    assert set(result["group"]) == {"active", "placebo"}
