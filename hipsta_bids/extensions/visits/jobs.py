"""All visits of one side of a participant from files to files, on one sheet, as workers run it."""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np

from hipsta_bids import __version__
from hipsta_bids.derivatives.results import ResultPlace, read_record
from hipsta_bids.errors import GeometryError, HipstaError, InputError, OutputError, UsageError
from hipsta_bids.extensions.visits import files as visit_files
from hipsta_bids.extensions.visits.options import OPTION
from hipsta_bids.extensions.visits.settings import FrameSettings
from hipsta_bids.inputs.scan import HemisphereInput
from hipsta_bids.inputs.search import count_names
from hipsta_bids.io import files
from hipsta_bids.participant import job as one_job
from hipsta_bids.participant.job import CostClock, Job, Measure, Outcome, fail, finished
from hipsta_bids.types import HemisphereMaps, LabelVolume

if TYPE_CHECKING:
    from hipsta_bids.extensions.visits.common import Frame, Placed
    from hipsta_bids.settings import Settings


def _side(job: Job) -> tuple[str, str, str]:
    return job.item.side


def share_sheets(jobs: Sequence[Job]) -> list[tuple[Job, ...]]:
    """Group hemispheres that share a sheet; each other one is alone."""
    if not any(job.item.session for job in jobs):
        raise UsageError(f"{OPTION}: no segmentation has a session; name the visits (ses-)")
    groups = []
    for _, group in groupby(sorted(jobs, key=_side), key=_side):
        visits = list(group)
        usable = tuple(job.item for job in visits if job.item.problem is None)
        groups.append(tuple(replace(job, visits=usable) for job in visits))
    return groups


def note_sheets(items: Iterable[HemisphereInput]) -> list[str]:
    """Count sheets of several visits and of a single one, and name participants and sessions."""
    visits: dict[tuple[str, str, str], list[str]] = {}
    for item in items:
        if item.problem is None:
            visits.setdefault(item.side, []).append(f"ses-{item.session}" if item.session else "")
    notes = []
    for title, is_common in (("several visits", True), ("a single visit", False)):
        sides = {side: labels for side, labels in visits.items() if (len(labels) > 1) == is_common}
        sessions: dict[str, dict[str, None]] = {}
        for (subject, *_), labels in sides.items():
            sessions.setdefault(subject, {}).update(dict.fromkeys(labels))
        names = [
            " ".join((f"sub-{subject}", *labels)).strip() for subject, labels in sessions.items()
        ]
        if names:
            notes.append(f"sheets of {title}: {len(sides)} of {count_names(names, 'participant')}")
    return notes


def run_visits(jobs: tuple[Job, ...]) -> list[Outcome]:
    """Measure the visits of one side and write their results; raises no foreseen error."""
    place = visit_files.template_place(jobs[0].result)
    try:
        with files.locked(place.root, place.name.title):
            earlier = [finished(job) for job in jobs]
            finished_jobs = [outcome for outcome in earlier if outcome is not None]
            return finished_jobs if len(finished_jobs) == len(jobs) else _measure_visits(jobs)
    except OutputError as error:
        return [fail(job, error) for job in jobs]


@dataclass(frozen=True, eq=False, kw_only=True)
class _Common:
    """The common sheet of one side of a participant, and what became of each visit."""

    usable: Sequence[Job]
    """Visits whose labels can be measured."""
    volumes: Sequence[LabelVolume]
    """Their labels."""
    frame: "Frame | None"
    """``None`` without a common sheet."""
    placed: "Mapping[int, Placed | GeometryError]"
    """Visits on the sheet, by number among those that are usable."""
    problem: Exception | None
    """Why there is no common sheet."""

    @property
    def on_sheet(self) -> list[Job]:
        """The visits that the sheet is made of."""
        return [self.usable[number] for number in self.placed]

    def measure(self, job: Job, volume: LabelVolume, clock: CostClock) -> HemisphereMaps:
        """Measure a visit on the common sheet; raises what prevents it."""
        from hipsta_bids.extensions.visits import common  # noqa: PLC0415  (workers only)

        if job not in self.usable or self.frame is None:
            common.check_alone(volume, job.item.hemi, job.settings)  # says what is wrong
            raise self.problem or HipstaError(
                "no visit can be read; check the labels", reason="internal-error"
            )
        if job not in self.on_sheet:
            raise GeometryError(
                "this visit does not resemble the other visits: check participant, side and labels",
                reason="visit-unlike",
            )
        placed = self.placed[self.usable.index(job)]
        if isinstance(placed, GeometryError):
            raise placed
        motion = self.frame.motions[self.on_sheet.index(job)]
        return common.measure_placed(self.frame, motion, volume, placed, clock)


def _find_common(jobs: Sequence[Job], settings: "Settings", clock: CostClock) -> _Common:
    """Read the visits, and lay out the mean of those that can be measured."""
    from hipsta_bids.extensions.visits import common  # noqa: PLC0415  (workers only)
    from hipsta_bids.inputs.labels import read_label_volume  # noqa: PLC0415  (likewise)

    hemi, usable, volumes = jobs[0].item.hemi, [], []
    for job in jobs:
        with suppress(HipstaError):  # its own job reports it
            volume = read_label_volume(job.item, settings.body.region)
            common.check_alone(volume, hemi, settings)
            volumes.append(volume)
            usable.append(job)
    frame, placed, problem = None, dict[int, "Placed | GeometryError"](), None
    try:
        shared = settings.of(FrameSettings).frame == "shared" or all(
            job.item.provenance.get("design") == "longitudinal" for job in usable
        )
        frame, placed = common.find_common(volumes, hemi, settings, clock, shared=shared)
    except Exception as error:  # noqa: BLE001  (each visit reports it)
        problem = error
    return _Common(usable=usable, volumes=volumes, frame=frame, placed=placed, problem=problem)


def _measure_visits(jobs: tuple[Job, ...]) -> list[Outcome]:
    """Lay out the mean of the visits, measure each visit on it, and write what they share."""
    clock, place = CostClock(), visit_files.template_place(jobs[0].result)
    visit_files.remove_template(place)
    common = _find_common(jobs, jobs[0].settings, clock)
    spent = clock.spent()
    shared_notes = (*_thick(common), *_left_out(jobs, common))
    measured: dict[str | None, HemisphereMaps] = {}

    def measure(job: Job) -> Measure:
        def run(volume: Any, _hemi: Any, _settings: Any, clock: Any) -> HemisphereMaps:  # noqa: ANN401
            measured[job.item.session] = maps = common.measure(job, volume, clock)
            return maps

        return run

    outcomes = []
    for job in jobs:
        renewal = _renewal(job)
        notes = (*job.item.notes, *shared_notes, *renewal)
        noted = replace(job, item=replace(job.item, notes=notes))
        outcome = one_job.measure_job(noted, measure(job))
        outcome = replace(outcome, notes=(*outcome.notes, *renewal))
        outcomes.append(_with_cost(outcome, spent, len(jobs)))
    if common.frame is not None and measured:
        _write_common(place, common.frame, common.on_sheet, measured)
    return outcomes


def _write_common(
    place: ResultPlace,
    frame: "Frame",
    jobs: Sequence[Job],
    measured: Mapping[str | None, HemisphereMaps],
) -> None:
    """Write what the visits share, and the change of each one."""
    from hipsta_bids.participant.measure import quality_metrics  # noqa: PLC0415  (workers only)

    thickness = np.stack([maps.thickness for maps in measured.values()])
    base = one_job.base_record(jobs[0])
    _, entries = one_job.hash_inputs(jobs[0], base)
    record = {
        **{key: base[key] for key in ("settings_hash", "scheme", "scheme_title")},
        "version": __version__,
        "visits": entries["visits"],
        "measured": list(measured),
        "motions": [
            {"session": job.item.session, "frame_to_visit": motion.round(6)}
            for job, motion in zip(jobs, frame.motions, strict=True)
        ],
        "metrics": quality_metrics(frame.evidence),
    }
    mask = frame.volume.in_file(frame.evidence.body.inside)
    visit_files.write_template(place, frame.evidence.sheet, thickness, mask, record)
    for job in jobs:
        if job.item.session in measured:
            change = measured[job.item.session].thickness - thickness.mean(axis=0)
            visit_files.write_change(job.result, change, record)


def _thick(common: _Common) -> list[str]:
    """Note visits in thick slices, of which a common sheet does not lower all noise."""
    from hipsta_bids.geometry.slices import has_thick_slices  # noqa: PLC0415  (workers only)

    sessions = [
        str(job.item.session)
        for job, volume in zip(common.usable, common.volumes, strict=True)
        if has_thick_slices(volume.affine, job.settings.slices)
    ]
    text = "thick slices: a common sheet does not lower noise of the mean thickness (sessions {})"
    return [text.format(", ".join(sessions))] if sessions else []


def _left_out(jobs: Sequence[Job], common: _Common) -> list[str]:
    """Note visits that are no part of the common sheet."""
    usable, on_sheet = common.usable, common.on_sheet
    groups = {
        "cannot be measured": [job for job in jobs if job not in usable],
        "do not resemble the others": [job for job in usable if job not in on_sheet],
    }
    return [
        f"common sheet without sessions that {why}: {', '.join(str(j.item.session) for j in group)}"
        for why, group in groups.items()
        if group and on_sheet
    ]


def _with_cost(outcome: Outcome, spent: dict[str, Any], count: int) -> Outcome:
    """Add to the cost of a visit its part of the cost of the mean."""
    stages = {name: seconds / count for name, seconds in spent["stages"].items()}
    return replace(
        outcome,
        stages={
            name: stages.get(name, 0.0) + outcome.stages.get(name, 0.0)
            for name in (*stages, *outcome.stages)
        },
        seconds=(outcome.seconds or 0.0) + spent["seconds"] / count,
        cpu_seconds=(outcome.cpu_seconds or 0.0) + spent["cpu_seconds"] / count,
        peak_memory_mb=max(outcome.peak_memory_mb or 0.0, spent["peak_memory_mb"]),
    )


def _renewal(job: Job) -> tuple[str, ...]:
    """Note that the sheet was made of other visits before, if it was."""
    before: list[str] = []
    with suppress(InputError):
        before = [str(visit.get("session")) for visit in read_record(job.result).get("visits", ())]
    sessions = [str(visit.session) for visit in job.visits]
    if not before or set(before) == set(sessions):
        return ()
    names = [", ".join(dict.fromkeys(group)) for group in (sessions, before)]
    return (f"measured again on a sheet of the sessions {names[0]} (before: {names[1]})",)
