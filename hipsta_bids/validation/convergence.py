"""How fast the error falls with the voxel size."""

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from hipsta_bids.phantom import PhantomSpec
from hipsta_bids.settings import GridSettings
from hipsta_bids.types import Float
from hipsta_bids.validation.cases import (
    EDGE,
    Case,
    Measured,
    Refusal,
    any_pose,
    measure_case,
    run_cases,
    without_edges,
)
from hipsta_bids.validation.report import Cell, Picture, Suite, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure


SEED = 20231
SIZES = (0.6, 0.5, 0.4, 0.3)
"""mm, isotropic voxels."""
POSES_QUICK, POSES_FULL = 2, 8

#: Working grid in mm for each voxel size: as it is by default, or always as fine as by default
#: for voxels of 0.4 mm.
GRIDS: Mapping[str, float | None] = {
    "default grid": None,
    "grid in proportion": GridSettings().spacing / 0.4,
}

SPECS = {
    "spiral 2.0 mm": PhantomSpec(kind="spiral", thickness=2.0, length=12.0),
    "spiral 2.0 mm, ±20%": PhantomSpec(kind="spiral", thickness=2.0, length=12.0, variation=0.2),
}

WHOLE = "whole"

#: Parts of the sheet whose error is followed.
ZONES: Mapping[str, Callable[[Float], Float]] = {
    WHOLE: lambda error: error,
    "without edges": without_edges,
}

Key = tuple[str, str]


def run(full: bool) -> Suite:
    """Measure the same phantoms in ever smaller voxels."""
    poses = POSES_FULL if full else POSES_QUICK
    names = list(SPECS) if full else list(SPECS)[:1]
    keys = [(name, grid) for name in names for grid in GRIDS]
    cases = [_case(key, size, pose) for key in keys for size in SIZES for pose in range(poses)]
    results = run_cases(measure_case, cases)
    table: dict[Key, list[list[Measured | Refusal]]] = {}
    for number, key in enumerate(keys):
        start = number * len(SIZES) * poses
        table[key] = [
            results[start + i * poses : start + (i + 1) * poses] for i in range(len(SIZES))
        ]
    errors = {key: [_errors(group) for group in groups] for key, groups in table.items()}
    return Suite(
        name="convergence",
        title="Convergence with voxel size",
        text=_TEXT.format(poses=poses),
        tables=(_table(errors),),
        pictures=(_picture(errors),),
    )


def rate(sizes: Sequence[float], errors: Sequence[float]) -> tuple[float, float]:
    """Fit ``error = constant * size ** rate`` by least squares in the logarithms.

    Returns The standard error is NaN for two sizes.
    """
    x, y = np.log(sizes), np.log(errors)
    design = np.column_stack([x, np.ones_like(x)])
    solution, *_ = np.linalg.lstsq(design, y, rcond=None)
    freedom = len(x) - 2
    residual = y - design @ solution
    variance = float(residual @ residual) / freedom if freedom else np.nan
    return float(solution[0]), float(np.sqrt(variance / ((x - x.mean()) ** 2).sum()))


def _case(key: Key, size: float, pose: int) -> Case:
    name, grid = key
    step = GRIDS[grid]
    # Seeded by the pose alone: all sizes and grids see the same poses.
    return Case(
        spec=SPECS[name],
        voxel_size=(size, size, size),
        pose=any_pose(np.random.default_rng((SEED, pose))),
        spacing=None if step is None else step * size,
    )


def _errors(group: Sequence[Measured | Refusal]) -> dict[str, float]:
    """Average over the poses: bias, and root mean square with and without edges, mm."""
    errors = [m.error for m in group if isinstance(m, Measured)]
    if not errors:
        return dict.fromkeys(("bias", *ZONES), float("nan"))
    squares = {zone: [np.nanmean(take(e) ** 2) for e in errors] for zone, take in ZONES.items()}
    return {
        "bias": float(np.mean([np.nanmean(e) for e in errors])),
        **{zone: float(np.sqrt(np.mean(values))) for zone, values in squares.items()},
    }


def _table(errors: Mapping[Key, Sequence[Mapping[str, float]]]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for (name, grid), values in errors.items():
        for zone in ZONES:
            rms = [value[zone] for value in values]
            slope, doubt = rate(SIZES, rms)
            falls = all(finer < coarser for coarser, finer in pairwise(rms))
            bias = [f"{v['bias']:+.3f} / " if zone == WHOLE else "" for v in values]
            rows.append(
                (
                    name,
                    grid,
                    zone,
                    *(f"{b}{r:.3f}" for b, r in zip(bias, rms, strict=True)),
                    f"{slope:.2f} ± {doubt:.2f}",
                    "falls",
                    bool(falls),
                )
            )
    return Table(
        title="Bias / root mean square error of thickness, mm, by voxel size",
        columns=(
            "phantom",
            "working grid",
            "part",
            *(f"{size:g} mm" for size in SIZES),
            "rate",
            "target",
            "met",
        ),
        rows=tuple(rows),
        notes=_NOTES.format(edge=EDGE),
    )


def _picture(errors: Mapping[Key, Sequence[Mapping[str, float]]]) -> Picture:
    def draw(figure: "Figure") -> None:
        axis = figure.subplots()
        colors = {name: f"C{number}" for number, name in enumerate(SPECS)}
        for (name, grid), values in errors.items():
            style = "o-" if GRIDS[grid] is None else "s--"
            for zone, alpha in zip(ZONES, (1.0, 0.45), strict=True):
                rms, label = [v[zone] for v in values], f"{name}, {grid}, {zone}"
                axis.loglog(SIZES, rms, style, color=colors[name], alpha=alpha, label=label)
        reach = np.array([min(SIZES), max(SIZES)])
        start = min(v[zone] for values in errors.values() for v in values for zone in ZONES)
        axis.loglog(reach, 0.8 * start * reach / reach[0], color="0.6", label="rate 1")
        axis.set_xticks(SIZES, [f"{size:g}" for size in SIZES])
        axis.minorticks_off()
        axis.set_yticks(ticks := [0.03, 0.04, 0.06, 0.08, 0.12], [f"{t:g}" for t in ticks])
        axis.set_xlabel("voxel size, mm")
        axis.set_ylabel("RMS error of thickness, mm")
        axis.legend(fontsize="small", loc="center left", bbox_to_anchor=(1.02, 0.5))

    return Picture(
        name="convergence",
        caption="Root mean square error of thickness over the whole grid against voxel size;"
        " the gray line falls in proportion. Pale: without edges.",
        draw=draw,
        size=(9.0, 4.2),
    )


_TEXT = """\
The same phantoms in voxels of 0.6 to 0.3 mm, averaged over poses (here {poses}) that are the
same at every size. Once with the default working grid, which does not follow the voxels, and once
with a grid in proportion to them.
"""

_NOTES = """\
The rate is the slope of log error against log voxel size by least squares, ± its standard error.
Labels drawn at voxel centers put the wall off by up to half a voxel at random; where smoothing and
grid are proportional to the voxels, this averages out alike at every size, so the rate to expect is
about 1. Bias may pass through zero and has no rate. Without edges: without the {edge} outer nodes
on each side. Single poses differ by half: where a wall is almost parallel to a layer of voxels, its
steps lie too far apart for the smoothing to remove them, and show as waves of up to 0.2 mm.
The target is that each smaller voxel size has a smaller error.
"""


# Sheets too thin for their voxels: refused or flagged, never silently wrong.


LIMITS_SEED = 20233
MAX_SILENT_ERROR = 0.15
"""mm; where the mean is farther off, the hemisphere has to be refused or flagged."""


def run_limits(full: bool) -> Suite:
    """Measure ever thinner sheets in ever larger voxels."""
    cases = _cases(full=full)
    return Suite(
        name="limits",
        title="Limits",
        text="Spirals, isotropic voxels, one pose each.",
        tables=(_limits_table(cases, run_cases(measure_case, cases)),),
    )


def _cases(*, full: bool) -> list[Case]:
    """Go from comfortable to far too thin."""
    sizes = (0.4, 0.6, 0.8, 1.0) if full else (0.5, 1.0)
    walls = (0.8, 1.2, 1.6, 3.0) if full else (0.8, 1.6)
    return [
        Case(
            spec=PhantomSpec(kind="spiral", thickness=wall, curvature=(0.02, 0.35)),
            voxel_size=(size, size, size),
            pose=any_pose(np.random.default_rng((LIMITS_SEED, i, j))),
        )
        for i, wall in enumerate(walls)
        for j, size in enumerate(sizes)
    ]


def _limits_table(cases: Sequence[Case], results: Sequence[Measured | Refusal]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for case, result in zip(cases, results, strict=True):
        start: tuple[Cell, ...] = (f"{case.spec.thickness:g}", f"{case.voxel_size[0]:g}")
        across = f"{case.spec.thickness / case.voxel_size[0]:.1f}"
        if isinstance(result, Refusal):
            outcome = str(result) if result.is_bug else f"refused: {result.reason}"
            rows.append((*start, across, outcome, None, None, not result.is_bug))
            continue
        bias = float(np.nanmean(result.error))
        outcome = ", ".join([result.status, *result.flags])
        told = bool(result.flags) or abs(bias) <= MAX_SILENT_ERROR
        rows.append((*start, across, outcome, f"{bias:+.3f}", float(np.nanstd(result.error)), told))
    return Table(
        title="Sheets too thin for their voxels",
        columns=("thickness, mm", "voxels, mm", "voxels across", "outcome", "bias", "SD", "met"),
        rows=tuple(rows),
        notes="Met: the map is refused or flagged, or its mean is within"
        f" {MAX_SILENT_ERROR:g} mm of the truth.",
    )
