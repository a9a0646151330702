"""Settings of thickness in single slices."""

from hipsta_bids.types import tables


class SurrogateSettings(tables.SettingsTable):
    """Thickness from the medial axis of single slices (``hipsta-bids surrogate``)."""

    positions: tables.OpenFractions = (0.5,)
    """Where the slices are, fractions of the body's length from its posterior end."""
