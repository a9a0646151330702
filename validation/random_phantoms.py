"""Thickness of phantoms that are drawn at random, on which no default was chosen."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from hipsta_bids.errors import SettingsError
from hipsta_bids.phantom import KINDS, Phantom, PhantomSpec
from hipsta_bids.types import Decision
from validation import cases
from validation.cases import Case, Measured, Refusal
from validation.report import Cell, Cells, Content, suite, table

SEED = 20261
NUMBER_QUICK, NUMBER_FULL = 3, 40
TILT = 10.0
"""Degrees by which slices may be tilted."""
#: Targets by voxels, mm: largest size of the mean bias, and SD over the grid. They are the widest
#: of the suite of chosen phantoms, and were set before the first run.
TARGETS = {"fine": (0.02, 0.05), "thick": (0.03, 0.09)}
#: Ranges from which each number is drawn evenly.
THICKNESS, VARIATION = (1.2, 2.6), (0.0, 0.3)
WIDTH, LENGTH, BEND = (16.0, 24.0), (14.0, 24.0), (-0.03, 0.03)
FINE, IN_PLANE, SLICES = (0.3, 0.5), (0.35, 0.5), (1.0, 2.0)

Results = Mapping[str, Sequence[tuple[Case, Measured | Refusal]]]


def draw(voxels: str, number: int, *, seed: int = SEED) -> Case:
    """Draw a shape, voxels and a position; a shape that cannot exist is drawn again."""
    generator = np.random.default_rng((seed, list(TARGETS).index(voxels), number))
    while True:
        spec = PhantomSpec(
            kind=str(generator.choice(list(KINDS))),
            thickness=float(generator.uniform(*THICKNESS)),
            variation=float(generator.uniform(*VARIATION)),
            variation_axis=str(generator.choice(["x", "y", "xy"])),
            width=float(generator.uniform(*WIDTH)),
            length=float(generator.uniform(*LENGTH)),
            bend=float(generator.uniform(*BEND)),
        )
        try:
            Phantom(spec)
        except SettingsError:
            continue
        break
    if voxels == "fine":
        pose = cases.any_pose(generator)
        return Case(spec=spec, voxel_size=(float(generator.uniform(*FINE)),) * 3, pose=pose)
    pose, turn = cases.along_slices(generator, tilt=float(generator.uniform(0.0, TILT)))
    plane = float(generator.uniform(*IN_PLANE))
    size = (plane, plane, float(generator.uniform(*SLICES)))
    return Case(spec=spec, voxel_size=size, pose=pose, grid_rotation=turn)


@suite("random")
def run(full: bool) -> Iterator[Content]:
    """Measure each phantom once."""
    number = NUMBER_FULL if full else NUMBER_QUICK
    drawn = {voxels: [draw(voxels, k) for k in range(number)] for voxels in TARGETS}
    measured = cases.run_groups(cases.measure_case, drawn)
    results = {name: list(zip(drawn[name], measured[name], strict=True)) for name in drawn}
    yield _summary(results)
    yield _phantoms(results)


@table("random.summary")
def _summary(results: Results) -> Iterator[Cells | str]:
    for voxels, group in results.items():
        errors = [m.error for _, m in group if isinstance(m, Measured)]
        decisions = [m.decision for _, m in group if isinstance(m, Measured)]
        bias = np.array([float(np.nanmean(error)) for error in errors] or [np.nan])
        spread = np.array([float(np.nanstd(error)) for error in errors] or [np.nan])
        most, largest = TARGETS[voxels]
        yield {
            "voxels": voxels,
            "phantoms": len(group),
            "refused": len(group) - len(errors),
            "flagged": decisions.count(Decision.LOOK),
            "bias": f"{bias.mean():+.3f}",
            "bias, largest": float(np.abs(bias).max()),
            "SD": cases.rms(spread),
            "SD, largest": float(spread.max()),
            "target |bias|": f"≤ {most:g}",
            "target SD": f"≤ {largest:g}",
            "met": bool(abs(bias.mean()) <= most and cases.rms(spread) <= largest),
        }
    yield cases.refusal_notes({name: [m for _, m in group] for name, group in results.items()})


@table("random.phantoms")
def _phantoms(results: Results) -> Iterator[Cells]:
    for group in results.values():
        for case, result in group:
            spec = case.spec
            shape: dict[str, Cell] = {
                "kind": spec.kind,
                "thickness, mm": spec.thickness,
                "variation": f"{spec.variation:.0%} along {spec.variation_axis}",
                "width, mm": f"{spec.width:.1f}",
                "length, mm": f"{spec.length:.1f}",
                "bend, 1/mm": spec.bend,
                "voxels, mm": " x ".join(f"{size:.2f}" for size in case.voxel_size),
            }
            if isinstance(result, Refusal):
                yield {**shape, "decision": result.reason, "bias": None, "SD": None, "flags": ""}
            else:
                yield {
                    **shape,
                    "decision": result.decision,
                    "bias": f"{np.nanmean(result.error):+.3f}",
                    "SD": float(np.nanstd(result.error)),
                    "flags": ", ".join(result.flags),
                }
