"""Which calls mean the group level, its help, and its settings as a file."""

from typing import get_args

import pytest

from hipsta_bids.cli.group import group_parser, is_group_level
from hipsta_bids.cli.main import main
from hipsta_bids.errors import UsageError
from hipsta_bids.group.cohort.exclusions import QualityCondition
from hipsta_bids.group.design.settings import GroupSettings, load_group_settings
from hipsta_bids.protocols.toml import settings_toml


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("in out group", True),
        ("in out group --participant-label participant", True),
        ("--seg demo in out group", True),
        ("in out participant", False),
        ("in out participant --participant-label group", False),
        ("group out participant", False),
        ("in group participant", False),
        ("settings group", False),
    ],
)
def test_group_level_is_told_from_folders_called_so(line, expected):
    assert is_group_level(line.split()) is expected


def test_settings_are_printed_and_read_back(tmp_path, capsys):
    assert main(["settings", "group"]) == 0
    path = tmp_path / "group.toml"
    path.write_text(capsys.readouterr().out)
    assert load_group_settings(path) == GroupSettings()
    assert "added" in settings_toml(GroupSettings())


@pytest.mark.parametrize(
    ("option", "group", "name"),
    [
        ("--align", "registration", "align"),
        ("--correction", "multiplicity", "method"),
        ("--fdr-scope", "multiplicity", "scope"),
        ("--longitudinal", "longitudinal", "random"),
    ],
)
def test_options_and_settings_know_the_same_choices(option, group, name):
    (action,) = (a for a in group_parser()._actions if option in a.option_strings)
    known = get_args(type(dict(GroupSettings())[group]).model_fields[name].annotation)
    assert set(action.choices) - {"penalised"} == set(known)


@pytest.mark.parametrize(
    ("text", "holds"),
    [
        ("a > 1", True),
        ("a > 2.5", False),
        ("1 < a <= 2 and word == 'cut'", True),
        ("not (a > 1 or a < 0)", False),
        ("a / 4 + 1 == 1.5", True),
        ("-a < 0", True),
        ("missing > 0", False),
        ("missing < 0 or a == 2", True),
        ("missing + 1 > 0", False),
    ],
)
def test_quality_conditions(text, holds):
    metrics = {"a": 2.0, "word": "cut", "missing": None}
    assert QualityCondition(text).holds(metrics) is holds


@pytest.mark.parametrize("text", ["a >", "open('x')", "a.b > 1", "a in [1]", "lambda: a"])
def test_other_expressions_are_refused(text):
    with pytest.raises(UsageError, match="--exclude-qc"):
        QualityCondition(text).holds({"a": 1.0})
