"""Words for people: what a status means, and which quality numbers are usual."""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

from hipsta_bids.reports.results import Hemisphere
from hipsta_bids.settings import Settings
from hipsta_bids.types import Status


@dataclass(frozen=True, kw_only=True)
class Reason:
    """What a machine-readable reason means, and what to do about it."""

    meaning: str
    remedy: str


@dataclass(frozen=True, kw_only=True)
class ReasonSection:
    """Reasons that are met in the same place."""

    title: str
    text: str
    reasons: Mapping[str, Reason]
    """By their names."""


@cache
def reason_sections() -> tuple[ReasonSection, ...]:
    """Read the table of all reasons, in the order of the reference page."""
    text = (files("hipsta_bids.reports") / "reasons.toml").read_text(encoding="utf-8")
    return tuple(
        ReasonSection(
            title=section["title"],
            text=section["text"],
            reasons={name: Reason(**row) for name, row in section["reasons"].items()},
        )
        for section in tomllib.loads(text)["section"]
    )


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """How a hemisphere ended, for a reader who decides about its use."""

    title: str
    advice: str


_VERDICTS = {
    Status.OK: Verdict(title="Measured", advice="Nothing stood out. It can be used as it is."),
    Status.REPAIRED: Verdict(
        title="Measured after repair",
        advice="Small defects of the labels were mended. Look at the places below; if the repair"
        " fits, it can be used.",
    ),
    Status.FLAGGED: Verdict(
        title="Look before use",
        advice="It was measured, but something is doubtful. Look at the places below, then use it,"
        " correct it, or leave it out.",
    ),
    Status.FAILED: Verdict(
        title="Not measured",
        advice="There are no maps. What stood in the way is said below, and what to try.",
    ),
}


def verdict_of(hemisphere: Hemisphere) -> Verdict:
    """Put the status in words."""
    return _VERDICTS[hemisphere.status]


@dataclass(frozen=True, kw_only=True)
class Usual:
    """A quality number and its usual range."""

    name: str
    """In the quality record."""
    title: str
    meaning: str
    low: float = -math.inf
    high: float = math.inf
    unit: str = ""
    percent: bool = False

    def text(self, value: float) -> str:
        """Spell a value with its unit."""
        if self.percent:
            return f"{value:.1%}"
        return f"{value:.3g}{f' {self.unit}' if self.unit else ''}"

    @property
    def range(self) -> str:
        """Spell the usual range."""
        low, high = math.isfinite(self.low), math.isfinite(self.high)
        if low and high:
            return f"{self.text(self.low)} to {self.text(self.high)}"
        if low:
            return f"at least {self.text(self.low)}"
        return f"at most {self.text(self.high)}" if high else "any"


def usual_ranges(thickness: float, settings: Mapping[str, Any]) -> tuple[Usual, ...]:
    """List the quality numbers that a page shows.

    ``thickness`` Mean over the sheet, mm, to which some limits are relative.
    """
    usual = Settings().model_dump()
    stages = {name: usual[name] | dict(settings.get(name) or {}) for name in usual}
    checks, topology, body = stages["checks"], stages["topology"], stages["body"]
    return (
        Usual(
            name="voxels_across",
            title="Voxels across the sheet",
            meaning="mean thickness in in-plane voxels: fewer make thickness coarse",
            low=checks["min_voxels_across"],
        ),
        Usual(
            name="body_length_mm",
            title="Length of the body",
            meaning="from one end plane to the other",
            low=body["min_length"],
            unit="mm",
        ),
        Usual(
            name="changed_fraction",
            title="Changed by repairs",
            meaning="share of the body that repairs of its topology added or removed",
            high=topology["flag_fraction"],
            percent=True,
        ),
        Usual(
            name="boundary_rim_distance_mm",
            title="Doubt of the boundaries",
            meaning="how far two ways to find the medial and the lateral boundary differ",
            high=checks["flag_rim_distance"] * thickness,
            unit="mm",
        ),
        Usual(
            name="label_order",
            title="Order of labels",
            meaning="rank correlation of x with the order of labels from medial to lateral",
            low=checks["min_label_order"],
        ),
        Usual(
            name="folded_fraction",
            title="Folded coordinates",
            meaning="share of the volume whose coordinates are turned inside out",
            high=checks["flag_folded"],
            percent=True,
        ),
        Usual(
            name="filled_fraction",
            title="Filled columns",
            meaning="share of the columns that were filled from their neighbors",
            high=checks["flag_filled"],
            percent=True,
        ),
        Usual(
            name="repaired_fraction",
            title="Repaired columns",
            meaning="share of the columns that a repair touched; they are hatched on the sheet",
            percent=True,
        ),
        Usual(
            name="tetra_quality_median",
            title="Quality of tetrahedra",
            meaning="median, 1 for regular ones",
        ),
    )


def number(metrics: Mapping[str, Any], name: str) -> float:
    """Give a number of the quality record, NaN where there is none."""
    value = metrics.get(name)
    return float(value) if isinstance(value, (int, float)) else math.nan
