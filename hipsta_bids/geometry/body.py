"""From subfield labels to the hippocampal body: one ribbon between two end planes.

The sheet's subfields are merged, with the molecular layer where the protocol says so. A mask that a
person corrected replaces them where there is one, the cortex beside the body is added on request,
and slits of about one voxel through the sheet are filled.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage.segmentation import watershed

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.digital import (
    ALL,
    FACES,
    Box,
    box,
    box_around,
    low_corner,
    piece_sizes,
    to_ras,
    voxel_points,
)
from hipsta_bids.geometry.ends import EndPlanes, find_end_planes
from hipsta_bids.protocols.load import for_region
from hipsta_bids.protocols.protocol import Tissue, lateral_rank
from hipsta_bids.settings import BodySettings
from hipsta_bids.types import Bool, EditedMask, Flag, Float, LabelVolume

Index = NDArray[np.intp]
Tissues = NDArray[np.uint8]

_TIES = 8
"""Nearest voxels that may be equally near: the corners of a cube."""
_NEAR = 8
"""Voxels beyond others within which their nearest donors lie."""
_DIRECTIONS = [step for step in product((-1, 0, 1), repeat=3) if step > (0, 0, 0)]
"""One of each two opposite directions to the 26 neighbors."""


@dataclass(frozen=True, kw_only=True)
class MaskChange:
    """What an edited mask changed of the body."""

    before: int
    """Voxels of the body as labeled."""
    added: int
    """Voxels that the mask added."""
    removed: int
    """Voxels that the mask removed."""

    @property
    def share(self) -> float:
        """Changed voxels over those of the body as labeled."""
        return (self.added + self.removed) / max(self.before, 1)


class Cavities(NamedTuple):
    """Voxels (N, 3) without a label that the hippocampus encloses, between the end planes."""

    narrow: tuple[Index, ...] = ()
    """Cavities that may be a part of the molecular layer."""
    wide: tuple[Index, ...] = ()
    """Cavities that are too wide for that."""

    @property
    def all(self) -> Index:
        """All voxels of all cavities."""
        return np.concatenate([np.zeros((0, 3), np.intp), *self.narrow, *self.wide])


@dataclass(frozen=True, eq=False, kw_only=True)
class Body:
    """The merged ribbon, on the grid of the label image."""

    tissue: Tissues
    """(I, J, K) tissue of the region's sheet, with the molecular layer; 0 elsewhere."""
    hippocampal: Tissues
    """(I, J, K) tissue of the hippocampal sheet, whatever the region; 0 elsewhere."""
    region: str
    """``body``, ``extended`` or ``entorhinal``."""
    interior: Bool
    """(I, J, K) labels known to lie on the interior side (DG, CA4, molecular layer)."""
    affine: Float
    """(4, 4), voxel index to RAS mm."""
    ends: EndPlanes
    """Planes between which the body lies."""
    layer_voxels: int
    """Voxels of the molecular layer that were merged with a subfield of the sheet."""
    inside: Bool
    """(I, J, K) sheet voxels between the end planes."""
    filled: Index = field(default_factory=lambda: np.zeros((0, 3), np.intp))
    """(N, 3) indices of voxels in slits through the sheet that were filled."""
    cavities: Cavities = field(default_factory=Cavities)
    """Cavities between the end planes that were filled."""
    uncus: Index = field(default_factory=lambda: np.zeros((0, 3), np.intp))
    """(N, 3) indices of voxels of the uncus, which are no part of the sheet."""
    handed_over: int = 0
    """Head or tail voxels between the planes that got the subfield of a neighbor."""
    gap: Index = field(default_factory=lambda: np.zeros((0, 3), np.intp))
    """(N, 3) indices of the largest thin gap in the labels that was not filled."""
    mask_change: MaskChange | None = None
    """What an edited mask changed; None without a mask."""

    @cached_property
    def lateral(self) -> Float:
        """How lateral each voxel between the end planes lies, (N,), larger is more lateral.

        The rank of its label; in the cortex alone, which may have one label only, minus its
        distance from the medial subfields of the hippocampus, mm.
        """
        if self.region != "entorhinal":
            return lateral_rank(self.tissue[self.inside]).astype(np.float64)
        medial = np.isin(self.hippocampal, (Tissue.PRESUBICULUM, Tissue.SUBICULUM))
        near = cKDTree(voxel_points(medial, self.affine))
        return np.asarray(-near.query(self.inside_points()[1])[0])

    def to_voxels(self, points: Float) -> Float:
        """Voxel indices (..., 3), fractions included, of points (..., 3), RAS mm."""
        return to_ras(points, np.linalg.inv(self.affine))

    def inside_points(self) -> tuple[Index, Float]:
        """Voxel indices (N, 3) and RAS mm (N, 3) of the sheet between the end planes."""
        return self._inside_points

    @cached_property
    def _inside_points(self) -> tuple[Index, Float]:
        """Cached: a dozen steps ask for it, and the volume is large."""
        index = np.argwhere(self.inside)
        points = to_ras(index, self.affine)
        index.flags.writeable = False
        points.flags.writeable = False
        return index, points


def extract_body(volume: LabelVolume, settings: BodySettings) -> Body:
    """Merge the sheet's subfields and find where the body begins and ends.

    Merging and the molecular-layer rule: Diers et al. 2023, section 2.1.
    """
    tissue, layer_voxels = _merge_layer(volume, settings)
    if not tissue.any():
        raise GeometryError(
            "no voxel of the sheet's subfields "
            f"({', '.join(t.name for t in volume.protocol.sheet)}): check the protocol",
            reason="no-sheet-labels",
        )
    ends = find_end_planes(volume, tissue, settings)
    volume, tissue, handed_over = _hand_over(volume, tissue, ends, settings.plane_reach)
    cavities = find_cavities(volume, tissue, ends, settings)
    volume, tissue = _fill_cavities(volume, tissue, cavities, settings)
    change = None
    if volume.edited_mask is not None:
        volume, tissue, change = _apply_mask(volume, tissue, volume.edited_mask, ends)
        # What the mask removed may have changed the long axis.
        ends = find_end_planes(volume, tissue, settings)
    uncus = find_uncus(tissue, volume.affine, ends, settings)
    tissue = tissue.copy()
    tissue[tuple(uncus.T)] = 0
    hippocampal, region = tissue, settings.region
    if region != "body":
        tissue = join_cortex(volume, hippocampal, region)
    inside, points = _between(tissue > 0, volume.affine, ends)
    length = ends.length(points) if len(points) else 0.0
    if length < settings.min_length:
        raise GeometryError(
            f"the body is {length:.1f} mm long, {settings.min_length:g} mm are needed: "
            "check the head and tail labels",
            reason="body-too-short",
        )
    if region != "body":
        check_reach(points, tissue[inside], ends, settings)
    slits = fill_slits(tissue, inside, volume.tissue == Tissue.BACKGROUND, volume.affine, settings)
    if len(slits.filled):
        inside, _ = _between(slits.tissue > 0, volume.affine, ends)
    return Body(
        tissue=slits.tissue,
        hippocampal=hippocampal,
        region=region,
        interior=np.isin(volume.tissue, volume.protocol.interior),
        affine=volume.affine,
        ends=ends,
        layer_voxels=layer_voxels,
        inside=inside,
        filled=slits.filled,
        cavities=cavities,
        uncus=uncus,
        handed_over=handed_over,
        gap=slits.gap,
        mask_change=change,
    )


def check_side(body: Body, hemi: str) -> float:
    """Refuse a body of the other side; return how far its medial subfields lie medially, mm.

    In subjects that lie feet first or on their side the subiculum may lie away from the midline;
    then the handedness decides, which no rotation changes.
    """
    inside, points = body.inside, body.inside_points()[1]
    if body.region != "body":
        inside, points = _between(body.hippocampal > 0, body.affine, body.ends)
    values = body.hippocampal[inside]
    medial = np.isin(values, (Tissue.PRESUBICULUM, Tissue.SUBICULUM))
    lateral = values == Tissue.CA1
    if not (medial.any() and lateral.any()):
        return float("nan")
    offset = points[medial, 0].mean() - points[lateral, 0].mean()
    offset = float(offset if hemi == "L" else -offset)
    # Six real bodies show 4-8 mm; one millimeter leaves room for a rotated head.
    centers = points[medial].mean(axis=0), points[lateral].mean(axis=0)
    if offset < -1.0 and not _has_handedness(body, *centers, hemi):
        side = {"L": "left", "R": "right"}
        other = side["R" if hemi == "L" else "L"]
        raise GeometryError(
            f"labeled {side[hemi]}, but the subiculum lies {-offset:.1f} mm lateral of CA1 as in "
            f"a {other} hemisphere: check the image's affine and which file is which",
            reason="left-right-swapped",
        )
    return offset


def _has_handedness(body: Body, subiculum: Float, ca1: Float, hemi: str) -> bool:
    """Say whether the body is certainly of the claimed side, wherever the subject lies.

    Seen along the long axis, the path from the subiculum over CA1 to the interior labels bends in
    opposite directions on the left and on the right.
    """
    _, points = _between(body.interior & (body.tissue == 0), body.affine, body.ends)
    if not len(points):
        return False
    first, second = ca1 - subiculum, points.mean(axis=0) - subiculum
    turn = float(body.ends.axis @ np.cross(first, second))
    turn /= float(np.linalg.norm(first) * np.linalg.norm(second))
    # The sine of the angle is 0.18 to 0.50 in twelve real bodies.
    return (turn if hemi == "L" else -turn) > 0.05  # noqa: PLR2004


def _merge_layer(volume: LabelVolume, settings: BodySettings) -> tuple[Tissues, int]:
    """Assign each molecular-layer voxel to the nearest subfield (distances in mm), and count them.

    By the rule ``nearest-label`` voxels nearer to another interior label are left out. A layer that
    the protocol does not list is left out as a whole, unless the settings ask for it.
    """
    protocol = volume.protocol
    kinds = {*protocol.layer, *((Tissue.MOLECULAR_LAYER,) if settings.join_every_layer else ())}
    tissue = np.where(np.isin(volume.tissue, protocol.sheet), volume.tissue, 0).astype(np.uint8)
    layer = np.isin(volume.tissue, list(kinds))
    if not layer.any() or not tissue.any():
        return tissue, 0
    candidates = tissue.copy()
    if settings.layer_rule == "nearest-label":
        rivals = [t for t in protocol.interior if t not in kinds]
        candidates[np.isin(volume.tissue, rivals)] = Tissue.OTHER
    # The nearest voxel always has a face neighbor outside.
    border = (candidates > 0) & ~ndimage.binary_erosion(candidates > 0, structure=FACES)
    nearest = _value_of_nearest(
        candidates[border],
        voxel_points(border, volume.affine),
        voxel_points(layer, volume.affine),
    )
    tissue[layer] = np.where(nearest == Tissue.OTHER, 0, nearest)
    return tissue, int(np.count_nonzero(tissue[layer]))


def _value_of_nearest(values: NDArray[np.integer], points: Float, at: Float) -> Index:
    """Value of the nearest of points (N, 3) at others (M, 3); the smallest if some are tied.

    So the way in which voxels are stored decides nothing.
    """
    found = cKDTree(points).query(at, k=_TIES)
    distance, index = (np.asarray(part) for part in found)
    tied = distance < distance[:, :1] + 1e-6
    most = np.iinfo(np.intp).max  # also for fewer points than asked
    ranked = np.append(values.astype(np.intp), most)[index]
    return np.asarray(np.where(tied, ranked, most).min(axis=1))


def find_uncus(tissue: Tissues, affine: Float, ends: EndPlanes, settings: BodySettings) -> Index:
    """Find voxels (N, 3) of the uncus, which the head bends back to beside the body.

    It shows as a second piece of CA2 or CA3 that reaches the anterior plane far medially of the
    first. The part of CA1 that is nearer to it than to the rest, on the way through the sheet, goes
    with it.
    """
    lateral = np.isin(tissue, (Tissue.CA2, Tissue.CA2_3, Tissue.CA3))
    medial = np.isin(tissue, (Tissue.PRESUBICULUM, Tissue.SUBICULUM))
    none = np.zeros((0, 3), np.intp)
    pieces, count = ndimage.label(_between(lateral, affine, ends)[0], structure=ALL)
    if count < 2 or not medial.any():  # noqa: PLR2004 -- the body's own is the first
        return none
    main = to_ras(np.argwhere(pieces == piece_sizes(pieces).argmax()), affine)
    towards = voxel_points(medial, affine).mean(axis=0) - voxel_points(lateral, affine).mean(axis=0)
    towards -= (towards @ ends.axis) * ends.axis
    towards /= np.linalg.norm(towards)
    found = np.zeros(tissue.shape, dtype=bool)
    depth = 0.0
    for number in np.flatnonzero(piece_sizes(pieces) * abs(np.linalg.det(affine[:3, :3])) > 1.0):
        points = to_ras(np.argwhere(pieces == number), affine)
        inside = -ends.height(points, "anterior")
        beside = main[-ends.height(main, "anterior") < inside.max() + ends.half_slice]
        aside = points.mean(axis=0) - (beside if len(beside) else main).mean(axis=0)
        if inside.min() < 3 * ends.half_slice and aside @ towards > settings.uncus_offset:
            found |= pieces == number
            depth = max(depth, float(inside.max()))
    if not found.any():
        return none
    near, _ = _between(tissue > 0, affine, ends.beyond(1.0))
    index = np.argwhere(near)
    height = -ends.height(to_ras(index, affine), "anterior")
    near[tuple(index[height > depth + 1.0].T)] = False
    markers = np.where(found, 1, np.where((lateral | medial) & near, 2, 0))
    around = box_around(np.argwhere(near))
    flat = np.zeros(markers[around].shape, np.uint8)
    basins = watershed(flat, markers[around], ALL, mask=near[around])  # type: ignore[no-untyped-call]
    return np.argwhere(basins == 1) + low_corner(around)


def _like_nearest(
    volume: LabelVolume, tissue: Tissues, where: Index, donors: Bool
) -> tuple[LabelVolume, Tissues]:
    """Give voxels (N, 3) the label and the part of the sheet that the nearest donor has."""
    around = box(np.maximum(where.min(axis=0) - _NEAR, 0), where.max(axis=0) + _NEAR + 1)
    index = np.argwhere(donors[around]) + low_corner(around)
    pairs = volume.tissue.astype(np.intp) * 256 + tissue
    nearest = _value_of_nearest(
        pairs[tuple(index.T)], to_ras(index, volume.affine), to_ras(where, volume.affine)
    )
    at = tuple(where.T)
    labels, sheet = volume.tissue.copy(), tissue.copy()
    labels[at], sheet[at] = np.divmod(nearest, 256)
    return replace(volume, tissue=labels), sheet


def _subfields(volume: LabelVolume) -> Bool:
    """Voxels of the sheet, of its layer, and of what lies on its interior side."""
    protocol = volume.protocol
    return np.isin(volume.tissue, (*protocol.sheet, *protocol.layer, *protocol.interior))


def _hand_over(
    volume: LabelVolume, tissue: Tissues, ends: EndPlanes, reach: float
) -> tuple[LabelVolume, Tissues, int]:
    """Give head and tail voxels up to a distance inside the planes the label of a neighbor.

    No plane separates labels perfectly; left out, these voxels would be holes in the sheet.
    """
    index = np.argwhere(volume.tissue == Tissue.HIPPOCAMPUS)
    depth = ends.depth(to_ras(index, volume.affine))
    where = index[(depth > 0) & (depth < reach)]
    if not len(where):
        return volume, tissue, 0
    volume, tissue = _like_nearest(volume, tissue, where, _subfields(volume))
    return volume, tissue, len(where)


def find_cavities(
    volume: LabelVolume, tissue: Tissues, ends: EndPlanes, settings: BodySettings
) -> Cavities:
    """Find what is unlabeled but enclosed by the sheet, its layer and its interior.

    Vessels, cysts and strata that were left out make the inner wall jump across them. A cavity is
    enclosed in three dimensions, or in a slice if little of it is open to the next slices.
    """
    solid = _subfields(volume) | np.isin(volume.tissue, (Tissue.HIPPOCAMPUS, Tissue.FISSURE))
    around = box_around(np.argwhere(_between(solid, volume.affine, ends)[0]))
    solid, sheet = solid[around], tissue[around] > 0
    inner = np.isin(volume.tissue[around], volume.protocol.interior)
    edges = np.linalg.norm(volume.affine[:3, :3], axis=0)
    through = int(np.argmax(np.abs(ends.axis @ volume.affine[:3, :3]) / edges))
    in_slice = FACES & (np.arange(3) == 1).reshape([3 if n == through else 1 for n in range(3)])
    # What cannot leave in three dimensions cannot in its slices.
    enclosed = _cannot_leave(solid, in_slice, through)
    enclosed &= np.isin(volume.tissue[around], (Tissue.BACKGROUND, Tissue.CYST))
    pieces, _ = ndimage.label(enclosed, structure=ALL)
    most_open = 1.0 if edges[through] > settings.slit_voxel else settings.cavity_openness
    narrow, wide = list[Index](), list[Index]()
    for number, part in enumerate(ndimage.find_objects(pieces), 1):
        room = box_around(np.argwhere(pieces[part] == number) + low_corner(part))
        piece = pieces[room] == number
        ring = ndimage.binary_dilation(piece, structure=ALL) & ~piece
        is_open = (ring & ~solid[room] & ~enclosed[room]).sum() > most_open * ring.sum()
        beside = ring & solid[room]
        index = np.argwhere(piece) + low_corner(around) + low_corner(room)
        index = index[ends.depth(to_ras(index, volume.affine)) > 0]
        if not len(index) or is_open or not (beside & sheet[room]).any():
            continue
        if (beside & inner[room]).any():
            radius = ndimage.distance_transform_edt(np.pad(piece, 1), sampling=edges).max()
            is_wide = float(radius) > settings.cavity_radius
            (wide if is_wide else narrow).append(index)
    return Cavities(tuple(narrow), tuple(wide))


def _cannot_leave(solid: Bool, structure: Bool, through: int) -> Bool:
    """Free voxels (I, J, K) that no path of neighbors connects to the border across one axis."""
    pieces, _ = ndimage.label(~solid, structure=structure)
    borders = [np.moveaxis(pieces, n, 0)[[0, -1]] for n in range(3) if n != through]
    outside = np.unique(np.concatenate([border.ravel() for border in borders]))
    return np.asarray(~np.isin(pieces, outside) & ~solid)


def _fill_cavities(
    volume: LabelVolume, tissue: Tissues, cavities: Cavities, settings: BodySettings
) -> tuple[LabelVolume, Tissues]:
    """Make narrow cavities a part of the layer, where it is labeled, and divide others.

    What lies between the sheet and its interior is the layer in the first place. What is too wide
    for that, or has no layer beside it, goes to the nearest label on either side.
    """
    donors = _subfields(volume)
    narrow = donors
    layer = volume.tissue == Tissue.MOLECULAR_LAYER
    if settings.layer_rule == "nearest-sheet" and layer.any():
        merged = tissue[layer].any()
        narrow = donors & ((tissue > 0) if merged else (tissue == 0))
    for group, chosen in ((cavities.wide, donors), (cavities.narrow, narrow)):
        if group:
            volume, tissue = _like_nearest(volume, tissue, np.concatenate(group), chosen)
    return volume, tissue


def _between(mask: Bool, affine: Float, ends: EndPlanes) -> tuple[Bool, Float]:
    """Part of a mask between the end planes, (I, J, K), and its voxels in RAS mm, (N, 3)."""
    index = np.argwhere(mask)
    points = to_ras(index, affine)
    between = ends.depth(points) > 0
    inside = np.zeros(mask.shape, dtype=bool)
    inside[tuple(index[between].T)] = True
    return inside, points[between]


def join_cortex(volume: LabelVolume, hippocampal: Tissues, region: str) -> Tissues:
    """Add the neighboring cortex to the hippocampal sheet, or return it alone."""
    kinds = [t for t in for_region(volume.protocol, region).sheet if t in volume.protocol.neighbors]
    if volume.edited_mask is not None:
        raise GeometryError(
            f"region {region}: an edited mask is about the body, not about the cortex beside it; "
            "edit the labels instead (desc-edited_dseg)",
            reason="edited-mask-region",
        )
    cortex = np.isin(volume.tissue, kinds)
    if not cortex.any():
        raise GeometryError(
            f"region {region}: no voxel is labeled {' or '.join(kind.name for kind in kinds)}; "
            "measure the body, or label the cortex beside it",
            reason="no-cortex-labels",
        )
    kept = hippocampal if region == "extended" else np.zeros_like(hippocampal)
    return np.where(cortex, volume.tissue, kept).astype(np.uint8)


def check_reach(points: Float, tissue: Tissues, ends: EndPlanes, settings: BodySettings) -> None:
    """Refuse cortex, among points (N, 3) of a region, that does not reach from end to end."""
    cortex = tissue > Tissue.HIPPOCAMPUS
    below = ends.height(points[cortex], "posterior")
    above = -ends.height(points[cortex], "anterior")
    length = ends.length(points)
    # Levels are as long as a voxel, so that each level with labels holds a center of one.
    count = max(int(length / (2 * ends.half_slice)), 1)
    level = np.minimum((count * below / (below + above)).astype(int), count - 1)
    share = len(np.unique(level)) / count
    if share < settings.min_cortex_reach:
        raise GeometryError(
            f"region {settings.region}: the cortex is labeled along {share * length:.1f} mm of the "
            f"{length:.1f} mm between the end planes: measure the body, or label the cortex beside "
            "all of it",
            reason="cortex-incomplete",
        )


def _apply_mask(
    volume: LabelVolume, tissue: Tissues, mask: EditedMask, ends: EndPlanes
) -> tuple[LabelVolume, Tissues, MaskChange]:
    """Replace the body between its end planes by an edited mask.

    Voxels outside of the mask lose their label, and voxels of the mask without a sheet label get
    that of the nearest voxel of the mask that has one. Beyond the end planes nothing changes.
    """
    between, points = _between(mask.inside | (tissue > 0), volume.affine, ends)
    index = np.argwhere(between)
    old, inside = tissue[tuple(index.T)], mask.inside[tuple(index.T)]
    kept = inside & (old > 0)
    if not kept.any():
        raise GeometryError(
            "the edited mask and the sheet's labels have no voxel in common between the end "
            "planes: check that the mask is of this hemisphere and in the space of the labels",
            reason="edited-mask-elsewhere",
        )
    new = np.where(kept, old, np.uint8(0))
    added = inside & (old == 0)
    if added.any():
        new[added] = old[kept][cKDTree(points[kept]).query(points[added])[1]]
    edited = tissue.copy()
    edited[tuple(index.T)] = new
    labels = np.where(edited == tissue, volume.tissue, edited)
    change = MaskChange(
        before=int(np.count_nonzero(old)),
        added=int(np.count_nonzero(added)),
        removed=int(np.count_nonzero((old > 0) & ~inside)),
    )
    return replace(volume, tissue=labels), edited, change


def check_mask(
    mask: EditedMask, change: MaskChange, voxel: float, settings: BodySettings
) -> list[Flag]:
    """Flag an edited mask that is coarser than the labels' voxels (mm), or differs much."""
    flags = []
    if mask.voxel > settings.max_mask_ratio * voxel:
        coarse = (
            f"the edited mask has voxels of {mask.voxel:.2f} mm, the labels of {voxel:.2f} mm: "
            "draw it on the grid of the labels"
        )
        flags.append(Flag(reason="edited-mask-coarse", message=coarse))
    if change.share > settings.max_mask_change:
        different = (
            f"the edited mask adds {change.added} voxels to the body and removes {change.removed} "
            f"of {change.before}: check that it is in the space of the labels"
        )
        flags.append(Flag(reason="edited-mask-different", message=different))
    return flags


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
    around = box_around(np.argwhere(inside))
    sheet = np.pad(tissue[around] > 0, 1)
    # Between the end planes: next to voxels that lie there.
    beside = ndimage.binary_dilation(np.pad(inside[around], 1), structure=ALL)
    empty = np.pad(unlabeled[around], 1)
    enclosed = _enclosed(sheet, settings.gap_directions)
    pieces, _ = ndimage.label(empty & beside & enclosed, structure=ALL)
    sizes = piece_sizes(pieces)
    edges = np.sort(np.linalg.norm(affine[:3, :3], axis=0))
    least = settings.slit_area / float(edges[0] * edges[1])
    through = [
        number
        for number in np.flatnonzero(sizes > least)
        if edges[2] <= settings.slit_voxel
        and _opens_on_both_sides(pieces == number, sheet, settings.slit_openings)
    ]
    filled = np.argwhere(np.isin(pieces, through)) + low_corner(around) - 1
    sizes[through] = 0
    gap = np.argwhere((pieces == sizes.argmax()) & (pieces > 0)) + low_corner(around) - 1
    return Slits(_with_nearest(tissue, filled, around), filled, gap)


def _enclosed(sheet: Bool, directions: int) -> Bool:
    """Voxels that have the sheet on both sides in at least ``directions`` of 13."""
    opposite = np.zeros(sheet.shape, dtype=np.int8)
    for step in _DIRECTIONS:
        back = tuple(-s for s in step)
        opposite += np.roll(sheet, step, (0, 1, 2)) & np.roll(sheet, back, (0, 1, 2))
    return np.asarray(~sheet & (opposite >= directions))


def _opens_on_both_sides(piece: Bool, sheet: Bool, least: float) -> bool:
    """Whether what surrounds a gap, outside of the sheet, has two pieces of at least this share."""
    border = ndimage.binary_dilation(piece, structure=ALL) & ~sheet & ~piece
    openings, count = ndimage.label(border, structure=ALL)
    sizes = np.sort(piece_sizes(openings))
    return count > 1 and bool(sizes[-2] >= least * sizes.sum())


def _with_nearest(tissue: Tissues, index: Index, around: Box) -> Tissues:
    """Label voxels (N, 3) with the nearest label within a box."""
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
