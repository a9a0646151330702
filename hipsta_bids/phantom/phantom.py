"""The phantom itself: a shape that can be drawn and whose truth is known."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hipsta_bids.phantom.labels import draw, make_grid, subfield_spans, tissue_at
from hipsta_bids.phantom.shape import Body, PhantomSpec, gauss_panels
from hipsta_bids.protocols.protocol import Protocol, Tissue
from hipsta_bids.types import Float, LabelVolume

# Exact thickness, curvatures, lengths, areas, cross-sections and volume of a phantom.


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
    """Mean curvature (half the sum of the principal curvatures) of the interior surface, 1/mm;
    positive where the sheet curls round its interior."""
    curvature: Float
    """Mean curvature of the mid-surface, 1/mm."""
    curvature_exterior: Float
    """Mean curvature of the exterior surface, 1/mm."""
    gaussian_curvature: Float
    """Gaussian curvature of the mid-surface, 1/mm2."""
    gaussian_curvature_interior: Float
    """Gaussian curvature of the interior surface, 1/mm2."""
    gaussian_curvature_exterior: Float
    """Gaussian curvature of the exterior surface, 1/mm2."""
    extent_x: Float
    """Length of the line u from 0 to 1 through each position, on the mid-surface, mm."""
    extent_y: Float
    """Length of the line v from 0 to 1, mm."""
    subfield: NDArray[np.uint8]
    """Values of :class:`~hipsta_bids.protocols.Tissue`, in the finest division."""
    summary: Mapping[str, float]
    """The whole wall, see :func:`summarize`."""


class _Jet(NamedTuple):
    """First and second derivatives (..., 3) of a surface by arc length s and long axis w.

    Components are (tangent and normal of the cross-section, long axis).
    """

    s: Float
    w: Float
    ss: Float
    sw: Float
    ww: Float


def curvatures(body: Body, u: Float, v: Float, *, at: float) -> tuple[Float, Float]:
    """Mean (1/mm) and Gaussian (1/mm2) curvature at positions (u, v) of a surface of the wall.

    ``at`` is where the surface lies in the wall, from -0.5 (interior) to 0.5 (exterior). With
    E, F, G and e, f, g the coefficients of the first and second fundamental form,
    H = (e G - 2 f F + g E) / (2 (E G - F^2)) and K = (e g - f^2) / (E G - F^2) (do Carmo,
    Differential Geometry of Curves and Surfaces, section 3-3), here for the normal that points to
    the interior.
    """
    jet = _surface_jet(body, u, v, at)
    normal = np.cross(jet.s, jet.w)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    normal *= -np.sign(normal[..., 1:2])  # to the interior: the section's normal points away
    pairs = ((jet.s, jet.s), (jet.s, jet.w), (jet.w, jet.w))
    first_ss, first_sw, first_ww = ((a * b).sum(axis=-1) for a, b in pairs)
    ss, sw, ww = ((second * normal).sum(axis=-1) for second in (jet.ss, jet.sw, jet.ww))
    det = first_ss * first_ww - first_sw**2
    mean = (ss * first_ww - 2.0 * sw * first_sw + ww * first_ss) / (2.0 * det)
    return np.asarray(mean), np.asarray((ss * ww - sw**2) / det)


def cut_sections(body: Body, v: Float) -> dict[str, Float]:
    """Measure the cross-sections at positions v, as the output's table of them; mm and mm2."""
    u, weights = gauss_panels(0.0, 1.0, _PANELS_U)
    u, v = u[:, None], np.asarray(v, np.float64)[None, :]
    cell = weights[:, None] * body.spec.width
    lengths = {
        f"length_{name}": (cell * np.linalg.norm(_surface_jet(body, u, v, at).s, axis=-1)).sum(0)
        for name, at in SURFACES.items()
    }
    thickness = body.thickness(u, v)
    # The integral of 1 + n k over n from -T/2 to T/2 is T.
    area = (cell * thickness).sum(axis=0)
    circumference = lengths["length_interior"] + lengths["length_exterior"]
    stretch = _axis_stretch(body, u)[0].ravel() @ weights
    return {
        "position": stretch * v.ravel() * body.spec.length,
        "thickness": area / body.spec.width,
        **lengths,
        "circumference": circumference,
        "interior_exterior_ratio": lengths["length_interior"] / lengths["length_exterior"],
        "section_area": area,
        "shape_index": circumference / area,
    }


def summarize(body: Body, *, span: tuple[float, float] = (0.0, 1.0)) -> dict[str, float]:
    """Measure the body, or the part of it between two positions u.

    Mean thickness is over the mid-surface; extents are the arc length of the mid-curve, the length
    along v averaged over u, and the mean thickness (mm, mm2 and mm3). The whole body also has
    ratios of sizes, and means of cross-sections over its length.
    """
    u, weights_u = gauss_panels(*span, _PANELS_U)
    v, weights_v = gauss_panels(0.0, 1.0, _PANELS_V)
    u, v = u[:, None], v[None, :]
    spec = body.spec
    cell = weights_u[:, None] * weights_v * (spec.width * spec.length)
    thickness = body.thickness(u, v)
    section = body.curve.curvature(u * spec.width)
    stretch, axis = _axis_stretch(body, u)
    area = cell * stretch
    # Integral of (1 + n k) (stretch + n axis) over n from -T/2 to T/2; odd powers cancel.
    column = stretch * thickness + section * axis * thickness**3 / 12.0
    mean = float((area * thickness).sum() / area.sum())
    jets = {name: _surface_jet(body, u, v, at) for name, at in SURFACES.items()}
    areas = {
        f"area_{name}": float((cell * np.linalg.norm(np.cross(jet.s, jet.w), axis=-1)).sum())
        for name, jet in jets.items()
    }
    summary = {
        "thickness_mean": mean,
        "extent_x": spec.width * (span[1] - span[0]),
        "extent_y": float(area.sum() / cell.sum()) * spec.length,
        "extent_z": mean,
        "volume": float((cell * column).sum()),
        **areas,
    }
    if span != (0.0, 1.0):
        return summary
    sections = cut_sections(body, v.ravel())
    walls = summary["area_interior"] + summary["area_exterior"]
    means = ("circumference", "interior_exterior_ratio", "section_area", "shape_index")
    return {
        **summary,
        "area_ratio": summary["area_interior"] / summary["area_exterior"],
        "surface_volume_ratio": walls / summary["volume"],
        **{f"{name}_mean": float(sections[name] @ weights_v) for name in means},
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
    n, n_s, n_w, n_ss, n_sw, n_ww = (at * sign for sign in wall)
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


def _stack(*components: Float) -> Float:
    return np.stack(np.broadcast_arrays(*components), axis=-1)


class Phantom:
    """An analytic hippocampal body with exact truth."""

    def __init__(self, spec: PhantomSpec) -> None:
        self.spec = spec
        self.body = Body(spec)

    def label_volume(
        self,
        protocol: Protocol,
        *,
        hemi: str = "L",
        voxel_size: tuple[float, float, float] = (0.4, 0.4, 0.4),
        pose: Float | None = None,
        axes: str = "RAS",
        grid_rotation: Float | None = None,
        supersample: int | tuple[int, int, int] = 1,
        border: float = 3.0,
    ) -> LabelVolume:
        """Draw the phantom as a segmentation.

        Parameters
        ----------
        voxel_size
            mm along the three voxel axes.
        pose
            (4, 4) rigid motion of the phantom, RAS mm.
        axes
            Where the voxel axes point, such as ``RAS`` or ``LIA``.
        grid_rotation
            (3, 3) rotation of the voxel grid.
        supersample
            Points per voxel and axis that vote for its label, and give the share of each tissue.
        border
            mm of background on every side.
        """
        shape, affine = make_grid(
            self._outline(hemi, pose),
            voxel_size=voxel_size,
            axes=axes,
            rotation=grid_rotation,
            border=border,
        )
        labels, shares = draw(
            self.body, shape, affine, protocol, hemi=hemi, pose=pose, supersample=supersample
        )
        meanings = [(0, 0), *((label.tissue, label.part) for label in protocol.labels)]
        tissue, part = np.array(meanings, dtype=np.uint8).T
        by_tissue: dict[int, NDArray[np.float32]] = {}
        for label, share in shares.items():
            kind = int(tissue[label])
            by_tissue[kind] = by_tissue.get(kind, np.float32(0)) + share
        return LabelVolume(
            tissue=tissue[labels],
            part=part[labels],
            affine=affine,
            protocol=protocol,
            shares=by_tissue,
        )

    def truth(
        self, u: ArrayLike, v: ArrayLike, *, hemi: str = "L", pose: Float | None = None
    ) -> PhantomTruth:
        """Return what a perfect method would measure at positions (u, v)."""
        x, y = np.broadcast_arrays(np.asarray(u, np.float64), np.asarray(v, np.float64))
        interior, mid, exterior = (curvatures(self.body, x, y, at=at) for at in SURFACES.values())
        return PhantomTruth(
            thickness=self.body.thickness(x, y),
            points=self.body.place(x, y, 0.0, hemi=hemi, pose=pose),
            curvature_interior=interior[0],
            curvature=mid[0],
            curvature_exterior=exterior[0],
            gaussian_curvature=mid[1],
            gaussian_curvature_interior=interior[1],
            gaussian_curvature_exterior=exterior[1],
            extent_x=np.full(x.shape, self.spec.width),
            extent_y=_axis_stretch(self.body, x)[0] * self.spec.length,
            subfield=tissue_at(self.spec, x, y),
            summary=summarize(self.body),
        )

    @property
    def regions(self) -> tuple[str, ...]:
        """Regions that can be measured in it."""
        return ("body", "extended", "entorhinal") if self.spec.cortex else ("body",)

    def region_summary(self, region: str) -> dict[str, float]:
        """Return what a perfect method would measure in a region as a whole."""
        border = self.spec.cortex_share
        border += self.spec.offset if border else 0.0
        spans = {"body": (border, 1.0), "extended": (0.0, 1.0), "entorhinal": (0.0, border)}
        return summarize(self.body, span=spans[region])

    def subfield_summary(self, protocol: Protocol) -> dict[Tissue, dict[str, float]]:
        """Return what a perfect method would measure in each subfield that a protocol draws."""
        share, shift = self.spec.cortex_share, self.spec.offset
        return {
            tissue: summarize(
                self.body,
                span=(
                    share + (1.0 - share) * start + (shift if start or share else 0.0),
                    share + (1.0 - share) * end + (shift if end < 1.0 else 0.0),
                ),
            )
            for tissue, (start, end) in subfield_spans(protocol).items()
        }

    def _outline(self, hemi: str, pose: Float | None) -> Float:
        """Points (N, 3), RAS mm, that span head, body and tail with all they enclose."""
        beyond = self.spec.end_length / self.spec.length
        half = self.body.thickest / 2.0
        u, v, n = np.meshgrid(
            np.linspace(0.0, 1.0, 101),
            np.linspace(-beyond, 1.0 + beyond, 21),
            [-half - self.spec.interior_depth, half],
            indexing="ij",
        )
        return self.body.place(u, v, n, hemi=hemi, pose=pose).reshape(-1, 3)
