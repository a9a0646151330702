"""The shape of a phantom: its specification, its mid-curve, and the sweep to scanner space.

A plane curve is fixed by curvature against arc length (fundamental theorem of plane curves;
do Carmo, Differential Geometry of Curves and Surfaces, section 1-5). Curvature here is a monomial
in arc length, so tangent angles are exact and positions are integrals of smooth functions.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Annotated, NamedTuple, get_type_hints

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree
from scipy.special import erf

from hipsta_bids.errors import SettingsError, did_you_mean
from hipsta_bids.types import Float

#: rad, direction in which the curve leaves its medial end, against the lateral direction. The
#: subiculum slopes down a little before the sheet turns up.
START_ANGLE = -0.35

#: RAS mm of the middle of a left body, and its pitch in rad (anterior end down), both about as in
#: an adult brain in scanner space.
CENTER = (-25.0, -20.0, -15.0)
PITCH = 0.45

#: rad, largest deviation from orthogonality in a pose.
_RIGID_TOLERANCE = 1e-6

#: mm of arc length within which two points of the mid-curve are the same: above the accuracy of
#: projection, below what a voxel can show.
_SAME_POINT = 0.02

_PANELS = 400
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)  # error far below 1e-12 mm in such panels
_SEEDS = 2000  # starting points for projection, about 0.01 mm apart


@dataclass(frozen=True, kw_only=True)
class Bend:
    """Curvature of a mid-curve: ``medial + (lateral - medial) * u ** power``, u in [0, 1]."""

    medial: float
    """1/mm at u = 0; positive where the sheet curls round its interior."""
    lateral: float
    """1/mm at u = 1."""
    power: int = 1


#: The shapes on offer. A spiral is a clothoid (curvature linear in arc length); the tight one
#: stays open for longer and ends with a radius of 1.6 mm.
KINDS: Mapping[str, Bend] = MappingProxyType(
    {
        "slab": Bend(medial=0.0, lateral=0.0),
        "arc": Bend(medial=0.25, lateral=0.25),
        "spiral": Bend(medial=0.02, lateral=0.44),
        "s-shape": Bend(medial=-0.15, lateral=0.35),
        "tight": Bend(medial=0.08, lateral=0.625, power=2),
    }
)

VARIATION_AXES = ("x", "y", "xy")


@dataclass(frozen=True, kw_only=True)
class Thinning:
    """A region of the sheet in which the wall is thinner.

    Its edges are smooth: at u and v of the limits, half of the depth is reached.
    """

    depth: float
    """mm, taken off the thickness inside; negative thickens."""
    u: tuple[float, float]
    """Limits medial to lateral, in sheet coordinates; beyond 0 or 1 there is no edge."""
    v: tuple[float, float]
    """Limits posterior to anterior."""
    edge: float = 1.0
    """mm, scale of the edges' error functions: 84 % of a step happens within this distance."""


@dataclass(frozen=True, kw_only=True)
class PhantomSpec:
    """An analytic hippocampal body. Two equal specifications are the same shape.

    Ranges only catch typing errors; whether the shape can exist is decided by the geometry.
    """

    kind: str = "spiral"
    """One of ``KINDS``: how the cross-section bends."""
    curvature: tuple[float, float] | None = None
    """1/mm at the medial and the lateral end, in place of those of the kind."""
    thickness: Annotated[float, (0.1, 10.0)] = 2.0
    """mm, mean over the sheet."""
    variation: Annotated[float, (0.0, 0.9)] = 0.0
    """Amplitude of the thickness sinusoid as a fraction of the mean, 0 to below 1."""
    variation_axis: str = "xy"
    """Where thickness varies: along x (medial-lateral), y (posterior-anterior) or both."""
    width: Annotated[float, (2.0, 100.0)] = 20.0
    """mm, arc length of the mid-curve."""
    length: Annotated[float, (2.0, 100.0)] = 16.0
    """mm, body along the long axis."""
    bend: Annotated[float, (-0.1, 0.1)] = 0.0
    """1/mm, curvature of the long axis (a circular arc, its center on the medial side if
    positive)."""
    end_length: Annotated[float, (0.0, 50.0)] = 4.0
    """mm by which head and tail go on beyond the body."""
    layer_thickness: Annotated[float, (0.0, 10.0)] = 0.0
    """mm of the wall, from its interior side, that are labeled molecular layer. The truth stays
    the whole wall, because measuring returns the layer to the sheet's subfields."""
    interior_depth: Annotated[float, (0.0, 10.0)] = 1.5
    """mm, depth of the dentate gyrus and CA4 beneath the interior side."""
    interior_start: Annotated[float, (0.0, 1.0)] = 0.45
    """Share of the hippocampal part of the mid-curve from which on dentate gyrus and CA4 line the
    interior side."""
    cortex: Annotated[float, (0.0, 80.0)] = 0.0
    """mm of the mid-curve, from its medial end, that are neighboring cortex; the hippocampal
    subfields share the rest. Drawn where the protocol has labels for it."""
    thinnings: tuple[Thinning, ...] = ()
    """Regions in which the wall is thinner. Where they overlap, depths add up."""
    offset: Annotated[float, (-0.15, 0.15)] = 0.0
    """Shift of the pattern of thickness (sinusoids and thinnings) and of the borders of subfields,
    in u from medial to lateral; the shape stays."""

    def __post_init__(self) -> None:
        _check_choice("kind", self.kind, tuple(KINDS))
        _check_choice("variation_axis", self.variation_axis, VARIATION_AXES)
        for name, hint in get_type_hints(PhantomSpec, include_extras=True).items():
            for low, high in getattr(hint, "__metadata__", ()):
                _check_range(name, getattr(self, name), low, high)
        for value in self.curvature or ():
            _check_range("curvature", value, -10.0, 10.0)
        for thinning in self.thinnings:
            _check_range("thinning depth", thinning.depth, -10.0, 10.0)
            _check_range("thinning edge", thinning.edge, 0.2, 10.0)
            for limit in (*thinning.u, *thinning.v):
                _check_range("thinning limit", limit, -1.0, 2.0)
        depth = sum(max(0.0, thinning.depth) for thinning in self.thinnings)
        thinnest = self.thickness * (1.0 - self.variation) - depth
        if thinnest <= 0.0:
            raise bad(
                f"thinning by {depth:g} mm leaves no wall of {self.thickness:g} mm; thin it less"
            )
        if self.cortex > 0.8 * self.width:
            raise bad(
                f"cortex of {self.cortex:g} mm leaves less than a fifth of the sheet's "
                f"{self.width:g} mm to the hippocampus; make it shorter"
            )
        if self.layer_thickness >= thinnest:
            raise bad(
                f"layer_thickness {self.layer_thickness:g} mm fills the wall, which is "
                f"{thinnest:g} mm at its thinnest; make the layer thinner"
            )

    @property
    def cortex_share(self) -> float:
        """Share of the mid-curve that is cortex."""
        return self.cortex / self.width

    @property
    def section_bend(self) -> Bend:
        """Curvature of the mid-curve, with the user's end values if there are any."""
        preset = KINDS[self.kind]
        if self.curvature is None:
            return preset
        medial, lateral = self.curvature
        return Bend(medial=medial, lateral=lateral, power=preset.power)


def bad(problem: str) -> SettingsError:
    """Error for a phantom that cannot be."""
    return SettingsError(f"phantom: {problem}")


def _check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise bad(
            f"{name} {value!r} is unknown; choose one of {', '.join(choices)}"
            f"{did_you_mean([value], choices)}"
        )


def _check_range(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:  # also catches NaN
        raise bad(f"{name} {value:g} is outside {low:g} to {high:g}")


class MidCurve:
    """An arc-length parametrized plane curve, its centroid at the origin.

    Plane coordinates are (lateral, superior) in mm; arc length runs medial to lateral. The
    normal points to the exterior (right of the tangent), so that a positive curvature turns the
    curve round its interior.
    """

    def __init__(self, bend: Bend, width: float) -> None:
        self.width = width
        self._bend, self._rise = bend, bend.lateral - bend.medial
        self._step = width / _PANELS
        edges = np.linspace(0.0, width, _PANELS + 1)
        steps = self._integrate(edges[:-1], np.full(_PANELS, self._step))
        self._edges = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
        s, weights = gauss_panels(0.0, width, _PANELS)
        self._edges = self._edges - weights @ self.position(s) / width
        self._seeds = np.linspace(0.0, width, _SEEDS + 1)
        self._tree = KDTree(self.position(self._seeds))

    def curvature(self, s: Float) -> Float:
        """Signed curvature at arc lengths ``s`` (mm), 1/mm."""
        return np.asarray(self._bend.medial + self._rise * (s / self.width) ** self._bend.power)

    def curvature_slope(self, s: Float) -> Float:
        """Differentiate curvature along the curve, 1/mm2."""
        power = self._bend.power
        return np.asarray(self._rise * power / self.width * (s / self.width) ** (power - 1))

    def angle(self, s: Float) -> Float:
        """Tangent angle in rad, from lateral towards superior."""
        power = self._bend.power
        turned = self._bend.medial * s + self._rise * s / (power + 1) * (s / self.width) ** power
        return np.asarray(START_ANGLE + turned)

    def tangent(self, s: Float) -> Float:
        """Return unit tangents (..., 2)."""
        angle = self.angle(s)
        return np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    def normal(self, s: Float) -> Float:
        """Return unit normals (..., 2), interior to exterior."""
        angle = self.angle(s)
        return np.stack([np.sin(angle), -np.cos(angle)], axis=-1)

    def position(self, s: Float) -> Float:
        """Points (..., 2) in mm at arc lengths ``s`` within [0, width]."""
        s = np.asarray(s, dtype=np.float64)
        panel = np.clip((s / self._step).astype(np.int64), 0, _PANELS - 1)
        start = np.asarray(panel * self._step, dtype=np.float64)
        return np.asarray(self._edges[panel] + self._integrate(start, s - start))

    def project(self, points: Float, *, reach: float = np.inf) -> tuple[Float, Float]:
        """Arc length and signed distance (N,), mm, of the nearest point on the curve.

        Distances are positive on the exterior side. Both are NaN for points (N, 2) farther than
        ``reach`` or beyond a flat end of the curve.
        """
        s = np.full(len(points), np.nan)
        n = np.full(len(points), np.nan)
        bound = reach + self._seeds[1]  # a seed may be half a step farther than the curve
        nearest = np.asarray(self._tree.query(points, distance_upper_bound=bound)[1])
        near = np.flatnonzero(nearest < len(self._seeds))
        foot = self._refine(points[near], self._seeds[nearest[near]])
        offset = points[near] - self.position(foot)
        along = np.einsum("ij,ij->i", offset, self.tangent(foot))
        across = np.einsum("ij,ij->i", offset, self.normal(foot))
        before = (foot <= 0.0) & (along < 0.0)
        after = (foot >= self.width) & (along > 0.0)
        keep = ~(before | after) & (np.abs(across) <= reach)
        s[near[keep]] = foot[keep]
        n[near[keep]] = across[keep]
        return s, n

    def foot(self, points: Float) -> Float:
        """Arc length (N,), mm, of the nearest point to points (N, 2), the ends included."""
        nearest = np.asarray(self._tree.query(points)[1])
        return self._refine(points, self._seeds[nearest])

    def _refine(self, points: Float, s: Float) -> Float:
        """Newton steps on (point - curve) . tangent = 0, from starts within half a seed step."""
        for _ in range(3):
            offset = points - self.position(s)
            along = np.einsum("ij,ij->i", offset, self.tangent(s))
            across = np.einsum("ij,ij->i", offset, self.normal(s))
            slope = np.maximum(1.0 + self.curvature(s) * across, 0.1)  # 0 at centers of curvature
            step = np.clip(along / slope, -self._seeds[1], self._seeds[1])
            s = np.clip(s + step, 0.0, self.width)
        return s

    def _integrate(self, start: Float, steps: Float) -> Float:
        """Displacement (..., 2) from ``start`` over ``steps`` of arc length."""
        half = steps[..., None] / 2.0
        at = start[..., None] + half * (1.0 + _NODES)
        total: Float = np.einsum("...qd,q->...d", self.tangent(at), _WEIGHTS)
        return total * half


def gauss_panels(low: float, high: float, panels: int) -> tuple[Float, Float]:
    """Nodes and weights (5 * panels,) of composite Gauss-Legendre quadrature on an interval."""
    edges = np.linspace(low, high, panels + 1)
    half = np.diff(edges)[:, None] / 2.0
    nodes = edges[:-1, None] + half * (1.0 + _NODES)
    return nodes.ravel(), (half * _WEIGHTS).ravel()


class ThicknessJet(NamedTuple):
    """Thickness of the wall and its derivatives by arc length s and long axis w; mm, 1, 1/mm."""

    value: Float
    s: Float
    w: Float
    ss: Float
    sw: Float
    ww: Float


#: Value, first and second derivative of a window.
Window = tuple[Float, Float, Float]


def window_jet(at: Float, limits: tuple[float, float], extent: float, edge: float) -> Window:
    """Window that is 1 between two limits and 0 outside, with error functions as edges.

    ``at``, ``extent`` and the scale ``edge`` are in mm, limits in fractions of the extent; returns
    the window, its slope (1/mm) and second derivative (1/mm2).
    """
    value, slope, second = (np.zeros(np.shape(at)) for _ in range(3))
    for limit, sign, open_end in ((limits[0], 1.0, 0.0), (limits[1], -1.0, 1.0)):
        if sign * (limit - open_end) <= 0.0:
            value = value + 0.5  # far inside an edge
            continue
        x = (at - limit * extent) / edge
        bell = np.exp(-(x**2)) / (np.sqrt(np.pi) * edge)
        value = value + 0.5 * sign * erf(x)
        slope = slope + sign * bell
        second = second - sign * 2.0 * x / edge * bell
    return value, slope, second


class Body:
    """The shape of a phantom, without labels.

    Sheet coordinates are u (medial to lateral, 0 to 1), v (posterior to anterior, 0 to 1; head
    and tail lie beyond) and n (mm from the mid-surface, positive on the exterior side).
    """

    def __init__(self, spec: PhantomSpec) -> None:
        self.spec = spec
        self.curve = MidCurve(spec.section_bend, spec.width)
        self._refuse_folds()
        self._refuse_overlap()

    def thickness(self, u: Float, v: Float) -> Float:
        """Thickness of the wall along its mid-surface's normal, mm."""
        return self.thickness_jet(u, v).value

    def thickness_jet(self, u: Float, v: Float) -> ThicknessJet:
        """Thickness and its derivatives; the sinusoids are added, so they have no mixed one."""
        spec = self.spec
        u, v = np.broadcast_arrays(np.asarray(u, np.float64), np.asarray(v, np.float64))
        u = u - spec.offset
        amplitude = spec.thickness * spec.variation / len(spec.variation_axis)
        by_s, by_w = 2.0 * np.pi / spec.width, 2.0 * np.pi / spec.length
        x, y = (amplitude * (axis in spec.variation_axis) for axis in "xy")
        a, b = 2.0 * np.pi * u, 2.0 * np.pi * v
        jet = ThicknessJet(
            value=spec.thickness + x * np.sin(a) + y * np.sin(b),
            s=x * by_s * np.cos(a),
            w=y * by_w * np.cos(b),
            ss=-x * by_s**2 * np.sin(a),
            sw=np.zeros(u.shape),
            ww=-y * by_w**2 * np.sin(b),
        )
        for thinning in spec.thinnings:
            across = window_jet(u * spec.width, thinning.u, spec.width, thinning.edge)
            along = window_jet(v * spec.length, thinning.v, spec.length, thinning.edge)
            orders = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
            windows = (thinning.depth * across[i] * along[j] for i, j in orders)
            jet = ThicknessJet(*(a - b for a, b in zip(jet, windows, strict=True)))
        return jet

    @cached_property
    def thickest(self) -> float:
        """Largest thickness anywhere, mm, or a little more."""
        grown = sum(max(0.0, -thinning.depth) for thinning in self.spec.thinnings)
        return self.spec.thickness * (1.0 + self.spec.variation) + grown

    def place(
        self,
        u: ArrayLike,
        v: ArrayLike,
        n: ArrayLike,
        *,
        hemi: str = "L",
        pose: Float | None = None,
    ) -> Float:
        """Scanner coordinates (..., 3), RAS mm, of sheet coordinates (u, v, n)."""
        across, along, off = np.broadcast_arrays(
            *(np.asarray(x, dtype=np.float64) for x in (u, v, n))
        )
        s = across * self.spec.width
        section = self.curve.position(s) + off[..., None] * self.curve.normal(s)
        w = (along - 0.5) * self.spec.length
        rotation, shift = placement(hemi, pose)
        return np.asarray(self._sweep(section, w) @ rotation.T + shift)

    def locate(
        self, points: Float, *, hemi: str = "L", pose: Float | None = None, reach: float = np.inf
    ) -> Float:
        """Sheet coordinates (N, 3) of scanner points (N, 3): the inverse of :meth:`place`.

        Rows are (u, v, n) of the nearest point on the mid-surface. They are NaN for points
        beyond the flat ends u = 0 and u = 1, or farther than ``reach`` (mm) from the mid-surface.
        """
        rotation, shift = placement(hemi, pose)
        section, w = self._unsweep((points - shift) @ rotation)
        s, n = self.curve.project(section, reach=reach)
        v = np.where(np.isnan(s), np.nan, w / self.spec.length + 0.5)
        return np.column_stack([s / self.spec.width, v, n])

    def _sweep(self, section: Float, w: Float) -> Float:
        """Section points (..., 2) carried to arc length ``w`` of the long axis: body (..., 3).

        A straight axis is the limit of no bend; sinc carries it without a special case.
        """
        bend, angle = self.spec.bend, w * self.spec.bend
        medial, superior = -section[..., 0], section[..., 1]
        rise = w * np.sin(angle / 2.0) * np.sinc(angle / (2.0 * np.pi))
        along = w * np.sinc(angle / np.pi)
        shrink = 1.0 - bend * medial
        return np.stack([-(medial * np.cos(angle) + rise), superior, along * shrink], axis=-1)

    def _unsweep(self, body: Float) -> tuple[Float, Float]:
        """Inverse of :meth:`_sweep`: section points (N, 2) and arc lengths (N,) of the axis."""
        bend = self.spec.bend
        lateral, superior, anterior = body.T
        if bend == 0.0:
            return np.column_stack([lateral, superior]), anterior
        inward = 1.0 + bend * lateral
        w = np.arctan2(bend * anterior, inward) / bend
        medial = (1.0 - np.hypot(inward, bend * anterior)) / bend
        return np.column_stack([-medial, superior]), w

    def _refuse_folds(self) -> None:
        """Refuse a wall or an axis that is bent more sharply than its extent allows."""
        spec = self.spec
        s = np.linspace(0.0, spec.width, 1001)
        sharpest = np.abs(self.curve.curvature(s)).max()
        if sharpest * self.thickest / 2.0 >= 1.0:
            raise bad(
                f"the wall folds: half its thickness ({self.thickest:g} mm) reaches the "
                f"curvature radius {1.0 / sharpest:.2f} mm; make it thinner or straighter"
            )
        inward = np.max(-np.sign(spec.bend) * self.curve.position(s)[:, 0]) + self.thickest / 2.0
        turned = abs(spec.bend) * (spec.length + 2.0 * spec.end_length)
        if abs(spec.bend) * inward >= 1.0 or turned >= np.pi:
            raise bad(
                f"the axis bends too sharply ({spec.bend:g} 1/mm) for {inward:.1f} mm inward "
                f"and a length of {spec.length + 2.0 * spec.end_length:g} mm; reduce the bend"
            )

    def _refuse_overlap(self) -> None:
        """Refuse a wall of which one turn runs into another.

        Two turns overlap exactly if, from a boundary point of one, some other point of the
        mid-curve is nearer than the one it belongs to, or as near where they coincide.
        """
        u, v = np.meshgrid(np.linspace(0.0, 1.0, 801), np.linspace(0.0, 1.0, 5), indexing="ij")
        half = self.thickness(u, v).ravel() / 2.0
        s = u.ravel() * self.spec.width
        for side in (-1.0, 1.0):
            boundary = self.curve.position(s) + side * half[:, None] * self.curve.normal(s)
            overlapping = np.abs(self.curve.foot(boundary) - s) > _SAME_POINT
            if overlapping.any():
                raise bad(
                    f"turns of the wall overlap near u = {u.ravel()[overlapping][0]:.2f}; "
                    "make it thinner, narrower or bend it less"
                )


def placement(hemi: str, pose: Float | None) -> tuple[Float, Float]:
    """Body to scanner: an orthogonal (3, 3) matrix and a shift (3,) in RAS mm."""
    if hemi not in ("L", "R"):
        raise bad(f"hemi {hemi!r} is unknown; choose L or R")
    cos, sin = np.cos(PITCH), np.sin(PITCH)
    mirror = np.diag([1.0 if hemi == "L" else -1.0, 1.0, 1.0])
    # Columns: where lateral, superior and anterior point in a left hemisphere.
    axes = np.array([[-1.0, 0.0, 0.0], [0.0, sin, cos], [0.0, cos, -sin]])
    rotation, shift = mirror @ axes, mirror @ np.array(CENTER)
    if pose is not None:
        pose = np.asarray(pose, dtype=np.float64)
        check_rotation(pose[:3, :3])
        rotation, shift = pose[:3, :3] @ rotation, pose[:3, :3] @ shift + pose[:3, 3]
    return rotation, shift


def check_rotation(matrix: Float) -> None:
    """Refuse a matrix that is no proper rotation (3, 3) with a SettingsError."""
    error = np.abs(matrix @ matrix.T - np.eye(3)).max()
    if not error < _RIGID_TOLERANCE or np.linalg.det(matrix) < 0.0:
        raise bad(
            "the pose or grid rotation is not rigid; give a rotation matrix without "
            "scaling or mirroring"
        )
