"""The books of a run: rows of ``status.tsv`` and a log file, right at any moment."""

import contextlib
import logging
import time
from collections.abc import Generator, Sequence
from datetime import UTC, datetime
from os import getpid
from pathlib import Path
from socket import gethostname

from hipsta_bids import __version__
from hipsta_bids.artifacts import Status
from hipsta_bids.bids import files
from hipsta_bids.bids.names import DATASET_FILES
from hipsta_bids.bids.status import (
    NOT_FINISHED,
    STAGE_PREFIX,
    identity,
    read_table,
    row_key,
    table_path,
    update_status,
)
from hipsta_bids.errors import HipstaError, OutputError
from hipsta_bids.job import Job, Outcome

_LOG_FORMAT = "%(asctime)s %(levelname)s %(message)s"
_CHEAP_WRITE = 0.1  # s; quicker writes are never put off
_LOGGER = logging.getLogger(__name__)


class Books:
    """The table and the log, written as hemispheres end.

    Parameters
    ----------
    root : Path
        The output dataset.
    shard : str, optional
        Name of the part of the dataset that this run does, which has a table of its own.
    """

    def __init__(self, root: Path, shard: str | None = None) -> None:
        self._root, self._shard = root, shard
        rows = read_table(root / table_path(shard))
        self._known = {row_key(row): row.get("status") for row in rows}
        self._pending: list[dict[str, str]] = []
        self._next_write = 0.0

    def expect(self, jobs: Sequence[Job]) -> None:
        """Make the table right for the case that this process ends at any moment from here on.

        Parameters
        ----------
        jobs : sequence of Job
            What this run is going to do: recorded as not finished until it is.

        Raises
        ------
        OutputError
            If the table cannot be written.
        """
        for row in map(status_row, map(not_finished, jobs)):
            self._pending.append(row)
            self._known[row_key(row)] = row["status"]
        self.close()

    def enter(self, outcome: Outcome) -> None:
        """Write one outcome to the log and to the table.

        Parameters
        ----------
        outcome : Outcome
            How a hemisphere ended.

        Raises
        ------
        OutputError
            If the table cannot be written.
        """
        _log(outcome)
        row = status_row(outcome)
        # Rows that are there already also have the times, which the quality record has not.
        if outcome.skipped and self._known.get(row_key(row)) == row["status"]:
            return
        self._pending.append(row)
        try:
            if time.monotonic() >= self._next_write:
                self.close()
        except OutputError:
            if not isinstance(outcome.error, OutputError):
                raise
            # The hemisphere's own error says more, and ends the run; the table keeps the row that
            # calls it not finished.
            self._pending = []

    def close(self) -> None:
        """Write what has not been written yet.

        Raises
        ------
        OutputError
            If the table cannot be written.
        """
        if not self._pending:
            return
        start = time.monotonic()
        update_status(self._root, self._pending, shard=self._shard)
        self._pending = []
        cost = time.monotonic() - start
        # Tables of many thousand rows may take a twentieth of the time, not more.
        wait = 0.0 if cost < _CHEAP_WRITE else 20 * cost
        self._next_write = time.monotonic() + wait


def not_finished(job: Job) -> Outcome:
    """Say of a hemisphere that no run has come to its end with it."""
    error = HipstaError(
        "the run ended before this hemisphere; run the same command again", reason=NOT_FINISHED
    )
    return Outcome(
        job=job, status=Status.FAILED, reason=error.reason, message=str(error), error=error
    )


def _log(outcome: Outcome) -> None:
    title = outcome.job.title
    if outcome.skipped:
        _LOGGER.info("%s: unchanged, skipped (%s)", title, outcome.status)
        return
    for edit in outcome.job.item.edits:
        _LOGGER.info("%s: edited %s: %s", title, edit.kind, edit.path)
    for stage, seconds in outcome.stages.items():
        _LOGGER.info("%s: %s %.3f s", title, stage, seconds)
    _LOGGER.info("%s: %s %s %s", title, outcome.status, outcome.reason or "", outcome.message or "")
    if outcome.trace:
        _LOGGER.error("%s: %s", title, outcome.trace)


def status_row(outcome: Outcome) -> dict[str, str]:
    """Spell one row of ``status.tsv``."""
    measured = {
        "seconds": outcome.seconds,
        "cpu_seconds": outcome.cpu_seconds,
        "peak_memory_mb": outcome.peak_memory_mb,
        **{f"{STAGE_PREFIX}{stage}": spent for stage, spent in outcome.stages.items()},
    }
    return {
        **identity(outcome.job.place.name),
        "status": str(outcome.status),
        "reason": outcome.reason or files.MISSING,
        "message": outcome.message or files.MISSING,
        "edited": "+".join(outcome.job.item.edited) or files.MISSING,
        "version": __version__,
        "settings_hash": outcome.job.settings_hash,
        "input_hash": outcome.input_hash or files.MISSING,
        **{
            name: files.MISSING if value is None else f"{value:.3f}"
            for name, value in measured.items()
        },
    }


@contextlib.contextmanager
def log_file(root: Path, verbosity: int, shard: str | None = None) -> Generator[Path]:
    """Log this run to a file of its own.

    Parameters
    ----------
    root : Path
        The output dataset.
    verbosity : int
        Above 0, debugging messages too.
    shard : str, optional
        Name of the part of the dataset that this run does.

    Yields
    ------
    Path
        The file.

    Raises
    ------
    OutputError
        If it cannot be made.
    """
    folder = root / DATASET_FILES["logs"]
    files.make_folder(folder)
    part = "" if shard is None else f"_shard-{shard}"
    # Process numbers alone are not unique among the nodes of a cluster.
    process = f"{gethostname().partition('.')[0]}-{getpid()}"
    path = folder / f"run-{datetime.now(UTC):%Y%m%dT%H%M%S}-{process}{part}.log"
    try:
        handler = _QuietHandler(path, encoding="utf-8", errors="surrogateescape")
    except OSError as error:
        raise files.output_error(path, error) from error
    handler.setFormatter(logging.Formatter(_LOG_FORMAT))
    logger = logging.getLogger("hipsta_bids")
    level = logger.level
    logger.setLevel(logging.DEBUG if verbosity else logging.INFO)
    logger.addHandler(handler)
    try:
        yield path
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)
        with contextlib.suppress(OSError):
            handler.close()


class _QuietHandler(logging.FileHandler):
    """Loses lines rather than the run when the disk is full; that is reported elsewhere."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802  (logging's name)
        del record
