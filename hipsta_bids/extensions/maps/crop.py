"""Maps of other programs at the nodes of each participant's sheet (``--maps-crop``).

A sheet ends at the end planes of the participant's body. Maps at its nodes end there, too, and have
the same places as the maps of the sheet.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from hipsta_bids.derivatives.results import ResultPlace, read_sheet
from hipsta_bids.errors import InputError
from hipsta_bids.extensions.maps.external import ExternalFiles, sign_notes
from hipsta_bids.geometry.agreement import compare_nearby
from hipsta_bids.inputs.maps import fill, find
from hipsta_bids.io import files
from hipsta_bids.io.gifti import read_map, read_surface
from hipsta_bids.io.hippunfold import surfaces_beside
from hipsta_bids.stats.arrays import SideMaps
from hipsta_bids.types import VisitKey

#: Nodes farther than this from all vertices have no value, mm; sheets are as thick or thicker.
REACH = 1.5
#: Maps that reach fewer nodes lie in another space, share.
_LEAST_SHARE = 0.5
_SPACE = "T1w"  # of surfaces beside maps without one in their names

Places = Mapping[tuple[VisitKey, str], ResultPlace]
"""Sheets by visit and hemisphere."""


def crop_maps(
    source: ExternalFiles, visits: Sequence[VisitKey], places: Places
) -> tuple[dict[str, SideMaps], str, list[str]]:
    """Sample one map at the nodes of sheets: maps by hemisphere, their unit, and notes."""
    row_of = {visit: row for row, visit in enumerate(visits)}
    name, sides, units, notes = source.request.name, {}, ["1"], list[str]()
    for hemi, path_of in source.files.items():
        notes += sign_notes(name, hemi, path_of.values())
        values = {}
        for visit in sorted(path_of, key=row_of.__getitem__):
            place = places.get((visit, hemi))
            if place is None:
                continue
            points = np.stack(list(read_sheet(place.path("sheet"), ("r", "a", "s")).values()), -1)
            point_map = read_map(path_of[visit], name, hemi)
            surface = _surface(source, visit, hemi)
            vertices = read_surface(surface).points
            if len(vertices) != len(point_map.values):
                raise InputError(
                    f"--maps-crop {name}: {surface} has {len(vertices)} vertices, the map"
                    f" {path_of[visit]} has {len(point_map.values)} points"
                )
            nodes = np.isfinite(points).all(axis=-1)
            sampled = np.full(nodes.shape, np.nan)
            sampled[nodes] = compare_nearby(points[nodes], vertices, point_map.values, REACH)
            share = np.isfinite(sampled[nodes]).mean() if nodes.any() else 0.0
            if share < _LEAST_SHARE:
                notes.append(
                    f"{path_of[visit]}: the surface reaches {share:.0%} of the sheet's nodes;"
                    " excluded, check that both are in one space"
                )
                continue
            values[row_of[visit]] = sampled
            units.append(point_map.unit)
        if values:
            maps = np.stack(list(values.values()))
            sides[hemi] = SideMaps(
                rows=np.array(list(values), dtype=np.int64),
                maps={name: maps},
                subfield=np.full(maps.shape, -1, dtype=np.int8),
                names=(),
                summary=pd.DataFrame(index=range(len(maps))),
            )
    if not sides:
        raise InputError(
            f"--maps-crop {name}: no map lies on a sheet; {notes[0] if notes else 'none has one'}"
        )
    return sides, units[-1], notes


def _surface(source: ExternalFiles, visit: VisitKey, hemi: str) -> Path:
    """Find the surface of a participant's map in scanner space."""
    path, pattern = source.files[hemi][visit], source.request.surface
    if pattern is not None:
        name = fill(pattern, *visit, hemi)
        candidates = [*find(name, source.root), *find(name, Path())]
    else:
        candidates = surfaces_beside(path, hemi, flat=False)
        space = files.entities(path.name).get("space", _SPACE)
        candidates.sort(key=lambda file: files.entities(file.name).get("space") != space)
    if not candidates:
        raise InputError(
            f"--maps-crop {source.request.name}: no surface in scanner space beside {path}; name"
            " it by --maps-surface"
        )
    return candidates[0]
