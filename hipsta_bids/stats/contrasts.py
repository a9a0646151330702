"""Contrasts as users and BIDS Stats Models 1.0.0 write them.

A contrast is a linear combination of names: columns of the design, levels such as ``group[AD]``,
terms such as ``group:age``, and products of these. Parentheses are multiplied out, and
``| sex=M, age=70`` fixes variables. :mod:`marginal` finds the weights of the columns.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import chain, product
from typing import Any, NoReturn

import numpy as np

from hipsta_bids.errors import ModelError
from hipsta_bids.types import Float

#: Version of BIDS Stats Models.
VERSION = "1.0.0"
#: Between a name and the values at which variables are fixed.
CONDITION = " | "

#: A number, a name such as ``age``, ``group[CU]`` or ``poly(age, 2)[1]``, or a sign.
_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:e-?\d+)?)"
    r"|(?P<name>(?:[^\W\d]|`[^`]+`)(?:[\w.]|`[^`]+`|\[[^\]]*\]|\([^)]*\))*)|(?P<sign>[-+*/:()]))"
)
#: Outside of brackets: the sign of a name and, after a bar, of a fixed value.
_EQUALS, _BAR = (re.compile(rf"{sign}(?![^\[]*\])") for sign in ("=", r"\|"))
_COMMA = re.compile(r",(?![^\[(]*[\])])")
#: Sign and margin of a one-sided test, at the end.
_SIDED = re.compile(r"(?P<sign>[<>])\s*(?P<margin>[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)\s*$")
_SIGN = re.compile(r"[<>](?![^\[]*\])")
#: Alternatives of one-sided tests, by their sign.
_SIDES = {">": "greater", "<": "less"}
#: Parentheses within parentheses, and products when all are multiplied out.
_DEEPEST, _MOST_PRODUCTS = 20, 1000
#: Smallest and largest size of a weight: products of weights and variables have to be finite.
_WEIGHTS = (1e-9, 1e9)


@dataclass(frozen=True)
class Contrast:
    """One hypothesis: that ``weights @ coefficients`` is zero, or a margin."""

    name: str
    weights: Float
    """(rows, columns of the design); one row is tested by t, several together by F."""
    side: str = ""
    """Alternative of a one-sided test, ``greater`` or ``less`` than the margin."""
    margin: float = 0.0
    """In units of the measure."""

    def __post_init__(self) -> None:
        weights = np.atleast_2d(np.array(self.weights, dtype=np.float64))
        if np.linalg.matrix_rank(weights) < weights.shape[0]:
            raise ModelError(f"contrast {self.name!r}: rows are redundant or zero; remove one")
        if self.side and len(weights) > 1:
            raise ModelError(
                f"contrast {self.name!r}: tests of several rows have no direction; give each row "
                "with > or < as a contrast"
            )
        weights.flags.writeable = False
        object.__setattr__(self, "weights", weights)

    @property
    def n_rows(self) -> int:
        """Degrees of freedom of the hypothesis."""
        return int(self.weights.shape[0])

    @property
    def hypothesis(self) -> str:
        """What a one-sided test shows, as ``> -0.05``; empty for other tests."""
        signs = {side: sign for sign, side in _SIDES.items()}
        return f"{signs[self.side]} {self.margin:g}" if self.side else ""

    def evidence(self, statistic: Float) -> Float:
        """Return what rises with the evidence for the alternative: the size of t or F, or t."""
        if not self.side:
            return np.abs(statistic)
        return statistic if self.side == "greater" else -statistic


@dataclass(frozen=True)
class ContrastSpec:
    """A contrast by the names of columns, levels, terms and products."""

    name: str
    conditions: tuple[str, ...]
    """Names of columns, levels, terms and products, with the values of fixed variables."""
    weights: tuple[tuple[float, ...], ...]
    """Rows; one for t, several for F."""
    test: str
    """``t`` or ``F``."""
    side: str = ""
    margin: float = 0.0


def contrast_json(text: str) -> dict[str, Any]:
    """Write a contrast of a command line, such as ``b=group[A]-group[B] | sex=M``, as JSON.

    A sign and a margin, as in ``arm[B]-arm[A] > -0.05``, are of a one-sided test, which BIDS Stats
    Models do not have; they are further keys.
    """
    combination, *conditions = _BAR.split(text, 1)
    *names, body = _EQUALS.split(combination)
    parts = [body, *conditions]  # a side may stand before the bar, or at the end
    sided = next(filter(None, map(_SIDED.search, parts)), None)
    body, *conditions = (_SIDED.sub("", part, count=1) for part in parts)
    if _SIGN.search(body) or (names and names[-1].rstrip().endswith(("<", ">"))):
        raise ModelError(
            f"contrast {text!r}: write one-sided tests with one > or < and a number, as"
            " arm[B]-arm[A] > -0.05"
        )
    side: dict[str, Any] = {}
    ending_side = ""
    if sided:
        side = {"Alternative": _SIDES[sided["sign"]], "Margin": float(sided["margin"])}
        ending_side = f" {sided['sign']} {side['Margin']:g}"
    ending = "".join(CONDITION + ", ".join(map(str.strip, c.split(","))) for c in conditions)
    rows = [
        {name + ending: weight for name, weight in parse_expression(row).items()}
        for row in _COMMA.split(body if body.strip() else text)
    ]
    combined = list(dict.fromkeys(chain.from_iterable(rows)))
    weights = [[row.get(name, 0.0) for name in combined] for row in rows]
    test, listed = ("t", weights[0]) if len(rows) == 1 else ("F", weights)
    return {
        "Name": "=".join(names).strip() or f"{body.strip()}{ending_side}{ending}",
        "ConditionList": combined,
        "Weights": listed,
        "Test": test,
        **side,
    }


def parse_contrast(contrast: Mapping[str, Any]) -> ContrastSpec:
    """Read a contrast of a BIDS Stats Model."""
    if not isinstance(contrast, Mapping) or not contrast.get("Name"):
        raise refusal("has a contrast without a name")
    name = str(contrast["Name"])
    test = str(contrast.get("Test", "t"))
    if test not in {"t", "F"}:
        raise refusal(f"has contrast {name!r} with test {test!r}; use t or F")
    try:
        conditions = tuple(map(str, contrast.get("ConditionList", ())))
        listed = contrast.get("Weights", [1] * len(conditions))
        rows = listed if listed and isinstance(listed[0], list) else [listed]
        weights = tuple(tuple(map(_number, row)) for row in rows)
    except (TypeError, ValueError, LookupError, ZeroDivisionError):
        limits = f"{_WEIGHTS[0]:g} to {_WEIGHTS[1]:g}, or 0"
        problem = f"has contrast {name!r} without lists of names and numbers (sizes {limits})"
        raise refusal(problem) from None
    if not conditions or any(len(row) != len(conditions) for row in weights):
        raise refusal(f"has contrast {name!r} with {len(conditions)} conditions and other weights")
    if test == "t" and len(weights) > 1:
        raise refusal(f"has contrast {name!r} with several rows; its test must be F")
    side, margin = _alternative(contrast)
    return ContrastSpec(name, conditions, weights, test, side, margin)


def _alternative(contrast: Mapping[str, Any]) -> tuple[str, float]:
    side, margin = str(contrast.get("Alternative", "")), contrast.get("Margin", 0.0)
    is_number = isinstance(margin, int | float) and abs(margin) < _WEIGHTS[1]
    if side not in {"", *_SIDES.values()} or not is_number:
        raise refusal(
            f"has contrast {str(contrast['Name'])!r} with alternative {side!r} and margin"
            f" {margin!r}; use greater or less, and a number"
        )
    return side, float(margin)


def refusal(problem: str) -> ModelError:
    """Return the error of a model file."""
    return ModelError(f"model file {problem} (BIDS Stats Models {VERSION})")


def _number(value: object) -> float:
    """Read a weight, which may be a fraction such as ``1/3``."""
    above, _, below = str(value).partition("/")
    number = float(above) / float(below or 1)
    if number and not _WEIGHTS[0] <= abs(number) <= _WEIGHTS[1]:  # NaN, too
        raise ValueError(number)
    return number


def parse_expression(text: str) -> dict[str, float]:
    """Read a linear combination, such as ``(a + b)/2 - group[CU]:sex[M]``; weights by name."""
    return _Expression(text).weights


class _Expression:
    """A recursive-descent parser of linear combinations, whose products are multiplied out."""

    def __init__(self, text: str) -> None:
        self.text, self.end, self.depth = text, len(text.rstrip()), 0
        self.kind, self.word, self.position = "", "", 0
        self._advance()
        terms = self._sum()
        if self.kind:
            self._refuse()
        self.weights = {":".join(atoms): weight for atoms, weight in terms.items()}

    def _advance(self) -> None:
        """Read the next token; its kind is empty at the end."""
        self.start = self.position
        if self.position >= self.end:
            self.kind = self.word = ""
            return
        match = _TOKEN.match(self.text, self.position)
        if match is None:
            self._refuse()
        self.kind, self.position = str(match.lastgroup), match.end()
        self.word = match[self.kind]

    def _refuse(self) -> NoReturn:
        raise ModelError(
            f"contrast {self.text!r}: cannot read {self.text[self.start :].strip()!r}; write"
            " group[A]-group[B], 0.5*age or group:age, and names with blanks in backticks"
        )

    def _sum(self) -> dict[tuple[str, ...], float]:
        """Read products with signs."""
        weights: dict[tuple[str, ...], float] = {}
        sign = -1.0 if self.word == "-" else 1.0
        if self.word in {"+", "-"}:
            self._advance()
        while True:
            for atoms, weight in self._product().items():
                weights[atoms] = weights.get(atoms, 0.0) + sign * weight
            if self.word not in {"+", "-"}:
                return weights
            sign = -1.0 if self.word == "-" else 1.0
            self._advance()

    def _product(self) -> dict[tuple[str, ...], float]:
        """Read a weight and names or parentheses, joined by colons, over a number."""
        scale = 1.0
        if self.kind == "number":
            scale = float(self.word)
            self._advance()
            if self.word == "*":
                self._advance()
        terms = self._item()
        while self.word == ":":
            self._advance()
            factors = list(product(terms.items(), self._item().items()))
            if len(factors) > _MOST_PRODUCTS:
                self._refuse()
            terms = {}
            for (left, a), (right, b) in factors:
                atoms = tuple(dict.fromkeys((*left, *right)))
                terms[atoms] = terms.get(atoms, 0.0) + a * b
        if self.word == "/":
            self._advance()
            if self.kind != "number" or not float(self.word):
                self._refuse()
            scale /= float(self.word)
            self._advance()
        return {atoms: scale * weight for atoms, weight in terms.items()}

    def _item(self) -> dict[tuple[str, ...], float]:
        """Read a name, or a sum in parentheses."""
        if self.kind == "name":
            atom = self.word.replace("`", "")
            self._advance()
            return {(atom,): 1.0}
        if self.word != "(" or self.depth == _DEEPEST:
            self._refuse()
        self.depth += 1
        self._advance()
        terms = self._sum()
        if self.word != ")":
            self._refuse()
        self.depth -= 1
        self._advance()
        return terms


def split_name(name: str) -> tuple[list[str], dict[str, str]]:
    """Return the atoms of a name, and the values at which it fixes variables."""
    body, _, condition = name.partition(CONDITION)
    pairs: Iterator[tuple[str, str, str]] = (part.partition("=") for part in condition.split(","))
    fixed = {variable.strip(" `"): value.strip() for variable, sign, value in pairs if sign}
    if condition and len(fixed) < condition.count(",") + 1:
        raise ModelError(f"contrast {name!r}: write fixed values as | sex=M, age=70")
    return re.split(r":(?![^\[(]*[\])])", body), fixed
