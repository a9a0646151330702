"""The joints at which extensions meet the program: separate commands, and parts of an analysis.

An extension is a folder of ``hipsta_bids.extensions``, whose ``__init__`` declares it. It names its
functions as ``module:function``; they are loaded when they are called.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

#: Writes files of a part into the folder of an analysis.
Writer = Callable[[Path], None]


def load(place: str) -> Any:  # noqa: ANN401  (what the module has by this name)
    """Load a function, or a table, by ``module:name``."""
    module, _, name = place.partition(":")
    return getattr(import_module(module), name)


@dataclass(frozen=True, kw_only=True)
class Command:
    """A command other than the BIDS App."""

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
class Question:
    """What options of the group level ask instead of a comparison."""

    flags: tuple[str, ...]
    """Names in Python of the options that ask it."""
    dependents: tuple[str, ...]
    """Names of options that have no effect without it."""
    without: str
    """How a message says that it is not asked."""
    options: str
    """Function that adds its options to the parser."""
    run: str
    """Function of the parsed options, the options and the settings of the group level."""
    settings: str = ""
    """Function of the parsed options; returns what they set, by table of the settings."""


@dataclass(frozen=True, kw_only=True)
class Extension:
    """What a folder adds to the program."""

    package: str
    meaning: str
    """One sentence."""
    commands: tuple[Command, ...] = ()
    parts: tuple[Part, ...] = ()
    questions: tuple[Question, ...] = ()
    sections: str = ""
    """Sections of the page of an analysis, as ``module:tuple``."""
    has_templates: bool = False
    """Whether the folder has templates of pages."""


@cache
def find_extensions() -> tuple[Extension, ...]:
    """Find the extensions whose folders exist, in the order of the registry."""
    registry = "hipsta_bids.extensions"
    specs = {name: find_spec(f"{registry}.{name}") for name in import_module(registry).NAMES}
    # A folder without its files has no origin.
    present = [name for name, spec in specs.items() if spec is not None and spec.origin]
    return tuple(import_module(f"{registry}.{name}").EXTENSION for name in present)


def is_present(name: str) -> bool:
    """Check whether the folder of an extension exists."""
    return any(extension.package.endswith(f".{name}") for extension in find_extensions())


def find_parts() -> tuple[Part, ...]:
    """Find what extensions add to the results of a comparison."""
    return tuple(part for extension in find_extensions() for part in extension.parts)


def find_questions() -> tuple[Question, ...]:
    """Find what extensions can be asked instead of a comparison."""
    return tuple(question for extension in find_extensions() for question in extension.questions)
