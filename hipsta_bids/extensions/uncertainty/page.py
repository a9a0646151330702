"""SD of thickness on the page of a visit."""

from collections.abc import Mapping, Sequence
from typing import Any

from hipsta_bids.derivatives.results import read_sheet
from hipsta_bids.reports.display import MapKind
from hipsta_bids.reports.results import Hemisphere
from hipsta_bids.reports.unfolded import draw_map

#: In phantoms it is about 0.1 mm.
UNCERTAINTY = MapKind(
    column="thickness_sd",
    title="SD of thickness",
    unit="mm",
    colors="magma",
    centered=False,
    digits=2,
    limits=(0.0, 0.3),
)


def read_columns(hemisphere: Hemisphere) -> Mapping[str, Any]:
    """Read the SDs (Nx, Ny) of a hemisphere, by column."""
    path = hemisphere.result.path("uncertainty")
    return read_sheet(path) if "uncertainty_copies" in hemisphere.metrics and path.exists() else {}


def draw_spread(measured: Sequence[Hemisphere]) -> tuple[list[Any], list[str]]:
    """Draw the SD of thickness where it was estimated, and describe it."""
    uncertain = [h for h in measured if UNCERTAINTY.column in h.sheet.columns]
    pictures = [draw_map(UNCERTAINTY, uncertain)] if uncertain else []
    return pictures, [_describe_spread(hemisphere) for hemisphere in uncertain]


def _describe_spread(hemisphere: Hemisphere) -> str:
    metrics = hemisphere.metrics
    copies = metrics["uncertainty_copies"] - metrics["uncertainty_failed"]
    return (
        f"Uncertainty, {hemisphere.side}: SD of thickness over {copies} perturbed copies: "
        f"{metrics['uncertainty_thickness_mm']:.2f} mm at a point (median), "
        f"{metrics['uncertainty_mean_mm']:.3f} mm of the mean"
    )
