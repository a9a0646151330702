"""From suites to the page, with suites that take no time."""

import re
import struct
import sys
from inspect import signature
from pathlib import Path
from types import SimpleNamespace

import pytest

from hipsta_bids.errors import ExitCode
from validation import __main__ as command
from validation import cases
from validation.cases import Refusal
from validation.report import (
    QUESTIONS,
    SUITES,
    WITH_LABELS,
    Picture,
    Suite,
    Table,
    markdown,
    opening,
    overview,
    page,
    render,
    run_suite,
    show,
)

TABLE = Table(
    title="Bias",
    rows=[
        {"case": "a|b", "|mm|": 0.01234, "target": "≤ 0.02", "met": True},
        {"case": "c", "target": "≤ 0.02", "met": False},
    ],
    notes="Read it so.",
)


def line(figure):
    figure.subplots().plot([0, 1], [1, 0])


PAGE = (Path(__file__).parents[2] / "docs" / "validation.md").read_text(encoding="utf-8")
WORDS = {"yes": True, r"**no**": False, "n/a": None}


def suites_of(text):
    """The suites that a page shows, as far as their tables."""
    for name, section in zip(SUITES, text.split("\n## ")[1:], strict=True):
        title, _, content = section.partition("\n")
        found = re.findall(r"^\*\*(.+)\*\*\n\n((?:\|.*\n)+)", content + "\n", re.MULTILINE)
        tables = tuple(table_of(heading, lines.splitlines()) for heading, lines in found)
        yield Suite(name=name, title=title, tables=tables)


def table_of(title, lines):
    cells = [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]
    headings, _, *rows = cells
    own = [{h: WORDS.get(c, c) for h, c in zip(headings, row, strict=True)} for row in rows]
    return Table(title=title, rows=own)


PICTURE = Picture(name="line", caption="A falling line.", draw=line, size=(3.0, 2.0))


@pytest.fixture
def one_suite(monkeypatch):
    """Replace all suites by one; remembers how it was called."""
    calls = []

    def run(full):
        calls.append(full)
        return Suite(name="toy", title="Toys", text="Why.", tables=(TABLE,), pictures=(PICTURE,))

    monkeypatch.setitem(sys.modules, "validation.toys", SimpleNamespace(run=run))
    monkeypatch.setattr("validation.report.SUITES", {"toy": "toys:run"})
    return calls


def test_a_table_in_markdown():
    assert markdown(TABLE).splitlines() == [
        "**Bias**",
        "",
        r"| case | \|mm\| | target | met |",
        "| --- | --- | --- | --- |",
        r"| a\|b | 0.012 | ≤ 0.02 | yes |",
        "| c | n/a | ≤ 0.02 | **no** |",
        "",
        "Read it so.",
    ]


@pytest.mark.parametrize(
    ("cell", "text"),
    [(None, "n/a"), (float("nan"), "n/a"), (3, "3"), (1.0, "1.00"), (True, "yes"), ("≤ 1", "≤ 1")],
)
def test_cells(cell, text):
    assert show(cell, 2) == text


def test_targets_are_counted_and_numbers_are_not():
    rows = [{"n": 1, "x": True}, {"n": 0, "x": False}, {"n": 0, "x": None}]
    table = Table(title="t", rows=rows)
    assert (table.targets, table.missed) == (2, 1)


def test_a_heading_that_the_longest_row_lacks_is_refused():
    with pytest.raises(ValueError, match=r"the longest row has no \['c'\]"):
        Table(title="t", rows=[{"a": 1, "b": 2}, {"c": 3}])


def test_page_says_that_it_is_generated_and_shows_all():
    text = page([Suite(name="toy", title="Toys", tables=(TABLE,), pictures=(PICTURE,))], full=True)
    assert text.startswith("<!-- Written by `hipsta-bids validate --full --suite toy`; do not")
    assert "| Toys | Bias | 2 | 1 |" in text
    assert "![A falling line.](images/validation-line.png)" in text
    assert text.count("**Bias**") == 1


def test_a_page_opens_with_what_was_asked_and_what_was_missed():
    good = Table(title="Good", rows=[{"case": "x", "met": True}])
    many = Table(title="Many, mm", rows=[{"case": str(i), "met": i > 3} for i in range(6)])
    suites = [
        Suite(name="toy", title="Toys", tables=(TABLE, many)),
        Suite(name="limits", title="Fine things", tables=(good,)),
        Suite(name="none", title="Not judged"),
    ]
    holds, misses = opening(suites).split("What does not hold everywhere:")
    assert holds.startswith("**4 of 9 targets are met.**")
    assert f"- [{QUESTIONS['limits']}](#fine-things) (1)" in holds
    assert "- [Toys](#toys): 3 of 8. Missed: Bias (1 of 2: c), Many (4 of 6)." in misses
    assert "Not judged" not in holds + misses
    assert render(overview(suites))[:4] == b"\x89PNG"


def test_misses_are_named_by_what_tells_rows_apart():
    rows = [
        {"a": "x", "b": 1.0, "c": "u", "met": False},
        {"a": "x", "b": 2.0, "c": "u", "met": True},
    ]
    assert Table(title="t", rows=rows, digits=1).misses == ["x, 1.0"]
    both = [{"a": "x", "one": False, "two": False}, {"a": "y", "one": True, "two": True}]
    assert Table(title="t", rows=both).misses == ["x"]


def test_every_suite_asks_something():
    assert QUESTIONS.keys() == SUITES.keys()


def test_the_page_in_the_documentation_opens_with_the_counts_of_its_tables():
    suites = list(suites_of(PAGE))
    assert [suite.name for suite in suites] == list(SUITES)
    assert opening(suites) in PAGE
    counted = re.findall(
        r"^\| (.+) \| (.+) \| (\d+) \| (\d+) \|$", PAGE.split("\n## ")[0], re.MULTILINE
    )
    assert [
        (one.title, table.title, str(table.targets), str(table.missed))
        for one in suites
        for table in one.tables
    ] == counted


def test_figures_are_png_and_the_same_each_time():
    first = render(PICTURE)
    assert first[:8] == b"\x89PNG\r\n\x1a\n"
    assert struct.unpack(">II", first[16:24]) == (300, 200)  # 3 x 2 inches, 100 dpi
    assert first == render(PICTURE)


def test_command_writes_the_report(tmp_path, capsys, one_suite):
    assert command.main(["--full", "--out", str(tmp_path / "a b")]) == ExitCode.OK
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "Toys: 1 of 2 targets met"
    assert said[1] == f"targets missed: 1; report: {tmp_path / 'a b' / 'validation.md'}"
    assert one_suite == [True]
    assert (tmp_path / "a b/images/validation-line.png").read_bytes() == render(PICTURE)
    text = (tmp_path / "a b/validation.md").read_text(encoding="utf-8")
    assert "`hipsta-bids validate --full`" in text  # all suites there are
    assert "## Toys\n\nWhy." in text


def test_command_is_quick_by_default(tmp_path, one_suite):
    assert command.main(["--out", str(tmp_path)]) == ExitCode.OK
    assert one_suite == [False]


def test_unknown_suites_are_refused(tmp_path, capsys):
    code = command.main(["--suite", "speed", "--out", str(tmp_path)])
    assert code == ExitCode.USAGE
    assert "suite 'speed' is unknown; choose from accuracy" in capsys.readouterr().err


@pytest.mark.usefixtures("one_suite")
def test_a_file_in_the_way_is_an_output_error(tmp_path):
    (tmp_path / "out").write_text("taken")
    assert command.main(["--out", str(tmp_path / "out")]) == ExitCode.NOT_WRITABLE


@pytest.mark.parametrize("name", SUITES)
def test_every_suite_can_be_imported(name):
    from importlib import import_module  # noqa: PLC0415

    module, function = SUITES[name].split(":")
    run = getattr(import_module(f"validation.{module}"), function)
    assert len(signature(run).parameters) == 1 + (name in WITH_LABELS)


@pytest.mark.parametrize(
    "name", ["accuracy", "limits", "slices", "convergence", "invariance", "uncertainty"]
)
def test_a_suite_of_which_nothing_is_measured_misses_all_targets(monkeypatch, name):
    lost = Refusal(reason="crash", message="a bug")
    monkeypatch.setattr(cases, "run_cases", lambda _, given, **__: [lost for _ in given])
    suite = run_suite(name, full=False)
    assert suite.missed == suite.targets > 0
    # All that texts name in braces is known.
    assert not re.search(r"\{\w", page([suite], full=False))


@pytest.mark.usefixtures("one_suite")
def test_a_suite_is_found_by_its_name():
    assert run_suite("toy", full=False).title == "Toys"
