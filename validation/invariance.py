"""What may not change a map: where the subject lies, and how voxels are stored."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hipsta_bids.inputs.labels import read_label_volume
from hipsta_bids.inputs.search import HemisphereInput
from hipsta_bids.phantom import PhantomSpec
from hipsta_bids.types import Float, LabelVolume
from validation import cases
from validation.cases import MIRROR, Case, Measured, Refusal
from validation.report import Cell, Cells, Content, picture, show_map, suite, table

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

MAX_RMS = 0.03
"""mm, root mean square change of the map of a real hemisphere in another form."""
FINE = 0.6
"""mm; segmentations without a longer edge are measured."""

AXES = ("RAS", "PIR", "ASL")
"""Orders and directions of voxel axes that are compared with LIA."""

SPEC = PhantomSpec(kind="spiral", thickness=2.0, variation=0.15)

MOTIONS = {"any rotation": cases.random_motion, "up to 25° about each axis": cases.any_pose}


@suite("invariance")
def run(full: bool, labels: Path | None = None) -> Iterator[Content]:
    """Measure a phantom in many positions, and equal voxels, also real ones, in another form."""
    count, pairs = (MOTIONS_FULL, PAIRS_FULL) if full else (MOTIONS_QUICK, PAIRS_QUICK)
    drawings = {}
    for number, (name, motion) in enumerate(MOTIONS.items()):
        generator = np.random.default_rng((SEED, number))
        drawings[name] = [Case(spec=SPEC, pose=motion(generator)) for _ in range(count)]
    results = cases.run_groups(
        cases.measure_case, drawings | {f"pair {n}": _pair(n) for n in range(pairs)}
    )
    motions = {name: results[name] for name in MOTIONS}
    real = cases.fine_segmentations(labels, FINE) if labels else []
    real = real if full else real[:1]
    yield _motion_table(motions)
    yield _pair_table([results[f"pair {number}"] for number in range(pairs)])
    if labels:
        yield _real_table(cases.run_cases(measure_forms, real))
    yield _picture(motions)
    yield cases.left_out(labels)


def _pair(number: int) -> list[Case]:
    """Cases of one pose: as it is, mirrored, and with other voxel axes."""
    pose = cases.any_pose(np.random.default_rng((SEED, 100, number)))
    return [
        Case(spec=SPEC, pose=pose),
        Case(spec=SPEC, pose=pose, mirrored=True),
        *(Case(spec=SPEC, pose=pose, axes=axes) for axes in AXES),
    ]


def measure_forms(item: HemisphereInput) -> tuple[float, float]:
    """RMS change of a segmentation's map, mm: as its mirror image, and stored in another order."""
    volume = read_label_volume(item)
    flip = np.diag([-1.0, -1.0, -1.0, 1.0])
    flip[:3, 3] = np.array(volume.tissue.shape) - 1
    order = np.eye(4)[[1, 2, 0, 3]]  # the old index of a new one: new axes are 1, 2 and 0
    tissue, part = (np.flip(v).transpose(1, 2, 0) for v in (volume.tissue, volume.part))
    stored = LabelVolume(
        tissue=tissue,
        part=part,
        affine=volume.affine @ flip @ order.T,
        protocol=volume.protocol,
    )
    mirrored = replace(volume, affine=MIRROR @ volume.affine)
    reference = cases.measure_body(volume, item.hemi).thickness
    other = "LR"[item.hemi == "L"]
    maps = (
        cases.measure_body(mirrored, other).thickness,
        cases.measure_body(stored, item.hemi).thickness,
    )
    first, second = (cases.rms(map_ - reference) for map_ in maps)
    return first, second


@table("invariance.real")
def _real_table(results: Sequence[tuple[float, float] | Refusal]) -> Iterator[Cells | str]:
    measured = [result for result in results if not isinstance(result, Refusal)]
    for column, form in enumerate(("mirror image", "voxels in another order")):
        change = np.array([result[column] for result in measured] or [np.nan])
        met = len(measured) == len(results) and bool(change.max() <= MAX_RMS)
        yield {
            "form": form,
            "hemispheres": len(results),
            "RMS, mean": f"{change.mean():.5f}",
            "RMS, largest": f"{change.max():.5f}",
            "target, largest": f"≤ {MAX_RMS:g}",
            "met": met,
        }
    yield cases.refusal_notes({"labels": results})


def _maps(group: Sequence[Measured | Refusal]) -> Float | None:
    """Thickness (M, Nx, Ny) of what was measured; None for less than two maps."""
    maps = [m.thickness for m in group if isinstance(m, Measured)]
    return np.array(maps) if len(maps) > 1 else None


@table("invariance.motions")
def _motion_table(motions: Mapping[str, Sequence[Measured | Refusal]]) -> Iterator[Cells]:
    for name, group in motions.items():
        maps = _maps(group)
        refused = sum(isinstance(m, Refusal) for m in group)
        cells: dict[str, Cell] = {"motions": name, "number": len(group), "refused": refused}
        good = False
        if maps is not None:
            of_mean = float(maps.mean(axis=(1, 2)).std(ddof=1))
            at_points = maps.std(axis=0, ddof=1)
            overall = cases.rms(at_points)
            good = of_mean <= MAX_SD_OF_MEAN and overall <= MAX_POINTWISE_SD and not refused
            cells |= {
                "SD of the mean": of_mean,
                "SD of a point (RMS)": overall,
                "median": float(np.median(at_points)),
                "95th percentile": float(np.quantile(at_points, 0.95)),
            }
        targets = (f"≤ {MAX_SD_OF_MEAN:g}", f"≤ {MAX_POINTWISE_SD:g}")
        yield {**cells, "target, mean": targets[0], "target, point": targets[1], "met": good}


@table("invariance.forms")
def _pair_table(pairs: Sequence[Sequence[Measured | Refusal]]) -> Iterator[Cells | str]:
    for column, name in enumerate(("mirror image", *(f"voxel axes {axes}" for axes in AXES)), 1):
        cells: dict[str, Cell] = {
            "form": name,
            "mean": None,
            "mean absolute": None,
            "largest": None,
        }
        both = [(pair[0], pair[column]) for pair in pairs]
        changes = [
            b.thickness - a.thickness
            for a, b in both
            if isinstance(a, Measured) and isinstance(b, Measured)
        ]
        met = False
        if len(changes) == len(pairs):
            size = np.abs(changes)
            met = bool(size.mean() <= MAX_CHANGE)
            cells |= {"mean": f"{np.mean(changes):+.5f}", "mean absolute": f"{size.mean():.5f}"}
            cells["largest"] = f"{size.max():.5f}"
        yield {**cells, "target, mean absolute": f"≤ {MAX_CHANGE:g}", "met": met}
    yield f"Number of poses: {len(pairs)}."


@picture("invariance")
def _picture(figure: "Figure", motions: Mapping[str, Sequence[Measured | Refusal]]) -> None:
    found = {name: maps for name, group in motions.items() if (maps := _maps(group)) is not None}
    axes = figure.subplots(1, max(1, len(found)), squeeze=False)[0]
    for axis, (name, maps) in zip(axes, found.items(), strict=False):
        spread = maps.std(axis=0, ddof=1)
        image = show_map(axis, spread, name, cmap="viridis", vmin=0, vmax=0.1)
        figure.colorbar(image, ax=axis, label="SD, mm")
