"""Contrasts of levels, terms and slopes against estimated marginal means of statsmodels' fits."""

import itertools

import numpy as np
import pandas as pd
import pytest
import statsmodels.api as sm
import statsmodels.formula.api as smf

from hipsta_bids.errors import ModelError
from hipsta_bids.stats.design import build_design
from hipsta_bids.stats.formula import model_from_shortcut, parse_model
from hipsta_bids.stats.glm import fit_points
from hipsta_bids.stats.settings import DesignSettings, GlmSettings

LEVELS = {"group": ["CN", "MCI", "AD"], "sex": ["F", "M"], "site": ["a", "b", "c", "d"]}
DESIGNS = [
    "group",
    "group + age",
    "group + age + sex",
    "group * age",
    "group * sex",
    "group * sex + age",
    "group * age + sex",
    "group * age + site",
    "group * sex * age",
    "group * sex + site * age",
    "group + sex + site",
    "group * site",
    "group + carrier",
    "group * carrier",
    "group * carrier + age",
    "group + I(age ** 2) + age",
    "group * (age + sex + site)",
    "group:sex + group + sex",
    "group + age:sex + age + sex",
    "group * sex + carrier * age",
]


def people(n=150, seed=4):
    """An unbalanced cohort: cells differ in size, and age with group."""
    random = np.random.default_rng(seed)
    table = pd.DataFrame(
        {name: random.choice(levels, n, p=unequal(len(levels))) for name, levels in LEVELS.items()}
    )
    table["carrier"] = random.choice([0.0, 1.0], n, p=[0.7, 0.3])
    older = table["group"].map({"CN": 0.0, "MCI": 3.0, "AD": 5.0})
    table["age"] = (random.normal(70, 7, n) + older).round(1)
    table["y"] = random.standard_normal(n) + (table["group"] == "AD") * (table["age"] - 70) / 9
    return table.set_index(pd.Index([f"sub-{i:03d}" for i in range(n)]))


def unequal(n):
    weights = np.arange(1, n + 1)[::-1] + 0.5
    return weights / weights.sum()


def estimate(formula, *contrasts):
    """Test contrasts in one design; by name."""
    table = people()
    spec = parse_model(model_from_shortcut(formula, list(contrasts), "test"))
    references = {"group": "CN"} if "group" in formula else {}
    design = build_design(table, spec, DesignSettings(), references)
    y = table["y"].to_numpy()[design.rows, None]
    tests = fit_points(y, design.matrix, design.contrasts, GlmSettings()).tests
    return {test.contrast.name: test for test in tests}


def marginal_mean(fit, table, fixed, names):
    """Average statsmodels' rows of an expanded grid: weights of its own coefficients."""
    axes = {}
    for name in names:
        distinct = np.unique(table[name]) if name == "carrier" else None
        axes[name] = LEVELS.get(name) or ([table[name].mean()] if distinct is None else distinct)
        axes[name] = [fixed[name]] if name in fixed else axes[name]
    grid = pd.DataFrame(list(itertools.product(*axes.values())), columns=list(axes))
    units = np.eye(len(fit.params))
    return np.array([type(fit._results)(fit.model, unit).predict(grid).mean() for unit in units])


@pytest.mark.slow
@pytest.mark.parametrize("formula", DESIGNS)
def test_differences_of_levels_are_those_of_marginal_means(formula):
    table = people()
    fit = smf.ols(f"y ~ {formula}", table).fit()
    names = [name for name in [*LEVELS, "carrier", "age"] if name in formula]
    left, right = (marginal_mean(fit, table, {"group": level}, names) for level in ("CN", "AD"))
    expected = fit.t_test(np.asarray(left - right)[None])
    found = estimate(formula, "d = group[CN] - group[AD]", "m = group[MCI]")
    np.testing.assert_allclose(found["d"].estimate, expected.effect[None], rtol=1e-8)
    np.testing.assert_allclose(found["d"].statistic, expected.tvalue[0], rtol=1e-8)
    mean = fit.t_test(marginal_mean(fit, table, {"group": "MCI"}, names)[None])
    np.testing.assert_allclose(found["m"].estimate, mean.effect[None], rtol=1e-8)
    np.testing.assert_allclose(found["m"].se.item(), mean.sd.item(), rtol=1e-8)


@pytest.mark.parametrize(
    ("formula", "coded"),
    [
        ("group * sex + age", "C(group, Sum) * C(sex, Sum) + old"),
        ("group * age + sex", "C(group, Sum) * old + C(sex, Sum)"),
        ("group * sex * age", "C(group, Sum) * C(sex, Sum) * old"),
        ("group * site", "C(group, Sum) * C(site, Sum)"),
    ],
)
def test_terms_are_tested_as_by_type_iii_sums_of_squares(formula, coded):
    """With sums to zero and centered numbers, type III tests are those of marginal means."""
    table = people().assign(old=lambda t: t["age"] - t["age"].mean())
    anova = sm.stats.anova_lm(smf.ols(f"y ~ {coded}", table).fit(), typ=3)
    names = {
        row: row.replace("C(", "").replace(", Sum)", "").replace("old", "age")
        for row in anova.index.drop(["Intercept", "Residual"])
    }
    # A number is a column by itself, whose name stands for the slope in the references.
    terms = [name for name in names.values() if name != "age"]
    found = estimate(formula, *terms)
    for row, name in names.items():
        if name == "age":
            continue
        statistic = found[name].statistic[0] ** (2 if found[name].contrast.n_rows == 1 else 1)
        assert statistic == pytest.approx(anova["F"][row], rel=1e-8), name
        assert found[name].p[0] == pytest.approx(anova["PR(>F)"][row], rel=1e-7, abs=1e-300)


@pytest.mark.slow
def test_cells_and_conditions():
    table = people()
    fit = smf.ols("y ~ group * sex * age", table).fit()
    names = ["group", "sex", "age"]

    def cell(group, sex, age):
        return marginal_mean(fit, table, {"group": group, "sex": sex, "age": age}, names)

    ages = (60.0, 61.0, table["age"].mean())
    keys = list(itertools.product(("CN", "MCI", "AD"), "FM", ages))
    cells = {key: cell(*key) for key in keys}
    middle = table["age"].mean()
    cases = {
        "group[AD]:sex[M]": cells["AD", "M", middle],
        "(group[CN] - group[AD]):sex[M]": cells["CN", "M", middle] - cells["AD", "M", middle],
        "group[CN]-group[AD] | sex=M, age=60": cells["CN", "M", 60.0] - cells["AD", "M", 60.0],
        "a = group[AD]:age | sex=F": cells["AD", "F", 61.0] - cells["AD", "F", 60.0],
        "(group[CN] - group[AD]):(sex[F] - sex[M])": cells["CN", "F", middle]
        - cells["CN", "M", middle]
        - cells["AD", "F", middle]
        + cells["AD", "M", middle],
        "(group[CN]:sex[F] + group[CN]:sex[M])/2": (
            cells["CN", "F", middle] + cells["CN", "M", middle]
        )
        / 2,
        "sex | group=AD": cells["AD", "F", middle] - cells["AD", "M", middle],
    }
    found = estimate("group * sex * age", *cases)
    for (text, weights), test in zip(cases.items(), found.values(), strict=True):
        expected = fit.t_test(np.asarray(weights)[None])
        assert test.estimate[0, 0] == pytest.approx(expected.effect.item(), rel=1e-8), text
        assert test.statistic[0] == pytest.approx(expected.tvalue.item(), rel=1e-8), text
    simple = estimate("group * sex * age", "group | sex=M")["group | sex=M"]
    rows = [cells[group, "M", middle] - cells["CN", "M", middle] for group in ("AD", "MCI")]
    assert simple.statistic[0] == pytest.approx(fit.f_test(np.vstack(rows)).fvalue, rel=1e-8)


def test_bent_terms_are_tested_whole():
    table = people()
    full = smf.ols("y ~ group * (age + I(age ** 2))", table).fit()
    reduced = smf.ols("y ~ group + age + I(age ** 2)", table).fit()
    f, p, df = full.compare_f_test(reduced)
    test = estimate("group * poly(age, 2)", "group:age")["group:age"]
    assert test.contrast.n_rows == df == 4
    assert test.statistic[0] == pytest.approx(f, rel=1e-7)
    assert test.p[0] == pytest.approx(p, rel=1e-7)


@pytest.mark.parametrize(
    ("contrast", "said"),
    [
        ("group:age", "the formula has no group:age"),
        ("group[AD]:sex | sex=M", "compares and fixes sex"),
        ("group[AD]:group[CN]", "fixes group twice"),
        ("group[AD] | sex=X", "sex has no level 'X', only F, M"),
        ("group[AD] | age=old", "age is a number, not 'old'"),
        ("group[AD] | wrong=1", "nothing is called 'wrong'"),
        ("CN-AD", r"nothing is called 'CN'; write group\[CN\]"),
        ("group[AD] | sex", r"write fixed values as \| sex=M, age=70"),
        ("group - sex", "group has several rows; test it by itself"),
        ("group[AD] - (group[CN]", "cannot read"),
        ("group[AD])", "cannot read"),
        ("group[AD]/0", "cannot read"),
        ("(" * 30 + "age" + ")" * 30, "cannot read"),
        ("(a+b)" + ":(a+b+c+d+e+f+g+h+i)" * 9, "cannot read"),
    ],
)
def test_contrasts_without_sense_are_refused_in_one_line(contrast, said):
    with pytest.raises(ModelError, match=said) as caught:
        estimate("group + sex + age", contrast)
    assert "\n" not in str(caught.value)


def weights_of(formula, *contrasts):
    """Weights other than zero by column, of contrasts or, without these, of columns."""
    spec = parse_model(model_from_shortcut(formula, list(contrasts), "m"))
    table = people().assign(part=np.resize(["F", "M"], 150))
    design = build_design(table, spec, DesignSettings(), {})
    names = [*design.columns, "map(c)", "map(d)"]
    return {
        c.name: {names[i]: c.weights[0, i] for i in np.flatnonzero(c.weights[0])}
        for c in design.contrasts
    }


@pytest.mark.parametrize(
    ("formula", "names"),
    [
        ("group + sex", ["CN-AD", "CN-MCI", "F-M"]),
        ("sex + part", ["F-M", "part F-M"]),
        ("C(carrier) * age", ["carrier 0-1", "age", "carrier 0-1:age"]),
        ("sex * part", ["F-M", "part F-M", "sex[T.M]:part[T.M]"]),
        ("0 + sex", ["sex[F]", "sex[M]"]),
        ("age * carrier + map(c)", ["age", "carrier", "age:carrier", "map(c)"]),
        ("sex + sex:age:carrier", ["F-M", "sex[F]:age:carrier", "sex[M]:age:carrier"]),
        ("poly(age, 2)", ["poly(age, 2)[1]", "poly(age, 2)[2]"]),
    ],
)
def test_columns_are_tested_by_names_that_say_what_they_are(formula, names):
    assert list(weights_of(formula)) == names


def test_weights_of_slopes_and_maps():
    assert weights_of("sex * age")["F-M:age"] == {"sex[T.M]:age": pytest.approx(-1)}
    both = weights_of("sex + map(c) + map(d)", "x = sex[F] - 3*map(d)", "m = 4*map(c)")
    assert both == {"x": {"Intercept": 1, "map(d)": -3}, "m": {"map(c)": 4}}


def test_bends_are_tested_apart_from_the_line():
    """The one row of a parabola has the coefficient of the square; others are an F of the rest."""
    table = people()
    square = np.polyfit(table["age"], table["y"], 2)[0]
    for formula in ("age + I(age ** 2)", "poly(age, 2)"):
        bend = estimate(formula, "nonlinear(age)")["nonlinear(age)"]
        assert bend.estimate[0, 0] == pytest.approx(square, rel=1e-6)
    splines = "cr(age, df=4, constraints='center') + sex"
    test = estimate(splines, "nonlinear(age)")["nonlinear(age)"]
    reduced = smf.ols("y ~ age + sex", table).fit()
    f, _, df = smf.ols(f"y ~ {splines}", table).fit().compare_f_test(reduced)
    assert (test.contrast.n_rows, test.statistic[0]) == (df, pytest.approx(f, rel=1e-6))
    for formula, contrast, text in (
        ("age + sex", "nonlinear(age)", "is in the formula as a line at most"),
        ("group", "nonlinear(group)", "is in the formula as a line at most"),
        ("I(age ** 2) + I(age ** 3)", "nonlinear(age)", "no line of 'age' is in the formula"),
        ("poly(age, 2) * sex", "age | sex=M", "age is no line, so that it has no slope"),
        ("sex + log(age)", "sex | age=0", "the formula has no value there"),
        ("sex + age", "sex | age=inf", "age is a number, not 'inf'"),
        ("sex + age", "nonlinear(age) - age", "nothing is called 'nonlinear"),
    ):
        with pytest.raises(ModelError, match=text):
            estimate(formula, contrast)
