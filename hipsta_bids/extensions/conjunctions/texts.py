"""How conjunctions and equivalence are written: ``A & B``, and ``|A| < 0.1``."""

import re
from collections.abc import Mapping, Sequence
from itertools import chain
from typing import TYPE_CHECKING

from hipsta_bids.cli.parser import Parser
from hipsta_bids.errors import ModelError

if TYPE_CHECKING:
    from hipsta_bids.group.request import Request

_NAMED = re.compile(r"\s*(?:(?P<name>[^=|&<>\[\]]+)=)?\s*(?P<body>.*?)\s*", re.DOTALL)
#: Outside of brackets.
_AND, _SIGN = (re.compile(rf"{sign}(?![^\[]*\])") for sign in (r"\s*&\s*", "[<>]"))
_WITHIN = re.compile(
    r"\|\s*(?P<body>[^|]+?)\s*\|\s*<\s*(?P<margin>(?:\d+\.?\d*|\.\d+)(?:e-?\d+)?)(?P<ending>\s*\|.*)?"
)
#: Names of parts by conjunction, and names of the contrasts that are no conjunctions.
Plan = tuple[Mapping[str, Sequence[str]], Sequence[str]]


def describe(parser: Parser) -> None:
    """Describe what contrasts can be, in the help."""
    parser.add_argument_group(
        "conjunction and equivalence",
        'Conjunction: --contrast "A & B", both above zero. Equivalence: --contrast "|A| < 0.1",'
        " A between -0.1 and 0.1 in the unit of the measure.",
    )


def is_asked(request: "Request") -> bool:
    """Check for conjunctions."""
    return any(_split(text)[1] for text in request.contrasts)


def fitted_contrasts(texts: Sequence[str]) -> tuple[str, ...]:
    """Return texts of contrasts with conjunctions as their parts, each part once."""
    parts = list(chain.from_iterable(_split(text)[1] for text in texts))
    if not parts:
        return tuple(texts)
    plain = [text for text in texts if not _split(text)[1]]
    names = set(map(_name, plain))
    return (*plain, *{_name(part): part for part in parts if _name(part) not in names}.values())


def plan_conjunctions(request: "Request") -> Plan:
    """Return conjunctions and other contrasts; ModelError if names of files are the same."""
    from hipsta_bids.stats.formula import check_labels  # noqa: PLC0415  (start-up time)

    splits = {text: _split(text) for text in request.contrasts}
    names = {text: name if parts else _name(text) for text, (name, parts) in splits.items()}
    check_labels([names[text] for text in request.contrasts])
    plan = {names[text]: [*map(_name, parts)] for text, (_, parts) in splits.items() if parts}
    return plan, [name for name in names.values() if name not in plan]


def _name(text: str) -> str:
    from hipsta_bids.stats.contrasts import contrast_json  # noqa: PLC0415  (start-up time)

    return str(contrast_json(text)["Name"])


def _split(text: str) -> tuple[str, list[str]]:
    """Return the name of a conjunction and its one-sided parts; no parts of other contrasts."""
    name, body = _NAMED.fullmatch(text).groups()  # type: ignore[union-attr]  # fits any text
    pieces = _AND.split(body)
    if len(pieces) == 1 and not body.startswith("|"):
        return "", []
    names, parts = zip(*map(_sided, pieces), strict=True)
    return (name or " and ".join(names)).strip(), list(chain.from_iterable(parts))


def _sided(piece: str) -> tuple[str, list[str]]:
    """Return the name and the one-sided contrasts of the text between two signs."""
    if not piece.startswith("|"):
        return piece, [piece if _SIGN.search(piece) else f"{piece} > 0"]
    match = _WITHIN.fullmatch(piece)
    if match is None or not float(match["margin"]):
        raise ModelError(
            f"contrast {piece!r}: write equivalence as |arm[B]-arm[A]| < 0.05, with <, and a"
            " number above zero"
        )
    body, margin, ending = match.groups(default="")
    return f"{body} within {margin}{ending}", [
        f"{body} {bound}{margin}{ending}" for bound in ("> -", "< ")
    ]
