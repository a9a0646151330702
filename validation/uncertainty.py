"""The SD that perturbed copies of labels predict, beside that over poses of phantoms."""

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.stats import spearmanr

from hipsta_bids.participant.uncertainty import Uncertainty, estimate_uncertainty
from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.settings import Settings
from hipsta_bids.types import Float
from validation import cases
from validation.cases import Case, Measured, Refusal
from validation.report import Cell, Cells, Content, suite, table
from validation.thick_slices import PHANTOMS

SEED = 20232
POSES_QUICK, POSES_FULL = 6, 20
COPIES_QUICK, COPIES_FULL = 4, 8
"""Perturbed copies per body."""
COPIED_QUICK, COPIED_FULL = 1, 2
"""Bodies that are copied, of each phantom."""

#: Voxels in which uncertainty is checked, mm.
VOXELS = ((0.4, 0.4, 0.4), (0.4, 0.4, 2.0))
#: What copies differ by: in the voxels alone, as the phantoms do, and as by default.
CAUSES = {"voxels": 0.0, "voxels and labels": Settings().uncertainty.jitter}
MAX_SD_RATIO = 1.5
"""Of the SD over poses and the one that copies predict, either way; perfect labels, one voxel."""


def measure_copies(copied: tuple[Case, float, int]) -> Uncertainty:
    """Estimate the uncertainty of a phantom by jittered copies."""
    case, jitter, copies = copied
    settings = Settings().changed(uncertainty={"jitter": jitter})
    return estimate_uncertainty(cases.draw(Phantom(case.spec), case), case.hemi, settings, copies)


@suite("uncertainty")
def run(full: bool) -> Iterator[Content]:
    """Set the SD that perturbed copies predict beside that over poses of a phantom."""
    if full:
        yield _sds(PHANTOMS, POSES_FULL, COPIED_FULL, COPIES_FULL)
    else:
        yield _sds(PHANTOMS[:1], POSES_QUICK, COPIED_QUICK, COPIES_QUICK)


@table("uncertainty.sd")
def _sds(specs: Sequence[PhantomSpec], poses: int, copied: int, copies: int) -> Iterator[Cells]:
    drawings = {
        (spec.kind, voxel): _posed(spec, voxel, poses) for spec in specs for voxel in VOXELS
    }
    seen = cases.run_groups(cases.measure_case, drawings)
    plan = {
        (*key, cause): [(case, jitter, copies) for case in group[:copied]]
        for key, group in drawings.items()
        for cause, jitter in CAUSES.items()
    }
    for (kind, voxel, cause), predicted in cases.run_groups(measure_copies, plan).items():
        yield _uncertainty_row(kind, voxel, cause, seen[kind, voxel], predicted)


def _posed(spec: PhantomSpec, voxel: tuple[float, float, float], count: int) -> list[Case]:
    """One phantom in several poses; thick slices go across its axis, as in scans."""
    generator = np.random.default_rng((SEED, 200))
    drawings = []
    for _ in range(count):
        pose, turn = cases.any_pose(generator), None
        if voxel[2] > voxel[0]:
            pose, turn = cases.along_slices(generator)
        drawings.append(Case(spec=spec, voxel_size=voxel, pose=pose, grid_rotation=turn))
    return drawings


def _uncertainty_row(
    kind: str,
    voxel: tuple[float, float, float],
    cause: str,
    seen: Sequence[Measured | Refusal],
    predicted: Sequence[Uncertainty | Refusal],
) -> Cells:
    measured = [m for m in seen if isinstance(m, Measured)]
    known = [u for u in predicted if isinstance(u, Uncertainty) and u.known]
    perfect = not CAUSES[cause]
    cells: dict[str, Cell] = {
        "phantom": kind,
        "voxel, mm": f"{voxel[0]:g} x {voxel[1]:g} x {voxel[2]:g}",
        "copies differ in": cause,
        "copies refused": sum(u.failed for u in predicted if isinstance(u, Uncertainty)),
    }
    if len(measured) > 1 and known:
        maps = np.array([m.thickness for m in measured])
        over_poses = maps.std(axis=0, ddof=1)
        copies = np.sqrt(np.mean([u.maps["thickness"] ** 2 for u in known], axis=0))
        halves = [maps[start::2].std(axis=0, ddof=1).ravel() for start in (0, 1)]
        ratio = float(np.sqrt((copies**2).mean() / (over_poses**2).mean()))
        means = np.std([m.summary["thickness_mean"] for m in measured], ddof=1)
        of_means = np.sqrt(np.mean([u.summary["thickness_mean"] ** 2 for u in known]))
        met = perfect and 1 / MAX_SD_RATIO <= ratio <= MAX_SD_RATIO
        cells |= {
            "over poses": float(np.sqrt((over_poses**2).mean())),
            "predicted": float(np.sqrt((copies**2).mean())),
            "ratio": f"{ratio:.2f}",
            "rank correlation": f"{_rank(copies.ravel(), over_poses.ravel()):.2f}",
            "that of halves of the poses": f"{_rank(*halves):.2f}",
            "mean over poses": f"{means:.4f}",
            "predicted mean": f"{of_means:.4f}",
        }
    else:
        met = False
    cells["target, ratio"] = f"{1 / MAX_SD_RATIO:.2f} to {MAX_SD_RATIO:g}" if perfect else None
    return {**cells, "met": met if perfect else None}


def _rank(a: Float, b: Float) -> float:
    """Rank correlation over the nodes that both know."""
    both = np.isfinite(a) & np.isfinite(b)
    return float(spearmanr(a[both], b[both]).statistic)
