"""How values look, the same on all pages and figures: color scales, palettes, and orientation."""

import atexit
import contextlib
import os
import shutil
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from hipsta_bids.io.files import scratch_folder
from hipsta_bids.protocols.protocol import Part, Protocol
from hipsta_bids.types import HATCHED_FROM, Float

#: How every unfolded map lies, of either hemisphere.
ORIENTATION = (
    "Unfolded maps of both hemispheres lie alike: medial left, lateral right, posterior below,"
    " anterior above."
)
#: What oblique hatching means on unfolded maps.
HATCHING = f"near a flag, or a repair (no filled gap) {HATCHED_FROM:g} mm off its neighbors"
#: Both ends of the axes of unfolded maps: of x to the right, and of y upward.
X_ENDS, Y_ENDS = ("medial", "lateral"), ("posterior", "anterior")

#: Colors that color-blind readers can distinguish (Okabe and Ito 2008): of groups, and of labels
#: whose protocol is not available.
COLORS = (
    *("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#F0E442"),
    *("#999999", "#000000"),
)
HEMISPHERE_COLORS = {"L": COLORS[0], "R": COLORS[1]}

#: Color maps of effect sizes, of significance and of design matrices.
EFFECT_COLORS, P_COLORS, DESIGN_COLORS = "RdBu_r", "PuOr_r", "cividis"
#: Of effects and significance that have no sign.
_UNSIGNED = "Reds", "Oranges"

#: What a user may have in the environment that would change figures.
_PREFERENCES = ("MPLBACKEND", "MATPLOTLIBRC")

_EFFECTS = 99.0  # percentile of sizes that the colors of effects span
_LEVEL = 0.05
_SMALLEST = 1e-6  # reach of colors where all values are zero
_LEAST_REACH = 3.0  # powers of ten of p that colors span at least
_FAR_APART = 0.35  # of the most extreme ticks of p


@dataclass(frozen=True, kw_only=True)
class MapKind:
    """How a map is shown."""

    column: str
    """Of the sheet table."""
    title: str
    unit: str
    colors: str
    """Color map of matplotlib, perceptually uniform or diverging, safe for color-blind readers."""
    centered: bool
    """Whether zero means something, and has the middle of the colors."""
    digits: int
    limits: tuple[float, float] | None = None
    """Values at the ends of the colors, the same on all pages and figures; beyond them colors
    stay as they are there. ``None`` where a measure has no usual range."""
    percentiles: tuple[float, float] = (1, 99)
    """Of the values that are shown, at the ends of the colors of kinds without limits."""


#: Limits are fixed, not taken from the hemispheres at hand: a page may be written before the others
#: are measured, and a color has to mean the same on all. Protocols share them, since they differ
#: little: in the three brains of Winterburn et al. (2013, doi:10.1016/j.neuroimage.2013.02.003),
#: drawn by hand, given as FreeSurfer and ASHS write labels, 98 % of the points lie between 0.6 and
#: 3.0 mm.
THICKNESS = MapKind(
    column="thickness",
    title="Thickness",
    unit="mm",
    colors="viridis",
    centered=False,
    digits=2,
    limits=(0.5, 3.0),
)
#: Zero is flat; the sign is the direction of the curl. In the same brains 98 % of the points of
#: the mid-surface lie within 0.4 1/mm; the walls, which share the limits, reach farther.
CURVATURE = MapKind(
    column="curvature",
    title="Mean curvature",
    unit="1/mm",
    colors="RdBu_r",
    centered=True,
    digits=3,
    limits=(-0.5, 0.5),
    percentiles=(4, 96),
)
MAP_KINDS = (THICKNESS, CURVATURE)
#: Of any measure, between two visits or sides.
_CHANGE = MapKind(
    column="", title="", unit="", colors="PRGn", centered=True, digits=3, percentiles=(2, 98)
)


@contextlib.contextmanager
def separate_settings() -> Iterator[None]:
    """Let matplotlib load with a temporary folder, which is removed when this process ends.

    It keeps a list of fonts in the user's home, which may be missing or read-only in containers
    and on clusters, and would read that user's preferences there.
    """
    if "matplotlib" in sys.modules:
        yield
        return
    folder = str(scratch_folder("fonts"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    before = {name: os.environ.pop(name, None) for name in (*_PREFERENCES, "MPLCONFIGDIR")}
    os.environ["MPLCONFIGDIR"] = folder
    try:
        yield
    finally:
        del os.environ["MPLCONFIGDIR"]
        os.environ.update({name: value for name, value in before.items() if value is not None})


def kind_of(measure: str, *, change: bool = False) -> MapKind:
    """Choose how a measure of the group level is shown: as on the pages of participants.

    Limits are for thickness and mean curvature; other measures have other units.
    """
    if change:
        return _CHANGE
    if measure == THICKNESS.column:
        return THICKNESS
    if "curvature" in measure:
        return replace(CURVATURE, limits=None) if "gaussian" in measure else CURVATURE
    return replace(THICKNESS, limits=None)


def known(values: Sequence[Float]) -> Float:
    """Join arrays of any shape to the (N,) numbers in them, without NaN."""
    joined = np.concatenate([np.empty(0), *(np.ravel(array) for array in values)])
    return np.asarray(joined[np.isfinite(joined)], dtype=np.float64)


def scale_of(kind: MapKind, values: Sequence[Float]) -> tuple[float, float]:
    """Return the values at both ends of the colors: fixed ones, or from the values shown."""
    return span_of(kind, values) if kind.limits is None else kind.limits


def span_of(kind: MapKind, values: Sequence[Float]) -> tuple[float, float]:
    """Return the percentiles of the values shown that are at both ends of the colors."""
    joined = known(values)
    low, high = np.percentile(joined, kind.percentiles).tolist() if len(joined) else (-1.0, 1.0)
    if kind.centered:
        high = max(abs(low), abs(high), _SMALLEST)
        return -high, high
    return low, max(high, low + _SMALLEST)


@dataclass(frozen=True)
class Effects:
    """A map of effect sizes, with its scale."""

    kind: str
    """Of the test, ``t`` or ``F``."""
    sizes: Float
    statistic: Float
    df: Float
    """Degrees of freedom, of the error."""

    @property
    def certain(self) -> float:
        """Size at which one point survives any correction: p times the number of points is 0.05.

        With several degrees of freedom in the numerator of F, it is a lower limit.
        """
        ready = np.isfinite(self.sizes) & np.isfinite(self.statistic) & (self.statistic != 0)
        if not ready.any():
            return 0.0
        from scipy import stats  # noqa: PLC0415  (slow to load)

        df = float(np.median(np.broadcast_to(self.df, ready.shape)[ready]))
        t = float(stats.t.isf(_LEVEL / ready.sum() / 2, df))
        if self.kind == "F":
            return t**2 / (t**2 + df)
        return t * float(np.median(np.abs(self.sizes[ready] / self.statistic[ready])))


def effect_reach(maps: Sequence[Effects]) -> float:
    """Return the effect size at the end of the colors, for all maps of one contrast.

    Noise alone does not reach it: it is at least what a single point takes to survive.
    """
    sizes = np.abs(known([effects.sizes for effects in maps]))
    usual = float(np.percentile(sizes, _EFFECTS)) if len(sizes) else 0.0
    return max(usual, *(effects.certain for effects in maps), _SMALLEST)


def effect_colors(kind: str) -> tuple[float, str, str]:
    """Where colors begin, as a share of their reach, and the colors of effects and significance.

    Differences (``t``) may be negative, shares of the variance (``F``) may not.
    """
    return (-1.0, EFFECT_COLORS, P_COLORS) if kind == "t" else (0.0, *_UNSIGNED)


def significance_reach(values: Sequence[Float]) -> float:
    """Return the power of ten of p at the end of the colors."""
    return max(_LEAST_REACH, float(np.abs(known(values)).max(initial=0)))


def p_ticks(level: float, top: float) -> list[tuple[float, str]]:
    """Positions and texts of ticks of p: one, the level, and powers of ten well beyond it."""
    last, far = -float(np.log10(level)), _FAR_APART * top / 2
    ticks = [(last, f"{level:g}"), *([(0.0, "1")] if last > far else [])]
    for power in range(1, int(top) + 1):
        if power - last > far:
            last = float(power)
            ticks.append((last, f"{10.0**-power:g}"))
    return ticks


@cache
def colors_of(name: str, n: int = 64) -> NDArray[np.str_]:
    """List the colors of one of matplotlib's color maps as ``#rrggbb``."""
    with separate_settings():
        from matplotlib import colormaps  # noqa: PLC0415  (slow to load)
        from matplotlib.colors import to_hex  # noqa: PLC0415

    return np.array([to_hex(color) for color in colormaps[name](np.linspace(0, 1, n))])


def gradient_of(colors: NDArray[np.str_]) -> str:
    """Write a color table as a CSS gradient from left to right."""
    stops = colors[np.linspace(0, len(colors) - 1, 9).round().astype(int)]
    return f"linear-gradient(to right,{','.join(stops.tolist())})"


def subfield_title(name: str) -> str:
    """Write the name of a tissue as in a text: ``CA2/3``, ``subiculum``."""
    return (
        name.replace("_", "/") if name.startswith(("CA", "BA")) else name.lower().replace("_", " ")
    )


def palette(protocol: Protocol | None, names: Sequence[str]) -> dict[str, str]:
    """Choose the colors of subfields by the protocol, of the body where parts differ."""
    labels = protocol.labels if protocol is not None else ()
    colors = {
        label.abbreviation or label.name: label.color
        for label in sorted(labels, key=lambda label: label.part is Part.BODY)
    }
    return {name: colors.get(name, COLORS[n % len(COLORS)]) for n, name in enumerate(names)}
