"""Brings together what runs side by side have done, each with a part of the dataset."""

import logging
from collections.abc import Sequence
from pathlib import Path

from hipsta_bids.bids.inputs import HemisphereInput
from hipsta_bids.bids.status import RECORDED, read_status, row_key, update_status
from hipsta_bids.bookkeeping import log_file, not_finished, status_row
from hipsta_bids.job import recorded
from hipsta_bids.reporting import Pages
from hipsta_bids.runner import RunOptions, RunResult, pages_after, prepare
from hipsta_bids.settings import Settings

_LOGGER = logging.getLogger(__name__)


def collect(
    items: Sequence[HemisphereInput], out_dir: Path, settings: Settings, options: RunOptions
) -> RunResult:
    """Make ``status.tsv`` complete: a row for each hemisphere, from its quality record.

    Nothing is measured. Times come from the tables of the runs. Pages that are missing are made,
    and that of all hemispheres.

    Parameters
    ----------
    items : sequence of HemisphereInput
        All that was to be measured.
    out_dir : Path
        The output dataset.
    settings : Settings
        What changes results.
    options : RunOptions
        What does not.

    Returns
    -------
    RunResult
        As if one run had done all; hemispheres that none has finished have failed.

    Raises
    ------
    OutputError
        If the output folder cannot be written.
    SettingsError
        If it holds results with other settings.
    UsageError
        If it is a dataset of other software.
    """
    jobs = prepare(items, out_dir, settings, options)
    outcomes = tuple(recorded(job) or not_finished(job) for job in jobs)
    rows = {row_key(row): row for row in read_status(out_dir)}
    for row in map(status_row, outcomes):
        known = rows.get(row_key(row), {})
        if any(known.get(key) != row[key] for key in RECORDED):
            rows[row_key(row)] = row
    update_status(out_dir, rows.values())
    with log_file(out_dir, options.verbosity) as log:
        pages = Pages()
        with pages_after(jobs, out_dir, options, log, pages):
            pass
        result = RunResult(
            outcomes=outcomes, n_requested=len(jobs), log=log, page_problems=tuple(pages.problems)
        )
        _LOGGER.info("collected: %s, exit code %d", dict(result.counts), result.exit_code)
    return result
