"""Where the hippocampal body ends along an axis where no label says so.

Cross-sections of the labels are measured at small steps along the axis. Evidence that a level lies
outside of the body is graded, from several cues, and an end is a mean over all levels at which the
body may end: so it moves little if voxels do.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import ndtr

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.digital import voxel_points
from hipsta_bids.protocols.protocol import CORE, LATERAL_END, Tissue
from hipsta_bids.settings import BodySettings
from hipsta_bids.types import Bool, End, Float, LabelVolume

#: Without end labels: standard deviation by which profiles along the axis are smoothed, mm.
END_SMOOTHING = 1.0
#: What is usual in the body: this quantile over cross-sections with CA1 and CA2 or CA3.
END_USUAL = 0.3
#: How much a millimeter of certain evidence multiplies odds, natural logarithm (times 0.5).
END_WEIGHT = 3.0
#: Even odds of an end: the sheet, CA1, or CA2 and CA3 have this share of their usual area.
LOST_SHARE = 0.5
#: Even odds of an end: dentate gyrus and CA4 have this share of their usual area. In the tail the
#: sheet closes over them.
CORE_SHARE = 0.5
#: The evidence rises from none to certain over this range of the shares of usual areas.
LOST_WIDTH = 0.5
#: Even odds: CA2 and CA3 spread this many times as far as usual, since the uncus has some.
UNCUS_SPREAD = 2.5
#: Even odds: dentate gyrus and CA4 have this multiple of their usual spread, or of their area.
CORE_GROWTH = 1.6
#: Even odds: the sheet has this multiple of its usual area.
HEAD_GROWTH = 1.5

Cues = dict[str, Float]
"""Evidence (T,) from 0 to 1 that a level is outside of the body, by name."""


class FoundEnd(NamedTuple):
    """An end that was placed by the automatic rule."""

    level: float
    """Along the axis, mm."""
    rule: str
    uncertainty: float
    """Standard error over the cues, mm."""


class _Profile(NamedTuple):
    """Cross-sections at equal steps along an axis, smoothed along it."""

    levels: Float
    """(T,) mm along the axis."""
    area: dict[str, Float]
    """(T,) area per kind of tissue, mm2."""
    spread: dict[str, Float]
    """(T,) root mean square distance of a tissue from its center, mm."""


_NEEDED = ("sheet", "CA1", "CA2-3")
_STEP = 0.25  # mm between the levels of a profile
_BEYOND = 2.0  # mm beyond an end, where it is asked why it is there


def find_ends(
    volume: LabelVolume,
    sheet: NDArray[np.uint8],
    axis: Float,
    known_levels: dict[End, float],
    settings: BodySettings,
) -> dict[End, FoundEnd]:
    """Find where each end lies along the axis, between the levels of ends that are known, mm.

    As in Diers et al. 2023, section 2.1, the body has CA1 and CA2 or CA3 everywhere. It also has a
    dentate gyrus, and cross-sections like its middle. All this is evidence for or against
    each level; an end is the mean over all places where the body may end, weighted by evidence.
    """
    if settings.end_rule == "last-slice":
        return _last_slices(volume, sheet, axis)
    profile = _profile(volume, sheet, axis)
    levels = profile.levels
    low, high = known_levels.get("posterior", -np.inf), known_levels.get("anterior", np.inf)
    typical = _has_subfields(profile) & (levels > low) & (levels < high)
    if not typical.any():
        raise _no_body()
    absence, odd = _evidence(profile, typical)
    ends = _mean_ends(levels, _doubt(absence, odd), known_levels, settings)
    jackknife = [
        _mean_ends(
            levels, _doubt(absence, {k: odd[k] for k in odd if k != left}), known_levels, settings
        )
        for left in odd
    ]
    results: dict[End, FoundEnd] = {}
    sides: tuple[tuple[End, float], ...] = (("posterior", 1.0), ("anterior", -1.0))
    for n, (end, sign) in enumerate(sides):
        order = np.argsort(sign * levels)
        depth = sign * (levels[order] - ends[n])
        trim = max(
            _grazed(depth, profile.area[name][order], absence[name][order], settings)
            for name in _NEEDED
        )
        trim += settings.end_margin
        rule = _main_evidence(levels, ends[n], sign, absence, odd)
        error = _jackknife_error([pair[n] for pair in jackknife])
        results[end] = FoundEnd(ends[n] + sign * trim, rule, error)
    return results


def _jackknife_error(estimates: list[float]) -> float:
    """Compute the standard error from estimates that leave out one cue each (Tukey 1958)."""
    return float(np.sqrt((len(estimates) - 1) * np.var(estimates))) if estimates else 0.0


def _no_body() -> GeometryError:
    return GeometryError(
        "no slice has both CA1 and CA2/CA3; head and tail have no labels: label both ends, "
        "or check the protocol",
        reason="no-body",
    )


def _last_slices(volume: LabelVolume, sheet: NDArray[np.uint8], axis: Float) -> dict[End, FoundEnd]:
    """Find the last slices of the image with labels of the body, as in Diers et al. 2023.

    Posteriorly a slice has CA1 and CA2 or CA3, anteriorly CA2 or CA3. The body ends at its outer
    side.
    """
    along = axis @ volume.affine[:3, :3]
    through = int(np.argmax(np.abs(along)))
    number = np.nonzero(sheet)[through]
    heights = voxel_points(sheet > 0, volume.affine) @ axis
    count = np.maximum(np.bincount(number, minlength=sheet.shape[through]), 1)
    level = np.bincount(number, heights, sheet.shape[through]) / count
    across = tuple(k for k in range(3) if k != through)
    lateral, ca1 = (
        np.isin(sheet, kinds).any(axis=across) for kinds in (LATERAL_END, (Tissue.CA1,))
    )
    if not (lateral & ca1).any():
        raise _no_body()
    half = abs(float(along[through])) / 2
    return {
        "posterior": FoundEnd(float(level[lateral & ca1].min()) - half, "last-slice", 0.0),
        "anterior": FoundEnd(float(level[lateral].max()) + half, "last-slice", 0.0),
    }


def _profile(volume: LabelVolume, sheet: NDArray[np.uint8], axis: Float) -> _Profile:
    """Measure cross-sections of the sheet and of what lies inside it."""
    edges = volume.affine[:3, :3]
    along = axis @ edges
    through = int(np.argmax(np.abs(along)))
    parts = int(np.ceil(abs(along[through]) / _STEP))
    offsets = ((np.arange(parts) + 0.5) / parts - 0.5) * along[through]
    tissues = {
        "sheet": sheet > 0,
        "CA1": sheet == Tissue.CA1,
        "CA2-3": np.isin(sheet, LATERAL_END),
        "core": np.isin(volume.tissue, CORE),
    }
    points = {name: voxel_points(mask, volume.affine) for name, mask in tissues.items()}
    middle = points["sheet"].mean(axis=0)
    reach = (points["sheet"] - middle) @ axis
    margin = 5 * END_SMOOTHING + abs(along[through])
    first = int(np.floor((reach.min() - margin) / _STEP))
    last = int(np.ceil((reach.max() + margin) / _STEP))
    volume_of_part = abs(float(np.linalg.det(edges))) / parts / _STEP
    area, spread = dict[str, Float](), dict[str, Float]()
    for name, position in points.items():
        local = position - middle
        height = local @ axis
        flat = local - height[:, None] * axis
        at = (height[:, None] + offsets) / _STEP - first  # parts of voxels
        moments = np.column_stack([np.ones(len(flat)), flat, (flat**2).sum(axis=1)])
        sums = _binned(at, moments, last - first + 1)
        sums = ndimage.gaussian_filter1d(sums, END_SMOOTHING / _STEP, axis=0, mode="constant")
        area[name] = sums[:, 0] * volume_of_part
        mean = sums[:, 1:] / np.maximum(sums[:, :1], 1e-9)
        spread[name] = np.sqrt(np.maximum(mean[:, 3] - (mean[:, :3] ** 2).sum(axis=1), 0))
    levels = middle @ axis + _STEP * np.arange(first, last + 1)
    return _Profile(levels, area, spread)


def _binned(at: Float, values: Float, count: int) -> Float:
    """Sum values (N, K) at places (N, M), in bins; each is shared by the two nearest, (count, K).

    So nothing jumps as voxels move.
    """
    low = np.floor(at).astype(int)
    in_range = (low >= 0) & (low < count - 1)
    upper = np.where(in_range, at - low, 0.0)
    lower = np.where(in_range, 1.0 - upper, 0.0)
    low = np.where(in_range, low, 0)
    sums = [
        np.bincount(low.ravel(), (lower * column[:, None]).ravel(), count)
        + np.bincount(low.ravel() + 1, (upper * column[:, None]).ravel(), count)
        for column in values.T
    ]
    return np.column_stack(sums)


def _has_subfields(profile: _Profile) -> Bool:
    """Say which levels have CA1 and CA2 or CA3."""
    has_both = np.ones(len(profile.levels), dtype=bool)
    for name in ("CA1", "CA2-3"):
        area = profile.area[name]
        present = area > 0.01 * area.max(initial=0)  # without tails of the Gaussian
        has_both &= area > 0.2 * np.median(area[present]) if present.any() else False
    return has_both


def _evidence(profile: _Profile, typical: Bool) -> tuple[Cues, Cues]:
    """Weigh what speaks against each level: tissues that are lost, and shapes unlike the body's.

    Either is 0.5 at the share, or ratio, that the constants name. Usual is a low quantile over the
    levels with CA1 and CA2 or CA3, since part of these may belong to the head or the tail.
    """

    def usual(values: Float) -> float:
        return max(float(np.quantile(values[typical], END_USUAL)), 1e-6)

    area, spread = profile.area, profile.spread
    shares = dict.fromkeys(_NEEDED, LOST_SHARE)
    has_core = usual(area["core"]) > 0.02 * usual(area["sheet"])  # is it labeled
    if has_core:
        shares["core"] = CORE_SHARE
    absence = {
        name: np.clip(0.5 + (share - area[name] / usual(area[name])) / LOST_WIDTH, 0, 1)
        for name, share in shares.items()
    }
    ratios = {
        "spread of CA2-3": (spread["CA2-3"], UNCUS_SPREAD),
        "area of the sheet": (area["sheet"], HEAD_GROWTH),
    }
    if has_core:
        ratios["spread of the core"] = (spread["core"], CORE_GROWTH)
        ratios["area of the core"] = (area["core"], CORE_GROWTH)
    odd = {
        name: np.clip(0.5 * np.log(np.maximum(x / usual(x), 1.0)) / np.log(ratio), 0, 1)
        for name, (x, ratio) in ratios.items()
    }
    return absence, odd


def _doubt(absence: Cues, odd: Cues) -> Float:
    """Combine evidence (T,): any lost tissue is enough, cues of the shape are averaged."""
    inside = 1.0 - np.mean(list(odd.values()), axis=0)
    for share in absence.values():
        inside = inside * (1.0 - share)
    return np.asarray(1.0 - inside)


def _mean_ends(
    levels: Float, doubt: Float, known_levels: dict[End, float], settings: BodySettings
) -> tuple[float, float]:
    """Mean level of both ends, weighted by the evidence for a body between each two levels.

    The logarithm of a weight is the integral of 0.5 - doubt over the body, times a setting. So an
    end is near to where doubt passes one half, or a mean if it does so at several places.
    """
    gain = END_WEIGHT * np.cumsum(0.5 - doubt) * _STEP
    weight = gain - gain[:, None]
    allowed = levels - levels[:, None] >= settings.min_length
    low, high = known_levels.get("posterior"), known_levels.get("anterior")
    if low is not None:
        allowed &= (levels == levels[np.abs(levels - low).argmin()])[:, None]
    if high is not None:
        allowed &= levels == levels[np.abs(levels - high).argmin()]
    if not allowed.any():
        raise GeometryError(
            f"the labels extend less than {settings.min_length:g} mm from the known end; "
            "check the known end, or label the whole hippocampus",
            reason="body-too-short",
        )
    weight = np.where(allowed, weight, -np.inf)
    weight = np.exp(weight - weight.max())
    weight /= weight.sum()
    edges = levels + 0.5 * _STEP  # the sums reach to here
    return float(weight.sum(axis=1) @ edges), float(weight.sum(axis=0) @ edges)


def _grazed(depth: Float, area: Float, absence: Float, settings: BodySettings) -> float:
    """Length behind an end, mm, at which a tissue's areas are smaller than behind it.

    Labels that end obliquely fill a part of these cross-sections only. Smoothing alone takes as
    much within a known distance of where labels end. Where they go on, nothing is left out.
    """
    inner = (depth > settings.end_reach) & (depth < 2 * settings.end_reach)
    if not inner.any():
        return 0.0
    fine = np.arange(0.5, settings.end_reach / _STEP) * _STEP
    share = np.interp(fine, depth, area) / max(float(area[inner].mean()), 1e-6)
    length = _below(share, settings.end_fullness)
    blurred = _below(ndtr(fine / END_SMOOTHING), settings.end_fullness)
    labels_end = np.interp(-_BEYOND, depth, absence)
    return float(labels_end * max(length - blurred, 0.0))


def _below(share: Float, fullness: float) -> float:
    """Length over which shares (N,), at steps of a profile, are less than they should be, mm."""
    return float(np.clip((fullness - share) / (1 - fullness), 0, 1).sum() * _STEP)


def _main_evidence(levels: Float, end: float, sign: float, absence: Cues, odd: Cues) -> str:
    """Name the strongest evidence just beyond an end."""
    depth = sign * (levels - end)
    beyond = (depth < 0) & (depth > -_BEYOND)
    strength = {name: float(share[beyond].mean()) for name, share in absence.items()}
    fields = max(strength[name] for name in _NEEDED)
    shape = float(np.mean([share[beyond].mean() for share in odd.values()]))
    names = {"subfields": fields, "core": strength.get("core", 0.0), "cross-section": shape}
    return max(names, key=lambda name: names[name])
