"""The headline about a hemisphere: the decision of its record, and the reason.

A hemisphere with a flag is one to look at, whatever was repaired. Its headline is the flag with the
largest consequence: by how much the mean thickness could be off, then the share of the map. Without
a flag, the headline is what was repaired.
"""

from dataclasses import dataclass

import numpy as np

from hipsta_bids.reports.page import number, read_table
from hipsta_bids.reports.results import Finding, Hemisphere
from hipsta_bids.types import Decision

#: Flags about what was measured besides.
_BESIDES = {
    name
    for section in read_table("reasons.toml")["section"]
    for name, row in section["reasons"].items()
    if row.get("is_besides")
}

#: Repairs by their kinds (:class:`Repair`).
_REPAIRS = {
    "cavity": "gaps filled",
    "slit": "slits filled",
    "fill": "holes filled",
    "cut": "bridges cut",
    "part": "touching turns parted",
    "island": "separate pieces removed",
    "uncus": "uncus excluded",
}

_SOUND = "No check raised a flag, and no label was repaired."
_ROUNDING = 0.005
"""mm; means that differ by less read the same."""

_TITLES = {Decision.USE: "Use", Decision.LOOK: "Look before use", Decision.FAILED: "Do not use"}
#: By which pages sort.
_ORDER = (Decision.FAILED, Decision.LOOK, Decision.USE)


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The first lines about a hemisphere."""

    decision: Decision
    reason: str
    """The finding that decides."""
    consequence: str
    advice: str
    change: float = float("nan")
    """What the mean thickness could be off by, mm."""
    share: float = float("nan")
    """Of the map that could be wrong."""

    @property
    def title(self) -> str:
        """The decision, in words."""
        return _TITLES[self.decision]

    @property
    def rank(self) -> tuple[int, float, float]:
        """By which pages sort: decision, then the largest change of the mean and share."""
        change, share = (float(np.nan_to_num(value)) for value in (self.change, self.share))
        return _ORDER.index(self.decision), -abs(change), -share


def verdict_of(hemisphere: Hemisphere) -> Verdict:
    """Take the decision from the quality record, and write its reasons."""
    decision = hemisphere.decision
    if decision == Decision.FAILED:
        return Verdict(
            decision=decision,
            reason=_sentence(hemisphere.message or "no message"),
            consequence="There are no maps and no numbers.",
            advice="What to do: " + _remedy(str(hemisphere.record.get("reason"))),
        )
    if decision == Decision.LOOK:
        finding = hemisphere.findings[0]
        return Verdict(
            decision=decision,
            reason=_sentence(finding.message),
            consequence=of_flag(hemisphere, finding),
            advice="Look at the numbered places; then use it, correct the labels, or exclude it.",
            change=finding.change,
            share=finding.share,
        )
    return Verdict(
        decision=decision,
        reason=_repairs(hemisphere),
        consequence=_of_repairs(hemisphere),
        advice="",
    )


def _repairs(hemisphere: Hemisphere) -> str:
    """Write how many repairs of each kind there were."""
    kinds = hemisphere.metrics.get("repair_kinds") or {}
    counts = [f"{text} ({kinds[kind]})" for kind, text in _REPAIRS.items() if kind in kinds]
    return f"Labels were repaired: {', '.join(counts)}." if counts else _SOUND


def _of_repairs(hemisphere: Hemisphere) -> str:
    """Write how much of the map depends on repairs, and by how much the mean thickness does."""
    keys = ("repaired_fraction", "repaired_change_mm", "doubtful_fraction")
    share, change, hatched = (number(hemisphere.metrics, key) for key in keys)
    if not share > 0:
        return ""
    mean = hemisphere.summary.get("thickness_mean", np.nan)
    before, after = f"{mean - change:.2f}", f"{mean:.2f} mm"
    return (
        f"Repairs touch {share:.1%} of the map; without repairs, the mean thickness would be "
        f"{f'{before} instead of' if f'{before} mm' != after else 'the same,'} {after}. "
        f"{f'{hatched:.1%} of the map is' if hatched else 'Nothing is'} hatched as doubtful."
    )


def of_flag(hemisphere: Hemisphere, finding: Finding) -> str:
    """Write what a flag may do to the map."""
    if finding.reason in _BESIDES:
        return "Thickness and shape do not depend on it."
    return _consequence(hemisphere, finding.share, finding.change)


def _consequence(hemisphere: Hemisphere, share: float, change: float) -> str:
    """Write which share of the map could be wrong, and what the mean could be off by, mm."""
    if np.isnan(share):
        return "The effect on the mean thickness is unknown."
    mean = hemisphere.summary.get("thickness_mean", np.nan)
    if share == 0:
        return f"No measured column lies there: the mean thickness stays {mean:.2f} mm."
    extent = "the whole map" if share == 1 else f"{share:.1%} of the map"
    if np.isnan(change):
        return f"It concerns {extent}; the effect on the mean thickness is unknown."
    if abs(change) < _ROUNDING:
        return f"It concerns {extent}; the mean thickness hardly depends on it: {mean:.2f} mm."
    compared = "expected" if share == 1 else "with values of the neighbors"
    return (
        f"The mean thickness could be {abs(change):.2f} mm too {'large' if change > 0 else 'small'}"
        f", and {extent} wrong: {mean:.2f} mm as measured, {mean - change:.2f} mm {compared}."
    )


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."


def _remedy(reason: str) -> str:
    """Say what to do about a reason."""
    for section in read_table("reasons.toml")["section"]:
        if reason in section["reasons"]:
            return " ".join(section["reasons"][reason]["remedy"].split())
    return "correct the labels and measure again."
