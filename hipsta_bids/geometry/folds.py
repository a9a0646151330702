"""Folds of the head that touch: two banks that the labels do not tell apart.

Where the cleft between two banks is lost, the wall there has the same face on both sides. Banks of
low folds hardly face each other: what is left of such a fold is a narrow ridge of a thick wall.
Two walls are thick beside any wall of the head; a thin neighborhood alone makes no ridge.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage, sparse
from scipy.spatial import cKDTree

from hipsta_bids.geometry.faces import Faces
from hipsta_bids.geometry.measures import column_area, measure_thickness
from hipsta_bids.geometry.mesh import vertex_areas
from hipsta_bids.types import Bool, Float, Sheet, Surface

LINK = 1.0
"""Parts of banks that touch are one place up to this distance, mm."""
RIDGE, SLOPE, AROUND = 1.35, 1.25, 4.0
"""A ridge is thicker than this multiple of the median up to this distance, mm, and its slopes than
the second."""
TWO_WALLS = 1.5
"""A ridge is thicker than this multiple of the median of all columns among which it is looked for.
Without it, walls that vary smoothly have ridges where what lies round them is thin."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TouchingBanks:
    """A place where two banks of a fold touch."""

    points: Float
    """(N, 3) midway between the two banks, RAS mm."""
    area: float
    """Of one bank, mm2."""
    side: str
    """The side on which the cleft is lost: ``interior`` or ``exterior``."""


def find_touching_banks(surface: Surface, faces: Faces) -> list[TouchingBanks]:
    """Find where opposite walls are both interior, or both exterior, largest place first."""
    side = np.where(faces.free, 0, np.sign(faces.side))
    mated = np.flatnonzero((faces.opposite >= 0) & (side != 0))
    mate = faces.opposite[mated]
    touching = side[mated] == side[mate]
    first, second = mated[touching], mate[touching]
    middle = (surface.vertices[first] + surface.vertices[second]) / 2
    pairs = cKDTree(middle).query_pairs(LINK, output_type="ndarray")
    links = sparse.coo_array(
        (np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(first), len(first))
    )
    count, place = sparse.csgraph.connected_components(links, directed=False)
    area = vertex_areas(surface.vertices, surface.triangles)[first] / 2  # both banks are counted
    banks = [
        TouchingBanks(
            points=middle[place == number],
            area=float(area[place == number].sum()),
            # The cleft of the other face is lost: both walls that are left are of one face.
            side="exterior" if side[first[place == number]].sum() > 0 else "interior",
        )
        for number in range(count)
    ]
    return sorted(banks, key=lambda bank: -bank.area)


def find_ridges(sheet: Sheet, among: Bool) -> list[tuple[Bool, float]]:
    """Find narrow places where the sheet is thick: columns (Nx, Ny), and area without slopes, mm2.

    Only columns ``among`` (Nx, Ny) belong to them; all that have a value are what is round them.
    """
    thickness, middle = measure_thickness(sheet), sheet.points[:, :, sheet.middle][sheet.valid]
    values = thickness[sheet.valid]
    near = cKDTree(middle).query_ball_point(middle, AROUND)
    ratio = np.zeros(thickness.shape)
    ratio[sheet.valid] = values / [np.median(values[own]) for own in near]
    places, count = ndimage.label(among & (ratio > SLOPE))
    if not count:
        return []
    thick = thickness > TWO_WALLS * np.median(thickness[sheet.valid & among])
    share = np.where(thick & (ratio > RIDGE), column_area(sheet), 0.0)
    areas = ndimage.sum_labels(share, places, np.arange(count) + 1)
    return [(places == number, float(area)) for number, area in enumerate(areas, start=1)]
