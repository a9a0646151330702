"""The extension that the documentation writes from scratch: it is built from there, and runs."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from small_cohorts import write_dataset

import hipsta_bids

ROOT = Path(__file__).resolve().parents[1]
_BLOCK = re.compile(
    r"^```python\n# (hipsta_bids/extensions/\S+)\n(.*?)^```", re.MULTILINE | re.DOTALL
)


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    """A copy of the package with the extension; a function that runs its group level."""
    folder = tmp_path_factory.mktemp("copy")
    package = Path(hipsta_bids.__file__).parent
    shutil.copytree(package, folder / "hipsta_bids", ignore=shutil.ignore_patterns("__pycache__"))
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    blocks = _BLOCK.findall(text)
    assert len(blocks) == 2
    assert sum(len(code.splitlines()) for _, code in blocks) <= 80
    for name, code in blocks:
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(code, encoding="utf-8")
    registry = folder / "hipsta_bids" / "extensions" / "__init__.py"
    registry.write_text(registry.read_text(encoding="utf-8") + 'NAMES = (*NAMES, "medians")\n')
    write_dataset(folder)

    def run(*options):
        return subprocess.run(
            [sys.executable, "-m", "hipsta_bids.cli", "bids", "out", "group", *options],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(folder), "HIPSTA_BIDS_INSTALLED": ""},
            capture_output=True,
            text=True,
            check=False,
        )

    return folder, run


def test_the_option_adds_its_table(example):
    folder, run = example
    options = ("--align", "none", "--no-reports", "--no-classification")
    done = run("--medians", "thickness", "--name", "model", *options)
    assert done.returncode == 0, done.stderr
    table = pd.read_csv(folder / "out" / "group" / "model" / "medians.tsv", sep="\t")
    assert f"medians.tsv has {len(table)} rows" in done.stdout
    assert len(table) > 10
    for row in table.itertuples():
        (sheet,) = (folder / "out" / row.participant_id).rglob(f"*hemi-{row.hemi}*sheet_morph.tsv")
        thickness = pd.read_csv(sheet, sep="\t", na_values="n/a")["thickness"]
        assert row.median == pytest.approx(thickness.median(), abs=1e-6)


def test_a_name_that_is_no_map_is_one_line(example):
    _, run = example
    done = run("--medians", "length", "--name", "wrong", "--no-reports")
    assert done.returncode == 65
    assert "--medians length: no map of this name" in done.stderr.splitlines()[-1]


def test_the_option_is_in_the_help(example):
    _, run = example
    assert "--medians [MEASURE]" in run("--help", "all").stdout
