"""Other volumes to be sampled on the sheet (``--map``): which files, and what is written."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hipsta_bids.artifacts import Float
from hipsta_bids.bids import files, gifti
from hipsta_bids.bids.inputs import HemisphereInput, MapSource
from hipsta_bids.bids.names import EXTRA_OUTPUTS, OUTPUTS
from hipsta_bids.bids.patterns import check_pattern, fill, find
from hipsta_bids.bids.results import ResultPlace
from hipsta_bids.errors import UsageError
from hipsta_bids.geometry.catalog import MAPS
from hipsta_bids.geometry.sampling import SampledMap


@dataclass(frozen=True, kw_only=True)
class MapRequest:
    """A volume that every hemisphere may have."""

    name: str
    pattern: str
    """Path with placeholders, absolute or relative to the BIDS dataset; may have wildcards."""
    sampling: str
    interpolation: str


def map_requests(
    patterns: Sequence[tuple[str, str]],
    samplings: Sequence[tuple[str | None, str]],
    interpolations: Sequence[tuple[str | None, str]],
) -> tuple[MapRequest, ...]:
    """Combine and check the options about maps.

    Parameters
    ----------
    patterns : sequence of (str, str)
        Names and patterns.
    samplings, interpolations : sequence of (str or None, str)
        Choices for one name, or (None) for all that have no choice of their own.

    Returns
    -------
    tuple of MapRequest

    Raises
    ------
    UsageError
        If a name occurs twice or belongs to other outputs, a placeholder is unknown, or a choice
        is for a map that does not exist.
    """
    names = [name for name, _ in patterns]
    taken = {row.desc for row in (*OUTPUTS, *EXTRA_OUTPUTS)} | {"x", "y", *(m.name for m in MAPS)}
    for name, pattern in patterns:
        if not name.isalnum() or not name.isascii():
            raise UsageError(f"--map: {name!r} is not a name of letters and digits", reason="usage")
        if name in taken or names.count(name) > 1:
            why = "belongs to other outputs" if name in taken else "occurs twice"
            raise UsageError(f"--map: the name {name} {why}; choose another one", reason="usage")
        check_pattern("--map", name, pattern)
    for option, choices in (("sampling", samplings), ("interpolation", interpolations)):
        lost = [name for name, _ in choices if name is not None and name not in names]
        if lost:
            raise UsageError(f"--map-{option}: there is no --map {lost[0]}=...", reason="usage")
    where = {None: "depth", **dict(samplings)}
    how = {None: "linear", **dict(interpolations)}
    return tuple(
        MapRequest(
            name=name,
            pattern=pattern,
            sampling=where.get(name, where[None]),
            interpolation=how.get(name, how[None]),
        )
        for name, pattern in patterns
    )


def attach(
    items: Iterable[HemisphereInput],
    requests: Sequence[MapRequest],
    regions: Path | None,
    bids_dir: Path,
) -> tuple[tuple[HemisphereInput, ...], tuple[str, ...]]:
    """Look for the volumes of each hemisphere.

    Parameters
    ----------
    items : iterable of HemisphereInput
    requests : sequence of MapRequest
    regions : Path or None
        Table of regions drawn on the sheet, the same for all.
    bids_dir : Path
        What patterns are relative to.

    Returns
    -------
    items : tuple of HemisphereInput
        With their maps, found or not.
    notes : tuple of str
        One line per map: for how many hemispheres there is a file.
    """
    found = tuple(
        replace(
            item, maps=tuple(_source(item, wish, bids_dir) for wish in requests), regions=regions
        )
        for item in items
    )
    notes = []
    for number, wish in enumerate(requests):
        without = [item for item in found if item.maps[number].path is None]
        line = f"map {wish.name}: {len(found) - len(without)} of {len(found)} hemispheres"
        if without:
            first = without[0]
            line += (
                f" have a file; not sub-{first.subject} hemi-{first.hemi}"
                f" ({first.maps[number].missing})"
            ) + (f" and {len(without) - 1} more" if len(without) > 1 else "")
        notes.append(line)
    return found, tuple(notes)


def _source(item: HemisphereInput, wish: MapRequest, bids_dir: Path) -> MapSource:
    name = fill(wish.pattern, item.subject, item.session, item.hemi)
    matches = find(name, bids_dir)
    missing, inside = None, not Path(wish.pattern).is_absolute()
    if not matches:
        missing = f"no file {name}"
    elif len(matches) > 1:
        missing = f"{len(matches)} files match {name}: {matches[0]}, {matches[1]}"
    return MapSource(
        name=wish.name,
        sampling=wish.sampling,
        interpolation=wish.interpolation,
        path=None if missing else matches[0],
        missing=missing,
        source_path=bids_dir if inside else None,
    )


def column_names(name: str, count: int) -> list[str]:
    """Name the columns of a map: by its name alone, or numbered from 1 if there are several."""
    return [name] if count == 1 else [f"{name}_{number}" for number in range(1, count + 1)]


def write_map(
    place: ResultPlace, source: MapSource, sampled: SampledMap, about: Mapping[str, object]
) -> None:
    """Write one map: table, sidecar and GIFTI.

    Parameters
    ----------
    place : ResultPlace
    source : MapSource
    sampled : SampledMap
    about : mapping
        What the sidecar says of the map as a whole.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
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
