"""Count names and imports that the rules exclude; the counts have budgets that may only fall."""

import argparse
import ast
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

#: Largest count of each check in the package. A change that lowers a count lowers its budget.
BUDGETS = {"names": 36, "imports": 21}

#: Pronouns, question words, adverbs, and participles of verbs that fit any object. None of them
#: says what is bound; "fitted" or "padded" at least say what was done.
WORDS = frozenset(
    """
    all another any anybody anyone anything both each either every everybody everyone everything
    few many more most neither nobody none nothing one ones other others own ours rest same several
    some somebody someone something such that theirs these they this those
    how what when where which who whose why
    again ahead alike alone anew anywhere apart aside astray away back else elsewhere enough even
    everywhere here later less now nowhere once only otherwise so still then there together twice
    asked chosen done found given going gone held kept known lost made meant met said seen shown
    taken told used wanted
    """.split()  # noqa: SIM905  (a list would take a line per word)
)


def names(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Return the bindings called by one of ``WORDS``, except variables of comprehensions."""
    brief = {
        id(name)
        for part in ast.walk(tree)
        if isinstance(part, ast.comprehension)
        for name in ast.walk(part.target)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and id(node) not in brief:
            name = node.id
        elif isinstance(node, ast.arg):
            name = node.arg
        else:
            continue
        if name.lstrip("_").lower() in WORDS and name != "OTHER":  # Tissue.OTHER: no subfield
            yield node.lineno, name


def imports(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Return the imports from the package that take more than one line."""
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.ImportFrom)
            and (node.module or "").split(".")[0] == "hipsta_bids"
            and node.end_lineno != node.lineno
        ):
            yield node.lineno, f"from {node.module} import ..."


CHECKS = {"names": names, "imports": imports}


def lines(check: str, paths: Sequence[Path]) -> list[str]:
    """Return what a check counts in files and folders, as ``file:line name``."""
    return [
        f"{file}:{line} {name}"
        for path in paths
        for file in (sorted(path.rglob("*.py")) if path.is_dir() else [path])
        for line, name in sorted(CHECKS[check](ast.parse(file.read_text(encoding="utf-8"))))
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Return 1 if a count is above its budget; or print what a check counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("check", nargs="?", choices=CHECKS, help="one check instead of all")
    parser.add_argument("--list", action="store_true", help="print file:line name instead")
    parser.add_argument("paths", nargs="*", type=Path, default=[Path("hipsta_bids")])
    options = parser.parse_intermixed_args(arguments)
    exit_code = 0
    for check in [options.check] if options.check else CHECKS:
        entries = lines(check, options.paths)
        if options.list:
            sys.stdout.writelines(f"{entry}\n" for entry in entries)
        elif len(entries) != BUDGETS[check]:
            exit_code |= len(entries) > BUDGETS[check]
            sys.stdout.write(
                f"{check}: {len(entries)}, the budget in {__file__} is {BUDGETS[check]}\n"
            )
    return exit_code


if __name__ == "__main__":
    sys.exit(main())
