"""Pages of the validation: the appendix of the site, and the list of suites in validation.md.

Both are made from what ``python -m validation`` writes into ``docs/validation``.
"""

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from claims import read_claims, refresh

from hipsta_bids.io.files import read_tsv
from validation.report import MET, MISSED, SUITES, Cells, Table, markdown, stale

DOCS = Path(__file__).resolve().parents[1] / "docs"
#: Folder of tables, figures and their texts, below docs/; also of the appendix on the site.
FOLDER = "validation"
#: A table in ``validation.md`` that is written from its file; ``suites`` is the list of suites.
BLOCK = re.compile(r"(<!-- table: (?P<name>\S+) -->\n).*?(\n<!-- end -->)", re.DOTALL)

Record = Mapping[str, Any]
"""What the JSON file of a suite holds."""


def records() -> dict[str, Record]:
    """Read the records of all suites, in the order of ``suites.toml``; others follow."""
    paths = {path.stem: path for path in sorted((DOCS / FOLDER).glob("*.json"))}
    names = [*(name for name in SUITES if name in paths), *sorted(set(paths) - set(SUITES))]
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
        yield f"{name}.md", "\n\n".join(_parts(name, record)) + "\n"


def _parts(name: str, record: Record) -> Iterator[str]:
    met, targets = count_targets(record)
    yield f"# {record['title']}"
    if targets:
        yield f"{record['question']}: {met} of {targets} targets are met."
    yield record["text"]
    if "command" in record:
        yield (
            f"Measured on {record['date']} by `{record['command']}` of version"
            f" {record['version']} (commit {record['commit']}){_time(record)}."
        )
        if folders := stale(name, record):
            yield f"**Stale**: code changed since, in {', '.join(folders)}."
    yield "[All claims](../validation.md)"
    for entry in record["tables"]:
        key = anchor(entry["file"])
        yield f"## {entry['title']} {{ #{key} }}"
        yield f"{_without_title(read_table(entry))}\n\n[This table as TSV]({entry['file']})"
    for entry in record["figures"]:
        yield f"![{entry['caption']}]({entry['file']})\n\n*{entry['caption']}*"


def _time(record: Record) -> str:
    if "seconds" not in record:
        return ""
    wall, cpu = (record[name] / 60 for name in ("seconds", "cpu_seconds"))
    return f" in {wall:.1f} min, {cpu:.1f} min of CPU time"


def anchor(file: str) -> str:
    """Return the anchor of a table on its page: ``accuracy--thickness.tsv`` has ``thickness``."""
    return Path(file).stem.rpartition("--")[2]


def site_link(path: str) -> str:
    """Convert a link to a table below docs/ into a link to its place in the appendix."""
    pages = {e["file"]: name for name, record in records().items() for e in record["tables"]}
    file = path.removeprefix(f"{FOLDER}/")
    return f"{FOLDER}/{pages[file]}.md#{anchor(file)}" if file in pages else path


def claims_page() -> str:
    """Return ``validation.md`` with its tables and numbers as their files are now."""
    text = (DOCS / "validation.md").read_text("utf-8")
    text = refresh(text, read_claims("docs/validation.md"))
    return BLOCK.sub(lambda found: f"{found[1]}\n{_block(found['name'])}\n{found[3]}", text)


def _block(name: str) -> str:
    if name == "suites":
        return _without_title(Table(title="", rows=list(_suites())))
    return _without_title(Table(title="", rows=read_tsv(DOCS / FOLDER / name)))


def _without_title(table: Table) -> str:
    return markdown(table).partition("\n\n")[2]


def _suites() -> Iterator[Cells]:
    for name, record in records().items():
        if "command" in record:
            met, targets = count_targets(record)
            score = f"{met} of {targets}" if targets else "none"
            place = re.sub(r"[^a-z0-9]+", "-", record["title"].lower())
            files = [entry["file"] for entry in record["tables"]]
            minutes = f"{record['seconds'] / 60:.1f}" if "seconds" in record else "n/a"
            old = "-stale" if stale(name, record) else ""
            yield {
                "suite": f'<a id="{place}"></a>{record["title"]}',
                "targets met; commit; minutes": f"{score}; {record['commit']}{old}; {minutes}",
                "tables": ", ".join(f"[{anchor(file)}]({FOLDER}/{file})" for file in files),
            }
