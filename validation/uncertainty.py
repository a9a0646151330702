"""The SD that perturbed copies of labels predict, beside that over poses, and beside errors."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

from hipsta_bids.extensions.uncertainty.copies import Uncertainty, estimate_uncertainty
from hipsta_bids.geometry.body import extract_body
from hipsta_bids.inputs.labels import read_label_volume
from hipsta_bids.inputs.search import HemisphereInput
from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.settings import Settings
from hipsta_bids.types import Float, HemisphereMaps, LabelVolume
from validation.cases import (
    Case,
    Measured,
    Refusal,
    ValidationBody,
    along_slices,
    any_pose,
    draw,
    fine_segmentations,
    hippunfold_beside,
    left_out,
    measure_body,
    measure_case,
    measure_reference,
    refusal_notes,
    rms,
    run_groups,
)
from validation.continuity import SMOOTHNESS, warped
from validation.report import Cell, Cells, Content, suite, table
from validation.thick_slices import FULL_VOXEL, PHANTOMS, PIXEL, reslice

SEED = 20232
POSES_QUICK, POSES_FULL = 6, 20
COPIES_QUICK, COPIES_FULL = 4, 8
"""Perturbed copies per body."""
COPIED_QUICK, COPIED_FULL = 1, 2
"""Bodies that are copied, of each phantom."""

#: Voxels in which uncertainty is checked, mm.
VOXELS = ((0.4, 0.4, 0.4), (0.4, 0.4, 2.0))
#: What copies differ by: in the voxels alone, as the phantoms do, and as by default.
CAUSES = {"voxels": {"relabeling": 0.0, "end_shift": 0.0, "jitter": 0.0}, "voxels and labels": {}}
MAX_SD_RATIO = 1.5
"""Of the SD over poses and the one that copies predict, either way; perfect labels, one voxel."""

DISPLACED, SLICES, REVISED = "displaced by 0.3 mm", "2 mm slices", "labels of the other set"
DISPLACEMENT, THICK = 0.3, 2.0
"""mm: SD along each axis; distance of slices."""
DRAWS = 3
"""Displacements of each body."""
COVERED = (0.90, 0.97)
"""Share of the points whose error lies within 2 predicted SDs, least and most."""
LEAST_RANK = 0.4
_VOXELS = 0.6
"""mm, longest edge of labels whose errors are looked at."""


@dataclass(frozen=True, kw_only=True)
class Relabeling:
    """Labels of a body that are changed as scanners and people change them."""

    body: ValidationBody
    change: str
    copies: int
    draws: int = 1
    other: HemisphereInput | None = None
    """The same hemisphere in another set of labels."""


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """Errors of a map beside the SDs that copies predict."""

    covered: float
    """Share of errors within 2 SD."""
    rank: float
    """Rank correlation of SD and root mean square error over the points."""
    chance: float
    """The same with errors drawn from these SDs: the largest that can be expected."""
    error: float
    """Root mean square error, mm."""
    sd: float
    """Root mean square SD, mm."""
    mean_error: float
    """Root mean square error of the mean thickness, mm."""
    mean_sd: float


def measure_copies(copied: tuple[Case, str, int]) -> Uncertainty:
    """Estimate the uncertainty of a phantom by perturbed copies."""
    case, cause, copies = copied
    settings = Settings().changed(uncertainty=CAUSES[cause])
    return estimate_uncertainty(draw(Phantom(case.spec), case), case.hemi, settings, copies)


@suite("uncertainty")
def run(full: bool, labels: Path | None = None) -> Iterator[Content]:
    """Set the SD that perturbed copies predict beside that over poses, and beside errors."""
    if full:
        yield _sds(PHANTOMS, POSES_FULL, COPIED_FULL, COPIES_FULL)
    else:
        yield _sds(PHANTOMS[:1], POSES_QUICK, COPIED_QUICK, COPIES_QUICK)
    yield _coverages(relabelings(labels, full))
    yield left_out(labels)


def relabelings(labels: Path | None, full: bool) -> list[Relabeling]:
    """List changes of phantoms, of a dataset, of HippUnfold's person, and of a revised dataset."""
    copies = COPIES_FULL if full else COPIES_QUICK
    bodies: list[ValidationBody] = list(PHANTOMS if full else PHANTOMS[-1:])
    pairs: list[tuple[HemisphereInput, HemisphereInput]] = []
    if labels is not None and full:
        for folder in (labels, *hippunfold_beside(labels)):
            bodies += fine_segmentations(folder, _VOXELS)
        revised = labels.absolute().parent / f"{labels.absolute().name}-revised"
        found = fine_segmentations(revised if revised.is_dir() else None, _VOXELS)
        pairs += [(a, b) for a in found for b in found if _is_other(a, b)]
    return [
        *(
            Relabeling(body=body, change=DISPLACED, copies=copies, draws=DRAWS if full else 1)
            for body in bodies
        ),
        *(Relabeling(body=body, change=SLICES, copies=copies) for body in bodies if full),
        *(Relabeling(body=a, other=b, change=REVISED, copies=copies) for a, b in pairs),
    ]


def _is_other(a: HemisphereInput, b: HemisphereInput) -> bool:
    """Whether two segmentations are of one hemisphere in two sets, as subjects 1A and 1B."""
    return a.hemi == b.hemi and a.subject[:-1] == b.subject[:-1] and a.subject != b.subject


def cover(case: Relabeling) -> Coverage:
    """Change labels, and set the errors of their maps beside the SDs that copies predict."""
    volume, hemi, reference = measure_reference(case.body, FULL_VOXEL)
    changed = _changed(case, volume)
    copied = changed[0] if case.change == SLICES else volume
    predicted = estimate_uncertainty(copied, hemi, Settings(), case.copies)
    maps = [measure_body(labels, hemi) for labels in changed]
    return compare_errors(reference, maps, predicted)


def compare_errors(
    reference: HemisphereMaps, maps: Sequence[HemisphereMaps], predicted: Uncertainty
) -> Coverage:
    """Set the errors of maps beside the SDs that copies predict."""
    errors = np.array([measured.thickness - reference.thickness for measured in maps])
    means = [m.summary["thickness_mean"] - reference.summary["thickness_mean"] for m in maps]
    sd = predicted.maps["thickness"]
    random = np.random.default_rng((SEED, 201))
    return Coverage(
        covered=float((np.abs(errors) <= 2 * sd)[np.isfinite(errors * sd)].mean()),
        rank=_rank(sd, _over_draws(errors)),
        chance=_rank(sd, _over_draws(sd * random.normal(size=errors.shape))),
        error=rms(errors),
        sd=rms(sd),
        mean_error=rms(means),
        mean_sd=predicted.summary["thickness_mean"],
    )


def _changed(case: Relabeling, volume: LabelVolume) -> list[LabelVolume]:
    if case.other is not None:
        return [read_label_volume(case.other)]
    if case.change == SLICES:
        axis = extract_body(volume, Settings().body).ends.axis
        return [reslice(volume, axis, (PIXEL, PIXEL, THICK))]
    randoms = [np.random.default_rng((SEED, 202, number)) for number in range(case.draws)]
    return [warped(volume, DISPLACEMENT, SMOOTHNESS, random) for random in randoms]


def _over_draws(errors: Float) -> Float:
    """Root mean square (Nx, Ny) of errors (draws, Nx, Ny)."""
    return np.asarray(np.sqrt(np.mean(errors**2, axis=0)))


@table("uncertainty.coverage")
def _coverages(cases: Sequence[Relabeling]) -> Iterator[Cells | str]:
    groups: dict[tuple[str, str], list[Relabeling]] = {}
    for case in cases:
        kind = "phantoms" if isinstance(case.body, PhantomSpec) else "labels"
        groups.setdefault((case.change, kind), []).append(case)
    results = run_groups(cover, groups, timeout=600)
    for (change, kind), group in results.items():
        yield coverage_row(change, kind, group)
    yield refusal_notes({f"{change}, {kind}": group for (change, kind), group in results.items()})


def coverage_row(
    change: str, kind: str, group: Sequence[Coverage | Refusal], *, least_rank: float = LEAST_RANK
) -> Cells:
    """Sum up the errors of one change of some bodies."""
    rows = [result for result in group if isinstance(result, Coverage)]
    cells: dict[str, Cell] = {"change": change, "bodies": kind, "number": len(group)}
    met = False
    if rows:
        shares = [row.covered for row in rows]
        rank = float(np.median([row.rank for row in rows]))
        met = bool(COVERED[0] <= np.mean(shares) <= COVERED[1] and rank >= least_rank)
        cells |= {
            "error": rms([row.error for row in rows]),
            "predicted": rms([row.sd for row in rows]),
            "within 2 SD": f"{np.mean(shares):.0%}",
            "least, most": f"{min(shares):.0%}, {max(shares):.0%}",
            "rank correlation": f"{rank:.2f}",
            "expected by chance at best": f"{np.median([row.chance for row in rows]):.2f}",
            "error of the mean": rms([row.mean_error for row in rows]),
            "predicted mean": rms([row.mean_sd for row in rows]),
        }
    target = f"{COVERED[0]:.0%} to {COVERED[1]:.0%}, r ≥ {least_rank:g}"
    return {**cells, "target": target, "met": met}


@table("uncertainty.sd")
def _sds(specs: Sequence[PhantomSpec], poses: int, copied: int, copies: int) -> Iterator[Cells]:
    cases = {(spec.kind, voxel): _posed(spec, voxel, poses) for spec in specs for voxel in VOXELS}
    seen = run_groups(measure_case, cases)
    plan = {
        (*key, cause): [(case, cause, copies) for case in group[:copied]]
        for key, group in cases.items()
        for cause in CAUSES
    }
    for (kind, voxel, cause), predicted in run_groups(measure_copies, plan).items():
        yield _uncertainty_row(kind, voxel, cause, seen[kind, voxel], predicted)


def _posed(spec: PhantomSpec, voxel: tuple[float, float, float], count: int) -> list[Case]:
    """One phantom in several poses; thick slices go across its axis, as in scans."""
    generator = np.random.default_rng((SEED, 200))
    cases = []
    for _ in range(count):
        pose, turn = any_pose(generator), None
        if voxel[2] > voxel[0]:
            pose, turn = along_slices(generator)
        cases.append(Case(spec=spec, voxel_size=voxel, pose=pose, grid_rotation=turn))
    return cases


def _uncertainty_row(
    kind: str,
    voxel: tuple[float, float, float],
    cause: str,
    seen: Sequence[Measured | Refusal],
    predicted: Sequence[Uncertainty | Refusal],
) -> Cells:
    measured = [m for m in seen if isinstance(m, Measured)]
    known = [u for u in predicted if isinstance(u, Uncertainty) and u.known]
    perfect = cause == "voxels"
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
