"""How fast the error falls with the voxel size, and sheets too thin for their voxels."""

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import linregress

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
    run_groups,
    without_edges,
)
from hipsta_bids.validation.report import Cell, Cells, Picture, Suite, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SEED = 20231
SIZES = (0.6, 0.5, 0.4, 0.3)
"""mm, isotropic voxels."""
POSES_QUICK, POSES_FULL = 2, 8
LIMITS_SEED = 20233
MAX_SILENT_ERROR = 0.15
"""mm; where the mean is farther off, the hemisphere has to be refused or flagged."""

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
    cases = {
        (key, size): [_case(key, size, pose) for pose in range(poses)]
        for key in keys
        for size in SIZES
    }
    results = run_groups(measure_case, cases)
    errors = {key: [_errors(results[key, size]) for size in SIZES] for key in keys}
    return Suite(
        name="convergence",
        title="Convergence with voxel size",
        text=_TEXT.format(poses=poses),
        tables=(_table(errors),),
        pictures=(_picture(errors),),
    )


def rate(sizes: Sequence[float], errors: Sequence[float]) -> tuple[float, float]:
    """Fit ``error = constant * size ** rate`` by least squares: the rate and its standard error."""
    fit = linregress(np.log(sizes), np.log(errors))
    return float(fit.slope), float(fit.stderr)


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
    """Average over the poses: bias, and root mean square in each zone, mm."""
    errors = [m.error for m in group if isinstance(m, Measured)]
    if not errors:
        return dict.fromkeys(("bias", *ZONES), float("nan"))
    squares = {zone: [np.nanmean(take(e) ** 2) for e in errors] for zone, take in ZONES.items()}
    return {
        "bias": float(np.mean([np.nanmean(e) for e in errors])),
        **{zone: float(np.sqrt(np.mean(values))) for zone, values in squares.items()},
    }


def _table(errors: Mapping[Key, Sequence[Mapping[str, float]]]) -> Table:
    rows: list[Cells] = []
    for (name, grid), values in errors.items():
        for zone in ZONES:
            rms = [value[zone] for value in values]
            slope, standard_error = rate(SIZES, rms)
            bias = [f"{v['bias']:+.3f} / " if zone == WHOLE else "" for v in values]
            sizes = [f"{size:g} mm" for size in SIZES]
            rows.append(
                {
                    "phantom": name,
                    "working grid": grid,
                    "part": zone,
                    **{s: f"{b}{r:.3f}" for s, b, r in zip(sizes, bias, rms, strict=True)},
                    "rate": f"{slope:.2f} ± {standard_error:.2f}",
                    "target": "falls",
                    "met": all(finer < coarser for coarser, finer in pairwise(rms)),
                }
            )
    return Table(
        title="Bias / root mean square error of thickness, mm, by voxel size",
        rows=rows,
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


def run_limits(full: bool) -> Suite:
    """Measure sheets that are too thin for their voxels: refused or flagged, not silently wrong."""
    sizes = (0.4, 0.6, 0.8, 1.0) if full else (0.5, 1.0)
    walls = (0.8, 1.2, 1.6, 3.0) if full else (0.8, 1.6)
    cases = [
        Case(
            spec=PhantomSpec(kind="spiral", thickness=wall, curvature=(0.02, 0.35)),
            voxel_size=(size, size, size),
            pose=any_pose(np.random.default_rng((LIMITS_SEED, i, j))),
        )
        for i, wall in enumerate(walls)
        for j, size in enumerate(sizes)
    ]
    return Suite(
        name="limits",
        title="Limits",
        text="Spirals, isotropic voxels, one pose each.",
        tables=(_limits_table(cases, run_cases(measure_case, cases)),),
    )


def _limits_table(cases: Sequence[Case], results: Sequence[Measured | Refusal]) -> Table:
    rows: list[Cells] = []
    for case, result in zip(cases, results, strict=True):
        cells: dict[str, Cell] = {
            "thickness, mm": f"{case.spec.thickness:g}",
            "voxels, mm": f"{case.voxel_size[0]:g}",
            "voxels across": f"{case.spec.thickness / case.voxel_size[0]:.1f}",
        }
        if isinstance(result, Refusal):
            cells["outcome"] = str(result) if result.is_bug else f"refused: {result.reason}"
            met = not result.is_bug
        else:
            bias = float(np.nanmean(result.error))
            met = bool(result.flags) or abs(bias) <= MAX_SILENT_ERROR
            cells |= {
                "outcome": ", ".join([result.status, *result.flags]),
                "bias": f"{bias:+.3f}",
                "SD": float(np.nanstd(result.error)),
            }
        rows.append({**cells, "met": met})
    return Table(
        title="Sheets too thin for their voxels",
        rows=rows,
        notes="Met: the map is refused or flagged, or its mean is within"
        f" {MAX_SILENT_ERROR:g} mm of the truth.",
    )
