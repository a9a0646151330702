"""Maps of other programs with corresponding points (``--maps``): files, visits and surfaces."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, product
from pathlib import Path

import numpy as np
import pandas as pd

from hipsta_bids.errors import InputError, NothingToDoError, UsageError
from hipsta_bids.geometry.catalog import why_impossible
from hipsta_bids.group.cohort.data import Cohort
from hipsta_bids.group.cohort.read import CURVATURE, THICKNESS, Measured
from hipsta_bids.inputs.maps import Found, check_pattern, fields_of, fill, find, scan
from hipsta_bids.io.gifti import DENSE_SCALARS, PointMap, cifti_sides, read_map, read_surface
from hipsta_bids.io.hippunfold import has_opposite_sign, surfaces_beside
from hipsta_bids.stats.arrays import SideMaps
from hipsta_bids.types import Mesh, VisitKey


@dataclass(frozen=True, kw_only=True)
class MapPattern:
    """A map that every hemisphere may have."""

    name: str
    pattern: str
    """Path with placeholders, absolute or relative to the BIDS dataset; may have wildcards."""
    surface: str | None = None
    """The same for the surface to draw it on."""


@dataclass(frozen=True, kw_only=True)
class ExternalFiles:
    """The files of one map."""

    request: MapPattern
    root: Path
    """Folder that patterns are relative to."""
    files: Mapping[str, Mapping[VisitKey, Path]]
    """By hemisphere and visit."""

    @property
    def visits(self) -> set[VisitKey]:
        """Visits with a map of either hemisphere."""
        return {visit for side in self.files.values() for visit in side}


def map_patterns(
    patterns: Sequence[tuple[str, str]],
    surfaces: Sequence[tuple[str | None, str]],
    reserved: Sequence[str],
) -> tuple[MapPattern, ...]:
    """Combine and check the options about maps; a surface without a name is for all other maps."""
    names = [name for name, _ in patterns]
    for name, pattern in patterns:
        _check_name(name, names, reserved)
        _check_map(name, pattern)
    if unmatched := [name for name, _ in surfaces if name is not None and name not in names]:
        raise UsageError(f"--maps-surface: there is no --maps {unmatched[0]}=...")
    for surface, pattern in surfaces:
        check_pattern("--maps-surface", surface or "", pattern)
    pattern_of = dict(surfaces)
    return tuple(
        MapPattern(name=name, pattern=pattern, surface=pattern_of.get(name, pattern_of.get(None)))
        for name, pattern in patterns
    )


def _check_name(name: str, names: Sequence[str], reserved: Sequence[str]) -> None:
    if not (name.isalnum() and name.isascii() and name[0].isalpha()):
        raise UsageError(f"--maps: {name!r} is not a name of letters and digits")
    if name in reserved or names.count(name) > 1:
        problem = "belongs to the sheets" if name in reserved else "occurs twice"
        raise UsageError(
            f"--maps: the name {name} {problem}; choose another one, such as other{name}"
        )


def _check_map(name: str, pattern: str) -> None:
    check_pattern("--maps", name, pattern)
    fields = fields_of(pattern)
    one_side = fields & {"hemi", "side"} or pattern.endswith(DENSE_SCALARS)
    if "subject" not in fields or not one_side:
        raise UsageError(
            f"--maps {name}: the pattern needs {{subject}}, and {{hemi}} or {{side}} unless it"
            f" ends with {DENSE_SCALARS}"
        )


def find_maps(
    request: MapPattern,
    root: Path,
    visits: Iterable[VisitKey],
    is_wanted: Callable[[str, str | None, str], bool],
    matches: Iterable[Found],
) -> ExternalFiles:
    """Choose from the files of one map."""
    sessions: dict[str, list[str | None]] = {}
    for subject, session in visits:
        sessions.setdefault(subject, []).append(session)
    paths: dict[str, dict[VisitKey, Path]] = {}
    for match in matches:
        hemis = [match.hemi] if match.hemi else cifti_sides(match.path)
        for hemi, session in product(hemis, _sessions(match, sessions)):
            if not is_wanted(match.subject, session, hemi):
                continue
            first = paths.setdefault(hemi, {}).setdefault((match.subject, session), match.path)
            if first != match.path:
                raise InputError(
                    f"--maps {request.name}: {first} and {match.path} are both for"
                    f" sub-{match.subject} hemi-{hemi}; make the pattern match one of them",
                    reason="several-files",
                )
    if not paths:
        raise NothingToDoError(
            f"--maps {request.name}: no file matches {request.pattern} (in {root})"
        )
    return ExternalFiles(
        request=request, root=root, files={hemi: paths[hemi] for hemi in "LR" if hemi in paths}
    )


def _sessions(match: Found, visits: Mapping[str, Sequence[str | None]]) -> Sequence[str | None]:
    """Sessions that a file is for."""
    sessions = visits.get(match.subject)
    if sessions is None:
        return [match.session]
    if match.session is None:
        return sessions
    return [match.session] if match.session in sessions else []


def read_maps(
    source: ExternalFiles, visits: Sequence[VisitKey], grid: tuple[int, int], *, with_sheets: bool
) -> tuple[dict[str, SideMaps], str, list[str]]:
    """Read one map of all hemispheres, by rows of visits, its unit, and notes of impossible ones.

    On the regular grid of sheets there is no mesh; without sheets, files may have their own grid.
    """
    row_of = {visit: row for row, visit in enumerate(visits)}
    name, sides, units, notes = source.request.name, {}, [], list[str]()
    for hemi in source.files:
        keys, maps, notes_of_side = _possible_maps(source, hemi, row_of)
        notes += notes_of_side
        first, points = maps[0], len(maps[0].values)
        nodes = first.nodes if first.nodes is not None and not with_sheets else grid
        mesh = None if first.nodes == nodes else _mesh(source, hemi, points)
        if mesh is None and points != nodes[0] * nodes[1]:
            place = min(source.files[hemi], key=row_of.__getitem__)
            raise InputError(
                f"--maps {name}, hemisphere {hemi}: {points} values fit neither sheets "
                f"({nodes[0]} x {nodes[1]}) nor a surface beside {source.files[hemi][place]}; use "
                "--maps-surface"
            )
        shape = nodes if mesh is None else (points, 1)
        values = np.stack([data.values.reshape(shape) for data in maps])  # noqa: PD011  (no table)
        sides[hemi] = SideMaps(
            rows=np.array([row_of[visit] for visit in keys], dtype=np.int64),
            maps={name: values},
            subfield=np.full(values.shape, -1, dtype=np.int8),
            names=(),
            summary=pd.DataFrame(index=range(len(keys))),
            mesh=mesh,
        )
        units.append(first.unit)
    return sides, units[0], notes


def _possible_maps(
    source: ExternalFiles, hemi: str, row_of: Mapping[VisitKey, int]
) -> tuple[list[VisitKey], list[PointMap], list[str]]:
    """Read the maps of a hemisphere, without impossible ones, of which notes are."""
    name, path_of = source.request.name, source.files[hemi]
    keys = sorted(path_of, key=row_of.__getitem__)
    paths = [path_of[visit] for visit in keys]
    maps = [read_map(path, name, hemi) for path in paths]
    notes = sign_notes(name, hemi, paths)
    _refuse_mixed(name, hemi, paths, maps)
    # The curvature of other programs may be huge at single vertices of good maps.
    problems = [why_impossible(name, m.values) if name == THICKNESS else None for m in maps]
    impossible = [(path, text) for path, text in zip(paths, problems, strict=True) if text]
    notes += [f"{path}: {text}; excluded" for path, text in impossible]
    if len(impossible) == len(maps):
        raise InputError(f"--maps {name}: {notes[-1]}, as are all")
    possible = [i for i, text in enumerate(problems) if not text]
    return [keys[i] for i in possible], [maps[i] for i in possible], notes


def sign_notes(name: str, hemi: str, paths: Iterable[Path]) -> list[str]:
    """Note maps that were multiplied by -1 when they were read."""
    turned = sum(has_opposite_sign(path, hemi) for path in paths)
    text = f"curvature of {turned} right hemispheres by HippUnfold 1 was multiplied by -1"
    return [f"--maps {name}: {text} (opposite sign)"] if turned else []


def _refuse_mixed(name: str, hemi: str, paths: Sequence[Path], maps: Sequence[PointMap]) -> None:
    counts = Counter(len(data.values) for data in maps)
    if len(counts) > 1:
        examples = {len(data.values): path for path, data in zip(paths, maps, strict=True)}
        parts = [f"{n} with {points} ({examples[points]})" for points, n in counts.most_common()]
        raise InputError(
            f"--maps {name}, hemisphere {hemi}: maps have different numbers of points:"
            f" {'; '.join(parts)}; use one density"
        )


def _mesh(source: ExternalFiles, hemi: str, points: int) -> Mesh | None:
    """Read the surface that the user named, or else that beside the first map that has one."""
    if source.request.surface is not None:
        return _named_surface(source, hemi, points)
    paths = source.files[hemi].values()
    meshes = (read_surface(surface) for path in paths for surface in surfaces_beside(path, hemi))
    return next((mesh for mesh in meshes if len(mesh.points) == points), None)


def _named_surface(source: ExternalFiles, hemi: str, points: int) -> Mesh:
    request = source.request
    pattern = request.surface or ""
    names = dict.fromkeys(
        fill(pattern, subject, session, hemi) for subject, session in source.files[hemi]
    )
    for name in names:
        for path in find(name, source.root) or find(name, Path()):
            mesh = read_surface(path)
            if len(mesh.points) != points:
                raise InputError(
                    f"--maps-surface {path}: has {len(mesh.points)} vertices, the maps"
                    f" {request.name} of hemisphere {hemi} have {points} points"
                )
            return mesh
    raise InputError(
        f"--maps-surface: no file {next(iter(names))}; it serves to draw {request.name}"
    )


def find_all(
    requests: Sequence[MapPattern],
    root: Path,
    known: Sequence[VisitKey],
    choice: Callable[[Iterable[VisitKey]], Callable[[str, str | None, str], bool]],
) -> list[ExternalFiles]:
    """Find the files of all maps."""
    matches = [scan(request.pattern, root) for request in requests]
    is_wanted = choice([*known, *((one.subject, one.session) for one in chain(*matches))])
    return [
        find_maps(request, root, known, is_wanted, files_of)
        for request, files_of in zip(requests, matches, strict=True)
    ]


_Flat = Mapping[str, Mapping[str, SideMaps]]
"""Maps on a grid by name and hemisphere."""
Reader = Callable[[ExternalFiles, Sequence[VisitKey]], tuple[dict[str, SideMaps], str, list[str]]]
"""Reads one map, as ``read_maps``."""


def add_external(
    measured: Measured,
    sources: Iterable[ExternalFiles],
    visits: Sequence[VisitKey],
    crop: Reader | None = None,
) -> tuple[Measured, dict[str, Cohort], list[str]]:
    """Read other programs' maps; maps on the grid of the sheets are added to the sheets.

    ``crop`` reads maps that are no tables, to bring them to this grid.

    Returns the sheets, cohorts by surface of maps with points of their own, and notes.

    Without sheets, maps on a grid replace them if there is a curvature to register them by.
    """
    grid, with_sheets = (len(measured.x), len(measured.y)), bool(measured.sides)
    maps, units, notes = {}, dict(measured.units), []
    for source in sources:
        name = source.request.name
        read = partial(read_maps, grid=grid, with_sheets=with_sheets)
        reader = crop if crop is not None and not source.request.pattern.endswith(".tsv") else read
        maps[name], units[name], left_out = reader(source, visits)
        notes += left_out
        counts = ", ".join(f"{len(side.rows)} {hemi}" for hemi, side in maps[name].items())
        points = ", ".join(str(np.prod(side.shape)) for side in maps[name].values())
        notes.append(f"maps {name}: {counts} of {len(visits)} visits, {points} points")
    measured = replace(measured, units=units)
    flat: _Flat = {
        name: sides
        for name, sides in maps.items()
        if all(side.mesh is None for side in sides.values())
    }
    if not with_sheets:
        measured, flat = _without_sheets(measured, flat)
    sides = {hemi: _with_maps(side, hemi, flat) for hemi, side in measured.sides.items()}
    cohorts = {name: _cohort(one, measured) for name, one in maps.items() if name not in flat}
    if cohorts:
        notes.append(f"maps {', '.join(cohorts)}: not registered, their points are to correspond")
    return replace(measured, sides=sides), cohorts, notes


def _cohort(sides: Mapping[str, SideMaps], measured: Measured) -> Cohort:
    """Return a map with points of its own as a cohort."""
    on_mesh = any(side.mesh is not None for side in sides.values())
    axes = measured if on_mesh else _on_grid(measured, _nodes(sides))
    return Cohort(table=measured.table, sides=sides, x=axes.x, y=axes.y, units=measured.units)


def _without_sheets(measured: Measured, flat: _Flat) -> tuple[Measured, _Flat]:
    """Take the grid of the curvature for that of the sheets; keep maps on this grid."""
    curvature = flat.get(CURVATURE, {})
    nodes = _nodes(curvature) if curvature else None
    sheets = {hemi: replace(side, maps={}) for hemi, side in curvature.items()}
    measured = replace(_on_grid(measured, nodes) if nodes else measured, sides=sheets)
    return measured, {name: sides for name, sides in flat.items() if _nodes(sides) == nodes}


def _nodes(sides: Mapping[str, SideMaps]) -> tuple[int, int]:
    return next(iter(sides.values())).shape


def _on_grid(measured: Measured, nodes: tuple[int, int]) -> Measured:
    """Coordinates of another number of nodes between the same ends."""
    x, y = (
        np.linspace(axis[0], axis[-1], count)
        for axis, count in zip((measured.x, measured.y), nodes, strict=True)
    )
    return replace(measured, x=x, y=y)


def _with_maps(side: SideMaps, hemi: str, maps: Mapping[str, Mapping[str, SideMaps]]) -> SideMaps:
    """Add maps of the same grid to those of the sheets; they are registered with them."""
    added = {}
    for name, sides in maps.items():
        added[name] = np.full((len(side.rows), *side.shape), np.nan)
        if hemi in sides:
            _, kept_rows, map_rows = np.intersect1d(
                side.rows, sides[hemi].rows, return_indices=True
            )
            added[name][kept_rows] = sides[hemi].maps[name][map_rows]
    return replace(side, maps={**side.maps, **added})
