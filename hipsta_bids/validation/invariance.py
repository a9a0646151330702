"""What may not change a map: where the subject lies, how voxels are stored, and thick slices."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import spearmanr

from hipsta_bids.geometry.body import extract_body
from hipsta_bids.participant.uncertainty import Uncertainty, estimate_uncertainty
from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.settings import Settings
from hipsta_bids.types import Float, HemisphereMaps, LabelVolume, Status
from hipsta_bids.validation.cases import (
    Case,
    Measured,
    Refusal,
    ValidationBody,
    along_slices,
    any_pose,
    draw,
    fine_segmentations,
    measure_body,
    measure_case,
    measure_reference,
    random_motion,
    refusal_notes,
    run_cases,
    run_groups,
)
from hipsta_bids.validation.report import Cell, Cells, Picture, Suite, Table, show_map

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SEED = 20232
MOTIONS_QUICK, MOTIONS_FULL = 6, 20
PAIRS_QUICK, PAIRS_FULL = 1, 4
COPIES_QUICK, COPIES_FULL = 4, 8
"""Perturbed copies per body."""
COPIED_QUICK, COPIED_FULL = 1, 2
"""Bodies that are copied, of each phantom."""

MAX_SD_OF_MEAN = 0.01
"""mm, of the mean thickness over rigid motions."""
MAX_POINTWISE_SD = 0.05
"""mm, root mean square over the sheet of the SD of a point."""
MAX_CHANGE = 0.02
"""mm, mean absolute change where the voxels are the same and only their form is another."""

AXES = ("RAS", "PIR", "ASL")
"""Orders and directions of voxel axes that are compared with LIA."""

SPEC = PhantomSpec(kind="spiral", thickness=2.0, variation=0.15)

PIXEL = 0.4
"""mm, of the slices."""
FULL_VOXEL = 0.3
"""mm, of phantoms at full resolution."""
TILT = 10.0
"""Degrees."""
OFFSETS = (0.0, 0.25, 0.5, 0.75)
"""Of slices, fractions of their distance; of tilted ones the first and the third."""
SAMPLED_OFFSETS = (0.0, 1 / 3, 2 / 3)
"""At which the map at full resolution is sampled."""
MAX_ACCEPTED = 0.15
"""mm; no map that is handed out as sound may be off by more in the mean."""

#: Distance of slices, mm: |difference of the mean thickness|, mean and worst, mm; map correlation,
#: median and worst.
TARGETS = {
    1.0: (0.015, 0.04, 0.89, 0.75),
    1.5: (0.02, 0.06, 0.89, 0.72),
    2.0: (0.035, 0.10, 0.84, 0.55),
}
LEAST_ACCEPTED = 0.85
"""Share of the maps from slices that are handed out as sound."""
MAX_HALF_CHANGE = 0.24
"""mm, RMS change of a map when the slices are moved by half their distance."""
MAX_FLIPS = 0.05
"""Share of these pairs of which one map is handed out as sound and the other is not."""

PHANTOMS = (
    PhantomSpec(kind="spiral", thickness=2.0, variation=0.3),
    PhantomSpec(kind="tight", thickness=1.6, variation=0.3),
    PhantomSpec(kind="arc", thickness=1.4, variation=0.3),
)

MOTIONS = {"any rotation": random_motion, "up to 25° about each axis": any_pose}


def run(full: bool) -> Suite:
    """Measure one phantom in many positions, and pairs of equal voxels in different form."""
    count, pairs = (MOTIONS_FULL, PAIRS_FULL) if full else (MOTIONS_QUICK, PAIRS_QUICK)
    cases = {}
    for number, (name, motion) in enumerate(MOTIONS.items()):
        generator = np.random.default_rng((SEED, number))
        cases[name] = [Case(spec=SPEC, pose=motion(generator)) for _ in range(count)]
    results = run_groups(measure_case, cases | {f"pair {n}": _pair(n) for n in range(pairs)})
    motions = {name: results[name] for name in MOTIONS}
    return Suite(
        name="invariance",
        title="Invariance",
        text=_TEXT,
        tables=(
            _motion_table(motions),
            _pair_table([results[f"pair {number}"] for number in range(pairs)]),
        ),
        pictures=(_picture(motions),),
    )


def _pair(number: int) -> list[Case]:
    """Cases of one pose: as it is, mirrored, and with other voxel axes."""
    pose = any_pose(np.random.default_rng((SEED, 100, number)))
    return [
        Case(spec=SPEC, pose=pose),
        Case(spec=SPEC, pose=pose, mirrored=True),
        *(Case(spec=SPEC, pose=pose, axes=axes) for axes in AXES),
    ]


def _maps(group: Sequence[Measured | Refusal]) -> Float | None:
    """Thickness (M, Nx, Ny) of what was measured; None for less than two maps."""
    maps = [m.thickness for m in group if isinstance(m, Measured)]
    return np.array(maps) if len(maps) > 1 else None


def _motion_table(motions: Mapping[str, Sequence[Measured | Refusal]]) -> Table:
    rows: list[Cells] = []
    for name, group in motions.items():
        maps = _maps(group)
        refused = sum(isinstance(m, Refusal) for m in group)
        cells: dict[str, Cell] = {"motions": name, "number": len(group), "refused": refused}
        good = False
        if maps is not None:
            of_mean = float(maps.mean(axis=(1, 2)).std(ddof=1))
            at_points = maps.std(axis=0, ddof=1)
            overall = float(np.sqrt((at_points**2).mean()))
            good = of_mean <= MAX_SD_OF_MEAN and overall <= MAX_POINTWISE_SD and not refused
            cells |= {
                "SD of the mean": of_mean,
                "SD of a point (RMS)": overall,
                "median": float(np.median(at_points)),
                "95th percentile": float(np.quantile(at_points, 0.95)),
            }
        targets = (f"≤ {MAX_SD_OF_MEAN:g}", f"≤ {MAX_POINTWISE_SD:g}")
        rows.append({**cells, "target, mean": targets[0], "target, point": targets[1], "met": good})
    return Table(
        title="One phantom in many positions, mm",
        rows=rows,
        digits=4,
        notes="A point is a node of the sheet's grid; the SD is over the motions.",
    )


def _pair_table(pairs: Sequence[Sequence[Measured | Refusal]]) -> Table:
    rows: list[Cells] = []
    for column, name in enumerate(("mirror image", *(f"voxel axes {axes}" for axes in AXES)), 1):
        changes = [
            b.thickness - a.thickness
            for a, b in ((pair[0], pair[column]) for pair in pairs)
            if isinstance(a, Measured) and isinstance(b, Measured)
        ]
        absolute = np.abs(changes)
        complete = len(changes) == len(pairs)
        rows.append(
            {
                "form": name,
                "mean": f"{np.mean(changes):+.5f}" if complete else None,
                "mean absolute": f"{absolute.mean():.5f}" if complete else None,
                "largest": f"{absolute.max():.5f}" if complete else None,
                "target, mean absolute": f"≤ {MAX_CHANGE:g}",
                "met": complete and bool(absolute.mean() <= MAX_CHANGE),
            }
        )
    return Table(
        title="The same voxels in another form: change of thickness, mm",
        rows=rows,
        notes=f"Number of poses: {len(pairs)}.",
    )


def _picture(motions: Mapping[str, Sequence[Measured | Refusal]]) -> Picture:
    found = {name: maps for name, group in motions.items() if (maps := _maps(group)) is not None}

    def draw(figure: "Figure") -> None:
        axes = figure.subplots(1, max(1, len(found)), squeeze=False)[0]
        for axis, (name, maps) in zip(axes, found.items(), strict=False):
            spread = maps.std(axis=0, ddof=1)
            image = show_map(axis, spread, name, cmap="viridis", vmin=0, vmax=0.1)
            figure.colorbar(image, ax=axis, label="SD, mm")

    return Picture(
        name="invariance",
        caption="SD of thickness over the motions at each point of the sheet, mm.",
        draw=draw,
        size=(9.0, 3.2),
    )


#: Voxels in which uncertainty is checked, mm.
VOXELS = ((0.4, 0.4, 0.4), (0.4, 0.4, 2.0))
#: What copies differ by: in the voxels alone, as the phantoms do, and as by default.
CAUSES = {"voxels": 0.0, "voxels and labels": Settings().uncertainty.jitter}
MAX_SD_RATIO = 1.5
"""Of the SD over poses and the one that copies predict, either way; perfect labels, one voxel."""


@dataclass(frozen=True, kw_only=True)
class Copied:
    """A phantom of whose labels perturbed copies are measured."""

    case: Case
    jitter: float
    """As in the settings."""
    copies: int


def measure_copies(copied: Copied) -> Uncertainty:
    """Estimate the uncertainty of one phantom."""
    settings = Settings().changed(uncertainty={"jitter": copied.jitter})
    volume = draw(Phantom(copied.case.spec), copied.case)
    return estimate_uncertainty(volume, copied.case.hemi, settings, copied.copies)


def run_uncertainty(full: bool) -> Suite:
    """Set the SD that perturbed copies predict beside that over poses of a phantom."""
    poses = MOTIONS_FULL if full else MOTIONS_QUICK
    copied, copies = (COPIED_FULL, COPIES_FULL) if full else (COPIED_QUICK, COPIES_QUICK)
    cases = {
        (spec.kind, voxel): _posed(spec, voxel, poses)
        for spec in (PHANTOMS if full else PHANTOMS[:1])
        for voxel in VOXELS
    }
    seen = run_groups(measure_case, cases)
    predicted = run_groups(
        measure_copies,
        {
            (*key, cause): [
                Copied(case=case, jitter=jitter, copies=copies) for case in group[:copied]
            ]
            for key, group in cases.items()
            for cause, jitter in CAUSES.items()
        },
    )
    rows = [
        _uncertainty_row(kind, voxel, cause, seen[kind, voxel], predicted[kind, voxel, cause])
        for kind, voxel in cases
        for cause in CAUSES
    ]
    return Suite(
        name="uncertainty",
        title="Uncertainty",
        text=_UNCERTAINTY_TEXT,
        tables=(
            Table(
                title="SD of thickness over poses, and as predicted from copies of one pose, mm",
                rows=rows,
                notes=_UNCERTAINTY_NOTES.format(copies=copies, poses=poses, copied=copied),
            ),
        ),
    )


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


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One hemisphere in slices."""

    body: ValidationBody
    step: float
    """Distance of slices, mm."""
    offset: float
    tilt: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Outcome:
    """A map from slices beside the one at full resolution."""

    status: str
    change: float
    """Of the mean thickness, mm."""
    correlation: float
    """Of the maps of thickness."""
    thickness: Float
    """(Nx, Ny), mm."""
    half_sampled: float
    """RMS change, mm, of the map at full resolution, known at slices only, when these are moved by
    half their distance."""
    sampled: tuple[tuple[float, float], ...]
    """The same two numbers for the map at full resolution, known at slices only."""

    @property
    def accepted(self) -> bool:
        """Whether the map was handed out as sound."""
        return self.status in (Status.OK, Status.REPAIRED)


def run_slices(full: bool, labels: Path | None = None) -> Suite:
    """Reslice bodies, segmentations of a dataset with fine voxels among them, and measure them."""
    steps = tuple(TARGETS) if full else (2.0,)
    ways = [(offset, 0.0) for offset in (OFFSETS if full else OFFSETS[::2])]
    ways += [(offset, TILT) for offset in (OFFSETS[::2] if full else OFFSETS[:1])]
    bodies: list[ValidationBody] = list(PHANTOMS if full else PHANTOMS[:1])
    if labels is not None:
        bodies += fine_segmentations(labels, PIXEL)
    trials = [
        Trial(body=body, step=step, offset=offset, tilt=tilt)
        for body in bodies
        for step, plan in ((PIXEL, (ways[0], ways[-1])), *((step, ways) for step in steps))
        for offset, tilt in plan
    ]
    results = run_cases(measure_trial, trials)
    return Suite(
        name="slices",
        title="Thick slices",
        text=_SLICES_TEXT,
        tables=(_table(trials, results), _half_table(trials, results)),
    )


def measure_trial(trial: Trial) -> Outcome:
    """Reslice a body, measure it and compare."""
    volume, hemi, reference = measure_reference(trial.body, FULL_VOXEL)
    axis = extract_body(volume, Settings().body).ends.axis
    size = (PIXEL, PIXEL, trial.step)
    thick = reslice(volume, axis, size, offset=trial.offset, tilt=trial.tilt)
    return compare(measure_body(thick, hemi), reference, trial.step)


def compare(maps: HemisphereMaps, reference: HemisphereMaps, step: float) -> Outcome:
    """Set a map from slices, ``step`` mm apart, beside the one at full resolution, node by node."""
    both = np.isfinite(maps.thickness) & np.isfinite(reference.thickness)
    pair = maps.thickness[both], reference.thickness[both]
    return Outcome(
        status=str(maps.status),
        change=float(pair[0].mean() - pair[1].mean()),
        correlation=float(np.corrcoef(*pair)[0, 1]),
        thickness=maps.thickness,
        half_sampled=_rms(*(_sampled_map(reference, step, offset) for offset in (0.0, 0.5))),
        sampled=_sampled(reference, step),
    )


def _sampled(reference: HemisphereMaps, step: float) -> tuple[tuple[float, float], ...]:
    """Change of the mean and correlation if the map itself were known at slices only.

    At three offsets of the slices.
    """
    found = []
    for offset in SAMPLED_OFFSETS:
        map_ = _sampled_map(reference, step, offset + 0.5 / len(SAMPLED_OFFSETS))
        correlation = float(np.corrcoef(map_.ravel(), reference.thickness.ravel())[0, 1])
        found.append((float(map_.mean() - reference.thickness.mean()), correlation))
    return tuple(found)


def _sampled_map(reference: HemisphereMaps, step: float, offset: float) -> Float:
    """Thickness (Nx, Ny) known at slices only; linear between them, constant beyond the last."""
    thickness = reference.thickness
    length = float(reference.qc["body_length_mm"])
    rows = np.linspace(0.0, length, thickness.shape[1])
    levels = np.arange(offset * step, length, step)
    weights = np.array([np.interp(levels, rows, unit) for unit in np.eye(len(rows))])
    back = np.array([np.interp(rows, levels, unit) for unit in np.eye(len(levels))])
    return np.asarray(thickness @ weights @ back)


def _rms(first: Float, second: Float) -> float:
    """Root mean square difference of two maps where both are known."""
    return float(np.sqrt(np.nanmean((first - second) ** 2)))


def reslice(
    volume: LabelVolume,
    axis: Float,
    voxel_size: tuple[float, float, float],
    *,
    offset: float = 0.0,
    tilt: float = 0.0,
) -> LabelVolume:
    """Take the labels at the voxel centers of thick slices.

    ``axis`` is the unit vector (3,) across the slices; ``voxel_size`` is pixel, pixel and distance
    of slices, mm; ``offset`` is a fraction of that distance, ``tilt`` in degrees.
    """
    aside = np.cross(axis, [0.0, 0.0, 1.0])
    aside /= np.linalg.norm(aside)
    turn = Rotation.from_euler("x", tilt, degrees=True).as_matrix()
    matrix = np.column_stack([aside, np.cross(axis, aside), axis]) @ turn * np.array(voxel_size)
    size = np.array(volume.tissue.shape) - 1
    corners = np.array(np.meshgrid(*([0, n] for n in size))).reshape(3, -1)
    corners = volume.affine[:3, :3] @ corners + volume.affine[:3, 3:]
    middle = corners.mean(axis=1)
    reach = np.linalg.solve(matrix, corners - middle[:, None])
    low = np.floor(reach.min(axis=1)) - 1
    shape = (np.ceil(reach.max(axis=1)) + 2 - low).astype(int)
    affine = np.eye(4)
    affine[:3, :3] = matrix
    affine[:3, 3] = middle + matrix @ (low + np.array([0.0, 0.0, offset]))
    to_volume = np.linalg.inv(volume.affine) @ affine
    index = np.indices(shape).reshape(3, -1)
    nearest = np.rint(to_volume[:3, :3] @ index + to_volume[:3, 3:]).astype(int)
    inside = ((nearest >= 0) & (nearest <= size[:, None])).all(axis=0)
    tissue, part = (np.zeros(index.shape[1], dtype=np.uint8) for _ in range(2))
    tissue[inside] = volume.tissue[tuple(nearest[:, inside])]
    part[inside] = volume.part[tuple(nearest[:, inside])]
    return LabelVolume(
        tissue=tissue.reshape(shape),
        part=part.reshape(shape),
        affine=affine,
        protocol=volume.protocol,
    )


def _table(trials: Sequence[Trial], results: Sequence[Outcome | Refusal]) -> Table:
    groups: dict[tuple[str, float, bool], list[Outcome | Refusal]] = {}
    for trial, result in zip(trials, results, strict=True):
        kind = "phantoms" if isinstance(trial.body, PhantomSpec) else "labels"
        groups.setdefault((kind, trial.step, trial.tilt > 0), []).append(result)
    refusals = refusal_notes(
        {
            f"{kind}, {step:g} mm, {'tilted' if tilted else 'straight'}": group
            for (kind, step, tilted), group in groups.items()
        }
    )
    return Table(
        title="Maps from slices beside those at full resolution",
        rows=[_row(*key, group) for key, group in groups.items()],
        notes=_NOTES.format(accepted=MAX_ACCEPTED, share=LEAST_ACCEPTED) + refusals,
    )


def _row(kind: str, step: float, tilted: bool, group: Sequence[Outcome | Refusal]) -> Cells:
    found = [result for result in group if isinstance(result, Outcome)]
    target = TARGETS.get(step)
    accepted = max((abs(result.change) for result in found if result.accepted), default=0.0)
    met = bool(found) and accepted <= MAX_ACCEPTED
    cells: dict[str, Cell] = {
        "bodies": kind,
        "slices, mm": f"{step:g}",
        "tilt": f"{TILT if tilted else 0:g}°",
        "number": len(group),
        "refused": len(group) - len(found),
        "flagged": sum(not result.accepted for result in found),
    }
    if found:
        change = np.array([result.change for result in found])
        mean, worst, likeness, lowest = _four(change, [result.correlation for result in found])
        sampled = np.array([sample for result in found for sample in result.sampled])
        if target:
            met &= mean <= target[0] and worst <= target[1]
            met &= likeness >= target[2] and lowest >= target[3]
            met &= sum(result.accepted for result in found) >= LEAST_ACCEPTED * len(group)
        cells |= {
            "change of mean, mm": f"{change.mean():+.3f}",
            "size of change, mean": mean,
            "size of change, worst": worst,
            "worst of accepted": accepted,
            "correlation, median": likeness,
            "correlation, worst": lowest,
            "by sampling alone": "{:.3f} / {:.3f}, {:.2f} / {:.2f}".format(*_four(*sampled.T)),
        }
    cells["targets"] = "{:g} / {:g}, {:g} / {:g}".format(*target) if target else None
    return {**cells, "met": met}


def _half_table(trials: Sequence[Trial], results: Sequence[Outcome | Refusal]) -> Table:
    """Compare maps whose slices lie half their distance apart."""
    known = {(t.body, t.step, t.tilt, t.offset): r for t, r in zip(trials, results, strict=True)}
    groups: dict[tuple[str, float, bool], list[tuple[Outcome | Refusal, Outcome | Refusal]]] = {}
    for (body, step, tilt, offset), first in known.items():
        second = known.get((body, step, tilt, offset + 0.5))
        if second is not None:
            kind = "phantoms" if isinstance(body, PhantomSpec) else "labels"
            groups.setdefault((kind, step, tilt > 0), []).append((first, second))
    return Table(
        title="Maps from slices half a slice apart",
        rows=[_half_row(*key, pairs) for key, pairs in groups.items()],
        notes=_HALF_NOTES,
    )


def _half_row(
    kind: str,
    step: float,
    tilted: bool,
    pairs: Sequence[tuple[Outcome | Refusal, Outcome | Refusal]],
) -> Cells:
    both = [(a, b) for a, b in pairs if isinstance(a, Outcome) and isinstance(b, Outcome)]
    sound = [[isinstance(r, Outcome) and r.accepted for r in pair] for pair in pairs]
    flips = sum(first != second for first, second in sound)
    cells: dict[str, Cell] = {
        "bodies": kind,
        "slices, mm": f"{step:g}",
        "tilt": f"{TILT if tilted else 0:g}°",
        "pairs": len(pairs),
        "one accepted only": flips,
    }
    met = bool(both) and flips <= MAX_FLIPS * len(pairs)
    if both:
        change = np.array([_rms(a.thickness, b.thickness) for a, b in both])
        met &= bool(change.mean() <= MAX_HALF_CHANGE)
        cells |= {
            "RMS change, mean": float(change.mean()),
            "RMS change, worst": float(change.max()),
            "by sampling alone": float(np.mean([a.half_sampled for a, _ in both])),
        }
    cells["targets"] = f"{MAX_HALF_CHANGE:g}, {MAX_FLIPS:.0%}"
    return {**cells, "met": met}


def _four(change: Float, correlation: Float | list[float]) -> tuple[float, ...]:
    """Size of the change, mean and worst; correlation, median and worst."""
    size = np.abs(change)
    return tuple(map(float, (size.mean(), size.max(), np.median(correlation), np.min(correlation))))


_TEXT = """\
One spiral of 2.0 mm ± 15 % in voxels of 0.4 mm. First in random positions: the phantom moves and
the grid stays, so that every position gives other voxels. Motions are uniform over all rotations
with shifts of up to 20 mm, and, as subjects lie in a scanner, of up to 25° and 2 mm. Then the very
same voxels mirrored (a left hemisphere becomes a right one) and stored in another order.
"""

_UNCERTAINTY_TEXT = """\
`--uncertainty` measures perturbed copies of one segmentation and tells the SD at each point. A
phantom in many positions shows what it should be: its labels are perfect but for their voxels, so
copies that differ in the voxels alone should predict the SD over positions. By default, copies also
allow for boundaries that are drawn up to half a voxel away. These labels have no such errors, so
the SD is larger.
"""

_UNCERTAINTY_NOTES = """\
Poses: {poses}; of {copied} of them {copies} copies each were measured. SDs are root mean squares
over the sheet; the rank correlation is over the points of the sheet, and cannot be higher than two
halves of the poses allow, whose SDs are correlated as given. No number was fitted to phantoms.
Between thick slices a copy knows no more than the slices that it is made from, and predicts less.
"""

_SLICES_TEXT = """\
Labels in voxels of 0.3 mm are taken at the centers of voxels of 0.4 x 0.4 mm and 1 to 2 mm, as if
drawn on thick slices: across the long axis at four offsets, and tilted by 10° at two. The map is
compared with that of the same labels at full resolution, at the same nodes of the sheet.
Voxels of 0.4 mm throughout check that reference: what they change does not come from the slices.
Real labels are measured with `--labels`; phantoms have a wall that varies by 30 %.
"""

_NOTES = """\
Targets: size of the change of the mean thickness, mean / worst, mm, and correlation of the maps,
median / worst, flagged maps included; at least {share:.0%} accepted; and no accepted map may be off
by more than {accepted:g} mm.
By sampling alone: the same four numbers if the map at full resolution were known without error at
the slices and linear between them, constant beyond the last. No method that sees nothing but
the slices can do much better.
"""

_HALF_NOTES = """\
The same body in slices that were moved by half their distance: root mean square change of the map,
mm, and in how many pairs one map is handed out as sound and the other is not. Targets: mean change,
share of such pairs. By sampling alone: the change of the map at full resolution, known at these
slices only. Thick slices leave open where between two of them the body ends: that alone moves the
rows by up to half a slice at either end.
"""
