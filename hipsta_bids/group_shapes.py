"""Average surfaces of the sheets that were analyzed, read and written."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from hipsta_bids.bids import files, gifti
from hipsta_bids.bids.group_inputs import SheetRecord
from hipsta_bids.bids.layer_surfaces import read_layer_surfaces
from hipsta_bids.bids.results import fill_from_nearest
from hipsta_bids.geometry.sheet import is_left_handed
from hipsta_bids.group.analysis import Analysis
from hipsta_bids.group.shapes import LAYERS, AverageShape, average_shape
from hipsta_bids.group_data import PARTICIPANT, SESSION, Cohort
from hipsta_bids.group_settings import GroupSettings

_MIDDLE = LAYERS.index("midthickness")


def average_shapes(
    records: Sequence[SheetRecord], cohort: Cohort, analysis: Analysis, settings: GroupSettings
) -> dict[str, AverageShape]:
    """Average the surfaces of each hemisphere, of the first visit of each participant.

    Parameters
    ----------
    records : sequence of SheetRecord
        Where the sheets are.
    cohort : Cohort
        Visits that were analyzed.
    analysis : Analysis
        Warps and groups.
    settings : GroupSettings
        How many are read at most; they are spread evenly over all.

    Returns
    -------
    dict
        By hemisphere; without those whose surfaces are missing.
    """
    place_of = {
        (f"sub-{r.place.name.subject}", r.place.name.session or "", r.place.name.hemi): r.place
        for r in records
    }
    shapes = {}
    for hemi, side in analysis.sides.items() if records else ():
        visits = cohort.table.iloc[side.registered.rows]
        first = np.flatnonzero(~visits[PARTICIPANT].duplicated().to_numpy())
        most = min(len(first), settings.shapes.most)
        chosen = first[np.linspace(0, len(first) - 1, most).round().astype(np.int64)]
        keys = [
            (str(row[PARTICIPANT]), str(row[SESSION] or "").removeprefix("ses-"), hemi)
            for row in visits.iloc[chosen].to_dict("records")
        ]
        chosen = chosen[[key in place_of for key in keys]]
        places = [place_of[key] for key in keys if key in place_of]
        read, layers = read_layer_surfaces(places, side.registered.shape)
        if not read:
            continue
        own = chosen[read]
        groups = analysis.groups
        names = (
            np.full(len(own), "all")
            if groups is None
            else visits[groups.column].iloc[own].astype(str).to_numpy(dtype=np.str_)
        )
        shapes[hemi] = average_shape(
            layers,
            side.registration.warps[own],
            names,
            ("all",) if groups is None else groups.levels,
            settings.shapes,
        )
    return shapes


def write_shapes(folder: Path, shapes: Mapping[str, AverageShape]) -> None:
    """Write the average middle surfaces, on which maps of statistics can be drawn.

    Parameters
    ----------
    folder : Path
        Of the model.
    shapes : mapping of str to AverageShape
        By hemisphere.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    for hemi, shape in shapes.items():
        points = fill_from_nearest(shape.mean[_MIDDLE])
        flip = is_left_handed(np.moveaxis(shape.mean, 0, 2))
        content = gifti.surface_bytes(
            points.reshape(-1, 3),
            gifti.sheet_triangles(*points.shape[:2], flip=flip),
            hemi=hemi,
            secondary="MidThickness",
            unfolded=False,
        )
        files.write_bytes(folder / f"hemi-{hemi}_desc-average_midthickness.surf.gii", content)
