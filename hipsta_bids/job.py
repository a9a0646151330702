"""What is to be done with one hemisphere, and what an earlier run has done with it."""

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hipsta_bids import __version__
from hipsta_bids.artifacts import Status
from hipsta_bids.bids import files
from hipsta_bids.bids.derivative import source_address
from hipsta_bids.bids.inputs import HemisphereInput
from hipsta_bids.bids.results import ResultPlace
from hipsta_bids.errors import HipstaError, InputError, SchemeError
from hipsta_bids.mapping import is_complete, signal_hash
from hipsta_bids.schemes import for_region
from hipsta_bids.settings import Settings


@dataclass(frozen=True, kw_only=True)
class Job:
    """All that a worker needs to know about one hemisphere."""

    item: HemisphereInput
    place: ResultPlace
    settings: Settings
    settings_hash: str
    sources: tuple[tuple[str, Path], ...]
    """Input datasets by name."""
    write_meshes: bool
    force: bool = False
    """Redo it even if an earlier run has done it just so."""

    @property
    def title(self) -> str:
        """What its messages are headed by."""
        return f"{self.place.name.stem}_{self.place.name.protocol}"


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How one hemisphere ended."""

    job: Job
    status: Status
    reason: str | None = None
    message: str | None = None
    error: HipstaError | None = None
    """Set if it failed for a foreseen reason."""
    trace: str | None = None
    """Set if it failed by a bug."""
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


def recorded(job: Job) -> Outcome | None:
    """Read how a hemisphere ended, if it did with the same settings and version.

    Parameters
    ----------
    job : Job
        What would be done.

    Returns
    -------
    Outcome or None
        ``None`` too if there should be files that are not there. Whether inputs have changed since
        then is not looked at.
    """
    try:
        record = files.read_json(job.place.path("qc"))
        status = Status(record.get("status", ""))
    except (InputError, ValueError):
        return None
    same = record.get("version") == __version__ and record.get("settings_hash") == job.settings_hash
    whole = status == Status.FAILED or (
        all(path.exists() for path in job.place.paths(optional=job.write_meshes))
        and is_complete(job.place, record)
    )
    if not (same and whole):
        return None
    return Outcome(
        job=job,
        status=status,
        reason=record.get("reason"),
        message=record.get("message"),
        input_hash=record.get("input_hash"),
        skipped=True,
    )


def finished(job: Job) -> Outcome | None:
    """Recognize a hemisphere that an earlier run has done just so.

    Parameters
    ----------
    job : Job
        What would be done.

    Returns
    -------
    Outcome or None
        Its outcome if all files are there and inputs, settings and version are unchanged.
        Failed hemispheres are always tried again: what stood in the way may be gone.
    """
    outcome = None if job.force else recorded(job)
    if outcome is None or outcome.status == Status.FAILED:
        return None
    try:
        digest, _ = hash_inputs(job)
    except (InputError, SchemeError):
        return None
    return outcome if outcome.input_hash == digest else None


def base_record(job: Job) -> dict[str, Any]:
    """Begin the quality record with what is known before any input is read."""
    item = job.item
    sources = dict(job.sources)
    return {
        "version": __version__,
        "settings_hash": job.settings_hash,
        "input_hash": None,
        "inputs": [{"file": source_address(path, sources)} for path in item.files],
        "edited": [
            {"what": edit.kind, "file": source_address(edit.path, sources)} for edit in item.edits
        ],
        "scheme": item.scheme.name,
        "region": job.settings.body.region,
        "scheme_title": item.scheme.title,
        "chosen_because": item.why,
        "passed_over": [
            {"file": source_address(Path(path), sources), "reason": why}
            for path, why in item.passed_over
        ],
        "notes": item.notes,
    }


def hash_inputs(job: Job) -> tuple[str, dict[str, list[dict[str, str]]]]:
    """Hash the input files and how they are read.

    Parameters
    ----------
    job : Job
        Whose inputs.

    Returns
    -------
    tuple of (str, dict)
        One hash of everything that decides what is measured, besides settings and version; and
        address and hash per file: ``inputs``, and what a person ``edited`` of them.

    Raises
    ------
    InputError
        If a file cannot be read.
    SchemeError
        If the protocol has no labels of the region.
    """
    item, sources = job.item, dict(job.sources)
    region = for_region(item.scheme, job.settings.body.region)
    hashes = [
        {"file": source_address(path, sources), "sha256": files.sha256_of(path)}
        for path in item.files
    ]
    edited = [
        {
            "what": edit.kind,
            "file": source_address(edit.path, sources),
            "sha256": files.sha256_of(edit.path),
        }
        for edit in item.edits
    ]
    reading = [
        [entry["sha256"] for entry in hashes],
        # The wording of the protocols (titles, citations) does not change what is read.
        [
            [label.code, int(label.tissue), int(label.part)]
            for scheme in (item.scheme, item.parts_scheme)
            if scheme is not None
            for label in scheme.labels
        ],
        [
            [int(tissue) for tissue in group]
            for group in (region.sheet, item.scheme.layer, item.scheme.interior)
        ],
        [item.scheme.unlisted, item.bilateral, item.code_offset, item.hemi],
        sorted([entry["what"], entry["sha256"]] for entry in edited),
        *signal_hash(item),
    ]
    digest = hashlib.sha256(json.dumps(reading).encode()).hexdigest()
    return digest, {"inputs": hashes, "edited": edited}
