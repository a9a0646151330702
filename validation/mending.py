"""What labels lack or have too much, planted: cavities, ragged ends, and an uncus."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.protocols.protocol import CORE, Tissue
from hipsta_bids.types import GivenEnd, HemisphereMaps, LabelVolume
from validation import cases
from validation.cases import Refusal, ValidationBody
from validation.damage import Injury, make_defect
from validation.defects import MAX_SHIFT, MAX_WRONG, VOXEL, WRONG, Damage, Trial, compare, site_of
from validation.report import Cell, Cells, Content, suite, table

LAYERED = tuple(
    PhantomSpec(kind=kind, thickness=2.0, length=12.0, layer_thickness=0.6)
    for kind in ("arc", "spiral")
)
PLAIN = tuple(replace(spec, layer_thickness=0.0) for spec in LAYERED)
"""Without the molecular layer that the others have."""

CAVITIES: tuple[Injury, ...] = (
    ("vessel", 0.8, (0.7, 0.5)),
    ("cyst", 1.0, (0.65, 0.4)),
    ("stratum", 6.0, (0.65, 0.5)),
)
RAGGED: tuple[Injury, ...] = (("ragged-end", 1.0, (0.5, 0.0)), ("ragged-end", 2.5, (0.3, 0.0)))
UNCUS: tuple[Injury, ...] = tuple(
    (kind, reach, (0.0, 1.0)) for kind, reach in product(("uncus", "attached-uncus"), (1.5, 3.5))
)

MAX_MEAN = 0.02
"""mm, change of the mean thickness by what was mended."""
FAR = 2.0
"""mm behind the anterior end, from which on an uncus is warned of."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What it did to the map."""

    damage: Damage
    planted: float
    """Volume of the changed voxels, mm3."""
    interior: float
    """Of that, what was dentate gyrus or CA4, mm3."""
    found: float
    """Volume that the quality record names, mm3."""
    moved: tuple[float, float]
    """By how much the posterior end plane moved, mm, and turned, degrees."""
    same_plane: float = 0.0
    """Share of the columns that are off against the labels before, cut at the plane that moved."""
    warned: bool
    """Whether a repair says that the uncus begins far behind the anterior end."""

    @property
    def off(self) -> float:
        """Share of the columns that are off."""
        return (self.damage.near_wrong + self.damage.far_wrong) / self.damage.columns


@suite("mending")
def run(full: bool, labels: Path | None = None) -> Iterator[Content]:
    """Plant what has to be mended into phantoms and segmentations, and measure them."""
    fine = cases.fine_segmentations(labels, VOXEL)
    some = slice(None if full else -1, None)
    bodies: list[ValidationBody] = [*LAYERED[: None if full else 1]]
    bodies += fine[::2] if full else fine[:1]
    hollow = [
        Trial(body=body, injury=injury, mended=mended)
        for body in (*bodies, *(PLAIN[1:] if full else ()))
        for injury in CAVITIES[some]
        for mended in (True, False)
    ]
    ragged = [Trial(body=body, injury=injury) for body in bodies for injury in RAGGED[some]]
    front = PLAIN if full else LAYERED[:1]
    beside = [Trial(body=body, injury=injury) for body in front for injury in UNCUS[some]]
    results = cases.run_groups(
        measure_trial, {"hollow": hollow, "ragged": ragged, "beside": beside}
    )
    yield _cavities(hollow, results["hollow"])
    yield _ragged(ragged, results["ragged"])
    yield _uncus(beside, results["beside"])
    yield cases.left_out(labels)


def measure_trial(trial: Trial) -> Outcome:
    """Measure a body with something planted, and compare it with the one as it was."""
    volume, hemi, reference = cases.measure_reference(trial.body, VOXEL)
    defect = make_defect(site_of(trial.body), *trial.injury)
    labels = defect.volume
    if not trial.mended:
        hole = labels.tissue != volume.tissue
        labels = replace(labels, tissue=np.where(hole, np.uint8(Tissue.OTHER), labels.tissue))
    maps = cases.measure_body(labels, hemi)
    voxel = abs(float(np.linalg.det(volume.affine[:3, :3])))
    kind = trial.injury[0]
    found = {"ragged-end": voxel * maps.qc["end_voxels_inside"]}
    found |= dict.fromkeys(("uncus", "attached-uncus"), maps.qc["uncus_mm3"])
    return Outcome(
        damage=compare(maps, _truth(trial, reference), defect.changed),
        planted=voxel * len(defect.changed),
        interior=voxel * np.count_nonzero(np.isin(volume.tissue, CORE) & (labels.tissue == 0)),
        same_plane=_same_plane(volume, hemi, maps) if kind == "ragged-end" else 0.0,
        moved=_moved(reference.qc["posterior_plane"], maps.qc["posterior_plane"]),
        found=found.get(kind, maps.qc["cavities_mm3"]),
        warned=any("where the head begins" in repair for repair in maps.repairs),
    )


def _moved(before: Mapping[str, Any], after: Mapping[str, Any]) -> tuple[float, float]:
    """Distance of a plane from the point of another, mm, and the angle between both, degrees."""
    normals = [np.array(plane["normal_ras"]) for plane in (before, after)]
    step = np.subtract(after["point_ras_mm"], before["point_ras_mm"]) @ normals[0]
    return abs(float(step)), float(np.degrees(np.arccos(np.clip(normals[0] @ normals[1], -1, 1))))


def _same_plane(volume: LabelVolume, hemi: str, maps: HemisphereMaps) -> float:
    """Share of columns that differ from those of labels cut at the same posterior plane."""
    plane = maps.qc["posterior_plane"]
    point, normal = (tuple(plane[name]) for name in ("point_ras_mm", "normal_ras"))
    given = GivenEnd(end="posterior", point=point, normal=normal)
    same = cases.measure_body(replace(volume, given_ends=(given,)), hemi)
    return float((np.abs(maps.thickness - same.thickness) > WRONG).mean())


def _truth(trial: Trial, reference: HemisphereMaps) -> HemisphereMaps:
    """Put the known thickness of a phantom into its map, for cavities; real ones stay."""
    if not (isinstance(trial.body, PhantomSpec) and trial.injury in CAVITIES):
        return reference
    middle = reference.sheet.points[:, :, reference.sheet.middle]
    truth, inside = cases.truth_at(Phantom(trial.body), middle)
    thickness = np.where(inside, truth.thickness, reference.thickness)
    return replace(reference, maps={**reference.maps, "thickness": thickness})


def _empty(result: Outcome | Refusal) -> bool:
    """Whether there was nothing to be planted, such as a layer that a protocol lacks."""
    return isinstance(result, Refusal) and result.reason == "defect-empty"


def _name(trial: Trial) -> dict[str, Cell]:
    kind, size, _ = trial.injury
    return {"body": trial.name, "planted": kind, "size, mm": f"{size:g}"}


def _lost(trials: Sequence[Trial], results: Sequence[Outcome | Refusal]) -> str:
    """List refusals, but for what some labels have no room for."""
    pairs = zip(trials, results, strict=True)
    return cases.refusal_notes({f"{t.name}, {t.injury[0]}": [r] for t, r in pairs if not _empty(r)})


@table("mending.cavities")
def _cavities(
    trials: Sequence[Trial], results: Sequence[Outcome | Refusal]
) -> Iterator[Cells | str]:
    """Trials come in pairs, mended and not."""
    for trial, mended, hollow in zip(trials[::2], results[::2], results[1::2], strict=True):
        if _empty(mended):
            continue
        cells, met = _name(trial), False
        if isinstance(mended, Outcome):
            met = mended.off <= MAX_WRONG and abs(mended.damage.mean) <= MAX_MEAN
            met &= mended.damage.outcome == "repaired"
            cells |= {
                "volume, mm3": f"{mended.planted:.1f}",
                "of it interior": f"{mended.interior:.1f}",
                "found": f"{mended.found:.1f}",
                "outcome": mended.damage.outcome,
                "off": f"{mended.off:.1%}",
                "mean": f"{mended.damage.mean:+.3f}",
            }
        if isinstance(hollow, Outcome):
            cells |= {
                "not mended: outcome": hollow.damage.outcome,
                "not mended: off": f"{hollow.off:.1%}",
                "not mended: mean": f"{hollow.damage.mean:+.3f}",
            }
        yield {**cells, "met": met}
    yield _lost(trials, results)


@table("mending.ragged")
def _ragged(trials: Sequence[Trial], results: Sequence[Outcome | Refusal]) -> Iterator[Cells | str]:
    for trial, result in zip(trials, results, strict=True):
        cells, met = _name(trial), False
        if isinstance(result, Outcome):
            met = result.off <= MAX_WRONG and result.found > 0
            cells |= {
                "volume, mm3": f"{result.planted:.1f}",
                "handed over": f"{result.found:.1f}",
                "outcome": result.damage.outcome,
                "end moved": "{:.2f} mm, {:.1f}°".format(*result.moved),
                "off": f"{result.off:.1%}",
                "off, same plane": f"{result.same_plane:.1%}",
                "mean": f"{result.damage.mean:+.3f}",
            }
        yield {**cells, "met": met}
    yield _lost(trials, results)


@table("mending.uncus")
def _uncus(trials: Sequence[Trial], results: Sequence[Outcome | Refusal]) -> Iterator[Cells | str]:
    for trial, result in zip(trials, results, strict=True):
        cells, met = _name(trial), False
        if isinstance(result, Outcome):
            damage = result.damage
            met = result.found > 0 and damage.outcome == "repaired" and not damage.changed
            met &= not result.off and damage.shift <= MAX_SHIFT
            met &= result.warned == (trial.injury[1] > FAR)
            cells |= {
                "volume, mm3": f"{result.planted:.1f}",
                "left out": f"{result.found:.1f}",
                "outcome": damage.outcome,
                "warned": "yes, it begins far behind" if result.warned else "-",
                "off": f"{result.off:.1%}",
                "largest change, mm": damage.shift,
                "changed by repairs": f"{damage.changed:.1%}",
            }
        yield {**cells, "met": met}
    yield _lost(trials, results)
