"""The mid-curve of a cross-section: a plane curve given by its curvature.

A plane curve is fixed by curvature against arc length (fundamental theorem of plane curves;
do Carmo, Differential Geometry of Curves and Surfaces, section 1-5). Curvature here is a monomial
in arc length, so tangent angles are exact and positions are integrals of smooth functions.
"""

import numpy as np
from scipy.spatial import KDTree

from hipsta_bids.artifacts import Float
from hipsta_bids.phantom.spec import Bend

#: rad, direction in which the curve leaves its medial end, against the lateral direction. The
#: subiculum slopes down a little before the sheet turns up.
START_ANGLE = -0.35

_PANELS = 400
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)  # error far below 1e-12 mm in such panels
_SEEDS = 2000  # starting points for projection, about 0.01 mm apart


class MidCurve:
    """An arc-length parametrized plane curve, its centroid at the origin.

    Plane coordinates are (lateral, superior) in mm; arc length runs medial to lateral. The
    normal points to the exterior (right of the tangent), so that a positive curvature turns the
    curve round its interior.

    Parameters
    ----------
    bend : Bend
        Curvature at both ends, 1/mm.
    width : float
        Arc length, mm.
    """

    def __init__(self, bend: Bend, width: float) -> None:
        self.width = width
        self._bend = bend
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
        rise = self._bend.lateral - self._bend.medial
        return np.asarray(self._bend.medial + rise * (s / self.width) ** self._bend.power)

    def curvature_slope(self, s: Float) -> Float:
        """Return the derivative of curvature along the curve, 1/mm2."""
        power = self._bend.power
        rise = self._bend.lateral - self._bend.medial
        return np.asarray(rise * power / self.width * (s / self.width) ** (power - 1))

    def angle(self, s: Float) -> Float:
        """Tangent angle in rad, from lateral towards superior."""
        power = self._bend.power
        rise = self._bend.lateral - self._bend.medial
        turned = self._bend.medial * s + rise * s / (power + 1) * (s / self.width) ** power
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
        """Find the nearest place on the curve.

        Parameters
        ----------
        points : (N, 2) array
            mm.
        reach : float
            mm; points farther than this from the curve are left out.

        Returns
        -------
        s : (N,) array
            Arc length, mm; NaN where out of reach, or beyond a flat end of the curve.
        n : (N,) array
            Signed distance, mm, positive on the exterior side; NaN likewise.
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
        """Arc length (N,), mm, of the nearest place to points (N, 2), the ends included."""
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
