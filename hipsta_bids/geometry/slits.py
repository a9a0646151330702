"""Layers of about one voxel without a label that part the sheet; slits through it are filled."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from hipsta_bids.artifacts import Bool, Float
from hipsta_bids.geometry.boxes import Box, box_around, low_corner
from hipsta_bids.settings import BodySettings

_ALL = np.ones((3, 3, 3), dtype=bool)
#: One of each two opposite directions to the 26 neighbors.
_DIRECTIONS = [step for step in product((-1, 0, 1), repeat=3) if step > (0, 0, 0)]

Tissues = NDArray[np.uint8]


@dataclass(frozen=True, eq=False, kw_only=True)
class Slits:
    """What was found between voxels of the sheet."""

    tissue: Tissues
    """(I, J, K) with the slits filled."""
    filled: NDArray[np.intp]
    """(N, 3) indices of voxels that were filled."""
    gap: NDArray[np.intp]
    """(N, 3) indices of the largest thin gap that was not filled."""


def fill_slits(
    tissue: Tissues, inside: Bool, unlabeled: Bool, affine: Float, settings: BodySettings
) -> Slits:
    """Fill slits through the sheet.

    A voxel without any label lies in a gap if the sheet is on both sides of it in several
    directions. A gap opens on both sides of the sheet if it goes through it, and on one if it is a
    crevice between two folds: only the first kind is filled, with the nearest labels.

    Parameters
    ----------
    tissue : (I, J, K) array of uint8
        Tissue of the sheet, 0 elsewhere.
    inside : (I, J, K) array of bool
        Voxels of the sheet between the end planes.
    unlabeled : (I, J, K) array of bool
        Voxels without any label.
    affine : (4, 4) array
    settings : BodySettings

    Returns
    -------
    Slits
    """
    around = box_around(np.argwhere(inside))
    sheet = np.pad(tissue[around] > 0, 1)
    # Between the end planes: next to voxels that lie there.
    beside = ndimage.binary_dilation(np.pad(inside[around], 1), structure=_ALL)
    empty = np.pad(unlabeled[around], 1)
    pieces, count = ndimage.label(
        empty & beside & _between(sheet, settings.gap_directions), structure=_ALL
    )
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)
    sizes[0] = 0
    edges = np.sort(np.linalg.norm(affine[:3, :3], axis=0))
    least = settings.slit_area / float(edges[0] * edges[1])
    through = [
        number
        for number in np.flatnonzero(sizes > least)
        if edges[2] <= settings.slit_voxel
        and _opens_on_both_sides(pieces == number, sheet, settings.slit_openings)
    ]
    slit = np.isin(pieces, through)
    sizes[through] = 0
    gap = (pieces == sizes.argmax()) & (pieces > 0)
    corner = low_corner(around) - 1
    return Slits(
        tissue=_with_nearest(tissue, np.argwhere(slit) + corner, around),
        filled=np.argwhere(slit) + corner,
        gap=np.argwhere(gap) + corner,
    )


def _between(sheet: Bool, directions: int) -> Bool:
    """Voxels that have the sheet on both sides in so many of 13 directions."""
    opposite = np.zeros(sheet.shape, dtype=np.int8)
    for step in _DIRECTIONS:
        back = tuple(-s for s in step)
        opposite += np.roll(sheet, step, (0, 1, 2)) & np.roll(sheet, back, (0, 1, 2))
    return np.asarray(~sheet & (opposite >= directions))


def _opens_on_both_sides(piece: Bool, sheet: Bool, least: float) -> bool:
    """Whether what surrounds a gap, and is not of the sheet, falls into two parts of fair size."""
    rim = ndimage.binary_dilation(piece, structure=_ALL) & ~sheet & ~piece
    openings, count = ndimage.label(rim, structure=_ALL)
    if count < 2:  # noqa: PLR2004 -- two sides
        return False
    sizes = np.sort(np.bincount(openings.ravel())[1:])
    return bool(sizes[-2] >= least * sizes.sum())


def _with_nearest(tissue: Tissues, index: NDArray[np.intp], around: Box) -> Tissues:
    """Give voxels (N, 3) the label that is nearest within a box."""
    if not len(index):
        return tissue
    nearest = ndimage.distance_transform_edt(
        tissue[around] == 0, return_distances=False, return_indices=True
    )
    low = low_corner(around)
    found = nearest[:, *(index - low).T].T + low
    filled = tissue.copy()
    filled[tuple(index.T)] = tissue[tuple(found.T)]
    return filled
