"""Limits of what tables, formulas and contrasts may hold: values on both sides of each."""

import numpy as np
import pandas as pd
import pytest

from hipsta_bids.errors import ModelError
from hipsta_bids.stats.contrasts import contrast_json, parse_contrast, parse_expression, split_name
from hipsta_bids.stats.design import build_design
from hipsta_bids.stats.formula import (
    cells,
    check_left,
    check_names,
    check_numbers,
    check_spelling,
    coding_note,
    columns_of,
    declared_levels,
    file_label,
    folder_name,
    in_order,
    interactions,
    left_side,
    listed,
    model_from_shortcut,
    parse_model,
    split_maps,
    typed,
    with_factors,
)
from hipsta_bids.stats.settings import DefaultModelSettings, DesignSettings

ROWS = 60


def design(formula, settings=None, **columns):
    """Ages of 50 to 79.5, three groups, and further columns."""
    ages = 50 + np.arange(ROWS) * 17 % ROWS / 2
    table = pd.DataFrame({"age": ages, "group": np.resize(["A", "B", "C"], ROWS)})
    table = table.assign(**columns).set_index(pd.Index([f"sub-{i:02d}" for i in range(ROWS)]))
    spec = parse_model(model_from_shortcut(formula, [], "m"))
    return build_design(table, spec, settings or DesignSettings(), {})


def says(text):
    """Return a context that wants this text in the message of a refusal."""
    return pytest.raises(ModelError, match=text)


def put(value, *rows, scale=1.0, first=50.0):
    """Values from the first one on, in steps of a scale, with some replaced."""
    values = first + scale * np.arange(ROWS)
    values[list(rows)] = value
    return values


@pytest.mark.parametrize(
    ("name", "values", "refused"),
    [
        ("age", put(-0.5, 3), "sub-03 (-0.5)"),
        ("age", put(0, 3), ""),
        ("age", put(130, 3, 4), ""),
        ("age", put(130.5, 4), "sub-04 (130.5)"),
        ("age", put(600, 3, first=500.0), ""),  # months
        ("age", np.repeat([120.0, 130.0, 140.0], [10, 49, 1]), "sub-59 (140)"),
        ("age", np.repeat([120.0, 131.0, 140.0], [10, 49, 1]), ""),  # months
        ("age_first", put(-2, 7), "sub-07 (-2)"),
        ("age", put(-3, 3, first=-30.0), ""),  # differences from a mean
        ("icv", put(0, 5, first=1400.0), "sub-05 (0)"),
        ("icv", put(-3, 5, first=1400.0), "sub-05 (-3)"),
        ("icv", put(0, 3, first=-30.0), ""),
        ("icv", np.repeat([0.0, 1.0], ROWS // 2) * np.arange(ROWS), ""),  # quartile of 0
        ("height", put(0, 3), ""),
    ],
)
def test_impossible_ages_and_heads_are_refused_with_their_rows(name, values, refused):
    if not refused:
        assert design(name, **{name: values}).columns[1] == name
        return
    with says("which is impossible") as caught:
        design(name, **{name: values})
    assert f"column '{name}' has {refused}, which" in str(caught.value)


def test_heads_in_two_units_are_refused():
    one_unit = put(20.0, 0, first=100.0, scale=10.0)
    assert len(design("icv", icv=np.where(one_unit > 600, 1000.0, one_unit)).rows) == ROWS
    with says(r"'icv' has 58 values to 1570, 2 from 1.5e\+06 .*: sub-03 \(1.5e\+06\), sub-09"):
        design("icv", icv=put(1.5e6, 3, 9, first=980.0, scale=10.0))
    with says(r"'icv' has 1 values to 20, 59 from 1010 .*use one unit: sub-00 \(20\)"):
        design("icv", icv=put(20.0, 0, first=1000.0, scale=10.0))
    exact = np.where(np.arange(ROWS) < 30, 20.0, 1000.0)  # 50 times as large
    assert len(design("icv", icv=exact).rows) == ROWS


def test_doubts_are_noted_from_their_limits_on():
    random = np.random.default_rng(0)
    six = {f"x{i}": random.standard_normal(ROWS) for i in range(7)}
    assert "columns" not in design(" + ".join(list(six)[:6]), **six).notes
    notes = design(" + ".join(six), **six).notes
    assert notes["columns"].startswith(
        "the model has 7 columns for 60 participants; use one per 10"
    )
    people = np.repeat([f"p{i}" for i in range(20)], 3)
    assert (
        "20 participants" in design("x0 + x1 + x2", participant_id=people, **six).notes["columns"]
    )
    close = {"x": six["x0"], "y": -six["x0"] + 0.02 * six["x1"], "z": six["x0"] + 0.2 * six["x2"]}
    notes = design("x + y + z", **close).notes
    assert "x and y are nearly the same (r = -0.9998)" in notes["x, y"]
    assert not {"x, z", "y, z"} & set(notes)


def test_designs_that_cannot_be_fitted_are_named():
    five = {f"x{i}": np.random.default_rng(i).standard_normal(ROWS) for i in range(57)}
    names = list(five)
    assert design(" + ".join(names[:56]), **five).matrix.shape == (60, 57)  # 3 are left
    with says("60 complete rows are too few for 58 columns; at least 61 are needed"):
        design(" + ".join(names), **five)
    with says(r"no row has 'I\(0 \* age\)'; remove it"):
        design("I(0 * age)")
    with says(r"column 'I\(2 \* age\)' is a combination of age; remove"):
        design("x0 + age + I(2 * age)", **five)
    found = design("group + C(site)", site=np.resize([1, 2], ROWS))
    assert found.min_level == 3
    assert found.members.sum(axis=0).tolist() == [20, 20, 20, 30, 30]
    assert found.members[4].tolist() == [False, True, False, True, False]


def refused_numbers(values, **settings):
    try:
        check_numbers(pd.Series(np.array(values, float), name="x"), DesignSettings(**settings))
    except ModelError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(
    ("values", "settings", "part"),
    [
        ([0, 5, 10, 20], {"missing_codes": (20,)}, ""),  # as far as the range
        ([0, 5, 10, 20.5], {"missing_codes": (20.5,)}, "x has 3 (20.5), other values are 0 to 10"),
        ([0, 5, 10, -10], {"missing_codes": (-10,)}, ""),
        ([3, 8, 11, -6], {"missing_codes": (-6,)}, "x has 3 (-6), other values are 3 to 11"),
        ([-9, -9, -9], {}, ""),
        ([1, 2, 3, 0, 12], {"farthest": 5}, ""),  # quartiles 1 to 3
        ([1, 2, 3, 0, 12.5], {"farthest": 5}, "x has 4 (12.5), half of the others 1 to 3"),
        ([1, 2, 3, 4, -8.5], {"farthest": 5}, "x has 4 (-8.5), half of the others 1 to 3"),
        ([1, 1, 1, 1, 9], {"farthest": 5}, ""),
        ([5, 6, 7, 8, 9, -1, -4, -1], {}, "x has -4 (1), -1 (2), other values are from 5;"),
        ([1, 1, 2, 3, 9, -1], {}, ""),  # as far as the middle half is wide
        ([1.1, 1.1, 2, 3, 9, -1], {}, "x has -1 (1)"),
        ([0, 5, 5, 5, 5, -1], {}, ""),
        ([-1, -1, -4], {}, ""),
        ([2, 3, np.nan], {}, ""),
        ([np.nan], {}, ""),
    ],
)
def test_codes_and_far_values_are_refused_beyond_their_limits(values, settings, part):
    text = refused_numbers(values, **settings).replace("'", "")
    assert part in text
    assert bool(part) == bool(text)


@pytest.mark.parametrize(
    ("cells_of", "expected"),
    [
        (["1", " 2 ", "\u22123", "n/a", ""], [1, 2, -3, np.nan, np.nan]),
        (["9e99", "1"], [9e99, 1]),
        ([True, False], ["yes", "no"]),
        ([1, np.inf], [1, np.nan]),
        (["1", "a"], ["1", "a"]),  # half are numbers
        (["1,5", "a"], ["1,5", "a"]),
        (["2020-1-1", "a"], ["2020-1-1", "a"]),
        (["1e100", "1"], "too large for rows 0"),
        (["1", "2", "a"], r"holds numbers but for rows 2 \('a'\)"),
        (["1,5", "2,5", "a"], r"holds decimal commas, as 0 \('1,5'\)"),
        (["2020-1-1", "3.4.21", "a"], r"holds dates, as 0 \('2020-1-1'\)"),
    ],
)
def test_cells_are_numbers_or_names(cells_of, expected):
    values = pd.Series(cells_of, name="x")
    if isinstance(expected, str):
        with says(expected):
            typed(values)
    else:
        found = typed(values)
        assert found.isna().tolist() == pd.Series(expected).isna().tolist()
        assert found.dropna().tolist() == pd.Series(expected).dropna().tolist()


def test_words_about_values():
    notes = [coding_note(pd.Series(np.arange(20) % n, name="x")) for n in (2, 3, 5, 6)]
    assert [note is None for note in notes] == [True, False, False, True]
    assert "x has 3 values (0, 1, 2), fitted as a line" in notes[1]
    assert cells(pd.Series([1.5, "b"], index=["r", "s"])) == "r (1.5), s ('b')"
    assert listed(range(9), 8) == "0, 1, 2, 3, 4, 5, 6, 7 and 1 more"
    assert sorted(["b", "10", "9", "a"], key=in_order) == ["9", "10", "a", "b"]
    check_spelling({"AD": 2, "A D E": 3}, "group")
    check_spelling({"F": 2, "M": 3}, "sex")
    with says(r"'group' differ in capitals or blanks only: 'A D' \(3\), 'ad' \(2\)"):
        check_spelling({"ad": 2, "A D": 3}, "group")
    with says("'Gender' are several spellings"):
        check_spelling({"F": 2, "female": 3}, "Gender")
    ordered = pd.Series(pd.Categorical(["b", "a"], ["b", "a"], ordered=True))
    assert declared_levels(ordered) == ["b", "a"]
    assert declared_levels(ordered.astype(str)) == declared_levels(ordered.cat.as_unordered()) == []
    with says(r"no row has all variables; missing are age \(2\)$"):
        check_left(pd.DataFrame(), {"age": ("a", "b")})
    with says("no row has all variables$"):
        check_left(pd.DataFrame(), {})
    with says("no column 'sit'; did you mean site"):
        check_names(["site", "sit"], pd.Index(["site", "age"]))


def test_levels_are_refused_with_their_numbers():
    groups = np.repeat(["A", "B", "C"], [57, 3, 0])
    assert design("group", group=groups).references == {"group": "A"}
    with says(r"too few complete rows in 'group': B \(3\); at least 4"):
        design("group", DesignSettings(min_level=4), group=groups)
    with says(r"'group' has -9 \(3\) among words"):
        design("group", group=np.where(groups == "B", "-9", "A"))
    assert design("C(dose)", dose=np.resize([1, 99], ROWS)).levels == {"dose": ["1", "99"]}
    table = pd.DataFrame({"Site": [1.0, 2.0], "age": [3, 4], "sex": pd.Categorical([1, 2])})
    made = with_factors(table, DesignSettings(), DefaultModelSettings())
    assert [made[name].tolist() for name in made] == [["1", "2"], [3, 4], [1, 2]]


def test_columns_of_given_levels():
    table = pd.DataFrame(
        {"g": ["b", "a", None, "b"], "x": [1.0, 2.0, 3.0, np.nan], "t": list("abcd")}
    )
    matrix, names, rows = columns_of(table, "g * x", {"g": ["a", "b", "c"]}, "file: ")
    assert names == ("g[T.b]", "g[T.c]", "x", "g[T.b]:x", "g[T.c]:x")
    assert rows.tolist() == [0, 1]
    assert matrix.tolist() == [[1, 0, 1, 1, 0], [0, 0, 2, 0, 0]]
    assert columns_of(table, "1", {}, "")[0].shape == (4, 0)
    with says("file: has no 'g' b, only a; exclude"):
        columns_of(table, "g", {"g": ["a"]}, "file: ")
    with says("file: t should be numbers"):
        columns_of(table, "t + x", {}, "file: ")


def test_parts_of_formulas():
    assert split_maps("y ~ group + map(curvature) + map( gyri )") == (
        "group",
        ("curvature", "gyri"),
    )
    assert split_maps("map(x)") == ("1", ("x",))
    for text in ("group * map(x)", "group:map(x)"):
        with says("add map"):
            split_maps(text)
    assert left_side("thickness + curvature + thickness ~ 1") == ("thickness", "curvature")
    assert left_side("age") == left_side(" ~ age") == ()
    for text in ("a ~ b ~ c", "2a ~ b", "a + ~ b"):
        with says("names of measures"):
            left_side(text)
    assert file_label("b-a > -0.05 | sex=M") == "BAAboveMinus005SexM"
    assert file_label("b < 1") == "BBelow1"
    assert file_label("g[A+]-\u5973") == "GAPlusU5973"
    assert folder_name("a - 1", ("x", "y")) == "x-y_a-without-1"
    assert interactions("y ~ group * age + `my sex`:age + age:group") == [
        *("group:age", "my sex:age = `my sex`:`age`")
    ]
    assert interactions("age **") == []


NODE = {"Level": "Dataset", "Model": {"X": [1, "age"]}}


@pytest.mark.parametrize(
    ("node", "text"),
    [
        ({"Level": "Subject"}, "level 'Subject'"),
        ({"Transformations": ["x"]}, "transformations"),
        ({"Model": "glm"}, "Model of Type glm"),
        ({"Model": {"Type": "meta", "X": [1]}}, "Model of Type glm"),
        ({"Model": {"X": []}}, "Model.X or Model.Formula"),
        ({"Model": {"X": "age"}}, "Model.X or Model.Formula"),
        ({"Contrasts": [{"Name": n, "ConditionList": ["a"]} for n in "xyx"]}, "same name: x "),
        (
            {"Contrasts": [{"Name": n, "ConditionList": ["a"]} for n in ("a:b", "a.b", "c")]},
            "one name: a:b, a.b; give",
        ),
        ({"Contrasts": [{"ConditionList": ["a"]}]}, "contrast without a name"),
        ({"Contrasts": ["a"]}, "contrast without a name"),
        ({"Contrasts": [{"Name": "x"}]}, "'x' with 0 conditions"),
        (
            {"Contrasts": [{"Name": "x", "ConditionList": ["a"], "Weights": [[1], [2]]}]},
            "must be F",
        ),
        (
            {"Contrasts": [{"Name": "x", "ConditionList": ["a"], "Weights": [1.1e9]}]},
            "without lists of names and numbers",
        ),
        (
            {"Contrasts": [{"Name": "x", "ConditionList": ["a"], "Weights": ["1e-9/2"]}]},
            "without lists of names and numbers",
        ),
        (
            {"Contrasts": [{"Name": "x", "ConditionList": ["a"], "Margin": 1e9}]},
            "alternative '' and margin",
        ),
        (
            {"Contrasts": [{"Name": "x", "ConditionList": ["a"], "Margin": -1e9}]},
            "alternative '' and margin",
        ),
    ],
)
def test_model_files_are_refused_with_the_problem(node, text):
    with says(text):
        parse_model({"Nodes": [NODE | node]})
    for nodes in ([NODE, NODE], [], {}, ["x"]):
        with says("exactly one node"):
            parse_model({"Nodes": nodes})


def test_weights_of_contrasts_in_files():
    contrast = {"Name": "x", "ConditionList": ["a", "b", "c"], "Weights": ["-1/4", 1e9, 1e-9]}
    assert parse_contrast(contrast).weights == ((-0.25, 1e9, 1e-9),)
    spec = parse_contrast({"Name": "x", "ConditionList": ["a", "b"], "Weights": [0, 1]})
    assert (spec.weights, spec.side, spec.margin) == (((0.0, 1.0),), "", 0.0)
    found = parse_model({"Name": "doc", "Nodes": [NODE | {"DummyContrasts": {"Test": "F"}}]})
    assert (found.name, found.formula, found.dummy) == ("doc", "1 + age", "F")
    assert parse_model({"Nodes": [NODE]}).dummy is None
    both = contrast_json("f = a - b, 2*a")
    assert (both["Name"], both["Test"]) == ("f", "F")
    assert both["Weights"] == [[1, -1], [2, 0]]
    assert contrast_json("a=b")["ConditionList"] == ["b"]


def test_combinations_are_multiplied_out():
    assert parse_expression("(a + 2*b):(c - d)/4 - 3e-1*a:c") == {
        "a:c": 0.25 - 0.3,
        "a:d": -0.25,
        "b:c": 0.5,
        "b:d": -0.5,
    }
    assert parse_expression("-(a - b) - a + a:a") == {"a": -1.0, "b": 1.0}
    assert parse_expression("+ a/.5") == {"a": 2.0}
    deep = [parse_expression("(" * n + "a" + ")" * n) for n in (1, 20)]
    assert deep == [{"a": 1.0}] * 2
    sums = [
        "(" + "+".join(f"{letter}{i}" for i in range(n)) + ")"
        for letter, n in (("a", 40), ("b", 25))
    ]
    assert len(parse_expression(":".join(sums))) == 1000
    sums[1] = sums[1].replace(")", "+z)")
    for text in (
        ":".join(sums),
        "(" * 21 + "a" + ")" * 21,
        "a b",
        "a/b",
        "a/0",
        "(a",
        "a)",
        "2*",
        "a:-b",
    ):
        with says("cannot read"):
            parse_expression(text)
    assert split_name("g[A:B]:age | sex=M, `my x`= 2") == (
        ["g[A:B]", "age"],
        {"sex": "M", "my x": "2"},
    )
    assert split_name("age") == (["age"], {})
    for text in ("age | sex", "age | sex=M, x", "age | sex=M, sex=F"):
        with says("write fixed values"):
            split_name(text)
