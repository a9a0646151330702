"""Simulated cohorts of sheets with known effects, and what the analysis makes of them.

One region is thinner in one group, and everything lies a little more lateral in that group. An
analysis without registration takes the shift for thinning; it must fail here.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from hipsta_bids.group.contrasts import Contrast
from hipsta_bids.group.glm import PointTest, fit_points
from hipsta_bids.group.multiplicity import fdr_two_stage
from hipsta_bids.group.profiles import mean_profiles
from hipsta_bids.group.registration import register
from hipsta_bids.group.warps import warp_values
from hipsta_bids.group_settings import GroupSettings

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


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
    curvature_sd: float = 0.03
    """1/mm, at a point."""
    age_slope: float = -0.005
    """mm per year."""


#: Mean thickness across the sheet, mm: a constant, and bumps of height, place and width.
_WALL = (1.6, ((0.35, 0.25, 0.10), (-0.30, 0.50, 0.08), (0.30, 0.80, 0.09)))
#: Mean curvature, 1/mm, in the same way.
_BEND = (0.10, ((0.20, 0.22, 0.08), (0.30, 0.62, 0.10), (-0.10, 0.85, 0.06)))


@dataclass(frozen=True)
class SimulatedCohort:
    """Maps as the participant level would give them, and the truth."""

    thickness: FloatArray
    """(subjects, x, y) mm."""
    curvature: FloatArray
    """(subjects, x, y) 1/mm."""
    group: BoolArray
    """Who has the effect."""
    age: FloatArray
    """Years."""
    sex: BoolArray
    warps: FloatArray
    """(subjects, x) true registered coordinate of each node, 0..1."""
    affected: FloatArray
    """(x, y) share of the full effect, at registered nodes."""


@dataclass(frozen=True)
class Finding:
    """One cohort through one analysis."""

    n_found: int
    """Points with a significant difference."""
    false_share: float
    """Of those found, points without effect; 0 if none is found."""
    core_power: float
    """Points with the full effect that are found, fraction."""
    peak_error: float
    """Distance along x from the region's center to the largest statistic, nodes."""


@dataclass(frozen=True)
class SimulationResult:
    """Means over cohorts."""

    false_discovery_rate: float
    core_power: float
    peak_error: float
    """Nodes; cohorts with a finding."""
    null_findings: float
    """Share of cohorts with a shift but no effect in which anything is found."""
    cohorts: int


def simulate_cohort(plan: SimulationPlan, seed: int) -> SimulatedCohort:
    """Draw one cohort.

    Parameters
    ----------
    plan : SimulationPlan
        Sizes and effects.
    seed : int
        The same seed gives the same cohort, with the same noise whatever the effect.
    """
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
    affected = _region(plan)
    bend = _bumps(warps, _BEND) * (1 + plan.amplitude_sd * random.standard_normal((n, 1)))
    curvature = bend[:, :, None] + plan.curvature_sd * random.standard_normal((n, x_nodes, y_nodes))
    field = plan.thickness_sd * _smooth_noise(random, (n, x_nodes, y_nodes), plan.correlation)
    field += plan.age_slope * (age - age.mean())[:, None, None]
    field -= plan.effect * plan.thickness_sd * group[:, None, None] * affected
    # What belongs to a registered place is seen where the subject has that place.
    seen = _at(field, warps) + _bumps(warps, _WALL)[:, :, None]
    return SimulatedCohort(seen, curvature, group, age, sex, warps, affected)


def analyze(cohort: SimulatedCohort, plan: SimulationPlan, settings: GroupSettings) -> Finding:
    """Register, fit group + age + sex at each point, control the FDR, compare with the truth."""
    profiles = mean_profiles(cohort.curvature, settings.registration)
    registration = register(profiles, settings.registration)
    maps = warp_values(cohort.thickness, registration.warps).reshape(len(profiles), -1)
    matrix = np.column_stack(
        [np.ones(len(maps)), cohort.group, cohort.age - cohort.age.mean(), cohort.sex]
    ).astype(np.float64)
    contrast = Contrast("group", np.array([0.0, 1.0, 0.0, 0.0]))
    (test,) = fit_points(maps, matrix, [contrast], settings.glm).tests
    return _judge(test, cohort, plan, settings.multiplicity.alpha)


def run_simulation(
    plan: SimulationPlan, settings: GroupSettings, seeds: Sequence[int]
) -> SimulationResult:
    """Analyze cohorts with and without the effect; both have the shift."""
    null = replace(plan, effect=0.0)
    with_effect = [analyze(simulate_cohort(plan, seed), plan, settings) for seed in seeds]
    without = [analyze(simulate_cohort(null, seed), null, settings) for seed in seeds]
    peaks = [one.peak_error for one in with_effect if one.n_found]
    return SimulationResult(
        false_discovery_rate=float(np.mean([one.false_share for one in with_effect])),
        core_power=float(np.mean([one.core_power for one in with_effect])),
        peak_error=float(np.mean(peaks)) if peaks else float("nan"),
        null_findings=float(np.mean([one.n_found > 0 for one in without])),
        cohorts=len(seeds),
    )


def _judge(test: PointTest, cohort: SimulatedCohort, plan: SimulationPlan, alpha: float) -> Finding:
    found = fdr_two_stage(test.p, alpha).rejected.reshape(cohort.affected.shape)
    count = int(found.sum())
    peak = int(np.nanargmax(np.abs(test.statistic))) // plan.nodes[1]
    return Finding(
        n_found=count,
        false_share=float((found & (cohort.affected == 0)).sum()) / max(count, 1)
        if plan.effect
        else float(count > 0),
        core_power=float(found[cohort.affected == 1].mean()),
        peak_error=abs(peak - plan.center[0]),
    )


def _region(plan: SimulationPlan) -> FloatArray:
    """Share of the full effect at each registered node: a plateau with cosine edges."""
    edges = []
    for nodes, center, half in zip(plan.nodes, plan.center, plan.core, strict=True):
        beyond = (np.abs(np.arange(nodes) - center) - half) / plan.taper
        edges.append(0.5 + 0.5 * np.cos(np.pi * np.clip(beyond, 0, 1)))
    return np.asarray(np.outer(edges[0], edges[1]), dtype=np.float64)


def _bumps(
    at: FloatArray, shape: tuple[float, tuple[tuple[float, float, float], ...]]
) -> FloatArray:
    level, bumps = shape
    total = np.full(at.shape, level)
    for height, place, width in bumps:
        total += height * np.exp(-(((at - place) / width) ** 2))
    return total


def _smooth_noise(
    random: np.random.Generator, shape: tuple[int, int, int], width: float
) -> FloatArray:
    """Gaussian noise of variance one, smooth along the sheet."""
    pad = int(np.ceil(4 * width))
    large = (shape[0], shape[1] + 2 * pad, shape[2] + 2 * pad)
    noise = ndimage.gaussian_filter(random.standard_normal(large), (0, width, width))
    noise = noise[:, pad:-pad, pad:-pad]
    return np.asarray(noise / noise.std(), dtype=np.float64)


def _at(maps: FloatArray, warps: FloatArray) -> FloatArray:
    """Values of maps at other places along x, linearly between nodes."""
    place = np.clip(warps, 0, 1) * (maps.shape[1] - 1)
    left = np.minimum(place.astype(np.int64), maps.shape[1] - 2)
    weight = (place - left)[:, :, None]
    rows = np.arange(len(maps))[:, None]
    mixed: FloatArray = (1 - weight) * maps[rows, left] + weight * maps[rows, left + 1]
    return mixed
