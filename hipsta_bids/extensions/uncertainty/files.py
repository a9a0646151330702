"""SDs over perturbed copies: when they are measured, and their files."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from hipsta_bids.derivatives import hemisphere
from hipsta_bids.derivatives.dataset import describe_columns
from hipsta_bids.derivatives.results import NODES, ResultPlace
from hipsta_bids.geometry.catalog import MAPS
from hipsta_bids.io import files, gifti
from hipsta_bids.participant.job import Job
from hipsta_bids.types import Float, HemisphereMaps, LabelVolume

_NAME = "uncertainty"


def estimate(
    job: Job, volume: LabelVolume, maps: HemisphereMaps, record: dict[str, Any]
) -> tuple[HemisphereMaps, Callable[[], None]]:
    """Measure the copies; return the maps with their numbers, and what writes the SDs."""
    from hipsta_bids.extensions.uncertainty import copies  # noqa: PLC0415  (heavy)

    spread = copies.estimate_uncertainty(volume, job.item.hemi, job.settings, job.further[_NAME])
    maps = copies.add_uncertainty(maps, spread)

    def write() -> None:
        if spread.known:
            measured = spread.copies - spread.failed
            finite = {name: np.isfinite(values) for name, values in maps.maps.items()}
            sd = {name: np.where(finite[name], sds, np.nan) for name, sds in spread.maps.items()}
            write_spread(job.result, sd, spread.summary, measured)

    record["notes"] = [*record["notes"], *spread.notes]
    return maps, write


def has_spread(job: Job, record: Mapping[str, Any]) -> bool:
    """Return whether the files of a record's uncertainty exist, and are of as many copies."""
    copies = job.further.get(_NAME, 0)
    metrics = record.get("metrics") or {}
    measured_copies = metrics.get("uncertainty_copies", 0)
    if not measured_copies or metrics.get("uncertainty_thickness_mm") is None:
        return measured_copies == copies or not copies
    keys = ("uncertainty", "summaryuncertainty", "thickness_sd")
    return copies in {0, measured_copies} and all(job.result.path(key).exists() for key in keys)


def spread_name(measure: str) -> str:
    """Name of the column with the SD of a measure over perturbed copies."""
    return f"{measure}_sd"


def write_spread(
    result: ResultPlace, maps: Mapping[str, Float], summary: Mapping[str, float], copies: int
) -> None:
    """Write SDs over perturbed copies: of maps (Nx, Ny), as table and GIFTI, and of the summary.

    Arguments are by name of the measure, ``copies`` is the number that SDs rest on.
    """
    wording = f"SD over {copies} perturbed copies of the labels: {{}}"
    nodes = {
        spread_name(name): column for name, column in hemisphere.format_measures(MAPS, maps).items()
    }
    definitions = {spread_name(row.name): hemisphere.define_measure(row, wording) for row in MAPS}
    hemisphere.write_table(
        result,
        "uncertainty",
        {**hemisphere.number_nodes(NODES, maps["thickness"].shape), **nodes},
        describe_columns(NODES) | definitions,
    )
    columns, definitions = {}, {}
    for name, value in summary.items():
        about: dict[str, Any] = hemisphere.summary_definition(name)
        about["Description"] = wording.format(about["Description"])
        definitions[spread_name(name)] = about
        columns[spread_name(name)] = hemisphere.summary_cell(name, value)
    hemisphere.write_table(result, "summaryuncertainty", columns, definitions)
    name, unit = spread_name("thickness"), "mm"
    content = gifti.shape_bytes(
        maps["thickness"].ravel(), hemi=result.name.hemi, name=name, unit=unit
    )
    files.write_bytes(result.path("thickness_sd"), content)
