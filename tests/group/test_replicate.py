"""The guide that repeats the paper's analyses: its files, its commands and its table of numbers.

The whole of it takes minutes: ``tools/test-tutorials`` runs it, which sets HIPSTA_BIDS_TUTORIALS.
"""

import csv
import io
import os
import re
import tomllib
from contextlib import redirect_stdout
from pathlib import Path

import pandas as pd
import pytest
from small_cohorts import table
from test_tutorials import DOCS, commands, whole

from hipsta_bids.cli.commands import compare_parser, phantom_parser, surrogate_parser
from hipsta_bids.cli.group import group_parser
from hipsta_bids.cli.main import main
from hipsta_bids.cli.participant import build_parser
from hipsta_bids.group.design.settings import GroupSettings
from hipsta_bids.settings import PUBLISHED, Settings

PAGE = (DOCS / "replicate.md").read_text()
PUBLISHED_TABLE = DOCS / "replicate.tsv"
ITEMS = [f"figure {n}" for n in (2, 3, 4, 5, 6, 7, "A1")] + [
    f"table {n}" for n in (3, 5, 6, 7, 8, 9, "A2", "A5", "A6", "A7", "A8")
]
NUMBERS = ("effect", "t", "p", "auc_base", "auc_full")


@pytest.fixture(scope="module", autouse=True)
def without_pages():
    """Let runs make pages here, as the commands do."""


def code(language):
    """List the blocks of the page in a language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


def commands_of_page():
    """List command lines without the program's name."""
    plain = re.sub(r"^```\w+\n.*?^```\n", "", PAGE, flags=re.MULTILINE | re.DOTALL)
    return [line for line, _ in commands(plain)]


def test_the_settings_of_the_page_are_those_of_the_published_method():
    participant, group = (tomllib.loads(text) for text in code("toml"))
    Settings().changed(**participant)  # names and ranges are checked
    grid = {"x_extent": 0.9, "y_extent": 0.975, "z_extent": 0.9, "z_nodes": 11}
    preset = {name: dict(values) for name, values in PUBLISHED.items()}
    assert participant == preset | {"sheet": preset["sheet"] | grid}
    checked = GroupSettings.model_validate(group)
    assert not checked.registration.standardize
    assert not checked.registration.center


def test_the_commands_of_the_page_are_understood():
    first, *_ = every = commands_of_page()
    named = {"phantom", "surrogate", "compare"}
    kinds = [line[0] if line[0] in named else line[2] for line in every]
    assert kinds == ["phantom", "participant", "group", "surrogate", *kinds[:3], "compare"]
    assert phantom_parser().parse_args(first[1:]).groups == ["CU", "MCI", "DAT"]
    for line in every:
        if "participant" in line:
            options = build_parser().parse_args(line)
            assert options.method == "published"
        elif line[0] == "surrogate":
            surrogate_parser().parse_args(line[1:])
        elif line[0] == "compare":
            names = [
                text.partition("=")[0] for text in compare_parser().parse_args(line[1:]).analyses
            ]
            assert names == ["published", "ashs"]
        elif "group" in line:
            assert len(group_parser().parse_args(line).contrast) == 5


def test_the_table_has_all_figures_and_tables_and_no_number_without_a_source():
    with PUBLISHED_TABLE.open(newline="") as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    assert list(rows[0]) == ["item", "measure", "hemi", "contrast", *NUMBERS, "source"]
    assert list(dict.fromkeys(row["item"] for row in rows)) == ITEMS
    for row in rows:
        known = [name for name in NUMBERS if row[name] != "n/a"]
        assert (row["source"] != "n/a") == bool(known)
    columns = re.search(r"`replicate.tsv` has the columns (.*?)\. ", PAGE, re.DOTALL)[1]
    assert re.findall(r"`(\w+)`", columns) == list(rows[0])


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """The folder in which every command of the page was run."""
    folder = tmp_path_factory.mktemp("replicate")
    before = Path.cwd()
    os.chdir(folder)
    for name, text in zip(("published", "published-group"), code("toml"), strict=True):
        Path(f"{name}.toml").write_text(text)
    for line in commands_of_page():
        assert main(line) == 0, line
    yield folder
    os.chdir(before)


@whole
def test_every_file_and_column_of_the_page_is_there(study):
    rows = re.findall(r"^\| .*? \| (`.*?) \| (.*?) \|$", PAGE, re.MULTILINE)
    assert len(rows) == 7
    columns = ""
    for out in ("out", "out-ashs"):
        folder = study / out / "group" / "published"
        for files, names in rows:
            columns = columns if names == "the same" else names
            wanted = set(re.findall(r"`(\w+)`", columns))
            for pattern in re.findall(r"`([^`]+)`", files):
                found = list(folder.glob(pattern))
                assert found, pattern
                tables = [table(path) for path in found if path.suffix == ".tsv"]
                wanted -= {name for one in tables for name in one.columns}
            assert not wanted
    assert list((study / "out").rglob("*_desc-surrogate_morph.tsv"))


@whole
def test_the_planted_loss_is_found_with_both_segmentations(study):
    for out in ("out", "out-ashs"):
        rows = table(study / out / "group" / "published" / "measures.tsv")
        thin = rows[(rows.measure == "thickness_mean_CA1") & (rows.contrast == "CU-DAT")]
        assert len(thin) == 3
        assert ((thin.estimate > 0) & (thin.p_fdr < 0.05)).all()


@whole
def test_both_segmentations_are_in_one_table(study):
    """The planted loss is in both, so that effect maps of the dementia group go together."""
    rows = table(study / "segmentations" / "agreement.tsv")
    thickness = rows[(rows.measure == "thickness") & (rows.contrast == "CU-DAT")]
    assert len(thickness) == 2
    assert (thickness.r > 0).all()


@whole
def test_numbers_that_a_reader_enters_stand_beside_those_of_the_cohort(study):
    own = table(study / "out" / "group" / "published" / "measures.tsv")
    entered = dict.fromkeys(["item", "measure", "hemi", "contrast", *NUMBERS, "source"], "n/a")
    entered |= {"item": "table 5", "measure": "thickness_nodes", "hemi": "L"}
    entered |= {"contrast": "CU-MCI", "effect": "0.1", "t": "2.5", "p": "0.01"}
    pd.DataFrame([entered]).to_csv(study / "replicate.tsv", sep="\t", index=False)
    (script,) = code("python")
    scope = {}
    with redirect_stdout(io.StringIO()) as printed:
        exec(script, scope)  # noqa: S102 -- the page's own example
    (row,) = scope["both"].itertuples()
    keys = (own.measure == "thickness_nodes") & (own.hemi == "L") & (own.contrast == "CU-MCI")
    assert row.statistic == own[keys].statistic.iloc[0]
    assert row.t == 2.5
    assert row.p_own == own[keys].p.iloc[0]
    assert "thickness_nodes" in printed.getvalue()
