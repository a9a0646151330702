"""Thickness, curvature, volume, areas and extents of phantoms against the truth."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from hipsta_bids.artifacts import Float
from hipsta_bids.validation.accuracy_rows import ROWS, Row
from hipsta_bids.validation.cases import (
    CURVATURES,
    EDGE,
    GAUSSIAN_CURVATURES,
    Case,
    Measured,
    along_slices,
    any_pose,
    measure_case,
    without_edges,
)
from hipsta_bids.validation.suite import Cell, Picture, Suite, Table
from hipsta_bids.validation.workers import Refusal, run_cases

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SEED = 20230
POSES_QUICK, POSES_FULL = 4, 12
MAX_SIZE_ERROR = 2.0
"""Percent, of volume, areas and extents."""
MAX_CURVATURE_ERROR = 5.0
"""Percent, of mean curvature in the middle of an arc."""
MAX_GAUSSIAN_ERROR = 0.005
"""1/mm2, root mean square over the middle of the sheet, on straight extrusions."""
SIZES = ("volume", "area_interior", "area_mid", "area_exterior", "extent_x", "extent_y")
SECTION_SIZES = (
    "circumference_mean",
    "interior_exterior_ratio_mean",
    "section_area_mean",
    "shape_index_mean",
    "area_ratio",
    "surface_volume_ratio",
)


def run(full: bool) -> Suite:
    """Measure every row in several poses.

    Parameters
    ----------
    full : bool
        Twelve poses a row instead of four.

    Returns
    -------
    Suite
    """
    poses = POSES_FULL if full else POSES_QUICK
    cases = [case for number, row in enumerate(ROWS) for case in _poses(number, row, poses)]
    results = run_cases(measure_case, cases)
    groups = [results[i * poses : (i + 1) * poses] for i in range(len(ROWS))]
    measured = [[m for m in group if isinstance(m, Measured)] for group in groups]
    return Suite(
        name="accuracy",
        title="Accuracy on phantoms",
        text=_TEXT.format(poses=poses),
        tables=(
            _thickness_table(groups),
            _curvature_table(measured),
            _gaussian_table(measured),
            _size_table(measured, "Volume, areas and extents, error in percent", SIZES),
            _size_table(measured, "Cross-sections and ratios, error in percent", SECTION_SIZES),
        ),
        pictures=(_error_picture(measured),),
    )


def _poses(number: int, row: Row, count: int) -> list[Case]:
    """Draw poses; the first ones are the same however many there are."""
    generator = np.random.default_rng((SEED, number))
    cases = []
    for _ in range(count):
        pose, turn = (
            (any_pose(generator), None)
            if row.tilt is None
            else along_slices(generator, tilt=row.tilt)
        )
        cases.append(Case(spec=row.spec, voxel_size=row.voxel_size, pose=pose, grid_rotation=turn))
    return cases


def mean_map(measured: Sequence[Measured]) -> Float:
    """Average the error of thickness over poses, (Nx, Ny) mm: what is not luck of the voxels."""
    return np.asarray(np.mean([m.error for m in measured], axis=0))


def _thickness_table(groups: Sequence[Sequence[Measured | Refusal]]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for row, group in zip(ROWS, groups, strict=True):
        errors = [m.error for m in group if isinstance(m, Measured)]
        targets = (f"≤ {row.bias:g}", f"≤ {row.sd:g}")
        refused = len(group) - len(errors)
        if not errors:
            rows.append((row.name, row.voxels, None, None, *targets, *(None,) * 3, refused, False))
            continue
        bias = np.array([np.nanmean(error) for error in errors])
        sd = np.array([np.nanstd(error) for error in errors])
        inside = np.array([np.nanstd(without_edges(error)) for error in errors])
        lasting = float(np.nanstd(np.mean(errors, axis=0)))
        good = abs(bias.mean()) <= row.bias and _rms(sd) <= row.sd and refused == 0
        rows.append(
            (
                row.name,
                row.voxels,
                f"{bias.mean():+.3f}",
                _rms(sd),
                *targets,
                f"{bias.min():+.3f} to {bias.max():+.3f}",
                _rms(inside),
                lasting,
                refused,
                bool(good),
            )
        )
    return Table(
        title="Thickness over the whole grid, mm",
        columns=(
            "phantom",
            "voxels, mm",
            "bias",
            "SD",
            "target |bias|",
            "target SD",
            "bias, pose by pose",
            "SD without edges",
            "SD of the mean map",
            "refused",
            "met",
        ),
        rows=tuple(rows),
        notes=_THICKNESS_NOTES.format(edge=EDGE) + _refusals(groups),
    )


def _refusals(groups: Sequence[Sequence[Measured | Refusal]]) -> str:
    """Say why maps are missing; bullets of Markdown, or nothing."""
    lines = [
        f"- {row.name}, {row.voxels}: {result}"
        for row, group in zip(ROWS, groups, strict=True)
        for result in group
        if isinstance(result, Refusal)
    ]
    return "\n".join(["\nRefused:\n", *lines]) if lines else ""


def _curvature_table(measured: Sequence[Sequence[Measured]]) -> Table:
    """Middle half of each row's sheet; the target is the issue of the arc alone."""
    rows: list[tuple[Cell, ...]] = []
    for row, group in zip(ROWS, measured, strict=True):
        if not group or row.tilt is not None:
            continue
        for name in CURVATURES:
            pairs = [(_middle(m.curvature[name]), _middle(m.true_curvature[name])) for m in group]
            found, true = (np.array(values) for values in zip(*pairs, strict=True))
            percent = 100.0 * (np.nanmean(found) / np.nanmean(true) - 1.0)
            target = row.spec.kind == "arc"
            rows.append(
                (
                    row.name,
                    name.removeprefix("curvature_").replace("curvature", "mid"),
                    float(np.nanmean(true)),
                    float(np.nanmean(found)),
                    f"{percent:+.1f} %",
                    float(np.sqrt(np.nanmean((found - true) ** 2))),
                    f"≤ {MAX_CURVATURE_ERROR:g} %" if target else None,
                    bool(abs(percent) <= MAX_CURVATURE_ERROR) if target else None,
                )
            )
    return Table(
        title="Mean curvature in the middle half of the sheet, 1/mm",
        columns=(
            "phantom, 0.4 mm voxels",
            "surface",
            "true mean",
            "measured mean",
            "error of the mean",
            "RMS error of points",
            "target",
            "met",
        ),
        rows=tuple(rows),
    )


def _gaussian_table(measured: Sequence[Sequence[Measured]]) -> Table:
    """Middle half of each row's sheet, over all surfaces and poses."""
    rows: list[tuple[Cell, ...]] = []
    for row, group in zip(ROWS, measured, strict=True):
        if not group or row.tilt is not None:
            continue
        for name in GAUSSIAN_CURVATURES:
            found = np.array([_middle(m.curvature[name]) for m in group])
            true = np.array([_middle(m.true_curvature[name]) for m in group])
            error = float(np.sqrt(np.nanmean((found - true) ** 2)))
            surface = name.removeprefix("gaussian_curvature").removeprefix("_") or "mid"
            rows.append(
                (
                    row.name,
                    surface,
                    f"{np.nanmean(true):.4f}",
                    f"{np.nanmean(found):.4f}",
                    f"{error:.4f}",
                    f"≤ {MAX_GAUSSIAN_ERROR:g}",
                    bool(error <= MAX_GAUSSIAN_ERROR),
                )
            )
    return Table(
        title="Gaussian curvature in the middle half of the sheet, 1/mm²",
        columns=(
            "phantom, 0.4 mm voxels",
            "surface",
            "true mean",
            "measured mean",
            "RMS error of points",
            "target",
            "met",
        ),
        rows=tuple(rows),
    )


def _size_table(
    measured: Sequence[Sequence[Measured]], title: str, names: tuple[str, ...]
) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for row, group in zip(ROWS, measured, strict=True):
        if not group:
            continue
        errors = {
            name: 100.0 * np.mean([m.summary[name] / m.true_summary[name] - 1.0 for m in group])
            for name in names
        }
        worst = max(map(abs, errors.values()))
        rows.append(
            (
                row.name,
                row.voxels,
                *(f"{error:+.1f}" for error in errors.values()),
                f"≤ {MAX_SIZE_ERROR:g}",
                bool(worst <= MAX_SIZE_ERROR),
            )
        )
    headings = tuple(name.removesuffix("_mean").replace("_", " ") for name in names)
    return Table(
        title=title,
        columns=("phantom", "voxels, mm", *headings, "target", "met"),
        rows=tuple(rows),
        notes="Mean over the poses. Extents are arc lengths of the mid-surface; cross-sections are"
        " averaged over the length of the body.",
    )


def _error_picture(measured: Sequence[Sequence[Measured]]) -> Picture:
    maps = [(row, mean_map(group)) for row, group in zip(ROWS, measured, strict=True) if group]

    def draw(figure: "Figure") -> None:
        columns = 5
        axes = figure.subplots(-(-len(maps) // columns), columns, squeeze=False)
        for axis in axes.flat:
            axis.set_axis_off()
        for axis, (row, error) in zip(axes.flat, maps, strict=False):
            axis.set_axis_on()
            image = axis.imshow(
                error.T, origin="lower", cmap="RdBu_r", vmin=-0.15, vmax=0.15, aspect="auto"
            )
            name = row.name.replace(", tilted", "\ntilted")
            axis.set_title(f"{name}\n{row.voxels}", fontsize="small")
            axis.set_xticks([0, error.shape[0] - 1], ["medial", "lateral"])
            axis.set_yticks([0, error.shape[1] - 1], ["post.", "ant."])
        figure.colorbar(image, ax=axes, label="error of thickness, mm", shrink=0.8)

    return Picture(
        name="accuracy",
        caption="Error of thickness, averaged over the poses: what stays where the luck of the"
        " voxels averages out. Mm, red is too thick.",
        draw=draw,
        size=(12.0, 5.6),
    )


def _middle(values: Float) -> Float:
    """Return the middle half along both axes."""
    x, y = (n // 4 for n in values.shape)
    return values[x:-x, y:-y]


def _rms(values: Float) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


_TEXT = """\
Phantoms are analytic shapes whose thickness, curvature, areas and volume are known at every point
(`hipsta_bids/phantom`). Each is drawn as a segmentation in {poses} random poses, since one pose is
luck: a voxel gets the label at its center (no partial volume, no smoothing), as harsh as a manual
segmentation. Isotropic voxels meet the phantom turned by up to 25° about each axis and shifted by
up to 2 mm. Thick slices are perpendicular to the long axis, as they are scanned, and in further
rows tilted by 10° from there; within the slices, the grid is turned by up to 25°. Settings are the
defaults.
"""

_THICKNESS_NOTES = """\
Bias is the mean over the grid, averaged over the poses; SD is over the grid, its root mean square
over the poses. Both take the whole default grid, edges included. The truth is that of the phantom
at the place where the mid-surface was found. Without edges: without the {edge} outer nodes on each
side. The SD of the mean map is what remains when the error is averaged over the poses at each grid
point: errors that stay at their place, near rims and bends.
"""
