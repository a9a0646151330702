"""Numbers of README, ``docs/validation.md`` and the paper, and the cells of tables they come from.

``docs/validation/claims.toml`` lists texts of a page with ``{}`` for each number, and for each of
these its source, ``file | rows | column | which | format``. ``rows`` are conditions on columns, all
of which hold (``a = b; c ~ part; d != e``). ``which`` is a key of ``PICKS`` or ``count``; ``#2``
after it takes the second number of each cell. A format in percent writes no sign.
"""

import re
import statistics
import tomllib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from hipsta_bids.io.files import read_tsv

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "validation"
NUMBER = re.compile(r"[+-]?\d+(?:\.\d+)?")


def _only(values: Iterable[float]) -> float:
    (value,) = set(values)
    return value


#: How one number is made of those of the rows.
PICKS: Mapping[str, Callable[[list[float]], float]] = {
    "only": _only,
    "least": min,
    "most": max,
    "nearest": lambda values: min(values, key=abs),
    "farthest": lambda values: max(values, key=abs),
    "mean": statistics.fmean,
    "median": statistics.median,
    "sum": sum,
}

Claim = Mapping[str, Any]
"""``page``, ``text`` and ``numbers``."""


def read_claims(page: str) -> list[Claim]:
    """Read the claims of a page."""
    claims = tomllib.loads((FOLDER / "claims.toml").read_text("utf-8"))["claim"]
    return [claim for claim in claims if claim["page"] == page]


def find_number(source: str) -> str:
    """Read a number from its table, and format it."""
    file, conditions, column, which, style = (part.strip() for part in source.split("|"))
    rows = [row for row in read_tsv(FOLDER / file) if _meets(row, conditions)]
    if not rows:
        raise ValueError(f"no row: {source}")
    if which == "count":
        return f"{len(rows):{style}}"
    pick, _, place = which.partition("#")
    cells = [NUMBER.findall(row[column]) for row in rows]
    value = PICKS[pick]([float(cell[int(place or 1) - 1]) for cell in cells])
    return f"{value:{style}}".removesuffix("%")


def _meets(row: Mapping[str, str], conditions: str) -> bool:
    for condition in filter(None, conditions.split("; ")):
        found = re.fullmatch(r"(.+?) (=|!=|~) (.+)", condition)
        if found is None:
            raise ValueError(f"no condition: {condition}")
        column, sign, wanted = found.groups()
        same = wanted in row[column] if sign == "~" else wanted == row[column]
        if same is (sign == "!="):
            return False
    return True


def fill(claim: Claim) -> str:
    """Return the text of a claim with its numbers."""
    return str(claim["text"]).format(*map(find_number, claim["numbers"]))


def refresh(text: str, claims: Iterable[Claim]) -> str:
    """Write the numbers of claims into a page that has other ones."""
    for claim in claims:
        words = re.escape(claim["text"]).replace(r"\{\}", NUMBER.pattern).replace(r"\ ", r"\s+")
        places = re.findall(words, text)
        if len(places) != 1:
            raise ValueError(f"on its page {len(places)} times: {claim['text']}")
        text = text.replace(places[0], _wrap(places[0], fill(claim)))
    return text


def _wrap(old: str, new: str) -> str:
    """Break the lines of a text where an old one was broken."""
    blanks = iter(re.findall(r"\s+", old))
    return re.sub(r"\s+", lambda _: next(blanks), new)
