"""Settings of perturbed copies."""

from typing import Annotated

from pydantic import Field, NonNegativeFloat

from hipsta_bids.types import tables


class UncertaintySettings(tables.SettingsTable):
    """Perturbed copies of the labels; their spread is the uncertainty of maps (--uncertainty)."""

    relabeling: NonNegativeFloat = 0.3
    """Boundaries are drawn elsewhere by this in all, mm: SD along each axis."""
    correlation: tables.Lengths = (1.0, 3.0)
    """Distances over which these errors correlate by 1/e, mm, in equal shares of the variance that
    ``jitter`` leaves."""
    end_shift: NonNegativeFloat = 0.5
    """End planes are placed elsewhere by this, slices: SD along the normal. An end without a label
    moves by its standard error if that is larger."""
    jitter: NonNegativeFloat = 0.5
    """Part of these errors is independent between voxels: even, up to this, in voxels along each
    axis. With 0, and ``relabeling`` 0, labels have no errors."""
    rotation: Annotated[float, Field(ge=0, le=45)] = 5.0
    """Rotation of the voxels about each axis, up to this, degrees, with a shift up to half a voxel.
    It simulates another position in the scanner."""
