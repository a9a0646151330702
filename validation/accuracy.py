"""Thickness, curvature, volume, areas and extents of phantoms against the truth."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import linregress

from hipsta_bids.phantom import PhantomSpec
from hipsta_bids.settings import GridSettings
from hipsta_bids.types import Float
from validation import cases
from validation.cases import CURVATURES, GAUSSIAN_CURVATURES, Case, Measured, Refusal
from validation.report import Cell, Cells, Content, picture, show_map, suite, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure


TILT = 10.0
"""Degrees by which tilted slices miss the perpendicular to the long axis."""
SEED = 20230
POSES_QUICK, POSES_FULL = 4, 12
MAX_SIZE_ERROR = 2.0
"""Percent, of volume, areas and extents."""
MAX_CURVATURE_ERROR = 5.0
"""Percent, of mean curvature in the middle of an arc."""
MAX_GAUSSIAN_ERROR = 0.005
"""1/mm2, root mean square over the middle of the sheet, on straight extrusions."""
#: Summary measures by the title of their table.
SIZES = {
    "sizes": (*("volume", "area_interior", "area_mid", "area_exterior", "extent_x", "extent_y"),),
    "sections": (
        *("circumference_mean", "interior_exterior_ratio_mean", "section_area_mean"),
        *("shape_index_mean", "area_ratio", "surface_volume_ratio"),
    ),
}


@dataclass(frozen=True, kw_only=True)
class Row:
    """One row of the accuracy table."""

    spec: PhantomSpec
    voxel_size: tuple[float, float, float]
    bias: float
    """mm, target."""
    sd: float
    """mm, target."""
    tilt: float | None = None
    """Degrees; None for isotropic voxels, which are turned at random."""

    @property
    def name(self) -> str:
        """For people."""
        spec = self.spec
        varied = f", ±{spec.variation:.0%}" if spec.variation else ""
        tilted = f", tilted by {self.tilt:g}°" if self.tilt else ""
        return f"{spec.kind} {spec.thickness:.1f} mm{varied}{tilted}"

    @property
    def voxels(self) -> str:
        """Voxel size for people."""
        x, y, z = self.voxel_size
        return f"{x:g} iso" if x == y == z else f"{x:g} x {y:g} x {z:g}"


def _rows() -> tuple[Row, ...]:
    iso, slices = (0.4, 0.4, 0.4), (0.4, 0.4, 2.0)
    thin = PhantomSpec(kind="spiral", thickness=1.2)
    arc, spiral, tight = (PhantomSpec(kind=k, thickness=2.0) for k in ("arc", "spiral", "tight"))
    fine = [Row(spec=s, voxel_size=iso, bias=0.015, sd=0.04) for s in (arc, spiral, tight)]
    fine.append(Row(spec=thin, voxel_size=iso, bias=0.02, sd=0.05))
    varied, narrow = replace(spiral, variation=0.3), replace(tight, thickness=1.6)
    thick = [
        row
        for tilt in (0.0, TILT)
        for row in (
            Row(spec=varied, voxel_size=slices, bias=0.015, sd=0.065, tilt=tilt),
            Row(spec=thin, voxel_size=slices, bias=0.02, sd=0.05, tilt=tilt),
            Row(spec=narrow, voxel_size=(0.5, 0.5, 1.5), bias=0.03, sd=0.09, tilt=tilt),
        )
    ]
    return (*fine, *thick)


ROWS = _rows()

Results = Mapping[Row, Sequence[Measured | Refusal]]


@suite("accuracy")
def run(full: bool) -> Iterator[Content]:
    """Measure every row in several poses."""
    poses = POSES_FULL if full else POSES_QUICK
    results = cases.run_groups(
        cases.measure_case, {r: _poses(n, r, poses) for n, r in enumerate(ROWS)}
    )
    yield _thickness_table(results)
    yield _curvature_table(results)
    yield _gaussian_table(results)
    for key, names in SIZES.items():
        yield table(f"accuracy.{key}")(_size_rows)(results, names)
    yield _error_picture(results)
    yield {"poses": poses}


def _poses(number: int, row: Row, count: int) -> list[Case]:
    """Draw poses; the first ones are the same whatever the count."""
    generator = np.random.default_rng((SEED, number))
    drawings = []
    for _ in range(count):
        if row.tilt is None:
            pose, turn = cases.any_pose(generator), None
        else:
            pose, turn = cases.along_slices(generator, tilt=row.tilt)
        drawings.append(
            Case(spec=row.spec, voxel_size=row.voxel_size, pose=pose, grid_rotation=turn)
        )
    return drawings


def _measured(results: Results) -> dict[Row, list[Measured]]:
    """Keep the rows of which something was measured."""
    kept = {row: [m for m in group if isinstance(m, Measured)] for row, group in results.items()}
    return {row: group for row, group in kept.items() if group}


@table("accuracy.thickness")
def _thickness_table(results: Results) -> Iterator[Cells | str]:
    measured = _measured(results)
    for row, group in results.items():
        errors = [m.error for m in measured.get(row, ())]
        refused = len(group) - len(errors)
        cells: dict[str, Cell] = {"phantom": row.name, "voxels, mm": row.voxels}
        good = False
        if errors:
            bias = np.array([np.nanmean(error) for error in errors])
            sd = cases.rms([np.nanstd(error) for error in errors])
            good = bool(abs(bias.mean()) <= row.bias and sd <= row.sd and refused == 0)
            cells |= {"bias": f"{bias.mean():+.3f}", "SD": sd}
        cells |= {"target |bias|": f"≤ {row.bias:g}", "target SD": f"≤ {row.sd:g}"}
        if errors:
            cells |= {
                "bias, pose by pose": f"{bias.min():+.3f} to {bias.max():+.3f}",
                "SD without edges": cases.rms(
                    [np.nanstd(cases.without_edges(error)) for error in errors]
                ),
                "SD of the mean map": float(np.nanstd(np.mean(errors, axis=0))),
            }
        yield {**cells, "refused": refused, "met": good}
    yield cases.refusal_notes({f"{row.name}, {row.voxels}": g for row, g in results.items()})


@table("accuracy.curvature")
def _curvature_table(results: Results) -> Iterator[Cells]:
    """Compare the middle half of each row's sheet; only the arc has a target."""
    for row, surface, true, found in _middles(results, CURVATURES):
        percent = 100.0 * (np.nanmean(found) / np.nanmean(true) - 1.0)
        target = row.spec.kind == "arc"
        yield {
            "phantom, 0.4 mm voxels": row.name,
            "surface": surface,
            "true mean": float(np.nanmean(true)),
            "measured mean": float(np.nanmean(found)),
            "error of the mean": f"{percent:+.1f} %",
            "RMS error of points": cases.rms(found - true),
            "target": f"≤ {MAX_CURVATURE_ERROR:g} %" if target else None,
            "met": bool(abs(percent) <= MAX_CURVATURE_ERROR) if target else None,
        }


@table("accuracy.gaussian")
def _gaussian_table(results: Results) -> Iterator[Cells]:
    """Compare the middle half of each row's sheet, over all poses."""
    for row, surface, true, found in _middles(results, GAUSSIAN_CURVATURES):
        error = cases.rms(found - true)
        yield {
            "phantom, 0.4 mm voxels": row.name,
            "surface": surface,
            "true mean": f"{np.nanmean(true):.4f}",
            "measured mean": f"{np.nanmean(found):.4f}",
            "RMS error of points": f"{error:.4f}",
            "target": f"≤ {MAX_GAUSSIAN_ERROR:g}",
            "met": bool(error <= MAX_GAUSSIAN_ERROR),
        }


def _middles(results: Results, names: Sequence[str]) -> Iterator[tuple[Row, str, Float, Float]]:
    """Yield row, surface, truth and measurement of curvatures in isotropic voxels."""
    for row, group in _measured(results).items():
        if row.tilt is None:
            for name in names:
                surface = name.rpartition("curvature")[2].removeprefix("_") or "mid"
                true = np.array([_middle(m.true_curvature[name]) for m in group])
                found = np.array([_middle(m.curvature[name]) for m in group])
                yield row, surface, true, found


def _size_rows(results: Results, names: Sequence[str]) -> Iterator[Cells]:
    for row, group in _measured(results).items():
        errors = {
            name.removesuffix("_mean").replace("_", " "): 100.0
            * float(np.mean([m.summary[name] / m.true_summary[name] - 1.0 for m in group]))
            for name in names
        }
        yield {
            "phantom": row.name,
            "voxels, mm": row.voxels,
            **{heading: f"{error:+.1f}" for heading, error in errors.items()},
            "target": f"≤ {MAX_SIZE_ERROR:g}",
            "met": max(map(abs, errors.values())) <= MAX_SIZE_ERROR,
        }


@picture("accuracy")
def _error_picture(figure: "Figure", results: Results) -> None:
    maps = {row: np.mean([m.error for m in g], axis=0) for row, g in _measured(results).items()}
    columns = 5
    axes = figure.subplots(-(-len(maps) // columns), columns, squeeze=False)
    for axis in axes.flat[len(maps) :]:
        axis.set_axis_off()
    for axis, (row, error) in zip(axes.flat, maps.items(), strict=False):
        title = row.name.replace(", tilted", "\ntilted") + f"\n{row.voxels}"
        style = {"cmap": "RdBu_r", "vmin": -0.15, "vmax": 0.15}
        image = show_map(axis, error, title, ends=("post.", "ant."), **style)
        axis.title.set_fontsize("small")
    figure.colorbar(image, ax=axes, label="error of thickness, mm", shrink=0.8)


def _middle(values: Float) -> Float:
    """Return the middle half along both axes."""
    x, y = (n // 4 for n in values.shape)
    return values[x:-x, y:-y]


# How fast the error falls with the voxel size, and sheets too thin for their voxels.


CONVERGENCE_SEED = 20231
VOXEL_SIZES = (0.6, 0.5, 0.4, 0.3)
"""mm, isotropic voxels."""
CONVERGENCE_QUICK, CONVERGENCE_FULL = 2, 8
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
    "without edges": cases.without_edges,
}

Key = tuple[str, str]


@suite("convergence")
def run_convergence(full: bool) -> Iterator[Content]:
    """Measure the same phantoms in ever smaller voxels."""
    poses = CONVERGENCE_FULL if full else CONVERGENCE_QUICK
    names = list(SPECS) if full else list(SPECS)[:1]
    keys = [(name, grid) for name in names for grid in GRIDS]
    drawings = {
        (key, size): [_case(key, size, pose) for pose in range(poses)]
        for key in keys
        for size in VOXEL_SIZES
    }
    results = cases.run_groups(cases.measure_case, drawings)
    errors = {key: [_errors(results[key, size]) for size in VOXEL_SIZES] for key in keys}
    yield _table(errors)
    yield _picture(errors)
    yield {"poses": poses}


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
        pose=cases.any_pose(np.random.default_rng((CONVERGENCE_SEED, pose))),
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


@table("convergence.falls")
def _table(errors: Mapping[Key, Sequence[Mapping[str, float]]]) -> Iterator[Cells]:
    for (name, grid), values in errors.items():
        for zone in ZONES:
            roots = [value[zone] for value in values]
            slope, standard_error = rate(VOXEL_SIZES, roots)
            bias = [f"{v['bias']:+.3f} / " if zone == WHOLE else "" for v in values]
            sizes = [f"{size:g} mm" for size in VOXEL_SIZES]
            yield {
                "phantom": name,
                "working grid": grid,
                "part": zone,
                **{s: f"{b}{r:.3f}" for s, b, r in zip(sizes, bias, roots, strict=True)},
                "rate": f"{slope:.2f} ± {standard_error:.2f}",
                "target": "falls",
                "met": all(finer < coarser for coarser, finer in pairwise(roots)),
            }


@picture("convergence")
def _picture(figure: "Figure", errors: Mapping[Key, Sequence[Mapping[str, float]]]) -> None:
    axis = figure.subplots()
    colors = {name: f"C{number}" for number, name in enumerate(SPECS)}
    for (name, grid), values in errors.items():
        style = "o-" if GRIDS[grid] is None else "s--"
        for zone, alpha in zip(ZONES, (1.0, 0.45), strict=True):
            roots, label = [v[zone] for v in values], f"{name}, {grid}, {zone}"
            axis.loglog(VOXEL_SIZES, roots, style, color=colors[name], alpha=alpha, label=label)
    reach = np.array([min(VOXEL_SIZES), max(VOXEL_SIZES)])
    start = min(v[zone] for values in errors.values() for v in values for zone in ZONES)
    axis.loglog(reach, 0.8 * start * reach / reach[0], color="0.6", label="rate 1")
    axis.set_xticks(VOXEL_SIZES, [f"{size:g}" for size in VOXEL_SIZES])
    axis.minorticks_off()
    axis.set_yticks(ticks := [0.03, 0.04, 0.06, 0.08, 0.12], [f"{t:g}" for t in ticks])
    axis.set_xlabel("voxel size, mm")
    axis.set_ylabel("RMS error of thickness, mm")
    axis.legend(fontsize="small", loc="center left", bbox_to_anchor=(1.02, 0.5))


@suite("limits")
def run_limits(full: bool) -> Iterator[Content]:
    """Measure sheets that are too thin for their voxels: refused or flagged, not silently wrong."""
    sizes = (0.4, 0.6, 0.8, 1.0) if full else (0.5, 1.0)
    walls = (0.8, 1.2, 1.6, 3.0) if full else (0.8, 1.6)
    drawings = [
        Case(
            spec=PhantomSpec(kind="spiral", thickness=wall, curvature=(0.02, 0.35)),
            voxel_size=(size, size, size),
            pose=cases.any_pose(np.random.default_rng((LIMITS_SEED, i, j))),
        )
        for i, wall in enumerate(walls)
        for j, size in enumerate(sizes)
    ]
    yield _limits_table(drawings, cases.run_cases(cases.measure_case, drawings))


@table("limits.thin")
def _limits_table(
    drawings: Sequence[Case], results: Sequence[Measured | Refusal]
) -> Iterator[Cells]:
    for case, result in zip(drawings, results, strict=True):
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
                "outcome": ", ".join([result.decision, *result.flags]),
                "bias": f"{bias:+.3f}",
                "SD": float(np.nanstd(result.error)),
            }
        yield {**cells, "met": met}
