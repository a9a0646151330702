"""The folder of an analysis of the group level, as it is read back: record and tables."""

import csv
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from hipsta_bids.io import files
from hipsta_bids.types import JOINT

#: How meta-analyses end the names of contrasts.
_MODELS = re.compile(r" \((fixed|random) effects?\)$")
#: Columns that are never numbers.
_TEXT = (
    *("measure", "unit", "contrast", "hemi", "group", "subfield", "shares", "test", "effect"),
    *("file", "model", "control", "case", "base", "added", "classifier", "region"),
    *("analysis", "other", "seg", "groups", "formula", "correction"),
    *("participant_id", "session_id", "reason", "message", "site", "kind", "version", "template"),
    *("variable", "level"),
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
        """Name of the model."""
        return self.folder.name

    @property
    def is_change(self) -> bool:
        """Whether values are differences of two sessions."""
        return bool((self.record.get("comparison") or {}).get("pair"))

    @property
    def levels(self) -> tuple[str, ...]:
        """Groups that are compared, from least to most affected; may be empty."""
        return tuple(str(level) for level in (self.record.get("groups") or {}).get("levels", ()))

    def table(self, name: str) -> pd.DataFrame:
        """Read a table; empty if there is none."""
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
        """Join a table of the sheets and tables of other programs' maps."""
        prefixes = [*((self.record.get("inputs") or {}).get("maps") or {}), JOINT]
        parts = [self.table(name), *(self.table(f"{prefix}_{name}") for prefix in prefixes)]
        return pd.concat([part for part in parts if len(part)] or parts[:1], ignore_index=True)


def read_group(folder: Path) -> GroupResults:
    """Read the record of an analysis."""
    return GroupResults(folder=folder, record=files.read_json(folder / "analysis.json"))


def records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """List the rows of a table by column."""
    return [dict(zip(map(str, table.columns), row, strict=True)) for row in table.to_numpy(object)]


def without_effects(contrast: str) -> str:
    """Remove the model of a meta-analysis from the name of a contrast."""
    return _MODELS.sub("", contrast)


def short_contrast(contrast: str) -> str:
    """Write ``group[A] - group[B]``, as users do, like the default model, as ``A-B``."""
    return re.sub(r"\w+\[([^\]]*)\]", r"\1", without_effects(contrast)).replace(" - ", "-")
