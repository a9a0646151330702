"""What a study reads beside its sheets: the steps of a source, each of which may do nothing."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from hipsta_bids.group.cohort.collect import Collection
from hipsta_bids.group.cohort.data import Cohort
from hipsta_bids.group.cohort.read import Measured
from hipsta_bids.types import VisitKey

Remark = Callable[[pd.DataFrame, str | None], str]
"""Makes a note from the table of visits and the column of groups."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Search:
    """Where a source looks for files."""

    bids_dir: Path
    maps: frozenset[str]
    """Names of the maps that are asked for."""
    visits: Sequence[VisitKey]
    """With sheets."""
    choice: Callable[[Iterable[VisitKey]], Callable[[str, str | None, str], bool]]
    """Returns a check of subject, session and hemisphere, from all visits."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Reading:
    """Sheets as they were read, with the additions of sources."""

    bids_dir: Path
    collection: Collection
    visits: Sequence[VisitKey]
    """Of sheets and sources."""
    measured: Measured
    surfaces: Mapping[str, Cohort] = field(default_factory=dict)
    """Maps with points of their own, by name."""
    notes: tuple[str, ...] = ()
    remarks: tuple[Remark, ...] = ()


class Source:
    """A source without content; each kind overrides some of its steps."""

    @property
    def has_maps(self) -> bool:
        """Whether it has maps of the dataset, which need no sheets."""
        return False

    @property
    def record(self) -> Mapping[str, Any]:
        """Return names and patterns of files, for the record of an analysis."""
        return {}

    def names(self, *, with_sheets: bool) -> tuple[str, ...]:  # noqa: ARG002  (of the kinds)
        """Check the options, and return the names of the maps."""
        return ()

    def find(self, search: Search) -> "tuple[Source, set[VisitKey]]":  # noqa: ARG002  (of the kinds)
        """Return the source with its files, and the visits that have any."""
        return self, set()

    def add(self, reading: Reading) -> Reading:
        """Read the files."""
        return reading

    def sentences(self, maps: Sequence[str], surfaces: Sequence[str]) -> Iterable[str]:  # noqa: ARG002  (of the kinds)
        """Return sentences of the methods on registration, by maps of a study and surfaces."""
        return ()
