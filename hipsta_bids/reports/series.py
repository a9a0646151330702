"""What the sections of a participant's page are about."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

from hipsta_bids.reports.cohort import Cohort
from hipsta_bids.reports.results import Hemisphere
from hipsta_bids.reports.volumes import Views, read_views


@dataclass(frozen=True, eq=False)
class Series:
    """Both hemispheres of one visit, measured with one protocol in one region."""

    hemispheres: tuple[Hemisphere, ...]
    """Left before right; one may be missing."""
    cohort: Cohort

    @property
    def measured(self) -> list[Hemisphere]:
        """Those with maps."""
        return [h for h in self.hemispheres if h.measured]

    @property
    def title(self) -> str:
        """Protocol and region."""
        first = self.hemispheres[0]
        name = first.place.name
        return name.seg if name.region == "body" else f"{name.seg}, {name.region} region"

    @cached_property
    def views(self) -> Mapping[str, Views | None]:
        """Labels and mask by hemisphere."""
        return {h.place.name.hemi: read_views(h) for h in self.hemispheres}

    def view(self, hemisphere: Hemisphere) -> Views | None:
        """Labels and mask of one hemisphere."""
        return self.views[hemisphere.place.name.hemi]
