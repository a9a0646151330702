"""Limits of what tables, formulas and contrasts may hold: values on both sides of each."""

import numpy as np
import pandas as pd
import pytest

from hipsta_bids.errors import ModelError
from hipsta_bids.stats import formula as formulas
from hipsta_bids.stats.contrasts import parse_expression, split_name
from hipsta_bids.stats.design import build_design
from hipsta_bids.stats.settings import DesignSettings

ROWS = 60


def design(formula, settings=None, **columns):
    """Ages of 50 to 79.5, three groups, and further columns."""
    ages = 50 + np.arange(ROWS) * 17 % ROWS / 2
    table = pd.DataFrame({"age": ages, "group": np.resize(["A", "B", "C"], ROWS)})
    table = table.assign(**columns).set_index(pd.Index([f"sub-{i:02d}" for i in range(ROWS)]))
    spec = formulas.parse_model(formulas.model_from_shortcut(formula, [], "m"))
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
        ("age", put(-3, 3, first=-30.0), ""),  # differences from a mean
        ("icv", put(0, 5, first=1400.0), "sub-05 (0)"),
        ("icv", put(0, 3, first=-30.0), ""),
        ("icv", np.repeat([0.0, 1.0], ROWS // 2) * np.arange(ROWS), ""),  # quartile of 0
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


@pytest.mark.slow
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
        formulas.check_numbers(
            pd.Series(np.array(values, float), name="x"), DesignSettings(**settings)
        )
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
        ([np.nan], {}, ""),
    ],
)
def test_codes_and_far_values_are_refused_beyond_their_limits(values, settings, part):
    text = refused_numbers(values, **settings).replace("'", "")
    assert part in text
    assert bool(part) == bool(text)


def test_columns_of_given_levels():
    table = pd.DataFrame(
        {"g": ["b", "a", None, "b"], "x": [1.0, 2.0, 3.0, np.nan], "t": list("abcd")}
    )
    matrix, names, rows = formulas.columns_of(table, "g * x", {"g": ["a", "b", "c"]}, "file: ")
    assert names == ("g[T.b]", "g[T.c]", "x", "g[T.b]:x", "g[T.c]:x")
    assert rows.tolist() == [0, 1]
    assert matrix.tolist() == [[1, 0, 1, 1, 0], [0, 0, 2, 0, 0]]
    assert formulas.columns_of(table, "1", {}, "")[0].shape == (4, 0)
    with says("file: has no 'g' b, only a; exclude"):
        formulas.columns_of(table, "g", {"g": ["a"]}, "file: ")
    with says("file: t should be numbers"):
        formulas.columns_of(table, "t + x", {}, "file: ")


def test_combinations_are_multiplied_out():
    half = parse_expression("(a + 2*b):(c - d)/4 - 3e-1*a:c")
    assert half == {"a:c": 0.25 - 0.3, "a:d": -0.25, "b:c": 0.5, "b:d": -0.5}
    assert parse_expression("-(a - b) - a + a:a") == {"a": -1.0, "b": 1.0}
    assert parse_expression("(" * 20 + "a" + ")" * 20) == {"a": 1.0}
    left, right = (
        "+".join(f"{letter}{i}" for i in range(n)) for letter, n in (("a", 40), ("b", 25))
    )
    assert len(parse_expression(f"({left}):({right})")) == 1000
    deep = "(" * 21 + "a" + ")" * 21
    for text in (f"({left}):({right}+z)", deep, "a/b", "a/0", "(a", "a)", "2*", "a:-b"):
        with says("cannot read"):
            parse_expression(text)
    names = split_name("g[A:B]:age | sex=M, `my x`= 2")
    assert names == (["g[A:B]", "age"], {"sex": "M", "my x": "2"})
    with says("write fixed values"):
        split_name("age | sex=M, x")
