"""From suites to their files, with suites that take no time; and the files in docs/validation."""

import json
import re
import struct
import sys
from dataclasses import replace
from inspect import signature
from pathlib import Path
from types import SimpleNamespace

import pytest

from hipsta_bids.errors import ExitCode
from hipsta_bids.io.files import read_tsv
from validation import __main__ as command
from validation import cases
from validation.cases import Refusal
from validation.report import (
    _TABLE,
    QUESTIONS,
    SUITES,
    WITH_LABELS,
    Picture,
    Suite,
    Table,
    commit,
    markdown,
    render,
    run_suite,
    show,
    write,
)

TABLE = Table(
    name="bias",
    title="Bias",
    rows=[
        {"case": "a|b", "|mm|": 0.01234, "target": "≤ 0.02", "met": True},
        {"case": "c", "target": "≤ 0.02", "met": False},
    ],
    notes="Read it so.",
)


def line(figure):
    figure.subplots().plot([0, 1], [1, 0])


FOLDER = Path(__file__).parents[2] / "docs" / "validation"

PICTURE = Picture(name="toy", caption="A falling line.", draw=line, size=(3.0, 2.0))

TOYS = Suite(name="toy", title="Toys", text="Why.", tables=(TABLE,), pictures=(PICTURE,))


@pytest.fixture
def one_suite(monkeypatch):
    """Replace all suites by one; remembers how it was called."""
    calls = []

    def run(full):
        calls.append(full)
        return TOYS

    monkeypatch.setitem(sys.modules, "validation.toys", SimpleNamespace(run=run))
    monkeypatch.setattr("validation.report.SUITES", {"toy": "toys:run"})
    return calls


def test_a_table_in_markdown():
    assert markdown(TABLE).splitlines() == [
        "**Bias**",
        "",
        r"| case | \|mm\| | target | met |",
        "| --- | --- | --- | --- |",
        r"| a\|b | 0.012 | ≤ 0.02 | met |",
        "| c | n/a | ≤ 0.02 | **missed** |",
        "",
        "Read it so.",
    ]


@pytest.mark.parametrize(
    ("cell", "text"),
    [(None, "n/a"), (float("nan"), "n/a"), (3, "3"), (1.0, "1.00"), (True, "met"), ("≤ 1", "≤ 1")],
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


def test_a_suite_replaces_its_files_and_leaves_those_of_others(tmp_path):
    for name in ("toy--old.tsv", "toys--bias.tsv", "toys.json"):
        (tmp_path / name).write_text("before")
    write(TOYS, tmp_path, {"command": "the command", "commit": "1234abc"})
    assert {path.name for path in tmp_path.iterdir()} == {
        *("toy.json", "toy--bias.tsv", "toy.png", "toys.json", "toys--bias.tsv")
    }
    assert (tmp_path / "toys--bias.tsv").read_text() == "before"
    assert read_tsv(tmp_path / "toy--bias.tsv") == [
        {"case": "a|b", "|mm|": "0.012", "target": "≤ 0.02", "met": "met"},
        {"case": "c", "|mm|": "n/a", "target": "≤ 0.02", "met": "missed"},
    ]
    record = json.loads((tmp_path / "toy.json").read_text("utf-8"))
    assert record["tables"] == [{"file": "toy--bias.tsv", "title": "Bias", "notes": "Read it so."}]
    assert record["figures"] == [{"file": "toy.png", "caption": "A falling line."}]
    assert (record["title"], record["text"], record["command"]) == (
        "Toys",
        "Why.",
        "the command",
    )
    assert record["commit"] == "1234abc"


def test_the_commit_is_that_of_the_checkout_if_git_is_there(tmp_path, monkeypatch):
    assert re.fullmatch(r"[0-9a-f]{7,40}(-dirty)?|n/a", commit())
    monkeypatch.setenv("PATH", str(tmp_path))
    assert commit() == "n/a"


def test_every_suite_asks_something():
    assert QUESTIONS.keys() == SUITES.keys()


def test_files_of_the_documentation_are_those_that_records_or_pages_name():
    records = {path.stem: json.loads(path.read_text("utf-8")) for path in FOLDER.glob("*.json")}
    assert SUITES.keys() <= records.keys()
    entries = [e for r in records.values() for e in (*r["tables"], *r["figures"])]
    named = {entry["file"] for entry in entries}
    found = {path.name for path in FOLDER.iterdir() if path.suffix in {".tsv", ".png"}}
    assert named <= found
    pages = "".join(path.read_text("utf-8") for path in FOLDER.parent.glob("*.md"))
    assert all(f"(validation/{name})" in pages for name in found - named)
    assert all(read_tsv(FOLDER / name) for name in found if name.endswith(".tsv"))


@pytest.mark.parametrize("name", SUITES)
def test_tables_of_the_documentation_are_those_of_the_suite(name):
    record = json.loads((FOLDER / f"{name}.json").read_text("utf-8"))
    texts = _TABLE[name]
    assert (record["title"], record["question"]) == (texts["title"], texts["question"])
    titles = {f"{name}--{key}.tsv": table["title"] for key, table in texts["tables"].items()}
    assert {entry["file"]: entry["title"] for entry in record["tables"]}.items() <= titles.items()


def test_figures_are_png_and_the_same_each_time():
    first = render(PICTURE)
    assert first[:8] == b"\x89PNG\r\n\x1a\n"
    assert struct.unpack(">II", first[16:24]) == (300, 200)  # 3 x 2 inches, 100 dpi
    assert first == render(PICTURE)


def test_command_writes_the_report(tmp_path, capsys, one_suite):
    assert command.main(["--full", "--out", str(tmp_path / "a b")]) == ExitCode.OK
    said = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"Toys: 1 of 2 targets met; \d+ s, \d+ s of CPU time", said[0])
    assert said[1] == f"targets missed: 1; report: {tmp_path / 'a b'}"
    assert one_suite == [True]
    assert (tmp_path / "a b/toy.png").read_bytes() == render(PICTURE)
    record = json.loads((tmp_path / "a b/toy.json").read_text("utf-8"))
    assert record["command"] == "python -m validation --suite toy --full"
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", record["date"])
    assert record["seconds"] >= 0
    assert record["cpu_seconds"] >= 0


def test_suites_of_this_code_and_form_are_skipped_unless_again(
    tmp_path, monkeypatch, capsys, one_suite
):
    run = ["--out", str(tmp_path)]
    for options in ([], [], ["--full"], ["--full"], ["--full", "--again"]):
        assert command.main([*run, *options]) == ExitCode.OK
    assert one_suite == [False, True, True]
    assert capsys.readouterr().out.count("toy: skipped, its record is of this code") == 2
    monkeypatch.setattr("validation.report.changed", lambda *_: ["hipsta_bids.geometry"])
    assert command.main([*run, "--full"]) == ExitCode.OK
    assert one_suite == [False, True, True, True]


def test_a_suite_that_is_interrupted_keeps_those_before_it(tmp_path, monkeypatch, one_suite):
    def stop(_full):
        raise KeyboardInterrupt

    monkeypatch.setitem(sys.modules, "validation.stopped", SimpleNamespace(run=stop))
    monkeypatch.setattr("validation.report.SUITES", {"toy": "toys:run", "stopped": "stopped:run"})
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            command.main(["--out", str(tmp_path)])
    assert one_suite == [False]
    assert {path.name for path in tmp_path.glob("*.json")} == {"toy.json"}


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
def test_a_suite_of_which_nothing_is_measured_misses_all_targets(monkeypatch, tmp_path, name):
    lost = Refusal(reason="crash", message="a bug")
    monkeypatch.setattr(cases, "run_cases", lambda _, given, **__: [lost for _ in given])
    suite = run_suite(name, full=False)
    assert suite.missed == suite.targets > 0
    # All that texts name in braces is known.
    write(replace(suite, pictures=()), tmp_path, {})
    assert not re.search(r"\{\w", (tmp_path / f"{name}.json").read_text("utf-8"))


@pytest.mark.usefixtures("one_suite")
def test_a_suite_is_found_by_its_name():
    assert run_suite("toy", full=False).title == "Toys"


def test_tables_and_numbers_of_the_page_are_those_of_the_records():
    from validation_pages import claims_page  # noqa: PLC0415  (reads all records)

    assert (FOLDER.parent / "validation.md").read_text("utf-8") == claims_page(), (
        "run tools/make-docs"
    )
