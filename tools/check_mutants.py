"""Ask how strong the tests are: change single operators of the code and see whether a test fails.

    tools/check_mutants.py map                  record which tests run which lines (minutes)
    tools/check_mutants.py run --count 200      try mutants, list the survivors

A mutant has one comparison or operator of ``geometry/`` or ``group/`` replaced. It is killed if a
test of those that run its line fails, or takes far too long; lines that no test runs count as
survivors. Tests that start processes of their own see the code as it is on disk, so that the share
is a lower limit.
"""

import argparse
import ast
import importlib.abc
import importlib.machinery
import importlib.util
import io
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from types import CodeType
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("geometry", "group")
TESTS = ("tests/geometry", "tests/group", "tests/participant", "tests/validation")
RECORD = ROOT / "build" / "mutants"
PATIENCE = 240  # s for the tests of one mutant
LEAST = 0.9  # of the mutants have to be killed

ORDER = (ast.Lt, ast.LtE, ast.Gt, ast.GtE, ast.Eq, ast.NotEq)
ARITHMETIC = (ast.Add, ast.Sub, ast.Mult, ast.Div, ast.FloorDiv, ast.Mod, ast.Pow)
#: Operators that replace each other.
FAMILIES: tuple[tuple[type[ast.AST], ...], ...] = (
    *(ORDER, ARITHMETIC, (ast.Is, ast.IsNot), (ast.In, ast.NotIn)),
    *((ast.And, ast.Or), (ast.BitAnd, ast.BitOr), (ast.MatMult, ast.Mult)),
)
OTHERS = {
    kind: tuple(other for other in family if other is not kind)
    for family in reversed(FAMILIES)
    for kind in family
}


@dataclass(frozen=True)
class Mutant:
    """One operator of one file, replaced."""

    path: str
    """Relative to the project."""
    line: int
    index: int
    """Of the operator among those of the file."""
    what: str

    @property
    def module(self) -> str:
        """Dotted name of the file's module."""
        return ".".join(Path(self.path).with_suffix("").parts)


class _Replace(ast.NodeTransformer):
    """Number the operators of a file and replace one of them, if its number is given."""

    def __init__(self, wanted: int | None = None) -> None:
        self.wanted, self.found = wanted, list[tuple[int, str]]()

    def _other(self, node: ast.AST, line: int) -> Any:  # noqa: ANN401  (of the node's own kind)
        others = OTHERS.get(type(node))
        if others is None:
            return node
        number = len(self.found)
        other = others[number % len(others)]
        self.found.append((line, f"{type(node).__name__} -> {other.__name__}"))
        return other() if number == self.wanted else node

    def visit_Compare(self, node: ast.Compare) -> ast.AST:
        self.generic_visit(node)
        node.ops = [self._other(op, node.lineno) for op in node.ops]
        return node

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        self.generic_visit(node)
        parts = (node.left, node.right)
        if not any(isinstance(p, ast.Constant) and isinstance(p.value, str) for p in parts):
            node.op = self._other(node.op, node.lineno)
        return node

    def visit_BoolOp(self, node: ast.BoolOp) -> ast.AST:
        self.generic_visit(node)
        node.op = self._other(node.op, node.lineno)
        return node

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:
        if node.value is not None:  # types are no code
            node.value = self.visit(node.value)
        return node

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        node.body = [self.visit(statement) for statement in node.body]
        return node


def mutants() -> Iterator[Mutant]:
    """List all mutants of the folders."""
    for folder in FOLDERS:
        for path in sorted((ROOT / "hipsta_bids" / folder).glob("*.py")):
            search = _Replace()
            search.visit(ast.parse(path.read_text(encoding="utf-8")))
            for index, (line, what) in enumerate(search.found):
                yield Mutant(str(path.relative_to(ROOT)), line, index, what)


class _Finder(importlib.abc.MetaPathFinder):
    """Imports one module with one operator replaced."""

    def __init__(self, mutant: Mutant) -> None:
        self.mutant = mutant

    def find_spec(self, name: str, *_: object) -> importlib.machinery.ModuleSpec | None:
        """Find the mutated module only."""
        if name != self.mutant.module:
            return None
        path = ROOT / self.mutant.path
        mutant = self.mutant

        class Loader(importlib.machinery.SourceFileLoader):
            def get_code(self, _name: str) -> CodeType:
                tree = ast.parse(path.read_text(encoding="utf-8"))
                tree = ast.fix_missing_locations(_Replace(mutant.index).visit(tree))
                return compile(tree, str(path), "exec")

        return importlib.util.spec_from_file_location(name, path, loader=Loader(name, str(path)))


def record_map() -> None:
    """Run the tests once, and keep which of them run which lines and how long each takes."""
    RECORD.mkdir(parents=True, exist_ok=True)
    command = [
        *(sys.executable, "-m", "pytest", "-n", "2", "-q", "--no-header", "--durations=0"),
        *("--cov=hipsta_bids", "--cov-context=test", "--cov-report=", *TESTS),
    ]
    environment = os.environ | {"COVERAGE_FILE": str(RECORD / "coverage")}
    done = subprocess.run(command, cwd=ROOT, env=environment, check=False, text=True, stdout=-1)  # noqa: S603
    seconds: dict[str, float] = {}
    for line in done.stdout.splitlines():
        words = line.split(maxsplit=2)
        if len(words) == 3 and words[1] in {"call", "setup"} and words[0].endswith("s"):  # noqa: PLR2004
            seconds[words[2]] = seconds.get(words[2], 0.0) + float(words[0][:-1])
    (RECORD / "seconds.json").write_text(json.dumps(seconds), encoding="utf-8")
    sys.stdout.write(done.stdout.splitlines()[-1] + "\n")


def tests_of(mutant: Mutant, lines: dict[int, list[str]], seconds: dict[str, float]) -> list[str]:
    """Tests that run a line, the quick ones first; of shared fixtures, all tests of the file."""
    contexts = [context for context in lines.get(mutant.line, []) if "::" in context]
    single = {name.split("|")[0] for name in contexts if name.endswith("|run")}
    files = {name.split("::")[0] for name in contexts if name.endswith("|setup")}
    quick = sorted(single, key=lambda name: seconds.get(name, 0.0))
    return [*quick[:60], *sorted(files)]


def start(mutant: Mutant, tests: Sequence[str]) -> int:
    """Run tests on a mutant in a forked process; returns its number."""
    child = os.fork()
    if child:
        return child
    signal.alarm(PATIENCE)
    sys.meta_path.insert(0, _Finder(mutant))
    os.chdir(ROOT)
    import pytest  # noqa: PLC0415  (loaded already)

    code = 1
    try:
        with (
            TemporaryDirectory(dir=RECORD) as folder,  # other test runs tidy up the common one
            redirect_stdout(io.StringIO()),
            redirect_stderr(io.StringIO()),
        ):
            options = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist"]
            options.append(f"--basetemp={Path(folder) / 'base'}")
            code = int(pytest.main([*options, *tests])) if tests else 0
    finally:
        os._exit(code)


def survivors(
    jobs: Sequence[tuple[Mutant, list[str]]], processes: int
) -> Iterator[tuple[Mutant, list[str]]]:
    """Yield the mutants that no test noticed, with the tests that should have."""
    waiting, running = list(jobs), dict[int, tuple[Mutant, list[str]]]()
    while waiting or running:
        while waiting and len(running) < processes:
            job = waiting.pop(0)
            running[start(*job)] = job
        child, status = os.wait()
        job = running.pop(child)
        if status == 0:
            yield job


def run(count: int, seed: int, processes: int) -> int:
    """Try a sample of mutants; the exit code says whether at least 90 % were killed."""
    import matplotlib.pyplot  # noqa: F401, ICN001, PLC0415  (shared by all children)
    import pytest  # noqa: F401, PLC0415
    import scipy.stats  # noqa: F401, PLC0415
    import sklearn.linear_model  # noqa: F401, PLC0415
    import statsmodels.api  # noqa: F401, PLC0415
    from coverage import CoverageData  # noqa: PLC0415

    data = CoverageData(str(RECORD / "coverage"))
    data.read()
    seconds = json.loads((RECORD / "seconds.json").read_text(encoding="utf-8"))
    sample = random.Random(seed).sample(list(mutants()), count)  # noqa: S311
    lines = {m.path: data.contexts_by_lineno(str(ROOT / m.path)) for m in sample}
    jobs = [(mutant, tests_of(mutant, lines[mutant.path], seconds)) for mutant in sample]
    begun, left = time.monotonic(), 0
    for mutant, tests in survivors(jobs, processes):
        left += 1
        sys.stdout.write(f"{mutant.path}:{mutant.line} {mutant.what} ({len(tests)} tests)\n")
        sys.stdout.flush()
    seconds_taken = time.monotonic() - begun
    sys.stdout.write(f"{count - left} of {count} killed in {seconds_taken:.0f} s\n")
    return int(count - left < LEAST * count)


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["map", "run"])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    if options.what == "map":
        record_map()
        return 0
    return run(options.count, options.seed, options.processes)


if __name__ == "__main__":
    sys.exit(main())
