"""Sample sizes against simulated trials: power as it was stated, and as it comes out."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats
from statsmodels.stats.multitest import multipletests

from hipsta_bids.extensions.trials.settings import PowerSettings
from hipsta_bids.extensions.trials.sizes import (
    SLOWING,
    THINNING,
    Reference,
    TrialEffect,
    point_level,
    power_of,
    sample_size,
)
from hipsta_bids.extensions.trials.trial import Modeled, Retested
from hipsta_bids.group.cohort.data import SHEET, Cohort, layers
from hipsta_bids.group.model import ModelRequest, VisitTime
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.stats.contrasts import Contrast
from hipsta_bids.stats.mixed import fit_mixed
from hipsta_bids.types import PARTICIPANT, SESSION, Bool, Float
from validation.group import smooth_noise, thickness_side
from validation.report import Cells, Content, suite, table

TRIALS, MIXED_TRIALS, MAP_TRIALS, FEW_MAP_TRIALS = 4000, 1000, 400, 150
#: Target: stated and observed power differ by at most this.
MAX_DIFFERENCE = 0.03

_MEAN, _BETWEEN, _WITHIN = 1.6, 0.16, 0.04  # mm
_MICROMETERS = (-4.0, 3.0)  # per month: mean of slopes, and their SD
_SLOPE, _SLOPE_SD = (slope / 1000 for slope in _MICROMETERS)  # mm per month
_COHORT, _MAP_COHORT = 5000, 400  # participants of the reference
_FOLLOWED = (0.0, 12.0, 24.0)  # months of the reference's visits
_AT_ONCE = 100  # trials with dropouts, by one mixed model
_PROCEDURES = {"bh": "fdr_bh", "fdr2": "fdr_tsbky"}


@dataclass(frozen=True)
class TrialDesign:
    """One question, and the reference that answers it."""

    title: str
    effect: TrialEffect
    retest: bool = False
    nodes: tuple[int, int] = (1, 1)
    """Of the sheet; one for a summary measure."""
    power: Mapping[str, Any] = field(default_factory=dict)
    """Settings."""
    correction: str = "fdr2"
    smoothness: float = 2.0
    """Of maps, standard deviation of a Gaussian, nodes."""

    @property
    def settings(self) -> GroupSettings:
        """Settings of the group level."""
        return GroupSettings().changed(power=self.power, multiplicity={"method": self.correction})

    @property
    def is_map(self) -> bool:
        """Whether it is about a map."""
        return self.nodes != (1, 1)


def _thinner(share: float, *visits: float) -> TrialEffect:
    return TrialEffect(kind=THINNING, share=share, visits=visits)


def _slower(share: float, *visits: float) -> TrialEffect:
    return TrialEffect(kind=SLOWING, share=share, visits=visits)


DESIGNS = (
    TrialDesign("measure, one visit, 5 % thinner", _thinner(0.05)),
    TrialDesign("measure, months 0, 12, 24, 30 % slower", _slower(0.3, 0, 12, 24)),
    TrialDesign(
        "measure, months 0 to 24 by 6, 25 % slower, 20 % drop out",
        _slower(0.25, 0, 6, 12, 18, 24),
        power={"power": 0.9, "dropout": 0.2},
    ),
    TrialDesign(
        "measure, test-retest, months 0, 12, 2 % thinner", _thinner(0.02, 0, 12), retest=True
    ),
    TrialDesign(
        "map, one visit, 5 % thinner at 10 % of the points, bh",
        _thinner(0.05),
        nodes=(40, 21),
        power={"affected": 0.1},
        correction="bh",
    ),
    TrialDesign(
        "map, one visit, 5 % thinner at 30 % of the points, fdr2",
        _thinner(0.05),
        nodes=(40, 21),
        power={"affected": 0.3, "power": 0.9},
    ),
    TrialDesign(
        "measure, months 0, 12, 24, 36, 30 % slower, 40 % drop out",
        _slower(0.3, 0, 12, 24, 36),
        power={"dropout": 0.4},
    ),
)


def simulate_design(design: TrialDesign, trials: int, seed: int = 0) -> dict[str, float]:
    """Find the sample size from a simulated reference cohort, and run trials of that size.

    Returns participants, power of the test with those who complete the trial, and the share of
    trials that find the effect, of maps mean share of the affected points found, by heading.
    """
    random = np.random.default_rng(seed)
    reference = _reference(design, random)
    settings = design.settings
    alpha = (
        point_level(settings.multiplicity, settings.of(PowerSettings))
        if design.is_map
        else settings.of(PowerSettings).alpha
    )
    found = sample_size(design.effect, reference, settings.of(PowerSettings), alpha=alpha)
    per_arm, enrolled = int(np.median(found["per_arm"])), int(np.median(found["enrolled_per_arm"]))
    if design.is_map:
        shares = [_map_trial(design, per_arm, random) for _ in range(trials)]
    elif settings.of(PowerSettings).dropout:
        shares = [
            share
            for _ in range(trials // _AT_ONCE)
            for share in _with_dropouts(design, enrolled, random)
        ]
    else:
        shares = [_trial(design, enrolled, random) for _ in range(trials)]
    power = power_of(found["cohen_d"], np.full(found["cohen_d"].shape, per_arm), alpha)
    return {
        "per arm": per_arm,
        "enrolled": enrolled,
        "stated power": float(np.mean(power)),
        "observed power": float(np.mean(shares)),
        "SE": float(np.std(shares) / np.sqrt(trials)),
    }


def _reference(design: TrialDesign, random: np.random.Generator) -> Reference:
    """Let the group level describe a cohort, as the command does."""
    n_visits = 2 if design.retest else len(_FOLLOWED)
    visits = _FOLLOWED[:n_visits] if design.effect.visits else (0.0,)
    people = _MAP_COHORT if design.is_map else _COHORT
    slopes = 0.0 if design.retest else _SLOPE + _SLOPE_SD * random.standard_normal(people)
    values = _values(design, people, random)[:, None] + np.zeros((len(visits), *design.nodes))
    values += (np.multiply.outer(slopes * np.ones(people), visits))[..., None, None]
    if design.effect.visits:
        values += _WITHIN * random.standard_normal(values.shape)
    names = [f"sub-{i:05d}" for i in range(people)]
    table = pd.DataFrame(
        {
            PARTICIPANT: np.repeat(names, len(visits)),
            SESSION: [f"ses-{j}" for j in range(len(visits))] * people,
            "months": np.tile(visits, people),
        }
    )
    side = thickness_side(values.reshape(-1, *design.nodes))
    axes = [np.linspace(-1, 1, n) for n in design.nodes]
    cohort = Cohort(table=table, sides={"L": side}, x=axes[0], y=axes[1], units={})
    source: Modeled | Retested
    if design.retest:
        source = Retested(cohort, design.settings, has_visits=True)
    else:
        time = VisitTime(table, "months", ()) if design.effect.visits else None
        source = Modeled(cohort, ModelRequest(), design.settings, time)
    (layer,) = layers({SHEET: cohort}, ["thickness"], ())
    return source.describe(layer).reference


def _values(design: TrialDesign, people: int, random: np.random.Generator) -> Float:
    """(people, x, y) mm at the first visit, without the error of single visits."""
    if design.is_map:
        noise = smooth_noise(random, (people, *design.nodes), design.smoothness)
    else:
        noise = random.standard_normal((people, 1, 1))
    return _MEAN + _BETWEEN * noise


def _with_dropouts(design: TrialDesign, enrolled: int, random: np.random.Generator) -> Bool:
    """Run slowing trials in which the same participants leave, by mixed models of all visits."""
    effect, settings = design.effect, design.settings
    times = np.array(effect.visits)
    hazard = -np.log1p(-settings.of(PowerSettings).dropout) / effect.duration
    leaves = random.exponential(1 / hazard, 2 * enrolled)
    who, visit = np.nonzero(times - times[0] <= leaves[:, None])
    treated, when = (who >= enrolled).astype(np.float64), times[visit]
    shape = 2 * enrolled, _AT_ONCE
    slopes = _SLOPE + _SLOPE_SD * random.standard_normal(shape)
    slopes[enrolled:] -= effect.share * _SLOPE
    first = _MEAN + _BETWEEN * random.standard_normal(shape)
    values = first[who] + slopes[who] * when[:, None]
    values += _WITHIN * random.standard_normal(values.shape)
    matrix = np.column_stack([np.ones(len(who)), treated, when, treated * when])
    contrast = [Contrast("slowing", np.array([0.0, 0, 0, 1]))]
    how = settings.changed(longitudinal={"random": "slope"}).longitudinal
    fit = fit_mixed(values, matrix, who.astype(np.str_), contrast, how, times=when)
    return np.asarray(fit.tests[0].p <= settings.of(PowerSettings).alpha)


def _trial(design: TrialDesign, enrolled: int, random: np.random.Generator) -> bool:
    """Run one trial of a summary measure, and tell whether it finds the effect."""
    effect = design.effect
    arms = []
    for treated in (False, True):
        first = _MEAN + _BETWEEN * random.standard_normal(enrolled)
        if not effect.visits:
            arms.append(first - (effect.share * _MEAN if treated else 0.0))
            continue
        times = np.array(effect.visits)
        slopes = np.zeros(len(first))
        if not design.retest:
            slopes += _SLOPE + _SLOPE_SD * random.standard_normal(len(first))
        if treated and effect.kind == SLOWING:
            slopes -= effect.share * _SLOPE
        elif treated:
            slopes -= effect.share * _MEAN / effect.duration
        values = first[:, None] + slopes[:, None] * times
        values += _WITHIN * random.standard_normal(values.shape)
        centered = times - times.mean()
        arms.append(values @ centered / (centered @ centered))
    return bool(stats.ttest_ind(*arms).pvalue <= design.settings.of(PowerSettings).alpha)


def _map_trial(design: TrialDesign, per_arm: int, random: np.random.Generator) -> float:
    """Run one trial of a map, and return the share of the affected points that it finds."""
    affected: Bool = np.zeros(design.nodes, dtype=bool)
    affected[: round(design.settings.of(PowerSettings).affected * design.nodes[0])] = True
    values = _values(design, 2 * per_arm, random)
    values[per_arm:, affected] -= design.effect.share * _MEAN
    flat = values.reshape(2 * per_arm, -1)
    p = stats.ttest_ind(flat[:per_arm], flat[per_arm:]).pvalue
    level = design.settings.multiplicity.alpha
    rejected = multipletests(p, level, method=_PROCEDURES[design.correction])[0]
    return float(rejected[affected.ravel()].mean())


@suite("trials")
def run(full: bool) -> Iterator[Content]:
    """Simulate the trials of all designs."""
    yield _trials(MAP_TRIALS if full else FEW_MAP_TRIALS)


@table("trials.trials")
def _trials(map_trials: int) -> Iterator[Cells]:
    for design in DESIGNS:
        trials = MIXED_TRIALS if design.power.get("dropout") else TRIALS
        trials = map_trials if design.is_map else trials
        found = simulate_design(design, trials)
        met = abs(found["observed power"] - found["stated power"]) <= MAX_DIFFERENCE
        yield {"design": design.title, **found, "trials": trials, "met": met}
