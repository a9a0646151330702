"""The joints at which extensions meet the program: commands of their own, and parts of an analysis.

An extension is a folder of ``hipsta_bids.extensions``, whose ``__init__`` declares it. It names its
functions as ``module:function``; they are loaded when they are called.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

#: Writes files of a part into the folder of an analysis.
Writer = Callable[[Path], None]


def load(place: str) -> Callable[..., Any]:
    """Load a function by ``module:function``."""
    module, _, name = place.partition(":")
    function: Callable[..., Any] = getattr(import_module(module), name)
    return function


@dataclass(frozen=True, kw_only=True)
class Command:
    """A command beside the BIDS App."""

    name: str
    run: str
    """Function of the arguments; returns the exit code."""
    arguments: str = ""
    """For the help."""
    meaning: str | None = None
    """For the help; ``None`` hides the command."""
    parser: str | None = None
    """Function that returns the parser, for the documentation."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """A block of the results of a comparison, which an option of the group level asks for."""

    option: str
    """With dashes."""
    value: str
    """What the option takes, for the help; it may be without a value."""
    text: str
    """Help of the option."""
    heading: str
    """Group of options, for the help."""
    make: str
    """Function of study, analysis and the option's value; returns a `Writer`, and notes."""

    @property
    def name(self) -> str:
        """Name of the option in Python."""
        return self.option.removeprefix("--").replace("-", "_")


@dataclass(frozen=True, kw_only=True)
class Extension:
    """What a folder adds to the program."""

    name: str
    meaning: str
    """One sentence."""
    commands: tuple[Command, ...] = ()
    parts: tuple[Part, ...] = ()
