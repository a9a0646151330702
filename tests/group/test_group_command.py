"""Which calls mean the group level, its help, and its settings as a file."""

from typing import get_args

import pytest
from extension_marks import PRESENT, needs

from hipsta_bids.cli.group import group_parser, is_group_level
from hipsta_bids.cli.main import main
from hipsta_bids.errors import ExitCode, UsageError
from hipsta_bids.group.cohort.exclusions import fulfilled
from hipsta_bids.group.settings import GroupSettings, load_group_settings
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
        pytest.param("--longitudinal", "longitudinal", "random", marks=needs("repeated")),
    ],
)
def test_options_and_settings_know_the_same_choices(option, group, name):
    (action,) = (a for a in group_parser()._actions if option in a.option_strings)
    known = get_args(type(dict(GroupSettings())[group]).model_fields[name].annotation)
    assert set(action.choices) == set(known)


@pytest.mark.parametrize(
    ("texts", "reason"),
    [
        (["a > 1"], "a > 1"),
        (["a > 2.5"], None),
        (["a>=2"], "a >= 2"),
        (["a < 2", "a<=2"], "a <= 2"),
        (["a != 2", "missing > 0", "a == 2e0"], "a == 2"),
        (["a > -.5"], "a > -0.5"),
        (["missing < 0", "missing != 0"], None),
    ],
)
def test_quality_conditions(texts, reason):
    parsed = group_parser().parse_args(["in", "out", "group", "--exclude-qc", *texts])
    assert fulfilled(parsed.exclude_qc, {"a": 2.0, "missing": None}) == reason


def test_conditions_can_be_given_by_several_options():
    options = ["--exclude-qc", "a > 1", "--exclude-qc", "b < 2"]
    parsed = group_parser().parse_args(["in", "out", "group", *options])
    assert parsed.exclude_qc == [("a", ">", 1.0), ("b", "<", 2.0)]


@pytest.mark.parametrize(
    "text",
    [
        *("a", "a >", "a > b", "1 < a", "a > 1 or b < 2", "not a > 1", "a => 1", "a > 1e", "x\0"),
        *("open('x')", "a.b > 1", "a in [1]", "lambda: a", "1" + "+1" * 100_000),
    ],
)
def test_other_conditions_are_refused(text):
    with pytest.raises(UsageError, match=r"--exclude-qc: .* is not of the form") as refusal:
        group_parser().parse_args(["in", "out", "group", "--exclude-qc", text])
    assert len(str(refusal.value)) < 400  # one message line, whatever the text


@pytest.mark.skipif("agreement" in PRESENT, reason="the extension compares protocols")
def test_one_protocol_is_named(capsys, tmp_path):
    (tmp_path / "participants.tsv").write_text("participant_id\n")
    folders = str(tmp_path), str(tmp_path)
    assert main([*folders, "group", "--seg", "ashs", "freesurfer"]) == ExitCode.USAGE
    assert "--seg: name one protocol" in capsys.readouterr().err
