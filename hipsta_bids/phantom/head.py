"""Labels of a hippocampus with a head: a spiral wall of known thickness along a hooked axis.

The wall is what lies within half its thickness of a surface: a spiral in each section, carried
along an axis that is straight along y and then turns medially in a circle. Digitations are folds
of that surface before the hook: arcs with straight banks between them, upright in CA1.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import translate
from hipsta_bids.types import Float, GivenEnd, LabelVolume

RADIUS = 4.0
"""Of the spiral, mm."""
_ARC, _FIRST = np.deg2rad(240), np.deg2rad(-30)
_BEND, _TURN = 9.0, np.deg2rad(100)
"""Radius of the hook, mm, and its angle."""
_FOLDED, _RISE = (0.2, 0.8), 0.15
"""Shares of the spiral between which it has folds, and over which their banks rise."""
_STEP = 0.04
"""Between points of the folded surface along the axis, mm."""
_CORE, _LAYER, _LEAVES = 2.0, 0.5, 1.2
"""Radius of the dentate gyrus and thickness of the molecular layer, mm; the share of the spiral up
to which the gyrus lies beside CA3."""


@dataclass(frozen=True, kw_only=True)
class HeadSpec:
    """Shape of a phantom with a head; lengths in mm."""

    thickness: float = 1.5
    uneven: float = 0.0
    """Share by which the wall is thicker at its edges, and thinner midway between them."""
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


def draw_head(spec: HeadSpec) -> LabelVolume:
    """Draw the labels of a left hemisphere, with the ends of its body; no wall runs along voxels.

    Labels are those of the protocol ``cobralab``; the tail ends bluntly at y = 0.
    """
    reach = 2 * spec.bank + 2 * RADIUS
    low = np.array([-reach, -3.0, -reach])
    high = np.array([2 * _BEND + 1, spec.straight + _BEND + 7, reach])
    rotation = Rotation.from_euler("xyz", [9, 6, 7], degrees=True).as_matrix()
    shape = np.ceil(1.25 * (high - low) / spec.voxel).astype(int)
    affine = np.eye(4)
    affine[:3, :3] = spec.voxel * rotation
    affine[:3, 3] = (low + high) / 2 - affine[:3, :3] @ ((shape - 1) / 2)
    points = np.moveaxis(np.indices(shape), 0, -1) @ affine[:3, :3].T + affine[:3, 3]
    x, y, z = np.moveaxis(points, -1, 0)
    from_axis = np.hypot(x - _BEND, y - spec.straight)
    hooked = y > spec.straight
    across = np.where(hooked, _BEND - from_axis, x)
    within = np.where(hooked, np.arctan2(y - spec.straight, _BEND - x) < _TURN, y > 0)
    radius = np.hypot(across, z)
    share = (_FIRST - np.arctan2(z, across)) % (2 * np.pi) / _ARC
    outward = radius - RADIUS
    if spec.digitations:
        surface, normals, top = _folded_surface(spec)
        near = ~hooked & (share > _FOLDED[0]) & (share < _FOLDED[1]) & (y > spec.ends[1])
        near &= (radius > 1) & (outward < top + spec.thickness)
        found, nearest = cKDTree(surface).query(points[near])
        side = ((points[near] - surface[nearest]) * normals[nearest]).sum(axis=1)
        height = outward / top
        outward[near] = np.where(side > 0, found, -found)
        if spec.filled:
            deep = height < 1 / 2
            half = deep if spec.filled == "deep" else ~deep & (height < 1)
            crests = (spec.digitations - 1) / 2 * _period(spec)
            between = np.abs(y - _middle(spec)) < crests
            upright = np.abs(share - np.mean(_FOLDED)) < np.ptp(_FOLDED) / 2 - _RISE
            outward[near & half & (outward > 0) & between & upright] = 0
    half = spec.thickness / 2 * (1 + spec.uneven * np.cos(2 * np.pi * share))
    wall = (np.abs(outward) < half) & (share < 1)
    codes = np.where((outward < 0) & (share < _LEAVES), 4, 0)
    codes[radius < _CORE] = 4
    codes[(outward < 0) & (outward > -half - _LAYER) & (share < 1)] = 6
    codes[wall] = np.select([share < 0.25, share < 0.7], [2, 1], 5)[wall]  # noqa: PLR2004
    protocol = load_protocol("cobralab")
    tissue, part = translate(np.where(within, codes, 0), protocol)
    ends = (
        GivenEnd(end="posterior", point=(0, spec.ends[0], 0), normal=(0, 1, 0)),
        GivenEnd(end="anterior", point=(0, spec.ends[1], 0), normal=(0, 1, 0)),
    )
    return LabelVolume(tissue=tissue, part=part, affine=affine, protocol=protocol, given_ends=ends)


def _folded_surface(spec: HeadSpec) -> tuple[Float, Float, float]:
    """Points (N, 3) of the folded surface, their outward normals, and the height of its folds."""
    pieces = []
    for share in np.arange(*_FOLDED, 0.006):
        rise = np.clip((np.ptp(_FOLDED) / 2 - abs(share - np.mean(_FOLDED))) / _RISE, 0.01, 1)
        rise *= rise * (3 - 2 * rise)
        along, height, angle = _meander(spec, rise)
        flat = np.arange(_STEP, spec.straight, 2 * _STEP)
        before, after = along[0] - flat, along[-1] + flat
        y = _middle(spec) + np.concatenate([before, along, after])
        height, angle = (np.pad(values, len(flat)) for values in (height, angle))
        turn = _FIRST - share * _ARC
        across = np.array([np.cos(turn), 0, np.sin(turn)])
        point = (RADIUS + height)[:, None] * across + y[:, None] * [0, 1, 0]
        normal = np.cos(angle)[:, None] * across - np.sin(angle)[:, None] * [0, 1, 0]
        pieces.append((point, normal, height.max()))
    points, normals, heights = zip(*pieces, strict=True)
    return np.concatenate(points), np.concatenate(normals), max(heights)


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
