"""Effects of sites as a file, for other participants of the same or new sites."""

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import ConfigDict, Field, model_validator

from hipsta_bids import __version__
from hipsta_bids.errors import ModelError
from hipsta_bids.extensions.sites.combat import ARRAYS, SiteEffects
from hipsta_bids.group.output.saved import LARGEST_FILE
from hipsta_bids.io import files
from hipsta_bids.stats.arrays import Key
from hipsta_bids.stats.grammar import closed_formula
from hipsta_bids.types.tables import TomlTable

_FLAT = frozenset({"mean", "sd", "ratio"})


class SavedEffects(TomlTable):
    """Parameters of an analysis as a file, for other participants of the same or new sites."""

    model_config = ConfigDict(alias_generator=str.capitalize, validate_by_name=True)

    file: Annotated[str, Field(exclude=True)] = ""
    """Where it was read, for messages."""
    description: str = "effects of sites on maps and summary measures (ComBat)"
    format: Literal[1] = 1
    version: str = __version__
    column: str
    formula: str
    """What they kept."""
    levels: dict[str, list[str]]
    columns: list[str]
    sites: dict[str, int]
    """Participants by site."""
    repeated: bool
    """Whether participants had several visits."""
    icv: str | None
    """Column that volumes, areas and extents kept besides."""
    labels: dict[str, list[str]] = Field(default_factory=dict)
    """Values of each field of provenance of the labels."""
    templates: dict[str, str]
    """Digest of the template of registration by hemisphere."""
    maps: files.Nested
    summaries: files.Nested
    """Each is a single point."""

    @model_validator(mode="after")
    def _fits(self) -> Self:
        """Refuse arrays that do not fit each other."""
        closed_formula(self.formula)
        _ = self.effects_on_maps, self.effects_on_summaries
        return self

    @cached_property
    def effects_on_maps(self) -> Mapping[Key, SiteEffects]:
        """Effects by hemisphere and measure."""
        return self._effects(self.maps)

    @cached_property
    def effects_on_summaries(self) -> Mapping[Key, SiteEffects]:
        """Effects by hemisphere and measure."""
        return self._effects(self.summaries)

    def _effects(self, nested: files.Nested) -> dict[Key, SiteEffects]:
        rows = {"slopes": {len(self.columns), len(self.columns) + (self.icv is not None)}}
        effects = {}
        for hemi, measures in nested.items():
            for measure, entry in measures.items():
                try:
                    numbers = {name: np.array(entry.get(name, ()), np.float64) for name in ARRAYS}
                except (TypeError, ValueError) as error:
                    raise ValueError(f"no numbers of {measure}, {hemi}: {error}") from error
                points = len(numbers["mean"])
                numbers["slopes"] = numbers["slopes"].reshape(-1, points)  # without columns: (0,)
                for name, values in numbers.items():
                    counts = rows.get(name, {len(self.sites)})
                    shapes = {(points,)} if name in _FLAT else {(row, points) for row in counts}
                    if values.shape not in shapes:
                        raise ValueError(f"{name} of {measure}, {hemi}, has {values.shape}")
                    if np.isinf(values).any():
                        raise ValueError(f"{name} of {measure}, {hemi}, is infinite")
                    if name in {"sd", "scale"} and (values <= 0).any():
                        raise ValueError(f"{name} of {measure}, {hemi}, is not positive")
                effects[hemi, measure] = SiteEffects(**numbers)
        return effects


def load_effects(path: Path) -> SavedEffects:
    """Read ``harmonization.json``; nothing in it is run.

    ModelError if it is too large, of another format, or its parts do not fit each other.
    """
    try:
        return files.read_foreign(path, SavedEffects, max_bytes=LARGEST_FILE).model_copy(
            update={"file": str(path)}
        )
    except ValueError as error:
        raise damaged(str(path), str(error)) from error


def damaged(source: str, problem: str) -> ModelError:
    """Make the error of a file that cannot be used."""
    return ModelError(
        f"{source}: not a file of harmonization ({problem}); use the harmonization.json of another"
        " analysis"
    )
