"""Files that later analyses use: templates, effects of sites, and norms."""

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field, model_validator

from hipsta_bids import __version__
from hipsta_bids.errors import ModelError
from hipsta_bids.io import files
from hipsta_bids.stats.arrays import Key
from hipsta_bids.stats.combat import ARRAYS, SiteEffects
from hipsta_bids.stats.grammar import closed_formula
from hipsta_bids.stats.warps import DEGREE, Template
from hipsta_bids.types.tables import Fraction, OpenFraction, TomlTable

#: Fields of a template that are arrays.
_TEMPLATE_ARRAYS = ("knots", "mean", "components", "center")
#: Bytes of the largest file that is read.
LARGEST_FILE = 1_000_000_000
_FLAT = frozenset({"mean", "sd", "ratio"})
#: Least distance of the knots of a template, and from 0 and 1.
_CLOSEST = 1e-6


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


def _rising(values: list[float]) -> list[float]:
    if (np.diff(values) < 0).any():
        raise ValueError("numbers that rise")
    return values


def _separate(values: list[float]) -> list[float]:
    # Splines of knots that meet cannot be differentiated.
    if (np.diff([0.0, *values, 1.0]) < _CLOSEST).any():
        raise ValueError("different numbers that rise")
    return values


_Rising = Annotated[list[Fraction], Field(max_length=1000), AfterValidator(_rising)]
_Knots = Annotated[list[OpenFraction], Field(max_length=1000), AfterValidator(_separate)]


def templates_to_json(templates: Mapping[str, Template]) -> dict[str, Any]:
    """Write templates by hemisphere as a JSON object.

    ``align`` and ``warp_variance`` are left of an earlier method: earlier files have them.
    """
    entries = {
        hemi: {
            "knots": template.knots.tolist(),
            "mean": template.mean.tolist(),
            "components": template.components.tolist(),
            "noise": template.noise,
            "scale": template.scale,
            "align": "registr",
            "warp_variance": None,
            "turns": template.turns,
            "center": template.center.tolist(),
        }
        for hemi, template in templates.items()
    }
    return {"Description": "template of curvature profiles along x", "Hemispheres": entries}


class _SavedTemplate(TomlTable):
    """A template in a file, which may be other people's and hold anything."""

    knots: _Knots
    mean: list[files.Number]
    components: list[list[files.Number]]
    noise: Annotated[files.Number, Field(gt=0)]
    scale: Annotated[files.Number, Field(gt=0)] | None
    align: Literal["registr"]
    warp_variance: None
    turns: Annotated[int, Field(ge=0, le=1000)]
    center: Annotated[_Rising, Field(min_length=2)]

    @model_validator(mode="after")
    def _fits(self) -> Self:
        """Refuse numbers that do not fit each other."""
        rows = {len(row) for row in self.components}
        sizes = {len(self.knots) + DEGREE + 1, len(self.mean), len(self.components)}
        if len(sizes) > 1 or len(rows) != 1 or not 0 < rows.pop() <= len(self.mean):
            raise ValueError("knots, mean and components do not fit each other")
        if not np.allclose([self.center[0], 1 - self.center[-1]], 0):
            raise ValueError("center does not run from 0 to 1")
        return self


def templates_from_json(content: Mapping[str, Any], source: str) -> dict[str, Template]:
    """Read what :func:`templates_to_json` wrote."""
    try:
        templates = {}
        for hemi, entry in content["Hemispheres"].items():
            values = dict(files.checked_foreign(entry, _SavedTemplate))
            values |= {name: np.array(values[name], dtype=np.float64) for name in _TEMPLATE_ARRAYS}
            del values["align"], values["warp_variance"]
            templates[str(hemi)] = Template(**values)
    except (KeyError, AttributeError, TypeError, ValueError) as error:
        problem = error if isinstance(error, ValueError) else "it has no Hemispheres"
        raise ModelError(
            f"{source}: not a template: {problem}; use the template.json of another analysis"
        ) from error
    return templates
