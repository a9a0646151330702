"""Count banned words and long sentences in the messages of the program and in the docs.

Each file has a budget in ``words.toml``, which may only fall; files without one have none.
"""

import argparse
import ast
import html
import inspect
import re
import sys
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

#: Banned words as patterns, by the words to write instead. Questions may begin with "what".
BANNED = {
    "no participant": r"nobody|no one|(any|some|every)(body|one)",
    "participant, reader, rater": r"people|persons?",
    "print, show, decide, distinguish": r"tells?|telling|told",
    "report, state, define": r"says?|saying|said",
    "exclude, omit": r"lea(ve|ves|ving) (\w+ ){0,3}out|left (\w+ )?out",
    "determine, measure": r"f(ind|inds|ound) out",
    "the noun": r"those|that of|the same (along|over|of|after)",
    "the noun, without what": r"what (is|are|was|were|has|have|had|it|they|its|their|this|there)",
    "the noun, like": r"such(?! as\b)",
    "a verb of the field": r"go(es|ne)?|went|comes?|came",
    "does not, do not": r"ha(s|ve|d) not(?! \w+(ed|en|t|un|ne)\b)",
    "instead of": r"in (the )?place of",
    "if": r"(?<=[,;.:] )(were|had) (it|they|this|these)|^were (it|they|this|these)",
}
_PATTERNS = {
    better: re.compile(rf"(?<![\w-])(?:{pattern})(?![\w-])", re.IGNORECASE)
    for better, pattern in BANNED.items()
}

#: Most words of a message, and of a sentence in docs, pages and methods texts.
MESSAGE, SENTENCE = 20, 25

#: Shortest string of the program that is taken for prose, in words.
_PROSE = 4

BUDGETS = Path(__file__).with_suffix(".toml")

#: A word for whatever is computed, and for code.
_PLACEHOLDER = "X1"
_WORD = re.compile(r"\S*[^\W_]\S*")
#: A list of code, each perhaps with a unit.
_CODES = re.compile(r"X1( \([^()]{1,6}\))?(,\s+(and |or )?X1( \([^()]{1,6}\))?)+")
_END = re.compile(r"(?<=[.?!])(?:\{\w+\}|X1)*[)\"]?\s+(?=[A-Z\"(`*\[])|\n\s*\n|\n {2,}|\n[-*] ")
_ABBREVIATIONS = re.compile(r"\b(et al|e\.g|i\.e|cf|vs|Fig|Eq|No|approx)\.")


class Text(NamedTuple):
    """A text of the program or the docs, and the most words of it or of each sentence."""

    line: int
    text: str
    most_words: int
    whole: bool = False


def sentences(text: str) -> list[str]:
    """Return the sentences of a text; abbreviations and numbers do not end one."""
    return [s for s in _END.split(_ABBREVIATIONS.sub(r"\1", text)) if s.strip()]


def problems(text: Text) -> Iterator[str]:
    """Return the banned words of a text with better ones, and the sentences that are too long."""
    for sentence in sentences(text.text):
        line = " ".join(sentence.split())
        for better, pattern in _PATTERNS.items():
            for match in pattern.finditer(line):
                if not (line.endswith("?") and match[0].lower().startswith("what")):
                    yield f"banned: '{match[0]}' (write: {better})"
    for sentence in [text.text] if text.whole else sentences(text.text):
        count = len(_WORD.findall(sentence))
        if count > text.most_words:
            start = " ".join(sentence.split()[:8])
            yield f"long: {count} words, limit {text.most_words}: {start} ..."


def _string(node: ast.AST) -> str | None:
    """Return a string of the source, with a word for each placeholder; None for other nodes."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else None
    if isinstance(node, ast.JoinedStr):
        parts = (_string(v) if isinstance(v, ast.Constant) else _PLACEHOLDER for v in node.values)
        return "".join(part or "" for part in parts)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        sides = _string(node.left), _string(node.right)
        if sides != (None, None):
            return "".join(_PLACEHOLDER if side is None else side for side in sides)
    return None


def _is_message(node: ast.AST) -> bool:
    """Check whether a call makes a message: an error, a finding, a warning or a note."""
    if not isinstance(node, ast.Call):
        return False
    function = node.func
    name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
    return name.endswith("Error") or name in {"Finding", "warn", "_warn", "echo", "Remark"}


def python_texts(source: str, most_words: int = MESSAGE) -> Iterator[Text]:
    """Return the messages and texts of a module, and the docstrings of public functions."""
    tree = ast.parse(source)
    notes = {id(n.value): n for n in ast.walk(tree) if isinstance(n, ast.Expr)}
    yield from _docstrings(tree)

    def visit(node: ast.AST, *, message: bool) -> Iterator[Text]:
        text = _string(node)
        if text is not None and id(node) not in notes and len(_WORD.findall(text)) >= _PROSE:
            line = getattr(node, "lineno", 0)
            yield Text(line, text, most_words, whole=message)
        for child in ast.iter_child_nodes(node):
            # Parts of a string count in the whole; only placeholders hold strings of their own.
            if text is None or _string(child) is None:
                yield from visit(child, message=message or _is_message(node))

    yield from visit(tree, message=False)


def _docstrings(tree: ast.Module) -> Iterator[Text]:
    """Return docstrings of public functions and classes; they have no limit but lines."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            text = ast.get_docstring(node)
            if text is not None:
                text = re.sub(r"^\w+ : .*$", "", text, flags=re.MULTILINE)  # parameters
                yield Text(node.lineno, _prose(text), sys.maxsize)


def settings_texts(source: str) -> Iterator[Text]:
    """Return the descriptions of the fields of a module of settings."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ClassDef):
            for note in node.body[1:]:
                text = _string(note.value) if isinstance(note, ast.Expr) else None
                if text is not None:
                    yield Text(note.lineno, _prose(inspect.cleandoc(text)), MESSAGE)


def toml_texts(source: str, most_words: int = MESSAGE) -> Iterator[Text]:
    """Return the texts of a TOML file, without keys."""

    def walk(value: object) -> Iterator[str]:
        if isinstance(value, Mapping):
            for part in value.values():
                yield from walk(part)
        elif isinstance(value, list):
            for part in value:
                yield from walk(part)
        elif isinstance(value, str) and len(_WORD.findall(value)) >= _PROSE:
            yield value

    for text in walk(tomllib.loads(source)):
        start = source.find(text.strip().splitlines()[0][:30])
        yield Text(source.count("\n", 0, max(start, 0)) + 1, _prose(text), most_words)


def template_texts(source: str) -> Iterator[Text]:
    """Return the text between the tags of a template; what is computed counts as a word."""

    def blank(match: re.Match[str], separator: str = "") -> str:
        return separator + "\n" * match[0].count("\n")

    def cut(match: re.Match[str]) -> str:
        return blank(match, "\x00")

    source = re.sub(r"\{#.*?#\}|<(script|style)\b.*?</\1>", cut, source, flags=re.DOTALL)
    source = re.sub(r"\{%-? *(if|endif)\b.*?%\}", blank, source, flags=re.DOTALL)
    source = re.sub(r"\{%.*?%\}", cut, source, flags=re.DOTALL)
    source = re.sub(r"\{\{.*?\}\}", _PLACEHOLDER, source, flags=re.DOTALL)
    inline = r"</?(b|i|em|strong|a|code|span|sub|sup|kbd)\b[^<>]*>"
    source = re.sub(inline, blank, source, flags=re.DOTALL)
    texts = re.sub(r"<[^<>]*>", cut, source, flags=re.DOTALL)
    line = 1
    for text in texts.split("\x00"):
        if len(_WORD.findall(text)) >= _PROSE:
            yield Text(line, html.unescape(text), SENTENCE)
        line += text.count("\n")


def script_texts(source: str) -> Iterator[Text]:
    """Return the strings of a script that are prose."""
    for match in re.finditer(r"`([^`]*)`|\"([^\"\n]*)\"|'([^'\n]*)'", source):
        text = re.sub(r"\$\{[^}]*\}", _PLACEHOLDER, "".join(filter(None, match.groups())))
        if len(_WORD.findall(text)) >= _PROSE and not re.search(r"[{}=<>]|\w\.\w", text):
            yield Text(source.count("\n", 0, match.start()) + 1, text, SENTENCE)


def _prose(text: str) -> str:
    """Return Markdown without code, addresses and comments: code, or a list of it, is a word."""
    text = re.sub(r"<!--.*?-->", " ", text, flags=re.DOTALL)
    text = re.sub(r"``?[^`]+``?", _PLACEHOLDER, text)
    text = _CODES.sub(_PLACEHOLDER, text)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    return re.sub(r"https?://\S+", _PLACEHOLDER, text)


def markdown_texts(source: str) -> Iterator[Text]:
    """Return the paragraphs, items and cells of a page, without code, headings and addresses."""
    kept = re.sub(
        r"^( *)(```|~~~).*?^ *\2 *$|\A---\n.*?^---$|<!--.*?-->|\$\$.*?\$\$",
        lambda m: "\n" * m[0].count("\n"),
        source,
        flags=re.DOTALL | re.MULTILINE,
    )
    lines = kept.splitlines()
    start, block = 1, list[str]()

    def flush() -> Iterator[Text]:
        text = _prose("\n".join(block))
        if _WORD.search(text):
            yield Text(start, text, SENTENCE)

    for number, line in enumerate([*lines, ""], 1):
        item = re.match(r"\s*([-*+]|\d+[.)]) ", line)
        table, heading = line.lstrip().startswith("|"), line.startswith("#")
        if not line.strip() or item or table or heading:
            yield from flush()
            block = []
        if table:
            for cell in re.split(r"(?<!\\)\|", line.strip().strip("|")):
                if _WORD.search(cell):
                    yield Text(number, _prose(cell), SENTENCE)
        elif line.strip() and not heading:
            start = start if block else number
            block.append(line.strip())


def _read(path: Path) -> list[Text]:
    """Return the texts of a file, by its name."""
    source = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        return list(markdown_texts(source))
    most_words = SENTENCE if path.name in METHODS else MESSAGE
    if path.suffix == ".toml":
        return list(toml_texts(source, most_words))
    if path.suffix == ".html":
        return list(template_texts(source))
    if path.suffix == ".js":
        return list(script_texts(source))
    texts = list(python_texts(source, most_words))
    return [*texts, *settings_texts(source)] if path.name == "settings.py" else texts


#: Files with methods texts.
METHODS = ("methods.py", "question_methods.py", "texts.toml")

#: Files whose texts are read.
FILES = (
    "hipsta_bids/**/*.py",
    "hipsta_bids/**/help.toml",
    "hipsta_bids/**/columns.toml",
    "hipsta_bids/derivatives/texts.toml",
    "hipsta_bids/inputs/layouts.toml",
    "hipsta_bids/reports/*.toml",
    "hipsta_bids/reports/**/*.html",
    "hipsta_bids/reports/**/*.js",
    "*.md",
    "docs/*.md",
)


def files(root: Path) -> Iterator[Path]:
    """Return the files of the program and of the docs that are checked."""
    for pattern in FILES:
        yield from (path for path in sorted(root.glob(pattern)) if ".min." not in path.name)


def _expanded(paths: Sequence[Path]) -> Iterator[Path]:
    """Return files, and the checked files of folders; all checked files without paths."""
    checked = list(files(Path()))
    for path in paths or [Path()]:
        yield from (f for f in checked if path in f.parents) if path.is_dir() else [path]


def lines(path: Path) -> list[str]:
    """Return the problems of a file, as ``file:line problem``."""
    return [f"{path}:{text.line} {p}" for text in _read(path) for p in problems(text)]


def write_budgets(counts: Mapping[str, int], budgets: Mapping[str, int]) -> None:
    """Lower the budgets to the counts; a count above its budget changes none."""
    text = (
        "# Most problems of each file; `python tools/words.py --lower` lowers them to the counts.\n"
    )
    for path, count in sorted(counts.items()):
        if least := min(count, budgets.get(path, 0)):
            text += f'"{path}" = {least}\n'
    BUDGETS.write_text(text, encoding="utf-8")


def main(arguments: Sequence[str] | None = None) -> int:
    """Return 1 if a file has more problems than its budget; or print the problems."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--list", action="store_true", help="print file:line problem instead")
    parser.add_argument("--lower", action="store_true", help="lower the budgets to the counts")
    parser.add_argument("paths", nargs="*", type=Path, help="files or folders (default: all)")
    options = parser.parse_args(arguments)
    rows_of = {str(path): lines(path) for path in _expanded(options.paths)}
    if options.list:
        sys.stdout.writelines(f"{line}\n" for rows in rows_of.values() for line in rows)
        return 0
    budgets = tomllib.loads(BUDGETS.read_text(encoding="utf-8"))
    counts = {path: len(rows) for path, rows in rows_of.items()}
    if options.lower:
        write_budgets(budgets | counts if options.paths else counts, budgets)
    above = {path: count for path, count in counts.items() if count > budgets.get(path, 0)}
    for path, count in above.items():
        text = f"{path}: {count} problems, the budget in {BUDGETS} is {budgets.get(path, 0)}"
        sys.stdout.write(f"{text}; python {__file__} --list {path}\n")
    return int(bool(above))


if __name__ == "__main__":
    sys.exit(main())
