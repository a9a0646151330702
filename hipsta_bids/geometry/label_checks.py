"""What the labels of one hemisphere show before anything is meshed: subfields, volumes, axes.

Axes are judged by anatomy, so that a rotated head is none of their business: the subfields wind
round the dentate gyrus in opposite directions on the left and on the right, seen from the tail, and
the hippocampus is thicker at its head and bows laterally.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.body import wrong_side
from hipsta_bids.geometry.digital import to_ras, voxel_points
from hipsta_bids.geometry.ends import hippocampal_voxels, long_axis
from hipsta_bids.geometry.grid import check_voxel
from hipsta_bids.protocols.protocol import CORE, LATERAL_END, MEDIAL_END, Part, Tissue
from hipsta_bids.settings import CheckSettings
from hipsta_bids.types import Bool, Finding, Float, LabelVolume

#: Volumes of one side that nobody has, mm3: less or more. Whole hippocampi of adults have about
#: 2,500 to 5,000 mm3 (Nobis et al. 2019, doi:10.1016/j.nicl.2019.101904), bodies alone a third of
#: it, and protocols divide them differently: the limits are far beyond all of that.
_VOLUMES: dict[str, tuple[tuple[Tissue, ...], float, float]] = {
    "subiculum": (MEDIAL_END, 10, 3000),
    "CA1": ((Tissue.CA1,), 10, 4000),
    "CA2 and CA3": (LATERAL_END, 2, 3000),
    "dentate gyrus and CA4": (CORE, 0, 3000),
    "hippocampus": (tuple(Tissue(n) for n in range(1, Tissue.HIPPOCAMPUS + 1)), 60, 10000),
}
#: Directions of RAS, from negative to positive.
_BORDERS = (("left", "right"), ("posterior", "anterior"), ("inferior", "superior"))
#: Reasons of refusals that no cut through the labels explains.
_UNCUT = frozenset({"sheet-too-thin", "left-right-swapped", "axis-flipped", "visit-unlike"})
#: Subfields with fewer voxels do not show how the sheet winds.
_LEAST_VOXELS = 50
#: Which part of the long axis shows it, as shares: in head and tail the subfields lie otherwise.
_MIDDLE = (0.25, 0.75)
#: Least cosine of the angle between the long axis and the normal of a triangle of subfields, 0.57
#: and more in whole hippocampi: what is cut short may be wider than long, and has another axis.
_ACROSS = 0.4
#: Winding (1: an equilateral triangle) of a mirrored image is below minus this; 0.43 to 0.76 in 30
#: real hemispheres.
_CLEAR_WINDING = 0.2
#: Logarithm of the volume of the anterior over that of the posterior two fifths: 0.32 to 0.68 in
#: whole hippocampi, -0.25 to 0.57 in parts of them.
_END, _CLEAR_BULGE = 0.4, 0.28
#: Whole hippocampi bow laterally by more than this share of their length (0.14 to 0.21).
_WHOLE_BOW = 0.075
#: What extends along its axis by less than this multiple of its extent across may be a body alone,
#: whose ends are alike and which may be wider than long: 2.1 to 2.8 in whole hippocampi, 1.2 to 1.6
#: in bodies.
_ELONGATED = 1.8
#: Usual directions in a left hemisphere, RAS: from tail to head, and to medial.
_USUAL = np.array([0.0, 0.86, -0.51]), np.array([1.0, 0.0, 0.0])
#: No head lies so far from the middle of the scanner that a hemisphere, 25 mm from its midline, is
#: on the other side of the middle by more than this, mm.
_WRONG_SIDE = 10.0
#: Between 60 degrees, a head turned by 30, and 150, an image with two flipped axes turned by 30.
_TURNED = 105.0


class _Position(NamedTuple):
    """How the labels of a hemisphere lie, the right side mirrored to the left."""

    labeled: bool
    """Whether labels of head or tail give the direction of the long axis."""
    winding: float
    """From -1 to 1, positive where the subfields wind as they should."""
    bowed: bool
    """Whether it bows laterally, as a hippocampus and no phantom does."""
    bulge: float
    """Logarithm of the volume of its anterior over that of its posterior end; 0 if it is short."""
    offset: float
    """How far the medial subfields lie medially of CA1, mm."""
    angle: float
    """By which the hippocampus is turned against its usual position, degrees."""


def check_label_image(volume: LabelVolume, hemi: str, settings: CheckSettings) -> list[Finding]:
    """Refuse labels of which no sheet can be made, or whose axes are flipped; flag doubtful ones.

    It takes a fraction of a second, and needs no end of the body.
    """
    check_voxel(volume, settings)
    _check_tissues(volume)
    return [*_check_volumes(volume), *_check_axes(volume, hemi)]


def note_labels(volume: LabelVolume, hemi: str) -> list[str]:
    """Note subfields of the protocol without a label, and labels on the other side of the origin.

    No map depends on the side: a header may have lost the place of the image in the scanner.
    """
    absent = [tissue.name for tissue in _absent(volume)]
    notes = [f"no label of {', '.join(absent)}; the sheet has the other subfields"] * bool(absent)
    points = voxel_points(hippocampal_voxels(volume), volume.affine)
    right = float(points[:, 0].mean()) if len(points) else 0.0
    if (right if hemi == "L" else -right) <= _WRONG_SIDE:
        return notes
    side, opposite = ("left", "right") if hemi == "L" else ("right", "left")
    place = f"the {side} hippocampus lies {abs(right):.0f} mm to the {opposite} of the origin"
    return [*notes, f"{place}. Check the affine of the image. Maps do not depend on it."]


@contextmanager
def naming_causes(volume: LabelVolume) -> Iterator[None]:
    """Name, in a refusal within the block, an impossible volume or the border of the image."""
    try:
        yield
    except GeometryError as error:
        whole = _check_volumes(volume)[-1:]
        causes = [f"{finding.text} ({finding.remedy}); " for finding in whole if finding.raised]
        sides = border_sides(hippocampal_voxels(volume), volume.affine)
        if sides and error.reason not in _UNCUT:
            remedy = "if it cuts them, use a larger image"
            causes.append(f"the labels touch the {sides} border of the image ({remedy}); ")
        raise GeometryError("".join([*causes, str(error)]), reason=error.reason) from error


def border_sides(inside: Bool, affine: Float) -> str:
    """Name the sides of an image on which voxels (I, J, K) are in its outermost layer."""
    sides = []
    for axis, step in enumerate(affine[:3, :3].T):
        main = np.abs(step).argmax()
        names = _BORDERS[main] if step[main] > 0 else _BORDERS[main][::-1]
        layers = np.moveaxis(inside, axis, 0)[[0, -1]]
        sides += [name for name, layer in zip(names, layers, strict=True) if layer.any()]
    return " and ".join(sides)


def _absent(volume: LabelVolume) -> list[Tissue]:
    """List subfields of the protocol's sheet that have no label."""
    present = set(np.unique(volume.tissue).tolist())
    return [tissue for tissue in volume.protocol.sheet if tissue not in present]


def _check_tissues(volume: LabelVolume) -> None:
    """Refuse an image in which an end or the middle of the protocol's sheet has no label at all."""
    sheet, absent = volume.protocol.sheet, _absent(volume)
    lateral = set(sheet).intersection(LATERAL_END)
    needed = [tissue.name for tissue in (Tissue.SUBICULUM, Tissue.CA1) if tissue in absent]
    if lateral and lateral.issubset(absent):
        needed.append(" or ".join(tissue.name for tissue in LATERAL_END if tissue in lateral))
    if needed and len(absent) < len(sheet):  # without any there is a separate message
        raise GeometryError(
            f"no label of {', '.join(needed)}, needed by the protocol "
            f"{volume.protocol.name}; check the labels, or name another protocol (--scheme)",
            reason="tissue-missing",
        )


def _check_volumes(volume: LabelVolume) -> list[Finding]:
    """Flag tissues that are far smaller or larger than in any hemisphere."""
    voxel = abs(float(np.linalg.det(volume.affine[:3, :3])))
    count = np.bincount(volume.tissue.ravel(), minlength=len(Tissue)) * voxel
    sizes = {name: float(count[list(kinds)].sum()) for name, (kinds, _, _) in _VOLUMES.items()}
    return [
        Finding(
            reason="volume-implausible",
            value=max(size / high, low / size),
            limit=1.0,
            text=f"the {name} labels have {size:.0f} mm3, {low:g} to {high:g} mm3 are possible",
            remedy="check the voxel size and its unit, and the protocol",
            share=1.0,
        )
        for (name, (_, low, high)), size in zip(_VOLUMES.items(), sizes.values(), strict=True)
        if size
    ]


def _check_axes(volume: LabelVolume, hemi: str) -> list[Finding]:
    """Refuse an image whose axes are flipped, if that would change the map; otherwise flag it."""
    position = _find_position(volume, hemi)
    if position is None:
        return []
    whole = position.bowed and abs(position.bulge) > _CLEAR_BULGE
    behind = 0.0 if position.labeled else -position.bulge
    check = "check the directions of the axes in the image's header"
    if whole and behind > _CLEAR_BULGE:
        raise GeometryError(
            f"the posterior hippocampus is {np.exp(behind):.1f} times the anterior one: the "
            f"head seems posterior; {check}",
            reason="axis-flipped",
        )
    if position.winding < -_CLEAR_WINDING and _is_ordered(volume.tissue):
        if position.offset < 0:
            raise wrong_side(hemi, position.offset)
        raise GeometryError(
            f"the order of subiculum, CA1 and CA3 is a mirror image; {check}, and the labels "
            "of head and tail",
            reason="axis-flipped",
        )
    return [
        Finding(
            reason="position-doubtful",
            value=value,
            limit=limit,
            text=text,
            remedy=f"{check}; thickness does not depend on them",
        )
        for value, limit, text in (
            (
                position.angle if whole else 0.0,
                _TURNED,
                f"the hippocampus is turned by {position.angle:.0f} degrees against the axes",
            ),
            (behind, _CLEAR_BULGE, "the head seems to lie posterior of the tail"),
        )
    ]


def _is_ordered(tissue: NDArray[np.uint8]) -> bool:
    """Say whether the subiculum borders more on CA1 than on CA2 and CA3; else labels are wrong."""
    bits = np.zeros(len(Tissue), dtype=np.uint8)
    bits[list(MEDIAL_END)], bits[Tissue.CA1], bits[list(LATERAL_END)] = 1, 2, 4
    groups = bits[tissue]
    pairs = [np.moveaxis(groups, k, 0)[1:] | np.moveaxis(groups, k, 0)[:-1] for k in range(3)]
    count = np.sum([np.bincount(pair.ravel(), minlength=8) for pair in pairs], axis=0)
    return bool(count[1 | 2] > count[1 | 4])


def _find_position(volume: LabelVolume, hemi: str) -> _Position | None:
    """Find how the labels lie; None with too few of them, or if their long axis is unknown."""
    index = np.nonzero(hippocampal_voxels(volume))
    tissue, parts = volume.tissue[index], volume.part[index]
    mirror = np.diag([1.0 if hemi == "L" else -1.0, 1.0, 1.0, 1.0])
    points = to_ras(np.stack(index, axis=1), mirror @ volume.affine)
    axis = long_axis(points, parts)
    points -= points.mean(axis=0)
    low, high = np.quantile(points @ axis, [0.005, 0.995])
    share = (points @ axis - low) / max(high - low, 1e-6)
    middle = (share > _MIDDLE[0]) & (share < _MIDDLE[1])
    groups = [
        points[middle & np.isin(tissue, kinds)]
        for kinds in (MEDIAL_END, (Tissue.CA1,), LATERAL_END, CORE)
    ]
    medial, ca1 = groups[:2]
    if min(len(medial), len(ca1)) < _LEAST_VOXELS:
        return None
    step = medial.mean(axis=0) - ca1.mean(axis=0)
    across = step - (step @ axis) * axis
    length = (points @ axis).std()
    flat = points - np.outer(points @ axis, axis)
    width = np.sqrt(np.linalg.eigvalsh(flat.T @ flat / len(flat))[-1])
    elongated, labeled = length > _ELONGATED * width, np.isin(parts, (Part.HEAD, Part.TAIL)).any()
    windings = [_winding([medial, ca1, group], axis) for group in groups[2:]]
    finite = [value for value in windings if np.isfinite(value)]
    if not finite:
        return None
    across /= np.linalg.norm(across)
    sagitta = np.polynomial.polynomial.polyfit(share, points @ across, 2)[2] / 4
    ends = np.count_nonzero(share > 1 - _END), np.count_nonzero(share < _END)
    # The rotation that takes the usual directions to these; its trace is 1 + 2 cos(angle).
    frame, usual = (np.stack([u, m, np.cross(u, m)]) for u, m in ((axis, across), _USUAL))
    cosine = (float(np.trace(frame.T @ usual)) - 1) / 2
    return _Position(
        labeled=bool(labeled),
        bowed=bool(sagitta > _WHOLE_BOW * (high - low)),
        winding=float(np.mean(finite)),
        bulge=float(np.log(ends[0] / ends[1])) if elongated else 0.0,
        offset=float(step[0]),
        angle=float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))),
    )


def _winding(groups: list[Float], axis: Float) -> float:
    """Signed shape of the triangle of the centers of three groups of points, seen along an axis.

    1 is equilateral, 0 a line; NaN if a group has too few points, or if it is seen edge-on.
    """
    if min(map(len, groups)) < _LEAST_VOXELS:
        return float("nan")
    corners = np.stack([group.mean(axis=0) for group in groups])
    sides = corners - np.roll(corners, 1, axis=0)
    normal = np.cross(sides[1], sides[2])
    if abs(axis @ normal) < _ACROSS * np.linalg.norm(normal):
        return float("nan")
    return float(2 * np.sqrt(3) * (axis @ normal) / (sides**2).sum())
