"""Reads the files of one analysis of the group level."""

import csv
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hipsta_bids.bids import files

#: Sides as they stand in tables; of maps and of summary measures, both mean different things.
SIDES = {"L": "left", "R": "right", "LR": "left minus right"}
BOTH = "LR"

MINUS = "\N{MINUS SIGN}"

_TEXT = (
    *("measure", "unit", "contrast", "hemi", "group", "subfield", "shares", "test", "effect"),
    *("file", "model", "control", "case", "base", "added", "classifier", "region"),
    *("participant_id", "session_id", "reason", "message"),
)


@dataclass(frozen=True, eq=False, kw_only=True)
class GroupResults:
    """The folder of one analysis."""

    folder: Path
    record: Mapping[str, Any]
    """What was run, from ``analysis.json``."""
    _tables: dict[str, pd.DataFrame] = field(default_factory=dict, repr=False)

    @property
    def name(self) -> str:
        """Of the model."""
        return self.folder.name

    @property
    def levels(self) -> tuple[str, ...]:
        """Groups that are compared, from least to most affected; perhaps none."""
        return tuple(str(level) for level in (self.record.get("groups") or {}).get("levels", ()))

    def table(self, name: str) -> pd.DataFrame:
        """Read a table; empty if there is none.

        Parameters
        ----------
        name : str
            File name without ``.tsv``.
        """
        if name not in self._tables:
            path = self.folder / f"{name}.tsv"
            self._tables[name] = (
                pd.read_csv(
                    path,
                    sep="\t",
                    na_values=[files.MISSING],
                    keep_default_na=False,
                    dtype=dict.fromkeys(_TEXT, str),
                    quoting=csv.QUOTE_NONE,
                )
                if path.exists()
                else pd.DataFrame()
            )
        return self._tables[name]

    def everywhere(self, name: str) -> pd.DataFrame:
        """Join a table of the sheets and those of other programs' maps."""
        others = (self.record.get("inputs") or {}).get("maps") or {}
        parts = [self.table(name), *(self.table(f"{other}_{name}") for other in others)]
        return pd.concat([part for part in parts if len(part)] or parts[:1], ignore_index=True)


def read_group(folder: Path) -> GroupResults:
    """Read what an analysis says of itself.

    Parameters
    ----------
    folder : Path
        Of the model.

    Raises
    ------
    InputError
        If ``analysis.json`` cannot be read.
    """
    return GroupResults(folder=folder, record=files.read_json(folder / "analysis.json"))


def records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """List the rows of a table by column."""
    return [dict(zip(map(str, table.columns), row, strict=True)) for row in table.to_numpy(object)]


def spelled(measure: str) -> str:
    """Spell a measure with spaces."""
    return measure.replace("_", " ")


def unit_of(unit: str) -> str:
    """Spell a unit as people write it; nothing for pure numbers."""
    return "" if unit == "1" else unit.replace("^2", "²").replace("^3", "³")


def with_unit(text: str, unit: str) -> str:
    """Put a unit behind a number or a name."""
    return f"{text} {unit_of(unit)}".rstrip()


def statistic_text(row: Mapping[str, Any]) -> str:
    """Spell a statistic with its degrees of freedom; of F, tables have those of the error."""
    value = number_text(row["statistic"])
    if row["test"] == "t":
        return f"t({row['df']:.0f}) {value}"
    return f"{row['test']} {value}, error df {row['df']:.0f}"


def number_text(value: float) -> str:
    """Spell a number with three digits."""
    if not np.isfinite(value):
        return files.MISSING
    text = f"{value:.3g}"
    text = f"{value:.0f}" if "e+" in text else text
    return text.replace("-", MINUS)


def p_text(p: float) -> str:
    """Spell a p-value."""
    if not np.isfinite(p):
        return files.MISSING
    return "< 0.001" if p < 0.001 else f"{p:.3f}"  # noqa: PLR2004  (as papers have it)


def direction(results: GroupResults, contrast: str, hemi: str, sign: float) -> str:
    """Say what a contrast above or below zero means.

    Parameters
    ----------
    results : GroupResults
    contrast : str
        Its name.
    hemi : str
        ``L``, ``R`` or ``LR``.
    sign : float
        Of the estimate.
    """
    comparison = results.record.get("comparison") or {}
    if contrast == "mean" and hemi == BOTH:
        return "larger on the left" if sign > 0 else "larger on the right"
    if contrast == "mean" and comparison.get("pair"):
        return "with an increase" if sign > 0 else "with a decrease"
    # Contrasts as users write them, and as the default model names them: of change in time, too.
    short = re.sub(r"\w+\[([^\]]*)\]", r"\1", contrast).replace(" - ", "-")
    for first in results.levels:
        for second in results.levels:
            if re.fullmatch(rf"(?:.* in )?{re.escape(first)}-{re.escape(second)}", short):
                return f"larger in {first if sign > 0 else second}"
    return "positive" if sign > 0 else "negative"
