"""What a hemisphere carries besides its shape: other volumes on the sheet, and regions drawn on it.

Nothing here can fail a hemisphere: what cannot be used is a flag, and its shape is unharmed.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hipsta_bids.derivatives import hemisphere
from hipsta_bids.derivatives.dataset import source_address
from hipsta_bids.derivatives.hemisphere import ResultPlace
from hipsta_bids.errors import InputError
from hipsta_bids.geometry.catalog import MAPS
from hipsta_bids.geometry.sampling import (
    Regions,
    RegionStatistics,
    SampledMap,
    sample_on_sheet,
    summarize_regions,
)
from hipsta_bids.inputs.maps import read_regions
from hipsta_bids.inputs.request import HemisphereInput, MapSource
from hipsta_bids.io import files, gifti
from hipsta_bids.settings import MapSettings
from hipsta_bids.types import Flag, Float, HemisphereMaps


def column_names(name: str, count: int) -> list[str]:
    """Name the columns of a map: by its name alone, or numbered from 1 if there are several."""
    return [name] if count == 1 else [f"{name}_{number}" for number in range(1, count + 1)]


def write_map(
    place: ResultPlace, source: MapSource, sampled: SampledMap, about: Mapping[str, object]
) -> None:
    """Write one map: table, sidecar and GIFTI."""
    nx, ny, count = sampled.values.shape
    flat = sampled.values.reshape(nx * ny, count)
    x, y = np.divmod(np.arange(nx * ny), ny)
    names = column_names(source.name, count)
    digits = 7 if source.interpolation == "linear" else 15
    cells = [_cells(column, digits) for column in flat.T]
    files.write_tsv(
        place.path("map_table", source.name),
        ["x", "y", *names],
        zip(map(str, (x + 1).tolist()), map(str, (y + 1).tolist()), *cells, strict=True),
    )
    definitions: dict[str, object] = {
        "x": {"Description": "node number along x, 1 at the medial end (subiculum)"},
        "y": {"Description": "node number along y, 1 at the posterior end"},
    }
    for number, name in enumerate(names, start=1):
        text = f"volume {number} of the source" if count > 1 else "value of the source"
        definitions[name] = {"Description": f"{text}, in its own unit"}
    files.write_json(place.path("map_sidecar", source.name), dict(about) | definitions)
    key = "map_shape" if count == 1 else "map_series"
    files.write_bytes(
        place.path(key, source.name), gifti.maps_bytes(flat, hemi=place.name.hemi, names=names)
    )


def _cells(values: Float, digits: int) -> list[str]:
    return [f"{v:.{digits}g}" if np.isfinite(v) else files.MISSING for v in values.tolist()]


_REGION_DIGITS = 6


def write_regions(
    table: Path, sidecar: Path, regions: Regions, found: RegionStatistics, units: Mapping[str, str]
) -> None:
    """Write one row per region, and the sidecar."""
    definitions: dict[str, dict[str, object]] = {
        "region": {"Description": "region, as the user named it"},
        "n_points": {"Description": "sheet points in the region"},
        "n_valid": {"Description": "... whose columns were measured directly"},
        "area": {"Description": "area of the mid-surface round these points", "Units": "mm^2"},
    }
    columns: dict[str, list[str]] = {
        "region": list(regions.names),
        "n_points": _region_cells(found.n_points),
        "n_valid": _region_cells(found.n_valid),
        "area": hemisphere.format_column(found.area, _REGION_DIGITS),
    }
    parts = (
        ("mean", "mean of {} over valid points", found.mean),
        ("sd", "standard deviation of {} over valid points", found.sd),
        ("mode", "most frequent value of {} at valid points", found.mode),
    )
    for suffix, text, values in parts:
        for name, column in values.items():
            unit = {"Units": units[name]} if name in units else {}
            definitions[f"{name}_{suffix}"] = {"Description": text.format(name), **unit}
            columns[f"{name}_{suffix}"] = (
                hemisphere.format_column(column, _REGION_DIGITS)
                if name in units
                else _region_cells(column)
            )
    files.write_tsv(table, list(columns), zip(*columns.values(), strict=True))
    files.write_json(sidecar, definitions)


def _region_cells(values: Float) -> list[str]:
    """Numbers of unknown size, to seven digits."""
    return [f"{v:.7g}" if np.isfinite(v) else files.MISSING for v in values.tolist()]


#: Maps of every hemisphere that are summed up in regions, and their units.
SHAPE_MAPS = {row.name: row.unit for row in MAPS}


@dataclass(frozen=True, eq=False, kw_only=True)
class Mapped:
    """What was sampled on one sheet."""

    maps: tuple[tuple[MapSource, SampledMap], ...] = ()
    regions: Regions | None = None
    flags: tuple[Flag, ...] = ()
    record: Mapping[str, Any] | None = None
    """For the quality record."""


def signal_hash(item: HemisphereInput) -> list[object]:
    """Tell what decides about maps and regions: their files' contents and how they are read."""
    maps = [
        [source.name, source.sampling, source.interpolation, _content(source.path)]
        for source in item.maps
    ]
    return [maps, _content(item.regions)] if maps or item.regions else []


def _content(path: Path | None) -> str | None:
    try:
        return None if path is None else files.sha256_of(path)
    except InputError:  # it will be tried again, and flagged
        return None


def add_signals(
    item: HemisphereInput, maps: HemisphereMaps, settings: MapSettings, sources: Mapping[str, Path]
) -> tuple[HemisphereMaps, Mapped]:
    """Sample a hemisphere's volumes on its sheet, and read the regions."""
    done = []
    flags = []
    entries: list[dict[str, Any]] = []
    for source in item.maps:
        entry = _entry(source, sources)
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
        done.append((source, sampled))
        entry |= _shares(sampled)
        if sampled.outside > settings.flag_outside:
            flags.append(_outside(source, sampled))
    regions, trouble = _regions(item, maps)
    record = {"maps": entries, "regions": str(item.regions) if item.regions else None}
    mapped = Mapped(maps=tuple(done), regions=regions, flags=(*flags, *trouble), record=record)
    return replace(maps, flags=(*maps.flags, *mapped.flags)), mapped


def write_signals(place: ResultPlace, maps: HemisphereMaps, mapped: Mapped) -> None:
    """Write the tables and GIFTI files of what was sampled."""
    numbers: dict[str, Float] = {name: maps.maps[name] for name in SHAPE_MAPS}
    labels: dict[str, Float] = {}
    entries = {entry["name"]: entry for entry in (mapped.record or {}).get("maps", ())}
    for source, sampled in mapped.maps:
        about = {_camel(key): value for key, value in entries[source.name].items()}
        write_map(place, source, sampled, about)
        columns = column_names(source.name, sampled.values.shape[2])
        kind = numbers if source.interpolation == "linear" else labels
        kind |= {name: sampled.values[:, :, k] for k, name in enumerate(columns)}
    if mapped.regions is not None:
        found = summarize_regions(mapped.regions, maps.sheet, numbers, labels)
        write_regions(
            place.path("roi"), place.path("roi_sidecar"), mapped.regions, found, SHAPE_MAPS
        )


def is_complete(place: ResultPlace, record: Mapping[str, Any]) -> bool:
    """Say whether the files of maps and regions that a record speaks of are there."""
    maps = [entry for entry in record.get("maps") or () if "outside" in entry]
    wanted = [place.path("map_table", entry["name"]) for entry in maps]
    usable = not any(f.get("reason") == "roi-unusable" for f in record.get("flags") or ())
    if record.get("regions") and usable:
        wanted.append(place.path("roi"))
    return all(path.exists() for path in wanted)


def _sample(
    source: MapSource, path: Path, maps: HemisphereMaps, settings: MapSettings
) -> SampledMap:
    from hipsta_bids.io.volumes import read_scalars  # noqa: PLC0415  (nibabel, in workers only)

    volume = read_scalars(path, maps.sheet.points.reshape(-1, 3))
    return sample_on_sheet(
        volume,
        maps.layers if source.sampling == "depth" else maps.sheet,
        settings,
        sampling=source.sampling,
        interpolation=source.interpolation,
    )


def _regions(item: HemisphereInput, maps: HemisphereMaps) -> tuple[Regions | None, list[Flag]]:
    if item.regions is None:
        return None, []
    nx, ny = maps.thickness.shape
    try:
        return read_regions(item.regions, (nx, ny)), []
    except InputError as error:
        return None, [Flag(reason="roi-unusable", message=f"regions: {error}")]


def _outside(source: MapSource, sampled: SampledMap) -> Flag:
    return Flag(
        reason="map-outside",
        message=f"map {source.name}: {sampled.outside:.0%} of the sheet lies outside of"
        f" {source.path}; is it in the space of the labels?",
    )


def _entry(source: MapSource, sources: Mapping[str, Path]) -> dict[str, Any]:
    return {
        "name": source.name,
        "source": None if source.path is None else source_address(source.path, sources),
        "sampling": source.sampling,
        "interpolation": source.interpolation,
    }


def _shares(sampled: SampledMap) -> dict[str, float]:
    return {
        "volumes": sampled.values.shape[2],
        "outside": sampled.outside,
        "unknown": sampled.unknown,
        "missing": sampled.missing,
    }


def _camel(key: str) -> str:
    return key.capitalize()
