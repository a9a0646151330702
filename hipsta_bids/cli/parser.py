"""The parser of every command, and the way from its options to a dataclass."""

import argparse
import math
import re
import sys
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from hipsta_bids.errors import UsageError, did_you_mean

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    Request = TypeVar("Request", bound=DataclassInstance)

#: Values that are paths, by what they are called in the help.
_PATHS = ("DIR", "FILE", "FILE.tsv", "FILE.toml", "FILE.json")
#: argparse's message about a word that is none of some.
_CHOICE = re.compile(r"invalid choice: '(?P<word>.*)' \(choose from (?P<known>.*)\)")
#: argparse's message about arguments without dashes that are missing.
_LACKING = re.compile(r"the following arguments are required: (?P<names>[^-].*)")
_OPTIONS = "OPTIONS"  # of another program: they may begin with a dash
_WORDS = 5  # of a call that a message repeats


class Parser(argparse.ArgumentParser):
    """Accepts underscores for hyphens in options; raises instead of exiting.

    With ``first`` options, ``--help`` shows these alone, and ``--help all`` shows all.
    """

    def __init__(
        self,
        prog: str,
        description: str,
        *,
        first: Sequence[str] = (),
        **options: Any,  # noqa: ANN401  (argparse's)
    ) -> None:
        super().__init__(
            prog=prog,
            description=description,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
            add_help=not first,
            **options,
        )
        self._words: list[str] = []
        if first:
            self.first = frozenset(first)
            self.add_argument(
                "-h",
                "--help",
                action=_Help,
                nargs="?",
                metavar="all",
                help="show the options that a first run needs, or all, and exit",
            )

    def format_first_help(self) -> str:
        """Return the help with the first options alone."""
        texts = {action: action.help for action in self._actions}
        for action in self._actions:
            if action.option_strings and self.first.isdisjoint(action.option_strings):
                action.help = argparse.SUPPRESS
        hidden = sum(action.help != texts[action] for action in self._actions)
        content = self.format_help()
        for action, text in texts.items():
            action.help = text
        hint = f"{hidden} more options: {self.prog} --help all"
        return content.replace(self.epilog or "", f"{hint}\n\n{self.epilog or ''}")

    def parse_known_args(self, args: Sequence[str], namespace: Any = None) -> Any:  # type: ignore[override]  # noqa: ANN401  (as in argparse, but without its overloads)
        """Parse options in either spelling; options of another program are a value.

        Unknown options are reported first: the next argument would be taken for something else.
        """
        spelled: list[str] = []
        for text in args:
            name, equals, value = text.partition("=")
            option = self._option_string_actions.get(spelled[-1]) if spelled else None
            if option is not None and option.metavar == _OPTIONS:
                spelled[-1] += f"={text}"
            elif text.startswith("--"):
                spelled.append(name.replace("_", "-") + equals + value)
            else:
                spelled.append(text)
        unknown = [
            text
            for text in spelled
            if text[2:]
            and text.startswith("--")
            and " " not in text.partition("=")[0]
            and text.partition("=")[0] not in self._option_string_actions
        ]
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        if namespace is None:  # the second pass of intermixed arguments lacks the options
            self._words = spelled
        return super().parse_known_args(spelled, namespace)

    def error(self, message: str) -> NoReturn:
        """Turn argparse's message into the package's error; name words like unknown ones."""
        hint = ""
        option, values = self._longest_values()
        if values and (lacking := _LACKING.match(message)):
            text = " ".join(["...", *values[-_WORDS:]] if len(values) > _WORDS else values)
            message = f"{option}: its values are {text}; write {option} after {lacking['names']}"
        unknown = message.removeprefix("unrecognized arguments: ")
        if unknown != message:
            words = [text.partition("=")[0] for text in unknown.split() if text.startswith("-")]
            hint = did_you_mean(words, self._option_string_actions)
            if not words and {"--formula", "--contrast"} & {*self._words}:
                hint = "; put the text of --formula and of each --contrast into quotes"
        elif choice := _CHOICE.search(message):
            choices = [name.strip("'\"") for name in choice["known"].split(", ")]
            hint = did_you_mean([choice["word"]], choices)
        raise UsageError(f"{message}{hint} (see {self.prog} --help)")

    def _longest_values(self) -> tuple[str, list[str]]:
        """Return the option with most values in a call, and these values."""
        options: list[tuple[str, list[str]]] = [("", [])]
        room = 0.0
        for word in self._words:
            if word.startswith("-"):
                nargs = getattr(self._option_string_actions.get(word), "nargs", None)
                room = {"+": math.inf, "?": 1.0}.get(str(nargs), 0.0)
                options.append((word, []))
            elif room > 0:
                options[-1][1].append(word)
                room -= 1
        return max(options, key=lambda pair: len(pair[1]))


class _Help(argparse.Action):
    """Print the help, and end."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        _namespace: argparse.Namespace,
        values: object,
        _option: str | None = None,
    ) -> None:
        content = parser.format_help()
        if isinstance(parser, Parser) and values != "all":
            content = parser.format_first_help()
        sys.stdout.write(content)
        parser.exit()


def accept(parser: argparse.ArgumentParser, options: Mapping[str, str]) -> None:
    """Accept options that have no meaning here; ``--name VALUE`` takes a value. Not in the help.

    The options given are in ``ignored`` of the namespace, in pairs with the reason.
    """
    for name, reason in options.items():
        flag, _, value = name.partition(" ")
        pair = flag, reason
        kind: dict[str, Any] = (
            {"action": "append", "type": lambda _, pair=pair: pair}
            if value
            else {"action": "append_const", "const": pair}
        )
        parser.add_argument(flag, dest="ignored", default=[], help=argparse.SUPPRESS, **kind)


@cache
def help_texts(package: str = "hipsta_bids.cli") -> dict[str, dict[str, str]]:
    """Read the texts of the help of a package, by command."""
    return tomllib.loads((files(package) / "help.toml").read_text(encoding="utf-8"))


def parser_of(command: str, package: str = "hipsta_bids.cli") -> tuple[Parser, Callable[..., None]]:
    """Return the parser of a command, and the function that adds an argument to it."""
    texts = help_texts(package)[command]
    parser = Parser(f"hipsta-bids {command}", texts["description"], epilog=texts.get("epilog"))
    return parser, adder(parser, command, package)


def adder(
    group: argparse._ActionsContainer, command: str = "", package: str = "hipsta_bids.cli"
) -> Callable[..., None]:
    """Return a function that adds an argument to a group: spellings, value, text, and more.

    Without a value it is a switch; ``A B`` takes two values; ``A...`` takes several,
        and more when
    it is repeated. Paths are recognized by the value's name, numbers by the
        default. The texts of a ``command`` are in ``help.toml`` of the ``package``.
    """

    def add(flags: str, value: str = "", text: str = "", **options: Any) -> None:  # noqa: ANN401  (argparse's)
        if value.endswith("..."):
            value = value.removesuffix("...")
            options |= {"nargs": "+", "action": "extend", "default": []}
        if " " in value:
            options |= {"metavar": tuple(value.split()), "nargs": len(value.split())}
        elif value:
            options["metavar"] = value
        elif not options:
            options["action"] = "store_true"
        if value in _PATHS:
            options["type"] = Path
        elif isinstance(options.get("default"), int | float) and "action" not in options:
            options.setdefault("type", type(options["default"]))
        names = flags.split()
        group.add_argument(*names, help=text or help_texts(package)[command][names[0]], **options)

    return add


def from_namespace(
    kind: "type[Request]",
    options: argparse.Namespace,
    **extras: Any,  # noqa: ANN401  (fields of any type)
) -> "Request":
    """Fill a dataclass with the options of the same names, lists as tuples, and further fields."""
    names = {field.name for field in fields(kind)} - extras.keys()
    values = {name: value for name, value in vars(options).items() if name in names}
    frozen = {name: tuple(v) if isinstance(v, list) else v for name, v in values.items()}
    return kind(**frozen, **extras)


# Converters of values; `tools/descriptors.py` knows them by name.


def bids_label(prefix: str) -> Callable[[str], str]:
    """Return a converter that reads a BIDS label with or without its prefix."""

    def convert(text: str) -> str:
        label = text.removeprefix(prefix)
        if not label.isalnum():
            raise argparse.ArgumentTypeError(f"{text!r} is not a BIDS label (letters and digits)")
        return label

    return convert


def subject_label(text: str) -> str:
    """Read a subject's BIDS label, or what may be the name of its FreeSurfer folder."""
    label = text.removeprefix("sub-")
    if not any(map(str.isalnum, label)) or "/" in label:
        raise argparse.ArgumentTypeError(f"{text!r} is not a BIDS label (letters and digits)")
    return label


def named_pattern(text: str) -> tuple[str, str]:
    """Read ``NAME=PATTERN``."""
    return _pair(text, "NAME=PATTERN")


def factor_level(text: str) -> tuple[str, str]:
    """Read ``FACTOR=LEVEL``."""
    return _pair(text, "FACTOR=LEVEL")


def model_text(text: str) -> str:
    r"""Read a formula or contrast; ``\|`` of a Markdown table, as in our guide, is a bar."""
    return text.replace("\\|", "|")


def _pair(text: str, form: str) -> tuple[str, str]:
    name, _, value = text.partition("=")
    if not (name and value):
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form {form}")
    return name, value


def named_path(text: str) -> tuple[str, Path]:
    """Read ``NAME=PATH``, or a path, whose last part is then the name."""
    name, equals, path = text.partition("=")
    if equals and name and path:
        return name, Path(path)
    folder = Path(text)
    if equals or not folder.name:
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form NAME=PATH")
    return folder.name, folder


def site_path(text: str) -> tuple[str | None, Path]:
    """Read ``NAME=PATH``, or a path."""
    name, equals, path = text.partition("=")
    if equals and name and "/" not in name:
        return name, Path(path)
    return None, Path(text)


def given_settings(choices: Mapping[str, Mapping[str, object]]) -> dict[str, dict[str, object]]:
    """Keep the settings, by group, that an option has set."""
    return {
        group: {name: value for name, value in options.items() if value is not None}
        for group, options in choices.items()
    }


def positive_int(text: str) -> int:
    """Read a whole number above 0."""
    if not text.isascii() or not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number above 0")
    return int(text)


def positive_float(text: str) -> float:
    """Read a finite number above 0."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return value
