"""Every number that changes a result: default, unit, meaning.

One frozen dataclass per stage; a stage receives its own part only and has no defaults of its own.
What does not change a result (jobs, verbosity, folders) is in :class:`hipsta_bids.runner.RunOptions`.
"""

from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True)
class BodySettings:
    """From labels to the body's mask and end planes."""

    layer_rule: str = "nearest-sheet"
    """Who gets the molecular layer: ``nearest-sheet`` (the nearest sheet subfield; Diers et al.
    2023) or ``nearest-label`` (the nearest label; voxels nearest to DG or CA4 are left out)."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """All settings of the participant level."""

    body: BodySettings = field(default_factory=BodySettings)
