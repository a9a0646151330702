"""Other programs' maps beside the sheets, as the models take them."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from hipsta_bids.bids.foreign_maps import (
    ForeignFiles,
    ForeignSide,
    MapPattern,
    find_maps,
    read_maps,
    rows_of,
)
from hipsta_bids.bids.measure_names import CURVATURE
from hipsta_bids.bids.sheets import Measured, Visit
from hipsta_bids.group_data import Cohort, Float, Int, SideMaps


@dataclass(frozen=True, eq=False, kw_only=True)
class ForeignCohorts:
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
) -> tuple[list[ForeignFiles], list[Visit]]:
    """Find the files of all maps, and who has them or a sheet.

    Parameters
    ----------
    requests : sequence of MapPattern
    root : Path
        What patterns are relative to.
    known : sequence of (str, str or None)
        Visits with sheets.
    is_wanted : callable
        Takes subject, session and hemisphere.

    Returns
    -------
    list of ForeignFiles
    list of (str, str or None)
        All visits, sorted.

    Raises
    ------
    HipstaError
        If there are no files of a map, or several for a hemisphere.
    """
    found = [find_maps(request, root, known, is_wanted) for request in requests]
    visits: set[Visit] = set(known).union(*(one.visits for one in found))
    return found, sorted(visits, key=lambda visit: (visit[0], visit[1] or ""))


def add_foreign(
    measured: Measured, found: Iterable[ForeignFiles], visits: Sequence[Visit]
) -> ForeignCohorts:
    """Read other programs' maps, and put those on the grid of the sheets to the sheets.

    Without sheets, maps on the grid take their place if there is a curvature to register them by.

    Parameters
    ----------
    measured : Measured
        Sheets, perhaps none.
    found : iterable of ForeignFiles
    visits : sequence of (str, str or None)
        Rows of the covariates.

    Raises
    ------
    InputError
        If a file cannot be read, maps have different numbers of points, or no surface fits.
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
    return ForeignCohorts(
        measured=replace(measured, sides=sides),
        others=others,
        names=tuple(flat),
        notes=tuple(notes),
    )


def _nodes(sides: Mapping[str, ForeignSide]) -> tuple[int, int]:
    return next(iter(sides.values())).nodes


def _on_grid(measured: Measured, nodes: tuple[int, int]) -> Measured:
    """Coordinates of another number of nodes between the same ends."""
    x, y = (
        np.linspace(axis[0], axis[-1], count)
        for axis, count in zip((measured.x, measured.y), nodes, strict=True)
    )
    return replace(measured, x=x, y=y)


def _found_note(name: str, sides: Mapping[str, ForeignSide], n_visits: int) -> str:
    counts = ", ".join(f"{len(side.visits)} {hemi}" for hemi, side in sides.items())
    points = ", ".join(str(side.data.shape[1]) for side in sides.values())
    return f"maps {name}: {counts} of {n_visits} visits, {points} points"


def _aligned(
    side: ForeignSide,
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
    maps: Mapping[str, Mapping[str, ForeignSide]],
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
    maps: Mapping[str, Mapping[str, ForeignSide]], visits: Sequence[Visit]
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
    measured: Measured, name: str, sides: Mapping[str, ForeignSide], visits: Sequence[Visit]
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
