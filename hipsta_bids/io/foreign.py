"""JSON that others wrote: read, checked against a table, and numbers for it."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import shorten
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field, ValidationError

from hipsta_bids.io import files
from hipsta_bids.protocols.toml import Table, first_mistake

Number = Annotated[float, Field(allow_inf_nan=False)]
FileNumbers = list[Number | None]
"""FileNumbers in JSON; null where one is missing."""
Nested = dict[str, dict[str, dict[str, list[Any]]]]
"""Arrays by hemisphere, measure and name as lists, for JSON."""

#: Characters of a mistake in a file.
_LONGEST = 300


def read_foreign(path: Path, kind: type[Table], *, max_bytes: float) -> Table:
    """Read a JSON file of other people, which may hold anything; nothing in it is run.

    Raises
    ------
    ValueError
        One line about what is wrong in it, or that it has more bytes than ``max_bytes``.
    """
    if path.is_file() and path.stat().st_size > max_bytes:
        raise ValueError(f"larger than {max_bytes / 1e6:g} MB")
    return checked_foreign(files.read_json(path), kind)


def checked_foreign(content: object, kind: type[Table]) -> Table:
    """Check what a file of other people holds; ValueError of one line if something is wrong."""
    try:
        return kind.model_validate(content)
    except RecursionError as error:
        raise ValueError("lists within lists without end") from error
    except ValidationError as error:
        mistake = first_mistake(error, kind).encode("unicode_escape").decode()
        raise ValueError(shorten(mistake, _LONGEST)) from error


def rounded(value: Any) -> Any:  # noqa: ANN401  (nested lists of numbers)
    """Round numbers to nine digits, in lists and arrays too; null where one is missing."""
    if isinstance(value, (list, np.ndarray)):
        return [rounded(one) for one in (value if isinstance(value, list) else value.tolist())]
    if isinstance(value, int):
        return value
    return float(f"{value:.9g}") if math.isfinite(value) else None


def as_nested(results: Mapping[tuple[str, str], object], names: Sequence[str]) -> Nested:
    """Write the named arrays of values by hemisphere and measure."""
    nested: Nested = {}
    for (hemi, measure), result in results.items():
        arrays = {name: rounded(getattr(result, name)) for name in names}
        nested.setdefault(hemi, {})[measure] = arrays
    return nested


def _printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError("a text without control characters")
    return text


Text = Annotated[str, Field(max_length=500), AfterValidator(_printable)]
