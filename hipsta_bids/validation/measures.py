"""Every measure of a phantom beside its analytic value.

A measure that is new in the catalog has to have one: it is looked up under the same name.
"""

from dataclasses import dataclass

import numpy as np

from hipsta_bids.artifacts import Float, HemisphereMaps
from hipsta_bids.geometry.catalog import MAPS, SECTIONS
from hipsta_bids.geometry.measures import away_from_edges, column_area
from hipsta_bids.geometry.summary import PER_SUBFIELD, SUMMARY
from hipsta_bids.phantom import Phantom, PhantomTruth
from hipsta_bids.phantom.truth import cut_sections
from hipsta_bids.schemes import Scheme
from hipsta_bids.settings import MeasureSettings

#: Sizes of a subfield, and what they are called where the truth of a part of the body is summed up.
_SUBFIELD_SIZES = {"area": "area_mid", "volume": "volume"}


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
    """Of the values in the mean; nodes beside rims and ends have none for curvatures."""

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
        Comparison(
            name=row.name,
            unit=row.unit,
            found=maps.maps[row.name],
            true=getattr(truth, row.name),
            weights=inner if "curvature" in row.name else area,
        )
        for row in MAPS
    ]


def compare_sections(
    phantom: Phantom, maps: HemisphereMaps, *, hemi: str = "L"
) -> list[Comparison]:
    """Set each measure of cross-sections beside the truth where they were found."""
    _, v = sheet_coordinates(phantom, maps, hemi=hemi)
    quarter = len(v) // 4  # rims may lie outside of the phantom
    truth = cut_sections(phantom.body, np.clip(np.nanmean(v[quarter:-quarter], axis=0), 0, 1))
    return [
        _comparison(row.name, row.unit, maps.sections[row.name], truth[row.name])
        for row in SECTIONS
    ]


def compare_summary(phantom: Phantom, maps: HemisphereMaps, *, hemi: str = "L") -> list[Comparison]:
    """Set each number of the summary beside the truth.

    Curvatures are averaged over part of the sheet; the truth is averaged over the same.
    """
    means = {f"{one.name}_mean": one.means[1] for one in compare_maps(phantom, maps, hemi=hemi)}
    truth = means | dict(phantom.region_summary("extended"))
    return [
        _comparison(row.name, row.unit, maps.summary[row.name], truth[row.name]) for row in SUMMARY
    ]


def compare_subfields(
    phantom: Phantom, maps: HemisphereMaps, scheme: Scheme, *, hemi: str = "L"
) -> list[Comparison]:
    """Set the numbers of each subfield beside the truth."""
    thickness = _truth_at_nodes(phantom, maps, hemi).thickness
    area = column_area(maps.sheet)
    rows = []
    for tissue, truth in phantom.subfield_summary(scheme).items():
        inside = area * (maps.subfield == tissue)
        for row in PER_SUBFIELD:
            name = f"{row.name}_{tissue.name}"
            wanted = (
                np.average(thickness, weights=inside)
                if row.name == "thickness_mean"
                else truth[_SUBFIELD_SIZES[row.name]]
            )
            rows.append(_comparison(name, row.unit, maps.summary[name], wanted))
    return rows


def sheet_coordinates(
    phantom: Phantom, maps: HemisphereMaps, *, hemi: str = "L"
) -> tuple[Float, Float]:
    """Find the true u and v (Nx, Ny) of the mid-surface; NaN beyond the phantom's rims."""
    points = maps.sheet.points[:, :, maps.sheet.middle]
    found = phantom.body.locate(points.reshape(-1, 3), hemi=hemi).reshape(points.shape)
    return found[..., 0], found[..., 1]


def _truth_at_nodes(phantom: Phantom, maps: HemisphereMaps, hemi: str) -> PhantomTruth:
    u, v = sheet_coordinates(phantom, maps, hemi=hemi)
    return phantom.truth(*(np.clip(np.nan_to_num(x, nan=0.5), 0, 1) for x in (u, v)))


def _comparison(name: str, unit: str, found: Float | float, true: Float | float) -> Comparison:
    values, wanted = np.atleast_1d(found), np.atleast_1d(true)
    return Comparison(
        name=name, unit=unit, found=values, true=wanted, weights=np.ones(values.shape)
    )
