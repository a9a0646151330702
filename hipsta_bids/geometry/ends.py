"""Where the hippocampal body begins and ends along its long axis."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import ndimage

from hipsta_bids.artifacts import Bool, Float, LabelVolume
from hipsta_bids.errors import GeometryError
from hipsta_bids.schemes import Part, Tissue
from hipsta_bids.settings import BodySettings

End = Literal["posterior", "anterior"]


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
    """``labels`` or ``subfields`` (the paper's automatic rule)."""
    anterior_rule: str
    """``labels``, ``subfields``, or ``cross-section`` (the rule ran into the head)."""
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
    volume: LabelVolume, sheet: np.ndarray[tuple[int, ...], np.dtype[np.uint8]], settings: BodySettings
) -> EndPlanes:
    """Find the planes between tail and body, and body and head.

    From labels where the segmentation has them; otherwise by the rule of Diers et al. 2023
    (section 2.1): the most anterior slice with CA2 or CA3, and the most posterior one with CA1 and
    CA2 or CA3, counted along the hippocampus's own long axis.

    Parameters
    ----------
    volume : LabelVolume
    sheet : (I, J, K) array of uint8
        Sheet tissue after the layer was given away.
    settings : BodySettings

    Returns
    -------
    EndPlanes

    Raises
    ------
    GeometryError
        ``no-body`` where no slice fulfils the rule, ``ends-crossed`` where the planes meet.
    """
    hippocampal = (volume.tissue > 0) & (volume.tissue <= Tissue.HIPPOCAMPUS) & ~np.isin(
        volume.tissue, (Tissue.FIMBRIA, Tissue.FISSURE, Tissue.CYST, Tissue.HATA)
    )
    index = np.argwhere(hippocampal)
    points = index @ volume.affine[:3, :3].T + volume.affine[:3, 3]
    parts = volume.part[hippocampal]
    axis = _long_axis(points, parts)
    half_slice = 0.5 * float(np.abs(axis @ volume.affine[:3, :3]).sum())

    is_head, is_tail = parts == Part.HEAD, parts == Part.TAIL
    is_body = ~is_head & ~is_tail
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
        # Where one end is labelled, the other is cut parallel to it.
        across = next((normal for _, normal, _ in planes.values()), axis)
        low, high, high_rule = _automatic_range(volume, sheet, across, planes, settings)
        for end, level, rule in (
            ("posterior", low, "subfields"),
            ("anterior", high, high_rule),
        ):
            if end not in planes:
                planes[end] = (level * across, across, rule)  # type: ignore[index]
    return _checked(planes, axis, half_slice)


def _checked(
    planes: dict[End, tuple[Float, Float, str]], axis: Float, half_slice: float
) -> EndPlanes:
    middle = planes["posterior"][1] + planes["anterior"][1]
    middle = middle / np.linalg.norm(middle)
    for end, (_, normal, _) in planes.items():
        tilt = np.degrees(np.arccos(np.clip(normal @ axis, -1, 1)))
        if tilt > 50:  # noqa: PLR2004 -- beyond this the labels do not end across the long axis
            raise GeometryError(
                f"the {end} end plane is tilted by {tilt:.0f} degrees against the long axis: "
                "check the head and tail labels",
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


def _long_axis(points: Float, parts: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]) -> Float:
    """First principal axis, pointing from tail to head (by labels, otherwise by +y in RAS)."""
    centred = points - points.mean(axis=0)
    _, vectors = np.linalg.eigh(centred.T @ centred)
    axis: Float = vectors[:, -1]
    sides = [points[parts == part] @ axis for part in (Part.TAIL, Part.BODY, Part.UNKNOWN, Part.HEAD)]
    known = [side.mean() for side in sides if len(side)]
    if len(known) > 1:
        sign = known[-1] - known[0]
    else:
        sign = axis[1]
    return axis if sign >= 0 else -axis


def _separating_plane(
    below: Float, above: Float, axis: Float, reach: float
) -> tuple[Float, Float]:
    """Plane between two label classes by ridge-penalised logistic regression near the interface.

    Parameters
    ----------
    below, above : (N, 3), (M, 3) arrays
        Voxel centers posterior and anterior of the interface, mm.
    axis : (3,) array
    reach : float
        Voxels within this distance of the interface count, mm.

    Returns
    -------
    point, normal : (3,) arrays
        The normal points to ``above``.
    """
    low, high = below @ axis, above @ axis
    # The classes overlap along the axis where the interface is tilted: start at the balance point.
    level = 0.5 * (np.quantile(low, 0.995) + np.quantile(high, 0.005))
    point, normal = level * axis, axis
    for _ in range(3):  # the window follows the plane's tilt
        near = [
            p[np.abs((p - point) @ normal) < reach] for p in (below, above)
        ]
        if min(len(p) for p in near) < 10:  # noqa: PLR2004 -- four parameters need some voxels
            break
        point, normal = _logistic_plane(near[0], near[1], axis)
    return point, normal


def _logistic_plane(below: Float, above: Float, axis: Float) -> tuple[Float, Float]:
    points = np.vstack([below, above])
    target = np.repeat([0.0, 1.0], [len(below), len(above)])
    weight = np.repeat([0.5 / len(below), 0.5 / len(above)], [len(below), len(above)])
    centre = points.mean(axis=0)
    scale = max(float(points.std(axis=0).mean()), 1e-9)
    design = np.column_stack([(points - centre) / scale, np.ones(len(points))])
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
    point = centre - beta[3] / length * scale * normal
    return point, normal


def _automatic_range(
    volume: LabelVolume,
    sheet: np.ndarray[tuple[int, ...], np.dtype[np.uint8]],
    axis: Float,
    known: dict[End, tuple[Float, Float, str]],
    settings: BodySettings,
) -> tuple[float, float, str]:
    """Posterior and anterior level along the axis by the subfields that the slices show, mm."""
    index = np.argwhere(sheet > 0)
    points = index @ volume.affine[:3, :3].T + volume.affine[:3, 3]
    values = sheet[sheet > 0]
    along = points @ axis
    step = float(np.abs(axis @ volume.affine[:3, :3]).max())
    first = along.min()
    slices = np.floor((along - first) / step + 0.5).astype(int)
    count = slices.max() + 1
    counts = {t: np.bincount(slices[values == t], minlength=count) for t in np.unique(values)}
    zero = np.zeros(count, dtype=int)
    ca1 = counts.get(Tissue.CA1, zero) > 0
    ca23 = sum((counts.get(t, zero) for t in (Tissue.CA2, Tissue.CA2_3, Tissue.CA3)), zero) > 0
    if "posterior" in known:
        floor = float(np.median((known["posterior"][0] @ axis)))
        eligible = first + step * np.arange(count) > floor
    else:
        eligible = np.ones(count, dtype=bool)
    both = np.flatnonzero(ca1 & ca23 & eligible)
    if not len(both):
        raise GeometryError(
            "no slice across the long axis has both CA1 and CA2/CA3, and there are no head and "
            "tail labels: cannot tell where the body lies",
            reason="no-body",
        )
    low, high = both[0], np.flatnonzero(ca23 & eligible)[-1]
    rule = "subfields"
    if "anterior" not in known:
        guarded = _before_the_head(sheet > 0, volume.affine, axis, (first, step), (low, high), settings)
        if guarded < high:
            high, rule = guarded, "cross-section"
    # Each kept slice reaches half a step to both sides.
    return (
        float(first + step * (low - 0.5) + settings.end_margin),
        float(first + step * (high + 0.5) - settings.end_margin),
        rule,
    )


def _before_the_head(
    mask: Bool,
    affine: Float,
    axis: Float,
    slicing: tuple[float, float],
    bounds: tuple[int, int],
    settings: BodySettings,
) -> int:
    """Last slice that still looks like the body.

    Where CA2/CA3 is labelled in the head, the rule of the paper runs deep into it. Going anterior
    from the middle, the body ends where the cross-section falls into two large pieces, or grows
    well beyond the posterior median twice running.
    """
    first, step = slicing
    low, high = bounds
    side = np.cross(axis, [1.0, 0, 0] if abs(axis[0]) < 0.9 else [0, 1.0, 0])  # noqa: PLR2004
    side = side / np.linalg.norm(side)
    up = np.cross(axis, side)
    pixel = float(np.min(np.linalg.norm(affine[:3, :3], axis=0)))
    inverse = np.linalg.inv(affine)
    points = np.argwhere(mask) @ affine[:3, :3].T + affine[:3, 3]
    a, b = points @ side, points @ up
    grid_a = np.arange(a.min() - 1, a.max() + 1, pixel)
    grid_b = np.arange(b.min() - 1, b.max() + 1, pixel)
    levels = first + step * np.arange(low, high + 1)
    where = (
        grid_a[None, :, None, None] * side
        + grid_b[None, None, :, None] * up
        + levels[:, None, None, None] * axis
    )
    voxel = where @ inverse[:3, :3].T + inverse[:3, 3]
    section = (
        ndimage.map_coordinates(
            mask.astype(np.float32), np.moveaxis(voxel, -1, 0), order=1, output=np.float32
        )
        > 0.5  # noqa: PLR2004 -- the mask's level
    )
    area = section.sum(axis=(1, 2)) * pixel**2
    middle = len(levels) // 2
    usual = float(np.median(area[: middle + 1]))
    in_slice = np.zeros((3, 3, 3), dtype=bool)
    in_slice[1] = True  # components are sought within each slice
    pieces, count = ndimage.label(section, structure=in_slice)
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)[1:] * pixel**2
    owner = np.zeros(count, dtype=int)
    planes = np.broadcast_to(np.arange(len(levels))[:, None, None], section.shape)
    owner[pieces[section] - 1] = planes[section]
    large = np.bincount(owner[sizes > settings.head_piece], minlength=len(levels))
    wide = area > settings.head_growth * usual
    stop = (large > 1) | (wide & np.roll(wide, 1)) | (wide & np.roll(wide, -1))
    stop[: middle + 1] = False
    hits = np.flatnonzero(stop)
    return int(low + (hits[0] - 1 if len(hits) else len(levels) - 1))
