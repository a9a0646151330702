"""The command line: which command runs, what ends it early, and its exit code."""

import contextlib
import errno
import gc
import logging
import os
import signal
import sys
import traceback
from collections.abc import Iterator, Sequence
from importlib.resources import files
from pathlib import Path
from types import FrameType

from hipsta_bids.cli.console import echo, warn
from hipsta_bids.cli.group import LEVEL, is_group_level, run_group_level
from hipsta_bids.cli.participant import LEVELS, build_parser, run_participant_level
from hipsta_bids.errors import EXIT_MEANINGS, ExitCode, HipstaError, UsageError, did_you_mean
from hipsta_bids.joints import Command, find_extensions, load

#: What a path or a file system may refuse anywhere.
_OF_PATHS = {errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTDIR, errno.EACCES, errno.EIO, errno.ESTALE}
_LONGEST_PATH = 300  # characters shown
_SIGNALED = 128  # shells report death by signal n as 128 + n

#: Commands other than the BIDS App: name, its function in `commands`, arguments and meaning for the
#: help. They are loaded when they are called.
_CORE = (
    ("protocols", "list_protocols", "", "list the known segmentation protocols"),
    ("settings", "print_settings", "[group]", "print all settings with their meaning, as TOML"),
    ("demo-data", "write_demo_data", "DIR", "write a synthetic dataset with known thickness"),
    ("demo", "run_demo", "DIR", "write it, run on it, and compare with the truth"),
    ("phantom", "write_phantoms", "DIR", "write a synthetic cohort with a known effect"),
    ("figure", "draw_figure", "WHAT OUT", "draw a figure for a paper from results"),
)
COMMANDS = {
    name: Command(
        name=name, run=f"hipsta_bids.cli.commands:{run}", arguments=arguments, meaning=meaning
    )
    for name, run, arguments, meaning in _CORE
} | {command.name: command for extension in find_extensions() for command in extension.commands}

_DESCRIPTOR = "--bids-exec-spec"

EPILOG = "\n".join(
    [
        "other commands (each has a --help of its own):",
        *(
            f"  hipsta-bids {f'{name} {command.arguments}':<18} {command.meaning}"
            for name, command in COMMANDS.items()
        ),
        f"  hipsta-bids {_DESCRIPTOR:<18} print the Boutiques descriptor of both levels",
        "",
        "exit codes:",
        *(f"  {int(code):<4} {meaning}" for code, meaning in EXIT_MEANINGS.items()),
    ]
)


class _TerminatedError(BaseException):
    """SIGTERM, as an exception that unwinds like Ctrl-C does."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    gc.set_threshold(20_000)  # Python's 700 costs a fifth where many objects are made and kept
    # What nibabel repairs in headers; what it cannot repair is an error that names the file.
    logging.getLogger("nibabel.global").setLevel(logging.CRITICAL)
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
    except Exception as error:  # noqa: BLE001  (any other exception is a bug: show it whole)
        if isinstance(error, OSError) and error.filename and error.errno in _OF_PATHS:
            path, code = str(error.filename)[:_LONGEST_PATH], ExitCode.BAD_DATA
            text = f"{path}: {error.strerror}; check the path, and who may read it"
        else:
            text, code = "internal error; please report it with the lines above", ExitCode.INTERNAL
            traceback.print_exc()
        warn(f"hipsta-bids: {text}")
        return int(code)


@contextlib.contextmanager
def _terminable() -> Iterator[None]:
    """Let SIGTERM unwind the run, so that workers end and the table and the log are complete."""

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
    """Distinguish commands from the BIDS App, whose dataset may have the name of a command."""
    if _DESCRIPTOR in arguments:
        echo((files("hipsta_bids.cli") / "descriptor.json").read_text(encoding="utf-8").rstrip())
        return ExitCode.OK
    level = arguments[2:3] if not "".join(arguments[1:2]).startswith("-") else []
    is_app = not {*LEVELS, LEVEL}.isdisjoint(level)
    if arguments and arguments[0] in COMMANDS and not is_app:
        code: ExitCode = load(COMMANDS[arguments[0]].run)(arguments[1:])
        return code
    near = did_you_mean(arguments[:1], COMMANDS)
    if near and not is_app and not Path(arguments[0]).exists():
        raise UsageError(f"{arguments[0]!r} is no command and no dataset{near}")
    _check_order(arguments)
    if is_group_level(arguments):
        return run_group_level(arguments)
    return run_participant_level(build_parser(EPILOG).parse_args(arguments), arguments)


def _check_order(arguments: Sequence[str]) -> None:
    """Refuse a level before the folders; a dataset may have its name if a level follows."""
    levels = {*LEVELS, LEVEL}
    level, words = "".join(arguments[:1]), arguments[1:]
    if level not in levels or (levels | {"-h", "--help", "--version"}).intersection(words):
        return
    options = [text.partition("=")[0] for text in words if text.startswith("-")]
    call = " ".join(["hipsta-bids BIDS_DIR OUT_DIR", level, *options[:1]])
    raise UsageError(f"{level}: the folders precede the level; write {call}")


if __name__ == "__main__":
    sys.exit(main())
