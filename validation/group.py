"""Simulated cohorts: what registration, models and multiplicity make of a known effect."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy import ndimage

from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.stats.arrays import SideMaps
from hipsta_bids.stats.clusters import sheet_edges
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.design import Design
from hipsta_bids.stats.exchangeability import Visits
from hipsta_bids.stats.glm import RowModel, fit_maps
from hipsta_bids.stats.inference import MapKey, PermutationPart, correct, permute
from hipsta_bids.stats.mixed import fit_mixed
from hipsta_bids.stats.registration import mean_profiles, register
from hipsta_bids.stats.settings import CORRECTIONS, LongitudinalSettings, MultiplicitySettings
from hipsta_bids.stats.warps import warp_values
from hipsta_bids.types import Bool, Float
from validation.report import Cells, Content, suite, table

COHORTS, FEW_COHORTS = 40, 4
MAX_FALSE, MIN_POWER, MAX_PEAK, MAX_NULL = 0.08, 0.70, 1.5, 0.15
"""Targets with registration: shares, and nodes."""
MIN_FALSE_UNREGISTERED = 0.4
"""Without registration, the shift has to be taken for thinning; else this is no test of it."""

#: Mean thickness across the sheet, mm: a constant, and bumps of height, position and width.
_WALL = (1.6, ((0.35, 0.25, 0.10), (-0.30, 0.50, 0.08), (0.30, 0.80, 0.09)))
#: Mean curvature, 1/mm, in the same way.
_BEND = (0.10, ((0.20, 0.22, 0.08), (0.30, 0.62, 0.10), (-0.10, 0.85, 0.06)))


@dataclass(frozen=True, kw_only=True)
class SimulationPlan:
    """One cohort."""

    sizes: tuple[int, int] = (221, 93)
    """Subjects without and with the effect."""
    nodes: tuple[int, int] = (41, 21)
    """Of the sheet along x and y."""
    effect: float = 0.8
    """Thinning in the region, in standard deviations of thickness."""
    center: tuple[float, float] = (24.0, 10.0)
    """Of the region, nodes along x and y."""
    core: tuple[float, float] = (1.5, 4.5)
    """Half widths inside which the effect is full, nodes."""
    taper: float = 3.0
    """Width over which it fades to nothing, nodes."""
    shift: float = 2.0
    """Displacement along x between the groups, in the middle of the sheet, nodes."""
    warp_sd: tuple[float, float] = (1.0, 0.5)
    """Of each subject's displacement: half a wave and a whole wave along x, nodes."""
    thickness_sd: float = 0.2
    """mm, at a point between subjects of one age."""
    correlation: float = 2.0
    """Smoothness of thickness along the sheet: standard deviation of a Gaussian, nodes."""
    amplitude_sd: float = 0.15
    """Of a subject's curvature, fraction."""
    amplitude: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    """Factors of the second group's curvature: its level and its three bumps."""
    curvature_sd: float = 0.03
    """1/mm, at a point."""
    age_slope: float = -0.005
    """mm per year."""


#: For corrections: cohorts without displacement, whose effect is hard to find.
NULL_COHORTS, FEW_NULL_COHORTS, PERMUTATIONS = 200, 10, 200
SMALL = SimulationPlan(sizes=(40, 40), effect=0.8, shift=0.0, warp_sd=(0.0, 0.0))
NOTHING = replace(SMALL, sizes=(20, 20), effect=0.0)
LEVEL, LEVEL_RANGE = 0.05, (0.02, 0.08)
_SHARE_WITH_EFFECT = 5  # as many times fewer cohorts say how much is found

#: For differences of curvature: cohorts, subjects, and factors of level and bumps.
BIAS_COHORTS, FEW_BIAS_COHORTS, MAX_BIAS = 12, 3, 0.25
MIDDLE = SimulationPlan(sizes=(60, 40))
AMPLITUDES = {
    "the same": (1.0, 1.0, 1.0, 1.0),
    "all 30 % larger": (1.3, 1.3, 1.3, 1.3),
    "all 30 % smaller": (0.7, 0.7, 0.7, 0.7),
    "medial bend 40 % larger": (1.0, 1.4, 1.0, 1.0),
    "middle bend 40 % smaller": (1.0, 1.0, 0.6, 1.0),
    "lateral bend twice as large": (1.0, 1.0, 1.0, 2.0),
}

#: Ways to register, by whether each curve is standardized; the first is the default.
WAYS = {
    f"registr, {title}": GroupSettings().changed(registration={"standardize": standardize})
    for title, standardize in (("each standardized", True), ("as measured", False))
}
DEFAULT = next(iter(WAYS))

#: For joint tests: cohorts, their subjects and nodes, correlation of the measures, effect sizes.
JOINT_COHORTS, FEW_JOINT_COHORTS = 200, 10
_JOINT_N, _JOINT_NODES, _JOINT_R, _JOINT_EFFECT = 40, (21, 11), 0.3, 1.2
_JOINT_CORE = (slice(8, 13), slice(3, 8))

#: For repeated visits: participants and points.
_VISITED, _VISITED_POINTS = 40, 8

_CORRECTIONS = {
    "fdr2": "false discovery rate, two stages (default)",
    "bh": "false discovery rate, Benjamini-Hochberg",
    "permutation-tfce": "family-wise error, cluster enhancement",
    "permutation-max": "family-wise error, largest t",
}
_METHODS = {
    "registr": "registered, registr (default)",
    "none": "not registered",
}
_GROUP = "group"


@dataclass(frozen=True)
class SimulatedCohort:
    """Maps as the participant level would write them, and the truth."""

    thickness: Float
    """(subjects, x, y) mm."""
    curvature: Float
    """(subjects, x, y) 1/mm."""
    group: Bool
    """Who has the effect."""
    age: Float
    """Years."""
    sex: Bool
    warps: Float
    """(subjects, x) true registered coordinate of each node, 0..1."""
    affected: Float
    """(x, y) share of the full effect, at registered nodes."""


@dataclass(frozen=True)
class Finding:
    """One cohort through one analysis."""

    n_found: int
    """Points with a significant difference."""
    false_share: float
    """Of those found, points without effect; 0 if none is found."""
    core_power: float
    """Points with the full effect that are found, fraction; NaN for cohorts without effect."""
    peak_error: float
    """Distance along x from the region's center to the largest statistic, nodes."""


def simulate_cohort(plan: SimulationPlan, seed: int) -> SimulatedCohort:
    """Draw one cohort."""
    random = np.random.default_rng(seed)
    n, (x_nodes, y_nodes) = sum(plan.sizes), plan.nodes
    group = np.arange(n) >= plan.sizes[0]
    age = random.uniform(55, 85, n)
    sex = random.random(n) < 0.5  # noqa: PLR2004 -- as many women as men
    grid = np.linspace(0, 1, x_nodes)
    waves = np.stack([np.sin(np.pi * grid), np.sin(2 * np.pi * grid)])
    size = random.standard_normal((n, 2)) * plan.warp_sd
    size[:, 0] += plan.shift * group
    warps = grid + (size - size.mean(axis=0)) @ waves / (x_nodes - 1)
    affected = region(plan)
    scaled = mean_curvature(warps, plan.amplitude)
    bend = np.where(group[:, None], scaled, mean_curvature(warps))
    bend *= 1 + plan.amplitude_sd * random.standard_normal((n, 1))
    curvature = bend[:, :, None] + plan.curvature_sd * random.standard_normal((n, x_nodes, y_nodes))
    field = plan.thickness_sd * smooth_noise(random, (n, x_nodes, y_nodes), plan.correlation)
    field += plan.age_slope * (age - age.mean())[:, None, None]
    field -= plan.effect * plan.thickness_sd * group[:, None, None] * affected
    # A subject shows the values of a registered point where that point lies in the subject.
    seen = _at(field, warps) + mean_wall(warps)[:, :, None]
    return SimulatedCohort(seen, curvature, group, age, sex, warps, affected)


def region(plan: SimulationPlan) -> Float:
    """Share of the full effect at each registered node: a plateau with cosine edges."""
    edges = []
    for nodes, center, half in zip(plan.nodes, plan.center, plan.core, strict=True):
        beyond = (np.abs(np.arange(nodes) - center) - half) / plan.taper
        edges.append(0.5 + 0.5 * np.cos(np.pi * np.clip(beyond, 0, 1)))
    return np.asarray(np.outer(edges[0], edges[1]), dtype=np.float64)


def mean_wall(at: Float) -> Float:
    """Return mean thickness at positions along x, mm."""
    return _bumps(at, *_WALL)


def mean_curvature(
    at: Float, amplitude: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
) -> Float:
    """Return mean curvature at positions along x, 1/mm, by factors of its level and bumps."""
    level, *factors = amplitude
    bumps = [
        (factor * height, *place)
        for factor, (height, *place) in zip(factors, _BEND[1], strict=True)
    ]
    return _bumps(at, level * _BEND[0], bumps)


def _bumps(at: Float, level: float, bumps: Sequence[Sequence[float]]) -> Float:
    total = np.full(at.shape, level)
    for height, center, width in bumps:
        total += height * np.exp(-(((at - center) / width) ** 2))
    return total


def smooth_noise(random: np.random.Generator, shape: tuple[int, int, int], width: float) -> Float:
    """Gaussian noise of variance one, smooth along the sheet."""
    pad = int(np.ceil(4 * width))
    large = (shape[0], shape[1] + 2 * pad, shape[2] + 2 * pad)
    noise = ndimage.gaussian_filter(random.standard_normal(large), (0, width, width))
    noise = noise[:, pad:-pad, pad:-pad]
    return np.asarray(noise / noise.std(), dtype=np.float64)


def _at(maps: Float, warps: Float) -> Float:
    """Values of maps at other points along x, linearly between nodes."""
    x = np.clip(warps, 0, 1) * (maps.shape[1] - 1)
    left = np.minimum(x.astype(np.int64), maps.shape[1] - 2)
    weight = (x - left)[:, :, None]
    rows = np.arange(len(maps))[:, None]
    mixed: Float = (1 - weight) * maps[rows, left] + weight * maps[rows, left + 1]
    return mixed


def analyze(cohort: SimulatedCohort, plan: SimulationPlan, settings: GroupSettings) -> Finding:
    """Register, fit group + age + sex at each point, correct, and compare with the truth."""
    profiles = mean_profiles(cohort.curvature, settings.registration)
    warps = register(profiles, settings.registration).warps
    n = len(cohort.age)
    matrix = np.column_stack([np.ones(n), cohort.group, cohort.age - cohort.age.mean(), cohort.sex])
    design = Design(
        matrix=matrix.astype(np.float64),
        columns=("Intercept", _GROUP, "age", "sex"),
        rows=np.arange(n),
        dropped={},
        references={},
        contrasts=(Contrast(_GROUP, np.array([0.0, 1.0, 0.0, 0.0])),),
    )
    side = thickness_side(warp_values(cohort.thickness, warps))
    model = RowModel(design, settings.glm)
    fitted = {"L": fit_maps("L", side, model)}
    flags = correct(fitted, model, pd.DataFrame(index=range(n)), settings.multiplicity)
    found = flags[MapKey("thickness", _GROUP, "L")].rejected.reshape(cohort.affected.shape)
    (test,) = (t for t in fitted["L"].fits["thickness"].tests if t.contrast.name == _GROUP)
    count = int(found.sum())
    affected = cohort.affected if plan.effect else np.zeros_like(cohort.affected)
    core = found[affected == 1]
    return Finding(
        n_found=count,
        false_share=float((found & (affected == 0)).sum()) / max(count, 1),
        core_power=float(core.mean()) if core.size else float("nan"),
        peak_error=abs(int(np.nanargmax(np.abs(test.statistic))) // plan.nodes[1] - plan.center[0]),
    )


def thickness_side(maps: Float) -> SideMaps:
    """One side of a cohort with maps (visits, x, y) of thickness, mm, alone."""
    return SideMaps(
        rows=np.arange(len(maps)),
        maps={"thickness": maps},
        subfield=np.zeros(maps.shape, dtype=np.int8),
        names=("all",),
        summary=pd.DataFrame(index=range(len(maps))),
    )


def run_simulation(
    plan: SimulationPlan, settings: GroupSettings, seeds: Sequence[int]
) -> dict[str, float]:
    """Analyze cohorts with and without the effect, both with the shift: means by heading."""
    null = replace(plan, effect=0.0)
    with_effect, without = [], []
    for seed in seeds:
        own = settings.changed(multiplicity={"seed": seed})
        with_effect.append(analyze(simulate_cohort(plan, seed), plan, own))
        without.append(analyze(simulate_cohort(null, seed), null, own))
    peaks = [one.peak_error for one in with_effect if one.n_found]
    return {
        "FDR": float(np.mean([one.false_share for one in with_effect])),
        "core power": float(np.mean([one.core_power for one in with_effect])),
        "peak error, nodes": float(np.mean(peaks)) if peaks else float("nan"),
        "null cohorts with findings": float(np.mean([one.n_found > 0 for one in without])),
    }


@suite("group")
def run(full: bool) -> Iterator[Content]:
    """Analyze cohorts with a thinner region and a shift, and with the shift alone."""
    plan = SimulationPlan()
    nulls = NULL_COHORTS if full else FEW_NULL_COHORTS
    yield {"plan": plan}
    yield _cohorts(plan, range(COHORTS if full else FEW_COHORTS))
    yield _amplitudes(BIAS_COHORTS if full else FEW_BIAS_COHORTS)
    yield _corrections(nulls, *limits(nulls))
    joint = JOINT_COHORTS if full else FEW_JOINT_COHORTS
    yield _together(joint, *limits(joint))
    yield repeated_visits(*limits(nulls), range(nulls))


@table("group.cohorts")
def _cohorts(plan: SimulationPlan, seeds: Sequence[int]) -> Iterator[Cells]:
    for align, title in _METHODS.items():
        how = GroupSettings().changed(registration={"align": align})
        found = run_simulation(plan, how, seeds)
        met = (
            found["FDR"] > MIN_FALSE_UNREGISTERED
            if align == "none"
            else found["FDR"] <= MAX_FALSE
            and found["core power"] >= MIN_POWER
            and found["peak error, nodes"] <= MAX_PEAK
            and found["null cohorts with findings"] <= MAX_NULL
        )
        yield {"analysis": title, "cohorts": len(seeds), **found, "met": met}


def warp_bias(plan: SimulationPlan, settings: GroupSettings, seeds: Sequence[int]) -> Float:
    """(x,) mean over cohorts of how far groups are moved apart, less the truth, nodes."""
    away = np.zeros((len(seeds), plan.nodes[0]))
    for row, seed in enumerate(seeds):
        cohort = simulate_cohort(plan, seed)
        profiles = mean_profiles(cohort.curvature, settings.registration)
        error = register(profiles, settings.registration).warps - cohort.warps
        away[row] = error[cohort.group].mean(axis=0) - error[~cohort.group].mean(axis=0)
    return np.asarray(away.mean(axis=0) * (plan.nodes[0] - 1), dtype=np.float64)


@table("group.amplitudes")
def _amplitudes(cohorts: int) -> Iterator[Cells]:
    """Compare ways to register where groups differ in the size of curvature, or of one bend."""
    for shift in (0.0, SimulationPlan.shift):
        for title, amplitude in AMPLITUDES.items():
            plan = replace(MIDDLE, shift=shift, amplitude=amplitude)
            biases = {
                way: float(np.abs(warp_bias(plan, how, range(cohorts))).max())
                for way, how in WAYS.items()
            }
            yield {
                "curvature of the second group": title,
                "shift, nodes": shift,
                "cohorts": cohorts,
                **biases,
                "met": biases[DEFAULT] <= MAX_BIAS,
            }


def limits(cohorts: int) -> tuple[float, float]:
    """Shares of null cohorts with findings that are as intended; of few, within three SDs."""
    if cohorts >= NULL_COHORTS:
        return LEVEL_RANGE
    return 0.0, LEVEL + 3 * (LEVEL * (1 - LEVEL) / cohorts) ** 0.5


@table("group.corrections")
def _corrections(cohorts: int, least: float, most: float) -> Iterator[Cells]:
    """Count what each correction finds where there is nothing, and where there is something."""
    settings = GroupSettings().changed(registration={"align": "none"})
    for method in CORRECTIONS:
        how = {"method": method, "permutations": PERMUTATIONS, "alpha": LEVEL}
        null, some = (
            [
                analyze(
                    simulate_cohort(plan, i), plan, settings.changed(multiplicity=how | {"seed": i})
                )
                for i in range(number)
            ]
            for plan, number in ((NOTHING, cohorts), (SMALL, cohorts // _SHARE_WITH_EFFECT))
        )
        false = float(np.mean([one.n_found > 0 for one in null]))
        yield {
            "correction": _CORRECTIONS[method],
            "null cohorts": cohorts,
            "null cohorts with findings": false,
            "cohorts with effect": len(some),
            "FDR": float(np.mean([one.false_share for one in some])),
            "core power": float(np.mean([one.core_power for one in some])),
            "met": (least if method.startswith("permutation") else 0.0) <= false <= most,
        }


def joint_findings(effects: tuple[float, float], seed: int) -> dict[str, Bool]:
    """(x, y) what tests of two measures, alone and together, find in one cohort of two groups."""
    random = np.random.default_rng(seed)
    group = np.arange(_JOINT_N) % 2
    age = random.normal(0.0, 8.0, _JOINT_N)
    first, second = (smooth_noise(random, (_JOINT_N, *_JOINT_NODES), 1.5) for _ in range(2))
    fields = first, _JOINT_R * first + (1 - _JOINT_R**2) ** 0.5 * second
    parts = []
    for field, effect in zip(fields, effects, strict=True):
        field[(group == 1, *_JOINT_CORE)] -= effect
        parts.append(
            PermutationPart(
                maps=field.reshape(_JOINT_N, -1),
                matrix=np.column_stack([np.ones(_JOINT_N), group, age]),
                subjects=np.arange(_JOINT_N),
                edges=sheet_edges(*_JOINT_NODES),
            )
        )
    contrast = Contrast(_GROUP, np.array([0.0, 1.0, 0.0]))
    how = MultiplicitySettings(
        method="permutation-tfce", permutations=PERMUTATIONS, alpha=LEVEL, seed=seed
    )
    single = how.changed(method="permutation-max")
    one, two = (permute([part], contrast, settings=single)[0].p_max for part in parts)
    (tippett,) = permute([parts], contrast, settings=single, combine="tippett")
    (fisher,) = permute([parts], contrast, settings=how, combine="fisher")
    found = {
        "first measure alone, largest t": one <= LEVEL,
        "either, each at half the level": np.minimum(one, two) <= LEVEL / 2,
        "together, Fisher (default)": fisher.p_max <= LEVEL,
        "together, Fisher, cluster enhancement": fisher.p_enhanced <= LEVEL,
        "together, Tippett": tippett.p_max <= LEVEL,
    }
    return {name: own.reshape(_JOINT_NODES) for name, own in found.items()}


@table("group.together")
def _together(cohorts: int, least: float, most: float) -> Iterator[Cells]:
    """Count what tests of two measures together find: nothing there, in both, and in one."""
    seeds = range(cohorts)
    null = [joint_findings((0.0, 0.0), seed) for seed in seeds]
    both = [joint_findings((_JOINT_EFFECT, _JOINT_EFFECT), seed) for seed in seeds]
    single = [joint_findings((_JOINT_EFFECT, 0.0), seed) for seed in seeds]
    for name in null[0]:
        false = float(np.mean([found[name].any() for found in null]))
        power, in_one = (
            float(np.mean([found[name][_JOINT_CORE].mean() for found in some]))
            for some in (both, single)
        )
        yield {
            "test": name,
            "cohorts": cohorts,
            "null cohorts with findings": false,
            "power, effect in both": power,
            "power, effect in the first": in_one,
            "met": least <= false <= most,
        }


def repeated_findings(seed: int, slope_sd: float) -> dict[str, Float]:
    """(contrasts,) what tests of group, time, and both find in visits without any effect.

    Mixed models the share of the points; permutations 1 if any point survives.
    """
    random = np.random.default_rng(seed)
    who = np.repeat(np.arange(_VISITED), random.integers(3, 5, _VISITED))
    visit = np.arange(len(who)) - np.searchsorted(who, who)
    time = visit + random.uniform(-0.15, 0.15, len(who)) * (visit > 0)
    own, slopes = random.normal(0, 1, (2, _VISITED, _VISITED_POINTS))
    maps = own[who] + slope_sd * slopes[who] * time[:, None]
    maps += random.normal(0, 0.5, maps.shape)
    group = who % 2
    matrix = np.column_stack([np.ones(len(who)), group, time, group * time])
    contrasts = [Contrast(name, row) for name, row in zip("gti", np.eye(4)[1:], strict=True)]
    names, plain = who.astype(np.str_), LongitudinalSettings()
    found = {
        title: [
            (test.p <= LEVEL).mean()
            for test in fit_mixed(maps, matrix, names, contrasts, plain, times=times).tests
        ]
        for title, times in (("slopes (default)", time), ("intercepts only", None))
    }
    part = PermutationPart(
        maps=maps,
        matrix=matrix,
        subjects=np.arange(len(who)),
        edges=np.empty((0, 2), dtype=np.int64),
        visits=Visits(who, time, slopes=slope_sd > 0),
    )
    how = MultiplicitySettings(method="permutation-max", permutations=PERMUTATIONS, seed=seed)

    def permuted(contrast: Contrast, settings: MultiplicitySettings) -> float:
        return float((permute([part], contrast, settings=settings)[0].p_max <= LEVEL).any())

    inside = how.changed(visits="within")
    found["permutation (default)"] = [permuted(one, how) for one in contrasts]
    found["permutation within participants"] = [
        np.nan,
        *(permuted(one, inside) for one in contrasts[1:]),
    ]
    return {title: np.array(own) for title, own in found.items()}


@table("group.repeated")
def repeated_visits(least: float, most: float, seeds: Sequence[int]) -> Iterator[Cells]:
    """Count what tests find where there is nothing; the limits are those of their level."""
    for slope_sd in (0.3, 0.0):
        found = [repeated_findings(seed, slope_sd) for seed in seeds]
        for title in found[0]:
            false = np.mean([one[title] for one in found], axis=0)
            yield {
                "test": title,
                "SD of slopes": slope_sd,
                "cohorts": len(seeds),
                **dict(zip(("group", "time", "group x time"), map(float, false), strict=True)),
                "met": all(least <= one <= most for one in false) if "default" in title else None,
            }
