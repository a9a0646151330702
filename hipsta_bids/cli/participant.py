"""The participant level: its options, and the run. Loads nothing heavy for ``--help``."""

import argparse
import os
import re
import shlex
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hipsta_bids import __version__, joints
from hipsta_bids.cli import console
from hipsta_bids.cli.parser import (
    Parser,
    accept,
    adder,
    bids_label,
    from_namespace,
    help_texts,
    named_path,
    positive_float,
    positive_int,
    subject_label,
)
from hipsta_bids.errors import ExitCode, NothingToDoError, OutputError, UsageError, did_you_mean
from hipsta_bids.participant.pool import pin_threads, processors
from hipsta_bids.participant.shard import Shard, parse_shard
from hipsta_bids.protocols import EXPERIMENTAL

if TYPE_CHECKING:
    from argparse import Namespace

    from hipsta_bids.inputs.scan import HemisphereInput, InputRequest
    from hipsta_bids.inputs.search import Findings
    from hipsta_bids.participant.run import RunOptions
    from hipsta_bids.settings import Settings

_HELP = "participant"
"""Texts of the help."""

#: Options that a first run may need.
_FIRST = (
    *("--help", "--version", "--dry-run", "--participant-label", "--session-label"),
    *("--derivatives", "--freesurfer-dir", "--ashs-dir", "--hippunfold-dir", "--ashs-atlas"),
    *("--settings", "--n-procs", "--mem", "--work-dir"),
)
COLLECT = "collect"
LEVELS = ("participant", COLLECT)
REGIONS = ("body", "extended", "entorhinal", *EXPERIMENTAL)

_GIGABYTES = {"K": 1e-6, "M": 1e-3, "G": 1.0, "T": 1e3}


def build_parser(epilog: str | None = None) -> Parser:
    """Describe the participant level's command line."""
    parser = Parser(
        "hipsta-bids",
        help_texts()[_HELP]["description"],
        first=_FIRST,
        usage="hipsta-bids BIDS_DIR OUT_DIR participant [options]",
        epilog=epilog,
    )
    add = adder(parser, _HELP)
    add("bids_dir", type=Path)
    add("output_dir", type=Path)
    add("analysis_level", type=_level)
    parser.add_argument("--version", action="version", version=f"hipsta_bids {__version__}")
    accept(parser, help_texts()["without meaning"])
    add_selection(parser)
    add_segmentations(parser)
    for addition in joints.find_inputs():
        joints.load(addition.options)(parser)
    _add_processing(parser)
    group = parser.add_argument_group("many machines")
    adder(group, _HELP)("--shard", "I/N", type=_shard)
    for engine in joints.find_engines():
        joints.load(engine.options)(group)
    return parser


def add_selection(parser: Parser) -> None:
    """Add the options that choose subjects, sessions and hemispheres."""
    add = adder(parser.add_argument_group("what to process"), _HELP)
    add("--participant-label", "LABEL...", type=subject_label)
    add("--exclude-participant-label", "LABEL...", type=subject_label)
    add("--session-label", "LABEL...", type=bids_label("ses-"))
    add("--hemi", "H", nargs="+", type=_hemi, default=["L", "R"])
    add("--bids-filter-file", "FILE")
    add("--bids-database-dir", "DIR")
    add("--skip-bids-validation")
    add("--dry-run")


def add_segmentations(parser: Parser) -> None:
    """Add the options for the folders of segmentations."""
    add = adder(parser.add_argument_group("where the segmentations are"), _HELP)
    add("-d --derivatives", "NAME=PATH...", type=named_path)
    add("--freesurfer-dir --fs-subjects-dir", "DIR")
    add("--ashs-dir", "DIR")
    add("--hippunfold-dir", "DIR")
    add("--fs-analysis", "NAME")
    add("--participants-map", "FILE.tsv")
    add("--ashs-atlas", "SCHEME")
    add("--scheme --protocol", "FILE.toml")
    add("--edited-dir", "DIR")


def _add_processing(parser: Parser) -> None:
    group = parser.add_argument_group("how to process")
    add = adder(group, _HELP)
    add("--settings --config-file", "FILE.toml")
    add("--region", "NAME", _regions_text(), choices=REGIONS)
    add("--method", "NAME", choices=("default", "published"))
    add("--x-coordinate", "NAME", choices=("midsurface", "volume"))
    add("--ends", "FILE.tsv")
    add("--probabilities", "auto|never|DIR", type=_probabilities, default="auto")
    for grouping in joints.find_groupings():
        joints.load(grouping.options)(group)
    add("--write-meshes")
    for measurement in joints.find_measurements():
        if measurement.options:
            joints.load(measurement.options)(group)
    add("--force")
    add_pages = adder(group.add_mutually_exclusive_group(), _HELP)
    add_pages("--no-reports")
    add_pages("--reports-only")
    add("--no-anatomy")
    processes = "--n-procs --nprocs --n-cpus --nthreads"
    add(processes, "N", type=positive_int, default=processors())
    add("--mem --mem-mb", "SIZE", type=_gigabytes)
    add("--timeout", "S", type=positive_float, default=600.0)
    add("-w --work-dir", "DIR")
    add("--stop-on-first-crash")
    add("-v --verbose", action="count", default=0)
    add("-q --quiet")


def _regions_text() -> str:
    """List the regions, for the help."""
    regions = joints.find_regions().items()
    further = [f"{name} ({one.meaning})" if one.meaning else name for name, one in regions]
    text = help_texts()["participant"]["--region"]
    return f"{text}; experimental: {', '.join(further)}" if further else text


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


def _probabilities(text: str) -> str | Path:
    return text if text in {"auto", "never"} else Path(text)


def _shard(text: str) -> Shard:
    return parse_shard(text, os.environ)


def _gigabytes(text: str) -> float:
    """Read a size as fMRIPrep does: megabytes unless a unit follows."""
    match = re.fullmatch(r"(\d+\.?\d*)\s*([KMGT]?)B?", text.strip().upper())
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a size; write 8000 (MB) or 8G")
    return positive_float(match[1]) * _GIGABYTES[match[2] or "M"]


def run_participant_level(options: "Namespace", arguments: Sequence[str] = ()) -> ExitCode:
    """Measure, collect or list hemispheres, by a parsed command line."""
    with console.quiet(options.quiet):
        return _run(options, arguments)


def _run(options: "Namespace", arguments: Sequence[str]) -> ExitCode:
    pin_threads()
    console.echo_ignored(options.ignored)
    check_folders(options)
    console.warn_if_lost(options.output_dir)
    collects = options.analysis_level == COLLECT
    if collects and options.shard is not None:
        raise UsageError("collect is about all parts; leave --shard out")
    if options.reports_only:
        return _rebuild_reports(options)
    settings = _settings(options)
    if settings.body.region in EXPERIMENTAL:
        console.echo(f"note: region {settings.body.region} is experimental")
    request = input_request(options)
    console.echo_start(options.analysis_level, options.bids_dir)
    from hipsta_bids.derivatives.dataset import upgrade_notes  # noqa: PLC0415  (heavy)
    from hipsta_bids.inputs import account, search  # noqa: PLC0415  (heavy)
    from hipsta_bids.inputs.edits import attach_ends  # noqa: PLC0415  (heavy)
    from hipsta_bids.io.volumes import limit_memory  # noqa: PLC0415  (heavy)

    limit_memory(options.mem)
    additions = [joints.load(addition.make)(options) for addition in joints.find_inputs()]
    with console.searching(has_bar=not (options.quiet or options.dry_run)):
        part = options.shard and options.shard.take(search.list_subjects(request))
        findings = _find(request, part, say=console.echo if options.dry_run else None)
    if findings is None:
        console.echo(f"part {options.shard.name} of the dataset has nothing to process")
        return ExitCode.OK
    items, end_notes = attach_ends(findings.items, options.ends)
    items, further_notes, warnings = _attach_all(items, additions)
    notes = (
        *search.dataset_notes(request, items, part),
        *findings.notes,
        *end_notes,
        *further_notes,
        *upgrade_notes(options.output_dir),
    )
    unused = (*findings.ignored, *findings.other_entries)
    inputs = account.input_table(items, unused, options.bids_dir)
    _echo_notes(notes, warnings)
    counts = f"inputs: {account.count_inputs(inputs)}"
    if options.dry_run:
        console.echo(counts)
        _list_inputs(items, findings, settings)
        _check_labels(items, settings)
        return ExitCode.OK
    check_output_is_no_input(options.output_dir, items)
    from hipsta_bids.participant.run import STAGE, collect, run_participants  # noqa: PLC0415  (heavy)

    notes += tuple(f"not used: {entry.path}: {entry.reason}" for entry in findings.ignored)
    out, run_options = options.output_dir, _run_options(options, arguments, notes)
    run_options = replace(
        run_options,
        inputs=tuple(inputs),
        is_whole=request.is_whole,
        pybids=request.uses_pybids,
    )
    console.echo(counts)
    with console.Progress(-1 if options.quiet else options.verbose) as progress:
        if collects:
            result = collect(items, out, settings, run_options)
        else:
            progress.show(STAGE, 0, len(items))
            result = run_participants(items, out, settings, run_options, progress.report)
    console.echo_result(result, out, has_pages=run_options.reports)
    return result.exit_code


def _echo_notes(notes: Iterable[str], warnings: Iterable[str]) -> None:
    """Print notes and warnings on inputs."""
    for note in notes:
        console.echo(f"note: {note}")
    for warning in warnings:
        console.warn(f"warning: {warning}")


def _attach_all(
    items: "Sequence[HemisphereInput]", additions: Iterable[Callable[..., Any]]
) -> tuple[tuple["HemisphereInput", ...], list[str], list[str]]:
    """Add what extensions bring to inputs; return notes and warnings, too."""
    notes, warnings = [], []
    for attach in additions:
        items, added_notes, added_warnings = attach(items)
        notes += added_notes
        warnings += added_warnings
    return tuple(items), notes, warnings


def _list_inputs(
    items: "Sequence[HemisphereInput]", findings: "Findings", settings: "Settings"
) -> None:
    """Print tables of the inputs and of all that is not used, and what is measured together."""
    from hipsta_bids.inputs import account  # noqa: PLC0415  (heavy)

    console.echo_table(account.selection_table(items))
    console.echo_table(account.ignored_table(findings.ignored))
    console.echo_table(account.other_entries_table(findings.other_entries))
    grouping = joints.find_grouping(settings)
    for note in joints.load(grouping.notes)(items) if grouping else ():
        console.echo(note)


def _check_labels(items: "Sequence[HemisphereInput]", settings: "Settings") -> None:
    """Print what is wrong with the labels of each usable hemisphere."""
    from hipsta_bids.participant.job import check_item  # noqa: PLC0415  (heavy)

    usable = [item for item in items if item.problem is None]
    problems = [(item, text) for item in usable for text in check_item(item, settings)]
    for item, text in problems:
        session = f" ses-{item.session}" if item.session else ""
        console.echo(f"sub-{item.subject}{session} {item.hemi} {item.protocol.name}, {text}")
    wrong = len({id(item) for item, _ in problems})
    console.echo(f"labels of {len(usable)} hemispheres checked, problems in {wrong}")


def _settings(options: "Namespace") -> "Settings":
    """Resolve settings: those of a file, of the published method, and of single options."""
    from hipsta_bids.settings import PUBLISHED, load_settings  # noqa: PLC0415  (start-up time)

    preset = PUBLISHED if options.method == "published" else {}
    settings = load_settings(options.settings).changed(**preset)
    settings = settings.changed(
        body={"region": options.region} if options.region else {},
        sheet={"x_coordinate": options.x_coordinate} if options.x_coordinate else {},
    )
    for grouping in joints.find_groupings():
        settings = joints.load(grouping.settings)(options, settings)
    return settings


def _further(options: "Namespace") -> dict[str, object]:
    """Collect the options of extensions that were given, by name."""
    names = [measurement.name for measurement in joints.find_measurements() if measurement.options]
    values = {name: getattr(options, name) for name in names}
    return {name: value for name, value in values.items() if value}


def _find(
    request: "InputRequest", part: Sequence[str] | None, say: Callable[[str], None] | None
) -> "Findings | None":
    """Find inputs, of one part of the subjects if asked for; ``None`` if that has none.

    Where there are none at all, ``say`` gets a line for each entry that was not used.
    """
    from hipsta_bids.inputs.search import find_inputs  # noqa: PLC0415  (heavy)

    if part is None:
        try:
            return find_inputs(request)
        except NothingToDoError as error:
            if say is not None:
                for line in getattr(error, "__notes__", ()):
                    say(line)
            raise
    if not part:
        return None
    try:
        return find_inputs(replace(request, participant_labels=tuple(part)))
    except NothingToDoError:
        return None  # others may have something, and collecting says if none has


def _rebuild_reports(options: "Namespace") -> ExitCode:
    """Make the pages of the requested visits and of the cohort again from their files."""
    from hipsta_bids.derivatives.names import DATASET_FILES  # noqa: PLC0415  (start-up time)
    from hipsta_bids.io.files import check_writable  # noqa: PLC0415  (start-up time)
    from hipsta_bids.participant.log import log_file  # noqa: PLC0415  (heavy)
    from hipsta_bids.participant.pages import PagePlan, visits_of, write_reports  # noqa: PLC0415  (heavy)

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
        plan = PagePlan(
            root=root,
            n_workers=options.n_procs,
            log=log,
            bids_dir=options.bids_dir,
            anatomy=not options.no_anatomy,
        )
        problems = list(write_reports(plan, visits))
    for problem in problems:
        console.warn(f"report: {problem}")
    console.echo(f"reports of {len(visits)} visits: {root / DATASET_FILES['report']}")
    if any(isinstance(problem, OutputError) for problem in problems):
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
    """Collect the options that select inputs."""
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
    engines = (joints.load(engine.make)(options) for engine in joints.find_engines())
    return from_namespace(
        RunOptions,
        options,
        mem_gb=options.mem,
        verbosity=options.verbose,
        engine=next(filter(None, engines), None),
        further=_further(options),
        reports=not options.no_reports,
        anatomy=not options.no_anatomy,
        # The home folder names a person.
        command=hide_home(shlex.join(("hipsta-bids", *arguments))) if arguments else None,
        notes=tuple(map(hide_home, notes)),
    )
