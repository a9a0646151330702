"""The participant level: its options, and the run. Loads nothing heavy for ``--help``."""

import argparse
import os
import re
import shlex
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from hipsta_bids import __version__
from hipsta_bids.cli import console
from hipsta_bids.cli.parser import (
    Parser,
    accept,
    adder,
    bids_label,
    from_namespace,
    named_path,
    named_pattern,
    positive_float,
    positive_int,
    subject_label,
)
from hipsta_bids.errors import ExitCode, NothingToDoError, UsageError, did_you_mean
from hipsta_bids.participant.cluster import Cluster, Shard, check_cluster, parse_shard
from hipsta_bids.participant.pool import pin_threads, processors
from hipsta_bids.protocols import EXPERIMENTAL

if TYPE_CHECKING:
    from argparse import Namespace

    from hipsta_bids.inputs.scan import HemisphereInput, InputRequest
    from hipsta_bids.inputs.search import Findings
    from hipsta_bids.participant.run import RunOptions

COLLECT = "collect"
LEVELS = ("participant", COLLECT)
REGIONS = ("body", "extended", "entorhinal", *EXPERIMENTAL)

#: Options of other BIDS Apps, and why they change nothing here.
_NO_MEANING = {
    "--omp-nthreads N": "each hemisphere uses one processor; --n-procs says how many at a time",
    "--low-mem": "a hemisphere takes a few hundred megabytes; --mem limits how many at a time",
    "--clean-workdir": "nothing is left in the scratch folder",
    "--notrack": "nothing is tracked",
    "--fs-license-file FILE": "FreeSurfer's programs are not run",
}

_GIGABYTES = {"K": 1e-6, "M": 1e-3, "G": 1.0, "T": 1e3}


def build_parser(epilog: str | None = None) -> Parser:
    """Describe the participant level's command line."""
    parser = Parser(
        prog="hipsta-bids",
        description="BIDS App: hippocampal thickness, curvature and shape maps from subfield"
        " segmentations",
        epilog=epilog,
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
    accept(parser, _NO_MEANING)
    add_selection(parser)
    add_segmentations(parser)
    _add_signals(parser)
    _add_processing(parser)
    _add_machines(parser)
    return parser


def add_selection(parser: Parser) -> None:
    """Add the options that choose subjects, sessions and hemispheres."""
    add = adder(parser.add_argument_group("what to process"))
    add(
        "--participant-label",
        "LABEL...",
        "subjects, with or without sub- (default: all)",
        type=subject_label,
    )
    add(
        "--exclude-participant-label",
        "LABEL...",
        "subjects to leave out",
        type=subject_label,
    )
    add(
        "--session-label",
        "LABEL...",
        "sessions, with or without ses- (default: all)",
        type=bids_label("ses-"),
    )
    add(
        "--hemi",
        "H",
        "hemispheres, L and R (default: both)",
        nargs="+",
        type=_hemi,
        default=["L", "R"],
    )
    add(
        "--bids-filter-file",
        "FILE",
        "JSON with the entities of the segmentations, in fMRIPrep's form",
    )
    add("--bids-database-dir", "DIR", "folder of a PyBIDS database, for speed")
    add(
        "--skip-bids-validation",
        "",
        "accepted for other BIDS Apps' sake; the raw dataset is never validated",
    )
    add("--dry-run", "", "print what would be processed and why, and end")


def add_segmentations(parser: Parser) -> None:
    """Add the options that say where segmentations are."""
    add = adder(parser.add_argument_group("where the segmentations are"))
    add(
        "-d --derivatives",
        "NAME=PATH...",
        "datasets with segmentations (default: BIDS_DIR/derivatives/*, BIDS_DIR/sourcedata/*)",
        type=named_path,
    )
    add("--freesurfer-dir --fs-subjects-dir", "DIR", "FreeSurfer's subjects folder")
    add("--ashs-dir", "DIR", "folder of ASHS runs")
    add("--hippunfold-dir", "DIR", "HippUnfold's output dataset")
    add(
        "--fs-analysis",
        "NAME",
        "FreeSurfer analysis to use where there are several, such as T1 or T1-T2",
    )
    add(
        "--participants-map",
        "FILE.tsv",
        "whose folders are, where names do not tell: columns folder, participant_id (and"
        " session_id)",
    )
    add("--ashs-atlas", "SCHEME", "atlas of the ASHS runs, a name from `hipsta-bids schemes`")
    add(
        "--scheme --protocol",
        "FILE.toml",
        "a protocol of your own for the BIDS dseg files; or the name of one from `hipsta-bids"
        " schemes` where labels do not tell (hsf, hsfCA23, cobralab)",
    )
    add(
        "--edited-dir",
        "DIR",
        "labels (_desc-edited_dseg) and masks (_desc-edited_mask) corrected by hand",
    )


def _add_signals(parser: Parser) -> None:
    add = adder(parser.add_argument_group("what else to bring to the sheet"))
    add(
        "--map",
        "NAME=PATTERN...",
        "volumes in the space of the labels: path (also in BIDS_DIR) with {subject}, {hemi}, *",
        type=named_pattern,
    )
    add(
        "--map-sampling",
        "[NAME=]depth|mid...",
        "mean from wall to wall (default), or on the mid-surface",
        type=_choice("depth", "mid"),
    )
    add(
        "--map-interpolation",
        "[NAME=]linear|nearest...",
        "between voxels (default: linear); nearest for labels",
        type=_choice("linear", "nearest"),
    )
    add(
        "--roi",
        "FILE.tsv",
        "regions drawn on the sheet: columns x, y, region; their means go to a table",
    )


def _add_processing(parser: Parser) -> None:
    group = parser.add_argument_group("how to process")
    add = adder(group)
    add(
        "--settings --config-file",
        "FILE.toml",
        "settings that change results (see `hipsta-bids settings`)",
    )
    add(
        "--region",
        "NAME",
        "body (default), extended (with neighboring cortex), entorhinal (that alone); experimental:"
        " headbody, whole (with head and tail)",
        choices=REGIONS,
    )
    add(
        "--x-coordinate",
        "NAME",
        "midsurface (default: harmonic on the mid-surface) or volume (Diers et al. 2023)",
        choices=("midsurface", "volume"),
    )
    add(
        "--ends",
        "FILE.tsv",
        "ends of the body placed by hand: columns participant_id, hemi, end, r, a, s (and session,"
        " nr, na, ns)",
    )
    add("--write-meshes", "", "also write the tetrahedral meshes (VTU)")
    add(
        "--uncertainty",
        "K",
        "also measure K perturbed copies of the labels, and write the SD of maps and summary"
        " measures (default: 0, none; 8 take about 7 times as long)",
        type=_copies,
        default=0,
    )
    add("--force", "", "redo what is up to date")
    add_pages = adder(group.add_mutually_exclusive_group())
    add_pages("--no-reports", "", "make no pages to look at (OUT_DIR/*.html)")
    add_pages(
        "--reports-only", "", "make these pages again from the results that are there, and end"
    )
    add(
        "--no-anatomy",
        "",
        "show no anatomical images on the pages (default: behind the labels, where there are some)",
    )
    add(
        "--n-procs --nprocs --n-cpus --nthreads",
        "N",
        "hemispheres at the same time, one processor each (default: all processors)",
        type=positive_int,
        default=processors(),
    )
    add(
        "--mem --mem-mb",
        "SIZE",
        "memory for all processes together: 8000 (MB) or 8G; labels that need more than half of one"
        " process' part to be read fail",
        type=_gigabytes,
    )
    add(
        "--timeout",
        "S",
        "seconds after which a hemisphere is given up (default: 600)",
        type=positive_float,
        default=600.0,
    )
    add("-w --work-dir", "DIR", "scratch folder")
    add("--stop-on-first-crash", "", "stop at the first hemisphere that fails")
    add("-v --verbose", "", "say more; twice for still more", action="count", default=0)
    add("-q --quiet", "", "say only what went wrong")


def _add_machines(parser: Parser) -> None:
    add = adder(parser.add_argument_group("many machines"))
    add(
        "--shard",
        "I/N",
        "do the I-th of N equal parts of the subjects; slurm: as the array job says",
        type=_shard,
    )
    add(
        "--dask-scheduler",
        "ADDRESS",
        "measure on the workers of this Dask scheduler (tcp://HOST:PORT, or its file)",
    )
    add(
        "--slurm",
        "OPTIONS",
        "measure in --n-procs SLURM jobs: sbatch's options in quotes, as '-p short'",
    )


def _level(text: str) -> str:
    if text not in LEVELS:
        raise argparse.ArgumentTypeError(
            f"{text!r} does not exist; there are participant, collect and group"
            f"{did_you_mean([text], [*LEVELS, 'group'])}"
        )
    return text


def _hemi(text: str) -> str:
    hemi = text.upper()
    if hemi not in {"L", "R"}:
        raise argparse.ArgumentTypeError(f"{text!r} is not a hemisphere; use L or R")
    return hemi


def _choice(*values: str) -> Callable[[str], tuple[str | None, str]]:
    """Return a converter that takes one of some words, for all maps or (NAME=) for one."""

    def convert(text: str) -> tuple[str | None, str]:
        name, equals, value = text.rpartition("=")
        if value not in values or (equals and not name):
            raise argparse.ArgumentTypeError(
                f"{text!r} is not {' or '.join(values)}, alone or after NAME="
            )
        return name or None, value

    return convert


def _copies(text: str) -> int:
    """Read a number of copies: an SD takes two."""
    if not text.isascii() or not text.isdigit() or int(text) == 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of copies; use 0, or 2 or more")
    return int(text)


def _shard(text: str) -> Shard:
    return parse_shard(text, os.environ)


def _gigabytes(text: str) -> float:
    """Read a size as fMRIPrep does: megabytes unless a unit follows."""
    match = re.fullmatch(r"(\d+\.?\d*)\s*([KMGT]?)B?", text.strip().upper())
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a size; write 8000 (MB) or 8G")
    return positive_float(match[1]) * _GIGABYTES[match[2] or "M"]


def run_participant_level(options: "Namespace", arguments: Sequence[str] = ()) -> ExitCode:
    """Measure, collect or list hemispheres, as a parsed command line says."""
    with console.quiet(options.quiet):
        return _run(options, arguments)


def _run(options: "Namespace", arguments: Sequence[str]) -> ExitCode:
    pin_threads()
    from hipsta_bids.settings import load_settings  # noqa: PLC0415  (start-up time)

    for name, reason in options.ignored.items():
        console.echo(f"note: {name} has no effect: {reason}")
    check_folders(options)
    collects = options.analysis_level == COLLECT
    if collects and options.shard is not None:
        raise UsageError("collect is about all parts; leave --shard out")
    if options.reports_only:
        return _rebuild_reports(options)
    settings = load_settings(options.settings).changed(
        body={"region": options.region} if options.region else {},
        sheet={"x_coordinate": options.x_coordinate} if options.x_coordinate else {},
    )
    if settings.body.region in EXPERIMENTAL:
        console.echo(f"note: region {settings.body.region} is experimental")
    request = input_request(options)
    console.echo_start(options.analysis_level, options.bids_dir)
    from hipsta_bids.inputs import account, search  # noqa: PLC0415  (heavy)
    from hipsta_bids.inputs.edits import attach_ends  # noqa: PLC0415  (heavy)
    from hipsta_bids.inputs.maps import attach, map_requests  # noqa: PLC0415  (heavy)
    from hipsta_bids.io.volumes import limit_memory  # noqa: PLC0415  (heavy)

    limit_memory(options.mem)
    requests = map_requests(options.map, options.map_sampling, options.map_interpolation)
    findings = _find(request, options.shard, say=console.echo if options.dry_run else None)
    if findings is None:
        console.echo(f"part {options.shard.name} of the dataset has nothing to process")
        return ExitCode.OK
    items, end_notes = attach_ends(findings.items, options.ends)
    items, map_notes = attach(items, requests, options.roi, options.bids_dir)
    notes = (*search.dataset_notes(request, items), *findings.notes, *end_notes, *map_notes)
    unused = (*findings.ignored, *findings.other_entries)
    inputs = account.input_table(items, unused, options.bids_dir)
    for note in notes:
        console.echo(f"note: {note}")
    counts = f"inputs: {account.count_inputs(inputs)}"
    if options.dry_run:
        console.echo(counts)
        console.echo_table(account.selection_table(items))
        console.echo_table(account.ignored_table(findings.ignored))
        console.echo_table(account.other_entries_table(findings.other_entries))
        return ExitCode.OK
    check_output_is_no_input(options.output_dir, items)
    from hipsta_bids.participant.run import collect, run_participants  # noqa: PLC0415  (heavy)

    notes += tuple(f"not used: {entry.path}: {entry.reason}" for entry in findings.ignored)
    out, run_options = options.output_dir, _run_options(options, arguments, notes)
    run_options = replace(run_options, inputs=tuple(inputs), is_whole=request.is_whole)
    console.echo(counts)
    with console.Progress(-1 if options.quiet else options.verbose) as progress:
        if collects:
            result = collect(items, out, settings, run_options)
        else:
            progress.show("hemispheres", 0, len(items))
            result = run_participants(items, out, settings, run_options, progress.report)
    console.echo_result(result, out)
    return result.exit_code


def _find(
    request: "InputRequest", shard: Shard | None, say: Callable[[str], None] | None
) -> "Findings | None":
    """Find inputs, of one part of the subjects if asked for; ``None`` if that has none.

    Where there are none at all, ``say`` gets a line for each entry that was not used.
    """
    from hipsta_bids.inputs.search import find_inputs, list_subjects  # noqa: PLC0415  (heavy)

    if shard is None:
        try:
            return find_inputs(request)
        except NothingToDoError as error:
            if say is not None:
                for line in getattr(error, "__notes__", ()):
                    say(line)
            raise
    subjects = shard.take(list_subjects(request))
    if not subjects:
        return None
    try:
        return find_inputs(replace(request, participant_labels=subjects))
    except NothingToDoError:
        return None  # others may have something, and collecting says if none has


def _rebuild_reports(options: "Namespace") -> ExitCode:
    """Make the pages of the requested visits and of the cohort again from their files."""
    from hipsta_bids.derivatives.names import DATASET_FILES  # noqa: PLC0415  (start-up time)
    from hipsta_bids.io.files import check_writable  # noqa: PLC0415  (start-up time)
    from hipsta_bids.participant.pages import PagePlan, visits_of, write_reports  # noqa: PLC0415  (heavy)
    from hipsta_bids.participant.run import log_file  # noqa: PLC0415  (heavy)

    root = options.output_dir
    _settle_labels(options)
    visits = [
        (subject, session)
        for subject, session in visits_of(root)
        if subject in (options.participant_label or [subject])
        and subject not in options.exclude_participant_label
        and session in (options.session_label or [session])
    ]
    if not visits:
        raise NothingToDoError(
            f"{root}: no results of these participants; run without --reports-only first"
        )
    check_writable(root)
    progress = console.Progress(-1 if options.quiet else options.verbose)
    with log_file(root, options.verbose) as log, progress:
        problems = list(
            write_reports(
                PagePlan(
                    root=root,
                    n_workers=options.n_procs,
                    log=log,
                    bids_dir=None if options.no_anatomy else options.bids_dir,
                ),
                visits,
            )
        )
    for problem in problems:
        console.warn(f"report: {problem.message}")
    console.echo(f"reports of {len(visits)} visits: {root / DATASET_FILES['report']}")
    if any(problem.fatal for problem in problems):
        return ExitCode.NOT_WRITABLE
    return ExitCode.INTERNAL if problems else ExitCode.OK


def check_folders(options: "Namespace") -> None:
    """Refuse a dataset as its own output folder."""
    if options.output_dir.resolve() == options.bids_dir.resolve():
        raise UsageError(
            f"{options.output_dir}: the output folder is the BIDS dataset itself; use for example"
            f" {options.bids_dir / 'derivatives' / 'hipsta_bids'}"
        )


def check_output_is_no_input(out_dir: Path, items: "Sequence[HemisphereInput]") -> None:
    """Refuse a folder with segmentations as output folder."""
    if out_dir.resolve() in {item.source_path.resolve() for item in items}:
        raise UsageError(
            f"{out_dir}: the output folder holds the segmentations; choose another one"
        )


def input_request(options: "Namespace") -> "InputRequest":
    """Collect the options that say which inputs are asked for."""
    from hipsta_bids.inputs.scan import InputRequest  # noqa: PLC0415  (heavy)

    _settle_labels(options)
    derivatives = dict(options.derivatives)
    if len(derivatives) != len(options.derivatives):
        raise UsageError("--derivatives: a name occurs twice; give each its own")
    return from_namespace(
        InputRequest,
        options,
        derivatives=derivatives,
        participant_labels=tuple(options.participant_label),
        excluded_labels=tuple(options.exclude_participant_label),
        session_labels=tuple(options.session_label),
        hemis=tuple(dict.fromkeys(options.hemi)),
        protocol=options.scheme,
    )


def _settle_labels(options: "Namespace") -> None:
    """Read names of folders as labels where these have their option, else refuse."""
    from hipsta_bids.inputs.tree import plain_label  # noqa: PLC0415  (heavy)

    for option in ("participant_label", "exclude_participant_label"):
        labels = getattr(options, option)
        wrong = [label for label in labels if label != plain_label(label)]
        folders = (options.freesurfer_dir, options.ashs_dir, options.hippunfold_dir)
        if wrong and not any(folders):
            raise UsageError(
                f"--{option.replace('_', '-')}: {wrong[0]!r} is not a BIDS label (letters and"
                " digits)"
            )
        setattr(options, option, [plain_label(label) for label in labels])


def _run_options(
    options: "Namespace", arguments: Sequence[str], notes: tuple[str, ...]
) -> "RunOptions":
    from hipsta_bids.io.files import check_scratch, hide_home  # noqa: PLC0415  (start-up time)
    from hipsta_bids.participant.run import WORKER_GB, RunOptions  # noqa: PLC0415  (heavy)

    if options.mem is not None and options.mem < WORKER_GB:
        raise UsageError(
            f"--mem: {options.mem * 1000:g} MB is less than one hemisphere may need"
            f" ({WORKER_GB * 1000:g} MB); for gigabytes write 8G"
        )
    check_scratch(options.work_dir)
    cluster = None
    if options.dask_scheduler is not None or options.slurm is not None:
        cluster = Cluster(scheduler=options.dask_scheduler, slurm=options.slurm)
        check_cluster(cluster)
    return from_namespace(
        RunOptions,
        options,
        mem_gb=options.mem,
        verbosity=options.verbose,
        cluster=cluster,
        reports=not options.no_reports,
        anatomy=None if options.no_anatomy else options.bids_dir,
        # The home folder names a person.
        command=hide_home(shlex.join(("hipsta-bids", *arguments))) if arguments else None,
        notes=tuple(map(hide_home, notes)),
    )
