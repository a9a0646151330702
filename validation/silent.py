"""Damage that leaves a plausible map, and how often a wrong map is handed out as sound."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from scipy import ndimage

from hipsta_bids.errors import SettingsError
from hipsta_bids.phantom import Phantom
from hipsta_bids.types import Decision, Float, HemisphereMaps
from validation import cases, random_phantoms
from validation.cases import Case, Refusal
from validation.damage import Injury, Site, make_defect
from validation.report import Cells, Content, suite, table

SEED = 20263
NUMBER_QUICK, NUMBER_FULL = 9, 200
LEAST_THICKNESS = 1.4
"""mm; thinner phantoms are drawn with this thickness, or thick voxels would not do."""
WINDOWS = ((5, 2), (2, 5), (4, 3), (3, 4))
"""Grid points, at least ten, over which an error is averaged, ..."""
WRONG = 0.25
"""... and its RMS from which on the map is wrong there, mm."""
SLID = 1.0
"""mm, RMS over the same points, by which grid points may slide along the sheet."""
MAX_SILENT = 0.03

Range = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Kind:
    """How damage of a kind is drawn at random."""

    injury: str
    size: Range
    u: Range
    v: Range
    voxels: bool = False
    """Whether the size is in voxels."""
    visible: bool = True
    """Whether a single brain can show it; otherwise only a cohort can."""


_MIDDLE, _EDGES = (0.15, 0.85), ((0.0, 0.0), (1.0, 1.0))
KINDS: Mapping[str, Kind] = MappingProxyType(
    {
        "ball, exterior wall": Kind(injury="leak", size=(0.8, 2.0), u=_MIDDLE, v=_MIDDLE),
        "ball, interior wall": Kind(injury="leak-interior", size=(0.8, 2.0), u=_MIDDLE, v=_MIDDLE),
        "leak, posterior end": Kind(injury="leak", size=(1.0, 3.0), u=_MIDDLE, v=(0.0, 0.05)),
        "leak, anterior end": Kind(
            injury="leak-interior", size=(1.0, 3.0), u=_MIDDLE, v=(0.95, 1.0)
        ),
        "thin medial edge": Kind(
            injury="thin-edge", size=(1.0, 1.5), u=_EDGES[0], v=_MIDDLE, voxels=True
        ),
        "thin lateral edge": Kind(
            injury="thin-edge", size=(1.0, 1.5), u=_EDGES[1], v=_MIDDLE, voxels=True
        ),
        "slit, medial edge": Kind(injury="slit", size=(0.4, 1.0), u=(0.05, 0.2), v=_MIDDLE),
        "half of a medial subfield": Kind(
            injury="half-subfield", size=(0.3, 0.6), u=_EDGES[0], v=(0.0, 1.0)
        ),
        "half of a lateral subfield": Kind(
            injury="half-subfield", size=(0.3, 0.6), u=_EDGES[1], v=(0.0, 1.0)
        ),
        "fissure labeled CA1": Kind(injury="fissure", size=(0.6, 1.2), u=(0.35, 0.6), v=_MIDDLE),
        "end inward by 2 mm": Kind(
            injury="moved-end", size=(2.0, 2.0), u=_MIDDLE, v=(0.0, 1.0), visible=False
        ),
        "end outward by 2 mm": Kind(
            injury="moved-end", size=(-2.0, -2.0), u=_MIDDLE, v=(0.0, 1.0), visible=False
        ),
    }
)


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One phantom with one damage."""

    voxels: str
    number: int
    kind: str


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What the damage did, and whether that was seen."""

    sound: tuple[str, ...]
    """Flags of the phantom as it was."""
    decision: str
    """On the damaged one."""
    reasons: tuple[str, ...] = ()
    error: float = 0.0
    """Largest RMS change of thickness over ten grid points, mm."""
    slide: float = 0.0
    """Largest RMS slide along the sheet over ten grid points, mm."""

    @property
    def wrong(self) -> bool:
        """Whether there is a map, and it is wrong."""
        return self.decision != Decision.FAILED and (self.error > WRONG or self.slide > SLID)

    @property
    def silent(self) -> bool:
        """Whether the map is wrong, and handed out as sound."""
        return self.wrong and self.decision == Decision.USE


@suite("silent")
def run(full: bool) -> Iterator[Content]:
    """Damage phantoms drawn at random, each in one way."""
    trials = plan(NUMBER_FULL if full else NUMBER_QUICK)
    results = cases.run_cases(measure_trial, trials, timeout=120.0)
    yield _kinds(trials, results)
    yield _sound(trials, results)


def plan(number: int) -> list[Trial]:
    """List trials: kinds in turn, in fine and thick voxels in turn."""
    names, voxels = list(KINDS), list(random_phantoms.TARGETS)
    return [
        Trial(
            voxels=voxels[(k + k // len(names)) % len(voxels)], number=k, kind=names[k % len(names)]
        )
        for k in range(number)
    ]


def draw(trial: Trial) -> tuple[Case, Injury]:
    """Draw the phantom of a trial and its damage."""
    case = random_phantoms.draw(trial.voxels, trial.number, seed=SEED)
    spec = replace(case.spec, thickness=max(case.spec.thickness, LEAST_THICKNESS))
    kind, generator = KINDS[trial.kind], np.random.default_rng((SEED, trial.number))
    size = generator.uniform(*kind.size) * (min(case.voxel_size) if kind.voxels else 1)
    v = generator.uniform(*kind.v)
    return replace(case, spec=spec), (kind.injury, size, (generator.uniform(*kind.u), v))


def measure_trial(trial: Trial) -> Outcome:
    """Measure a phantom as it is and damaged."""
    case, injury = draw(trial)
    volume = cases.draw(Phantom(case.spec), case)
    reference = cases.measure_body(volume, case.hemi)
    sound = tuple(flag.reason for flag in reference.flags)
    try:
        defect = make_defect(Site(volume, reference.sheet), *injury)
    except SettingsError:  # nothing there to damage
        return Outcome(sound=sound, decision="")
    maps = cases.attempt(lambda labels: cases.measure_body(labels, case.hemi), defect.volume)
    if isinstance(maps, Refusal):
        return Outcome(sound=sound, decision=Decision.FAILED, reasons=(maps.reason,))
    # An edge that was made thinner is thin: its columns are right if they stay where they were.
    thinner = injury[0] == "thin-edge"
    return Outcome(
        sound=sound,
        decision=maps.decision,
        reasons=tuple(flag.reason for flag in maps.flags),
        error=0.0 if thinner else worst(maps.thickness - reference.thickness),
        slide=worst(_slide(maps, reference)),
    )


def worst(error: Float) -> float:
    """Compute the largest RMS of an error (Nx, Ny) over a window of ten grid points or more."""
    squares = np.nan_to_num(error) ** 2
    return max(
        float(np.sqrt(ndimage.uniform_filter(squares, window, mode="nearest").max()))
        for window in WINDOWS
    )


def _slide(maps: HemisphereMaps, reference: HemisphereMaps) -> Float:
    """Compute by how much the columns (Nx, Ny) moved from medial to lateral, mm."""
    before, after = (m.sheet.points[:, :, m.sheet.middle] for m in (reference, maps))
    along = np.gradient(before, axis=0)
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    return np.asarray(((after - before) * along).sum(axis=-1))


def _count(outcomes: Sequence[Outcome], test: Callable[[Outcome], bool]) -> int:
    return sum(map(test, outcomes))


@table("silent.kinds")
def _kinds(trials: Sequence[Trial], results: Sequence[Outcome | Refusal]) -> Iterator[Cells | str]:
    pairs = [(t, r) for t, r in zip(trials, results, strict=True) if isinstance(r, Outcome)]
    for voxels in random_phantoms.TARGETS:
        group = [(t, r) for t, r in pairs if t.voxels == voxels and r.decision]
        for kind in KINDS:
            yield _row(kind, voxels, [r for t, r in group if t.kind == kind])
        visible = [r for t, r in group if KINDS[t.kind].visible]
        wrong = _count(visible, lambda r: r.wrong)
        yield {
            **_row("all that one brain can show", voxels, visible),
            "target": f"≤ {MAX_SILENT:.0%} of wrong ones",
            "met": _count(visible, lambda r: r.silent) <= MAX_SILENT * wrong,
        }
    yield cases.refusal_notes({"as drawn": results})


def _row(kind: str, voxels: str, outcomes: Sequence[Outcome]) -> dict[str, str | int]:
    return {
        "damage": kind,
        "voxels": voxels,
        "phantoms": len(outcomes),
        "refused": _count(outcomes, lambda r: r.decision == Decision.FAILED),
        "flagged": _count(outcomes, lambda r: r.decision == Decision.LOOK),
        "wrong": _count(outcomes, lambda r: r.wrong),
        "wrong and accepted": _count(outcomes, lambda r: r.silent),
    }


@table("silent.sound")
def _sound(trials: Sequence[Trial], results: Sequence[Outcome | Refusal]) -> Iterator[Cells]:
    for voxels in random_phantoms.TARGETS:
        flags = [
            result.sound
            for trial, result in zip(trials, results, strict=True)
            if isinstance(result, Outcome) and trial.voxels == voxels
        ]
        reasons = sorted({reason for group in flags for reason in group})
        yield {
            "voxels": voxels,
            "phantoms": len(flags),
            "flagged": sum(map(bool, flags)),
            "flags": ", ".join(reasons) or "-",
        }
