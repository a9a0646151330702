"""Sheets too thin for their voxels: refused or flagged, never silently wrong."""

from collections.abc import Sequence

import numpy as np

from hipsta_bids.phantom import PhantomSpec
from hipsta_bids.validation.cases import Case, Measured, any_pose, measure_case
from hipsta_bids.validation.suite import Cell, Suite, Table
from hipsta_bids.validation.workers import Refusal, run_cases

SEED = 20233
MAX_SILENT_ERROR = 0.15
"""mm; where the mean is farther off, the hemisphere has to be refused or flagged."""


def run(full: bool) -> Suite:
    """Measure ever thinner sheets in ever larger voxels.

    Parameters
    ----------
    full : bool
        Sixteen pairs of thickness and voxel size instead of four.

    Returns
    -------
    Suite
    """
    cases = _cases(full=full)
    return Suite(
        name="limits",
        title="Limits",
        text="Spirals, isotropic voxels, one pose each.",
        tables=(_table(cases, run_cases(measure_case, cases)),),
    )


def _cases(*, full: bool) -> list[Case]:
    """Go from comfortable to far too thin."""
    sizes = (0.4, 0.6, 0.8, 1.0) if full else (0.5, 1.0)
    walls = (0.8, 1.2, 1.6, 3.0) if full else (0.8, 1.6)
    return [
        Case(
            spec=PhantomSpec(kind="spiral", thickness=wall, curvature=(0.02, 0.35)),
            voxel_size=(size, size, size),
            pose=any_pose(np.random.default_rng((SEED, i, j))),
        )
        for i, wall in enumerate(walls)
        for j, size in enumerate(sizes)
    ]


def _table(cases: Sequence[Case], results: Sequence[Measured | Refusal]) -> Table:
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
