"""Formulas, BIDS Stats Models, contrasts, and impossible designs."""

import json

import numpy as np
import pandas as pd
import pytest
from people_tables import participants
from scipy import stats

from hipsta_bids.errors import ModelError
from hipsta_bids.stats.contrasts import parse_expression
from hipsta_bids.stats.design import build_design
from hipsta_bids.stats.formula import (
    folder_name,
    listed,
    model_from_shortcut,
    parse_model,
)
from hipsta_bids.stats.glm import fit_points
from hipsta_bids.stats.references import choose_reference
from hipsta_bids.stats.settings import DesignSettings, GlmSettings

SETTINGS = DesignSettings()


def design(formula, contrasts=(), table=None, references=None, settings=SETTINGS):
    spec = parse_model(model_from_shortcut(formula, list(contrasts), "test"))
    table = participants() if table is None else table
    return build_design(table, spec, settings, references or {})


def t_of(found, y):
    return fit_points(y[found.rows, None], found.matrix, found.contrasts, GlmSettings()).tests


def test_matrix_of_groups_and_covariates():
    table = participants()
    found = design("thickness ~ group + age + sex", table=table, references={"group": "CU"})
    assert found.columns == ("Intercept", "group[T.DAT]", "group[T.MCI]", "age", "sex[T.M]")
    np.testing.assert_array_equal(found.matrix[:, 1], table["group"] == "DAT")
    np.testing.assert_array_equal(found.matrix[:, 3], table["age"])
    assert dict(found.references) == {"group": "CU", "sex": "F"}
    assert [contrast.name for contrast in found.contrasts] == ["CU-DAT", "CU-MCI", "age", "F-M"]


@pytest.mark.parametrize("reference", ["CU", "MCI", "DAT"])
@pytest.mark.parametrize("formula", ["group + age", "0 + group + age"])
def test_difference_of_levels_does_not_depend_on_coding(formula, reference):
    table = participants()
    y = np.random.default_rng(1).standard_normal(60)
    found = design(formula, ["group[CU]-group[DAT]"], table, {"group": reference})
    (test,) = t_of(found, y)
    dummies = np.column_stack([table["group"] == level for level in ("CU", "MCI", "DAT")])
    matrix = np.column_stack([dummies, table["age"]]).astype(float)
    beta, *_ = np.linalg.lstsq(matrix, y, rcond=None)
    assert test.estimate[0, 0] == pytest.approx(beta[0] - beta[2], rel=1e-9)


def test_difference_under_interaction_is_that_at_the_mean_covariate():
    table = participants()
    y = np.random.default_rng(2).standard_normal(60)
    (test,) = t_of(design("group * age", ["group[CU] - group[MCI]"], table), y)
    centered = table.assign(age=table["age"] - table["age"].mean())
    (expected,) = t_of(design("group * age", ["group[T.MCI]"], centered), y)
    assert test.statistic[0] == pytest.approx(-expected.statistic[0], rel=1e-8)


def test_f_of_all_groups_is_analysis_of_variance():
    table = participants()
    y = np.random.default_rng(3).standard_normal(60)
    found = design("group", ["any=group[CU]-group[MCI], group[CU]-group[DAT]"], table)
    (test,) = t_of(found, y)
    expected = stats.f_oneway(*(y[table["group"] == level] for level in ("CU", "MCI", "DAT")))
    assert test.contrast.name == "any"
    assert test.statistic[0] == pytest.approx(expected.statistic, rel=1e-10)
    assert test.p[0] == pytest.approx(expected.pvalue, rel=1e-10)


def test_incomplete_rows_are_left_out_and_named():
    table = participants()
    table.loc["sub-03", "age"] = np.nan
    table["sex"] = table["sex"].astype(object)
    table.loc[["sub-05", "sub-07"], "sex"] = ["n/a", None]
    found = design("group + age + sex", table=table)
    assert dict(found.dropped) == {"age": ("sub-03",), "sex": ("sub-05", "sub-07")}
    assert len(found.matrix) == len(found.rows) == 57
    assert set(range(60)) - set(found.rows.tolist()) == {3, 5, 7}


def test_text_that_is_numbers_is_numbers():
    table = participants()
    table["age"] = table["age"].astype(str)
    table.loc["sub-09", "age"] = "n/a"
    found = design("group + age", table=table)
    np.testing.assert_array_equal(found.matrix[:, 3], participants().drop("sub-09")["age"])


def test_functions_in_formulas():
    found = design("log(age) + center(age) + sex")
    ages = participants()["age"].to_numpy()
    np.testing.assert_allclose(found.matrix[:, 1], np.log(ages))
    np.testing.assert_allclose(found.matrix[:, 2], ages - ages.mean(), atol=1e-12)


def damaged(**columns):
    table = participants()
    for name, change in columns.items():
        table[name] = change(table[name].astype(object))
    return table


def with_value(value, *rows):
    return lambda column: column.where(~column.index.isin(rows), value)


REFUSALS = {
    "unknown-variable": ("group + aeg", {}, {}, "did you mean age"),
    "not-numeric": ("group + age", {"age": with_value("old", "sub-04")}, {}, "rows sub-04"),
    "group-size": (
        "group",
        {"group": with_value("rare", "sub-04")},
        {},
        r"rare \(1\).*merge levels or remove group",
    ),
    "constant-column": ("group + site", {}, {}, "all 60 complete rows have 'site' one"),
    "unknown-level": ("group", {}, {"group": "HC"}, "no level 'HC'"),
    "design-rank": ("age + I(2 * age) + sex", {}, {}, "is a combination of"),
    "design-missing": ("log(age)", {"age": with_value(0.0, "sub-02")}, {}, "rows sub-02"),
    "formula": ("group + ", {}, {}, "cannot be read"),
}


@pytest.mark.filterwarnings("ignore:divide by zero")
@pytest.mark.parametrize("problem", REFUSALS)
def test_says_what_keeps_a_model_from_being_fitted(problem):
    formula, changes, references, says = REFUSALS[problem]
    with pytest.raises(ModelError, match=says) as caught:
        design(formula, table=damaged(**changes), references=references)
    assert "\n" not in str(caught.value)


def test_more_refusals():
    table = participants()
    with pytest.raises(ModelError, match="'age' is 70 in all 60"):
        design("group + age", table=table.assign(age=70.0))
    with pytest.raises(ModelError, match="no row has all"):
        design("group + age", table=table.assign(age=np.nan))
    with pytest.raises(ModelError, match="6 complete rows are too few for 4 columns"):
        design("group + age", table=table.iloc[:6], settings=SETTINGS.changed(min_level=2))
    with pytest.raises(ModelError, match="did you mean group"):
        design("group + age", ["group[CU]-group[DTA]"])
    with pytest.raises(ModelError, match=r"no factor of the model; its factors: group$"):
        design("group", references={"sex": "F"})
    with pytest.raises(ModelError, match=r"did you mean group\?"):
        design("group", references={"grp": "CN"})


def test_expressions():
    assert parse_expression("group[A] - group[B-2]") == {"group[A]": 1.0, "group[B-2]": -1.0}
    assert parse_expression("0.5*a + 0.5 b-age") == {"a": 0.5, "b": 0.5, "age": -1.0}
    assert parse_expression("-group[T.x]:age") == {"group[T.x]:age": -1.0}
    assert parse_expression("a + a") == {"a": 2.0}
    for text in ("", "a b", "a +", "2", "a * * b"):
        with pytest.raises(ModelError):
            parse_expression(text)


def test_shortcut_writes_the_model_it_stands_for():
    document = json.loads(
        json.dumps(model_from_shortcut("thickness ~ group + age", ["group[CU]-group[DAT]"], "m"))
    )
    assert document["BIDSModelVersion"] == "1.0.0"
    (contrast,) = document["Nodes"][0]["Contrasts"]
    assert contrast["ConditionList"] == ["group[CU]", "group[DAT]"]
    assert contrast["Weights"] == [1.0, -1.0]
    assert parse_model(document).formula == "group + age"


def document(node):
    return {
        "Name": "m",
        "BIDSModelVersion": "1.0.0",
        "Nodes": [{"Level": "Dataset", "Name": "n"} | node],
    }


def test_x_and_names_of_pybids():
    contrasts = [
        {
            "Name": "c",
            "ConditionList": ["group.CU", "group.DAT"],
            "Weights": ["1/2", "-1/2"],
            "Test": "t",
        },
        {
            "Name": "f",
            "ConditionList": ["age", "group.CU", "group.DAT"],
            "Weights": [[1, 0, 0], [0, 1, -1]],
            "Test": "F",
        },
    ]
    node = {"Model": {"Type": "glm", "X": [1, "group", "age"]}, "Contrasts": contrasts}
    spec = parse_model(document(node))
    assert spec.formula == "1 + group + age"
    found = build_design(participants(), spec, SETTINGS, {})
    np.testing.assert_allclose(found.contrasts[0].weights, [[0, -0.5, 0, 0]], atol=1e-12)
    assert found.contrasts[1].n_rows == 2
    without = parse_model(document({"Model": {"X": ["group"]}}))
    assert without.formula == "0 + group"


def test_refuses_models_that_say_something_else():
    glm = {"Model": {"Type": "glm", "X": [1, "age"]}}
    cases = [
        {"Nodes": []},
        document(glm | {"Level": "Run"}),
        document(glm | {"Transformations": {"Instructions": []}}),
        document({"Model": {"Type": "meta", "X": [1]}}),
        document({"Model": {"Type": "glm"}}),
        document({"Model": {"X": [1, "a)+b"]}}),
        document(glm | {"Contrasts": [{"Name": "c", "ConditionList": ["age"], "Test": "z"}]}),
        document(glm | {"Contrasts": [{"Name": "c", "ConditionList": ["a"], "Weights": [1, 2]}]}),
        document(glm | {"Contrasts": [{"Name": "c", "ConditionList": ["a"], "Weights": ["x"]}]}),
        document(glm | {"Contrasts": [{"Name": "c", "ConditionList": ["a"], "Weights": ["1/0"]}]}),
        document(glm | {"Contrasts": [{"Name": "c", "ConditionList": ["a"], "Weights": [np.nan]}]}),
        document(glm | {"Contrasts": [{"Name": "c", "ConditionList": ["a"], "Weights": 1.0}]}),
        document(glm | {"Contrasts": [{"Name": "c", "ConditionList": ["a"], "Weights": [1e308]}]}),
        document(glm | {"Contrasts": [{"Name": "c", "ConditionList": ["a"], "Weights": [1e-320]}]}),
        document(glm | {"Contrasts": [{"Name": "c", "ConditionList": 7}]}),
        document(glm | {"Contrasts": [{"Name": "c", "ConditionList": ["a"]}] * 2}),
        document(glm | {"Contrasts": None}),
    ]
    for case in cases:
        with pytest.raises(ModelError, match=r"^model"):
            parse_model(case)


WORDS = SETTINGS.reference_levels


@pytest.mark.parametrize(
    ("levels", "reference"),
    [
        ("AD|healthy control", "healthy control"),
        ("demented|non-demented", "non-demented"),
        ("demented|nondemented", "nondemented"),
        ("Alzheimer|Gesund", "Gesund"),
        ("Alzheimer|Kontrollgruppe", "Kontrollgruppe"),
        ("patients|témoins", "témoins"),
        ("patients|te\u0301moins", "te\u0301moins"),  # accents as characters of their own
        ("EA|sano", "sano"),
        ("患者|健康对照", "健康对照"),
        ("больной|здоровый", "здоровый"),
        ("abnormal|normal", "normal"),
        ("healthy|not healthy", "healthy"),
        ("AD|Cognitively Normal", "Cognitively Normal"),
        ("impaired|unimpaired", "unimpaired"),
        ("affected|unaffected", "unaffected"),
        ("amyloid negative|amyloid positive", "amyloid negative"),
        ("APOE4+|APOE4-", "APOE4-"),
        ("no|yes", "no"),
        ("drug|none", "none"),
        ("HC_1|MCI_1", "HC_1"),
        ("con demencia|sin demencia", "sin demencia"),
        ("CON|PAT", "CON"),
        ("AD|normal control|normal pressure hydrocephalus", "normal control"),
        ("AD|healthy control|healthy sibling", "healthy control"),
        ("uncontrolled|well-treated control", "well-treated control"),
    ],
)
def test_controls_are_recognized_in_phrases_and_languages(levels, reference):
    for order in (levels.split("|"), levels.split("|")[::-1]):
        chosen = choose_reference(order, WORDS)
        assert (chosen.level, chosen.is_known) == (reference, True)


@pytest.mark.parametrize("levels", ["1|2", "0|1", "AD|MCI", "F|M", "healthy old|healthy young"])
def test_what_names_do_not_decide_is_the_first_in_order_and_is_no_knowledge(levels):
    chosen = choose_reference(levels.split("|"), WORDS)
    assert (chosen.level, chosen.is_known) == (levels.split("|")[0], False)


def test_slopes_and_levels_without_a_control_are_named_with_their_factor():
    table = pd.DataFrame({"dose": ["2", "1"] * 10, "age": np.arange(20.0)})
    spec = parse_model(model_from_shortcut("C(dose) * age", [], "m"))
    found = build_design(table, spec, SETTINGS, {})
    assert [one.name for one in found.contrasts] == ["dose 1-2", "age", "dose 1-2:age"]
    assert "dose 1 (first in order); change with --reference" in found.notes["references"]


def test_different_models_have_different_folders():
    formulas = (
        "group + age",
        "group * age",
        "group:age",
        "group + age - 1",
        "~ group + log(age)",
    )
    assert len({folder_name(formula) for formula in formulas}) == len(formulas)
    assert folder_name("thickness ~ group + age") == "group-age"
    assert folder_name("`âge` * 女") == "age-x-u5973"  # as --name has it


def test_long_lists_are_cut_in_messages():
    assert listed(range(8)) == "0, 1, 2, 3, 4, 5, 6, 7"
    assert listed(range(11)) == "0, 1, 2, 3, 4, 5, 6, 7 and 3 more"


def test_numbers_in_brackets_of_c_are_levels():
    table = participants().assign(dose=[str(k % 4 * 5) for k in range(60)])
    found = design("group + C(dose)", ["dose[0]-dose[10]"], table)
    assert found.columns[3:] == ("C(dose)[T.5]", "C(dose)[T.10]", "C(dose)[T.15]")
    assert set(found.notes) == {"references"}
    assert list(design("group + dose", table=table).notes) == ["dose", "references"]


def test_random_intercepts_are_refused_where_nothing_fits_them():
    """As without the extension that fits them."""
    with pytest.raises(
        ModelError, match=r"\(1\|sex\) cannot be fitted here; remove it, or write sex"
    ):
        design("group + (1|sex)")


def test_rows_without_a_level_of_a_random_intercept_are_left_out():
    table = participants().assign(site=lambda table: np.arange(len(table)) % 4)
    table["site"] = table["site"].astype(object)
    table.loc[table.index[2], "site"] = None
    spec = parse_model(model_from_shortcut("group + (1|site)", [], "test"))
    found = build_design(table, spec, SETTINGS, {}, has_random=True)
    assert spec.text == "group + (1|site)"
    assert found.columns == ("Intercept", "group[T.DAT]", "group[T.MCI]")
    assert dict(found.dropped) == {"site": (table.index[2],)}
    assert found.random.tolist() == [str(i % 4) for i in range(len(table)) if i != 2]
