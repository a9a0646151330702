"""Which code records depend on, and what of it counts."""

import subprocess
import sys

import pytest

from validation import sources
from validation.report import modules_of, stale
from validation.sources import code_of

TEXT = '''"""Why."""
from pathlib import Path  # a comment

if TYPE_CHECKING:
    from fake.typed import Kind


class Thing:
    """A thing."""

    size: int = 1
    """Of it."""

    def grow(self):
        """Grow."""
        from fake import other

        return f"{other.size:.{self.size}f} hipsta_bids"


START = "hipsta_bids.geometry.tetgen_worker"
'''


@pytest.fixture
def spell(tmp_path):
    """Spell a text as a module in a file of its own."""
    count = iter(range(99))

    def write(text):
        path = tmp_path / f"{next(count)}.py"
        path.write_text(text)
        return sources._spell(path), sources._imports(path)

    return write


def test_comments_docstrings_and_layout_do_not_count(spell):
    bare = (
        TEXT.replace('"""A thing."""', "")
        .replace('    """Of it."""\n', "")
        .replace("  # a comment", "")
        .replace("(self)", "(\n        self,\n    )")
    )
    assert bare != TEXT
    assert spell(bare)[0] == spell(TEXT)[0]


@pytest.mark.parametrize(
    ("old", "new"), [("= 1", "= 2"), ("size:.", "size:0."), (" hipsta", "hipsta"), ("int", "float")]
)
def test_everything_else_counts(spell, old, new):
    assert spell(TEXT.replace(old, new))[0] != spell(TEXT)[0]


def test_imports_are_those_at_work_wherever_they_stand(spell):
    names = set(spell(TEXT)[1])
    assert {"pathlib", "fake", "fake.other", "hipsta_bids.geometry.tetgen_worker"} <= names
    assert "fake.typed" not in names


def test_suites_depend_on_what_they_measure_with():
    shapes, cohorts = code_of(*modules_of("accuracy")), code_of(*modules_of("group"))
    assert {"hipsta_bids.geometry", "hipsta_bids.protocols", "validation.accuracy"} <= {*shapes}
    assert {"hipsta_bids.stats", "hipsta_bids.group", "validation.group"} <= {*cohorts}
    assert not {"hipsta_bids.stats", "validation.group"} & {*shapes}
    assert not {"hipsta_bids.geometry", "validation.accuracy"} & {*cohorts}
    # What shows and writes results changes none, nor does the version.
    apart = {"hipsta_bids", "hipsta_bids.reports", "hipsta_bids.cli", "validation.report"}
    assert not apart & {*shapes, *cohorts}
    assert "hipsta_bids.extensions.visits" in code_of(*modules_of("visits"))
    assert "benchmarks.hipsta" in code_of(*modules_of("beside-hipsta"))


def test_a_record_names_the_folders_that_changed():
    code = dict(code_of(*modules_of("norms")))
    assert stale("norms", {"code": code}) == []
    code["hipsta_bids.stats"] = "other"
    code["hipsta_bids.gone"] = "1"
    del code["validation.norms"]
    changed = ["hipsta_bids.gone", "hipsta_bids.stats", "validation.norms"]
    assert stale("norms", {"code": code}) == changed
    assert stale("norms", {}) == sorted(code_of(*modules_of("norms")))


def test_the_hash_needs_no_git_and_no_order():
    code = "from validation.sources import code_of; print(code_of('validation.norms'))"
    env = {"PATH": "", "PYTHONHASHSEED": "7", "PYTHONPATH": ":".join(filter(None, sys.path))}
    done = subprocess.run(
        [sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == str(code_of("validation.norms"))
