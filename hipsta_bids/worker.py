"""One hemisphere from files to files: read, measure, write. This is what workers run."""

import traceback
from pathlib import Path
from typing import Any

from hipsta_bids.artifacts import BodyMask, Status
from hipsta_bids.bids import files, results
from hipsta_bids.bids.locks import locked
from hipsta_bids.cost import CostClock
from hipsta_bids.errors import GeometryError, HipstaError, OutputError
from hipsta_bids.job import Job, Outcome, base_record, finished, hash_inputs
from hipsta_bids.mapping import Mapped, add_signals, write_signals
from hipsta_bids.schemes import for_region

INTERNAL = "internal-error"
"""Reason of a failure that is a bug."""


def warm_up() -> None:
    """Load the libraries, so that no hemisphere's time includes it."""
    import hipsta_bids.bids.images  # noqa: PLC0415  (loaded in workers only)
    import hipsta_bids.participant  # noqa: F401, PLC0415


def run_job(job: Job) -> Outcome:
    """Measure one hemisphere and write its results; never raises a foreseen error.

    Where another run is just doing the same, it is waited for, and its results are taken.

    Parameters
    ----------
    job : Job
        What to do.

    Returns
    -------
    Outcome
        ``failed`` hemispheres leave nothing but their quality record and, if the labels tell, the
        mask of the body.
    """
    try:
        with locked(job.place.root, job.title):
            return finished(job) or _measure(job)
    except OutputError as error:
        return fail(job, error)


def _measure(job: Job) -> Outcome:
    from hipsta_bids.bids.images import read_label_volume  # noqa: PLC0415  (workers only)
    from hipsta_bids.participant import find_body, measure_hemisphere  # noqa: PLC0415

    clock = CostClock()
    record = base_record(job)
    hashed, volume = None, None
    try:
        with clock("read"):
            hashed, hashes = hash_inputs(job)
            record |= {"input_hash": hashed} | hashes
            volume = read_label_volume(job.item, job.settings.body.region)
        maps = measure_hemisphere(volume, job.item.hemi, job.settings, clock)
        mapped = Mapped()
        if job.item.maps or job.item.regions:
            with clock("maps"):
                maps, mapped = add_signals(job.item, maps, job.settings.maps, dict(job.sources))
                record |= mapped.record or {}
        with clock("write"):
            results.write_results(
                job.place,
                maps,
                for_region(job.item.scheme, job.settings.body.region),
                record,
                write_meshes=job.write_meshes,
                write_more=lambda: write_signals(job.place, maps, mapped),
            )
    except Exception as error:  # noqa: BLE001  (one hemisphere's bug must not end the others)
        foreseen = foresee(error, job.place.root)
        trace = None if foreseen else traceback.format_exc()
        body = None
        if volume is not None and isinstance(error, GeometryError):
            body = find_body(volume, job.settings)
        return fail(
            job,
            foreseen or unforeseen(error),
            trace=trace,
            record=record,
            body=body,
            **clock.spent(),
        )
    status, reason, message = results.verdict(maps)
    return Outcome(
        job=job,
        status=status,
        reason=reason,
        message=message,
        input_hash=hashed,
        thickness=maps.summary.get("thickness_mean"),
        **clock.spent(),
    )


def fail(
    job: Job,
    error: HipstaError,
    *,
    trace: str | None = None,
    record: dict[str, Any] | None = None,
    body: BodyMask | None = None,
    **spent: Any,  # noqa: ANN401  (fields of Outcome)
) -> Outcome:
    """Record that a hemisphere failed, and remove what it had.

    Parameters
    ----------
    job : Job
        Whose failure.
    error : HipstaError
        Why.
    trace : str, optional
        Traceback, if it is a bug.
    record : dict, optional
        What is known about its inputs.
    body : BodyMask, optional
        What could not be measured, for a person to correct.
    **spent
        Times and memory, as fields of :class:`Outcome`.

    Returns
    -------
    Outcome
        With the error of writing instead, if not even the record can be written.
    """
    record = base_record(job) if record is None else record
    try:
        results.write_failure(job.place, error, record, body)
    except OutputError as worse:
        if not isinstance(error, OutputError):
            error = worse
    return Outcome(
        job=job,
        status=Status.FAILED,
        reason=error.reason,
        message=str(error),
        error=None if trace else error,
        trace=trace,
        input_hash=record.get("input_hash"),
        **spent,
    )


def foresee(error: Exception, root: Path) -> HipstaError | None:
    """Tell what a user can act on from a bug.

    Parameters
    ----------
    error : Exception
        What was raised.
    root : Path
        The output dataset, for messages.

    Returns
    -------
    HipstaError or None
        ``None`` for a bug.
    """
    if isinstance(error, HipstaError):
        return error
    if isinstance(error, MemoryError):
        return HipstaError(
            "out of memory; use fewer processes (--n-procs) or a machine with more",
            reason="out-of-memory",
        )
    if isinstance(error, OSError) and files.is_disk_full(error):
        return files.output_error(Path(error.filename) if error.filename else root, error)
    return None


def unforeseen(error: Exception) -> HipstaError:
    """Word a bug as an error; its traceback goes to the log."""
    what = " ".join(f"{type(error).__name__}: {error}".split())
    return HipstaError(f"internal error ({what}); please report it with the log", reason=INTERNAL)
