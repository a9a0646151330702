"""What is to be fitted and tested: BIDS Stats Models 1.0.0, one dataset-level node."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hipsta_bids.errors import ModelError

_VERSION = "1.0.0"
#: A weight and a name such as ``age``, ``group[CU]`` or ``group[T.CU]:age``.
_TERM = re.compile(
    r"\s*(?P<sign>[+-])?\s*(?:(?P<weight>\d+\.?\d*|\.\d+)\s*\*?\s*)?"
    r"(?P<name>[^\W\d](?:[\w.:]|\[[^\]]*\]|\([^)]*\))*)"
)


@dataclass(frozen=True)
class ContrastSpec:
    """A contrast by the names of what it combines."""

    name: str
    conditions: tuple[str, ...]
    """Columns of the design, or levels such as ``group[CU]``: then means of the model there."""
    weights: tuple[tuple[float, ...], ...]
    """Rows; one for t, one or more for F."""
    test: str
    """``t`` or ``F``."""


@dataclass(frozen=True)
class ModelSpec:
    """One linear model."""

    name: str
    formula: str
    """Right-hand side, in formulaic's grammar."""
    contrasts: tuple[ContrastSpec, ...]
    dummy: str | None
    """Also test each column by itself, with this test."""
    measures: tuple[str, ...] = ()
    """Left-hand side: what the model is fitted to; empty for the default."""


def model_from_shortcut(formula: str, contrasts: Sequence[str], name: str) -> dict[str, Any]:
    """Write the BIDS Stats Model that says the same as a formula and contrasts.

    Parameters
    ----------
    formula : str
        Such as ``thickness ~ group + age``.
    contrasts : sequence of str
        Such as ``group[CU]-group[DAT]``, ``0.5*a+0.5*b``; rows of an F test are parted by
        commas; ``name=...`` in front gives a name. Without any, each column is tested.
    name : str
        Of the model.

    Raises
    ------
    ModelError
        If a contrast cannot be read.
    """
    node: dict[str, Any] = {
        "Level": "Dataset",
        "Name": name,
        "GroupBy": ["contrast"],
        "Model": {"Type": "glm", "X": [1], "Formula": formula},
    }
    if contrasts:
        node["Contrasts"] = [_contrast_json(text) for text in contrasts]
    else:
        node["DummyContrasts"] = {"Test": "t"}
    return {"Name": name, "BIDSModelVersion": _VERSION, "Nodes": [node]}


def parse_model(document: Mapping[str, Any]) -> ModelSpec:
    """Read a BIDS Stats Model.

    Parameters
    ----------
    document : mapping
        The JSON object. One node at dataset level, type ``glm``, with ``Model.X`` (1, names of
        columns, and ``a*b`` or ``a:b``) or ``Model.Formula``.

    Raises
    ------
    ModelError
        If it is no such model, or asks for what is not supported.
    """
    nodes = document.get("Nodes")
    if not isinstance(nodes, list) or len(nodes) != 1 or not isinstance(nodes[0], Mapping):
        raise _refusal("needs exactly one node, at dataset level")
    node = nodes[0]
    if str(node.get("Level", "")).lower() != "dataset":
        raise _refusal(f"has a node at level {node.get('Level')!r}; only Dataset is supported")
    if node.get("Transformations"):
        raise _refusal("has transformations; write them into the formula instead, as log(age)")
    model = node.get("Model")
    if not isinstance(model, Mapping) or str(model.get("Type", "glm")).lower() != "glm":
        raise _refusal("needs a Model of Type glm")
    name = str(node.get("Name") or document.get("Name") or "model")
    dummy = node.get("DummyContrasts")
    specs = tuple(_parse_contrast(one) for one in node.get("Contrasts", ()))
    names = [spec.name for spec in specs]
    if twice := sorted({one for one in names if names.count(one) > 1}):
        raise _refusal(f"has contrasts of the same name: {', '.join(twice)}")
    return ModelSpec(
        name=name,
        formula=_formula(model),
        measures=left_side(str(model.get("Formula") or "")),
        contrasts=specs,
        dummy=str(dummy.get("Test", "t")) if isinstance(dummy, Mapping) else None,
    )


def left_side(formula: str) -> tuple[str, ...]:
    """Names on the left of the tilde, as in ``thickness + curvature ~ group``.

    Parameters
    ----------
    formula : str

    Returns
    -------
    tuple of str
        Empty if there is no left-hand side.

    Raises
    ------
    ModelError
        If it is not a sum of names.
    """
    left, tilde, right = formula.partition("~")
    if not tilde or not left.strip():
        return ()
    names = tuple(dict.fromkeys(name.strip() for name in left.split("+")))
    if "~" in right or not all(name.isidentifier() for name in names):
        raise ModelError(
            f"formula {formula!r}: on the left of ~ stand names of measures, joined by +, as"
            " thickness + curvature",
            reason="formula",
        )
    return names


def parse_expression(text: str) -> dict[str, float]:
    """Read a linear combination, such as ``0.5*a + 0.5*b - group[CU]``.

    Raises
    ------
    ModelError
        If it is none.
    """
    weights: dict[str, float] = {}
    position = 0
    while position < len(text.rstrip()):
        found = _TERM.match(text, position)
        if found is None or (position and found["sign"] is None):
            raise ModelError(
                f"contrast {text!r}: cannot read {text[position:].strip()!r}; write it as"
                " group[A]-group[B] or 0.5*age",
                reason="contrast-syntax",
            )
        weight = float(found["weight"] or 1) * (-1 if found["sign"] == "-" else 1)
        weights[found["name"]] = weights.get(found["name"], 0.0) + weight
        position = found.end()
    if not weights:
        raise ModelError("contrast: empty; name what to compare", reason="contrast-syntax")
    return weights


def _contrast_json(text: str) -> dict[str, Any]:
    given, _, body = text.rpartition("=")
    rows = [parse_expression(row) for row in re.split(r",(?![^\[(]*[\])])", body)]
    names = list(dict.fromkeys(name for row in rows for name in row))
    weights = [[row.get(name, 0.0) for name in names] for row in rows]
    return {
        "Name": given.strip() or body.strip(),
        "ConditionList": names,
        "Weights": weights[0] if len(rows) == 1 else weights,
        "Test": "t" if len(rows) == 1 else "F",
    }


def _parse_contrast(contrast: Mapping[str, Any]) -> ContrastSpec:
    if not isinstance(contrast, Mapping) or not contrast.get("Name"):
        raise _refusal("has a contrast without a name")
    name = str(contrast["Name"])
    test = str(contrast.get("Test", "t"))
    if test not in {"t", "F"}:
        raise _refusal(f"has contrast {name!r} with test {test!r}; use t or F")
    conditions = tuple(str(one) for one in contrast.get("ConditionList", ()))
    given = contrast.get("Weights", [1] * len(conditions))
    rows = given if given and isinstance(given[0], list) else [given]
    try:
        weights = tuple(tuple(_number(value) for value in row) for row in rows)
    except (TypeError, ValueError):
        raise _refusal(f"has contrast {name!r} with weights that are no numbers") from None
    if not conditions or any(len(row) != len(conditions) for row in weights):
        raise _refusal(f"has contrast {name!r} with {len(conditions)} conditions and other weights")
    if test == "t" and len(weights) > 1:
        raise _refusal(f"has contrast {name!r} with several rows; its test must be F")
    return ContrastSpec(name, conditions, weights, test)


def _number(value: object) -> float:
    """Weights may be fractions such as ``1/3``."""
    if isinstance(value, str) and "/" in value:
        above, below = value.split("/")
        return float(above) / float(below)
    return float(value)  # type: ignore[arg-type]


def _formula(model: Mapping[str, Any]) -> str:
    if text := model.get("Formula"):
        return str(text).rpartition("~")[2].strip()
    terms = model.get("X")
    if not isinstance(terms, list) or not terms:
        raise _refusal("needs Model.X or Model.Formula")
    names = [str(term) for term in terms if str(term) != "1"]
    plain = re.compile(r"[\w.*: ]+")
    if bad := [name for name in names if not plain.fullmatch(name)]:
        raise _refusal(f"has {bad[0]!r} in X; use names of columns, or a Formula")
    return " + ".join(["1" if len(names) < len(terms) else "0", *names])


def _refusal(what: str) -> ModelError:
    return ModelError(f"model file {what} (BIDS Stats Models {_VERSION})", reason="model-file")
