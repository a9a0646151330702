"""``import hipsta_bids as hb``: what it offers, that it loads nothing, and that examples hold."""

import doctest
import subprocess
import sys
from importlib import import_module

import pytest

import hipsta_bids as hb

MODULES = ("hipsta_bids.api.maps", "hipsta_bids.api.plots", "hipsta_bids.group.questions.models")


@pytest.mark.parametrize("module", MODULES)
def test_examples_in_docstrings_hold(module):
    result = doctest.testmod(import_module(module))
    assert result.attempted > 5
    assert result.failed == 0


def test_import_loads_no_other_module():
    program = "import sys; before = set(sys.modules); import hipsta_bids"
    program += "; print(sorted(set(sys.modules) - before))"
    done = subprocess.run(
        [sys.executable, "-c", program], check=True, capture_output=True, text=True
    )
    assert done.stdout.strip() == "['hipsta_bids']"


def test_a_measurement_needs_no_xarray():
    program = "import sys; import hipsta_bids as hb; hb.measure; hb.group; hb.load; hb.plot_sheet"
    program += "; print('xarray' in sys.modules, 'matplotlib.pyplot' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", program], check=True, capture_output=True, text=True
    )
    assert done.stdout.strip() == "False False"


@pytest.mark.parametrize("name", hb.__all__)
def test_every_name_is_there_and_documented(name):
    found = getattr(hb, name)
    assert name in dir(hb)
    assert callable(found)
    target = import_module("hipsta_bids.group.questions.models").group if name == "group" else found
    for section in ("Parameters", "Returns", "Raises", "Examples"):
        assert f"\n    {section}\n    ---" in target.__doc__


def test_other_names_are_refused():
    with pytest.raises(AttributeError, match="sheet_plot"):
        _ = hb.sheet_plot
