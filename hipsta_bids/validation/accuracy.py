"""Thickness, curvature, volume, areas and extents of phantoms against the truth."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hipsta_bids.geometry.catalog import MAPS, PER_SUBFIELD, SECTIONS, SUMMARY
from hipsta_bids.geometry.measures import away_from_edges, column_area
from hipsta_bids.phantom import Phantom, PhantomSpec, PhantomTruth
from hipsta_bids.phantom.truth import cut_sections
from hipsta_bids.protocols.protocol import Protocol
from hipsta_bids.settings import MeasureSettings
from hipsta_bids.types import Float, HemisphereMaps
from hipsta_bids.validation.cases import (
    CURVATURES,
    EDGE,
    GAUSSIAN_CURVATURES,
    Case,
    Measured,
    Refusal,
    along_slices,
    any_pose,
    measure_case,
    run_cases,
    without_edges,
)
from hipsta_bids.validation.report import Cell, Picture, Suite, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# Which phantoms the accuracy suite measures, in which voxels, and what is asked of each.


TILT = 10.0
"""Degrees by which tilted slices miss the perpendicular to the long axis."""


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
    iso = (0.4, 0.4, 0.4)
    thin = PhantomSpec(kind="spiral", thickness=1.2)
    fine = [
        *(
            Row(spec=PhantomSpec(kind=kind, thickness=2.0), voxel_size=iso, bias=0.015, sd=0.04)
            for kind in ("arc", "spiral", "tight")
        ),
        Row(spec=thin, voxel_size=iso, bias=0.02, sd=0.05),
    ]
    varied = PhantomSpec(kind="spiral", thickness=2.0, variation=0.3)
    tight = PhantomSpec(kind="tight", thickness=1.6)
    thick = [
        row
        for tilt in (0.0, TILT)
        for row in (
            Row(spec=varied, voxel_size=(0.4, 0.4, 2.0), bias=0.015, sd=0.065, tilt=tilt),
            Row(spec=thin, voxel_size=(0.4, 0.4, 2.0), bias=0.02, sd=0.05, tilt=tilt),
            Row(spec=tight, voxel_size=(0.5, 0.5, 1.5), bias=0.03, sd=0.09, tilt=tilt),
        )
    ]
    return (*fine, *thick)


ROWS = _rows()


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
    """Measure every row in several poses."""
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


# Every measure of a phantom beside its analytic value.


#: Sizes of a subfield, and what they are called where the truth of a part of the body is summed up.
_SUBFIELD_SIZES = {"area": "area_mid", "volume": "volume"}


@dataclass(frozen=True, eq=False, kw_only=True)
class Comparison:
    """One measure of one phantom."""

    name: str
    """Of the column."""
    unit: str
    found: Float
    """Values where it is measured: (Nx, Ny) of a map, (Ny,) of sections, one of a summary."""
    true: Float
    """The same, analytic."""
    weights: Float
    """Of the values in the mean; nodes beside rims and ends have none for curvatures."""

    @property
    def means(self) -> tuple[float, float]:
        """Means of what was found and of the truth."""
        found, true = (np.average(x, weights=self.weights) for x in (self.found, self.true))
        return float(found), float(true)

    @property
    def rms_error(self) -> float:
        """Root mean square error of the values."""
        return float(np.sqrt(np.average((self.found - self.true) ** 2, weights=self.weights)))


def compare_maps(phantom: Phantom, maps: HemisphereMaps, *, hemi: str = "L") -> list[Comparison]:
    """Set each map beside the truth where its mid-surface was found."""
    truth = _truth_at_nodes(phantom, maps, hemi)
    area = column_area(maps.sheet)
    inner = area * away_from_edges(area.shape, MeasureSettings())
    return [
        Comparison(
            name=row.name,
            unit=row.unit,
            found=maps.maps[row.name],
            true=getattr(truth, row.name),
            weights=inner if "curvature" in row.name else area,
        )
        for row in MAPS
    ]


def compare_sections(
    phantom: Phantom, maps: HemisphereMaps, *, hemi: str = "L"
) -> list[Comparison]:
    """Set each measure of cross-sections beside the truth where they were found."""
    _, v = sheet_coordinates(phantom, maps, hemi=hemi)
    quarter = len(v) // 4  # rims may lie outside of the phantom
    truth = cut_sections(phantom.body, np.clip(np.nanmean(v[quarter:-quarter], axis=0), 0, 1))
    return [
        _comparison(row.name, row.unit, maps.sections[row.name], truth[row.name])
        for row in SECTIONS
    ]


def compare_summary(phantom: Phantom, maps: HemisphereMaps, *, hemi: str = "L") -> list[Comparison]:
    """Set each number of the summary beside the truth.

    Curvatures are averaged over part of the sheet; the truth is averaged over the same.
    """
    means = {f"{one.name}_mean": one.means[1] for one in compare_maps(phantom, maps, hemi=hemi)}
    truth = means | dict(phantom.region_summary("extended"))
    return [
        _comparison(row.name, row.unit, maps.summary[row.name], truth[row.name]) for row in SUMMARY
    ]


def compare_subfields(
    phantom: Phantom, maps: HemisphereMaps, protocol: Protocol, *, hemi: str = "L"
) -> list[Comparison]:
    """Set the numbers of each subfield beside the truth."""
    thickness = _truth_at_nodes(phantom, maps, hemi).thickness
    area = column_area(maps.sheet)
    rows = []
    for tissue, truth in phantom.subfield_summary(protocol).items():
        inside = area * (maps.subfield == tissue)
        for row in PER_SUBFIELD:
            name = f"{row.name}_{tissue.name}"
            wanted = (
                np.average(thickness, weights=inside)
                if row.name == "thickness_mean"
                else truth[_SUBFIELD_SIZES[row.name]]
            )
            rows.append(_comparison(name, row.unit, maps.summary[name], wanted))
    return rows


def sheet_coordinates(
    phantom: Phantom, maps: HemisphereMaps, *, hemi: str = "L"
) -> tuple[Float, Float]:
    """Find the true u and v (Nx, Ny) of the mid-surface; NaN beyond the phantom's rims."""
    points = maps.sheet.points[:, :, maps.sheet.middle]
    found = phantom.body.locate(points.reshape(-1, 3), hemi=hemi).reshape(points.shape)
    return found[..., 0], found[..., 1]


def _truth_at_nodes(phantom: Phantom, maps: HemisphereMaps, hemi: str) -> PhantomTruth:
    u, v = sheet_coordinates(phantom, maps, hemi=hemi)
    return phantom.truth(*(np.clip(np.nan_to_num(x, nan=0.5), 0, 1) for x in (u, v)))


def _comparison(name: str, unit: str, found: Float | float, true: Float | float) -> Comparison:
    values, wanted = np.atleast_1d(found), np.atleast_1d(true)
    return Comparison(
        name=name, unit=unit, found=values, true=wanted, weights=np.ones(values.shape)
    )
