"""Simulated sites: what ComBat leaves of their shifts and scales, and what it does to effects."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from hipsta_bids.extensions.sites.combat import Visits, fit_effects, harmonize
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.stats.arrays import Float, Int
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.glm import fit_points
from hipsta_bids.stats.mixed import fit_mixed
from validation.report import Cell, Cells, Content, suite, table

COHORTS, FEW_COHORTS = 40, 10
MAX_LEFT, MAX_BIAS, MAX_ERROR = 0.05, 0.05, 0.03
"""Targets: shares of what was planted, and distance of the false positive rate from the level."""
LEVEL = 0.05
_VISITS, _FEW_NODES = 3, (15, 9)


@dataclass(frozen=True, kw_only=True)
class SitesPlan:
    """One cohort; values have an SD of one at each point, before effects of sites."""

    sizes: tuple[int, ...] = (60, 40, 50, 30, 40)
    """Participants by site."""
    cases: tuple[float, ...] = (0.1, 0.9, 0.5, 0.2, 0.8)
    """Share of the second group by site."""
    shifts: tuple[float, ...] = (0.6, -0.5, 0.2, -0.4, 0.3)
    """Of sites, mean over points."""
    scales: tuple[float, ...] = (1.3, 0.75, 1.0, 1.15, 0.85)
    """Of residuals of sites, mean over points."""
    local: float = 0.1
    """SD over points of shifts, and of logarithms of scales."""
    nodes: tuple[int, int] = (31, 15)
    smoothness: float = 1.0
    """SD of a Gaussian, nodes."""
    effect: float = 0.5
    """Of the second group, with repeated sessions on the slope over the time of all sessions."""
    missing: float = 0.02
    """Share of values that are missing."""
    person: float = 0.7
    """Share of the variance between participants, with repeated sessions."""


def simulate_sites(
    plan: SitesPlan, seed: int, *, repeated: bool = False
) -> tuple[Float, Visits, Float, Float]:
    """Draw one cohort; with repeated sessions of three each, all at one site.

    Returns values (visits, points), visits, and the true shift and scale (sites, points). Columns
    that are kept are group and age, with repeated sessions also time and its product with group.
    """
    random = np.random.default_rng(seed)
    sites, n = len(plan.sizes), sum(plan.sizes)
    site: Int = np.repeat(np.arange(sites), plan.sizes).astype(np.int64)
    group = (random.random(n) < np.take(plan.cases, site)).astype(np.float64)
    age = random.normal(0.0, 1.0, n) + 0.5 * group
    person: Int | None = None
    base = _noise(random, n, plan)
    columns: Float = np.column_stack([group, age])
    if repeated:
        times = np.tile(np.linspace(-1, 1, _VISITS), n) / 2
        site, person = np.repeat(site, _VISITS), np.repeat(np.arange(n), _VISITS)
        columns = np.repeat(columns, _VISITS, axis=0)
        columns = np.column_stack([columns, times, columns[:, 0] * times])
        own = _noise(random, len(site), plan) * np.sqrt(1 - plan.person)
        base = np.repeat(base, _VISITS, axis=0) * np.sqrt(plan.person)
    else:
        own, base = base, np.zeros_like(base)
    shift = np.array(plan.shifts)[:, None] + plan.local * _noise(random, sites, plan)
    scale = np.array(plan.scales)[:, None] * np.exp(plan.local * _noise(random, sites, plan))
    slopes = np.zeros(columns.shape[1])
    slopes[-1 if repeated else 0], slopes[1] = plan.effect, -0.2
    # With repeated sessions the scale is that of differences within participants.
    values = (columns @ slopes)[:, None] + base + shift[site] + scale[site] * own
    values[random.random(values.shape) < plan.missing] = np.nan
    return values, Visits(site=site, columns=columns, participant=person), shift, scale


def _noise(random: np.random.Generator, n: int, plan: SitesPlan) -> Float:
    """(n, points) smooth fields of variance one."""
    white = random.standard_normal((n, *plan.nodes))
    smooth = ndimage.gaussian_filter(white, (0, plan.smoothness, plan.smoothness), mode="wrap")
    return np.asarray(smooth.reshape(n, -1) / smooth.std(), dtype=np.float64)


def left_over(plan: SitesPlan, seeds: Sequence[int], settings: GroupSettings) -> dict[str, float]:
    """Regress what ComBat leaves of shifts and of logarithms of scales on what was planted.

    Returns the slopes over sites, points and cohorts, by heading: of means over the map, and of
    what varies over it.
    """
    left, planted = np.zeros((2, 4))
    for seed in seeds:
        values, visits, shift, scale = simulate_sites(plan, seed)
        effects, _ = fit_effects(
            values, visits, len(plan.sizes), settings.longitudinal, pooled=True
        )
        weights = np.array(plan.sizes) / sum(plan.sizes)
        truth = np.stack([shift, np.log(scale)])
        taken = np.stack([effects.shift * effects.sd, np.log(effects.scale * effects.sd)])
        # Only differences between sites can be known; what all have in common is the mean.
        truth, taken = (one - (weights @ one)[:, None] for one in (truth, taken))
        for part, keep in enumerate((True, False)):
            means = [one.mean(axis=2, keepdims=True) for one in (truth, taken)]
            true, known = means if keep else (truth - means[0], taken - means[1])
            left[part::2] += np.sum(true * (true - known), axis=(1, 2))
            planted[part::2] += np.sum(true**2, axis=(1, 2))
    names = ("shift left", "scale left", "of shift, local part left", "of scale, local part left")
    return dict(zip(names, (left / planted)[[0, 2, 1, 3]].tolist(), strict=True))


def analyze_sites(
    plan: SitesPlan,
    seeds: Sequence[int],
    settings: GroupSettings,
    *,
    with_combat: bool,
    with_site: bool,
    repeated: bool = False,
) -> tuple[float, float]:
    """Fit the model to cohorts: mean estimate, and share of points with p below the level."""
    estimates, rejected = [], []
    for seed in seeds:
        values, visits, *_ = simulate_sites(plan, seed, repeated=repeated)
        if with_combat:
            effects, _ = fit_effects(
                values, visits, len(plan.sizes), settings.longitudinal, pooled=True
            )
            values = harmonize(values, visits, effects)
        member = np.eye(len(plan.sizes))[visits.site]
        means = member if with_site else np.ones((len(member), 1))
        matrix = np.hstack([means, visits.columns])
        weights = np.zeros(matrix.shape[1])
        weights[-1 if repeated else means.shape[1]] = 1.0
        contrast = [Contrast("effect", weights)]
        if visits.participant is not None:
            names = visits.participant.astype(np.str_)
            fit = fit_mixed(values, matrix, names, contrast, settings.longitudinal)
        else:
            fit = fit_points(values, matrix, contrast, settings.glm)
        (test,) = fit.tests
        estimates.append(test.estimate[0].mean())
        rejected.append(np.mean(test.p < LEVEL))
    return float(np.mean(estimates)), float(np.mean(rejected))


@suite("harmonization")
def run(full: bool) -> Iterator[Content]:
    """Plant shifts and scales of sites, take them out, and test an effect and its absence."""
    plan, seeds = SitesPlan(), range(COHORTS if full else FEW_COHORTS)
    ends = {name: getattr(plan, name) for name in ("cases", "shifts", "scales")}
    yield {name: (min(values), max(values)) for name, values in ends.items()}
    yield {"plan": plan, "sizes": ", ".join(map(str, plan.sizes))}
    yield _left(plan, seeds, GroupSettings())
    yield _effects(plan, seeds, GroupSettings())


@table("harmonization.left")
def _left(plan: SitesPlan, seeds: Sequence[int], settings: GroupSettings) -> Iterator[Cells]:
    for title, sizes, judged in (
        ("as above", plan.sizes, True),
        ("25 each", (25,) * len(plan.sizes), False),
        ("10 each", (10,) * len(plan.sizes), False),
    ):
        found = left_over(replace(plan, sizes=sizes), seeds, settings)
        row: dict[str, Cell] = {"participants of sites": title, "cohorts": len(seeds), **found}
        if judged:
            row["met"] = max(abs(found["shift left"]), abs(found["scale left"])) <= MAX_LEFT
        yield row


@table("harmonization.effects")
def _effects(plan: SitesPlan, seeds: Sequence[int], settings: GroupSettings) -> Iterator[Cells]:
    null = replace(plan, effect=0.0)
    for title, combat, site, repeated, judged in (
        ("nothing done", False, False, False, False),
        ("sites in the model only", False, True, False, False),
        ("ComBat only", True, False, False, False),
        ("ComBat, sites in the model (--harmonize)", True, True, False, True),
        ("three sessions: nothing done", False, False, True, False),
        ("three sessions: ComBat, sites in the model", True, True, True, True),
    ):
        how = {"with_combat": combat, "with_site": site, "repeated": repeated}
        # Mixed models take long.
        nodes = _FEW_NODES if repeated else plan.nodes
        effect, found = analyze_sites(replace(plan, nodes=nodes), seeds, settings, **how)
        _, false = analyze_sites(replace(null, nodes=nodes), seeds, settings, **how)
        bias = effect / plan.effect - 1
        row: dict[str, Cell] = {"analysis": title, "cohorts": len(seeds), "bias": bias}
        row |= {"found": found, "false positives": false}
        if judged:
            row["met"] = abs(bias) <= MAX_BIAS and abs(false - LEVEL) <= MAX_ERROR
        yield row
