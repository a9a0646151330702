"""Other volumes sampled on a hemisphere's sheet, and regions drawn on it.

Nothing here can fail a hemisphere: what cannot be used is a flag, and its shape is unharmed.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hipsta_bids.derivatives import hemisphere
from hipsta_bids.derivatives.dataset import TABLES, describe_columns, source_address
from hipsta_bids.derivatives.results import NODES, ResultPlace
from hipsta_bids.errors import InputError
from hipsta_bids.extensions.signals import sampling
from hipsta_bids.extensions.signals.inputs import MapSource, signals_of
from hipsta_bids.extensions.signals.settings import MapSettings
from hipsta_bids.geometry.catalog import MAPS
from hipsta_bids.inputs.regions import Regions, read_regions
from hipsta_bids.io import files, gifti
from hipsta_bids.participant.job import Job
from hipsta_bids.types import Flag, Float, HemisphereMaps, LabelVolume

_REGION_DIGITS = 6

#: Maps of every hemisphere that are summarized in regions, and their units.
_SHAPE_UNITS = {row.name: row.unit for row in MAPS}


def _column_names(name: str, count: int) -> list[str]:
    """Name the columns of a map: by its name alone, or numbered from 1 if there are several."""
    return [name] if count == 1 else [f"{name}_{number}" for number in range(1, count + 1)]


def write_map(
    result: ResultPlace,
    source: MapSource,
    sampled: sampling.SampledMap,
    about: Mapping[str, object],
) -> None:
    """Write one map: table, sidecar and GIFTI."""
    count = sampled.values.shape[2]
    names = _column_names(source.name, count)
    digits = 7 if source.interpolation == "linear" else 15
    columns = _with_mean(source, sampled.values)
    values = np.stack(list(columns.values()), axis=-1)
    hemisphere.write_nodes(result.path("map_table", source.name), list(columns), values, digits)
    definitions = describe_columns(NODES)
    if source.name in columns:
        definitions[source.name] = {"Description": "mean of the volumes, in their unit"}
    for number, name in enumerate(names, start=1):
        text = f"volume {number} of the source" if count > 1 else "value of the source"
        definitions[name] = {"Description": f"{text}, in its own unit"}
    files.write_json(result.path("map_sidecar", source.name), dict(about) | definitions)
    key = "map_shape" if count == 1 else "map_series"
    flat = sampled.values.reshape(-1, count)
    files.write_bytes(
        result.path(key, source.name), gifti.maps_bytes(flat, hemi=result.name.hemi, names=names)
    )


def _with_mean(source: MapSource, values: Float) -> dict[str, Float]:
    """Name the volumes (Nx, Ny, T) of a map; numbers of several volumes begin with their mean."""
    names = _column_names(source.name, values.shape[2])
    columns = {name: values[:, :, number] for number, name in enumerate(names)}
    if len(names) > 1 and source.interpolation == "linear":
        return {source.name: values.mean(axis=2), **columns}
    return columns


def _write_regions(
    result: ResultPlace, regions: Regions, statistics: sampling.RegionStatistics
) -> None:
    """Write one row per region, and the sidecar."""
    definitions = describe_columns(TABLES["roi"])
    columns: dict[str, list[str]] = {
        "region": list(regions.names),
        "n_points": hemisphere.format_cells(statistics.n_points),
        "n_valid": hemisphere.format_cells(statistics.n_valid),
        "area": hemisphere.format_column(statistics.area, _REGION_DIGITS),
    }
    parts = (
        ("mean", "mean of {} over valid points", statistics.mean),
        ("sd", "standard deviation of {} over valid points", statistics.sd),
        ("mode", "most frequent value of {} at valid points", statistics.mode),
    )
    for suffix, text, values in parts:
        for name, column in values.items():
            key = f"{name}_{suffix}"
            definitions[key] = {"Description": text.format(name)}
            if name in _SHAPE_UNITS:
                definitions[key]["Units"] = _SHAPE_UNITS[name]
                columns[key] = hemisphere.format_column(column, _REGION_DIGITS)
            else:
                columns[key] = hemisphere.format_cells(column)
    files.write_tsv(result.path("roi"), list(columns), zip(*columns.values(), strict=True))
    files.write_json(result.path("roi_sidecar"), definitions)


#: What was sampled from a volume, with its entry of the quality record.
Mapped = tuple[MapSource, dict[str, Any], sampling.SampledMap]


def add_signals(
    job: Job, _: LabelVolume, maps: HemisphereMaps, record: dict[str, Any]
) -> tuple[HemisphereMaps, Callable[[], None]]:
    """Sample the volumes of a hemisphere on its sheet, and read the regions.

    Returns maps with flags, and what writes the samples; the quality record gets their entries.
    """
    signals, settings, sources = (
        signals_of(job.item),
        job.settings.of(MapSettings),
        dict(job.sources),
    )
    mapped: list[Mapped] = []
    flags = []
    entries: list[dict[str, Any]] = []
    for source in signals.maps:
        entry: dict[str, Any] = {
            "name": source.name,
            "source": None if source.path is None else source_address(source.path, sources),
            "sampling": source.sampling,
            "interpolation": source.interpolation,
        }
        if source.transform is not None:
            entry["transform"] = source_address(source.transform, sources)
        entries.append(entry)
        if source.path is None:
            entry["note"] = source.missing
            continue
        try:
            sampled = _sample(source, source.path, maps, settings)
        except InputError as error:
            flags.append(Flag(reason="map-unusable", message=f"map {source.name}: {error}"))
            entry["problem"] = str(error)
            continue
        mapped.append((source, entry, sampled))
        entry |= {
            "volumes": sampled.values.shape[2],
            "outside": sampled.outside,
            "unknown": sampled.unknown,
            "missing": sampled.missing,
        }
        if sampled.outside > settings.flag_outside:
            message = (
                f"map {source.name}: {sampled.outside:.0%} of the sheet lies outside of"
                f" {source.path}; is it in the space of the labels?"
            )
            flags.append(Flag(reason="map-outside", message=message))
    regions = None
    if signals.regions is not None:
        nx, ny = maps.thickness.shape
        try:
            regions = read_regions(signals.regions, (nx, ny))
        except InputError as error:
            flags.append(Flag(reason="roi-unusable", message=f"regions: {error}"))
    record |= {"maps": entries, "regions": str(signals.regions) if signals.regions else None}
    maps = replace(maps, flags=(*maps.flags, *flags))
    return maps, partial(write_signals, job.result, maps, mapped, regions)


def _sample(
    source: MapSource, path: Path, maps: HemisphereMaps, settings: MapSettings
) -> sampling.SampledMap:
    from hipsta_bids.extensions.signals.transforms import read_transform  # noqa: PLC0415  (in workers only)
    from hipsta_bids.io.volumes import read_scalars  # noqa: PLC0415  (nibabel, in workers only)

    sheet = maps.layers if source.sampling == "depth" else maps.sheet
    if source.transform is not None:
        to_image = read_transform(source.transform, path, source.reference)
        points = to_image(sheet.points.reshape(-1, 3)).reshape(sheet.points.shape)
        sheet = replace(sheet, points=points)
    sampled = sampling.sample_on_sheet(
        read_scalars(path, sheet.points.reshape(-1, 3)),
        sheet,
        settings,
        sampling=source.sampling,
        interpolation=source.interpolation,
    )
    # Rims and holes of a sheet with a head have positions, but no values.
    measured = np.isfinite(maps.thickness)[:, :, None]
    return replace(sampled, values=np.where(measured, sampled.values, np.nan))


def write_signals(
    result: ResultPlace,
    maps: HemisphereMaps,
    mapped: Sequence[Mapped],
    regions: Regions | None,
) -> None:
    """Write the tables and GIFTI files of the samples."""
    numbers: dict[str, Float] = {name: maps.maps[name] for name in _SHAPE_UNITS}
    labels: dict[str, Float] = {}
    for source, entry, sampled in mapped:
        about = {key.capitalize(): value for key, value in entry.items()}
        write_map(result, source, sampled, about)
        kind = numbers if source.interpolation == "linear" else labels
        kind |= _with_mean(source, sampled.values)
    if regions is not None:
        statistics = sampling.summarize_regions(regions, maps.sheet, numbers, labels)
        _write_regions(result, regions, statistics)


def is_complete(job: Job, record: Mapping[str, Any]) -> bool:
    """Return whether the files of maps and regions that a record names exist."""
    maps = [entry for entry in record.get("maps") or () if "outside" in entry]
    paths = [job.result.path("map_table", entry["name"]) for entry in maps]
    usable = not any(f.get("reason") == "roi-unusable" for f in record.get("flags") or ())
    if record.get("regions") and usable:
        paths.append(job.result.path("roi"))
    return all(path.exists() for path in paths)
