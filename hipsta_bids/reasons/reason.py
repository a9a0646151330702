"""The type of one entry."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Reason:
    """A machine-readable reason, in words."""

    meaning: str
    remedy: str
