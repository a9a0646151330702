"""Whether a hemisphere can be used: the finding that decides, and what it may do to the map.

The severity of a hemisphere is one number, by which the pages sort:

- 0: nothing was found;
- above 0: the consequence of the finding that decides, millimeters by which the mean thickness
  could be off times percent of the map that could be wrong, 99 at most;
- at least 1 where there are flags, whatever is known of their consequence;
- 100: not measured.

Of several findings that with the largest consequence decides; all repairs together count as one
finding, and among equals the first flag goes first. Below 1, as with 0.1 mm and a tenth of the
map, a hemisphere is for use, from 1 on a person should look at it, and 100 is for no use.
"""

import re
from dataclasses import dataclass

import numpy as np

from hipsta_bids.derivatives.hemisphere import read_sheet
from hipsta_bids.errors import InputError
from hipsta_bids.geometry.checks import FLAG_REACH, spread_over
from hipsta_bids.geometry.measures import layer_area, node_shares
from hipsta_bids.reports.page import read_table
from hipsta_bids.reports.results import Finding, Hemisphere
from hipsta_bids.types import Float, Status

#: How a person rates a hemisphere, in the order of the keys 1, 2, 3; the last leaves it out.
RATINGS = ("use", "unsure", "exclude")

#: Flags about volumes that were sampled besides.
_BESIDES = ("map-outside", "map-unusable", "roi-unusable")

#: Least severity at which a person should look.
LOOK = 1.0
#: Severity of what was not measured, and the largest of what was.
REFUSED, LARGEST = 100.0, 99.0

_ROUNDING = 0.005
"""mm; means that differ by less read the same."""


@dataclass(frozen=True, kw_only=True)
class Consequence:
    """What one finding may do to the map of thickness."""

    share: float = float("nan")
    """Of the map that could be wrong."""
    mean: float = float("nan")
    """Mean thickness as measured, mm."""
    smoothed: float = float("nan")
    """Mean thickness if the columns concerned were as those around them, mm."""
    without: float = float("nan")
    """Mean thickness of the other columns alone, mm."""
    harmless: bool = False
    """Whether it is about something else than thickness and shape."""

    @property
    def weight(self) -> float:
        """Millimeters times percent of the map; 0 where one of these is not known."""
        weight = abs(self.mean - self.smoothed) * 100 * self.share
        return float(weight) if np.isfinite(weight) else 0.0

    @property
    def text(self) -> str:
        """Both figures, for people."""
        extent = "the whole map" if self.share == 1 else f"{self.share:.1%} of the map"
        if self.harmless:
            return "Thickness and shape do not depend on it."
        if np.isnan(self.share):
            return "What it does to the mean thickness is not known."
        if self.share == 0:
            return f"No measured column lies there: the mean thickness stays {self.mean:.2f} mm."
        if np.isnan(self.smoothed):
            return f"It concerns {extent}; what it does to the mean thickness is not known."
        off = self.mean - self.smoothed
        compared = "expected" if self.share == 1 else "with these columns as those around them"
        means = f"{self.mean:.2f} mm as measured"
        suffix = f", {self.without:.2f} mm without them" if self.without > 0 else ""
        if abs(off) < _ROUNDING:
            return (
                f"It concerns {extent}; the mean thickness hardly depends on it: {means}, the same"
                f" {compared}{suffix}."
            )
        return (
            f"The mean thickness could be {abs(off):.2f} mm too {'large' if off > 0 else 'small'},"
            f" and {extent} wrong: {means}, {self.smoothed:.2f} mm {compared}{suffix}."
        )


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What a person is told about a hemisphere first."""

    title: str
    kind: str
    """``use``, ``look`` or ``refuse``."""
    reason: str
    """The finding that decides."""
    consequence: str
    advice: str
    severity: float


def verdict_of(hemisphere: Hemisphere, reach: float = FLAG_REACH) -> Verdict:
    """Decide from the quality record, and from the tables where it lacks a consequence.

    Columns within ``reach`` of a point, mm, are concerned.
    """
    if not hemisphere.measured:
        return Verdict(
            title="Do not use",
            kind="refuse",
            reason=_sentence(hemisphere.message or "no message"),
            consequence="There are no maps and no numbers.",
            advice="What to do: " + _remedy(str(hemisphere.record.get("reason"))),
            severity=REFUSED,
        )
    if hemisphere.status == Status.OK:
        return Verdict(
            title="Use",
            kind="use",
            reason="Nothing stood out.",
            consequence="No finding puts the mean thickness or the map in doubt.",
            advice="",
            severity=0.0,
        )
    rows = consequences(hemisphere, reach)
    reason, consequence = max(rows, key=lambda row: row[1].weight)
    least = LOOK if hemisphere.status == Status.FLAGGED else 0.0
    severity = min(max(consequence.weight, least), LARGEST)
    look = severity >= LOOK
    return Verdict(
        title="Look before use" if look else "Use",
        kind="look" if look else "use",
        reason=reason,
        consequence=consequence.text,
        advice="Look at the places below; then use it, correct the labels, or leave it out."
        if look
        else "Repairs of this size hardly change the map.",
        severity=round(severity, 2),
    )


def consequences(hemisphere: Hemisphere, reach: float) -> list[tuple[str, Consequence]]:
    """List what flags, and all repairs together, may do to the map."""
    rows = [
        (_sentence(finding.message.split("; it concerns")[0]), _of_flag(hemisphere, finding, reach))
        for finding in hemisphere.findings
        if finding.kind == "flag"
    ]
    repairs = [str(repair) for repair in hemisphere.record.get("repairs") or []]
    if repairs:
        largest = max(repairs, key=_nodes).split(";")[0]
        summary = f"{len(repairs)} repairs of the labels, the largest: {largest}"
        title = _sentence(largest if len(repairs) == 1 else summary)
        rows.append((title, _of_columns(hemisphere, None, reach)))
    return rows or [(_sentence(hemisphere.message or "no message"), Consequence())]


def _nodes(repair: str) -> int:
    """Size of a repair, nodes of the grid, as its message says."""
    size = re.search(r"(\d+) grid nodes", repair)
    return int(size[1]) if size else 0


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."


def _of_flag(hemisphere: Hemisphere, finding: Finding, reach: float) -> Consequence:
    """Take the consequence of a flag from the record, or else from the columns round its point."""
    if finding.reason in _BESIDES:
        return Consequence(harmless=True)
    if np.isnan(finding.share) and finding.point is not None:
        return _of_columns(hemisphere, finding.point, reach)
    mean = hemisphere.summary.get("thickness_mean", np.nan)
    return Consequence(share=finding.share, mean=mean, smoothed=mean - finding.change)


def _of_columns(
    hemisphere: Hemisphere, point: tuple[float, float, float] | None, reach: float
) -> Consequence:
    """Compare means over the area with and without some columns: those repaired, or near a point.

    Shares are of the area of the mid-surface, of the columns that were measured directly.
    """
    try:
        table = read_sheet(
            hemisphere.result.path("sheet"), ["r", "a", "s", "thickness"], ["valid", "repaired"]
        )
    except InputError:
        return Consequence()
    thickness = table["thickness"]
    middle = np.stack([table[axis] for axis in "ras"], axis=-1)
    if point is None:
        concerned = table["repaired"] == "true"
    else:
        gap = np.linalg.norm(middle - np.array(point), axis=-1)
        concerned = gap <= reach + thickness / 2
    area = np.where(table["valid"] == "true", node_shares(np.nan_to_num(layer_area(middle))), 0.0)
    area[~np.isfinite(thickness)] = 0.0
    if not area[~concerned].sum() > 0:
        return Consequence(share=1.0, mean=_mean(thickness, area))
    smooth = spread_over(thickness, concerned | ~np.isfinite(thickness))
    return Consequence(
        share=float(area[concerned].sum() / area.sum()),
        mean=_mean(thickness, area),
        smoothed=_mean(np.where(concerned, smooth, thickness), area),
        without=_mean(thickness, np.where(concerned, 0.0, area)),
    )


def _mean(values: Float, weights: Float) -> float:
    return float(np.average(np.nan_to_num(values), weights=weights)) if weights.any() else np.nan


def _remedy(reason: str) -> str:
    """Say what to do about a reason."""
    for section in read_table("reasons.toml")["section"]:
        if reason in section["reasons"]:
            return " ".join(section["reasons"][reason]["remedy"].split())
    return "correct the labels and measure again."
