"""One hemisphere from files to files, as workers run it: read, measure, write, and what it cost."""

import contextlib
import hashlib
import json
import resource
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from hipsta_bids import __version__
from hipsta_bids.derivatives import hemisphere
from hipsta_bids.derivatives.dataset import source_address
from hipsta_bids.derivatives.names import ADDED_MAPS
from hipsta_bids.derivatives.results import ResultPlace, read_record
from hipsta_bids.errors import GeometryError, HipstaError, InputError, OutputError, ProtocolError
from hipsta_bids.inputs.scan import HemisphereInput
from hipsta_bids.io import files
from hipsta_bids.joints import find_groupings, find_measurements, load
from hipsta_bids.protocols.load import for_region
from hipsta_bids.settings import Settings
from hipsta_bids.types import BodyMask, Decision, HemisphereMaps, LabelVolume

INTERNAL = "internal-error"
"""Reason of a failure that is a bug."""

_MEGABYTE = 1e6


@dataclass(frozen=True, kw_only=True)
class Job:
    """All that a worker needs to know about one hemisphere."""

    item: HemisphereInput
    result: ResultPlace
    settings: Settings
    settings_hash: str
    sources: tuple[tuple[str, Path], ...]
    """Input datasets by name."""
    write_meshes: bool
    visits: tuple[HemisphereInput, ...] = ()
    """All visits that are measured together, this one included; none if it is measured alone."""
    further: Mapping[str, Any] = field(default_factory=dict)
    """Options of extensions that were given, by name in Python."""
    force: bool = False
    """Redo it even if an earlier run has done the same."""
    memory_gb: float | None = None
    """Memory that reading may count on; ``None`` is no limit."""

    @property
    def title(self) -> str:
        """Name in messages."""
        return self.result.name.title


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How one hemisphere ended."""

    job: Job
    decision: Decision
    reason: str | None = None
    message: str | None = None
    repairs: int = 0
    """How many repairs of the labels there were."""
    error: HipstaError | None = None
    """Set if it failed for a foreseen reason."""
    trace: str | None = None
    """Set if it failed by a bug."""
    notes: tuple[str, ...] = ()
    """What was noted beside the choice of the labels."""
    skipped: bool = False
    """An earlier run had done it."""
    input_hash: str | None = None
    thickness: float | None = None
    """Mean over the sheet, mm."""
    stages: dict[str, float] = field(default_factory=dict)
    """Seconds per stage."""
    seconds: float | None = None
    cpu_seconds: float | None = None
    peak_memory_mb: float | None = None

    @property
    def headline(self) -> str:
        """The message in 25 words at most; empty without one."""
        return hemisphere.headline(self.message or "")


def recorded(job: Job) -> Outcome | None:
    """Read how a hemisphere ended, if it did with the same settings and version."""
    try:
        record = read_record(job.result)
        decision = Decision(record.get("decision", ""))
    except (InputError, ValueError):
        return None
    is_current = (
        record.get("version") == __version__ and record.get("settings_hash") == job.settings_hash
    )
    whole = decision == Decision.FAILED or (
        all(path.exists() for path in job.result.paths(optional=job.write_meshes))
        and all(load(measurement.is_complete)(job, record) for measurement in find_measurements())
        and (not job.visits or all(load(g.is_complete)(job) for g in find_groupings()))
    )
    if not (is_current and whole):
        return None
    return Outcome(
        job=job,
        decision=decision,
        reason=record.get("reason"),
        message=record.get("message"),
        repairs=len(record.get("repairs") or ()),
        input_hash=record.get("input_hash"),
        skipped=True,
    )


def finished(job: Job) -> Outcome | None:
    """Return the outcome of a hemisphere that an earlier run has done with the same inputs."""
    outcome = None if job.force or job.item.problem else recorded(job)
    if outcome is None or outcome.decision == Decision.FAILED:
        return None
    try:
        digest, _ = hash_inputs(job, base_record(job))
    except (InputError, ProtocolError):
        return None
    return outcome if outcome.input_hash == digest else None


def base_record(job: Job) -> dict[str, Any]:
    """Begin the quality record with the facts known before any input is read."""
    item = job.item
    sources = dict(job.sources)
    given_ends = [
        {"end": end.end, "point_ras_mm": end.point}
        | ({"normal_ras": end.normal} if end.normal else {})
        for end in item.ends
    ]
    published = job.settings.as_published()
    soft = [{"file": source_address(path, sources)} for path in item.probability_files]
    return {
        "version": __version__,
        "settings_hash": job.settings_hash,
        "input_hash": None,
        "inputs": [{"file": source_address(path, sources)} for path in item.files],
        "edited": [
            {"what": edit.kind, "file": source_address(edit.path, sources)} for edit in item.edits
        ],
        "scheme": item.protocol.name,
        "region": job.settings.body.region,
        "scheme_title": item.protocol.title,
        "provenance": item.origin,
        "chosen_because": item.explanation,
        "passed_over": [
            {"file": source_address(Path(path), sources), "reason": why}
            for path, why in item.passed_over
        ],
        "notes": item.notes,
        **({"probabilities": soft} if soft else {}),
        **({"given_ends": given_ends} if given_ends else {}),
        **({"as_published": published} if published else {}),
    }


def hash_inputs(job: Job, record: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """Hash the input files and how they are read; return entries of a record with hashes, too."""
    item = job.item
    inputs = [
        entry | {"sha256": files.sha256_of(path)}
        for entry, path in zip(record["inputs"], item.files, strict=True)
    ]
    edited = [
        entry | {"sha256": files.sha256_of(edit.path)}
        for entry, edit in zip(record["edited"], item.edits, strict=True)
    ]
    entries = {"inputs": inputs, "edited": edited}
    reading = _describe_reading(job, inputs, edited)
    if item.probabilities:
        entries["probabilities"] = [
            entry | {"sha256": files.sha256_of(path)}
            for entry, path in zip(record["probabilities"], item.probability_files, strict=True)
        ]
        reading.append([entry["sha256"] for entry in entries["probabilities"]])
        reading.append([list(map(int, tissues)) for _, tissues in item.probabilities.files])
    if job.visits:
        entries["visits"] = list(_hash_visits(job))
        reading.append([entry["sha256"] for entry in entries["visits"]])
        reading.append([[asdict(end) for end in visit.ends] for visit in job.visits])
    digest = hashlib.sha256(json.dumps(reading).encode()).hexdigest()
    return digest, entries


def _describe_reading(
    job: Job, inputs: Sequence[Mapping[str, Any]], edited: Sequence[Mapping[str, Any]]
) -> list[Any]:
    """List what decides how labels are read, with the hashes of input files and edits."""
    item = job.item
    region = for_region(item.protocol, job.settings.body.region)
    return [
        [entry["sha256"] for entry in inputs],
        # The wording of the protocols (titles, citations) does not change what is read.
        [
            [label.code, int(label.tissue), int(label.part)]
            for protocol in (item.protocol, item.parts_protocol)
            if protocol is not None
            for label in protocol.labels
        ],
        [
            [int(tissue) for tissue in group]
            for group in (region.sheet, item.protocol.layer, item.protocol.interior)
        ],
        [item.protocol.unlisted, item.bilateral, item.code_offset, item.hemi],
        sorted([entry["what"], entry["sha256"]] for entry in edited),
        *([[asdict(end) for end in item.ends]] if item.ends else []),
        *chain.from_iterable(addition.describe() for addition in item.further.values()),
    ]


def _hash_visits(job: Job) -> Iterator[dict[str, Any]]:
    """List the files of all visits that are measured together, with their hashes."""
    sources = dict(job.sources)
    for visit in job.visits:
        edited = (edit.path for edit in visit.edits)
        for path in (*visit.files, *edited, *visit.probability_files):
            yield {
                "session": visit.session,
                "file": source_address(path, sources),
                "sha256": files.sha256_of(path),
            }


class CostClock:
    """Times stages, and measures their cost in this process since the clock was made."""

    def __init__(self) -> None:
        self._stages: dict[str, float] = {}
        self._start = time.perf_counter()
        self._cpu = cpu_seconds()
        reset_peak_memory()

    @contextlib.contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Time a stage; several times with the same name add up."""
        start = time.perf_counter()
        try:
            yield
        finally:
            spent = time.perf_counter() - start
            self._stages[stage] = self._stages.get(stage, 0.0) + spent

    def spent(self) -> dict[str, Any]:
        """Return the cost so far: seconds per stage and in all, and peak memory in MB."""
        return {
            "stages": dict(self._stages),
            "seconds": time.perf_counter() - self._start,
            "cpu_seconds": cpu_seconds() - self._cpu,
            "peak_memory_mb": peak_memory() / _MEGABYTE,
        }


def cpu_seconds() -> float:
    """Compute processor time of this process and its helpers, running (to 20 ms) or ended, in s."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    total = time.process_time() + ended.ru_utime + ended.ru_stime
    for process in helpers():
        with contextlib.suppress(psutil.Error):  # it may end now
            spent = process.cpu_times()
            total += spent.user + spent.system
    return total


def helpers() -> list[psutil.Process]:
    """Return running children."""
    children: list[psutil.Process] = psutil.Process().children()
    return children


def reset_peak_memory(process: str = "self") -> None:
    """Forget how much memory a process needed so far, where Linux allows it; psutil cannot."""
    with contextlib.suppress(OSError):
        Path(f"/proc/{process}/clear_refs").write_text("5")


def peak_memory(process: str = "self") -> float:
    """Return the largest resident memory of a process since the last reset, in bytes.

    Where there is no ``/proc``: of this process since it began. psutil knows it on Windows alone.
    """
    with contextlib.suppress(OSError, StopIteration, ValueError):
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
        return 1024.0 * int(next(line for line in lines if line.startswith("VmHWM")).split()[1])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return float(peak if sys.platform == "darwin" else 1024 * peak)  # getrusage(2): bytes, or KiB


def warm_up() -> None:
    """Load the libraries, so that no hemisphere's time includes it."""
    import hipsta_bids.inputs.labels  # noqa: PLC0415  (loaded in workers only)
    import hipsta_bids.participant.measure  # noqa: F401, PLC0415


def check_item(item: HemisphereInput, settings: Settings) -> list[str]:
    """Read and check the labels of a hemisphere without measuring it; list the problems."""
    from hipsta_bids.geometry import label_checks as checks  # noqa: PLC0415  (heavy)
    from hipsta_bids.inputs.labels import read_label_volume  # noqa: PLC0415  (heavy)

    try:
        volume = read_label_volume(item, settings.body.region)
        with checks.naming_causes(volume):
            findings = checks.check_label_image(volume, item.hemi, settings.checks)
    except HipstaError as error:
        return [f"will be refused: {error}"]
    flags = [f"will be flagged: {f.text}: {f.remedy}" for f in findings if f.raised]
    notes = (*volume.notes, *checks.note_labels(volume, item.hemi))
    return [*flags, *(f"will be noted: {note}" for note in notes)]


def run_job(job: Job) -> Outcome:
    """Measure one hemisphere and write its results; never raises a foreseen error.

    If another run is doing the same, its results are awaited and taken.
    """
    try:
        with files.locked(job.result.root, job.title):
            return finished(job) or measure_job(job)
    except OutputError as error:
        return fail(job, error)


def run_alone(jobs: tuple[Job, ...]) -> list[Outcome]:
    """Measure hemispheres, each by itself."""
    return [run_job(job) for job in jobs]


#: Function of labels, hemisphere, settings and clock that measures a hemisphere.
Measure = Callable[[LabelVolume, str, Settings, CostClock], HemisphereMaps]


def measure_job(job: Job, measure: Measure | None = None) -> Outcome:
    """Measure a hemisphere, by default on a sheet of its own, and write its results."""
    from hipsta_bids.io.volumes import limit_memory  # noqa: PLC0415  (workers only)
    from hipsta_bids.participant.measure import find_body, measure_hemisphere  # noqa: PLC0415

    limit_memory(job.memory_gb)
    clock = CostClock()
    record = base_record(job)
    volume = None
    try:
        with clock("read"):
            volume = _read(job, record)
        maps, writers = _measure(job, volume, measure or measure_hemisphere, record, clock)
        with clock("write"):
            hemisphere.write_results(
                job.result,
                maps,
                for_region(job.item.protocol, job.settings.body.region),
                record,
                write_meshes=job.write_meshes,
                write_more=lambda: _call_all(writers),
            )
    except Exception as error:  # noqa: BLE001  (one hemisphere's bug must not end the others)
        explained = _explain(error, job.result.root)
        trace = traceback.format_exc() if explained.reason == INTERNAL else None
        body = None
        if volume is not None and isinstance(error, GeometryError):
            body = find_body(volume, job.settings)
        return fail(job, explained, trace=trace, record=record, body=body, **clock.spent())
    decision, reason, message = hemisphere.verdict(maps)
    return Outcome(
        job=job,
        decision=decision,
        reason=reason,
        message=message,
        repairs=len(maps.repairs),
        notes=_added_notes(job, record),
        input_hash=record["input_hash"],
        thickness=maps.summary.get("thickness_mean"),
        **clock.spent(),
    )


def _read(job: Job, record: dict[str, Any]) -> LabelVolume:
    """Read the labels; add hashes and the size of voxels to the record."""
    from hipsta_bids.inputs.labels import read_label_volume  # noqa: PLC0415  (workers only)

    hashed, entries = hash_inputs(job, record)
    record |= {"input_hash": hashed} | entries
    volume = read_label_volume(job.item, job.settings.body.region)
    edges = np.linalg.norm(volume.affine[:3, :3], axis=0)
    record["provenance"]["voxel_size"] = " x ".join(f"{edge:.3g}" for edge in edges)
    return volume


def _measure(
    job: Job, volume: LabelVolume, measure: Measure, record: dict[str, Any], clock: CostClock
) -> tuple[HemisphereMaps, list[Callable[[], None]]]:
    """Measure a hemisphere and what options ask for; return what writes the latter, too.

    Notes and sources are added to the record.
    """
    from hipsta_bids.geometry.label_checks import naming_causes, note_labels  # noqa: PLC0415  (workers only)

    noted = (*volume.notes, *note_labels(volume, job.item.hemi))
    record["notes"] = [*record["notes"], *noted]
    with naming_causes(volume):
        maps = measure(volume, job.item.hemi, job.settings, clock)
    writers: list[Callable[[], None]] = [partial(_write_maps, job.result, maps)]
    for measurement in find_measurements():
        if measurement.name in {*job.further, *job.item.further}:
            with clock(measurement.name):
                maps, write = load(measurement.after)(job, volume, maps, record)
            writers.append(write)
    return maps, writers


def _call_all(writers: Sequence[Callable[[], None]]) -> None:
    for write in writers:
        write()


def _write_maps(result: ResultPlace, maps: HemisphereMaps) -> None:
    """Write the maps of a region."""
    for name in maps.maps.keys() & ADDED_MAPS.keys():
        from hipsta_bids.io import gifti  # noqa: PLC0415  (workers only)

        values, unit = maps.maps[name].ravel(), ADDED_MAPS[name].unit or ""
        content = gifti.shape_bytes(values, hemi=result.name.hemi, name=name, unit=unit)
        files.write_bytes(result.path(name), content)


def fail(
    job: Job,
    error: HipstaError,
    *,
    trace: str | None = None,
    record: dict[str, Any] | None = None,
    body: BodyMask | None = None,
    **spent: Any,  # noqa: ANN401  (fields of Outcome)
) -> Outcome:
    """Record that a hemisphere failed, and remove its files."""
    record = base_record(job) if record is None else record
    try:
        hemisphere.write_failure(job.result, error, record, body)
    except OutputError as worse:
        if not isinstance(error, OutputError):
            error = worse
    return Outcome(
        job=job,
        decision=Decision.FAILED,
        reason=error.reason,
        message=str(error),
        error=None if trace else error,
        trace=trace,
        notes=_added_notes(job, record),
        input_hash=record.get("input_hash"),
        **spent,
    )


def _added_notes(job: Job, record: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the notes of a record that a job did not have before the labels were read."""
    return tuple(record["notes"][len(job.item.notes) :])


def _explain(error: Exception, root: Path) -> HipstaError:
    """Return an error as a user can act on it; a bug, whose traceback goes to the log, as such."""
    if isinstance(error, HipstaError):
        return error
    if isinstance(error, MemoryError):
        return HipstaError(
            "out of memory; use fewer processes (--n-procs) or a machine with more",
            reason="out-of-memory",
        )
    if isinstance(error, OSError) and files.is_disk_full(error):
        return files.output_error(Path(error.filename) if error.filename else root, error)
    text = " ".join(f"{type(error).__name__}: {error}".split())
    return HipstaError(f"internal error ({text}); please report it with the log", reason=INTERNAL)
