"""What may not change a map: where the subject lies, how voxels are stored, and mirroring."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hipsta_bids.geometry.body import extract_body
from hipsta_bids.phantom import PhantomSpec
from hipsta_bids.settings import Settings
from hipsta_bids.types import Float, HemisphereMaps, LabelVolume, Status
from hipsta_bids.validation.cases import (
    Case,
    Measured,
    Refusal,
    ValidationBody,
    any_pose,
    fine_segmentations,
    load_body,
    measure_body,
    measure_case,
    random_motion,
    reslice,
    run_cases,
)
from hipsta_bids.validation.report import Cell, Picture, Suite, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure


SEED = 20232
MOTIONS_QUICK, MOTIONS_FULL = 6, 20
PAIRS_QUICK, PAIRS_FULL = 1, 4

MAX_SD_OF_MEAN = 0.01
"""mm, of the mean thickness over rigid motions."""
MAX_POINTWISE_SD = 0.05
"""mm, root mean square over the sheet of the SD of a point."""
MAX_CHANGE = 0.02
"""mm, mean absolute change where the voxels are the same and only their form is another."""

AXES = ("RAS", "PIR", "ASL")
"""Orders and directions of voxel axes that are compared with LIA."""

SPEC = PhantomSpec(kind="spiral", thickness=2.0, variation=0.15)


@dataclass(frozen=True, eq=False, kw_only=True)
class Motions:
    """Maps of one phantom in many positions."""

    thickness: Float
    """(M, Nx, Ny) mm."""

    @property
    def pointwise(self) -> Float:
        """SD over the motions at each point, (Nx, Ny) mm."""
        return np.asarray(self.thickness.std(axis=0, ddof=1))


def run(full: bool) -> Suite:
    """Measure one phantom in many positions, and pairs of equal voxels in different form."""
    count = MOTIONS_FULL if full else MOTIONS_QUICK
    pairs = PAIRS_FULL if full else PAIRS_QUICK
    kinds = {"any rotation": random_motion, "up to 25° about each axis": any_pose}
    cases: list[Case] = []
    for number, pose in enumerate(kinds.values()):
        generator = np.random.default_rng((SEED, number))
        cases += [Case(spec=SPEC, pose=pose(generator)) for _ in range(count)]
    first = len(cases)
    per_pair = 2 + len(AXES)
    for number in range(pairs):
        cases += _pair(number)
    results = run_cases(measure_case, cases)
    groups = {name: results[i * count : (i + 1) * count] for i, name in enumerate(kinds)}
    motions = {name: _motions(group) for name, group in groups.items()}
    same = [results[first + i * per_pair : first + (i + 1) * per_pair] for i in range(pairs)]
    return Suite(
        name="invariance",
        title="Invariance",
        text=_TEXT,
        tables=(_motion_table(groups, motions), _pair_table(same)),
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


def _motions(group: Sequence[Measured | Refusal]) -> Motions | None:
    maps = [m.thickness for m in group if isinstance(m, Measured)]
    return Motions(thickness=np.array(maps)) if len(maps) > 1 else None


def _motion_table(
    groups: dict[str, list[Measured | Refusal]], motions: dict[str, Motions | None]
) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for name, group in groups.items():
        found = motions[name]
        refused = sum(isinstance(m, Refusal) for m in group)
        if found is None:
            rows.append((name, len(group), refused, *(None,) * 6, False))
            continue
        of_mean = float(found.thickness.mean(axis=(1, 2)).std(ddof=1))
        overall = float(np.sqrt((found.pointwise**2).mean()))
        good = of_mean <= MAX_SD_OF_MEAN and overall <= MAX_POINTWISE_SD and not refused
        rows.append(
            (
                name,
                len(group),
                refused,
                of_mean,
                overall,
                float(np.median(found.pointwise)),
                float(np.quantile(found.pointwise, 0.95)),
                f"≤ {MAX_SD_OF_MEAN:g}",
                f"≤ {MAX_POINTWISE_SD:g}",
                good,
            )
        )
    return Table(
        title="One phantom in many positions, mm",
        columns=(
            "motions",
            "number",
            "refused",
            "SD of the mean",
            "SD of a point (RMS)",
            "median",
            "95th percentile",
            "target, mean",
            "target, point",
            "met",
        ),
        rows=tuple(rows),
        digits=4,
        notes="A point is a node of the sheet's grid; the SD is over the motions.",
    )


def _pair_table(pairs: Sequence[Sequence[Measured | Refusal]]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for column, name in enumerate(("mirror image", *(f"voxel axes {axes}" for axes in AXES)), 1):
        both = [(pair[0], pair[column]) for pair in pairs]
        changes = [
            b.thickness - a.thickness
            for a, b in both
            if isinstance(a, Measured) and isinstance(b, Measured)
        ]
        if len(changes) < len(both):
            rows.append((name, None, None, None, f"≤ {MAX_CHANGE:g}", False))
            continue
        absolute = np.abs(changes)
        rows.append(
            (
                name,
                f"{np.mean(changes):+.5f}",
                f"{absolute.mean():.5f}",
                f"{absolute.max():.5f}",
                f"≤ {MAX_CHANGE:g}",
                bool(absolute.mean() <= MAX_CHANGE),
            )
        )
    return Table(
        title="The same voxels in another form: change of thickness, mm",
        columns=("form", "mean", "mean absolute", "largest", "target, mean absolute", "met"),
        rows=tuple(rows),
        notes=f"Number of poses: {len(pairs)}.",
    )


def _picture(motions: dict[str, Motions | None]) -> Picture:
    found = {name: motion for name, motion in motions.items() if motion is not None}

    def draw(figure: "Figure") -> None:
        axes = figure.subplots(1, max(1, len(found)), squeeze=False)[0]
        for axis, (name, motion) in zip(axes, found.items(), strict=False):
            image = axis.imshow(
                motion.pointwise.T, origin="lower", cmap="viridis", vmin=0, vmax=0.1, aspect="auto"
            )
            axis.set_title(name)
            shape = motion.pointwise.shape
            axis.set_xticks([0, shape[0] - 1], ["medial", "lateral"])
            axis.set_yticks([0, shape[1] - 1], ["posterior", "anterior"])
            figure.colorbar(image, ax=axis, label="SD, mm")

    return Picture(
        name="invariance",
        caption="SD of thickness over the motions at each point of the sheet, mm.",
        draw=draw,
        size=(9.0, 3.2),
    )


_TEXT = """\
One spiral of 2.0 mm ± 15 % in voxels of 0.4 mm. First in random positions: the phantom moves and
the grid stays, so that every position gives other voxels. Motions are uniform over all rotations
with shifts of up to 20 mm, and, as subjects lie in a scanner, of up to 25° and 2 mm. Then the very
same voxels mirrored (a left hemisphere becomes a right one) and stored in another order.
"""


# Thick slices: maps of resliced bodies against those of the same bodies at full resolution.


PIXEL = 0.4
"""mm."""
FULL_VOXEL = 0.3
"""mm, of phantoms at full resolution."""
TILT = 10.0
"""Degrees."""
OFFSETS = (0.0, 1 / 3, 2 / 3)
"""Of slices, fractions of their distance."""
MAX_ACCEPTED = 0.15
"""mm; no map that is handed out as sound may be off by more in the mean."""

#: Distance of slices, mm: |difference of the mean thickness|, mean and worst, mm; map correlation,
#: median and worst.
TARGETS = {
    1.0: (0.015, 0.04, 0.87, 0.75),
    1.5: (0.02, 0.06, 0.83, 0.72),
    2.0: (0.03, 0.08, 0.80, 0.62),
}

PHANTOMS = (
    PhantomSpec(kind="spiral", thickness=2.0, variation=0.3),
    PhantomSpec(kind="tight", thickness=1.6, variation=0.3),
    PhantomSpec(kind="arc", thickness=1.4, variation=0.3),
)


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
    sampled: tuple[tuple[float, float], ...]
    """The same two numbers for the map at full resolution, known at slices only."""

    @property
    def accepted(self) -> bool:
        """Whether the map was handed out as sound."""
        return self.status in (Status.OK, Status.REPAIRED)


def run_slices(full: bool, labels: Path | None = None) -> Suite:
    """Reslice bodies and measure them.

    ``labels`` A BIDS dataset with segmentations in voxels of about 0.3 mm to be resliced too.
    """
    steps = tuple(TARGETS) if full else (2.0,)
    ways = [(offset, 0.0) for offset in (OFFSETS if full else OFFSETS[:1])] + [(OFFSETS[1], TILT)]
    bodies: list[ValidationBody] = list(PHANTOMS if full else PHANTOMS[:1])
    if labels is not None:
        bodies += fine_segmentations(labels, PIXEL)
    trials = [
        Trial(body=body, step=step, offset=offset, tilt=tilt)
        for body in bodies
        for step, plan in ((PIXEL, ways[-2:]), *((step, ways) for step in steps))
        for offset, tilt in plan
    ]
    results = run_cases(measure_trial, trials)
    return Suite(
        name="slices",
        title="Thick slices",
        text=_SLICES_TEXT,
        tables=(_table(trials, results),),
    )


def measure_trial(trial: Trial) -> Outcome:
    """Reslice a body, measure it and compare."""
    volume, hemi, reference = _full(trial.body)
    axis = extract_body(volume, Settings().body).ends.axis
    size = (PIXEL, PIXEL, trial.step)
    thick = reslice(volume, axis, size, offset=trial.offset, tilt=trial.tilt)
    return compare(measure_body(thick, hemi), reference, trial.step)


def compare(maps: HemisphereMaps, reference: HemisphereMaps, step: float) -> Outcome:
    """Set a map beside the one at full resolution, node by node.

    ``step`` Distance of slices, mm.
    """
    both = np.isfinite(maps.thickness) & np.isfinite(reference.thickness)
    pair = maps.thickness[both], reference.thickness[both]
    return Outcome(
        status=str(maps.status),
        change=float(pair[0].mean() - pair[1].mean()),
        correlation=float(np.corrcoef(*pair)[0, 1]),
        sampled=_sampled(reference, step),
    )


def _sampled(reference: HemisphereMaps, step: float) -> tuple[tuple[float, float], ...]:
    """Change of the mean and correlation if the map itself were known at slices only.

    At three offsets; linear between the slices, constant beyond the last.
    """
    thickness = reference.thickness
    length = float(reference.qc["body_length_mm"])
    rows = np.linspace(0.0, length, thickness.shape[1])
    found = []
    for offset in OFFSETS:
        levels = np.arange((offset + 0.5 / len(OFFSETS)) * step, length, step)
        weights = np.array([np.interp(levels, rows, unit) for unit in np.eye(len(rows))])
        back = np.array([np.interp(rows, levels, unit) for unit in np.eye(len(levels))])
        blurred = thickness @ weights @ back
        correlation = float(np.corrcoef(blurred.ravel(), thickness.ravel())[0, 1])
        found.append((float(blurred.mean() - thickness.mean()), correlation))
    return tuple(found)


@lru_cache(maxsize=2)
def _full(body: ValidationBody) -> tuple[LabelVolume, str, HemisphereMaps]:
    """Labels at full resolution, the hemisphere and its maps; the cases of a body are together."""
    volume, hemi = load_body(body, FULL_VOXEL)
    return volume, hemi, measure_body(volume, hemi)


def _table(trials: Sequence[Trial], results: Sequence[Outcome | Refusal]) -> Table:
    groups: dict[tuple[str, float, bool], list[Outcome | Refusal]] = {}
    for trial, result in zip(trials, results, strict=True):
        kind = "phantoms" if isinstance(trial.body, PhantomSpec) else "labels"
        groups.setdefault((kind, trial.step, trial.tilt > 0), []).append(result)
    return Table(
        title="Maps from slices beside those at full resolution",
        columns=(
            "bodies",
            "slices, mm",
            "tilt",
            "number",
            "refused",
            "flagged",
            "change of mean, mm",
            "size of change, mean",
            "worst",
            "worst of accepted",
            "correlation, median",
            "worst",
            "by sampling alone",
            "targets",
            "met",
        ),
        rows=tuple(_row(key, group) for key, group in groups.items()),
        notes=_NOTES.format(accepted=MAX_ACCEPTED) + _refusals(groups),
    )


def _row(key: tuple[str, float, bool], group: Sequence[Outcome | Refusal]) -> tuple[Cell, ...]:
    kind, step, tilted = key
    found = [result for result in group if isinstance(result, Outcome)]
    start: tuple[Cell, ...] = (
        kind,
        f"{step:g}",
        f"{TILT if tilted else 0:g}°",
        len(group),
        len(group) - len(found),
        sum(not result.accepted for result in found),
    )
    target = TARGETS.get(step)
    aim = "{:g} / {:g}, {:g} / {:g}".format(*target) if target else None
    if not found:
        return (*start, *(None,) * 7, aim, False)
    change = np.array([result.change for result in found])
    correlation = np.array([result.correlation for result in found])
    accepted = max((abs(result.change) for result in found if result.accepted), default=0.0)
    lost, kept = np.array([sample for result in found for sample in result.sampled]).T
    sizes = (float(np.abs(change).mean()), float(np.abs(change).max()))
    likeness = (float(np.median(correlation)), float(correlation.min()))
    four = (np.abs(lost).mean(), np.abs(lost).max(), np.median(kept), kept.min())
    sampling = "{:.3f} / {:.3f}, {:.2f} / {:.2f}".format(*four)
    met = accepted <= MAX_ACCEPTED
    if target:
        met = met and sizes[0] <= target[0] and sizes[1] <= target[1]
        met = met and likeness[0] >= target[2] and likeness[1] >= target[3]
    return (
        *start,
        f"{change.mean():+.3f}",
        *sizes,
        accepted,
        *likeness,
        sampling,
        aim,
        bool(met),
    )


def _refusals(groups: Mapping[tuple[str, float, bool], Sequence[Outcome | Refusal]]) -> str:
    """Say why maps are missing; bullets of Markdown, or nothing."""
    lines = [
        f"- {kind}, {step:g} mm, {'tilted' if tilted else 'straight'}: {result}"
        for (kind, step, tilted), group in groups.items()
        for result in group
        if isinstance(result, Refusal)
    ]
    return "\n".join(["\nRefused:\n", *lines]) if lines else ""


_SLICES_TEXT = """\
Labels in voxels of 0.3 mm are taken at the centers of voxels of 0.4 x 0.4 mm and 1 to 2 mm, as if
drawn on thick slices: across the long axis at three offsets, and once tilted by 10° from there. The
map is compared with that of the same labels at full resolution, at the same nodes of the sheet.
Voxels of 0.4 mm throughout check that reference: what they change does not come from the slices.
Real labels are measured with `--labels`; phantoms have a wall that varies by 30 %.
"""

_NOTES = """\
Targets: size of the change of the mean thickness, mean / worst, mm, and correlation of the maps,
median / worst, flagged maps included; and no accepted map may be off by more than {accepted:g} mm.
By sampling alone: the same four numbers if the map at full resolution were known without error at
the slices and linear between them, constant beyond the last. No method that sees nothing but
the slices can do much better.
"""
