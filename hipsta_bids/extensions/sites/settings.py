"""Settings of harmonization."""

from typing import Annotated

from pydantic import Field

from hipsta_bids.types import tables


class HarmonizationSettings(tables.SettingsTable):
    """ComBat: effects of sites or scanners, taken out of maps and summary measures."""

    column: str = ""
    """Column whose levels are harmonized, as ``site``; empty is none."""
    least_participants: Annotated[int, Field(ge=3)] = 10
    """Sites with fewer participants are refused: the mean of ten is known to a third of an SD."""
    explained: tables.OpenFraction = 0.8
    """A note names columns of the model of whose variance sites explain more than this."""
    pooling: bool = True
    """Points of a map inform each other about a site (empirical Bayes); summary measures never
    do."""
