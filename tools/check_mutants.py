"""Ask how strong the tests are: change single operators of the code and see whether a test fails.

    tools/check_mutants.py --count 200      try mutants, list the survivors

A mutant has one comparison or operator of ``geometry/`` or ``stats/`` replaced. It is killed
if one of its module's own tests fails, or takes far too long. These are ``test_<module>*.py`` in
the folder of the same name. A module without such a file is tested by the files that import
it, there or elsewhere, or else by those of the modules that import it.
"""

import argparse
import ast
import importlib.abc
import importlib.machinery
import importlib.util
import io
import os
import random
import re
import signal
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
FOLDERS = ("geometry", "stats")
RECORD = ROOT / "build" / "mutants"
PATIENCE = 240  # s for the tests of one mutant
LEAST = 0.85  # of the mutants have to be killed

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


def tests_of(path: Path) -> list[Path]:
    """List files of tests of a module: of its name, or that import it, or of its importers."""
    folder = ROOT / "tests" / path.parent.relative_to(ROOT / "hipsta_bids")
    package = re.escape(".".join(path.parent.relative_to(ROOT).parts))
    imports = re.compile(
        rf"^(from|import) {package}(\.{path.stem}\b| import .*\b{path.stem}\b)", re.MULTILINE
    )

    def importers(root: Path, pattern: str) -> list[Path]:
        return [file for file in sorted(root.rglob(pattern)) if imports.search(file.read_text())]

    files = [*folder.glob(f"test_{path.stem}.py"), *sorted(folder.glob(f"test_{path.stem}_*.py"))]
    files = files or importers(folder, "test_*.py") or importers(ROOT / "tests", "test_*.py")
    users = [] if files else importers(ROOT / "hipsta_bids", "*.py")
    return files or sorted({file for user in users for file in tests_of(user)})


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
    """Try a sample of mutants; the exit code says whether at least 85 % were killed."""
    import matplotlib.pyplot  # noqa: F401, ICN001, PLC0415  (shared by all children)
    import pytest  # noqa: F401, PLC0415
    import scipy.stats  # noqa: F401, PLC0415
    import sklearn.linear_model  # noqa: F401, PLC0415
    import statsmodels.api  # noqa: F401, PLC0415

    RECORD.mkdir(parents=True, exist_ok=True)
    sample = random.Random(seed).sample(list(mutants()), count)  # noqa: S311
    jobs = [(mutant, [str(path) for path in tests_of(ROOT / mutant.path)]) for mutant in sample]
    begun, left = time.monotonic(), 0
    for mutant, tests in survivors(jobs, processes):
        left += 1
        sys.stdout.write(f"{mutant.path}:{mutant.line} {mutant.what} ({len(tests)} files)\n")
        sys.stdout.flush()
    seconds_taken = time.monotonic() - begun
    sys.stdout.write(f"{count - left} of {count} killed in {seconds_taken:.0f} s\n")
    return int(count - left < LEAST * count)


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    return run(options.count, options.seed, options.processes)


if __name__ == "__main__":
    sys.exit(main())
