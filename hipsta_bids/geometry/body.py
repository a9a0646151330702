"""From subfield labels to the hippocampal body: one ribbon between two end planes."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from hipsta_bids.artifacts import Bool, Float, LabelVolume
from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.edited import MaskChange, apply_mask
from hipsta_bids.geometry.ends import EndPlanes, find_end_planes
from hipsta_bids.geometry.neighbors import check_reach, join_cortex
from hipsta_bids.geometry.slits import fill_slits
from hipsta_bids.schemes import Tissue, lateral_rank
from hipsta_bids.settings import BodySettings


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

    Parameters
    ----------
    volume : LabelVolume
    settings : BodySettings

    Returns
    -------
    Body

    Raises
    ------
    GeometryError
        ``no-sheet-labels``, ``body-too-short`` or what :func:`find_end_planes` raises.

    Notes
    -----
    Merging and the molecular-layer rule: Diers et al. 2023, section 2.1.
    """
    tissue, layer_voxels = _give_away_layer(volume, settings.layer_rule)
    if not tissue.any():
        raise GeometryError(
            "no voxel of the sheet's subfields "
            f"({', '.join(t.name for t in volume.scheme.sheet)}): check the scheme",
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
        interior=np.isin(volume.tissue, volume.scheme.interior),
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

    Parameters
    ----------
    body : Body
    hemi : {"L", "R"}

    Returns
    -------
    float
        How far the medial subfields lie medially of the lateral ones, mm.

    Raises
    ------
    GeometryError
        ``left-right-swapped`` if they lie on the far side by more than 1 mm, and the body is not
        of the handedness that the file claims.
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
            f"labelled {side[hemi]}, but the subiculum lies {-offset:.1f} mm lateral of CA1 as in "
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
    scheme = volume.scheme
    tissue = np.where(np.isin(volume.tissue, scheme.sheet), volume.tissue, 0).astype(np.uint8)
    layer = np.isin(volume.tissue, scheme.layer)
    if not layer.any() or not tissue.any():
        return tissue, 0
    takers = tissue.copy()
    if rule == "nearest-label":
        rivals = [t for t in scheme.interior if t not in scheme.layer]
        takers[np.isin(volume.tissue, rivals)] = Tissue.OTHER
    rim = _touching(takers > 0)
    _, nearest = cKDTree(_millimetres(rim, volume.affine)).query(_millimetres(layer, volume.affine))
    given = takers[rim][nearest]
    tissue[layer] = np.where(given == Tissue.OTHER, 0, given)
    return tissue, int(np.count_nonzero(tissue[layer]))


def _touching(mask: Bool) -> Bool:
    """Voxels of a mask with a face neighbour outside it: the nearest voxel is always one."""
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
