"""The default model, and models that a user asks for."""

import numpy as np
import pandas as pd
import pytest
from people_tables import participants

from hipsta_bids.errors import ModelError, UsageError
from hipsta_bids.group.model import (
    ModelRequest,
    choose_model,
    default_formula,
    find_groups,
    model_document,
)
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.stats.design import build_design
from hipsta_bids.stats.formula import parse_model

DEFAULTS = GroupSettings()
SETTINGS = DEFAULTS.design


@pytest.mark.parametrize(
    ("levels", "reference"),
    [
        (["MCI", "AD", "CN"], "CN"),
        (["patients", "Controls"], "Controls"),
        (["a", "b", "b"], "a"),  # the first by name, whatever the numbers of participants
        (["b", "a"], "a"),
        (["HC", "CU", "CU"], "CU"),  # the settings' order
    ],
)
def test_reference_level(levels, reference):
    groups = find_groups(pd.DataFrame({"Diagnosis": levels}), DEFAULTS)
    assert groups.column == "Diagnosis"
    assert groups.reference == reference
    assert groups.levels[1:] == tuple(sorted(set(levels) - {reference}))


@pytest.mark.parametrize("column", ["group", "diag", "clinical status"])
@pytest.mark.parametrize("coding", ["{}", "C({})", "C({}, contr.sum)"])
def test_names_of_columns_and_codings_do_not_change_signs(column, coding):
    table = pd.DataFrame({column: ["patient", "control"] * 10, "age": np.arange(60, 80)})
    y = np.where(table[column] == "control", 2.5, 2.0) + 1e-3 * np.cos(np.arange(20))
    formula = f"{coding.format(f'`{column}`' if ' ' in column else column)} + age"
    request = ModelRequest(formula=formula)
    _, spec, _, references = choose_model(request, table, DEFAULTS)
    found = build_design(table, spec, SETTINGS, references)
    (contrast,) = (one for one in found.contrasts if one.name == "control-patient")
    coefficients = np.linalg.lstsq(found.matrix, y, rcond=None)[0]
    np.testing.assert_allclose(contrast.weights @ coefficients, 0.5, atol=1e-3)  # noise of y
    assert "control (control)" in found.notes["references"]


def test_the_coding_of_a_formula_sets_the_reference_of_contrasts():
    table = participants()
    request = ModelRequest(formula="C(group, contr.treatment('DAT')) + age")
    _, spec, groups, references = choose_model(request, table, DEFAULTS)
    assert groups.reference == references["group"] == "DAT"
    assert [one.name for one in spec.contrasts] == ["DAT-CU", "DAT-MCI"]
    found = build_design(table, spec, SETTINGS, references)
    assert found.references["group"] == "DAT"
    request = ModelRequest(formula=request.formula, references=(("group", "CU"),))
    with pytest.raises(UsageError, match=r"--reference group=CU, but the formula has"):
        choose_model(request, table, DEFAULTS)


def test_contrasts_are_positive_where_the_reference_has_more():
    groups = find_groups(pd.DataFrame({"group": ["CN", "AD", "MCI"]}), DEFAULTS)
    assert groups.contrasts() == [
        "CN-AD = group[CN] - group[AD]",
        "CN-MCI = group[CN] - group[MCI]",
    ]


def test_covariates_that_do_not_vary_or_are_missing_are_left_out():
    table = pd.DataFrame(
        {"group": ["a", "b"], "Age": ["61", "72"], "sex": ["F", "F"], "site": ["x", "n/a"]}
    )
    groups = find_groups(table, DEFAULTS)
    assert default_formula(table, groups, DEFAULTS) == "group + Age"


def test_one_level_is_no_group_and_numbers_name_groups_in_their_order():
    assert find_groups(pd.DataFrame({"group": ["a", "a", None]}), DEFAULTS) is None
    assert find_groups(pd.DataFrame({"age": ["1", "2"]}), DEFAULTS) is None
    table = pd.DataFrame({"group": ["10", "2", "0", "0"]})
    assert find_groups(table, DEFAULTS).levels == ("0", "2", "10")


def test_names_of_group_columns_in_settings_are_read_in_any_case_of_letters():
    settings = DEFAULTS.changed(model={"group_columns": ("Group", "Cohort")})
    table = participants()
    table = table.assign(cohort=table["group"].to_numpy()[::-1])
    *_, groups, _ = choose_model(ModelRequest(formula="cohort + age"), table, settings)
    assert groups.column == "cohort"
    with pytest.raises(ModelError, match="cohort is CU for all"):
        choose_model(ModelRequest(), table.assign(group="CU", cohort="CU")[["cohort"]], settings)


@pytest.mark.parametrize("formula", [None, "thickness ~ group + age + sex"])
def test_models_have_the_name_that_they_are_given_or_that_of_their_formula(formula):
    table = participants()
    groups = find_groups(table, DEFAULTS)
    for name, wanted in ((None, "group-age-sex"), ("mine", "mine")):
        request = ModelRequest(formula=formula, name=name)
        assert model_document(request, table, groups, DEFAULTS)["Name"] == wanted


def test_contrasts_of_a_request_come_before_those_of_the_groups():
    table = participants()
    groups = find_groups(table, DEFAULTS)
    for formula in (None, "group + age"):
        for contrasts, names in (((), ["CU-DAT", "CU-MCI"]), (("slope = age",), ["slope"])):
            request = ModelRequest(formula=formula, contrasts=contrasts)
            spec = parse_model(model_document(request, table, groups, DEFAULTS))
            assert [contrast.name for contrast in spec.contrasts] == names


def test_interactions_are_tested_without_being_asked_for():
    table = participants()
    groups = find_groups(table, DEFAULTS)
    for formula, expected in (
        ("group + age", []),
        ("group * age", ["group:age"]),
        ("thickness ~ group * poly(age, 2) + sex", ["group:age"]),
        ("group * sex * age", ["group:sex", "group:age", "sex:age", "group:sex:age"]),
        ("group + age * sex", ["age:sex"]),
    ):
        document = model_document(ModelRequest(formula=formula), table, groups, DEFAULTS)
        names = [contrast.name for contrast in parse_model(document).contrasts]
        assert names == ["CU-DAT", "CU-MCI", *expected]
        design = build_design(table, parse_model(document), SETTINGS, {"group": "CU"})
        assert len(design.contrasts) == 2 + len(expected)
