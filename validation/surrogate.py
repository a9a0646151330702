"""Thickness in single slices beside that of the mesh (Diers et al. 2023, appendix C)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hipsta_bids.errors import GeometryError
from hipsta_bids.extensions.surrogate.crosscheck import MATCH_REACH
from hipsta_bids.extensions.surrogate.medial_axis import surrogate_profiles
from hipsta_bids.geometry.agreement import agreement, compare_nearby
from hipsta_bids.geometry.body import extract_body
from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.settings import Settings
from hipsta_bids.types import Float
from validation import cases
from validation.cases import Refusal, ValidationBody
from validation.report import Cell, Cells, Content, picture, suite, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

POSITIONS = (0.25, 0.5, 0.75)
"""Of the slices, fractions of the body's length."""

VOXEL = 0.4
"""mm, of phantoms."""

LEAST_CORRELATION = 0.9
"""Of surrogate and mesh, on phantoms of varying thickness."""

PHANTOMS = (
    PhantomSpec(kind="spiral", thickness=2.0, variation=0.3),
    PhantomSpec(kind="arc", thickness=2.0, variation=0.3),
    PhantomSpec(kind="s-shape", thickness=2.0, variation=0.3),
    PhantomSpec(kind="tight", thickness=1.6, variation=0.3),
    PhantomSpec(kind="spiral", thickness=1.2, variation=0.3),
)


@dataclass(frozen=True, eq=False)
class Compared:
    """Thickness at the same points, by slice; all arrays (slices, N), mm."""

    fraction: Float
    """Of the medial axis, 0 at the medial edge."""
    surrogate: Float
    mesh: Float
    truth: Float
    """NaN where it is not known."""
    equidistant: tuple[tuple[Float, Float], ...]
    """Fraction and thickness of the other sampling, by slice."""
    problems: tuple[str, ...]
    """Of slices that the surrogate refused."""


@suite("surrogate")
def run(full: bool, labels: Path | None = None) -> Iterator[Content]:
    """Compare on phantoms and, where there are any, on real segmentations."""
    phantoms = PHANTOMS[: None if full else 1]
    bodies: list[ValidationBody] = [*phantoms, *(cases.segmentations(labels) if labels else ())]
    results = cases.run_cases(compare_body, bodies)
    shown = [(_name(b), r) for b, r in zip(bodies, results, strict=True) if isinstance(r, Compared)]
    pictured = [*shown[:2], *shown[len(phantoms) :][:2]]
    yield _table(bodies, results)
    if pictured:
        yield _picture(pictured)
    yield {"slices": ", ".join(f"{p:.0%}" for p in POSITIONS)}


def compare_body(body: ValidationBody) -> Compared:
    """Measure one body both ways."""
    settings = Settings()
    phantom = Phantom(body) if isinstance(body, PhantomSpec) else None
    volume, hemi = cases.load_body(body, VOXEL)
    maps = cases.measure_body(volume, hemi)
    middle = maps.sheet.points[:, :, maps.sheet.middle].reshape(-1, 3)
    merged = extract_body(volume, settings.body)
    columns: list[tuple[Float, Float, Float, Float]] = []
    others, problems = [], []
    for position in POSITIONS:
        try:
            even, steps = surrogate_profiles(merged, position, settings.sheet)
        except GeometryError as error:
            problems.append(error.reason)
            continue
        mesh = compare_nearby(even.points, middle, maps.thickness.ravel(), MATCH_REACH)
        columns.append((even.fraction, even.thickness, mesh, _truth(phantom, even.points)))
        others.append((steps.fraction, steps.thickness))
    stacked = np.array(columns).reshape(len(columns), 4, settings.sheet.x_nodes)
    fraction, thickness, mesh, truth = np.moveaxis(stacked, 1, 0)
    return Compared(fraction, thickness, mesh, truth, tuple(others), tuple(problems))


def _truth(phantom: Phantom | None, points: Float) -> Float:
    """Look up true thickness (N,) beside points; NaN where it is not known."""
    if phantom is None:
        return np.full(len(points), np.nan)
    truth, inside = cases.truth_at(phantom, points)
    return np.where(inside, truth.thickness, np.nan)


def _name(body: ValidationBody) -> str:
    if isinstance(body, PhantomSpec):
        return f"{body.kind} {body.thickness:g} mm, ±{body.variation:.0%}"
    return f"sub-{body.subject} {body.hemi} ({body.protocol.name})"


@table("surrogate.mesh")
def _table(
    bodies: Sequence[ValidationBody], results: Sequence[Compared | Refusal]
) -> Iterator[Cells]:
    for body, result in zip(bodies, results, strict=True):
        is_phantom = isinstance(body, PhantomSpec)
        cells: dict[str, Cell] = {"body": _name(body)}
        met = False
        if isinstance(result, Refusal):
            cells["slices"] = result.reason
        else:
            pair = agreement(result.surrogate.ravel(), result.mesh.ravel())
            true = agreement(result.surrogate.ravel(), result.truth.ravel())
            met = bool(pair.correlation >= LEAST_CORRELATION)
            cells |= {
                "slices": "; ".join(result.problems) or f"{len(result.surrogate)} slices",
                "r": pair.correlation,
                "slope": pair.slope,
                "difference, mm": pair.difference,
                "SD, mm": pair.deviation,
                "r with truth": true.correlation if is_phantom else None,
                "slope on truth": true.slope if is_phantom else None,
            }
        cells["target"] = f"r ≥ {LEAST_CORRELATION}" if is_phantom else "n/a"
        yield {**cells, "met": met if is_phantom else None}


@picture("surrogate")
def _picture(figure: "Figure", shown: Sequence[tuple[str, Compared]]) -> None:
    figure.set_size_inches(3.0 * max(len(shown), 2), 3.2)
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
        axis.set_xlabel("position on the medial axis")
    axes[0].set_ylim(bottom=0)
    axes[0].set_ylabel("thickness, mm")
    axes[0].legend(fontsize="small")
