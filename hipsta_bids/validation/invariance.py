"""What may not change a map: where the subject lies, how voxels are stored, and mirroring."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hipsta_bids.artifacts import Float
from hipsta_bids.phantom import PhantomSpec
from hipsta_bids.validation.cases import Case, Measured, any_pose, measure_case, random_motion
from hipsta_bids.validation.suite import Cell, Picture, Suite, Table
from hipsta_bids.validation.workers import Refusal, run_cases

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

AXES = ("RAS", "PIR", "ASL")
"""Orders and directions of voxel axes that are compared with LIA."""

SPEC = PhantomSpec(kind="spiral", thickness=2.0, variation=0.15)


@dataclass(frozen=True, eq=False, kw_only=True)
class Motions:
    """Maps of one phantom in many positions."""

    thickness: Float
    """(M, Nx, Ny) mm."""

    @property
    def pointwise(self) -> Float:
        """SD over the motions at each point, (Nx, Ny) mm."""
        return np.asarray(self.thickness.std(axis=0, ddof=1))


def run(full: bool) -> Suite:
    """Measure one phantom in many positions, and pairs of equal voxels in different form.

    Parameters
    ----------
    full : bool
        20 motions and 4 pairs instead of 6 and 1.

    Returns
    -------
    Suite
    """
    count = MOTIONS_FULL if full else MOTIONS_QUICK
    pairs = PAIRS_FULL if full else PAIRS_QUICK
    kinds = {"any rotation": random_motion, "up to 25° about each axis": any_pose}
    cases: list[Case] = []
    for number, pose in enumerate(kinds.values()):
        generator = np.random.default_rng((SEED, number))
        cases += [Case(spec=SPEC, pose=pose(generator)) for _ in range(count)]
    first = len(cases)
    per_pair = 2 + len(AXES)
    for number in range(pairs):
        cases += _pair(number)
    results = run_cases(measure_case, cases)
    groups = {name: results[i * count : (i + 1) * count] for i, name in enumerate(kinds)}
    motions = {name: _motions(group) for name, group in groups.items()}
    same = [results[first + i * per_pair : first + (i + 1) * per_pair] for i in range(pairs)]
    return Suite(
        name="invariance",
        title="Invariance",
        text=_TEXT,
        tables=(_motion_table(groups, motions), _pair_table(same)),
        pictures=(_picture(motions),),
    )


def _pair(number: int) -> list[Case]:
    """Cases of one pose: as it is, mirrored, and with other voxel axes."""
    pose = any_pose(np.random.default_rng((SEED, 100, number)))
    return [
        Case(spec=SPEC, pose=pose),
        Case(spec=SPEC, pose=pose, mirrored=True),
        *(Case(spec=SPEC, pose=pose, axes=axes) for axes in AXES),
    ]


def _motions(group: Sequence[Measured | Refusal]) -> Motions | None:
    maps = [m.thickness for m in group if isinstance(m, Measured)]
    return Motions(thickness=np.array(maps)) if len(maps) > 1 else None


def _motion_table(
    groups: dict[str, list[Measured | Refusal]], motions: dict[str, Motions | None]
) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for name, group in groups.items():
        found = motions[name]
        refused = sum(isinstance(m, Refusal) for m in group)
        if found is None:
            rows.append((name, len(group), refused, *(None,) * 6, False))
            continue
        of_mean = float(found.thickness.mean(axis=(1, 2)).std(ddof=1))
        overall = float(np.sqrt((found.pointwise**2).mean()))
        good = of_mean <= MAX_SD_OF_MEAN and overall <= MAX_POINTWISE_SD and not refused
        rows.append(
            (
                name,
                len(group),
                refused,
                of_mean,
                overall,
                float(np.median(found.pointwise)),
                float(np.quantile(found.pointwise, 0.95)),
                f"≤ {MAX_SD_OF_MEAN:g}",
                f"≤ {MAX_POINTWISE_SD:g}",
                good,
            )
        )
    return Table(
        title="One phantom in many positions, mm",
        columns=(
            "motions",
            "number",
            "refused",
            "SD of the mean",
            "SD of a point (RMS)",
            "median",
            "95th percentile",
            "target, mean",
            "target, point",
            "met",
        ),
        rows=tuple(rows),
        digits=4,
        notes="A point is a node of the sheet's grid; the SD is over the motions.",
    )


def _pair_table(pairs: Sequence[Sequence[Measured | Refusal]]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for column, name in enumerate(("mirror image", *(f"voxel axes {axes}" for axes in AXES)), 1):
        both = [(pair[0], pair[column]) for pair in pairs]
        changes = [
            b.thickness - a.thickness
            for a, b in both
            if isinstance(a, Measured) and isinstance(b, Measured)
        ]
        if len(changes) < len(both):
            rows.append((name, None, None, None, f"≤ {MAX_CHANGE:g}", False))
            continue
        absolute = np.abs(changes)
        rows.append(
            (
                name,
                f"{np.mean(changes):+.5f}",
                f"{absolute.mean():.5f}",
                f"{absolute.max():.5f}",
                f"≤ {MAX_CHANGE:g}",
                bool(absolute.mean() <= MAX_CHANGE),
            )
        )
    return Table(
        title="The same voxels in another form: change of thickness, mm",
        columns=("form", "mean", "mean absolute", "largest", "target, mean absolute", "met"),
        rows=tuple(rows),
        notes=f"Number of poses: {len(pairs)}.",
    )


def _picture(motions: dict[str, Motions | None]) -> Picture:
    found = {name: motion for name, motion in motions.items() if motion is not None}

    def draw(figure: "Figure") -> None:
        axes = figure.subplots(1, max(1, len(found)), squeeze=False)[0]
        for axis, (name, motion) in zip(axes, found.items(), strict=False):
            image = axis.imshow(
                motion.pointwise.T, origin="lower", cmap="viridis", vmin=0, vmax=0.1, aspect="auto"
            )
            axis.set_title(name)
            shape = motion.pointwise.shape
            axis.set_xticks([0, shape[0] - 1], ["medial", "lateral"])
            axis.set_yticks([0, shape[1] - 1], ["posterior", "anterior"])
            figure.colorbar(image, ax=axis, label="SD, mm")

    return Picture(
        name="invariance",
        caption="SD of thickness over the motions at each point of the sheet, mm.",
        draw=draw,
        size=(9.0, 3.2),
    )


_TEXT = """\
One spiral of 2.0 mm ± 15 % in voxels of 0.4 mm. First in random positions: the phantom moves and
the grid stays, so that every position gives other voxels. Motions are uniform over all rotations
with shifts of up to 20 mm, and, as subjects lie in a scanner, of up to 25° and 2 mm. Then the very
same voxels mirrored (a left hemisphere becomes a right one) and stored in another order.
"""
