"""Simulated norms: how many of other people lie below each centile, at known and at new sites."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import special, stats

from hipsta_bids.extensions.norms.centiles import LEVELS, Norms, People, fit_norms
from hipsta_bids.extensions.norms.settings import NormSettings
from hipsta_bids.stats.arrays import Float
from validation.report import Cell, Cells, Content, suite, table

#: Target: shares below centiles differ from these by at most this, percentage points.
MAX_ERROR = 2.0
_SITES, _NEW = (120, 80, 100, 60, 140), 25
_POINTS, _FEW_POINTS, _PEOPLE, _REFERENCES = 861, 200, 4000, 8
_AGES = (20.0, 90.0)
_KNOTS = np.linspace(*_AGES, 5)


@dataclass(frozen=True, kw_only=True)
class Population:
    """Values between participants of one age, sex and site, of mean 0 and SD 1."""

    title: str
    kind: str
    """``normal``, or a distribution that the norms do not have: ``gamma`` or ``t``."""
    growth: float = 0.0
    """Of the logarithm of the SD over the range of ages."""

    def draw(self, random: np.random.Generator, shape: tuple[int, ...]) -> Float:
        """Draw values."""
        if self.kind == "gamma":
            # Skewness 1.15, as of thickness with thin walls in some.
            return np.asarray((3.0 - random.gamma(3.0, size=shape)) / np.sqrt(3.0))
        if self.kind == "t":
            return np.asarray(stats.t(6).rvs(size=shape, random_state=random) / np.sqrt(1.5))
        return np.asarray(random.standard_normal(shape))


POPULATIONS = (
    Population(title="normal", kind="normal"),
    Population(title="SD grows with age", kind="normal", growth=0.7),
    Population(title="skewed", kind="gamma"),
    Population(title="heavy tails", kind="t"),
    Population(title="skewed, SD grows with age", kind="gamma", growth=0.7),
)


def simulate(
    population: Population, sizes: tuple[int, ...], points: int, seed: int, *, first: int = 0
) -> tuple[Float, People]:
    """Draw people of sites from number ``first`` on; the mean bends with age."""
    random = np.random.default_rng(seed)
    site = first + np.repeat(np.arange(len(sizes)), sizes)
    age = random.uniform(*_AGES, len(site))
    sex = (random.random(len(site)) < 0.5).astype(np.float64)  # noqa: PLR2004 -- half of them
    # Sites are the same at each draw.
    effects = np.random.default_rng(99)
    shift, scale = effects.normal(0, 0.1, 20), np.exp(effects.normal(0, 0.2, 20))
    share = (age - _AGES[0]) / (_AGES[1] - _AGES[0])
    mean = 2.0 - 0.4 * share**2 + 0.05 * np.sin(6 * share) + 0.05 * sex + shift[site]
    sd = 0.15 * np.exp(population.growth * share) * scale[site]
    values = mean[:, None] + sd[:, None] * population.draw(random, (len(site), points))
    return values, People(age=age, sex=sex[:, None], site=site)


def below(norms: Norms, population: Population, sites: tuple[int, ...], first: int = 0) -> Float:
    """(levels, points) shares of other people below centiles, who are as many at each site."""
    per_site = (_PEOPLE // len(sites),) * len(sites)
    values, people = simulate(population, per_site, norms.mean.shape[1], 7, first=first)
    z = norms.score(values, people)
    return np.stack([(z < special.ndtri(level)).mean(axis=0) for level in LEVELS])


def calibrate(
    population: Population, points: int, settings: NormSettings
) -> Iterator[tuple[str, Float]]:
    """Shares below centiles at known sites, and at a new one after transfer."""
    known, new = [], []
    n_sites, step = len(_SITES), -(-points // _REFERENCES)
    for seed in range(_REFERENCES):
        values, people = simulate(population, _SITES, step, 100 + seed)
        norms = fit_norms(values, people, n_sites, _KNOTS, settings)
        known.append(below(norms, population, _SITES))
        controls = simulate(population, (_NEW,), step, 200 + seed, first=n_sites)
        moved = norms.extended(*controls, n_sites + 1, _NEW)
        new.append(below(moved, population, (1,), first=n_sites))
    yield "known sites", np.hstack(known)
    yield f"new site, {_NEW} controls", np.hstack(new)


@suite("norms")
def run(full: bool) -> Iterator[Content]:
    """Fit norms to simulated references, and score others of the same and of a new site."""
    sites = ", ".join(map(str, _SITES))
    yield {"people": f"{sum(_SITES)} participants of {len(_SITES)} sites ({sites})"}
    yield _calibration(_POINTS if full else _FEW_POINTS)


@table("norms.calibration")
def _calibration(points: int) -> Iterator[Cells]:
    for population in POPULATIONS:
        for where, shares in calibrate(population, points, NormSettings()):
            means = shares.mean(axis=1)
            row: dict[str, Cell] = {"values": population.title, "scored": where}
            row |= {
                f"below {100 * level:g}": float(100 * share)
                for level, share in zip(LEVELS, means, strict=True)
            }
            row["SD of 5"] = float(100 * shares[0].std())
            row["met"] = bool(np.abs(means - LEVELS).max() <= MAX_ERROR / 100)
            yield row
