"""Flags of visits on a common sheet: false alarms, and one visit that does not fit."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from nibabel.affines import apply_affine
from scipy import ndimage
from scipy.spatial import KDTree

from hipsta_bids.errors import GeometryError
from hipsta_bids.extensions.visits.common import Placed, find_common, measure_placed
from hipsta_bids.inputs.search import HemisphereInput, InputRequest, find_hemispheres
from hipsta_bids.protocols.protocol import Part, Tissue
from hipsta_bids.settings import Settings
from hipsta_bids.types import HemisphereMaps, LabelVolume, Sheet
from validation import cases
from validation.labelings import revisions
from validation.report import Cell, Cells, Content, suite, table
from validation.visits import (
    NOISE,
    STRONG,
    Person,
    Source,
    draw,
    measure_person,
    noise_table,
    untimed,
)

SHIFTS = (0.4, 0.8, 1.2, 2.0)
"""mm by which an end of the body moves at one visit."""
LOST = 0.05
"""Share of the labels of the sheet in the body that one visit lacks at an edge."""
REASONS = ("visits-differ", "columns-filled")
"""Flags that compare a visit with the mean."""
MAX_FALSE = 0.05
"""Share of sound visits that may have one of these flags."""
LEAST_FOUND = 0.95
"""Share of other hemispheres as a visit that are to be flagged or refused."""
SOUND, NOISY, VERY_NOISY = "sound", f"errors of {NOISE:g} mm", f"errors of {STRONG:g} mm"
PARTICIPANT, SIDE = "wrong participant", "swapped side"


@dataclass(frozen=True, kw_only=True)
class Hemisphere:
    """Labels of a hemisphere, and labels that may be taken for a visit of it by mistake."""

    name: str
    source: Source
    others: Mapping[str, Source]
    """A participant and a side, by the name of the mistake."""
    seed: int


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of three visits, of which the last one is changed."""

    change: str
    refused: str
    """Reason why the last visit has no map; empty if it has."""
    flags: tuple[frozenset[str], ...]
    """Reasons of each visit."""
    new: frozenset[str]
    """Reasons of the last visit that it does not have while it is sound."""
    distance: float
    """Of the walls of the last visit, mm."""
    overlap: float
    filled: float
    """Share of columns of the last visit without a wall."""
    effect: float
    """Mean thickness of the last visit minus that of the first one, mm."""

    @property
    def found(self) -> bool:
        """Whether the last visit is refused, or flagged as unlike the mean."""
        return bool(self.refused or self.flags[-1] & set(REASONS))


def shift_end(volume: LabelVolume, part: Part, size: float) -> LabelVolume | None:
    """Label what lies within ``size`` mm of the head or tail as head or tail; None without one."""
    edges = np.linalg.norm(volume.affine[:3, :3], axis=0)
    beyond = volume.part == part
    if not beyond.any():
        return None
    near = ndimage.distance_transform_edt(~beyond, sampling=edges) <= size + 1e-6
    return replace(volume, part=np.where(near & (volume.part == Part.BODY), part, volume.part))


def lose_edge(volume: LabelVolume, sheet: Sheet, *, lateral: bool) -> LabelVolume:
    """Erase ``LOST`` of the sheet's labels along its medial or lateral edge, between the ends."""
    first, last = sheet.points[:, [0, -1]].mean(axis=(0, 2))
    labels = np.argwhere(np.isin(volume.tissue, volume.protocol.sheet))
    points = apply_affine(volume.affine, labels)
    along = (points - first) @ (last - first) / ((last - first) @ (last - first))
    labels, points = (values[(along >= 0) & (along <= 1)] for values in (labels, points))
    distance, nearest = KDTree(sheet.points.reshape(-1, 3)).query(points)
    column = np.unravel_index(nearest, sheet.points.shape[:3])[0].astype(float)
    if lateral:
        column = len(sheet.points) - 1 - column
    order = np.argsort(column - np.where(column == 0, distance, 0.0), kind="stable")
    gone = tuple(labels[order[: round(LOST * len(labels))]].T)
    tissue, parts = volume.tissue.copy(), volume.part.copy()
    tissue[gone], parts[gone] = Tissue.BACKGROUND, Part.UNKNOWN
    return replace(volume, tissue=tissue, part=parts)


def measure(volumes: Sequence[LabelVolume], hemi: str) -> list[HemisphereMaps | str]:
    """Measure visits on a common sheet; a reason replaces the maps of a visit without."""
    try:
        frame, placed = find_common(volumes, hemi, Settings(), untimed, shared=False)
    except GeometryError as error:
        return [error.reason] * len(volumes)
    motions = dict(zip(placed, frame.motions, strict=True))
    results: list[HemisphereMaps | str] = []
    for number, volume in enumerate(volumes):
        visit = placed.get(number)
        if isinstance(visit, Placed):
            results.append(measure_placed(frame, motions[number], volume, visit, untimed))
        else:
            results.append(visit.reason if visit else "visit-unlike")
    return results


def reasons(result: HemisphereMaps | str) -> frozenset[str]:
    """Return the reasons of the flags of a visit, or why it has no map."""
    return frozenset({result} if isinstance(result, str) else {f.reason for f in result.flags})


def judge(hemisphere: Hemisphere) -> list[Outcome]:
    """Draw three visits of a hemisphere, and change the last one in every way."""
    person = Person(
        name=hemisphere.name, sources=(hemisphere.source,) * 3, seed=500 + hemisphere.seed
    )
    visits, hemi = draw(person)
    sound = measure(visits, hemi)
    outcomes = [_outcome(SOUND, sound, reasons(sound[-1]))]
    for name, noise in ((NOISY, NOISE), (VERY_NOISY, STRONG)):
        noisy = draw(replace(person, noise=noise))[0]
        outcomes.append(_outcome(name, measure(noisy, hemi), reasons(sound[-1])))
    changes: dict[str, Callable[[LabelVolume], LabelVolume | None]] = {}
    for name, source in hemisphere.others.items():
        other = draw(replace(person, sources=(hemisphere.source,) * 2 + (source,)))[0][-1]
        changes[name] = lambda _, other=other: other  # type: ignore[misc]  # bound at once
    for size in SHIFTS:
        changes[f"anterior end, {size:g} mm"] = partial(shift_end, part=Part.HEAD, size=size)
    if not isinstance(sound[-1], str):
        for lateral, name in ((False, "medial"), (True, "lateral")):
            lose = partial(lose_edge, sheet=sound[-1].sheet, lateral=lateral)
            changes[f"{LOST:.0%} fewer labels, {name} edge"] = lose
    for name, change in changes.items():
        changed = change(visits[-1])
        if changed is not None:
            result = measure([*visits[:-1], changed], hemi)
            outcomes.append(_outcome(name, result, reasons(sound[-1])))
    return outcomes


def _outcome(name: str, results: Sequence[HemisphereMaps | str], before: frozenset[str]) -> Outcome:
    first, last = results[0], results[-1]
    qc: Mapping[str, float] = {} if isinstance(last, str) else last.qc
    both = not isinstance(last, str) and not isinstance(first, str)
    return Outcome(
        change=name,
        refused=last if isinstance(last, str) else "",
        flags=tuple(map(reasons, results)),
        new=reasons(last) - before,
        distance=qc.get("frame_distance_mm", np.nan),
        overlap=qc.get("frame_overlap", np.nan),
        filled=qc.get("filled_fraction", np.nan),
        effect=float(last.thickness.mean() - first.thickness.mean()) if both else np.nan,  # type: ignore[union-attr]  # maps
    )


def hemispheres(labels: Path | None, *, full: bool) -> list[Hemisphere]:
    """List the second labels of each brain, HippUnfold's person, and HippUnfold's templates."""
    found: dict[tuple[str, str, str], Source] = {}
    for pair in revisions(labels, Settings()):
        found["cobralab", pair.first.subject, pair.first.hemi] = pair.first
    for folder in cases.hippunfold_beside(labels) if labels else []:
        items = find_hemispheres(InputRequest(bids_dir=folder))
        found |= {("hippunfold", i.subject, i.hemi): i for i in items if i.problem is None}
        for path in sorted(folder.glob("templates/tpl-*")):
            found |= {("hippunfold", path.name, hemi): (path, hemi) for hemi in "LR"}
    listed = []
    for number, ((program, subject, hemi), source) in enumerate(found.items()):
        same = sorted({key[1] for key in found if key[0] == program})
        stranger = same[(same.index(subject) + 1) % len(same)]
        others = {
            PARTICIPANT: found.get((program, stranger, hemi)),
            SIDE: found.get((program, subject, "LR"[hemi == "L"])),
        }
        listed.append(
            Hemisphere(
                name=f"{subject.removeprefix('tpl-')} {hemi}",
                source=source,
                others={name: other for name, other in others.items() if other is not None},
                seed=number,
            )
        )
    return listed if full else listed[:1]


@suite("visit-flags")
def run(full: bool, labels: Path | None = None) -> Iterator[Content]:
    """Judge visits of hemispheres, and compare the noise of common and separate sheets."""
    listed = hemispheres(labels, full=full)
    outcomes = cases.run_cases(judge, listed, timeout=1800.0)
    if listed:
        yield _flags(dict(zip((h.name for h in listed), outcomes, strict=True)))
    groups: dict[str, list[Person]] = {"other labels": [], "templates": []}
    for hemisphere in listed if full else []:
        name = "other labels" if isinstance(hemisphere.source, HemisphereInput) else "templates"
        person = Person(name=hemisphere.name, sources=(hemisphere.source,) * 3)
        groups[name].append(replace(person, seed=700 + hemisphere.seed))
    groups = {name: group for name, group in groups.items() if group}
    if groups:
        groups = {"all": [p for group in groups.values() for p in group], **groups}
        results = dict(
            zip(
                (person.name for person in groups["all"]),
                cases.run_cases(measure_person, groups["all"], timeout=600.0),
                strict=True,
            )
        )
        measured = {key: [results[p.name] for p in group] for key, group in groups.items()}
        yield noise_table(measured, groups)
    yield cases.left_out(labels)


@table("visit-flags.flags")
def _flags(results: Mapping[str, Sequence[Outcome] | cases.Refusal]) -> Iterator[Cells | str]:
    every = [o for group in results.values() if not isinstance(group, cases.Refusal) for o in group]
    for name in dict.fromkeys(outcome.change for outcome in every):
        group = [outcome for outcome in every if outcome.change == name]
        sound = name in (SOUND, NOISY, VERY_NOISY)
        visits = [flags for outcome in group for flags in outcome.flags]
        alarms = [flags for flags in visits if flags & {*REASONS, "visit-unlike"}]
        refusals = sorted({outcome.refused for outcome in group if outcome.refused})
        rate = sum(outcome.found for outcome in group) / len(group)
        cells: dict[str, Cell] = {
            "last visit": name,
            "hemispheres": len(group),
            "refused": sum(bool(outcome.refused) for outcome in group),
            **{reason: sum(reason in o.flags[-1] for o in group) for reason in REASONS},
            "flagged or refused": f"{rate:.0%}",
            "with other new flags": f"{np.mean([bool(o.new) or o.found for o in group]):.0%}",
            "visits with a flag, all": f"{len(alarms)} of {len(visits)}",
            "distance, mm": _median([outcome.distance for outcome in group]),
            "overlap": _median([outcome.overlap for outcome in group]),
            "without wall, share": _median([outcome.filled for outcome in group]),
            "change of the mean, mm": _median([abs(outcome.effect) for outcome in group]),
            "reasons of refusals": ", ".join(refusals) or "none",
        }
        met = None
        if sound:
            met = len(alarms) <= MAX_FALSE * len(visits)
        elif name in (PARTICIPANT, SIDE):
            met = rate >= LEAST_FOUND
        yield cells | {"met": met}
    lost = {n: [r] for n, r in results.items() if isinstance(r, cases.Refusal)}
    yield cases.refusal_notes(lost)


def _median(values: Sequence[float]) -> float | None:
    """Compute the median of visits with a map; None if no visit has one."""
    known = [value for value in values if np.isfinite(value)]
    return float(np.median(known)) if known else None
