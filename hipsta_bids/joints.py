"""The joints at which extensions meet the program: separate commands, and parts of an analysis.

An extension is a folder of ``hipsta_bids.extensions``, whose ``__init__`` declares it. It names its
functions as ``module:function``; they are loaded when they are called.
"""

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from importlib.resources import files
from importlib.util import find_spec
from itertools import chain
from operator import attrgetter
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
    meaning: str
    """For the help."""
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
class Step:
    """What an option adds to the line of an analysis, and to its results."""

    name: str
    """Key of its plan and its result in an analysis, and of its entry in the record."""
    flag: str
    """How messages name it."""
    names: tuple[str, ...]
    """Names in Python of its options."""
    condition: str
    """Function of a request: whether it is asked."""
    plan: str
    """Function of a request; returns what its functions need."""
    options: str = ""
    """Function that adds its options to the parser."""
    excludes: tuple[str, ...] = ()
    """Flags beside which it is refused."""
    contrasts: str = ""
    """Function of the texts of contrasts; returns texts of the contrasts that are fitted."""
    settings: str = ""
    """Function of the parsed options and the settings; returns the settings, or refuses both."""
    setting: str = ""
    """Setting that asks it, too, as ``table.name``."""
    permutes: str = ""
    """Setting that asks it, as ``table.name``, of a step that permutes."""
    records: tuple[str, ...] = ()
    """Keys of the record, ``None`` in analyses that do not ask it."""
    comparison: tuple[str, ...] = ()
    """Names of options that are recorded with sessions and sides."""
    inputs: Mapping[str, str] = field(default_factory=dict)
    """Keys of the record of inputs, by the names of options that are paths."""
    places: Mapping[str, str] = field(default_factory=dict)
    """Functions of an analysis and the plan, which return the analysis, by place of the line:
    ``design`` (after it), ``adjust`` (registered maps, before sessions are compared), ``tests``
    (after ``design`` and each fit of maps, before its correction), ``score`` (after the fit),
    ``summarize`` (after the fit of summary measures), ``classify`` (before it). Of ``surfaces``,
    the last place, functions take and return the analyses of all surfaces, by name."""
    blocks: Mapping[str, str] = field(default_factory=dict)
    """Functions that yield parts of results, by place: ``tables``, ``figures``, ``files``,
    ``methods`` (before the model), ``methods-model`` (after it), ``methods-after`` (at the end),
    ``record``, ``source`` (of labels that a plan rests on), ``columns`` (meanings, by column of
    tables of tests), ``rows`` (what makes the model of rows, with a random intercept)."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """What a study has beside the sheets: another kind of map, of summary measure, or a mask."""

    options: str
    """Function that adds its options to the parser of the group level."""
    make: str
    """Function of the parsed options; returns sources (`hipsta_bids.group.cohort.sources`)."""


@dataclass(frozen=True, kw_only=True)
class SessionChoice:
    """Which sessions of a participant can be compared, beside the first."""

    names: tuple[str, ...]
    """Names in Python of its options."""
    hint: str
    """How a note names them."""
    options: str
    """Function that adds them, by a function that adds one."""
    settings: str
    """Function of the parsed options; returns what they set, by table of the settings."""
    make: str
    """Function of the parsed options and the settings; returns the sessions
    (`hipsta_bids.group.model.Sessions`), ``None`` for the default."""
    page: str
    """Function of the record of a comparison; returns the description of a row and the name of the
    estimate that may be missing, ``None`` for the default."""


@dataclass(frozen=True, kw_only=True)
class Page:
    """A page that ``--reports-only`` makes again, beside the pages of analyses."""

    record: str
    """File of a folder of the group level that has this page."""
    make: str
    """Function of the folder; returns the page."""


@dataclass(frozen=True, kw_only=True)
class Region:
    """An experimental region, which the participant level measures instead of the body."""

    name: str
    measure: str
    """Function as ``measure_hemisphere``: of labels, hemisphere, settings and clock."""
    meaning: str = ""
    """For the help."""


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """What options of the participant level add to each measured hemisphere."""

    name: str
    """Of the option in Python, or of an addition to the inputs; and of its stage."""
    after: str
    """Function of a job, its labels, its maps and its quality record, which it may change; returns
    the maps, and a function that writes further files."""
    is_complete: str
    """Function of a job and its quality record: whether its files exist as the option asks."""
    options: str = ""
    """Function that adds the option to a group of the parser."""
    cost: str = ""
    """Function of the option's value: how many times as long a hemisphere takes."""
    tables: tuple[str, ...] = ()
    """Keys of tables with further maps, a row per node."""
    columns: str = ""
    """Function of a hemisphere of a page; returns further maps of its sheet, by name."""
    pictures: str = ""
    """Function of measured hemispheres of a page; returns pictures, and lines below them."""


@dataclass(frozen=True, kw_only=True)
class Input:
    """What options of the participant level add to the inputs of each hemisphere."""

    options: str
    """Function that adds its options to the parser."""
    make: str
    """Function of the parsed options; returns a function of inputs, which returns these with
    additions (``HemisphereInput.further``), notes and warnings."""


@dataclass(frozen=True, kw_only=True)
class Grouping:
    """Hemispheres that are measured together (``Job.visits``): all are inputs of each."""

    setting: str
    """Setting of the participant level that asks it, as ``table.name``."""
    commands: Mapping[str, tuple[str, ...]]
    """Words of a command line that ask it, by values of the setting. Others do not."""
    options: str
    """Function that adds its options to a group of the parser."""
    settings: str
    """Function of the parsed options and the settings; returns the settings, or refuses both."""
    advice: str
    """Function of two values of the setting: how a folder was made with the first one, and what to
    do; empty for other values."""
    notes: str
    """Function of inputs; returns notes on their groups."""
    gather: str
    """Function of jobs; returns them in groups."""
    run: str
    """Function of a group; returns outcomes."""
    is_complete: str
    """Function of a job of a group: whether its files exist."""
    methods: str
    """Function of settings; returns sentences of the methods text."""
    columns: str
    """As of `Measurement`."""

    def is_asked(self, settings: Any) -> bool:  # noqa: ANN401  (of the participant level)
        """Check whether settings ask it."""
        table, name = self.setting.split(".")
        return getattr(getattr(settings, table), name) in self.commands


@dataclass(frozen=True, kw_only=True)
class Engine:
    """Workers that options of the participant level choose instead of this machine's."""

    options: str
    """Function that adds its options to a group of the parser."""
    make: str
    """Function of the parsed options; returns what runs jobs (``RunJobs`` of
    `hipsta_bids.participant.pool`), ``None`` if it is not asked."""


@dataclass(frozen=True, kw_only=True)
class Extension:
    """What a folder adds to the program."""

    package: str
    meaning: str
    """One sentence."""
    commands: tuple[Command, ...] = ()
    parts: tuple[Part, ...] = ()
    questions: tuple[Question, ...] = ()
    steps: tuple[Step, ...] = ()
    sources: tuple[Source, ...] = ()
    settings: tuple[tuple[str, str, str], ...] = ()
    """Tables of settings: level (``participant``, ``group``), name, and class as ``module:name``.
    Under the name of a table of the core, its settings are added to that table."""
    pages: tuple[Page, ...] = ()
    sessions: tuple[SessionChoice, ...] = ()
    protocols: str = ""
    """Function of the options and settings of the group level, and of protocols: runs each."""
    functions: tuple[str, ...] = ()
    """Functions of the Python interface, as ``module:name``."""
    regions: tuple[Region, ...] = ()
    inputs: tuple[Input, ...] = ()
    measurements: tuple[Measurement, ...] = ()
    groupings: tuple[Grouping, ...] = ()
    engines: tuple[Engine, ...] = ()
    sections: str = ""
    """Sections of the page of an analysis, as ``module:tuple``."""
    participant_sections: str = ""
    """Sections of the page of a participant."""
    findings: str = ""
    """Sentences on discoveries: function of the results of a comparison; returns a template and
    its values, ``None`` without any."""
    addition: str = ""
    """What each comparison adds: function of study and analysis; as ``Part.make``."""
    figures: str = ""
    """Function of the results of a comparison; yields its figures, by name."""

    def has(self, name: str) -> bool:
        """Check for ``columns.toml`` (of tables), ``texts.toml`` (files) or ``templates``."""
        place = files(self.package) / name
        return place.is_file() or place.is_dir()


@cache
def find_extensions() -> tuple[Extension, ...]:
    """Find the extensions whose folders exist, in the order of the registry."""
    registry = "hipsta_bids.extensions"
    specs = {name: find_spec(f"{registry}.{name}") for name in import_module(registry).NAMES}
    # A folder without its files has no origin.
    present = [name for name, spec in specs.items() if spec is not None and spec.origin]
    return tuple(import_module(f"{registry}.{name}").EXTENSION for name in present)


def _gather(kind: str) -> tuple[Any, ...]:
    """Gather what all extensions declare of a kind, the name of a field of `Extension`."""
    return tuple(chain.from_iterable(getattr(extension, kind) for extension in find_extensions()))


def load_all(kind: str) -> list[Any]:
    """Load the function or table that each extension names in a field of `Extension`."""
    places = (getattr(extension, kind) for extension in find_extensions())
    return [load(place) for place in places if place]


@cache
def read_texts(package: str) -> dict[str, Any]:
    """Read the ``texts.toml`` of an extension."""
    return tomllib.loads((files(package) / "texts.toml").read_text(encoding="utf-8"))


def find_texts(kind: str) -> dict[str, dict[str, Any]]:
    """Collect the tables of texts of extensions of a kind, joined where they have one key."""
    texts: dict[str, dict[str, Any]] = {}
    for extension in find_extensions():
        if extension.has("texts.toml"):
            for key, table in read_texts(extension.package).get(kind, {}).items():
                texts[key] = texts.get(key, {}) | table
    return texts


def is_present(name: str) -> bool:
    """Check whether the folder of an extension exists."""
    return any(extension.package.endswith(f".{name}") for extension in find_extensions())


def find_regions() -> dict[str, Region]:
    """Find the regions of extensions, by name."""
    return {region.name: region for region in _gather("regions")}


def find_measurements() -> tuple[Measurement, ...]:
    """Find what options of extensions add to measured hemispheres."""
    return _gather("measurements")


def find_inputs() -> tuple[Input, ...]:
    """Find what options of extensions add to inputs."""
    return _gather("inputs")


def find_groupings() -> tuple[Grouping, ...]:
    """Find which hemispheres can be measured together."""
    return _gather("groupings")


def find_engines() -> tuple[Engine, ...]:
    """Find workers elsewhere."""
    return _gather("engines")


def find_grouping(settings: Any) -> Grouping | None:  # noqa: ANN401  (of the participant level)
    """Find how these settings measure hemispheres together; ``None`` is each alone."""
    return next((grouping for grouping in find_groupings() if grouping.is_asked(settings)), None)


def find_columns() -> list[str]:
    """Find functions of a hemisphere of a page that return further maps of its sheet."""
    places = (part.columns for part in _gather("measurements") + _gather("groupings"))
    return [place for place in places if place]


def find_parts() -> tuple[Part, ...]:
    """Find what extensions add to the results of a comparison."""
    return _gather("parts")


def find_protocols() -> str:
    """Find the function that analyzes several protocols; empty without an extension."""
    return next((found.protocols for found in find_extensions() if found.protocols), "")


def find_functions() -> dict[str, str]:
    """Find functions of the Python interface: their modules, by name."""
    places = (place.split(":") for place in _gather("functions"))
    return {name: module for module, name in places}


def find_sources() -> tuple[Source, ...]:
    """Find what extensions read beside the sheets, in the order of reading."""
    return _gather("sources")


def find_settings(level: str) -> dict[str, Any]:
    """Load tables of settings of a level, by name; two extensions may share one."""
    return {name: load(place) for of, name, place in _gather("settings") if of == level}


def find_sessions() -> tuple[SessionChoice, ...]:
    """Find which sessions can be compared, beside the first of each participant."""
    return _gather("sessions")


def find_questions() -> tuple[Question, ...]:
    """Find what extensions can be asked instead of a comparison."""
    return _gather("questions")


def find_steps() -> tuple[Step, ...]:
    """Find what extensions add to the line of an analysis."""
    return _gather("steps")


def fitted_contrasts(texts: tuple[str, ...]) -> tuple[str, ...]:
    """Return texts of the contrasts that are fitted, by the texts of the user."""
    for step in find_steps():
        texts = load(step.contrasts)(texts) if step.contrasts else texts
    return texts


def find_permuting(settings: Any) -> dict[str, bool]:  # noqa: ANN401  (of the group level)
    """Find the flags of steps that permute, and whether settings ask them."""
    steps = (step for step in find_steps() if step.permutes)
    return {step.flag: bool(attrgetter(step.permutes)(settings)) for step in steps}
