"""How damaged labels end: repaired, flagged or refused, and how far the maps move."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from hipsta_bids.phantom import PhantomSpec
from hipsta_bids.types import Decision, Float, HemisphereMaps
from validation import cases
from validation.cases import Refusal, ValidationBody
from validation.damage import Injury, Position, Site, make_defect
from validation.report import Cell, Cells, Content, suite, table

NEAR = 2.0
"""mm; columns within this distance of a changed voxel are near the defect."""
WRONG = 0.3
"""mm; a column that differs by more than this is off."""
MAX_WRONG = 0.02
"""Largest share of columns that are off in an accepted map."""
MAX_SHIFT = 0.15
"""mm; largest change of a column elsewhere in an accepted map."""
TIMEOUT = 60.0
"""s per case."""
MAX_CHANGED = 0.05
"""Largest share of the body that repairs may change in a map that is not flagged."""
PLACELESS = frozenset({"sheet-too-thin", "body-too-short", "no-body"})
"""Reasons of refusals that concern the whole body, and need not say where."""

CRASH = "crash"
#: How a case ends. Flagged and refused ones name the defect.
OUTCOMES = ("unnoticed", "repaired", "flagged", "refused", CRASH)

SPECS = (
    PhantomSpec(kind="spiral", thickness=2.0, length=12.0),
    PhantomSpec(kind="tight", thickness=1.6, length=12.0),
)
VOXEL = 0.4
"""mm, of the phantoms and at most of labels."""

MIDDLE: Position = (0.5, 0.5)
HOLES: tuple[Position, ...] = (MIDDLE, (0.2, 0.35), (0.82, 0.6))
ALL_OF_IT = 200.0
"""mm, longer than any hippocampus."""

#: The quick selection takes every third.
PLAN: tuple[Injury, ...] = (
    *(("hole", r, p) for r in (0.4, 0.8, 1.3, 1.6, 2.0) for p in HOLES),
    ("cavity", 0.4, MIDDLE),
    ("cavity", 0.8, MIDDLE),
    *(("bridge-ca3-subiculum", r, MIDDLE) for r in (0.4, 0.8, 1.2, 2.0)),
    *(("bridge-ca1-ca1", r, MIDDLE) for r in (0.4, 0.8, 1.2)),
    *(("island", r, MIDDLE) for r in (0.5, 1.0, 3.0)),
    *(("salt", share, MIDDLE) for share in (0.03, 0.08, 0.15)),
    *(("protrusion", r, MIDDLE) for r in (0.6, 1.0)),
    *(("leak", r, MIDDLE) for r in (0.75, 1.5, 3.0)),
    *(("slit", w, p) for w in (0.4, 0.8, 1.2) for p in (MIDDLE, (0.15, 0.5))),
    *(("gap", w, p) for w in (0.4, 0.8, 2.0) for p in (MIDDLE, (0.78, 0.5))),
    *(("missing-subfield", ALL_OF_IT, (u, 0.5)) for u in (0.07, 0.25, 0.5, 0.78)),
    *(("missing-subfield", t, (u, 0.5)) for t in (2.0, 4.0, 6.0) for u in (0.03, 0.97)),
    *(("missing-slices", t, MIDDLE) for t in (0.3, 1.0, 2.0)),
    *(("tail-inside", t, (0.5, v)) for t in (0.4, 2.0) for v in (0.5, 0.8)),
    *(("head-inside", t, (0.5, v)) for t in (0.4, 2.0) for v in (0.5, 0.8)),
    *(("cut-short", length, MIDDLE) for length in (3.0, 6.0, 8.0)),
    *(("notch", t, (u, 0.5)) for t in (0.5, 2.0) for u in (0.5, 0.75, 0.9)),
    *(("waist", depth, MIDDLE) for depth in (0.5, 0.7)),
    *(("wrong-voxels", factor, MIDDLE) for factor in (2.0, 4.0)),
    *(("at-border", lost, MIDDLE) for lost in (0.0, 1.0)),
    ("ends-flush", 1.0, MIDDLE),
    *(("pits", count, MIDDLE) for count in (10, 25)),
    *(("rim-notch", r, (u, v)) for r in (1.0, 1.4) for u in (0.05, 0.95) for v in (0.4, 0.7)),
    *(("relabeled-tip", w, (u, 0.5)) for w in (0.8, 1.4) for u in (0.05, 0.95)),
)


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One body with one defect."""

    body: ValidationBody
    injury: Injury
    mended: bool = True
    """False: what lost its label is labeled as tissue outside, and stays a hole."""

    @property
    def name(self) -> str:
        """Of the body, for people."""
        if isinstance(self.body, PhantomSpec):
            return self.body.kind + (", layer" if self.body.layer_thickness else "")
        return f"labels {self.body.subject} {self.body.hemi}"


@dataclass(frozen=True, kw_only=True)
class Damage:
    """What a defect did to a map."""

    decision: str
    """On the map, or a crash."""
    reasons: tuple[str, ...]
    """Of flags, or why it was refused."""
    message: str = ""
    """Of the refusal."""
    near_wrong: int = 0
    """Columns near the defect that are off."""
    far_wrong: int = 0
    """Columns elsewhere that are off."""
    shift: float = 0.0
    """Largest change elsewhere, mm."""
    mean: float = 0.0
    """Change of the mean thickness, mm."""
    columns: int = 1
    """All columns of the sheet."""
    changed: float = 0.0
    """Share of the body that repairs changed."""
    far: int = 0
    """Columns that are not near the defect."""
    margins: Mapping[str, float] = field(default_factory=dict)
    """Statistic over limit by reason of a flag."""
    repairs: int = 0

    @property
    def outcome(self) -> str:
        """How the case ended."""
        words = {Decision.LOOK: "flagged", Decision.FAILED: "refused", CRASH: CRASH}
        return words.get(self.decision, "repaired" if self.repairs else "unnoticed")

    @property
    def missed(self) -> tuple[str, ...]:
        """Rules that are broken; see the notes below the table."""
        wrong = (self.near_wrong + self.far_wrong) / self.columns
        accepted = self.decision == Decision.USE
        named = self.reasons[:1] and self.reasons[0] in PLACELESS
        rules = (
            ("crash", self.decision == CRASH),
            ("wrong", accepted and wrong > MAX_WRONG),
            ("moved", accepted and self.shift > MAX_SHIFT),
            ("big", accepted and self.changed > MAX_CHANGED),
            ("placeless", self.outcome == "refused" and not named and "RAS" not in self.message),
        )
        return tuple(rule for rule, broken in rules if broken)


@suite("defects")
def run(full: bool, labels: Path | None = None) -> Iterator[Content]:
    """Damage bodies in many ways and measure them."""
    bodies: list[ValidationBody] = [
        *SPECS[: None if full else 1],
        *cases.fine_segmentations(labels, VOXEL)[::2],
    ]
    plan = PLAN if full else PLAN[::3]
    trials = [Trial(body=body, injury=injury) for body in bodies for injury in plan]
    results = [
        refused(result) if isinstance(result, Refusal) else result
        for result in cases.run_cases(measure_trial, trials, timeout=TIMEOUT)
    ]
    yield _cases(trials, results)
    yield _totals(results)


def measure_trial(trial: Trial) -> Damage:
    """Measure one damaged body and compare it with the undamaged one."""
    _, hemi, reference = cases.measure_reference(trial.body, VOXEL)
    defect = make_defect(site_of(trial.body), *trial.injury)
    return compare(cases.measure_body(defect.volume, hemi), reference, defect.changed)


@lru_cache(maxsize=2)
def site_of(body: ValidationBody) -> Site:
    """Measure a body as it is, to damage it; the cases of one body should follow each other."""
    volume, _, reference = cases.measure_reference(body, VOXEL)
    return Site(volume, reference.sheet)


def compare(maps: HemisphereMaps, reference: HemisphereMaps, changed: Float) -> Damage:
    """Compare the maps of damaged labels with those of the undamaged ones.

    ``changed`` are centers (N, 3) of the changed voxels, RAS mm.
    """
    points = reference.sheet.points
    distance = np.asarray(cKDTree(changed).query(points.reshape(-1, 3))[0])
    near = distance.reshape(points.shape[:3]).min(axis=2) <= NEAR
    change = maps.thickness - reference.thickness
    off = ~(np.abs(change) <= WRONG)  # a missing column is off too
    return Damage(
        decision=maps.decision,
        reasons=tuple(dict.fromkeys(flag.reason for flag in maps.flags)),
        near_wrong=int(np.count_nonzero(off & near)),
        far_wrong=int(np.count_nonzero(off & ~near)),
        shift=float(np.abs(change[~near]).max(initial=0.0)),
        mean=float(np.nanmean(change)),
        columns=change.size,
        changed=float(maps.qc["changed_fraction"]),
        far=int(np.count_nonzero(~near)),
        margins=maps.qc["flag_margins"],
        repairs=len(maps.repairs),
    )


def refused(refusal: Refusal) -> Damage:
    """Enter a refusal among the results."""
    decision = CRASH if refusal.is_bug else Decision.FAILED
    return Damage(decision=decision, reasons=(refusal.reason,), message=refusal.message)


@table("defects.defects")
def _cases(trials: list[Trial], results: list[Damage]) -> Iterator[Cells]:
    for trial, result in zip(trials, results, strict=True):
        kind, size, position = trial.injury
        cells: dict[str, Cell] = {
            "body": trial.name,
            "defect": kind,
            "size": f"{size:g}",
            "position (u, v)": "{:g}, {:g}".format(*position),
            "outcome": result.outcome,
            "reason": ", ".join(result.reasons) or "-",
        }
        if result.outcome not in ("refused", CRASH):
            cells |= {
                f"columns off by > {WRONG:g} mm within {NEAR:g} mm": result.near_wrong,
                "the same elsewhere": result.far_wrong,
                "largest change elsewhere (mm)": result.shift,
                "change of mean (mm)": result.mean,
            }
        broken = ", ".join(result.missed) or "-"
        yield {**cells, "rules broken": broken, "met": not result.missed}


@table("defects.ends")
def _totals(results: list[Damage]) -> Iterator[Cells]:
    for word in OUTCOMES:
        group = [result for result in results if result.outcome == word]
        kept = sum(not result.missed for result in group)
        yield {"outcome": word, "cases": len(group), "of them within the rules": kept}
