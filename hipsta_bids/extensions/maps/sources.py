"""Maps, masks and volumes as sources of a study."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import pandas as pd

from hipsta_bids.errors import UsageError
from hipsta_bids.extensions.maps import external, volumes
from hipsta_bids.extensions.maps.crop import Places, crop_maps
from hipsta_bids.extensions.maps.masks import mask_note, mask_sheets
from hipsta_bids.extensions.maps.methods import map_sentences
from hipsta_bids.group.cohort.collect import Collection
from hipsta_bids.group.cohort.read import SHEET_MAPS
from hipsta_bids.group.cohort.sources import Reading, Search, Source
from hipsta_bids.types import VisitKey


@dataclass(frozen=True, kw_only=True)
class Maps(Source):
    """Maps of other programs."""

    patterns: tuple[tuple[str, str], ...]
    """Names and patterns."""
    surfaces: tuple[tuple[str | None, str], ...] = ()
    """Patterns of the surfaces to draw these on, for one or for all."""
    crop: bool = False
    """Whether these maps are sampled at the nodes of the sheets."""
    files: tuple[external.ExternalFiles, ...] = ()

    @property
    def has_maps(self) -> bool:
        """Whether maps are asked for."""
        return bool(self.patterns)

    @property
    def record(self) -> Mapping[str, Any]:
        """Return the patterns by name."""
        return {"maps": dict(self.patterns)}

    def names(self, *, with_sheets: bool) -> tuple[str, ...]:
        """Check the options, and return the names of the maps."""
        return tuple(request.name for request in self._requests(SHEET_MAPS if with_sheets else ()))

    def _requests(self, reserved: Sequence[str] = ()) -> tuple[external.MapPattern, ...]:
        return external.map_patterns(self.patterns, self.surfaces, reserved)

    def find(self, search: Search) -> tuple[Source, set[VisitKey]]:
        """Find the files of the maps that are asked for."""
        requests = [request for request in self._requests() if request.name in search.maps]
        files = external.find_all(requests, search.bids_dir, search.visits, search.choice)
        visits = set[VisitKey]().union(*(one.visits for one in files))
        return replace(self, files=tuple(files)), visits

    def add(self, reading: Reading) -> Reading:
        """Add maps on the grid of the sheets to the sheets; others are surfaces of their own."""
        crop = partial(crop_maps, places=_places(reading.collection)) if self.crop else None
        measured, surfaces, notes = external.add_external(
            reading.measured, self.files, reading.visits, crop
        )
        return replace(
            reading, measured=measured, surfaces=surfaces, notes=(*reading.notes, *notes)
        )

    def sentences(self, maps: Sequence[str], surfaces: Sequence[str]) -> Iterator[str]:
        """Describe how the maps were brought to points that correspond."""
        cropped = [
            name for name, pattern in self.patterns if name in maps and not pattern.endswith(".tsv")
        ]
        return map_sentences(surfaces, cropped if self.crop else [])


@dataclass(frozen=True, kw_only=True)
class Masks(Source):
    """Grid points that count as missing."""

    masks: tuple[str, ...]
    """``repaired``, or tables."""

    def add(self, reading: Reading) -> Reading:
        """Set masked points to missing, and note their share by group."""
        if not self.masks:
            return reading
        measured, shares, notes = mask_sheets(
            reading.measured, reading.collection.records, self.masks
        )

        def remark(table: pd.DataFrame, column: str | None) -> str:
            compared = shares[shares["visit"].isin(table.index)]
            return mask_note(compared, table[column] if column else None)

        return replace(
            reading,
            measured=measured,
            notes=(*reading.notes, *notes),
            remarks=(*reading.remarks, remark),
        )


@dataclass(frozen=True, kw_only=True)
class Volumes(Source):
    """Tables of volumes, beside segmentations and named."""

    patterns: tuple[tuple[str, str], ...]
    """Names and patterns."""

    def __post_init__(self) -> None:
        """Refuse wrong names and patterns."""
        volumes.check_volumes(self.patterns)

    @property
    def record(self) -> Mapping[str, Any]:
        """Return the patterns by name."""
        return {"volumes": dict(self.patterns)}

    def add(self, reading: Reading) -> Reading:
        """Add volumes to the summary measures."""
        measured, notes = volumes.add_volumes(
            reading.measured, reading.collection.records, self.patterns, reading.bids_dir
        )
        return replace(reading, measured=measured, notes=(*reading.notes, *notes))


def _places(collection: Collection) -> Places:
    """Return the sheets by visit and hemisphere."""
    results = [record.result for record in collection.records]
    if not results:
        raise UsageError("--maps-crop: there are no sheets; run the participant level first")
    return {((r.name.subject, r.name.session), r.name.hemi): r for r in results}
