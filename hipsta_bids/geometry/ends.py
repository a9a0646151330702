"""Where the hippocampal body begins and ends along its long axis."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from hipsta_bids.errors import GeometryError
from hipsta_bids.protocols.protocol import Part, Tissue
from hipsta_bids.settings import BodySettings
from hipsta_bids.types import Bool, Float, Int, LabelVolume

# Where the body ends if nothing is labeled head or tail.


End = Literal["posterior", "anterior"]


@dataclass(frozen=True, eq=False, kw_only=True)
class _Slices:
    """Cross-sections at equal steps along an axis."""

    axis: Float
    first: float
    """Level of the first slice along the axis, mm."""
    step: float

    def level(self, number: float) -> float:
        return float(self.first + self.step * number)


def automatic_range(
    volume: LabelVolume,
    sheet: NDArray[np.uint8],
    axis: Float,
    known: dict[End, tuple[Float, Float, str]],
    settings: BodySettings,
) -> dict[End, tuple[float, str]]:
    """Find the ends of the body that have no labels by the rule of Diers et al. 2023, section 2.1.

    Returns Level along the axis, mm, and rule of each end.
    """
    index = np.argwhere(sheet > 0)
    along = (index @ volume.affine[:3, :3].T + volume.affine[:3, 3]) @ axis
    step = float(np.abs(axis @ volume.affine[:3, :3]).max())
    slices = _Slices(axis=axis, first=float(along.min()), step=step)
    number = np.floor((along - slices.first) / step + 0.5).astype(int)
    low, high = _subfield_range(sheet[sheet > 0], number, slices, known)
    section, pixel = _sections(sheet > 0, volume.affine, slices, (low, high))
    first, last = (low + number for number in _body_like(section, pixel, settings))
    area = section.sum(axis=(1, 2))[first - low : last - low + 1]
    reach = max(round(settings.end_reach / step), 1)
    before, after = (_grazed(a, reach, settings.end_fullness) for a in (area, area[::-1]))
    # Each kept slice reaches half a step to both sides.
    return {
        "posterior": (
            slices.level(first + before - 0.5) + settings.end_margin,
            "cross-section" if first > low else "subfields",
        ),
        "anterior": (
            slices.level(last - after + 0.5) - settings.end_margin,
            "cross-section" if last < high else "subfields",
        ),
    }


def _subfield_range(
    values: NDArray[np.uint8],
    number: Int,
    slices: _Slices,
    known: dict[End, tuple[Float, Float, str]],
) -> tuple[int, int]:
    """First slice that has CA1 and CA2 or CA3, and last that has CA2 or CA3, between known ends."""
    count = int(number.max()) + 1
    ca1 = np.bincount(number[values == Tissue.CA1], minlength=count) > 0
    lateral = np.isin(values, (Tissue.CA2, Tissue.CA2_3, Tissue.CA3))
    ca23 = np.bincount(number[lateral], minlength=count) > 0
    levels = slices.first + slices.step * np.arange(count)
    if "posterior" in known:
        ca23 &= levels > known["posterior"][0] @ slices.axis
    if "anterior" in known:
        ca23 &= levels < known["anterior"][0] @ slices.axis
    both = np.flatnonzero(ca1 & ca23)
    if not len(both):
        raise GeometryError(
            "no slice across the long axis has both CA1 and CA2/CA3, and there are no head and "
            "tail labels: cannot tell where the body lies",
            reason="no-body",
        )
    return int(both[0]), int(np.flatnonzero(ca23)[-1])


def _body_like(section: Bool, pixel: float, settings: BodySettings) -> tuple[int, int]:
    """First and last cross-section, counted from the middle, that look like the body.

    Where CA2/CA3 is labeled in the head or in the tail's bend, the rule of the paper runs deep
    into them. The body ends where the cross-section falls into two large pieces, or twice running
    exceeds the usual area.
    """
    area = section.sum(axis=(1, 2)) * pixel**2
    count = len(area)
    usual = float(np.median(area[count // 4 : count - count // 4]))
    in_slice = np.zeros((3, 3, 3), dtype=bool)
    in_slice[1] = True  # pieces are sought within each slice
    pieces, total = ndimage.label(section, structure=in_slice)
    sizes = np.bincount(pieces.ravel(), minlength=total + 1)[1:] * pixel**2
    owner = np.zeros(total, dtype=int)
    number = np.broadcast_to(np.arange(count)[:, None, None], section.shape)
    owner[pieces[section] - 1] = number[section]
    split = np.bincount(owner[sizes > settings.head_piece], minlength=count) > 1
    wide = area > settings.head_growth * usual
    twice = np.zeros(count, dtype=bool)
    twice[:-1] |= wide[:-1] & wide[1:]
    twice[1:] |= wide[1:] & wide[:-1]
    odd = np.flatnonzero(split | twice)
    before, after = odd[odd < count // 2], odd[odd > count // 2]
    first = int(before[-1]) + 1 if len(before) else 0
    last = int(after[0]) - 1 if len(after) else count - 1
    return first, last


def _grazed(area: Int, reach: int, fullness: float) -> int:
    """How many of the first cross-sections are smaller than those that follow them.

    Labels that end obliquely leave cross-sections that have a part of them only.
    """
    outer = area[: min(reach, len(area) // 4)]
    usual = [np.median(area[i + 1 : i + 1 + reach]) for i in range(len(outer))]
    whole = np.flatnonzero(outer >= fullness * np.array(usual))
    return int(whole[0]) if len(whole) else len(outer)


def _sections(
    mask: Bool, affine: Float, slices: _Slices, bounds: tuple[int, int]
) -> tuple[Bool, float]:
    """Sample the mask in the slices between bounds, (N, A, B); also the pixel edge, mm."""
    axis = slices.axis
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side = side / np.linalg.norm(side)
    up = np.cross(axis, side)
    pixel = float(np.linalg.norm(affine[:3, :3], axis=0).min())
    points = np.argwhere(mask) @ affine[:3, :3].T + affine[:3, 3]
    a, b = (
        np.arange(reach.min() - 1, reach.max() + 1, pixel) for reach in (points @ side, points @ up)
    )
    levels = slices.first + slices.step * np.arange(bounds[0], bounds[1] + 1)
    where = (
        a[None, :, None, None] * side
        + b[None, None, :, None] * up
        + levels[:, None, None, None] * axis
    )
    inverse = np.linalg.inv(affine)
    voxels = np.moveaxis(where @ inverse[:3, :3].T + inverse[:3, 3], -1, 0)
    field = ndimage.map_coordinates(mask.astype(np.float32), voxels, order=1, output=np.float32)
    return field > 0.5, pixel  # noqa: PLR2004 -- halfway between outside and inside


@dataclass(frozen=True, eq=False, kw_only=True)
class EndPlanes:
    """Two planes; both normals point anterior.

    The height of a point above a plane is its distance along the normal, positive anterior.
    """

    posterior_point: Float
    posterior_normal: Float
    anterior_point: Float
    anterior_normal: Float
    axis: Float
    """(3,) unit vector, posterior to anterior, between the two normals."""
    posterior_rule: str
    """``labels``, ``subfields`` (the paper's automatic rule), or ``cross-section`` (that rule ran
    beyond the body and was cut short)."""
    anterior_rule: str
    """As above."""
    half_slice: float
    """Half of a voxel's extent along the axis, mm."""

    def height(self, points: Float, end: End) -> Float:
        """Signed distance of (N, 3) points from one end plane, mm, (N,)."""
        if end == "posterior":
            return np.asarray((points - self.posterior_point) @ self.posterior_normal)
        return np.asarray((points - self.anterior_point) @ self.anterior_normal)

    def length(self, points: Float) -> float:
        """Mean distance between the planes along the axis, over (N, 3) points, mm."""
        below = self.height(points, "posterior") / (self.posterior_normal @ self.axis)
        above = self.height(points, "anterior") / (self.anterior_normal @ self.axis)
        return float(np.mean(below - above))


def find_end_planes(
    volume: LabelVolume, sheet: NDArray[np.uint8], settings: BodySettings
) -> EndPlanes:
    """Find the planes between tail and body, and body and head.

    From labels where the segmentation has them; otherwise by the rule of Diers et al. 2023
    (section 2.1): the most anterior slice with CA2 or CA3, and the most posterior one with CA1 and
    CA2 or CA3, counted along the hippocampus's own long axis.
    """
    hippocampal = (
        (volume.tissue > 0)
        & (volume.tissue <= Tissue.HIPPOCAMPUS)
        & ~np.isin(volume.tissue, (Tissue.FIMBRIA, Tissue.FISSURE, Tissue.CYST, Tissue.HATA))
    )
    index = np.argwhere(hippocampal)
    points = index @ volume.affine[:3, :3].T + volume.affine[:3, 3]
    parts = _largest_ends(np.where(hippocampal, volume.part, Part.UNKNOWN))[hippocampal]
    axis = _long_axis(points, parts)
    half_slice = 0.5 * float(np.abs(axis @ volume.affine[:3, :3]).sum())

    is_head, is_tail = parts == Part.HEAD, parts == Part.TAIL
    is_body = np.isin(volume.part[hippocampal], (Part.BODY, Part.UNKNOWN))
    enough = settings.min_end_voxels
    planes: dict[End, tuple[Float, Float, str]] = {}
    if is_tail.sum() >= enough and is_body.sum() >= enough:
        planes["posterior"] = (
            *_separating_plane(points[is_tail], points[is_body], axis, settings.plane_reach),
            "labels",
        )
    if is_head.sum() >= enough and is_body.sum() >= enough:
        planes["anterior"] = (
            *_separating_plane(points[is_body], points[is_head], axis, settings.plane_reach),
            "labels",
        )
    if len(planes) < 2:  # noqa: PLR2004 -- two ends
        # Where one end is labeled, the other is cut parallel to it.
        across = next((normal for _, normal, _ in planes.values()), axis)
        found = automatic_range(volume, sheet, across, planes, settings)
        for end, (level, rule) in found.items():
            planes.setdefault(end, (level * across, across, rule))
    return _checked(planes, axis, half_slice)


def _largest_ends(part: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Keep the largest piece each of head and tail: stray voxels must not move the end planes."""
    kept = part.copy()
    for end in (Part.HEAD, Part.TAIL):
        pieces, count = ndimage.label(part == end, structure=np.ones((3, 3, 3)))
        if count > 1:
            sizes = np.bincount(pieces.ravel())
            sizes[0] = 0
            kept[(pieces > 0) & (pieces != sizes.argmax())] = Part.UNKNOWN
    return kept


def _checked(
    planes: dict[End, tuple[Float, Float, str]], axis: Float, half_slice: float
) -> EndPlanes:
    middle = planes["posterior"][1] + planes["anterior"][1]
    middle = middle / np.linalg.norm(middle)
    for end, (point, normal, _) in planes.items():
        place = "RAS " + " ".join(f"{value:.1f}" for value in point) + " mm"
        tilt = np.degrees(np.arccos(np.clip(normal @ axis, -1, 1)))
        if tilt > 90:  # noqa: PLR2004 -- turned round
            name = "tail" if end == "posterior" else "head"
            raise GeometryError(
                f"labels of the {name} lie on both sides of the body or inside it, near {place}: "
                "correct them",
                reason="end-labels-inside",
            )
        if tilt > 50:  # noqa: PLR2004 -- beyond this the labels do not end across the long axis
            lacking = [name for name, (_, _, rule) in planes.items() if rule != "labels"]
            if lacking:
                raise GeometryError(
                    f"what is labeled does not run from the {end} end near {place} to the "
                    f"{lacking[0]} one, which has no label: the body may be cut short there; label "
                    "the whole hippocampus",
                    reason="labels-end",
                )
            raise GeometryError(
                f"the {end} end plane near {place} is tilted by {tilt:.0f} degrees against the "
                "long axis: check the head and tail labels there",
                reason="end-plane-tilted",
            )
    return EndPlanes(
        posterior_point=planes["posterior"][0],
        posterior_normal=planes["posterior"][1],
        posterior_rule=planes["posterior"][2],
        anterior_point=planes["anterior"][0],
        anterior_normal=planes["anterior"][1],
        anterior_rule=planes["anterior"][2],
        axis=middle,
        half_slice=half_slice,
    )


def _long_axis(points: Float, parts: NDArray[np.uint8]) -> Float:
    """Find the unit vector from tail to head.

    Between the centers of the labeled head and tail; otherwise the first principal axis, turned
    to the front (+y in RAS). Where one end is labeled and lies in quite another direction from the
    rest, that direction: what is cut short may be wider than long.
    """
    head, tail = points[parts == Part.HEAD], points[parts == Part.TAIL]
    if len(head) and len(tail):
        between = head.mean(axis=0) - tail.mean(axis=0)
        return np.asarray(between / np.linalg.norm(between))
    centered = points - points.mean(axis=0)
    _, vectors = np.linalg.eigh(centered.T @ centered)
    if not len(head) and not len(tail):
        axis: Float = vectors[:, -1]
        return axis if axis[1] >= 0 else -axis
    rest = points[(parts != Part.HEAD) & (parts != Part.TAIL)]
    rest = rest if len(rest) else points
    way = (
        head.mean(axis=0) - rest.mean(axis=0)
        if len(head)
        else rest.mean(axis=0) - tail.mean(axis=0)
    )
    way = way / np.linalg.norm(way)
    along = float(vectors[:, -1] @ way)
    if abs(along) < 0.8:  # noqa: PLR2004 -- 37 degrees
        return np.asarray(way)
    return np.asarray(vectors[:, -1] if along > 0 else -vectors[:, -1])


def _separating_plane(below: Float, above: Float, axis: Float, reach: float) -> tuple[Float, Float]:
    """Plane between two label classes by ridge-penalised logistic regression near the interface.

    ``below, above`` Voxel centers posterior and anterior of the interface, mm; ``reach`` Voxels
    within this distance of the interface count, mm.
    """
    low, high = below @ axis, above @ axis
    # The classes overlap along the axis where the interface is tilted: start at the balance point.
    level = 0.5 * (np.quantile(low, 0.995) + np.quantile(high, 0.005))
    point, normal = level * axis, axis
    for _ in range(3):  # the window follows the plane's tilt
        near = [p[np.abs((p - point) @ normal) < reach] for p in (below, above)]
        if min(len(p) for p in near) < 10:  # noqa: PLR2004 -- four parameters need some voxels
            break
        point, normal = _logistic_plane(near[0], near[1], axis)
    return point, normal


def _logistic_plane(below: Float, above: Float, axis: Float) -> tuple[Float, Float]:
    points = np.vstack([below, above])
    target = np.repeat([0.0, 1.0], [len(below), len(above)])
    weight = np.repeat([0.5 / len(below), 0.5 / len(above)], [len(below), len(above)])
    center = points.mean(axis=0)
    scale = max(float(points.std(axis=0).mean()), 1e-9)
    design = np.column_stack([(points - center) / scale, np.ones(len(points))])
    beta = np.append(axis, 0.0)
    # A weak ridge keeps separable classes finite and turns the plane to the widest margin.
    ridge = np.diag([1e-4, 1e-4, 1e-4, 0.0])
    for _ in range(50):
        p = 1 / (1 + np.exp(-np.clip(design @ beta, -40, 40)))
        gradient = design.T @ (weight * (p - target)) + ridge @ beta
        hessian = (design * (weight * np.maximum(p * (1 - p), 1e-9))[:, None]).T @ design + ridge
        step = np.linalg.solve(hessian, gradient)
        step *= min(1.0, 4.0 / max(float(np.abs(step).max()), 1e-12))
        beta = beta - step
        if np.abs(step).max() < 1e-6:  # noqa: PLR2004 -- converged
            break
    length = np.linalg.norm(beta[:3])
    normal = beta[:3] / length
    point = center - beta[3] / length * scale * normal
    return point, normal
