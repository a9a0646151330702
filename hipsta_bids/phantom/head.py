"""Labels of a hippocampus with a head: a spiral wall of known thickness along a hooked axis.

The wall is what lies within half its thickness of a surface: a spiral in each section, carried
along an axis that is straight along y and then turns medially in a circle. Digitations are folds
of that surface before the hook: arcs with straight banks between them, upright in CA1.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from hipsta_bids.errors import SettingsError
from hipsta_bids.phantom.labels import label_for, make_grid
from hipsta_bids.phantom.shape import placement
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Part, Protocol, Tissue
from hipsta_bids.types import End, Float, GivenEnd, LabelVolume

RADIUS = 4.0
"""Of the spiral, mm, if no other is given."""
_ARC, _FIRST = np.deg2rad(240), np.deg2rad(-30)
_BEND, _TURN = 9.0, np.deg2rad(100)
"""Radius of the hook, mm, and its angle."""
_FOLDED, _RISE = (0.2, 0.8), 0.15
"""Shares of the spiral between which it has folds, and over which their banks rise."""
_SUBFIELDS = (Tissue.SUBICULUM, Tissue.CA1, Tissue.CA2, Tissue.CA3)
_BORDERS = (0.25, 0.7, 0.78)
"""Shares at which the second and following subfields begin."""
_WALLS, _TAPER = (0.5, 3.5), 3.0
"""Thickness of walls that can be drawn, and over how much of the axis it changes, mm."""
_CELLS = 120
"""Grid of the mid-surface, across; twice as many along each part."""
_SPANS = {"tail": (0, 1), "body": (1, 2), "head": (2, 3), "headbody": (1, 3), "whole": (0, 3)}
"""Regions and parts: from which part to before which, of tail, body and head."""
_STEP = 0.04
"""Between points of the folded surface along the axis, mm."""
_CORE, _LAYER, _LEAVES = 2.0, 0.5, 1.2
"""Radius of the dentate gyrus and thickness of the molecular layer, mm; the share of the spiral up
to which the gyrus lies next to CA3."""


@dataclass(frozen=True, kw_only=True)
class HeadSpec:
    """Shape of a phantom with a head; lengths in mm."""

    kind: ClassVar[str] = "head"
    cortex: ClassVar[float] = 0.0
    thickness: float = 1.5
    uneven: float = 0.0
    """Share by which the wall is thicker at its edges, and thinner midway between them."""
    thinning: float = 0.0
    """By how much the wall of the head is thinner, from 3 mm before the body on."""
    radius: float = RADIUS
    straight: float = 22.0
    """Length of the axis up to the hook."""
    ends: tuple[float, float] = (5.0, 20.0)
    """y of the two ends of the body."""
    digitations: int = 0
    """Folds midway between the body and the hook."""
    bank: float = 1.5
    """Height of the straight part of a bank."""
    interior: float = 0.8
    """Width of the clefts on the interior side; none are left at 0."""
    exterior: float = 0.8
    filled: Literal["", "deep", "shallow"] = ""
    """Half of the exterior clefts in which the labels have no gap."""
    voxel: float = 0.4
    taper: float = 0.0
    """Over so much of the axis the sheet narrows towards both ends, to a third of its width."""

    def __post_init__(self) -> None:
        low, high = _WALLS
        if not all(low <= self.thickness - thinning <= high for thinning in (0.0, self.thinning)):
            raise SettingsError(
                f"phantom: a wall of {self.thickness:g} mm, {self.thinning:g} mm thinner in the "
                f"head, exceeds {low:g} to {high:g} mm; choose others"
            )


def draw_head(spec: HeadSpec) -> LabelVolume:
    """Draw the labels of a left hemisphere, with the ends of its body; no wall runs along voxels.

    Labels follow the protocol ``cobralab``; the tail ends bluntly at y = 0.
    """
    reach = 2 * spec.bank + 2 * spec.radius
    low = np.array([-reach, -3.0, -reach])
    high = np.array([2 * _BEND + 1, spec.straight + _BEND + 7, reach])
    rotation = Rotation.from_euler("xyz", [9, 6, 7], degrees=True).as_matrix()
    shape = np.ceil(1.25 * (high - low) / spec.voxel).astype(int)
    affine = np.eye(4)
    affine[:3, :3] = spec.voxel * rotation
    affine[:3, 3] = (low + high) / 2 - affine[:3, :3] @ ((shape - 1) / 2)
    points = np.moveaxis(np.indices(shape), 0, -1) @ affine[:3, :3].T + affine[:3, 3]
    protocol = load_protocol("cobralab")
    tissue, part = _labeled(_tissues(spec, points), Part.BODY, protocol)
    ends = (
        GivenEnd(end="posterior", point=(0, spec.ends[0], 0), normal=(0, 1, 0)),
        GivenEnd(end="anterior", point=(0, spec.ends[1], 0), normal=(0, 1, 0)),
    )
    return LabelVolume(tissue=tissue, part=part, affine=affine, protocol=protocol, given_ends=ends)


def _tissues(spec: HeadSpec, points: Float) -> NDArray[np.uint8]:
    """Tissue at points (..., 3), mm to medial, anterior and superior, in the finest division."""
    x, y, z = np.moveaxis(points, -1, 0)
    from_axis = np.hypot(x - _BEND, y - spec.straight)
    hooked = y > spec.straight
    across = np.where(hooked, _BEND - from_axis, x)
    hook = np.arctan2(y - spec.straight, _BEND - x)
    within = np.where(hooked, hook < _TURN, y > 0)
    radius = np.hypot(across, z)
    share = (_FIRST - np.arctan2(z, across)) % (2 * np.pi) / _ARC
    outward = radius - spec.radius
    if spec.digitations:
        surface, normals, top = _folded_surface(spec)
        near = ~hooked & (share > _FOLDED[0]) & (share < _FOLDED[1]) & (y > spec.ends[1])
        near &= (radius > 1) & (outward < top + spec.thickness)
        distance, nearest = cKDTree(surface).query(points[near])
        side = ((points[near] - surface[nearest]) * normals[nearest]).sum(axis=1)
        height = outward / top
        outward[near] = np.where(side > 0, distance, -distance)
        if spec.filled:
            deep = height < 1 / 2
            half = deep if spec.filled == "deep" else ~deep & (height < 1)
            crests = (spec.digitations - 1) / 2 * _period(spec)
            between = np.abs(y - _middle(spec)) < crests
            upright = np.abs(share - np.mean(_FOLDED)) < np.ptp(_FOLDED) / 2 - _RISE
            outward[near & half & (outward > 0) & between & upright] = 0
    along = np.where(hooked, spec.straight + _BEND * hook, y)
    half, spared = _wall(spec, along, share) / 2, _spared(spec, along)
    wall = (np.abs(outward) < half) & (share > spared) & (share < 1 - spared)
    gyrus = ((outward < 0) & (share < _LEAVES)) | (radius < _CORE)
    tissue = np.where(gyrus, Tissue.DENTATE_GYRUS, 0).astype(np.uint8)
    tissue[(outward < 0) & (outward > -half - _LAYER) & (share < 1)] = Tissue.MOLECULAR_LAYER
    tissue[wall] = np.array(_SUBFIELDS)[
        np.searchsorted(_BORDERS, ((share - spared) / (1 - 2 * spared))[wall])
    ]
    return np.where(within, tissue, 0).astype(np.uint8)


def _wall(spec: HeadSpec, along: Float, share: Float) -> Float:
    """Thickness of the wall by the place along the axis and the share of the spiral, mm."""
    rise = np.clip((along - spec.ends[1]) / _TAPER, 0, 1)
    wall = spec.thickness - spec.thinning * rise**2 * (3 - 2 * rise)
    return np.asarray(wall * (1 + spec.uneven * np.cos(2 * np.pi * share)))


def _spared(spec: HeadSpec, along: Float) -> Float:
    """Share of the spiral without a wall on either side."""
    end = np.minimum(along, spec.straight + _BEND * _TURN - along)
    return np.asarray((1 - np.clip(end / max(spec.taper, 1e-9), 0, 1)) ** 2 / 3)


def _labeled(
    tissue: NDArray[np.uint8], part: NDArray[np.uint8] | Part, protocol: Protocol
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Tissue and part as a protocol has labels for them; those of the body where it has no others.

    Without labels of parts subfields go on in head and tail.
    """
    table = np.zeros((2, max(Tissue) + 1, max(Part) + 1), dtype=np.uint8)
    for code in np.unique(tissue[tissue > 0]):
        for part_code in (Part.BODY, Part.HEAD, Part.TAIL):
            labels = (label_for(protocol, Tissue(code), p) for p in (part_code, Part.BODY))
            if label := next(filter(None, labels), None):
                table[:, code, part_code] = label.tissue, label.part
    return table[0, tissue, part], table[1, tissue, part]


class HeadPhantom:
    """A hippocampus with a head, as :class:`Phantom` is one of a body."""

    regions = ("body", "headbody", "whole")

    def __init__(self, spec: HeadSpec) -> None:
        self.spec = spec

    def label_volume(
        self,
        protocol: Protocol,
        *,
        hemi: str,
        pose: Float | None,
        voxel_size: tuple[float, float, float],
        axes: str,
    ) -> LabelVolume:
        """Draw the phantom as a segmentation; the arguments are as of :class:`Phantom`."""
        rotation, shift = self._placement(hemi, pose)
        outer = [
            (points + wall[..., None] * out).reshape(-1, 3) for points, out, wall in self._parts
        ]
        outline = np.concatenate(outer) @ rotation.T + shift
        shape, affine = make_grid(
            outline, voxel_size=voxel_size, axes=axes, rotation=None, border=3.0
        )
        points = np.moveaxis(np.indices(shape), 0, -1) @ affine[:3, :3].T
        points = (points + affine[:3, 3] - shift) @ rotation
        tissue = _tissues(self.spec, points)
        # In other protocols the layer belongs to the body's sheet, which then were thicker.
        tissue[tissue == Tissue.MOLECULAR_LAYER] = Tissue.DENTATE_GYRUS
        parts = np.array([Part.TAIL, Part.BODY, Part.HEAD], dtype=np.uint8)
        part = parts[np.searchsorted(self.spec.ends, points[..., 1])]
        tissue, part = _labeled(tissue, part, protocol)
        return LabelVolume(tissue=tissue, part=part, affine=affine, protocol=protocol)

    def ends(self, hemi: str, pose: Float | None) -> dict[End, Float]:
        """Return a point and the normal (6,) of the planes at which the body ends, RAS mm."""
        rotation, shift = self._placement(hemi, pose)
        names: tuple[End, End] = ("posterior", "anterior")
        return {
            name: np.concatenate([rotation @ [0, y, 0] + shift, rotation[:, 1]])
            for name, y in zip(names, self.spec.ends, strict=True)
        }

    def _placement(self, hemi: str, pose: Float | None) -> tuple[Float, Float]:
        """Matrix and shift of medial, anterior and superior to the scanner, mm."""
        rotation, shift = placement(hemi, pose)
        rotation = rotation[:, [0, 2, 1]] * [-1, 1, 1]
        return rotation, shift - rotation @ [0, sum(self.spec.ends) / 2, 0]

    def region_summary(self, region: str) -> dict[str, float]:
        """Return what a perfect method would measure in a region, or a part, as a whole."""
        first, last = _SPANS[region]
        sums = [_sums(*part) for part in self._parts[first:last]]
        total = {name: sum(part[name] for part in sums) for name in sums[0]}
        mean = total["thickness_mean"] / total["area_mid"]
        across = total["area_mid"] / total["extent_y"]
        return {**total, "thickness_mean": mean, "extent_x": across, "extent_z": mean}

    @cached_property
    def _parts(self) -> list[tuple[Float, Float, Float]]:
        """Points (S, L, 3), outward normals and thickness on the mid-surface of each part."""
        limits = (0.0, *self.spec.ends, self.spec.straight + _BEND * _TURN)
        return [_grid(self.spec, *part) for part in pairwise(limits)]


def _grid(spec: HeadSpec, low: float, high: float) -> tuple[Float, Float, Float]:
    """Points (S, L, 3), outward normals and thickness between two places on the axis."""
    shares, lines = np.linspace(0, 1, _CELLS), []
    for share in shares.tolist():
        along, *bent = _line(spec, share)
        inside = (along > low) & (along < high)
        line = np.concatenate([[low], along[inside], [high]])
        all_lines = (line, *(np.pad(values[inside], 1) for values in bent))
        at = np.linspace(0, len(line) - 1, 2 * _CELLS)
        lines.append([np.interp(at, np.arange(len(line)), values) for values in all_lines])
    along, *bent = np.stack(lines, axis=1)
    spared = _spared(spec, along)
    share = spared + shares[:, None] * (1 - 2 * spared)
    points, normals = _place(spec, share, along, *bent)
    return points, normals, _wall(spec, along, share)


def _sums(points: Float, normals: Float, thickness: Float) -> dict[str, float]:
    """Areas, volume, and thickness times area of the wall round a grid (S, L); mm2 and mm3.

    Also the mean length of its lines, mm. The area of a parallel surface is quadratic in its
    distance (Steiner's formula), so Simpson's rule gives the volume.
    """
    offsets = (side * thickness[..., None] * normals for side in (-0.5, 0.0, 0.5))
    areas = [_areas(points + offset) for offset in offsets]
    wall = (thickness[1:, 1:] + thickness[:-1, :-1]) / 2
    inner, mid, outer = (float(area.sum()) for area in areas)
    return {
        "thickness_mean": float((areas[1] * wall).sum()),
        "extent_y": float(np.linalg.norm(np.diff(points, axis=1), axis=-1).sum(axis=1).mean()),
        "volume": float((wall * (areas[0] + 4 * areas[1] + areas[2])).sum()) / 6,
        "area_interior": inner,
        "area_mid": mid,
        "area_exterior": outer,
    }


def _areas(points: Float) -> Float:
    """Area (S - 1, L - 1) of the cells of a grid of points (S, L, 3)."""
    diagonal, antidiagonal = points[1:, 1:] - points[:-1, :-1], points[1:, :-1] - points[:-1, 1:]
    return np.asarray(np.linalg.norm(np.cross(diagonal, antidiagonal), axis=-1) / 2)


def _place(
    spec: HeadSpec, share: Float | float, along: Float, height: Float, angle: Float
) -> tuple[Float, Float]:
    """Points (..., 3) of the surface and outward normals.

    ``along`` is where on the axis, also in the hook; ``height`` and ``angle`` are those of folds.
    """
    turn, hook = _FIRST - share * _ARC, np.maximum(along - spec.straight, 0) / _BEND
    medial = (spec.radius + height) * np.cos(turn)
    x = _BEND - (_BEND - medial) * np.cos(hook)
    y = np.minimum(along, spec.straight) + (_BEND - medial) * np.sin(hook)
    points = np.stack([x, y, (spec.radius + height) * np.sin(turn)], axis=-1)
    outward, forward = np.cos(angle) * np.cos(turn), -np.sin(angle)
    across = outward * np.cos(hook) + forward * np.sin(hook)
    front = forward * np.cos(hook) - outward * np.sin(hook)
    return points, np.stack([across, front, np.cos(angle) * np.sin(turn)], axis=-1)


def _line(spec: HeadSpec, share: float) -> tuple[Float, Float, Float]:
    """Place along the axis, height and direction of a line of the surface, tail to hook."""
    rise = np.clip((np.ptp(_FOLDED) / 2 - abs(share - np.mean(_FOLDED))) / _RISE, 0.01, 1)
    flat = np.arange(_STEP, spec.straight, 2 * _STEP)
    along = height = angle = np.zeros(1)
    if spec.digitations:
        along, height, angle = _meander(spec, rise * rise * (3 - 2 * rise))
    along = _middle(spec) + np.concatenate([along[0] - flat[::-1], along, along[-1] + flat])
    return along, np.pad(height, len(flat)), np.pad(angle, len(flat))


def _folded_surface(spec: HeadSpec) -> tuple[Float, Float, float]:
    """Points (N, 3) of the folded surface, their outward normals, and the height of its folds."""
    lines = [(share, *_line(spec, share)) for share in np.arange(*_FOLDED, 0.006)]
    points, normals = zip(*(_place(spec, *line) for line in lines), strict=True)
    top = max(height.max() for _, _, height, _ in lines)
    return np.concatenate(points), np.concatenate(normals), top


def _meander(spec: HeadSpec, rise: float) -> tuple[Float, Float, Float]:
    """Place along the axis, height and direction, radians, of folds whose banks rise to a share.

    Arcs are wider where banks are less steep, so that all folds have the same period.
    """
    steep, bank = rise * np.pi / 2, rise * spec.bank
    interior, exterior = _arcs(spec)
    half = _period(spec) / 2
    wider = (half - bank * np.cos(steep)) / (half * np.sin(steep))
    out, top = exterior * wider * steep, 2 * interior * wider * steep
    lengths = np.tile([out, bank, top, bank, out], spec.digitations)
    knots = np.concatenate([[0], lengths.cumsum()])
    angles = np.append(np.tile([0, steep, steep, -steep, -steep], spec.digitations), 0)
    step = knots[-1] / np.ceil(knots[-1] / _STEP)
    angle = np.interp(np.arange(step / 2, knots[-1], step), knots, angles)
    along, height = (step * (f(angle).cumsum() - f(angle) / 2) for f in (np.cos, np.sin))
    return along - along[-1] / 2, height, angle


def _arcs(spec: HeadSpec) -> tuple[float, float]:
    """Radii of the surface round interior and exterior clefts."""
    return (spec.thickness + spec.interior) / 2, (spec.thickness + spec.exterior) / 2


def _period(spec: HeadSpec) -> float:
    return 2 * sum(_arcs(spec))


def _middle(spec: HeadSpec) -> float:
    """Where along y the folds have their middle, mm."""
    return (spec.ends[1] + spec.straight) / 2
