"""Walls from the shares that tissues have in voxels, beside those from labels alone."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from time import process_time

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from hipsta_bids.extensions.uncertainty.copies import estimate_uncertainty
from hipsta_bids.geometry.body import extract_body
from hipsta_bids.inputs.search import HemisphereInput
from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.settings import Settings
from hipsta_bids.types import Decision, Float, HemisphereMaps, LabelVolume
from validation import cases, continuity, random_phantoms, thick_slices, uncertainty
from validation.cases import Case, Measured, Refusal
from validation.continuity import Movement
from validation.report import Cell, Cells, Content, suite, table

SEED = 20262
POINTS = 4
"""Points per axis of a phantom's voxels, from which its shares are known."""
NOISE = 0.1
"""SD of noise of a share; of a posterior where it is a half."""
LENGTH = 1.0
"""mm over which the noise of posteriors is correlated."""
LABELS, SHARES = "labels", "shares"
CENTERS, SHARPENED = "labels at centers", "shares, sharpened"
NOISY = "shares with noise"

RANDOM_QUICK, RANDOM_FULL = 1, 12
#: By voxels: largest size of the bias, and SD without edges, mm, of shares with and without noise.
RANDOM_TARGETS = {"fine": (0.005, 0.028), "thick": (0.005, 0.042)}

BLURS = (0.0, 0.2, 0.4, 0.6)
"""SD of the Gaussian that blurs shares, mm."""
KINDS, WALLS = ("arc", "spiral"), (1.0, 1.4, 1.8)
"""Phantoms of the blurred shares, and their thickness, mm."""

LATTICES_QUICK, LATTICES_FULL = 1, 4
#: Voxels of copies of real labels, mm, and the points along their axes that give the shares.
COPIES = {"0.6 mm": ((0.6, 0.6, 0.6), (3, 3, 3)), "2 mm slices": ((0.4, 0.4, 2.0), (2, 2, 8))}
#: By voxels: which targets shares have to meet, as columns of the table.
SHAPE_TARGETS: Mapping[str, Mapping[str, float]] = {
    "0.6 mm": {"RMS, median": 0.14, "r, median": 0.98, "r, worst": 0.96},
    "2 mm slices": {"size of change, mean": 0.025, "r, median": 0.90, "r, worst": 0.80},
}

MIXES = (0.0, 0.25, 0.5, 0.75)
"""Parts of the true shares in shares of 0 and 1, as labels have them; shares themselves follow."""
MIXED = 4
"""Random phantoms, of each kind of voxels, whose shares are mixed."""
MAX_HARD = 0.01
"""mm, largest RMS difference of a map from shares of 0 and 1 to that from labels."""
MAX_COST = 1.1

POSTERIORS = (("spiral", 2.0), ("spiral", 1.6), ("arc", 2.0), ("arc", 1.6))
"""Phantoms, by kind and thickness, mm, whose posteriors are drawn."""
WIDTHS, WIDTH_LENGTH = (0.08, 0.45), 8.0
"""Least and largest SD of the place of a wall, mm, and over which distance it changes."""
LENGTHS = (1.0, 3.0)
"""mm over which displacements of walls are correlated, in equal shares."""
DRAWS_QUICK, DRAWS_FULL = 3, 12
COPIES_OF_POSTERIOR = 8
LEAST_RANK = 0.5

_TIMEOUT = 900.0

Shares = Mapping[int, NDArray[np.float32]]
"""(I, J, K) by tissue, as ``LabelVolume`` has them."""

Forms = Mapping[str, LabelVolume]
"""The same body as labels alone, with shares, with noise in them, ..."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Timed:
    """What was measured of one form of a body, and what it cost."""

    result: Measured | Movement | Refusal
    seconds: float = np.nan
    """CPU time of the map."""


Outcomes = Sequence[Mapping[str, Timed] | Refusal]
"""Of each body, its forms."""


@dataclass(frozen=True, kw_only=True)
class Copy:
    """A real hemisphere in coarser voxels, on one of their lattices."""

    body: HemisphereInput
    voxels: str
    number: int


@suite("soft")
def run(full: bool, labels: Path | None = None) -> Iterator[Content]:
    """Measure bodies with and without shares, on phantoms and on labels with fine voxels."""
    number = RANDOM_FULL if full else RANDOM_QUICK
    timed: dict[str, Outcomes] = {
        **cases.run_groups(
            measure_random,
            # Thick slices are drawn sooner.
            {
                voxels: [(voxels, n) for n in range(number)]
                for voxels in (RANDOM_TARGETS if full else ("thick",))
            },
            timeout=_TIMEOUT,
        )
    }
    yield _random(timed)
    yield _continuity(timed)
    specs = [
        PhantomSpec(kind=kind, thickness=wall)
        for kind in (KINDS if full else KINDS[:1])
        for wall in (WALLS if full else WALLS[1:2])
    ]
    blurs = BLURS if full else BLURS[2:3]
    yield _blurred(specs, cases.run_cases(partial(measure_blurred, blurs), specs, timeout=_TIMEOUT))
    drawn = POSTERIORS if full else POSTERIORS[-1:]
    draws = DRAWS_FULL if full else DRAWS_QUICK
    yield _coverage(cases.run_cases(partial(measure_draws, draws), drawn, timeout=_TIMEOUT))
    if labels is not None:
        bodies = cases.fine_segmentations(labels, min(COPIES["2 mm slices"][0]))
        copies = [
            Copy(body=body, voxels=voxels, number=n)
            for body in (bodies if full else bodies[:1])
            for voxels in COPIES
            for n in range(LATTICES_FULL if full else LATTICES_QUICK)
        ]
        results = cases.run_cases(measure_copy, copies, timeout=_TIMEOUT)
        shapes: dict[str, Outcomes] = {
            voxels: [r for c, r in zip(copies, results, strict=True) if c.voxels == voxels]
            for voxels in COPIES
        }
        yield _shapes(shapes)
        timed |= shapes
    yield _cost(timed)
    yield cases.left_out(labels)


def measure_forms(
    forms: Forms, hemi: str, compare: Callable[[HemisphereMaps], Measured | Movement]
) -> dict[str, Timed]:
    """Measure each form of a body and compare its maps with what is true."""
    results = {}
    for name, volume in forms.items():
        start = process_time()
        maps = cases.attempt(partial(cases.measure_body, hemi=hemi), volume)
        seconds = process_time() - start
        result = maps if isinstance(maps, Refusal) else compare(maps)
        results[name] = Timed(result=result, seconds=seconds)
    return results


def measure_random(drawn: tuple[str, int]) -> dict[str, Timed]:
    """Measure a random phantom, by its voxels and number, by labels, shares, and mixes of both."""
    case = random_phantoms.draw(*drawn, seed=SEED)
    phantom = Phantom(case.spec)
    volume = cases.draw(phantom, case, supersample=POINTS)
    generator = np.random.default_rng((SEED, drawn[1]))
    forms = {
        LABELS: replace(volume, shares={}),
        SHARES: volume,
        NOISY: add_noise(volume, generator),
    }
    if drawn[1] < MIXED:
        forms |= {_mix_name(mix): mix_shares(volume, mix) for mix in MIXES}
    return measure_forms(forms, case.hemi, partial(cases.compare, phantom, case))


def measure_blurred(blurs: Sequence[float], spec: PhantomSpec) -> dict[tuple[float, str], Timed]:
    """Measure a phantom by blurred shares, as a segmentation without a sharp wall has them."""
    generator = np.random.default_rng((SEED, KINDS.index(spec.kind), round(10 * spec.thickness)))
    phantom, case = Phantom(spec), Case(spec=spec, pose=cases.any_pose(generator))
    volume = cases.draw(phantom, case, supersample=POINTS)
    results: dict[tuple[float, str], Timed] = {}
    for blur in blurs:
        soft = blur_shares(volume, blur)
        forms = {
            LABELS: replace(soft, shares={}),
            SHARES: soft,
            SHARPENED: label_weights(volume, {k: p**2 for k, p in soft.shares.items()}),
            NOISY: label_weights(volume, noisy_weights(soft, generator)),
        }
        timed = measure_forms(forms, case.hemi, partial(cases.compare, phantom, case))
        results |= {(blur, name): each for name, each in timed.items()}
    return results


def measure_draws(draws: int, drawn: tuple[str, float]) -> dict[str, uncertainty.Coverage]:
    """Draw posteriors of a phantom, whose walls are as far off as each posterior says.

    The errors of their maps are set beside the SDs that copies of the first posterior predict, and
    of its labels alone.
    """
    kind, thickness = drawn
    generator = np.random.default_rng((SEED, POSTERIORS.index(drawn)))
    spec = PhantomSpec(kind=kind, thickness=thickness, variation=0.2, length=16.0)
    case = Case(spec=spec, pose=cases.any_pose(generator))
    volume = cases.draw(Phantom(spec), case, supersample=POINTS)
    edges = np.linalg.norm(volume.affine[:3, :3], axis=0)
    level = continuity.smooth_noise(volume.tissue.shape, WIDTH_LENGTH / edges, generator)
    width = WIDTHS[0] + (WIDTHS[1] - WIDTHS[0]) / (1 + np.exp(-2 * level))
    reference = cases.measure_body(volume, case.hemi)
    posteriors = [draw_posterior(volume, width, generator) for _ in range(draws)]
    forms = {
        SHARES: posteriors,
        LABELS: [replace(posterior, shares={}) for posterior in posteriors],
    }
    return {
        name: uncertainty.compare_errors(
            reference,
            [cases.measure_body(volume, case.hemi) for volume in volumes],
            estimate_uncertainty(volumes[0], case.hemi, Settings(), COPIES_OF_POSTERIOR),
        )
        for name, volumes in forms.items()
    }


def draw_posterior(
    volume: LabelVolume, width: Float, generator: np.random.Generator
) -> LabelVolume:
    """Displace shares by noise whose SD along each axis is ``width`` (I, J, K), mm; blur by it."""
    edges = np.linalg.norm(volume.affine[:3, :3], axis=0)
    shape = volume.tissue.shape
    places = np.indices(shape).astype(np.float64)
    for axis, edge in enumerate(edges):
        noise = sum(continuity.smooth_noise(shape, each / edges, generator) for each in LENGTHS)
        places[axis] += width / edge * noise / np.sqrt(len(LENGTHS))
    levels = np.linspace(0.0, WIDTHS[1], 6)
    level = np.clip(np.interp(width, levels, np.arange(len(levels))), 0, len(levels) - 1.001)
    low = level.astype(np.intp)
    weights = {}
    for kind, share in volume.shares.items():
        moved = ndimage.map_coordinates(share, places, order=3, mode="nearest").clip(0, 1)
        blurred = np.stack([ndimage.gaussian_filter(moved, sd / edges) for sd in levels])
        first, second = (np.take_along_axis(blurred, n[None], axis=0)[0] for n in (low, low + 1))
        weights[kind] = (first + (level - low) * (second - first)).astype(np.float32)
    return label_weights(volume, weights)


def measure_copy(copy: Copy) -> dict[str, Timed]:
    """Bring labels of a real hemisphere to coarser voxels, and compare with the fine map."""
    fine, hemi, reference = cases.measure_reference(copy.body, thick_slices.FULL_VOXEL)
    axis = extract_body(fine, Settings().body).ends.axis
    size, points = COPIES[copy.voxels]
    generator = np.random.default_rng((SEED, list(COPIES).index(copy.voxels), copy.number))
    x, y, z = generator.uniform(size=3)
    slices = partial(thick_slices.reslice, fine, axis, size, offset=z, aside=(x, y))
    soft = slices(points=points)
    forms = {CENTERS: slices(), LABELS: replace(soft, shares={}), SHARES: soft}
    return measure_forms(forms, hemi, partial(movement, reference))


def movement(reference: HemisphereMaps, maps: HemisphereMaps) -> Movement:
    """Compare a map with that of full resolution."""
    return continuity.compare(reference, maps, np.zeros((0, 3)))


def add_noise(volume: LabelVolume, generator: np.random.Generator) -> LabelVolume:
    """Add noise to shares that are not 0 or 1, another draw in each voxel and tissue."""
    noise = {
        kind: NOISE * generator.standard_normal(share.shape, dtype=np.float32)
        for kind, share in volume.shares.items()
    }
    shares = {
        kind: np.where((share > 0) & (share < 1), np.clip(share + noise[kind], 0, 1), share)
        for kind, share in volume.shares.items()
    }
    return replace(volume, shares=shares)


def mix_shares(volume: LabelVolume, mix: float) -> LabelVolume:
    """Mix shares of 0 and 1, as labels have them, with the part ``mix`` of the true ones."""
    shares = {
        kind: np.float32(1 - mix) * (volume.tissue == kind) + np.float32(mix) * share
        for kind, share in volume.shares.items()
    }
    return replace(volume, shares=shares)


def _mix_name(mix: float) -> str:
    return f"mix of {mix:g}"


def blur_shares(volume: LabelVolume, sd: float) -> LabelVolume:
    """Blur shares by a Gaussian of ``sd`` mm, and label voxels by the largest."""
    sigma = sd / np.linalg.norm(volume.affine[:3, :3], axis=0)
    weights = {
        kind: ndimage.gaussian_filter(share, sigma, mode="nearest")
        for kind, share in volume.shares.items()
    }
    return label_weights(volume, weights)


def noisy_weights(volume: LabelVolume, generator: np.random.Generator) -> Shares:
    """Add noise to the logarithms of shares, correlated over ``LENGTH``.

    A share of a half, in two tissues, then has noise of SD ``NOISE``: the log-odds, which are four
    times as steep there, have the noise of two tissues.
    """
    length = LENGTH / np.linalg.norm(volume.affine[:3, :3], axis=0)
    size = 4 * NOISE / np.sqrt(2)
    return {
        kind: share
        * np.float32(np.exp(size * continuity.smooth_noise(share.shape, length, generator)))
        for kind, share in volume.shares.items()
    }


def label_weights(volume: LabelVolume, weights: Shares) -> LabelVolume:
    """Make shares of weights (I, J, K) by tissue, and label voxels by the largest.

    Head, body and tail are those of the nearest voxel with a label in ``volume``.
    """
    stack = np.stack(list(weights.values()))
    stack /= stack.sum(axis=0)
    tissue = np.array(list(weights), dtype=np.uint8)[stack.argmax(axis=0)]
    nearest = ndimage.distance_transform_edt(
        volume.tissue == 0, return_distances=False, return_indices=True
    )
    part = np.where(tissue > 0, volume.part[tuple(nearest)], 0).astype(np.uint8)
    return replace(volume, tissue=tissue, part=part, shares=dict(zip(weights, stack, strict=True)))


def _forms(outcomes: Outcomes) -> dict[str, list[Timed]]:
    """Collect bodies by form; a body that could not be drawn lacks all."""
    drawn = [forms for forms in outcomes if not isinstance(forms, Refusal)]
    refused = [Timed(result=forms) for forms in outcomes if isinstance(forms, Refusal)]
    names = dict.fromkeys(name for forms in drawn for name in forms)
    return {name: [forms[name] for forms in drawn if name in forms] + refused for name in names}


def _accuracy(errors: Sequence[Float]) -> tuple[float, float]:
    """Mean error, averaged over maps, and its SD over the grid, root mean square over maps."""
    if not errors:
        return np.nan, np.nan
    bias = np.mean([float(np.nanmean(error)) for error in errors])
    return float(bias), cases.rms([float(np.nanstd(error)) for error in errors])


@table("soft.random")
def _random(groups: Mapping[str, Outcomes]) -> Iterator[Cells | str]:
    for voxels, outcomes in groups.items():
        forms = _forms(outcomes)
        for name in (LABELS, SHARES, NOISY):
            timed = forms.get(name, [])
            results = [each.result for each in timed if isinstance(each.result, Measured)]
            inner = [cases.without_edges(result.error) for result in results]
            bias, sd = _accuracy(inner)
            bias_limit, sd_limit = RANDOM_TARGETS[voxels]
            yield {
                "voxels": voxels,
                "walls from": name,
                "phantoms": len(timed),
                "refused": len(timed) - len(results),
                "flagged": sum(result.decision == Decision.LOOK for result in results),
                "bias": f"{bias:+.3f}",
                "SD": sd,
                "largest error": max((float(np.nanmax(np.abs(e))) for e in inner), default=None),
                "SD with edges": _accuracy([result.error for result in results])[1],
                "target": None
                if name == LABELS
                else f"size of bias ≤ {bias_limit:g}, SD ≤ {sd_limit:g}",
                "met": None if name == LABELS else bool(abs(bias) <= bias_limit and sd <= sd_limit),
            }
        yield _refusals(voxels, outcomes)


@table("soft.blurred")
def _blurred(
    specs: Sequence[PhantomSpec], outcomes: Sequence[Mapping[tuple[float, str], Timed] | Refusal]
) -> Iterator[Cells]:
    results = {
        (spec.kind, key, spec.thickness): timed.result
        for spec, forms in zip(specs, outcomes, strict=True)
        if not isinstance(forms, Refusal)
        for key, timed in forms.items()
    }
    for kind, (blur, name) in dict.fromkeys(key[:2] for key in results):
        cells: dict[str, Cell] = {"phantom": kind, "blur, mm": f"{blur:g}", "walls from": name}
        for wall in dict.fromkeys(spec.thickness for spec in specs):
            result = results.get((kind, (blur, name), wall))
            names = [f"{wall:g} mm: {what}" for what in ("bias", "SD", "decision")]
            values: tuple[Cell, ...] = (None, None, None)
            if isinstance(result, Measured):
                bias, sd = _accuracy([cases.without_edges(result.error)])
                values = (f"{bias:+.3f}", sd, result.decision)
            elif isinstance(result, Refusal):
                values = (None, None, result.reason)
            cells |= dict(zip(names, values, strict=True))
        yield cells


@table("soft.coverage")
def _coverage(outcomes: Sequence[Mapping[str, uncertainty.Coverage] | Refusal]) -> Iterator[Cells]:
    for name in (LABELS, SHARES):
        group = [each if isinstance(each, Refusal) else each[name] for each in outcomes]
        row = uncertainty.coverage_row("posteriors", "phantoms", group, least_rank=LEAST_RANK)
        row = {"copies of": name, **{k: v for k, v in row.items() if k not in {"change", "bodies"}}}
        yield row if name == SHARES else row | {"target": None, "met": None}


@table("soft.shapes")
def _shapes(groups: Mapping[str, Outcomes]) -> Iterator[Cells | str]:
    for voxels, outcomes in groups.items():
        for name, timed in _forms(outcomes).items():
            results = [each.result for each in timed if isinstance(each.result, Movement)]
            change = np.array([each.mean for each in results] or [np.nan])
            error = np.array([each.same_xy for each in results] or [np.nan])
            likeness = np.array([each.correlation for each in results] or [np.nan])
            numbers = {
                "size of change, mean": float(np.abs(change).mean()),
                "RMS, median": float(np.median(error)),
                "RMS, largest": float(error.max()),
                "r, median": float(np.median(likeness)),
                "r, worst": float(likeness.min()),
            }
            targets = SHAPE_TARGETS[voxels] if name == SHARES else {}
            met = all(
                numbers[key] >= value if key[0] == "r" else numbers[key] <= value
                for key, value in targets.items()
            )
            yield {
                "voxels": voxels,
                "walls from": name,
                "maps": len(timed),
                "refused": len(timed) - len(results),
                "flagged": sum(not each.accepted for each in results),
                "change of mean, mm": f"{change.mean():+.3f}",
                **numbers,
                "targets": ", ".join(
                    f"{key} {'≥' if key[0] == 'r' else '≤'} {value:g}"
                    for key, value in targets.items()
                )
                or None,
                "met": met if targets else None,
            }
        yield _refusals(voxels, outcomes)


@table("soft.continuity")
def _continuity(groups: Mapping[str, Outcomes]) -> Iterator[Cells]:
    names = [LABELS, *map(_mix_name, MIXES), SHARES]
    for voxels, outcomes in groups.items():
        bodies = [
            [forms[name].result for name in names]
            for forms in outcomes
            if not isinstance(forms, Refusal) and set(names) <= set(forms)
        ]
        maps = [
            [result.thickness for result in results if isinstance(result, Measured)]
            for results in bodies
        ]
        moved = np.array(
            [
                [
                    cases.rms(second - first)
                    for first, second in (*pairwise(each), (each[1], each[-1]))
                ]
                for each in maps
                if len(each) == len(names)
            ]
            or [[np.nan] * len(names)]
        )
        hard, steps = moved[:, 0], moved[:, 1:-1]
        hard_rms, *step_rms, whole = np.sqrt(np.square(moved).mean(axis=0)).tolist()
        yield {
            "voxels": voxels,
            "phantoms": len(bodies),
            "refused": sum(len(each) < len(names) for each in maps),
            "0 beside labels": f"{hard_rms:.4f}",
            "0 beside labels, largest": f"{hard.max():.4f}",
            "target": f"≤ {MAX_HARD:g}",
            "met": bool(hard.max() <= MAX_HARD),
            **{
                f"{low:g} to {high:g}": step
                for (low, high), step in zip(pairwise((*MIXES, 1.0)), step_rms, strict=True)
            },
            "largest step": float(steps.max()),
            "0 to 1": whole,
        }


@table("soft.cost")
def _cost(groups: Mapping[str, Outcomes]) -> Iterator[Cells]:
    for voxels, outcomes in groups.items():
        forms = _forms(outcomes)
        pairs = np.array(
            [
                (without.seconds, shares.seconds)
                for without, shares in zip(
                    forms.get(LABELS, ()), forms.get(SHARES, ()), strict=True
                )
                if not isinstance(without.result, Refusal)
                and not isinstance(shares.result, Refusal)
            ]
            or [(np.nan, np.nan)]
        )
        ratio = float(np.median(pairs[:, 1] / pairs[:, 0]))
        yield {
            "voxels": voxels,
            "hemispheres": len(pairs),
            "CPU s, labels": float(np.median(pairs[:, 0])),
            "CPU s, shares": float(np.median(pairs[:, 1])),
            "ratio": ratio,
            "target": f"≤ {MAX_COST:g}",
            "met": bool(ratio <= MAX_COST),
        }


def _refusals(voxels: str, outcomes: Outcomes) -> str:
    """List why maps of each form are missing."""
    return cases.refusal_notes(
        {
            f"{voxels}, {name}": [each.result for each in timed]
            for name, timed in _forms(outcomes).items()
        }
    )
