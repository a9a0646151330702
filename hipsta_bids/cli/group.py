"""What the group level's command line looks like. Loads nothing heavy."""

import argparse
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from hipsta_bids import __version__
from hipsta_bids.cli.participant import (
    REGIONS,
    Parser,
    named_pattern,
    rebuild_group_reports,
)
from hipsta_bids.errors import ExitCode, UsageError
from hipsta_bids.group.settings import CORRECTIONS

if TYPE_CHECKING:
    from hipsta_bids.group.read import GroupOptions
    from hipsta_bids.group.settings import GroupSettings


LEVEL = "group"

_EPILOG = """\
without --model and --formula: group + age + sex (+ site), each group against its reference level
(CN, CU, HC, control ..., else the most frequent), from BIDS_DIR/participants.tsv

results: OUT_DIR/group/MODEL/; begin with OUT_DIR/group/MODEL.html

exit codes: 0 done; 64 wrong use; 65 the data do not allow it; 66 no hemispheres; 73 cannot write
"""


def group_parser() -> Parser:
    """Describe ``hipsta-bids BIDS_DIR OUT_DIR group``."""
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
    _add_comparison(parser)
    _add_methods(parser)
    _add_reports(parser)
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
    add(
        "--segmentations",
        nargs="+",
        action="extend",
        default=[],
        type=Path,
        metavar="DIR",
        help="folders of FreeSurfer, ASHS or HippUnfold, if they have moved since the participant"
        " level: for the intracranial and other volumes beside the segmentations",
    )
    add(
        "--maps",
        nargs="+",
        action="extend",
        default=[],
        type=named_pattern,
        metavar="NAME=PATTERN",
        help="other programs' maps with corresponding points, GIFTI or TSV, with sheets or alone:"
        " path (also in BIDS_DIR) with {subject}, {session}, {hemi} or {side} (lh, rh), *",
    )
    add(
        "--maps-surface",
        "--maps_surface",
        nargs="+",
        action="extend",
        default=[],
        type=_maybe_named,
        metavar="[NAME=]PATTERN",
        help="surfaces (.surf.gii) whose vertices these points are (default: HippUnfold's unfolded"
        " surface beside a map, or the grid of the sheets)",
    )
    add("--seg", metavar="NAME", help="segmentation protocol, where there are several")
    add(
        "--region",
        choices=REGIONS,
        default=REGIONS[0],
        help="what the participant level measured (default: body)",
    )
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
    add(
        "--volumes",
        nargs="+",
        action="extend",
        default=[],
        type=named_pattern,
        metavar="NAME=PATTERN",
        help="tables of volumes as FreeSurfer, ASHS or HippUnfold write them: path (also in"
        " BIDS_DIR) with {subject}, {session}, {hemi} or {side} (lh, rh), * (those beside the"
        " segmentations are found anyway)",
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
    add(
        "--measures",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME",
        help="maps (columns of the sheet table, maps sampled by --map) or summary measures to fit"
        " the model to, as does the left side of a formula (default: thickness curvature, and all"
        " summary measures)",
    )
    add("--name", type=_name, metavar="NAME", help="folder of the results (default: the formula)")


def _add_comparison(parser: Parser) -> None:
    add = parser.add_argument_group("sessions and sides (default: first sessions)").add_argument
    add(
        "--longitudinal",
        nargs="?",
        const="intercept",
        choices=["intercept", "slope"],
        help="all sessions, by a mixed model in which participants have an intercept (default) or"
        " also a slope of their own",
    )
    add(
        "--paired",
        nargs=2,
        type=_session,
        metavar=("SES1", "SES2"),
        help="the second session minus the first",
    )
    add("--asymmetry", action="store_true", help="also maps of left minus right")
    add(
        "--normative",
        type=_reference,
        metavar="FACTOR=LEVEL",
        help="score each participant against these, as group=CN (w-scores)",
    )


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
        "--correction",
        choices=CORRECTIONS,
        help="for the number of points: false discovery rate (fdr2, the default; bh), or"
        " family-wise error by permutation of residuals (permutation-tfce, permutation-max)",
    )
    add("--permutations", type=int, metavar="N", help="the data as they are included; default 5000")
    add("--blocks", metavar="COLUMN", help="permute inside its levels only, as those of site")
    add(
        "--fdr-scope",
        "--fdr_scope",
        choices=["map", "hemispheres"],
        help="what is one family of tests, for permutations too (default: map)",
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


def _add_reports(parser: Parser) -> None:
    group = parser.add_argument_group("report")
    add = group.add_mutually_exclusive_group().add_argument
    add(
        "--no-reports",
        "--no_reports",
        action="store_true",
        help="make no page to look at (OUT_DIR/group/MODEL.html)",
    )
    add(
        "--reports-only",
        "--reports_only",
        action="store_true",
        help="make these pages anew from the results that are there, of all analyses or that of"
        " --name, and end",
    )


def _session(text: str) -> str:
    return f"ses-{_label(text)}"


def _label(text: str) -> str:
    return text.removeprefix("sub-").removeprefix("ses-")


def _folder(text: str) -> Path:
    return Path(text.partition("=")[2] or text)


def _reference(text: str) -> tuple[str, str]:
    factor, equals, level = text.partition("=")
    if not (factor and equals and level):
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form FACTOR=LEVEL")
    return factor, level


def _maybe_named(text: str) -> tuple[str | None, str]:
    name, equals, pattern = text.partition("=")
    return (name, pattern) if equals and name.isalnum() else (None, text)


def _name(text: str) -> str:
    if not text.replace("-", "").replace("_", "").isalnum():
        raise argparse.ArgumentTypeError(f"{text!r} is not a name of letters, digits, - and _")
    return text


# The group level's command line: its options as a request, and the run.


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
    """Run the group level."""
    parsed = group_parser().parse_args(arguments)
    if parsed.model is not None and (parsed.formula or parsed.contrast):
        raise UsageError("give --model, or --formula and --contrast", reason="usage")
    if parsed.reports_only:
        return rebuild_group_reports(parsed.output_dir, parsed.name)
    # Thousands of tiny fits: threads of the linear algebra would only get in each other's way.
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    from hipsta_bids.cli.console import echo, echo_start, warn  # noqa: PLC0415  (start-up time)

    echo_start(LEVEL, parsed.bids_dir)
    from hipsta_bids.group.run import run_group  # noqa: PLC0415  (heavy)
    from hipsta_bids.io.files import check_scratch  # noqa: PLC0415  (heavy)

    check_scratch()
    settings = _settings(parsed)
    result = run_group(_options(parsed, arguments), settings)
    for note in result.notes:
        echo(f"note: {note}")
    echo(f"{result.n_participants} participants in the model, {result.n_excluded} left out")
    echo(f"results: {result.folder}")
    echo(f"what was done and found: {result.page or result.folder / 'methods.md'}")
    if result.problem is not None:
        warn(f"report: {result.problem}")
    return ExitCode.OK


def _settings(parsed: argparse.Namespace) -> "GroupSettings":
    from hipsta_bids.group.settings import load_group_settings  # noqa: PLC0415  (start-up time)

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
    from hipsta_bids.group.collect import GroupRequest, QualityCondition  # noqa: PLC0415  (heavy)
    from hipsta_bids.group.comparison import Comparison  # noqa: PLC0415  (heavy)
    from hipsta_bids.group.model import ModelRequest  # noqa: PLC0415  (heavy)
    from hipsta_bids.group.read import GroupOptions  # noqa: PLC0415  (heavy)

    condition = None if parsed.exclude_qc is None else QualityCondition(parsed.exclude_qc)
    return GroupOptions(
        bids_dir=parsed.bids_dir,
        out_dir=parsed.output_dir,
        sheets=GroupRequest(
            roots=tuple(dict.fromkeys(parsed.derivatives)) or (parsed.output_dir,),
            seg=parsed.seg,
            region=parsed.region,
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
