"""All visits of one side of a participant from files to files, on one sheet, as workers run it."""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np

from hipsta_bids import __version__
from hipsta_bids.derivatives import template
from hipsta_bids.derivatives.results import ResultPlace, read_record
from hipsta_bids.errors import GeometryError, HipstaError, InputError, OutputError, UsageError
from hipsta_bids.io import files
from hipsta_bids.participant import job as one_job
from hipsta_bids.participant.job import CostClock, Job, Measure, Outcome, fail, finished
from hipsta_bids.types import HemisphereMaps, LabelVolume

if TYPE_CHECKING:
    from hipsta_bids.participant.longitudinal import Frame


def by_side(jobs: Iterable[Job]) -> list[tuple[Job, ...]]:
    """Group hemispheres that share a sheet; each other one is alone."""
    ordered = sorted(jobs, key=lambda job: job.item.side)
    return [tuple(group) for _, group in groupby(ordered, key=lambda job: job.item.side)]


def share_sheets(jobs: Sequence[Job]) -> list[Job]:
    """Add to each hemisphere all visits that share its sheet."""
    if not any(job.item.session for job in jobs):
        raise UsageError("--longitudinal: no segmentation has a session; name the visits (ses-)")
    usable = [[job.item for job in unit if job.item.problem is None] for unit in by_side(jobs)]
    visits = {items[0].side: tuple(items) for items in usable if items}
    return [replace(job, visits=visits.get(job.item.side, ())) for job in jobs]


def run_visits(jobs: tuple[Job, ...]) -> list[Outcome]:
    """Measure the visits of one side and write their results; raises no foreseen error."""
    place = template.template_place(jobs[0].result)
    try:
        with files.locked(place.root, place.name.title):
            earlier = [finished(job) for job in jobs]
            finished_jobs = [outcome for outcome in earlier if outcome is not None]
            return finished_jobs if len(finished_jobs) == len(jobs) else _measure_visits(jobs)
    except OutputError as error:
        return [fail(job, error) for job in jobs]


def _measure_visits(jobs: tuple[Job, ...]) -> list[Outcome]:
    """Lay out the mean of the visits, measure each visit on it, and write what they share."""
    from hipsta_bids.inputs.labels import read_label_volume  # noqa: PLC0415  (workers only)
    from hipsta_bids.participant import longitudinal  # noqa: PLC0415  (likewise)

    clock = CostClock()
    place, settings = template.template_place(jobs[0].result), jobs[0].settings
    template.remove_template(place)
    hemi = jobs[0].item.hemi
    usable, volumes = [], []
    for job in jobs:
        with suppress(HipstaError):  # its own job reports it
            volume = read_label_volume(job.item, settings.body.region)
            longitudinal.check_alone(volume, hemi, settings)
            volumes.append(volume)
            usable.append(job)
    frame, problem = None, None
    laid: dict[int, longitudinal.Laid | GeometryError] = {}
    try:
        shared = settings.sheet.frame == "shared" or all(
            job.item.provenance.get("design") == "longitudinal" for job in usable
        )
        frame, laid = longitudinal.find_common(volumes, hemi, settings, clock, shared=shared)
    except Exception as error:  # noqa: BLE001  (each visit reports it)
        problem = error
    spent = clock.spent()
    on_sheet = [usable[number] for number in laid]
    shared_notes = (*_thick(usable, volumes), *_left_out(jobs, usable, on_sheet))
    measured: dict[str | None, HemisphereMaps] = {}

    def measure(job: Job) -> Measure:
        def run(volume: Any, hemi: str, _settings: Any, clock: Any) -> HemisphereMaps:  # noqa: ANN401
            if job not in usable or frame is None:
                longitudinal.check_alone(volume, hemi, settings)  # says what is wrong
                raise problem or HipstaError(
                    "no visit can be read; check the labels", reason="internal-error"
                )
            if job not in on_sheet:
                raise GeometryError(
                    "this visit does not resemble the other visits: check participant, side and "
                    "labels",
                    reason="visit-unlike",
                )
            result = laid[usable.index(job)]
            if isinstance(result, GeometryError):
                raise result
            motion = frame.motions[on_sheet.index(job)]
            maps = longitudinal.measure_laid(frame, motion, volume, result, clock)
            measured[job.item.session] = maps
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
    if frame is not None and measured:
        _write_common(place, frame, on_sheet, measured)
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
    template.write_template(place, frame.evidence.sheet, thickness, mask, record)
    for job in jobs:
        if job.item.session in measured:
            change = measured[job.item.session].thickness - thickness.mean(axis=0)
            template.write_change(job.result, change, record)


def _thick(jobs: Sequence[Job], volumes: Sequence[LabelVolume]) -> list[str]:
    """Note visits in thick slices, of which a common sheet does not lower all noise."""
    from hipsta_bids.geometry.slices import has_thick_slices  # noqa: PLC0415  (workers only)

    sessions = [
        str(job.item.session)
        for job, volume in zip(jobs, volumes, strict=True)
        if has_thick_slices(volume.affine, job.settings.slices)
    ]
    text = "thick slices: a common sheet does not lower noise of the mean thickness (sessions {})"
    return [text.format(", ".join(sessions))] if sessions else []


def _left_out(jobs: Sequence[Job], usable: Sequence[Job], on_sheet: Sequence[Job]) -> list[str]:
    """Note visits that are no part of the common sheet."""
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
