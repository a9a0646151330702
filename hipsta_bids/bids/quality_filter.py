"""Conditions on quality metrics, such as ``filled_fraction > 0.01 or voxels_across < 3``."""

import ast
import difflib
import operator
from collections.abc import Callable, Mapping
from typing import Any

from hipsta_bids.errors import UsageError

_COMPARISONS: Mapping[type[ast.cmpop], Callable[[Any, Any], bool]] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
}
_ARITHMETIC: Mapping[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
}


class QualityCondition:
    """A condition under which a hemisphere is left out.

    Parameters
    ----------
    text : str
        Comparisons of metrics with numbers or quoted words, joined by ``and``, ``or``, ``not``;
        ``+ - * /`` and parentheses.

    Raises
    ------
    UsageError
        If it cannot be read.
    """

    def __init__(self, text: str) -> None:
        self.text = text
        try:
            self._tree = ast.parse(text.strip(), mode="eval").body
        except SyntaxError as error:
            raise self._refusal("cannot be read; write it as filled_fraction > 0.01") from error

    def holds(self, metrics: Mapping[str, Any]) -> bool:
        """Evaluate the condition.

        Parameters
        ----------
        metrics : mapping
            Numbers and words by name. Comparisons with a missing number are false.

        Raises
        ------
        UsageError
            If a metric is unknown, or numbers are compared with words.
        """
        return bool(self._value(self._tree, metrics))

    def _value(self, node: ast.expr, metrics: Mapping[str, Any]) -> Any:  # noqa: ANN401 -- of the metric
        if isinstance(node, ast.Constant):
            return node.value
        if isinstance(node, ast.Name):
            return self._metric(node.id, metrics)
        if isinstance(node, ast.Compare) and all(type(sign) in _COMPARISONS for sign in node.ops):
            values = [self._value(part, metrics) for part in (node.left, *node.comparators)]
            signs = [_COMPARISONS[type(sign)] for sign in node.ops]
            return all(
                None not in {a, b} and self._act(sign, a, b)
                for sign, a, b in zip(signs, values, values[1:], strict=False)
            )
        return self._joined(node, metrics)

    def _joined(self, node: ast.expr, metrics: Mapping[str, Any]) -> Any:  # noqa: ANN401 -- as above
        if isinstance(node, ast.BoolOp):
            both = isinstance(node.op, ast.And)
            parts = (self._value(part, metrics) for part in node.values)
            return all(parts) if both else any(parts)
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.Not, ast.USub)):
            value = self._value(node.operand, metrics)
            if isinstance(node.op, ast.Not):
                return not value
            return None if value is None else self._act(operator.sub, 0, value)
        if isinstance(node, ast.BinOp) and type(node.op) in _ARITHMETIC:
            a, b = self._value(node.left, metrics), self._value(node.right, metrics)
            return None if None in {a, b} else self._act(_ARITHMETIC[type(node.op)], a, b)
        raise self._refusal("may hold comparisons, and, or, not, + - * / only")

    def _act(self, act: Callable[[Any, Any], Any], a: Any, b: Any) -> Any:  # noqa: ANN401 -- as above
        try:
            return act(a, b)
        except (TypeError, ZeroDivisionError) as error:
            raise self._refusal(f"cannot combine {a!r} and {b!r}") from error

    def _metric(self, name: str, metrics: Mapping[str, Any]) -> Any:  # noqa: ANN401 -- as above
        if name not in metrics:
            near = difflib.get_close_matches(name, metrics, n=1)
            hint = f"did you mean {near[0]}?" if near else "see the desc-qc_metrics.json files"
            raise self._refusal(f"has {name!r}, which is no quality metric; {hint}")
        return metrics[name]

    def _refusal(self, what: str) -> UsageError:
        return UsageError(f"--exclude-qc {self.text!r} {what}", reason="quality-condition")
