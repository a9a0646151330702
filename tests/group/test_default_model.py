"""Which groups, reference level and covariates are taken when no model is given."""

import pandas as pd
import pytest

from hipsta_bids.errors import ModelError
from hipsta_bids.group.model import default_formula, find_groups, folder_name
from hipsta_bids.group.settings import GroupSettings

SETTINGS = GroupSettings()


@pytest.mark.parametrize(
    ("levels", "reference"),
    [
        (["MCI", "AD", "CN"], "CN"),
        (["patients", "Controls"], "Controls"),
        (["a", "b", "b"], "b"),  # the most frequent one
        (["b", "a"], "a"),  # equally frequent
        (["HC", "CU", "CU"], "CU"),  # the settings' order
    ],
)
def test_reference_level(levels, reference):
    groups = find_groups(pd.DataFrame({"Diagnosis": levels}), SETTINGS)
    assert groups.column == "Diagnosis"
    assert groups.reference == reference
    assert groups.levels[1:] == tuple(sorted(set(levels) - {reference}))


def test_contrasts_are_positive_where_the_reference_has_more():
    groups = find_groups(pd.DataFrame({"group": ["CN", "AD", "MCI"]}), SETTINGS)
    assert groups.contrasts() == [
        "CN-AD = group[CN] - group[AD]",
        "CN-MCI = group[CN] - group[MCI]",
    ]


def test_covariates_that_do_not_vary_or_are_missing_are_left_out():
    table = pd.DataFrame(
        {"group": ["a", "b"], "Age": ["61", "72"], "sex": ["F", "F"], "site": ["x", "n/a"]}
    )
    groups = find_groups(table, SETTINGS)
    assert default_formula(table, groups, SETTINGS) == "group + Age"


def test_one_level_is_no_group_and_numbers_are_no_names():
    assert find_groups(pd.DataFrame({"group": ["a", "a", None]}), SETTINGS) is None
    assert find_groups(pd.DataFrame({"age": ["1", "2"]}), SETTINGS) is None
    with pytest.raises(ModelError) as caught:
        find_groups(pd.DataFrame({"group": ["0", "1"]}), SETTINGS)
    assert caught.value.reason == "group-numeric"


def test_different_models_have_different_folders():
    formulas = (
        "group + age",
        "group * age",
        "group:age",
        "group + age - 1",
        "~ group + np.log(age)",
    )
    assert len({folder_name(formula) for formula in formulas}) == len(formulas)
    assert folder_name("thickness ~ group + age") == "group-age"
