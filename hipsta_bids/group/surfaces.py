"""Other programs' maps with corresponding points (``--maps``): which files, whose, on what."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from hipsta_bids.errors import InputError, NothingToDoError, UsageError
from hipsta_bids.geometry.catalog import MAPS
from hipsta_bids.group.data import Cohort, Float, Int, SideMaps
from hipsta_bids.group.read import CURVATURE, Measured, Visit
from hipsta_bids.inputs.maps import Found, check_pattern, fields_of, fill, find, scan
from hipsta_bids.io.files import entities
from hipsta_bids.io.gifti import PointMap, read_map, read_mesh
from hipsta_bids.types import Mesh


@dataclass(frozen=True, kw_only=True)
class MapPattern:
    """A map that every hemisphere may have."""

    name: str
    pattern: str
    """Path with placeholders, absolute or relative to the BIDS dataset; may have wildcards."""
    surface: str | None = None
    """The same for the surface to draw it on."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ExternalSide:
    """One map of one hemisphere."""

    visits: tuple[Visit, ...]
    data: Float
    """(visits, points)"""
    unit: str
    mesh: Mesh | None
    """``None`` on the regular grid of sheets."""
    nodes: tuple[int, int]
    """Nodes along x and y of that grid; (points, 1) on a mesh."""


@dataclass(frozen=True, kw_only=True)
class ExternalFiles:
    """The files of one map."""

    request: MapPattern
    root: Path
    """What patterns are relative to."""
    files: Mapping[str, Mapping[Visit, Path]]
    """By hemisphere and visit."""

    @property
    def visits(self) -> set[Visit]:
        """Visits that have it, in either hemisphere."""
        return {visit for side in self.files.values() for visit in side}


def map_patterns(
    patterns: Sequence[tuple[str, str]],
    surfaces: Sequence[tuple[str | None, str]],
    taken: Sequence[str],
) -> tuple[MapPattern, ...]:
    """Combine and check the options about maps.

    ``surfaces`` Surfaces for one name, or (None) for all that have none of their own.
    """
    names = [name for name, _ in patterns]
    for name, pattern in patterns:
        if not (name.isalnum() and name.isascii() and name[0].isalpha()):
            raise UsageError(
                f"--maps: {name!r} is not a name of letters and digits", reason="usage"
            )
        if name in taken or names.count(name) > 1:
            why = "belongs to the sheets" if name in taken else "occurs twice"
            raise UsageError(
                f"--maps: the name {name} {why}; choose another one, such as other{name}",
                reason="usage",
            )
        check_pattern("--maps", name, pattern)
        fields = fields_of(pattern)
        if "subject" not in fields or not fields & {"hemi", "side"}:
            raise UsageError(
                f"--maps {name}: the pattern needs {{subject}}, and {{hemi}} or {{side}}",
                reason="usage",
            )
    if lost := [name for name, _ in surfaces if name is not None and name not in names]:
        raise UsageError(f"--maps-surface: there is no --maps {lost[0]}=...", reason="usage")
    for whose, pattern in surfaces:
        check_pattern("--maps-surface", whose or "", pattern)
    chosen = dict(surfaces)
    return tuple(
        MapPattern(name=name, pattern=pattern, surface=chosen.get(name, chosen.get(None)))
        for name, pattern in patterns
    )


def taken_names(*, with_sheets: bool) -> tuple[str, ...]:
    """Names that other programs' maps may not have."""
    return tuple(row.name for row in MAPS) if with_sheets else ()


def find_maps(
    request: MapPattern,
    root: Path,
    known: Iterable[Visit],
    is_wanted: Callable[[str, str | None, str], bool],
) -> ExternalFiles:
    """Look for the files of one map."""
    sessions: dict[str, list[str | None]] = {}
    for subject, session in known:
        sessions.setdefault(subject, []).append(session)
    found: dict[str, dict[Visit, Path]] = {}
    for one in scan(request.pattern, root):
        if one.hemi is None:
            continue
        for session in _sessions(one, sessions):
            if not is_wanted(one.subject, session, one.hemi):
                continue
            first = found.setdefault(one.hemi, {}).setdefault((one.subject, session), one.path)
            if first != one.path:
                raise InputError(
                    f"--maps {request.name}: {first} and {one.path} are both for sub-{one.subject}"
                    f" hemi-{one.hemi}; make the pattern match one of them",
                    reason="several-files",
                )
    if not found:
        raise NothingToDoError(
            f"--maps {request.name}: no file matches {request.pattern} (in {root})",
            reason="no-maps",
        )
    return ExternalFiles(
        request=request, root=root, files={hemi: found[hemi] for hemi in "LR" if hemi in found}
    )


def _sessions(one: Found, known: Mapping[str, Sequence[str | None]]) -> Sequence[str | None]:
    """Sessions that a file is for."""
    own = known.get(one.subject)
    if own is None:
        return [one.session]
    if one.session is None:
        return own
    return [one.session] if one.session in own else []


def read_maps(
    found: ExternalFiles, grid: tuple[int, int], *, with_sheets: bool
) -> dict[str, ExternalSide]:
    """Read one map of all hemispheres."""
    return {hemi: _read_side(found, hemi, grid, with_sheets=with_sheets) for hemi in found.files}


def _read_side(
    found: ExternalFiles, hemi: str, grid: tuple[int, int], *, with_sheets: bool
) -> ExternalSide:
    paths = found.files[hemi]
    visits = tuple(sorted(paths, key=lambda visit: (visit[0], visit[1] or "")))
    maps = [read_map(paths[visit], found.request.name) for visit in visits]
    _refuse_mixed(found.request.name, hemi, [paths[visit] for visit in visits], maps)
    first = maps[0]
    points = len(first.values)
    own = first.nodes if first.nodes is not None and not with_sheets else grid
    mesh = None if first.nodes == own else _mesh(found, hemi, points)
    if mesh is None and points != own[0] * own[1]:
        raise InputError(
            f"--maps {found.request.name}, hemisphere {hemi}: no surface of {points} vertices lies"
            f" beside {paths[visits[0]]}, and sheets have {own[0]} x {own[1]} points; name one by"
            " --maps-surface",
            reason="no-surface",
        )
    return ExternalSide(
        visits=visits,
        data=np.stack([one.values for one in maps]),  # noqa: PD011  (no table)
        unit=first.unit,
        mesh=mesh,
        nodes=own if mesh is None else (points, 1),
    )


def _refuse_mixed(name: str, hemi: str, paths: Sequence[Path], maps: Sequence[PointMap]) -> None:
    counts = Counter(len(one.values) for one in maps)
    if len(counts) > 1:
        examples = {len(one.values): path for path, one in zip(paths, maps, strict=True)}
        parts = [f"{n} with {points} ({examples[points]})" for points, n in counts.most_common()]
        raise InputError(
            f"--maps {name}, hemisphere {hemi}: maps have different numbers of points:"
            f" {'; '.join(parts)}; use one density",
            reason="mixed-grids",
        )


def _mesh(found: ExternalFiles, hemi: str, points: int) -> Mesh | None:
    """Read the surface that the user named, or else that beside the first map that has one."""
    paths = found.files[hemi]
    if found.request.surface is not None:
        return _named_surface(found, hemi, points)
    for path in paths.values():
        for candidate in _surfaces_beside(path):
            mesh = read_mesh(candidate)
            if len(mesh.points) == points:
                return mesh
    return None


def _named_surface(found: ExternalFiles, hemi: str, points: int) -> Mesh:
    request = found.request
    pattern = request.surface or ""
    names = dict.fromkeys(
        fill(pattern, subject, session, hemi) for subject, session in found.files[hemi]
    )
    for name in names:
        for path in find(name, found.root) or find(name, Path()):
            mesh = read_mesh(path)
            if len(mesh.points) != points:
                raise InputError(
                    f"--maps-surface {path}: has {len(mesh.points)} vertices, the maps"
                    f" {request.name} of hemisphere {hemi} have {points} points",
                    reason="mixed-grids",
                )
            return mesh
    raise InputError(
        f"--maps-surface: no file {next(iter(names))}; it serves to draw {request.name}",
        reason="no-surface",
    )


def _surfaces_beside(path: Path) -> list[Path]:
    """HippUnfold's unfolded surface: beside the map, or in version 2 in ``surf/``."""
    own = entities(path.name)
    folders = [path.parent, path.parent.parent / "surf"]
    return [
        candidate
        for folder in folders
        for candidate in sorted(folder.glob("*space-unfold*_midthickness.surf.gii"))
        if _belongs(own, entities(candidate.name))
    ]


def _belongs(own: Mapping[str, str], surface: Mapping[str, str]) -> bool:
    keys = ("sub", "ses", "hemi", "den", "label")
    # Sheets of this program have an unfolded surface too, but their maps have their grid.
    return "seg" not in surface and all(own.get(key) == surface.get(key) for key in keys)


def rows_of(visits: Sequence[Visit], keys: Sequence[Visit]) -> tuple[Int, Int]:
    """Match visits to rows of the covariates."""
    row_of = {visit: row for row, visit in enumerate(keys)}
    rows = np.array([row_of[visit] for visit in visits], dtype=np.int64)
    places = np.argsort(rows)
    return rows[places], np.asarray(places, dtype=np.int64)


# Other programs' maps beside the sheets, as the models take them.


@dataclass(frozen=True, eq=False, kw_only=True)
class ExternalCohorts:
    """Maps of other programs."""

    measured: Measured
    """Sheets, with the maps that lie on their grid."""
    others: Mapping[str, Cohort]
    """Maps with points of their own, by name; the covariates are the visits only."""
    names: tuple[str, ...]
    """Of the maps that lie with the sheets."""
    notes: tuple[str, ...]


def find_all(
    requests: Sequence[MapPattern],
    root: Path,
    known: Sequence[Visit],
    is_wanted: Callable[[str, str | None, str], bool],
) -> tuple[list[ExternalFiles], list[Visit]]:
    """Find the files of all maps, and who has them or a sheet."""
    found = [find_maps(request, root, known, is_wanted) for request in requests]
    visits: set[Visit] = set(known).union(*(one.visits for one in found))
    return found, sorted(visits, key=lambda visit: (visit[0], visit[1] or ""))


def add_external(
    measured: Measured, found: Iterable[ExternalFiles], visits: Sequence[Visit]
) -> ExternalCohorts:
    """Read other programs' maps, and put those on the grid of the sheets to the sheets.

    Without sheets, maps on the grid take their place if there is a curvature to register them by.
    """
    grid = len(measured.x), len(measured.y)
    maps = {
        one.request.name: read_maps(one, grid, with_sheets=bool(measured.sides)) for one in found
    }
    notes = [_found_note(name, sides, len(visits)) for name, sides in maps.items()]
    units = {name: next(iter(sides.values())).unit for name, sides in maps.items()}
    measured = replace(measured, units={**measured.units, **units})
    flat = {
        name: sides
        for name, sides in maps.items()
        if all(side.mesh is None for side in sides.values())
    }
    if not measured.sides and CURVATURE in flat:
        nodes = _nodes(flat[CURVATURE])
        measured = _on_grid(measured, nodes)
        flat = {name: sides for name, sides in flat.items() if _nodes(sides) == nodes}
    if measured.sides:
        sides = {
            hemi: _with_maps(side, hemi, flat, visits) for hemi, side in measured.sides.items()
        }
    elif CURVATURE in flat:
        sides = _as_sheets(flat, visits)
    else:
        sides, flat = {}, {}
    others = {
        name: _cohort(measured, name, own, visits) for name, own in maps.items() if name not in flat
    }
    if others:
        notes.append(f"maps {', '.join(others)}: not registered, their points are to correspond")
    return ExternalCohorts(
        measured=replace(measured, sides=sides),
        others=others,
        names=tuple(flat),
        notes=tuple(notes),
    )


def _nodes(sides: Mapping[str, ExternalSide]) -> tuple[int, int]:
    return next(iter(sides.values())).nodes


def _on_grid(measured: Measured, nodes: tuple[int, int]) -> Measured:
    """Coordinates of another number of nodes between the same ends."""
    x, y = (
        np.linspace(axis[0], axis[-1], count)
        for axis, count in zip((measured.x, measured.y), nodes, strict=True)
    )
    return replace(measured, x=x, y=y)


def _found_note(name: str, sides: Mapping[str, ExternalSide], n_visits: int) -> str:
    counts = ", ".join(f"{len(side.visits)} {hemi}" for hemi, side in sides.items())
    points = ", ".join(str(side.data.shape[1]) for side in sides.values())
    return f"maps {name}: {counts} of {n_visits} visits, {points} points"


def _aligned(
    side: ExternalSide,
    rows: Int,
    visits: Sequence[Visit],
) -> Float:
    """Values of some rows, in the shape of the sheet; NaN where there is no map."""
    own = {visit: place for place, visit in enumerate(side.visits)}
    result = np.full((len(rows), *side.nodes), np.nan)
    for i, row in enumerate(rows.tolist()):
        place = own.get(visits[row])
        if place is not None:
            result[i] = side.data[place].reshape(side.nodes)
    return result


def _with_maps(
    side: SideMaps,
    hemi: str,
    maps: Mapping[str, Mapping[str, ExternalSide]],
    visits: Sequence[Visit],
) -> SideMaps:
    """Add maps of the same grid to those of the sheets; they are registered with them."""
    blank = np.full((len(side.rows), *side.shape), np.nan)
    more = {
        name: _aligned(sides[hemi], side.rows, visits) if hemi in sides else blank
        for name, sides in maps.items()
    }
    return replace(side, maps={**side.maps, **more})


def _as_sheets(
    maps: Mapping[str, Mapping[str, ExternalSide]], visits: Sequence[Visit]
) -> dict[str, SideMaps]:
    """Sheets of those who have a curvature map."""
    result = {}
    for hemi, curvature in maps[CURVATURE].items():
        rows, _ = rows_of(curvature.visits, visits)
        result[hemi] = _with_maps(_empty(rows, curvature.nodes), hemi, maps, visits)
    return result


def _empty(rows: Int, nodes: tuple[int, int]) -> SideMaps:
    return SideMaps(
        rows=rows,
        maps={},
        subfield=np.full((len(rows), *nodes), -1, dtype=np.int8),
        names=(),
        summary=pd.DataFrame(index=range(len(rows))),
    )


def _cohort(
    measured: Measured, name: str, sides: Mapping[str, ExternalSide], visits: Sequence[Visit]
) -> Cohort:
    own = {}
    if all(side.mesh is None for side in sides.values()):
        measured = _on_grid(measured, _nodes(sides))
    for hemi, side in sides.items():
        rows, _ = rows_of(side.visits, visits)
        values = _aligned(side, rows, visits)
        own[hemi] = replace(_empty(rows, side.nodes), maps={name: values}, mesh=side.mesh)
    return Cohort(
        table=measured.visits, sides=own, x=measured.x, y=measured.y, units=measured.units
    )
