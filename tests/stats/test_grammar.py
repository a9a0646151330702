"""Formulas are a closed language: what is allowed works, and nothing else is evaluated."""

import ast
import contextlib
import os
from collections import deque

import formulaic.materializers.base
import numpy as np
import pandas as pd
import pytest
from formulaic import Formula
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hipsta_bids.errors import HipstaError, ModelError, UsageError
from hipsta_bids.stats import grammar
from hipsta_bids.stats.design import build_design
from hipsta_bids.stats.formula import model_from_shortcut, parse_model
from hipsta_bids.stats.grammar import closed_formula, split_random, without_variable
from hipsta_bids.stats.settings import DesignSettings

N = 40
AGE = np.linspace(50.0, 89.0, N)
TABLE = pd.DataFrame(
    {
        "age": AGE,
        "group": np.array(["CN", "AD"])[np.arange(N) % 2],
        "weight in kg": 60.0 + np.sqrt(np.arange(N)),
        "sex": np.array(["F", "F", "M"])[np.arange(N) % 3],
    },
    index=[f"sub-{i:02d}" for i in range(N)],
)
#: Functions that formulas may call, and where the codings of factors are.
FUNCTIONS = {"C", "I", "abs", "bs", "center", "cr", "exp", "log", "log10", "log2", "poly"}
FUNCTIONS |= {"scale", "sqrt", "contr"}


def design(formula):
    spec = parse_model(model_from_shortcut(formula, [], "test"))
    return build_design(TABLE, spec, DesignSettings(), {})


@pytest.mark.parametrize(
    ("formula", "expected"),
    [
        ("log(age)", np.log(AGE)),
        ("log2(age)", np.log2(AGE)),
        ("log10(age)", np.log10(AGE)),
        ("exp(age - 90)", np.exp(AGE - 90)),
        ("sqrt(abs(age - 60.5))", np.sqrt(np.abs(AGE - 60.5))),
        ("I(age**2 / 100 + 2 * age)", AGE**2 / 100 + 2 * AGE),
        ("I(-age)", -AGE),
        ("center(age)", AGE - AGE.mean()),
        ("scale(age)", (AGE - AGE.mean()) / AGE.std(ddof=1)),
        ("log(`weight in kg`)", np.log(TABLE["weight in kg"])),
        ("center(log(age))", np.log(AGE) - np.log(AGE).mean()),
    ],
)
def test_function_of_a_column(formula, expected):
    np.testing.assert_allclose(design(formula).matrix[:, 1], expected, atol=1e-12)


@pytest.mark.parametrize(
    ("formula", "columns"),
    [
        ("bs(age, df=4)", 5),
        ("cr(age, df=4, constraints='center')", 5),
        ("poly(age, 3)", 4),
        ("poly(age, degree=2) + sex", 4),
        ("(group + sex + age)**2", 7),
        ("group/sex", 4),
        ("0 + group:sex", 4),
        ('C(group, contr.treatment("CN")) * age', 4),
        ("C(group, contr.sum) + C(sex, contr.helmert)", 3),
        ('C(group, levels=["CN", "AD"])', 2),
    ],
)
def test_number_of_columns(formula, columns):
    found = design(formula)
    assert found.matrix.shape == (N, columns)
    assert np.linalg.matrix_rank(found.matrix) == columns


def test_polynomials_and_splines_span_what_they_should():
    for formula, power in (("poly(age, 3)", 3), ("bs(age, df=3)", 3)):
        matrix = design(formula).matrix
        wanted = np.vander((AGE - 70) / 20, power + 1)
        rest = wanted - matrix @ np.linalg.lstsq(matrix, wanted, rcond=None)[0]
        assert np.abs(rest).max() < 1e-10


ATTACK = (
    "I(age.map(lambda x: x).__class__.__init__.__globals__['__builtins__']['__import__']('os')"
    ".system('touch pwned'))"
)


@pytest.mark.parametrize(
    ("formula", "part"),
    [
        (ATTACK, "["),
        ("age + {age.to_csv('pwned')}", "{age.to_csv('pwned')}"),
        ("__import__('os').system('touch pwned')", "."),
        ("__import__('os')", "__import__('os')"),
        ("I(age.to_csv('pwned'))", "age.to_csv('pwned')"),
        ("I([age for age in group])", "[age for age in group]"),
        ("log(*group)", "*group"),
        ("log(age, age)", "log(age, age)"),
        ("np.log(age)", "."),
        ("eval(age)", "eval(age)"),
        ("Q('age')", "Q('age')"),
        ("bs(age, df=open('pwned', 'w'))", "open('pwned', 'w')"),
        ("bs(age, _state=1)", "1"),
        ("C(group, contr.__class__)", "contr.__class__"),
        ("C(group, contr.treatment(open('pwned', 'w')))", "open('pwned', 'w')"),
        ('I(f"{age}")', 'I(f"{age}")'),
        ("I(age if age else age)", "age if age else age"),
        ("I(9**9**9**9)", "9 ** 9 ** 9 ** 9"),
        ("I(age**99)", "age ** 99"),
        ("(age + sex)**99", "99"),
        ("bs(age, df=100000000)", "100000000"),
        ("age | sex", "|"),
        ("2*age", "2"),
        ("lambda", "lambda"),
        ("my age", "my age"),
        ("age[0]", "["),
        ("log(age)(sex)", ") ("),
        ("(" * 30 + "age" + ")" * 30, "("),
        ("age + log(age", "( without )"),
        (" + ".join(["age"] * 1000), "characters"),
    ],
)
def test_part_that_is_not_allowed_is_named(formula, part, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError, match="is not allowed; allowed are") as caught:
        design(formula)
    assert part in str(caught.value).partition(" is not allowed")[0]
    assert "log2, poly" in str(caught.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "formula", ["(0) / age", "age ** (0)", "age **", "age + + age +", "exp(exp(age))"]
)
def test_formula_without_sense_is_refused_in_one_line(formula):
    with pytest.raises(ModelError) as caught:
        design(formula)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("formula", "is_refused"),
    [
        ("(group + age + sex + a + b)**9", True),
        ("((age + sex)**9)**9", True),
        ("age*a*b*c*d*e*f*g*h*i", True),
        ("bs(age, df=50):cr(a, df=30)", True),
        ("(age + sex):((a + b)**9)", True),
        ("(age + sex + a + b)**4", False),
        ("age*a*b*c*d*e*f*g*h", False),
        ("age/a/b/c - a:b", False),
        ("poly(age / 50, 2)*poly(a / 50, 2)*bs(b, df=20)", False),
        ("-" * 1900 + "age", False),
    ],
)
def test_products_are_counted_before_they_are_made(formula, is_refused):
    context = pytest.raises(UsageError, match="more than 1000 products")
    with context if is_refused else contextlib.nullcontext():
        assert "age" in closed_formula(formula).names


@given(
    st.recursive(
        st.sampled_from(["a", "b", "c", "d"]),
        lambda parts: st.one_of(
            st.builds("({} {} {})".format, parts, st.sampled_from("+-*/:"), parts),
            st.builds("{} {} {}".format, parts, st.sampled_from("+-*/:"), parts),
            st.builds("({})**{}".format, parts, st.sampled_from("23")),
        ),
        max_leaves=9,
    )
)
@settings(deadline=None, max_examples=100)
def test_no_formula_that_passes_has_more_terms_than_counted(formula):
    with contextlib.suppress(UsageError, TypeError):  # formulaic's, of an empty sum
        closed_formula(formula)
        assert len(list(Formula(formula))) <= 1001


@pytest.mark.slow
def test_products_of_factors_are_refused_before_columns_are_made():
    many = np.arange(30_000) % 500
    levels = {"a": many, "b": many[::-1], "c": many // 2}
    table = pd.DataFrame(
        {name: np.char.add("L", part.astype(str)) for name, part in levels.items()}
    )
    spec = parse_model(model_from_shortcut("a:b:c", [], "test"))
    with pytest.raises(ModelError, match=f"few for {499 * 499 * 249 + 1} columns"):
        build_design(table, spec, DesignSettings(), {})


def test_names_with_blanks_in_terms_keep_their_backticks():
    table = TABLE.rename(columns={"age": "age at scan", "sex": "lambda"})
    model = model_from_shortcut(
        "poly(`age at scan`, 2) + `lambda`", ["nonlinear(`age at scan`)"], "test"
    )
    found = build_design(table, parse_model(model), DesignSettings(), {})
    bend = np.abs(found.contrasts[0].weights[0]) > 1e-12  # else rounding
    assert [name for name, is_used in zip(found.columns, bend, strict=True) if is_used] == [
        "poly(`age at scan`, 2)[2]"
    ]


def test_functions_of_names_are_refused_by_the_name():
    for formula in ("log(group)", "group + center(sex)", "poly(group, 2)"):
        with pytest.raises(ModelError, match=r"take numbers, but (group|sex) holds names"):
            design(formula)


def test_column_named_as_a_function():
    table = TABLE.assign(log=1.0 + np.arange(N) ** 2)
    spec = parse_model(model_from_shortcut("log + age", [], "test"))
    found = build_design(table, spec, DesignSettings(), {})
    np.testing.assert_array_equal(found.matrix[:, 1], table["log"])
    both = parse_model(model_from_shortcut("log + log(age)", [], "test"))
    with pytest.raises(ModelError, match="not callable"):
        build_design(table, both, DesignSettings(), {})


COLUMNS = ["age", "group", "sex", "`weight in kg`"]
OTHERS = ["0", "1", "2", "'x'", "df=3", "contr", "contr.sum", "os", "np", "open", "__import__"]
FOREIGN = ["age.map", "lambda x: x", "{age}", "[age]", "*age"]
ATOMS = st.sampled_from([*COLUMNS, *OTHERS, *FOREIGN])
NAMES = st.sampled_from(
    [*sorted(FUNCTIONS), "eval", "exec", "open", "__import__", "getattr", "hashed", "lag", "Q"]
)


def larger(parts):
    binary = st.sampled_from(["+", "-", "*", "/", ":", "**", ",", ".", " ", "@", "|", "if", "=="])
    return st.one_of(
        st.builds("{} {} {}".format, parts, binary, parts),
        st.builds("({})".format, parts),
        st.builds("{}({})".format, NAMES, parts),
        st.builds("{}({}, {})".format, NAMES, parts, parts),
        st.builds("{}[{}]".format, parts, parts),
        st.builds("{}.{}".format, parts, parts),
    )


FORMULAS = st.recursive(ATOMS, larger, max_leaves=8)


@st.composite
def mutated(draw):
    """A formula with some characters exchanged, dropped or put in."""
    text = list(draw(FORMULAS))
    for _ in range(draw(st.integers(0, 3))):
        at = draw(st.integers(0, len(text)))
        text[at : at + draw(st.integers(0, 2))] = draw(
            st.text("()[]{}.,:=`'\"_ age*%~|\\\n", max_size=2)
        )
    return "".join(text)


def outside(source):
    """Names, attributes and other syntax in an expression that the language does not have."""
    found = []
    plain = source.strip().replace("`weight in kg`", "age")
    for node in ast.walk(ast.parse(plain, mode="eval")):
        if isinstance(node, ast.Name) and node.id not in FUNCTIONS | {"age", "group", "sex"}:
            found.append(node.id)
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) != "contr":
            found.append(ast.unparse(node))
        if isinstance(
            node, ast.Lambda | ast.Subscript | ast.JoinedStr | ast.comprehension | ast.Starred
        ):
            found.append(ast.unparse(node))
    return found


@pytest.mark.slow
@settings(
    max_examples=int(os.environ.get("FUZZ_EXAMPLES", "400")),
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(st.one_of(FORMULAS, mutated()))
def test_nothing_else_is_ever_evaluated(monkeypatch, formula):
    evaluated = []
    inner = formulaic.materializers.base.stateful_eval

    def watched(source, *args, **kwargs):
        evaluated.append(str(source))
        return inner(source, *args, **kwargs)

    with monkeypatch.context() as patch, contextlib.suppress(HipstaError):
        patch.setattr(formulaic.materializers.base, "stateful_eval", watched)
        design(formula)
    assert not [name for source in evaluated for name in outside(source)]


def test_watch_sees_what_is_evaluated(monkeypatch):
    """The test above sees a name outside of the language where formulaic is asked directly."""
    evaluated = []
    inner = formulaic.materializers.base.stateful_eval
    monkeypatch.setattr(
        formulaic.materializers.base,
        "stateful_eval",
        lambda source, *rest, **more: evaluated.append(str(source)) or inner(source, *rest, **more),
    )
    formulaic.model_matrix("I(age.map(str).str.len())", TABLE)
    assert [name for source in evaluated for name in outside(source)]


def test_names_are_those_of_columns():
    closed = closed_formula("log(`weight in kg`) + C(group, contr.sum):age + I(age*sex)")
    assert closed.names == ("weight in kg", "group", "age", "sex")
    assert closed.references == closed_formula("C(group, contr.helmert(True))").references == ()
    coded = closed_formula('C(group, contr.treatment(base="CN"))')
    assert coded.references == (("group", "CN"),)


def test_names_with_blanks_keep_their_backticks():
    assert without_variable("`age at scan`*`lambda` + group", "group") == (
        "1 + `age at scan` + `lambda` + `age at scan`:`lambda`"
    )


def test_random_intercepts_are_taken_out():
    """One term (1|NAME), added to other terms; any other term with a bar is refused."""
    assert split_random("group * age + (1 | site)") == ("group * age", "site")
    assert split_random("thickness ~ (1|`site id`) + age") == ("thickness ~age", "site id")
    assert split_random("(1|site)") == ("1", "site")
    quoted = "C(dose, contr.treatment('(a|b)'))"
    assert split_random(quoted) == (quoted, "")
    more = ("(age|site)", "(1|a) + (1|b)", "(1|a:b)", "(0 + age|site)", "age - (1|site)")
    for text in (*more, "age * (1|site)", "(1||site)", "(1|1)"):
        with pytest.raises(UsageError, match=r"only one \(1\|NAME\) can be added"):
            split_random(text)


PRODUCTS = {"": 1, "- 1 + 1": 2, "1 * 1 * 1": 7, "1 * 1 / 1": 4, "1 / 1 * 1": 5, "3 : 4 ** 2": 48}
PRODUCTS |= {"1 + 1 * 1 : 2": 6, "( 1 + 1 ) ** 2 ** 3": 64, "- ( 2 + 3 ) : ( 1 * 2 )": 25}
PRODUCTS |= {"1000 : 1": 1000, "50 : 50 : 50": 1001}


@pytest.mark.parametrize("formula", PRODUCTS)
def test_products_are_those_of_the_expanded_formula(formula):
    """Numbers are of columns: a + b*c:d, of one, one, one and two, has a, b, c:d and b:c:d."""
    assert grammar._products(deque(formula.split())) == PRODUCTS[formula]
