"""Volumes to sample (``--map``), and regions (``--roi``): which files a hemisphere has."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

from hipsta_bids.derivatives.names import EXTRA_OUTPUTS, OUTPUTS
from hipsta_bids.errors import InputError, UsageError
from hipsta_bids.extensions.signals.transforms import check_installed
from hipsta_bids.geometry.catalog import MAPS
from hipsta_bids.inputs.maps import check_pattern, fill, find
from hipsta_bids.inputs.scan import HemisphereInput
from hipsta_bids.io import files

NAME = "maps"
"""Of these inputs, and of their stage."""


@dataclass(frozen=True, kw_only=True)
class MapSource:
    """Another volume of the same participant, to be sampled on the sheet."""

    name: str
    """What its outputs are called."""
    pattern: str = ""
    """Path with placeholders, absolute or relative to the BIDS dataset; may have wildcards."""
    sampling: str
    """As of ``sampling.sample_on_sheet``: surface, or ``depth``."""
    interpolation: str
    """``linear`` or ``nearest``."""
    path: Path | None = None
    """None where there is no file, or more than one that it could be."""
    missing: str | None = None
    """Why there is no path, in one phrase."""
    source_path: Path | None = None
    """The dataset that it is in, if it is in the one that was given."""
    transform_pattern: str | None = None
    """As ``pattern``, for the registration of the volume to the space of the labels."""
    transform: Path | None = None
    """The file of this registration, where there is one."""
    reference_pattern: str | None = None
    """As ``pattern``, for the image that FSL registered the volume to."""
    reference: Path | None = None
    """The file of this image, where there is one."""


@dataclass(frozen=True, kw_only=True)
class Signals:
    """Volumes and regions of a hemisphere."""

    maps: tuple[MapSource, ...] = ()
    """Other volumes to be sampled on the sheet."""
    regions: Path | None = None
    """Table of regions drawn on the sheet."""

    @property
    def origins(self) -> list[tuple[str, Path]]:
        """Datasets of the volumes: their names and folders."""
        return [("bids", source.source_path) for source in self.maps if source.source_path]

    def describe(self) -> list[object]:
        """List what decides about maps and regions: contents of files, and how they are read."""
        maps = [
            [
                *(source.name, source.sampling, source.interpolation, _content(source.path)),
                *(_content(path) for path in (source.transform, source.reference) if path),
            ]
            for source in self.maps
        ]
        return [maps, _content(self.regions)]


def _content(path: Path | None) -> str | None:
    try:
        return None if path is None else files.sha256_of(path)
    except InputError:  # reading it will be tried again, and flagged
        return None


def signals_of(item: HemisphereInput) -> Signals:
    """Return the volumes and regions of a hemisphere."""
    return cast("Signals", item.further.get(NAME, Signals()))


def _check_names(names: Sequence[str]) -> None:
    reserved = {"x", "y", *(row.desc for row in (*OUTPUTS, *EXTRA_OUTPUTS))}
    reserved |= {m.name for m in MAPS}
    for name in names:
        if not name.isalnum() or not name.isascii():
            raise UsageError(f"--map: {name!r} is not a name of letters and digits")
        if name in reserved or names.count(name) > 1:
            fault = "belongs to other outputs" if name in reserved else "occurs twice"
            raise UsageError(f"--map: the name {name} {fault}; choose another one")


def map_requests(
    patterns: Sequence[tuple[str, str]],
    samplings: Sequence[tuple[str | None, str]],
    interpolations: Sequence[tuple[str | None, str]],
    transforms: Sequence[tuple[str, str]] = (),
    references: Sequence[tuple[str, str]] = (),
) -> tuple[MapSource, ...]:
    """Combine and check the options about maps; choices without a name are for all other maps."""
    names = [name for name, _ in patterns]
    _check_names(names)
    for name, pattern in patterns:
        check_pattern("--map", name, pattern)
    if transforms:
        check_installed("--map-transform")
    for option, files_of in (("transform", transforms), ("reference", references)):
        for name, pattern in files_of:
            check_pattern(f"--map-{option}", name, pattern)
    options = {
        "sampling": samplings,
        "interpolation": interpolations,
        "transform": transforms,
        "reference": references,
    }
    for option, choices in options.items():
        if unknown_names := [name for name, _ in choices if name not in {None, *names}]:
            raise UsageError(f"--map-{option}: there is no --map {unknown_names[0]}=...")
    sampling_of = {None: "depth", **dict(samplings)}
    interpolation_of = {None: "linear", **dict(interpolations)}
    return tuple(
        MapSource(
            name=name,
            pattern=pattern,
            sampling=sampling_of.get(name, sampling_of[None]),
            interpolation=interpolation_of.get(name, interpolation_of[None]),
            transform_pattern=dict(transforms).get(name),
            reference_pattern=dict(references).get(name),
        )
        for name, pattern in patterns
    )


def attach(
    items: Sequence[HemisphereInput],
    requests: Sequence[MapSource],
    regions: Path | None,
    bids_dir: Path,
) -> tuple[tuple[HemisphereInput, ...], list[str], list[str]]:
    """Look for the volumes of each hemisphere; return a note per map, and warnings, too."""
    if not requests and regions is None:
        return tuple(items), [], []
    signals = [
        Signals(
            maps=tuple(_source(item, request, bids_dir) for request in requests), regions=regions
        )
        for item in items
    ]
    attached = tuple(
        replace(item, further={**item.further, NAME: addition})
        for item, addition in zip(items, signals, strict=True)
    )
    notes, warnings = [], []
    for number, request in enumerate(requests):
        without = [item for item in attached if signals_of(item).maps[number].path is None]
        line = f"map {request.name}: {len(attached) - len(without)} of {len(attached)} hemispheres"
        if without:
            first = without[0]
            line += (
                f" have a file; not sub-{first.subject} hemi-{first.hemi}"
                f" ({signals_of(first).maps[number].missing})"
            ) + (f" and {len(without) - 1} more" if len(without) > 1 else "")
        notes.append(line)
        if attached and len(without) == len(attached):
            warnings.append(
                f"--map {request.name}: no hemisphere has this map; check the pattern"
                f" {request.pattern}"
            )
    return attached, notes, warnings


def _source(item: HemisphereInput, request: MapSource, bids_dir: Path) -> MapSource:
    patterns = {
        "path": request.pattern,
        "transform": request.transform_pattern,
        "reference": request.reference_pattern,
    }
    paths: dict[str, Path | None] = {}
    missing = None
    for key, pattern in patterns.items():
        if pattern is None:
            continue
        name = fill(pattern, item.subject, item.session, item.hemi)
        matches = find(name, bids_dir)
        if not matches:
            missing = missing or f"no file {name}"
        elif len(matches) > 1:
            missing = missing or f"{len(matches)} files match {name}: {matches[0]}, {matches[1]}"
        else:
            paths[key] = matches[0]
    return replace(
        request,
        path=None if missing else paths["path"],
        transform=paths.get("transform"),
        reference=paths.get("reference"),
        missing=missing,
        source_path=None if Path(request.pattern).is_absolute() else bids_dir,
    )
