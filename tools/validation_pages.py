"""Pages of the validation: the appendix of the site, and the list of suites in validation.md.

Both are made from what ``python -m validation`` writes into ``docs/validation``.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from hipsta_bids.io.files import read_tsv
from validation.report import MET, MISSED, SUITES, Table, markdown

DOCS = Path(__file__).resolve().parents[1] / "docs"
#: Folder of tables, figures and their texts, below docs/; also of the appendix on the site.
FOLDER = "validation"
#: Begin and end of the list of suites in ``validation.md``.
MARKS = ("<!-- Suites: written by tools/make-docs. -->", "<!-- End of suites. -->")

Record = Mapping[str, Any]
"""What the JSON file of a suite holds."""


def records() -> dict[str, Record]:
    """Read the records of all suites, in the order of ``suites.toml``; others follow."""
    paths = {path.stem: path for path in sorted((DOCS / FOLDER).glob("*.json"))}
    names = [*(name for name in SUITES if name in paths), *(set(paths) - set(SUITES))]
    return {name: json.loads(paths[name].read_text("utf-8")) for name in names}


def read_table(entry: Mapping[str, str]) -> Table:
    """Read a table of a record; its cells are texts."""
    rows = read_tsv(DOCS / FOLDER / entry["file"])
    return Table(title=entry["title"], rows=rows, notes=entry["notes"])


def count_targets(record: Record) -> tuple[int, int]:
    """Count the targets of a suite that are met, and all targets."""
    cells = [
        cell
        for entry in record["tables"]
        for row in read_table(entry).rows
        for cell in row.values()
    ]
    return cells.count(MET), cells.count(MET) + cells.count(MISSED)


def appendix() -> Iterator[tuple[str, str]]:
    """Write a page per suite: name of the file below ``FOLDER``, and Markdown."""
    for name, record in records().items():
        yield f"{name}.md", "\n\n".join(_parts(record)) + "\n"


def _parts(record: Record) -> Iterator[str]:
    met, targets = count_targets(record)
    yield f"# {record['title']}"
    if targets:
        yield f"{record['question']}: {met} of {targets} targets are met."
    yield record["text"]
    yield (
        f"Measured on {record['date']} by `{record['command']}` of version {record['version']}"
        f" (commit {record['commit']}). [All claims](../validation.md)."
    )
    for entry in record["tables"]:
        key = anchor(entry["file"])
        _, _, table = markdown(read_table(entry)).partition("\n\n")
        yield f"## {entry['title']} {{ #{key} }}"
        yield f"{table}\n\n[This table as TSV]({entry['file']})"
    for entry in record["figures"]:
        yield f"![{entry['caption']}]({entry['file']})\n\n*{entry['caption']}*"


def anchor(file: str) -> str:
    """Return the anchor of a table on its page: ``accuracy--thickness.tsv`` has ``thickness``."""
    return Path(file).stem.partition("--")[2]


def site_link(path: str) -> str:
    """Convert a link to a table below docs/ into a link to its place in the appendix."""
    found = re.fullmatch(rf"{FOLDER}/([\w-]+?)(--[\w-]+)\.tsv", path)
    return f"{FOLDER}/{found[1]}.md#{found[2][2:]}" if found else path


def claims_page() -> str:
    """Return ``validation.md`` with the list of suites as their tables are now."""
    text = (DOCS / "validation.md").read_text("utf-8")
    before, _, rest = text.partition(MARKS[0])
    _, _, after = rest.partition(MARKS[1])
    return f"{before}{MARKS[0]}\n\n{_suites()}\n\n{MARKS[1]}{after}"


def _suites() -> str:
    lines: list[Sequence[str]] = [("suite", "targets met", "commit, date", "tables")]
    lines.append(["---"] * len(lines[0]))
    for record in records().values():
        met, targets = count_targets(record)
        place = re.sub(r"[^a-z0-9]+", "-", record["title"].lower())
        tables = [f"[{anchor(e['file'])}]({FOLDER}/{e['file']})" for e in record["tables"]]
        lines.append(
            (
                f'<a id="{place}"></a>{record["title"]}',
                f"{met} of {targets}" if targets else "no targets",
                f"{record['commit']}, {record['date']}",
                ", ".join(tables),
            )
        )
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
