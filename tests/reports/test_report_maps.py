"""Figures where there is no screen and no home."""

import subprocess
import sys
from pathlib import Path

import pytest

import hipsta_bids
from hipsta_bids.reports.maps import usual_subfields

PACKAGE = Path(hipsta_bids.__file__).parents[1]
DRAW = """
import os
from hipsta_bids.reports.maps import new_figure
before = dict(os.environ)
new_figure((2, 2), "constrained").savefig("figure.png")
assert dict(os.environ) == before
"""


@pytest.mark.parametrize(
    "surroundings",
    [
        # Where nobody can make folders, not even root.
        {"HOME": "/proc/nobody", "MPLBACKEND": "no-such-backend"},
        # A file, and not one of preferences.
        {"MPLCONFIGDIR": "/proc/nobody", "MATPLOTLIBRC": "/proc/version"},
    ],
    ids=str,
)
def test_drawing_minds_no_surroundings(tmp_path, surroundings):
    aside = tmp_path / "aside"
    aside.mkdir()
    environment = {"PYTHONPATH": str(PACKAGE), "TMPDIR": str(aside)} | surroundings
    run = subprocess.run(
        [sys.executable, "-c", DRAW],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.stderr == ""
    assert run.returncode == 0
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")
    assert not list(aside.iterdir())


TIES = """
import hipsta_bids
from hipsta_bids.reports.maps import usual_subfields
print(usual_subfields([["CA2", "CA1", "CA1", "CA2"], ["Sub", "CA1", "CA1"], ["DG", "CA3"]]))
"""


@pytest.mark.parametrize("seed", ["0", "2"])
def test_of_subfields_as_frequent_the_first_is_named_in_every_process(seed):
    assert usual_subfields([["b", "a"]]) == ["b"]
    run = subprocess.run(
        [sys.executable, "-c", TIES],
        env={"PYTHONPATH": str(PACKAGE), "PYTHONHASHSEED": seed},
        capture_output=True,
        text=True,
        check=True,
    )
    assert run.stdout == "['CA2', 'CA1', 'DG']\n"
