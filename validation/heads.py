"""Phantoms with a head and digitations: thickness, and whether folds that touch are found."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from hipsta_bids.phantom.head import HeadSpec, draw_head
from hipsta_bids.settings import Settings
from hipsta_bids.types import Float
from validation.cases import Refusal, measure_body, run_cases
from validation.report import Cells, Content, suite, table

MAX_BIAS = 0.03
"""mm, of the head's mean thickness."""
WRONG = 0.5
"""mm; columns that are off by more are counted."""
VOXELS = (0.3, 0.4)
"""mm."""
_HEAD = 30
"""The last row of the body."""

_FOLDS = HeadSpec(thickness=1.2, straight=36.0, ends=(5.0, 18.0), digitations=3)
_THICK = replace(_FOLDS, thickness=2.0, digitations=2)
_OPEN = (*(replace(_FOLDS, digitations=count) for count in range(5)), _THICK)
_NARROW = tuple(replace(_FOLDS, exterior=width) for width in (0.6, 0.4, 0.3, 0.2))
_TOUCHING = (
    *(replace(_FOLDS, digitations=count, exterior=0.0) for count in (2, 3, 4)),
    *(replace(_FOLDS, digitations=count, interior=0.0, exterior=1.2) for count in (1, 2, 3, 4)),
    replace(_FOLDS, filled="deep"),
    replace(_FOLDS, filled="shallow"),
    replace(_THICK, exterior=0.0),
    replace(_THICK, interior=0.0, exterior=1.2),
    replace(_THICK, filled="deep"),
    replace(_THICK, filled="shallow"),
    *(replace(_FOLDS, bank=bank, exterior=0.0) for bank in (1.0, 0.75, 0.5, 0.25, 0.0)),
    *(replace(_FOLDS, bank=bank, interior=0.0) for bank in (0.75, 0.5, 0.25, 0.0)),
    replace(_THICK, bank=0.5, exterior=0.0),
    replace(_THICK, bank=0.5, interior=0.0),
)
_UNEVEN = tuple(
    replace(_FOLDS, uneven=uneven, digitations=count, interior=width, exterior=width)
    for uneven, width in ((0.3, 0.8), (-0.3, 1.2), (0.4, 0.8))
    for count in (0, 2)
)


@suite("heads")
def run(full: bool) -> Iterator[Content]:
    """Measure heads with open clefts, with narrow ones, with banks that touch, and uneven walls."""
    groups = (_OPEN, _NARROW, _TOUCHING, _UNEVEN) if full else (_OPEN[3:4], (), _TOUCHING[1:2], ())
    voxels = VOXELS if full else VOXELS[1:]
    specs = [[replace(s, voxel=v) for v in voxels for s in group] for group in groups]
    results = iter(run_cases(_measure, [s for group in specs for s in group], timeout=120.0))
    for name, group in zip(("open", "narrow", "touching", "uneven"), specs, strict=True):
        if group:
            yield table(f"heads.{name}")(_rows)(group, results)


def _rows(
    group: Sequence[HeadSpec], results: Iterator[tuple[Float, int] | Refusal]
) -> Iterator[Cells]:
    yield from (_row(spec, next(results)) for spec in group)


def _measure(spec: HeadSpec) -> tuple[Float, int]:
    """Error (N,) of the head's columns with values, mm, and how many places of banks touch."""
    settings = Settings().changed(body={"region": "whole"})
    maps = measure_body(draw_head(spec), "L", settings)
    head = maps.thickness[:, _HEAD + 1 :]
    reasons = [flag.reason for flag in maps.flags]
    return head[np.isfinite(head)] - spec.thickness, reasons.count("fused-digitation")


def _row(spec: HeadSpec, result: tuple[Float, int] | Refusal) -> Cells:
    """Bias where all clefts are wide, no wrong column where they are narrow; found elsewhere."""
    clefts = f"{spec.interior:g} / {spec.exterior:g}"
    if spec.filled:
        clefts += f", {spec.filled} half filled"
    if spec.bank != _FOLDS.bank:
        clefts += f", banks of {spec.bank:g}"
    what: Cells = {
        "voxels": f"{spec.voxel:g}",
        "thickness": f"{spec.thickness:g}",
        "digitations": spec.digitations,
        "clefts, interior / exterior": clefts,
    }
    if isinstance(result, Refusal):
        return {**what, "target": str(result), "met": False}
    error, places = result
    if spec.uneven:
        found: Cells = {"found": places, "target": "none", "met": not places}
        return {**what, "uneven": f"{spec.uneven:+.0%}", **found}
    off = float(np.mean(np.abs(error) > WRONG))
    bias = float(error.mean())
    if not spec.interior * spec.exterior or spec.filled:
        target, met = "found", places > 0
    elif spec.exterior < _FOLDS.exterior:
        target, met = "off 0 %", off == 0
    else:
        target = f"bias within {MAX_BIAS:g}, none found"
        met = abs(bias) <= MAX_BIAS and not places
    return {
        **what,
        "bias": f"{bias:+.3f}",
        "SD": float(error.std()),
        "off": f"{off:.1%}",
        "found": places,
        "target": target,
        "met": met,
    }
