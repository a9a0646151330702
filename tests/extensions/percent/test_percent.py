"""Differences in percent of the reference's mean, against statsmodels, and where there are none."""

import warnings
from dataclasses import replace

import nibabel as nib
import numpy as np
import pytest
import statsmodels.formula.api as smf
from extension_marks import needs
from scipy import stats
from scipy.optimize import brentq
from small_cohorts import FAST, NODES, PLAN, methods_of, place_of, run_named, table, write_dataset
from statsmodels.regression.mixed_linear_model import MixedLM

from hipsta_bids.cli.main import main
from hipsta_bids.extensions.percent.ratio import percent_of
from hipsta_bids.reports.cells import number_text
from hipsta_bids.reports.group import group_page
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.glm import fit_points
from hipsta_bids.stats.settings import GlmSettings

pytestmark = pytest.mark.usefixtures("without_figures")
COLUMNS = ["percent", "percent_low", "percent_high"]
MAP = "hemi-L_contrast-CNAD_desc-thickness_statmap.tsv"
ADDED = ("--percent", *FAST)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("unbalanced"))


def walls(out, people):
    """(participants, points) thickness of the left sheets."""
    paths = [place_of(out, p.removeprefix("sub-"), "L").path("sheet") for p in people]
    return np.array([table(path).thickness for path in paths])


def limits_of(t_of, ratio, df):
    """Find the ratios on both sides of an estimate at which ``t_of`` has the p-value 0.05."""
    edge = stats.t.ppf(0.975, df)
    low = brentq(lambda q: t_of(q) - edge, ratio - 0.9, ratio, xtol=1e-15, rtol=1e-14)
    high = brentq(lambda q: t_of(q) + edge, ratio, ratio + 0.9, xtol=1e-15, rtol=1e-14)
    return low, high


def expect(people, values, formula, age, *, kind="nonrobust", sex=0.5):
    """Percent and limits by statsmodels, by hand from a row of the design for each group's mean."""
    fit = smf.ols(f"y ~ {formula}", people.assign(y=values)).fit(cov_type=kind, use_t=True)
    names = list(fit.params.index)

    def mean(patient):
        row = {"Intercept": 1, "group[T.AD]": patient, "sex[T.M]": sex, "age": age}
        row["group[T.AD]:age"] = patient * age
        return np.array([row[name] for name in names], dtype=float)

    reference, patients = mean(0), mean(1)
    ratio = (patients @ fit.params) / (reference @ fit.params)
    t_of = lambda q: fit.t_test(patients - q * reference).tvalue.item()  # noqa: E731
    return [100 * (q - 1) for q in (ratio, *limits_of(t_of, ratio, fit.df_resid))]


def ordered(people):
    """Participants, with CN as the reference of statsmodels' coding."""
    return people.assign(group=people.group.astype("category").cat.set_categories(["CN", "AD"]))


@pytest.mark.parametrize("case", ["unbalanced", "balanced", "hc3", "missing"])
def test_percent_and_limits_equal_statsmodels(case, tmp_path, dataset):
    options = []
    if case == "balanced":
        dataset = write_dataset(tmp_path, plan=replace(PLAN, sizes=(14, 14)))
    elif case == "missing":
        known = np.random.default_rng(0).random((sum(PLAN.sizes), *NODES)) < 0.85
        dataset = write_dataset(tmp_path, known=known)
    elif case == "hc3":
        (tmp_path / "hc3.toml").write_text('[glm]\ncovariance = "hc3"\n')
        options = ["--settings", str(tmp_path / "hc3.toml")]
    folder = run_named(dataset, *ADDED, *options)
    people = ordered(table(folder / "covariates.tsv"))
    values, written = walls(dataset[1], people.participant_id), table(folder / MAP)
    kind = "HC3" if case == "hc3" else "nonrobust"
    for point in range(3, np.prod(NODES), 29):
        expected = expect(
            people, values[:, point], "group + sex + age", people.age.mean(), kind=kind
        )
        # Ten digits are written.
        np.testing.assert_allclose(written[COLUMNS].loc[point], expected, rtol=1e-8)
    assert (written.percent_low < written.percent).all()
    # Positive estimates are of CN; AD is thinner.
    assert (np.sign(written.estimate) == -np.sign(written.percent)).all()


def test_conditions_signs_and_slopes(dataset):
    contrasts = {
        "man": "group[CN]-group[AD] | sex=M",
        "reversed": "group[AD]-group[CN]",
        "old": "group[CN]-group[AD] | age=80",
        "cell": "group[CN]:sex[F]-group[AD]:sex[F]",
        "half": "0.5*group[CN]-0.5*group[AD]",
        "slope": "group[CN]:age-group[AD]:age",
        "mean": "group[AD]",
    }
    texts = [f"{name}={text}" for name, text in contrasts.items()]
    formula = ["--formula", "group * age + sex", "--contrast", *texts, "--name", "contrasts"]
    assert main([*map(str, dataset), "group", *ADDED, *formula]) == 0
    folder = dataset[1] / "group" / "contrasts"
    people = ordered(table(folder / "covariates.tsv"))
    values = walls(dataset[1], people.participant_id)[:, 20]
    conditions = {"man": (0, 1), "reversed": (0, 0.5), "old": (80, 0.5), "cell": (0, 0)}
    for name, (age, sex) in conditions.items():
        written = table(folder / MAP.replace("CNAD", name.capitalize()))
        expected = expect(people, values, "group * age + sex", age or people.age.mean(), sex=sex)
        np.testing.assert_allclose(written[COLUMNS].loc[20], expected, rtol=1e-8, err_msg=name)
    for name in ("half", "slope", "mean"):
        assert "percent" not in table(folder / MAP.replace("CNAD", name.capitalize()))
    peaks = table(folder / "peaks.tsv").set_index("contrast").percent
    assert set(peaks[peaks.notna()].index) == set(conditions)


def test_a_column_of_the_design_is_not_taken_for_the_mean(dataset):
    """Without an intercept, group[CN] is a column: the mean at age 0."""
    contrast = ["--contrast", "d=group[CN]-group[AD]", "--name", "columns"]
    command = [*map(str, dataset), "group", *ADDED, *contrast, "--formula"]
    assert main([*command, "0 + group + age + sex"]) == 0
    folder = dataset[1] / "group" / "columns"
    people = ordered(table(folder / "covariates.tsv"))
    values, written = (
        walls(dataset[1], people.participant_id),
        table(folder / MAP.replace("CNAD", "D")),
    )
    expected = expect(people, values[:, 20], "group + sex + age", people.age.mean())
    np.testing.assert_allclose(written[COLUMNS].loc[20], expected, rtol=1e-8)
    # A difference at age 0 is none of means at the mean age.
    assert main([*command, "0 + group + group:age + sex"]) == 0
    assert "percent" not in table(folder / MAP.replace("CNAD", "D"))


@pytest.fixture(scope="module")
def results(dataset, quick):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hipsta_bids.group.output.write.draw_figures", lambda *_: iter(()))
        options = ["--percent", "--align", "none", "--no-classification", "--name", "all"]
        assert main([*map(str, dataset), "group", *quick, *options]) == 0
    return dataset[1] / "group" / "all"


def test_peaks_summaries_maps_and_page_have_percent(results):
    written, peaks = table(results / MAP), table(results / "peaks.tsv")
    first = peaks[(peaks.measure == "thickness") & (peaks.hemi == "L")].iloc[0]
    at = written[(written.node_x == first.node_x) & (written.node_y == first.node_y)].iloc[0]
    np.testing.assert_array_equal(first[COLUMNS].astype(float), at[COLUMNS].astype(float))
    assert peaks.percent[peaks.measure == "curvature"].isna().all()
    image = nib.load(
        results / MAP.replace("_desc", "_stat-percent_desc").replace("tsv", "shape.gii")
    )
    np.testing.assert_allclose(image.darrays[0].data, written.percent, rtol=1e-6)
    assert not list(results.glob("*stat-percent_desc-curvature*"))

    people = ordered(table(results / "covariates.tsv"))
    rows = table(results / "measures.tsv").query("measure == 'volume'").set_index("hemi")
    volumes = {
        hemi: [
            table(
                place_of(results.parents[1], p.removeprefix("sub-"), hemi).path("summary")
            ).volume[0]
            for p in people.participant_id
        ]
        for hemi in "LR"
    }
    volumes["LR"] = np.mean([volumes["L"], volumes["R"]], axis=0)
    for hemi, values in volumes.items():
        expected = expect(people, values, "group + sex + age", people.age.mean())
        np.testing.assert_allclose(rows.loc[hemi, COLUMNS].astype(float), expected, rtol=1e-8)
    means = table(results / "measures.tsv").query("measure == 'thickness_mean'")
    assert means.percent.between(-20, 0).all()

    for name in ("peaks.json", "measures.json", MAP.replace("tsv", "json")):
        assert "percent of its adjusted mean" in (results / name).read_text()
    assert "percent of the participants" in (results / "demographics.json").read_text()
    text = methods_of(results)
    assert "95% confidence limits by Fieller's theorem" in text
    assert "Some problems in interval estimation" in text
    percent, low, high = (number_text(value) for value in first[COLUMNS])
    assert f"; {percent} % ({low} to {high})" in group_page(results)


def test_without_the_option_nothing_is_added(dataset):
    folder = run_named(dataset, *FAST)
    assert "percent" not in table(folder / "peaks.tsv")
    assert "percent" not in (folder / "methods.md").read_text()
    assert not list(folder.glob("*stat-percent*"))


def test_limits_are_missing_where_the_reference_may_be_zero():
    random = np.random.default_rng(0)
    patient = np.arange(20) % 2
    matrix = np.column_stack([1 - patient, patient]).astype(float)
    means = np.array([1.0, 0.1, -1.0])  # of CN, in standard errors 10, 1 and -10
    maps = random.standard_normal((20, 3))
    for group in (0, 1):  # exactly: mean of the group, and SD
        rows = maps[patient == group]
        maps[patient == group] = stats.zscore(rows, ddof=1) * np.sqrt(10) / 10 + means * (
            1 - group / 4
        )
    weights = {"CN": [1.0, 0], "AD": [0, 1.0], "CN-AD": [1.0, -1]}
    contrasts = [Contrast(name, np.array(row)) for name, row in weights.items()]
    tests = fit_points(maps, matrix, contrasts, GlmSettings()).tests
    percent, low, high = percent_of(*tests, 0.95).values()
    np.testing.assert_allclose(percent, [-25, -25, np.nan], rtol=1e-10)
    assert np.isfinite(low).tolist() == np.isfinite(high).tolist() == [True, False, False]


@needs("repeated")
@pytest.mark.parametrize("random", ["intercept", "slope"])
def test_mixed_models(sessions, random):
    formula = "group * time + age + sex"
    folder = run_named(sessions, *ADDED, "--longitudinal", random, "--formula", formula)
    visits = ordered(table(folder / "covariates.tsv"))
    written, design = table(folder / MAP), table(folder / "design.tsv").iloc[:, 2:]
    people = visits.participant_id.to_numpy()
    assert list(design.columns[:2]) == ["Intercept", "group[T.AD]"]
    time = visits.time.to_numpy()
    effects = np.column_stack([np.ones(len(time)), time])[:, : 1 + (random == "slope")]
    means = {"sex[T.M]": 0.5, "age": visits.age.mean(), "time": time.mean(), "Intercept": 1.0}
    reference, patients = (
        np.array(
            [
                {**means, "group[T.AD]": g, "group[T.AD]:time": g * time.mean()}[name]
                for name in design.columns
            ]
        )
        for g in (0, 1)
    )
    for point in (5, 60, 120):
        wall = [
            table(place_of(sessions[1], p[4:], "L", session=s[4:]).path("sheet")).thickness[point]
            for p, s in zip(people, visits.session_id, strict=True)
        ]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            fit = MixedLM(np.array(wall), design.to_numpy(), people, exog_re=effects).fit(
                reml=True, method=["powell", "lbfgs"], ftol=1e-12, xtol=1e-10
            )
        spread = effects @ fit.cov_re @ effects.T * (people[:, None] == people)
        spread = spread + fit.scale * np.eye(len(time))
        covariance = np.linalg.inv(design.T @ np.linalg.solve(spread, design))

        def t_of(q, fit=fit, covariance=covariance):
            row = patients - q * reference
            return row @ fit.fe_params / np.sqrt(row @ covariance @ row)

        ratio = (patients @ fit.fe_params) / (reference @ fit.fe_params)
        expected = ratio, *limits_of(t_of, ratio, written.df[point])
        # The accuracy of that optimizer.
        np.testing.assert_allclose(1 + written[COLUMNS].loc[point] / 100, expected, rtol=1e-4)


REFUSAL = "--percent needs groups in the model, and not --paired; remove it"


def test_a_model_without_groups_is_refused(dataset, capsys):
    command = [*map(str, dataset), "group", *ADDED]
    assert main([*command, "--formula", "age", "--contrast", "age"]) == 65
    assert REFUSAL in capsys.readouterr().err


@needs("repeated")
def test_changes_are_refused(sessions, capsys):
    command = [*map(str, sessions), "group", *ADDED]
    assert main([*command, "--paired", "1", "3"]) == 65
    assert REFUSAL in capsys.readouterr().err
