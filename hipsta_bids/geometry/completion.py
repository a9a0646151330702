"""What labels lack, or have too much, before they make one ribbon.

Cavities between the sheet and the dentate gyrus, slits through the sheet, end labels on the wrong
side of an end plane, and the uncus next to the front of the body.
"""

from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from hipsta_bids.geometry import digital
from hipsta_bids.geometry.ends import EndPlanes
from hipsta_bids.protocols.protocol import LATERAL_END, MEDIAL_END, Tissue
from hipsta_bids.settings import BodySettings
from hipsta_bids.types import Bool, Float, LabelVolume

#: A voxel without a label lies in a thin gap if it has the sheet on both sides in this many of
#: 13 directions; where an edge of the voxels is longer than ``slit_voxel``, in the same share of
#: those across that edge.
GAP_DIRECTIONS = 3
#: A gap goes through the sheet if what is next to it falls into two parts, each of at least this
#: share (in six real bodies: none, and gaps with one opening are up to 4.0 mm2).
SLIT_OPENINGS = 0.2
#: A voxel without a label lies in a pit if the sheet is this near, mm, ...
PIT_REACH = 0.9
#: ... on so many of its six sides (5 is open on one side).
PIT_SIDES = 5
#: Pits of this volume are filled, mm3, where gaps are (there are two in six real bodies).
PIT_SIZE = (0.2, 1.8)
#: Smaller pieces of CA2 or CA3 are no uncus, mm3.
UNCUS_SIZE = 1.0
#: CA2 or CA3 at the anterior plane is the uncus if it lies farther than this medially of the
#: body's own, mm (10 to 12 in three real brains).
UNCUS_OFFSET = 5.0
#: What is enclosed in a slice is filled if at most this share of what surrounds it is open to
#: the next slices; between thick slices, whatever lies there.
CAVITY_OPENNESS = 0.25
#: A cavity with room for a ball of this radius is too wide to be the molecular layer, mm.
CAVITY_RADIUS = 0.9
#: A cavity of at least this volume, mm3, whose openness or radius is within this factor of its
#: limit could as well be taken for the other kind.
DOUBTFUL_CAVITY, CAVITY_MARGIN = 2.0, 1.15

#: Neighbors that are no farther than the nearest by more than this are tied, mm: the affine of an
#: image is stored with errors of a hundredth of that.
TIE_SLACK = 1e-3

Index = NDArray[np.intp]
Tissues = NDArray[np.uint8]

_TIES = 8
"""Nearest voxels that may be equally near: the corners of a cube."""
_NEAR = 8
"""Voxels beyond others within which their nearest donors lie."""
_DIRECTIONS = [step for step in product((-1, 0, 1), repeat=3) if step > (0, 0, 0)]
"""One of each two opposite directions to the 26 neighbors."""


def between(mask: Bool, affine: Float, ends: EndPlanes) -> tuple[Bool, Float]:
    """Part of a mask between the end planes, (I, J, K), and its voxels in RAS mm, (N, 3)."""
    index = digital.positions(mask)
    points = digital.to_ras(index, affine)
    between = ends.depth(points) > 0
    inside = np.zeros(mask.shape, dtype=bool)
    inside[tuple(index[between].T)] = True
    return inside, points[between]


def value_of_nearest(values: NDArray[np.integer], points: Float, at: Float) -> Index:
    """Value of the nearest of points (N, 3) at others (M, 3); the smallest if some are tied.

    So the way in which voxels are stored decides nothing.
    """
    neighbors = cKDTree(points).query(at, k=_TIES)
    distance, index = (np.asarray(part) for part in neighbors)
    tied = distance < distance[:, :1] + TIE_SLACK
    padding = np.iinfo(np.intp).max  # also for fewer points than asked
    ranked = np.append(values.astype(np.intp), padding)[index]
    return np.asarray(np.where(tied, ranked, padding).min(axis=1))


class Cavities(NamedTuple):
    """Voxels (N, 3) without a label that the hippocampus encloses, between the end planes."""

    narrow: tuple[Index, ...] = ()
    """Cavities that may be a part of the molecular layer."""
    wide: tuple[Index, ...] = ()
    """Cavities that are too wide for that."""
    doubtful: bool = False
    """Whether a large one is near to a limit that decides about it."""

    @property
    def all(self) -> Index:
        """All voxels of all cavities."""
        return np.concatenate([np.zeros((0, 3), np.intp), *self.narrow, *self.wide])


def find_uncus(tissue: Tissues, affine: Float, ends: EndPlanes) -> Index:
    """Find voxels (N, 3) of the uncus, which the head bends back to next to the body.

    It shows as a second piece of CA2 or CA3 that reaches the anterior plane far medially of the
    first. The part of CA1 that is nearer to it than to the rest, on the way through the sheet, is
    part of it.
    """
    index = digital.positions(tissue > 0)
    points = digital.to_ras(index, affine)
    near = ends.beyond(1.0).depth(points) > 0
    index, points = index[near], points[near]
    low = index.min(axis=0) if len(index) else np.zeros(3, np.intp)
    kinds, at = tissue[tuple(index.T)], tuple((index - low).T)
    lateral = np.isin(kinds, LATERAL_END)
    medial = np.isin(kinds, MEDIAL_END)
    grid = np.zeros(index.max(axis=0, initial=-1) - low + 1, dtype=np.int32)
    grid[at] = lateral & (ends.depth(points) > 0)
    pieces = ndimage.label(grid, structure=digital.CUBE)[0][at]
    sizes = np.bincount(pieces)[1:] * abs(np.linalg.det(affine[:3, :3]))
    if len(sizes) < 2 or not medial.any():  # noqa: PLR2004 -- the body's is the first
        return np.zeros((0, 3), np.intp)
    towards = points[medial].mean(axis=0) - points[lateral].mean(axis=0)
    towards -= (towards @ ends.axis) * ends.axis
    towards /= np.linalg.norm(towards)
    depth = -ends.height(points, "anterior")
    main = pieces == sizes.argmax() + 1
    uncus = np.zeros(len(points), dtype=bool)
    for number in np.flatnonzero(sizes > UNCUS_SIZE) + 1:
        piece = pieces == number
        adjacent = main & (depth < depth[piece].max() + ends.half_slice)
        body = points[adjacent if adjacent.any() else main]
        offset = (points[piece].mean(axis=0) - body.mean(axis=0)) @ towards
        if depth[piece].min() < 3 * ends.half_slice and offset > UNCUS_OFFSET:
            uncus |= piece
    if not uncus.any():
        return np.zeros((0, 3), np.intp)
    adjacent = depth < depth[uncus].max() + 1.0
    uncus_grid, body_grid, free = (np.zeros(grid.shape, dtype=bool) for _ in range(3))
    uncus_grid[at], body_grid[at], free[at] = (
        uncus,
        (lateral | medial) & adjacent & ~uncus,
        adjacent,
    )
    return np.asarray(index[_nearer_to(uncus_grid, body_grid, free)[at]])


def _nearer_to(first: Bool, second: Bool, free: Bool) -> Bool:
    """Grow two masks through free voxels, a voxel at a time; return the first.

    What both reach at once goes to the second, whatever the order in which voxels are stored.
    """
    free = free & ~first & ~second
    while True:
        to_first, to_second = (digital.widened(part) & free for part in (first, second))
        if not (to_first | to_second).any():
            return first
        second = second | to_second
        first = first | (to_first & ~to_second)
        free &= ~(to_first | to_second)


def _like_nearest(
    volume: LabelVolume, tissue: Tissues, voxels: Index, donors: Bool
) -> tuple[LabelVolume, Tissues]:
    """Give voxels (N, 3) the label and the part of the sheet that the nearest donor has."""
    around = digital.box(np.maximum(voxels.min(axis=0) - _NEAR, 0), voxels.max(axis=0) + _NEAR + 1)
    index = digital.positions(donors[around]) + digital.low_corner(around)
    pairs = volume.tissue.astype(np.intp) * 256 + tissue
    nearest = value_of_nearest(
        pairs[tuple(index.T)],
        digital.to_ras(index, volume.affine),
        digital.to_ras(voxels, volume.affine),
    )
    at = tuple(voxels.T)
    labels, sheet = volume.tissue.copy(), tissue.copy()
    labels[at], sheet[at] = np.divmod(nearest, 256)
    return replace(volume, tissue=labels), sheet


def _subfields(volume: LabelVolume) -> Bool:
    """Voxels of the sheet, of its layer, and of what lies on its interior side."""
    protocol = volume.protocol
    return np.isin(volume.tissue, (*protocol.sheet, *protocol.layer, *protocol.interior))


def hand_over(
    volume: LabelVolume, tissue: Tissues, ends: EndPlanes, reach: float
) -> tuple[LabelVolume, Tissues, int]:
    """Give head and tail voxels up to a distance inside the planes the label of a neighbor.

    No plane separates labels perfectly; if excluded, these voxels would be holes in the sheet.
    """
    index = digital.positions(volume.tissue == Tissue.HIPPOCAMPUS)
    depth = ends.depth(digital.to_ras(index, volume.affine))
    voxels = index[(depth > 0) & (depth < reach)]
    if not len(voxels):
        return volume, tissue, 0
    volume, tissue = _like_nearest(volume, tissue, voxels, _subfields(volume))
    return volume, tissue, len(voxels)


def find_cavities(
    volume: LabelVolume,
    tissue: Tissues,
    ends: EndPlanes,
    settings: BodySettings,
    *,
    second: bool = False,
) -> Cavities:
    """Find unlabeled voxels enclosed by the sheet, its layer and its interior.

    Vessels, cysts and strata without a label make the inner wall jump across them. A cavity is
    enclosed in three dimensions, or in a slice if little of it is open to the next slices. With
    ``second``, cavities near to a limit are taken for the other kind.
    """
    solid = _subfields(volume) | np.isin(volume.tissue, (Tissue.HIPPOCAMPUS, Tissue.FISSURE))
    around = digital.box_around(digital.positions(between(solid, volume.affine, ends)[0]))
    solid, sheet = solid[around], tissue[around] > 0
    inner = np.isin(volume.tissue[around], volume.protocol.interior)
    edges = np.linalg.norm(volume.affine[:3, :3], axis=0)
    through = int(np.argmax(np.abs(ends.axis @ volume.affine[:3, :3]) / edges))
    in_slice = digital.FACES & (np.arange(3) == 1).reshape(
        [3 if n == through else 1 for n in range(3)]
    )
    # What cannot leave in three dimensions cannot in its slices.
    enclosed = _cannot_leave(solid, in_slice, through)
    enclosed &= np.isin(volume.tissue[around], (Tissue.BACKGROUND, Tissue.CYST))
    pieces, _ = ndimage.label(enclosed, structure=digital.CUBE)
    most_open = 1.0 if edges[through] > settings.slit_voxel else CAVITY_OPENNESS
    narrow, wide, doubtful = list[Index](), list[Index](), False
    layered = bool((volume.tissue[around] == Tissue.MOLECULAR_LAYER).any())
    for number, part in enumerate(ndimage.find_objects(pieces), 1):
        room = digital.box_around(
            digital.positions(pieces[part] == number) + digital.low_corner(part)
        )
        piece = pieces[room] == number
        ring = digital.widened(piece) & ~piece
        adjacent = ring & solid[room]
        index = digital.positions(piece) + digital.low_corner(around) + digital.low_corner(room)
        index = index[ends.depth(digital.to_ras(index, volume.affine)) > 0]
        if not (len(index) and (adjacent & sheet[room]).any() and (adjacent & inner[room]).any()):
            continue
        opened = (ring & ~solid[room] & ~enclosed[room]).sum() / ring.sum() / most_open
        radius = ndimage.distance_transform_edt(np.pad(piece, 1), sampling=edges).max()
        ratios = np.array([opened, radius / CAVITY_RADIUS])
        near = (ratios > 1 / CAVITY_MARGIN) & (ratios < CAVITY_MARGIN)
        near &= len(index) * float(np.prod(edges)) > DOUBTFUL_CAVITY
        # Without a layer, both kinds are divided alike.
        doubtful |= bool(near[0] or (near[1] and opened <= 1 and layered))
        is_open, is_wide = (ratios > 1) ^ (near & second)
        if not is_open:
            (wide if is_wide else narrow).append(index)
    return Cavities(tuple(narrow), tuple(wide), doubtful)


def _cannot_leave(solid: Bool, structure: Bool, through: int) -> Bool:
    """Free voxels (I, J, K) that no path of neighbors connects to the border across one axis."""
    pieces, _ = ndimage.label(~solid, structure=structure)
    borders = [np.moveaxis(pieces, n, 0)[[0, -1]] for n in range(3) if n != through]
    outside = np.unique(np.concatenate([border.ravel() for border in borders]))
    return np.asarray(~np.isin(pieces, outside) & ~solid)


def fill_cavities(
    volume: LabelVolume, tissue: Tissues, cavities: Cavities, settings: BodySettings
) -> tuple[LabelVolume, Tissues]:
    """Make narrow cavities a part of the layer, where it is labeled, and divide others.

    Cavities between the sheet and its interior belong to the layer. Wider ones, and ones without a
    layer next to them, get the nearest label on either side.
    """
    donors = _subfields(volume)
    narrow = donors
    layer = volume.tissue == Tissue.MOLECULAR_LAYER
    if settings.layer_rule == "nearest-sheet" and layer.any():
        merged = tissue[layer].any()
        narrow = donors & ((tissue > 0) if merged else (tissue == 0))
    for group, candidates in ((cavities.wide, donors), (cavities.narrow, narrow)):
        if group:
            volume, tissue = _like_nearest(volume, tissue, np.concatenate(group), candidates)
    return volume, tissue


def close_mask(tissue: Tissues, allowed: Bool, affine: Float) -> tuple[Tissues, Index]:
    """Dilate and erode the mask by a voxel; what that adds, (N, 3), gets the nearest tissue."""
    donors = tissue > 0
    closed = ndimage.binary_closing(np.pad(donors, 1), structure=digital.CUBE)[1:-1, 1:-1, 1:-1]
    added = digital.positions(closed & allowed & ~donors)
    tissue = tissue.copy()
    tissue[tuple(added.T)] = value_of_nearest(
        tissue[donors], digital.voxel_points(donors, affine), digital.to_ras(added, affine)
    )
    return tissue, added


class Slits(NamedTuple):
    """Narrow gaps in the sheet."""

    tissue: Tissues
    """(I, J, K) tissue with the slits filled."""
    filled: Index
    """(N, 3) indices of voxels that were filled."""
    gap: Index
    """(N, 3) indices of the largest thin gap that was not filled."""


def fill_slits(
    tissue: Tissues, inside: Bool, unlabeled: Bool, affine: Float, settings: BodySettings
) -> Slits:
    """Fill slits through the sheet with the nearest labels.

    A voxel without any label lies in a gap if the sheet is on both sides of it in several
    directions. A slit opens on both sides of the sheet; a crevice between two folds, which opens
    on one side, is left as it is.
    """
    around = digital.box_around(digital.positions(inside))
    sheet = np.pad(tissue[around] > 0, 1)
    # Between the end planes: next to voxels that lie there.
    adjacent = digital.widened(np.pad(inside[around], 1))
    empty = np.pad(unlabeled[around], 1)
    edges = np.linalg.norm(affine[:3, :3], axis=0)
    coarse = edges > settings.slit_voxel
    enclosed = _enclosed(sheet, GAP_DIRECTIONS, coarse)
    pieces, _ = ndimage.label(empty & adjacent & enclosed, structure=digital.CUBE)
    sizes = digital.piece_sizes(pieces)
    small = np.sort(edges)[:2]
    least = settings.slit_area / float(small[0] * small[1])
    through = [
        number
        for number in np.flatnonzero(sizes > least)
        if not coarse.any() and _opens_on_both_sides(pieces == number, sheet, SLIT_OPENINGS)
    ]
    filled = digital.positions(np.isin(pieces, through)) + digital.low_corner(around) - 1
    sizes[through] = 0
    gap = (
        digital.positions((pieces == sizes.argmax()) & (pieces > 0))
        + digital.low_corner(around)
        - 1
    )
    return Slits(_with_nearest(tissue, filled, around), filled, gap)


def fill_pits(
    tissue: Tissues, inside: Bool, unlabeled: Bool, affine: Float, settings: BodySettings
) -> tuple[Tissues, Index]:
    """Fill small pits in the walls with the nearest labels; return them, (N, 3), too.

    A voxel without any label lies in a pit if the sheet is near on most of its six sides. Crevices
    between folds are open on two sides or more, and larger. Small holes through the sheet may be
    filled, too.
    """
    edges = np.linalg.norm(affine[:3, :3], axis=0)
    if edges.max() > settings.slit_voxel:
        return tissue, np.zeros((0, 3), np.intp)
    around = digital.box_around(digital.positions(inside))
    steps = np.maximum(np.rint(PIT_REACH / edges), 1).astype(int)
    room = [(int(n), int(n)) for n in steps + 1]
    sheet = np.pad(tissue[around] > 0, room)
    sides = np.zeros(sheet.shape, dtype=np.int8)
    for axis, count in enumerate(steps):
        for sign in (-1, 1):
            rolled = (np.roll(sheet, sign * n, axis) for n in range(1, count + 1))
            sides += np.logical_or.reduce(list(rolled))
    # Between the end planes: next to voxels that lie there.
    adjacent = digital.widened(np.pad(inside[around], room))
    empty = np.pad(unlabeled[around], room) & ~sheet & adjacent
    pieces, _ = ndimage.label(empty & (sides >= PIT_SIDES), structure=digital.FACES)
    sizes = digital.piece_sizes(pieces) * float(np.prod(edges))
    smallest, largest = PIT_SIZE
    pits = np.flatnonzero((sizes >= smallest) & (sizes <= largest))
    voxels = digital.positions(np.isin(pieces, pits)) + digital.low_corner(around) - steps - 1
    if not len(voxels):
        return tissue, voxels
    donors = digital.positions(tissue[around] > 0) + digital.low_corner(around)
    nearest = value_of_nearest(
        tissue[tuple(donors.T)], digital.to_ras(donors, affine), digital.to_ras(voxels, affine)
    )
    filled = tissue.copy()
    filled[tuple(voxels.T)] = nearest
    return filled, voxels


def _enclosed(sheet: Bool, directions: int, coarse: Bool) -> Bool:
    """Voxels that have the sheet on both sides in at least ``directions`` of 13.

    Steps along a ``coarse`` axis (3,) do not count, and the same share of the others is asked for:
    from one thick slice to the next, a sheet that moves sideways lies on both sides of what is
    next to it.
    """
    steps = [step for step in _DIRECTIONS if not np.any(coarse & (np.array(step) != 0))]
    least = max(round(directions * len(steps) / len(_DIRECTIONS)), 1)
    opposite = np.zeros(sheet.shape, dtype=np.int8)
    for step in steps:
        reverse = tuple(-s for s in step)
        opposite += np.roll(sheet, step, (0, 1, 2)) & np.roll(sheet, reverse, (0, 1, 2))
    return np.asarray(~sheet & (opposite >= least))


def _opens_on_both_sides(piece: Bool, sheet: Bool, least: float) -> bool:
    """Whether what surrounds a gap, outside of the sheet, has two pieces of at least this share."""
    border = digital.widened(piece) & ~sheet & ~piece
    openings, count = ndimage.label(border, structure=digital.CUBE)
    sizes = np.sort(digital.piece_sizes(openings))
    return count > 1 and bool(sizes[-2] >= least * sizes.sum())


def _with_nearest(tissue: Tissues, index: Index, around: digital.Box) -> Tissues:
    """Label voxels (N, 3) with the nearest label within a box."""
    if not len(index):
        return tissue
    nearest = ndimage.distance_transform_edt(
        tissue[around] == 0, return_distances=False, return_indices=True
    )
    low = digital.low_corner(around)
    sources = nearest[:, *(index - low).T].T + low
    filled = tissue.copy()
    filled[tuple(index.T)] = tissue[tuple(sources.T)]
    return filled
