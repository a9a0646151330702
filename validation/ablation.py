"""What each difference from the published method does: each is switched off alone."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from hipsta_bids.inputs.labels import read_label_volume
from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.settings import PUBLISHED, Settings
from hipsta_bids.types import Decision
from validation import cases, continuity
from validation.labelings import Revision, revisions
from validation.report import Cell, Cells, Content, suite, table

SEED = 20242
VOXEL = 0.4  # mm, of phantoms
PHANTOMS = (
    PhantomSpec(kind="spiral", thickness=2.0),
    PhantomSpec(kind="spiral", thickness=1.2),
    PhantomSpec(kind="tight", thickness=1.8),
    PhantomSpec(kind="spiral", thickness=2.0, variation=0.3),
)
POSES = 2
#: Settings that take a part of the method back to what was published, or leave it out.
VARIANTS: Mapping[str, Mapping[str, Mapping[str, Any]]] = MappingProxyType(
    {
        "default": {},
        "published operator": {"boundaries": {"operator": "published", "anisotropy": 40.0}},
        "edges at zero lines": {"boundaries": {"edges": "zero-lines"}},
        "published rule of the ends": {"body": {"end_rule": "last-slice"}},
        "closing, no gaps mended": {"body": {"mending": "closing"}},
        "x of the volume": {"sheet": {"x_coordinate": "volume"}},
        "no pits or slits filled": {"body": {"slit_voxel": 0.0}},
        "slices interpolated linearly": {"slices": {"min_ratio": 1e6}},
        "all as published": PUBLISHED,
    }
)
#: Perturbations of the suite of continuity: small ones, and damage of an edge.
SMALL = ("affine, 1e-5 mm", "end plane moved by 0.4 mm")


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """A phantom in a pose, measured with some settings."""

    case: cases.Case
    settings: Settings


def measure_error(drawing: Drawing) -> tuple[float, float]:
    """Measure the mean and the SD of a phantom's error of thickness, mm."""
    case = drawing.case
    phantom = Phantom(case.spec)
    maps = cases.measure_body(cases.draw(phantom, case), case.hemi, drawing.settings)
    error = cases.compare(phantom, case, maps).error
    return float(np.nanmean(error)), float(np.nanstd(error))


def compare_revision(revision: Revision) -> tuple[float, float, bool]:
    """Compare maps of two sets of labels: r, RMS, mm, and whether both need a look."""
    first, second = (
        cases.measure_body(read_label_volume(item), item.hemi, revision.settings)
        for item in (revision.first, revision.second)
    )
    pair = first.thickness, second.thickness
    known = np.isfinite(pair[0]) & np.isfinite(pair[1])
    flagged = [maps.decision is Decision.LOOK for maps in (first, second)]
    return (
        float(np.corrcoef(pair[0][known], pair[1][known])[0, 1]),
        cases.rms(pair[0] - pair[1]),
        flagged[0] == flagged[1],
    )


@suite("ablation")
def run(full: bool, labels: Path | None = None) -> Iterator[Content]:
    """Measure phantoms, small changes, damaged edges and revised labels with each variant."""
    generator = np.random.default_rng(SEED)
    poses = [cases.any_pose(generator) for _ in range(POSES)]
    specs = PHANTOMS if full else PHANTOMS[:1]
    groups: dict[tuple[str, str], list[Any]] = {}
    for name, changes in VARIANTS.items():
        settings = Settings().changed(**changes)
        groups[name, "phantoms"] = [
            Drawing(
                case=cases.Case(spec=spec, voxel_size=(VOXEL,) * 3, pose=pose), settings=settings
            )
            for spec in specs
            for pose in poses
        ]
        subjects = [
            continuity.Subject(labels=item) for item in cases.fine_segmentations(labels, 0.6)
        ] or continuity.subjects(None, full)
        for kind, perturbations in (("small", SMALL), ("edges", continuity.EDGES)):
            groups[name, kind] = [
                continuity.Trial(
                    subject=subject, perturbation=perturbation, draw=0, settings=settings
                )
                for subject in subjects
                for perturbation in perturbations
            ]
        groups[name, "revised"] = list(revisions(labels, settings) if full else [])
    results = cases.run_groups(_work, groups)
    yield _variants(results)
    yield cases.left_out(labels)


def _work(case: Drawing | continuity.Trial | Revision) -> Any:  # noqa: ANN401  (one of three)
    if isinstance(case, Drawing):
        return measure_error(case)
    return continuity.move(case) if isinstance(case, continuity.Trial) else compare_revision(case)


@table("ablation.variants")
def _variants(results: Mapping[tuple[str, str], Sequence[Any]]) -> Iterator[Cells | str]:
    for name in VARIANTS:
        measured = {
            kind: [one for one in group if not isinstance(one, cases.Refusal)]
            for (variant, kind), group in results.items()
            if variant == name
        }
        refused = sum(len(results[name, kind]) - len(group) for kind, group in measured.items())
        errors = np.array(measured["phantoms"] or [(np.nan, np.nan)])
        small = [movement.same_xy for movement in measured["small"]] or [np.nan]
        revised = np.array([row[:2] for row in measured["revised"]] or [(np.nan, np.nan)])
        cells: dict[str, Cell] = {
            "variant": name,
            "phantoms, bias": float(errors[:, 0].mean()),
            "phantoms, SD": float(errors[:, 1].mean()),
            "small changes, RMS median": float(np.median(small)),
            "small changes, RMS largest": float(np.max(small)),
            "edges, silent": sum(movement.silent for movement in measured["edges"]),
            "edges, maps": len(measured["edges"]),
            "two labelings, r": float(revised[:, 0].mean()),
            "two labelings, RMS": float(revised[:, 1].mean()),
            "status differs": sum(not row[2] for row in measured["revised"]),
            "refused": refused,
        }
        yield cells
