"""Settings of other volumes on the sheet."""

from pydantic import NonNegativeFloat

from hipsta_bids.types import tables


class MapSettings(tables.SettingsTable):
    """Other volumes on the sheet (``--map``)."""

    min_known: tables.Fraction = 0.5
    """A value is missing if less than this share of its voxels, or of the depth, is known."""
    flag_outside: NonNegativeFloat = 0.05
    """Flag if a larger share of the points lies outside the volume's field of view."""
