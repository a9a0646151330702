"""What a hemisphere carries besides its shape: other volumes on the sheet, and regions drawn on it.

Nothing here can fail a hemisphere: what cannot be used is a flag, and its shape is unharmed.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hipsta_bids.artifacts import Flag, Float, HemisphereMaps
from hipsta_bids.bids import files
from hipsta_bids.bids.derivative import source_address
from hipsta_bids.bids.inputs import HemisphereInput, MapSource
from hipsta_bids.bids.maps import column_names, write_map
from hipsta_bids.bids.results import ResultPlace
from hipsta_bids.bids.rois import read_regions, write_regions
from hipsta_bids.errors import InputError
from hipsta_bids.geometry.catalog import MAPS
from hipsta_bids.geometry.regions import Regions, summarize_regions
from hipsta_bids.geometry.sampling import SampledMap, sample_on_sheet
from hipsta_bids.settings import MapSettings

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
    """Tell what decides about maps and regions: their files' contents and how they are read.

    Parameters
    ----------
    item : HemisphereInput

    Returns
    -------
    list
        Empty if there are neither.
    """
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
    """Sample a hemisphere's volumes on its sheet, and read the regions.

    Parameters
    ----------
    item : HemisphereInput
    maps : HemisphereMaps
    settings : MapSettings
    sources : mapping of str to Path
        Input datasets by name.

    Returns
    -------
    maps : HemisphereMaps
        With flags for what could not be used or lies outside.
    mapped : Mapped
    """
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
    """Write the tables and GIFTI files of what was sampled.

    Parameters
    ----------
    place : ResultPlace
    maps : HemisphereMaps
    mapped : Mapped

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
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
    from hipsta_bids.bids.volumes import read_scalars  # noqa: PLC0415  (nibabel, in workers only)

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
