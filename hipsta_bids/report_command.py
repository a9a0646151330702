"""``--reports-only``: the pages of an output dataset, made anew from its files."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from hipsta_bids.console import complain, say
from hipsta_bids.errors import ExitCode, NothingToDoError

if TYPE_CHECKING:
    from argparse import Namespace


def rebuild_reports(options: "Namespace") -> ExitCode:
    """Make the pages of all visits that are asked for, and that of the cohort.

    Parameters
    ----------
    options : Namespace
        Of the participant level.

    Returns
    -------
    ExitCode

    Raises
    ------
    NothingToDoError
        If the output dataset has no results of these visits.
    OutputError
        If it cannot be written.
    """
    from hipsta_bids.bids.files import check_writable  # noqa: PLC0415  (start-up time)
    from hipsta_bids.bids.names import DATASET_FILES  # noqa: PLC0415
    from hipsta_bids.bookkeeping import log_file  # noqa: PLC0415  (heavy)
    from hipsta_bids.reporting import PagePlan, visits_of, write_reports  # noqa: PLC0415  (heavy)

    root = options.output_dir
    visits = [
        (subject, session)
        for subject, session in visits_of(root)
        if subject in (options.participant_label or [subject])
        and session in (options.session_label or [session])
    ]
    if not visits:
        raise NothingToDoError(
            f"{root}: no results of these participants; run without --reports-only first",
            reason="nothing-to-report",
        )
    check_writable(root)
    with log_file(root, options.verbose) as log:
        plan = PagePlan(root=root, n_workers=options.n_procs, log=log)
        problems = list(write_reports(plan, visits))
    for problem in problems:
        complain(f"report: {problem.message}")
    say(f"reports of {len(visits)} visits: {root / DATASET_FILES['report']}")
    if any(problem.fatal for problem in problems):
        return ExitCode.NOT_WRITABLE
    return ExitCode.INTERNAL if problems else ExitCode.OK


def rebuild_group_reports(root: Path, name: str | None) -> ExitCode:
    """Make the pages of analyses of the group level.

    Parameters
    ----------
    root : Path
        The output dataset.
    name : str or None
        Of one analysis; else all.

    Returns
    -------
    ExitCode

    Raises
    ------
    NothingToDoError
        If there is no such analysis.
    OutputError
        If it cannot be written.
    """
    from hipsta_bids.bids.files import check_writable  # noqa: PLC0415  (start-up time)
    from hipsta_bids.bids.names import group_report  # noqa: PLC0415
    from hipsta_bids.reporting import group_models, write_group_report  # noqa: PLC0415  (heavy)

    models = [model for model in group_models(root) if name in {None, model}]
    if not models:
        raise NothingToDoError(
            f"{root}: no analysis{f' of the name {name}' if name else ''}; run the group level"
            " without --reports-only first",
            reason="nothing-to-report",
        )
    check_writable(root)
    problems = [write_group_report(root, model) for model in models]
    for model, problem in zip(models, problems, strict=True):
        if problem is None:
            say(f"report: {root / group_report(model)}")
        else:
            complain(f"report: {problem}")
    return ExitCode.INTERNAL if any(problems) else ExitCode.OK


def command_line(arguments: Sequence[str]) -> str:
    """Spell a command line for the record; the home folder, which names a person, as ``~``."""
    from hipsta_bids.bids.files import hide_home  # noqa: PLC0415  (start-up time)

    return hide_home(shlex.join(("hipsta-bids", *arguments)))
