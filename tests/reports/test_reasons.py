"""The table of reasons: complete, without leftovers, and with remedies that exist.

That every reason which the package gives is in the table is checked wherever one is given: see
``known_reasons`` in ``conftest.py``.
"""

import re
from collections import Counter
from importlib.resources import files

import pytest
from reference_pages import reasons_page

from hipsta_bids.cli.group import group_parser
from hipsta_bids.cli.participant import build_parser
from hipsta_bids.errors import HipstaError
from hipsta_bids.reports.page import read_table
from hipsta_bids.types import Flag

TABLE = read_table("reasons.toml")
ROWS = [pair for section in TABLE["section"] for pair in section["reasons"].items()]


def test_each_reason_has_one_row():
    assert [name for name, times in Counter(name for name, _ in ROWS).items() if times > 1] == []


@pytest.mark.parametrize("kind", ["HipstaError", "Flag"])
def test_an_unknown_reason_is_noticed(kind):
    line = f"{kind}(message='text', reason='nobody-knows')"
    if kind == "HipstaError":
        line = line.replace("message=", "")
    code = compile(line, str(files("hipsta_bids") / "made_up.py"), "eval")
    with pytest.raises(AssertionError, match="nobody-knows"):
        eval(code, {"HipstaError": HipstaError, "Flag": Flag})  # noqa: S307


def test_each_reason_says_what_kind_of_thing_to_do():
    assert {row["action"] for _, row in ROWS} == set(TABLE["actions"])


def test_the_page_has_each_reason_under_what_to_do():
    page = reasons_page()
    for action, title in TABLE["actions"].items():
        part = page.split(f"\n## {title}\n")[1].split("\n## ")[0]
        names = re.findall(r"^#### `(.+)`$", part, re.MULTILINE)
        assert sorted(names) == sorted(name for name, row in ROWS if row["action"] == action)


def test_the_table_has_no_leftovers():
    package = files("hipsta_bids")
    code = "".join(path.read_text(encoding="utf-8") for path in package.rglob("*.py"))
    assert [name for name, _ in ROWS if f'"{name}"' not in code] == []


def test_options_in_remedies_exist():
    known = {
        name
        for parser in (build_parser(), group_parser())
        for action in parser._actions
        for name in action.option_strings
    }
    words = " ".join(f"{row['meaning']} {row['remedy']}" for _, row in ROWS)
    assert set(re.findall(r"--[a-z][a-z-]+", words)) - {"--array"} <= known


def test_meanings_and_remedies_are_sentences():
    for name, row in ROWS:
        assert row["meaning"].endswith("."), name
        assert row["remedy"].endswith("."), name
