"""Names that the rules exclude, counted in known sources; and names of tests in scripts."""

import re
from pathlib import Path

import names
import pytest

ROOT = Path(__file__).resolve().parents[2]

BINDINGS = """
import other
from dataclasses import dataclass

@dataclass
class Sheet:
    own: int
    rows: int = 0

def found(given, *, rest=0, **_others):
    one = given.most
    for here, row in rest:
        with here as there:
            known, (why, column) = there
    if (told := [kept for kept in one if kept]):
        return lambda who: who
    each.same = known[what]
"""

IMPORTS = """
from hipsta_bids.stats import glm
from hipsta_bids.io.files import (
    read_table,
)
from numpy import (
    ndarray,
)
if True:
    from hipsta_bids.types import (
        Float,
    )
"""


def test_every_kind_of_binding_is_counted_and_every_use_is_not() -> None:
    counted = " ".join(name for _, name in sorted(names.names(BINDINGS)))
    assert counted == "own _others given rest one here there known why kept told who"


def test_imports_of_the_package_alone_are_counted() -> None:
    lines = [line for line, _ in names.imports(IMPORTS)]
    assert lines == [3, 10]


def test_dialect_is_counted_in_names_comments_and_docstrings_with_the_fields_words() -> None:
    source = """own_rows = found("told")  # beside
def tell():
    '''Read what
    was found.'''
"""
    counted = [(line, word.partition(":")[0]) for line, word in names.dialect(source)]
    assert counted == [(1, "own"), (1, "found"), (1, "beside"), (2, "tell"), (4, "found")]
    assert next(names.dialect("told = 1")) == (1, "told: reported")


def test_only_a_count_above_the_budget_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "module.py").write_text(BINDINGS)
    counts = ("names", str(tmp_path))
    for budget, exit_code, printed in ((12, 0, False), (11, 1, True), (13, 0, True)):
        monkeypatch.setitem(names.BUDGETS, "names", budget)
        assert names.main(counts) == exit_code
        assert (f"the budget in {names.__file__} is {budget}" in capsys.readouterr().out) is printed


def test_the_list_names_file_and_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "module.py"
    path.write_text("found = 1\nresult = found\nwhy = found\n")
    assert names.main(["names", "--list", str(path)]) == 0
    assert capsys.readouterr().out == f"{path}:1 found\n{path}:3 why\n"


def test_long_checks_name_tests_that_exist():
    scripts = sorted((ROOT / "tools").glob("test-*"))
    named = {
        (script.name, pattern)
        for script in scripts
        for pattern in re.findall(r"\btests/[\w/*]+\.py\b", script.read_text("utf-8"))
    }
    assert len(named) > 3
    assert not [(name, pattern) for name, pattern in named if not any(ROOT.glob(pattern))]


def test_the_fuzz_check_finds_the_modules_of_the_tests():
    (folder,) = re.findall(r'\$here/\.\./(\w+)"', (ROOT / "tools/test-fuzz").read_text("utf-8"))
    inputs = (ROOT / "tools/fuzz_inputs.py").read_text("utf-8")
    modules = re.findall(r'import_module\("(\w+)"\)', inputs)
    assert len(modules) > 1
    assert [name for name in modules if not (ROOT / folder / f"{name}.py").is_file()] == []
