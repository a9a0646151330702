"""Visits of one participant without change: how often the slope differs from zero."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import stats

from hipsta_bids.inputs.search import HemisphereInput
from hipsta_bids.types import Float
from validation import cases
from validation.report import Cells, Content, suite, table
from validation.visits import NOISE, SEED, Person, Result, measure_person, plain, slopes

PARTICIPANTS = 200
STUDY = 20
"""Participants of a small study; every participant is in one of these studies."""
LEVEL = 0.05
FALSE_POSITIVES = (0.04, 0.06)
"""Share of points, fixed before the first run."""
FLIPS = 2000
"""Reversals of the visits of random participants."""
VOXEL = 0.5
"""mm."""


def participants(count: int, bodies: Sequence[HemisphereInput]) -> list[Person]:
    """List participants, every other one with the shape of a real hemisphere, if there is any."""
    random = np.random.default_rng((SEED, 11))
    sources: list[cases.ValidationBody] = []
    for n in range(count):
        thickness, bend = random.uniform(1.7, 2.3), random.uniform(0.0, 0.03)
        shape = replace(plain(n // 2), length=10.0, thickness=float(thickness), bend=float(bend))
        sources.append(bodies[n // 2 % len(bodies)] if bodies and n % 2 else shape)
    return [
        Person(
            name=source.subject if isinstance(source, HemisphereInput) else "phantom",
            sources=(source,) * 3,
            voxels=((VOXEL,) * 3,) * 3,
            noise=NOISE,
            seed=1000 + n,
            separate=False,
            coarse=True,
        )
        for n, source in enumerate(sources)
    ]


def positives(maps: Float) -> float:
    """Compute the share of points at which slopes (participants, ...) differ from zero."""
    return float(np.mean(stats.ttest_1samp(maps, 0.0, axis=0).pvalue < LEVEL))


def by_chance(maps: Float, random: np.random.Generator) -> Float:
    """Compute that share after reversing the visits of random participants, ``FLIPS`` times.

    Reversed visits are as probable as visits in order, if nothing changes. The shares vary as those
    of new participants do, since the map keeps its correlation between points.
    """
    flat = maps.reshape(len(maps), -1)
    signs = random.choice((-1.0, 1.0), (FLIPS, len(maps)))
    mean = signs @ flat / len(maps)
    spread = np.sqrt(((flat**2).mean(axis=0) - mean**2) / (len(maps) - 1))
    limit = stats.t.ppf(1 - LEVEL / 2, len(maps) - 1)
    return np.asarray((np.abs(mean / spread) > limit).mean(axis=1))


def studies(maps: Float) -> list[Float]:
    """Split participants into studies of ``STUDY``, each with both kinds of shapes."""
    return np.array_split(maps, max(1, len(maps) // STUDY))


@suite("unchanged")
def run(full: bool, labels: Path | None = None) -> Iterator[Content]:
    """Measure participants that do not change."""
    folders = [labels, *cases.hippunfold_beside(labels)] if labels else []
    bodies = [item for folder in folders for item in cases.fine_segmentations(folder, 0.6)]
    people = participants(PARTICIPANTS if full else 8, bodies)
    results = cases.run_cases(measure_person, people, timeout=300.0)
    real = [isinstance(person.sources[0], HemisphereInput) for person in people]
    yield _false_positives(
        {
            "all": results,
            "real shapes": [r for r, kind in zip(results, real, strict=True) if kind],
            "phantoms": [r for r, kind in zip(results, real, strict=True) if not kind],
        }
    )
    yield cases.left_out(labels)


@table("unchanged.slopes")
def _false_positives(
    groups: Mapping[str, Sequence[Result | cases.Refusal]],
) -> Iterator[Cells | str]:
    low, high = FALSE_POSITIVES
    for name, group in groups.items():
        measured = [result for result in group if isinstance(result, Result)]
        if len(measured) < 2:  # noqa: PLR2004 -- no SD
            continue
        maps = np.stack([slopes(result.frame) for result in measured])
        means = maps.mean(axis=(1, 2))
        chance = by_chance(maps, np.random.default_rng(SEED))
        few = [positives(study) for study in studies(maps)]
        ends = np.quantile(chance, (LEVEL / 2, 1 - LEVEL / 2))
        cells: Cells = {
            "shapes": name,
            "participants": f"{len(measured)} of {len(group)}",
            "slope, mm per year": float(means.mean()),
            "standard error": float(means.std(ddof=1) / np.sqrt(len(means))),
            "p of the mean": float(stats.ttest_1samp(means, 0.0).pvalue),
            "false positives": positives(maps),
            "visits reversed": float(chance.mean()),
            "visits reversed, 95 %": f"{ends[0]:.3f} to {ends[1]:.3f}",
            "studies": len(few),
            "false positives of studies": float(np.mean(few)),
            "their standard error": float(stats.sem(few)) if len(few) > 1 else None,
        }
        targets: dict[str, bool | None] = {"met": None, "studies met": None}
        if name == "all":
            targets["met"] = low <= positives(maps) <= high
            targets["studies met"] = bool(low <= np.mean(few) <= high)
        yield {**cells, **targets}
    yield cases.refusal_notes({name: group for name, group in groups.items() if name != "all"})
