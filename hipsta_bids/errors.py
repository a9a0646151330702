"""Errors that a user can act on, and the exit codes that go with them.

A message says what is wrong, where, and what to try, on one line. Any exception that is not a
:class:`HipstaError` is a bug in this package and shows its traceback.
"""

import difflib
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from enum import IntEnum
from signal import SIGINT, SIGTERM


class ExitCode(IntEnum):
    """What the command line returns (64-73 as in BSD's sysexits.h)."""

    OK = 0
    SOME_FAILED = 1
    USAGE = 64
    BAD_DATA = 65
    NOTHING_TO_DO = 66
    INTERNAL = 70
    NOT_WRITABLE = 73


#: What exit codes mean, those of signals included: shells report death by signal n as 128 + n.
EXIT_MEANINGS: dict[int, str] = {
    ExitCode.OK: "all hemispheres done",
    ExitCode.SOME_FAILED: "some hemisphere failed, the rest is complete (see status.tsv)",
    ExitCode.USAGE: "wrong use of the command line, wrong settings",
    ExitCode.BAD_DATA: "bad data: an unreadable folder, no usable hemisphere, or no possible model",
    ExitCode.NOTHING_TO_DO: "nothing to process",
    ExitCode.INTERNAL: "internal error, or a page could not be made: please report it",
    ExitCode.NOT_WRITABLE: "the output folder cannot be written, or the disk is full",
    128 + SIGINT: "stopped by Ctrl-C; run the same command again to complete",
    128 + SIGTERM: "stopped by SIGTERM; run the same command again to complete",
}


class HipstaError(Exception):
    """Base of all foreseen errors; ``reason`` is a name for programs, if a file can hold it."""

    exit_code = ExitCode.BAD_DATA

    def __init__(self, message: str, *, reason: str = "") -> None:
        super().__init__(message)
        self.reason = reason

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        """Survive pickling between processes (the default forgets keyword arguments)."""
        return _rebuild, (type(self), str(self), self.reason)


def _rebuild(kind: type[HipstaError], message: str, reason: str) -> HipstaError:
    return kind(message, reason=reason)


class InputError(HipstaError):
    """A file or folder that the user gave cannot be used."""


class MissingFileError(InputError, FileNotFoundError):
    """A file or folder that the user gave does not exist."""


class NothingToDoError(HipstaError):
    """No segmentation matches the request."""

    exit_code = ExitCode.NOTHING_TO_DO


class UsageError(HipstaError):
    """The command line itself is wrong."""

    exit_code = ExitCode.USAGE


class ArgumentError(UsageError, ValueError):
    """An argument of a Python function is wrong; the command line names its option instead."""

    def __init__(self, argument: str, problem: str) -> None:
        super().__init__(f"{argument} {problem}")
        self.argument, self.problem = argument, problem

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        """Survive pickling between processes."""
        return type(self), (self.argument, self.problem)


class SettingsError(UsageError):
    """A setting is unknown or out of range."""


class MissingSettingsError(SettingsError, MissingFileError):
    """A file of settings does not exist."""


class ProtocolError(HipstaError):
    """A segmentation protocol file is wrong, or does not fit the labels."""


class MissingProtocolError(ProtocolError, MissingFileError):
    """A protocol file does not exist."""


class OutputError(HipstaError):
    """The output folder cannot be written."""

    exit_code = ExitCode.NOT_WRITABLE


class GeometryError(HipstaError):
    """The shape does not allow a trustworthy map; the reason names the step."""


class ModelError(HipstaError):
    """A statistical model cannot be fitted to these data."""


#: Arguments of Python functions, by the options that messages name.
_ARGUMENTS = {
    f"--{name}": f"{name}=" for name in ("correction", "formula", "probabilities", "settings")
}
_ARGUMENTS |= {"--scheme": "protocol=", "--contrast": "contrasts=", "--blocks": "blocks (setting)"}


@contextmanager
def in_python() -> Iterator[None]:
    """Name arguments of Python functions, not options, in messages of foreseen errors."""
    try:
        yield
    except HipstaError as error:
        options = r"--[a-z][a-z-]*"
        error.args = (re.sub(options, lambda o: _ARGUMENTS.get(o[0], o[0]), str(error)),)
        raise


def did_you_mean(words: Iterable[str], vocabulary: Iterable[str]) -> str:
    """Name the nearest known words as the end of a message; empty if none is near."""
    names = list(vocabulary)
    near = [match for word in words for match in difflib.get_close_matches(word, names, n=1)]
    return f"; did you mean {' '.join(near)}?" if near else ""
