"""Where the hippocampal body begins and ends along its long axis.

A user's planes come first, then planes fitted to head and tail labels. Other ends come from
the cross-sections of the labels (``automatic_ends``).
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import expit

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.automatic_ends import find_ends
from hipsta_bids.geometry.digital import CUBE, box_around, piece_sizes, positions, voxel_points
from hipsta_bids.protocols.protocol import Part, Tissue
from hipsta_bids.settings import BodySettings
from hipsta_bids.types import Bool, End, Float, GivenEnd, LabelVolume, position_text

#: Where slices are thicker than this many pixels, they have a say in the tilt of the planes.
PLANE_RATIO = 1.8
#: Planes of thick slices are fitted to labels within this many slices of the interface.
PLANE_SLICES = 1.5
#: Width of the logistic function by which planes are fitted, slices.
PLANE_WIDTH = 0.05
#: Tilts against the slices are expected to be of this size, degrees (standard deviation).
PLANE_TILT = 10.0
#: Weight of the expected tilt; all labels together weigh 1.
PLANE_PRIOR = 0.05

_FAR = 10.0
"""A point of a plane may lie next to the hippocampus, but not farther than this, mm."""

_ELONGATED = 1.6
"""A body whose extents (standard deviations) differ by this ratio has a separate axis."""
_NEAR = 2.0
"""What lies within this distance of a plane is its cross-section, mm."""


class EndPlane(NamedTuple):
    """One end plane, and the rule that placed it.

    The rule is ``user``, ``labels``, or the largest difference for the automatic rule beyond the
    plane: ``subfields`` (no CA1, CA2 or CA3), ``core`` (no dentate gyrus) or ``cross-section``; or
    ``last-slice``.
    """

    point: Float
    """(3,) RAS mm."""
    normal: Float
    """(3,) unit vector that points anterior."""
    rule: str
    uncertainty: float = 0.0
    """Standard error over the cues of the automatic rule, mm."""

    def entry(self, points: Float) -> dict[str, list[float]]:
        """Describe the plane for the quality record, by a place next to one of points (N, 3)."""
        place = np.array(self.moved("posterior", 0.0, points).point)
        return {
            "point_ras_mm": place.round(3).tolist(),
            "normal_ras": self.normal.round(4).tolist(),
        }

    def moved(self, end: End, shift: float, points: Float) -> GivenEnd:
        """Give the plane that lies ``shift`` mm anterior, by a place next to one of points (N, 3).

        The point of an automatic plane may lie far from the body.
        """
        height = (points - self.point) @ self.normal
        nearest = np.abs(height).argmin()
        point = points[nearest] + (shift - height[nearest]) * self.normal
        return GivenEnd(end=end, point=tuple(point.tolist()), normal=tuple(self.normal.tolist()))


@dataclass(frozen=True, eq=False, kw_only=True)
class EndPlanes:
    """The planes between which the body lies."""

    posterior: EndPlane
    anterior: EndPlane
    axis: Float
    """(3,) unit vector, posterior to anterior, between the two normals."""
    half_slice: float
    """Half of a voxel's extent along the axis, mm."""

    def __getitem__(self, end: End) -> EndPlane:
        """Return one of the planes."""
        return self.posterior if end == "posterior" else self.anterior

    def height(self, points: Float, end: End) -> Float:
        """Distance of (N, 3) points from one end plane, mm, (N,); positive anterior of it."""
        return np.asarray((points - self[end].point) @ self[end].normal)

    def beyond(self, distance: float) -> "EndPlanes":
        """Planes that lie farther apart, each moved outward along the axis by a distance, mm."""
        step = distance * self.axis
        return replace(
            self,
            posterior=self.posterior._replace(point=self.posterior.point - step),
            anterior=self.anterior._replace(point=self.anterior.point + step),
        )

    def depths(self, points: Float) -> tuple[Float, Float]:
        """Distances of (N, 3) points from both planes, mm, (N,); positive inside of each."""
        return self.height(points, "posterior"), -self.height(points, "anterior")

    def depth(self, points: Float) -> Float:
        """Distance of (N, 3) points from the nearer plane, mm, (N,); positive between them."""
        return np.minimum(*self.depths(points))

    def length(self, points: Float) -> float:
        """Mean distance between the planes along the axis, over (N, 3) points, mm."""
        below = self.height(points, "posterior") / (self.posterior.normal @ self.axis)
        above = self.height(points, "anterior") / (self.anterior.normal @ self.axis)
        return float(np.mean(below - above))


def hippocampal_voxels(volume: LabelVolume) -> Bool:
    """Mark the voxels (I, J, K) of the hippocampus that have a place along its long axis."""
    excluded = (Tissue.FIMBRIA, Tissue.FISSURE, Tissue.CYST, Tissue.HATA)
    labeled = (volume.tissue > 0) & (volume.tissue <= Tissue.HIPPOCAMPUS)
    return np.asarray(labeled & ~np.isin(volume.tissue, excluded))


def find_end_planes(
    volume: LabelVolume, sheet: NDArray[np.uint8], settings: BodySettings
) -> EndPlanes:
    """Find the planes between tail and body, and between body and head."""
    hippocampal = hippocampal_voxels(volume)
    points = voxel_points(hippocampal, volume.affine)
    parts = _largest_ends(np.where(hippocampal, volume.part, Part.UNKNOWN))[hippocampal]
    axis = long_axis(points, parts)
    half_slice = 0.5 * float(np.abs(axis @ volume.affine[:3, :3]).sum())

    is_head, is_tail = parts == Part.HEAD, parts == Part.TAIL
    is_body = np.isin(volume.part[hippocampal], (Part.BODY, Part.UNKNOWN))
    planes: dict[End, EndPlane] = {}
    sides: tuple[tuple[End, Bool, Bool], ...] = (
        ("posterior", is_tail, is_body),
        ("anterior", is_body, is_head),
    )
    for end, below, above in sides:
        if min(below.sum(), above.sum()) >= settings.min_end_voxels:
            across = _across_slices(volume.affine, axis)
            point, normal = (
                _separating_plane(points[below], points[above], axis, settings.plane_reach)
                if across is None
                else _plane_along_slices(points[below], points[above], across)
            )
            planes[end] = EndPlane(point, normal, "labels")
    for user_end in volume.given_ends:
        _check_inside(user_end, points)
        without = planes[user_end.end].normal if user_end.end in planes else axis
        planes[user_end.end] = _given_plane(user_end, without, axis)
    if len(planes) < 2:  # noqa: PLR2004 -- two ends
        across = _body_axis(points[~is_head & ~is_tail], axis, planes)
        known_levels = {end: _level(plane, points, across) for end, plane in planes.items()}
        for end, automatic in find_ends(volume, sheet, across, known_levels, settings).items():
            plane = EndPlane(
                automatic.level * across, across, automatic.rule, automatic.uncertainty
            )
            planes.setdefault(end, plane)
    return _checked(planes, axis, half_slice)


def _level(plane: EndPlane, points: Float, axis: Float) -> float:
    """Where a plane lies along the axis in the middle of the hippocampus, at points (N, 3), mm."""
    near = points[np.abs((points - plane.point) @ plane.normal) < _NEAR]
    return float((near.mean(axis=0) if len(near) else plane.point) @ axis)


def _check_inside(user_end: GivenEnd, points: Float) -> None:
    """Refuse a plane that a person has placed far from the hippocampus, at points (N, 3)."""
    distance = float(np.linalg.norm(points - user_end.point, axis=1).min())
    if distance > _FAR:
        raise GeometryError(
            f"the given {user_end.end} end at {position_text(np.array(user_end.point))} is "
            f"{distance:.0f} mm from the labels; give scanner coordinates (RAS, mm)",
            reason="given-end-outside",
        )


def _given_plane(user_end: GivenEnd, without: Float, axis: Float) -> EndPlane:
    """Place a user's plane; its normal is that of the plane without it, if none is given."""
    if user_end.normal is None:
        return EndPlane(np.array(user_end.point), without, "user")
    normal = np.array(user_end.normal) / np.linalg.norm(user_end.normal)
    return EndPlane(np.array(user_end.point), normal if normal @ axis > 0 else -normal, "user")


def _largest_ends(part: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Keep the largest piece each of head and tail: stray voxels must not move the end planes."""
    cleaned = part.copy()
    for end in (Part.HEAD, Part.TAIL):
        index = positions(part == end)
        if len(index):
            around = box_around(index)
            pieces, _ = ndimage.label(part[around] == end, structure=CUBE)
            cleaned[around][(pieces > 0) & (pieces != piece_sizes(pieces).argmax())] = Part.UNKNOWN
    return cleaned


def _checked(planes: dict[End, EndPlane], axis: Float, half_slice: float) -> EndPlanes:
    """Combine two planes that lie across the long axis; refuse others."""
    for end, (point, normal, rule, _) in planes.items():
        at = position_text(point)
        tilt = np.degrees(np.arccos(np.clip(normal @ axis, -1, 1)))
        if tilt > 90:  # noqa: PLR2004 -- reversed
            name = "tail" if end == "posterior" else "head"
            raise GeometryError(
                f"labels of the {name} lie on both sides of the body or inside it, near {at}: "
                "correct these labels",
                reason="end-labels-inside",
            )
        if tilt > 50:  # noqa: PLR2004 -- beyond this the labels do not end across the long axis
            if rule == "user":
                raise GeometryError(
                    f"the given {end} end plane at {at} is tilted by {tilt:.0f} degrees; "
                    "correct its normal in the table of ends",
                    reason="end-plane-tilted",
                )
            lacking = [
                name for name, plane in planes.items() if plane.rule not in ("labels", "user")
            ]
            if lacking:
                raise GeometryError(
                    f"the labels near {at} are cut short: the {lacking[0]} end has no labels; "
                    "label the whole hippocampus",
                    reason="labels-end",
                )
            raise GeometryError(
                f"the {end} end plane near {at} is tilted by {tilt:.0f} degrees; check the "
                "head and tail labels there",
                reason="end-plane-tilted",
            )
    posterior, anterior = planes["posterior"], planes["anterior"]
    middle = posterior.normal + anterior.normal
    return EndPlanes(
        posterior=posterior,
        anterior=anterior,
        axis=middle / np.linalg.norm(middle),
        half_slice=half_slice,
    )


def long_axis(points: Float, parts: NDArray[np.uint8]) -> Float:
    """Find the unit vector from tail to head.

    It joins the centers of the labeled head and tail. Otherwise it is the first principal axis,
    directed anteriorly (+y in RAS), unless one end is labeled and lies in quite another direction
    from the rest: a body cut short may be wider than long.
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
    middle = points[(parts != Part.HEAD) & (parts != Part.TAIL)]
    middle = middle if len(middle) else points
    below, above = (middle, head) if len(head) else (tail, middle)
    direction = above.mean(axis=0) - below.mean(axis=0)
    direction = direction / np.linalg.norm(direction)
    along = float(vectors[:, -1] @ direction)
    if abs(along) < 0.8:  # noqa: PLR2004 -- 37°
        return np.asarray(direction)
    return np.asarray(vectors[:, -1] if along > 0 else -vectors[:, -1])


def _body_axis(points: Float, axis: Float, planes: dict[End, EndPlane]) -> Float:
    """First principal axis (3,) of the body, at points (N, 3), directed as the long axis.

    Where it is short and wide, that says little: then the other end's normal, or the long axis.
    """
    centered = points - points.mean(axis=0)
    spread, vectors = np.linalg.eigh(centered.T @ centered)
    direction: Float = vectors[:, -1] * np.sign(vectors[:, -1] @ axis)
    if spread[-1] > _ELONGATED**2 * spread[-2] and direction @ axis > 0.8:  # noqa: PLR2004 -- 37°
        return direction
    return next((plane.normal for plane in planes.values()), axis)


def _separating_plane(below: Float, above: Float, axis: Float, reach: float) -> tuple[Float, Float]:
    """Fit the point and normal of a plane between voxel centers below and above it, RAS mm.

    Ridge-penalized logistic regression with the voxels within ``reach`` mm of the interface.
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


def _across_slices(affine: Float, axis: Float) -> Float | None:
    """Vector from one slice to the next, mm, (3,), where slices are thick and lie across the axis.

    It points as the axis does.
    """
    edges = np.linalg.norm(affine[:3, :3], axis=0)
    through = int(np.argmax(edges))
    step = np.asarray(affine[:3, through])
    along = float(step @ axis)
    if (
        edges[through] <= PLANE_RATIO * np.delete(edges, through).max()
        or abs(along) < edges[through] * np.cos(np.radians(60))  # cut lengthwise
    ):
        return None
    return step if along > 0 else -step


def _plane_along_slices(below: Float, above: Float, across: Float) -> tuple[Float, Float]:
    """Fit the point and normal of a plane between labels in thick slices, RAS mm.

    The labels of one slice or two that lie on both sides leave the tilt open over a wide range. Of
    that range the plane takes what is near to the slices: its slopes against them have a normal
    prior distribution. The logistic function's width is a fraction of a slice, whatever the tilt.
    """
    step = float(np.linalg.norm(across))
    normal = across / step
    flat = np.linalg.svd(normal[None])[2][1:]
    low, high = below @ normal, above @ normal
    level = 0.5 * (np.quantile(low, 0.995) + np.quantile(high, 0.005))
    point, slopes = level * normal, np.zeros(2)
    prior = np.full(3, PLANE_PRIOR / np.tan(np.radians(PLANE_TILT)) ** 2)
    prior[0] = 0.0
    reach = PLANE_SLICES * step
    # From a wide function to the narrow one: Newton's method needs a start near its end.
    for width in (1.0, 0.3, PLANE_WIDTH):
        near = [
            # Whole slices often lie at just this distance: rounding must not decide about them.
            part[np.abs((part - point) @ (normal - slopes @ flat)) < reach + 1e-3]
            for part in (below, above)
        ]
        count = [len(part) for part in near]
        if min(count) < 10:  # noqa: PLR2004 -- three parameters need some voxels
            break
        points = np.vstack(near)
        offset = points - points.mean(axis=0)
        design = np.column_stack([np.ones(len(points)), offset @ flat.T])
        target, weight = np.repeat([0.0, 1.0], count), np.repeat([0.5 / n for n in count], count)
        moved = point - points.mean(axis=0)
        fit = np.array([moved @ normal - moved @ flat.T @ slopes, *slopes])
        scale = width * step
        for _ in range(50):
            p = expit((offset @ normal - design @ fit) / scale)
            gradient = design.T @ (weight * (target - p)) / scale + prior * fit
            curvature = weight * np.maximum(p * (1 - p), 1e-9) / scale**2
            change = np.linalg.solve((design.T * curvature) @ design + np.diag(prior), gradient)
            change *= min(1.0, 0.5 * scale / max(float(np.abs(design @ change).max()), 1e-12))
            fit = fit - change
            if np.abs(change).max() < 1e-6:  # noqa: PLR2004 -- converged
                break
        point, slopes = points.mean(axis=0) + fit[0] * normal, fit[1:]
    tilted = normal - slopes @ flat
    return point, tilted / np.linalg.norm(tilted)


def _logistic_plane(below: Float, above: Float, axis: Float) -> tuple[Float, Float]:
    """Fit the plane by Newton's method, starting with a normal along the axis."""
    points = np.vstack([below, above])
    target = np.repeat([0.0, 1.0], [len(below), len(above)])
    weight = np.repeat([0.5 / len(below), 0.5 / len(above)], [len(below), len(above)])
    center = points.mean(axis=0)
    scale = max(float(points.std(axis=0).mean()), 1e-9)
    design = np.column_stack([(points - center) / scale, np.ones(len(points))])
    beta = np.append(axis, 0.0)
    # A weak ridge keeps separable classes finite and leads to the widest margin.
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
    return center - beta[3] / length * scale * normal, normal
