"""Files that later analyses use: templates, effects of sites, and norms."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from hipsta_bids.errors import ModelError
from hipsta_bids.io import files
from hipsta_bids.stats.warps import DEGREE, Template
from hipsta_bids.types.tables import Fraction, OpenFraction, TomlTable

#: Fields of a template that are arrays.
_TEMPLATE_ARRAYS = ("knots", "mean", "components", "center")
#: Bytes of the largest file that is read.
LARGEST_FILE = 1_000_000_000
#: Least distance of the knots of a template, and from 0 and 1.
_CLOSEST = 1e-6


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
