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
#: Names of the parts of each conjunction, by its name.
Plan = Mapping[str, tuple[str, ...]]


def describe(parser: Parser) -> None:
    """Describe what contrasts can be, in the help."""
    parser.add_argument_group(
        "conjunction and equivalence",
        'Conjunction: --contrast "A & B", both above zero. Equivalence: --contrast "|A| < 0.1",'
        " A between -0.1 and 0.1 in the unit of the measure.",
    )


def fitted_contrasts(texts: Sequence[str]) -> tuple[str, ...]:
    """Return texts of contrasts with conjunctions as their parts, each part once."""
    plain = [text for text in texts if not _split(text)[1]]
    return (*plain, *(text for name, text in _parts(texts).items() if name not in _names(plain)))


def is_asked(request: "Request") -> bool:
    """Check for conjunctions."""
    return bool(_parts(request.contrasts))


def plan_conjunctions(request: "Request") -> tuple[Plan, frozenset[str]]:
    """Return conjunctions, and the names of parts that are no results by themselves."""
    from hipsta_bids.stats.formula import check_labels  # noqa: PLC0415  (start-up time)

    splits = [_split(text) for text in request.contrasts]
    pairs = zip(request.contrasts, splits, strict=True)
    plain = _names([text for text, (_, parts) in pairs if not parts])
    check_labels([*plain, *(name for name, parts in splits if parts)])
    plan = {name: tuple(_names(parts)) for name, parts in splits if parts}
    return plan, frozenset(chain.from_iterable(plan.values())) - frozenset(plain)


def _parts(texts: Sequence[str]) -> dict[str, str]:
    """Return the texts of all parts by their names."""
    parts = list(chain.from_iterable(_split(text)[1] for text in texts))
    return dict(zip(_names(parts), parts, strict=True))


def _names(texts: Sequence[str]) -> list[str]:
    from hipsta_bids.stats.contrasts import contrast_json  # noqa: PLC0415  (start-up time)

    return [str(contrast_json(text)["Name"]) for text in texts]


def _split(text: str) -> tuple[str, list[str]]:
    """Return the name of a conjunction and its one-sided parts; no parts of other contrasts."""
    match = _NAMED.fullmatch(text)
    name, body = match.groups() if match else ("", text)
    pieces = _AND.split(body)
    if len(pieces) == 1 and not body.startswith("|"):
        return "", []
    names, parts = zip(*map(_sided, pieces), strict=True)
    return (name or " and ".join(names)).strip(), list(chain.from_iterable(parts))


def _sided(piece: str) -> tuple[str, tuple[str, ...]]:
    """Return the name and the one-sided contrasts of what stands between signs."""
    if not piece.startswith("|"):
        return piece, (piece if _SIGN.search(piece) else f"{piece} > 0",)
    match = _WITHIN.fullmatch(piece)
    if match is None or not float(match["margin"]):
        raise ModelError(
            f"contrast {piece!r}: write equivalence as |arm[B]-arm[A]| < 0.05, with a margin"
            " above zero"
        )
    body, margin, ending = match.groups(default="")
    parts = (f"{body} > -{margin}{ending}", f"{body} < {margin}{ending}")
    return f"{body} within {margin}{ending}", parts
