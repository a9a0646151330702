"""Thick slices: maps of resliced bodies against those of the same bodies at full resolution."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from hipsta_bids.artifacts import HemisphereMaps, LabelVolume, Status
from hipsta_bids.geometry.body import extract_body
from hipsta_bids.phantom import PhantomSpec
from hipsta_bids.settings import Settings
from hipsta_bids.validation.bodies import (
    ValidationBody,
    fine_segmentations,
    load_body,
    measure_body,
)
from hipsta_bids.validation.reslice import reslice
from hipsta_bids.validation.suite import Cell, Suite, Table
from hipsta_bids.validation.workers import Refusal, run_cases

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


def run(full: bool, labels: Path | None = None) -> Suite:
    """Reslice bodies and measure them.

    Parameters
    ----------
    full : bool
        All slice distances, offsets and phantoms instead of one each.
    labels : Path, optional
        A BIDS dataset with segmentations in voxels of about 0.3 mm to be resliced too.

    Returns
    -------
    Suite
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
        text=_TEXT,
        tables=(_table(trials, results),),
    )


def measure_trial(trial: Trial) -> Outcome:
    """Reslice a body, measure it and compare.

    Raises
    ------
    GeometryError
        If the package refuses the slices.
    """
    volume, hemi, reference = _full(trial.body)
    axis = extract_body(volume, Settings().body).ends.axis
    size = (PIXEL, PIXEL, trial.step)
    thick = reslice(volume, axis, size, offset=trial.offset, tilt=trial.tilt)
    return compare(measure_body(thick, hemi), reference, trial.step)


def compare(maps: HemisphereMaps, reference: HemisphereMaps, step: float) -> Outcome:
    """Set a map beside the one at full resolution, node by node.

    Parameters
    ----------
    maps, reference : HemisphereMaps
    step : float
        Distance of slices, mm.

    Returns
    -------
    Outcome
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


_TEXT = """\
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
