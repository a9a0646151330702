"""From subfield labels to the hippocampal body: one ribbon between two end planes.

The sheet's subfields are merged, with the molecular layer where the protocol says so. A mask that a
person corrected replaces them where there is one, the cortex next to the body is added on request,
and what the labels lack or have too much is mended (``completion``).
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry import completion, digital
from hipsta_bids.geometry.ends import EndPlanes, find_end_planes
from hipsta_bids.geometry.shares import SheetShare, sheet_share
from hipsta_bids.protocols.load import for_region
from hipsta_bids.protocols.protocol import MEDIAL_END, Tissue, lateral_rank
from hipsta_bids.settings import BodySettings
from hipsta_bids.types import Bool, EditedMask, End, Finding, Float, LabelVolume

_END_REACH = 4.0  # mm behind an end plane over which the body's direction is taken
_LAST_VOXEL = 3.0  # mm from an end plane to the voxel of the sheet that is nearest to it

#: Sign of heights over an end plane that points to the other one.
_SIGNS: dict[End, float] = {"posterior": 1.0, "anterior": -1.0}
_LEAST_SLOPE = 0.34  # cosine of 70 degrees


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
        """Changed voxels over the voxels of the body as labeled."""
        return (self.added + self.removed) / max(self.before, 1)


@dataclass(frozen=True, eq=False, kw_only=True)
class Body:
    """The merged ribbon, on the grid of the label image."""

    tissue: completion.Tissues
    """(I, J, K) tissue of the region's sheet, with the molecular layer; 0 elsewhere."""
    hippocampal: completion.Tissues
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
    filled: completion.Index = field(default_factory=lambda: np.zeros((0, 3), np.intp))
    """(N, 3) indices of voxels in slits through the sheet that were filled."""
    cavities: completion.Cavities = field(default_factory=completion.Cavities)
    """Cavities between the end planes that were filled."""
    uncus: completion.Index = field(default_factory=lambda: np.zeros((0, 3), np.intp))
    """(N, 3) indices of voxels of the uncus, which are no part of the sheet."""
    handed_over: int = 0
    """Head or tail voxels between the planes that got the subfield of a neighbor."""
    gap: completion.Index = field(default_factory=lambda: np.zeros((0, 3), np.intp))
    """(N, 3) indices of the largest thin gap in the labels that was not filled."""
    mask_change: MaskChange | None = None
    """What an edited mask changed; None without a mask."""
    soft: SheetShare | None = None
    """Share of the sheet in each voxel; None without probabilities."""

    @cached_property
    def lateral(self) -> Float:
        """How lateral each voxel between the end planes lies, (N,), larger is more lateral.

        The rank of its label; in the cortex alone, which may have one label only, minus its
        distance from the medial subfields of the hippocampus, mm.
        """
        if self.region != "entorhinal":
            return lateral_rank(self.tissue[self.inside]).astype(np.float64)
        medial = np.isin(self.hippocampal, MEDIAL_END)
        near = cKDTree(digital.voxel_points(medial, self.affine))
        return np.asarray(-near.query(self.inside_points()[1])[0])

    @cached_property
    def voxel_volume(self) -> float:
        """Volume of a voxel, mm3."""
        return abs(float(np.linalg.det(self.affine[:3, :3])))

    @cached_property
    def outward(self) -> dict[End, Float]:
        """Unit vectors (3,) along which the body leaves its two end planes."""
        index, points = self.inside_points()
        around = digital.box_around(index)
        pieces, _ = ndimage.label(self.inside[around], structure=digital.CUBE)
        number = pieces[tuple((index - digital.low_corner(around)).T)]
        ends, directions = self.ends, dict[End, Float]()
        for end, sign in _SIGNS.items():
            depth = sign * ends.height(points, end)
            last = depth < min(_END_REACH, float(depth.max()))
            last &= number == np.bincount(number[last]).argmax()  # without an uncus next to it
            # The slope of least squares of position on depth; weights fall to zero at the reach,
            # so that no slice enters or leaves as a whole.
            near, weight = points[last], _END_REACH - depth[last]
            middle = np.average(depth[last], weights=weight)
            step = -(weight * (depth[last] - middle)) @ (near - near.mean(axis=0))
            step /= max(float(np.linalg.norm(step)), 1e-9)
            # Nearly along the plane, or of a single slice, it says nothing.
            along = -sign * (step @ ends[end].normal) > _LEAST_SLOPE
            directions[end] = step if along else -sign * ends.axis
        return directions

    def to_voxels(self, points: Float) -> Float:
        """Voxel indices (..., 3), fractions included, of points (..., 3), RAS mm."""
        return digital.to_ras(points, np.linalg.inv(self.affine))

    def inside_points(self) -> tuple[completion.Index, Float]:
        """Voxel indices (N, 3) and RAS mm (N, 3) of the sheet between the end planes."""
        return self._inside_points

    def nearest(self, points: Float, count: int = 1) -> completion.Index:
        """Numbers (M,), or (M, count), of the inside points that are nearest to points (M, 3)."""
        return np.asarray(self._tree.query(points, k=count)[1])

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.inside_points()[1])

    @cached_property
    def _inside_points(self) -> tuple[completion.Index, Float]:
        """Cached: a dozen steps ask for it, and the volume is large."""
        index = digital.positions(self.inside)
        points = digital.to_ras(index, self.affine)
        index.flags.writeable = False
        points.flags.writeable = False
        return index, points


def extract_body(volume: LabelVolume, settings: BodySettings, *, second: bool = False) -> Body:
    """Merge the sheet's subfields and find where the body begins and ends.

    With ``second``, doubtful cavities are taken for the other kind. Merging and the molecular-layer
    rule: Diers et al. 2023, section 2.1.
    """
    labels = volume
    tissue, layer_voxels = _merge_layer(volume, settings)
    if not tissue.any():
        raise GeometryError(
            "no voxel of the sheet's subfields "
            f"({', '.join(t.name for t in volume.protocol.sheet)}): check the protocol",
            reason="no-sheet-labels",
        )
    ends = find_end_planes(volume, tissue, settings)
    volume, tissue, handed_over = completion.hand_over(volume, tissue, ends, settings.plane_reach)
    cavities = completion.Cavities()
    if settings.mending == "gaps":
        cavities = completion.find_cavities(volume, tissue, ends, settings, second=second)
    volume, tissue = completion.fill_cavities(volume, tissue, cavities, settings)
    change = None
    if volume.edited_mask is not None:
        volume, tissue, change = _apply_mask(volume, tissue, volume.edited_mask, ends)
        # What the mask removed may have changed the long axis.
        ends = find_end_planes(volume, tissue, settings)
    uncus = completion.find_uncus(tissue, volume.affine, ends)
    tissue = tissue.copy()
    tissue[tuple(uncus.T)] = 0
    hippocampal, region = tissue, settings.region
    if region != "body":
        tissue = join_cortex(volume, hippocampal, region)
    inside, points = completion.between(tissue > 0, volume.affine, ends)
    length = ends.length(points) if len(points) else 0.0
    if length < settings.min_length:
        raise GeometryError(
            f"the body is {length:.1f} mm long, {settings.min_length:g} mm are needed: "
            "check the head and tail labels",
            reason="body-too-short",
        )
    if region != "body":
        check_reach(points, tissue[inside], ends, settings)
    _check_ends_reached(points, ends)
    tissue, added, gap = _mend(volume, tissue, inside, settings)
    if len(added):
        inside, _ = completion.between(tissue > 0, volume.affine, ends)
    return Body(
        tissue=tissue,
        hippocampal=hippocampal,
        region=region,
        interior=np.isin(volume.tissue, volume.protocol.interior),
        affine=volume.affine,
        ends=ends,
        layer_voxels=layer_voxels,
        inside=inside,
        filled=added,
        cavities=cavities,
        uncus=uncus,
        handed_over=handed_over,
        gap=gap,
        mask_change=change,
        soft=sheet_share(labels, tissue > 0, for_region(labels.protocol, region).sheet),
    )


def _check_ends_reached(points: Float, ends: EndPlanes) -> None:
    """Refuse labels (N, 3), RAS mm, of which none lies near an end plane, as of a damaged file."""
    for end, sign in _SIGNS.items():
        gap = float((sign * ends.height(points, end)).min())
        if gap > _LAST_VOXEL:
            raise GeometryError(
                f"the labels end {gap:.1f} mm before the {end} end plane; check the "
                "labels of body, head and tail",
                reason="body-too-short",
            )


def _mend(
    volume: LabelVolume, tissue: completion.Tissues, inside: Bool, settings: BodySettings
) -> tuple[completion.Tissues, completion.Index, completion.Index]:
    """Fill what the settings say; return the tissue, what was added, and a gap that was left."""
    affine, empty = volume.affine, volume.tissue == Tissue.BACKGROUND
    allowed = np.ones_like(empty)
    if volume.edited_mask is not None:  # a person has taken these voxels out
        allowed = volume.edited_mask.inside
    if settings.mending == "closing":
        tissue, added = completion.close_mask(tissue, allowed, affine)
        return tissue, added, added[:0]
    slits = completion.fill_slits(tissue, inside, empty, affine, settings)
    tissue, pits = completion.fill_pits(slits.tissue, inside, empty & allowed, affine, settings)
    return tissue, np.concatenate([slits.filled, pits]), slits.gap


def check_side(body: Body, hemi: str) -> float:
    """Refuse a body of the other side; return how far its medial subfields lie medially, mm.

    In subjects that lie feet first or on their side the subiculum may lie away from the midline;
    then the handedness decides, which no rotation changes.
    """
    inside, points = body.inside, body.inside_points()[1]
    if body.region != "body":
        inside, points = completion.between(body.hippocampal > 0, body.affine, body.ends)
    values = body.hippocampal[inside]
    medial = np.isin(values, MEDIAL_END)
    lateral = values == Tissue.CA1
    if not (medial.any() and lateral.any()):
        return float("nan")
    offset = points[medial, 0].mean() - points[lateral, 0].mean()
    offset = float(offset if hemi == "L" else -offset)
    # Six real bodies show 4-8 mm; one millimeter leaves room for a rotated head.
    centers = points[medial].mean(axis=0), points[lateral].mean(axis=0)
    if offset < -1.0 and not _has_handedness(body, *centers, hemi):
        raise wrong_side(hemi, offset)
    return offset


def wrong_side(hemi: str, offset: float) -> GeometryError:
    """Make the error of a hemisphere whose medial subfields lie ``offset`` mm medially of CA1."""
    side = {"L": "left", "R": "right"}
    opposite = side["R" if hemi == "L" else "L"]
    return GeometryError(
        f"labeled {side[hemi]}, but the subiculum lies {-offset:.1f} mm lateral of CA1 as "
        f"in a {opposite} hemisphere; check affine and file",
        reason="left-right-swapped",
    )


def _has_handedness(body: Body, subiculum: Float, ca1: Float, hemi: str) -> bool:
    """Say whether the body is certainly of the claimed side, wherever the subject lies.

    Seen along the long axis, the path from the subiculum over CA1 to the interior labels bends in
    opposite directions on the left and on the right.
    """
    _, points = completion.between(body.interior & (body.tissue == 0), body.affine, body.ends)
    if not len(points):
        return False
    first, second = ca1 - subiculum, points.mean(axis=0) - subiculum
    turn = float(body.ends.axis @ np.cross(first, second))
    turn /= float(np.linalg.norm(first) * np.linalg.norm(second))
    # The sine of the angle is 0.18 to 0.50 in twelve real bodies.
    return (turn if hemi == "L" else -turn) > 0.05  # noqa: PLR2004


def _merge_layer(volume: LabelVolume, settings: BodySettings) -> tuple[completion.Tissues, int]:
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
        replaced = [t for t in protocol.interior if t not in kinds]
        candidates[np.isin(volume.tissue, replaced)] = Tissue.OTHER
    # The nearest voxel always has a face neighbor outside.
    border = (candidates > 0) & ~ndimage.binary_erosion(candidates > 0, structure=digital.FACES)
    nearest = completion.value_of_nearest(
        candidates[border],
        digital.voxel_points(border, volume.affine),
        digital.voxel_points(layer, volume.affine),
    )
    tissue[layer] = np.where(nearest == Tissue.OTHER, 0, nearest)
    return tissue, int(np.count_nonzero(tissue[layer]))


def join_cortex(
    volume: LabelVolume, hippocampal: completion.Tissues, region: str
) -> completion.Tissues:
    """Add the neighboring cortex to the hippocampal sheet, or return it alone."""
    kinds = [t for t in for_region(volume.protocol, region).sheet if t in volume.protocol.neighbors]
    cortex = np.isin(volume.tissue, kinds)
    if not cortex.any():
        raise GeometryError(
            f"region {region}: no voxel is labeled {' or '.join(kind.name for kind in kinds)}; "
            "measure the body, or label the cortex beside it",
            reason="no-cortex-labels",
        )
    base = hippocampal if region == "extended" else np.zeros_like(hippocampal)
    return np.where(cortex, volume.tissue, base).astype(np.uint8)


def check_reach(
    points: Float, tissue: completion.Tissues, ends: EndPlanes, settings: BodySettings
) -> None:
    """Refuse cortex, among points (N, 3) of a region, that does not reach from end to end."""
    cortex = tissue > Tissue.HIPPOCAMPUS
    below, above = ends.depths(points[cortex])
    length = ends.length(points)
    # Levels are as long as a voxel, so that each level with labels holds a center of one.
    count = max(int(length / (2 * ends.half_slice)), 1)
    level = np.minimum((count * below / (below + above)).astype(int), count - 1)
    share = len(np.unique(level)) / count
    if share < settings.min_cortex_reach:
        raise GeometryError(
            f"region {settings.region}: cortex is labeled along {share * length:.1f} of "
            f"{length:.1f} mm; label the cortex all along, or measure the body",
            reason="cortex-incomplete",
        )


def _apply_mask(
    volume: LabelVolume, tissue: completion.Tissues, mask: EditedMask, ends: EndPlanes
) -> tuple[LabelVolume, completion.Tissues, MaskChange]:
    """Replace the body between its end planes by an edited mask.

    Voxels outside of the mask lose their label, and voxels of the mask without a sheet label get
    that of the nearest voxel of the mask that has one. Beyond the end planes nothing changes.
    """
    region, points = completion.between(mask.inside | (tissue > 0), volume.affine, ends)
    index = digital.positions(region)
    old, inside = tissue[tuple(index.T)], mask.inside[tuple(index.T)]
    retained = inside & (old > 0)
    if not retained.any():
        raise GeometryError(
            "the edited mask misses the sheet's labels between the end planes; check its "
            "hemisphere and its space",
            reason="edited-mask-elsewhere",
        )
    new = np.where(retained, old, np.uint8(0))
    added = inside & (old == 0)
    if added.any():
        new[added] = old[retained][cKDTree(points[retained]).query(points[added])[1]]
    edited = tissue.copy()
    edited[tuple(index.T)] = new
    labels = np.where(edited == tissue, volume.tissue, edited)
    change = MaskChange(
        before=int(np.count_nonzero(old)),
        added=int(np.count_nonzero(added)),
        removed=int(np.count_nonzero((old > 0) & ~inside)),
    )
    return replace(volume, tissue=labels), edited, change


def relabel_by_mask(volume: LabelVolume, settings: BodySettings) -> LabelVolume:
    """Return labels whose body is their edited mask, if they have one.

    GeometryError as from :func:`extract_body`.
    """
    if volume.edited_mask is None:
        return volume
    tissue, _ = _merge_layer(volume, settings)
    ends = find_end_planes(volume, tissue, settings)
    changed, _, _ = _apply_mask(volume, tissue, volume.edited_mask, ends)
    return replace(changed, edited_mask=None)


def check_mask(
    mask: EditedMask, change: MaskChange, voxel: float, settings: BodySettings
) -> list[Finding]:
    """Flag an edited mask that is coarser than the labels' voxels (mm), or differs much."""
    return [
        Finding(
            reason="edited-mask-coarse",
            value=mask.voxel / voxel,
            limit=settings.max_mask_ratio,
            text=f"the edited mask has voxels of {mask.voxel:.2f} mm, the labels of {voxel:.2f} mm",
            remedy="draw the mask on the grid of the labels",
            share=1.0,
        ),
        Finding(
            reason="edited-mask-different",
            value=change.share,
            limit=settings.max_mask_change,
            text=f"the edited mask adds {change.added} voxels to the body and removes "
            f"{change.removed} of {change.before}",
            remedy="check the space of the mask",
            share=1.0,
        ),
    ]
