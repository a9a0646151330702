"""Count names, imports and words that the rules exclude; the counts may only fall."""

import argparse
import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterator, Sequence
from pathlib import Path

#: Largest count of each check in the package. A change that lowers a count lowers its budget.
BUDGETS = {"names": 72, "imports": 19, "dialect": 250}

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


#: Words that only this project uses so, in names, comments and docstrings, and the field's words.
DIALECT = {
    "account": "list",
    "beside": "adjacent, neighboring, next to",
    "found": "estimated, detected, result",
    "laid": "placed, aligned, flattened",
    "own": "separate, or what it belongs to",
    "rival": "alternative",
    "rivals": "alternatives, candidates",
    "tell": "report, distinguish",
    "tells": "reports, distinguishes",
    "told": "reported",
}


def names(source: str) -> Iterator[tuple[int, str]]:
    """Return the bindings called by one of ``WORDS``, also those of comprehensions and lambdas."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            name = node.id
        elif isinstance(node, ast.arg):
            name = node.arg
        else:
            continue
        if name.lstrip("_").lower() in WORDS and name != "OTHER":  # Tissue.OTHER: no subfield
            yield node.lineno, name


def imports(source: str) -> Iterator[tuple[int, str]]:
    """Return the imports from the package that take more than one line."""
    for node in ast.walk(ast.parse(source)):
        if (
            isinstance(node, ast.ImportFrom)
            and (node.module or "").split(".")[0] == "hipsta_bids"
            and node.end_lineno != node.lineno
        ):
            yield node.lineno, f"from {node.module} import ..."


def dialect(source: str) -> Iterator[tuple[int, str]]:
    """Return the words of ``DIALECT`` in names, comments and docstrings, with the field's words."""
    is_start = True  # of a statement, where a string is a docstring
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        is_text = token.type == tokenize.COMMENT or (is_start and token.type == tokenize.STRING)
        if is_text or token.type == tokenize.NAME:
            for number, line in enumerate(token.string.splitlines(), token.start[0]):
                for word in re.findall("[a-z]+", line.lower()):
                    if word in DIALECT:
                        yield number, f"{word}: {DIALECT[word]}"
        if token.type not in {tokenize.COMMENT, tokenize.NL, tokenize.INDENT, tokenize.DEDENT}:
            is_start = token.type == tokenize.NEWLINE


CHECKS = {"names": names, "imports": imports, "dialect": dialect}


def lines(check: str, paths: Sequence[Path]) -> list[str]:
    """Return what a check counts in files and folders, as ``file:line name``."""
    return [
        f"{file}:{line} {name}"
        for path in paths
        for file in (sorted(path.rglob("*.py")) if path.is_dir() else [path])
        for line, name in sorted(CHECKS[check](file.read_text(encoding="utf-8")))
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
