"""The closed language of formulas: what may stand in one, checked before anything is evaluated.

formulaic evaluates as Python what stands in the parentheses of a function. So a formula is first
taken apart into names of columns, numbers, operators, and calls of known functions that hold
arithmetic and plain options. formulaic gets what these parts are put together to, nothing else.
"""

import ast
import keyword
import re
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import NoReturn

import numpy as np
from formulaic import Formula
from formulaic.parser.types import Term

from hipsta_bids.errors import UsageError

#: Functions of each value.
_VALUE = frozenset({"I", "abs", "exp", "log", "log10", "log2", "sqrt"})
#: Functions of a whole column; options may follow.
_COLUMN = frozenset({"bs", "center", "cr", "poly", "scale"})
#: Ways in which ``C`` codes a factor, as ``contr.sum`` or ``contr.treatment("CN")``.
_CODINGS = frozenset({"diff", "helmert", "poly", "sum", "treatment"})

#: Functions that formulaic does not have.
CONTEXT: Mapping[str, object] = MappingProxyType({"abs": np.abs, "sqrt": np.sqrt})

_ALLOWED = (
    "allowed are names of columns (except words in backticks), 0, 1, + - * : / **, parentheses"
    f" and {', '.join(['C', *sorted(_VALUE | _COLUMN)])}"
)
_TOKEN = re.compile(
    r"\s*(?:(?P<quoted>`[^`\n]+`)|(?P<string>\"[^\"\\\n]*\"|'[^'\\\n]*')"
    r"|(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<name>[^\W\d]\w*)"
    r"|(?P<sign>\*\*|[-+*/:(),=\[\].]))"
)
#: Operators, the closer they bind the larger.
_OPERATORS = {"+": 1, "-": 1, "*": 2, "/": 2, ":": 3, "**": 4}
#: A random intercept, with the sign before it, other terms with a bar, and texts.
_RANDOM = re.compile(r"\+\s*\(\s*1\s*\|\s*([^\W\d]\w*|`[^`\n]+`)\s*\)(?=\s*(?:\+|$))")
_BAR = re.compile(r"\([^()|]*\|")
_QUOTED = re.compile(r"`[^`]*`|\"[^\"]*\"|'[^']*'")
_PLAIN = re.compile(rf"(?!(?:{'|'.join(keyword.kwlist)})$)[^\W\d]\w*")  # needs no backticks
_PLACEHOLDER = "quoted_column_"

_LONGEST = 2000  # characters
_DEEPEST = 20  # parentheses within parentheses
_HIGHEST_POWER = 9  # of a sum of terms
_MOST_COLUMNS = 50  # of a spline or polynomial
_WIDE = frozenset({"bs", "cr", "poly"})  # functions that make several columns
_MOST_PRODUCTS = 1000  # columns of numbers that operators would make, repeated ones included


#: Kind and text.
_Token = tuple[str, str]


@dataclass(frozen=True)
class ClosedFormula:
    """The right-hand side of a formula of allowed terms only."""

    text: str
    """The formula, put together from its checked parts."""
    names: tuple[str, ...]
    """Columns that it needs, without backticks, in the order of their first use."""
    factors: frozenset[str] = frozenset()
    """Those of them that stand in ``C`` only."""
    numbers: frozenset[str] = frozenset()
    """Those of them that stand in other functions, which take numbers."""
    references: tuple[tuple[str, str], ...] = ()
    """Factors and reference levels of codings, as in ``C(group, contr.treatment("CN"))``."""


def _is_call(tokens: Sequence[tuple[str, str]], position: int) -> bool:
    words = [word for _, word in tokens[position + 1 : position + 2]]
    return tokens[position][0] == "name" and words == ["("]


def _check_number(text: str, tokens: Sequence[tuple[str, str]], position: int) -> None:
    """Refuse a number that is neither an intercept nor a power."""
    is_power = position > 0 and tokens[position - 1][1] == "**"
    powers = [str(power) for power in range(1, _HIGHEST_POWER + 1)]
    if tokens[position][1] not in (powers if is_power else ["0", "1"]):
        _refuse(text, tokens[position][1])


def split_random(formula: str) -> tuple[str, str]:
    """Take the term ``(1|NAME)`` out of a formula, and return the rest and the name, or ``""``."""
    left, tilde, right = formula.rpartition("~")
    names = _RANDOM.findall(f"+{right}")
    plain = _RANDOM.sub(" ", f"+{right}")
    if len(names) > 1 or _BAR.search(_QUOTED.sub("", plain)):
        raise UsageError(
            f"formula {_shortened(right.strip())!r}: of terms with |, only one (1|NAME) can be"
            " added, as group + age + (1|site)"
        )
    if not names:
        return formula, ""
    return left + tilde + (re.sub(r"^[\s+]+", "", plain).strip() or "1"), names[0].strip("`")


def closed_formula(text: str) -> ClosedFormula:
    """Check the right-hand side of a formula; UsageError names unknown and allowed terms."""
    names: dict[str, None] = {}
    plain: set[str] = set()
    numbers: set[str] = set()
    references: dict[str, str] = {}
    parts: list[str] = []
    sizes: deque[str] = deque()
    tokens = _tokens(text)
    position, after_operand = 0, False
    while position < len(tokens):
        kind, word = tokens[position]
        end = position + 1
        is_call = _is_call(tokens, position)
        is_operand = kind in {"name", "quoted", "number"}
        if after_operand and (is_operand or word == "("):
            _refuse(text, f"{tokens[position - 1][1]} {word}")
        if is_call:
            end = _call_end(tokens, position)
            call = _check_call(text, tokens[position:end])
            inside = call.names
            references |= dict.fromkeys(inside, call.base) if call.base else {}
            names |= dict.fromkeys(inside)
            numbers |= set(inside) if word != "C" else set()
        elif kind == "number":
            _check_number(text, tokens, position)
        elif kind in {"name", "quoted"}:
            names[_column(text, word)] = None
            plain.add(_column(text, word))
        elif word not in {*_OPERATORS, "(", ")"}:
            _refuse(text, word)
        after_operand = is_operand or word == ")"
        is_column = kind in {"name", "quoted"}
        sizes.append(_columns_of_call(tokens[position:end]) if is_column else word)
        parts.append("".join(part for _, part in tokens[position:end]))
        position = end
    if _products(sizes) > _MOST_PRODUCTS:
        raise UsageError(
            f"formula {_shortened(text)!r}: its operators make more than {_MOST_PRODUCTS} products;"
            " write fewer * and lower powers"
        )
    factors = frozenset(names) - plain - numbers
    return ClosedFormula(
        " ".join(parts), tuple(names), factors, frozenset(numbers), tuple(references.items())
    )


def _columns_of_call(tokens: Sequence[_Token]) -> str:
    """Return how many columns a name makes, or a call: the largest whole number of its options."""
    words = [word for _, word in tokens]
    options = words[words.index(",") :] if "," in words and _WIDE & set(words) else []
    return max(["1", *filter(str.isdecimal, options)], key=int)


def _products(parts: deque[str], binding: int = 1) -> int:
    """Count products that a formula is expanded to, before equal ones are joined, up to a limit.

    ``parts`` are consumed up to an operator that binds less. They are numbers of columns in place
    of operands. A formula without sense gets any count, as formulaic refuses it.
    """
    while parts and parts[0] in _OPERATORS:  # signs
        parts.popleft()
    if not parts or parts[0] == ")":
        return 1
    if (first := parts.popleft()) == "(":
        size = _products(parts)
        parts.popleft()
    else:
        size = int(first)
    while parts and _OPERATORS.get(parts[0], 0) >= binding:
        sign = parts.popleft()
        right = _products(parts, _OPERATORS[sign] + 1)
        sizes = {"*": size + right + size * right, ":": size * right, "**": size**right}
        size = min(sizes.get(sign, size + right), _MOST_PRODUCTS + 1)
    return size


def term_text(term: Term) -> str:
    """Write a term as a formula has it; formulaic takes the backticks off."""
    return ":".join(
        f"`{factor.expr}`"
        if factor.eval_method.value == "lookup" and not _PLAIN.fullmatch(factor.expr)
        else factor.expr
        for factor in term.factors
    )


def _refuse(text: str, part: str) -> NoReturn:
    """Say that a part of a formula is not allowed."""
    raise UsageError(
        f"formula {_shortened(text)!r}: {_shortened(part)!r} is not allowed; {_ALLOWED}"
    )


def _shortened(text: str, limit: int = 200) -> str:
    return text if len(text) <= limit else f"{text[:limit]}..."


def _tokens(text: str) -> list[_Token]:
    """Take a formula apart."""
    if len(text) > _LONGEST:
        _refuse(text, f"a formula of {len(text)} characters")
    tokens: list[_Token] = []
    position, depth, stop = 0, 0, len(text.rstrip())
    while position < stop:
        match = _TOKEN.match(text, position)
        if match is None:
            _refuse(text, text[position:].split(maxsplit=1)[0])
        kind = str(match.lastgroup)
        tokens.append((kind, match[kind]))
        depth += {"(": 1, ")": -1}.get(match[kind], 0)
        if not 0 <= depth <= _DEEPEST:
            _refuse(text, text[: match.end()].strip())
        position = match.end()
    if depth:
        _refuse(text, "( without )")
    return tokens


def _call_end(tokens: Sequence[_Token], start: int) -> int:
    """Position after the parenthesis that closes a call."""
    depth, end = 0, start + 1
    while True:
        depth += {"(": 1, ")": -1}.get(tokens[end][1], 0)
        end += 1
        if depth == 0:
            return end


def _column(text: str, word: str) -> str:
    """Name of a column; Python's words have a meaning unless they are quoted."""
    if keyword.iskeyword(word):
        _refuse(text, word)
    return word.strip("`")


def _check_call(text: str, tokens: Sequence[_Token]) -> "_Call":
    """Check the call of a function, and return the columns and the reference level in it."""
    quoted = [word for kind, word in tokens if kind == "quoted"]
    if any(word.startswith(_PLACEHOLDER) for _, word in tokens):
        _refuse(text, _PLACEHOLDER)
    numbers = iter(range(len(quoted)))
    source = " ".join(
        f"{_PLACEHOLDER}{next(numbers)}" if kind == "quoted" else word for kind, word in tokens
    )
    try:
        tree = ast.parse(source, mode="eval").body
    except SyntaxError:
        _refuse(text, " ".join(word for _, word in tokens))
    call = _Call(text, quoted)
    call.names = call.columns(tree)
    return call


class _Call:
    """Walks through the syntax tree of a call; what no rule names is refused."""

    def __init__(self, text: str, quoted: Sequence[str]) -> None:
        self.text, self.quoted = text, quoted
        self.names: list[str] = []
        self.base = ""

    def _check_factor(self, positional: list[ast.expr], keywords: list[ast.keyword]) -> None:
        codings = [option for option in keywords if option.arg == "contrasts"]
        for coding in [*positional, *(option.value for option in codings)]:
            self._check_coding(coding)
        self._check_options([], [option for option in keywords if option not in codings])

    def columns(self, node: ast.expr) -> list[str]:
        """Columns in arithmetic or in a call."""
        names: list[str] = []
        inner: list[ast.expr] = []
        match node:
            case ast.Name(id=name):
                names = [self._name(name)]
            case ast.Constant(value=int() | float()) if not isinstance(node.value, bool):
                pass
            case ast.UnaryOp(op=ast.UAdd() | ast.USub(), operand=part):
                inner = [part]
            case ast.BinOp(op=ast.Add() | ast.Sub() | ast.Mult() | ast.Div(), left=a, right=b):
                inner = [a, b]
            case ast.BinOp(op=ast.Pow(), left=base, right=ast.Constant() as power) if (
                not isinstance(base, ast.Constant) and self._is_number(power, _HIGHEST_POWER)
            ):
                inner = [base]
            case ast.Call(func=ast.Name(id=name), args=[part], keywords=[]) if name in _VALUE:
                inner = [part]
            case ast.Call(func=ast.Name(id=name), args=[part, *more]) if name in _COLUMN:
                self._check_options(more, node.keywords)
                inner = [part]
            case ast.Call(func=ast.Name(id="C"), args=[ast.Name(id=name), *more]):
                self._check_factor(more, node.keywords)
                names = [self._name(name)]
            case _:
                self._refuse(node)
        return [*names, *(name for part in inner for name in self.columns(part))]

    def _name(self, name: str) -> str:
        number = name.removeprefix(_PLACEHOLDER)
        return name if number == name else self.quoted[int(number)].strip("`")

    def _check_coding(self, node: ast.expr) -> None:
        if isinstance(node, ast.Call):
            self._check_options(node.args, node.keywords)
            bases = [*node.args, *(option.value for option in node.keywords)]
            node = node.func
            is_treatment = isinstance(node, ast.Attribute) and node.attr == "treatment"
            if is_treatment and bases and isinstance(bases[0], ast.Constant):
                self.base = str(bases[0].value)
        match node:
            case ast.Attribute(value=ast.Name(id="contr"), attr=name) if name in _CODINGS:
                return
        self._refuse(node)

    def _check_options(self, nodes: Sequence[ast.expr], named: Sequence[ast.keyword]) -> None:
        """Options are texts, truth values, numbers, and lists of them."""
        for option in named:
            if option.arg is None or option.arg.startswith("_"):  # formulaic's own
                self._refuse(option.value)
        for node in [*nodes, *(option.value for option in named)]:
            match node:
                case ast.List(elts=parts) | ast.Tuple(elts=parts):
                    self._check_options(parts, [])
                case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() | float())):
                    pass
                case ast.Constant(value=int()) if not self._is_number(node, _MOST_COLUMNS):
                    self._refuse(node)
                case ast.Constant(value=str() | bool() | int() | float()):
                    pass
                case _:
                    self._refuse(node)

    @staticmethod
    def _is_number(node: ast.Constant, limit: int) -> bool:
        return isinstance(node.value, int | float) and abs(node.value) <= limit

    def _refuse(self, node: ast.AST) -> NoReturn:
        part = ast.unparse(node)
        for number, name in enumerate(self.quoted):
            part = part.replace(f"{_PLACEHOLDER}{number}", name)
        _refuse(self.text, part)


def without_variable(formula: str, factor: str) -> str:
    """Remove all terms in which a variable has a part."""
    terms = [
        term_text(term)
        for term in Formula(closed_formula(formula).text)
        if factor not in closed_formula(term_text(term)).names
    ]
    return " + ".join(terms) or "1"
