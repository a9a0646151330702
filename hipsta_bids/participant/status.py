"""Keeps ``status.tsv`` right at any moment of a run: one row per hemisphere, from its outcome."""

import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import median

from hipsta_bids import __version__
from hipsta_bids.derivatives import dataset
from hipsta_bids.errors import HipstaError, OutputError
from hipsta_bids.io import files
from hipsta_bids.participant.job import Job, Outcome
from hipsta_bids.types import Decision

_USUAL_SECONDS = 3.0  # of a hemisphere on a usual machine, if none was measured before
_CHEAP_WRITE = 0.1  # s; quicker writes are never put off


class StatusTable:
    """``status.tsv`` as a view of the quality records, right at any moment of a run.

    It adds hemispheres that a run has not reached, and times and memory, which would make records
    differ from run to run. A row that agrees with its record is kept for these.
    """

    def __init__(self, root: Path, shard: str | None = None) -> None:
        self._root, self._shard = root, shard
        shard_rows = _by_key(dataset.read_table(root / dataset.table_path(shard)))
        # The table of the whole dataset takes up those of its parts.
        self._known = dict(shard_rows) if shard else _by_key(dataset.read_status(root))
        self._pending = {key: row for key, row in self._known.items() if row != shard_rows.get(key)}
        self._next_write = 0.0

    def expect(self, jobs: Sequence[Job]) -> None:
        """Make the table right for the case that this process ends at any moment from here on."""
        self._pending |= _by_key(map(status_row, map(not_finished, jobs)))
        self._known |= self._pending
        self.close()

    def add(self, outcome: Outcome) -> None:
        """Take in one outcome."""
        row = status_row(outcome)
        recorded_row = self._known.get(dataset.row_key(row), {})
        if outcome.seconds is None and all(
            recorded_row.get(cell) == row[cell] for cell in dataset.RECORDED
        ):
            return
        self._pending[dataset.row_key(row)] = row
        try:
            if time.monotonic() >= self._next_write:
                self.close()
        except OutputError:
            if not isinstance(outcome.error, OutputError):
                raise
            # The hemisphere's own error says more, and ends the run; the table keeps the row that
            # calls it not finished.
            self._pending = {}

    def usual_seconds(self) -> float:
        """Median time of the hemispheres that were measured before, s."""
        cells = [row.get("seconds", files.MISSING) for row in self._known.values()]
        return median([float(cell) for cell in cells if cell != files.MISSING] or [_USUAL_SECONDS])

    def close(self) -> None:
        """Write the rows that are not written yet."""
        if not self._pending:
            return
        start = time.monotonic()
        dataset.update_status(self._root, self._pending.values(), shard=self._shard)
        self._pending = {}
        cost = time.monotonic() - start
        # Tables of many thousand rows may take a twentieth of the time, not more.
        self._next_write = time.monotonic() + (0.0 if cost < _CHEAP_WRITE else 20 * cost)


def _by_key(rows: Iterable[dict[str, str]]) -> dict[tuple[str, ...], dict[str, str]]:
    """Return rows by the hemisphere that they are about."""
    return {dataset.row_key(row): row for row in rows}


def not_finished(job: Job) -> Outcome:
    """Outcome of a hemisphere that no run has finished."""
    message = "the run ended before this hemisphere; run the same command again"
    error = HipstaError(message, reason=dataset.NOT_FINISHED)
    return Outcome(
        job=job, decision=Decision.FAILED, reason=error.reason, message=message, error=error
    )


def status_row(outcome: Outcome) -> dict[str, str]:
    """Row of ``status.tsv``."""
    measured = {
        "seconds": outcome.seconds,
        "cpu_seconds": outcome.cpu_seconds,
        "peak_memory_mb": outcome.peak_memory_mb,
        **{f"{dataset.STAGE_PREFIX}{stage}": spent for stage, spent in outcome.stages.items()},
    }
    return {
        **dataset.identity(outcome.job.result.name),
        "decision": str(outcome.decision),
        "reason": outcome.reason or files.MISSING,
        "message": outcome.headline or files.MISSING,
        "repairs": str(outcome.repairs),
        "edited": "+".join(outcome.job.item.edited) or files.MISSING,
        "version": __version__,
        "settings_hash": outcome.job.settings_hash,
        "input_hash": outcome.input_hash or files.MISSING,
        **{
            name: files.MISSING if value is None else f"{value:.3f}"
            for name, value in measured.items()
        },
    }
