"""The group level: its options, and the run. Loads nothing heavy for ``--help``."""

import argparse
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from hipsta_bids import __version__, joints
from hipsta_bids.cli import console, questions
from hipsta_bids.cli.parser import (
    Parser,
    accept,
    adder,
    bids_label,
    factor_level,
    from_namespace,
    given_settings,
    help_texts,
    model_text,
    positive_int,
)
from hipsta_bids.cli.participant import REGIONS
from hipsta_bids.errors import ExitCode, NothingToDoError, UsageError
from hipsta_bids.participant.pool import processors

if TYPE_CHECKING:
    from hipsta_bids.group.questions.study import GroupOptions
    from hipsta_bids.group.settings import GroupSettings

LEVEL = "group"
#: Options that a first run may need.
_FIRST = (
    *("--help", "--version", "--participant-label", "--exclude-look", "--ratings"),
    *("--covariates", "--formula", "--contrast", "--reference", "--measures", "--name"),
    *("--longitudinal", "--correction", "--settings"),
)

_EPILOG = """\
without --model and --formula: group + age + sex (+ site) from BIDS_DIR/participants.tsv

each group is compared with the reference level: CN, CU, healthy control ..., else the first.
The run prints the reference level; --reference FACTOR=LEVEL changes it.

{questions}

results: OUT_DIR/group/MODEL/; begin with OUT_DIR/group/MODEL.html

exit codes: 0 done; 64 wrong use; 65 the data do not allow it; 66 no hemispheres; 73 cannot write
"""


def group_parser() -> Parser:
    """Describe ``hipsta-bids BIDS_DIR OUT_DIR group``."""
    parser = Parser(
        prog="hipsta-bids BIDS_DIR OUT_DIR group",
        first=_FIRST,
        usage="hipsta-bids BIDS_DIR OUT_DIR group [options]",
        description="compare maps and summary measures of participants",
        epilog=_EPILOG.format(questions=questions.listed_questions()),
    )
    parser.add_argument("bids_dir", type=Path, help="the BIDS dataset, with participants.tsv")
    parser.add_argument("output_dir", type=Path, help="the participant level's output dataset")
    parser.add_argument("analysis_level", choices=[LEVEL], help=LEVEL)
    parser.add_argument("--version", action="version", version=f"hipsta_bids {__version__}")
    raw = {"--skip-bids-validation": "the raw dataset is never validated"}
    accept(parser, {**help_texts()["without meaning"], **raw})
    _add_sheets(parser)
    for source in joints.find_sources():
        joints.load(source.options)(parser)
    _add_model(parser)
    _add_comparison(parser)
    _add_methods(parser)
    for step in joints.find_steps():
        if step.options:
            joints.load(step.options)(parser)
    questions.add_questions(parser)
    for part in joints.find_parts():
        adder(parser.add_argument_group(part.heading))(
            part.option, part.value, part.text, nargs="?", const=""
        )
    _add_reports(parser)
    return parser


def _add_sheets(parser: Parser) -> None:
    add = adder(parser.add_argument_group("which hemispheres"))
    add(
        "-d --derivatives",
        "NAME=PATH...",
        "output datasets of the participant level, as of several sites (default: OUT_DIR)",
        type=_folder,
    )
    add(
        "--segmentations",
        "DIR...",
        "folders of FreeSurfer, ASHS or HippUnfold that have moved since the participant "
        "level; for volumes",
    )
    add(
        "--seg",
        "NAME...",
        "segmentation protocol, where there are several"
        + ("; two or more are analyzed each, and compared" if joints.find_protocols() else ""),
    )
    add(
        "--mixed",
        "FIELD...",
        "differences of segmentations that are allowed: tool, version, analysis, atlas, "
        "hierarchy, space, design, edited, voxel_size",
    )
    add(
        "--region",
        "",
        "what the participant level measured (default: body)",
        choices=REGIONS,
        default=REGIONS[0],
    )
    _add_selection(add)


def _add_selection(add: Callable[..., None]) -> None:
    """Add the options that select and exclude participants, visits, hemispheres and points."""
    for label, prefix in (("participant", "sub-"), ("session", "ses-")):
        add(
            f"--{label}-label",
            "LABEL...",
            "only these, with or without prefix",
            type=bids_label(prefix),
        )
    add(
        "--exclude-participant-label",
        "LABEL...",
        "exclude these, with or without prefix",
        type=bids_label("sub-"),
    )
    add(
        "--exclude-look",
        "",
        "exclude hemispheres to look at first, unless --ratings has use",
    )
    add(
        "--exclude-outliers",
        "",
        "exclude hemispheres with a cohort_outlier in measures.tsv, unless --ratings has use",
    )
    add(
        "--exclude-qc",
        "CONDITION...",
        "exclude by quality metrics, as 'filled_fraction > 0.01' 'voxels_across < 3'; one "
        "criterion is enough",
        type=_condition,
    )
    add(
        "--exclude",
        "FILE.tsv",
        "exclude: columns participant_id, perhaps session_id, hemi, protocol, region, reason",
    )
    add(
        "--ratings",
        "FILE.tsv",
        (
            "ratings saved from report.html: excludes hemispheres rated exclude, and counts the "
            "others"
        ),
    )


def _add_model(parser: Parser) -> None:
    add = adder(parser.add_argument_group("model"))
    add(
        "--covariates",
        "FILE.tsv...",
        "more tables with participant_id (participants.tsv, sessions.tsv and phenotype/*.tsv"
        " are read anyway)",
    )
    add("--model", "FILE.json", "BIDS Stats Model with one dataset node")
    add("--formula", "TEXT", 'such as "thickness ~ group + age + sex"', type=model_text)
    add(
        "--contrast",
        "TEXT...",
        'such as "group[CU]-group[DAT]", or one-sided "arm[B]-arm[A] > -0.05"; rows of an F '
        "test are separated by commas",
        type=model_text,
    )
    add(
        "--age-model",
        "",
        "age in the default model (default: linear); quadratic and spline (natural cubic) "
        "add a test for nonlinearity",
        choices=["linear", "quadratic", "spline"],
    )
    add(
        "--allow-missing",
        "",
        "analyze although participants.tsv has no row of more than 10 %% of the participants",
        action="store_true",
    )
    add("--reference", "FACTOR=LEVEL...", "reference levels", type=factor_level)
    add(
        "--measures",
        "NAME...",
        "maps (columns of the sheet table or --map), summary measures, also left of a "
        "formula (default: thickness curvature, all summaries)",
    )
    add("--name", "NAME", "folder of the results (default: the formula)", type=_name)


def _add_comparison(parser: Parser) -> None:
    add = adder(parser.add_argument_group("sessions and sides (default: first sessions)"))
    for choice in joints.find_sessions():
        joints.load(choice.options)(add)
    add("--asymmetry", "", "also maps of left minus right")


def _add_methods(parser: Parser) -> None:
    add = adder(parser.add_argument_group("methods"))
    add(
        "--align",
        "",
        "registration of curvature profiles (auto, the default: none for fewer than 10 sheets)",
        choices=["auto", "registr", "none"],
    )
    add(
        "--template",
        "FILE",
        "register to the template.json of another analysis, or that in a summary.json or in a"
        " dataset of a template",
    )
    _add_tests(add)
    add(
        "--base",
        "MEASURE...",
        "measures and covariates of the base model of classification (default: volume)",
    )
    add("--no-classification", "", "omit the classification of groups by logistic models")
    add(
        "--settings", "FILE.toml", "settings that change results (see `hipsta-bids settings group`)"
    )


def _add_tests(add: Callable[..., None]) -> None:
    """Add the options of corrections and permutations."""
    add(
        "--correction",
        "",
        "false discovery rate (fdr2, the default; bh), or family-wise error by permutation "
        "of residuals (permutation-tfce, permutation-max)",
        choices=["fdr2", "bh", "permutation-tfce", "permutation-max"],
    )
    add("--permutations", "N", "the data as they are included; default 5000", type=int)
    add(
        "--n-procs --nprocs --n-cpus --nthreads",
        "N",
        "processors that permute, which share memory (default: all); no result depends on it",
        type=positive_int,
        default=processors(),
    )
    add("--blocks", "COLUMN", "permute inside the levels of this column only, as site")
    add(
        "--fdr-scope",
        "",
        "one family of tests, for permutations too (default: map)",
        choices=["map", "hemispheres", "all"],
    )


def _add_reports(parser: Parser) -> None:
    group = parser.add_argument_group("report")
    add = adder(group.add_mutually_exclusive_group())
    add("--no-reports", "", "make no page to look at (OUT_DIR/group/MODEL.html)")
    add(
        "--reports-only",
        "",
        "make these pages again from existing results, of all analyses and comparisons in"
        " OUT_DIR/group or of --name, and end",
    )
    adder(group)(
        "--figures",
        "",
        "also write all figures for print, as PDF and PNG (default: SVG of the page);"
        " `hipsta-bids figure` draws one later",
    )
    adder(group)("-q --quiet", "", "print only problems")


def _folder(text: str) -> Path:
    return Path(text.partition("=")[2] or text)


def _condition(text: str) -> tuple[str, str, float]:
    """Read ``METRIC OPERATOR NUMBER``."""
    number = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
    match = re.fullmatch(rf"\s*(\w+)\s*([<>]=?|[=!]=)\s*({number})\s*", text)
    if match is None:
        raise argparse.ArgumentTypeError(
            f"{text[:80]!r} is not of the form 'filled_fraction > 0.01' (or >=, <, <=, ==, !=)"
        )
    return match[1], match[2], float(match[3])


def _name(text: str) -> str:
    if not re.fullmatch(r"[\w-]*[^\W_][\w-]*", text, re.ASCII):
        raise argparse.ArgumentTypeError(f"{text!r} is not a name of letters, digits, - and _")
    return text


def is_group_level(arguments: Sequence[str]) -> bool:
    """Check whether a call is of the group level, whatever the names of folders."""
    if arguments[:1] == [LEVEL] and {"-h", "--help"} & set(arguments):
        return True
    if arguments[2:3]:
        if arguments[2] == LEVEL:
            return True
        if arguments[2] == "participant":
            return False
    # Options may precede the positions.
    return LEVEL in arguments[2:] and "participant" not in arguments


def run_group_level(arguments: Sequence[str]) -> ExitCode:
    """Run the group level."""
    parsed = group_parser().parse_args(arguments)
    with console.quiet(parsed.quiet):
        return _run(parsed, arguments)


def _check_model(parsed: argparse.Namespace) -> None:
    if parsed.model is not None and (parsed.formula or parsed.contrast):
        raise UsageError("give --model, or --formula and --contrast")
    if parsed.age_model is not None and (parsed.model or parsed.formula):
        raise UsageError(
            "--age-model is of the default model; write poly(age, 2) in the formula, and --contrast"
            ' "nonlinear(age)"'
        )


def _run(parsed: argparse.Namespace, arguments: Sequence[str]) -> ExitCode:
    console.echo_ignored(parsed.ignored)
    _check_model(parsed)
    if parsed.reports_only:
        return _rebuild_reports(parsed.output_dir, parsed.name)
    # Thousands of tiny fits: threads of the linear algebra would only get in each other's way.
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    console.echo_start(LEVEL, parsed.bids_dir)
    from hipsta_bids.io.files import check_scratch, check_writable  # noqa: PLC0415  (heavy)

    check_scratch()
    console.warn_if_lost(parsed.output_dir)
    if parsed.output_dir.is_dir():  # or nothing was measured, which is said later
        check_writable(parsed.output_dir)
    from hipsta_bids.stats.inference import PROCESSORS  # noqa: PLC0415  (heavy)

    PROCESSORS.set(parsed.n_procs)
    settings = _settings(parsed)
    with console.Progress(-1 if parsed.quiet else 0):
        answer = (
            questions.run_question if questions.is_question(parsed) else questions.run_comparison
        )
        result = answer(parsed, _options(parsed, arguments, settings), settings)
    for warning in result.warnings:
        console.warn(f"warning: {warning}")
    for note in result.notes:
        console.echo(f"note: {note}")
    left_out = f"{result.n_excluded} exclusions of participants, visits or hemispheres"
    left_out += " (see excluded.tsv for the reasons)" if result.n_excluded else ""
    console.echo(f"{result.n_participants} participants in the model, {left_out}")
    console.echo(f"results: {result.folder}")
    console.echo(f"report: {result.page or result.folder / 'methods.md'}")
    if result.problem is not None:
        console.warn(f"report: {result.problem}")
    return ExitCode.OK if result.problem is None else ExitCode.INTERNAL


def _rebuild_reports(root: Path, name: str | None) -> ExitCode:
    """Make the pages of analyses and comparisons again from their files, of all or of one."""
    from hipsta_bids.derivatives.names import group_report  # noqa: PLC0415  (start-up time)
    from hipsta_bids.io.files import check_writable  # noqa: PLC0415  (start-up time)
    from hipsta_bids.reports import group as pages  # noqa: PLC0415  (heavy)

    makers = dict.fromkeys(pages.group_models(root), pages.group_page)
    # Last, as they link the pages of analyses that exist.
    for page in (page for extension in joints.find_extensions() for page in extension.pages):
        makers |= dict.fromkeys(pages.group_models(root, page.record), joints.load(page.make))
    models = [model for model in makers if name in {None, model}]
    if not models:
        raise NothingToDoError(
            f"{root}: no analysis{f' of the name {name}' if name else ''}; run the group level"
            " without --reports-only first"
        )
    check_writable(root)
    problems = [pages.write_group_report(root, model, makers[model]) for model in models]
    for model, problem in zip(models, problems, strict=True):
        if problem is None:
            console.echo(f"report: {root / group_report(model)}")
        else:
            console.warn(f"report: {problem}")
    return ExitCode.INTERNAL if any(problems) else ExitCode.OK


def _settings(parsed: argparse.Namespace) -> "GroupSettings":
    """Read the settings, and put those in that have a separate option."""
    from hipsta_bids.group.settings import load_group_settings  # noqa: PLC0415  (start-up time)

    choices = {
        "registration": {"align": parsed.align},
        "multiplicity": {
            "method": parsed.correction,
            "scope": parsed.fdr_scope,
            "permutations": parsed.permutations,
            "blocks": parsed.blocks,
        },
        "design": {"mixed": tuple(parsed.mixed) or None},
        "model": {"age": parsed.age_model},
        "classification": {
            "base": tuple(parsed.base) or None,
            "added": () if parsed.no_classification else None,
        },
    }
    places = [choice.settings for choice in joints.find_sessions()]
    for place in (*places, *(question.settings for question in joints.find_questions())):
        choices |= joints.load(place)(parsed) if place else {}
    settings = load_group_settings(parsed.settings)
    settings = settings.changed(**given_settings(choices))
    for step in joints.find_steps():
        if step.settings:
            settings = joints.load(step.settings)(parsed, settings)
    return settings


def _options(
    parsed: argparse.Namespace, arguments: Sequence[str], settings: "GroupSettings"
) -> "GroupOptions":
    from hipsta_bids.group.cohort.collect import GroupRequest  # noqa: PLC0415  (heavy)
    from hipsta_bids.group.model import Comparison, ModelRequest, Sessions  # noqa: PLC0415  (heavy)
    from hipsta_bids.group.questions.study import GroupOptions  # noqa: PLC0415  (heavy)

    sheets = from_namespace(
        GroupRequest,
        parsed,
        roots=tuple(dict.fromkeys(parsed.derivatives)) or (parsed.output_dir,),
        subjects=tuple(parsed.participant_label),
        seg=next(iter(parsed.seg), None),
        excluded=tuple(parsed.exclude_participant_label),
        sessions=tuple(parsed.session_label),
        exclude_table=parsed.exclude,
    )
    model = from_namespace(
        ModelRequest,
        parsed,
        file=parsed.model,
        contrasts=tuple(parsed.contrast),
        references=tuple(parsed.reference),
    )
    choices = (joints.load(choice.make)(parsed, settings) for choice in joints.find_sessions())
    sessions = next(filter(None, choices), Sessions())
    return from_namespace(
        GroupOptions,
        parsed,
        out_dir=parsed.output_dir,
        sheets=sheets,
        model=model,
        comparison=Comparison(sessions=sessions, asymmetry=parsed.asymmetry),
        sources=tuple(
            data for source in joints.find_sources() for data in joints.load(source.make)(parsed)
        ),
        measures=tuple(dict.fromkeys(parsed.measures)),
        reports=not parsed.no_reports,
        further={
            name: getattr(parsed, name) for step in joints.find_steps() for name in step.names
        },
        parts=tuple(
            (part, value)
            for part in joints.find_parts()
            if (value := getattr(parsed, part.name)) is not None
        ),
        command=("hipsta-bids", *arguments),
    )
