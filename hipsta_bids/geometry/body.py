"""From subfield labels to the hippocampal body: one ribbon between two end planes."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.digital import Box, box_around, low_corner
from hipsta_bids.geometry.ends import EndPlanes, find_end_planes
from hipsta_bids.protocols.load import for_region
from hipsta_bids.protocols.protocol import Tissue, lateral_rank
from hipsta_bids.settings import BodySettings
from hipsta_bids.types import Bool, EditedMask, Flag, Float, LabelVolume

# Cortex beside the hippocampal body: the sheet's way on beyond the subiculum.


def join_cortex(
    volume: LabelVolume, hippocampal: NDArray[np.uint8], region: str
) -> NDArray[np.uint8]:
    """Add the neighboring cortex to the hippocampal sheet, or take it alone."""
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
            f"region {region}: no voxel is labeled {_names(kinds)}; measure the body, or label the "
            "cortex beside it",
            reason="no-cortex-labels",
        )
    kept = hippocampal if region == "extended" else np.zeros_like(hippocampal)
    return np.where(cortex, volume.tissue, kept).astype(np.uint8)


def check_reach(
    points: Float, tissue: NDArray[np.uint8], ends: EndPlanes, settings: BodySettings
) -> None:
    """Refuse cortex that does not reach from one end plane to the other.

    ``points`` The region between the end planes, RAS mm.
    """
    cortex = tissue > Tissue.HIPPOCAMPUS
    below = ends.height(points[cortex], "posterior")
    above = -ends.height(points[cortex], "anterior")
    length = ends.length(points)
    # Levels are as long as a voxel, so that each level with labels has the center of one.
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


def _names(kinds: list[Tissue]) -> str:
    return " or ".join(kind.name for kind in kinds)


# Layers of about one voxel without a label that part the sheet; slits through it are filled.


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
    """
    around = box_around(np.argwhere(inside))
    sheet = np.pad(tissue[around] > 0, 1)
    # Between the end planes: next to voxels that lie there.
    beside = ndimage.binary_dilation(np.pad(inside[around], 1), structure=_ALL)
    empty = np.pad(unlabeled[around], 1)
    pieces, count = ndimage.label(
        empty & beside & _enclosed(sheet, settings.gap_directions), structure=_ALL
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


def _enclosed(sheet: Bool, directions: int) -> Bool:
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


# A body mask that a person corrected takes the place of the labels' own.


@dataclass(frozen=True, kw_only=True)
class MaskChange:
    """What an edited mask changed of the body, in voxels."""

    before: int
    """Voxels of the body as labeled."""
    added: int
    removed: int

    @property
    def share(self) -> float:
        """Changed voxels over those of the body as labeled."""
        return (self.added + self.removed) / max(self.before, 1)


def apply_mask(
    volume: LabelVolume, tissue: NDArray[np.uint8], mask: EditedMask, ends: EndPlanes
) -> tuple[LabelVolume, NDArray[np.uint8], MaskChange]:
    """Make the body between its end planes what an edited mask says it is.

    Voxels outside of the mask lose their label, and voxels of the mask without a sheet label get
    that of the nearest voxel of the mask that has one. Beyond the end planes nothing changes: head
    and tail are those of the labels.
    """
    affine = volume.affine
    index = np.argwhere(mask.inside | (tissue > 0))
    points = index @ affine[:3, :3].T + affine[:3, 3]
    between = (ends.height(points, "posterior") > 0) & (ends.height(points, "anterior") < 0)
    index, points = index[between], points[between]
    old, inside = tissue[tuple(index.T)], mask.inside[tuple(index.T)]
    kept = inside & (old > 0)
    if not kept.any():
        raise GeometryError(
            "the edited mask and the sheet's labels have no voxel in common between the end "
            "planes: check that the mask is of this hemisphere and in the space of the labels",
            reason="edited-mask-elsewhere",
        )
    new = np.where(kept, old, np.uint8(0))
    bare = inside & (old == 0)
    if bare.any():
        _, nearest = cKDTree(points[kept]).query(points[bare])
        new[bare] = old[kept][nearest]
    edited = tissue.copy()
    edited[tuple(index.T)] = new
    labels = np.where(edited == tissue, volume.tissue, edited)
    change = MaskChange(
        before=int(np.count_nonzero(old)),
        added=int(np.count_nonzero(bare)),
        removed=int(np.count_nonzero((old > 0) & ~inside)),
    )
    return replace(volume, tissue=labels), edited, change


def check_mask(
    mask: EditedMask, change: MaskChange, voxel: float, settings: BodySettings
) -> list[Flag]:
    """Flag an edited mask that is coarser than the labels, or differs very much from them.

    ``voxel`` Edge of the labels' voxels in plane, mm.
    """
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


@dataclass(frozen=True, eq=False, kw_only=True)
class Body:
    """The merged ribbon, on the grid of the label image."""

    tissue: NDArray[np.uint8]
    """(I, J, K) tissue of the region's sheet after the layer was given away; 0 elsewhere."""
    hippocampal: NDArray[np.uint8]
    """(I, J, K) the same of the hippocampal sheet, whatever the region."""
    region: str
    """``body``, ``extended`` or ``entorhinal``."""
    interior: Bool
    """(I, J, K) labels known to lie on the interior side (DG, CA4, molecular layer)."""
    affine: Float
    ends: EndPlanes
    layer_voxels: int
    """Voxels of the molecular layer that went to a sheet subfield."""
    inside: Bool
    """(I, J, K) sheet voxels between the end planes."""
    filled: NDArray[np.intp] = field(default_factory=lambda: np.zeros((0, 3), np.intp))
    """(N, 3) indices of voxels in slits through the sheet that were filled."""
    gap: NDArray[np.intp] = field(default_factory=lambda: np.zeros((0, 3), np.intp))
    """(N, 3) indices of the largest thin gap in the labels that was not filled."""
    mask_change: MaskChange | None = None
    """What an edited mask changed; None if there is none."""

    @cached_property
    def lateral(self) -> Float:
        """How lateral each voxel between the end planes lies, (N,), larger is more lateral.

        The rank of its label; in the cortex alone, which may have one label only, minus its
        distance from the medial subfields of the hippocampus, mm.
        """
        if self.region != "entorhinal":
            return lateral_rank(self.tissue[self.inside]).astype(np.float64)
        medial = np.isin(self.hippocampal, (Tissue.PRESUBICULUM, Tissue.SUBICULUM))
        near = cKDTree(_millimetres(medial, self.affine))
        return np.asarray(-near.query(self.inside_points()[1])[0])

    def to_voxels(self, points: Float) -> Float:
        """Voxel indices (..., 3), fractions included, of points (..., 3), RAS mm."""
        inverse = np.linalg.inv(self.affine)
        return np.asarray(points @ inverse[:3, :3].T + inverse[:3, 3])

    def inside_points(self) -> tuple[NDArray[np.intp], Float]:
        """Voxel indices (N, 3) and RAS mm (N, 3) of the sheet between the end planes."""
        return self._inside_points

    @cached_property
    def _inside_points(self) -> tuple[NDArray[np.intp], Float]:
        """Found once: a dozen steps ask for it, and the volume is large."""
        index = np.argwhere(self.inside)
        points = index @ self.affine[:3, :3].T + self.affine[:3, 3]
        index.flags.writeable = False
        points.flags.writeable = False
        return index, points


def extract_body(volume: LabelVolume, settings: BodySettings) -> Body:
    """Merge the sheet's subfields and find where the body begins and ends.

    Merging and the molecular-layer rule: Diers et al. 2023, section 2.1.
    """
    tissue, layer_voxels = _give_away_layer(volume, settings.layer_rule)
    if not tissue.any():
        raise GeometryError(
            "no voxel of the sheet's subfields "
            f"({', '.join(t.name for t in volume.protocol.sheet)}): check the protocol",
            reason="no-sheet-labels",
        )
    ends = find_end_planes(volume, tissue, settings)
    change = None
    if volume.edited_mask is not None:
        volume, tissue, change = apply_mask(volume, tissue, volume.edited_mask, ends)
        # What the mask took away may have turned the long axis.
        ends = find_end_planes(volume, tissue, settings)
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
        gap=slits.gap,
        mask_change=change,
    )


def check_side(body: Body, hemi: str) -> float:
    """Check that the subiculum lies towards the midline for the hemisphere that the file claims.

    In subjects that lie feet first or on their side it may not; then the handedness decides, which
    no rotation changes.

    Returns How far the medial subfields lie medially of the lateral ones, mm.
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
    if offset < -1.0 and not _has_handedness(
        body, points[medial].mean(axis=0), points[lateral].mean(axis=0), hemi
    ):
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

    Seen along the long axis, the way from the subiculum over CA1 to the interior labels turns one
    way on the left and the other way on the right.
    """
    _, points = _between(body.interior & (body.tissue == 0), body.affine, body.ends)
    if not len(points):
        return False
    first, second = ca1 - subiculum, points.mean(axis=0) - subiculum
    turn = float(body.ends.axis @ np.cross(first, second))
    turn /= float(np.linalg.norm(first) * np.linalg.norm(second))
    # The sine of the angle is 0.18 to 0.50 in twelve real bodies.
    return (turn if hemi == "L" else -turn) > 0.05  # noqa: PLR2004


def _give_away_layer(volume: LabelVolume, rule: str) -> tuple[NDArray[np.uint8], int]:
    """Give each molecular-layer voxel to the nearest subfield (distances in mm)."""
    protocol = volume.protocol
    tissue = np.where(np.isin(volume.tissue, protocol.sheet), volume.tissue, 0).astype(np.uint8)
    layer = np.isin(volume.tissue, protocol.layer)
    if not layer.any() or not tissue.any():
        return tissue, 0
    takers = tissue.copy()
    if rule == "nearest-label":
        rivals = [t for t in protocol.interior if t not in protocol.layer]
        takers[np.isin(volume.tissue, rivals)] = Tissue.OTHER
    rim = _touching(takers > 0)
    _, nearest = cKDTree(_millimetres(rim, volume.affine)).query(_millimetres(layer, volume.affine))
    given = takers[rim][nearest]
    tissue[layer] = np.where(given == Tissue.OTHER, 0, given)
    return tissue, int(np.count_nonzero(tissue[layer]))


def _touching(mask: Bool) -> Bool:
    """Voxels of a mask with a face neighbor outside it: the nearest voxel is always one."""
    deep = np.zeros_like(mask)
    deep[1:-1, 1:-1, 1:-1] = (
        mask[:-2, 1:-1, 1:-1]
        & mask[2:, 1:-1, 1:-1]
        & mask[1:-1, :-2, 1:-1]
        & mask[1:-1, 2:, 1:-1]
        & mask[1:-1, 1:-1, :-2]
        & mask[1:-1, 1:-1, 2:]
    )
    return mask & ~deep


def _between(mask: Bool, affine: Float, ends: EndPlanes) -> tuple[Bool, Float]:
    """Part of a mask between the end planes, (I, J, K), and its voxels in RAS mm, (N, 3)."""
    index = np.argwhere(mask)
    points = index @ affine[:3, :3].T + affine[:3, 3]
    between = (ends.height(points, "posterior") > 0) & (ends.height(points, "anterior") < 0)
    inside = np.zeros(mask.shape, dtype=bool)
    inside[tuple(index[between].T)] = True
    return inside, points[between]


def _millimetres(mask: Bool, affine: Float) -> Float:
    points: Float = np.argwhere(mask) @ affine[:3, :3].T + affine[:3, 3]
    return points
