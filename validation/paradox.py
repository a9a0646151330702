"""What losses of tissue and errors of labels do to thickness, volume and surface area."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy import ndimage

from hipsta_bids.phantom import Phantom, PhantomSpec, Thinning
from hipsta_bids.protocols.protocol import Part, Tissue
from hipsta_bids.settings import PUBLISHED, Settings
from hipsta_bids.types import Bool, Float, LabelVolume
from validation import cases
from validation.accuracy import TILT
from validation.report import Cell, Cells, Content, suite, table

SEED = 20244
POSES_QUICK, POSES_FULL = 1, 2
MAX_ERROR = 1.5
"""Percentage points, of the change of thickness where labels are right."""
CHANGED = 0.5
"""Percent; smaller changes of volume or thickness count as none."""

#: The undamaged body: mm of width and length, thickness between its edges, and curvature at the
#: medial and lateral end, 1/mm.
WIDTH, LENGTH, WALL, BENDS = 20.0, 16.0, 2.0, (0.02, 0.44)
#: Its wall is thinner at the edges, as in the presubiculum and in CA3: depth, and where it begins
#: or ends on the mid-curve, mm.
MEDIAL_EDGE, LATERAL_EDGE = (0.6, 2.0), (0.9, 17.2)
_HALF = 0.5  # of a blurred mask
_STEP = 1.0  # mm, scale of the steps to the thin edges

SOUND = "none"
ACCURATE = "tissue"  # what is lost is tissue, and labels are right
ERRORS = "labels"  # the tissue is as before, and labels are wrong
BOTH = "both"


def draw_body(
    *,
    wall: float = WALL,
    lost: float = 0.0,
    narrow: float = 1.0,
    length: float = LENGTH,
    fold: float = 1.0,
    scale: float = 1.0,
) -> PhantomSpec:
    """Return a body: ``lost`` mm off its lateral edge, its width and its folding times factors."""
    kept = 1.0 - lost / WIDTH
    width = WIDTH * kept * narrow * scale
    medial, lateral = BENDS
    depths, (until, start) = zip(MEDIAL_EDGE, LATERAL_EDGE, strict=True)
    return PhantomSpec(
        kind="spiral",
        thickness=wall * scale,
        width=width,
        length=length * scale,
        curvature=(medial / scale, (medial + (lateral * fold - medial) * kept) / scale),
        thinnings=tuple(
            Thinning(depth=depth * scale, u=limits, v=(0.0, 1.0), edge=_STEP * narrow * scale)
            for depth, limits in zip(
                depths,
                ((0.0, until / WIDTH / kept), (start / WIDTH / kept, 1.0)),
                strict=True,
            )
        ),
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class Loss:
    """One way of losing tissue, or one error of its labels."""

    name: str
    strength: float
    unit: str
    kind: str
    true: PhantomSpec = field(default_factory=draw_body)
    """The tissue."""
    drawn: PhantomSpec | None = None
    """What is drawn, where labels are wrong by a constant."""
    least: float = 0.0
    """mm; where the wall is thinner, it has no label."""
    blur: float = 0.0
    """mm, SD of a Gaussian; labels end where half of the blurred mask is left."""
    closed: float = 0.0
    """mm; clefts that a ball of this radius does not enter get labels."""
    voxel: tuple[float, float, float] = (0.4, 0.4, 0.4)
    """mm"""


#: Losses by name: unit and kind of strength, strengths, and what a strength changes.
SERIES: Mapping[str, tuple[str, str, Sequence[float], Callable[[float], dict[str, Any]]]] = {
    "thinner wall": (
        *("mm", ACCURATE, (0.1, 0.2, 0.4)),
        lambda depth: {"true": draw_body(wall=WALL - depth)},
    ),
    "narrower sheet": (
        *("%", ACCURATE, (10.0, 20.0)),
        lambda share: {"true": draw_body(narrow=1.0 - share / 100.0)},
    ),
    "shorter body": (
        *("%", ACCURATE, (10.0, 20.0)),
        lambda share: {"true": draw_body(length=LENGTH * (1.0 - share / 100.0))},
    ),
    "less folding": (
        *("%", ACCURATE, (25.0, 50.0)),
        lambda share: {"true": draw_body(fold=1.0 - share / 100.0)},
    ),
    "smaller in all directions": (
        *("%", ACCURATE, (5.0, 10.0)),
        lambda share: {"true": draw_body(scale=1.0 - share / 100.0)},
    ),
    "thin edge lost": (
        *("mm", ACCURATE, (1.0, 2.0, 3.0)),
        lambda lost: {"true": draw_body(lost=lost)},
    ),
    "thin edges without label": (
        *("mm", ERRORS, (1.2, 1.5, 1.8)),
        lambda least: {"least": least},
    ),
    "rounded labels": (*("mm", ERRORS, (0.4, 0.6, 0.8)), lambda blur: {"blur": blur}),
    "fold filled by labels": (*("mm", ERRORS, (1.2, 1.6)), lambda radius: {"closed": radius}),
    "labels too thick": (
        *("mm", ERRORS, (0.1, 0.2)),
        lambda more: {"drawn": draw_body(wall=WALL + more)},
    ),
    "larger voxels": (
        *("mm", ERRORS, (0.5, 0.7)),
        lambda size: {"voxel": (size, size, size)},
    ),
    "thicker slices": (*("mm", ERRORS, (1.0, 2.0)), lambda step: {"voxel": (0.4, 0.4, step)}),
    "thinner wall (0.1 mm), thin edges without label": (
        *("mm", BOTH, (1.5,)),
        lambda least: {"true": draw_body(wall=WALL - 0.1), "least": least},
    ),
    "narrower sheet (10 %), labels too thick": (
        *("mm", BOTH, (0.1,)),
        lambda more: {
            "true": draw_body(narrow=0.9),
            "drawn": draw_body(narrow=0.9, wall=WALL + more),
        },
    ),
}
LOSSES = (
    Loss(name=SOUND, strength=0.0, unit="n/a", kind=SOUND),
    *(
        Loss(name=name, strength=strength, unit=unit, kind=kind, **changes(strength))
        for name, (unit, kind, strengths, changes) in SERIES.items()
        for strength in strengths
    ),
)


@dataclass(frozen=True, eq=False, kw_only=True)
class Trial:
    """A loss in one pose."""

    loss: Loss
    pose: int


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """What was measured."""

    area: float
    """mm, mean thickness by area."""
    nodes: float
    """mm, mean thickness by nodes."""
    published: float
    """mm, the same with ``--method published``."""
    volume: float
    """mm3"""
    surface: float
    """mm2, of the mid-surface."""
    flagged: bool


def measure_trial(trial: Trial) -> Sizes:
    """Draw a body with its error of labels, and measure it by both methods."""
    volume = draw_labels(trial)
    maps, published = (
        cases.measure_body(volume, "L", settings)
        for settings in (Settings(), Settings().changed(**PUBLISHED))
    )
    return Sizes(
        area=maps.summary["thickness_mean"],
        nodes=maps.summary["thickness_nodes"],
        published=published.summary["thickness_nodes"],
        volume=maps.summary["volume"],
        surface=maps.summary["area_mid"],
        flagged=bool(maps.flags),
    )


def draw_labels(trial: Trial) -> LabelVolume:
    """Draw the labels of a trial; poses are the same for every loss."""
    loss, generator = trial.loss, np.random.default_rng((SEED, trial.pose))
    phantom = Phantom(loss.drawn or loss.true)
    if len(set(loss.voxel)) > 1:
        pose, turn = cases.along_slices(generator, tilt=TILT)
    else:
        pose, turn = cases.any_pose(generator), None
    case = cases.Case(spec=phantom.spec, voxel_size=loss.voxel, pose=pose, grid_rotation=turn)
    volume = cases.draw(phantom, case)
    if loss.least:
        volume = _keep(volume, _wall(phantom, volume, pose) >= loss.least)
    if loss.blur:
        sheet = _sheet_of(volume)
        kept = ndimage.gaussian_filter(sheet.astype(float), loss.blur / loss.voxel[0]) > _HALF
        volume = _grow(_keep(volume, kept), kept)
    if loss.closed:
        volume = _grow(volume, _closed(_sheet_of(volume), loss.closed, loss.voxel[0]))
    return volume


def _sheet_of(volume: LabelVolume) -> Bool:
    """Mark the voxels of the sheet's subfields."""
    return np.isin(volume.tissue, [int(one) for one in volume.protocol.sheet])


def _wall(phantom: Phantom, volume: LabelVolume, pose: Float) -> Float:
    """Look up the thickness of the wall round each voxel of the sheet, mm; 0 elsewhere."""
    at = np.argwhere(_sheet_of(volume))
    points = at @ volume.affine[:3, :3].T + volume.affine[:3, 3]
    u, v, _ = phantom.body.locate(points, pose=pose).T
    wall = np.zeros(volume.tissue.shape)
    wall[tuple(at.T)] = phantom.body.thickness(u, np.clip(v, 0.0, 1.0))
    return wall


def _keep(volume: LabelVolume, kept: Bool) -> LabelVolume:
    """Take the labels off the sheet's voxels that are not kept."""
    lost = _sheet_of(volume) & ~kept
    return replace(
        volume,
        tissue=np.where(lost, Tissue.BACKGROUND, volume.tissue).astype(volume.tissue.dtype),
        part=np.where(lost, Part.UNKNOWN, volume.part).astype(volume.part.dtype),
    )


def _grow(volume: LabelVolume, mask: Bool) -> LabelVolume:
    """Give all voxels of a mask the label of the nearest voxel of the sheet."""
    sheet = _sheet_of(volume)
    nearest = ndimage.distance_transform_edt(~sheet, return_distances=False, return_indices=True)
    tissue, part = (np.where(mask, x[tuple(nearest)], x) for x in (volume.tissue, volume.part))
    return replace(volume, tissue=tissue, part=part)


def _closed(mask: Bool, radius: float, voxel: float) -> Bool:
    """Close a mask with a ball, radius and edge of the voxels in mm."""
    pad = int(np.ceil(radius / voxel)) + 1
    outside = np.pad(~mask, pad, constant_values=True)
    near = ndimage.distance_transform_edt(outside, sampling=voxel) <= radius
    grown = ndimage.distance_transform_edt(near, sampling=voxel) > radius
    return np.asarray(grown[(slice(pad, -pad),) * 3] | mask)


Results = Mapping[Loss, Sequence[Sizes | cases.Refusal]]


@suite("paradox")
def run(full: bool) -> Iterator[Content]:
    """Measure all losses in the same poses."""
    poses = POSES_FULL if full else POSES_QUICK
    trials = {loss: [Trial(loss=loss, pose=pose) for pose in range(poses)] for loss in LOSSES}
    results = cases.run_groups(measure_trial, trials)
    yield _changes(results)
    yield _values(results)
    yield {"poses": poses, "edges": (WALL - MEDIAL_EDGE[0], WALL - LATERAL_EDGE[0])}


def average(loss: Loss, group: Sequence[Sizes | cases.Refusal]) -> dict[str, str | float]:
    """Average a loss over its poses: values by column."""
    measured = [one for one in group if isinstance(one, Sizes)]
    truth = Phantom(loss.true).truth(0.5, 0.5).summary

    def mean(name: str) -> float:
        return float(np.mean([getattr(one, name) for one in measured] or [np.nan]))

    return {
        "loss": loss.name,
        "kind": loss.kind,
        "strength": loss.strength,
        "strength_unit": loss.unit.replace("%", "percent"),
        "n_poses": len(group),
        "n_refused": len(group) - len(measured),
        "n_flagged": sum(one.flagged for one in measured),
        "true_thickness_mm": truth["thickness_mean"],
        "thickness_area_mm": mean("area"),
        "thickness_nodes_mm": mean("nodes"),
        "thickness_published_mm": mean("published"),
        "true_volume_mm3": truth["volume"],
        "volume_mm3": mean("volume"),
        "true_area_mm2": truth["area_mid"],
        "area_mm2": mean("surface"),
        "volume_per_area_mm": mean("volume") / mean("surface"),
    }


@table("paradox.changes")
def _changes(results: Results) -> Iterator[Cells | str]:
    """Compare each loss with the undamaged body in the same poses."""
    rows = [average(loss, group) for loss, group in results.items()]
    for loss, row in zip(results, rows, strict=True):
        if loss.kind != SOUND:
            yield _change(loss, row, rows[0])
    true, area = (float(rows[0][f"{name}_mm"]) for name in ("true_thickness", "thickness_area"))
    yield (
        f"The undamaged phantom reads {area:.2f} mm by area, and its true mean is {true:.2f} mm:"
        f" the grid spans {Settings().sheet.x_extent:.0%} of x, and edges are thin.\n"
    )
    names = {f"{loss.name}, {loss.strength:g}": group for loss, group in results.items()}
    yield cases.refusal_notes(names)


def _change(loss: Loss, row: Mapping[str, str | float], sound: Mapping[str, str | float]) -> Cells:
    """Compute the changes of one loss, percent."""

    def change(name: str) -> float:
        return 100.0 * (float(row[name]) / float(sound[name]) - 1.0)

    true, measured = change("true_thickness_mm"), change("thickness_area_mm")
    means = {name: change(f"thickness_{name}_mm") for name in ("area", "nodes", "published")}
    falls = change("volume_mm3") < -CHANGED
    rising = [name for name, value in means.items() if falls and value > CHANGED]
    judged = loss.kind == ACCURATE
    return {
        "loss": loss.name,
        "strength": f"{loss.strength:g} {loss.unit}",
        "true thickness": _signed(true),
        "thickness by area": _signed(measured),
        "by nodes": _signed(means["nodes"]),
        "by nodes, published method": _signed(means["published"]),
        "volume": _signed(change("volume_mm3")),
        "surface area": _signed(change("area_mm2")),
        "volume / area": _signed(change("volume_per_area_mm")),
        "rises as volume falls": None if np.isnan(measured) else ", ".join(rising) or "no",
        "flagged": f"{row['n_flagged']} of {row['n_poses']}",
        "target": f"± {MAX_ERROR:g}" if judged else None,
        "met": bool(abs(measured - true) <= MAX_ERROR) if judged else None,
    }


def _signed(value: float) -> Cell:
    return None if np.isnan(value) else f"{round(value, 1) + 0.0:+.1f}"  # no -0.0


@table("paradox.values")
def _values(results: Results) -> Iterator[Cells]:
    for loss, group in results.items():
        yield {name: _spelled(value) for name, value in average(loss, group).items()}


def _spelled(value: str | float) -> Cell:
    if isinstance(value, float):
        return None if np.isnan(value) else f"{value:.5g}"
    return value
