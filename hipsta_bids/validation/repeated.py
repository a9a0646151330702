"""Repeated visits of simulated participants: errors of mixed models and of permutations."""

from collections.abc import Sequence

import numpy as np

from hipsta_bids.group.exchangeability import Visits
from hipsta_bids.group.formula import Contrast
from hipsta_bids.group.inference import PermutationPart, permute
from hipsta_bids.group.mixed import fit_mixed
from hipsta_bids.group.settings import LongitudinalSettings, MultiplicitySettings
from hipsta_bids.types import Float
from hipsta_bids.validation.report import Cells, Table

_N, _POINTS, _PERMUTATIONS, _LEVEL = 40, 8, 200, 0.05


def repeated_findings(seed: int, slope_sd: float) -> dict[str, Float]:
    """(contrasts,) what tests of group, time, and both find in visits without any effect.

    Mixed models the share of the points; permutations 1 if any point survives.
    """
    random = np.random.default_rng(seed)
    who = np.repeat(np.arange(_N), random.integers(3, 5, _N))
    visit = np.arange(len(who)) - np.searchsorted(who, who)
    time = visit + random.uniform(-0.15, 0.15, len(who)) * (visit > 0)
    own, slopes = random.normal(0, 1, (2, _N, _POINTS))
    maps = own[who] + slope_sd * slopes[who] * time[:, None]
    maps += random.normal(0, 0.5, maps.shape)
    group = who % 2
    matrix = np.column_stack([np.ones(len(who)), group, time, group * time])
    contrasts = [Contrast(name, row) for name, row in zip("gti", np.eye(4)[1:], strict=True)]
    names, plain = who.astype(np.str_), LongitudinalSettings()
    found = {
        title: [
            (test.p <= _LEVEL).mean()
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
    how = MultiplicitySettings(method="permutation-max", permutations=_PERMUTATIONS, seed=seed)

    def permuted(contrast: Contrast, settings: MultiplicitySettings) -> float:
        return float((permute([part], contrast, settings=settings)[0].p_max <= _LEVEL).any())

    inside = how.changed(visits="within")
    found["permutation (default)"] = [permuted(one, how) for one in contrasts]
    found["permutation within participants"] = [
        np.nan,
        *(permuted(one, inside) for one in contrasts[1:]),
    ]
    return {title: np.array(own) for title, own in found.items()}


def repeated_visits(least: float, most: float, seeds: Sequence[int]) -> Table:
    """Count what tests find where there is nothing; the limits are those of their level."""
    rows: list[Cells] = []
    for slope_sd in (0.3, 0.0):
        found = [repeated_findings(seed, slope_sd) for seed in seeds]
        for title in found[0]:
            false = np.mean([one[title] for one in found], axis=0)
            rows.append(
                {
                    "test": title,
                    "SD of slopes": slope_sd,
                    "cohorts": len(seeds),
                    **dict(zip(("group", "time", "group x time"), map(float, false), strict=True)),
                    "met": all(least <= one <= most for one in false)
                    if "default" in title
                    else None,
                }
            )
    return Table(
        title="Repeated visits",
        rows=rows,
        notes=f"Cohorts of {_N} subjects in two groups with three or four visits each, without any"
        " effect; intercepts have an SD of 1 between subjects, visits one of 0.5. Shares of tests"
        f" at {_POINTS} points with p of at most {_LEVEL:g} by mixed models; of cohorts in which"
        f" any point survives, by {_PERMUTATIONS} permutations. Where slopes differ, intercepts"
        " alone, and visits permuted within participants, find too much. Target of the"
        f" defaults: {least:.2g} to {most:.2g}.",
    )
