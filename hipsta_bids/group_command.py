"""The group level's command line: what it looks like, and its options as a request."""

import argparse
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from hipsta_bids import __version__
from hipsta_bids.errors import ExitCode, UsageError
from hipsta_bids.parser import Parser

if TYPE_CHECKING:
    from hipsta_bids.group_runner import GroupOptions
    from hipsta_bids.group_settings import GroupSettings

LEVEL = "group"

_EPILOG = """\
without --model and --formula: group + age + sex (+ site), each group against its reference level
(CN, CU, HC, control ..., else the most frequent), from BIDS_DIR/participants.tsv

results: OUT_DIR/group/MODEL/; begin with methods.md and peaks.tsv

exit codes: 0 done; 64 wrong use; 65 the data do not allow it; 66 no hemispheres; 73 cannot write
"""


def is_group_level(arguments: Sequence[str]) -> bool:
    """Tell a call of the group level from others, whatever folders are called."""
    if arguments[2:3]:
        if arguments[2] == LEVEL:
            return True
        if arguments[2] == "participant":
            return False
    # Positions may be taken by options; "settings group" is another command.
    return LEVEL in arguments[2:] and "participant" not in arguments


def group_parser() -> Parser:
    """Describe ``hipsta-bids BIDS_DIR OUT_DIR group``.

    Returns
    -------
    Parser
        Raises :class:`UsageError` on wrong use.
    """
    parser = Parser(
        prog="hipsta-bids BIDS_DIR OUT_DIR group",
        usage="hipsta-bids BIDS_DIR OUT_DIR group [options]",
        description="compare maps and summary measures of participants",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("bids_dir", type=Path, help="the BIDS dataset, with participants.tsv")
    parser.add_argument("output_dir", type=Path, help="the participant level's output dataset")
    parser.add_argument("analysis_level", choices=[LEVEL], help=LEVEL)
    parser.add_argument("--version", action="version", version=f"hipsta_bids {__version__}")
    _add_sheets(parser)
    _add_model(parser)
    _add_methods(parser)
    return parser


def _add_sheets(parser: Parser) -> None:
    add = parser.add_argument_group("which hemispheres").add_argument
    add(
        "-d",
        "--derivatives",
        nargs="+",
        action="extend",
        default=[],
        type=_folder,
        metavar="NAME=PATH",
        help="output datasets of the participant level, as of several sites (default: OUT_DIR)",
    )
    add("--seg", metavar="NAME", help="segmentation protocol, where there are several")
    for what in ("participant", "session"):
        add(
            f"--{what}-label",
            f"--{what}_label",
            nargs="+",
            default=[],
            metavar="LABEL",
            type=_label,
            help="only these, with or without prefix",
        )
    add(
        "--exclude-flagged",
        "--exclude_flagged",
        action="store_true",
        help="leave out hemispheres that the participant level flagged",
    )
    add(
        "--exclude-qc",
        "--exclude_qc",
        metavar="EXPRESSION",
        help="leave out by quality metrics, as 'filled_fraction > 0.01 or voxels_across < 3'",
    )
    add(
        "--exclude",
        type=Path,
        metavar="FILE.tsv",
        help="leave out: columns participant_id, perhaps session_id, hemi, reason",
    )


def _add_model(parser: Parser) -> None:
    add = parser.add_argument_group("model").add_argument
    add(
        "--covariates",
        nargs="+",
        action="extend",
        default=[],
        type=Path,
        metavar="FILE.tsv",
        help="more tables with participant_id (participants.tsv, sessions.tsv and phenotype/*.tsv"
        " are read anyway)",
    )
    add("--model", type=Path, metavar="FILE.json", help="BIDS Stats Model with one dataset node")
    add("--formula", metavar="TEXT", help='such as "thickness ~ group + age + sex"')
    add(
        "--contrast",
        nargs="+",
        action="extend",
        default=[],
        metavar="TEXT",
        help='such as "group[CU]-group[DAT]"; rows of an F test are parted by commas',
    )
    add(
        "--reference",
        nargs="+",
        action="extend",
        default=[],
        type=_reference,
        metavar="FACTOR=LEVEL",
        help="reference levels",
    )
    add("--name", type=_name, metavar="NAME", help="folder of the results (default: the formula)")


def _add_methods(parser: Parser) -> None:
    add = parser.add_argument_group("methods").add_argument
    add(
        "--align",
        choices=["registr", "penalized", "penalised", "none"],
        help="registration of curvature profiles (default: registr)",
    )
    add(
        "--template",
        type=Path,
        metavar="FILE",
        help="register to the template.json of another analysis",
    )
    add(
        "--fdr-scope",
        "--fdr_scope",
        choices=["map", "hemispheres"],
        help="what is one family of tests (default: map)",
    )
    add(
        "--base",
        nargs="+",
        default=[],
        metavar="MEASURE",
        help="measures and covariates of the base model of classification (default: volume)",
    )
    add(
        "--settings",
        type=Path,
        metavar="FILE.toml",
        help="settings that change results (see `hipsta-bids settings group`)",
    )


def _label(text: str) -> str:
    return text.removeprefix("sub-").removeprefix("ses-")


def _folder(text: str) -> Path:
    return Path(text.partition("=")[2] or text)


def _reference(text: str) -> tuple[str, str]:
    factor, equals, level = text.partition("=")
    if not (factor and equals and level):
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form FACTOR=LEVEL")
    return factor, level


def _name(text: str) -> str:
    if not text.replace("-", "").replace("_", "").isalnum():
        raise argparse.ArgumentTypeError(f"{text!r} is not a name of letters, digits, - and _")
    return text


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
    # Thousands of tiny fits: threads of the linear algebra would only get in each other's way.
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    from hipsta_bids.console import say  # noqa: PLC0415  (start-up time)
    from hipsta_bids.group_runner import run_group  # noqa: PLC0415  (heavy)

    settings = _settings(parsed)
    result = run_group(_options(parsed, arguments), settings)
    for note in result.notes:
        say(f"note: {note}")
    say(f"{result.n_participants} participants in the model, {result.n_excluded} left out")
    say(f"results: {result.folder}")
    say(f"what was done and found: {result.folder / 'methods.md'}")
    return ExitCode.OK


def _settings(parsed: argparse.Namespace) -> "GroupSettings":
    from hipsta_bids.settings_file import load_group_settings  # noqa: PLC0415  (start-up time)

    settings = load_group_settings(parsed.settings)
    if parsed.align is not None:
        align = parsed.align.replace("penalised", "penalized")
        settings = replace(settings, registration=replace(settings.registration, align=align))
    if parsed.fdr_scope is not None:
        multiplicity = replace(settings.multiplicity, scope=parsed.fdr_scope)
        settings = replace(settings, multiplicity=multiplicity)
    if parsed.base:
        classification = replace(settings.classification, base=tuple(parsed.base))
        settings = replace(settings, classification=classification)
    return settings


def _options(parsed: argparse.Namespace, arguments: Sequence[str]) -> "GroupOptions":
    from hipsta_bids.bids.group_inputs import GroupRequest  # noqa: PLC0415  (heavy)
    from hipsta_bids.bids.quality_filter import QualityCondition  # noqa: PLC0415  (heavy)
    from hipsta_bids.group_runner import GroupOptions, ModelRequest  # noqa: PLC0415  (heavy)

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
        ),
        model=ModelRequest(
            file=parsed.model,
            formula=parsed.formula,
            contrasts=tuple(parsed.contrast),
            references=tuple(parsed.reference),
            name=parsed.name,
        ),
        covariates=tuple(parsed.covariates),
        template=parsed.template,
        command=("hipsta-bids", *arguments),
    )
