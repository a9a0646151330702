"""``import hipsta_bids as hb``: what it offers, that it loads nothing, and that examples hold."""

import doctest
import inspect
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
from extension_marks import PRESENT, needs

import hipsta_bids as hb
from hipsta_bids.errors import ExitCode

MODULES = (
    *(f"hipsta_bids.api.{name}" for name in ("maps", "datasets", "plots")),
    "hipsta_bids.api.models",
)
#: What 1.x promises: names may be added here, none may be removed or renamed before 2.0.
NAMES = (
    *("correlate", "example", "figure", "group", "load", "measure", "plot_group", "plot_sheet"),
    *("plot_surface", "register"),
)
CODES = {0, 1, 64, 65, 66, 70, 73}
LIBRARIES = ("xarray", "matplotlib.pyplot")


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


def loaded(program):
    program = f"import sys; {program}; print(*(m in sys.modules for m in {LIBRARIES}))"
    done = subprocess.run(
        [sys.executable, "-c", program], check=True, capture_output=True, text=True
    )
    return dict(zip(LIBRARIES, done.stdout.split(), strict=True))


def test_the_command_line_needs_no_xarray():
    """Images do without it."""
    modules = ("cli.main", "participant.run", "group.questions.compare", "api.figures")
    names = ", ".join(f"hipsta_bids.{name}" for name in modules)
    assert loaded(f"import {names}")["xarray"] == "False"


def test_the_interface_opens_no_window_system():
    assert loaded("import hipsta_bids as hb; hb.load; hb.plot_sheet") == {
        "xarray": "True",
        "matplotlib.pyplot": "False",
    }


def test_group_has_the_signature_and_text_of_its_function():
    function = import_module("hipsta_bids.api.models").group
    assert inspect.signature(hb.group) == inspect.signature(function)
    assert list(inspect.signature(hb.group).parameters)[:3] == ["maps", "table", "formula"]
    assert inspect.getdoc(hb.group) == inspect.getdoc(function)
    with pytest.raises(TypeError, match="missing 2 required positional arguments"):
        hb.group(None)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=needs("agreement")) if name == "correlate" else name
        for name in hb.__all__
    ],
)
def test_every_name_is_there_and_documented(name):
    found = getattr(hb, name)
    assert name in dir(hb)
    assert callable(found)
    for section in ("Parameters", "Returns", "Raises", "Examples"):
        assert f"\n    {section}\n    ---" in found.__doc__


def test_names_and_exit_codes_are_the_promised_and_the_documented_ones():
    page = (Path(__file__).parents[2] / "docs" / "api.md").read_text(encoding="utf-8")
    assert tuple(hb.__all__) == NAMES
    assert tuple(re.findall(r"`hb\.(\w+)`", page)) == NAMES
    assert set(ExitCode) == CODES  # with their meaning in docs/command-line.md: test_project.py
    paths = [f".{name}\n" for name in NAMES]
    assert [path for path in paths if path not in page.partition("## One hemisphere")[0]] == []


def test_functions_of_the_reference_have_their_sections():
    """As docs/python.md promises; only a function without parameters has no errors."""
    page = (Path(__file__).parents[2] / "docs" / "api.md").read_text(encoding="utf-8")
    count = 0
    for path in re.findall(r"^::: (.+)$", page, re.MULTILINE):
        module, _, name = path.rpartition(".")
        if ".extensions." in path and path.split(".")[2] not in PRESENT:
            continue
        target = getattr(import_module(module), name)
        if inspect.isfunction(target):
            sections = [
                "Returns",
                *["Parameters", "Raises"] * bool(inspect.signature(target).parameters),
            ]
            lines = inspect.getdoc(target).splitlines()
            assert [section for section in sections if section not in lines] == [], path
            count += 1
    assert count > len(NAMES)


def test_other_names_are_refused():
    with pytest.raises(AttributeError, match="sheet_plot"):
        _ = hb.sheet_plot


@pytest.mark.skipif("agreement" in PRESENT, reason="the extension is there")
def test_the_name_of_a_deleted_function_is_refused():
    with pytest.raises(AttributeError, match="its extension was deleted"):
        _ = hb.correlate
