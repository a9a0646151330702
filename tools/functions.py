"""Check that no function of the package has too many branches or lines.

Complexity is counted as by radon: 1, and 1 for each if, elif, ternary, loop, except, assert, case,
comprehension, if of a comprehension, and operand of ``and`` and ``or`` beyond the first. Functions
inside a function count for themselves. Lines of docstrings do not count.
"""

import ast
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

MAX_COMPLEXITY, MAX_LINES = 15, 60

#: Functions that may be larger, by file and name, with the reason; at most five.
EXCEPTIONS: tuple[tuple[str, str], ...] = (
    ("cli/participant.py:_run", "messages of wrong use, in the order in which they are given"),
    ("participant/pool.py:run_jobs", "one loop over processes that end, fail or are killed"),
)

_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
_BRANCHES = (ast.If, ast.IfExp, ast.For, ast.While, ast.ExceptHandler, ast.Assert, ast.match_case)


def complexity(node: ast.AST) -> int:
    """Return the number of branches below a node, without those of functions inside it."""
    total = isinstance(node, _BRANCHES) + 0
    if isinstance(node, ast.BoolOp):
        total += len(node.values) - 1
    elif isinstance(node, ast.comprehension):
        total += 1 + len(node.ifs)
    inner = (child for child in ast.iter_child_nodes(node) if not isinstance(child, _FUNCTIONS))
    return total + sum(map(complexity, inner))


def large_functions(tree: ast.Module) -> Iterator[tuple[str, int, int]]:
    """Return name, complexity and number of lines of each function that is too large."""
    for node in ast.walk(tree):
        if isinstance(node, _FUNCTIONS):
            text = node.body[0] if ast.get_docstring(node) is not None else None
            n_text = (text.end_lineno or 0) - text.lineno + 1 if text else 0
            n_lines = (node.end_lineno or 0) - node.lineno + 1 - n_text
            n_branches = 1 + complexity(node)
            if n_branches > MAX_COMPLEXITY or n_lines > MAX_LINES:
                yield node.name, n_branches, n_lines


def main(folders: Sequence[str]) -> int:
    """Return 1 if a function is too large, or if a listed function is not."""
    listed = {name for name, _ in EXCEPTIONS}
    large: dict[str, str] = {}
    for folder in map(Path, folders or ["hipsta_bids"]):
        for path in sorted(folder.rglob("*.py")):
            for name, n_branches, n_lines in large_functions(ast.parse(path.read_text("utf-8"))):
                key = f"{path.relative_to(folder).as_posix()}:{name}"
                large[key] = f"complexity {n_branches}, {n_lines} lines"
    for name in sorted(large.keys() - listed):
        limits = f"{MAX_COMPLEXITY} and {MAX_LINES}"
        sys.stdout.write(f"{name}: {large[name]}; the limits are {limits}. Split it.\n")
    for name in sorted(listed - large.keys()):
        sys.stdout.write(f"{name} is not too large; remove it from {__file__}\n")
    return int(large.keys() != listed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
