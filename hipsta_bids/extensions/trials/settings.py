"""Settings of trials."""

from typing import Annotated

from pydantic import Field, PositiveFloat

from hipsta_bids.types import tables


class RetestSettings(tables.SettingsTable):
    """Agreement of repeated sessions."""

    confidence: tables.OpenFraction = 0.95
    """Coverage of two-sided confidence limits, fraction."""
    min_participants: Annotated[int, Field(ge=3)] = 5
    """Fewer participants with all sessions are too few, also at a point."""


class PowerSettings(tables.SettingsTable):
    """Participants that a trial of two arms needs."""

    power: tables.OpenFraction = 0.8
    """Chance to find the effect."""
    dropout: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Share of the enrolled participants lost before the last visit, at a constant hazard. Their
    visits before that are in the mixed model of several visits."""
    allocation: Annotated[float, Field(ge=1, le=20)] = 1.0
    """Participants of the larger arm over the smaller arm."""
    alpha: tables.OpenFraction = 0.05
    """Two-sided level of the test of a summary measure, one of which is the end point. Maps hold
    the false discovery rate ``multiplicity.alpha``."""
    affected: tables.OpenFraction = 0.1
    """Share of the points of a map that differ, as it decides on the level at each of them."""
    months_per_time: PositiveFloat = 12.0
    """Months per unit of a column of time that is not called years, months or days."""
