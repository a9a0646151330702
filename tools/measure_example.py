"""A phantom that was measured, with every number beside its analytic value, as figures show it."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hipsta_bids.geometry.sheet import sample_sheet, whole_body
from hipsta_bids.phantom import Phantom
from hipsta_bids.phantom.shape import placement
from hipsta_bids.protocols.protocol import Protocol
from hipsta_bids.settings import Settings
from hipsta_bids.types import Float, HemisphereMaps, Sheet
from hipsta_bids.validation.accuracy import (
    Comparison,
    compare_maps,
    compare_sections,
    compare_subfields,
    compare_summary,
)


@dataclass(frozen=True, eq=False, kw_only=True)
class Example:
    """The phantom that all figures show, and what was measured of it."""

    phantom: Phantom
    maps: HemisphereMaps
    protocol: Protocol

    @cached_property
    def measured(self) -> dict[str, dict[str, Comparison]]:
        """Every measure beside its truth: by table, then by name."""
        tables = {
            "sheet": compare_maps(self.phantom, self.maps),
            "sections": compare_sections(self.phantom, self.maps),
            "summary": compare_summary(self.phantom, self.maps),
            "subfields": compare_subfields(self.phantom, self.maps, self.protocol),
        }
        return {name: {one.name: one for one in rows} for name, rows in tables.items()}

    @cached_property
    def whole(self) -> Sheet:
        """The body from rim to rim."""
        grid = whole_body(Settings().sheet)
        return sample_sheet(self.maps.mesh, self.maps.coordinates, grid)

    @property
    def half(self) -> int:
        """Number of the cross-section in the middle of the body."""
        return int(self.maps.thickness.shape[1] // 2)

    def upright(self, points: Float) -> Float:
        """Points in the phantom's own frame: lateral, superior, anterior, mm."""
        rotation, shift = placement("L", None)
        return np.asarray((points - shift) @ rotation)

    def section(self, sheet: Sheet) -> Float:
        """Take the middle cross-section (Nx, Nz, 2) of a sheet, lateral and superior."""
        return self.upright(sheet.points[:, self.half])[..., :2]

    def at(self, name: str, x: int, digits: int = 2) -> str:
        """Spell what a map has at a node of the middle section, and what is true there."""
        one = self.measured["sheet"][name]
        return spell(one.found[x, self.half], one.true[x, self.half], one.unit, digits)

    def of_section(self, name: str, digits: int = 2) -> str:
        """Spell the same for a measure of the middle section."""
        one = self.measured["sections"][name]
        return spell(one.found[self.half], one.true[self.half], one.unit, digits)

    def of_summary(self, name: str, digits: int = 2, table: str = "summary") -> str:
        """Spell the same for a number of the summary."""
        one = self.measured[table][name]
        return spell(*one.means, one.unit, digits)


def spell(found: float, true: float, unit: str, digits: int) -> str:
    """Spell what was found and what is true."""
    units = "" if unit == "1" else f" {unit.replace('^2', '²').replace('^3', '³')}"
    return f"{found:.{digits}f}{units} (analytic {true:.{digits}f})"
