"""Thick slices: bodies are resliced, measured and compared with full resolution."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from nibabel.affines import from_matvec
from scipy.spatial.transform import Rotation

from hipsta_bids.geometry.body import extract_body
from hipsta_bids.phantom import PhantomSpec
from hipsta_bids.settings import Settings
from hipsta_bids.types import Decision, Float, HemisphereMaps, LabelVolume
from validation import cases
from validation.cases import Refusal, ValidationBody
from validation.report import Cell, Cells, Content, suite, table

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


_GROUP = ("bodies", "slices, mm", "tilt")


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One hemisphere in slices."""

    body: ValidationBody
    step: float
    """Distance of slices, mm."""
    offset: float
    tilt: float

    @property
    def group(self) -> tuple[str, str, str]:
        """What its rows are about: bodies, distance of slices in mm, and tilt."""
        kind = "phantoms" if isinstance(self.body, PhantomSpec) else "labels"
        return kind, f"{self.step:g}", f"{TILT if self.tilt else 0:g}°"


@dataclass(frozen=True, eq=False, kw_only=True)
class Outcome:
    """A map from slices beside the one at full resolution."""

    decision: str
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
    """Change of the mean and correlation if the map at full resolution were known at slices only,
    at three offsets of these."""

    @property
    def accepted(self) -> bool:
        """Whether the map was handed out as sound."""
        return self.decision == Decision.USE


@suite("slices")
def run(full: bool, labels: Path | None = None) -> Iterator[Content]:
    """Reslice bodies, segmentations of a dataset with fine voxels among them, and measure them."""
    steps = tuple(TARGETS) if full else (2.0,)
    ways = [(offset, 0.0) for offset in (OFFSETS if full else OFFSETS[::2])]
    ways += [(offset, TILT) for offset in (OFFSETS[::2] if full else OFFSETS[:1])]
    bodies: list[ValidationBody] = [
        *PHANTOMS[: None if full else 1],
        *cases.fine_segmentations(labels, PIXEL),
    ]
    trials = [
        Trial(body=body, step=step, offset=offset, tilt=tilt)
        for body in bodies
        for step, plan in ((PIXEL, (ways[0], ways[-1])), *((step, ways) for step in steps))
        for offset, tilt in plan
    ]
    results = cases.run_cases(measure_trial, trials)
    yield _table(trials, results)
    yield _half_table(trials, results)


def measure_trial(trial: Trial) -> Outcome:
    """Reslice a body, measure it and compare."""
    volume, hemi, reference = cases.measure_reference(trial.body, FULL_VOXEL)
    axis = extract_body(volume, Settings().body).ends.axis
    size = (PIXEL, PIXEL, trial.step)
    thick = reslice(volume, axis, size, offset=trial.offset, tilt=trial.tilt)
    return compare(cases.measure_body(thick, hemi), reference, trial.step)


def compare(maps: HemisphereMaps, reference: HemisphereMaps, step: float) -> Outcome:
    """Set a map from slices, ``step`` mm apart, beside the one at full resolution, node by node."""
    sampled = []
    for offset in SAMPLED_OFFSETS:
        map_ = _sampled_map(reference, step, offset + 0.5 / len(SAMPLED_OFFSETS))
        correlation = float(np.corrcoef(map_.ravel(), reference.thickness.ravel())[0, 1])
        sampled.append((float(map_.mean() - reference.thickness.mean()), correlation))
    both = np.isfinite(maps.thickness) & np.isfinite(reference.thickness)
    pair = maps.thickness[both], reference.thickness[both]
    return Outcome(
        decision=str(maps.decision),
        change=float(pair[0].mean() - pair[1].mean()),
        correlation=float(np.corrcoef(*pair)[0, 1]),
        thickness=maps.thickness,
        half_sampled=cases.rms(
            _sampled_map(reference, step, 0.0) - _sampled_map(reference, step, 0.5)
        ),
        sampled=tuple(sampled),
    )


def _sampled_map(reference: HemisphereMaps, step: float, offset: float) -> Float:
    """Thickness (Nx, Ny) known at slices only; linear between them, constant beyond the last."""
    thickness = reference.thickness
    length = float(reference.qc["body_length_mm"])
    rows = np.linspace(0.0, length, thickness.shape[1])
    levels = np.arange(offset * step, length, step)
    weights = np.array([np.interp(levels, rows, unit) for unit in np.eye(len(rows))])
    back = np.array([np.interp(rows, levels, unit) for unit in np.eye(len(levels))])
    return np.asarray(thickness @ weights @ back)


def slice_frame(axis: Float) -> Float:
    """Matrix (3, 3) of unit vectors in slices across an axis, and the axis."""
    aside = np.cross(axis, [0.0, 0.0, 1.0])
    aside /= np.linalg.norm(aside)
    return np.column_stack([aside, np.cross(axis, aside), axis])


def reslice(
    volume: LabelVolume,
    axis: Float,
    voxel_size: tuple[float, float, float],
    *,
    offset: float = 0.0,
    tilt: float = 0.0,
    aside: tuple[float, float] = (0.0, 0.0),
    points: tuple[int, int, int] = (1, 1, 1),
) -> LabelVolume:
    """Take the labels at the voxel centers of thick slices.

    ``axis`` is the unit vector (3,) across the slices; ``voxel_size`` is pixel, pixel and distance
    of slices, mm; ``offset`` is a fraction of that distance, ``aside`` of the pixels, ``tilt`` in
    degrees. With several ``points`` along its axes, a voxel gets the label of most of its points,
    and the share of points of each tissue.
    """
    turn = Rotation.from_euler("x", tilt, degrees=True).as_matrix()
    matrix = slice_frame(axis) @ turn * np.array(voxel_size)
    size = np.array(volume.tissue.shape) - 1
    corners = np.array(np.meshgrid(*([0, n] for n in size))).reshape(3, -1)
    corners = volume.affine[:3, :3] @ corners + volume.affine[:3, 3:]
    middle = corners.mean(axis=1)
    reach = np.linalg.solve(matrix, corners - middle[:, None])
    low = np.floor(reach.min(axis=1)) - 1
    shape = (np.ceil(reach.max(axis=1)) + 2 - low).astype(int)
    affine = from_matvec(matrix, middle + matrix @ (low + np.array([*aside, offset])))
    to_volume = np.linalg.inv(volume.affine) @ affine
    index = np.indices(shape).reshape(3, -1)
    places = (
        to_volume[:3, :3] @ (index + step[:, None]) + to_volume[:3, 3:]
        for step in steps_in_voxel(points)
    )
    return sample_labels(volume, places, shape, affine)


def steps_in_voxel(points: tuple[int, int, int]) -> Iterator[Float]:
    """Yield steps (3,) from the center of a voxel to points at even distances in it, voxels."""
    for step in product(*((np.arange(n) + 0.5) / n - 0.5 for n in points)):
        yield np.array(step)


def sample_labels(
    volume: LabelVolume, places: Iterable[Float], shape: Sequence[int], affine: Float
) -> LabelVolume:
    """Take labels at places (3, N), in voxels of the volume, one or more in each of N voxels.

    A voxel gets the label of most of its places and, of several, the share of each tissue.
    """
    size = np.array(volume.tissue.shape) - 1
    # Background, 0, is the first kind: that of points outside.
    codes = volume.tissue.astype(np.intp) + 256 * volume.part.astype(np.intp)
    kinds = np.union1d(0, codes)
    kind_of = np.searchsorted(kinds, codes)
    votes = np.zeros((len(kinds), int(np.prod(shape))), dtype=np.uint16)
    for place in places:
        nearest = np.rint(place).astype(int)
        inside = np.flatnonzero(((nearest >= 0) & (nearest <= size[:, None])).all(axis=0))
        kind = np.zeros(votes.shape[1], dtype=np.intp)
        kind[inside] = kind_of[tuple(nearest[:, inside])]
        votes[kind, np.arange(len(kind))] += 1
    part, tissue = np.divmod(kinds[votes.argmax(axis=0)].reshape(shape), 256)
    number = int(votes[:, 0].sum())
    return LabelVolume(
        tissue=tissue.astype(np.uint8),
        part=part.astype(np.uint8),
        affine=affine,
        protocol=volume.protocol,
        shares={
            int(each): (votes[kinds % 256 == each].sum(axis=0) / np.float32(number)).reshape(shape)
            for each in np.unique(kinds % 256)
            if number > 1
        },
    )


@table("slices.maps")
def _table(trials: Sequence[Trial], results: Sequence[Outcome | Refusal]) -> Iterator[Cells | str]:
    groups: dict[tuple[str, str, str], list[Outcome | Refusal]] = {}
    for trial, result in zip(trials, results, strict=True):
        groups.setdefault(trial.group, []).append(result)
    for key, group in groups.items():
        found = [result for result in group if isinstance(result, Outcome)]
        target = TARGETS.get(float(key[1]))
        accepted = max((abs(result.change) for result in found if result.accepted), default=0.0)
        met = bool(found) and accepted <= MAX_ACCEPTED
        cells: dict[str, Cell] = dict(zip(_GROUP, key, strict=True))
        cells |= {
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
        targets = "{:g} / {:g}, {:g} / {:g}".format(*target) if target else None
        yield {**cells, "targets": targets, "met": met}
    yield cases.refusal_notes(
        {
            f"{kind}, {step} mm, {'straight' if tilt == '0°' else 'tilted'}": group
            for (kind, step, tilt), group in groups.items()
        }
    )


@table("slices.half")
def _half_table(trials: Sequence[Trial], results: Sequence[Outcome | Refusal]) -> Iterator[Cells]:
    """Compare maps whose slices lie half their distance apart."""
    known = dict(zip(trials, results, strict=True))
    groups: dict[tuple[str, str, str], list[tuple[Outcome | Refusal, Outcome | Refusal]]] = {}
    for trial, first in known.items():
        second = known.get(replace(trial, offset=trial.offset + 0.5))
        if second is not None:
            groups.setdefault(trial.group, []).append((first, second))
    for key, pairs in groups.items():
        both = [(a, b) for a, b in pairs if isinstance(a, Outcome) and isinstance(b, Outcome)]
        sound = [[isinstance(r, Outcome) and r.accepted for r in pair] for pair in pairs]
        flips = sum(first != second for first, second in sound)
        cells: dict[str, Cell] = dict(zip(_GROUP, key, strict=True))
        cells |= {"pairs": len(pairs), "one accepted only": flips}
        met = bool(both) and flips <= MAX_FLIPS * len(pairs)
        if both:
            change = np.array([cases.rms(a.thickness - b.thickness) for a, b in both])
            met &= bool(change.mean() <= MAX_HALF_CHANGE)
            cells |= {
                "RMS change, mean": float(change.mean()),
                "RMS change, worst": float(change.max()),
                "by sampling alone": float(np.mean([a.half_sampled for a, _ in both])),
            }
        yield {**cells, "targets": f"{MAX_HALF_CHANGE:g}, {MAX_FLIPS:.0%}", "met": met}


def _four(change: Float, correlation: Float | list[float]) -> tuple[float, ...]:
    """Size of the change, mean and worst; correlation, median and worst."""
    size = np.abs(change)
    return tuple(map(float, (size.mean(), size.max(), np.median(correlation), np.min(correlation))))
