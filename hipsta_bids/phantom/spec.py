"""What a phantom is: a handful of numbers, checked."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType

from hipsta_bids.errors import SettingsError


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
    """An analytic hippocampal body. Two equal specifications are the same shape."""

    kind: str = "spiral"
    """One of ``KINDS``: how the cross-section bends."""
    curvature: tuple[float, float] | None = None
    """1/mm at the medial and the lateral end, in place of the kind's own."""
    thickness: float = 2.0
    """mm, mean over the sheet."""
    variation: float = 0.0
    """Amplitude of the thickness sinusoid as a fraction of the mean, 0 to below 1."""
    variation_axis: str = "xy"
    """Where thickness varies: along x (medial-lateral), y (posterior-anterior) or both."""
    width: float = 20.0
    """mm, arc length of the mid-curve."""
    length: float = 16.0
    """mm, body along the long axis."""
    bend: float = 0.0
    """1/mm, curvature of the long axis (a circular arc, its center on the medial side if
    positive)."""
    end_length: float = 4.0
    """mm by which head and tail go on beyond the body."""
    layer_thickness: float = 0.0
    """mm of the wall, from its interior side, that are labeled molecular layer. The truth stays
    the whole wall, because the layer is given back to the sheet's subfields."""
    interior_depth: float = 1.5
    """mm, depth of the dentate gyrus and CA4 beneath the interior side."""
    interior_start: float = 0.45
    """Share of the hippocampal part of the mid-curve from which on dentate gyrus and CA4 line the
    interior side."""
    cortex: float = 0.0
    """mm of the mid-curve, from its medial end, that are neighboring cortex; the hippocampal
    subfields share the rest. Drawn where the protocol has labels for it."""
    thinnings: tuple[Thinning, ...] = ()
    """Regions in which the wall is thinner. Where they overlap, depths add up."""
    offset: float = 0.0
    """By how much u the pattern of thickness (sinusoids and thinnings) and the borders of
    subfields are shifted from medial to lateral; the shape stays."""

    def __post_init__(self) -> None:
        _check_choice("kind", self.kind, tuple(KINDS))
        _check_choice("variation_axis", self.variation_axis, VARIATION_AXES)
        for field in fields(self):
            limits = _LIMITS.get(field.name)
            if limits is not None:
                _check_range(field.name, getattr(self, field.name), *limits)
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
            raise SettingsError(
                f"phantom: thinning by {depth:g} mm leaves no wall of {self.thickness:g} mm; "
                "thin it less",
                reason="phantom-setting",
            )
        if self.cortex > 0.8 * self.width:
            raise SettingsError(
                f"phantom: cortex of {self.cortex:g} mm leaves less than a fifth of the sheet's "
                f"{self.width:g} mm to the hippocampus; make it shorter",
                reason="phantom-setting",
            )
        if self.layer_thickness >= thinnest:
            raise SettingsError(
                f"phantom: layer_thickness {self.layer_thickness:g} mm fills the wall, which is "
                f"{thinnest:g} mm at its thinnest; make the layer thinner",
                reason="phantom-layer",
            )

    @property
    def cortex_share(self) -> float:
        """Share of the mid-curve that is cortex."""
        return self.cortex / self.width

    @property
    def section_bend(self) -> Bend:
        """Curvature of the mid-curve, with the user's own end values if there are any."""
        preset = KINDS[self.kind]
        if self.curvature is None:
            return preset
        medial, lateral = self.curvature
        return Bend(medial=medial, lateral=lateral, power=preset.power)


#: Lowest and highest value (mm, 1/mm or a fraction). They only keep typing errors out: whether
#: the shape can exist is decided by the geometry.
_LIMITS: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "thickness": (0.1, 10.0),
        "variation": (0.0, 0.9),
        "width": (2.0, 100.0),
        "length": (2.0, 100.0),
        "bend": (-0.1, 0.1),
        "end_length": (0.0, 50.0),
        "layer_thickness": (0.0, 10.0),
        "cortex": (0.0, 80.0),
        "interior_depth": (0.0, 10.0),
        "interior_start": (0.0, 1.0),
        "offset": (-0.15, 0.15),
    }
)


def _check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise SettingsError(
            f"phantom: {name} {value!r} is unknown; choose one of {', '.join(choices)}",
            reason="phantom-setting",
        )


def _check_range(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:  # also catches NaN
        raise SettingsError(
            f"phantom: {name} {value:g} is outside {low:g} to {high:g}", reason="phantom-setting"
        )
