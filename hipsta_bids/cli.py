"""The command line: arguments to settings and options, errors to exit codes."""

import contextlib
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from hipsta_bids.console import Progress, complain, say, say_result, say_start, say_table
from hipsta_bids.errors import ExitCode, HipstaError, NothingToDoError, UsageError
from hipsta_bids.group_command import is_group_level, run_group_level
from hipsta_bids.parser import COLLECT, LEVELS, build_parser, join_slurm
from hipsta_bids.report_command import command_line, rebuild_reports
from hipsta_bids.threads import pin_threads

if TYPE_CHECKING:
    from argparse import Namespace

    from hipsta_bids.bids.dataset import Findings
    from hipsta_bids.bids.inputs import HemisphereInput, InputRequest
    from hipsta_bids.cluster import Cluster
    from hipsta_bids.runner import RunOptions
    from hipsta_bids.settings import Settings
    from hipsta_bids.shard import Shard

_SIGNALED = 128  # shells report death by signal n as 128 + n


class _TerminatedError(BaseException):
    """SIGTERM, as an exception that unwinds like Ctrl-C does."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments without the program's name; those of this process by default.

    Returns
    -------
    int
        An :class:`ExitCode`, or 128 plus the number of the signal that stopped the run.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        with _terminable():
            return int(_dispatch(arguments))
    except HipstaError as error:
        complain(f"hipsta-bids: {error}")
        return int(error.exit_code)
    except KeyboardInterrupt:
        complain("hipsta-bids: stopped by Ctrl-C; run the same command again to complete")
        return _SIGNALED + signal.SIGINT
    except _TerminatedError:
        complain("hipsta-bids: stopped by SIGTERM; run the same command again to complete")
        return _SIGNALED + signal.SIGTERM
    except BrokenPipeError:
        # The reader of the output is gone (as in `| head`); do not fail again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return _SIGNALED + signal.SIGPIPE
    except Exception:  # noqa: BLE001  (any other exception is a bug: show it whole)
        traceback.print_exc()
        complain("hipsta-bids: internal error; please report it with the lines above")
        return int(ExitCode.INTERNAL)


@contextlib.contextmanager
def _terminable() -> Iterator[None]:
    """Let SIGTERM unwind the run, so that workers end and the books are closed."""

    def stop(_signal: int, _frame: FrameType | None) -> None:
        raise _TerminatedError

    try:
        before = signal.signal(signal.SIGTERM, stop)
    except ValueError:  # not in the main thread: whoever embeds this handles signals
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _dispatch(arguments: list[str]) -> ExitCode:
    """Tell the other commands from the BIDS App, whose dataset may have any name."""
    commands: dict[str, Callable[[list[str]], ExitCode]] = {
        "schemes": _schemes,
        "settings": _settings,
        "demo-data": _demo_data,
        "demo": _demo,
        "phantom": _phantom,
        "surrogate": _surrogate,
        "validate": _validate,
    }
    if "--bids-exec-spec" in arguments:
        return _descriptor()
    if is_group_level(arguments):
        return run_group_level(arguments)
    is_app = any(level in arguments[1:] for level in LEVELS)
    if arguments and arguments[0] in commands and not is_app:
        return commands[arguments[0]](arguments[1:])
    options = build_parser().parse_args(join_slurm(arguments))
    return _participant(options, command_line(arguments))


def _participant(options: "Namespace", command: str | None = None) -> ExitCode:
    pin_threads()
    from hipsta_bids.settings_file import load_settings  # noqa: PLC0415  (start-up time)

    _check_folders(options)
    if options.analysis_level == COLLECT and options.shard is not None:
        raise UsageError("collect is about all parts; leave --shard out", reason="usage")
    if options.reports_only:
        return rebuild_reports(options)
    settings = _with_region(load_settings(options.settings), options.region)
    request = _request(options)
    say_start(options.analysis_level, options.bids_dir)
    from hipsta_bids.bids.dataset import dataset_notes, selection_table  # noqa: PLC0415  (heavy)
    from hipsta_bids.bids.maps import attach, map_requests  # noqa: PLC0415  (heavy)

    wishes = map_requests(options.map, options.map_sampling, options.map_interpolation)
    found = _find(request, options.shard)
    if found is None:
        say(f"part {options.shard.name} of the dataset has nothing to process")
        return ExitCode.OK
    items, map_notes = attach(found.items, wishes, options.roi, options.bids_dir)
    for note in (*dataset_notes(request, items), *found.notes, *map_notes):
        say(f"note: {note}")
    if options.dry_run:
        say_table(selection_table(items))
        return ExitCode.OK
    _check_output_is_no_input(options.output_dir, items)
    if options.analysis_level == COLLECT:
        from hipsta_bids.collect import collect  # noqa: PLC0415  (heavy)

        result = collect(items, options.output_dir, settings, _run_options(options, command))
        say_result(result, options.output_dir)
        return result.exit_code
    from hipsta_bids.runner import run_participants  # noqa: PLC0415  (heavy)

    progress = Progress(len(items), options.verbose)
    try:
        result = run_participants(
            items, options.output_dir, settings, _run_options(options, command), progress.report
        )
    finally:
        progress.close()
    say_result(result, options.output_dir)
    return result.exit_code


def _find(request: "InputRequest", shard: "Shard | None") -> "Findings | None":
    """Find inputs, of one part of the subjects if asked for; ``None`` if that has none."""
    from hipsta_bids.bids.dataset import find_inputs, list_subjects  # noqa: PLC0415  (heavy)

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
    return replace(settings, body=replace(settings.body, region=region))


def _check_folders(options: "Namespace") -> None:
    if options.output_dir.resolve() == options.bids_dir.resolve():
        raise UsageError(
            f"{options.output_dir}: the output folder is the BIDS dataset itself; use for example"
            f" {options.bids_dir / 'derivatives' / 'hipsta_bids'}",
            reason="output-is-input",
        )


def _check_output_is_no_input(out_dir: Path, items: "Sequence[HemisphereInput]") -> None:
    if out_dir.resolve() in {item.source_path.resolve() for item in items}:
        raise UsageError(
            f"{out_dir}: the output folder holds the segmentations; choose another one",
            reason="output-is-input",
        )


def _request(options: "Namespace") -> "InputRequest":
    from hipsta_bids.bids.inputs import InputRequest  # noqa: PLC0415  (heavy)

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
        scheme=options.scheme,
        edited_dir=options.edited_dir,
        output_dir=options.output_dir,
        bids_filter_file=options.bids_filter_file,
        bids_database_dir=options.bids_database_dir,
    )


def _run_options(options: "Namespace", command: str | None) -> "RunOptions":
    from hipsta_bids.bids.files import check_scratch  # noqa: PLC0415  (start-up time)
    from hipsta_bids.runner import WORKER_GB, RunOptions  # noqa: PLC0415  (heavy)

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


def _descriptor() -> ExitCode:
    """Print what the command line looks like, for platforms."""
    from hipsta_bids.boutiques import descriptor_text  # noqa: PLC0415  (start-up time)

    say(descriptor_text().rstrip())
    return ExitCode.OK


def _cluster(options: "Namespace") -> "Cluster | None":
    from hipsta_bids.cluster import Cluster, check_cluster  # noqa: PLC0415  (start-up time)

    if options.dask_scheduler is None and options.slurm is None:
        return None
    cluster = Cluster(scheduler=options.dask_scheduler, slurm=options.slurm)
    check_cluster(cluster)
    return cluster


def _no_arguments(arguments: list[str], command: str) -> None:
    if arguments:
        raise UsageError(f"{command} takes no arguments (see hipsta-bids --help)", reason="usage")


def _one_folder(arguments: list[str], command: str) -> Path:
    if len(arguments) != 1 or arguments[0].startswith("-"):
        raise UsageError(f"{command} takes one folder: hipsta-bids {command} DIR", reason="usage")
    return Path(arguments[0])


def _schemes(arguments: list[str]) -> ExitCode:
    _no_arguments(arguments, "schemes")
    from hipsta_bids.schemes import scheme_table  # noqa: PLC0415  (heavy)

    say_table(scheme_table())
    return ExitCode.OK


def _settings(arguments: list[str]) -> ExitCode:
    group = arguments == ["group"]
    _no_arguments([] if group else arguments, "settings")
    from hipsta_bids.group_settings import GroupSettings  # noqa: PLC0415  (start-up time)
    from hipsta_bids.settings import Settings  # noqa: PLC0415  (start-up time)
    from hipsta_bids.settings_file import settings_toml  # noqa: PLC0415  (start-up time)

    say(settings_toml(GroupSettings() if group else Settings()).rstrip())
    return ExitCode.OK


def _demo_data(arguments: list[str]) -> ExitCode:
    folder = _one_folder(arguments, "demo-data")
    from hipsta_bids.demo import write_demo_data  # noqa: PLC0415  (heavy)

    write_demo_data(folder)
    say(f"demo dataset: {folder}")
    return ExitCode.OK


def _demo(arguments: list[str]) -> ExitCode:
    """Write the demo dataset, run on it, and print true beside measured thickness."""
    folder = _one_folder(arguments, "demo")
    from hipsta_bids.demo import compare_with_truth, write_demo_data  # noqa: PLC0415  (heavy)

    data, out = folder / "bids", folder / "out"
    write_demo_data(data)
    code = _participant(build_parser().parse_args([str(data), str(out), "participant"]))
    for line in compare_with_truth(data, out):
        say(line)
    return code


def _phantom(arguments: list[str]) -> ExitCode:
    """Write a cohort of phantoms."""
    from hipsta_bids.subcommands import phantom_parser  # noqa: PLC0415  (start-up time)

    options = phantom_parser().parse_args(arguments)
    from hipsta_bids.phantom.cohort import CohortPlan  # noqa: PLC0415  (heavy)
    from hipsta_bids.phantom.cohort_dataset import write_cohort  # noqa: PLC0415  (heavy)

    plan = CohortPlan(
        n_subjects=options.n_subjects,
        groups=tuple(options.groups),
        thinning=options.thinning,
        region=options.region,
        shift=options.shift,
        seed=options.seed,
        kind=options.kind,
        thickness=options.thickness,
        cortex=options.cortex,
    )
    write_cohort(options.out, plan, layout=options.layout, voxel_size=tuple(options.voxel_size))
    say(f"synthetic dataset of {plan.n_subjects} subjects: {options.out}")
    return ExitCode.OK


def _surrogate(arguments: list[str]) -> ExitCode:
    """Measure thickness in single slices."""
    from hipsta_bids.subcommands import surrogate_parser  # noqa: PLC0415  (start-up time)

    given = surrogate_parser().parse_args(arguments)
    # What is not asked here is as if it had not been asked for.
    defaults = build_parser().parse_args([str(given.bids_dir), str(given.output_dir), LEVELS[0]])
    options = type(given)(**{**vars(defaults), **vars(given)})
    _check_folders(options)
    from hipsta_bids.settings_file import load_settings  # noqa: PLC0415  (start-up time)

    settings = load_settings(options.settings)
    from hipsta_bids.bids.dataset import (  # noqa: PLC0415  (heavy)
        dataset_notes,
        find_inputs,
        selection_table,
    )
    from hipsta_bids.crosscheck import crosscheck  # noqa: PLC0415  (heavy)

    request = _request(options)
    found = find_inputs(request)
    for note in (*dataset_notes(request, found.items), *found.notes):
        say(f"note: {note}")
    if options.dry_run:
        say_table(selection_table(found.items))
        return ExitCode.OK
    _check_output_is_no_input(options.output_dir, found.items)
    return crosscheck(found.items, options.output_dir, settings, say, complain)


def _validate(arguments: list[str]) -> ExitCode:
    """Run the validation suites and write their report."""
    from hipsta_bids.subcommands import validate_parser  # noqa: PLC0415  (start-up time)

    options = validate_parser().parse_args(arguments)
    from hipsta_bids.validation.report import PAGE, validate  # noqa: PLC0415  (heavy)

    missed = validate(
        options.out, full=options.full, names=options.suite, labels=options.labels, report=say
    )
    say(f"targets missed: {missed}; report: {options.out / PAGE}")
    return ExitCode.OK


if __name__ == "__main__":
    sys.exit(main())
