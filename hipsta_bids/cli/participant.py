"""What the command line looks like. Loads nothing heavy, so that ``--help`` is instant."""

import argparse
import os
import re
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from hipsta_bids import __version__
from hipsta_bids.cli.console import Progress, echo, echo_result, echo_start, echo_table, warn
from hipsta_bids.errors import EXIT_MEANINGS, ExitCode, NothingToDoError, UsageError
from hipsta_bids.participant.cluster import Shard, parse_shard
from hipsta_bids.participant.pool import pin_threads

if TYPE_CHECKING:
    from argparse import Namespace

    from hipsta_bids.inputs.request import HemisphereInput, InputRequest
    from hipsta_bids.inputs.search import Findings
    from hipsta_bids.participant.cluster import Cluster
    from hipsta_bids.participant.run import RunOptions
    from hipsta_bids.settings import Settings


COLLECT = "collect"
LEVELS = ("participant", COLLECT)
REGIONS = ("body", "extended", "entorhinal")

EPILOG = """\
other commands:
  hipsta-bids schemes          list the segmentation protocols that are known
  hipsta-bids settings         print all settings with their meaning, as TOML
  hipsta-bids demo-data DIR    write a synthetic dataset with known thickness
  hipsta-bids demo DIR         write it, run on it, and compare with the truth
  hipsta-bids phantom DIR      write a synthetic cohort with a known effect (see its --help)
  hipsta-bids surrogate IN OUT measure thickness in single slices to cross-check maps
  hipsta-bids validate         measure accuracy on phantoms, write a report (see its --help)
  hipsta-bids --bids-exec-spec print the Boutiques descriptor of both levels

exit codes:
""" + "".join(f"  {int(code):<4} {meaning}\n" for code, meaning in EXIT_MEANINGS.items())

_MEMORY_UNITS = {"K": 1e-6, "M": 1e-3, "G": 1.0, "T": 1e3}


class Parser(argparse.ArgumentParser):
    """Raises instead of exiting, so that there is one place that makes exit codes."""

    def error(self, message: str) -> NoReturn:
        """Turn argparse's complaint into the package's own error."""
        raise UsageError(f"{message} (see {self.prog} --help)", reason="usage")


def join_slurm(arguments: Sequence[str]) -> list[str]:
    """Attach the value of ``--slurm``, since argparse takes what begins with a dash for options."""
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1] == "--slurm":
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


def build_parser() -> Parser:
    """Describe the participant level's command line."""
    parser = Parser(
        prog="hipsta-bids",
        description="BIDS App: hippocampal thickness, curvature and shape maps from subfield"
        " segmentations",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("bids_dir", type=Path, help="a BIDS dataset")
    parser.add_argument("output_dir", type=Path, help="where the output dataset goes")
    parser.add_argument(
        "analysis_level",
        type=_level,
        help="participant; collect, which completes status.tsv after runs with --shard; or group"
        " (which has a --help of its own)",
    )
    parser.add_argument("--version", action="version", version=f"hipsta_bids {__version__}")
    add_selection(parser)
    add_segmentations(parser)
    _add_signals(parser)
    _add_processing(parser)
    _add_machines(parser)
    return parser


def add_selection(parser: Parser) -> None:
    """Add the options that choose subjects, sessions and hemispheres."""
    group = parser.add_argument_group("what to process")
    _add(
        group,
        ("--participant-label", "--participant_label"),
        ("LABEL", "subjects, with or without sub- (default: all)"),
        nargs="+",
        type=_label("sub-"),
        default=[],
    )
    _add(
        group,
        ("--session-label", "--session_label"),
        ("LABEL", "sessions, with or without ses- (default: all)"),
        nargs="+",
        type=_label("ses-"),
        default=[],
    )
    _add(
        group,
        ("--hemi",),
        ("H", "hemispheres, L and R (default: both)"),
        nargs="+",
        type=_hemi,
        default=["L", "R"],
    )
    _add(
        group,
        ("--bids-filter-file", "--bids_filter_file"),
        ("FILE", "JSON with the entities of the segmentations, in fMRIPrep's form"),
        type=Path,
    )
    _add(
        group,
        ("--bids-database-dir", "--bids_database_dir"),
        ("DIR", "folder of a PyBIDS database, for speed"),
        type=Path,
    )
    _add(
        group,
        ("--skip-bids-validation", "--skip_bids_validation"),
        (None, "accepted for other BIDS Apps' sake; the raw dataset is never validated"),
        action="store_true",
    )
    _add(
        group,
        ("--dry-run", "--dry_run"),
        (None, "print what would be processed and why, and end"),
        action="store_true",
    )


def add_segmentations(parser: Parser) -> None:
    """Add the options that say where segmentations are."""
    group = parser.add_argument_group("where the segmentations are")
    _add(
        group,
        ("-d", "--derivatives"),
        (
            "NAME=PATH",
            "datasets with segmentations (default: BIDS_DIR/derivatives/*, BIDS_DIR/sourcedata/*)",
        ),
        nargs="+",
        action="extend",
        type=_named_path,
        default=[],
    )
    _add(
        group,
        ("--freesurfer-dir", "--freesurfer_dir", "--fs-subjects-dir", "--fs_subjects_dir"),
        ("DIR", "FreeSurfer's subjects folder"),
        type=Path,
    )
    _add(group, ("--ashs-dir", "--ashs_dir"), ("DIR", "folder of ASHS runs"), type=Path)
    _add(
        group,
        ("--hippunfold-dir", "--hippunfold_dir"),
        ("DIR", "HippUnfold's output dataset"),
        type=Path,
    )
    _add(
        group,
        ("--fs-analysis", "--fs_analysis"),
        ("NAME", "FreeSurfer analysis to use where there are several, such as T1 or T1-T2"),
    )
    _add(
        group,
        ("--ashs-atlas", "--ashs_atlas"),
        ("SCHEME", "atlas of the ASHS runs, a name from `hipsta-bids schemes`"),
    )
    _add(
        group,
        ("--scheme",),
        ("FILE.toml", "a protocol of your own for the BIDS dseg files"),
        type=Path,
    )
    _add(
        group,
        ("--edited-dir", "--edited_dir"),
        ("DIR", "labels (_desc-edited_dseg) and masks (_desc-edited_mask) corrected by hand"),
        type=Path,
    )


def _add_signals(parser: Parser) -> None:
    group = parser.add_argument_group("what else to bring to the sheet")
    _add(
        group,
        ("--map",),
        (
            "NAME=PATTERN",
            "volumes in the space of the labels: path (also in BIDS_DIR) with {subject}, {hemi}, *",
        ),
        nargs="+",
        action="extend",
        type=named_pattern,
        default=[],
    )
    _add(
        group,
        ("--map-sampling", "--map_sampling"),
        ("[NAME=]depth|mid", "mean from wall to wall (default), or on the mid-surface"),
        nargs="+",
        action="extend",
        type=_choice("depth", "mid"),
        default=[],
    )
    _add(
        group,
        ("--map-interpolation", "--map_interpolation"),
        ("[NAME=]linear|nearest", "between voxels (default: linear); nearest for labels"),
        nargs="+",
        action="extend",
        type=_choice("linear", "nearest"),
        default=[],
    )
    _add(
        group,
        ("--roi",),
        ("FILE.tsv", "regions drawn on the sheet: columns x, y, region; their means go to a table"),
        type=Path,
    )


def _add_processing(parser: Parser) -> None:
    group = parser.add_argument_group("how to process")
    _add(
        group,
        ("--settings",),
        ("FILE.toml", "settings that change results (see `hipsta-bids settings`)"),
        type=Path,
    )
    _add(
        group,
        ("--region",),
        ("NAME", "body (default), extended (with neighboring cortex), entorhinal (that alone)"),
        choices=REGIONS,
    )
    _add(
        group,
        ("--write-meshes", "--write_meshes"),
        (None, "also write the tetrahedral meshes (VTU)"),
        action="store_true",
    )
    _add(group, ("--force",), (None, "redo what is up to date"), action="store_true")
    pages = group.add_mutually_exclusive_group()
    _add(
        pages,
        ("--no-reports", "--no_reports"),
        (None, "make no pages to look at (OUT_DIR/*.html)"),
        action="store_true",
    )
    _add(
        pages,
        ("--reports-only", "--reports_only"),
        (None, "make these pages anew from the results that are there, and end"),
        action="store_true",
    )
    _add(
        group,
        ("--n-procs", "--nprocs", "--n_procs", "--n-cpus", "--n_cpus"),
        ("N", "hemispheres at the same time, one processor each (default: all processors)"),
        type=_positive_int,
        default=_processors(),
    )
    _add(
        group,
        ("--mem", "--mem-mb", "--mem_mb"),
        ("SIZE", "memory for all processes together: 8000 (MB) or 8G"),
        type=_gigabytes,
    )
    _add(
        group,
        ("--timeout",),
        ("S", "seconds after which a hemisphere is given up (default: 600)"),
        type=_positive_float,
        default=600.0,
    )
    _add(group, ("-w", "--work-dir", "--work_dir"), ("DIR", "scratch folder"), type=Path)
    _add(
        group,
        ("--stop-on-first-crash", "--stop_on_first_crash"),
        (None, "stop at the first hemisphere that fails"),
        action="store_true",
    )
    _add(
        group,
        ("-v", "--verbose"),
        (None, "say more; twice for still more"),
        action="count",
        default=0,
    )


def _add_machines(parser: Parser) -> None:
    group = parser.add_argument_group("many machines")
    _add(
        group,
        ("--shard",),
        ("I/N", "do the I-th of N equal parts of the subjects; slurm: as the array job says"),
        type=_shard,
    )
    _add(
        group,
        ("--dask-scheduler", "--dask_scheduler"),
        ("ADDRESS", "measure on the workers of this Dask scheduler (tcp://HOST:PORT, or its file)"),
    )
    _add(
        group,
        ("--slurm",),
        ("OPTIONS", "measure in --n-procs SLURM jobs: sbatch's options in quotes, as '-p short'"),
    )


def _add(
    group: Any,  # noqa: ANN401  (argparse has no public name for groups)
    flags: Sequence[str],
    texts: tuple[str | None, str],
    **options: Any,  # noqa: ANN401  (passed on)
) -> None:
    metavar, text = texts
    if metavar is not None:
        options["metavar"] = metavar
    group.add_argument(*flags, help=text, **options)


def _level(text: str) -> str:
    if text not in LEVELS:
        raise argparse.ArgumentTypeError(
            f"{text!r} does not exist; there are participant, collect and group"
        )
    return text


def _label(prefix: str) -> Any:  # noqa: ANN401  (a converter for argparse)
    def convert(text: str) -> str:
        label = text.removeprefix(prefix)
        if not label.isalnum():
            raise argparse.ArgumentTypeError(f"{text!r} is not a BIDS label (letters and digits)")
        return label

    return convert


def _hemi(text: str) -> str:
    hemi = text.upper()
    if hemi not in {"L", "R"}:
        raise argparse.ArgumentTypeError(f"{text!r} is not a hemisphere; use L or R")
    return hemi


def _named_path(text: str) -> tuple[str, Path]:
    name, equals, path = text.partition("=")
    if equals and name and path:
        return name, Path(path)
    folder = Path(text)
    if equals or not folder.name:
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form NAME=PATH")
    return folder.name, folder


def named_pattern(text: str) -> tuple[str, str]:
    """Read ``NAME=PATTERN``."""
    name, equals, pattern = text.partition("=")
    if not (equals and name and pattern):
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form NAME=PATTERN")
    return name, pattern


def _choice(*values: str) -> Any:  # noqa: ANN401  (a converter for argparse)
    """Take one of some words, for all maps or (NAME=) for one."""

    def convert(text: str) -> tuple[str | None, str]:
        name, equals, value = text.rpartition("=")
        if value not in values or (equals and not name):
            raise argparse.ArgumentTypeError(
                f"{text!r} is not {' or '.join(values)}, alone or after NAME="
            )
        return name or None, value

    return convert


def _shard(text: str) -> Shard:
    return parse_shard(text, os.environ)


def _positive_int(text: str) -> int:
    if not text.isascii() or not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number above 0")
    return int(text)


def _positive_float(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return value


def _gigabytes(text: str) -> float:
    """Read a size as fMRIPrep does: megabytes unless a unit follows."""
    match = re.fullmatch(r"(\d+\.?\d*)\s*([KMGT]?)B?", text.strip().upper())
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a size; write 8000 (MB) or 8G")
    return _positive_float(match[1]) * _MEMORY_UNITS[match[2] or "M"]


def _processors() -> int:
    """Count the processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


# ``--reports-only``: the pages of an output dataset, made anew from its files.


def rebuild_reports(options: "Namespace") -> ExitCode:
    """Make the pages of all visits that are asked for, and that of the cohort."""
    from hipsta_bids.derivatives.names import DATASET_FILES  # noqa: PLC0415
    from hipsta_bids.io.files import check_writable  # noqa: PLC0415  (start-up time)
    from hipsta_bids.participant.pages import PagePlan, visits_of, write_reports  # noqa: PLC0415  (heavy)
    from hipsta_bids.participant.run import log_file  # noqa: PLC0415  (heavy)

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
        warn(f"report: {problem.message}")
    echo(f"reports of {len(visits)} visits: {root / DATASET_FILES['report']}")
    if any(problem.fatal for problem in problems):
        return ExitCode.NOT_WRITABLE
    return ExitCode.INTERNAL if problems else ExitCode.OK


def rebuild_group_reports(root: Path, name: str | None) -> ExitCode:
    """Make the pages of analyses of the group level."""
    from hipsta_bids.derivatives.names import group_report  # noqa: PLC0415
    from hipsta_bids.io.files import check_writable  # noqa: PLC0415  (start-up time)
    from hipsta_bids.reports.group import group_models, write_group_report  # noqa: PLC0415  (heavy)

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
            echo(f"report: {root / group_report(model)}")
        else:
            warn(f"report: {problem}")
    return ExitCode.INTERNAL if any(problems) else ExitCode.OK


def command_line(arguments: Sequence[str]) -> str:
    """Spell a command line for the record; the home folder, which names a person, as ``~``."""
    from hipsta_bids.io.files import hide_home  # noqa: PLC0415  (start-up time)

    return hide_home(shlex.join(("hipsta-bids", *arguments)))


# The participant level's command line: from options to a run.


def run_participant_level(options: "Namespace", command: str | None = None) -> ExitCode:
    """Measure, collect or list hemispheres, as a parsed command line says."""
    pin_threads()
    from hipsta_bids.settings import load_settings  # noqa: PLC0415  (start-up time)

    check_folders(options)
    if options.analysis_level == COLLECT and options.shard is not None:
        raise UsageError("collect is about all parts; leave --shard out", reason="usage")
    if options.reports_only:
        return rebuild_reports(options)
    settings = _with_region(load_settings(options.settings), options.region)
    request = input_request(options)
    echo_start(options.analysis_level, options.bids_dir)
    from hipsta_bids.inputs.maps import attach, map_requests  # noqa: PLC0415  (heavy)
    from hipsta_bids.inputs.search import dataset_notes, selection_table  # noqa: PLC0415  (heavy)

    wishes = map_requests(options.map, options.map_sampling, options.map_interpolation)
    found = _find(request, options.shard)
    if found is None:
        echo(f"part {options.shard.name} of the dataset has nothing to process")
        return ExitCode.OK
    items, map_notes = attach(found.items, wishes, options.roi, options.bids_dir)
    for note in (*dataset_notes(request, items), *found.notes, *map_notes):
        echo(f"note: {note}")
    if options.dry_run:
        echo_table(selection_table(items))
        return ExitCode.OK
    check_output_is_no_input(options.output_dir, items)
    if options.analysis_level == COLLECT:
        from hipsta_bids.participant.run import collect  # noqa: PLC0415  (heavy)

        result = collect(items, options.output_dir, settings, _run_options(options, command))
        echo_result(result, options.output_dir)
        return result.exit_code
    from hipsta_bids.participant.run import run_participants  # noqa: PLC0415  (heavy)

    progress = Progress(len(items), options.verbose)
    try:
        result = run_participants(
            items, options.output_dir, settings, _run_options(options, command), progress.report
        )
    finally:
        progress.close()
    echo_result(result, options.output_dir)
    return result.exit_code


def _find(request: "InputRequest", shard: "Shard | None") -> "Findings | None":
    """Find inputs, of one part of the subjects if asked for; ``None`` if that has none."""
    from hipsta_bids.inputs.search import find_inputs, list_subjects  # noqa: PLC0415  (heavy)

    if shard is None:
        return find_inputs(request)
    subjects = shard.take(list_subjects(request))
    if not subjects:
        return None
    try:
        return find_inputs(replace(request, participant_labels=subjects))
    except NothingToDoError:
        return None  # others may have something, and collecting says if none has


def _with_region(settings: "Settings", region: str | None) -> "Settings":
    if region is None:
        return settings
    return settings.changed(body={"region": region})


def check_folders(options: "Namespace") -> None:
    """Refuse a dataset as its own output folder."""
    if options.output_dir.resolve() == options.bids_dir.resolve():
        raise UsageError(
            f"{options.output_dir}: the output folder is the BIDS dataset itself; use for example"
            f" {options.bids_dir / 'derivatives' / 'hipsta_bids'}",
            reason="output-is-input",
        )


def check_output_is_no_input(out_dir: Path, items: "Sequence[HemisphereInput]") -> None:
    """Refuse a folder with segmentations as output folder."""
    if out_dir.resolve() in {item.source_path.resolve() for item in items}:
        raise UsageError(
            f"{out_dir}: the output folder holds the segmentations; choose another one",
            reason="output-is-input",
        )


def input_request(options: "Namespace") -> "InputRequest":
    """Say which inputs are asked for."""
    from hipsta_bids.inputs.request import InputRequest  # noqa: PLC0415  (heavy)

    derivatives = dict(options.derivatives)
    if len(derivatives) != len(options.derivatives):
        raise UsageError("--derivatives: a name occurs twice; give each its own", reason="usage")
    return InputRequest(
        bids_dir=options.bids_dir,
        derivatives=derivatives,
        freesurfer_dir=options.freesurfer_dir,
        ashs_dir=options.ashs_dir,
        hippunfold_dir=options.hippunfold_dir,
        participant_labels=tuple(options.participant_label),
        session_labels=tuple(options.session_label),
        hemis=tuple(dict.fromkeys(options.hemi)),
        fs_analysis=options.fs_analysis,
        ashs_atlas=options.ashs_atlas,
        protocol=options.scheme,
        edited_dir=options.edited_dir,
        output_dir=options.output_dir,
        bids_filter_file=options.bids_filter_file,
        bids_database_dir=options.bids_database_dir,
    )


def _run_options(options: "Namespace", command: str | None) -> "RunOptions":
    from hipsta_bids.io.files import check_scratch  # noqa: PLC0415  (start-up time)
    from hipsta_bids.participant.run import WORKER_GB, RunOptions  # noqa: PLC0415  (heavy)

    if options.mem is not None and options.mem < WORKER_GB:
        raise UsageError(
            f"--mem: {options.mem * 1000:g} MB is less than one hemisphere may need"
            f" ({WORKER_GB * 1000:g} MB); for gigabytes write 8G",
            reason="too-little-memory",
        )
    check_scratch(options.work_dir)
    return RunOptions(
        n_procs=options.n_procs,
        mem_gb=options.mem,
        work_dir=options.work_dir,
        stop_on_first_crash=options.stop_on_first_crash,
        verbosity=options.verbose,
        force=options.force,
        write_meshes=options.write_meshes,
        timeout=options.timeout,
        shard=options.shard,
        cluster=_cluster(options),
        reports=not options.no_reports,
        command=command,
    )


def _cluster(options: "Namespace") -> "Cluster | None":
    from hipsta_bids.participant.cluster import Cluster, check_cluster  # noqa: PLC0415  (start-up time)

    if options.dask_scheduler is None and options.slurm is None:
        return None
    cluster = Cluster(scheduler=options.dask_scheduler, slurm=options.slurm)
    check_cluster(cluster)
    return cluster
