"""Runs hemispheres side by side, keeps going after a failure, and keeps the books."""

import contextlib
import logging
import math
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from hipsta_bids import __version__
from hipsta_bids.artifacts import Status
from hipsta_bids.bids import derivative, files, results
from hipsta_bids.bids.inputs import HemisphereInput
from hipsta_bids.bids.locks import DATASET, locked
from hipsta_bids.bids.names import DATASET_FILES, HemisphereName
from hipsta_bids.bids.results import ResultPlace
from hipsta_bids.bids.status import write_sidecar
from hipsta_bids.bookkeeping import Books, log_file
from hipsta_bids.cluster import Cluster, run_on_cluster
from hipsta_bids.errors import ExitCode, HipstaError, InputError, OutputError, SchemeError
from hipsta_bids.job import Job, Outcome, finished
from hipsta_bids.pool import WorkerLost, WorkerPlan, run_jobs
from hipsta_bids.reporting import PagePlan, Pages, reports_after
from hipsta_bids.schemes import Scheme
from hipsta_bids.settings import Settings
from hipsta_bids.shard import Shard
from hipsta_bids.worker import INTERNAL, fail, run_job, warm_up

WORKER_GB = 0.6
"""Memory that one worker may need, GB: 500 MB for a hemisphere, and its helper process."""

_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """What never changes a result."""

    n_procs: int = 1
    """Hemispheres measured at the same time."""
    mem_gb: float | None = None
    """Upper limit for all workers together; ``None`` is no limit."""
    work_dir: Path | None = None
    """Scratch folder; ``None`` is the system's."""
    stop_on_first_crash: bool = False
    verbosity: int = 0
    force: bool = False
    """Redo hemispheres that are up to date."""
    write_meshes: bool = False
    timeout: float = 600.0
    """Seconds per hemisphere."""
    shard: Shard | None = None
    """Which part of the dataset this is, if other runs do the others."""
    cluster: Cluster | None = None
    """Workers elsewhere; ``None`` is this machine."""
    reports: bool = False
    """Make pages to look at afterwards."""
    command: str | None = None
    """The command line, for the log."""


@dataclass(frozen=True, kw_only=True)
class RunResult:
    """What a run did."""

    outcomes: tuple[Outcome, ...]
    """Of all hemispheres that ended or were skipped."""
    n_requested: int
    log: Path
    page_problems: tuple[str, ...] = ()
    """One line per page that could not be made."""

    @property
    def counts(self) -> Counter[str]:
        """Hemispheres per status, skipped ones under the status that they have."""
        return Counter(str(outcome.status) for outcome in self.outcomes)

    @property
    def exit_code(self) -> ExitCode:
        """The gravest of what happened.

        A disk that cannot be written outranks a bug, a bug outranks failed hemispheres. When
        every hemisphere failed because of its input, the data are to blame.
        """
        failed = [outcome for outcome in self.outcomes if outcome.status == Status.FAILED]
        if any(isinstance(outcome.error, OutputError) for outcome in failed):
            return ExitCode.NOT_WRITABLE
        if any(outcome.reason == INTERNAL for outcome in failed):
            return ExitCode.INTERNAL
        if not failed and len(self.outcomes) == self.n_requested:
            return ExitCode.OK
        if len(failed) == self.n_requested and all(
            isinstance(outcome.error, (InputError, SchemeError)) for outcome in failed
        ):
            return ExitCode.BAD_DATA
        return ExitCode.SOME_FAILED


def run_participants(
    items: Sequence[HemisphereInput],
    out_dir: Path,
    settings: Settings,
    options: RunOptions,
    report: Callable[[Outcome], None],
) -> RunResult:
    """Measure hemispheres and write the output dataset.

    Parameters
    ----------
    items : sequence of HemisphereInput
        What to measure.
    out_dir : Path
        The output dataset; made if need be.
    settings : Settings
        What changes results.
    options : RunOptions
        What does not.
    report : callable
        Called in this process with each outcome as it comes.

    Returns
    -------
    RunResult
        Failed hemispheres are in it, not raised.

    Raises
    ------
    OutputError
        If the output folder cannot be written, at the start or for want of space later.
    SettingsError
        If it holds results with other settings.
    UsageError
        If it is a dataset of other software.
    """
    jobs = prepare(items, out_dir, settings, options)
    shard = None if options.shard is None else options.shard.name
    with log_file(out_dir, options.verbosity, shard) as log:
        _LOGGER.info("hipsta_bids %s, %d hemispheres", __version__, len(jobs))
        if options.command:
            _LOGGER.info("command: %s", options.command)
        books = Books(out_dir, shard)
        pages = Pages()
        # Closed at once, whatever ends the loop, so that no worker outlives it.
        with (
            pages_after(jobs, out_dir, options, log, pages),
            contextlib.closing(books),
            contextlib.closing(_outcomes(jobs, books, options, log)) as found,
        ):
            outcomes = _run(found, books, options, report)
            pages.wanted = not any(isinstance(one.error, OutputError) for one in outcomes)
        result = RunResult(
            outcomes=tuple(outcomes),
            n_requested=len(jobs),
            log=log,
            page_problems=tuple(pages.problems),
        )
        _LOGGER.info("done: %s, exit code %d", dict(result.counts), result.exit_code)
    return result


def prepare(
    items: Sequence[HemisphereInput], out_dir: Path, settings: Settings, options: RunOptions
) -> list[Job]:
    """Write what describes the dataset as a whole, and say what is to be done.

    Parameters, and what is raised, are those of :func:`run_participants`.

    Returns
    -------
    list of Job
        One per item.
    """
    sources = _source_names(items)
    derivative.check_not_foreign(out_dir)
    files.check_writable(out_dir)
    with locked(out_dir, DATASET) as alone:
        if alone:
            files.remove_leftovers(out_dir, "*")
        digest = derivative.settle_settings(out_dir, settings)
        derivative.write_description(out_dir, sources)
        if options.shard is None or not (out_dir / DATASET_FILES["citation"]).exists():
            derivative.write_citation(out_dir, settings, _schemes(items))
        write_sidecar(out_dir)
    return [
        Job(
            item=item,
            place=ResultPlace(root=out_dir, name=hemisphere_name(item, settings)),
            settings=settings,
            settings_hash=digest,
            sources=tuple(sources.items()),
            write_meshes=options.write_meshes,
            force=options.force,
        )
        for item in items
    ]


def _run(
    outcomes: Iterable[Outcome],
    books: Books,
    options: RunOptions,
    report: Callable[[Outcome], None],
) -> list[Outcome]:
    """Book and report outcomes as they come, until all are there or one ends the run."""
    kept = []
    for outcome in outcomes:
        books.enter(outcome)
        kept.append(outcome)
        report(outcome)
        if isinstance(outcome.error, OutputError):
            break  # the next one would fail just so
        if options.stop_on_first_crash and outcome.status == Status.FAILED:
            break
    return kept


def pages_after(
    jobs: Sequence[Job], out_dir: Path, options: RunOptions, log: Path, pages: Pages
) -> AbstractContextManager[None]:
    """Make pages when a block ends, if they are wanted; that of all if this is no part."""
    if not options.reports:
        return contextlib.nullcontext()
    visits = [(job.place.name.subject, job.place.name.session) for job in jobs]
    plan = PagePlan(
        root=out_dir,
        n_workers=n_workers(options, len(visits)),
        log=log,
        cohort=options.shard is None,
        cluster=options.cluster,
    )
    return reports_after(plan, visits, pages)


def hemisphere_name(item: HemisphereInput, settings: Settings) -> HemisphereName:
    """Name the results of one input."""
    return HemisphereName(
        subject=item.subject,
        session=item.session,
        hemi=item.hemi,
        seg=item.scheme.name,
        region=settings.body.region,
    )


def n_workers(options: RunOptions, n_jobs: int) -> int:
    """How many workers the limits on processes and memory allow, at least one."""
    by_memory = math.inf if options.mem_gb is None else options.mem_gb // WORKER_GB
    return int(max(1, min(options.n_procs, by_memory, n_jobs)))


def _outcomes(
    jobs: Sequence[Job], books: Books, options: RunOptions, log: Path
) -> Generator[Outcome]:
    """Give the outcomes of all hemispheres: first what is done already, then the others."""
    todo = []
    for job in jobs:
        earlier = finished(job)
        if earlier is None:
            todo.append(job)
        else:
            yield earlier
    books.expect(todo)
    for job in todo:
        if job.item.problem is not None:
            yield fail(job, job.item.problem)
    able = [job for job in todo if job.item.problem is None]
    plan = _plan(options, len(able), log)
    if options.cluster is None or not able:
        pool = run_jobs(plan, able)
    else:
        pool = run_on_cluster(options.cluster, plan, able)
    try:
        for job, answer in pool:
            yield _lost(job, answer, options) if isinstance(answer, WorkerLost) else answer
    except BaseException:
        pool.close()
        for job in able:
            with contextlib.suppress(OutputError):
                _remove_unfinished(job)
        raise


def _remove_unfinished(job: Job) -> None:
    """Remove what was being written: it has no quality record yet."""
    if job.place.path("sheet").exists() and not job.place.path("qc").exists():
        with locked(job.place.root, job.title):
            if not job.place.path("qc").exists():  # another run may have been at it
                results.remove_results(job.place)


def _plan(options: RunOptions, n_jobs: int, log: Path) -> WorkerPlan:
    scratch = () if options.work_dir is None else (("TMPDIR", str(options.work_dir)),)
    return WorkerPlan(
        work=run_job,
        n_workers=n_workers(options, n_jobs),
        timeout=options.timeout,
        log=log,
        warm_up=warm_up,
        environment=scratch,
    )


def _lost(job: Job, loss: WorkerLost, options: RunOptions) -> Outcome:
    """Turn the loss of a worker into a failure of its hemisphere."""
    if loss.timed_out:
        error = HipstaError(
            f"not done within {options.timeout:g} s; look at the segmentation, or raise --timeout",
            reason="timeout",
        )
    else:
        error = HipstaError(
            f"the process died ({loss.cause}); if memory ran out use fewer --n-procs, else report"
            " it with the log",
            reason="worker-died",
        )
    # Another run may have been at it, and for that one it may have gone well.
    with locked(job.place.root, job.title):
        return finished(job) or fail(job, error, seconds=loss.seconds)


def _source_names(items: Sequence[HemisphereInput]) -> dict[str, Path]:
    """Name the datasets that inputs come from."""
    origins = [(item.source, item.source_path) for item in items]
    origins += [(edit.source, edit.source_path) for item in items for edit in item.edits]
    origins += [("bids", m.source_path) for item in items for m in item.maps if m.source_path]
    return derivative.source_names(origins)


def _schemes(items: Sequence[HemisphereInput]) -> list[Scheme]:
    """List the protocols in use, each once."""
    found = {}
    for item in items:
        for scheme in (item.scheme, item.parts_scheme):
            if scheme is not None:
                found[scheme.name] = scheme
    return [found[name] for name in sorted(found)]
