"""Exact thickness, curvature, areas and volume of a phantom.

The three surfaces are ``mid(s, w) + n(s, w) * normal(s, w)`` with n = -T/2, 0 and T/2. Their
derivatives are written out in the frame that moves with the sweep, so curvature is a formula and
holds for varying thickness too. Areas and volume integrate smooth functions by Gauss-Legendre
quadrature, to better than 1e-9 of their value.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.artifacts import Float
from hipsta_bids.phantom.body import Body
from hipsta_bids.phantom.curve import gauss_panels

#: Where a surface lies in the wall, as a fraction of its thickness from the mid-surface.
SURFACES: Mapping[str, float] = {"interior": -0.5, "mid": 0.0, "exterior": 0.5}

_PANELS_U, _PANELS_V = 40, 20


@dataclass(frozen=True, eq=False, kw_only=True)
class PhantomTruth:
    """What a perfect method would measure at positions (u, v) of the sheet."""

    thickness: Float
    """mm, along the normal of the mid-surface, wall to wall."""
    points: Float
    """(..., 3) RAS mm, on the mid-surface."""
    curvature_interior: Float
    """Mean curvature (half the sum of the principal curvatures), 1/mm; positive where the sheet
    curls round its interior. Likewise below."""
    curvature: Float
    """Of the mid-surface."""
    curvature_exterior: Float
    subfield: NDArray[np.uint8]
    """Values of :class:`~hipsta_bids.schemes.Tissue`, in the finest division."""
    summary: Mapping[str, float]
    """The whole body, see :func:`summarize`."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Jet:
    """First and second derivatives (..., 3) of a surface by arc length s and long axis w.

    Components are (tangent and normal of the cross-section, long axis).
    """

    s: Float
    w: Float
    ss: Float
    sw: Float
    ww: Float


def mean_curvature(body: Body, u: Float, v: Float, *, at: float) -> Float:
    """Mean curvature at positions (u, v) of a surface of the wall, 1/mm.

    ``at`` is the surface's place in the wall, from -0.5 (interior) to 0.5 (exterior). With
    E, F, G and e, f, g the coefficients of the first and second fundamental form,
    H = (e G - 2 f F + g E) / (2 (E G - F^2)) (do Carmo, Differential Geometry of Curves and
    Surfaces, section 3-3), here for the normal that points to the interior.
    """
    jet = _surface_jet(body, u, v, at)
    normal = np.cross(jet.s, jet.w)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    normal *= -np.sign(normal[..., 1:2])  # to the interior: the section's normal points away
    first_ss, first_sw, first_ww = _dot(jet.s, jet.s), _dot(jet.s, jet.w), _dot(jet.w, jet.w)
    second_ss, second_sw, second_ww = (_dot(x, normal) for x in (jet.ss, jet.sw, jet.ww))
    twice_det = 2.0 * (first_ss * first_ww - first_sw**2)
    trace = second_ss * first_ww - 2.0 * second_sw * first_sw + second_ww * first_ss
    return np.asarray(trace / twice_det)


def summarize(body: Body, *, span: tuple[float, float] = (0.0, 1.0)) -> dict[str, float]:
    """Measure the body, or the part of it between two positions u.

    Parameters
    ----------
    body : Body
        The shape.
    span : tuple of float
        Range of u, such as a subfield's.

    Returns
    -------
    dict
        ``thickness_mean`` (mm, over uniform u and v), ``extent_x``, ``extent_y``, ``extent_z``
        (mm: arc length of the mid-curve, length along v averaged over u, mean thickness),
        ``volume`` (mm3), ``area_interior``, ``area_mid`` and ``area_exterior`` (mm2).
    """
    u, weights_u = gauss_panels(*span, _PANELS_U)
    v, weights_v = gauss_panels(0.0, 1.0, _PANELS_V)
    u, v = u[:, None], v[None, :]
    spec = body.spec
    cell = weights_u[:, None] * weights_v * (spec.width * spec.length)
    uniform = cell / cell.sum()
    thickness = body.thickness(u, v)
    section = body.curve.curvature(u * spec.width)
    stretch, axis = _axis_stretch(body, u)
    # Integral of (1 + n k) (stretch + n axis) over n from -T/2 to T/2; odd powers cancel.
    column = stretch * thickness + section * axis * thickness**3 / 12.0
    mean = float((uniform * thickness).sum())
    areas = {
        f"area_{name}": float((cell * _area_element(body, u, v, at)).sum())
        for name, at in SURFACES.items()
    }
    return {
        "thickness_mean": mean,
        "extent_x": spec.width * (span[1] - span[0]),
        "extent_y": float((uniform * stretch).sum()) * spec.length,
        "extent_z": mean,
        "volume": float((cell * column).sum()),
        **areas,
    }


def _surface_jet(body: Body, u: Float, v: Float, at: float) -> _Jet:
    """Differentiate ``mid + at * T * normal``.

    With t and m tangent and normal of the section (t' = -k m, m' = k t) and f the axis direction
    (df/dw = bend * d, dd/dw = -bend * f, d the medial direction), the surface is
    X = axis(w) + c(s) + n m and X_w = stretch f + n_w m.
    """
    u, v = np.broadcast_arrays(np.asarray(u, np.float64), np.asarray(v, np.float64))
    s = u * body.spec.width
    bend = body.spec.bend
    wall = body.thickness_jet(u, v)
    n, n_s, n_w = at * wall.value, at * wall.s, at * wall.w
    n_ss, n_sw, n_ww = at * wall.ss, at * wall.sw, at * wall.ww
    k, k_s = body.curve.curvature(s), body.curve.curvature_slope(s)
    mid_stretch, by_n = _axis_stretch(body, u)
    stretch = mid_stretch + n * by_n
    medial_t, medial_m = -body.curve.tangent(s)[..., 0], -body.curve.normal(s)[..., 0]
    grow = 1.0 + k * n
    zero = np.zeros_like(n)
    return _Jet(
        s=_stack(grow, n_s, zero),
        w=_stack(zero, n_w, stretch),
        ss=_stack(k_s * n + 2.0 * k * n_s, n_ss - k * grow, zero),
        sw=_stack(k * n_w, n_sw, -bend * (grow * medial_t + n_s * medial_m)),
        ww=_stack(
            bend * stretch * medial_t,
            n_ww + bend * stretch * medial_m,
            -2.0 * bend * n_w * medial_m,
        ),
    )


def _axis_stretch(body: Body, u: Float) -> tuple[Float, Float]:
    """Length per length of long axis at the mid-surface, and its change per mm of n.

    Nearer to the center of a bent axis it is below 1.
    """
    s = np.asarray(u * body.spec.width, dtype=np.float64)
    medial, by_n = -body.curve.position(s)[..., 0], -body.curve.normal(s)[..., 0]
    return 1.0 - body.spec.bend * medial, -body.spec.bend * by_n


def _area_element(body: Body, u: Float, v: Float, at: float) -> Float:
    jet = _surface_jet(body, u, v, at)
    return np.asarray(np.linalg.norm(np.cross(jet.s, jet.w), axis=-1))


def _stack(*components: Float) -> Float:
    return np.stack(np.broadcast_arrays(*components), axis=-1)


def _dot(a: Float, b: Float) -> Float:
    return np.asarray((a * b).sum(axis=-1))
