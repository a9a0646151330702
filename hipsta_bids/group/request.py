"""What an analysis is asked: data, model and settings, and plans of extensions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pandas as pd

from hipsta_bids.group.cohort.data import Cohort, Measures
from hipsta_bids.group.model import Comparison, Groups
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.stats.formula import ModelSpec
from hipsta_bids.stats.warps import Template


@dataclass(frozen=True, eq=False, kw_only=True)
class Request:
    """A model, and the cohort that it is fitted to."""

    cohort: Cohort
    """The visits that are compared."""
    model: ModelSpec
    """Formula and contrasts."""
    groups: Groups | None
    """For classification, and for figures by group."""
    settings: GroupSettings
    measures: Measures
    surfaces: Sequence[str] = ()
    """Maps with points of their own, which are analyzed after the sheets."""
    references: Mapping[str, str]
    """Reference levels of factors, as ``choose_model`` gives them."""
    comparison: Comparison = field(default_factory=Comparison)
    """Which sessions and sides; by default one visit per participant."""
    time: str | None = None
    """Column of the time of visits, for random slopes."""
    icv: str | None = None
    """Column of intracranial volume, for volumes, areas and extents."""
    templates: Mapping[str, Template] | None = None
    """Of registration, by hemisphere; without, they are made from this cohort."""
    contrasts: tuple[str, ...] = ()
    """Texts, as the user wrote them."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Values of the options of extensions, by their names in Python."""
    plans: Mapping[str, Any] = field(default_factory=dict)
    """Plans of the steps of extensions that are asked, by step."""
    has_unregistered: bool = True
    """Whether a fit of unregistered maps has a meaning."""

    @property
    def table(self) -> pd.DataFrame:
        """Rows of the model: visits, or participants of whom two sessions are compared."""
        return self.comparison.sessions.rows(self.cohort.table)
