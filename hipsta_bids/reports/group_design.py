"""The model of an analysis: in words, and as a picture of its design matrix."""

import base64
import io
import shlex
from collections.abc import Mapping
from typing import Any

import numpy as np

from hipsta_bids.bids.files import hide_home
from hipsta_bids.reports.figures import colors_of
from hipsta_bids.reports.group_results import GroupResults, number_text, spelled

_CELL = (24, 6)  # pixels of a cell, as wide and as high as a short table wants
_TALLEST = 360  # pixels on the screen
_SHADES = 64


def design(results: GroupResults) -> Mapping[str, Any] | None:
    """Show the design matrix, its contrasts, and what was modeled.

    Parameters
    ----------
    results : GroupResults

    Returns
    -------
    mapping or None
        For the template.
    """
    record = results.record
    table = results.table("design")
    columns = [str(name) for name in record.get("columns") or ()]
    measures = results.table("maps")
    comparison = record.get("comparison") or {}
    return {
        "formula": record.get("formula"),
        "measures": [spelled(m) for m in measures["measure"].unique()] if len(measures) else [],
        "what": _what(comparison),
        "references": list((record.get("references") or {}).items()),
        "columns": columns,
        "contrasts": [
            {
                "name": name,
                "rows": [[number_text(w) for w in row] for row in np.atleast_2d(weights)],
            }
            for name, weights in (record.get("contrasts") or {}).items()
        ],
        "picture": _picture(table, columns) if len(table) else None,
    }


def _what(comparison: Mapping[str, Any]) -> str:
    """Say what a row of the model is."""
    if comparison.get("longitudinal"):
        return (
            "A row is a visit; a mixed model gives each participant an intercept, or a slope too."
        )
    if comparison.get("pair"):
        first, second = comparison["pair"]
        return f"A row is a participant's change from {first} to {second}."
    return "A row is a participant."


def _picture(table: Any, columns: list[str]) -> dict[str, Any]:  # noqa: ANN401  (of pandas)
    from PIL import Image  # noqa: PLC0415  (slow to load)

    matrix = table[columns].to_numpy(dtype=np.float64)
    low, high = matrix.min(axis=0), matrix.max(axis=0)
    share = np.where(high > low, (matrix - low) / np.where(high > low, high - low, 1.0), 1.0)
    shades = (share * (_SHADES - 1)).round().astype(np.uint8)
    image = Image.fromarray(shades, mode="P")
    colors = colors_of("cividis", _SHADES)
    image.putpalette([int(color[i : i + 2], 16) for color in colors.tolist() for i in (1, 3, 5)])
    buffer = io.BytesIO()
    image.save(buffer, format="png", optimize=True)
    ends = [
        number_text(a) if a == b else f"{number_text(a)} to {number_text(b)}"
        for a, b in zip(low, high, strict=True)
    ]
    return {
        "address": "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode(),
        "height": int(min(_TALLEST, max(60, _CELL[1] * len(matrix)))),
        "columns": list(zip(columns, ends, strict=True)),
        "rows": len(matrix),
        "colors": colors[::9].tolist(),
    }


def origin(results: GroupResults) -> Mapping[str, Any]:
    """List what is needed to repeat the analysis."""
    record = results.record
    inputs = record.get("inputs") or {}
    settings = record.get("settings") or {}
    return {
        "command": hide_home(shlex.join(str(part) for part in record.get("command") or ())),
        "version": record.get("version"),
        "inputs": inputs,
        "datasets": [hide_home(str(path)) for path in inputs.get("datasets") or ()],
        "settings": [
            (f"{stage}.{name}", value)
            for stage, part in settings.items()
            for name, value in (part.items() if isinstance(part, Mapping) else [("", part)])
        ],
        "notes": record.get("notes") or [],
    }
