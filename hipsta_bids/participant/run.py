"""Runs hemispheres side by side, goes on after a failure, and writes the output dataset."""

import contextlib
import logging
import math
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import timedelta
from itertools import chain
from pathlib import Path
from typing import Any

from hipsta_bids import __version__
from hipsta_bids.derivatives import dataset, hemisphere
from hipsta_bids.derivatives.copies import describe_copies, mark_copies
from hipsta_bids.derivatives.measures import write_measures
from hipsta_bids.derivatives.names import DATASET_FILES, HemisphereName, write_shared
from hipsta_bids.derivatives.results import ResultPlace, read_record
from hipsta_bids.errors import ExitCode, HipstaError, InputError, OutputError, ProtocolError
from hipsta_bids.inputs.scan import HemisphereInput
from hipsta_bids.io import files
from hipsta_bids.joints import find_grouping, find_measurements, load
from hipsta_bids.participant.job import (
    INTERNAL,
    Job,
    Outcome,
    fail,
    finished,
    recorded,
    run_alone,
    warm_up,
)
from hipsta_bids.participant.log import log_file, log_outcome
from hipsta_bids.participant.pages import PagePlan, reports_after
from hipsta_bids.participant.pool import RunJobs, WorkerLost, WorkerPlan, run_jobs
from hipsta_bids.participant.shard import Shard
from hipsta_bids.participant.status import StatusTable, not_finished
from hipsta_bids.progress import tell
from hipsta_bids.settings import Settings
from hipsta_bids.types import Decision

WORKER_GB = 0.6
"""Memory that one worker may need, GB: 500 MB for a hemisphere, and its helper process."""

STAGE = "hemispheres"
"""Name of the stage that measures them, on the terminal."""

#: Hemispheres by the groups in which they are measured.
_Groups = list[tuple[Job, ...]]

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
    further: Mapping[str, Any] = field(default_factory=dict)
    """Options of extensions that were given, by name in Python."""
    timeout: float = 600.0
    """Seconds per hemisphere."""
    shard: Shard | None = None
    """Which part of the dataset this is, if other runs do the others."""
    engine: RunJobs | None = None
    """Workers elsewhere; ``None`` is this machine."""
    reports: bool = False
    """Make pages to look at afterwards."""
    bids_dir: Path | None = None
    """The BIDS dataset whose images and dates of sessions the pages show; ``None`` shows none."""
    anatomy: bool = True
    """Whether the pages show anatomical images."""
    command: str | None = None
    """The command line, for the log."""
    notes: tuple[str, ...] = ()
    """What the search for inputs had to say, for the log."""
    inputs: tuple[Mapping[str, str], ...] = ()
    """Rows of ``inputs.tsv``."""
    is_whole: bool = True
    """Whether these are about all participants."""
    pybids: bool = False
    """Whether PyBIDS selected the inputs, so that the methods text cites it."""


@dataclass(frozen=True, kw_only=True)
class RunResult:
    """What a run did."""

    outcomes: tuple[Outcome, ...]
    """Of all hemispheres that ended or were skipped."""
    n_requested: int
    log: Path
    page_problems: tuple[HipstaError, ...] = ()
    """Why pages could not be made."""
    copies: tuple[str, ...] = ()
    """One line per group of hemispheres with the same labels."""

    @property
    def counts(self) -> Counter[str]:
        """Hemispheres per decision, skipped ones included."""
        return Counter(str(outcome.decision) for outcome in self.outcomes)

    @property
    def exit_code(self) -> ExitCode:
        """The gravest: a disk that is full, a bug or no page, bad data, failed hemispheres.

        The data are to blame if every hemisphere failed because of its input.
        """
        failed = [outcome for outcome in self.outcomes if outcome.decision == Decision.FAILED]
        errors = [*(outcome.error for outcome in failed), *self.page_problems]
        if any(isinstance(error, OutputError) for error in errors):
            return ExitCode.NOT_WRITABLE
        if self.page_problems or any(outcome.reason == INTERNAL for outcome in failed):
            return ExitCode.INTERNAL
        if not failed and len(self.outcomes) == self.n_requested:
            return ExitCode.OK
        if len(failed) == self.n_requested and all(
            isinstance(outcome.error, (InputError, ProtocolError)) for outcome in failed
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
        Called in this process with each outcome at once.

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
    return _run(items, out_dir, settings, options, report=report, outcomes_of=_measured)


def collect(
    items: Sequence[HemisphereInput], out_dir: Path, settings: Settings, options: RunOptions
) -> RunResult:
    """Collect the results of runs of parts of a dataset; measures nothing.

    ``status.tsv`` gets a row for each hemisphere, from its quality record, with times from the
    tables of the runs. Pages that are missing are made, and the page of all hemispheres.
    """
    options = replace(options, stop_on_first_crash=False)
    return _run(items, out_dir, settings, options, report=lambda _: None, outcomes_of=_collected)


def _run(
    items: Sequence[HemisphereInput],
    out_dir: Path,
    settings: Settings,
    options: RunOptions,
    *,
    report: Callable[[Outcome], None],
    outcomes_of: Callable[[_Groups, StatusTable, RunOptions, Path], Generator[Outcome]],
) -> RunResult:
    """Log, report and tabulate outcomes as they come, then make the pages."""
    groups = _prepare(items, out_dir, settings, options)
    jobs = list(chain.from_iterable(groups))
    shard = None if options.shard is None else options.shard.name
    outcomes: list[Outcome] = []
    copies: list[str] = []
    visits = [(job.result.name.subject, job.result.name.session) for job in jobs]
    with log_file(out_dir, options.verbosity, shard) as log:
        _log_start(options, len(jobs))
        table = StatusTable(out_dir, shard)
        _write_inputs(out_dir, options, ())
        plan = PagePlan(
            root=out_dir,
            n_workers=n_workers(options, len(visits)),
            log=log,
            bids_dir=options.bids_dir,
            anatomy=options.anatomy,
            cohort=options.shard is None,
            engine=options.engine,
        )
        # Closed at once, whatever ends the loop, so that no worker outlives it.
        with (
            reports_after(plan if options.reports else None, visits) as pages,
            contextlib.closing(table),
            contextlib.closing(outcomes_of(groups, table, options, log)) as results,
        ):
            for outcome in results:
                log_outcome(outcome)
                table.add(outcome)
                outcomes.append(outcome)
                report(outcome)
                if isinstance(outcome.error, OutputError):
                    pages.enabled = False
                    break  # the next one would fail just so
                if options.stop_on_first_crash and outcome.decision == Decision.FAILED:
                    break
            _write_inputs(out_dir, options, outcomes)
            table.close()
            if not any(isinstance(outcome.error, OutputError) for outcome in outcomes):
                write_measures(out_dir, complete=shard is None)
            if pages.enabled and shard is None:
                copies += _find_copies(jobs, out_dir)
        result = RunResult(
            outcomes=tuple(outcomes),
            n_requested=len(jobs),
            log=log,
            page_problems=tuple(pages.problems),
            copies=tuple(copies),
        )
        _LOGGER.info("done: %s, exit code %d", dict(result.counts), result.exit_code)
    return result


def _log_start(options: RunOptions, count: int) -> None:
    """Log what begins, and what the search for inputs noted."""
    _LOGGER.info("hipsta_bids %s, %d hemispheres", __version__, count)
    if options.command:
        _LOGGER.info("command: %s", options.command)
    for note in options.notes:
        _LOGGER.info("note: %s", note)


def _write_inputs(out_dir: Path, options: RunOptions, outcomes: Sequence[Outcome]) -> None:
    """Write what became of all that was found."""
    if not options.inputs:
        return
    endings: dict[tuple[str, ...], dict[str, str]] = {}
    for outcome in outcomes:
        with contextlib.suppress(InputError):
            ending = dataset.provenance_of(read_record(outcome.job.result))
            if outcome.decision == Decision.FAILED:
                ending |= {"status": "failed", "reason": outcome.message or ""}
            endings[dataset.row_key(dataset.identity(outcome.job.result.name))[:-1]] = ending
    rows = []
    for row in options.inputs:
        key = tuple(row.get(name, files.MISSING) for name in dataset.KEY)
        rows.append({**row, **endings.get(key, {})} if row["status"] == "used" else row)
    is_whole = options.is_whole and options.shard is None
    dataset.write_inputs(out_dir, rows, is_whole=is_whole)


def _find_copies(jobs: Sequence[Job], out_dir: Path) -> Iterator[str]:
    """Mark hemispheres with the same labels in the table, and describe those of this run."""
    names_of_jobs = {job.result.name for job in jobs}
    for names in mark_copies(out_dir):
        if names_of_jobs.intersection(names):
            line = describe_copies(names)
            _LOGGER.warning("%s", line)
            yield line


def _prepare(
    items: Sequence[HemisphereInput], out_dir: Path, settings: Settings, options: RunOptions
) -> _Groups:
    """Write what describes the dataset as a whole; list what is to be done, in groups."""
    sources = _find_sources(items)
    digest = _describe(items, out_dir, settings, options, sources)
    memory = options.mem_gb and options.mem_gb / n_workers(options, len(items))
    jobs = [
        Job(
            item=item,
            result=ResultPlace(
                root=out_dir,
                name=HemisphereName(
                    subject=item.subject,
                    session=item.session,
                    hemi=item.hemi,
                    seg=item.protocol.name,
                    region=settings.body.region,
                ),
            ),
            settings=settings,
            settings_hash=digest,
            sources=tuple(sources.items()),
            write_meshes=options.write_meshes,
            further=options.further,
            force=options.force,
            memory_gb=memory,
        )
        for item in items
    ]
    grouping = find_grouping(settings)
    return [(job,) for job in jobs] if grouping is None else load(grouping.gather)(jobs)


def _find_sources(items: Sequence[HemisphereInput]) -> dict[str, Path]:
    """Name the datasets of all inputs."""
    origins = [(item.source, item.source_path) for item in items]
    origins += [(edit.source, edit.source_path) for item in items for edit in item.edits]
    origins += [(soft.source, soft.source_path) for i in items if (soft := i.probabilities)]
    additions = chain.from_iterable(item.further.values() for item in items)
    origins += chain.from_iterable(addition.origins for addition in additions)
    return dataset.source_names(origins)


def _describe(
    items: Sequence[HemisphereInput],
    out_dir: Path,
    settings: Settings,
    options: RunOptions,
    sources: Mapping[str, Path],
) -> str:
    """Write the files of the dataset as a whole; return the hash of the settings."""
    used_protocols = [
        p for item in items for p in (item.protocol, item.parts_protocol) if p is not None
    ]
    protocols = {protocol.name: protocol for protocol in used_protocols}
    dataset.check_own_dataset(out_dir)
    files.check_writable(out_dir)
    with files.locked(out_dir, files.DATASET) as is_only_run:
        if is_only_run:
            files.remove_leftovers(out_dir, "*")
        digest = dataset.settle_settings(out_dir, settings)
        dataset.write_description(out_dir, sources)
        if options.shard is None or not (out_dir / DATASET_FILES["citation"]).exists():
            text = dataset.citation_text(
                settings,
                [protocols[k] for k in sorted(protocols)],
                pybids=options.pybids,
                probabilities=any(item.probabilities for item in items),
            )
            files.write_text(out_dir / DATASET_FILES["citation"], text)
        dataset.write_sidecar(out_dir)
        write_shared(out_dir)
    return digest


def n_workers(options: RunOptions, n_jobs: int) -> int:
    """Return how many workers the limits on processes and memory allow, at least one."""
    by_memory = math.inf if options.mem_gb is None else options.mem_gb // WORKER_GB
    return int(max(1, min(options.n_procs, by_memory, n_jobs)))


def _collected(groups: _Groups, *_: object) -> Generator[Outcome]:
    """Read the outcomes of all hemispheres from their records."""
    for job in chain.from_iterable(groups):
        yield recorded(job) or not_finished(job)


def _measured(
    groups: _Groups, table: StatusTable, options: RunOptions, log: Path
) -> Generator[Outcome]:
    """Return the outcomes of all hemispheres: first what is done already, then the others."""
    todo: _Groups = []
    for group in groups:
        earlier = [outcome for job in group if (outcome := finished(job)) is not None]
        if len(earlier) < len(group):
            todo.append(group)
        else:
            yield from earlier
    table.expect(list(chain.from_iterable(todo)))
    for job in chain.from_iterable(todo):
        if job.item.problem is not None:
            yield fail(job, job.item.problem)
    able = [tuple(job for job in group if job.item.problem is None) for group in todo]
    yield from _pooled([group for group in able if group], table, options, log)


def _pooled(
    groups: _Groups, table: StatusTable, options: RunOptions, log: Path
) -> Generator[Outcome]:
    """Measure groups of hemispheres side by side; clean up if the user stops it."""
    jobs = list(chain.from_iterable(groups))
    grouping = find_grouping(jobs[0].settings) if jobs else None
    plan = WorkerPlan(
        work=run_alone if grouping is None else load(grouping.run),
        n_workers=n_workers(options, len(groups)),
        timeout=options.timeout * max(map(len, groups), default=1),
        log=log,
        warm_up=warm_up,
        environment=() if options.work_dir is None else (("TMPDIR", str(options.work_dir)),),
        begun=_tell_titles,
    )
    if options.engine is None or not groups:
        tell(STAGE, None, current=f"about {_expected(table, plan, jobs)}")
        pool = run_jobs(plan, groups)
    else:
        pool = options.engine(plan, groups)
    try:
        for group, answer in pool:
            if isinstance(answer, WorkerLost):
                yield from (_lost(job, answer, options) for job in group)
            else:
                yield from answer
    except BaseException:
        pool.close()
        for job in jobs:
            with contextlib.suppress(OutputError):
                _remove_unfinished(job)
        raise


def _tell_titles(groups: _Groups) -> None:
    name, count = groups[-1][0].result.name, len(groups) - 1
    ending = f" and {count} more" if count else ""
    tell(STAGE, None, current=f"sub-{name.subject} {name.hemi}{ending}")


def _expected(table: StatusTable, plan: WorkerPlan, jobs: Sequence[Job]) -> timedelta:
    """Guess how long jobs take, from what others in the same folder took."""
    further = jobs[0].further if jobs else {}
    costs = (load(m.cost)(further[m.name]) for m in find_measurements() if m.name in further)
    seconds = table.usual_seconds() * math.prod(costs)
    return timedelta(seconds=round(seconds * math.ceil(len(jobs) / plan.n_workers)))


def _remove_unfinished(job: Job) -> None:
    """Remove what was being written: it has no quality record yet."""
    if job.result.path("sheet").exists() and not job.result.path("qc").exists():
        with files.locked(job.result.root, job.title):
            if not job.result.path("qc").exists():  # another run may have been at it
                hemisphere.remove_results(job.result)


def _lost(job: Job, loss: WorkerLost, options: RunOptions) -> Outcome:
    """Outcome of a hemisphere whose worker was lost."""
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
    with files.locked(job.result.root, job.title):
        return finished(job) or fail(job, error, seconds=loss.seconds)
