"""Alignment by curvature: effects in simulated cohorts, and labels of real brains."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from scipy import ndimage, stats
from statsmodels.stats.multitest import multipletests

from hipsta_bids.inputs.labels import read_label_volume
from hipsta_bids.inputs.search import HemisphereInput
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.settings import Settings
from hipsta_bids.types import Bool, Float, HemisphereMaps
from validation import cases, group, labelings
from validation.displacements import NONE, REGISTR, WAYS, align, sample
from validation.report import Cells, Content, suite, table

COHORTS, FEW_COHORTS = 30, 2
SIZES = (40, 40)
NODES = (41, 21)
EFFECT = 0.8
"""Thinning in the region, in standard deviations of thickness."""
THICKNESS_SD, THICKNESS_SMOOTH = 0.3, 2.0
"""mm at a point, and standard deviation of a Gaussian, nodes."""
CURVATURE_SD, CURVATURE_SMOOTH = 0.075, 1.75
"""The same, 1/mm: as three brains differ from their mean."""
WALL = 1.9
"""Times the bumps of thickness of the group suite: slopes are then those of three brains."""
TREND_SD = 0.045
"""1/mm, of mean curvature along y about its profile along x."""
AMOUNTS = (0.5, 1.0)
"""Root mean square of displacements along x, nodes: small, and as measured between brains."""
ALONG_Y = 0.5
"""Displacement along y in two dimensions, of that along x."""
SHIFT = 2.0
"""Nodes between groups in the middle of the sheet."""

#: Displacements of simulated cohorts.
_KINDS = {"one": "along x, one for all rows", "rows": "along x, by row", "both": "along x and y"}

#: Differences between groups: factors of curvature, and the shift, nodes.
DIFFERENCES = {
    "none": ((1.0, 1.0, 1.0, 1.0), 0.0),
    f"shift of {SHIFT:g} nodes": ((1.0, 1.0, 1.0, 1.0), SHIFT),
    "curvature 30 % larger": ((1.3, 1.3, 1.3, 1.3), 0.0),
    "medial bend 40 % larger": ((1.0, 1.4, 1.0, 1.0), 0.0),
    "middle bend 40 % smaller": ((1.0, 1.0, 0.6, 1.0), 0.0),
}


@dataclass(frozen=True, kw_only=True)
class Plan:
    """One kind of cohort."""

    kind: str = "one"
    """In ``_KINDS``."""
    amount: float = 0.0
    """Root mean square of displacements along x, nodes."""
    amplitude: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    """Factors of the second group's curvature: its level and its three bumps."""
    shift: float = 0.0
    """Nodes by which the second group lies more lateral, in the middle of the sheet."""


@dataclass(frozen=True, kw_only=True)
class Cohort:
    """Maps of two groups without an effect, and the truth."""

    thickness: Float
    """(n, x, y) mm."""
    thinning: Float
    """(n, x, y) mm, at the participants' nodes: the effect, if there were one."""
    curvature: Float
    """(n, x, y) 1/mm."""
    group: Bool
    moved: Float
    """(n, 2, x, y) true position of each node minus the node, nodes."""


def simulate(plan: Plan, seed: int) -> Cohort:
    """Draw one cohort."""
    random = np.random.default_rng(seed)
    n = sum(SIZES)
    second = np.arange(n) >= SIZES[0]
    moved = displace(plan, second, random)
    grid = np.linspace(0.0, 1.0, NODES[0])
    bends = np.stack([group.mean_curvature(grid), group.mean_curvature(grid, plan.amplitude)])
    trend = TREND_SD * group.smooth_noise(np.random.default_rng(0), (1, *NODES), 2.5)
    curvature = sample(bends[second.astype(int)][:, :, None] + trend, moved)
    curvature *= 1 + group.SimulationPlan.amplitude_sd * random.standard_normal((n, 1, 1))
    curvature += CURVATURE_SD * group.smooth_noise(random, (n, *NODES), CURVATURE_SMOOTH)
    field = THICKNESS_SD * group.smooth_noise(random, (n, *NODES), THICKNESS_SMOOTH)
    field += WALL * group.mean_wall(grid)[:, None]
    lost = EFFECT * THICKNESS_SD * second[:, None, None] * group.region(group.SimulationPlan())
    return Cohort(
        thickness=sample(field, moved),
        thinning=sample(lost, moved),
        curvature=curvature,
        group=second,
        moved=moved,
    )


def displace(plan: Plan, second: Bool, random: np.random.Generator) -> Float:
    """Draw smooth displacements (n, 2, x, y) of mean zero that keep all edges, nodes."""
    grid_x, grid_y = (np.linspace(0.0, 1.0, nodes) for nodes in NODES)
    moved = np.zeros((len(second), 2, *NODES))
    if plan.amount:
        rows = 1 if plan.kind == "one" else len(_SLOW)
        waves = np.stack([np.sin(np.pi * grid_x), 0.5 * np.sin(2 * np.pi * grid_x)])
        size = random.standard_normal((len(second), 2, rows)) * _SLOW[:rows]
        moved[:, 0] = np.einsum("nwk,wx,ky->nxy", size, waves, _slow(grid_y)[:rows])
        if plan.kind == "both":
            size = random.standard_normal((len(second), len(_SLOW))) * _SLOW
            moved[:, 1] = np.einsum("nk,kx,y->nxy", size, _slow(grid_x), np.sin(np.pi * grid_y))
        for axis, amount in ((0, plan.amount), (1, plan.amount * ALONG_Y)):
            moved[:, axis] *= amount / max(cases.rms(moved[:, axis]), 1e-12)
    moved[:, 0] += plan.shift * second[:, None, None] * np.sin(np.pi * grid_x)[:, None]
    moved -= moved.mean(axis=0)
    return moved


#: Standard deviations of a constant, a slope and a wave across the sheet.
_SLOW = np.array([1.0, 0.7, 0.7])


def _slow(grid: Float) -> Float:
    return np.stack([np.ones_like(grid), 2 * grid - 1, np.cos(2 * np.pi * grid)])


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """One cohort, aligned in one way."""

    error: tuple[float, float]
    """Root mean square error of positions along x and y, nodes."""
    created: float
    """Largest difference of mean position errors between the groups, along x, nodes."""
    null: bool
    """Whether any point of the cohort without effect is significant."""
    power: float
    """Share of the region's points that are found."""
    false_share: float
    """Share of the found points outside of the effect."""
    missed_by: float
    """Distance of the found region's center from the true one, nodes; NaN if none is found."""


def judge(cohort: Cohort, title: str, *, effect: bool = True) -> Outcome:
    """Align a cohort, test its groups without and with the effect, and compare with the truth."""
    moved, _ = align(cohort.curvature, title)
    error = moved + np.stack([sample(cohort.moved[:, k], moved) for k in (0, 1)], axis=1)
    apart = error[cohort.group, 0].mean(axis=0) - error[~cohort.group, 0].mean(axis=0)
    error -= error.mean(axis=0)
    thickness = sample(cohort.thickness, moved)
    null, _ = compare_groups(thickness, cohort.group)
    power = false_share = missed_by = float("nan")
    if effect:
        affected = group.region(group.SimulationPlan())
        thinned = thickness - sample(cohort.thinning, moved)
        found, statistic = compare_groups(thinned, cohort.group)
        power = float(found[affected == 1].mean())
        false_share = float((found & (affected == 0)).sum()) / max(int(found.sum()), 1)
        if found.any():
            weight = np.where(found, np.abs(statistic), 0.0)
            missed_by = float(np.linalg.norm(_center(weight) - _center(affected)))
    return Outcome(
        error=(cases.rms(error[:, 0]), cases.rms(error[:, 1])),
        created=float(np.abs(apart).max()),
        null=bool(null.any()),
        power=power,
        false_share=false_share,
        missed_by=missed_by,
    )


def compare_groups(maps: Float, second: Bool) -> tuple[Bool, Float]:
    """Test two groups at each point: (x, y) points that survive FDR of two stages, and t."""
    test = stats.ttest_ind(maps[~second], maps[second])
    survives = multipletests(test.pvalue.ravel(), group.LEVEL, method="fdr_tsbky")[0]
    return survives.reshape(maps.shape[1:]), np.asarray(test.statistic, dtype=np.float64)


def _center(weight: Float) -> Float:
    return np.asarray(ndimage.center_of_mass(weight), dtype=np.float64)


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """Maps (x, y) of one real hemisphere."""

    brain: str
    hemi: str
    curvature: Float
    thickness: Float
    subfield: Float
    """Subiculum, CA1, or beyond: 0, 1, 2."""


@dataclass(frozen=True, kw_only=True)
class Brains:
    """Hemispheres, measured in several ways."""

    first: Sequence[Sheet]
    """Of the first labeling; templates are made of these."""
    pairs: Mapping[str, Sequence[tuple[Sheet, Sheet]]]
    """Two sheets of the same brain, by what differs."""


_REVISED, _THICK, _SIDES = "revised labels", "slices of 1.5 mm", "left and right"


def read_brains(labels: Path) -> Brains:
    """Measure the brains that were labeled twice, their thick slices, and those of HippUnfold."""
    revised = labelings.revisions(labels, Settings())
    coarse = [
        item
        for item in cases.segmentations(labels)
        if cases.longest_edge(read_label_volume(item)) > labelings.FINE
    ]
    others = cases.segmentations(*cases.hippunfold_beside(labels))
    sets = [[pair.first for pair in revised], [pair.second for pair in revised], coarse, others]
    measured = cases.run_groups(measure_sheet, dict(enumerate(sets)))
    first, second, thick, further = (
        [sheet for sheet in sheets if isinstance(sheet, Sheet)] for sheets in measured.values()
    )
    kinds = {_REVISED: (first, second), _THICK: (first, thick), _SIDES: (first + further,) * 2}
    return Brains(
        first=first,
        pairs={
            kind: [
                (one, two)
                for one, two in product(*sheets)
                if one.brain == two.brain
                and ((one.hemi, two.hemi) == ("L", "R") if kind == _SIDES else one.hemi == two.hemi)
            ]
            for kind, sheets in kinds.items()
        },
    )


def measure_sheet(item: HemisphereInput) -> Sheet:
    """Measure a hemisphere; brains have the number of the participant."""
    maps: HemisphereMaps = cases.measure_body(read_label_volume(item), item.hemi)
    subfield = np.where(
        maps.subfield <= Tissue.SUBICULUM, 0, np.where(maps.subfield == Tissue.CA1, 1, 2)
    )
    return Sheet(
        brain=item.subject.rstrip("AB").removeprefix("0"),
        hemi=item.hemi,
        curvature=maps.maps["curvature"],
        thickness=maps.thickness,
        subfield=subfield.astype(np.float64),
    )


def _stack(sheets: Sequence[Sheet], name: str) -> Float:
    return np.array([getattr(sheet, name) for sheet in sheets])


@dataclass(frozen=True, kw_only=True)
class Likeness:
    """How alike two sheets are at the same registered nodes."""

    same_label: float
    """Share of nodes."""
    border: float
    """Mean distance of the borders of the subiculum along x, nodes."""
    thickness: float
    """Pearson's r."""
    curvature: float
    """Pearson's r."""


def compare_sheets(one: Sheet, two: Sheet, moved: Float) -> Likeness:
    """Compare two sheets at registered nodes, by the displacements (2, 2, x, y) of both."""
    pair = (one, two)
    first, second = sample(_stack(pair, "subfield"), moved, order=0)
    r = {
        name: float(np.corrcoef(*sample(_stack(pair, name), moved).reshape(2, -1))[0, 1])
        for name in ("thickness", "curvature")
    }
    borders = [(labels == 0).sum(axis=0) for labels in (first, second)]
    return Likeness(
        same_label=float((first == second).mean()),
        border=float(np.abs(borders[0] - borders[1]).mean()),
        thickness=r["thickness"],
        curvature=r["curvature"],
    )


def compare_left_out(
    brains: Sequence[Sheet], title: str
) -> dict[str, tuple[list[Likeness], Float]]:
    """Align each brain to a template of the others, and compare it with each of them.

    Also the displacements (n, 2, x, y) of its sheets. By brain.
    """
    found = {}
    for brain in dict.fromkeys(sheet.brain for sheet in brains):
        inside, outside = (
            [s for s in brains if (s.brain == brain) is held] for held in (False, True)
        )
        moved, placed = align(_stack(inside, "curvature"), title, _stack(outside, "curvature"))
        likenesses = [
            compare_sheets(one, two, np.stack([first, second]))
            for (one, first), (two, second) in product(
                zip(outside, placed, strict=True), zip(inside, moved, strict=True)
            )
        ]
        found[brain] = (likenesses, placed)
    return found


def compare_retests(
    brains: Sequence[Sheet], pairs: Sequence[tuple[Sheet, Sheet]], title: str
) -> list[tuple[Likeness, float]]:
    """Align both sheets of each pair to a template of other brains, and compare them.

    Also the root mean square difference of the two displacements, nodes.
    """
    found = []
    for one, two in pairs:
        inside = [sheet for sheet in brains if sheet.brain != one.brain]
        _, moved = align(_stack(inside, "curvature"), title, _stack((one, two), "curvature"))
        found.append((compare_sheets(one, two, moved), cases.rms(moved[1] - moved[0])))
    return found


@suite("alignment")
def run(full: bool, labels: Path | None = None) -> Iterator[Content]:
    """Align simulated cohorts in several ways, and real brains where there are labels."""
    seeds = range(COHORTS if full else FEW_COHORTS)
    yield _cohorts(seeds)
    yield _groups(seeds)
    if labels:
        brains = read_brains(labels)
        yield _labels(brains)
        yield _retest(brains)
    yield cases.left_out(labels)


def _plans() -> Iterator[tuple[str, Plan]]:
    yield "none", Plan()
    for kind, amount in product(_KINDS, AMOUNTS):
        yield _KINDS[kind], Plan(kind=kind, amount=amount)


def _met(way: str, is_met: bool) -> bool | None:
    """Return a target of the default; other ways have none."""
    return is_met if way == REGISTR else None


@table("alignment.cohorts")
def _cohorts(seeds: Sequence[int]) -> Iterator[Cells]:
    for title, plan in _plans():
        drawn = [simulate(plan, seed) for seed in seeds]
        unregistered = float("nan")
        for way in WAYS:
            outcomes = [judge(cohort, way) for cohort in drawn]
            null, power = (
                float(np.mean([getattr(one, name) for one in outcomes]))
                for name in ("null", "power")
            )
            unregistered = power if way == NONE else unregistered
            along, across = np.mean([one.error for one in outcomes], axis=0)
            distances = [one.missed_by for one in outcomes if np.isfinite(one.missed_by)]
            yield {
                "displacement": title,
                "RMS, nodes": plan.amount,
                "aligned": way,
                "cohorts": len(outcomes),
                "error along x, nodes": float(along),
                "error along y, nodes": float(across),
                "null cohorts with findings": null,
                "FDR": float(np.mean([one.false_share for one in outcomes])),
                "power": power,
                "location error, nodes": float(np.mean(distances)) if distances else float("nan"),
                "met": _met(way, null <= group.limits(len(drawn))[1] and power >= unregistered),
            }


@table("alignment.groups")
def _groups(seeds: Sequence[int]) -> Iterator[Cells]:
    for title, (amplitude, shift) in DIFFERENCES.items():
        plan = Plan(kind="rows", amount=AMOUNTS[0], amplitude=amplitude, shift=shift)
        drawn = [simulate(plan, seed) for seed in seeds]
        for way in WAYS:
            outcomes = [judge(cohort, way, effect=False) for cohort in drawn]
            null = float(np.mean([one.null for one in outcomes]))
            yield {
                "difference of the groups": title,
                "aligned": way,
                "cohorts": len(outcomes),
                "null cohorts with findings": null,
                "groups apart, nodes": float(np.mean([one.created for one in outcomes])),
                "met": _met(way, null <= group.limits(len(drawn))[1]),
            }


@table("alignment.labels")
def _labels(brains: Brains) -> Iterator[Cells]:
    unregistered = float("nan")
    for way in WAYS:
        found = compare_left_out(brains.first, way)
        means = [np.mean([one.same_label for one in each]) for each, _ in found.values()]
        unregistered = float(np.mean(means)) if way == NONE else unregistered
        every = [one for each, _ in found.values() for one in each]
        along, across = (
            cases.rms(np.concatenate([placed[:, axis] for _, placed in found.values()]))
            for axis in (0, 1)
        )
        yield {
            "aligned": way,
            "same label, %": 100 * float(np.mean(means)),
            "lowest brain, %": 100 * float(min(means)),
            "highest brain, %": 100 * float(max(means)),
            "border, nodes": float(np.mean([one.border for one in every])),
            "r of thickness": float(np.mean([one.thickness for one in every])),
            "r of curvature": float(np.mean([one.curvature for one in every])),
            "moved along x, nodes": along,
            "moved along y, nodes": across,
            "met": _met(way, bool(np.mean(means) >= unregistered)),
        }


@table("alignment.retest")
def _retest(brains: Brains) -> Iterator[Cells]:
    for kind, pairs in brains.pairs.items():
        for way in WAYS:
            found = compare_retests(brains.first, pairs, way)
            alike = [one for one, _ in found]
            yield {
                "pairs": f"{kind} ({len(found)})",
                "aligned": way,
                "same label, %": 100 * float(np.mean([one.same_label for one in alike])),
                "r of thickness": float(np.mean([one.thickness for one in alike])),
                "r of curvature": float(np.mean([one.curvature for one in alike])),
                "displacements differ, nodes": float(np.mean([apart for _, apart in found])),
            }
