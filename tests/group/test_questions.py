"""The page of questions: its commands are understood, work, and write the numbers it names.

All of them take minutes: ``tools/test-questions`` runs them, which sets HIPSTA_BIDS_QUESTIONS.
"""

import os
import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import small_cohorts
from extension_marks import needs
from norm_cohorts import write_people

from hipsta_bids.cli.group import group_parser
from hipsta_bids.cli.main import main
from hipsta_bids.extensions import NAMES
from hipsta_bids.io import files
from validation.group import simulate_cohort

PAGE = Path(__file__).parents[2] / "docs" / "questions.md"
#: Extensions by what shows in a command that it needs them.
EXTENSIONS = {
    " --(paired|longitudinal|endpoint)": "repeated",
    " --harmonize": "sites",
    "-bids meta ": "consortia",
    " --(norms|normative)": "norms",
    " --(power|retest)": "trials",
    " --mask": "maps",
    " --joint": "combination",
    " --percent": "percent",
    " --regions": "parcels",
    r"\(1\|": "multilevel",
    r" & |\| <": "conjunctions",
}
#: Studies by what shows in a command that it needs their data.
STUDIES = {" --(paired|longitudinal|endpoint|retest|visits)": "visits", " --norms": "people"}


def read_rows():
    """Yield question, command lines and numbers (``FILE:COLUMN``, perhaps ``:KEY=VALUE``)."""
    for line in PAGE.read_text(encoding="utf-8").splitlines():
        cells = [cell.replace(r"\|", "|") for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        if len(cells) > 1 and "hipsta-bids " in cells[1]:
            commands, numbers = (re.findall("`([^`]+)`", cell) for cell in cells[1:])
            yield cells[0].split("*")[0].strip(), "\n".join(commands), numbers


def find(signs, commands):
    """Return the values whose sign a row has."""
    return [value for sign, value in signs.items() if re.search(sign, commands)]


each_row = pytest.mark.parametrize(
    ("commands", "numbers"),
    [
        pytest.param(*row, id=question, marks=[*map(needs, find(EXTENSIONS, row[0]))])
        for question, *row in read_rows()
    ],
)


def test_the_page_has_25_questions_and_the_extensions_of_their_commands():
    questions, commands, numbers = zip(*read_rows(), strict=True)
    assert len(set(questions)) == len(questions) == 25
    assert all(commands)
    assert all(numbers)
    used = find(EXTENSIONS, "\n".join(commands))
    assert used == list(EXTENSIONS.values())
    assert set(used) <= set(NAMES)


@each_row
def test_commands_are_understood(commands, numbers):  # noqa: ARG001  (of each row)
    for program, *arguments in map(shlex.split, commands.splitlines()):
        assert program == "hipsta-bids"
        if arguments[0] == "meta":
            from hipsta_bids.extensions.consortia.commands import meta_parser  # noqa: PLC0415

            meta_parser().parse_intermixed_args(arguments[1:])
        else:
            group_parser().parse_args(arguments)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Make studies: a cohort, visits, two sites, and a reference with scored participants."""
    folder = tmp_path_factory.mktemp("studies")
    plan, losses = small_cohorts.PLAN, 0.03 + 0.02 * np.random.default_rng(0).random(24)
    for name, sizes in {"cohort": (24, 24), "A": (24, 24), "B": (22, 20)}.items():
        data, _ = small_cohorts.write_dataset(folder / name, plan=replace(plan, sizes=sizes))
        write_participants(data, ["CN"] * sizes[0] + ["AD"] * sizes[1])
    nodes = [(f"{x + 1}", f"{y + 1}") for x, y in np.ndindex(7, small_cohorts.NODES[1])]
    files.write_tsv(folder / "cohort" / "bids" / "outside.tsv", ["x", "y"], nodes)
    walls = simulate_cohort(replace(plan, sizes=(12, 12), effect=0.0), 0)
    years = {"column": "years", "times": lambda _, year: f"{year}"}
    data, _ = small_cohorts.write_sessions(folder / "visits", walls, losses, noise=0.03, **years)
    write_participants(data, ["CN", "AD"] * 12)
    write_people(folder / "reference", {"A": 62, "B": 48}, 1)
    write_people(folder / "people", {"A": 20, "B": 26}, 2, cases=8)
    return folder


def write_participants(data, groups):
    """Write a table with all columns of the page."""
    random = np.random.default_rng(1)
    columns = ("participant_id", "group", "age", "sex", "site", "stage", "arm", "memory")
    factors = [(5, "F M"), (3, "a b c d"), (1, "CN MCI AD"), (2, "placebo active")]
    rows = []
    for i, group in enumerate(groups):
        levels = [text.split()[i // run % len(text.split())] for run, text in factors]
        age, memory = random.normal(70, 6), random.normal(25, 3)
        rows.append([f"sub-{i + 1:02d}", group, f"{age:.1f}", *levels, f"{memory:.1f}"])
    small_cohorts.write_participants(data, rows, columns)


def with_places(commands):
    """Replace the folders of a row."""
    study = next(iter(find(STUDIES, commands)), "cohort")
    known = {"DIR": study, "A": "A", "B": "B"}
    commands = re.sub("REFERENCE_(DIR|OUT)", r"reference/\1", commands)
    commands = re.sub("(BIDS|OUT)_(DIR|A|B)", lambda text: f"{known[text[2]]}/{text[1]}", commands)
    return commands.replace("/DIR", "/bids").replace("/BIDS", "/bids").replace("/OUT", "/out")


@pytest.mark.skipif(
    os.environ.get("HIPSTA_BIDS_QUESTIONS") != "required", reason="run tools/test-questions"
)
@pytest.mark.usefixtures("without_figures")
@each_row
def test_commands_write_the_numbers_of_the_sentence(commands, numbers, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    for results in folder.glob("*/out/group"):
        shutil.rmtree(results)
    for command in with_places(commands).splitlines():
        assert main(shlex.split(command)[1:]) == 0
    places = re.findall("^results: (.+)", capsys.readouterr().out, re.MULTILINE)
    for name, column, *condition in (text.split(":", 2) for text in numbers):
        path = next(filter(Path.exists, (Path(place) / name for place in reversed(places))))
        rows = small_cohorts.table(path)
        for key, value in (text.split("=", 1) for part in condition for text in part.split("&")):
            rows = rows[rows[key] == value]
        assert rows[column].notna().any(), (path, column, condition)
        if (column, condition) == ("n_significant", ["contrast=CN-AD"]):
            assert rows[column].max() > 0  # the effect of the simulated cohort
