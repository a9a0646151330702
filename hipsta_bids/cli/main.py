"""The command line: arguments to settings and options, errors to exit codes."""

import contextlib
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FrameType

from hipsta_bids.cli.console import echo, echo_table, warn
from hipsta_bids.cli.group import is_group_level, run_group_level
from hipsta_bids.cli.participant import (
    LEVELS,
    build_parser,
    check_folders,
    check_output_is_no_input,
    command_line,
    input_request,
    join_slurm,
    run_participant_level,
)
from hipsta_bids.errors import ExitCode, HipstaError, UsageError

_SIGNALED = 128  # shells report death by signal n as 128 + n


class _TerminatedError(BaseException):
    """SIGTERM, as an exception that unwinds like Ctrl-C does."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        with _terminable():
            return int(_dispatch(arguments))
    except HipstaError as error:
        warn(f"hipsta-bids: {error}")
        return int(error.exit_code)
    except KeyboardInterrupt:
        warn("hipsta-bids: stopped by Ctrl-C; run the same command again to complete")
        return _SIGNALED + signal.SIGINT
    except _TerminatedError:
        warn("hipsta-bids: stopped by SIGTERM; run the same command again to complete")
        return _SIGNALED + signal.SIGTERM
    except BrokenPipeError:
        # The reader of the output is gone (as in `| head`); do not fail again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return _SIGNALED + signal.SIGPIPE
    except Exception:  # noqa: BLE001  (any other exception is a bug: show it whole)
        traceback.print_exc()
        warn("hipsta-bids: internal error; please report it with the lines above")
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
        "schemes": _protocols,
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
    return run_participant_level(options, command_line(arguments))


def _descriptor() -> ExitCode:
    """Print what the command line looks like, for platforms."""
    from importlib.resources import files  # noqa: PLC0415  (start-up time)

    echo((files("hipsta_bids.cli") / "descriptor.json").read_text(encoding="utf-8").rstrip())
    return ExitCode.OK


def _no_arguments(arguments: list[str], command: str) -> None:
    if arguments:
        raise UsageError(f"{command} takes no arguments (see hipsta-bids --help)", reason="usage")


def _one_folder(arguments: list[str], command: str) -> Path:
    if len(arguments) != 1 or arguments[0].startswith("-"):
        raise UsageError(f"{command} takes one folder: hipsta-bids {command} DIR", reason="usage")
    return Path(arguments[0])


def _protocols(arguments: list[str]) -> ExitCode:
    _no_arguments(arguments, "schemes")
    from hipsta_bids.protocols.load import protocol_table  # noqa: PLC0415  (heavy)

    echo_table(protocol_table())
    return ExitCode.OK


def _settings(arguments: list[str]) -> ExitCode:
    group = arguments == ["group"]
    _no_arguments([] if group else arguments, "settings")
    from hipsta_bids.group.settings import GroupSettings  # noqa: PLC0415  (start-up time)
    from hipsta_bids.protocols.toml import settings_toml  # noqa: PLC0415  (start-up time)
    from hipsta_bids.settings import Settings  # noqa: PLC0415  (start-up time)

    echo(settings_toml(GroupSettings() if group else Settings()).rstrip())
    return ExitCode.OK


def _demo_data(arguments: list[str]) -> ExitCode:
    folder = _one_folder(arguments, "demo-data")
    from hipsta_bids.cli.phantom import write_demo_data  # noqa: PLC0415  (heavy)

    write_demo_data(folder)
    echo(f"demo dataset: {folder}")
    return ExitCode.OK


def _demo(arguments: list[str]) -> ExitCode:
    """Write the demo dataset, run on it, and print true beside measured thickness."""
    folder = _one_folder(arguments, "demo")
    from hipsta_bids.cli.phantom import compare_with_truth, write_demo_data  # noqa: PLC0415  (heavy)

    data, out = folder / "bids", folder / "out"
    write_demo_data(data)
    code = run_participant_level(build_parser().parse_args([str(data), str(out), "participant"]))
    for line in compare_with_truth(data, out):
        echo(line)
    return code


def _phantom(arguments: list[str]) -> ExitCode:
    """Write a cohort of phantoms."""
    from hipsta_bids.cli.phantom import phantom_parser  # noqa: PLC0415  (start-up time)

    options = phantom_parser().parse_args(arguments)
    from hipsta_bids.phantom.cohort import CohortPlan, write_cohort  # noqa: PLC0415  (heavy)

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
    echo(f"synthetic dataset of {plan.n_subjects} subjects: {options.out}")
    return ExitCode.OK


def _surrogate(arguments: list[str]) -> ExitCode:
    """Measure thickness in single slices."""
    from hipsta_bids.cli.phantom import surrogate_parser  # noqa: PLC0415  (start-up time)

    given = surrogate_parser().parse_args(arguments)
    # What is not asked here is as if it had not been asked for.
    defaults = build_parser().parse_args([str(given.bids_dir), str(given.output_dir), LEVELS[0]])
    options = type(given)(**{**vars(defaults), **vars(given)})
    check_folders(options)
    from hipsta_bids.settings import load_settings  # noqa: PLC0415  (start-up time)

    settings = load_settings(options.settings)
    from hipsta_bids.inputs.search import dataset_notes, find_inputs, selection_table  # noqa: PLC0415  (heavy)
    from hipsta_bids.validation.slice_thickness import crosscheck  # noqa: PLC0415  (heavy)

    request = input_request(options)
    found = find_inputs(request)
    for note in (*dataset_notes(request, found.items), *found.notes):
        echo(f"note: {note}")
    if options.dry_run:
        echo_table(selection_table(found.items))
        return ExitCode.OK
    check_output_is_no_input(options.output_dir, found.items)
    return crosscheck(found.items, options.output_dir, settings, echo, warn)


def _validate(arguments: list[str]) -> ExitCode:
    """Run the validation suites and write their report."""
    from hipsta_bids.cli.phantom import validate_parser  # noqa: PLC0415  (start-up time)

    options = validate_parser().parse_args(arguments)
    from hipsta_bids.validation.report import PAGE, validate  # noqa: PLC0415  (heavy)

    missed = validate(
        options.out, full=options.full, names=options.suite, labels=options.labels, report=echo
    )
    echo(f"targets missed: {missed}; report: {options.out / PAGE}")
    return ExitCode.OK


if __name__ == "__main__":
    sys.exit(main())
