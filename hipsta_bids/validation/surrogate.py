"""The surrogate without a mesh against the mesh: two ways to thickness that share labels only."""

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hipsta_bids.artifacts import Float
from hipsta_bids.bids.dataset import HemisphereInput, InputRequest, find_hemispheres
from hipsta_bids.bids.images import read_label_volume
from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.agreement import agreement, compare_nearby
from hipsta_bids.geometry.body import extract_body
from hipsta_bids.geometry.surrogate import surrogate_profiles
from hipsta_bids.participant import measure_hemisphere
from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.schemes import load_scheme
from hipsta_bids.settings import Settings
from hipsta_bids.validation.suite import Cell, Picture, Suite, Table
from hipsta_bids.validation.workers import Refusal, run_cases

if TYPE_CHECKING:
    from matplotlib.figure import Figure

POSITIONS = (0.25, 0.5, 0.75)
"""Of the slices, fractions of the body's length."""

LEAST_CORRELATION = 0.9
"""Of surrogate and mesh, on phantoms of varying thickness."""

PHANTOMS = (
    PhantomSpec(kind="spiral", thickness=2.0, variation=0.3),
    PhantomSpec(kind="arc", thickness=2.0, variation=0.3),
    PhantomSpec(kind="s-shape", thickness=2.0, variation=0.3),
    PhantomSpec(kind="tight", thickness=1.6, variation=0.3),
    PhantomSpec(kind="spiral", thickness=1.2, variation=0.3),
)


@dataclass(frozen=True, eq=False, kw_only=True)
class Compared:
    """Thickness at the same places, by slice; all arrays (slices, N), mm."""

    fraction: Float
    """Of the medial axis, 0 at the medial rim."""
    surrogate: Float
    mesh: Float
    truth: Float
    """NaN where it is not known."""
    equidistant: tuple[tuple[Float, Float], ...]
    """Fraction and thickness of the other sampling, by slice."""
    problems: tuple[str, ...]
    """Of slices that the surrogate refused."""


def run(full: bool, labels: Path | None = None) -> Suite:
    """Compare on phantoms and, where there are any, on real segmentations.

    Parameters
    ----------
    full : bool
        All phantoms instead of one.
    labels : Path, optional
        A BIDS dataset with segmentations.

    Returns
    -------
    Suite
    """
    bodies: list[PhantomSpec | HemisphereInput] = list(PHANTOMS if full else PHANTOMS[:1])
    if labels is not None:
        bodies += [
            item for item in find_hemispheres(InputRequest(bids_dir=labels)) if not item.problem
        ]
    results = run_cases(compare_body, bodies)
    shown = [(_name(b), r) for b, r in zip(bodies, results, strict=True) if isinstance(r, Compared)]
    pictured = [*shown[:2], *shown[len(PHANTOMS if full else PHANTOMS[:1]) :][:2]]
    return Suite(
        name="surrogate",
        title="Thickness without a mesh",
        text=_TEXT.format(slices=", ".join(f"{p:.0%}" for p in POSITIONS)),
        tables=(_table(bodies, results),),
        pictures=(_picture(pictured),) if pictured else (),
    )


def compare_body(body: PhantomSpec | HemisphereInput) -> Compared:
    """Measure one body both ways.

    Raises
    ------
    GeometryError
        If the mesh is refused.
    """
    settings = Settings()
    phantom = Phantom(body) if isinstance(body, PhantomSpec) else None
    if isinstance(body, PhantomSpec):
        volume, hemi = Phantom(body).label_volume(load_scheme("freesurfer"), hemi="L"), "L"
    else:
        volume, hemi = read_label_volume(body), body.hemi
    maps = measure_hemisphere(volume, hemi, settings, lambda _: nullcontext())
    middle = maps.sheet.points[:, :, maps.sheet.middle].reshape(-1, 3)
    merged = extract_body(volume, settings.body)
    columns: list[tuple[Float, Float, Float, Float]] = []
    others, problems = [], []
    for position in POSITIONS:
        try:
            even, steps = surrogate_profiles(merged, position, settings.sheet, settings.surrogate)
        except GeometryError as error:
            problems.append(error.reason)
            continue
        mesh = compare_nearby(even.points, middle, maps.thickness.ravel(), settings.surrogate.reach)
        columns.append((even.fraction, even.thickness, mesh, _truth(phantom, even.points)))
        others.append((steps.fraction, steps.thickness))
    stacked = np.array(columns).reshape(len(columns), 4, settings.sheet.x_nodes)
    return Compared(
        fraction=stacked[:, 0],
        surrogate=stacked[:, 1],
        mesh=stacked[:, 2],
        truth=stacked[:, 3],
        equidistant=tuple(others),
        problems=tuple(problems),
    )


def _truth(phantom: Phantom | None, points: Float) -> Float:
    """Look up true thickness (N,) beside points; NaN outside of the phantom's rims."""
    if phantom is None:
        return np.full(len(points), np.nan)
    u, v, _ = phantom.body.locate(points).T
    inside = np.isfinite(u)
    found = phantom.truth(np.where(inside, u, 0.5), np.where(inside, v, 0.5))
    return np.where(inside, found.thickness, np.nan)


def _name(body: PhantomSpec | HemisphereInput) -> str:
    if isinstance(body, PhantomSpec):
        return f"{body.kind} {body.thickness:g} mm, ±{body.variation:.0%}"
    return f"sub-{body.subject} {body.hemi} ({body.scheme.name})"


def _table(
    bodies: Sequence[PhantomSpec | HemisphereInput], results: Sequence[Compared | Refusal]
) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for body, result in zip(bodies, results, strict=True):
        is_phantom = isinstance(body, PhantomSpec)
        target = f"r ≥ {LEAST_CORRELATION}" if is_phantom else "n/a"
        if isinstance(result, Refusal):
            rows.append(
                (_name(body), result.reason, *[None] * 6, target, False if is_phantom else None)
            )
            continue
        pair = agreement(result.surrogate.ravel(), result.mesh.ravel())
        true = agreement(result.surrogate.ravel(), result.truth.ravel())
        met = bool(pair.correlation >= LEAST_CORRELATION) if is_phantom else None
        rows.append(
            (
                _name(body),
                "; ".join(result.problems) or f"{len(result.surrogate)} slices",
                pair.correlation,
                pair.slope,
                pair.difference,
                pair.deviation,
                true.correlation if is_phantom else None,
                true.slope if is_phantom else None,
                target,
                met,
            )
        )
    return Table(
        title="Surrogate against mesh",
        columns=(
            "body",
            "slices",
            "r",
            "slope",
            "difference, mm",
            "SD, mm",
            "r with truth",
            "slope on truth",
            "target",
            "met",
        ),
        rows=tuple(rows),
        notes=_NOTES,
    )


def _picture(shown: Sequence[tuple[str, Compared]]) -> Picture:
    def draw(figure: "Figure") -> None:
        axes = figure.subplots(1, len(shown), sharey=True, squeeze=False)[0]
        for axis, (name, result) in zip(axes, shown, strict=True):
            k = len(result.surrogate) // 2
            x = result.fraction[k]
            if np.isfinite(result.truth[k]).any():
                axis.plot(x, result.truth[k], color="0.6", linewidth=3, label="truth")
            axis.plot(x, result.mesh[k], "C0-", label="mesh")
            axis.plot(x, result.surrogate[k], "C1o", markersize=3, label="proportional")
            axis.plot(*result.equidistant[k], "C3+", markersize=5, label="equidistant")
            axis.set_title(name, fontsize="small")
            axis.set_xlabel("place on the medial axis")
        axes[0].set_ylim(bottom=0)
        axes[0].set_ylabel("thickness, mm")
        axes[0].legend(fontsize="small")

    return Picture(
        name="surrogate",
        caption="Thickness from medial (0) to lateral (1) in the middle slice: of the mesh, and of"
        " the surrogate with proportional and equidistant sampling. At the rims the closest points"
        " lie on the rounded ends.",
        draw=draw,
        size=(3.0 * max(len(shown), 2), 3.2),
    )


_TEXT = """\
`hipsta-bids surrogate` measures thickness in single slices from the medial axis of the labels and
the closest points of their outline on both sides, without a mesh (here at {slices} of the body's
length). It shares the labels with the mesh and nothing else: a thickening that both show lies in
the labels, one that the mesh alone shows does not.
"""

_NOTES = """\
Phantoms in voxels of 0.4 mm. At each point of the proportional sampling, the mesh's thickness is
that of the mid-surface nearby. Slope: of the surrogate on the other, by least squares over all
slices. The surrogate is measured in the plane of the slice: where the wall is oblique to it, as in
real bodies, it reads more than a line straight through the wall. It repairs nothing: where labels
touch across a fold it reads the sum of both walls, or finds a loop and refuses the slice.
"""
