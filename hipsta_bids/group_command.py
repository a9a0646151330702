"""The group level's command line: its options as a request, and the run."""

import argparse
import os
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from hipsta_bids.errors import ExitCode, UsageError
from hipsta_bids.group_parser import LEVEL, group_parser
from hipsta_bids.report_command import rebuild_group_reports

if TYPE_CHECKING:
    from hipsta_bids.group_record import GroupOptions
    from hipsta_bids.group_settings import GroupSettings


def is_group_level(arguments: Sequence[str]) -> bool:
    """Tell a call of the group level from others, whatever folders are called."""
    if arguments[2:3]:
        if arguments[2] == LEVEL:
            return True
        if arguments[2] == "participant":
            return False
    # Positions may be taken by options; "settings group" is another command.
    return LEVEL in arguments[2:] and "participant" not in arguments


def run_group_level(arguments: Sequence[str]) -> ExitCode:
    """Run the group level.

    Parameters
    ----------
    arguments : sequence of str
        Those of the command line.

    Raises
    ------
    HipstaError
        If use, inputs or output folder are wrong.
    """
    parsed = group_parser().parse_args(arguments)
    if parsed.model is not None and (parsed.formula or parsed.contrast):
        raise UsageError("give --model, or --formula and --contrast", reason="usage")
    if parsed.reports_only:
        return rebuild_group_reports(parsed.output_dir, parsed.name)
    # Thousands of tiny fits: threads of the linear algebra would only get in each other's way.
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    from hipsta_bids.console import complain, say, say_start  # noqa: PLC0415  (start-up time)

    say_start(LEVEL, parsed.bids_dir)
    from hipsta_bids.bids.files import check_scratch  # noqa: PLC0415  (heavy)
    from hipsta_bids.group_runner import run_group  # noqa: PLC0415  (heavy)

    check_scratch()
    settings = _settings(parsed)
    result = run_group(_options(parsed, arguments), settings)
    for note in result.notes:
        say(f"note: {note}")
    say(f"{result.n_participants} participants in the model, {result.n_excluded} left out")
    say(f"results: {result.folder}")
    say(f"what was done and found: {result.page or result.folder / 'methods.md'}")
    if result.problem is not None:
        complain(f"report: {result.problem}")
    return ExitCode.OK


def _settings(parsed: argparse.Namespace) -> "GroupSettings":
    from hipsta_bids.settings_file import load_group_settings  # noqa: PLC0415  (start-up time)

    settings = load_group_settings(parsed.settings)
    if parsed.align is not None:
        align = parsed.align.replace("penalised", "penalized")
        settings = replace(settings, registration=replace(settings.registration, align=align))
    given = {
        "method": parsed.correction,
        "scope": parsed.fdr_scope,
        "permutations": parsed.permutations,
        "blocks": parsed.blocks,
    }
    chosen = {name: value for name, value in given.items() if value is not None}
    settings = replace(settings, multiplicity=replace(settings.multiplicity, **chosen))
    if parsed.longitudinal is not None:
        longitudinal = replace(settings.longitudinal, random=parsed.longitudinal)
        settings = replace(settings, longitudinal=longitudinal)
    if parsed.base:
        classification = replace(settings.classification, base=tuple(parsed.base))
        settings = replace(settings, classification=classification)
    return settings


def _options(parsed: argparse.Namespace, arguments: Sequence[str]) -> "GroupOptions":
    from hipsta_bids.bids.group_inputs import GroupRequest  # noqa: PLC0415  (heavy)
    from hipsta_bids.bids.quality_filter import QualityCondition  # noqa: PLC0415  (heavy)
    from hipsta_bids.group.comparison import Comparison  # noqa: PLC0415  (heavy)
    from hipsta_bids.group_model import ModelRequest  # noqa: PLC0415  (heavy)
    from hipsta_bids.group_record import GroupOptions  # noqa: PLC0415  (heavy)

    condition = None if parsed.exclude_qc is None else QualityCondition(parsed.exclude_qc)
    return GroupOptions(
        bids_dir=parsed.bids_dir,
        out_dir=parsed.output_dir,
        sheets=GroupRequest(
            roots=tuple(dict.fromkeys(parsed.derivatives)) or (parsed.output_dir,),
            seg=parsed.seg,
            subjects=tuple(parsed.participant_label),
            sessions=tuple(parsed.session_label),
            exclude_flagged=parsed.exclude_flagged,
            exclude_quality=condition,
            exclude_table=parsed.exclude,
            segmentations=tuple(parsed.segmentations),
        ),
        model=ModelRequest(
            file=parsed.model,
            formula=parsed.formula,
            contrasts=tuple(parsed.contrast),
            references=tuple(parsed.reference),
            name=parsed.name,
        ),
        covariates=tuple(parsed.covariates),
        maps=tuple(parsed.maps),
        surfaces=tuple(parsed.maps_surface),
        volumes=tuple(parsed.volumes),
        measures=tuple(dict.fromkeys(parsed.measures)),
        template=parsed.template,
        comparison=Comparison(
            longitudinal=parsed.longitudinal is not None,
            pair=None if parsed.paired is None else tuple(parsed.paired),
            asymmetry=parsed.asymmetry,
            normative=parsed.normative,
        ),
        reports=not parsed.no_reports,
        command=("hipsta-bids", *arguments),
    )
