"""Results of an analysis: the values that tables, figures and pages are made of."""

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from hipsta_bids.group.cohort import data
from hipsta_bids.group.model import Comparison, Groups
from hipsta_bids.group.output.saved import templates_to_json
from hipsta_bids.group.request import Request
from hipsta_bids.stats import arrays
from hipsta_bids.stats import registration as alignment
from hipsta_bids.stats.arrays import Bool, Float, Int
from hipsta_bids.stats.classify import ModelComparison
from hipsta_bids.stats.design import Design
from hipsta_bids.stats.formula import ModelSpec
from hipsta_bids.stats.glm import FittedMaps, PointTest, PointwiseFit, RowModel
from hipsta_bids.stats.inference import Discoveries, MapKey
from hipsta_bids.types import PARTICIPANT

#: Group of all, where there are no groups.
ALL = "all"


def templates_of(registrations: Mapping[str, alignment.Registration]) -> dict[str, Any] | None:
    """Write the templates of registration for ``template.json``; ``None`` without registration."""
    templates = {hemi: r.template for hemi, r in registrations.items() if r.template}
    return templates_to_json(templates) if templates else None


@dataclass(frozen=True, eq=False, kw_only=True)
class Analysis:
    """Results of one model; each step of the line adds its own."""

    request: Request
    design: Design
    row_model: RowModel
    """What is fitted to each row."""
    cohort: data.Cohort
    """Visits with registered maps, and with what extensions changed in them."""
    registrations: Mapping[str, alignment.Registration] = field(default_factory=dict)
    """By hemisphere; empty without sheets."""
    registered: Mapping[str, arrays.SideMaps] = field(default_factory=dict)
    """Registered maps of all visits that were chosen, by hemisphere."""
    compared: data.Cohort
    """Rows of the model's table with registered maps; of two sessions, their differences."""
    fitted: Mapping[str, FittedMaps] = field(default_factory=dict)
    """Fitted maps by hemisphere; ``LR`` is left minus right."""
    found: Mapping[MapKey, Discoveries] = field(default_factory=dict)
    unregistered: Mapping[MapKey, tuple[Float, Discoveries]] = field(default_factory=dict)
    """Statistic (points,), and the same, of maps that were not registered; empty without
    registration, with permutations, which are too slow to do twice, and where a plan of an
    extension is about registered nodes."""
    measures: Mapping[tuple[str, str], tuple[Sequence[str], PointwiseFit, Int]] = field(
        default_factory=dict
    )
    """Of summary measures, by side (``LR`` for the mean of both) and formula: names, their fits as
    points, and participants with a value; a fit counts visits."""
    classified: data.Cohort
    """What classifiers are given."""
    pairs: Sequence[tuple[str, str, tuple[str, str], ModelComparison]] = ()
    """Hemisphere, added measure, control and case, and result."""
    parts: Mapping[str, Any] = field(default_factory=dict)
    """Results of the steps of extensions, by step."""
    skipped: Sequence[str] = ()
    """What was excluded, and why; one line each."""

    @property
    def model(self) -> ModelSpec:
        """Formula and contrasts."""
        return self.request.model

    @property
    def comparison(self) -> Comparison:
        """Which sessions and sides."""
        return self.request.comparison

    @property
    def groups(self) -> Groups | None:
        """For classification, and for figures by group."""
        return self.request.groups

    @property
    def measured(self) -> data.Measures:
        """What the model was fitted to."""
        return self.request.measures

    @property
    def is_adjusted(self) -> bool:
        """Whether an extension changed the registered maps."""
        before = self.registered or self.request.cohort.sides
        return any(side is not before.get(hemi) for hemi, side in self.cohort.sides.items())

    def noted(self, lines: Iterable[str]) -> "Analysis":
        """Add notes about exclusions."""
        return replace(self, skipped=(*self.skipped, *lines))

    @property
    def n_participants(self) -> int:
        """Number of participants in the model; some may have several rows."""
        return int(self.compared.table[PARTICIPANT].iloc[self.design.rows].nunique())


def tested_maps(analysis: Analysis) -> Iterator[tuple[MapKey, PointTest, Discoveries]]:
    """Tests of all maps, with what survives correction."""
    for hemi, fitted in analysis.fitted.items():
        for measure, fit in fitted.fits.items():
            for test in fit.tests:
                key = MapKey(measure, test.contrast.name, hemi)
                yield key, test, analysis.found[key]


def rows_of(analysis: Analysis, fitted: FittedMaps) -> pd.DataFrame:
    """Rows of the model's table of the sheets that were used."""
    return analysis.compared.table.iloc[fitted.maps.rows[fitted.used]]


def members_of(analysis: Analysis, table: pd.DataFrame) -> Mapping[str, NDArray[np.bool_]]:
    """Determine the rows of each group; all to one where there are no groups."""
    if analysis.groups is None:
        return {ALL: np.ones(len(table), dtype=bool)}
    names = table[analysis.groups.column]
    return {level: (names == level).to_numpy() for level in analysis.groups.levels}


def profiles_of(maps: Mapping[str, Float], name: str, rows: Bool) -> Float:
    """(sheets, x) means over y of some sheets of a map."""
    return np.concatenate(
        [arrays.mean_of_known(part, 2) for part in arrays.parts_of_sheets(maps, name, rows)]
    )


def digests(registrations: Mapping[str, alignment.Registration]) -> dict[str, str]:
    """Digest of the template by hemisphere, or ``none`` without registration."""
    digest_of = {}
    for hemi, registration in registrations.items():
        digest_of[hemi] = "none"
        if registration.template is not None:
            text = json.dumps(templates_to_json({hemi: registration.template}), sort_keys=True)
            digest_of[hemi] = hashlib.sha256(text.encode()).hexdigest()
    return digest_of
