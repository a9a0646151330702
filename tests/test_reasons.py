"""The table of reasons: complete, without leftovers, and with remedies that exist."""

import ast
import re
from collections import Counter
from functools import cache
from pathlib import Path

import hipsta_bids
from hipsta_bids.group_parser import group_parser
from hipsta_bids.parser import build_parser
from hipsta_bids.reasons import SECTIONS

PACKAGE = Path(hipsta_bids.__file__).parent
SOURCES = [path for path in PACKAGE.rglob("*.py") if path.parent.name != "reasons"]
KEBAB = re.compile(r"[a-z]+[0-9]?(-[a-z0-9]+)+")
#: Modules that pass reasons through a variable: flags from tables, and names for all modules.
INDIRECT = ("label_checks.py", "quality.py", "sections.py", "ends.py", "checks.py")


@cache
def nodes(path):
    return list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


def texts(node):
    """Whole strings that an expression can be."""
    if isinstance(node, ast.IfExp):
        return texts(node.body) | texts(node.orelse)
    return {node.value} if isinstance(node, ast.Constant) else set()


def given(path):
    """Reasons that a module gives."""
    direct, indirect = set(), set()
    for node in nodes(path):
        if isinstance(node, ast.keyword) and node.arg == "reason":
            direct |= texts(node.value)
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            # NOT_FINISHED = "not-finished", and a local variable that is passed on
            if node.targets[0].id in {"NOT_FINISHED", "INTERNAL", "reason"}:
                indirect |= texts(node.value)
        elif isinstance(node, ast.Tuple) and path.name in INDIRECT:
            indirect |= {text for each in node.elts for text in texts(each)}
    return direct | {x for x in indirect if isinstance(x, str) and KEBAB.fullmatch(x)}


def names():
    return [name for section in SECTIONS for name in section.reasons]


def test_every_reason_of_the_package_is_in_the_table():
    lacking = {(path.name, x) for path in SOURCES for x in given(path)} - {
        (path.name, x) for path in SOURCES for x in names()
    }
    assert not lacking, "add a row to hipsta_bids/reasons/, then run tools/make-docs"


def test_the_search_for_reasons_finds_them():
    found = set().union(*map(given, SOURCES))
    # One of each way: an error, a flag, a table of flags, a choice, a constant.
    assert found > {"no-segmentation", "layers-fold", "section-notch", "other-session", "timeout"}
    assert found > {"not-finished", "internal-error", "much-repaired", "thin-gap"}


def test_the_table_has_no_leftovers():
    strings = {
        node.value for path in SOURCES for node in nodes(path) if isinstance(node, ast.Constant)
    }
    assert set(names()) <= strings
    assert [name for name, times in Counter(names()).items() if times > 1] == []


def test_options_in_remedies_exist():
    known = {
        name
        for parser in (build_parser(), group_parser())
        for action in parser._actions
        for name in action.option_strings
    }
    words = " ".join(
        f"{reason.meaning} {reason.remedy}"
        for section in SECTIONS
        for reason in section.reasons.values()
    )
    assert set(re.findall(r"--[a-z][a-z-]+", words)) - {"--array"} <= known


def test_meanings_and_remedies_are_sentences():
    for section in SECTIONS:
        for name, reason in section.reasons.items():
            assert reason.meaning.endswith("."), name
            assert reason.remedy.endswith("."), name
