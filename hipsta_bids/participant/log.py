"""The log of a run: a file of its own for each command, in the folder of logs of the dataset."""

import contextlib
import logging
from collections.abc import Generator
from datetime import UTC, datetime
from os import getpid
from pathlib import Path
from socket import gethostname

from hipsta_bids.derivatives.names import DATASET_FILES
from hipsta_bids.io import files
from hipsta_bids.participant.job import Outcome

_FORMAT = "%(asctime)s %(levelname)s %(message)s"
_LOGGER = logging.getLogger(__name__)


@contextlib.contextmanager
def log_file(root: Path, verbosity: int, shard: str | None = None) -> Generator[Path]:
    """Log this run to a file of its own."""
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
    handler.setFormatter(logging.Formatter(_FORMAT))
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


def log_outcome(outcome: Outcome) -> None:
    """Write what became of a hemisphere."""
    title = outcome.job.title
    if outcome.skipped:
        _LOGGER.info("%s: unchanged, skipped (%s)", title, outcome.decision)
        return
    for note in dict.fromkeys((*outcome.job.item.notes, *outcome.notes)):
        _LOGGER.info("%s: note: %s", title, note)
    for edit in outcome.job.item.edits:
        _LOGGER.info("%s: edited %s: %s", title, edit.kind, edit.path)
    for stage, seconds in outcome.stages.items():
        _LOGGER.info("%s: %s %.3f s", title, stage, seconds)
    reason, message = outcome.reason or "", outcome.message or ""
    _LOGGER.info("%s: %s %s %s", title, outcome.decision, reason, message)
    if outcome.trace:
        _LOGGER.error("%s: %s", title, outcome.trace)
