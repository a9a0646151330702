"""Ends of the body: found where no label says so, and oblique where labels do."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry.body import extract_body
from hipsta_bids.geometry.digital import to_ras
from hipsta_bids.phantom import Phantom, PhantomSpec
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Part, Tissue
from hipsta_bids.settings import BodySettings, Settings
from hipsta_bids.types import End, Float, LabelVolume
from validation import cases
from validation.cases import Refusal, ValidationBody
from validation.population import find_bodies, is_fine
from validation.report import Cell, Cells, Content, suite, table
from validation.thick_slices import FULL_VOXEL, PHANTOMS, PIXEL, reslice

ENDS: tuple[End, End] = ("posterior", "anterior")

STEPS = (PIXEL, 1.5, 2.0)
"""mm between slices."""
OFFSETS = (0.0, 0.25, 0.5, 0.75)
"""Of slices, fractions of their distance."""
TILTS = (0.0, 8.0, -8.0)
"""Degrees."""

#: How ends are found: with default settings, and with oblique cross-sections left in the body.
FOUND, KEPT = "end", "end, oblique sections kept"

Copy = tuple[float, float, float]
"""Distance of a body's slices in mm, their offset and their tilt."""

MAX_SPREAD = (0.3, 0.3, 0.4, 3.0)
"""mm, over the copies of a body: SD of the posterior end, of the anterior end and of the length,
mean over bodies; largest range of the length."""
MAX_OFF = {"phantoms": (0.5, 0.5), "labels": (0.5, 1.5)}
"""mm, posterior and anterior: how far ends lie from where labels have them, root mean square."""
MAX_SIDES = 3.0
"""mm, largest error of a difference of length between left and right."""
_NEAR = 1.0
"""mm; voxels of the sheet that are nearer to an end plane are its cross-section."""

OBLIQUE = tuple(
    PhantomSpec(kind=kind, thickness=2.0, length=18.0, end_length=4.0) for kind in ("arc", "spiral")
)
DEGREES = (10.0, 20.0, 35.0)
"""Tilt of end planes."""
ABOUT = ("width", "thickness")
_ROWS = ("first row", "second", "last but one", "last")
MAX_ROW = 0.08
"""mm, error of the mean thickness of the two rows beside each end."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """A body, and the copies of it whose ends are found."""

    body: ValidationBody
    copies: tuple[Copy, ...]

    @property
    def kind(self) -> str:
        """Key of ``MAX_OFF``."""
        return "phantoms" if isinstance(self.body, PhantomSpec) else "labels"

    @property
    def name(self) -> str:
        """For people."""
        body = self.body
        if isinstance(body, PhantomSpec):
            return f"phantom {body.kind}"
        return f"{body.subject} {body.hemi} ({body.protocol.name})"


@dataclass(frozen=True, eq=False, kw_only=True)
class Found:
    """Ends of one body and of its copies."""

    copies: Float
    """(N, 4) posterior and anterior end of each copy, mm anterior of where labels have it or,
    without such labels, of where it is in the body's own voxels; then their uncertainties, mm."""
    refused: int
    own: Mapping[str, tuple[float, float]]
    """Both ends in the body's own voxels, by variant; empty without labels that say where."""


Oblique = tuple[PhantomSpec, float, str]
"""A phantom whose head and tail labels end at planes, their tilt in degrees, and the direction that
they are tilted about: across the sheet, or through it."""


@suite("ends")
def run(full: bool, labels: Path | None = None) -> Iterator[Content]:
    """Find ends without labels on copies of bodies; measure bodies between oblique end planes."""
    bodies: list[ValidationBody] = [*PHANTOMS[: None if full else 1]]
    if labels:
        fine = [
            body for body in find_bodies(labels) if is_fine(cases.load_body(body, FULL_VOXEL)[0])
        ]
        bodies += fine if full else fine[:2]
    plan = (STEPS, OFFSETS, TILTS) if full else (STEPS[-1:], OFFSETS[::2], TILTS[:1])
    copies = tuple(product(*plan))
    jobs = [Job(body=body, copies=copies) for body in bodies]
    found = dict(zip(jobs, cases.run_cases(find_ends, jobs, timeout=120.0), strict=True))
    choices = (OBLIQUE, DEGREES, ABOUT) if full else (OBLIQUE[:1], DEGREES[-1:], ABOUT[:1])
    tilted = list(product(*choices))
    yield _copies_table(found)
    yield _places_table(found)
    yield _oblique_table(tilted, cases.run_cases(measure_oblique, tilted))
    yield cases.left_out(labels)


def find_ends(job: Job) -> Found:
    """Find the ends of a body, and of its copies, whose head and tail labels are taken away."""
    settings = Settings().body
    volume, _ = cases.load_body(job.body, FULL_VOXEL)
    body = extract_body(volume, settings)
    points = body.inside_points()[1]
    near = {end: points[np.abs(body.ends.height(points, end)) < _NEAR] for end in ENDS}

    def places(labels: LabelVolume, settings: BodySettings = settings) -> list[float]:
        ends = extract_body(labels, settings).ends
        gaps = [body.ends.height(near[end], end) - ends.height(near[end], end) for end in ENDS]
        unsure = ends.posterior.uncertainty, ends.anterior.uncertainty
        return [*(float(gap.mean()) for gap in gaps), *unsure]

    bare = _without_ends(volume, job.body)
    own: dict[str, tuple[float, float]] = {}
    if volume.part.any():
        ways = {FOUND: settings, KEPT: settings.changed(end_reach=0.0)}
        for way, chosen in ways.items():
            posterior, anterior, *_ = places(bare, chosen)
            own[way] = posterior, anterior
    found = list[list[float]]()
    for step, offset, tilt in job.copies:
        copy = reslice(bare, body.ends.axis, (PIXEL, PIXEL, step), offset=offset, tilt=tilt)
        with suppress(GeometryError):
            found.append(places(copy))
    return Found(
        copies=np.array(found).reshape(-1, 4), refused=len(job.copies) - len(found), own=own
    )


def _without_ends(volume: LabelVolume, body: ValidationBody) -> LabelVolume:
    """Take head and tail away where labels say no more; a phantom is drawn as HippUnfold labels."""
    if isinstance(body, PhantomSpec):  # CA2 and CA3 end with the body
        return Phantom(body).label_volume(load_protocol("hippunfold"), voxel_size=(FULL_VOXEL,) * 3)
    tissue = np.where(volume.tissue == Tissue.HIPPOCAMPUS, np.uint8(0), volume.tissue)
    return replace(volume, tissue=tissue, part=np.zeros_like(volume.part))


def cut_obliquely(phantom: Phantom, volume: LabelVolume, degrees: float, about: str) -> LabelVolume:
    """Let head and tail begin at v of 0.2 and 0.8, at planes tilted about a direction.

    ``about`` is ``width``, across the sheet, or ``thickness``, through it.
    """
    points = to_ras(np.moveaxis(np.indices(volume.tissue.shape), 0, -1), volume.affine)
    first, last = (phantom.body.place(0.5, v, 0.0) for v in (0.2, 0.8))
    axis = (last - first) / np.linalg.norm(last - first)
    across = phantom.body.place(0.5, 0.5, 1.0) - phantom.body.place(0.5, 0.5, -1.0)
    across -= axis * (across @ axis)
    across /= np.linalg.norm(across)
    lean = across if about == "width" else np.cross(axis, across)
    normal = np.cos(np.deg2rad(degrees)) * axis + np.sin(np.deg2rad(degrees)) * lean
    below, above = (points - first) @ normal < 0, (points - last) @ normal > 0
    part = np.where(below, Part.TAIL, np.where(above, Part.HEAD, Part.BODY))
    labeled = (volume.tissue > 0) & (volume.tissue < Tissue.HIPPOCAMPUS)
    tissue = np.where(labeled & below, Tissue.HIPPOCAMPUS, volume.tissue)
    return replace(volume, tissue=tissue, part=np.where(tissue > 0, part, 0))


def measure_oblique(case: Oblique) -> tuple[str, Float]:
    """Measure a phantom between oblique planes: decision, and error of thickness (Nx, Ny), mm."""
    spec, degrees, about = case
    phantom = Phantom(spec)
    volume = phantom.label_volume(load_protocol("freesurfer"))
    maps = cases.measure_body(cut_obliquely(phantom, volume, degrees, about), "L")
    truth, inside = cases.truth_at(phantom, maps.sheet.points[:, :, maps.sheet.middle])
    return maps.decision, np.where(inside, maps.thickness - truth.thickness, np.nan)


@table("ends.copies")
def _copies_table(results: Mapping[Job, Found | Refusal]) -> Iterator[Cells | str]:
    """SD of ends over copies, by body and in the mean."""
    for kind in MAX_OFF:
        group = {job: r for job, r in results.items() if job.kind == kind}
        found = {job: r for job, r in group.items() if isinstance(r, Found) and len(r.copies) > 1}
        numbers = [_numbers(job, result) for job, result in found.items()]
        for job, row in zip(found, numbers, strict=True):
            yield {"body": job.name, **dict(zip(_COLUMNS, row, strict=True))}
        if group:
            mean, met = dict[str, Cell](), False
            if found:
                overall = np.mean(numbers, axis=0)
                overall[3] = np.max(numbers, axis=0)[3]
                met = bool((overall[:4] <= MAX_SPREAD).all())
                mean = dict(zip(_COLUMNS, map(float, overall), strict=True))
            refused = sum(
                result.refused if isinstance(result, Found) else len(job.copies)
                for job, result in group.items()
            )
            targets = ", ".join(f"{limit:g}" for limit in MAX_SPREAD)
            mean = {"body": f"{kind}, mean", **mean, "refused": refused, "targets": targets}
            yield {**mean, "met": met and not refused}
    yield cases.refusal_notes({job.name: [result] for job, result in results.items()})


_COLUMNS = (
    "SD, posterior",
    "SD, anterior",
    "SD, length",
    "range, length",
    "by slices alone",
    "uncertainty, posterior",
    "uncertainty, anterior",
)


def _numbers(job: Job, found: Found) -> list[float]:
    """Compute a row of the table, by ``_COLUMNS``."""
    # An edge between two slices may be anywhere between them: the SD of a uniform distribution.
    alone = np.sqrt(np.mean([step**2 / 12 for step, _, _ in job.copies]))
    longer = found.copies[:, 1] - found.copies[:, 0]
    spread = np.column_stack([found.copies[:, :2], longer]).std(axis=0, ddof=1)
    row = [*spread, np.ptp(longer), alone, *found.copies[:, 2:].mean(axis=0)]
    return [float(number) for number in row]


@table("ends.places")
def _places_table(results: Mapping[Job, Found | Refusal]) -> Iterator[Cells]:
    """Where ends are found in a body's own voxels, against where labels have them."""
    found = {job: r.own for job, r in results.items() if isinstance(r, Found) and r.own}
    for (kind, limits), variant in product(MAX_OFF.items(), (FOUND, KEPT)):
        group = [own[variant] for job, own in found.items() if job.kind == kind and variant in own]
        for k, end in enumerate(ENDS if group else ()):
            off = [ends[k] for ends in group]
            if variant == FOUND:
                row = _place_row(kind, f"{end} {variant}", off)
                yield {**row, "target": f"RMS ≤ {limits[k]:g}", "met": cases.rms(off) <= limits[k]}
            elif end == ENDS[0]:
                yield _place_row(kind, f"{end} {variant}", off)
    sides: dict[str, list[float]] = {}
    for job, own in found.items():
        if not isinstance(job.body, PhantomSpec):
            sides.setdefault(job.body.subject, []).append(own[FOUND][1] - own[FOUND][0])
    if pairs := [both[0] - both[1] for both in sides.values() if len(both) > 1]:
        met = max(map(abs, pairs)) <= MAX_SIDES
        row = _place_row("labels", "length, left minus right", pairs)
        yield {**row, "target": f"largest ≤ {MAX_SIDES:g}", "met": met}


def _place_row(kind: str, what: str, off: Sequence[float]) -> Cells:
    mean, largest = f"{np.mean(off):+.2f}", float(np.abs(off).max())
    cells: Cells = {"bodies": kind, "number": len(off), "what": what}
    return {**cells, "mean": mean, "RMS": cases.rms(off), "largest": largest}


@table("ends.oblique")
def _oblique_table(
    tilted: Sequence[Oblique], results: Sequence[tuple[str, Float] | Refusal]
) -> Iterator[Cells | str]:
    """Error of thickness beside oblique end planes."""
    names = [f"{spec.kind}, {degrees:g}° about the {about}" for spec, degrees, about in tilted]
    for name, result in zip(names, results, strict=True):
        cells: dict[str, Cell] = {"planes": name}
        met = False
        if not isinstance(result, Refusal):
            decision, error = result
            of_rows = np.nanmean(error, axis=0)
            ends = of_rows[[0, 1, -2, -1]]
            met = bool(np.abs(ends).max() <= MAX_ROW) and decision == "use"
            cells |= {
                "decision": decision,
                **{row: f"{value:+.3f}" for row, value in zip(_ROWS, ends, strict=True)},
                "all rows": f"{of_rows.mean():+.3f}",
                "largest of a column": float(np.nanmax(np.abs(error))),
            }
        yield {**cells, "target": f"≤ {MAX_ROW:g}", "met": met}
    yield cases.refusal_notes({name: [result] for name, result in zip(names, results, strict=True)})
