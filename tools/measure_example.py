"""A phantom that was measured, with every number beside its analytic value, as figures show it."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hipsta_bids.geometry.catalog import MAPS, PER_SUBFIELD, SECTIONS, SUMMARY, Column
from hipsta_bids.geometry.measures import away_from_edges, column_area
from hipsta_bids.geometry.sheet import sample_sheet, whole_body
from hipsta_bids.phantom import Phantom, PhantomTruth
from hipsta_bids.phantom.phantom import cut_sections
from hipsta_bids.phantom.shape import placement
from hipsta_bids.protocols.protocol import Protocol
from hipsta_bids.settings import MeasureSettings, Settings
from hipsta_bids.types import Float, HemisphereMaps, Sheet


@dataclass(frozen=True, eq=False, kw_only=True)
class Comparison:
    """One measure of one phantom."""

    name: str
    """Of the column."""
    unit: str
    found: Float
    """Values where it is measured: (Nx, Ny) of a map, (Ny,) of sections, one of a summary."""
    true: Float
    """The same, analytic."""
    weights: Float
    """Of the values in the mean; zero beside the edges of the sheet for curvatures."""

    @property
    def means(self) -> tuple[float, float]:
        """Means of what was found and of the truth."""
        found, true = (np.average(x, weights=self.weights) for x in (self.found, self.true))
        return float(found), float(true)

    @property
    def rms_error(self) -> float:
        """Root mean square error of the values."""
        return float(np.sqrt(np.average((self.found - self.true) ** 2, weights=self.weights)))


def compare_maps(phantom: Phantom, maps: HemisphereMaps, *, hemi: str = "L") -> list[Comparison]:
    """Set each map beside the truth where its mid-surface was found."""
    truth = _truth_at_nodes(phantom, maps, hemi)
    area = column_area(maps.sheet)
    inner = area * away_from_edges(area.shape, MeasureSettings())
    return [
        _comparison(
            row,
            maps.maps[row.name],
            getattr(truth, row.name),
            inner if "curvature" in row.name else area,
        )
        for row in MAPS
    ]


def compare_sections(
    phantom: Phantom, maps: HemisphereMaps, *, hemi: str = "L"
) -> list[Comparison]:
    """Set each measure of cross-sections beside the truth where they were found."""
    _, v = _sheet_coordinates(phantom, maps, hemi)
    quarter = len(v) // 4  # the outer columns may lie outside of the phantom
    truth = cut_sections(phantom.body, np.clip(np.nanmean(v[quarter:-quarter], axis=0), 0, 1))
    return [_comparison(row, maps.sections[row.name], truth[row.name]) for row in SECTIONS]


def compare_summary(phantom: Phantom, maps: HemisphereMaps, *, hemi: str = "L") -> list[Comparison]:
    """Set each number of the summary beside the truth.

    Curvatures are averaged over part of the sheet; the truth is averaged over the same.
    """
    means = {f"{one.name}_mean": one.means[1] for one in compare_maps(phantom, maps, hemi=hemi)}
    nodes = float(_truth_at_nodes(phantom, maps, hemi).thickness.mean())
    truth = means | dict(phantom.region_summary("extended")) | {"thickness_nodes": nodes}
    return [_comparison(row, maps.summary[row.name], truth[row.name]) for row in SUMMARY]


def compare_subfields(
    phantom: Phantom, maps: HemisphereMaps, protocol: Protocol, *, hemi: str = "L"
) -> list[Comparison]:
    """Set the numbers of each subfield beside the truth."""
    thickness = _truth_at_nodes(phantom, maps, hemi).thickness
    area = column_area(maps.sheet)
    rows = []
    for tissue, sizes in phantom.subfield_summary(protocol).items():
        inside = area * (maps.subfield == tissue)
        truth = {
            "thickness_mean": np.average(thickness, weights=inside),
            "area": sizes["area_mid"],
            "volume": sizes["volume"],
        }
        for row in PER_SUBFIELD:
            own = replace(row, name=f"{row.name}_{tissue.name}")
            rows.append(_comparison(own, maps.summary[own.name], truth[row.name]))
    return rows


def _sheet_coordinates(phantom: Phantom, maps: HemisphereMaps, hemi: str) -> tuple[Float, Float]:
    """Find the true u and v (Nx, Ny) of the mid-surface; NaN beyond the phantom's edges."""
    points = maps.sheet.points[:, :, maps.sheet.middle]
    found = phantom.body.locate(points.reshape(-1, 3), hemi=hemi).reshape(points.shape)
    return found[..., 0], found[..., 1]


def _truth_at_nodes(phantom: Phantom, maps: HemisphereMaps, hemi: str) -> PhantomTruth:
    u, v = _sheet_coordinates(phantom, maps, hemi)
    return phantom.truth(*(np.clip(np.nan_to_num(x, nan=0.5), 0, 1) for x in (u, v)))


def _comparison(
    row: Column, found: Float | float, true: Float | float, weights: Float | None = None
) -> Comparison:
    """Compare one measure; its values count the same unless weights are given."""
    values, wanted = np.atleast_1d(found), np.atleast_1d(true)
    return Comparison(
        name=row.name,
        unit=row.unit,
        found=values,
        true=wanted,
        weights=np.ones(values.shape) if weights is None else weights,
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
