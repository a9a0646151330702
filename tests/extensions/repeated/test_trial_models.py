"""Models of trials by the command: visits as categories, end points, and one-sided tests."""

import numpy as np
import pandas as pd
import pytest
from extension_marks import needs
from scipy import stats
from small_cohorts import (
    NODES,
    begin_dataset,
    methods_of,
    place_of,
    table,
    write_hemisphere,
    write_participants,
)
from statsmodels.formula.api import ols

from hipsta_bids.cli.main import main
from hipsta_bids.extensions.repeated.mmrm import fit_visits
from hipsta_bids.io import files
from hipsta_bids.reports.group import group_page
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.settings import LongitudinalSettings

SESSIONS = ("base", "m06", "m12")
PEOPLE = 24
#: Placebo loses this much at each visit, mm; the active arm half of it.
LOSS = 0.1
PLAIN = ("--align", "none", "--measures", "thickness", "thickness_mean")


@pytest.fixture(scope="module")
def trial(tmp_path_factory):
    """A trial of two arms whose thickness falls; participant 24 lacks the last visit."""
    data, out = begin_dataset(tmp_path_factory.mktemp("trial"))
    random = np.random.default_rng(7)
    bend = 0.1 + 0.2 * np.exp(-(np.linspace(-2, 2, NODES[0])[:, None] ** 2)) + np.zeros(NODES)
    ages = random.uniform(60, 80, PEOPLE).round(1)
    for i in range(PEOPLE):
        level = {hemi: 0.15 * random.standard_normal() for hemi in "LR"}
        for visit, session in enumerate(SESSIONS):
            if (i, session) == (PEOPLE - 1, "m12"):
                continue
            for hemi in "LR":
                loss = visit * LOSS * (1 if i % 2 else 0.5)
                noise = 0.05 * random.standard_normal() + 0.05 * random.standard_normal(NODES)
                place = place_of(out, f"{i + 1:02d}", hemi, session=session)
                curvature = bend + 0.01 * random.standard_normal(NODES)
                write_hemisphere(place, 1.8 + level[hemi] - loss + noise, curvature)
    arms = ("active", "placebo")
    rows = [[f"sub-{i + 1:02d}", arms[i % 2], f"{ages[i]}"] for i in range(PEOPLE)]
    write_participants(data, rows, ("participant_id", "arm", "age"))
    return data, out


def run(trial, *options, name):
    data, out = trial
    call = [str(data), str(out), "group", *PLAIN, "--name", name, *options]
    assert main(call) == 0
    return out / "group" / name


def values_at(out, node=(11, 4), hemi="L"):
    """Thickness of one node by participant and session."""
    rows = []
    for path in sorted(out.glob(f"sub-*/ses-*/anat/*hemi-{hemi}*sheet_morph.tsv")):
        sheet = pd.read_table(path)
        at = (sheet["x"] == node[0]) & (sheet["y"] == node[1])
        person, session = path.name.split("_")[:2]
        rows.append((person, session.removeprefix("ses-"), float(sheet["thickness"][at].iloc[0])))
    return pd.DataFrame(rows, columns=["participant_id", "visit", "value"])


def point(folder, contrast, node=(11, 4), hemi="L"):
    rows = table(folder / f"hemi-{hemi}_contrast-{contrast}_desc-thickness_statmap.tsv")
    return rows[(rows["node_x"] == node[0]) & (rows["node_y"] == node[1])].iloc[0]


def with_people(trial):
    data, out = trial
    people = pd.read_table(data / "participants.tsv")
    return values_at(out).merge(people, on="participant_id")


def by_visit(trial, *index):
    return with_people(trial).set_index([*index, "visit"])["value"].unstack()  # noqa: PD010 -- no sum


def test_ancova_is_the_regression_on_the_baseline(trial):
    folder = run(trial, "--endpoint", "ancova", "base", "ses-m12", name="ancova")
    wide = by_visit(trial, "participant_id", "arm", "age").reset_index().dropna()
    expected = ols("m12 ~ C(arm, Treatment('placebo')) + age + base", wide).fit()
    row = point(folder, "PlaceboActive")
    name = expected.params.index[1]
    # Tables have five digits.
    near = {"rtol": 1e-4}
    np.testing.assert_allclose(row["estimate"], -expected.params[name], **near)
    np.testing.assert_allclose(row["se"], expected.bse[name], **near)
    np.testing.assert_allclose([row["df"], row["p"]], [19, expected.pvalues[name]], **near)
    text = methods_of(folder)
    assert "A linear model, `arm + age`, was fitted" in text
    assert "The value at ses-base was a covariate at each point (analysis of covariance)" in text
    assert "random" not in text.partition("# References")[0]
    measures = table(folder / "measures.tsv")
    assert (measures["n"] == 23).all()
    assert (measures["df"] == 19).all()
    excluded = table(folder / "excluded.tsv")
    assert (excluded["reason"] == "other-session").all()


def designs(rows):
    """Rows in order, names of visits, and columns of visits and of the active arm."""
    rows = rows.sort_values(["visit", "participant_id"])
    visits = [name for name in SESSIONS if (rows["visit"] == name).any()]
    at = np.column_stack([rows["visit"] == name for name in visits]).astype(float)
    arm = (rows["arm"] == "active").to_numpy(dtype=float)
    return rows, visits, at, arm


@pytest.mark.parametrize("model", ["mmrm", "clda"])
def test_end_points_of_repeated_visits(trial, model):
    """The command is the model on columns that are written out here."""
    folder = run(trial, "--endpoint", model, *SESSIONS, name=model)
    rows = with_people(trial)
    first = rows[rows["visit"] == "base"].set_index("participant_id")["value"]
    if model == "mmrm":
        rows = rows[rows["visit"] != "base"]
    rows, visits, at, arm = designs(rows)
    late = at[:, visits.index("m06") :]
    matrix = np.column_stack([at, late * arm[:, None], rows["age"]])
    people = rows["participant_id"].to_numpy(dtype=np.str_)
    baseline = first.loc[people].to_numpy()[:, None] if model == "mmrm" else None
    contrasts = [
        Contrast(name, -np.eye(matrix.shape[1])[len(visits) + i])
        for i, name in enumerate(("M06", "M12"))
    ]
    expected = fit_visits(
        rows[["value"]].to_numpy(),
        matrix,
        (people, at.argmax(axis=1)),
        contrasts,
        LongitudinalSettings(),
        baseline=baseline,
    )
    for test in expected.tests:
        row = point(folder, f"{test.contrast.name}InPlaceboActive")
        for column in ("estimate", "se", "df", "p"):
            value = np.ravel(getattr(test, column))[0]
            np.testing.assert_allclose(row[column], value, rtol=1e-4, err_msg=column)  # 5 digits
    text = methods_of(folder)
    assert "Visits were categories with an unstructured covariance" in text
    assert "followed Kenward and Roger" in text
    assert "Kenward MG, Roger JH" in text
    assert ("constrained longitudinal data analysis" in text) == (model == "clda")
    assert ("with a slope for each visit" in text) == (model == "mmrm")
    page = group_page(folder)
    assert ("arms are equal at ses-base" in page) == (model == "clda")
    # The true difference at the last visit is the loss of one visit.
    measures = table(folder / "measures.tsv")
    at_end = measures[measures["contrast"] == "m12 in placebo-active"]
    assert (np.abs(at_end["estimate"] + LOSS) < 3 * at_end["se"]).all()
    assert (at_end["p"] < 0.01).all()


def test_visits_as_categories_compare_changes(trial):
    folder = run(trial, "--longitudinal", "visits", name="visits")
    rows = by_visit(trial, "participant_id", "arm")
    change = (rows["m06"] - rows["base"]).reset_index(name="change")
    groups = [change["change"][change["arm"] == arm] for arm in ("placebo", "active")]
    exact = np.mean(groups[0]) - np.mean(groups[1])
    # Nearly all visits are complete, and age differs little between arms.
    row = point(folder, "ChangeToM06InPlaceboActive")
    assert abs(row["estimate"] - exact) < 0.1 * row["se"]
    text = methods_of(folder)
    assert "Visits were categories with an unstructured covariance" in text
    assert "change to m12 in placebo-active" in text


def test_non_inferiority_in_tables_and_text(trial):
    options = ("--endpoint", "clda", "base", "m12", "--formula", "arm * visit + age")
    difference = "(arm[active]-arm[placebo]):visit[m12]"
    contrasts = (f"two = {difference}", f"ni = {difference} > -0.05", f"sup={difference}<.2")
    folder = run(trial, *options, "--contrast", *contrasts, name="noninferior")
    two, above, below = (point(folder, name) for name in ("Two", "Ni", "Sup"))
    assert "alternative" not in two
    assert [above["alternative"], below["alternative"]] == ["> -0.05", "< 0.2"]
    for row, margin, tail in ((above, -0.05, stats.t.sf), (below, 0.2, stats.t.cdf)):
        for name in ("estimate", "se", "df", "cohen_d"):
            assert row[name] == two[name]
        t = (row["estimate"] - margin) / row["se"]
        np.testing.assert_allclose(row["statistic"], t, rtol=1e-3)  # the table's digits
        np.testing.assert_allclose(row["p"], tail(t, row["df"]), rtol=2e-2)
    measures = table(folder / "measures.tsv").set_index("contrast")
    assert measures["alternative"].isna()["two"].all()
    assert (measures["alternative"]["ni"] == "> -0.05").all()
    record = files.read_json(folder / "analysis.json")
    assert record["one_sided"] == {"ni": "> -0.05", "sup": "< 0.2"}
    text = methods_of(folder)
    assert "Tests were one-sided, with this alternative and margin: ni (> -0.05)" in text
    assert "ni (&gt; -0.05)" in group_page(folder)


def test_equivalence_has_two_sides_of_one_difference(trial, capsys):
    """Without names; no point that misses a margin by its own p is significant."""
    difference = "arm[active]-arm[placebo]"
    contrasts = (f"{difference} > -0.05", f"{difference} < 0.05", f"{difference} > 0.08")
    options = ("--endpoint", "ancova", "base", "m12", "--formula", "arm + age", "--contrast")
    folder = run(trial, *options, *contrasts, name="equivalence")
    assert "head size" not in capsys.readouterr().out  # the mean of thickness is none of a size
    maps = table(folder / "maps.tsv")
    assert set(maps["contrast"]) == set(contrasts)
    for name in maps["file"]:
        points = table(folder / f"{name}.tsv")
        assert (points["p_corrected"] >= points["p"] * (1 - 1e-6)).all()
        assert (
            points.loc[points["significant"], "p"].max() <= 0.05 or not points["significant"].any()
        )
    measures = table(folder / "measures.tsv")
    assert (measures["p_fdr"] >= measures["p"] * (1 - 1e-6)).all()


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (["--endpoint", "clda", "base"], 64, "later sessions"),
        (["--endpoint", "lmm", "base", "m12"], 64, "give ancova, mmrm or clda"),
        (["--endpoint", "mmrmm", *SESSIONS], 64, "later sessions; did you mean mmrm?"),
        (["--endpoint", "ancova", *SESSIONS], 64, "use mmrm for several"),
        (["--endpoint", "clda", "base", "m12", "--paired", "base", "m12"], 64, "give one of"),
        (["--endpoint", "clda", "base", "m18"], 65, "no session ses-m18"),
        (["--endpoint", "clda", "base", "m12", "--asymmetry"], 64, "remove --asymmetry"),
        (["--endpoint", "clda", "base", "m12", "--formula", "arm+visit"], 65, "arm * visit"),
        (
            ["--longitudinal", "visits", "--correction", "permutation-max"],
            65,
            "--longitudinal visits: not with --correction by permutation; remove one of them",
        ),
        (
            ["--endpoint", "mmrm", *SESSIONS, "--correction", "permutation-tfce"],
            65,
            "--endpoint: not with --correction by permutation; remove one of them",
        ),
        (
            ["--longitudinal", "visits", "--formula", "arm * visit + map(curvature)"],
            65,
            "not with map() in the formula",
        ),
        (["--contrast", "arm[active]-arm[placebo] > -0.05 > 1"], 65, "one > or <"),
        (["--contrast", "arm[active]-arm[placebo] >= 0"], 65, "one > or <"),
        (["--contrast", "arm, age > 0"], 65, "no direction"),
        (
            ["--contrast", "age > 0", "--correction", "permutation-max"],
            65,
            "one-sided tests are not permuted",
        ),
        (["--contrast", "age > 0.1", "--measures", "curvature"], 65, "a margin has one unit"),
        pytest.param(
            ["--endpoint", "mmrm", *SESSIONS, "--harmonize", "arm"],
            65,
            "--harmonize: not with --endpoint",
            marks=needs("sites"),
        ),
        pytest.param(
            ["--endpoint", "mmrm", "base", "m12", "--retest"],
            64,
            "has no effect with --retest",
            marks=needs("trials"),
        ),
    ],
)
def test_wrong_use_is_one_line(trial, capsys, options, code, words):
    data, out = trial
    if "--contrast" in options:
        options = ["--formula", "arm + age", *options]
    assert main([str(data), str(out), "group", *PLAIN, "--name", "wrong", *options]) == code
    message = capsys.readouterr().err.strip().splitlines()[-1]
    assert words in message
    assert not (out / "group" / "wrong").exists()
